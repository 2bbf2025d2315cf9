# SPDX-License-Identifier: GPL-3.0-or-later
"""Light sources as over-exposed spots: needs no weights.

A source is far brighter than what it lights. In the picture it is a clipped region that is compact (solid,
not long, small against the frame), white to the core (all channels clip, where a bright coloured surface
clips one), brighter than its surroundings (a clipped patch of sky or wall goes on into pixels nearly as
bright), and alone (the panes of a window come together). Each of these is a soft step; their product is the score.
"""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..images.picture import Picture
from .detection import Detection, measured

THIN = 0.55    # of the thickest part's radius; thinner parts are cut off
SMALLEST = 12  # pixels; below it noise and sparkle
COSTLY = 1e10  # pixels times those of a disc: a quarter of a second
LARGE = 0.025  # of the frame; a clipped region from there on is no lamp


@dataclass(frozen=True)
class Exposure:
    """The detector; `threshold` 0..1 of the score, `clipped` of full scale (HSV value)."""

    threshold: float = 0.7
    clipped: float = 0.98

    def detect(self, picture: Picture) -> list[Detection]:
        """The light sources of a picture, best first."""
        import cv2

        display = picture.display()
        clipped = (display.max(axis=2) >= self.clipped).astype(np.uint8)
        number, labels, boxes, _ = cv2.connectedComponentsWithStats(clipped, connectivity=8)
        crowd = _crowd(clipped)
        found = []
        for label in range(1, number):
            left, top, width, height, area = map(int, boxes[label])
            if area < SMALLEST:
                continue
            whole = labels[top:top + height, left:left + width] == label
            mask = _core(whole, LARGE * clipped.size)
            if mask is None:
                continue
            around = float(crowd[top:top + height, left:left + width][mask].max()) / float(mask.sum()) - 1
            score = (_score(mask, (left, top), display) * _step(_attached(mask, whole), 0.4, 0.1)
                     * _step(around, 5.0, 1.5))
            if score >= self.threshold:
                rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
                tight = mask[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
                corner = (left + int(columns[0]), top + int(rows[0]))
                found.append(measured(tight, corner, picture, display, score))
        return sorted(found, key=lambda detection: -detection.score)


def _crowd(clipped: NDArray[np.uint8]) -> NDArray[np.int64]:
    """For each pixel (h, w), how many clipped pixels its neighbourhood has, regions nearer to each other than 1.5 % of
    the diagonal counted as one: the panes of a window, the words of a sign, the flecks of a bright cloth."""
    import cv2

    reach = max(1, round(0.0075 * math.hypot(*clipped.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    _, groups = cv2.connectedComponents(cv2.dilate(clipped, disc), connectivity=8)
    members: NDArray[np.int64] = np.bincount(np.asarray(groups).ravel(), clipped.ravel()).astype(np.int64)
    return members[groups]


def _core(mask: NDArray[np.bool_], largest: float) -> NDArray[np.bool_] | None:
    """The mask's main body: holes filled, and without what is thinner than half its thickest part, such as spikes of
    a starburst or a bright bracket. Discs, ellipses and bars stay as they are. None where a disc of more than `largest`
    pixels fits in."""
    import cv2

    padded = np.pad(mask, 1).astype(np.uint8)
    outline, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(padded, outline, -1, (1.0,), cv2.FILLED)
    thickest = float(cv2.distanceTransform(padded, cv2.DIST_L2, 5).max())
    if math.pi * thickest ** 2 > largest:
        return None
    reach = int(THIN * thickest)
    if reach >= 1:
        number, labels, boxes, _ = cv2.connectedComponentsWithStats(_opened(padded, reach), connectivity=4)
        if number > 1:
            padded = (labels == 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))).astype(np.uint8)
    return np.asarray(padded[1:-1, 1:-1] > 0)


def _opened(mask: NDArray[np.uint8], reach: int) -> NDArray[np.uint8]:
    """Without what a disc of that radius does not fit in. Where the region is large by distances, which take a few
    steps a pixel and not as many as the disc has pixels, and round the disc's rim a little otherwise."""
    import cv2

    if (2 * reach + 1) ** 2 * mask.size <= COSTLY:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        opened = cv2.morphologyEx(np.pad(mask, reach), cv2.MORPH_OPEN, disc)[reach:-reach, reach:-reach]
        return np.asarray(opened, np.uint8)
    away: Any = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    away = cv2.distanceTransform((away <= reach).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (away <= reach).astype(np.uint8)


def _attached(core: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    """The share of a ring half the core's radius outside it in which the clipped region goes on: high for a patch cut
    out of a surface, low past the short spikes of a star or beside a bracket."""
    import cv2

    radius = float(np.sqrt(core.sum() / np.pi))
    room = 3 + int(radius)
    away: Any = cv2.distanceTransform(1 - np.pad(core, room).astype(np.uint8), cv2.DIST_L2, 5)
    middle = max(1.5, 0.5 * radius)
    ring = (away > middle - 1) & (away <= middle + 1)
    return float(np.pad(whole, room)[ring].mean())


def _step(value: float, low: float, high: float) -> float:
    """0 below `low`, 1 above `high`, smooth between (for low > high: the other way round)."""
    t = min(max((value - low) / (high - low), 0.0), 1.0)
    return t * t * (3 - 2 * t)


def _score(mask: NDArray[np.bool_], corner: tuple[int, int], display: NDArray[np.float32]) -> float:
    import cv2

    height, width = display.shape[:2]
    area = int(mask.sum())
    outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(np.concatenate(outline))
    # A contour runs through pixel centres: half a pixel all round is missing from its area.
    solid = area / (cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + 1.0)
    sides = np.sort(np.asarray(cv2.minAreaRect(hull)[1]) + 1.0)
    here = display[corner[1]:corner[1] + mask.shape[0], corner[0]:corner[0] + mask.shape[1]][mask]
    return (_step(solid, 0.84, 0.95) * _step(sides[1] / sides[0], 9.0, 5.0)
            * _step(area / (width * height), LARGE, 0.005)
            * _step(float(here.min(axis=1).mean()), 0.78, 0.97)
            * _step(_surroundings(mask, corner, display), 0.97, 0.9))


def _surroundings(mask: NDArray[np.bool_], corner: tuple[int, int], display: NDArray[np.float32]) -> float:
    """How bright the picture is a radius away from the mask (HSV value); 1 where nothing is there."""
    import cv2

    height, width = display.shape[:2]
    reach = max(4, round(float(np.sqrt(mask.sum() / np.pi))))
    left, top = max(corner[0] - 2 * reach, 0), max(corner[1] - 2 * reach, 0)
    right = min(corner[0] + mask.shape[1] + 2 * reach, width)
    bottom = min(corner[1] + mask.shape[0] + 2 * reach, height)
    area = np.zeros((bottom - top, right - left), np.uint8)
    area[corner[1] - top:corner[1] - top + mask.shape[0], corner[0] - left:corner[0] - left + mask.shape[1]] = mask
    away: Any = cv2.distanceTransform(1 - area, cv2.DIST_L2, 3)
    ring = (away > reach) & (away <= 1.5 * reach)
    return float(display[top:bottom, left:right][ring].max(axis=1).mean()) if ring.any() else 1.0
