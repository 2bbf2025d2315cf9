# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds everything in a frame that may be a light: the candidates that `tracks.py` follows from frame to frame.

A source is a clipped spot. Spots that touch, such as distant twin headlights or two bulbs, are separated into their
thick parts. The place of a source is the flux centroid of its thick part, which spikes of the starburst and ghosts
beside it hardly move. Its evidence says how much it looks like a lamp: compact and white as for `exposure.py`, and
soft, because the flare round a lamp fades over many pixels, where a clipped window, shirt or sheet of paper ends at an
edge.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Floats
from ..conventions.smoothstep import smoothstep
from ..images.picture import Picture
from .detection import Detection, Mask, measure_detection
from .exposure import open_by_disc, shape_score

OPENING_RATIO = 0.75
"""Radius of the opening that removes spikes and separates spots, relative to the thickest part's."""
MIN_THICKNESS = 0.55
"""Thickness of a part, relative to the thickest of its spot, from which it is a source of its own."""
MIN_RADIUS = 0.0018
"""Smallest radius of a spot, in frame diagonals; one pixel at least."""
SHOT_AREA_SHARES = 0.05, 0.015
"""Shares of the frame from which a spot is no light, and up to which every one may be: larger than for `exposure.py`,
since the softness tells a low sun with its glow from clipped sky and walls."""
CLIPPED = 0.98
"""Display value from which pixels are clipped, unless the whole shot stays below it."""
HARD, SOFT = 0.04, 0.16
"""Softness of an edge that no lamp has, and from which every lamp may have it."""
NEAR, FAR = (1.5, 3.5), (9.0, 16.0)
"""Rings of the softness: distances from the spot's edge, pixels of a frame with a diagonal of REFERENCE."""
REFERENCE = 550.0
PROFILE_RADII = (1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 10.0, 11.5, 13.5, 16.0, 19.0, 23.0, 28.0, 34.0)
"""Edges of the rings of the brightness, pixels from the centre, as above."""
CLIPPED_RING = 0.85
"""Linear light from which a ring counts as partly clipped."""
MAX_SOURCES = 40
"""Sources of a frame, those that look most like lamps: a street at night has hundreds of lit signs."""
SECTORS = 12
"""Sectors of a ring; the median over them leaves out ghosts, streaks and what stands beside the light."""
SIDE_QUANTILE = 0.35
"""Quantile of the softness over the sectors: a lamp is soft on all sides, unless something hides one of them."""
LONG, COMPACT = 4.5, 2.8
"""Ratio of a spot's sides from which it is no lamp, and up to which it may be one."""


@dataclass(frozen=True, eq=False)
class Source:
    """A candidate for a light in one frame.

    detection: place, radius, colour and mask. evidence: 0..1, how much it looks like a lamp. profile: (rings,) linear
    light in the rings of PROFILE_RADII, NaN where a ring is clipped or out of the frame.
    """

    detection: Detection
    evidence: float
    profile: Floats

    @property
    def xy(self) -> Floats:
        """(2,) pixels."""
        return self.detection.xy


def find_sources(picture: Picture, clipped_from: float = CLIPPED) -> list[Source]:
    """Return at most MAX_SOURCES sources of a frame, the largest evidence first.

    clipped_from: display value from which pixels are clipped.
    """
    import cv2

    display, linear = picture.display(), picture.linear()
    value = np.asarray(display.max(axis=2))
    luminance = np.minimum(linear, 1.0).mean(axis=2)
    diagonal = float(np.hypot(*picture.size))
    clipped = (value >= clipped_from).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(clipped, connectivity=8)
    min_area = max(3.0, np.pi * (MIN_RADIUS * diagonal) ** 2)
    # Scores expect clipped pixels near 1, so a shot that never reaches white is scaled.
    scaled = display if clipped_from >= CLIPPED else np.minimum(display / np.float32(clipped_from), 1)
    sources = []
    for label in range(1, count):
        left, top, width, height, area = map(int, boxes[label])
        if area < min_area:
            continue
        region = labels[top:top + height, left:left + width] == label
        for mask, corner in _thick_parts(region, SHOT_AREA_SHARES[0] * clipped.size):
            corner = (left + corner[0], top + corner[1])
            shape = shape_score(mask, corner, scaled, SHOT_AREA_SHARES)
            soft = smoothstep(_softness(mask, corner, luminance, diagonal / REFERENCE), HARD, SOFT)
            detection = measure_detection(mask, corner, picture, scaled, shape)
            if picture.encoding == "linear":
                detection = _with_flux_centroid(detection, linear)
            sources.append(Source(detection, shape * soft * _roundness(mask), measure_profile(luminance, detection.xy)))
    return sorted(sources, key=lambda source: (-source.evidence, -source.detection.radius))[:MAX_SOURCES]


