# SPDX-License-Identifier: GPL-3.0-or-later
"""Prepares plates of any shape for the network: transparent ones, panoramas, and long ones.

What alpha hides continues the picture for the network (`fill_hidden`). A panorama of the whole circle gets a margin
from its other side at each edge, and both predictions of a margin are merged, so that there is no seam. A long picture
is predicted in parts that overlap. `remover` calls all of it.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels, srgb_from_linear
from ...images.panorama import do_sides_meet, wraps_around
from ...images.plates import Plate, finite_light
from ..model.network import SIZE_MULTIPLE

MAX_ASPECT = 3.0
"""Long side relative to the short one up to which a picture is predicted as a whole."""
PART_ASPECT = 2
"""Long side of a part relative to the short one."""
MAX_LONG_SIDE = 32
"""Largest long side of the network's input, relative to the working size."""
FILL_SIZE = 256
"""Long side at which hidden parts are filled, pixels."""
WRAP_SHARE = 8
"""Width of a panorama relative to the margin at each of its edges."""


def fill_hidden(plate: Plate) -> Plate:
    """Return the plate opaque, its hidden parts filled with a continuation of the colours beside them.

    A plate without straight alpha below 1 is returned unchanged: premultiplied codes hold no hidden colours. The
    colours that a file stores under straight alpha 0 are arbitrary, and black ones would look like a vignette to the
    network.
    """
    import cv2

    alpha = plate.straight_alpha
    if alpha is None or (alpha >= 1).all():
        return plate
    height, width = alpha.shape
    scale = min(FILL_SIZE / max(height, width), 1)
    small_size = max(round(width * scale), 1), max(round(height * scale), 1)
    light = plate.space.to_linear(plate.values) * alpha[..., None]
    filling = _pull_push_fill(*(np.asarray(cv2.resize(part, small_size, interpolation=cv2.INTER_AREA), np.float32)
                                for part in (light, alpha)))
    # Where alpha is partial, the filling shows through.
    light += (1 - alpha)[..., None] * np.asarray(cv2.resize(filling, (width, height)), np.float32)
    values = plate.space.from_linear(light)
    if plate.encoding == "srgb":
        values = np.clip(values * np.float32(plate.max_code) + np.float32(0.5), 0, plate.max_code)
    codes = np.where((alpha < 1)[..., None], values.astype(plate.codes.dtype), plate.codes)
    return replace(plate, codes=codes, alpha=None)


def _pull_push_fill(light: Pixels, alpha: Pixels) -> Pixels:
    """Fill premultiplied light (h, w, 3) where its alpha (h, w) is below 1 by means over larger and larger windows
    (pull-push, Gortler et al. 1996)."""
    import cv2

    if min(alpha.shape) <= 2:
        alpha_sum = alpha.sum()
        return np.broadcast_to(light.sum((0, 1)) / max(alpha_sum, np.float32(1e-6)), light.shape).astype(np.float32)
    coarse = _pull_push_fill(np.asarray(cv2.pyrDown(light), np.float32), np.asarray(cv2.pyrDown(alpha), np.float32))
    upsampled = np.asarray(cv2.pyrUp(coarse, dstsize=(alpha.shape[1], alpha.shape[0])), np.float32)
    return light + (1 - alpha)[..., None] * upsampled


def wrap_margin(plate: Plate) -> int:
    """Return how many columns a panorama gets from its other side at each edge; 0 for other pictures.

    A picture counts as a panorama by its name or header, or where it is twice as wide as high and its sides meet.
    """
    width = plate.codes.shape[1]
    is_panorama = wraps_around(plate.path, plate.extras.get("header")) or (
        width == 2 * plate.codes.shape[0] >= 4 and do_sides_meet(_side_columns(plate)))
    return width // WRAP_SHARE if is_panorama else 0


