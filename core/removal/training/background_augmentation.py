# SPDX-License-Identifier: GPL-3.0-or-later
"""Augments backgrounds, so that few photographs look like many: warped, graded, cut up, overlaid, with bright objects
that are no flare.

A network that has seen a photograph often enough knows it, and then predicts as flare whatever differs from it; on new
pictures it fails. Dead leaves give no end of pictures (Lee, Mumford and Huang 2001, "Occlusion models for natural
images"). `backgrounds.Backgrounds.draw` calls `augment`.
"""
from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ...errors import EngineError
from ..synthesis.canvas import log_uniform

Random = np.random.Generator
DrawView = Callable[[Random, int, int], Pixels]
"""Draws a random view of that width and height: (height, width, 3) linear light."""

WARP_MARGIN = 1.4
"""Factor by which a picture that will be warped is drawn larger than the frame."""
UNIT_SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
"""The corners of a frame, relative to its middle, in half sides."""


def require_ximgproc() -> None:
    """Raise EngineError if OpenCV lacks the module that `augment` needs."""
    import cv2

    if not hasattr(cv2, "ximgproc"):
        raise EngineError("A training needs OpenCV's extra modules, which the OpenCV of this Python lacks; uninstall "
                          "every opencv package there, and install opencv-contrib-python-headless alone.")


def augment(random: Random, draw_view: DrawView, width: int, height: int) -> Pixels:
    """Return (height, width, 3) linear light: a view in a random pose, in four of five cases changed by defocus, dead
    leaves, a second scene, a grade, haze or bright objects."""
    scene = _random_pose(random, draw_view, width, height)
    if random.random() < 0.12:
        scene = _random_defocus(random, scene)
    if random.random() < 0.35:
        scene = _add_dead_leaves(random, scene, draw_view)
    elif random.random() < 0.2:
        scene = _combine_scenes(random, scene, _random_pose(random, draw_view, width, height))
    if random.random() < 0.4:
        scene = _random_grade(random, scene)
    if random.random() < 0.15:
        scene = _add_haze(random, scene)
    if random.random() < 0.15:
        scene = _add_bright_objects(random, scene)
    return scene


def _random_pose(random: Random, draw_view: DrawView, width: int, height: int) -> Pixels:
    """Return a view: upright in six of ten, else on its side, or rolled by some degrees and seen in perspective."""
    import cv2

    pose_draw = random.random()
    if pose_draw < 0.6:
        return draw_view(random, width, height)
    if pose_draw < 0.75:  # on its side
        return np.ascontiguousarray(draw_view(random, height, width).swapaxes(0, 1))
    piece_width, piece_height = math.ceil(width * WARP_MARGIN), math.ceil(height * WARP_MARGIN)
    scene = draw_view(random, piece_width, piece_height)
    roll = math.radians(random.normal(0, 12))
    rotation = np.array([[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]])
    # The corners of the frame in the piece: each is moved along its diagonal, which makes the perspective.
    corners = (UNIT_SQUARE * (width, height) / 2) @ rotation.T * np.exp(random.normal(0, 0.1, (4, 1)))
    corners += (piece_width / 2, piece_height / 2)
    target_corners = (UNIT_SQUARE + 1) / 2 * (width, height)
    matrix = cv2.getPerspectiveTransform(corners.astype(np.float32), target_corners.astype(np.float32))
    return np.asarray(cv2.warpPerspective(scene, matrix, (width, height), flags=cv2.INTER_LINEAR,
                                          borderMode=cv2.BORDER_REFLECT), np.float32)


def _random_defocus(random: Random, scene: Pixels) -> Pixels:
    """Blur the scene as a lens that is focused nearer does: lights become discs or polygons."""
    radius = math.hypot(*scene.shape[:2]) * log_uniform(random, 0.004, 0.04)
    blades = int(random.integers(5, 9)) if random.random() < 0.4 else 48  # enough to look round
    angles = np.arange(blades) * (2 * math.pi / blades) + random.uniform(0, 2 * math.pi)
    side = 2 * math.ceil(radius) + 1
    points = np.stack([np.cos(angles), np.sin(angles)], -1) * radius + side // 2
    return defocus(scene, _draw_polygon(points, side, side))


def defocus(scene: Pixels, aperture: Pixels) -> Pixels:
    """Convolve a scene with the image of the aperture, (height, width) in pixels of the scene, of any sum."""
    import cv2

    blurred = cv2.filter2D(scene, -1, aperture / aperture.sum(), borderType=cv2.BORDER_REFLECT)
    return np.asarray(np.maximum(blurred, 0), np.float32)  # OpenCV filters by FFT, which may round below 0


