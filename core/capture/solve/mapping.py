# SPDX-License-Identifier: GPL-3.0-or-later
"""pycolmap's part of a solve: features, matches and incremental mapping, in steps that can be stopped.

Features and matches go into a database batch by batch; what it holds is not made again.
"""
from __future__ import annotations

import contextlib
import shutil
import signal
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...errors import CaptureError, EngineError
from ...images.read import decoded
from ...images.size import picture_size
from ...system.files import read_json, write_json, write_text
from ...system.progress import Progress
from ..camera import Floats
from ..colmap import read_model
from ..lens import MODELS, Lens
from .pairs import choose_matching, choose_pairs
from .stills import Still

if TYPE_CHECKING:
    from . import SolveSettings

DATABASE, MAPPED, FOUND = "database.db", "mapped.json", "models"  # of the work that can be gone on with
DEFAULT_FOCAL = 1.2  # of the long side, where the file does not tell; COLMAP's own guess
ENOUGH = 20          # frames from which a principal point can be told from a turn of the cameras
OFF_CENTRE = 0.015   # of the long side; a principal point further from the middle is an artefact
PLAIN = 800          # corners below which a frame has too little texture for the usual threshold of features
MATCHES = 15         # verified ones from which two frames count as matched
MOVED = 1.0          # pixels of the small pictures; less is no motion


@dataclass(eq=False)
class SolvedFrame:
    """A registered frame: index of its still, lens and observations at the size of its small picture."""

    still: int
    lens: Lens
    world_to_camera: Floats
    pixels: Floats
    points: NDArray[np.int64]


@dataclass(eq=False)
class Model:
    """Points (n, 3), colours (n, 3) uint8, errors (n,) in pixels of the small pictures, track lengths (n,)."""

    xyz: Floats
    rgb: NDArray[np.uint8]
    error: Floats
    tracks: NDArray[np.int64]
    frames: list[SolvedFrame]


@dataclass(eq=False)
class Solved:
    """The largest model, how many frames each model found has, and how the frames were matched."""

    model: Model
    sizes: list[int]
    matching: str
    pairs: int

    @property
    def frames(self) -> list[SolvedFrame]:
        """The registered frames."""
        return self.model.frames


def solve(stills: Sequence[Still], work: Path, settings: SolveSettings, video: bool, progress: Progress) -> Solved:
    """From small pictures and masks below `work` to the largest model. See `core.capture.solve.solve`."""
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    pycolmap.set_random_seed(settings.seed)
    database = work / DATABASE
    _refuse_one_picture(stills, work)
    _extract(pycolmap, stills, work, database, settings, progress)
    matching = choose_matching(settings.matching, len(stills), video)
    pairs = _match(pycolmap, stills, work, database, matching, settings, progress)
    _refuse_without_parallax(pycolmap, database, settings.size)
    models = _map(pycolmap, work, database, len(stills), settings, progress)
    if not models:
        raise CaptureError("The frames match, but no two of them give a reliable start; film with more sideways "
                           "motion or choose more frames.")
    largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    if settings.principal_point and largest.num_reg_images() >= ENOUGH:
        progress.stage("find principal point", 1)
        largest = _with_principal_point(pycolmap, largest)
        progress.advance()
    names = {still.name: index for index, still in enumerate(stills)}
    return Solved(_model(largest, names), sorted((m.num_reg_images() for m in models), reverse=True), matching, pairs)


def check(work: Path) -> None:
    """Raises CaptureError where the database or a model of an earlier run is damaged, for instance cut off by a power
    failure: pycolmap reads such a model without end."""
    database = work / DATABASE
    if database.is_file():
        try:
            with contextlib.closing(sqlite3.connect(database)) as opened:
                told = opened.execute("PRAGMA quick_check").fetchone()[0]
        except sqlite3.DatabaseError as problem:
            told = str(problem)
        if told != "ok":
            raise CaptureError(f"{database} is damaged ({told}).")
    for folder in _mapped(work) or ():
        read_model(folder)


def load_pycolmap() -> Any:
    """The module; EngineError where it is not installed.

    OpenCV is imported first: the other way round its PNG writer finds pycolmap's libpng and aborts the process
    (seen with pycolmap 4.2.1 and OpenCV 4.11).
    """
    try:
        import cv2  # noqa: F401
        import pycolmap
    except ImportError as problem:
        raise EngineError("solve needs pycolmap and OpenCV; install them with: pip install pycolmap "
                          "opencv-contrib-python-headless.") from problem
    if threading.current_thread() is threading.main_thread():
        # Its logging takes the signal that asks a process to end, and ends it with a trace of the stack.
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return pycolmap


