# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes training pairs one by one: a flare laid over a clean picture, as a camera would film it with and without.

A pair is a function of its random generator, the flares and the backgrounds. `gpu.composition` makes the same pairs in
batches.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ..model.image_formation import GAMMA_RANGE, add_under_shoulder, to_display
from . import random_cameras
from .backgrounds import Backgrounds

Random = np.random.Generator
SHOT_NOISE, READ_NOISE, GRAIN = 0.002, 1e-5, 0.3
"""Variance of a sensor's noise relative to the light, and in the dark; factor of the usual noise."""
LIGHT_RADIUS = 0.35
"""Distance from a light, in halves of the frame's diagonal, within which saturated glow counts as the light itself."""
CLIP_START, CLIP_RANGE = 0.5, 0.4
"""Light of a glow from which on a camera begins to clip it, and the range over which it comes to clip completely."""
BRIGHTNESS_CELL = 16
"""About the side in pixels of the cells over which the brightness of a scene is averaged, to place a light in it."""
WHITE: NDArray[np.float32] = np.ones(3, np.float32)
"""The colour of lights whose colour is in their layers."""


class FlareLayers(NamedTuple):
    """A flare on the square canvas.

    rest, glow, light: layers (size, size, 3), linear light, float32 when drawn: what is always removed, the glow round
    the light, and the light itself. lights: positions on the canvas, -1..1. colour: (3,), a factor of all layers that
    is still to be applied.
    """

    rest: NDArray[Any]
    glow: NDArray[Any]
    light: NDArray[Any]
    lights: tuple[tuple[float, float], ...]
    colour: NDArray[np.float32] = WHITE

    @property
    def size(self) -> int:
        """Side of the canvas, pixels."""
        return int(self.rest.shape[0])


class FlareSource(Protocol):
    """What flares are drawn from."""

    def draw(self, random: Random) -> FlareLayers: ...


@dataclass(frozen=True)
class Pair:
    """Display values 0..1, each (height, width, 3): the frame with its flare, the frame without any flare (`scene`),
    and the frame without flare but with the glow of its lights (`scene_with_glow`)."""

    frame: Pixels
    scene: Pixels
    scene_with_glow: Pixels


def make_pair(random: Random, bank: FlareSource, backgrounds: Backgrounds, width: int, height: int, *,
              clean_share: float = 0.08, against_light_share: float = 0.0, shoulder_share: float = 0.0,
              lifted_black_share: float = 0.0) -> Pair:
    """Return one frame of that size with and without flare.

    Each share, 0..1, is the probability of a kind of frame. clean_share: without flare. against_light_share: with the
    lights where the scene is bright, like the sun in its sky, instead of anywhere. shoulder_share: filmed by a camera
    whose curve bends towards white. lifted_black_share: graded so that black is grey and white dimmer, like flat or
    logarithmic footage.
    """
    gamma = float(random.uniform(*GAMMA_RANGE))
    scene: Pixels = backgrounds.draw(random, width, height, gamma) * random_cameras.draw_exposure(random)
    without_flare = random.random() < clean_share
    faces_light = against_light_share > 0 and random.random() < against_light_share
    scene, rest, glow, light = _draw_flares(random, bank, scene, faces_light=faces_light)
    if without_flare:  # half of these frames still show the lights
        rest, glow, light = rest * 0, glow * 0, light * float(random.random() < 0.5)
    scene = scene + light
    scene = _add_grain(random, scene)  # the same in all pictures, since removal does not denoise
    if shoulder_share > 0 and random.random() < shoulder_share:
        shoulder = random_cameras.draw_shoulder(random)
        exposed = [add_under_shoulder(scene, rest + glow, shoulder), scene, add_under_shoulder(scene, glow, shoulder)]
    else:
        exposed = [scene + rest + glow, scene, scene + glow]
    displayed = [to_display(linear, gamma) for linear in exposed]
    if random.random() < random_cameras.DEVELOPED_SHARE:
        displayed = _develop(random_cameras.draw_development(random), displayed)
    if lifted_black_share > 0 and random.random() < lifted_black_share:
        black, white = random_cameras.draw_fade(random)
        displayed = [black + (white - black) * picture for picture in displayed]
    frame, clean_scene, scene_with_glow = displayed
    if without_flare:  # not quantised: frame and scene are equal, so that the flare to predict is exactly 0
        return Pair(frame, clean_scene, scene_with_glow)
    return Pair(_quantise(random, frame), clean_scene, scene_with_glow)


