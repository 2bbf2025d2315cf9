# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects lights as over-exposed spots; needs no weights.

A light is far brighter than what it lights. In the picture it is a clipped region that is compact (solid, not long,
small against the frame), white at its core (all channels clip, where a bright coloured surface clips one), brighter
than its surroundings (a clipped patch of sky or wall continues into pixels nearly as bright), and isolated (the panes
of a window are close together). Each of these is a smooth step; their product is the score.
"""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..conventions.smoothstep import smoothstep
from ..images.picture import Picture
from .detection import Detection, measure_detection

OPENING_RATIO = 0.55
"""Radius of the opening that removes thin parts, relative to the thickest part's."""
MIN_AREA_PX = 12
"""Smallest region, px; smaller ones are noise and sparkle."""
MAX_MORPHOLOGY_COST = 1e10
"""Largest region times structuring element, px², for morphology: a quarter of a second."""
MAX_AREA_SHARE = 0.025
"""Share of the frame from which a clipped region is no light."""
CORE_SHARE = 0.25
"""Share of a region that is its core, its whitest pixels. The glow about a coloured lamp or a low sun clips too, but in
one channel only."""
GROUP_DISTANCE = 0.015
"""Distance, frame diagonals, below which clipped regions are one group."""
ATTACHED_SHARES, GROUP_EXCESSES = (0.4, 0.1), (5.0, 1.5)
SOLIDITIES, SIDE_RATIOS, AREA_SHARES = (0.84, 0.95), (9.0, 5.0), (MAX_AREA_SHARE, 0.005)
WHITENESSES, SURROUNDING_LEVELS = (0.78, 0.97), (0.97, 0.9)
"""Values of each criterion at which its factor of the score is 0 and 1: see `ExposureDetector.detect`, `shape_score`.
"""


