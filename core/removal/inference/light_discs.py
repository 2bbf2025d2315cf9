# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps the light discs of a scene, and part of the glow about them at night, when a flare is removed.

A light disc clips, and so does the glow in front of it, so the frame does not show how much of the clipped light is
glow. A network that removes part of it turns lights grey; in photographs of streets at night, most of the fainter
lights. So a small clipped region that still has contrast to its surroundings when the flare is removed counts as a
light disc. It keeps the more of its predicted flare the brighter a pixel stays: all in its centre, little at its rim. A
bright wall under a veil has little contrast, and a ghost disappears with the flare. Some light discs have no contrast
left; but a glow about a white region comes from a light in its centre.

At night a light has some glow with every lens, and the flare adds to that glow. One frame does not separate the two,
and the network, whose training flares lie over lights without glow, removes both. So in dark scenes a part of the glow
is kept near a light disc. Streaks, starbursts and ghosts are removed entirely, and so is all glow in bright scenes,
where lights stand out less.

`remover.Remover.linear_flare` calls `retained_fraction`.
"""
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels

MIN_DISC_BRIGHTNESS = 0.9
"""Smallest brightness (mean of the three display values) of a pixel of a light disc."""
RIM_RAMP = (0.8, 0.95)
"""Brightness of a pixel as filmed at which none and all of the flare that belongs to its light disc is kept."""
DISC_AREA_RAMP = (0.01, 0.02)
"""Area of a bright region, share of the frame, up to which it may be a light disc, and from which on it is none."""
MIN_DISC_PIXELS = 3
"""Smallest number of pixels of a light disc, at the working size."""
CONTRAST_RAMP = (0.15, 0.3)
"""Contrast of a region to its surroundings, display values without the flare, at which its certainty of being a light
disc is 0 and 1."""
RIM_SIZE, SURROUND_SIZE = 3, 7
"""Sides of the squares that dilate a region by its rim, and by its surroundings, pixels."""
BRIGHTNESS_EXPONENT = 4
"""The share of the flare that a pixel keeps is its brightness, relative to the brightest pixel of its light disc, to
this power."""
SURROUND_GLOW_RAMP = (0.5, 0.8)
"""Fraction of glow in the flare about a region at which the certainty of a light disc in the region's centre is 0 and
1. The centre is the pixels at least half as far from the region's edge as its innermost pixel."""
OBSERVED_CONTRAST_RAMP = (0.05, 0.15)
"""Contrast of such a region to its surroundings, display values as filmed, at which that certainty is 0 and 1."""
MAX_GLOW_KEPT, GLOW_FALLOFF = 0.5, 0.05
"""Fraction of the glow that is kept at a light disc, and the distance, relative to the frame's long side, over which
that fraction falls to 1 / e."""
DARK_SCENE_RAMP = (0.2, 0.3)
"""Median brightness of the frame without the flare at which all and none of MAX_GLOW_KEPT is kept."""
DISC_PEAK_RAMP = (0.9, 0.97)
"""Brightness of the brightest pixel of a light disc at which none and all of MAX_GLOW_KEPT is kept."""
DISTANCE_LEVELS = 4
"""Number of steps in which a region's certainty of being a light disc weights the glow about it."""


class _LightDiscs(NamedTuple):
    """Bright regions that may be light discs.

    labels: (h, w), 0 outside. The others have one value per label, (count,). contrast_certainty, glow_certainty:
    certainty that the region is a light disc, 0..1, by its contrast and by the glow about it. peak_observed,
    peak_clean: greatest brightness of the region, as filmed and without the flare.
    """

    labels: NDArray[np.int32]
    contrast_certainty: NDArray[Any]
    glow_certainty: NDArray[Any]
    peak_observed: NDArray[Any]
    peak_clean: NDArray[Any]


def retained_fraction(display: Pixels, flare: Pixels, glow_fraction: Pixels, *, keep_glow: bool = True) -> Pixels:
    """Return the fraction of a predicted flare that stays in the frame, 0..1, (h, w, 3).

    display: display values 0..1. flare: what the flare adds to them. glow_fraction: share of the flare that is glow
    about lights, 0..1. All (h, w, 3). keep_glow: keep part of the glow about light discs, not the discs alone.
    """
    observed, clean = display.mean(-1), np.maximum(display - flare, 0).mean(-1)
    discs = _find_light_discs(observed, clean, flare.mean(-1), (flare * glow_fraction).mean(-1))
    retained_glow = (_retained_glow_fraction(discs, clean)[..., None] * glow_fraction if keep_glow
                     else np.zeros_like(glow_fraction))
    return np.asarray(np.maximum(_retained_on_discs(discs, observed, clean)[..., None], retained_glow), np.float32)