def _add_dead_leaves(random: Random, scene: Pixels, draw_view: DrawView) -> Pixels:
    """Cover the scene, linear light (height, width, 3), with one to eight pieces of other views, each in its own
    exposure, some with soft edges."""
    height, width = scene.shape[:2]
    scene = scene.copy()
    for _ in range(int(random.integers(1, 9))):
        piece_size = math.hypot(width, height) * log_uniform(random, 0.1, 0.8)
        aspect = math.exp(random.normal(0, 0.5))
        piece_width, piece_height = (max(int(piece_size * stretch), 8)
                                     for stretch in (math.sqrt(aspect), 1 / math.sqrt(aspect)))
        left = int(random.uniform(-piece_width / 2, width - piece_width / 2))
        top = int(random.uniform(-piece_height / 2, height - piece_height / 2))
        mask = _draw_leaf(random, piece_width, piece_height)[..., None]
        piece = draw_view(random, piece_width, piece_height) * np.float32(math.exp(random.normal(0, 0.5)))
        # The part of the piece that lies in the frame, and its place there.
        piece_window = np.s_[max(-top, 0):height - top, max(-left, 0):width - left]
        scene_window = np.s_[max(top, 0):top + piece_height, max(left, 0):left + piece_width]
        scene[scene_window] = _blend(scene[scene_window], piece[piece_window], mask[piece_window])
    return scene


def _blend(first: Pixels, second: Pixels, weight: Pixels) -> Pixels:
    """Mix two pictures by the weight 0..1 of the second; light that rounding leaves below zero becomes zero."""
    return np.asarray(np.maximum(first + (second - first) * weight, 0), np.float32)


def _draw_leaf(random: Random, width: int, height: int) -> Pixels:
    """Draw the mask (height, width), 0..1, of a dead leaf: a blob, a polygon or an ellipse; a third of them blurred."""
    import cv2

    shape = ("blob", "polygon", "ellipse")[random.integers(3)]
    if shape == "blob":
        mask = _draw_blob(random, width, height)
    else:
        if shape == "polygon":
            corners = int(random.integers(3, 8))
            angles = np.sort(random.uniform(0, 2 * math.pi, corners))
            radius = random.uniform(0.5, 1, (corners, 1))
        else:
            angles = np.linspace(0, 2 * math.pi, 48)  # enough to look round
            radius = np.array(0.95)
        points = (np.stack([np.cos(angles), np.sin(angles)], -1) * radius + 1) / 2 * (width, height)
        mask = _draw_polygon(points, width, height)
    if random.random() < 1 / 3:
        softness = max(width, height) * log_uniform(random, 0.005, 0.08)
        return np.asarray(cv2.GaussianBlur(mask, (0, 0), softness, borderType=cv2.BORDER_CONSTANT), np.float32)
    return mask


def _draw_blob(random: Random, width: int, height: int) -> Pixels:
    """Return the mask (height, width) 0..1 of smooth random hills above a level."""
    import cv2

    coarse = random.random((int(random.integers(3, 9)), int(random.integers(3, 9)))).astype(np.float32)
    coarse[0] = coarse[-1] = coarse[:, 0] = coarse[:, -1] = 0  # so that the blob ends inside the mask
    hills = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)
    return np.asarray(np.clip((hills - random.uniform(0.3, 0.5)) * min(width, height) / 4 + 0.5, 0, 1), np.float32)


def _draw_polygon(corners: NDArray[np.float64], width: int, height: int) -> Pixels:
    """Return an anti-aliased mask (height, width) 0..1. corners: (n, 2) in pixels."""
    import cv2

    mask = np.zeros((height, width), np.float32)
    cv2.fillPoly(mask, [(corners * 16).astype(np.int32)], (1.0,), cv2.LINE_AA, 4)  # 4: corners in 1/16 px
    return mask


def _random_grade(random: Random, scene: Pixels) -> Pixels:
    """Change contrast, saturation and colour balance of linear light (height, width, 3), each in half of the scenes;
    permute the channels of a fifth."""
    level = np.float32(max(float(scene.mean()), 1e-4))  # contrast changes about the mean
    if random.random() < 0.5:
        scene = level * (scene / level) ** np.float32(math.exp(random.normal(0, 0.25)))
    if random.random() < 0.5:
        grey = scene.mean(-1, keepdims=True)
        scene = np.maximum(grey + (scene - grey) * np.float32(random.uniform(0, 1.6)), 0)
    if random.random() < 0.5:
        scene = scene * np.exp(random.normal(0, 0.35, 3)).astype(np.float32)
    if random.random() < 0.2:
        scene = scene[..., random.permutation(3)]
    return np.asarray(scene, np.float32)


def _combine_scenes(random: Random, scene: Pixels, second: Pixels) -> Pixels:
    """Return one scene beside the other, with a sharp or soft edge between them, or both mixed as by a reflection in a
    pane of glass."""
    height, width = scene.shape[:2]
    if random.random() < 0.3:
        share = np.float32(random.uniform(0.2, 0.8))
        return scene * share + second * (1 - share)
    angle, softness = random.uniform(0, 2 * math.pi), log_uniform(random, 0.005, 0.3)
    x = np.linspace(-1, 1, width, dtype=np.float32)[None, :]
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    distance = x * np.float32(math.cos(angle)) + y * np.float32(math.sin(angle)) - random.uniform(-0.7, 0.7)
    weight = (1 / (1 + np.exp(-np.clip(distance / softness, -30, 30)))).astype(np.float32)[..., None]
    return _blend(scene, second, weight)


