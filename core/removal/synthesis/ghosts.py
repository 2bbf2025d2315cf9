# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws reflective flares: ghosts traced through lens prescriptions, freehand ones, mirrored lights and arcs."""
from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...optics.prescription import (
    CHANNEL_WAVELENGTHS,
    HALF_DIAGONAL,
    GhostPath,
    Prescription,
    reflectance,
    trace_ghost_pairs,
)
from .canvas import GREEN_WAVELENGTH, Array, Point, Random, draw_ghost, log_uniform, random_tint, spectral_colour


@lru_cache(maxsize=2048)
def _ghost_paths(lens: Prescription) -> list[GhostPath]:
    """Return the lens's ghost paths, cached."""
    return trace_ghost_pairs(lens)


def draw_traced(random: Random, lens: Prescription, light: Point, size: int) -> Array:
    """Return the ghosts of one light through a lens: (size, size, 3), the brightest parts around 1.

    light: position on the canvas, where radius 1 is the corner of the sensor.

    The lens determines where ghosts lie, how large they are, how they are clipped and how their colours separate. The
    stop's blades and opening, the coatings' colours, and the number and brightness of weak ghosts are random.
    """
    layer = np.zeros((size, size, 3), np.float32)
    crop = random.uniform(0.6, 1.3)  # the sensor may be smaller or larger than the lens was made for
    focal = lens.focal_length()
    slopes = np.array(light) * HALF_DIAGONAL * crop / focal
    opening = log_uniform(random, 0.12, 1.0)
    stop = lens.semi_aperture[lens.stop] * opening
    entrance = lens.semi_aperture[0]
    blades, rotation = int(random.integers(5, 12)), random.uniform(0, 2 * math.pi)
    roundness = random.choice([0.0, 0.0, 0.3, 1.0]) if opening < 0.9 else 1.0
    coating_wavelengths = _draw_coatings(random, lens)
    softness = log_uniform(random, 0.002, 0.03)
    rim, rim_width = (log_uniform(random, 0.1, 2.0), random.uniform(0.02, 0.12)) if random.random() < 0.6 else (0, 0.1)
    candidates = []  # (greatest channel, light by channel, path)
    for ghost in _ghost_paths(lens):
        weight, radius = _brightness_and_radius(ghost, coating_wavelengths, stop, entrance)
        # Smaller ghosts are points, and larger ones an even veil.
        if 0.004 < radius / (HALF_DIAGONAL * crop) < 6 and np.isfinite(weight).all():
            candidates.append((float(weight.max()), weight, ghost))
    candidates.sort(key=lambda candidate: -candidate[0])
    strongest = candidates[:int(random.integers(4, 45))]
    if not strongest:
        return layer
    # Ghosts differ by orders of magnitude; cameras show the strong ones. The power brings weak ones closer.
    reference, power = np.median([candidate[0] for candidate in strongest[:5]]), random.uniform(0.45, 1.0)
    saturation = random.uniform(0, 0.8) if random.random() < 0.6 else 0.0  # real coatings have many layers
    unit = HALF_DIAGONAL * crop  # of the canvas, mm
    for strength, weight, ghost in strongest:
        images = _project_apertures(ghost, slopes, stop, entrance, unit)
        if np.hypot(*images.centre[1]) - images.radius[1] > 1.5:  # beyond the canvas
            continue
        gain = (strength / reference) ** power / strength
        level = np.minimum(weight * gain, 4.0) * random_tint(random, saturation)
        draw_ghost(layer, _to_float32(images.centre), _to_float32(images.radius), _to_float32(images.clip_centre),
                   _to_float32(images.clip_radius), _to_float32(images.second_centre),
                   _to_float32(images.second_radius), _to_float32(level), blades, rotation, float(roundness),
                   softness * (1 + 0.4 * float(images.radius[1])), rim, rim_width,
                   random.uniform(0, 0.6) if rim else 0.0, random.uniform(-0.4, 0.4))
    return layer


class _ApertureImages(NamedTuple):
    """The images of apertures that bound a ghost on the canvas, by channel: centres (3, 2) and radii (3,), for
    `draw_ghost`.

    centre, radius: image of the stop. clip_centre, clip_radius: image of the entrance. second_centre, second_radius:
    image of the stop at the light's last passage through it.
    """

    centre: NDArray[np.float64]
    radius: NDArray[np.float64]
    clip_centre: NDArray[np.float64]
    clip_radius: NDArray[np.float64]
    second_centre: NDArray[np.float64]
    second_radius: NDArray[np.float64]


