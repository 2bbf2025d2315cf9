# SPDX-License-Identifier: GPL-3.0-or-later
"""The removal network: predicts the flare of a frame from the whole frame.

A U-Net of residual blocks. A flare has long-range structure: a veil lifts the darkest values of the whole frame, and
ghosts lie on the line from a light through the principal point. So every level gets, beside the features of the level
above, the mean, the minimum and the over-exposure of the pixels under each position; the same rotated by 180 degrees
about the centre, where the mirrored ghosts of a light fall; and the position itself. On the two coarsest levels every
position attends to every other, after every second of the first residual blocks and after the last.

The network predicts what the flare adds to the frame's display values, and how much of that is not glow about the
lights. The clean frame is the frame minus the prediction, and the flare is their difference in linear light. What the
network does not predict as flare, such as the light disc, stays in the frame.

`weights` reads and builds it, `inference.remover` runs it on a frame, `training.trainer` trains it.
"""
from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor, nn

SHUFFLE_FACTOR = 2
"""Side in pixels of a position of the finest level (pixel unshuffle)."""
LEVELS = 5
SIZE_MULTIPLE = SHUFFLE_FACTOR * 2 ** (LEVELS - 1)
"""The network's input has a height and a width that are multiples of this, in pixels."""


class NetworkOutput(NamedTuple):
    """What the flare adds to display values, with and without the glow about the lights, each (n, 3, h, w).

    Values are not clamped; below 0 they count as no flare.
    """

    flare: Tensor
    flare_without_glow: Tensor


def pyramid_inputs(display: Tensor) -> list[Tensor]:
    """Return the input of each level, finest first, (n, INPUT_CHANNELS, h / side, w / side), where `side` is the side
    of a position in pixels: SHUFFLE_FACTOR, doubled from level to level. The finest level also holds the pixels of the
    frame (pixel unshuffle).

    display: whole frames (n, 3, h, w), values 0..1, principal point in the centre; h and w multiples of SIZE_MULTIPLE.
    """
    # 0 where the darkest channel is at 0.9 or less, 1 where it is clipped
    exposure = ((display.amin(1, keepdim=True) - 0.9) * 10).clamp(0, 1)
    mean, minimum, over_exposure = torch.cat([display, exposure], 1), display, exposure
    inputs = []
    for level in range(LEVELS):
        side = SHUFFLE_FACTOR if level == 0 else 2
        mean, minimum = F.avg_pool2d(mean, side), -F.max_pool2d(-minimum, side)
        over_exposure = F.max_pool2d(over_exposure, side)
        pooled = torch.cat([mean, minimum, over_exposure], 1)
        n, _, height, width = pooled.shape
        inputs.append(torch.cat([pooled, torch.flip(pooled, (2, 3)),
                                 _position_channels(display, height, width).expand(n, 3, height, width)], 1))
    inputs[0] = torch.cat([F.pixel_unshuffle(display, SHUFFLE_FACTOR), inputs[0]], 1)
    return inputs


def _position_channels(like: Tensor, height: int, width: int) -> Tensor:
    """Return (3, height, width): x, y and x^2 + y^2 of each position from the centre, in half diagonals, so that the
    last is 1 at the corners. like: a tensor of the dtype and device to use."""
    half_diagonal = (height**2 + width**2) ** 0.5 / 2
    y = (torch.arange(height, dtype=like.dtype, device=like.device) + 0.5 - height / 2) / half_diagonal
    x = (torch.arange(width, dtype=like.dtype, device=like.device) + 0.5 - width / 2) / half_diagonal
    x, y = torch.broadcast_tensors(x[None, :], y[:, None])
    return torch.stack([x, y, x * x + y * y])


INPUT_CHANNELS = 2 * (4 + 3 + 1) + 3
"""Channels of `pyramid_inputs` that every level has: mean of RGB and exposure, minimum of RGB and maximum of the
exposure, the same rotated, and the position."""


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of each position."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions with a skip connection; the identity before training."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(width)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(self.norm(x))))


POSITION_OCTAVES = 4
"""Octaves of the positional encoding of the attention layers between blocks."""


