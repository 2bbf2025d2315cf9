# SPDX-License-Identifier: GPL-3.0-or-later
"""Predicted streaks are corrected by what the frame shows along them."""
from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from core.colour.srgb import Pixels
from core.removal.inference.streaks import correct_streaks

WIDTH, HEIGHT = 320, 224
LIGHT = (150.0, 120.0)


def draw_streak(angle: float = 0.4, *, bend: float = 0.0, fan: float = 0.0, light: tuple[float, float] = LIGHT,
                width: float = 2.5) -> Pixels:
    """Draw a streak on both sides of a light, linear light, (h, w, 3). bend: of its line, per pixel. fan: growth of its
    width, per pixel."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    dx, dy = x - light[0], y - light[1]
    along = dx * math.cos(angle) + dy * math.sin(angle)
    across = dy * math.cos(angle) - dx * math.sin(angle) - bend * along**2
    spread = width + fan * np.abs(along)
    brightness = 0.25 * np.exp(-np.abs(along) / 90) * np.exp(-0.5 * (across / spread) ** 2)
    return np.asarray(brightness[..., None] * np.array([1.0, 0.8, 0.6]), np.float32)


def draw_scene(texture: float = 0.0, light: tuple[float, float] = LIGHT) -> Pixels:
    """Draw an even scene with a light disc, linear light, (h, w, 3). texture: of its detail, standard deviation."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    scene = np.full((HEIGHT, WIDTH, 3), 0.08, np.float32)
    scene += np.random.default_rng(3).normal(0, texture, (HEIGHT, WIDTH, 1)).astype(np.float32)
    scene[(x - light[0]) ** 2 + (y - light[1]) ** 2 < 25] = 2
    return np.maximum(scene, 0)


def beside_light(light: tuple[float, float] = LIGHT) -> np.ndarray:
    """Return where the light and what is next to it are not, (h, w)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray((x - light[0]) ** 2 + (y - light[1]) ** 2 > 20**2)


def correct(scene: Pixels, streak: Pixels, share: float, confidence: float = 1.0) -> tuple[Pixels, Pixels]:
    """Return the error of the clean frame, linear light, with this share of a streak predicted: before and after the
    correction."""
    frame = np.clip(scene + streak, 0, 1)
    predicted = np.where(frame < 0.95, share * streak, 0).astype(np.float32)
    corrected = correct_streaks(np.sqrt(frame), predicted, confidence)
    return frame - predicted - scene, frame - corrected - scene


@pytest.mark.parametrize("form", [{}, {"angle": 1.9}, {"bend": 2e-4}, {"fan": 0.03}, {"light": (60.0, 180.0)},
                                  {"width": 1.2}])
def test_the_missing_part_of_a_streak_is_removed(form: dict[str, float]) -> None:
    """Of a streak that was predicted at half of its light, less than half of the rest stays."""
    light = form.get("light", LIGHT)
    before, after = correct(draw_scene(0.004, light), draw_streak(**form), 0.5)
    area = beside_light(light) & (draw_streak(**form).mean(-1) > 0.02)
    assert np.abs(after[area]).mean() < np.abs(before[area]).mean() / 2
    assert np.abs(after[beside_light(light)]).max() <= np.abs(before[beside_light(light)]).max()


@pytest.mark.parametrize("form", [{}, {"bend": 2e-4}, {"fan": 0.03}])
def test_a_streak_that_is_predicted_too_bright_leaves_a_faint_line(form: dict[str, float]) -> None:
    """Predicted at 1.6 times its light, it leaves less than half of the darkness."""
    before, after = correct(draw_scene(0.004), draw_streak(**form), 1.6)
    codes = [255 * (math.sqrt(0.08) - np.sqrt(np.maximum(0.08 + np.minimum(error, 0), 0))) for error in (before, after)]
    area = beside_light() & (draw_streak(**form).mean(-1) > 0.02)
    dark_before, dark_after = (float(np.quantile(values[area], 0.95)) for values in codes)
    assert dark_before > 15 and dark_after < dark_before / 2


def test_a_frame_without_predicted_flare_is_unchanged() -> None:
    """A streak in the frame alone is no evidence: it may be a beam in the scene."""
    empty = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    frame = np.sqrt(np.clip(draw_scene() + draw_streak(), 0, 1))
    assert not correct_streaks(frame, empty).any()


def test_a_smooth_glow_is_unchanged() -> None:
    """A glow has no ridge, so it stays as it was predicted."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    glow = (0.3 / (1 + ((x - LIGHT[0]) ** 2 + (y - LIGHT[1]) ** 2) / 400))[..., None].astype(np.float32) * np.ones(3)
    before, after = correct(draw_scene(0.004), glow.astype(np.float32), 0.7)
    assert np.array_equal(before, after)


