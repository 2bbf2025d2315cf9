# SPDX-License-Identifier: GPL-3.0-or-later
"""The pairs of an iteration, all at once and where the network learns: what `pairs.pair` makes one by one.

A graphics card learns from ten times the pixels that sixteen cores can compose. So the cores draw scenes and flares,
which cost them most, and each iteration lays other flares over other scenes: of a hundred of each there are ten
thousand pairs.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Self

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from numpy.typing import NDArray
from torch import Tensor

from ...model.recipe import Recipe
from .. import random_cameras
from ..pairs import CLIPS_FROM, CLIPS_OVER, GRAIN, NEAR, READ_NOISE, SHOT_NOISE
from . import jpeg

Random = np.random.Generator
LIGHTS = 3
"""Of a flare, at most."""
BLUR_REACH = 6
"""Pixels to either side, three deviations of the most that a flare is blurred."""


class Flares(NamedTuple):
    """Some flares on their canvas: layers (n, 9, size, size) of `rest`, `glare` and `light`, linear; places of their
    lights (n, LIGHTS, 2), -1..1, and which of these there are (n, LIGHTS); the colour (n, 3) that all is still to be
    multiplied by."""

    layers: Tensor
    lights: Tensor
    there: Tensor
    colour: Tensor

    @property
    def size(self) -> int:
        """Pixels a side of the canvas."""
        return self.layers.shape[-1]


@dataclass(frozen=True)
class _Numbers:
    """What is drawn for each of n frames; n first."""

    def on(self, device: torch.device) -> Self:
        """The same there, sent without waiting for what it is at."""
        return type(self)(**{field.name: _sent(getattr(self, field.name), device) for field in fields(self)})


@dataclass(frozen=True)
class Filming(_Numbers):
    """Of a frame, as `chances` has it: scene and camera. (n, 1, 1, 1) where nothing else is said."""

    exposure: Any      # (n, 3, 1, 1)
    mirrored: Any
    flared: Any        # 0 where the frame has no flare
    lit: Any           # 0 where it has no lights either
    against: Any       # (n,): whether the lights are where the scene is bright
    aim: Any           # (n,): of light there that the scene is brought to; 0 for as it is
    grain: Any
    bend: Any          # of a curve that bends towards white; 0 for none
    contrast: Any
    saturation: Any
    lift: Any
    black: Any         # (n, 3, 1, 1): what it comes to
    white: Any         # (n, 3, 1, 1)
    dither: Any        # of codes, before they are cut to whole ones
    quality: Any       # of JPEG; 0 for none
    channels: Any      # (n, 3, 3): which of its channels each comes to show


@dataclass(frozen=True)
class Laying(_Numbers):
    """Of a flare over a frame, as `chances` has it. (n, 1, 1, 1) where nothing else is said."""

    matrices: Any      # (n, tries, 2, 3) from canvas to frame in pixels
    blur: Any          # (n,) pixels
    colour: Any        # (n, 3, 1, 1)
    gain: Any
    most: Any          # mean light that it has


def filming(random: Random, count: int, recipe: Recipe) -> Filming:
    """Of `count` frames, float32."""
    def some(share: float) -> NDArray[np.bool_]:
        return random.random(count) < share

    def each(draw: Callable[[Random], float]) -> NDArray[Any]:
        return _by_frame(np.array([draw(random) for _ in range(count)]))

    bare, against = some(recipe.clean), some(recipe.against_light)
    developed = np.array([random_cameras.development(random) if does else random_cameras.AS_IT_IS
                          for does in some(random_cameras.DEVELOPED)])
    unchanged = np.zeros(3), np.ones(3)
    faded = np.array([random_cameras.fade(random) if does else unchanged for does in some(recipe.faded)])
    channels = np.tile(np.eye(3), (count, 1, 1))
    grey = np.nonzero(some(recipe.grey))[0]
    channels[grey] = np.eye(3)[random.integers(0, 3, len(grey))][:, None]
    return Filming(
        exposure=np.array([random_cameras.exposure(random) for _ in range(count)])[..., None, None],
        mirrored=_by_frame(some(0.5)), flared=_by_frame(~bare), lit=_by_frame(~bare | some(0.5)),
        against=against, aim=each(random_cameras.aim).ravel() * against, grain=each(random_cameras.graininess),
        bend=_by_frame(some(recipe.shoulder)) * each(random_cameras.bend),
        contrast=_by_frame(developed[:, 0]), saturation=_by_frame(developed[:, 1]), lift=_by_frame(developed[:, 2]),
        black=faded[:, 0, :, None, None], white=faded[:, 1, :, None, None],
        dither=each(random_cameras.dither), quality=each(random_cameras.quality), channels=channels)


def laying(random: Random, count: int, canvas: int, width: int, height: int, *, second: bool = False) -> Laying:
    """Of `count` flares, the first or the second of their frames, float32."""
    shining = [random_cameras.shining(random, random_cameras.second_strength(random) if second else 1.0)
               for _ in range(count)]
    blurs, colours, gains, mosts = (np.array(part) for part in zip(*shining, strict=True))
    matrices = random_cameras.laid(random, canvas, width, height, (count, random_cameras.TRIES))
    return Laying(matrices=matrices, blur=blurs,
                  colour=colours[..., None, None], gain=_by_frame(gains), most=_by_frame(mosts))


def composed(scene: Tensor, gamma: Tensor, filmed: Filming,
             over: Sequence[tuple[Flares, Laying]]) -> tuple[Tensor, Tensor, Tensor]:
    """Display values 0..1, each (n, 3, h, w): frames, the same without any flare, and with the glow round the lights
    alone, as `pairs.Pair` has them.

    scene: linear light (n, 3, h, w), h and w multiples of 16; gamma: (n,) of its display values. over: flares of all
    frames, then flares that lie over the first of them too."""
    scene = torch.where(filmed.mirrored > 0, scene.flip(3), scene).float() * filmed.exposure
    rest, glare, light = (torch.zeros_like(scene) for _ in range(3))
    for number, (flares, how) in enumerate(over):
        some = slice(0, len(flares.layers))
        matrix, bright = _chosen(flares, how.matrices, scene[some], filmed.against[some] > 0)
        if number == 0:
            brought = (filmed.aim / bright.clamp(min=1e-3)).clamp(*random_cameras.AIMED)
            as_it_is = (filmed.aim == 0) | ~flares.there[:, 0]
            scene = scene * brought.masked_fill(as_it_is, 1)[:, None, None, None]
        r, g, li = _placed(flares, how, matrix, *scene.shape[2:])
        rest[some] += r
        glare[some] += g
        light[some] = torch.maximum(light[some], li)
    rest, glare = rest * filmed.flared, glare * filmed.flared
    scene = scene + light * filmed.lit
    grain = (scene.clamp(min=0) * SHOT_NOISE + READ_NOISE).sqrt() * filmed.grain * GRAIN
    scene = (scene + grain * torch.randn_like(scene)).clamp(min=0)
    formed = torch.stack([_formed(scene, rest + glare, filmed.bend), scene, _formed(scene, glare, filmed.bend)])
    shown = _developed(formed.clamp(0, 1).pow(1 / gamma[:, None, None, None]), filmed)
    codes = torch.floor(shown[0] * 255 + filmed.dither)
    compressed = jpeg.stored(codes, filmed.quality.flatten().clamp(min=50))
    kept = torch.where(filmed.quality > 0, compressed, codes) / 255
    frame = torch.where(filmed.flared > 0, kept, shown[0])
    frame, scene, gentle = torch.einsum("nij,knjhw->knihw", filmed.channels, torch.stack([frame, shown[1], shown[2]]))
    return frame, scene, gentle


def _by_frame(values: NDArray[Any]) -> NDArray[Any]:
    return values[:, None, None, None]


def _sent(values: NDArray[Any], device: torch.device) -> Tensor:
    """float32, from memory that the card reads by itself: of other memory it would first end what it is at."""
    here = torch.from_numpy(np.asarray(values, np.float32))
    return here.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else here.to(device)


def _formed(scene: Tensor, flare: Tensor, bend: Tensor) -> Tensor:
    """Linear light of both, under a shoulder (`formation.under_shoulder`) where there is a bend."""
    curved = bend.clamp(min=1e-3)
    through = torch.exp(-curved * flare)
    return torch.where(bend > 0, scene.clamp(0, 1) * through + (1 - through) / curved, scene + flare)


def _developed(shown: Tensor, filmed: Filming) -> Tensor:
    """(k, n, 3, h, w) by a camera's curve and saturation, and faded."""
    curve = shown + filmed.contrast * (shown * shown * (3 - 2 * shown) - shown)
    grey = curve.mean(2, keepdim=True)
    lifted = filmed.lift + (1 - filmed.lift) * (grey + filmed.saturation * (curve - grey))
    return filmed.black + (filmed.white - filmed.black) * lifted.clamp(0, 1)