def _retained_on_discs(discs: _LightDiscs, observed: Pixels, clean: Pixels) -> NDArray[Any]:
    """Return the fraction of the flare that is kept on the light discs themselves and their rims, 0..1, (h, w).

    observed, clean: brightness (h, w) as filmed and without the flare.
    """
    with_rim = _dilate_labels(discs.labels, RIM_SIZE)
    retained_by_contrast = (discs.contrast_certainty[with_rim]
                            * np.clip(clean / discs.peak_clean[with_rim], 0, 1) ** BRIGHTNESS_EXPONENT)
    retained_by_glow = discs.glow_certainty[discs.labels] * _centre_weight(discs.labels)
    return np.asarray(np.interp(observed, RIM_RAMP, (0, 1)) * np.maximum(retained_by_contrast, retained_by_glow))


def _retained_glow_fraction(discs: _LightDiscs, clean: Pixels) -> NDArray[Any]:
    """Return the fraction of the glow that is kept, (h, w): greatest at the light discs, falling off with distance.

    clean: brightness (h, w) without the flare.
    """
    import cv2

    certainty = np.maximum(discs.contrast_certainty, discs.glow_certainty)
    certainty = (certainty * np.interp(discs.peak_observed, DISC_PEAK_RAMP, (0, 1)))[discs.labels]
    falloff = np.float32(GLOW_FALLOFF * max(certainty.shape))
    proximity = np.zeros(certainty.shape, np.float32)
    # For each of DISTANCE_LEVELS certainties: the falloff with the distance to the nearest disc of greater certainty.
    # The mean over the levels weights the glow about each disc by its certainty.
    for level in range(DISTANCE_LEVELS):
        outside = (certainty <= (level + 0.5) / DISTANCE_LEVELS).astype(np.uint8)
        if not outside.all():
            distance = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_5)
            proximity += np.exp(-distance / falloff) / DISTANCE_LEVELS
    return np.asarray(MAX_GLOW_KEPT * np.interp(np.median(clean), DARK_SCENE_RAMP, (1, 0)) * proximity)


def _find_light_discs(observed: Pixels, clean: Pixels, flare: Pixels, glow: Pixels) -> _LightDiscs:
    """Find the bright regions (connected components) that may be light discs.

    observed, clean: brightness as filmed and without the flare. flare, glow: brightness of the flare and of its glow.
    All (h, w).
    """
    import cv2

    count, components = cv2.connectedComponents((observed > MIN_DISC_BRIGHTNESS).astype(np.uint8))
    labels = np.asarray(components, np.int32)
    surround = np.where(_dilate_labels(labels, RIM_SIZE) > 0, 0, _dilate_labels(labels, SURROUND_SIZE))
    # core: the label of each pixel in the brighter part of its region; the darker ones are partly surroundings.
    core = np.where(observed >= _label_means(observed, labels, count)[labels], labels, 0)
    contrast, observed_contrast = (_label_means(brightness, core, count) - _label_means(brightness, surround, count)
                                   for brightness in (clean, observed))
    glow_fraction = _label_means(glow, surround, count) / np.maximum(_label_means(flare, surround, count), 1e-6)
    pixels = np.bincount(labels.ravel(), minlength=count)
    area_weight = np.interp(pixels / observed.size, DISC_AREA_RAMP, (1, 0))
    area_weight[pixels < MIN_DISC_PIXELS] = 0
    area_weight[0] = 0  # label 0 is outside all regions
    return _LightDiscs(
        labels=labels,
        contrast_certainty=area_weight * np.interp(contrast, CONTRAST_RAMP, (0, 1)),
        glow_certainty=(area_weight * np.interp(glow_fraction, SURROUND_GLOW_RAMP, (0, 1))
                        * np.interp(observed_contrast, OBSERVED_CONTRAST_RAMP, (0, 1))),
        peak_observed=_label_maxima(observed, core, count), peak_clean=_label_maxima(clean, core, count))


def _centre_weight(labels: NDArray[np.int32]) -> Pixels:
    """Return how central each pixel is in its region, (h, w): 0 at the edge, 1 from half of the greatest distance to
    the edge on."""
    import cv2

    depth = cv2.distanceTransform((labels > 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    greatest = _label_maxima(np.asarray(depth), labels, int(labels.max()) + 1)
    return np.asarray(np.clip(depth / greatest[labels] * 2, 0, 1), np.float32)


def _dilate_labels(labels: NDArray[np.int32], side: int) -> NDArray[np.int32]:
    """Dilate labelled regions (h, w) by a square; where two meet, the greater label counts."""
    import cv2

    return np.asarray(cv2.dilate(labels.astype(np.float32), np.ones((side, side), np.uint8)), np.int32)


def _label_maxima(values: Pixels, labels: NDArray[np.int32], count: int) -> NDArray[Any]:
    """Return the maximum over each label, (count,); 1e-6 for one without pixels."""
    maxima = np.full(count, 1e-6)
    np.maximum.at(maxima, labels, values)
    return maxima


def _label_means(values: Pixels, labels: NDArray[np.int32], count: int) -> NDArray[Any]:
    """Return the mean over each label, (count,); 0 for one without pixels."""
    totals = np.bincount(labels.ravel(), values.ravel(), minlength=count)
    return totals / np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
