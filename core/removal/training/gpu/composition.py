# SPDX-License-Identifier: GPL-3.0-or-later
"""Composes the pairs of an iteration in one batch on the GPU, as `pairs.make_pair` makes them one by one.

A GPU learns from ten times the pixels that sixteen CPU cores can compose. So the cores draw scenes and flares, which
cost most, and each iteration lays other flares over other scenes: a hundred of each give ten thousand pairs.
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
from ..pairs import BRIGHTNESS_CELL, CLIP_RANGE, CLIP_START, GRAIN, LIGHT_RADIUS, READ_NOISE, SHOT_NOISE
from . import jpeg

Random = np.random.Generator
FLARE_CHANNELS = 9
"""Red, green and blue of a flare's three layers: rest, glow, light."""
MAX_LIGHTS = 3
"""Lights of a flare."""
BLUR_REACH = 6
"""Pixels to either side: three standard deviations of the largest blur of a flare."""


class FlareBatch(NamedTuple):
    """Flares on their canvas.

    layers: (n, FLARE_CHANNELS, size, size), linear. lights: positions (n, MAX_LIGHTS, 2), -1..1. is_light: (n,
    MAX_LIGHTS), which of them exist. colour: (n, 3), a factor of all layers that is still to be applied.
    """

    layers: Tensor
    lights: Tensor
    is_light: Tensor
    colour: Tensor

    @property
    def size(self) -> int:
        """Side of the canvas, pixels."""
        return self.layers.shape[-1]


@dataclass(frozen=True)
class _PerFrame:
    """Random parameters of n frames, n first."""

    def to(self, device: torch.device) -> Self:
        """Return a copy on a device, sent without waiting for the device's queue."""
        return type(self)(**{field.name: _to_device(getattr(self, field.name), device) for field in fields(self)})


@dataclass(frozen=True)
class FrameParameters(_PerFrame):
    """Scene and camera of each frame, from `random_cameras`. Shapes are (n, 1, 1, 1) unless noted."""

    exposure: Any      # (n, 3, 1, 1): gain and balance of the scene
    mirrored: Any
    has_flare: Any
    has_lights: Any    # 0 only where the frame has no flare either
    faces_light: Any   # (n,): whether the lights are where the scene is bright
    target_light: Any  # (n,): brightness to expose the scene to at the light; 0 to leave the exposure
    grain: Any
    shoulder: Any      # strength of a curve that bends towards white; 0 for none
    contrast: Any
    saturation: Any
    lift: Any
    black: Any         # (n, 3, 1, 1): display value that black becomes
    white: Any         # (n, 3, 1, 1)
    dither: Any        # added to codes before they are truncated
    jpeg_quality: Any  # 0 for none
    channels: Any      # (n, 3, 3): channel mixing, the identity or one channel for all


@dataclass(frozen=True)
class FlarePlacements(_PerFrame):
    """Placement and appearance of each flare, from `random_cameras`. Shapes are (n, 1, 1, 1) unless noted."""

    matrices: Any      # (n, PLACEMENTS, 2, 3) from canvas to frame in pixels
    blur: Any          # (n,) pixels
    colour: Any        # (n, 3, 1, 1)
    gain: Any
    max_mean: Any      # limit of the flare's mean light over the frame