def _thick_parts(region: Mask, max_area: float) -> Iterator[tuple[Mask, tuple[int, int]]]:
    """Yield the thick parts of a spot, without spikes: each as the mask within its box, and the box's corner (x, y).

    Parts are separated by morphological opening. region: mask (h, w) of the spot. Nothing is yielded if a disc of more
    than `max_area` px² fits in.
    """
    import cv2

    padded = np.pad(region, 1).astype(np.uint8)
    outline, _ = cv2.findContours(padded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(padded, outline, -1, (1.0,), cv2.FILLED)
    thickness = np.asarray(cv2.distanceTransform(padded, cv2.DIST_L2, 5))
    thickest = float(thickness.max())
    if np.pi * thickest ** 2 > max_area:
        return
    # Opening by a small disc separates the parts; then a larger disc, by each part's thickness, removes its spikes.
    count, labels = cv2.connectedComponents(_open(padded, MIN_THICKNESS * thickest), connectivity=4)
    if count <= 2:  # one part: label 0 is the background
        yield _largest_part(_open(padded, OPENING_RATIO * thickest))
        return
    for label in range(1, count):
        part = (np.asarray(labels) == label).astype(np.uint8)
        opened = _open(part, OPENING_RATIO * float(cv2.distanceTransform(part, cv2.DIST_L2, 5).max()))
        if opened.any():
            yield _largest_part(opened)


def _open(mask: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """Remove the parts of a mask that are too narrow for a disc of this radius, pixels, rounded down."""
    reach = int(radius)
    return open_by_disc(mask, reach) if reach >= 1 else mask


def _largest_part(mask: NDArray[np.uint8]) -> tuple[Mask, tuple[int, int]]:
    """Return the largest connected part of a mask, within its bounding box, and the box's corner (x, y).

    mask: with a pixel of padding on each side, which the corner does not count.
    """
    import cv2

    count, labels, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    label = 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA])) if count > 1 else 0
    left, top, width, height = map(int, boxes[label][:4])
    return np.asarray(labels[top:top + height, left:left + width] == label), (left - 1, top - 1)


def _with_flux_centroid(detection: Detection, linear: NDArray[np.float32]) -> Detection:
    """Return a detection at the flux centroid of its pixels above half its peak.

    linear: the frame, (height, width, 3). A detection whose peak is at most twice white is returned unchanged.
    """
    from dataclasses import replace

    left, top, right, bottom = detection.box
    light = linear[top:bottom, left:right].mean(axis=2) * detection.mask
    peak = float(light.max())
    if peak <= 2.0:
        return detection
    weight = np.maximum(light - 0.5 * peak, 0)
    v, u = np.mgrid[top:bottom, left:right] + 0.5
    return replace(detection, xy=np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum())


