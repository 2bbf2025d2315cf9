# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights that were given beside their flares, put where those are.

A light that was placed by hand is off by a part of its distance, and with it the line that its ghosts lie on, in every
view. A flare is brightest about its light. So each light climbs to where it is brightest, in all views at once: mean
shift (Comaniciu and Meer 2002) under windows that narrow, whose steps in the pictures become one step in the world by
least squares. A pixel belongs to the lights in parts, as their windows reach it, so that two do not climb one flare.

A light that is right already sits on a peak, and stays as it was given. So does one that finds no clear peak.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..capture.camera import Camera, Floats
from ..capture.discs import WHITE
from ..colour.srgb import linear_from_srgb

WINDOWS = (0.12, 0.08, 0.05, 0.03, 0.02, 0.013)
"""Deviations of the windows, of the frame's width: from as far as a light may be off. Peaks nearby are tried first, so
that each light finds its own."""
REACH = 1.5
"""Of the widest window: how far a light may be off, in the median view."""
STEPS = 12
"""At most, under each window."""
FINE, PEAK, RESTLESS = 0.02, 1.5, 0.3
"""A light sits on a peak where the window FINE holds so many times as much as one twice as wide, and the views would
draw it aside by less than such a part of the window."""
GLOW, CORE = 0.03, 10.0
"""A clipped light adds nothing in the frame to what its own white already is: it counts for so many times the flare
about it, under a window of this deviation."""
STIFF = 3e-3
"""Of the mean curvature: how little is known along the line of sight moves a light but little."""


class Sight(NamedTuple):
    """A camera, and how bright a flare is in its picture: (height, width), linear, 0 and more."""

    camera: Camera
    flare: NDArray[np.float32]


def sight(camera: Camera, frame: NDArray[np.float32], clean: NDArray[np.float32]) -> Sight:
    """From a frame and the same without flare, display values 0..1, (height, width, 3) of the camera's size."""
    import cv2

    added = (linear_from_srgb(frame) - linear_from_srgb(clean)).clip(min=0).mean(-1)
    about = cv2.GaussianBlur(added, (0, 0), GLOW * camera.width)
    return Sight(camera, np.asarray(added + (frame >= WHITE).all(-1) * about * np.float32(CORE), np.float32))


def snapped(sights: Sequence[Sight], lights: ArrayLike) -> Floats:
    """Where the lights (n, 3), world coordinates, are by their flares; the same (n, 3) where these do not say."""
    given = np.array(lights, np.float64).reshape(-1, 3)
    found, settled = given.copy(), _on_peaks(sights, given)
    for first in reversed(range(len(WINDOWS) - 2)):
        if settled.all():
            break
        tried = _climbed(sights, found, ~settled, WINDOWS[first:])
        better = ~settled & _on_peaks(sights, tried) & ~_together(sights, tried) & _near(sights, given, tried)
        found[better], settled = tried[better], settled | better
    return found


def _climbed(sights: Sequence[Sight], places: Floats, loose: NDArray[np.bool_], windows: Sequence[float]) -> Floats:
    """(n, 3) where those that are loose (n,) come to; the others keep what is theirs of the pictures."""
    places = places.copy()
    for window in windows:
        for _ in range(STEPS):
            farthest = 0.0
            for light, seen in enumerate(_observe(sights, places, window)):
                if not loose[light] or len(seen) < 2:
                    continue
                step = _step(seen)
                places[light] += step
                farthest = max(farthest, *(float(np.linalg.norm(one.slope @ step)) for one in seen))
            if farthest < 0.05:
                break
    return places