class Attention(nn.Module):
    """Multi-head self-attention over positions with a skip connection; the identity before training.

    octaves: number of octaves of sines and cosines in the positional encoding. Without them a query can select only
    what changes slowly over the frame, and a ghost has to be located to within its width.
    """

    def __init__(self, width: int, heads: int, octaves: int = 0) -> None:
        """Make a layer for `width` channels, a multiple of `heads`."""
        super().__init__()
        self.heads, self.octaves = heads, octaves
        self.norm = ChannelNorm(width)
        # position 3, direction 2, sine and cosine of x and y for each octave
        self.pos_embed = nn.Conv2d(5 + 4 * octaves, width, 1)
        self.qkv = nn.Conv2d(width, 3 * width, 1)
        self.proj = nn.Conv2d(width, width, 1)
        nn.init.zeros_(self.proj.weight)
        nn.init.zeros_(self.proj.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Return features x (n, width, rows, columns) plus what each position gathers from all others."""
        n, width, rows, columns = x.shape
        position = _position_channels(x, rows, columns)
        encoding = [position, position[:2] / (position[2:].sqrt() + 0.1)]  # with the direction from the centre
        for octave in range(self.octaves):
            phase = position[:2] * (math.pi * 2**octave)
            encoding += [phase.sin(), phase.cos()]
        embedded = self.pos_embed(torch.cat(encoding)[None])
        qkv = self.qkv(self.norm(x) + embedded).flatten(2)
        query, key, value = qkv.reshape(n, 3, self.heads, width // self.heads, rows * columns).mT.unbind(1)
        return x + self.proj(_attend(query, key, value).mT.reshape(n, width, rows, columns))


MAX_EXPLICIT_POSITIONS = 1024
"""Positions up to which attention is written out on a CPU, where that takes a third of the time of torch's own; for
more, the weights of all pairs would not fit into memory."""


def _attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Return the scaled dot-product attention; all (n, heads, positions, channels)."""
    if query.device.type != "cpu" or query.shape[-2] > MAX_EXPLICIT_POSITIONS:
        return F.scaled_dot_product_attention(query, key, value)
    return torch.softmax(query * query.shape[-1] ** -0.5 @ key.mT, -1) @ value


class RemovalNetwork(nn.Module):
    """The U-Net.

    widths: channels of each of the LEVELS levels, from the finest; those of the coarsest two are multiples of HEADS.
    blocks: residual blocks of each level of the encoder; the decoder has one for each level.
    attention: number of attention layers between the blocks of each of the coarsest two levels, one after every second
    block; another one follows the last block.
    """

    HEADS = 4

    def __init__(self, widths: tuple[int, ...], blocks: tuple[int, ...], attention: tuple[int, ...]) -> None:
        """Build the network with random weights. widths, blocks, attention: see the class."""
        super().__init__()
        # The finest level has the frame's own pixels beside what every level has.
        input_channels = (3 * SHUFFLE_FACTOR**2 + INPUT_CHANNELS, *(INPUT_CHANNELS for _ in widths[1:]))
        self.input_convs = nn.ModuleList(nn.Conv2d(channels, width, 3, padding=1)
                                         for channels, width in zip(input_channels, widths, strict=True))
        self.down = nn.ModuleList(nn.Conv2d(finer, coarser, 2, stride=2) for finer, coarser in pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(coarser, finer, 1) for finer, coarser in pairwise(widths))
        self.encoder = nn.ModuleList(nn.Sequential(*(ResidualBlock(width) for _ in range(count)))
                                     for width, count in zip(widths, blocks, strict=True))
        self.decoder = nn.ModuleList(ResidualBlock(width) for width in widths)
        self.inner_attention = nn.ModuleList(
            nn.ModuleList(Attention(width, self.HEADS, POSITION_OCTAVES) for _ in range(count))
            for width, count in zip(widths[-2:], attention, strict=True))
        self.attention = nn.ModuleList(Attention(width, self.HEADS) for width in widths[-2:])
        # For each pixel of a position: the flare of three channels, and the share of each that is not glow.
        self.head = nn.Conv2d(widths[0], 6 * SHUFFLE_FACTOR**2, 1)
        nn.init.normal_(self.head.weight, std=1e-3)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, display: Tensor) -> NetworkOutput:
        """Predict the flare of whole frames (n, 3, h, w), display values 0..1, principal point in the centre; h and w
        multiples of SIZE_MULTIPLE."""
        features = [self.input_convs[level](part) for level, part in enumerate(pyramid_inputs(display))]
        x, skips = features[0], []
        for level in range(LEVELS):
            if level:
                skips.append(x)
                x = self.down[level - 1](x) + features[level]
            x = self._encode_level(x, level)
        for level in reversed(range(LEVELS)):
            x = self.decoder[level](x)
            if level:
                x = F.interpolate(self.up[level - 1](x), scale_factor=2, mode="nearest") + skips.pop()
        out = F.pixel_shuffle(self.head(x), SHUFFLE_FACTOR).float()
        # The share without glow is a sigmoid; the factor 4 makes its slope at 0 equal to 1.
        return NetworkOutput(out[:, :3], out[:, :3] * torch.sigmoid(out[:, 3:] * 4))

    def _encode_level(self, x: Tensor, level: int) -> Tensor:
        """Apply the encoder's residual blocks of a level, and its attention layers, to features (n, c, h, w)."""
        coarse = level - (LEVELS - 2)  # 0 and 1 on the levels with attention, below 0 on the others
        inner_layers = list(cast(nn.ModuleList, self.inner_attention[coarse])) if coarse >= 0 else []
        for index, block in enumerate(cast(nn.Sequential, self.encoder[level])):
            x = block(x)
            if index % 2 and index // 2 < len(inner_layers):
                x = inner_layers[index // 2](x)
        return cast(Tensor, self.attention[coarse](x)) if coarse >= 0 else x
