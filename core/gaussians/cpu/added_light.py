# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds scene-linear light to a picture in sRGB display values, with both slopes; the definition is
`core.flare.compositing`.

A scene's value is decoded to linear light, light is added, and the sum is encoded (`core.colour.srgb_torch`). A power
x^p is 2^(p log2 x). The forward pass keeps the derivatives of the result by light and scene, so that the backward pass
is one product each. Clips have a straight-through gradient. NaN stays NaN.
"""
from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...colour import srgb_torch as curve
from . import buffers
from .compilation import kernel
from .threads import parallel
from .tiles import EMPTY, flat
from .vector import LANES, atomic_increment, exp2, fma, load, log2, maximum, minimum, splat, store, where

PIXELS_PER_TASK = 1 << 12
"""Fewest pixels that a thread processes at a time, in a picture that has so many."""
NO_MASK = np.empty(0, np.bool_)
INFINITY = np.float32(np.inf)

ZERO, TOE_SLOPE, INVERSE_TOE_SLOPE = np.float32(0), np.float32(curve.TOE_SLOPE), np.float32(1 / curve.TOE_SLOPE)
DISPLAY_TOE, LINEAR_TOE = np.float32(curve.DISPLAY_TOE), np.float32(curve.LINEAR_TOE)
INVERSE_SCALE, SHIFT = np.float32(1 / curve.SCALE), np.float32(curve.OFFSET / curve.SCALE)
SCALE, OFFSET = np.float32(curve.SCALE), np.float32(curve.OFFSET)
DECODE_POWER, ENCODE_POWER = np.float32(curve.GAMMA - 1), np.float32(1 / curve.GAMMA)
DECODE_SLOPE, ENCODE_SLOPE = np.float32(curve.GAMMA / curve.SCALE), np.float32(curve.SCALE / curve.GAMMA)


@kernel
def add_light_kernel(counter, scene, light, black, white, tasks, display, scene_slope, light_slope):
    """Write encode(decode(scene) + light), clipped to 0..white, to `display`, and its derivatives to both slopes.

    counter: index of the next task, of `tasks`. scene, light and the results: flat, 3 values a pixel. black: a bool for
    each pixel whose scene counts as black, or empty. scene_slope, light_slope: may be empty.
    """
    pixels = scene.size // 3
    while True:
        task = atomic_increment(counter)
        if task >= tasks:
            break
        first_pixel, end_pixel = pixels * task // tasks, pixels * (task + 1) // tasks
        for block in range(3 * first_pixel, 3 * end_pixel, LANES):
            i = min(block, 3 * end_pixel - LANES)  # the last block overlaps the one before
            behind = minimum(splat(white), maximum(splat(ZERO), load(scene, i)))  # NaN, as second, stays NaN
            base = fma(behind, INVERSE_SCALE, splat(SHIFT))
            power = exp2(log2(base) * DECODE_POWER)
            is_low = behind <= DISPLAY_TOE
            linear = where(is_low, behind * INVERSE_TOE_SLOPE, base * power) + load(light, i)
            bright = maximum(splat(LINEAR_TOE), linear)
            root = exp2(log2(bright) * ENCODE_POWER)
            is_dark = linear <= LINEAR_TOE
            encoded = where(is_dark, linear * TOE_SLOPE, fma(root, SCALE, splat(-OFFSET)))
            clipped = minimum(splat(white), maximum(splat(ZERO), encoded))
            store(display, i, where(linear <= INFINITY, clipped, linear))  # log2 of NaN is a number
            if light_slope.size > 0:
                slope = where(is_dark, splat(TOE_SLOPE), root * ENCODE_SLOPE / bright)
                store(light_slope, i, slope)
                if scene_slope.size > 0:
                    store(scene_slope, i, slope * where(is_low, splat(INVERSE_TOE_SLOPE), power * DECODE_SLOPE))
        if black.size > 0:
            for pixel in range(first_pixel, end_pixel):
                if black[pixel]:
                    for i in range(3 * pixel, 3 * pixel + 3):
                        is_dark = light[i] <= LINEAR_TOE
                        root = max(light[i], LINEAR_TOE) ** ENCODE_POWER
                        encoded = light[i] * TOE_SLOPE if is_dark else root * SCALE - OFFSET
                        display[i] = encoded if math.isnan(encoded) else min(max(encoded, ZERO), white)
                        if light_slope.size > 0:
                            light_slope[i] = TOE_SLOPE if is_dark else root * ENCODE_SLOPE / light[i]
                        if scene_slope.size > 0:
                            scene_slope[i] = ZERO


@kernel
def multiply_kernel(counter, gradient, scene_slope, light_slope, tasks, d_scene, d_light):
    """Write gradient times slope to d_scene and d_light, all flat. scene_slope and d_scene may be empty.

    counter: index of the next task, of `tasks`.
    """
    while True:
        task = atomic_increment(counter)
        if task >= tasks:
            break
        start, end = gradient.size * task // tasks, gradient.size * (task + 1) // tasks
        for block in range(start, end, LANES):
            i = min(block, end - LANES)
            g = load(gradient, i)
            store(d_light, i, g * load(light_slope, i))
            if d_scene.size > 0:
                store(d_scene, i, g * load(scene_slope, i))


class _AddLight(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scene: Tensor, light: Tensor, white: float, black: Tensor | None) -> Tensor:
        """Return the sum in display values (h, w, 3); the arguments are those of `add_light`."""
        height, width, _ = scene.shape
        display, display_flat = buffers.tensor_and_array(height, width, 3)
        has_scene, has_light = ctx.needs_input_grad[:2]
        scene_slope = buffers.empty(scene.numel()) if has_scene else EMPTY
        light_slope = buffers.empty(scene.numel()) if has_scene or has_light else EMPTY
        ctx.tasks = max(height * width // PIXELS_PER_TASK, 1)
        mask = NO_MASK if black is None else black.contiguous().numpy().ravel()
        parallel(add_light_kernel, flat(scene), flat(light), mask, np.float32(white), ctx.tasks, display_flat,
                 scene_slope, light_slope, limit=ctx.tasks)
        ctx.slopes = scene_slope, light_slope
        return display

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        scene_slope, light_slope = ctx.slopes
        d_light, d_light_flat = buffers.tensor_and_array(*gradient.shape)
        d_scene, d_scene_flat = (buffers.tensor_and_array(*gradient.shape) if scene_slope.size else (None, EMPTY))
        parallel(multiply_kernel, flat(gradient), scene_slope, light_slope, ctx.tasks, d_scene_flat, d_light_flat,
                 limit=ctx.tasks)
        return d_scene, d_light, None, None


def add_light(scene: Tensor, light: Tensor, white: float, black: Tensor | None) -> Tensor | None:
    """Return encode(decode(scene) + light) (h, w, 3) in display values, clipped to 0..white; None for a picture of
    fewer values than a vector has.

    scene: (h, w, 3) display values, clipped before. light: (h, w, 3) scene-linear. black: (h, w) mask of pixels whose
    scene counts as black and gets no gradient, or None. The clips have a straight-through gradient.
    """
    if scene.numel() < LANES:
        return None
    added: Tensor = _AddLight.apply(scene, light, white, black)
    return added
