# SPDX-License-Identifier: GPL-3.0-or-later
"""The sRGB transfer curve (IEC 61966-2-1), exposure and clipping for tensors, with gradients.

`srgb.py` has the same curve for arrays. Fits compare display values by it.
"""
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

LINEAR_TOE, DISPLAY_TOE = 0.0031308, 0.04045
"""End of the curve's linear segment, in linear light and in display values."""
TOE_SLOPE = 12.92
SCALE, OFFSET, GAMMA = 1.055, 0.055, 2.4
"""The curve beyond it: display = SCALE * linear**(1 / GAMMA) - OFFSET."""


def decode(display: Tensor) -> Tensor:
    """Convert sRGB display values, not negative, to linear light (IEC 61966-2-1)."""
    return torch.where(display <= DISPLAY_TOE, display / TOE_SLOPE,
                       ((display.clamp_min(DISPLAY_TOE) + OFFSET) / SCALE) ** GAMMA)


def encode(linear: Tensor) -> Tensor:
    """Convert linear light, not negative, to sRGB display values, unclipped above 1."""
    return torch.where(linear <= LINEAR_TOE, linear * TOE_SLOPE,
                       SCALE * linear.clamp_min(LINEAR_TOE) ** (1 / GAMMA) - OFFSET)


def expose(display: Tensor, exposure: float) -> Tensor:
    """Multiply the light of display values, not negative, by `exposure`; unclipped above 1."""
    encoded: Tensor = display if exposure == 1 else _Expose.apply(display, exposure)
    return encoded


def clip_straight_through(display: Tensor, white: float) -> Tensor:
    """Clip display values at `white` with a straight-through gradient: a pixel that is too bright must be able to
    darken."""
    return display - (display - white).clamp_min(0).detach()


class _Expose(torch.autograd.Function):
    """encode(exposure * decode(display)); both slopes reuse the forward pass's powers."""

    @staticmethod
    def forward(ctx: Any, display: Tensor, exposure: float) -> Tensor:
        linear, within = decode_with_slope(display)
        encoded, slope = encode_with_slope(linear.mul_(exposure))
        ctx.save_for_backward(within.mul_(exposure).mul_(slope))
        return encoded

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient * ctx.saved_tensors[0], None


def decode_with_slope(display: Tensor) -> tuple[Tensor, Tensor]:
    """Return `decode(display)` and its derivative, which share one power. The caller may change both in place."""
    base = (display + OFFSET) / SCALE
    power, low = base ** (GAMMA - 1), display <= DISPLAY_TOE
    linear = torch.where(low, display / TOE_SLOPE, base * power)
    return linear, power.mul_(GAMMA / SCALE).masked_fill_(low, 1 / TOE_SLOPE)


def encode_with_slope(linear: Tensor) -> tuple[Tensor, Tensor]:
    """Return `encode(linear)` and its derivative, which share one power. The caller may change both in place."""
    bright, low = linear.clamp_min(LINEAR_TOE), linear <= LINEAR_TOE
    power = bright ** (1 / GAMMA)
    encoded = torch.where(low, linear * TOE_SLOPE, power * SCALE - OFFSET)
    return encoded, power.mul_(SCALE / GAMMA).div_(bright).masked_fill_(low, TOE_SLOPE)
