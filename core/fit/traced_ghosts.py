# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures each ghost of a lens, and starts the Gaussians of a fit at the ghosts; called by `traced_flare`.

A fit that starts with Gaussians spread along the line misses small ghosts, because no Gaussian is near enough to learn
them. Each ghost is therefore drawn alone for some places of the light, which gives its place on the line, size,
brightness and colour.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..conventions.splatting import C0
from ..flare.model import LightFlare
from ..optics.flare import Camera, LensSetup, build_optics
from ..optics.ghosts import draw_ghosts

Floats = NDArray[np.float64]

CANVAS_WIDTH, CANVAS_REACH = 192, 3.0
"""Width of the pictures of single ghosts, pixels, and their field relative to the frame's."""
MIN_LIGHT = 1e-9
"""Root mean square of a ghost's light over the frame up to which it counts as absent."""
ENERGY_POWER = 0.35
"""Exponent of `MeasuredGhost.light`; the ghost's share of the Gaussians is proportional to the power."""
MIN_SHARE, MAX_SHARE = 0.008, 0.15
"""Range of a ghost's share of the Gaussians."""
OVERLAP = 0.75
"""Standard deviation of a Gaussian in a ghost, relative to the distance of its neighbours."""
MIN_INNER_SHARE = 0.3
"""Smallest radius of the disc over which the centres of a ghost's Gaussians are spread, relative to the ghost's."""
OPACITIES = 0.002, 0.3
"""Range of the first opacities."""
CODE_SCALE = 0.3
"""Scale of the numbers of the first latent codes."""


@dataclass(frozen=True)
class MeasuredGhost:
    """A ghost, averaged over places of the light.

    place: on the line, 0 at the principal point and 1 at the light. radius: normalised coordinates. level: linear RGB
    inside it. light: its root mean square over the frame.
    """

    place: float
    radius: float
    level: tuple[float, float, float]
    light: float


def measure_ghosts(setup: LensSetup, camera: Camera, lights: Floats, colour: Sequence[float]) -> list[MeasuredGhost]:
    """Return the ghosts of a setup that reach the frame, brightest first.

    Each ghost is drawn alone for each place of the light. Its place, radius and level follow from the centroid,
    variance and brightness of these pictures, averaged with the ghost's light over the frame as the weight. camera:
    that of the traced pictures. lights: (n, 2) places of the light, normalised coordinates. colour: of the light,
    linear RGB.
    """
    optics, pairs = build_optics(setup)
    height = round(CANVAS_WIDTH * camera.height / camera.width)
    scale = CANVAS_WIDTH / CANVAS_REACH / camera.width
    focal, centre = (camera.fx * scale, camera.fy * scale), (CANVAS_WIDTH / 2, height / 2)
    x, y = np.meshgrid((np.arange(CANVAS_WIDTH) + 0.5 - centre[0]) / focal[0],
                       (np.arange(height) + 0.5 - centre[1]) / focal[1])
    is_in_frame = (abs(x) < camera.width / 2 / camera.fx) & (abs(y) < camera.height / 2 / camera.fy)
    drawing = replace(setup.ghosts, bands=min(setup.ghosts.bands, 3), supersample=1)
    ghosts = []
    for pair in pairs:
        measurements, lights_over_frame = [], []
        for light in lights:
            # An anamorphic lens is traced as a spherical one that sees x divided by the squeeze.
            picture = draw_ghosts(optics, [pair], drawing, (light[0] / setup.squeeze, light[1]),
                                  (focal[0] * setup.squeeze, focal[1]), centre, CANVAS_WIDTH, height)
            picture = picture.astype(np.float64) * np.asarray(colour)
            light_over_frame = math.sqrt(float(np.square(picture[is_in_frame]).mean()))
            if light_over_frame <= MIN_LIGHT or picture.sum(-1).sum() <= 0:
                continue
            moments = _measure_moments(picture, x, y)
            measurements.append([moments.centroid @ light, light @ light, moments.variance, *moments.level])
            lights_over_frame.append(light_over_frame)
        if measurements:
            weights = np.array(lights_over_frame)
            along, squared, variance, *level = (weights[:, None] * np.array(measurements)).sum(0) / weights.sum()
            # The place on the line is a least squares fit of centroid = place * light. An even disc of radius r has a
            # variance of r^2 / 4 along each axis; half a pixel of the canvas is its least deviation.
            pixel = 0.5 / focal[0]
            ghosts.append(MeasuredGhost(float(along / max(squared, 1e-12)), 2 * math.sqrt(max(variance, pixel**2)),
                                        (level[0], level[1], level[2]),
                                        float(np.sqrt((weights**2).sum() / len(lights)))))
    return sorted(ghosts, key=lambda ghost: -ghost.light)


