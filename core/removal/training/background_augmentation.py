# SPDX-License-Identifier: GPL-3.0-or-later
"""Few photographs made to look like many: filmed askew, graded, cut up and laid over each other, with bright things
that are no flare.

A network that has seen the same photograph often enough knows it, and what it then takes away for a flare is the
difference from what it knows; over pictures it has not seen it fails. Of pieces there are no end (dead leaves: Lee,
Mumford and Huang 2001, "Occlusion models for natural images").
"""
from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ...errors import EngineError
from ..synthesis.canvas import uniform_log

Random = np.random.Generator
Film = Callable[[Random, int, int], Pixels]
"""A random view of that width and height, (height, width, 3) linear light."""

ROOM = 1.4
"""Parts of its size by which a picture to be laid askew is filmed larger."""
SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
"""The corners of a frame, from its middle in halves of its sides."""


def need() -> None:
    """Raises EngineError where OpenCV has not what `varied` asks of it."""
    import cv2

    if not hasattr(cv2, "ximgproc"):
        raise EngineError("A training needs OpenCV's extra modules, which the OpenCV of this Python has not; remove "
                          "every opencv package there and install opencv-contrib-python-headless alone.")


def varied(random: Random, film: Film, width: int, height: int) -> Pixels:
    """(height, width, 3) linear light: as filmed in one of six, else changed in some of the ways below."""
    scene = _askew(random, film, width, height)
    if random.random() < 0.12:
        scene = _out_of_focus(random, scene)
    if random.random() < 0.35:
        scene = _under_leaves(random, scene, film)
    elif random.random() < 0.2:
        scene = _joined(random, scene, _askew(random, film, width, height))
    if random.random() < 0.4:
        scene = _graded(random, scene)
    if random.random() < 0.15:
        scene = _hazy(random, scene)
    if random.random() < 0.15:
        scene = _with_bright_things(random, scene)
    return scene


def _askew(random: Random, film: Film, width: int, height: int) -> Pixels:
    """Upright in six of ten, else sideways, or turned by some degrees and seen from the side."""
    import cv2

    how = random.random()
    if how < 0.6:
        return film(random, width, height)
    if how < 0.75:
        return np.ascontiguousarray(film(random, height, width).swapaxes(0, 1))
    wide, high = math.ceil(width * ROOM), math.ceil(height * ROOM)
    scene = film(random, wide, high)
    turn = math.radians(random.normal(0, 12))
    spin = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    corners = (SQUARE * (width, height) / 2) @ spin.T * np.exp(random.normal(0, 0.1, (4, 1))) + (wide / 2, high / 2)
    onto = (SQUARE + 1) / 2 * (width, height)
    matrix = cv2.getPerspectiveTransform(corners.astype(np.float32), onto.astype(np.float32))
    return np.asarray(cv2.warpPerspective(scene, matrix, (width, height), flags=cv2.INTER_LINEAR,
                                          borderMode=cv2.BORDER_REFLECT), np.float32)


