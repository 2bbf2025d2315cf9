# SPDX-License-Identifier: GPL-3.0-or-later
"""Deforms canonical flare Gaussians and places them on the normalised plane, forth and back; the definition is
`core.flare.model` with `core.flare.placement`.

For ellipses on the line with rings and one colour. x + delta_x is written as x, delta_x being a column of the
network's offsets:

    mean = mu light + scale plane_offset + offset       covariance = R diag(exp(2 log_scales)) R^T
    opacity = sigmoid(logit)      colour = max(C0 sh + 1/2, 0)      ring = (r0, exp(log w)), log w in -3..3

A flare has a thousand Gaussians, so one thread computes them all in less time than a second one takes to start.
"""
from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...conventions.splatting import C0
from . import buffers
from .compilation import kernel
from .tiles import flat

COLUMNS = (("log_scales", 2), ("opacity_logits", 1), ("positions", 1), ("rings", 2), ("rotations", 2), ("sh", 3),
           ("plane_offset", 2))
"""Names and widths of the columns of the network's offsets: the rows in alphabetical order, as torch's ParameterDict
has them, then the offset of the mean."""
SCALES, LOGIT, POSITION, RINGS, ROTATION, SH, PLANE = 0, 2, 3, 4, 6, 8, 11
"""First columns of these."""
WIDTH = sum(width for _, width in COLUMNS)
MAX_LOG_WIDTH = np.float32(3)
"""Bound of |log w| of a ring."""
MIN_LENGTH = 1e-12
"""Least length by which a direction is divided."""
ONE, TWO, HALF, ZERO, SH0 = np.float32(1), np.float32(2), np.float32(0.5), np.float32(0), np.float32(C0)


@kernel
def place_kernel(
    deltas, positions, log_scales, rotations, logits, sh, rings, offsets, light, scale,
    means, covariances, opacities, colours, placed_rings,
):  # fmt: skip
    """Write the placed Gaussians; the module head explains the letters. All arrays are flat; deltas: (n, WIDTH)."""
    for i in range(logits.size):
        d = i * WIDTH
        mu = positions[i] + deltas[d + POSITION]
        means[2 * i] = mu * light[0] + scale * deltas[d + PLANE] + offsets[2 * i]
        means[2 * i + 1] = mu * light[1] + scale * deltas[d + PLANE + 1] + offsets[2 * i + 1]
        x, y = rotations[2 * i] + deltas[d + ROTATION], rotations[2 * i + 1] + deltas[d + ROTATION + 1]
        length = max(math.sqrt(x * x + y * y), MIN_LENGTH)
        c, s = np.float32(x / length), np.float32(y / length)
        a = math.exp(TWO * (log_scales[2 * i] + deltas[d + SCALES]))
        b = math.exp(TWO * (log_scales[2 * i + 1] + deltas[d + SCALES + 1]))
        covariances[3 * i], covariances[3 * i + 1] = a * c * c + b * s * s, (a - b) * c * s
        covariances[3 * i + 2] = a * s * s + b * c * c
        opacities[i] = ONE / (ONE + math.exp(-(logits[i] + deltas[d + LOGIT])))
        for channel in range(3):
            colours[3 * i + channel] = max(SH0 * (sh[3 * i + channel] + deltas[d + SH + channel]) + HALF, ZERO)
        placed_rings[2 * i] = rings[2 * i] + deltas[d + RINGS]
        log_width = min(max(rings[2 * i + 1] + deltas[d + RINGS + 1], -MAX_LOG_WIDTH), MAX_LOG_WIDTH)
        placed_rings[2 * i + 1] = math.exp(log_width)


