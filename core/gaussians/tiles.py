# SPDX-License-Identifier: GPL-3.0-or-later
"""The picture of `reference.py` in torch, tile by tile, with analytic gradients: for machines without a
faster kernel set.

The frame is cut into tiles; each has the list of the Gaussians that reach it, front to back (`bin_tiles`).
Tiles whose lists are about as long are worked on together, a chunk of their lists at a time, as tensors of
tiles x pixels x entries. A Gaussian enters whitened: with covariance = M M^T, M lower triangular, and
W = M^-1, the squared Mahalanobis distance is u² + v², (u, v) = W d, which loses far fewer digits on needles
than the quadratic form; u and v are matrix products of the pixels with the Gaussians. Geometry per Gaussian
is in double precision where there is any, for the same reason.

Backward goes through the lists in the same order. With g_i = dL/dcolour . values_i, transmittance T_i before
entry i and S_i = sum_{j > i} alpha_j T_j g_j, which is what is left of the whole sum:

    dL/dalpha_i = T_i g_i - S_i / (1 - alpha_i)
"""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, threshold

from .projection import camera_position, determinants, half_sizes, project, visible_radii
from .reference import RADIUS_MIN
from .rendering import (
    ALPHA_MIN,
    ARC_APEX,
    OPACITY_MAX,
    PROFILE_MIN,
    TRANSMITTANCE_MIN,
    Rendering,
    Splats,
    extent,
    record_gradient,
)
from .spherical_harmonics import colours as colours_of

TILE = 8
CHUNK = 128
"""Entries of a list at a time."""
GROUP = 32
"""Tiles at a time; with the above, what bounds the memory: half a dozen tensors of 1 MiB."""
AFTER_MIN = TRANSMITTANCE_MIN * (1 - OPACITY_MAX) / 2
"""Below the transmittance behind anything that counts."""
MARGIN = 1e-3
"""By how much lists reach further than the last contribution, so that rounding cannot lose one."""


class Lists(NamedTuple):
    """Gaussians of each tile. entries (m,) row numbers, tile by tile, in row order; starts (tiles + 1,) where
    each tile's begin; columns and rows: of tiles."""

    entries: Tensor
    starts: Tensor
    columns: int
    rows: int


class Gaussians(NamedTuple):
    """What is drawn. places (n, 5): centres x, y and whitening W xx, yx, yy; values (n, 1 + c): peaks, and what
    is blended (where light adds, peaks are 1 and opacity is in the values); rings; arcs."""

    places: Tensor
    values: Tensor
    rings: Tensor | None
    arcs: Tensor | None


def whitening(covariances: Tensor) -> Tensor:
    """(n, 3) elements xx, yx, yy of the inverse Cholesky factors of (n, 3) covariances."""
    xx, xy, yy = covariances.unbind(-1)
    w_xx = xx.rsqrt()
    w_yy = (yy - xy * xy / xx).rsqrt()
    return torch.stack([w_xx, -xy / xx * w_yy, w_yy], -1)


