# SPDX-License-Identifier: GPL-3.0-or-later
"""The network in the box: a U-Net of plain 3x3 convolutions that sees a frame and tells its flare.

It sees ten channels: the frame (display values), the frame turned by 180 degrees about the principal point,
where a light's ghosts mirror it, how over-exposed both are, and where on the frame it is. It gives what the
flare adds to the frame's display values, of which `gentle` is the part that is not the glow round the lights.
The clean picture is the frame less that, and the flare the difference of the two in light: what the network
does not call flare, the source of light among it, is the frame's own.

Plain convolutions on a quarter, an eighth, ... of the resolution were chosen over depthwise ones because the
matrix units of processors and graphics cards alike are several times faster on them.
"""
from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor, nn

INPUTS = 10
FOLD = 4
"""Pixels a side that become the channels of one: most of the cost of a network lies at its finest resolution, and
what it tells is smooth, and carried up by a guided filter."""
MULTIPLE = 32
"""Height and width that the network takes are multiples of this."""
GAMMA = 2
"""Of the light that flares are taken from display values in: the middle of what pictures are formed with, and cheap."""


class Prediction(NamedTuple):
    """(n, 3, h, w) what the flare adds to display values, and the same without the glow round the lights.

    Below 0 where the network is in doubt the other way; who uses it counts that as none. An activation that
    cannot go below 0 has no slope there, and a network that begins with "no flare", which is most often right,
    would never leave it.
    """

    flare: Tensor
    gentle: Tensor


def inputs(display: Tensor) -> Tensor:
    """(n, 10, h, w) from whole frames (n, 3, h, w) of display values 0..1, the principal point in the middle."""
    n, _, height, width = display.shape
    over = ((display.amin(1, keepdim=True) - 0.9) * 10).clamp(0, 1)
    turned = torch.flip(torch.cat([display, over], 1), (2, 3))
    half = (height**2 + width**2) ** 0.5 / 2
    y = (torch.arange(height, dtype=display.dtype, device=display.device) + 0.5 - height / 2) / half
    x = (torch.arange(width, dtype=display.dtype, device=display.device) + 0.5 - width / 2) / half
    place = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None])).expand(n, 2, height, width)
    return torch.cat([display, over, turned, place], 1)


class Norm(nn.Module):
    """Layer normalisation over the channels of each pixel; every layer but the first sees normalised values, for
    without it what is carried from level to level grows out of bounds."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        last = x.permute(0, 2, 3, 1)  # the memory's own order
        return F.layer_norm(last, last.shape[-1:], self.weight, self.bias).permute(0, 3, 1, 2)


class Block(nn.Module):
    """x + scale * convolutions(x). The scales start near zero, so that a deep network starts as a shallow one. Were it
    the convolutions that start at zero, the first steps would turn all of their weights the same way, and what is
    the same in every pixel would drown the rest.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = Norm(width)
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        self.scale = nn.Parameter(torch.full((width, 1, 1), 0.05))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.scale * self.second(F.leaky_relu(self.first(self.norm(x)), 0.1))


class Everywhere(nn.Module):
    """What the whole frame has on average, told to every place: how bright, whose lights."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, x: Tensor) -> Tensor:
        seen = torch.cat([x.mean((2, 3)), x.amax((2, 3))], 1)
        return x + self.layers(seen)[:, :, None, None]


class RemovalNetwork(nn.Module):
    """widths: channels at 1/4, 1/8, ... of the resolution; depths: blocks on the way down, and up again."""

    def __init__(self, widths: tuple[int, ...] = (64, 96, 128, 192), depths: tuple[int, ...] = (1, 2, 2, 4)) -> None:
        super().__init__()
        self.widths, self.depths = tuple(widths), tuple(depths)
        self.stem = nn.Conv2d(INPUTS * FOLD**2, widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Sequential(*(Block(width) for _ in range(depth)))
                                  for width, depth in zip(widths, depths, strict=True))
        self.reduce = nn.ModuleList(nn.Sequential(Norm(a), nn.Conv2d(a, b, 2, stride=2)) for a, b in pairwise(widths))
        self.everywhere = Everywhere(widths[-1])
        self.grow = nn.ModuleList(nn.Sequential(Norm(b), nn.Conv2d(b, 4 * a, 1), nn.PixelShuffle(2))
                                  for a, b in pairwise(widths))
        self.up = nn.ModuleList(nn.Sequential(*(Block(width) for _ in range(depth)))
                                for width, depth in zip(widths[:-1], depths[:-1], strict=True))
        self.last = Norm(widths[0])
        self.head = nn.Conv2d(widths[0], 6 * FOLD**2, 3, padding=1)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Prediction:
        """x: (n, 10, h, w) as `inputs` makes it, h and w multiples of MULTIPLE."""
        x = self.stem(F.pixel_unshuffle(x, FOLD))
        kept = []
        for level, blocks in enumerate(self.down):
            x = blocks(x)
            if level < len(self.reduce):
                kept.append(x)
                x = self.reduce[level](x)
        x = self.everywhere(x)
        for level in reversed(range(len(self.grow))):
            x = self.up[level](self.grow[level](x) + kept[level])
        out = F.pixel_shuffle(self.head(self.last(x)), FOLD).float()
        flare = out[:, :3]
        return Prediction(flare, flare * torch.sigmoid(8 * out[:, 3:] + 1))


def flare_light(display: Tensor, added: Tensor) -> Tensor:
    """Linear flare (of GAMMA): what the frame's light has more than that of the clean display values."""
    return display**GAMMA - (display - added).clamp(min=0) ** GAMMA