class _Moments(NamedTuple):
    """Means over a ghost's picture, weighted by its light: centroid (2,) and variance along an axis, normalised
    coordinates, and level (3,), linear RGB."""

    centroid: Floats
    variance: float
    level: Floats


def _measure_moments(picture: Floats, x: Floats, y: Floats) -> _Moments:
    """Measure a picture (height, width, 3) of a ghost. x, y: (height, width), the pixels' normalised coordinates."""
    total = picture.sum(-1)
    share = total / total.sum()
    centroid = np.array([(share * x).sum(), (share * y).sum()])
    variance = float((share * ((x - centroid[0]) ** 2 + (y - centroid[1]) ** 2)).sum()) / 2
    return _Moments(centroid, variance, (picture * share[..., None]).sum((0, 1)))


def start_at_ghosts(flare: LightFlare, rows: torch.Tensor, ghosts: Sequence[MeasuredGhost],
                    generator: torch.Generator) -> None:
    """Move the Gaussians `rows` (their indices) to the ghosts, in place: evenly over a disc for each ghost.

    Brighter ghosts get more rows, in proportion to light^ENERGY_POWER; rows that remain keep their places. A ghost's
    Gaussians share a latent code, except for its last two numbers, a Gaussian's place in the ghost, so that the network
    can move, stretch and clip a ghost as one.
    """
    if not ghosts or not len(rows):
        return
    shares = np.array([ghost.light for ghost in ghosts]) ** ENERGY_POWER
    shares = np.clip(shares / shares.sum(), MIN_SHARE, MAX_SHARE)
    # Shares that were raised to MIN_SHARE may add up to more than 1.
    counts = np.floor(shares / max(shares.sum(), 1.0) * len(rows)).astype(int)
    parts = torch.split(rows[:int(counts.sum())], counts.tolist())
    table = flare.gaussians
    with torch.no_grad():
        for ghost, part in zip(ghosts, parts, strict=True):
            count = len(part)
            if not count:
                continue
            index = torch.arange(count) + 0.5  # a spiral by the golden angle fills a unit disc evenly
            radius, angle = (index / count).sqrt(), index * (math.pi * (3 - math.sqrt(5)))
            disc_place = radius[:, None] * torch.stack([angle.cos(), angle.sin()], -1)
            size = OVERLAP * ghost.radius * math.sqrt(math.pi / count)
            # The outermost Gaussians reach the ghost's edge.
            inner_radius = max(ghost.radius - size, MIN_INNER_SHARE * ghost.radius)
            level = np.maximum(ghost.level, 1e-6)
            # A disc of level L: opacity x colour x 2 pi size^2 x count = L pi radius^2, with colours about 0.5.
            brightness = float(level.mean()) * ghost.radius**2 / (2 * size**2 * count)
            opacity = min(max(2 * brightness, OPACITIES[0]), OPACITIES[1])
            table["positions"][part] = ghost.place
            table["offsets"][part] = inner_radius * disc_place
            table["log_scales"][part] = math.log(size)
            table["opacity_logits"][part] = math.log(opacity / (1 - opacity))
            table["rings"][part] = 0.0
            table["sh"][part, :3] = torch.tensor((0.5 * level / level.mean() - 0.5) / C0, dtype=torch.float32)
            code = torch.randn(table["latent"].shape[1], generator=generator)
            table["latent"][part] = CODE_SCALE * code
            table["latent"][part, -2:] = CODE_SCALE * disc_place
