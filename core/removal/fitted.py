# SPDX-License-Identifier: GPL-3.0-or-later
"""A capture's frames without the flare that a fit has found in them.

What a fit knows of a flare it knows from all views together, which is more than any single plate says. Its flare is
taken from a plate in linear light. Where the plate is clipped, nothing is left of what lay under the flare: there the
fitted scene stands in, as far as it is brighter. The lights' own clipped discs stay as they are; where the fit was
shown light above white the scene stands in there too, so that a lamp keeps the light that is its own.
"""
from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture, View
from ..capture.discs import clipped_discs
from ..errors import CaptureError
from ..files import check_apart, inside
from ..metrics.evaluation import Renderer
from ..pictures import linear_from_srgb, srgb_from_linear
from ..progress import Progress
from .inference import CLIPPED
from .plates import Plate, read_plate, write_flare, write_plate
from .record import Record, made_from

Pixels = NDArray[np.float32]


def remove_fitted(fitted: Renderer, capture: Capture, views: Sequence[View], folder: Path, progress: Progress, *,
                  flare_folder: Path | None = None, overwrite: bool = False,
                  made_by: str = "", above_white: bool = False) -> dict[str, Any]:
    """Write the views' frames without the fitted flare below `folder`, each under its own name, in its own kind and
    depth; those that are there, made from the same frame, camera and lights by the same fit, their flares too where
    those are wanted, are kept, unless `overwrite`. made_by: changes whenever the fit's pictures would. above_white:
    whether the fit was shown light above white.

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
    made = 0
    for view, targets in zip(views, results, strict=True):
        name = Path(view.name)
        how = made_from(repr((made_by, view.camera.numbers, lights)), [capture.frame_path(view)])
        if overwrite or not record.is_made(name, how, targets):
            record.begin(name, how, targets, overwrite)
            _remove(fitted, capture, view, targets, above_white)
            made += 1
        progress.advance()
    if made < len(views):
        progress.say(f"{len(views) - made} plates were in {folder} already; --overwrite makes them again.")
    progress.say(f"{len(views)} clean plates are in {folder}.")
    return {"plates": str(folder), "made": made, "kept": len(views) - made}


def _results(view: View, folder: Path, flare_folder: Path | None) -> list[Path]:
    """Of the clean plate, and of the flare where it is wanted."""
    plate = inside(folder, view.name, CaptureError)
    if flare_folder is None:
        return [plate]
    return [plate, inside(flare_folder, str(Path(view.name).with_suffix(".exr")), CaptureError)]


def _remove(fitted: Renderer, capture: Capture, view: View, results: Sequence[Path], above_white: bool) -> None:
    """results: the clean plate's path, and the flare's where it is wanted."""
    plate = read_plate(capture.frame_path(view))
    height, width = plate.codes.shape[:2]
    camera = view.camera if view.camera.size == (width, height) else view.camera.scaled(width, height)
    layers = fitted.render(camera)
    flare = np.zeros((height, width, 3), np.float32)
    part = plate.inside.part  # the borders, which were not fitted, stay
    flare[part] = np.sum([flare, *layers.flare_by_light.values()], axis=0)[part]
    scene = layers.scene
    if plate.encoding == "linear":  # the fit was shown Rec. 709
        flare, scene = plate.space.from_linear(flare), plate.space.from_linear(scene)
    lights = clipped_discs(_display(plate), camera, [light.xyz for light in capture.lights])
    if above_white and plate.encoding == "linear":
        clean = without(plate, flare, scene, lights)
    else:
        clean = without(plate, np.where(lights[..., None], 0, flare), scene)
    write_plate(results[0], plate, clean)
    for result in results[1:]:
        write_flare(result, plate, flare)


def _display(plate: Plate) -> Pixels:
    """Display values of the codes, 0..1."""
    if plate.encoding == "srgb":
        return plate.codes.astype(np.float32) / np.float32(plate.top)
    return srgb_from_linear(np.clip(np.nan_to_num(plate.codes.astype(np.float32)), 0, 1))


def without(plate: Plate, flare: Pixels, scene: Pixels, hidden: NDArray[np.bool_] | None = None) -> NDArray[Any]:
    """The plate's codes less a flare, given linear light of flare and scene as (height, width, 3); kept to the last bit
    where there is no flare, and where they are no numbers. The scene stands in where the plate is clipped and where,
    (height, width), what lies under the flare is `hidden` otherwise."""
    if plate.encoding == "srgb":
        display = _display(plate)
        light, clipped = linear_from_srgb(display), display.max(-1, keepdims=True) >= CLIPPED
    else:
        light = np.nan_to_num(plate.codes.astype(np.float32), nan=0.0, posinf=65504.0, neginf=0.0)
        clipped = np.zeros((*light.shape[:2], 1), bool)
    if hidden is not None:
        clipped = clipped | hidden[..., None]
    less = light - flare
    less = np.maximum(np.where(clipped, np.maximum(less, np.minimum(scene, light)), less), np.minimum(light, 0))
    if plate.encoding == "srgb":
        codes = (srgb_from_linear(less) * np.float32(plate.top) + np.float32(0.5)).astype(plate.codes.dtype)
    else:
        codes = less.astype(plate.codes.dtype)
    return np.where((flare != 0) & np.isfinite(plate.codes.astype(np.float32)), codes, plate.codes)
