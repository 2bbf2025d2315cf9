# SPDX-License-Identifier: GPL-3.0-or-later
"""The network in the box: tells the flare of a frame from the whole frame.

A U-Net of residual blocks. A flare is known by what it does over long ways: a veil lifts the darkest values of
the whole frame, and ghosts lie on the line from a light through the principal point. So it is given, beside the
frame, on every level the means, the darkest values and the over-exposure of what a place covers, the same turned
by 180 degrees about the middle, where a light's mirrored ghosts fall, and where on the frame the place is; and on
the two coarsest levels every place attends to every other, after every second of the first blocks and in the end.

It tells what the flare adds to the frame's display values, of which `gentle` is the part that is not the glow
round the lights. The clean picture is the frame less that, and the flare the difference of the two in light:
what the network does not call flare, the source of light among it, is the frame's own.
"""
from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor, nn

CELL = 2
"""Pixels a side of what the finest level sees as one place."""
LEVELS = 5
MULTIPLE = CELL * 2 ** (LEVELS - 1)
"""Height and width that the network takes are multiples of this."""


class Prediction(NamedTuple):
    """(n, 3, h, w) what the flare adds to display values, and the same without the glow round the lights.

    Below 0 where the network is in doubt the other way; who uses it counts that as none.
    """

    flare: Tensor
    gentle: Tensor


def seen(display: Tensor) -> list[Tensor]:
    """What each level is shown of whole frames (n, 3, h, w) of display values 0..1, the principal point in the
    middle; h and w multiples of MULTIPLE. The finest, at h / CELL, the frame's own pixels; every one its means,
    darkest values and over-exposure, the same turned, and the place."""
    over = ((display.amin(1, keepdim=True) - 0.9) * 10).clamp(0, 1)
    mean, dark, bright = torch.cat([display, over], 1), display, over
    shown = []
    for level in range(LEVELS):
        side = CELL if level == 0 else 2
        mean, dark = F.avg_pool2d(mean, side), -F.max_pool2d(-dark, side)
        bright = F.max_pool2d(bright, side)
        here = torch.cat([mean, dark, bright], 1)
        n, _, height, width = here.shape
        shown.append(torch.cat([here, torch.flip(here, (2, 3)),
                                _place(display, height, width).expand(n, 3, height, width)], 1))
    shown[0] = torch.cat([F.pixel_unshuffle(display, CELL), shown[0]], 1)
    return shown


def _place(like: Tensor, height: int, width: int) -> Tensor:
    """(3, height, width): x, y and their squares' sum, of which the corners have 1."""
    half = (height**2 + width**2) ** 0.5 / 2
    y = (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5 - height / 2) / half
    x = (torch.arange(width, dtype=like.dtype, device=like.device) + 0.5 - width / 2) / half
    x, y = torch.broadcast_tensors(x[None, :], y[:, None])
    return torch.stack([x, y, x * x + y * y])


SHOWN = 2 * (4 + 3 + 1) + 3
"""Planes of `seen` that every level has."""


class Norm(nn.LayerNorm):
    """LayerNorm over the planes of each place."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Block(nn.Module):
    """x + what two convolutions make of it, which is nothing before training."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = Norm(width)
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(F.relu(self.first(self.norm(x))))


WAVES = 4
"""Octaves of the waves by which layers of attention between blocks tell places from each other."""


