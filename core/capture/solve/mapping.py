# SPDX-License-Identifier: GPL-3.0-or-later
"""pycolmap's part of a solve: features, matches and incremental mapping, in steps that can be stopped.

Features and matches go into a database batch by batch; a resumed solve does not compute them again.
"""
from __future__ import annotations

import contextlib
import re
import shutil
import signal
import sqlite3
import threading
import traceback
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...errors import CaptureError, EngineError, is_out_of_memory
from ...images.read import decode_by_opencv
from ...images.size import picture_size
from ...system.files import read_json, write_json, write_text
from ...system.progress import Progress
from ..camera import Floats
from ..colmap import read_model
from ..lens import MODELS, Lens
from .pairs import choose_matching, choose_pairs
from .source_frames import SourceFrame

if TYPE_CHECKING:
    from . import SolveSettings

DATABASE, MODELS_FILE, MODELS_FOLDER = "database.db", "mapped.json", "models"
"""Files of the work that can be resumed."""
DEFAULT_FOCAL = 1.2
"""Focal length, in long sides, where the file has none; COLMAP's default."""
MIN_FRAMES_FOR_PRINCIPAL_POINT = 20
"""Number of frames from which a principal point can be separated from a rotation of the cameras."""
MAX_PRINCIPAL_POINT_OFFSET = 0.015
"""Distance from the centre, in long sides, from which a principal point is an artefact."""
MIN_CORNERS = 800
"""Number of corners below which a frame has too little texture for the usual threshold of features."""
MIN_MATCHES = 15
"""Number of verified matches from which two frames count as matched."""
MIN_MOTION_PX = 1.0
"""Median motion of features, in pixels of the small pictures, below which the camera counts as still."""
MIN_PARALLAX_SHARE = 0.02
"""Share of the matched pairs of frames that must have parallax."""
MAX_EQUAL_DIFFERENCE = 3
"""Largest difference of two thumbnails' pixels, of 255, up to which the frames count as equal."""
LOW_TEXTURE_THRESHOLD = 0.4
"""Factor on the threshold of features for frames with little texture."""
FEATURE_BATCH, MATCH_BATCH = 8, 100
"""Frames, and pairs of frames, between two checks for a stop."""

_SOURCE_LINE = re.compile(r"\[\w+\.(cc|h):\d+\]")
"""Start of the messages of pycolmap's checks."""


@dataclass(eq=False)
class SolvedFrame:
    """A registered frame: index of its source frame, lens and observations at the size of its small picture."""

    index: int
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
    """The largest model, the number of frames of each model, and how the frames were matched."""

    model: Model
    sizes: list[int]
    matching: str
    pairs: int

    @property
    def frames(self) -> list[SolvedFrame]:
        """The registered frames."""
        return self.model.frames


def solve(sources: Sequence[SourceFrame], work: Path, settings: SolveSettings, video: bool,
          progress: Progress) -> Solved:
    """Reconstruct the largest model from small pictures and masks below `work`, where a stopped solve resumes.

    video: True for frames of a video, whose neighbours are matched. Raises CaptureError where nothing can be
    reconstructed, EngineError without pycolmap, Cancelled on a stop request.
    """
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    pycolmap.set_random_seed(settings.seed)
    with _report_library_errors(work, progress):
        return _solve(pycolmap, sources, work, settings, video, progress)


def _solve(pycolmap: Any, sources: Sequence[SourceFrame], work: Path, settings: SolveSettings, video: bool,
           progress: Progress) -> Solved:
    """Carry out `solve`; errors of pycolmap are raised as they are, and `solve` converts them."""
    database = work / DATABASE
    _check_frames_differ(sources, work)
    _extract_features(pycolmap, sources, work, database, settings, progress)
    matching = choose_matching(settings.matching, len(sources), video)
    pairs = _match_frames(pycolmap, sources, work, database, matching, settings, progress)
    _check_parallax(pycolmap, database, settings.size)
    models = _run_mapper(pycolmap, work, database, len(sources), settings, progress)
    if not models:
        raise CaptureError("The frames match, but no two of them give a reliable start; film with more sideways "
                           "motion or choose more frames.")
    largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    if settings.principal_point and largest.num_reg_images() >= MIN_FRAMES_FOR_PRINCIPAL_POINT:
        progress.stage("find principal point", 1)
        largest = _refine_principal_point(pycolmap, largest)
        progress.advance()
    names = {source.name: index for index, source in enumerate(sources)}
    sizes = sorted((model.num_reg_images() for model in models), reverse=True)
    return Solved(_to_model(largest, names), sizes, matching, pairs)