def _on_peaks(sights: Sequence[Sight], places: Floats) -> NDArray[np.bool_]:
    """(n,) which lights sit on a peak of brightness."""
    fine, wide = (_observe(sights, places, window) for window in (FINE, 2 * FINE))
    found = np.zeros(len(places), bool)
    for light, (near, about) in enumerate(zip(fine, wide, strict=True)):
        if near:
            brightness = np.array([one.brightness for one in near])
            aside = np.array([np.linalg.norm(one.aside) for one in near]) @ brightness / brightness.sum()
            peak = brightness.mean() / np.mean([one.brightness for one in about])
            found[light] = peak > PEAK and aside < RESTLESS * FINE * sights[0].camera.width
    return found


class _Observation(NamedTuple):
    """What one view says of a light: mean brightness under its window; the mean of where it is, from the window's own
    (2,), pixels; and how the pixel moves with the light (2, 3)."""

    brightness: float
    aside: Floats
    slope: Floats


def _step(seen: Sequence[_Observation]) -> Floats:
    """(3,) in the world, that brings a light nearest to where its views see the most; dim views count less."""
    brightness = np.array([one.brightness for one in seen])
    weights = np.minimum(brightness / np.quantile(brightness, 0.75), 1)
    slopes, asides = np.stack([one.slope for one in seen]), np.stack([one.aside for one in seen])
    curvature = np.einsum("v,vij,vik->jk", weights, slopes, slopes)
    pull = np.einsum("v,vij,vi->j", weights, slopes, asides)
    return np.asarray(np.linalg.solve(curvature + STIFF * np.trace(curvature) / 3 * np.eye(3), pull))


def _observe(sights: Sequence[Sight], places: Floats, window: float) -> list[list[_Observation]]:
    """By light, the views that see anything under its window, a deviation in parts of the frame's width."""
    found: list[list[_Observation]] = [[] for _ in places]
    for camera, flare in sights:
        height, width = flare.shape
        deviation = window * width
        across, down = np.arange(width) + 0.5, np.arange(height) + 0.5
        pixels, depth = camera.project(places)
        at = {light: (np.exp(-0.5 * ((across - x) / deviation) ** 2), np.exp(-0.5 * ((down - y) / deviation) ** 2))
              for light, (x, y) in enumerate(pixels) if depth[light] > 0}
        windows = {light: row * column[:, None] for light, (row, column) in at.items()}
        together = sum(windows.values(), np.full((height, width), 1e-12))
        for light, one in windows.items():
            own = one * one / together
            weights = own * flare
            whole, total = own.sum(), weights.sum()
            if total <= 1e-12 * max(whole, 1e-12):
                continue
            # Less the window's own mean, which the frame's edge and the other lights' windows draw aside.
            aside = [(weights.sum(axis) @ where) / total - (own.sum(axis) @ where) / whole
                     for axis, where in ((0, across), (1, down))]
            found[light].append(_Observation(float(total) / (2 * np.pi * deviation**2), np.array(aside),
                                             camera.jacobian(places[light])))
    return found


def _together(sights: Sequence[Sight], places: Floats) -> NDArray[np.bool_]:
    """(n,) which lights have another in their place, in most views."""
    near = np.zeros((len(places), len(places)))
    for camera, _ in sights:
        pixels, _ = camera.project(places)
        near += np.linalg.norm(pixels[:, None] - pixels, axis=-1) < FINE * camera.width
    near -= np.diag(np.diag(near))
    return np.asarray((near > len(sights) / 2).any(1))


def _near(sights: Sequence[Sight], given: Floats, places: Floats) -> NDArray[np.bool_]:
    """(n,) which places lie no farther from the lights given than the widest window reaches: what does is a ghost of
    a light that is out of the frame."""
    near = np.zeros(len(given), bool)
    pictures = [(camera.width, *camera.project(given), *camera.project(places)) for camera, _ in sights]
    for light in range(len(given)):
        moved = [float(np.linalg.norm(after[light] - before[light])) / width
                 for width, before, front, after, still in pictures if front[light] > 0 and still[light] > 0]
        near[light] = bool(moved) and float(np.median(moved)) < REACH * WINDOWS[0]
    return near