def _project_apertures(ghost: GhostPath, slopes: NDArray[np.float64], stop: float, entrance: float,
                       unit: float) -> _ApertureImages:
    """Return the images of a lens's apertures along a ghost path, by paraxial optics.

    slopes: slopes of the light's rays in x and y, (2,). stop, entrance: radii of the stop and of the front surface, mm.
    unit: length of 1 on the canvas, mm.
    """
    # A ray of height h and slope u meets the stop at a h + b u, and the sensor at s h + t u. The one through the
    # stop's centre has h = -b u / a, which gives the ghost's centre; its radius is the stop's times |s / a|.
    a, b = ghost.stop[:, 0], ghost.stop[:, 1]
    s, t = ghost.sensor[:, 0], ghost.sensor[:, 1]
    a = np.where(np.abs(a) < 1e-4, 1e-4, a)
    last_a = np.where(np.abs(ghost.last_stop[:, 0]) < 1e-4, 1e-4, ghost.last_stop[:, 0])
    magnification, last_magnification = s / a, s / last_a  # from the stop to the sensor, and from its last passage
    return _ApertureImages(
        centre=np.outer(t - magnification * b, slopes) / unit,
        radius=np.maximum(np.abs(magnification) * stop / unit, 0.004),
        clip_centre=np.outer(t, slopes) / unit, clip_radius=np.maximum(np.abs(s) * entrance / unit, 1e-3),
        second_centre=np.outer(t - last_magnification * ghost.last_stop[:, 1], slopes) / unit,
        second_radius=np.maximum(np.abs(last_magnification) * stop / unit, 1e-3))


def _draw_coatings(random: Random, lens: Prescription) -> NDArray[np.float64]:
    """Return the wavelength in micrometres that each surface is coated for; 0 for bare glass."""
    count = len(lens.index)
    era = random.random()  # old lenses have no coatings, others one for each surface, or the same for all
    if era < 0.15:
        return np.zeros(count)
    coating_wavelengths = random.uniform(0.42, 0.66, count) if era < 0.7 else np.full(count, random.uniform(0.45, 0.6))
    coating_wavelengths[random.random(count) < random.uniform(0, 0.25)] = 0
    return coating_wavelengths


def _brightness_and_radius(ghost: GhostPath, coating_wavelengths: NDArray[np.float64], stop: float,
                           entrance: float) -> tuple[NDArray[np.float64], float]:
    """Return (light of a ghost by channel (3,), before any exposure; its radius on the sensor, mm).

    The light is what both surfaces reflect, divided by the area over which the sensor gets it. stop, entrance: radii of
    the stop and of the front surface, mm.
    """
    i, j = ghost.surfaces
    wavelengths = np.array(CHANNEL_WAVELENGTHS)
    indices = ghost.contrast  # (3, 4) refractive indices: before and behind surface i, then surface j
    reflected = (reflectance(indices[:, 0], indices[:, 1], wavelengths, float(coating_wavelengths[i]))
                 * reflectance(indices[:, 2], indices[:, 3], wavelengths, float(coating_wavelengths[j])))
    stop_heights = np.maximum(np.abs(ghost.stop[:, 0]), 1e-4)
    # A ghost in focus is as large as the light, not a point.
    sensor_heights = np.maximum(np.abs(ghost.sensor[:, 0]), 0.02)
    beam_radius = min(stop / float(stop_heights[1]), entrance)
    return reflected / sensor_heights**2, float(sensor_heights[1]) * beam_radius


def draw_freehand(random: Random, light: Point, size: int) -> Array:
    """Return ghosts (size, size, 3) as film effects and phones show them: a chain of discs, polygons and rings on the
    line through the light and the middle, with random positions and colours."""
    layer = np.zeros((size, size, 3), np.float32)
    blades, rotation = int(random.integers(5, 10)), random.uniform(0, 2 * math.pi)
    same_shape = random.random() < 0.6  # all of one shape, or each of another
    roundness = random.choice([0.0, 0.5, 1.0])
    base = log_uniform(random, 0.02, 0.25)
    for _ in range(int(random.integers(1, 14))):
        # 0 at the middle, 1 at the light; in three of ten about -1, where the light's mirror image is
        line_position = random.normal(0, 0.8) if random.random() < 0.7 else -1 + random.normal(0, 0.1)
        offset = random.normal(0, 0.01, 2) if random.random() < 0.2 else np.zeros(2)
        spread = random.normal(0, 0.02) if random.random() < 0.4 else 0.0
        channel_positions = line_position * (1 + spread * np.array([-1.0, 0.0, 1.0]))
        centre = np.outer(channel_positions, light) + offset
        radius = base * log_uniform(random, 0.2, 4) * (1 + random.normal(0, 0.03) * np.array([-1, 0, 1]))
        if not same_shape:
            roundness = random.choice([0.0, 0.5, 1.0, 1.0])
        hollow = random.uniform(0, 1) if random.random() < 0.5 else 0.0
        rim = log_uniform(random, 0.1, 3) if random.random() < 0.5 else 0.0
        # A circle beside the ghost cuts some of them, as the rim of another lens does.
        clip_centre = centre + random.normal(0, 0.3, 2) * radius[1] if random.random() < 0.3 else centre
        level = log_uniform(random, 0.03, 1) * random_tint(random, 0.6)
        draw_ghost(layer, _to_float32(centre), _to_float32(np.abs(radius)), _to_float32(clip_centre),
                   _to_float32(np.abs(radius) * 1.02), _to_float32(centre),
                   _to_float32(np.abs(radius) * 1.01), level, blades, rotation, float(roundness),
                   float(radius[1]) * log_uniform(random, 0.02, 0.8), rim, log_uniform(random, 0.03, 0.3), hollow,
                   random.uniform(-0.6, 0.6))
    return layer


