# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernel set `tiles`: draws tiles in torch, with analytic gradients, on machines without a faster kernel set.

Tiles with lists of similar length are processed together, a chunk of their lists at a time, as tensors of
tiles x pixels x entries; (u, v) of `tiled.py` are matrix products of the pixels with the Gaussians.
"""
from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import threshold

from ..choices import Blend
from . import tiled
from .reference import RADIUS_MIN
from .rendering import ALPHA_MIN, OPACITY_MAX, PROFILE_MIN, TRANSMITTANCE_MIN
from .tiled import TileLists, WhitenedGaussians

TILE = 8
ENTRIES_PER_CHUNK = 128
"""Entries of a list that are evaluated at a time."""
TILES_PER_GROUP = 32
"""Tiles that are evaluated at a time; together with ENTRIES_PER_CHUNK it bounds the memory to some tensors of 1 MiB."""
MIN_TRANSMITTANCE = TRANSMITTANCE_MIN * (1 - OPACITY_MAX) / 2
"""A lower bound on the transmittance behind any entry that contributes."""


def _tile_pixels(like: Tensor) -> Tensor:
    """Return (TILE², 3) pixel centres relative to the middle of a tile, and ones: x, y, 1."""
    along = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5 - TILE / 2
    grid = torch.cartesian_prod(along, along).flip(-1)
    return torch.cat([grid, torch.ones_like(grid[:, :1])], -1)


def _tile_groups(lists: TileLists, filler: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield groups of tiles that are processed together, those with the longest lists first.

    A group is (b,), the numbers of its tiles, and (b, longest), their entries, padded with `filler`, the row of an
    invisible Gaussian. Tiles without entries are omitted."""
    lengths = lists.starts.diff()
    order = torch.argsort(lengths, descending=True, stable=True)
    num_nonempty = int((lengths > 0).sum())
    for first in range(0, num_nonempty, TILES_PER_GROUP):
        tiles = order[first : min(first + TILES_PER_GROUP, num_nonempty)]
        place = torch.arange(int(lengths[tiles[0]]), device=tiles.device)
        is_entry = place < lengths[tiles, None]  # beyond the end of a list: index 0, to be replaced
        entries = lists.entries[(lists.starts[tiles, None] + place) * is_entry]
        yield tiles, torch.where(is_entry, entries, filler)


class _Chunk:
    """A chunk of k entries of b tiles, evaluated at all pixels; tensors are (b, pixels, k) unless stated otherwise.

    u, v: whitened offsets of the pixels; g: profiles. With rings: r, the Mahalanobis distance, w, and t = (r - r0) / w.
    With arcs: a_u and a_v, coefficients of u and v."""

    def __init__(self, gaussians: WhitenedGaussians, index: Tensor, origins: Tensor, pixels: Tensor) -> None:
        """Evaluate the profiles of Gaussians at the pixels of tiles.

        index: (b, k) rows of `gaussians`. origins: (b, 2) middles of the tiles, px. pixels: (TILE², 3) of
        `_tile_pixels`.
        """
        self.gaussians, self.pixels = gaussians, pixels
        places = gaussians.places[index]
        places[..., :2] -= origins[:, None]
        # (b, k) each; centres relative to the middle of the tile
        self.cx, self.cy, self.w_xx, self.w_yx, self.w_yy = places.to(pixels.dtype).unbind(-1)
        values = gaussians.values[index]
        self.peaks, self.values = values[:, None, :, 0], values[..., 1:]  # (b, 1, k), (b, k, c)
        self.u = self._linear(self.w_xx, torch.zeros_like(self.w_xx))
        self.v = self._linear(self.w_yx, self.w_yy)
        q = (self.u * self.u).addcmul_(self.v, self.v)
        if gaussians.rings is None:
            log_g = q.mul_(-0.5)
        else:
            r0, self.w = gaussians.rings[index][:, None].unbind(-1)
            self.r = q.clamp_(min=RADIUS_MIN**2).sqrt_()
            self.t = (self.r - r0) / self.w
            log_g = self.t.square() * -0.5
        if gaussians.arcs is not None:
            self.a_u, self.a_v, m = gaussians.arcs[index][:, None].unbind(-1)
            log_g = log_g + (self.a_u * self.u + self.a_v * self.v - m)
        self.g = log_g.exp_()

    def _linear(self, along_x: Tensor, along_y: Tensor) -> Tensor:
        """Return a (x - cx) + b (y - cy) at all pixels, from (b, k) a and b."""
        offset = -(along_x * self.cx + along_y * self.cy)
        return self.pixels @ torch.stack([along_x, along_y, offset], 1)

    def backward(self, h: Tensor) -> list[Tensor]:
        """Return the gradients, (b, k) each, by centre x, y, whitening xx, yx, yy, then by r0, w and a_u, a_v, m if
        there are rings and arcs. h (b, pixels, k): the gradient by log g."""
        d_shapes = []
        scaled = h  # -2 dL/dq
        if self.gaussians.rings is not None:
            dr = h * self.t / self.w  # dL/dr0
            d_shapes += [dr.sum(1), (dr * self.t).sum(1)]
            scaled = dr / self.r
        scaled_u, scaled_v = scaled * self.u, scaled * self.v  # -dL/du, -dL/dv
        if self.gaussians.arcs is not None:
            d_shapes += [(h * self.u).sum(1), (h * self.v).sum(1), -h.sum(1)]
            scaled_u, scaled_v = scaled_u - h * self.a_u, scaled_v - h * self.a_v
        # Sums over the pixels of both times x, y and 1.
        sx_u, _, s_u = (self.pixels.T @ scaled_u).unbind(1)
        sx_v, sy_v, s_v = (self.pixels.T @ scaled_v).unbind(1)
        d_cx, d_cy = self.w_xx * s_u + self.w_yx * s_v, self.w_yy * s_v
        d_whitening = [self.cx * s_u - sx_u, self.cx * s_v - sx_v, self.cy * s_v - sy_v]
        return [d_cx, d_cy, *d_whitening, *d_shapes]


