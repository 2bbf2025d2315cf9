# SPDX-License-Identifier: GPL-3.0-or-later
"""The network in the box: tells the flare of a frame from what lies round each place, near and far.

For each cell of a few pixels it sees the colour and over-exposure there and in ever larger neighbourhoods, the
darkest values of each (a veil lifts the darkest), the same of the whole frame, what lies at the place turned
by 180 degrees about the principal point, where a light's ghosts mirror it, and where on the frame it is. A
perceptron, the same in every cell, tells what the flare adds to the frame's display values, of which `gentle`
is the part that is not the glow round the lights. The clean picture is the frame less that, and the flare the
difference of the two in light: what the network does not call flare, the source of light among it, is the
frame's own.

Since it is the same in every cell, it can be trained on cells of thousands of frames at a time, so that minutes
of one processor core are enough to learn something.
"""
from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor, nn

CELL = 2
"""Pixels a side of what the network tells one flare for."""
REACHES = (4, 8, 16, 32)
"""Sides of the neighbourhoods, in cells."""
MULTIPLE = CELL * REACHES[-1] // 2
"""Height and width that the network takes are multiples of this."""
INPUTS = 7 + 7 * len(REACHES) + 7 + 14 + 3
GAMMA = 2
"""Of the light that flares are taken from display values in: the middle of what pictures are formed with, and cheap."""


class Prediction(NamedTuple):
    """(n, 3, h, w) what the flare adds to display values, and the same without the glow round the lights.

    Below 0 where the network is in doubt the other way; who uses it counts that as none.
    """

    flare: Tensor
    gentle: Tensor


def inputs(display: Tensor) -> Tensor:
    """(n, INPUTS, h / CELL, w / CELL) from whole frames (n, 3, h, w) of display values 0..1, the principal point
    in the middle; h and w multiples of MULTIPLE."""
    over = ((display.amin(1, keepdim=True) - 0.9) * 10).clamp(0, 1)
    mean = F.avg_pool2d(torch.cat([display, over], 1), CELL)
    dark = -F.max_pool2d(-display, CELL)
    n, _, height, width = mean.shape
    found = [mean, dark]
    for reach in REACHES:
        side = min(reach, height, width)
        coarse = torch.cat([F.avg_pool2d(mean, side, ceil_mode=True, count_include_pad=False),
                            -F.max_pool2d(-dark, side, ceil_mode=True)], 1)
        found.append(F.interpolate(coarse, size=(height, width), mode="bilinear", align_corners=False))
    near = found[3]  # of the second reach
    found.append(torch.cat([mean.mean((2, 3)), dark.amin((2, 3))], 1)[:, :, None, None].expand(-1, -1, height, width))
    found.append(torch.flip(torch.cat([mean, dark, near], 1), (2, 3)))
    half = (height**2 + width**2) ** 0.5 / 2
    y = (torch.arange(height, dtype=display.dtype, device=display.device) + 0.5 - height / 2) / half
    x = (torch.arange(width, dtype=display.dtype, device=display.device) + 0.5 - width / 2) / half
    x, y = torch.broadcast_tensors(x[None, :], y[:, None])
    found.append(torch.stack([x, y, x * x + y * y]).expand(n, 3, height, width))
    return torch.cat(found, 1)


class RemovalNetwork(nn.Module):
    """widths: of the perceptron's hidden layers."""

    def __init__(self, widths: tuple[int, ...] = (192, 128, 64)) -> None:
        super().__init__()
        self.widths = tuple(widths)
        self.register_buffer("mean", torch.zeros(INPUTS))
        self.register_buffer("spread", torch.ones(INPUTS))
        sides = (INPUTS, *widths)
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sides, widths, strict=False))
        self.head = nn.Linear(widths[-1], 6)

    mean: Tensor
    spread: Tensor

    def forward(self, seen: Tensor) -> Prediction:
        """seen: as `inputs` makes it; the prediction is CELL times as high and wide."""
        out = self.cells(seen.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
        out = F.interpolate(out, scale_factor=CELL, mode="bilinear", align_corners=False)
        return Prediction(out[:, :3], out[:, 3:])

    def cells(self, seen: Tensor) -> Tensor:
        """(…, 6) flare and its gentle part, from (…, INPUTS)."""
        x = (seen - self.mean) / self.spread
        for layer in self.hidden:
            x = F.leaky_relu(layer(x), 0.1)
        out = self.head(x)
        return torch.cat([out[..., :3], out[..., :3] * torch.sigmoid(out[..., 3:])], -1)


def flare_light(display: Tensor, added: Tensor) -> Tensor:
    """Linear flare (of GAMMA): what the frame's light has more than that of the clean display values."""
    return display**GAMMA - (display - added).clamp(min=0) ** GAMMA
