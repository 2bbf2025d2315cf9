# SPDX-License-Identifier: GPL-3.0-or-later
"""A capture's frames without the flare that a fit has found in them.

What a fit knows of a flare it knows from all views together, which is more than any single plate says. Its flare is
taken from a plate in linear light, of each light as much as the plate shows of it. Where the plate is clipped, nothing
is left of what lay under the flare: there the fitted scene stands in, as far as it is brighter. The lights' own clipped
discs stay as they are; where the fit was shown light above white the scene stands in there too, so that a lamp keeps
the light that is its own.
"""
from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...capture import Capture, View
from ...capture.discs import clipped_discs
from ...colour.srgb import Pixels, linear_from_srgb, srgb_from_linear
from ...errors import CaptureError
from ...images.exr import window_of
from ...images.plates import Plate, finite, read_plate, write_results
from ...metrics.evaluation import Renderer
from ...system.files import check_apart, inside
from ...system.progress import Progress
from ..inference.remover import CLIPPED
from .manifest import Kept, Record, made_from

Floats = NDArray[np.float64]

ASKED = 100_000
"""Pixels of a plate, about, that are asked how much of each light's flare is there."""
HALF = 0.5
"""Part of a flare below which it is told that there is less of it."""
UNEVEN = 1.25
"""Times that a plate's scene may be brighter or darker than it was fitted: what `core.fit.metering` leaves."""
ROUNDS, SWEEPS = 8, 50
FAINT = 0.01
"""Linear light, below which errors count by their squares."""
KEPT = 1e-4
"""How much, a pixel, counts what was fitted: more than the plate does for flares of a thousandth of white."""


def remove_fitted(fitted: Renderer, capture: Capture, views: Sequence[View], folder: Path, progress: Progress, *,
                  flare_folder: Path | None = None, overwrite: bool = False,
                  made_by: str = "", above_white: bool = False) -> dict[str, Any]:
    """Write the views' frames without the fitted flare below `folder`, each under its own name, in its own kind and
    depth; those that are there, made from the same frame, camera and lights by the same fit, their flares too where
    those are wanted, or worked on since they were made from the same frame, are kept, unless `overwrite`. made_by:
    changes whenever the fit's pictures would. above_white: whether the fit was shown light above white.

    Raises CaptureError for frames with lens distortion, which the flare was not fitted with, SettingsError where frames
    would be overwritten, FrameError for a frame that cannot be read or whose plate in `folder` is not from here.
    """
    if any(view.lens for view in views):
        raise CaptureError(f"The frames of {capture.folder} are distorted by their lens, and the flare was fitted "
                           "without that; undistort them first (for instance with COLMAP's image_undistorter).")
    results = [_results(view, folder, flare_folder) for view in views]
    check_apart([capture.frame_path(view) for view in capture.views], itertools.chain.from_iterable(results))
    progress.stage("remove", len(views))
    record, lights = Record(folder), [(light.name, light.xyz.tolist()) for light in capture.lights]
    made, kept, dim = 0, Counter[Kept](), Counter[str]()
    for view, targets in zip(views, results, strict=True):
        name = Path(view.name)
        frame = capture.frame_path(view)
        how = made_from(repr((made_by, view.camera.numbers, lights)), [frame])
        if not overwrite and (why := record.keeps(name, frame, how, targets)):
            kept[why] += 1
        else:
            record.begin(name, frame, how, targets, overwrite)
            parts = _remove(fitted, capture, view, targets, above_white)
            record.end(targets)
            dim.update(light for light, part in parts.items() if part < HALF)
            made += 1
        progress.advance()
    for light, count in dim.items():
        progress.say(f"{count} of {made} frames show less than half of the flare that {light!r} has in the fit; no "
                     "more than they show was taken from them.")
    record.tell_kept(kept, progress)
    progress.say(f"{len(views)} clean plates are in {folder}.")
    return {"plates": str(folder), "made": made, "kept": kept.total()}


def _results(view: View, folder: Path, flare_folder: Path | None) -> list[Path]:
    """Of the clean plate, and of the flare where it is wanted."""
    plate = inside(folder, view.name, CaptureError)
    if flare_folder is None:
        return [plate]
    return [plate, inside(flare_folder, str(Path(view.name).with_suffix(".exr")), CaptureError)]