@pytest.mark.parametrize("share", [0.5, 1.6])
def test_over_busy_detail_the_prediction_stays(share: float) -> None:
    """Where the scene's detail is as bright as the streak, its ridge is uncertain: less than half of a wrong
    prediction is corrected, of which an even scene has most corrected."""
    changes = []
    for texture in (0.004, 0.15):
        before, after = correct(np.clip(draw_scene(texture), 0, 0.6), draw_streak(), share)
        area = beside_light() & (draw_streak().mean(-1) > 0.02)
        changes.append(float(np.abs(after - before)[area].mean() / np.abs(before)[area].mean()))
    assert changes[0] > 0.6 and changes[1] < 0.5


@pytest.mark.parametrize("form", [{"light": (150.0, 3.0), "angle": 0.0}, {"light": (150.0, 8.0), "angle": 0.04},
                                  {"light": (316.0, 120.0), "angle": math.pi / 2}])
@pytest.mark.parametrize("share", [1.0, 0.7])
def test_a_streak_along_the_frames_border_gets_no_worse(form: dict[str, Any], share: float) -> None:
    """Outside the frame there is nothing to compare a streak with, so there it stays as predicted."""
    scene = np.full((HEIGHT, WIDTH, 3), 0.3, np.float32)
    scene[draw_scene(light=form["light"])[..., 0] > 1] = 2
    before, after = correct(scene, draw_streak(**form), share)
    area = beside_light(form["light"])
    assert np.abs(after[area]).mean() <= np.abs(before[area]).mean() + 1e-4
    assert after[area].min() > -0.01


def test_an_edge_of_the_scene_that_meets_the_light_stays() -> None:
    """A step in brightness along a predicted streak is no ridge: most of the streak goes, and the step stays."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    scene = draw_scene(0.002)
    scene += np.where((y - LIGHT[1]) * math.cos(0.4) - (x - LIGHT[0]) * math.sin(0.4) > 0, 0.1, 0)[..., None]
    _, after = correct(scene, draw_streak(), 1.0)
    area = beside_light() & (draw_streak().mean(-1) > 0.02)
    assert np.abs(after[area]).mean() < 0.35 * draw_streak()[area].mean()
    assert np.abs(after[beside_light() & ~area]).mean() < 0.001


def test_a_correction_grows_with_the_predicted_ridge() -> None:
    """Twice the smallest ridge is corrected as a whole, less in part, so that a shot does not flicker at a threshold.
    """
    removed = []
    for share in np.linspace(0.02, 0.3, 15):
        frame = np.clip(draw_scene(0.002) + draw_streak(), 0, 1)
        predicted = np.where(frame < 0.95, share * draw_streak(), 0).astype(np.float32)
        removed.append(float(correct_streaks(np.sqrt(frame), predicted).sum() / draw_streak().sum()))
    assert removed[0] < 0.1 and removed[-1] > 0.4 and np.diff(removed).max() < 0.12


def test_confidence_bounds_the_correction() -> None:
    """At a confidence of one half, half of a streak is removed, not all of it."""
    frame = np.clip(draw_scene(0.002) + draw_streak(), 0, 1)
    predicted = np.where(frame < 0.95, 0.3 * draw_streak(), 0).astype(np.float32)
    area = beside_light() & (draw_streak().mean(-1) > 0.03)
    removed = correct_streaks(np.sqrt(frame), predicted, 0.5)[area].sum() / draw_streak()[area].sum()
    assert 0.35 < removed < 0.55


@pytest.mark.parametrize("shape", [(1, 1), (32, 32), (32, 480), (480, 32)])
def test_pictures_of_any_shape(shape: tuple[int, int]) -> None:
    """Small and narrow pictures, and lights at their border, raise nothing; no flare exceeds the frame."""
    random = np.random.default_rng(1)
    display = random.random((*shape, 3)).astype(np.float32)
    display[:2, :2] = 1
    flare = (0.5 * display**2).astype(np.float32)
    corrected = correct_streaks(display, flare)
    assert np.isfinite(corrected).all() and (corrected >= 0).all() and (corrected <= display**2 + 1e-6).all()