def draw_frame_parameters(random: Random, count: int, recipe: Recipe) -> FrameParameters:
    """Draw the parameters of `count` frames, float32."""
    def draw_mask(share: float) -> NDArray[np.bool_]:
        return random.random(count) < share

    def draw_each(draw: Callable[[Random], float]) -> NDArray[Any]:
        return _per_frame(np.array([draw(random) for _ in range(count)]))

    without_flare, faces_light = draw_mask(recipe.clean_share), draw_mask(recipe.against_light_share)
    developed = np.array([
        random_cameras.draw_development(random) if is_developed else random_cameras.NEUTRAL_DEVELOPMENT
        for is_developed in draw_mask(random_cameras.DEVELOPED_SHARE)])
    not_faded = np.zeros(3), np.ones(3)
    faded = np.array([random_cameras.draw_fade(random) if is_faded else not_faded
                      for is_faded in draw_mask(recipe.lifted_black_share)])
    channels = np.tile(np.eye(3), (count, 1, 1))
    grey_frames = np.nonzero(draw_mask(recipe.grey_share))[0]
    channels[grey_frames] = np.eye(3)[random.integers(0, 3, len(grey_frames))][:, None]
    return FrameParameters(
        exposure=np.array([random_cameras.draw_exposure(random) for _ in range(count)])[..., None, None],
        mirrored=_per_frame(draw_mask(0.5)), has_flare=_per_frame(~without_flare),
        has_lights=_per_frame(~without_flare | draw_mask(0.5)), faces_light=faces_light,
        target_light=draw_each(random_cameras.draw_target_light).ravel() * faces_light,
        grain=draw_each(random_cameras.draw_grain),
        shoulder=_per_frame(draw_mask(recipe.shoulder_share)) * draw_each(random_cameras.draw_shoulder),
        contrast=_per_frame(developed[:, 0]), saturation=_per_frame(developed[:, 1]), lift=_per_frame(developed[:, 2]),
        black=faded[:, 0, :, None, None], white=faded[:, 1, :, None, None],
        dither=draw_each(random_cameras.draw_dither), jpeg_quality=draw_each(random_cameras.draw_jpeg_quality),
        channels=channels)


def draw_flare_placements(random: Random, count: int, canvas_size: int, width: int, height: int, *,
                          is_second: bool = False) -> FlarePlacements:
    """Draw placement and appearance of `count` flares, one per frame, float32. is_second: they are the second flares of
    their frames, whose strength is random."""
    appearances = [random_cameras.draw_appearance(
        random, random_cameras.draw_second_strength(random) if is_second else 1.0) for _ in range(count)]
    blurs, colours, gains, max_means = (np.array(part) for part in zip(*appearances, strict=True))
    matrices = random_cameras.draw_placement(random, canvas_size, width, height, (count, random_cameras.PLACEMENTS))
    return FlarePlacements(matrices=matrices, blur=blurs,
                           colour=colours[..., None, None], gain=_per_frame(gains), max_mean=_per_frame(max_means))


def compose(scene: Tensor, gamma: Tensor, frames: FrameParameters,
            flares_and_placements: Sequence[tuple[FlareBatch, FlarePlacements]]) -> tuple[Tensor, Tensor, Tensor]:
    """Return (frame with flare, scene without, scene with the lights' glow), display values 0..1, (n, 3, h, w) each.

    scene: linear light (n, 3, h, w), h and w multiples of 16. gamma: gamma of each frame's display values, (n,).
    flares_and_placements: first for a flare of every frame, then for the second flares of the batch's first frames.
    """
    scene = torch.where(frames.mirrored > 0, scene.flip(3), scene).float() * frames.exposure
    rest, glow, light = (torch.zeros_like(scene) for _ in range(3))
    for number, (flares, placement) in enumerate(flares_and_placements):
        flared_frames = slice(0, len(flares.layers))  # the frames that get this flare
        matrix, light_level = _choose_placement(flares, placement.matrices, scene[flared_frames],
                                                frames.faces_light[flared_frames] > 0)
        if number == 0:  # expose some scenes for their brightness at the light of the first flare
            exposure = (frames.target_light / light_level.clamp(min=1e-3)).clamp(*random_cameras.EXPOSURE_LIMITS)
            keeps_exposure = (frames.target_light == 0) | ~flares.is_light[:, 0]
            scene = scene * exposure.masked_fill(keeps_exposure, 1)[:, None, None, None]
        frame_rest, frame_glow, frame_light = _flare_on_frame(flares, placement, matrix, *scene.shape[2:])
        rest[flared_frames] += frame_rest
        glow[flared_frames] += frame_glow
        light[flared_frames] = torch.maximum(light[flared_frames], frame_light)
    rest, glow = rest * frames.has_flare, glow * frames.has_flare
    scene = scene + light * frames.has_lights
    grain = (scene.clamp(min=0) * SHOT_NOISE + READ_NOISE).sqrt() * frames.grain * GRAIN
    scene = (scene + grain * torch.randn_like(scene)).clamp(min=0)
    exposed = torch.stack([_add_flare(scene, rest + glow, frames.shoulder), scene,
                           _add_flare(scene, glow, frames.shoulder)])
    displayed = _develop(exposed.clamp(0, 1).pow(1 / gamma[:, None, None, None]), frames)
    codes = torch.floor(displayed[0] * 255 + frames.dither)
    compressed = jpeg.simulate_jpeg(codes, frames.jpeg_quality.flatten().clamp(min=50))
    # Quality 0 stands for no compression; what was computed for it, at 50, is not used.
    stored = torch.where(frames.jpeg_quality > 0, compressed, codes) / 255
    frame = torch.where(frames.has_flare > 0, stored, displayed[0])
    pictures = torch.stack([frame, displayed[1], displayed[2]])
    frame, scene, scene_with_glow = torch.einsum("nij,knjhw->knihw", frames.channels, pictures)
    return frame, scene, scene_with_glow


