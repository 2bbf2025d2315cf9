# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the COLMAP model of a rendered capture: true poses, points triangulated from features of its frames."""
from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from core.system.progress import Progress

from .capture_files import FRAME_SUFFIX
from .description import Pinhole, SceneDescription

MAX_REPROJECTION_ERROR = 1.5
"""Pixels; points with a larger mean error are left out."""
MIN_TRACK_LENGTH = 3
"""Frames that have to show a point at least."""
SIFT_PEAK_THRESHOLD = 0.004
"""Contrast of a feature at least; lower than COLMAP's own, so that small frames have enough features."""
MAX_FEATURES = 3000
"""Features of a frame at most."""


def write_model(scene: SceneDescription, out: Path, progress: Progress) -> None:
    """Match the frames, triangulate points and write sparse/0, binary, unless it exists.

    The features are SIFT of the frames as filmed, with flares and noise; the poses are the true ones.
    """
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
        reader.camera_params = ",".join(str(value) for value in _pinhole_parameters(scene.camera))
        features = pycolmap.FeatureExtractionOptions()
        features.sift.peak_threshold = SIFT_PEAK_THRESHOLD
        features.sift.max_num_features = MAX_FEATURES
        pycolmap.extract_features(database, out / "images", camera_mode=pycolmap.CameraMode.SINGLE,
                                  reader_options=reader, extraction_options=features)
        progress.advance()
        pycolmap.match_exhaustive(database)
        progress.advance()
        true_cameras = _posed_cameras(scene, database)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = scene.seed
        reconstruction = pycolmap.triangulate_points(true_cameras, database, out / "images", folder, options=options)
        reconstruction.extract_colors_for_all_images(out / "images")
        result = _filter_points(reconstruction)
        model_folder = Path(folder) / "model"
        model_folder.mkdir()
        result.write(model_folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(model_folder, target)
    progress.advance(points=result.num_points3D(), error_px=result.compute_mean_reprojection_error(),
                     track=result.compute_mean_track_length())


def _pinhole_parameters(camera: Pinhole) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy]


def _posed_cameras(scene: SceneDescription, database: Path) -> Any:
    """Return a model of the true cameras without points; image numbers and keypoints come from the COLMAP database."""
    import pycolmap

    true_cameras = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=scene.camera.width, height=scene.camera.height,
                             params=_pinhole_parameters(scene.camera), camera_id=1)
    true_cameras.add_camera_with_trivial_rig(camera)
    poses = dict(zip((f"{stem}{FRAME_SUFFIX}" for stem in scene.stems), scene.poses, strict=True))
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        keypoints = {image.image_id: opened.read_keypoints(image.image_id) for image in images}
    for image in images:
        posed_image = pycolmap.Image(name=image.name, keypoints=np.asarray(keypoints[image.image_id])[:, :2],
                                     camera_id=1, image_id=image.image_id)
        true_cameras.add_image_with_trivial_frame(posed_image, pycolmap.Rigid3d(poses[image.name][:3]))
    return true_cameras


def _filter_points(reconstruction: Any) -> Any:
    """Return the model without inexact points and points of short tracks, and without the image points of either."""
    import pycolmap

    good_points = {number: point for number, point in reconstruction.points3D.items()
                   if point.error <= MAX_REPROJECTION_ERROR and point.track.length() >= MIN_TRACK_LENGTH}
    filtered = pycolmap.Reconstruction()
    for camera in reconstruction.cameras.values():
        filtered.add_camera_with_trivial_rig(camera)
    # From (image, index of an image point in the full model) to its index in the filtered model.
    new_index: dict[tuple[int, int], int] = {}
    for number, image in sorted(reconstruction.images.items()):
        observations = [(index, point.xy) for index, point in enumerate(image.points2D)
                        if point.has_point3D() and point.point3D_id in good_points]
        new_index.update({(number, index): new for new, (index, _) in enumerate(observations)})
        keypoints = np.array([xy for _, xy in observations]).reshape(-1, 2)
        filtered_image = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=image.camera_id,
                                        image_id=number)
        filtered.add_image_with_trivial_frame(filtered_image, image.cam_from_world())
    for _, point in sorted(good_points.items()):
        track = pycolmap.Track()
        for element in point.track.elements:
            track.add_element(element.image_id, new_index[element.image_id, element.point2D_idx])
        filtered.add_point3D(point.xyz, track, point.color)
    filtered.update_point_3d_errors()
    return filtered
