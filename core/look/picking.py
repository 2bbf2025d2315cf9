# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the element of a flare that is brightest at a point of the picture; the add-on picks elements by a click."""
from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Blend
from ..colour.srgb import LUMINANCE
from ..conventions.pixel_grid import PixelGrid
from ..conventions.splatting import ALPHA_MIN, OPACITY_MAX, PROFILE_MIN
from .drawing import profile_exponent
from .edits import LookEdits
from .look import LightLook, Look
from .plane import Floats, PlaneGaussians, arc_log_peak, arc_strengths, arcs_to_pixels, concatenate, to_pixels

MIN_LIGHT = 3e-4
"""Luminance of an element at a point below which nothing is picked there: 1 code of 8 bits."""


def light_at(gaussians: PlaneGaussians, intrinsics: ArrayLike, point: ArrayLike, blend: Blend,
             pixel_grid: PixelGrid | None = None) -> Floats:
    """Return the luminance (n,) that each Gaussian adds at a point (2,) of the picture, px, pixel centres at + 0.5.

    With the blend "over", only what the Gaussians in front of it let through counts. intrinsics (3, 3). pixel_grid:
    that of the fit, which sets the low-pass filter; None for the default filter.
    """
    centres, covariances = to_pixels(gaussians, intrinsics, pixel_grid)
    profiles = _profiles(gaussians, np.asarray(point, np.float64) - centres, covariances,
                         arcs_to_pixels(gaussians, intrinsics))
    luminance = np.maximum(gaussians.colours, 0) @ LUMINANCE.astype(np.float32)
    if blend == "add":
        weights = np.where(profiles >= PROFILE_MIN, profiles, 0) * gaussians.opacities
    else:
        alphas = profiles * np.minimum(gaussians.opacities, OPACITY_MAX)
        alphas = np.where(alphas >= ALPHA_MIN, alphas, 0)
        weights = alphas * np.concatenate([[1.0], np.cumprod(1 - alphas)[:-1]])  # the first lies in front
    return np.asarray(weights * luminance, np.float32)


def _profiles(gaussians: PlaneGaussians, offsets: NDArray[np.float64], covariances: Floats, pixel_arcs: Floats
              ) -> NDArray[np.float64]:
    """Return the profile of each Gaussian (n,) at an offset (n, 2), px, from its centre, 1 at the peak.

    0 for degenerate Gaussians. covariances (n, 3), px². pixel_arcs (n, 2): px, towards the brighter side of a ring."""
    xx, xy, yy = covariances.T.astype(np.float64)
    dx, dy = offsets.T
    rings = None if gaussians.rings is None else gaussians.rings.T.astype(np.float64)
    with np.errstate(all="ignore"):
        log_peaks = None if rings is None else arc_log_peak(arc_strengths(pixel_arcs, covariances), gaussians.rings)
        profiles = np.exp(-profile_exponent(dx, dy, (xx, xy, yy), rings, pixel_arcs.T.astype(np.float64), log_peaks))
        return np.where((xx * yy - xy * xy > 0) & np.isfinite(profiles), profiles, 0)


def brightest_element(look: Look, source_names: Mapping[str, str], flares: Mapping[str, PlaneGaussians],
                      edits: LookEdits, intrinsics: ArrayLike, point: ArrayLike) -> tuple[str, str] | None:
    """Return the names of the placed light and of its element that has most light at a point (2,), px; None where no
    element has MIN_LIGHT.

    source_names: name of the look's light whose flare each placed light shows, by the placed light's name. flares:
    Gaussians of the placed lights by name, as `Look.evaluate_lights` returns them with these edits.
    """
    all_gaussians = concatenate(list(flares.values()))
    if all_gaussians is None:
        return None
    sources = {light.name: light for light in look.lights}
    luminance = light_at(all_gaussians, intrinsics, point, look.blend, look.pixel_grid)
    brightest, max_sum, start = None, MIN_LIGHT, 0
    for name, gaussians in flares.items():
        light_luminance = luminance[start:start + len(gaussians)]
        start += len(gaussians)
        source = sources[source_names[name]]
        indices = _element_indices(source, name, edits, len(gaussians))
        has_element = indices >= 0
        sums = np.bincount(indices[has_element], light_luminance[has_element], len(source.elements))
        if len(sums) and sums.max() >= max_sum:
            brightest, max_sum = (name, source.elements[int(sums.argmax())].name), float(sums.max())
    return brightest


def _element_indices(source: LightLook, name: str, edits: LookEdits, count: int) -> NDArray[np.int64]:
    """Return the index of the element of each of `count` evaluated Gaussians of a placed light; -1 for none.

    Gaussians of hidden elements are not evaluated. A light with an extent has the Gaussians of its cells, one cell
    after the other."""
    hidden = edits.hidden_elements(name, source.elements)
    indices = np.full(source.count, -1, np.int64)
    is_evaluated = np.ones(source.count, bool)
    for index, element in enumerate(source.elements):
        indices[element.members] = index
        is_evaluated[element.members] = element.name not in hidden
    indices = indices[is_evaluated]
    return np.tile(indices, count // len(indices)) if len(indices) else indices