class Attention(nn.Module):
    """x + what each place takes from every other, by likeness and by where the two are.

    waves: octaves of sines and cosines of the place, without which only what changes slowly over the frame can be
    asked of it: a ghost lies where it lies to within its width.
    """

    def __init__(self, width: int, heads: int, waves: int = 0) -> None:
        super().__init__()
        self.heads, self.waves = heads, waves
        self.norm = Norm(width)
        self.place = nn.Conv2d(5 + 4 * waves, width, 1)
        self.asked = nn.Conv2d(width, 3 * width, 1)
        self.told = nn.Conv2d(width, width, 1)
        nn.init.zeros_(self.told.weight)
        nn.init.zeros_(self.told.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        n, width, rows, columns = x.shape
        place = _place(x, rows, columns)
        told = [place, place[:2] / (place[2:].sqrt() + 0.1)]  # with the direction from the middle
        for octave in range(self.waves):
            phase = place[:2] * (math.pi * 2**octave)
            told += [phase.sin(), phase.cos()]
        place = torch.cat(told)[None]
        parts = self.asked(self.norm(x) + self.place(place)).flatten(2)
        query, key, value = parts.reshape(n, 3, self.heads, width // self.heads, rows * columns).mT.unbind(1)
        return x + self.told(_attended(query, key, value).mT.reshape(n, width, rows, columns))


WRITTEN_OUT = 1024
"""Places up to which attention is written out on a processor, which then takes a third of the time of torch's own;
beyond, the weights of all pairs would not fit memory."""


def _attended(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """What each place takes from every other; all (n, heads, places, planes)."""
    if query.device.type != "cpu" or query.shape[-2] > WRITTEN_OUT:
        return F.scaled_dot_product_attention(query, key, value)
    return torch.softmax(query * query.shape[-1] ** -0.5 @ key.mT, -1) @ value


class RemovalNetwork(nn.Module):
    """widths: planes of each of the LEVELS levels, from the finest; the coarsest two are multiples of HEADS.
    blocks: of each level on the way down; one each on the way up.
    attention: layers of it between the blocks of the coarsest two, one after every second block, beside the one after
    all of them."""

    HEADS = 4

    def __init__(self, widths: tuple[int, ...], blocks: tuple[int, ...], attention: tuple[int, ...]) -> None:
        super().__init__()
        planes = (3 * CELL**2 + SHOWN, *(SHOWN for _ in widths[1:]))
        self.see = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in zip(planes, widths, strict=True))
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(widths))
        self.enter = nn.ModuleList(nn.Sequential(*(Block(width) for _ in range(count)))
                                   for width, count in zip(widths, blocks, strict=True))
        self.leave = nn.ModuleList(Block(width) for width in widths)
        self.between = nn.ModuleList(nn.ModuleList(Attention(width, self.HEADS, WAVES) for _ in range(count))
                                     for width, count in zip(widths[-2:], attention, strict=True))
        self.attention = nn.ModuleList(Attention(width, self.HEADS) for width in widths[-2:])
        self.head = nn.Conv2d(widths[0], 6 * CELL**2, 1)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, display: Tensor) -> Prediction:
        """display: whole frames (n, 3, h, w), values 0..1, the principal point in the middle; h and w multiples of
        MULTIPLE."""
        shown = [self.see[level](part) for level, part in enumerate(seen(display))]
        x, kept = shown[0], []
        for level in range(LEVELS):
            if level:
                kept.append(x)
                x = self.down[level - 1](x) + shown[level]
            x = self._entered(x, level)
        for level in reversed(range(LEVELS)):
            x = self.leave[level](x)
            if level:
                x = F.interpolate(self.up[level - 1](x), scale_factor=2, mode="nearest") + kept.pop()
        out = F.pixel_shuffle(self.head(x), CELL).float()
        return Prediction(out[:, :3], out[:, :3] * torch.sigmoid(out[:, 3:] * 4))

    def _entered(self, x: Tensor, level: int) -> Tensor:
        """Through the blocks of a level on the way down, and what attention it has."""
        coarse = level - (LEVELS - 2)
        between = list(cast(nn.ModuleList, self.between[coarse])) if coarse >= 0 else []
        for number, block in enumerate(cast(nn.Sequential, self.enter[level])):
            x = block(x)
            if number % 2 and number // 2 < len(between):
                x = between[number // 2](x)
        return cast(Tensor, self.attention[coarse](x)) if coarse >= 0 else x
