# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterization by tiles: all but the drawing of a tile, which `tiles.py` and `warp_kernels.py` have.

The frame is cut into tiles; each has the list of the Gaussians that reach it, front to back (`bin_tiles`). A
Gaussian enters whitened: with covariance = M M^T, M lower triangular, and W = M^-1, the squared Mahalanobis
distance is u² + v², (u, v) = W d, which loses far fewer digits on needles than the quadratic form. Geometry per
Gaussian is in double precision where there is any, for the same reason.

A drawing goes through the lists. Its gradient does so in the same order: with g_i = dL/dcolour . values_i,
transmittance T_i before entry i, and S_i = sum_{j > i} alpha_j T_j g_j, what is left of the whole sum,

    dL/dalpha_i = T_i g_i - S_i / (1 - alpha_i)
"""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..choices import Blend
from .projection import camera_position, determinants, half_sizes, project, visible_radii
from .rendering import (
    ALPHA_MIN,
    OPACITY_MAX,
    Rendering,
    Splats,
    activated,
    arc_strengths,
    extent,
    record_gradient,
)
from .spherical_harmonics import colours as colours_of

ENTRIES_MAX = 1 << 24
"""Entries of all lists at a time; what bounds the memory that they take."""
MARGIN = 1e-3
"""By how much lists reach further than the last contribution, so that rounding cannot lose one."""


class Lists(NamedTuple):
    """Gaussians of each tile. entries (m,) row numbers, tile by tile, in row order; starts (tiles + 1,) where
    each tile's begin; columns and rows: of tiles; size: of a tile, px."""

    entries: Tensor
    starts: Tensor
    columns: int
    rows: int
    size: int


class Gaussians(NamedTuple):
    """What is drawn. places (n, 5): centres x, y and whitening W xx, yx, yy; values (n, 1 + c): peaks, and what
    is blended (where light adds, peaks are 1 and opacity is in the values); rings; arcs (n, 3) whitened: what b·d is
    of u and of v, and m."""

    places: Tensor
    values: Tensor
    rings: Tensor | None
    arcs: Tensor | None


Draw = Callable[[Lists, Blend, bool, Gaussians], tuple[Tensor, Tensor]]
"""draw(lists, blend, median, gaussians): the pictures of the tiles, (tiles, size², c), sums of the values by their
weights; and the row of the Gaussian at which transmittance falls below 1/2, or -1, (tiles, size²), if `median`.
Differentiable by the Gaussians."""


def whitening(covariances: Tensor) -> Tensor:
    """(n, 3) elements xx, yx, yy of the inverse Cholesky factors of (n, 3) covariances."""
    xx, xy, yy = covariances.unbind(-1)
    w_xx = xx.rsqrt()
    w_yy = (yy - xy * xy / xx).rsqrt()
    return torch.stack([w_xx, -xy / xx * w_yy, w_yy], -1)


def whitened_arcs(arcs: Tensor, whitening: Tensor) -> Tensor:
    """(n, 3) a_u, a_v and m from b and m, with b·d = a_u u + a_v v: a = M^T b."""
    w_xx, w_yx, w_yy = whitening.unbind(-1)
    b_x, b_y, m = arcs.to(whitening.dtype).unbind(-1)
    return torch.stack([(b_x - b_y * w_yx / w_yy) / w_xx, b_y / w_yy, m], -1)


def _span(centres: Tensor, half: Tensor, radii: Tensor, columns: int, rows: int, size: int) -> tuple[Tensor, Tensor]:
    """First tile x, y (n, 2) of the boxes of half size `half` (n, 2) px, and how many they span (n, 2)."""
    low = ((centres - half) / size).floor().clamp(min=-1, max=2**30).long().clamp(min=0)
    high = ((centres + half) / size).floor().clamp(min=-1, max=2**30).long()
    high = torch.minimum(high, torch.tensor([columns - 1, rows - 1], device=centres.device))
    return low, (high - low + 1).clamp(min=0) * (radii > 0)[:, None]