@contextlib.contextmanager
def _report_library_errors(work: Path, progress: Progress) -> Iterator[None]:
    """Raise CaptureError in place of pycolmap's errors: RuntimeError, or ValueError whose message names a line of C++.

    Errors of Python code and lack of memory pass unchanged.
    """
    try:
        yield
    except (RuntimeError, ValueError) as problem:
        *_, (frame, _) = traceback.walk_tb(problem.__traceback__)
        is_library = frame.f_code.co_filename == __file__  # Python code that fails has a frame of its own
        if not is_library or is_out_of_memory(problem) or (
                isinstance(problem, ValueError) and not _SOURCE_LINE.match(str(problem))):
            raise
        raise CaptureError(f"COLMAP failed at the step \"{progress.stage_name}\" ({' '.join(str(problem).split())}); "
                           f"mostly the disk of {work} is full or fails: make room and solve again, finished steps are "
                           "kept.") from problem


def check_intermediate_files(work: Path) -> None:
    """Raise CaptureError where the database or a model of an earlier run is damaged, for instance by a power failure.

    pycolmap would read such a model without end.
    """
    database = work / DATABASE
    if database.is_file():
        try:
            with contextlib.closing(sqlite3.connect(database)) as opened:
                status = opened.execute("PRAGMA quick_check").fetchone()[0]
        except sqlite3.DatabaseError as problem:
            status = str(problem)
        if status != "ok":
            raise CaptureError(f"{database} is damaged ({status}).")
    for folder in _model_folders(work) or ():
        read_model(folder)