@kernel
def place_backward_kernel(
    deltas, positions, log_scales, rotations, rings, light, scale, opacities, colours, placed_rings,
    g_means, g_covariances, g_opacities, g_colours, g_rings, d_deltas, d_light,
):  # fmt: skip
    """Write the gradient of the deltas (n, WIDTH), which is that of the canonical rows too, and of the light (2,).

    opacities, colours, placed_rings: results of the forward pass. g_...: gradients of the results.
    """
    light_x = light_y = 0.0
    for i in range(opacities.size):
        d = i * WIDTH
        g_x, g_y = g_means[2 * i], g_means[2 * i + 1]
        mu = positions[i] + deltas[d + POSITION]
        light_x += mu * g_x
        light_y += mu * g_y
        d_deltas[d + POSITION] = g_x * light[0] + g_y * light[1]
        d_deltas[d + PLANE], d_deltas[d + PLANE + 1] = scale * g_x, scale * g_y
        x, y = rotations[2 * i] + deltas[d + ROTATION], rotations[2 * i + 1] + deltas[d + ROTATION + 1]
        length = np.float32(max(math.sqrt(x * x + y * y), MIN_LENGTH))
        c, s = x / length, y / length
        a = math.exp(TWO * (log_scales[2 * i] + deltas[d + SCALES]))
        b = math.exp(TWO * (log_scales[2 * i + 1] + deltas[d + SCALES + 1]))
        xx, xy, yy = g_covariances[3 * i], g_covariances[3 * i + 1], g_covariances[3 * i + 2]
        d_deltas[d + SCALES] = TWO * a * (c * c * xx + c * s * xy + s * s * yy)
        d_deltas[d + SCALES + 1] = TWO * b * (s * s * xx - c * s * xy + c * c * yy)
        d_c = TWO * c * (a * xx + b * yy) + (a - b) * s * xy
        d_s = TWO * s * (b * xx + a * yy) + (a - b) * c * xy
        along = d_c * c + d_s * s  # a change of length alone does not turn the axis
        d_deltas[d + ROTATION], d_deltas[d + ROTATION + 1] = (d_c - along * c) / length, (d_s - along * s) / length
        d_deltas[d + LOGIT] = g_opacities[i] * opacities[i] * (ONE - opacities[i])
        for channel in range(3):
            is_clipped = colours[3 * i + channel] <= ZERO
            d_deltas[d + SH + channel] = ZERO if is_clipped else SH0 * g_colours[3 * i + channel]
        d_deltas[d + RINGS] = g_rings[2 * i]
        is_inside = abs(rings[2 * i + 1] + deltas[d + RINGS + 1]) <= MAX_LOG_WIDTH
        d_deltas[d + RINGS + 1] = g_rings[2 * i + 1] * placed_rings[2 * i + 1] if is_inside else ZERO
    d_light[0], d_light[1] = light_x, light_y


class _Place(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scale: float, deltas: Tensor, light: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
        """Return means, covariances, opacities, colours and rings; the arguments are those of `place`."""
        count = len(deltas)
        results, arrays = zip(*(buffers.tensor_and_array(*shape) for shape in
                                ((count, 2), (count, 3), (count,), (count, 3), (count, 2))), strict=True)
        inputs = tuple(flat(part) for part in (deltas, *rows))
        place_kernel(*inputs, flat(light), np.float32(scale), *arrays)
        ctx.save_for_backward(deltas, light, *rows)
        ctx.scale, ctx.results = scale, arrays
        return results

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        deltas, light, *rows = ctx.saved_tensors
        positions, log_scales, rotations, _, _, rings, _ = map(flat, rows)
        d_deltas, d_flat = buffers.tensor_and_array(*deltas.shape)
        d_light, d_light_flat = buffers.tensor_and_array(2)
        place_backward_kernel(
            flat(deltas), positions, log_scales, rotations, rings, flat(light), np.float32(ctx.scale), *ctx.results[2:],
            *map(flat, gradients), d_flat, d_light_flat,
        )  # fmt: skip
        d_rows = [d_deltas[:, first : first + row.shape[1]].contiguous()
                  for first, row in zip((POSITION, SCALES, ROTATION, LOGIT, SH, RINGS), rows[:-1], strict=True)]
        return (None, d_deltas, d_light, *d_rows, gradients[0])


def place(
    deltas: Tensor, light: Tensor, scale: float, positions: Tensor, log_scales: Tensor, rotations: Tensor,
    opacity_logits: Tensor, sh: Tensor, rings: Tensor, offsets: Tensor,
) -> tuple[Tensor, ...] | None:  # fmt: skip
    """Return means (n, 2), covariances (n, 3), opacities (n,), colours (n, 3) and rings (n, 2) on the plane; None
    without Gaussians.

    deltas: (n, WIDTH), the network's offsets, with the columns COLUMNS. light: (2,), its place on the plane, with its
    correction. scale: of plane offsets. The others are the canonical rows: (n, 1), (n, 2), (n, 2), (n, 1), (n, 3), (n,
    2) and (n, 2).
    """
    if len(deltas) == 0:
        return None
    rows = positions, log_scales, rotations, opacity_logits, sh, rings, offsets
    placed: tuple[Tensor, ...] = _Place.apply(scale, deltas, light, *rows)
    return placed