def _on_frame(matrices: Tensor, places: Tensor, size: int) -> Tensor:
    """(n, k, 2), x and y in pixels, of places on a canvas: (n, 2) by k matrices (n, k, 2, 3), or (n, k, 2) by one
    (n, 1, 2, 3)."""
    at = (places + 1) * (size / 2)
    at = at[:, None] if at.ndim == 2 else at
    return (matrices[..., :2] * at[..., None, :]).sum(-1) + matrices[..., 2]


def _chosen(flares: Flares, matrices: Tensor, scene: Tensor, against: Tensor) -> tuple[Tensor, Tensor]:
    """Of each frame's matrices the first, or where it is `against` the light that which has the first light where the
    scene is brightest; (n, 2, 3), and how bright (n,) it is there."""
    n, _, height, width = scene.shape
    rows, columns = max(height // 16, 1), max(width // 16, 1)
    brightness = F.adaptive_avg_pool2d(scene.mean(1, keepdim=True), (rows, columns)).flatten(1)
    x, y = _on_frame(matrices, flares.lights[:, 0], flares.size).unbind(-1)
    row, column = ((at / side * count).long().clamp(0, count - 1)
                   for at, side, count in ((y, height, rows), (x, width, columns)))
    there = brightness.gather(1, row * columns + column)
    best = torch.where(against & flares.there[:, 0], there.argmax(1), 0)
    frames = torch.arange(n, device=scene.device)
    return matrices[frames, best], there[frames, best]


def _placed(flares: Flares, how: Laying, matrix: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """The canvas cut to the frame; then coloured, and what the glow saturates near a light given to the light:
    `rest`, `glare` and `light`, (n, 3, height, width) each."""
    grid = _canvas_of(matrix, height, width, flares.size)
    layers = F.grid_sample(flares.layers.float(), grid, "bilinear", "zeros", align_corners=True)
    rest, glare, light = layers.split(3, 1)
    rest = _blurred(rest, how.blur)
    mean = ((rest[..., ::4, ::4] + glare[..., ::4, ::4]) * how.gain).clamp(max=1).mean((1, 2, 3), keepdim=True)
    factor = how.colour * how.gain * (how.most / mean.clamp(min=1e-6)).clamp(max=1)
    rest, glare = rest * factor, glare * factor
    at = _on_frame(matrix[:, None], flares.lights, flares.size)
    reach = NEAR * math.hypot(width, height) / 2
    away = (_pixels(height, width, matrix) - at[:, :, None, None]).square().sum(-1)
    near = (torch.exp(-away / reach**2) * flares.there[:, :, None, None]).amax(1, keepdim=True)
    kept = (((rest + glare).amin(1, keepdim=True) * near - CLIPS_FROM) / CLIPS_OVER).clamp(0, 1)
    kept = kept * kept * (3 - 2 * kept)
    tint = flares.colour[:, :, None, None]
    light = torch.maximum(light, (rest + glare) * kept)
    return rest * (1 - kept) * tint, glare * (1 - kept) * tint, light * tint


def _pixels(height: int, width: int, like: Tensor) -> Tensor:
    """(height, width, 2), x and y."""
    y, x = (torch.arange(side, dtype=like.dtype, device=like.device) for side in (height, width))
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def _canvas_of(matrix: Tensor, height: int, width: int, size: int) -> Tensor:
    """Where on the canvas a frame's pixels lie, -1..1 from the middle of its first pixel to that of its last:
    (n, height, width, 2)."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    inverse = torch.stack([d, -b, -c, a], -1).reshape(-1, 2, 2) / (a * d - b * c)[:, None, None]
    from_there = _pixels(height, width, matrix) - matrix[:, None, None, :, 2]
    return torch.einsum("nij,nhwj->nhwi", inverse, from_there) * (2 / (size - 1)) - 1


def _blurred(planes: Tensor, deviation: Tensor) -> Tensor:
    """(n, c, h, w), each by its own deviation in pixels; none where that is 0."""
    n, c, h, w = planes.shape
    taps = torch.arange(-BLUR_REACH, BLUR_REACH + 1, dtype=planes.dtype, device=planes.device)
    kernel = torch.exp(-(taps**2) / (2 * deviation[:, None].clamp(min=1e-2) ** 2))
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(c, 0)
    flat = F.pad(planes, (BLUR_REACH,) * 4, mode="reflect").reshape(1, n * c, h + 2 * BLUR_REACH, w + 2 * BLUR_REACH)
    flat = F.conv2d(F.conv2d(flat, kernel[:, None, :, None], groups=n * c), kernel[:, None, None, :], groups=n * c)
    return flat.reshape(n, c, h, w).clamp(min=0)