def _softness(mask: Mask, corner: tuple[int, int], luminance: NDArray[np.float32], scale: float) -> float:
    """Return how softly a spot ends: the light in the ring NEAR outside its edge minus that in the ring FAR.

    This difference is divided by that of the spot itself, whose light is 1, from the ring FAR: 1 for a glow as bright
    as the spot, about 0 for a hard edge. It is measured in each sector, and the quantile SIDE_QUANTILE over the sectors
    is returned; 0 if none can be measured. mask: the spot within its box. corner: (x, y) of the box in the frame.
    luminance: (height, width), clipped at 1. scale: the frame's diagonal over REFERENCE.
    """
    import cv2

    height, width = luminance.shape
    margin = int(np.ceil(FAR[1] * scale)) + 1
    left, top = max(corner[0] - margin, 0), max(corner[1] - margin, 0)
    right, bottom = min(corner[0] + mask.shape[1] + margin, width), min(corner[1] + mask.shape[0] + margin, height)
    area = np.ones((bottom - top, right - left), np.uint8)
    y, x = corner[1] - top, corner[0] - left
    area[y:y + mask.shape[0], x:x + mask.shape[1]][mask] = 0
    distance = np.asarray(cv2.distanceTransform(area, cv2.DIST_L2, 5))
    surroundings = luminance[top:bottom, left:right]
    v, u = np.mgrid[:bottom - top, :right - left]
    sector = _sectors(u - x - 0.5 * mask.shape[1], v - y - 0.5 * mask.shape[0])
    values = []
    for number in range(SECTORS):
        near, far = (surroundings[(distance > low * scale) & (distance <= high * scale) & (sector == number)]
                     for low, high in (NEAR, FAR))
        if len(near) and len(far):
            outside = float(np.median(far))
            values.append((float(np.median(near)) - outside) / max(1 - outside, 1e-3))
    return float(np.quantile(values, SIDE_QUANTILE)) if values else 0.0


def _sectors(u: Floats, v: Floats) -> NDArray[np.int64]:
    """Return the sector, 0 to SECTORS - 1, of offsets (u, v) from a centre."""
    return np.asarray((np.arctan2(v, u) / (2 * np.pi) % 1.0) * SECTORS, np.int64) % SECTORS


def _roundness(mask: Mask) -> float:
    """Return 1 for compact masks, 0 for long ones, such as the lit edge of a shirt."""
    import cv2

    outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    sides = np.sort(np.asarray(cv2.minAreaRect(np.concatenate(outline))[1]) + 1.0)
    return smoothstep(float(sides[1] / sides[0]), LONG, COMPACT)


def measure_profile(luminance: NDArray[np.float32], xy: Floats) -> Floats:
    """Return linear light in the rings of PROFILE_RADII round a place: the median over the sectors of each ring.

    luminance: (height, width), clipped at 1. NaN for a ring that is clipped, or mostly out of the frame.
    """
    height, width = luminance.shape
    radii = np.array(PROFILE_RADII) * float(np.hypot(height, width)) / REFERENCE
    reach = int(np.ceil(radii[-1]))
    left, right = max(int(xy[0]) - reach, 0), min(int(xy[0]) + reach + 1, width)
    top, bottom = max(int(xy[1]) - reach, 0), min(int(xy[1]) + reach + 1, height)
    profile = np.full(len(radii) - 1, np.nan)
    if right <= left or bottom <= top:
        return profile
    v, u = np.mgrid[top:bottom, left:right] + 0.5
    u, v = u - xy[0], v - xy[1]
    ring = np.digitize(np.hypot(u, v), radii) - 1
    sector = _sectors(u, v)
    inside = (ring >= 0) & (ring < len(profile))
    index = (ring * SECTORS + sector)[inside]
    pixels = luminance[top:bottom, left:right][inside]
    count = np.bincount(index, minlength=len(profile) * SECTORS).reshape(len(profile), SECTORS)
    total = np.bincount(index, pixels, minlength=len(profile) * SECTORS).reshape(len(profile), SECTORS)
    for number in range(len(profile)):
        covered = count[number] > 0
        if covered.sum() >= SECTORS // 2:
            profile[number] = float(np.median(total[number][covered] / count[number][covered]))
    # The ring beyond the clipped ones holds the disc's own edge, whose size says nothing about the glow.
    clipped = np.flatnonzero(profile >= CLIPPED_RING)
    profile[:clipped[-1] + 2 if len(clipped) else 0] = np.nan
    return profile