def _per_frame(values: NDArray[Any]) -> NDArray[Any]:
    return values[:, None, None, None]


def _to_device(values: NDArray[Any], device: torch.device) -> Tensor:
    """Return float32 on the device, from pinned memory; a copy from other memory would wait for the GPU's queue."""
    tensor = torch.from_numpy(np.asarray(values, np.float32))
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def _add_flare(scene: Tensor, flare: Tensor, shoulder: Tensor) -> Tensor:
    """Return linear light of scene and flare, under a shoulder where there is one
    (`image_formation.add_under_shoulder`)."""
    strength = shoulder.clamp(min=1e-3)
    transmitted = torch.exp(-strength * flare)
    return torch.where(shoulder > 0, scene.clamp(0, 1) * transmitted + (1 - transmitted) / strength, scene + flare)


def _develop(displayed: Tensor, frames: FrameParameters) -> Tensor:
    """Apply the camera's curve and saturation, and the fade, to display values 0..1, (k, n, 3, h, w): k pictures of
    each frame."""
    curve = displayed + frames.contrast * (displayed * displayed * (3 - 2 * displayed) - displayed)
    grey = curve.mean(2, keepdim=True)
    lifted = frames.lift + (1 - frames.lift) * (grey + frames.saturation * (curve - grey))
    return frames.black + (frames.white - frames.black) * lifted.clamp(0, 1)


def _canvas_to_frame(matrices: Tensor, canvas_positions: Tensor, size: int) -> Tensor:
    """Return positions in pixels of the frame, x and y (n, k, 2), of positions on the canvas, -1..1.

    matrices, canvas_positions: (n, k, 2, 3) and (n, 2), or (n, 1, 2, 3) and (n, k, 2). size: of the canvas, pixels.
    """
    positions = (canvas_positions + 1) * (size / 2)
    positions = positions[:, None] if positions.ndim == 2 else positions
    return (matrices[..., :2] * positions[..., None, :]).sum(-1) + matrices[..., 2]