def _tile_centres(tiles: Tensor, columns: int) -> Tensor:
    """Return (b, 2) middles of the tiles, px."""
    return torch.stack([tiles % columns, tiles // columns], -1) * TILE + TILE / 2


def _append_empty(gaussians: WhitenedGaussians) -> WhitenedGaussians:
    """Append an invisible Gaussian, which pads the lists: all zeros, except r0 = w = 1, since w is a divisor."""
    return WhitenedGaussians(*(  # type: ignore[arg-type]
        None if part is None else torch.cat([part, part.new_full((1, part.shape[1]), fill)])
        for part, fill in zip(gaussians, (0.0, 0.0, 1.0, 0.0), strict=True)
    ))  # fmt: skip


class _DrawTiles(torch.autograd.Function):
    """Draws tiles; see `tiled.DrawTiles`."""

    @staticmethod
    def forward(ctx: Any, lists: TileLists, blend: Blend, median: bool, *parts: Tensor | None) -> Any:
        """Return the tiles' pictures (tiles, pixels, c) and median rows (tiles, pixels).

        The lists are blended chunk by chunk, until all pixels of a group of tiles are opaque. parts: the fields of
        `WhitenedGaussians`."""
        ctx.lists, ctx.blend = lists, blend
        gaussians = _append_empty(WhitenedGaussians(*parts))  # type: ignore[arg-type]
        n, channels = len(gaussians.values) - 1, gaussians.values.shape[1] - 1
        pixels = _tile_pixels(gaussians.values)
        picture = gaussians.values.new_zeros(lists.columns * lists.rows, TILE * TILE, channels)
        median_rows = torch.full(picture.shape[:2], -1, dtype=torch.int64, device=picture.device)
        for tiles, entries in _tile_groups(lists, n):
            total = torch.zeros_like(picture[tiles])
            t_before = torch.ones_like(total[..., :1])
            for index in entries.split(ENTRIES_PER_CHUNK, 1):
                chunk = _Chunk(gaussians, index, _tile_centres(tiles, lists.columns), pixels)
                weights, t_after = _blend_weights(chunk, blend, t_before)
                total.baddbmm_(weights, chunk.values)
                if blend == "add":
                    continue
                if median:
                    median_rows[tiles] = torch.maximum(median_rows[tiles], _median_rows(t_before, t_after, index))
                t_before = t_after[..., -1:]
                if float(t_before.max()) < TRANSMITTANCE_MIN:
                    break
            picture[tiles] = total
        ctx.save_for_backward(picture, *parts)
        ctx.mark_non_differentiable(median_rows)
        return picture, median_rows

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> Any:
        """Return the gradients by `parts` from that by the pictures, front to back; the head of `tiled` has the
        formulas.
        """
        picture, *parts = ctx.saved_tensors
        lists: TileLists = ctx.lists
        gaussians = _append_empty(WhitenedGaussians(*parts))
        # Numbers of columns of `sums`: gradients by values, places, rings and arcs.
        widths = [0 if part is None else part.shape[1] for part in (gaussians.values, *gaussians[:1], *gaussians[2:])]
        sums = gaussians.values.new_zeros(len(gaussians.values), sum(widths))
        pixels = _tile_pixels(gaussians.values)
        for tiles, entries in _tile_groups(lists, len(gaussians.values) - 1):
            upstream = gradient[tiles]
            remaining = (upstream * picture[tiles]).sum(-1, keepdim=True)  # S: the part of the sum behind the entries
            t_before = torch.ones_like(remaining)
            for index in entries.split(ENTRIES_PER_CHUNK, 1):
                chunk = _Chunk(gaussians, index, _tile_centres(tiles, lists.columns), pixels)
                weights, t_after = _blend_weights(chunk, ctx.blend, t_before)
                h = upstream @ chunk.values.transpose(1, 2)
                h *= weights
                if ctx.blend == "over":
                    remaining_behind = remaining - h.cumsum(-1)
                    # weights / t_after is alpha / (1 - alpha), or 0 if the entry did not count
                    h.addcmul_(weights / t_after.clamp(min=MIN_TRANSMITTANCE), remaining_behind, value=-1)
                    remaining, t_before = remaining_behind[..., -1:], t_after[..., -1:]
                d_peaks = h.sum(1) / chunk.peaks[:, 0].clamp(min=ALPHA_MIN)
                d_values = weights.transpose(1, 2) @ upstream
                gradients = torch.stack([d_peaks, *d_values.unbind(-1), *chunk.backward(h)], -1)
                sums.index_add_(0, index.flatten(), gradients.flatten(0, 1))
                if ctx.blend == "over" and float(t_before.max()) < TRANSMITTANCE_MIN:
                    break
        values, places, rings, arcs = sums[:-1].split(widths, 1)
        return (
            None, None, None, places.to(gaussians.places.dtype), values,
            None if gaussians.rings is None else rings, None if gaussians.arcs is None else arcs,
        )  # fmt: skip


def _blend_weights(chunk: _Chunk, blend: Blend, t_before: Tensor) -> tuple[Tensor, Tensor]:
    """Return the entries' weights (b, pixels, k) in the sum, and the transmittances (b, pixels, k) behind them.

    t_before (b, pixels, 1): transmittance in front of the chunk; with the blend "add" it is returned unchanged."""
    if blend == "add":
        return threshold(chunk.g, PROFILE_MIN, 0.0), t_before
    alpha = threshold(chunk.peaks * chunk.g, ALPHA_MIN, 0.0)
    t_after = torch.cumprod(1 - alpha, -1).mul_(t_before)
    t_in_front = torch.cat([t_before, t_after[..., :-1]], -1)
    return alpha.mul_(threshold(t_in_front, TRANSMITTANCE_MIN, 0.0)), t_after


def _median_rows(t_before: Tensor, t_after: Tensor, index: Tensor) -> Tensor:
    """Return (b, pixels), the Gaussian's row at which transmittance falls below 1/2, or -1 if it does not here.

    t_before (b, pixels, 1): transmittance in front of the chunk; t_after (b, pixels, k): behind each entry; index
    (b, k): rows of the entries."""
    limit = torch.full_like(t_before, -0.5)
    # Negated, since searchsorted needs ascending order.
    place = torch.searchsorted(t_after.neg(), limit, right=True)[..., 0]
    crosses = (place < index.shape[1]) & (t_before[..., 0] >= 0.5)
    return torch.where(crosses, index.gather(1, place.clamp(max=index.shape[1] - 1)), -1)


def draw(lists: TileLists, blend: Blend, median: bool, gaussians: WhitenedGaussians) -> tuple[Tensor, Tensor]:
    """Draw the tiles of `lists`; return their pictures and median rows, in the form of `tiled.DrawTiles`."""
    return _DrawTiles.apply(lists, blend, median, *gaussians)


rasterize_scene = partial(tiled.rasterize_scene, draw, TILE)
splat = partial(tiled.splat, draw, TILE)