@torch.no_grad()
def bin_tiles(centres: Tensor, whitening: Tensor, half: Tensor, radii: Tensor, width: int, height: int) -> Lists:
    """Lists of the tiles that the ellipses of Mahalanobis radius `radii` (n,), inside boxes of half size
    `half` (n, 2) px, touch."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    grid = torch.tensor([columns, rows], device=centres.device)
    low = ((centres - half) / TILE).floor().clamp(min=-1, max=2**30).long().clamp(min=0)
    high = ((centres + half) / TILE).floor().clamp(min=-1, max=2**30).long()
    high = torch.minimum(high, grid - 1)
    span = (high - low + 1).clamp(min=0) * (radii > 0)[:, None]
    counts = span.prod(-1)

    # One entry for each tile of each box, then without those that the ellipse inside the box misses.
    entries = torch.repeat_interleave(counts)
    number = torch.arange(len(entries), device=centres.device) - (counts.cumsum(0) - counts)[entries]
    across = span[entries, 0]
    x, y = low[entries, 0] + number % across, low[entries, 1] + number // across
    near = _nearest(centres[entries], whitening[entries], torch.stack([x, y], -1) * TILE)
    hit = near <= (radii * (1 + MARGIN) + MARGIN)[entries] ** 2
    tiles, entries = (y * columns + x)[hit], entries[hit]

    order = torch.argsort(tiles, stable=True)
    starts = torch.searchsorted(tiles[order], torch.arange(columns * rows + 1, device=centres.device))
    return Lists(entries[order], starts, columns, rows)


def _nearest(centres: Tensor, whitening: Tensor, corners: Tensor) -> Tensor:
    """(m,) least squared Mahalanobis distance to tiles with these upper left corners: at the centre if that
    is inside, else on one of the two edges that face it."""
    low = corners - centres
    high = low + TILE
    bx, by = torch.zeros_like(low).clamp(low, high).unbind(-1)
    w_xx, w_yx, w_yy = whitening.unbind(-1)
    slope = w_yx / w_yy  # v = w_yy (dy + slope dx)

    def distance(dx: Tensor, dy: Tensor) -> Tensor:
        return (w_xx * dx) ** 2 + (w_yy * dy + w_yx * dx) ** 2

    on_vertical = distance(bx, (-slope * bx).clamp(low[:, 1], high[:, 1]))
    a = w_xx**2 + w_yx**2
    on_horizontal = distance((-w_yx * w_yy * by / a).clamp(low[:, 0], high[:, 0]), by)
    return torch.minimum(on_vertical, on_horizontal)


def _pixels(like: Tensor) -> Tensor:
    """(TILE², 3) pixel centres of a tile from its middle, and ones: x, y, 1."""
    along = torch.arange(TILE, dtype=like.dtype, device=like.device) + 0.5 - TILE / 2
    grid = torch.cartesian_prod(along, along).flip(-1)
    return torch.cat([grid, torch.ones_like(grid[:, :1])], -1)


def _groups(lists: Lists, filler: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Tiles that are worked on together: (b,) tile numbers and their (b, longest) entries, `filler` where a
    list is shorter."""
    lengths = lists.starts.diff()
    order = torch.argsort(lengths, descending=True, stable=True)
    busy = int((lengths > 0).sum())
    for first in range(0, busy, GROUP):
        tiles = order[first : min(first + GROUP, busy)]
        place = torch.arange(int(lengths[tiles[0]]), device=tiles.device)
        inside = place < lengths[tiles, None]
        entries = lists.entries[(lists.starts[tiles, None] + place) * inside]
        yield tiles, torch.where(inside, entries, filler)


