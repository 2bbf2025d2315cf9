# SPDX-License-Identifier: GPL-3.0-or-later
"""Training pairs: a flare laid over a clean picture, as cameras would have filmed it with and without.

Every pair is a function of its random generator, the flares and the backgrounds alone.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ..model.image_formation import GAMMAS, display, under_shoulder
from . import random_cameras
from .backgrounds import Backgrounds

Random = np.random.Generator
SHOT_NOISE, READ_NOISE, GRAIN = 0.002, 1e-5, 0.3
"""Squared deviation of a sensor's noise, in parts of the light and besides; how much of that is usual."""
NEAR = 0.35
"""Halves of the frame's diagonal from a light, within which what saturates is taken for the light."""
CLIPS_FROM, CLIPS_OVER = 0.5, 0.4
"""Light of a glow from which on a camera begins to clip it, and over how much more it comes to do so."""
WHITE: NDArray[np.float32] = np.ones(3, np.float32)
"""The colour of lights that have what colour they have in their layers."""


class Layers(NamedTuple):
    """A flare on the square canvas, as `synthesis.layers.Flare` has it: float32 where it is drawn. colour: (3,), by
    which all of it is still to be multiplied."""

    rest: NDArray[Any]
    glare: NDArray[Any]
    light: NDArray[Any]
    lights: tuple[tuple[float, float], ...]
    colour: NDArray[np.float32] = WHITE

    @property
    def size(self) -> int:
        """Pixels a side of the canvas."""
        return int(self.rest.shape[0])


class Bank(Protocol):
    """Where flares come from."""

    def draw(self, random: Random) -> Layers: ...


@dataclass(frozen=True)
class Pair:
    """Display values 0..1, each (height, width, 3): the frame as filmed, without any flare (`scene`), and
    without flare but with the glow round its lights (`gentle`)."""

    frame: Pixels
    scene: Pixels
    gentle: Pixels


def pair(random: Random, bank: Bank, backgrounds: Backgrounds, width: int, height: int, *,
         clean: float = 0.08, against_light: float = 0.0, shoulder: float = 0.0, faded: float = 0.0) -> Pair:
    """One frame of that size; a share `clean` of all has no flare. In a share `against_light` the lights are where
    the scene is bright, as a sun is in its sky; in the others anywhere. A share `shoulder` are of cameras whose curves
    bend towards white, a share `faded` are graded so that black is grey, or are as logarithmic footage is."""
    gamma = float(random.uniform(*GAMMAS))
    scene: Pixels = backgrounds.draw(random, width, height, gamma) * random_cameras.exposure(random)
    rest, glare, light = (np.zeros_like(scene) for _ in range(3))
    bare = random.random() < clean
    against = against_light > 0 and random.random() < against_light
    for number in range(1 if random.random() < 1 - random_cameras.SECOND else 2):
        layers = bank.draw(random)
        strength = 1.0 if number == 0 else random_cameras.second_strength(random)
        matrix = random_cameras.laid(random, layers.size, width, height)
        if against and layers.lights:
            matrix, bright = _against_light(random, layers, matrix, scene)
            if number == 0 and (aim := random_cameras.aim(random)):
                scene = scene * np.float32(np.clip(aim / max(bright, 1e-3), *random_cameras.AIMED))
        r, g, li = _placed(layers, random_cameras.shining(random, strength), matrix, width, height)
        rest, glare, light = rest + r, glare + g, np.maximum(light, li)
    if bare:
        rest, glare, light = rest * 0, glare * 0, light * float(random.random() < 0.5)
    scene = scene + light
    if graininess := random_cameras.graininess(random):  # the same in both pictures, since removal is no denoising
        grain = np.sqrt(np.maximum(scene, 0) * SHOT_NOISE + READ_NOISE).astype(np.float32) * graininess * GRAIN
        scene = np.maximum(scene + grain * random.standard_normal(scene.shape, np.float32), 0)
    if shoulder > 0 and random.random() < shoulder:
        bend = random_cameras.bend(random)
        formed = [under_shoulder(scene, rest + glare, bend), scene, under_shoulder(scene, glare, bend)]
    else:
        formed = [scene + rest + glare, scene, scene + glare]
    shown = [display(linear, gamma) for linear in formed]
    if random.random() < random_cameras.DEVELOPED:
        shown = _developed(random_cameras.development(random), shown)
    if faded > 0 and random.random() < faded:
        black, white = random_cameras.fade(random)
        shown = [black + (white - black) * picture for picture in shown]
    frame, clear, gentle = shown
    if bare:
        return Pair(frame, clear, gentle)
    return Pair(_stored(random, frame), clear, gentle)