def draw_mirrored_light(random: Random, source: Array, light: Point) -> Array:
    """Return images of the light itself, reflected between sensor and lens: mostly rotated by 180 degrees about the
    middle, scaled and coloured, as phones show them at night.

    source: (n, n, 3), the layer of the light. light: its position. Dai et al. 2023, "Nighttime Smartphone Reflective
    Flare Removal Using Optical Center Symmetry Prior", describe the symmetry.
    """
    import cv2

    size = source.shape[0]
    source_image = np.minimum(source, 4.0)  # the ghost is faint, whatever the light's own level
    brightness = source_image.sum(-1)
    source_image = source_image * (brightness > 0.25 * brightness.max())[..., None]
    layer = np.zeros_like(source)
    for _ in range(int(random.integers(1, 4))):
        # On the line through the light (1) and the middle (0).
        line_position = -random.uniform(0.8, 1.2) if random.random() < 0.7 else random.normal(0, 0.9)
        zoom = log_uniform(random, 0.5, 2.0) * (-1 if random.random() < 0.8 else 1)  # below 0: rotated by 180 degrees
        half = size / 2
        centre = (np.array(light) + 1) * half
        target = (np.array(light) * line_position + 1) * half
        matrix = np.array([[zoom, 0, target[0] - zoom * centre[0]], [0, zoom, target[1] - zoom * centre[1]]])
        mirrored = cv2.warpAffine(source_image, matrix, (size, size))
        blur = log_uniform(random, 0.5, 0.015 * size)
        level = log_uniform(random, 0.02, 0.6) * random_tint(random, 0.8)
        layer += cv2.GaussianBlur(mirrored, (0, 0), blur) * level
    return layer


def draw_arc(random: Random, light: Point, size: int, x: Array, y: Array) -> Array:
    """Return a caustic near the frame's edge, linear light (size, size, 3): a rainbow arc about the middle, opposite to
    the light in seven of ten cases, else on the light's side. x, y: `canvas_grid`."""
    light_radius = math.hypot(*light)
    radius, width = random.uniform(0.5, 1.3), log_uniform(random, 0.01, 0.12)
    direction = math.atan2(-light[1], -light[0]) + (math.pi if random.random() < 0.3 else 0)
    angle = np.arctan2(y, x) - direction
    opening_angle = random.uniform(0.1, 0.9) * (1 + light_radius)
    window = np.exp(-(np.arctan2(np.sin(angle), np.cos(angle)) / opening_angle) ** 2 * 2)
    pixel_radius = np.hypot(x, y)
    wavelengths = np.linspace(0.42, 0.68, 9)
    colours = spectral_colour(wavelengths)
    layer = np.zeros((size, size, 3), np.float32)
    spread = random.uniform(-0.6, 0.6)  # of the colours: change of the radius per micrometre from green
    for wavelength, colour in zip(wavelengths, colours / colours.sum(0), strict=True):
        wave_radius = radius * (1 + spread * (wavelength - GREEN_WAVELENGTH))
        layer += np.exp(-((pixel_radius - wave_radius) / width) ** 2)[..., None] * colour.astype(np.float32)
    return layer * window[..., None] * log_uniform(random, 0.1, 1.0)


def choose_lens(random: Random, lenses: Sequence[Prescription]) -> Prescription:
    """Return a random lens."""
    return lenses[int(random.integers(len(lenses)))]


def _to_float32(values: NDArray[np.float64]) -> Array:
    return np.ascontiguousarray(values, np.float32)