def load_pycolmap() -> Any:
    """Import pycolmap. Raises EngineError where it is not installed.

    OpenCV is imported first: otherwise its PNG writer finds pycolmap's libpng and aborts the process (pycolmap 4.2.1
    with OpenCV 4.11).
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


def _check_frames_differ(sources: Sequence[SourceFrame], work: Path) -> None:
    """Raise CaptureError where all frames are equal, compared as thumbnails of 64 x 64 pixels."""
    import cv2

    first: Any = None
    for source in sources:
        grey = _read_grey(work / "small" / source.name)
        thumbnail = cv2.resize(grey, (64, 64), interpolation=cv2.INTER_AREA).astype(np.float32)
        first = thumbnail if first is None else first
        if np.abs(thumbnail - first).max() > MAX_EQUAL_DIFFERENCE:
            return
    raise CaptureError(f"All {len(sources)} frames show the same picture; a solve needs a camera that moves.")


def _group_frames(pycolmap: Any, db: Any, sources: Sequence[SourceFrame], extracted: Container[str], work: Path,
                  settings: SolveSettings) -> dict[tuple[int, bool], list[str]]:
    """Return the names of the frames without features, by the id of their camera and whether they have little texture.

    Frames of one size and focal length share a camera; cameras that the open database `db` lacks are added to it.
    extracted: names of the frames with features.
    """
    camera_by_format: dict[tuple[int, int, float | None], int] = {}
    # The first parameter of a camera is its focal length, in every model to solve with.
    camera_ids = {(c.width, c.height, round(c.params[0], 6)): c.camera_id for c in db.read_all_cameras()}
    names_by_group: dict[tuple[int, bool], list[str]] = {}
    for source in sources:
        frame_format = (source.width, source.height, source.focal)
        if frame_format not in camera_by_format:
            camera = _make_camera(pycolmap, picture_size(work / "small" / source.name), source.focal, settings.lens)
            parameters = (camera.width, camera.height, round(camera.params[0], 6))
            camera_by_format[frame_format] = camera_ids.get(parameters) or db.write_camera(camera)
            camera_ids[parameters] = camera_by_format[frame_format]
        if source.name not in extracted:
            group = (camera_by_format[frame_format], _has_little_texture(work / "small" / source.name))
            names_by_group.setdefault(group, []).append(source.name)
    return names_by_group


def _extract_features(pycolmap: Any, sources: Sequence[SourceFrame], work: Path, database: Path,
                      settings: SolveSettings, progress: Progress) -> None:
    """Extract SIFT features of every frame that has none in the database, and store them there."""
    with _open_database(pycolmap, database) as db:
        extracted = {image.name for image in db.read_all_images()
                     if db.num_keypoints_for_image(image.image_id) or db.exists_descriptors(image.image_id)}
        names_by_group = _group_frames(pycolmap, db, sources, extracted, work, settings)
    progress.stage("find features", len(sources), len(extracted))
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = settings.features
    options.use_gpu = False
    reader = pycolmap.ImageReaderOptions()
    if settings.mask:
        reader.mask_path = str(work / "masks")
    default_threshold = options.sift.peak_threshold
    for (camera_id, has_little_texture), names in names_by_group.items():
        reader.existing_camera_id = camera_id
        # A lower threshold for frames of walls and skies: weak features are better than none.
        options.sift.peak_threshold = (LOW_TEXTURE_THRESHOLD if has_little_texture else 1.0) * default_threshold
        for start in range(0, len(names), FEATURE_BATCH):
            batch = names[start:start + FEATURE_BATCH]
            pycolmap.extract_features(database, work / "small", image_names=batch,
                                      camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                                      extraction_options=options, device=pycolmap.Device.cpu)
            progress.advance(len(batch))


def _has_little_texture(small: Path) -> bool:
    """Return whether a quick count finds few corners."""
    import cv2

    return len(cv2.FastFeatureDetector.create(12).detect(_read_grey(small))) < MIN_CORNERS


def _read_grey(path: Path) -> NDArray[np.uint8]:
    """Read (height, width) of a small picture. Raises CaptureError where it has been damaged."""
    import cv2

    picture = decode_by_opencv(path, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise CaptureError(f"{path} is damaged; remove the folder {path.parents[1]} and solve again.")
    return np.asarray(picture, np.uint8)


def _make_camera(pycolmap: Any, size: tuple[int, int], focal: float | None, model: str) -> Any:
    """Make a camera of this model with an initial focal length."""
    width, height = size
    camera = pycolmap.Camera.create_from_model_name(0, model, (focal or DEFAULT_FOCAL) * max(size), width, height)
    camera.has_prior_focal_length = focal is not None
    return camera


def _match_frames(pycolmap: Any, sources: Sequence[SourceFrame], work: Path, database: Path, matching: Any,
                  settings: SolveSettings, progress: Progress) -> int:
    """Match and verify (RANSAC) the chosen pairs that the database lacks, and store the matches there.

    Returns the number of chosen pairs, old ones included.
    """
    with _open_database(pycolmap, database) as db:
        ids = [db.read_image_with_name(source.name).image_id for source in sources]
        pairs = choose_pairs(matching, len(sources), lambda i: np.asarray(db.read_descriptors(ids[i]).data),
                             settings.seed)
        missing_pairs = [(i, j) for i, j in pairs if not db.exists_two_view_geometry(ids[i], ids[j])]
    progress.stage("match frames", len(pairs), len(pairs) - len(missing_pairs))
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed
    listing = pycolmap.ImportedPairingOptions()
    listing.match_list_path = str(work / "pairs.txt")
    for start in range(0, len(missing_pairs), MATCH_BATCH):
        batch = missing_pairs[start:start + MATCH_BATCH]
        write_text(work / "pairs.txt", "".join(f"{sources[i].name} {sources[j].name}\n" for i, j in batch))
        pycolmap.match_image_pairs(database, matching_options=options, pairing_options=listing,
                                   verification_options=verification, device=pycolmap.Device.cpu)
        progress.advance(len(batch))
    return len(pairs)


def _run_mapper(pycolmap: Any, work: Path, database: Path, frames: int, settings: SolveSettings,
                progress: Progress) -> list[Any]:
    """Run incremental mapping; return all pycolmap reconstructions, of this run or an earlier one that finished.

    frames: number of source frames. Raises Cancelled on a stop request.
    """
    finished = _model_folders(work)
    if finished is not None:
        return [pycolmap.Reconstruction(str(model)) for model in finished]
    folder = work / MODELS_FOLDER
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

    def report_placed(count: int) -> None:
        """Report `count` placed frames; on a requested stop cancel the mapping."""
        # pycolmap cannot pass an exception on: the token ends the mapping, and the exception is raised afterwards.
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
            database, work / "small", folder, options, initial_image_pair_callback=lambda: report_placed(2),
            next_image_callback=lambda: report_placed(1), cancellation_token=token)
    except InterruptedError:
        if failures:
            raise failures[0] from None
        progress.check()
        raise
    if failures:  # an incomplete result must not be recorded for the next solve
        raise failures[0]
    progress.check()
    _write_models(work, models)
    return list(models.values())


def _write_models(work: Path, models: Mapping[int, Any]) -> None:
    """Write pycolmap reconstructions into a folder each, then the list of their folders, which records the end of
    mapping. Raises CaptureError."""
    for number, model in models.items():
        folder = work / MODELS_FOLDER / str(number)
        folder.mkdir(exist_ok=True)
        model.write(str(folder))
        read_model(folder)  # pycolmap does not report a write that fails
    write_json(work / MODELS_FILE, [str(number) for number in models])


def _model_folders(work: Path) -> list[Path] | None:
    """Return the folders of the models, None where mapping is not finished. Raises CaptureError where the list is
    damaged."""
    if not (work / MODELS_FILE).is_file():
        return None
    names = read_json(work / MODELS_FILE, CaptureError)
    if not isinstance(names, list) or not all(isinstance(name, str) and name.isdecimal() for name in names):
        raise CaptureError(f"{work / MODELS_FILE} is damaged.")
    return [work / MODELS_FOLDER / name for name in names]


def _refine_principal_point(pycolmap: Any, model: Any) -> Any:
    """Return the model after bundle adjustment with free principal points.

    Returns the old model if a principal point moves too far off centre: no real lens is that far off, so the views do
    not determine it.
    """
    refined = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    # Not pycolmap.bundle_adjustment, which writes to standard error whatever the log level.
    config = pycolmap.BundleAdjustmentConfig()
    for image in refined.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, refined).solve()
    refined.update_point_3d_errors()
    for camera in refined.cameras.values():
        offset = np.hypot(camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2)
        if not offset < MAX_PRINCIPAL_POINT_OFFSET * max(camera.width, camera.height):
            return model
    return refined


def _check_parallax(pycolmap: Any, database: Path, size: int) -> None:
    """Raise CaptureError where matched features show that depth cannot be measured.

    Mapping would take long and might return a wrong model. size: long side of the small pictures, for the message.
    """
    configuration = pycolmap.TwoViewGeometryConfiguration
    without_parallax = (configuration.PLANAR_OR_PANORAMIC, configuration.PANORAMIC)
    motions, with_parallax = [], 0
    with _open_database(pycolmap, database) as db:
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            matches = np.asarray(geometry.inlier_matches)
            if len(matches) < MIN_MATCHES:
                continue
            first, second = (np.asarray(db.read_keypoints(image), np.float64)[:, :2]
                             for image in pycolmap.pair_id_to_image_pair(pair_id))
            motions.append(float(np.median(np.linalg.norm(first[matches[:, 0]] - second[matches[:, 1]], axis=1))))
            with_parallax += geometry.config not in without_parallax
    if not motions:
        raise CaptureError("The frames share too few features to place a camera; film with more overlap, more texture "
                           "or less blur.")
    if np.median(motions) < MIN_MOTION_PX:
        raise CaptureError(f"The camera hardly moves: matched features shift by {np.median(motions):.2f} pixels at "
                           f"{size}; a solve needs a camera that travels.")
    if with_parallax < MIN_PARALLAX_SHARE * len(motions):
        raise CaptureError("The camera turns but does not travel, or sees one flat surface only: there is no parallax "
                           "to measure depth by.")


def _to_model(reconstruction: Any, names: dict[str, int]) -> Model:
    """Convert pycolmap's reconstruction to plain arrays. names: index of each source frame by its name."""
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
        observed = image.get_observation_points2D()
        frames.append(SolvedFrame(names[image.name], lenses[image.camera_id], pose,
                                  np.array([point.xy for point in observed], np.float64).reshape(-1, 2),
                                  np.array([index[point.point3D_id] for point in observed], np.int64)))
    return Model(np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
                 np.array([point.color for point in points], np.uint8).reshape(-1, 3),
                 np.array([point.error for point in points], np.float64),
                 np.array([point.track.length() for point in points], np.int64),
                 sorted(frames, key=lambda frame: frame.index))


@contextlib.contextmanager
def _open_database(pycolmap: Any, database: Path) -> Iterator[Any]:
    db = pycolmap.Database.open(database)
    try:
        yield db
    finally:
        db.close()


__all__ = ["Model", "Solved", "SolvedFrame", "solve"]
