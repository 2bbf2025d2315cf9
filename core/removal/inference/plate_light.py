# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts between the codes of a plate, linear light and display values, and subtracts a flare from codes.

Linear light is that of `image_formation.GAMMA`, in which the network's training frames are composed, for plates of
either encoding; a fit's layers are by the sRGB curve (`jobs.fitted`).
"""
from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import LUMINANCE, Pixels, linear_from_srgb
from ...images.picture import Encoding
from ...images.plates import Plate, finite_light
from ...images.write import MAX_HALF
from ..model import image_formation
from ..model.image_formation import GAMMA

CLIPPING_LEVEL = 0.97
"""Display value from which on a pixel counts as clipped."""
STRIP_ROWS = 256
"""Rows of a plate that are converted at a time, which bounds the memory."""

_LINEAR_FROM_UINT8 = np.power(np.arange(256, dtype=np.float32) / 255, np.float32(GAMMA)).astype(np.float32)


_PERCENTILES, _MAX_HIGHLIGHT = (95.0, 99.5), 4.0
"""Percentiles of the luminance that the exposure follows, and the largest ratio of the two that counts: lamps and the
sun exceed any picture's highlights."""
_USUAL_LEVEL = 0.65
"""Geometric mean of both in usual photographs, linear light."""
_MAX_GAIN = 1024.0
"""Largest gain, and smallest by its inverse, of a frame that is all black or all light."""
_MAX_SAMPLES = 500_000


def gain_to_usual_exposure(plate: Plate) -> np.float32:
    """Return the gain that brings a scene-linear plate to the exposure of a usual photograph; 1 for other plates.

    Plates that differ only by an exposure factor then look the same to the network, so it predicts the same flare.
    """
    if plate.encoding != "linear":
        return np.float32(1)
    stride = max(int(np.sqrt(plate.codes.shape[0] * plate.codes.shape[1] / _MAX_SAMPLES)), 1)
    luminance = finite_light(plate.codes[::stride, ::stride]) @ LUMINANCE.astype(np.float32)
    luminance = luminance[luminance > 0]  # borders are black
    if not len(luminance):
        return np.float32(1)
    bright_level, highlight_level = np.percentile(luminance, _PERCENTILES)
    picture_level = np.sqrt(max(bright_level * min(highlight_level, _MAX_HIGHLIGHT * bright_level), 0))
    return np.float32(np.clip(_USUAL_LEVEL / max(picture_level, 1e-9), 1 / _MAX_GAIN, _MAX_GAIN))


def to_network_plate(plate: Plate) -> tuple[Plate, np.float32]:
    """Return (plate as the network sees it, gain that its light was multiplied by): sRGB codes, or Rec. 709 light at a
    usual exposure; the plate itself if nothing had to change."""
    rec709 = plate.in_rec709
    gain = gain_to_usual_exposure(rec709)
    return (rec709 if gain == 1 else replace(rec709, codes=finite_light(rec709.codes) * gain, extras={})), gain


def to_linear(codes: NDArray[Any], encoding: Encoding, max_code: float) -> Pixels:
    """Convert codes to linear light, float32. max_code: the code of white, if the encoding is "srgb"."""
    if encoding == "srgb":
        if codes.dtype == np.uint8:
            return _LINEAR_FROM_UINT8[codes]
        return np.power(codes.astype(np.float32) / np.float32(max_code), np.float32(GAMMA))
    return finite_light(codes)


def to_display(light: Pixels) -> Pixels:
    """Convert linear light to display values, clipped to 0..1."""
    return image_formation.to_display(light, GAMMA)


def downscale_linear(codes: NDArray[Any], encoding: Encoding, max_code: float, width: int, height: int) -> Pixels:
    """Downscale a plate to (height, width, 3) by averaging areas of linear light, clipped to 0..1 before.

    Works in strips of result rows, whose borders are rounded to whole rows of the plate: the whole plate as floats
    might not fit into memory.
    """
    import cv2

    rows = codes.shape[0]
    result = np.zeros((height, width, 3), np.float32)
    strip_rows = max(height * STRIP_ROWS // rows, 1)
    for start in range(0, height, strip_rows):
        stop = min(start + strip_rows, height)
        first_row, end_row = start * rows // height, max(-(-stop * rows // height), start * rows // height + 1)
        strip = np.clip(to_linear(codes[first_row:end_row], encoding, max_code), 0, 1)
        result[start:stop] = cv2.resize(strip, (width, stop - start), interpolation=cv2.INTER_AREA)
    return result


def subtract_flare(codes: NDArray[Any], flare: Pixels, encoding: Encoding, max_code: float) -> NDArray[Any]:
    """Return the codes minus a linear flare; unchanged to the last bit where the flare is 0 or a code is not finite."""
    light = to_linear(codes, encoding, max_code) - flare
    if encoding == "srgb":
        clean = (to_display(light) * np.float32(max_code) + np.float32(0.5)).astype(codes.dtype)
    else:
        clean = light.astype(codes.dtype)
    return np.where((flare > 0) & np.isfinite(codes), clean, codes)


def removed_light(codes: NDArray[Any], clean: NDArray[Any], flare: Pixels, encoding: Encoding,
                  max_code: float) -> Pixels:
    """Return the flare to write, in scene-linear light, at most MAX_HALF.

    For linear codes that is `flare`, the linear flare that was subtracted. For display codes it is the light of the
    codes minus the light of the clean codes, both by the sRGB curve; `flare` itself is by another curve
    (`image_formation.GAMMA`). codes, clean, flare and the result: (height, width, 3).
    """
    if encoding == "linear":
        return np.minimum(flare, MAX_HALF)
    before, after = (linear_from_srgb(part.astype(np.float32) / np.float32(max_code)) for part in (codes, clean))
    return np.where(flare > 0, before - after, 0)