class _Chunk:
    """Some entries of some tiles, evaluated: tensors are (b, pixels, k) unless said otherwise."""

    def __init__(self, drawn: Gaussians, index: Tensor, origins: Tensor, pixels: Tensor) -> None:
        """index (b, k) rows of `drawn`; origins (b, 2) middles of the tiles, px; pixels as `_pixels`."""
        self.drawn, self.pixels = drawn, pixels
        places = drawn.places[index]
        places[..., :2] -= origins[:, None]
        # (b, k), from the middle of the tile
        self.cx, self.cy, self.w_xx, self.w_yx, self.w_yy = places.to(pixels.dtype).unbind(-1)
        values = drawn.values[index]
        self.peaks, self.values = values[:, None, :, 0], values[..., 1:]  # (b, 1, k), (b, k, c)
        zero, one = torch.zeros_like(self.cx), torch.ones_like(self.cx)
        self.u = self._linear(self.w_xx, zero)
        self.v = self._linear(self.w_yx, self.w_yy)
        q = (self.u * self.u).addcmul_(self.v, self.v)
        if drawn.rings is None:
            log_g = q.mul_(-0.5)
        else:
            r0, self.w = drawn.rings[index][:, None].unbind(-1)
            self.r = q.clamp_(min=RADIUS_MIN**2).sqrt_()
            self.t = (self.r - r0) / self.w
            log_g = self.t.square() * -0.5
        if drawn.arcs is not None:
            theta0, self.cos_delta, self.k = drawn.arcs[index][:, None].unbind(-1)
            self.cos, self.sin = theta0.cos(), theta0.sin()
            self.dx, self.dy = self._linear(one, zero), self._linear(zero, one)
            self.per_distance = (self.dx * self.dx + self.dy * self.dy + ARC_APEX**2).rsqrt()
            self.cosine = (self.dx * self.cos + self.dy * self.sin) * self.per_distance
            self.angle = self.k * (self.cosine - self.cos_delta)
            log_g = log_g + logsigmoid(self.angle)
        self.g = log_g.exp_()

    def _linear(self, along_x: Tensor, along_y: Tensor) -> Tensor:
        """a (x - cx) + b (y - cy) at all pixels, from (b, k) a and b."""
        offset = -(along_x * self.cx + along_y * self.cy)
        return self.pixels @ torch.stack([along_x, along_y, offset], 1)

    def backward(self, h: Tensor) -> list[Tensor]:
        """From h = dL/dlog g, the gradients (b, k): five of the places, then those of the ring and the arc."""
        extras = []
        pull = h  # -2 dL/dq
        if self.drawn.rings is not None:
            dr = h * self.t / self.w  # dL/dr0
            extras += [dr.sum(1), (dr * self.t).sum(1)]
            pull = dr / self.r
        # Sums over the pixels of -dL/du and -dL/dv times x, y, 1.
        sx_u, _, s_u = (self.pixels.T @ (pull * self.u)).unbind(1)
        sx_v, sy_v, s_v = (self.pixels.T @ (pull * self.v)).unbind(1)
        d_cx, d_cy = self.w_xx * s_u + self.w_yx * s_v, self.w_yy * s_v
        d_whitening = [self.cx * s_u - sx_u, self.cx * s_v - sx_v, self.cy * s_v - sy_v]
        if self.drawn.arcs is not None:
            d_angle = h * torch.sigmoid(-self.angle)
            d_cosine = d_angle * self.k * self.per_distance
            extras += [
                (d_cosine * (self.dy * self.cos - self.dx * self.sin)).sum(1),
                -(d_angle * self.k).sum(1),
                (d_angle * (self.cosine - self.cos_delta)).sum(1),
            ]
            radial = self.cosine * self.per_distance
            d_cx = d_cx - (d_cosine * (self.cos - radial * self.dx)).sum(1)
            d_cy = d_cy - (d_cosine * (self.sin - radial * self.dy)).sum(1)
        return [d_cx, d_cy, *d_whitening, *extras]