def of_one_channel(one: Pair, channel: int) -> Pair:
    """As a grey picture: a channel of a coloured light is a light, which saturates in all that a grey picture has."""
    return Pair(*(np.repeat(part[..., channel, None], 3, -1) for part in (one.frame, one.scene, one.gentle)))


def _against_light(random: Random, layers: Layers, matrix: NDArray[Any],
                   scene: Pixels) -> tuple[NDArray[Any], float]:
    """Of `matrix` and others the one that has the first light where the scene is brightest, and how bright it is
    there; for a light off the frame at the frame's edge."""
    import cv2

    height, width = scene.shape[:2]
    columns, rows = max(width // 16, 1), max(height // 16, 1)
    brightness = cv2.resize(scene, (columns, rows), interpolation=cv2.INTER_AREA).mean(-1)
    best = -1.0
    others = (random_cameras.laid(random, layers.size, width, height) for _ in range(random_cameras.TRIES - 1))
    for other in [matrix, *others]:
        x, y = _on_frame(other, layers, layers.lights[0])
        there = float(brightness[int(np.clip(y / height * rows, 0, rows - 1)),
                                 int(np.clip(x / width * columns, 0, columns - 1))])
        if there > best:
            matrix, best = other, there
    return matrix, best


def _on_frame(matrix: NDArray[Any], layers: Layers, place: tuple[float, float]) -> NDArray[Any]:
    """(x, y) in pixels of a place on the canvas."""
    return matrix[:, :2] @ ((np.array(place) + 1) * layers.size / 2) + matrix[:, 2]


def _placed(layers: Layers, how: random_cameras.Shining, matrix: NDArray[Any], width: int,
            height: int) -> tuple[Pixels, Pixels, Pixels]:
    """The canvas cut to the frame; then coloured, and what the glow saturates near a light given to the light."""
    import cv2

    half = math.hypot(width, height) / 2
    rest, glare, light = (cv2.warpAffine(layer, matrix, (width, height),
                                         flags=cv2.INTER_LINEAR)
                          for layer in (layers.rest, layers.glare, layers.light))
    if how.blur:
        rest = cv2.GaussianBlur(rest, (0, 0), how.blur)
    mean = float(np.minimum((rest[::4, ::4] + glare[::4, ::4]) * how.gain, 1).mean())
    gain = how.gain * np.float32(min(how.most / max(mean, 1e-6), 1))
    rest, glare = rest * (how.colour * gain), glare * (how.colour * gain)
    near = np.zeros((height, width), np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    for place in layers.lights:
        at = _on_frame(matrix, layers, place)
        near = np.maximum(near, np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / np.float32((NEAR * half) ** 2)))
    red, green, blue = np.moveaxis(rest + glare, -1, 0)
    least = np.minimum(np.minimum(red, green), blue)
    # What a camera clips, and be it in a light's own colour alone, is clipped with flare and without.
    kept = np.clip((least * near - CLIPS_FROM) / CLIPS_OVER, 0, 1)[..., None]
    kept = kept * kept * (3 - 2 * kept)
    kept_light: Pixels = np.maximum(light, (rest + glare) * kept)
    rest, glare, light = (part * layers.colour for part in (rest * (1 - kept), glare * (1 - kept), kept_light))
    return rest, glare, light


def _developed(how: random_cameras.Development, shown: Sequence[Pixels]) -> list[Pixels]:
    """The same for all pictures."""
    contrast, saturation, lift = how
    result = []
    for picture in shown:
        curve = picture + contrast * (picture * picture * (3 - 2 * picture) - picture)
        grey = ((curve[..., 0] + curve[..., 1] + curve[..., 2]) / 3)[..., None]
        result.append(np.clip(lift + (1 - lift) * (grey + saturation * (curve - grey)), 0, 1).astype(np.float32))
    return result


def _stored(random: Random, frame: Pixels) -> Pixels:
    """8 bit, by JPEG in some."""
    import cv2

    codes: NDArray[Any] = (frame * 255 + random_cameras.dither(random)).astype(np.uint8)
    if quality := random_cameras.quality(random):
        _, data = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, quality])
        codes = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return codes.astype(np.float32) / np.float32(255)