def _out_of_focus(random: Random, scene: Pixels) -> Pixels:
    """What lies behind, as a lens focused on something nearer shows it: its lights become discs or polygons."""
    radius = math.hypot(*scene.shape[:2]) * uniform_log(random, 0.004, 0.04)
    blades = int(random.integers(5, 9)) if random.random() < 0.4 else 48  # so many that it looks round
    at = np.arange(blades) * (2 * math.pi / blades) + random.uniform(0, 2 * math.pi)
    side = 2 * math.ceil(radius) + 1
    return seen_through(scene, _polygon(np.stack([np.cos(at), np.sin(at)], -1) * radius + side // 2, side, side))


def seen_through(scene: Pixels, opening: Pixels) -> Pixels:
    """A scene out of focus, behind a lens of that opening (height, width) in pixels."""
    import cv2

    blurred = cv2.filter2D(scene, -1, opening / opening.sum(), borderType=cv2.BORDER_REFLECT)
    return np.asarray(np.maximum(blurred, 0), np.float32)  # by Fourier transform, which rounds to either side


def _under_leaves(random: Random, scene: Pixels, film: Film) -> Pixels:
    """Under pieces of other pictures, each in its own light, some of them out of focus."""
    height, width = scene.shape[:2]
    scene = scene.copy()
    for _ in range(int(random.integers(1, 9))):
        size = math.hypot(width, height) * uniform_log(random, 0.1, 0.8)
        lengthened = math.exp(random.normal(0, 0.5))
        wide, high = (max(int(size * part), 8) for part in (math.sqrt(lengthened), 1 / math.sqrt(lengthened)))
        left, top = int(random.uniform(-wide / 2, width - wide / 2)), int(random.uniform(-high / 2, height - high / 2))
        shape = _leaf(random, wide, high)[..., None]
        piece = film(random, wide, high) * np.float32(math.exp(random.normal(0, 0.5)))
        seen = np.s_[max(-top, 0):height - top, max(-left, 0):width - left]
        covered = np.s_[max(top, 0):top + high, max(left, 0):left + wide]
        scene[covered] = _mixed(scene[covered], piece[seen], shape[seen])
    return scene


def _mixed(one: Pixels, other: Pixels, of_other: Pixels) -> Pixels:
    """By a share 0..1 of the other; light that rounding would leave below zero is none."""
    return np.asarray(np.maximum(one + (other - one) * of_other, 0), np.float32)


def _leaf(random: Random, width: int, height: int) -> Pixels:
    """(height, width) 0..1: a blot, a polygon or an ellipse, sharp in two of three."""
    import cv2

    kind = random.integers(3)
    if kind == 0:
        shape = _blot(random, width, height)
    else:
        corners = int(random.integers(3, 8)) if kind == 1 else 48  # so many that it looks round
        at = np.sort(random.uniform(0, 2 * math.pi, corners)) if kind == 1 else np.linspace(0, 2 * math.pi, corners)
        reach = random.uniform(0.5, 1, (corners, 1)) if kind == 1 else 0.95
        shape = _polygon((np.stack([np.cos(at), np.sin(at)], -1) * reach + 1) / 2 * (width, height), width, height)
    if random.random() < 1 / 3:
        soft = max(width, height) * uniform_log(random, 0.005, 0.08)
        return np.asarray(cv2.GaussianBlur(shape, (0, 0), soft, borderType=cv2.BORDER_CONSTANT), np.float32)
    return shape


def _blot(random: Random, width: int, height: int) -> Pixels:
    """(height, width) 0..1: what of some smooth hills is above a level."""
    import cv2

    coarse = random.random((int(random.integers(3, 9)), int(random.integers(3, 9)))).astype(np.float32)
    coarse[0] = coarse[-1] = coarse[:, 0] = coarse[:, -1] = 0
    hills = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)
    return np.asarray(np.clip((hills - random.uniform(0.3, 0.5)) * min(width, height) / 4 + 0.5, 0, 1), np.float32)


def _polygon(corners: NDArray[np.float64], width: int, height: int) -> Pixels:
    """(height, width) 0..1, with smooth edges. corners: (n, 2) in pixels."""
    import cv2

    shape = np.zeros((height, width), np.float32)
    cv2.fillPoly(shape, [(corners * 16).astype(np.int32)], (1.0,), cv2.LINE_AA, 4)  # in sixteenths of a pixel
    return shape


def _graded(random: Random, scene: Pixels) -> Pixels:
    """More or less of contrast and colour, under coloured light, in a few with colours exchanged."""
    level = np.float32(max(float(scene.mean()), 1e-4))
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


def _joined(random: Random, scene: Pixels, other: Pixels) -> Pixels:
    """One beside the other, with a sharp or a soft edge between them; or one as a pane of glass reflects it over the
    other."""
    height, width = scene.shape[:2]
    if random.random() < 0.3:
        share = np.float32(random.uniform(0.2, 0.8))
        return scene * share + other * (1 - share)
    angle, soft = random.uniform(0, 2 * math.pi), uniform_log(random, 0.005, 0.3)
    x = np.linspace(-1, 1, width, dtype=np.float32)[None, :]
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    beside = (x * np.float32(math.cos(angle)) + y * np.float32(math.sin(angle)) - random.uniform(-0.7, 0.7)) / soft
    of_other = (1 / (1 + np.exp(-np.clip(beside, -30, 30)))).astype(np.float32)[..., None]
    return _mixed(scene, other, of_other)


def _hazy(random: Random, scene: Pixels) -> Pixels:
    """Under haze of its own, lit by a low sun in half of them: bright and soft as a veil of flare, but behind what is
    near (Koschmieder's law; He, Sun and Tang 2009, "Single image haze removal using dark channel prior", take it out
    so)."""
    height, width = scene.shape[:2]
    across = math.hypot(width, height)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32) - random.uniform(-0.3, 1.3) * width,
                       np.arange(height, dtype=np.float32) - random.uniform(0, 0.7) * height)
    hidden = np.float32(1) - np.exp(-_haze_before(random, scene, y / height))[..., None]
    colour = np.exp(random.normal(0, 0.12, 3)).astype(np.float32)
    air = np.float32(np.quantile(scene.mean(-1), 0.9) * uniform_log(random, 0.5, 1.5)) * colour
    if random.random() < 0.5:
        warm = np.exp(random.normal((0.2, 0, -0.3), 0.2)).astype(np.float32)
        near_sun = np.exp(-np.hypot(x, y) / np.float32(across * uniform_log(random, 0.15, 0.8)))[..., None]
        air = air * (1 + near_sun * warm * np.float32(uniform_log(random, 0.5, 6)))
    return _mixed(scene, air, hidden)