def _draw_flares(random: Random, bank: FlareSource, scene: Pixels, *,
                 faces_light: bool) -> tuple[Pixels, Pixels, Pixels, Pixels]:
    """Return the scene, then rest, glow and light of the one or two flares of a frame, (height, width, 3) each.

    faces_light: put the lights where the scene is bright, and in half of the cases expose the scene for that place.
    """
    height, width = scene.shape[:2]
    rest, glow, light = (np.zeros_like(scene) for _ in range(3))
    for number in range(1 if random.random() < 1 - random_cameras.SECOND_FLARE_SHARE else 2):
        layers = bank.draw(random)
        strength = 1.0 if number == 0 else random_cameras.draw_second_strength(random)
        matrix = random_cameras.draw_placement(random, layers.size, width, height)
        if faces_light and layers.lights:
            matrix, light_level = _place_against_bright_scene(random, layers, matrix, scene)
            if number == 0 and (target_light := random_cameras.draw_target_light(random)):
                exposure = np.clip(target_light / max(light_level, 1e-3), *random_cameras.EXPOSURE_LIMITS)
                scene = scene * np.float32(exposure)
        appearance = random_cameras.draw_appearance(random, strength)
        frame_rest, frame_glow, frame_light = _flare_on_frame(layers, appearance, matrix, width, height)
        rest, glow, light = rest + frame_rest, glow + frame_glow, np.maximum(light, frame_light)
    return scene, rest, glow, light


def _add_grain(random: Random, scene: Pixels) -> Pixels:
    """Return linear light with a sensor's noise, of a random strength; in half of the frames without noise."""
    graininess = random_cameras.draw_grain(random)
    if not graininess:
        return scene
    deviation = np.sqrt(np.maximum(scene, 0) * SHOT_NOISE + READ_NOISE).astype(np.float32) * graininess * GRAIN
    noisy: Pixels = np.maximum(scene + deviation * random.standard_normal(scene.shape, np.float32), 0)
    return noisy


def to_grey(pair: Pair, channel: int) -> Pair:
    """Return the pair as a grey picture of one channel: there a coloured light saturates as a white one does."""
    return Pair(*(np.repeat(picture[..., channel, None], 3, -1)
                  for picture in (pair.frame, pair.scene, pair.scene_with_glow)))


