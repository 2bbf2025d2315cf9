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

from ..pictures import Pixels
from .backgrounds import Backgrounds
from .formation import GAMMAS, display, under_shoulder

Random = np.random.Generator
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
    scene = _exposed(random, backgrounds.draw(random, width, height, gamma))
    rest, glare, light = (np.zeros_like(scene) for _ in range(3))
    bare = random.random() < clean
    against = against_light > 0 and random.random() < against_light
    for number in range(1 if random.random() < 0.85 else 2):
        layers = bank.draw(random)
        strength = 1.0 if number == 0 else random.uniform(0.1, 1)
        matrix = _laid(random, layers, width, height)
        if against and layers.lights:
            matrix, bright = _against_light(random, layers, matrix, scene)
            if number == 0 and random.random() < 0.5:
                scene = scene * np.float32(np.clip(random.uniform(0.4, 2) / max(bright, 1e-3), 0.3, 3))
        r, g, li = _placed(random, layers, matrix, width, height, strength)
        rest, glare, light = rest + r, glare + g, np.maximum(light, li)
    if bare:
        rest, glare, light = rest * 0, glare * 0, light * float(random.random() < 0.5)
    scene = scene + light
    if random.random() < 0.5:  # of the sensor; the same in both pictures, since removal is no denoising
        grain = np.sqrt(np.maximum(scene, 0) * 0.002 + 1e-5).astype(np.float32) * random.chisquare(1) * 0.3
        scene = np.maximum(scene + grain * random.standard_normal(scene.shape, np.float32), 0)
    if shoulder > 0 and random.random() < shoulder:
        bend = float(random.uniform(0.3, 1))
        formed = [under_shoulder(scene, rest + glare, bend), scene, under_shoulder(scene, glare, bend)]
    else:
        formed = [scene + rest + glare, scene, scene + glare]
    shown = [display(linear, gamma) for linear in formed]
    if random.random() < 0.35:
        shown = _developed(random, shown)
    if faded > 0 and random.random() < faded:
        black, white = fade(random)
        shown = [black + (white - black) * picture for picture in shown]
    frame, clear, gentle = shown
    if bare:
        return Pair(frame, clear, gentle)
    return Pair(_stored(random, frame), clear, gentle)


def of_one_channel(one: Pair, channel: int) -> Pair:
    """As a grey picture: a channel of a coloured light is a light, which saturates in all that a grey picture has."""
    return Pair(*(np.repeat(part[..., channel, None], 3, -1) for part in (one.frame, one.scene, one.gentle)))


def _exposed(random: Random, scene: Pixels) -> Pixels:
    """Day and night: gain, balance and contrast of the scene alone."""
    gain = random.uniform(0.5, 1.2) if random.random() < 0.65 else math.exp(random.uniform(math.log(0.03), 0))
    balance = np.exp(random.normal(0, 0.06, 3))
    return scene * (gain * balance).astype(np.float32)


def _laid(random: Random, layers: Layers, width: int, height: int) -> NDArray[Any]:
    """(2, 3) from canvas to frame in pixels, at random."""
    return laid(layers.rest.shape[0], width, height, zoom=random.uniform(*ZOOM),
                turn=random.uniform(0, 2 * math.pi), flip=random.choice([-1.0, 1.0]),
                longer=math.exp(random.normal(0, SHEAR)), shear=random.normal(0, SHEAR),
                shift=random.normal(0, OFF_MIDDLE[0] if random.random() < IN_THE_MIDDLE else OFF_MIDDLE[1], 2))


ZOOM = (0.85, 1.5)
"""Of the canvas, from that at which its inner circle goes through the frame's corners."""
SHEAR = 0.05
"""Deviation of a canvas's shear, and of the logarithm by which it is longer one way."""
IN_THE_MIDDLE, OFF_MIDDLE = 0.8, (0.01, 0.25)
"""Share of the canvases that have their middle at the frame's, and how far those and the others have it from there, in
halves of the frame's diagonal."""


def laid(size: int, width: int, height: int, *, zoom: Any, turn: Any, flip: Any, longer: Any, shear: Any,
         shift: Any) -> NDArray[Any]:
    """(..., 2, 3) from a canvas of `size` pixels to a frame in pixels: turned by an angle, scaled, mirrored where
    `flip` is -1 and sheared, its middle `shift` (..., 2) halves of the diagonal off the frame's. All others (...)."""
    half = math.hypot(width, height) / 2
    none, one = np.zeros_like(turn), np.ones_like(turn)
    stretch = _matrix(longer, shear, none, one)
    spin = _matrix(np.cos(turn) * flip, -np.sin(turn), np.sin(turn) * flip, np.cos(turn))
    linear = (half / (size / 2) * np.asarray(zoom))[..., None, None] * spin @ stretch
    offset = np.array([width / 2, height / 2]) + shift * half - linear @ np.array([size / 2, size / 2])
    return np.concatenate([linear, offset[..., None]], -1)