@dataclass(frozen=True)
class ExposureDetector:
    """Detects over-exposed spots. threshold: lowest score, 0..1; clipped: level of clipped pixels (HSV value, 0..1)."""

    threshold: float = 0.7
    clipped: float = 0.98

    def detect(self, picture: Picture) -> list[Detection]:
        """Return the lights of a picture, highest score first.

        Each clipped region is scored by its shape, size, whiteness and surroundings, by how far it continues past its
        main body, and by the size of its group.
        """
        import cv2

        display = picture.display()
        clipped = (display.max(axis=2) >= self.clipped).astype(np.uint8)
        number, labels, boxes, _ = cv2.connectedComponentsWithStats(clipped, connectivity=8)
        group_areas = _group_areas(clipped)
        detections = []
        for label in range(1, number):
            left, top, width, height, area = map(int, boxes[label])
            if area < MIN_AREA_PX:
                continue
            region = labels[top:top + height, left:left + width] == label
            mask = _main_body(region, MAX_AREA_SHARE * clipped.size)
            if mask is None:
                continue
            # The group's clipped pixels outside the mask, relative to those in it.
            group_excess = float(group_areas[top:top + height, left:left + width][mask].max()) / float(mask.sum()) - 1
            score = (shape_score(mask, (left, top), display)
                     * smoothstep(_attached_share(mask, region), *ATTACHED_SHARES)
                     * smoothstep(group_excess, *GROUP_EXCESSES))
            if score >= self.threshold:
                rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
                tight = mask[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
                corner = (left + int(columns[0]), top + int(rows[0]))
                detections.append(measure_detection(tight, corner, picture, display, score))
        return sorted(detections, key=lambda detection: -detection.score)


def _group_areas(clipped: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return (h, w), the number of clipped pixels in each pixel's group.

    Regions nearer to each other than GROUP_DISTANCE form one group: the panes of a window, the letters of a sign, the
    flecks of a bright cloth.
    """
    import cv2

    reach = max(1, round(GROUP_DISTANCE / 2 * math.hypot(*clipped.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    _, groups = cv2.connectedComponents(cv2.dilate(clipped, disc), connectivity=8)
    members: NDArray[np.int64] = np.bincount(np.asarray(groups).ravel(), clipped.ravel()).astype(np.int64)
    return members[groups]


def _main_body(mask: NDArray[np.bool_], max_area: float) -> NDArray[np.bool_] | None:
    """Return a mask (h, w) with holes filled and without thin parts, such as spikes of a starburst or a bright bracket.

    Thin parts are removed by morphological opening; discs, ellipses and bars are unchanged. None where a disc of more
    than `max_area` pixels fits in.
    """
    import cv2

    padded = np.pad(mask, 1).astype(np.uint8)
    outline, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(padded, outline, -1, (1.0,), cv2.FILLED)
    thickest = float(cv2.distanceTransform(padded, cv2.DIST_L2, 5).max())
    if math.pi * thickest ** 2 > max_area:
        return None
    reach = int(OPENING_RATIO * thickest)
    if reach >= 1:
        number, labels, boxes, _ = cv2.connectedComponentsWithStats(open_by_disc(padded, reach), connectivity=4)
        if number > 1:
            padded = (labels == 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))).astype(np.uint8)
    return np.asarray(padded[1:-1, 1:-1] > 0)


def open_by_disc(mask: NDArray[np.uint8], reach: int) -> NDArray[np.uint8]:
    """Remove the parts of a mask (h, w), 0 and 1, that are too narrow for a disc of radius `reach`, pixels.

    Large regions are opened by distance transforms, whose cost does not grow with the disc, slightly rounder at the
    rim.
    """
    import cv2

    if (2 * reach + 1) ** 2 * mask.size <= MAX_MORPHOLOGY_COST:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        opened = cv2.morphologyEx(np.pad(mask, reach), cv2.MORPH_OPEN, disc)[reach:-reach, reach:-reach]
        return np.asarray(opened, np.uint8)
    distance: Any = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = cv2.distanceTransform((distance <= reach).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (distance <= reach).astype(np.uint8)


def _attached_share(core: NDArray[np.bool_], region: NDArray[np.bool_]) -> float:
    """Return the share of a ring around the core, half its radius outside it, that the clipped region covers.

    core, region: masks (h, w) of the region without thin parts and with them. The share is high for a patch cut out of
    a surface, low for a lamp with the short spikes of a star or a bracket.
    """
    import cv2

    radius = float(np.sqrt(core.sum() / np.pi))
    room = 3 + int(radius)
    distance: Any = cv2.distanceTransform(1 - np.pad(core, room).astype(np.uint8), cv2.DIST_L2, 5)
    middle = max(1.5, 0.5 * radius)
    ring = (distance > middle - 1) & (distance <= middle + 1)
    return float(np.pad(region, room)[ring].mean())


def shape_score(mask: NDArray[np.bool_], corner: tuple[int, int], display: NDArray[np.float32],
                area_shares: tuple[float, float] = AREA_SHARES) -> float:
    """Return the score, 0..1, of a mask's shape, size, whiteness and surroundings.

    The score is 1 for a region that is solid (its share of its convex hull), compact (the ratio of its sides), small
    (its share of the frame), white (the mean least channel of its core) and in darker surroundings. mask: (h, w), whose
    top left pixel is `corner` (x, y) of the picture. display: the picture's display values (height, width, 3).
    area_shares: shares of the frame at which the factor for the size is 0 and 1.
    """
    import cv2

    height, width = display.shape[:2]
    area = int(mask.sum())
    outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(np.concatenate(outline))
    # A contour runs through pixel centres: half a pixel all round is missing from its area.
    solid = area / (cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + 1.0)
    sides = np.sort(np.asarray(cv2.minAreaRect(hull)[1]) + 1.0)
    colours = display[corner[1]:corner[1] + mask.shape[0], corner[0]:corner[0] + mask.shape[1]][mask]
    return (smoothstep(solid, *SOLIDITIES) * smoothstep(sides[1] / sides[0], *SIDE_RATIOS)
            * smoothstep(area / (width * height), *area_shares)
            * smoothstep(_core_whiteness(colours), *WHITENESSES)
            * smoothstep(_surrounding_level(mask, corner, display), *SURROUNDING_LEVELS))


def _core_whiteness(colours: NDArray[np.float32]) -> float:
    """Return the mean least channel of the whitest pixels: CORE_SHARE of `colours` (n, 3), at least one pixel."""
    whiteness = np.sort(colours.min(axis=1))
    return float(whiteness[-max(round(CORE_SHARE * len(whiteness)), 1):].mean())


def _surrounding_level(mask: NDArray[np.bool_], corner: tuple[int, int], display: NDArray[np.float32]) -> float:
    """Return the mean HSV value in the ring from 1 to 1.5 radii outside the mask; 1 where the ring is out of frame.

    corner: (x, y) of the mask's top left pixel in the picture. display: its display values (height, width, 3).
    """
    import cv2

    height, width = display.shape[:2]
    reach = max(4, round(float(np.sqrt(mask.sum() / np.pi))))
    left, top = max(corner[0] - 2 * reach, 0), max(corner[1] - 2 * reach, 0)
    right = min(corner[0] + mask.shape[1] + 2 * reach, width)
    bottom = min(corner[1] + mask.shape[0] + 2 * reach, height)
    area = np.zeros((bottom - top, right - left), np.uint8)
    area[corner[1] - top:corner[1] - top + mask.shape[0], corner[0] - left:corner[0] - left + mask.shape[1]] = mask
    distance: Any = cv2.distanceTransform(1 - area, cv2.DIST_L2, 3)
    ring = (distance > reach) & (distance <= 1.5 * reach)
    return float(display[top:bottom, left:right][ring].max(axis=1).mean()) if ring.any() else 1.0