def _haze_before(random: Random, scene: Pixels, below_horizon: Pixels) -> Pixels:
    """(height, width), how much haze lies before each place: none before what is near. How far a place is, is guessed:
    farther up to a horizon, and where it is bright, with the edges of the picture. below_horizon: in heights."""
    import cv2

    grey = np.log(scene.mean(-1) + np.float32(0.01))
    grey = (grey - grey.mean()) / max(float(grey.std()), 1e-2)
    up = np.float32(random.uniform(0.5, 4)) * np.minimum(-below_horizon, 0)
    radius = max(round(math.hypot(*scene.shape[:2]) * uniform_log(random, 0.01, 0.05)), 2)
    distance = cv2.ximgproc.guidedFilter(grey, up + grey, radius, 0.02)
    distance -= np.quantile(distance, random.uniform(0.15, 0.5))
    thick = uniform_log(random, 0.4, 4) / max(float(distance.max()), 1e-3)
    return np.asarray(np.maximum(distance, 0) * np.float32(thick), np.float32)


def _with_bright_things(random: Random, scene: Pixels) -> Pixels:
    """With some panels, or with what a floor or water shows of some lamps."""
    on_floor = random.random() < 0.4
    for _ in range(int(random.integers(1, 5))):
        colour = np.exp(random.normal(0, 0.3, 3) + random.uniform(-1.5, 1.5)).astype(np.float32)
        if on_floor:
            scene = scene + _reflection(random, *scene.shape[:2])[..., None] * colour
        else:
            shown = _panel(random, *scene.shape[:2])[..., None]
            scene = _mixed(scene, colour, shown)
    return scene


def _reflection(random: Random, height: int, width: int) -> Pixels:
    """(height, width) 0..1: of a lamp on a floor, long, upright, and broken up."""
    import cv2

    across = math.hypot(width, height) * uniform_log(random, 0.004, 0.03)
    along = across * uniform_log(random, 2, 12)
    x = (np.arange(width, dtype=np.float32)[None, :] - random.uniform(0, width)) / across
    y = (np.arange(height, dtype=np.float32)[:, None] - random.uniform(0, height)) / along
    waves = random.random((max(height // int(random.integers(2, 12)), 1), 3)).astype(np.float32)
    waves = np.asarray(cv2.resize(waves, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    return np.asarray(np.exp(-(x**2) - y**2) * (1 - random.uniform(0.4, 1) * waves), np.float32)


def _panel(random: Random, height: int, width: int) -> Pixels:
    """(height, width) 0..1: a window, screen or sign, level or in perspective, of one pane or of several."""
    import cv2

    half = math.hypot(width, height) * np.array([uniform_log(random, 0.01, 0.15), uniform_log(random, 0.01, 0.15)])
    corners = random.uniform(0, (width, height)) + SQUARE * half * np.exp(random.normal(0, 0.15, (4, 2)))
    shown = _polygon(corners, width, height)
    if random.random() < 0.5:
        panes = random.uniform(random.random(), 1, tuple(random.integers(1, 8, 2))).astype(np.float32)
        shown *= cv2.resize(panes, (width, height), interpolation=cv2.INTER_NEAREST)
    return shown