def _choose_placement(flares: FlareBatch, matrices: Tensor, scene: Tensor,
                      faces_light: Tensor) -> tuple[Tensor, Tensor]:
    """Return each frame's matrix (n, 2, 3), and the scene's brightness where this puts the flare's first light (n,).

    matrices: candidates (n, PLACEMENTS, 2, 3). scene: linear light (n, 3, h, w). faces_light: (n,), frames for which
    the candidate is chosen that puts the light where the scene is brightest; the others get their first candidate. A
    light outside the frame counts as at the nearest edge.
    """
    n, _, height, width = scene.shape
    rows, columns = max(height // BRIGHTNESS_CELL, 1), max(width // BRIGHTNESS_CELL, 1)
    brightness = F.adaptive_avg_pool2d(scene.mean(1, keepdim=True), (rows, columns)).flatten(1)
    x, y = _canvas_to_frame(matrices, flares.lights[:, 0], flares.size).unbind(-1)
    row, column = ((coordinates / side * count).long().clamp(0, count - 1)
                   for coordinates, side, count in ((y, height, rows), (x, width, columns)))
    light_levels = brightness.gather(1, row * columns + column)
    best = torch.where(faces_light & flares.is_light[:, 0], light_levels.argmax(1), 0)
    frame_indices = torch.arange(n, device=scene.device)
    return matrices[frame_indices, best], light_levels[frame_indices, best]


def _flare_on_frame(flares: FlareBatch, placement: FlarePlacements, matrix: Tensor, height: int,
                    width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the flares' layers rest, glow and light on the frames, linear light (n, 3, height, width) each.

    The canvases are warped by `matrix` (n, 2, 3), canvas to frame in pixels, then blurred, coloured and dimmed as
    `placement` says. Near a light, flare that is bright enough to clip moves into the layer light.
    """
    grid = _canvas_grid(matrix, height, width, flares.size)
    layers = F.grid_sample(flares.layers.float(), grid, "bilinear", "zeros", align_corners=True)
    rest, glow, light = layers.split(FLARE_CHANNELS // 3, 1)
    rest = _gaussian_blur(rest, placement.blur)
    mean = ((rest[..., ::4, ::4] + glow[..., ::4, ::4]) * placement.gain).clamp(max=1).mean((1, 2, 3), keepdim=True)
    factor = placement.colour * placement.gain * (placement.max_mean / mean.clamp(min=1e-6)).clamp(max=1)
    rest, glow = rest * factor, glow * factor
    light_proximity = _light_proximity(flares, matrix, height, width)
    clipped = (((rest + glow).amin(1, keepdim=True) * light_proximity - CLIP_START) / CLIP_RANGE).clamp(0, 1)
    clipped = clipped * clipped * (3 - 2 * clipped)  # smoothstep
    tint = flares.colour[:, :, None, None]
    light = torch.maximum(light, (rest + glow) * clipped)
    return rest * (1 - clipped) * tint, glow * (1 - clipped) * tint, light * tint


def _light_proximity(flares: FlareBatch, matrix: Tensor, height: int, width: int) -> Tensor:
    """Return (n, 1, height, width): 1 at the flares' lights on the frames, falling to 0 as a Gaussian of LIGHT_RADIUS
    half diagonals. matrix: (n, 2, 3), from canvas to frame, pixels."""
    light_positions = _canvas_to_frame(matrix[:, None], flares.lights, flares.size)
    light_radius = LIGHT_RADIUS * math.hypot(width, height) / 2
    squared_distance = (_pixel_coordinates(height, width, matrix) - light_positions[:, :, None, None]).square().sum(-1)
    return (torch.exp(-squared_distance / light_radius**2) * flares.is_light[:, :, None, None]).amax(1, keepdim=True)


def _pixel_coordinates(height: int, width: int, like: Tensor) -> Tensor:
    """Return (height, width, 2), x and y."""
    y, x = (torch.arange(side, dtype=like.dtype, device=like.device) for side in (height, width))
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def _canvas_grid(matrix: Tensor, height: int, width: int, size: int) -> Tensor:
    """Return where on the canvas the frame's pixels lie, (n, height, width, 2), in the coordinates of `grid_sample`
    with align_corners: -1 and 1 are the middles of the first and the last canvas pixel."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    inverse = torch.stack([d, -b, -c, a], -1).reshape(-1, 2, 2) / (a * d - b * c)[:, None, None]
    offset = _pixel_coordinates(height, width, matrix) - matrix[:, None, None, :, 2]
    return torch.einsum("nij,nhwj->nhwi", inverse, offset) * (2 / (size - 1)) - 1


def _gaussian_blur(planes: Tensor, deviation: Tensor) -> Tensor:
    """Blur (n, c, h, w), each by its own standard deviation in pixels; 0 for none."""
    n, c, h, w = planes.shape
    taps = torch.arange(-BLUR_REACH, BLUR_REACH + 1, dtype=planes.dtype, device=planes.device)
    kernel = torch.exp(-(taps**2) / (2 * deviation[:, None].clamp(min=1e-2) ** 2))
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(c, 0)
    flat = F.pad(planes, (BLUR_REACH,) * 4, mode="reflect").reshape(1, n * c, h + 2 * BLUR_REACH, w + 2 * BLUR_REACH)
    flat = F.conv2d(F.conv2d(flat, kernel[:, None, :, None], groups=n * c), kernel[:, None, None, :], groups=n * c)
    return flat.reshape(n, c, h, w).clamp(min=0)