@torch.no_grad()
def bin_tiles(
    centres: Tensor, whitening: Tensor, half: Tensor, radii: Tensor, width: int, height: int, size: int
) -> Lists:
    """Lists of the tiles that the ellipses of Mahalanobis radius `radii` (n,), inside boxes of half size
    `half` (n, 2) px, touch."""
    columns, rows = -(-width // size), -(-height // size)
    low, span = _span(centres, half, radii, columns, rows, size)
    counts = span.prod(-1)

    # One entry for each tile of each box, then without those that the ellipse inside the box misses.
    entries = torch.repeat_interleave(counts)
    number = torch.arange(len(entries), device=centres.device) - (counts.cumsum(0) - counts)[entries]
    across = span[entries, 0]
    x, y = low[entries, 0] + number % across, low[entries, 1] + number // across
    near = _nearest(centres[entries], whitening[entries], torch.stack([x, y], -1) * size, size)
    hit = near <= (radii * (1 + MARGIN) + MARGIN)[entries] ** 2
    tiles, entries = (y * columns + x)[hit], entries[hit]

    order = torch.argsort(tiles, stable=True)
    starts = torch.searchsorted(tiles[order], torch.arange(columns * rows + 1, device=centres.device))
    return Lists(entries[order], starts, columns, rows, size)


def _nearest(centres: Tensor, whitening: Tensor, corners: Tensor, size: int) -> Tensor:
    """(m,) least squared Mahalanobis distance to tiles with these upper left corners: at the centre if that
    is inside, else on one of the two edges that face it."""
    low = corners - centres
    high = low + size
    bx, by = torch.zeros_like(low).clamp(low, high).unbind(-1)
    w_xx, w_yx, w_yy = whitening.unbind(-1)
    slope = w_yx / w_yy  # v = w_yy (dy + slope dx)

    def distance(dx: Tensor, dy: Tensor) -> Tensor:
        return (w_xx * dx) ** 2 + (w_yy * dy + w_yx * dx) ** 2

    on_vertical = distance(bx, (-slope * bx).clamp(low[:, 1], high[:, 1]))
    a = w_xx**2 + w_yx**2
    on_horizontal = distance((-w_yx * w_yy * by / a).clamp(low[:, 0], high[:, 0]), by)
    return torch.minimum(on_vertical, on_horizontal)


def draw_tiles(
    draw: Draw, size: int, drawn: Gaussians, radii: Tensor, half: Tensor, width: int, height: int,
    *, blend: Blend, median: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """(height, width, c) sums of the values, by their weights, and (height, width) rows, see `Draw`.

    radii (n,): Mahalanobis distance up to which each Gaussian is drawn; half (n, 2): of the box around it, px;
    size: of a tile, px."""
    centres = drawn.places.detach()[:, :2]
    columns, rows = -(-width // size), -(-height // size)
    entries = int(_span(centres, half, radii, columns, rows, size)[1].prod(-1).sum())
    if entries > ENTRIES_MAX and rows > 1:  # too many for one go: the upper half of the picture, then the lower
        middle = rows // 2 * size
        down = drawn.places.new_tensor([0, middle, 0, 0, 0])
        halves = [
            draw_tiles(draw, size, part, radii, half, width, part_height, blend=blend, median=median)
            for part, part_height in ((drawn, middle), (drawn._replace(places=drawn.places - down), height - middle))
        ]
        return torch.cat([picture for picture, _ in halves]), torch.cat([which for _, which in halves])
    lists = bin_tiles(centres, drawn.places.detach()[:, 2:], half, radii, width, height, size)
    picture, which = (_assembled(part, lists)[:height, :width] for part in draw(lists, blend, median, drawn))
    return picture, which


def _assembled(parts: Tensor, lists: Lists) -> Tensor:
    """(rows * size, columns * size, ...) from (tiles, size², ...)."""
    parts = parts.reshape(lists.rows, lists.columns, lists.size, lists.size, *parts.shape[2:]).transpose(1, 2)
    return parts.reshape(lists.rows * lists.size, lists.columns * lists.size, *parts.shape[4:])


def _geometry(tensor: Tensor) -> Tensor:
    """In double precision, where the device has it."""
    return tensor if tensor.device.type == "mps" else tensor.double()


def rasterize_scene(
    draw: Draw, size: int,
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
    *, background: Tensor | None, sh_degree: int, near: float, dilation: float, depth: bool, raw: bool,
) -> Rendering:  # fmt: skip
    """See `rasterization`; with this drawing, in tiles of this size."""
    scales, opacities = activated(scales, opacities, raw)
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

    drawn = Gaussians(
        torch.cat([centres, whitening(covariances)], -1),
        torch.cat([opacities[index].clamp(max=OPACITY_MAX)[:, None], values], -1),
        None,
        None,
    )
    reach = reach[order]
    half = half_sizes(covariances.detach(), reach)
    picture, rows = draw_tiles(draw, size, drawn, reach, half, width, height, blend="over", median=depth)
    alpha = picture[..., 4]
    colour = picture[..., :3]
    if background is not None:
        colour = colour + (1 - alpha)[..., None] * background
    if depth:
        mean_depth = picture[..., 3] / alpha.clamp(min=ALPHA_MIN / 2)
        median_depth = torch.cat([depths, depths.new_zeros(1)]).detach()[rows]
    else:
        mean_depth = median_depth = means.new_empty(0, 0)
    return Rendering(colour, alpha, mean_depth, median_depth, all_centres, radii, gradients)


def splat(
    draw: Draw, size: int,
    centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, width: int, height: int,
    *, rings: Tensor | None, arcs: Tensor | None, blend: Blend,
) -> Splats:  # fmt: skip
    """See `splat` of the package; at full resolution, with this drawing, in tiles of this size."""
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
        reach = extent(peaks, blend, rings, None if arcs is None else arc_strengths(covariances, arcs))
    values = torch.cat([peaks[:, None], colours, torch.ones_like(colours[:, :1])], -1)
    white = whitening(covariances)
    if arcs is not None:
        arcs = whitened_arcs(arcs, white).to(values.dtype)
    drawn = Gaussians(torch.cat([centres, white], -1), values, rings, arcs)
    half = half_sizes(covariances.detach(), reach)
    picture, _ = draw_tiles(draw, size, drawn, reach, half, width, height, blend=blend)
    alpha = picture[..., 3]
    return Splats(picture[..., :3], 1 - alpha if blend == "over" else torch.ones_like(alpha))