def _remove(fitted: Renderer, capture: Capture, view: View, results: Sequence[Path],
            above_white: bool) -> dict[str, float]:
    """results: the clean plate's path, and the flare's where it is wanted. Gives the part of each light's flare that
    was there."""
    plate = read_plate(capture.frame_path(view))
    height, width = plate.codes.shape[:2]
    window = window_of(capture.frame_path(view))  # an EXR's pixels may be more than those of the frame, or fewer
    camera = view.camera if view.camera.size == window.frame else view.camera.scaled(*window.frame)
    camera = camera if window.is_frame else camera.cropped(*window.origin, *window.size)
    layers = fitted.render(camera)
    flare = np.zeros((height, width, 3), np.float32)
    part = plate.inside.part  # the borders, which were not fitted, stay
    flares, scene = layers.flare_by_light, layers.scene
    if plate.encoding == "linear":  # the fit was shown Rec. 709
        flares = {light: plate.space.from_linear(one) for light, one in flares.items()}
        scene = plate.space.from_linear(scene)
    flares, scene = {light: plate.shown(one) for light, one in flares.items()}, plate.shown(scene)
    parts = _parts(plate, scene, flares)
    for light, one in flares.items():
        flare[part] += np.float32(parts[light]) * one[part]
    lights = clipped_discs(_display(plate), camera, [light.xyz for light in capture.lights])
    if above_white and plate.encoding == "linear":
        clean = without(plate, flare, scene, lights)
    else:
        clean = without(plate, np.where(lights[..., None], 0, flare), scene)
    write_results(results, plate, clean, flare)
    return parts


def _parts(plate: Plate, scene: Pixels, flares: Mapping[str, Pixels]) -> dict[str, float]:
    """Of each light's flare the part, 0..1, that the plate holds beside the scene, in the sense of least absolute
    errors: a light that is switched off, or hidden by what the fit knows nothing of, leaves no dark flare. The scene
    may be a little brighter or darker than it was fitted, or a frame exposed for less would seem to lack flare."""
    if not flares:
        return {}
    part = plate.inside.part
    step = max(round(math.sqrt(math.prod(plate.codes.shape[:2]) / ASKED)), 1)
    shown, *layers = (one[part][::step, ::step] for one in (_light(plate), scene, *flares.values()))
    clipped = linear_from_srgb(np.array(CLIPPED)) if plate.encoding == "srgb" else np.inf
    tells = (shown < clipped).all(-1)
    light = shown[tells].ravel().astype(np.float64)
    columns = np.stack([one[tells].ravel() for one in layers], 1).astype(np.float64)
    low, high = np.array([[1 / UNEVEN, UNEVEN], *len(flares) * [[0.0, 1.0]]]).T
    parts, weights = np.ones(len(layers)), np.ones(len(light))
    held = KEPT * max(len(light), 1) * np.eye(len(layers))  # of a plate that is white all over nothing else tells
    for _ in range(ROUNDS):
        weighted = columns.T * weights
        parts = _least_squares(weighted @ columns + held, weighted @ light + held.sum(1), parts, low, high)
        weights = 1 / (np.abs(light - columns @ parts) + FAINT)
    return dict(zip(flares, parts[1:].tolist(), strict=True))


def _least_squares(product: Floats, goal: Floats, begin: Floats, low: Floats, high: Floats) -> Floats:
    """x (n,) between two bounds that product x = goal comes nearest to, one coordinate after the other."""
    found = begin.copy()
    for _ in range(SWEEPS):
        for at in range(len(found)):
            rest = goal[at] - product[at] @ found + product[at, at] * found[at]
            found[at] = min(max(rest / product[at, at], low[at]), high[at])
    return found


def _light(plate: Plate) -> Pixels:
    """Linear light of the codes by sRGB's curve, which is that of a fit's layers; the network's has its own
    (`formation.GAMMA`)."""
    if plate.encoding == "srgb":
        return linear_from_srgb(_display(plate))
    return finite(plate.codes)


def _display(plate: Plate) -> Pixels:
    """Display values of the codes, 0..1."""
    if plate.encoding == "srgb":
        return plate.values
    return srgb_from_linear(np.clip(np.nan_to_num(plate.codes.astype(np.float32)), 0, 1))


def without(plate: Plate, flare: Pixels, scene: Pixels, hidden: NDArray[np.bool_] | None = None) -> NDArray[Any]:
    """The plate's codes less a flare, given linear light of flare and scene as (height, width, 3); kept to the last bit
    where there is no flare, and where they are no numbers. The scene stands in where the plate is clipped and where,
    (height, width), what lies under the flare is `hidden` otherwise."""
    light = _light(plate)
    clipped = np.zeros((*light.shape[:2], 1), bool)
    if plate.encoding == "srgb":
        clipped = _display(plate).max(-1, keepdims=True) >= CLIPPED
    if hidden is not None:
        clipped = clipped | hidden[..., None]
    less = light - flare
    less = np.maximum(np.where(clipped, np.maximum(less, np.minimum(scene, light)), less), np.minimum(light, 0))
    if plate.encoding == "srgb":
        codes = (srgb_from_linear(less) * np.float32(plate.top) + np.float32(0.5)).astype(plate.codes.dtype)
    else:
        codes = less.astype(plate.codes.dtype)
    return np.where((flare != 0) & np.isfinite(plate.codes.astype(np.float32)), codes, plate.codes)
