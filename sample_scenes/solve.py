# SPDX-License-Identifier: GPL-3.0-or-later
"""The COLMAP model of a rendered capture: true poses, points triangulated from features of its frames."""
from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from core.system.progress import Progress

from .description import Pinhole, SceneDescription
from .layers import FRAME_SUFFIX

LONGEST_ERROR = 1.5
"""Pixels; points that project worse on average are left out."""
SHORTEST_TRACK = 3


def write_model(scene: SceneDescription, out: Path, progress: Progress) -> None:
    """sparse/0, binary. Features are SIFT of the frames as filmed, flares and noise and all."""
    target = out / "sparse" / "0"
    if (target / "points3D.bin").is_file():
        return
    import pycolmap

    progress.stage("points", 3)
    pycolmap.set_random_seed(scene.seed)
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "PINHOLE"
        reader.camera_params = ",".join(str(value) for value in _parameters(scene.camera))
        features = pycolmap.FeatureExtractionOptions()
        features.sift.peak_threshold = 0.004
        features.sift.max_num_features = 3000
        pycolmap.extract_features(database, out / "images", camera_mode=pycolmap.CameraMode.SINGLE,
                                  reader_options=reader, extraction_options=features)
        progress.advance()
        pycolmap.match_exhaustive(database)
        progress.advance()
        known = _known(scene, database)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = scene.seed
        found = pycolmap.triangulate_points(known, database, out / "images", folder, options=options)
        found.extract_colors_for_all_images(out / "images")
        result = _lean(found)
        written = Path(folder) / "model"
        written.mkdir()
        result.write(written)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(written, target)
    progress.advance(points=result.num_points3D(), error_px=result.compute_mean_reprojection_error(),
                     track=result.compute_mean_track_length())


def _parameters(camera: Pinhole) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy]


def _known(scene: SceneDescription, database: Path) -> Any:
    """A reconstruction of the true cameras, numbered as in the database, without points."""
    import pycolmap

    known = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=scene.camera.width, height=scene.camera.height,
                             params=_parameters(scene.camera), camera_id=1)
    known.add_camera_with_trivial_rig(camera)
    poses = dict(zip((f"{stem}{FRAME_SUFFIX}" for stem in scene.stems), scene.poses, strict=True))
    with pycolmap.Database.open(database) as store:
        images = store.read_all_images()
        keypoints = {image.image_id: store.read_keypoints(image.image_id) for image in images}
    for image in images:
        placed = pycolmap.Image(name=image.name, keypoints=np.asarray(keypoints[image.image_id])[:, :2],
                                camera_id=1, image_id=image.image_id)
        known.add_image_with_trivial_frame(placed, pycolmap.Rigid3d(poses[image.name][:3]))
    return known


def _lean(found: Any) -> Any:
    """The model with good points only, and only the image points that belong to them."""
    import pycolmap

    good = {number: point for number, point in found.points3D.items()
            if point.error <= LONGEST_ERROR and point.track.length() >= SHORTEST_TRACK}
    lean = pycolmap.Reconstruction()
    for camera in found.cameras.values():
        lean.add_camera_with_trivial_rig(camera)
    places: dict[tuple[int, int], int] = {}
    for number, image in sorted(found.images.items()):
        seen = [(index, point.xy) for index, point in enumerate(image.points2D)
                if point.has_point3D() and point.point3D_id in good]
        places.update({(number, index): at for at, (index, _) in enumerate(seen)})
        kept = pycolmap.Image(name=image.name, keypoints=np.array([xy for _, xy in seen]).reshape(-1, 2),
                              camera_id=image.camera_id, image_id=number)
        lean.add_image_with_trivial_frame(kept, image.cam_from_world())
    for _, point in sorted(good.items()):
        track = pycolmap.Track()
        for element in point.track.elements:
            track.add_element(element.image_id, places[element.image_id, element.point2D_idx])
        lean.add_point3D(point.xyz, track, point.color)
    lean.update_point_3d_errors()
    return lean