def _matrix(a: Any, b: Any, c: Any, d: Any) -> NDArray[Any]:
    """(..., 2, 2): a and b above c and d."""
    return np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2)


TRIES = 12
"""Ways of laying a flare, of which the one with its light in the brightest place is taken."""


def _against_light(random: Random, layers: Layers, matrix: NDArray[Any],
                   scene: Pixels) -> tuple[NDArray[Any], float]:
    """Of `matrix` and others the one that has the first light where the scene is brightest, and how bright it is
    there; for a light off the frame at the frame's edge."""
    import cv2

    height, width = scene.shape[:2]
    columns, rows = max(width // 16, 1), max(height // 16, 1)
    brightness = cv2.resize(scene, (columns, rows), interpolation=cv2.INTER_AREA).mean(-1)
    best = -1.0
    for other in [matrix, *(_laid(random, layers, width, height) for _ in range(TRIES - 1))]:
        x, y = _on_frame(other, layers, layers.lights[0])
        there = float(brightness[int(np.clip(y / height * rows, 0, rows - 1)),
                                 int(np.clip(x / width * columns, 0, columns - 1))])
        if there > best:
            matrix, best = other, there
    return matrix, best


def _on_frame(matrix: NDArray[Any], layers: Layers, place: tuple[float, float]) -> NDArray[Any]:
    """(x, y) in pixels of a place on the canvas."""
    return matrix[:, :2] @ ((np.array(place) + 1) * layers.rest.shape[0] / 2) + matrix[:, 2]


def _placed(random: Random, layers: Layers, matrix: NDArray[Any], width: int, height: int,
            strength: float) -> tuple[Pixels, Pixels, Pixels]:
    """The canvas cut to the frame; then coloured, and what the glow saturates near a light given to the light."""
    import cv2

    half = math.hypot(width, height) / 2
    rest, glare, light = (cv2.warpAffine(layer, matrix, (width, height),
                                         flags=cv2.INTER_LINEAR)
                          for layer in (layers.rest, layers.glare, layers.light))
    if random.random() < 0.25:
        blur = random.uniform(0.3, 2.0)
        rest = cv2.GaussianBlur(rest, (0, 0), blur)
    colour = np.exp(random.normal(0, 0.12, 3)).astype(np.float32)
    gain = np.float32(math.exp(random.normal(0, 0.6)) * strength)
    # Frames that are washed out altogether teach nothing: the flare's mean light is bounded.
    mean = float(np.minimum((rest[::4, ::4] + glare[::4, ::4]) * gain, 1).mean())
    gain *= np.float32(min(random.uniform(0.02, 0.18) / max(mean, 1e-6), 1))
    rest, glare = rest * (colour * gain), glare * (colour * gain)
    near = np.zeros((height, width), np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    for place in layers.lights:
        at = _on_frame(matrix, layers, place)
        near = np.maximum(near, np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / np.float32((0.35 * half) ** 2)))
    red, green, blue = np.moveaxis(rest + glare, -1, 0)
    least = np.minimum(np.minimum(red, green), blue)
    # What a camera clips, and be it in a light's own colour alone, is clipped with flare and without.
    kept = np.clip((least * near - 0.5) / 0.4, 0, 1)[..., None]
    kept = kept * kept * (3 - 2 * kept)
    kept_light: Pixels = np.maximum(light, (rest + glare) * kept)
    rest, glare, light = (part * layers.colour for part in (rest * (1 - kept), glare * (1 - kept), kept_light))
    return rest, glare, light


def _developed(random: Random, shown: Sequence[Pixels]) -> list[Pixels]:
    """A camera's curve and saturation, the same for all pictures."""
    contrast, saturation = random.uniform(0, 0.7), random.uniform(0.8, 1.3)
    lift = random.uniform(0, 0.04) if random.random() < 0.3 else 0.0
    result = []
    for picture in shown:
        curve = picture + contrast * (picture * picture * (3 - 2 * picture) - picture)
        grey = ((curve[..., 0] + curve[..., 1] + curve[..., 2]) / 3)[..., None]
        result.append(np.clip(lift + (1 - lift) * (grey + saturation * (curve - grey)), 0, 1).astype(np.float32))
    return result


def fade(random: Random) -> tuple[Pixels, Pixels]:
    """Display values (3,) that black and white come to."""
    black = random.uniform(0.02, 0.2) + random.normal(0, 0.015, 3)
    white = random.uniform(0.75, 1) + random.normal(0, 0.01, 3)
    return np.clip(black, 0, 1).astype(np.float32), np.clip(white, 0, 1).astype(np.float32)


def _stored(random: Random, frame: Pixels) -> Pixels:
    """8 bit, by JPEG in four of ten."""
    import cv2

    codes: NDArray[Any] = (frame * 255 + random.uniform(0.3, 0.7)).astype(np.uint8)
    if random.random() < 0.4:
        _, data = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, int(random.integers(60, 99))])
        codes = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return codes.astype(np.float32) / np.float32(255)