def _side_columns(plate: Plate) -> Pixels:
    """Return display values (height, 4, 3) of the first two and the last two columns."""
    sides = replace(plate, codes=plate.codes[:, [0, 1, -2, -1]], alpha=None).in_rec709
    return sides.values if sides.encoding == "srgb" else np.asarray(
        srgb_from_linear(np.clip(finite_light(sides.codes), 0, 1)))


def wrap_plate(plate: Plate, margin: int) -> Plate:
    """Return a plate with `margin` columns from its other side at each edge; itself without a margin."""
    return replace(plate, codes=wrap_columns(plate.codes, margin), alpha=None) if margin else plate


def wrap_columns(pixels: NDArray[Any], margin: int) -> NDArray[Any]:
    """Return pixels (height, width, ...) with `margin` columns from the other side at each edge."""
    return np.concatenate([pixels[:, pixels.shape[1] - margin:], pixels, pixels[:, :margin]], 1) if margin else pixels


def merge_margins(light: Pixels, margin: int) -> Pixels:
    """Remove the margins of a wrapped plate's light: (height, width + 2 margin, 3) to (height, width, 3).

    Each margin is a second prediction of the columns at the other edge. It counts half at the seam and falls linearly
    to nothing within `margin` columns, where the first prediction has more picture around it.
    """
    if not margin:
        return light
    width = light.shape[1] - 2 * margin
    merged = light[:, margin:margin + width].copy()
    weight = (np.arange(margin, 0, -1, dtype=np.float32) - np.float32(0.5))[None, :, None] / (2 * margin)
    merged[:, :margin] += weight * (light[:, margin + width:] - merged[:, :margin])
    merged[:, width - margin:] += weight[:, ::-1] * (light[:, :margin] - merged[:, width - margin:])
    return merged


def input_size(width: int, height: int, working_size: int) -> tuple[int, int]:
    """Return (width, height) of the network's input for a picture, multiples of SIZE_MULTIPLE. The working size is the
    long side of the picture or, if it is predicted in parts, of each part."""
    long_side, short_side = max(width, height), min(width, height)
    scale = working_size / long_side
    if long_side > MAX_ASPECT * short_side:
        scale = min(working_size / (PART_ASPECT * short_side), MAX_LONG_SIDE * working_size / long_side)
    # Rounding a side up must not exceed the long side.
    max_multiple = max(int(max(long_side * scale, working_size)) // SIZE_MULTIPLE, 2)
    input_width, input_height = (int(np.clip(round(side * scale / SIZE_MULTIPLE), 2, max_multiple)) * SIZE_MULTIPLE
                                 for side in (width, height))
    return input_width, input_height


def predict_in_parts(display: Pixels, predict: Callable[[Pixels], Pixels]) -> Pixels:
    """Predict display values (h, w, 3); a long picture in parts, whose predictions are averaged where they overlap.

    predict: the network, (h, w, 3) to (h, w, n), h and w multiples of SIZE_MULTIPLE.
    """
    height, width = display.shape[:2]
    if max(height, width) <= MAX_ASPECT * min(height, width):
        return predict(display)
    if height > width:
        return predict_in_parts(display.swapaxes(0, 1), lambda part: predict(part.swapaxes(0, 1)).swapaxes(0, 1)
                                ).swapaxes(0, 1)
    part_width = PART_ASPECT * height
    # Parts begin half a part apart at most. Their weight falls to 0 at their ends, so no seam shows.
    starts = np.linspace(0, width - part_width, -(-2 * (width - part_width) // part_width) + 1).round().astype(int)
    position = np.arange(part_width, dtype=np.float32) + np.float32(0.5)
    weight = np.minimum(position, part_width - position)[None, :, None]
    weight_sum, merged = np.zeros((1, width, 1), np.float32), None
    for start in starts:
        prediction = predict(display[:, start:start + part_width]) * weight
        if merged is None:
            merged = np.zeros((height, width, prediction.shape[2]), np.float32)
        merged[:, start:start + part_width] += prediction
        weight_sum[:, start:start + part_width] += weight
    assert merged is not None
    return merged / weight_sum