def _refuse_one_picture(stills: Sequence[Still], work: Path) -> None:
    """Stop early where every frame shows the same: nothing moves."""
    import cv2

    first: Any = None
    for still in stills:
        small = _grey(work / "small" / still.name)
        tiny = cv2.resize(small, (64, 64), interpolation=cv2.INTER_AREA).astype(np.float32)
        first = tiny if first is None else first
        if np.abs(tiny - first).max() > 3:
            return
    raise CaptureError(f"All {len(stills)} frames show the same picture; a solve needs a camera that moves.")


def _extract(pycolmap: Any, stills: Sequence[Still], work: Path, database: Path, settings: SolveSettings,
             progress: Progress) -> None:
    """Features of every frame that has none yet; one camera for all frames of one size and focal length."""
    with _opened(pycolmap, database) as db:
        done = {image.name for image in db.read_all_images()
                if db.num_keypoints_for_image(image.image_id) or db.exists_descriptors(image.image_id)}
        cameras: dict[tuple[int, int, float | None], int] = {}
        known = {(c.width, c.height, round(c.params[0], 6)): c.camera_id for c in db.read_all_cameras()}
        groups: dict[tuple[int, bool], list[str]] = {}
        for still in stills:
            key = (still.width, still.height, still.focal)
            if key not in cameras:
                camera = _camera(pycolmap, picture_size(work / "small" / still.name), still.focal, settings.lens)
                mark = (camera.width, camera.height, round(camera.params[0], 6))
                cameras[key] = known.get(mark) or db.write_camera(camera)
                known[mark] = cameras[key]
            if still.name not in done:
                groups.setdefault((cameras[key], _is_plain(work / "small" / still.name)), []).append(still.name)
    progress.stage("find features", len(stills), len(done))
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = settings.features
    options.use_gpu = False
    reader = pycolmap.ImageReaderOptions()
    if settings.mask:
        reader.mask_path = str(work / "masks")
    usual = options.sift.peak_threshold
    for (camera_id, plain), names in groups.items():
        reader.existing_camera_id = camera_id
        # Walls and skies: weak features are better than none.
        options.sift.peak_threshold = 0.4 * usual if plain else usual
        for at in range(0, len(names), 8):
            pycolmap.extract_features(database, work / "small", image_names=names[at:at + 8],
                                      camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                                      extraction_options=options, device=pycolmap.Device.cpu)
            progress.advance(len(names[at:at + 8]))


def _is_plain(small: Path) -> bool:
    """Whether a picture has little texture, by a quick count of corners."""
    import cv2

    return len(cv2.FastFeatureDetector.create(12).detect(_grey(small))) < PLAIN


def _grey(path: Path) -> NDArray[np.uint8]:
    """(height, width) of one of our own pictures. Raises CaptureError where it was damaged since."""
    import cv2

    picture = decoded(path, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise CaptureError(f"{path} is damaged; remove the folder {path.parents[1]} and solve again.")
    return np.asarray(picture, np.uint8)


def _camera(pycolmap: Any, size: tuple[int, int], focal: float | None, model: str) -> Any:
    """A camera of the wanted model with a focal length to start from."""
    width, height = size
    camera = pycolmap.Camera.create_from_model_name(0, model, (focal or DEFAULT_FOCAL) * max(size), width, height)
    camera.has_prior_focal_length = focal is not None
    return camera


def _match(pycolmap: Any, stills: Sequence[Still], work: Path, database: Path, matching: Any,
           settings: SolveSettings, progress: Progress) -> int:
    """Match and verify the chosen pairs that have not been; returns how many were chosen."""
    with _opened(pycolmap, database) as db:
        ids = [db.read_image_with_name(still.name).image_id for still in stills]
        pairs = choose_pairs(matching, len(stills), lambda i: np.asarray(db.read_descriptors(ids[i]).data),
                             settings.seed)
        open_pairs = [(i, j) for i, j in pairs if not db.exists_two_view_geometry(ids[i], ids[j])]
    progress.stage("match frames", len(pairs), len(pairs) - len(open_pairs))
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed
    listing = pycolmap.ImportedPairingOptions()
    listing.match_list_path = str(work / "pairs.txt")
    for at in range(0, len(open_pairs), 100):
        batch = open_pairs[at:at + 100]
        write_text(work / "pairs.txt", "".join(f"{stills[i].name} {stills[j].name}\n" for i, j in batch))
        pycolmap.match_image_pairs(database, matching_options=options, pairing_options=listing,
                                   verification_options=verification, device=pycolmap.Device.cpu)
        progress.advance(len(batch))
    return len(pairs)


def _map(pycolmap: Any, work: Path, database: Path, frames: int, settings: SolveSettings,
         progress: Progress) -> list[Any]:
    """Incremental mapping; all models found, by this run or an earlier one."""
    before = _mapped(work)
    if before is not None:
        return [pycolmap.Reconstruction(str(model)) for model in before]
    folder = work / FOUND
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.max_num_models = 8
    options.random_seed = settings.seed
    options.mapper.random_seed = settings.seed
    options.triangulation.random_seed = settings.seed
    progress.stage("place cameras", frames)
    token = pycolmap.CancellationToken()
    placed = 0
    failures: list[Exception] = []

    def step(count: int) -> None:
        # An exception may not cross pycolmap: its token ends the mapping, and it is raised thereafter.
        nonlocal placed
        placed += count
        try:
            progress.advance(count if placed <= frames else 0)
        except Exception as problem:
            failures.append(problem)
            token.cancel()

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        models = pycolmap.incremental_mapping(
            database, work / "small", folder, options, initial_image_pair_callback=lambda: step(2),
            next_image_callback=lambda: step(1), cancellation_token=token)
    except InterruptedError:
        if failures:
            raise failures[0] from None
        progress.check()
        raise
    if failures:  # what was found by then is not all there is, and not to be taken for it by the next solve
        raise failures[0]
    progress.check()
    for number, model in models.items():
        (folder / str(number)).mkdir(exist_ok=True)
        model.write(str(folder / str(number)))
    write_json(work / MAPPED, [str(number) for number in models])
    return list(models.values())


def _mapped(work: Path) -> list[Path] | None:
    """The folders of the models that were found, None where that is still to do. Raises CaptureError where what is
    written down makes no sense."""
    if not (work / MAPPED).is_file():
        return None
    names = read_json(work / MAPPED, CaptureError)
    if not isinstance(names, list) or not all(isinstance(name, str) and name.isdecimal() for name in names):
        raise CaptureError(f"{work / MAPPED} is damaged.")
    return [work / FOUND / name for name in names]


def _with_principal_point(pycolmap: Any, found: Any) -> Any:
    """The reconstruction adjusted once more with its principal points free, or as it was where one of them
    strays further than a lens can be off centre: then the views do not determine it."""
    moved = pycolmap.Reconstruction(found)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    # Not pycolmap.bundle_adjustment, which writes to standard error whatever the log level.
    config = pycolmap.BundleAdjustmentConfig()
    for image in moved.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, moved).solve()
    moved.update_point_3d_errors()
    for camera in moved.cameras.values():
        off = np.hypot(camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2)
        if not off < OFF_CENTRE * max(camera.width, camera.height):
            return found
    return moved