def _origins(tiles: Tensor, columns: int) -> Tensor:
    """(b, 2) middles of the tiles, px."""
    return torch.stack([tiles % columns, tiles // columns], -1) * TILE + TILE / 2


def _with_nothing(drawn: Gaussians) -> Gaussians:
    """One row more, of a Gaussian that shows nothing, which fills up lists."""
    return Gaussians(*(  # type: ignore[arg-type]
        None if part is None else torch.cat([part, part.new_full((1, part.shape[1]), fill)])
        for part, fill in zip(drawn, (0.0, 0.0, 1.0, 0.0), strict=True)
    ))  # fmt: skip


class _Draw(torch.autograd.Function):
    """Pictures of tiles, (tiles, TILE², c), sums of the values by their weights; and the row of `drawn` at
    which transmittance falls below 1/2, or -1, (tiles, TILE²), if `median`."""

    @staticmethod
    def forward(ctx: Any, lists: Lists, blend: str, median: bool, *parts: Tensor | None) -> Any:
        ctx.lists, ctx.blend = lists, blend
        drawn = _with_nothing(Gaussians(*parts))  # type: ignore[arg-type]
        n, channels = len(drawn.values) - 1, drawn.values.shape[1] - 1
        pixels = _pixels(drawn.values)
        picture = drawn.values.new_zeros(lists.columns * lists.rows, TILE * TILE, channels)
        halves = torch.full(picture.shape[:2], -1, dtype=torch.int64, device=picture.device)
        for tiles, entries in _groups(lists, n):
            total = torch.zeros_like(picture[tiles])
            before = torch.ones_like(total[..., :1])
            for index in entries.split(CHUNK, 1):
                chunk = _Chunk(drawn, index, _origins(tiles, lists.columns), pixels)
                weights, after = _weigh(chunk, blend, before)
                total.baddbmm_(weights, chunk.values)
                if blend == "add":
                    continue
                if median:
                    halves[tiles] = torch.maximum(halves[tiles], _half_lost(before, after, index))
                before = after[..., -1:]
                if float(before.max()) < TRANSMITTANCE_MIN:
                    break
            picture[tiles] = total
        ctx.save_for_backward(picture, *parts)
        ctx.mark_non_differentiable(halves)
        return picture, halves

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> Any:
        picture, *parts = ctx.saved_tensors
        lists: Lists = ctx.lists
        drawn = _with_nothing(Gaussians(*parts))
        columns = [0 if part is None else part.shape[1] for part in (drawn.values, *drawn[:1], *drawn[2:])]
        sums = drawn.values.new_zeros(len(drawn.values), sum(columns))
        pixels = _pixels(drawn.values)
        for tiles, entries in _groups(lists, len(drawn.values) - 1):
            upstream = gradient[tiles]
            left = (upstream * picture[tiles]).sum(-1, keepdim=True)  # of the sum, behind the entry
            before = torch.ones_like(left)
            for index in entries.split(CHUNK, 1):
                chunk = _Chunk(drawn, index, _origins(tiles, lists.columns), pixels)
                weights, after = _weigh(chunk, ctx.blend, before)
                h = upstream @ chunk.values.transpose(1, 2)
                h *= weights
                if ctx.blend == "over":
                    behind = left - h.cumsum(-1)
                    # alpha / (1 - alpha), or 0 if the entry did not count
                    h.addcmul_(weights / after.clamp(min=AFTER_MIN), behind, value=-1)
                    left, before = behind[..., -1:], after[..., -1:]
                d_peaks = h.sum(1) / chunk.peaks[:, 0].clamp(min=ALPHA_MIN)
                d_values = weights.transpose(1, 2) @ upstream
                found = torch.stack([d_peaks, *d_values.unbind(-1), *chunk.backward(h)], -1)
                sums.index_add_(0, index.flatten(), found.flatten(0, 1))
                if ctx.blend == "over" and float(before.max()) < TRANSMITTANCE_MIN:
                    break
        values, places, rings, arcs = sums[:-1].split(columns, 1)
        return (
            None, None, None, places.to(drawn.places.dtype), values,
            None if drawn.rings is None else rings, None if drawn.arcs is None else arcs,
        )  # fmt: skip


def _weigh(chunk: _Chunk, blend: str, before: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (b, pixels, k) of the entries, and the transmittances after them, from those before the chunk
    (b, pixels, 1)."""
    if blend == "add":
        return threshold(chunk.g, PROFILE_MIN, 0.0), before
    alpha = threshold(chunk.peaks * chunk.g, ALPHA_MIN, 0.0)
    after = torch.cumprod(1 - alpha, -1).mul_(before)
    reaching = torch.cat([before, after[..., :-1]], -1)
    return alpha.mul_(threshold(reaching, TRANSMITTANCE_MIN, 0.0)), after


def _half_lost(before: Tensor, after: Tensor, index: Tensor) -> Tensor:
    """(b, pixels) the row whose contribution takes the transmittance below 1/2, -1 where none of `index` does."""
    limit = torch.full_like(before, -0.5)
    place = torch.searchsorted(after.neg(), limit, right=True)[..., 0]  # in ascending order, as it must be
    crosses = (place < index.shape[1]) & (before[..., 0] >= 0.5)
    return torch.where(crosses, index.gather(1, place.clamp(max=index.shape[1] - 1)), -1)


def _draw(
    centres: Tensor, covariances: Tensor, radii: Tensor, peaks: Tensor, values: Tensor, width: int, height: int,
    *, blend: str, median: bool = False, rings: Tensor | None = None, arcs: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """(height, width, c) sums of the values (n, c), weighted; and (height, width) rows, see `_Draw`."""
    white = whitening(covariances)
    lists = bin_tiles(centres, white, half_sizes(covariances, radii), radii, width, height)
    places = torch.cat([centres, white], -1)
    picture, halves = _Draw.apply(
        lists, blend, median, places, torch.cat([peaks[:, None], values], -1), rings, arcs
    )
    shape = (lists.rows, lists.columns, TILE, TILE)
    picture = picture.reshape(*shape, -1).transpose(1, 2).reshape(lists.rows * TILE, lists.columns * TILE, -1)
    halves = halves.reshape(shape).transpose(1, 2).reshape(lists.rows * TILE, lists.columns * TILE)
    return picture[:height, :width], halves[:height, :width]


def _geometry(tensor: Tensor) -> Tensor:
    """In double precision, where the device has it."""
    return tensor if tensor.device.type == "mps" else tensor.double()


def rasterize_scene(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
    *, background: Tensor | None, sh_degree: int, near: float, dilation: float,
) -> Rendering:  # fmt: skip
    """See `rasterization`."""
    dtype = means.dtype
    seen = project(
        _geometry(means), _geometry(quats), _geometry(scales), _geometry(world_to_camera),
        _geometry(intrinsics), width, height, near, dilation,
    )  # fmt: skip
    with torch.no_grad():
        reach = extent(opacities[seen.indices].clamp(max=OPACITY_MAX))
        visible = visible_radii(seen.centres, seen.covariances, reach, width, height)
        order = torch.argsort(seen.depths, stable=True)
        order = order[visible[order] > 0]
        all_centres = torch.zeros_like(means[:, :2]).index_copy_(0, seen.indices, seen.centres.to(dtype))
        radii = torch.zeros_like(means[:, 0]).index_copy_(0, seen.indices, visible.to(dtype))
    index, centres, covariances, depths = (part[order] for part in seen)
    depths = depths.to(dtype)
    colours = colours_of((means - camera_position(world_to_camera))[index], sh[index], sh_degree)
    values = torch.cat([colours, depths[:, None], torch.ones_like(depths)[:, None]], -1)

    gradients = record_gradient(centres, index, len(means))

    peaks = opacities[index].clamp(max=OPACITY_MAX)
    picture, halves = _draw(
        centres, covariances, reach[order], peaks, values, width, height, blend="over", median=True
    )
    alpha = picture[..., 4]
    colour = picture[..., :3]
    if background is not None:
        colour = colour + (1 - alpha)[..., None] * background
    depth = picture[..., 3] / alpha.clamp(min=ALPHA_MIN / 2)
    median_depth = torch.cat([depths, depths.new_zeros(1)]).detach()[halves]
    return Rendering(colour, alpha, depth, median_depth, all_centres, radii, gradients)


def splat(
    centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, width: int, height: int,
    *, rings: Tensor | None, arcs: Tensor | None, blend: str,
) -> Splats:  # fmt: skip
    """See `splat` of the package; full resolution."""
    centres, covariances = _geometry(centres), _geometry(covariances)
    index = torch.nonzero(determinants(covariances) > 0)[:, 0]
    centres, covariances, opacities, colours = (
        part[index] for part in (centres, covariances, opacities, colours)
    )
    rings, arcs = (None if part is None else part[index] for part in (rings, arcs))
    if blend == "over":
        peaks = opacities.clamp(max=OPACITY_MAX)
    else:
        peaks = torch.ones_like(opacities)
        colours = opacities[:, None] * colours
    with torch.no_grad():
        reach = extent(peaks, blend, rings)
    values = torch.cat([colours, torch.ones_like(colours[:, :1])], -1)
    picture, _ = _draw(
        centres, covariances, reach, peaks, values, width, height, blend=blend, rings=rings, arcs=arcs
    )
    alpha = picture[..., 3]
    return Splats(picture[..., :3], 1 - alpha if blend == "over" else torch.ones_like(alpha))
