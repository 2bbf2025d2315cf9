# SPDX-License-Identifier: GPL-3.0-or-later
"""The detection of a light in one picture, whatever the detector."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..images.picture import Picture

Mask = NDArray[np.bool_]
RIM = 0.3, 0.8
"""Distances from the edge of a light, radii, between which its surround is measured."""
SURROUND_QUANTILE = 0.2
"""Quantile of the surround over its pixels: a lamp lights up or outshines all sides, a window ends at a dark frame."""


@dataclass(frozen=True, eq=False)
class Detection:
    """A light in one picture.

    xy: (2,) sub-pixel centroid in pixels, pixel centres at +0.5.
    radius: of the disc of the same area, in pixels.
    score: confidence of the detector, 0..1.
    colour: (3,) linear Rec. 709 of the glow round the clipped core, its largest channel 1.
    mask: (h, w) of the light within its box; corner: (x, y) of the box in the picture.
    is_cut: True if it touches the frame's edge, so that its centroid is not the light's.
    surround: linear light, 0..1, on the darker sides of the light (quantile SURROUND_QUANTILE within RIM).
    """

    xy: NDArray[np.float64]
    radius: float
    score: float
    colour: NDArray[np.float64]
    mask: Mask
    corner: tuple[int, int]
    is_cut: bool
    surround: float = 0.0

    @property
    def box(self) -> tuple[int, int, int, int]:
        """(left, top, right, bottom) in pixels, right and bottom exclusive."""
        height, width = self.mask.shape
        return self.corner[0], self.corner[1], self.corner[0] + width, self.corner[1] + height


class Detector(Protocol):
    """Detects lights in a picture."""

    def detect(self, picture: Picture) -> list[Detection]:
        """Return the lights, highest score first."""
        ...


def union_mask(detections: Sequence[Detection], size: tuple[int, int]) -> Mask:
    """Return (h, w), the union of all masks in a picture of `size` (width, height)."""
    union = np.zeros((size[1], size[0]), np.bool_)
    for detection in detections:
        left, top, right, bottom = detection.box
        union[top:bottom, left:right] |= detection.mask
    return union


def measure_detection(mask: Mask, corner: tuple[int, int], picture: Picture, display: NDArray[np.float32],
                      score: float) -> Detection:
    """Measure a detection from its mask (h, w), whose top left pixel is `corner` (x, y) of the picture.

    display: the picture's display values (height, width, 3). The centroid weighs pixels from 0.8 of full scale up, also
    one pixel outside the mask: partly covered pixels of the rim then locate the edge between two pixels.
    """
    import cv2

    height, width = display.shape[:2]
    left, top = corner[0] - 1, corner[1] - 1
    grown = cv2.dilate(np.pad(mask, 1).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rows = slice(max(top, 0), min(top + grown.shape[0], height))
    columns = slice(max(left, 0), min(left + grown.shape[1], width))
    grown = grown[rows.start - top:rows.stop - top, columns.start - left:columns.stop - left]
    value = display[rows, columns].max(axis=2)
    # Weights are above 0, so that a mask without bright pixels has a centroid too.
    weight = np.where(grown, np.clip((value - 0.8) / 0.2, 1e-3, 1.0), 0.0)
    v, u = np.mgrid[rows, columns] + 0.5
    xy = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    bottom, right = corner[1] + mask.shape[0], corner[0] + mask.shape[1]
    is_cut = bool((corner[0] == 0 and mask[:, 0].any()) or (corner[1] == 0 and mask[0].any())
                  or (right == width and mask[:, -1].any()) or (bottom == height and mask[-1].any()))
    radius = float(np.sqrt(mask.sum() / np.pi))
    colour, surround = _measure_around(mask, corner, picture)
    return Detection(xy, radius, score, colour, mask, corner, is_cut, surround)


def _measure_around(mask: Mask, corner: tuple[int, int], picture: Picture) -> tuple[NDArray[np.float64], float]:
    """Return the colour of the glow and the surround of a light.

    The colour is the light within half a radius of the disc minus that two to three radii away: (3,) linear, the
    largest channel 1; white where no glow can be measured. At most half of the near light is subtracted, so that some
    glow is left beside a bright surface. The surround is as in `Detection`. mask: (h, w), the disc, whose top left
    pixel is `corner` (x, y) of the picture.
    """
    import cv2

    reach = max(3, round(float(np.sqrt(mask.sum() / np.pi))))
    height, width = picture.pixels.shape[:2]
    left, top = max(corner[0] - 3 * reach, 0), max(corner[1] - 3 * reach, 0)
    right, bottom = (min(corner[0] + mask.shape[1] + 3 * reach, width),
                     min(corner[1] + mask.shape[0] + 3 * reach, height))
    area = np.zeros((bottom - top, right - left), np.uint8)
    y, x = corner[1] - top, corner[0] - left
    area[y:y + mask.shape[0], x:x + mask.shape[1]] = mask
    distance = cv2.distanceTransform(1 - area, cv2.DIST_L2, 3)
    around = Picture(picture.pixels[top:bottom, left:right], picture.encoding).linear()
    near = (distance > 1) & (distance <= 1 + 0.5 * reach)
    far = (distance > 2 * reach) & (distance <= 3 * reach)
    rim = (distance > RIM[0] * reach) & (distance <= RIM[1] * reach)
    surround = float(np.quantile(around[rim].mean(axis=1).clip(0, 1), SURROUND_QUANTILE)) if rim.any() else 0.0
    if not near.any():
        return np.ones(3), surround
    glow = around[near].mean(axis=0).astype(np.float64)
    if far.any():
        glow = glow - np.minimum(np.median(around[far], axis=0), 0.5 * glow)
    return glow / glow.max() if glow.max() > 1e-4 else np.ones(3), surround