def _place_against_bright_scene(random: Random, layers: FlareLayers, matrix: NDArray[Any],
                                scene: Pixels) -> tuple[NDArray[Any], float]:
    """Choose the placement that puts the flare's first light where the scene is brightest, out of `matrix` and
    PLACEMENTS - 1 random ones.

    Returns its matrix (2, 3), canvas to frame in pixels, and the scene's brightness at the light, linear light. A light
    outside the frame counts as at the nearest edge.
    """
    import cv2

    height, width = scene.shape[:2]
    columns, rows = max(width // BRIGHTNESS_CELL, 1), max(height // BRIGHTNESS_CELL, 1)
    brightness = cv2.resize(scene, (columns, rows), interpolation=cv2.INTER_AREA).mean(-1)
    best_level = -1.0
    other_placements = (random_cameras.draw_placement(random, layers.size, width, height)
                        for _ in range(random_cameras.PLACEMENTS - 1))
    for candidate in [matrix, *other_placements]:
        x, y = _canvas_to_frame(candidate, layers, layers.lights[0])
        light_level = float(brightness[int(np.clip(y / height * rows, 0, rows - 1)),
                                       int(np.clip(x / width * columns, 0, columns - 1))])
        if light_level > best_level:
            matrix, best_level = candidate, light_level
    return matrix, best_level


def _canvas_to_frame(matrix: NDArray[Any], layers: FlareLayers, position: tuple[float, float]) -> NDArray[Any]:
    """Return (x, y) in pixels of the frame of a position on the canvas, -1..1."""
    return matrix[:, :2] @ ((np.array(position) + 1) * layers.size / 2) + matrix[:, 2]


def _flare_on_frame(layers: FlareLayers, appearance: random_cameras.FlareAppearance, matrix: NDArray[Any], width: int,
                    height: int) -> tuple[Pixels, Pixels, Pixels]:
    """Return the flare's layers rest, glow and light on the frame, linear light (height, width, 3) each.

    The canvas is warped by `matrix` (2, 3), canvas to frame in pixels, then blurred, coloured and dimmed as
    `appearance` says. Near a light, flare that is bright enough to clip moves into the layer light.
    """
    import cv2

    rest, glow, light = (cv2.warpAffine(layer, matrix, (width, height), flags=cv2.INTER_LINEAR)
                         for layer in (layers.rest, layers.glow, layers.light))
    if appearance.blur:
        rest = cv2.GaussianBlur(rest, (0, 0), appearance.blur)
    sampled = rest[::4, ::4] + glow[::4, ::4]  # every fourth pixel is enough for a mean
    mean = float(np.minimum(sampled * appearance.gain, 1).mean())
    gain = appearance.gain * np.float32(min(appearance.max_mean / max(mean, 1e-6), 1))
    rest, glow = rest * (appearance.colour * gain), glow * (appearance.colour * gain)
    red, green, blue = np.moveaxis(rest + glow, -1, 0)
    min_channel = np.minimum(np.minimum(red, green), blue)
    light_proximity = _light_proximity(layers, matrix, width, height)
    # Clipped flare joins the light, with flare and without. It is found before the light's colour is applied, so that
    # a coloured light clips as a white one would.
    clipped = np.clip((min_channel * light_proximity - CLIP_START) / CLIP_RANGE, 0, 1)[..., None]
    clipped = clipped * clipped * (3 - 2 * clipped)  # smoothstep
    clipped_light: Pixels = np.maximum(light, (rest + glow) * clipped)
    rest, glow, light = (part * layers.colour for part in (rest * (1 - clipped), glow * (1 - clipped), clipped_light))
    return rest, glow, light


def _light_proximity(layers: FlareLayers, matrix: NDArray[Any], width: int, height: int) -> NDArray[np.float32]:
    """Return (height, width): 1 at the flare's lights on the frame, falling to 0 as a Gaussian of LIGHT_RADIUS half
    diagonals. matrix: (2, 3), from canvas to frame, pixels."""
    squared_radius = np.float32((LIGHT_RADIUS * math.hypot(width, height) / 2) ** 2)
    proximity = np.zeros((height, width), np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    for light_position in layers.lights:
        frame_position = _canvas_to_frame(matrix, layers, light_position)
        squared_distance = (x - frame_position[0]) ** 2 + (y - frame_position[1]) ** 2
        proximity = np.maximum(proximity, np.exp(-squared_distance / squared_radius))
    return proximity


def _develop(development: random_cameras.Development, displayed: Sequence[Pixels]) -> list[Pixels]:
    """Apply a camera's curve, saturation and lift to each picture, (height, width, 3) display values 0..1."""
    contrast, saturation, lift = development
    result = []
    for picture in displayed:
        curve = picture + contrast * (picture * picture * (3 - 2 * picture) - picture)
        grey = ((curve[..., 0] + curve[..., 1] + curve[..., 2]) / 3)[..., None]
        result.append(np.clip(lift + (1 - lift) * (grey + saturation * (curve - grey)), 0, 1).astype(np.float32))
    return result


def _quantise(random: Random, frame: Pixels) -> Pixels:
    """Return the frame, display values (height, width, 3), as it is read from a file of 8 bit codes, in four of ten
    cases from a JPEG."""
    import cv2

    codes: NDArray[Any] = (frame * 255 + random_cameras.draw_dither(random)).astype(np.uint8)
    if quality := random_cameras.draw_jpeg_quality(random):
        _, data = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, quality])
        codes = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return codes.astype(np.float32) / np.float32(255)
