# SPDX-License-Identifier: GPL-3.0-or-later
"""Upsamples a flare from the working size to the plate.

A flare lies over the scene and does not follow its edges, so it is interpolated. Where the plate is clipped, though,
only the visible part of the flare is predicted, and that ends where the clipping does: there a guided filter (He et al.
2013, in the fast form of He and Sun 2015) follows the plate, flare = gain * plate + offset, with smooth gain and offset
that are fitted at the working size and applied to the plate's own pixels.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ...images.picture import Encoding
from .plate_light import CLIPPING_LEVEL, STRIP_ROWS, to_display, to_linear

RADIUS, EPSILON = 1, 1e-3
"""Radius of the guided filter's window at the working size, pixels, and its regularisation."""
MAX_GAIN = 4
"""Bound of the gain's magnitude."""
REMAP_COLUMNS = 16384
"""Columns of a plate that are interpolated at a time; OpenCV counts coordinates in 16 bits."""


@dataclass(frozen=True)
class GuidedFilterMaps:
    """A flare at the working size: flare = gain * display + offset, (h, w, 3) each."""

    gain: Pixels
    offset: Pixels

    @property
    def is_empty(self) -> bool:
        """Return whether there is no flare at all."""
        return not (self.gain.any() or self.offset.any())


def fit_guided_filter(display: Pixels, flare: Pixels) -> GuidedFilterMaps:
    """Fit the maps to a flare in linear light, both (h, w, 3) at the working size.

    Away from clipped pixels the gain is 0 and the offset is the flare. Around clipped pixels each channel has a guided
    filter: a linear fit in every window, then for every pixel the mean of the fits of the windows that contain it,
    weighted by their variance, so that windows with an edge count most.
    """
    import cv2

    if not flare.any():
        return GuidedFilterMaps(np.zeros_like(flare), np.zeros_like(flare))
    window = (2 * RADIUS + 1, 2 * RADIUS + 1)

    def mean(values: Pixels) -> Pixels:
        return np.asarray(cv2.blur(values, window, borderType=cv2.BORDER_REFLECT), np.float32)

    clipped_reach = (4 * RADIUS + 1, 4 * RADIUS + 1)  # the pixels that a clipped pixel affects through two means
    # guidance: share of the guided filter in the result, 0..1; it falls off smoothly around clipped pixels.
    clipped = cv2.dilate((display.max(-1) > CLIPPING_LEVEL).astype(np.uint8), np.ones(clipped_reach, np.uint8))
    guidance = mean(clipped.astype(np.float32))[..., None]
    mean_display, mean_flare = mean(display), mean(flare)
    covariance = mean(display * flare) - mean_display * mean_flare
    variance = np.maximum(mean(display * display) - mean_display**2, 0)
    gain = np.clip(covariance / (variance + np.float32(EPSILON)), -MAX_GAIN, MAX_GAIN)
    # This mask clears the rounding errors that the means' running sums leave where there is no flare at all.
    near_flare = cv2.dilate((flare > 0).any(-1).astype(np.uint8), np.ones(window, np.uint8))[..., None]
    offset = mean_flare - gain * mean_display
    guidance = guidance * cv2.dilate(near_flare, np.ones(window, np.uint8))[..., None]
    # Windows with an edge count: their fit holds on both of its sides.
    weight = (variance + np.float32(EPSILON)) * near_flare
    mean_weight = mean(variance + np.float32(EPSILON))
    gain, offset = mean(gain * weight) / mean_weight, mean(offset * weight) / mean_weight
    return GuidedFilterMaps(guidance * gain, guidance * offset + (1 - guidance) * flare)


def upsample_flare(maps: GuidedFilterMaps, codes: NDArray[Any], encoding: Encoding,
                   max_code: float) -> Iterator[tuple[slice, Pixels]]:
    """Yield (rows, linear flare there (n, width, 3)), strip by strip, for a plate's codes (height, width, 3).

    max_code: the code of white, if the encoding is "srgb". The flare is 0 or more, and no more than the plate's light.
    """
    height, width = codes.shape[:2]
    map_height, map_width = maps.gain.shape[:2]
    x = ((np.arange(width, dtype=np.float32) + 0.5) * (map_width / width) - 0.5)[None, :]
    for first in range(0, height, STRIP_ROWS):
        rows = slice(first, min(first + STRIP_ROWS, height))
        y = ((np.arange(first, rows.stop, dtype=np.float32) + 0.5) * (map_height / height) - 0.5)[:, None]
        map_top = max(int(y[0, 0]) - 2, 0)  # rows of the maps that the strip needs, with some to spare
        map_bottom = min(int(y[-1, 0]) + 4, map_height)
        map_x, map_y = np.broadcast_to(x, (len(y), width)), np.broadcast_to(y - map_top, (len(y), width))
        gain, offset = (_remap(part[map_top:map_bottom], map_x, map_y) for part in (maps.gain, maps.offset))
        light = to_linear(codes[rows], encoding, max_code)
        display = codes[rows].astype(np.float32) / np.float32(max_code) if encoding == "srgb" else to_display(light)
        flare = gain * display + offset
        yield rows, np.minimum(np.maximum(flare, 0), np.maximum(light, 0))


def _remap(values: Pixels, map_x: Pixels, map_y: Pixels) -> Pixels:
    """Interpolate values (h, w, 3) at map_x, map_y (n, width) bilinearly, REMAP_COLUMNS columns at a time."""
    import cv2

    source = np.ascontiguousarray(values)
    return np.concatenate([
        cv2.remap(source, np.ascontiguousarray(map_x[:, left:left + REMAP_COLUMNS]),
                  np.ascontiguousarray(map_y[:, left:left + REMAP_COLUMNS]), cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REPLICATE) for left in range(0, map_x.shape[1], REMAP_COLUMNS)], 1)