def _add_haze(random: Random, scene: Pixels) -> Pixels:
    """Add haze, lit by a low sun in half of the cases: bright and soft like a veil, but absent where the scene is near.

    Koschmieder's law; He, Sun and Tang 2009, "Single image haze removal using dark channel prior", invert it.
    """
    height, width = scene.shape[:2]
    diagonal = math.hypot(width, height)
    # x and y of each pixel relative to the sun, which is on the horizon.
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) - random.uniform(-0.3, 1.3) * width,
                       np.arange(height, dtype=np.float32) - random.uniform(0, 0.7) * height)
    opacity = np.float32(1) - np.exp(-_optical_depth(random, scene, y / height))[..., None]
    colour = np.exp(random.normal(0, 0.12, 3)).astype(np.float32)
    # The light that distant parts fade to, about as bright as the brightest tenth of the scene.
    airlight = np.float32(np.quantile(scene.mean(-1), 0.9) * log_uniform(random, 0.5, 1.5)) * colour
    if random.random() < 0.5:
        warm = np.exp(random.normal((0.2, 0, -0.3), 0.2)).astype(np.float32)
        near_sun = np.exp(-np.hypot(x, y) / np.float32(diagonal * log_uniform(random, 0.15, 0.8)))[..., None]
        airlight = airlight * (1 + near_sun * warm * np.float32(log_uniform(random, 0.5, 6)))
    return _blend(scene, airlight, opacity)


def _optical_depth(random: Random, scene: Pixels, below_horizon: Pixels) -> Pixels:
    """Return the optical depth of haze (height, width), 0 where the scene is near.

    Distance is guessed: it grows up the picture as far as the horizon, and with brightness. A guided filter smooths it
    along the edges of the picture. below_horizon: (height, width) in picture heights, negative above it.
    """
    import cv2

    log_grey = np.log(scene.mean(-1) + np.float32(0.01))
    log_grey = (log_grey - log_grey.mean()) / max(float(log_grey.std()), 1e-2)
    elevation = np.float32(random.uniform(0.5, 4)) * np.minimum(-below_horizon, 0)
    radius = max(round(math.hypot(*scene.shape[:2]) * log_uniform(random, 0.01, 0.05)), 2)
    distance = cv2.ximgproc.guidedFilter(log_grey, elevation + log_grey, radius, 0.02)
    # The nearest part of the picture, 15 to 50 %, is without haze.
    distance -= np.quantile(distance, random.uniform(0.15, 0.5))
    density = log_uniform(random, 0.4, 4) / max(float(distance.max()), 1e-3)
    return np.asarray(np.maximum(distance, 0) * np.float32(density), np.float32)


def _add_bright_objects(random: Random, scene: Pixels) -> Pixels:
    """Add one to four panels to linear light (height, width, 3), or the reflections of as many lamps on a floor or
    water."""
    on_floor = random.random() < 0.4
    for _ in range(int(random.integers(1, 5))):
        colour = np.exp(random.normal(0, 0.3, 3) + random.uniform(-1.5, 1.5)).astype(np.float32)
        if on_floor:
            scene = scene + _draw_reflection(random, *scene.shape[:2])[..., None] * colour
        else:
            mask = _draw_panel(random, *scene.shape[:2])[..., None]
            scene = _blend(scene, colour, mask)
    return scene


def _draw_reflection(random: Random, height: int, width: int) -> Pixels:
    """Return the mask (height, width) 0..1 of a lamp's reflection on a floor or water: an upright streak that waves
    break up."""
    import cv2

    half_width = math.hypot(width, height) * log_uniform(random, 0.004, 0.03)
    half_length = half_width * log_uniform(random, 2, 12)
    x = (np.arange(width, dtype=np.float32)[None, :] - random.uniform(0, width)) / half_width
    y = (np.arange(height, dtype=np.float32)[:, None] - random.uniform(0, height)) / half_length
    waves = random.random((max(height // int(random.integers(2, 12)), 1), 3)).astype(np.float32)
    waves = np.asarray(cv2.resize(waves, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    return np.asarray(np.exp(-(x**2) - y**2) * (1 - random.uniform(0.4, 1) * waves), np.float32)


def _draw_panel(random: Random, height: int, width: int) -> Pixels:
    """Return the mask (height, width) 0..1 of a window, screen or sign of one or several panes, level or in
    perspective."""
    import cv2

    half_sides = math.hypot(width, height) * np.array([log_uniform(random, 0.01, 0.15),
                                                       log_uniform(random, 0.01, 0.15)])
    corners = random.uniform(0, (width, height)) + UNIT_SQUARE * half_sides * np.exp(random.normal(0, 0.15, (4, 2)))
    mask = _draw_polygon(corners, width, height)
    if random.random() < 0.5:
        panes = random.uniform(random.random(), 1, tuple(random.integers(1, 8, 2))).astype(np.float32)
        mask *= cv2.resize(panes, (width, height), interpolation=cv2.INTER_NEAREST)
    return mask