def _refuse_without_parallax(pycolmap: Any, database: Path, size: int) -> None:
    """Stop before mapping where matched features show that depth cannot be measured: mapping would go on for long
    and might come back with a model of nothing."""
    configuration = pycolmap.TwoViewGeometryConfiguration
    flat = (configuration.PLANAR_OR_PANORAMIC, configuration.PANORAMIC)
    moves, parallax = [], 0
    with _opened(pycolmap, database) as db:
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            matches = np.asarray(geometry.inlier_matches)
            if len(matches) < MATCHES:
                continue
            first, second = (np.asarray(db.read_keypoints(image), np.float64)[:, :2]
                             for image in pycolmap.pair_id_to_image_pair(pair_id))
            moves.append(float(np.median(np.linalg.norm(first[matches[:, 0]] - second[matches[:, 1]], axis=1))))
            parallax += geometry.config not in flat
    if not moves:
        raise CaptureError("The frames share too few features to place a camera; film with more overlap, more texture "
                           "or less blur.")
    if np.median(moves) < MOVED:
        raise CaptureError(f"The camera hardly moves: matched features shift by {np.median(moves):.2f} pixels at "
                           f"{size}; a solve needs a camera that travels.")
    if parallax < 0.02 * len(moves):
        raise CaptureError("The camera turns but does not travel, or sees one flat surface only: there is no parallax "
                           "to measure depth by.")


def _model(reconstruction: Any, names: dict[str, int]) -> Model:
    """pycolmap's reconstruction as plain arrays."""
    ids = sorted(reconstruction.points3D)
    index = {point: i for i, point in enumerate(ids)}
    points = [reconstruction.points3D[i] for i in ids]
    lenses = {number: Lens(camera.model.name, tuple(camera.params), camera.width, camera.height)
              for number, camera in reconstruction.cameras.items()}
    assert all(lens.model in MODELS for lens in lenses.values())
    frames = []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        seen = image.get_observation_points2D()
        frames.append(SolvedFrame(names[image.name], lenses[image.camera_id], pose,
                                  np.array([point.xy for point in seen], np.float64).reshape(-1, 2),
                                  np.array([index[point.point3D_id] for point in seen], np.int64)))
    return Model(np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
                 np.array([point.color for point in points], np.uint8).reshape(-1, 3),
                 np.array([point.error for point in points], np.float64),
                 np.array([point.track.length() for point in points], np.int64),
                 sorted(frames, key=lambda frame: frame.still))


@contextlib.contextmanager
def _opened(pycolmap: Any, database: Path) -> Iterator[Any]:
    db = pycolmap.Database.open(database)
    try:
        yield db
    finally:
        db.close()


__all__ = ["Model", "Solved", "SolvedFrame", "solve"]
