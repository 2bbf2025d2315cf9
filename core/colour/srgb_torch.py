# SPDX-License-Identifier: GPL-3.0-or-later
"""Display values and linear light as tensors, with gradients: the sRGB curve (IEC 61966-2-1) that `core.pictures` has
for arrays, and what a camera makes of light, exposure and clipping."""
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

LINEAR_TOE, DISPLAY_TOE = 0.0031308, 0.04045
"""Where the curve's straight beginning ends, in linear light and in display values."""
TOE_SLOPE = 12.92
SCALE, OFFSET, GAMMA = 1.055, 0.055, 2.4
"""Beyond it: display = SCALE * linear**(1 / GAMMA) - OFFSET."""


def decode(display: Tensor) -> Tensor:
    """sRGB display values, not negative, to linear light (IEC 61966-2-1)."""
    return torch.where(display <= DISPLAY_TOE, display / TOE_SLOPE,
                       ((display.clamp_min(DISPLAY_TOE) + OFFSET) / SCALE) ** GAMMA)


def encode(linear: Tensor) -> Tensor:
    """Linear light, not negative, to sRGB display values; above 1 the curve goes on."""
    return torch.where(linear <= LINEAR_TOE, linear * TOE_SLOPE,
                       SCALE * linear.clamp_min(LINEAR_TOE) ** (1 / GAMMA) - OFFSET)


def exposed(display: Tensor, exposure: float) -> Tensor:
    """Display values, not negative, of `exposure` times the light; above 1 the curve goes on."""
    shown: Tensor = display if exposure == 1 else _Exposed.apply(display, exposure)
    return shown


def clipped(display: Tensor, white: float) -> Tensor:
    """As a camera clips it, with the gradient passed on as it is: a pixel that is too bright must be able to come down
    again."""
    return display - (display - white).clamp_min(0).detach()


class _Exposed(torch.autograd.Function):
    """encode(exposure * decode(display)), by the powers of which the slopes are made too."""

    @staticmethod
    def forward(ctx: Any, display: Tensor, exposure: float) -> Tensor:
        linear, within = decoded_with_slope(display)
        shown, slope = encoded_with_slope(linear.mul_(exposure))
        ctx.save_for_backward(within.mul_(exposure).mul_(slope))
        return shown

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient * ctx.saved_tensors[0], None


def decoded_with_slope(display: Tensor) -> tuple[Tensor, Tensor]:
    """`decode` and its slope, which the same power gives: autograd would take another. Both are the caller's own."""
    base = (display + OFFSET) / SCALE
    power, low = base ** (GAMMA - 1), display <= DISPLAY_TOE
    linear = torch.where(low, display / TOE_SLOPE, base * power)
    return linear, power.mul_(GAMMA / SCALE).masked_fill_(low, 1 / TOE_SLOPE)


def encoded_with_slope(linear: Tensor) -> tuple[Tensor, Tensor]:
    """`encode` and its slope, likewise."""
    bright, low = linear.clamp_min(LINEAR_TOE), linear <= LINEAR_TOE
    power = bright ** (1 / GAMMA)
    shown = torch.where(low, linear * TOE_SLOPE, power * SCALE - OFFSET)
    return shown, power.mul_(SCALE / GAMMA).div_(bright).masked_fill_(low, TOE_SLOPE)
