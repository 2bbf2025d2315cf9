# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the points that a fit starts from where a capture has poses without points, as instant-ngp, BlenderNeRF and
Polycam write it. `run_loop` calls `ensure_points`.

The poses are known, so matches of neighbouring frames give points by triangulation. Where they give too few, points are
drawn at random in the cameras' view, as 3DGS does for synthetic scenes.
"""
from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..capture import Camera, Capture, PointCloud
from ..capture.camera import triangulate_midpoints
from ..images.features import Features, detect_features, match_features
from ..images.picture import Picture
from ..system.progress import Progress
from .frames import subsample
from .settings import FitSettings

MATCHED_VIEWS = 60
"""Approximate number of frames that are matched."""
MATCHED_WIDTH, MAX_FEATURES = 1000, 4000
"""Largest width in pixels of the matched frames, and the number of features of each."""
MAX_ERROR_PX, MIN_ANGLE = 2.0, np.deg2rad(1.5)
"""Largest reprojection error and smallest angle between the rays of a point."""
MIN_TRIANGULATED = 200
"""Number of triangulated points below which random ones are added."""
RANDOM_POINTS = 5000
NEAR_FACTOR, FAR_FACTOR = 0.3, 3.0
"""Depths of random points relative to the distance of what the cameras look at."""

Floats = NDArray[np.float64]


def ensure_points(capture: Capture, settings: FitSettings, progress: Progress) -> tuple[Capture, tuple[str, ...]]:
    """Return the capture with points, and a message to the user if they had to be made.

    Points are triangulated from matched frames; if these are too few, random ones are added. Nothing is done for a
    capture with points, and in fits that start from a scene or plates. Raises Cancelled.
    """
    if len(capture.points) or settings.scene.start or settings.uses_plates:
        return capture, ()
    xyz, rgb, observed = _triangulate_matches(capture, progress)
    source = f"{len(xyz)} points that were triangulated from matches of its frames"
    if len(xyz) < MIN_TRIANGULATED:
        random_xyz, random_rgb = _random_points(capture, xyz, settings.seed)
        xyz, rgb = np.concatenate([xyz, random_xyz]), np.concatenate([rgb, random_rgb])
        source = (f"{source} and " if len(observed) else "") + f"{len(random_xyz)} random ones in the cameras' view"
    cloud = PointCloud(xyz.astype(np.float32), rgb, np.zeros(len(xyz), np.float32))
    return capture.with_points(cloud, observed), (f"{capture.folder} has no 3D points: the fit starts from {source}.",)


def _triangulate_matches(capture: Capture,
                         progress: Progress) -> tuple[Floats, NDArray[np.uint8], dict[str, NDArray[np.int64]]]:
    """Return points (n, 3), colours (n, 3), and by the view's name the indices of the points that it observes.

    SIFT features of each frame are matched with those of the next two; every sound match gives a point, in the colour
    of the first frame.
    """
    views = subsample(capture.views, MATCHED_VIEWS)
    progress.stage("match frames for points", len(views))
    cameras: list[Camera] = []
    features: list[Features] = []
    colours: list[NDArray[np.uint8]] = []
    for view in views:
        cameras.append(view.camera.scaled(min(MATCHED_WIDTH, view.camera.width)))
        frame_features, frame_colours = _detect_coloured_features(capture.frame(view, cameras[-1].size))
        features.append(frame_features)
        colours.append(frame_colours)
        progress.advance()
    xyz, rgb, observed = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], dict[str, list[NDArray[np.int64]]]()
    count = 0
    pairs = [*pairwise(range(len(views))), *((i, i + 2) for i in range(len(views) - 2))]
    for first, second in pairs:
        matches = match_features(features[first], features[second], mutual=True)
        if not len(matches):
            continue
        # A camera's pixel centres are at + 0.5, those of features are whole numbers.
        pixels, other_pixels = (features[view].positions[matches[:, column]].astype(np.float64) + 0.5
                                for column, view in enumerate((first, second)))
        points, is_sound = triangulate_pair(cameras[first], cameras[second], pixels, other_pixels)
        xyz.append(points[is_sound])
        rgb.append(colours[first][matches[is_sound, 0]])
        indices = np.arange(count, count + int(is_sound.sum()))
        count += len(indices)
        for index in (first, second):
            observed.setdefault(views[index].name, []).append(indices)
    return (np.concatenate(xyz), np.concatenate(rgb),
            {name: np.unique(np.concatenate(parts)) for name, parts in observed.items() if count})


def _detect_coloured_features(frame: Picture) -> tuple[Features, NDArray[np.uint8]]:
    """Return the features of a frame, and their sRGB colours (n, 3)."""
    import cv2

    codes = (frame.display() * 255 + 0.5).astype(np.uint8)
    features = detect_features(np.asarray(cv2.cvtColor(codes, cv2.COLOR_RGB2GRAY), np.uint8), MAX_FEATURES)
    x, y = np.minimum(np.rint(features.positions).astype(int), np.array(frame.size) - 1).T
    return features, codes[y, x]


def triangulate_pair(first: Camera, second: Camera, pixels: Floats, other_pixels: Floats
                     ) -> tuple[Floats, NDArray[np.bool_]]:
    """Return points (n, 3) from pixels (n, 2) of the first and other pixels (n, 2) of the second camera, and which (n,)
    are sound.

    A point is sound if it lies before both cameras, its rays differ by more than MIN_ANGLE, and it projects to less
    than MAX_ERROR_PX from both pixels.
    """
    points, cosines, is_in_front = triangulate_midpoints(first.position, first.rays(pixels),
                                                         second.position, second.rays(other_pixels))
    is_sound = is_in_front & (np.arccos(cosines.clip(-1, 1)) > MIN_ANGLE)
    for camera, observed in ((first, pixels), (second, other_pixels)):
        places, depth = camera.project(points)
        with np.errstate(invalid="ignore"):
            is_sound &= (depth > 0) & (np.linalg.norm(places - observed, axis=1) < MAX_ERROR_PX)
    return points, is_sound


def _random_points(capture: Capture, triangulated: Floats, seed: int) -> tuple[Floats, NDArray[np.uint8]]:
    """Return points (n, 3) in the view of the cameras, with the colours (n, 3) of the frames where they were drawn.

    Depths are log-uniform about the distance of what each camera looks at. triangulated: known points (m, 3).
    """
    generator = np.random.default_rng(seed)
    views = subsample(capture.views, MATCHED_VIEWS)
    focus = None if capture.is_rotation_only else _focus_point([view.camera for view in views])
    xyz, rgb = [], []
    for view in views:
        camera = view.camera.scaled(min(MATCHED_WIDTH, view.camera.width))
        distance = _subject_distance(camera, triangulated, focus, capture)
        count = RANDOM_POINTS // len(views) + 1
        pixels = generator.random((count, 2)) * camera.size
        depth = distance * np.exp(generator.uniform(np.log(NEAR_FACTOR), np.log(FAR_FACTOR), count))
        xyz.append(camera.position + depth[:, None] * camera.rays(pixels))
        codes = (capture.frame(view, camera.size).display() * 255 + 0.5).astype(np.uint8)
        x, y = pixels.astype(int).T
        rgb.append(codes[y, x])
    return np.concatenate(xyz), np.concatenate(rgb)


def _focus_point(cameras: list[Camera]) -> Floats | None:
    """Return the point (3,) that is nearest to all optical axes, by least squares; None where they are parallel."""
    matrix, vector = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        perpendicular = np.eye(3) - np.outer(camera.forward, camera.forward)
        matrix, vector = matrix + perpendicular, vector + perpendicular @ camera.position
    return None if np.linalg.cond(matrix) > 1e6 else np.linalg.solve(matrix, vector)


def _subject_distance(camera: Camera, known: Floats, focus: Floats | None, capture: Capture) -> float:
    """Return the distance, world units, of what a camera looks at.

    It is the median depth of at least 20 known points (n, 3), else the depth of `focus` (3,), the point nearest to all
    optical axes, else the capture's extent.
    """
    if len(known) >= 20:  # enough for a median
        depths = camera.project(known)[1]
        if (depths > 0).any():
            return float(np.median(depths[depths > 0]))
    if focus is not None and (depth := float(camera.project(focus)[1][0])) > 0:
        return depth
    return capture.extent
