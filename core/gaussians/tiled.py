# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterization by tiles, for the kernel sets `tiles` and `cuda`, whose modules draw the tiles.

The frame is cut into tiles, each with a list of the Gaussians that reach it, front to back (`bin_tiles`). Gaussians are
whitened: with covariance = M M^T, M lower triangular, and W = M^-1, the squared Mahalanobis distance is u² + v²,
(u, v) = W d, which loses far fewer digits for needles than the quadratic form. For the same reason the geometry of a
Gaussian is computed in double precision if the device has it.

The forward pass walks through the lists, and the backward pass does so in the same order: with g_i = dL/dcolour .
values_i, transmittance T_i in front of entry i, and S_i = sum_{j > i} alpha_j T_j g_j, the remainder of the whole sum,

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
    activate,
    arc_strengths,
    cutoff_radii,
    record_gradient,
)
from .spherical_harmonics import colours as colours_of

MAX_ENTRIES = 1 << 24
"""Most entries of all lists at a time; bounds the memory."""
REACH_MARGIN = 1e-3
"""Margin of the lists beyond the last contribution, relative and absolute, so that rounding cannot lose one."""


class TileLists(NamedTuple):
    """Gaussians of each tile. entries (m,): row numbers, tile by tile, in row order; starts (tiles + 1,): offset of
    each tile; columns, rows: number of tiles; size: of a tile, px."""

    entries: Tensor
    starts: Tensor
    columns: int
    rows: int
    size: int


class WhitenedGaussians(NamedTuple):
    """2D Gaussians in whitened form. places (n, 5): centres x, y and whitening W xx, yx, yy; values (n, 1 + c): peaks,
    and the blended channels (for "add", peaks are 1 and the opacity is multiplied into the values); rings (n, 2); arcs
    (n, 3): the coefficients of u and v in b·d, and m."""

    places: Tensor
    values: Tensor
    rings: Tensor | None
    arcs: Tensor | None


DrawTiles = Callable[[TileLists, Blend, bool, WhitenedGaussians], tuple[Tensor, Tensor]]
"""draw(lists, blend, median, gaussians) returns the pictures of the tiles, (tiles, size², c), the weighted sums of the
values; and, if `median`, (tiles, size²) rows of the Gaussians at which transmittance falls below 1/2, or -1.
Differentiable by the Gaussians."""


def whitening(covariances: Tensor) -> Tensor:
    """Return (n, 3) elements xx, yx, yy of the whitening W, the inverse Cholesky factor of each covariance (n, 3)."""
    xx, xy, yy = covariances.unbind(-1)
    w_xx = xx.rsqrt()
    w_yy = (yy - xy * xy / xx).rsqrt()
    return torch.stack([w_xx, -xy / xx * w_yy, w_yy], -1)


def whiten_arcs(arcs: Tensor, whitening: Tensor) -> Tensor:
    """Return arcs (n, 3) in whitened coordinates, a_u, a_v and m, from arcs (n, 3), b and m: b·d = a_u u + a_v v with
    a = M^T b."""
    w_xx, w_yx, w_yy = whitening.unbind(-1)
    b_x, b_y, m = arcs.to(whitening.dtype).unbind(-1)
    return torch.stack([(b_x - b_y * w_yx / w_yy) / w_xx, b_y / w_yy, m], -1)


def _tile_span(
    centres: Tensor, half_size: Tensor, radii: Tensor, columns: int, rows: int, tile_size: int
) -> tuple[Tensor, Tensor]:
    """Return the first tile x, y (n, 2) that each bounding box touches, and its size in tiles (n, 2).

    centres, half_size (n, 2): of the boxes, px; radii (n,): 0 for a Gaussian that gets no tiles; columns, rows: number
    of tiles of the picture."""
    # Bounded before the conversion, since large floats overflow int64.
    low = ((centres - half_size) / tile_size).floor().clamp(min=-1, max=2**30).long().clamp(min=0)
    high = ((centres + half_size) / tile_size).floor().clamp(min=-1, max=2**30).long()
    high = torch.minimum(high, torch.tensor([columns - 1, rows - 1], device=centres.device))
    return low, (high - low + 1).clamp(min=0) * (radii > 0)[:, None]


@torch.no_grad()
def bin_tiles(
    centres: Tensor, whitening: Tensor, half_size: Tensor, radii: Tensor, width: int, height: int, tile_size: int
) -> TileLists:
    """Return for each tile the list of Gaussians whose ellipse at Mahalanobis radius `radii` (n,) touches the tile.

    centres (n, 2), whitening (n, 3): of the Gaussians; half_size (n, 2): half size of their bounding boxes, px;
    tile_size: side of a tile, px."""
    columns, rows = -(-width // tile_size), -(-height // tile_size)
    low, span = _tile_span(centres, half_size, radii, columns, rows, tile_size)
    counts = span.prod(-1)

    # Entries for all tiles of each Gaussian's bounding box, numbered row by row within the box. Entries whose tile the
    # ellipse misses are dropped below.
    entries = torch.repeat_interleave(counts)
    tile_number = torch.arange(len(entries), device=centres.device) - (counts.cumsum(0) - counts)[entries]
    box_columns = span[entries, 0]
    x, y = low[entries, 0] + tile_number % box_columns, low[entries, 1] + tile_number // box_columns
    distances = _min_squared_distance(
        centres[entries], whitening[entries], torch.stack([x, y], -1) * tile_size, tile_size
    )
    is_touched = distances <= (radii * (1 + REACH_MARGIN) + REACH_MARGIN)[entries] ** 2
    tiles, entries = (y * columns + x)[is_touched], entries[is_touched]

    order = torch.argsort(tiles, stable=True)
    starts = torch.searchsorted(tiles[order], torch.arange(columns * rows + 1, device=centres.device))
    return TileLists(entries[order], starts, columns, rows, tile_size)


def _min_squared_distance(centres: Tensor, whitening: Tensor, corners: Tensor, tile_size: int) -> Tensor:
    """Return (m,) the smallest squared Mahalanobis distance from each Gaussian's centre (m, 2) to a tile.

    It is 0 if the centre is inside the tile, else it lies on one of the two edges that face the centre. whitening
    (m, 3): of the Gaussians; corners (m, 2): upper left corner of each tile, px."""
    low = corners - centres
    high = low + tile_size
    # Offset of the tile's point nearest to the centre; its x and y are those of the two edges that face the centre.
    nearest_x, nearest_y = torch.zeros_like(low).clamp(low, high).unbind(-1)
    w_xx, w_yx, w_yy = whitening.unbind(-1)
    slope = w_yx / w_yy  # v = w_yy (dy + slope dx)

    def distance(dx: Tensor, dy: Tensor) -> Tensor:
        return (w_xx * dx) ** 2 + (w_yy * dy + w_yx * dx) ** 2

    on_vertical = distance(nearest_x, (-slope * nearest_x).clamp(low[:, 1], high[:, 1]))
    x_coefficient = w_xx**2 + w_yx**2
    on_horizontal = distance((-w_yx * w_yy * nearest_y / x_coefficient).clamp(low[:, 0], high[:, 0]), nearest_y)
    return torch.minimum(on_vertical, on_horizontal)


def draw_tiles(
    draw: DrawTiles, tile_size: int, gaussians: WhitenedGaussians, radii: Tensor, half_size: Tensor, width: int,
    height: int, *, blend: Blend, median: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Draw Gaussians by tiles; return (height, width, c), the weighted sums of their values, and (height, width), the
    row of the Gaussian at which transmittance falls below 1/2, or -1 (valid only if `median`).

    draw: draws the tiles; tile_size: side of a tile, px; radii (n,): Mahalanobis distance up to which each Gaussian is
    drawn; half_size (n, 2): half size of its bounding box, px. Large pictures are drawn in halves, to bound the
    memory."""
    centres = gaussians.places.detach()[:, :2]
    columns, rows = -(-width // tile_size), -(-height // tile_size)
    entries = int(_tile_span(centres, half_size, radii, columns, rows, tile_size)[1].prod(-1).sum())
    if entries > MAX_ENTRIES and rows > 1:  # too many at a time: the upper half of the picture, then the lower
        middle = rows // 2 * tile_size  # px, at a tile's edge
        shifted = gaussians._replace(places=gaussians.places - gaussians.places.new_tensor([0, middle, 0, 0, 0]))
        halves = [
            draw_tiles(draw, tile_size, part, radii, half_size, width, part_height, blend=blend, median=median)
            for part, part_height in ((gaussians, middle), (shifted, height - middle))
        ]
        return torch.cat([picture for picture, _ in halves]), torch.cat([median_rows for _, median_rows in halves])
    lists = bin_tiles(centres, gaussians.places.detach()[:, 2:], half_size, radii, width, height, tile_size)
    picture, median_rows = (assemble(part, lists)[:height, :width] for part in draw(lists, blend, median, gaussians))
    return picture, median_rows


def assemble(parts: Tensor, lists: TileLists) -> Tensor:
    """Assemble tiles (tiles, size², ...) to a picture (rows * size, columns * size, ...)."""
    parts = parts.reshape(lists.rows, lists.columns, lists.size, lists.size, *parts.shape[2:]).transpose(1, 2)
    return parts.reshape(lists.rows * lists.size, lists.columns * lists.size, *parts.shape[4:])


def _to_double(tensor: Tensor) -> Tensor:
    """Convert to double precision if the device has it."""
    return tensor if tensor.device.type == "mps" else tensor.double()


def rasterize_scene(
    draw: DrawTiles, tile_size: int,
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
    *, background: Tensor | None, sh_degree: int, near: float, dilation: float, depth: bool, raw: bool,
) -> Rendering:  # fmt: skip
    """Render as `rasterization` of the package does; the other arguments and the result are explained there.

    draw: draws the tiles; tile_size: side of a tile, px."""
    scales, opacities = activate(scales, opacities, raw)
    dtype = means.dtype
    projected = project(
        _to_double(means), _to_double(quats), _to_double(scales), _to_double(world_to_camera),
        _to_double(intrinsics), width, height, near, dilation,
    )  # fmt: skip
    with torch.no_grad():
        reach = cutoff_radii(opacities[projected.indices].clamp(max=OPACITY_MAX))
        visible = visible_radii(projected.centres, projected.covariances, reach, width, height)
        order = torch.argsort(projected.depths, stable=True)
        order = order[visible[order] > 0]
        all_centres = torch.zeros_like(means[:, :2]).index_copy_(0, projected.indices, projected.centres.to(dtype))
        radii = torch.zeros_like(means[:, 0]).index_copy_(0, projected.indices, visible.to(dtype))
    index, centres, covariances, depths = (part[order] for part in projected)
    depths = depths.to(dtype)
    colours = colours_of((means - camera_position(world_to_camera))[index], sh[index], sh_degree)
    values = torch.cat([colours, depths[:, None], torch.ones_like(depths)[:, None]], -1)

    gradients = record_gradient(centres, index, len(means))

    gaussians = WhitenedGaussians(
        torch.cat([centres, whitening(covariances)], -1),
        torch.cat([opacities[index].clamp(max=OPACITY_MAX)[:, None], values], -1),
        None,
        None,
    )
    reach = reach[order]
    half_size = half_sizes(covariances.detach(), reach)
    picture, rows = draw_tiles(draw, tile_size, gaussians, reach, half_size, width, height, blend="over", median=depth)
    colour, alpha, mean_depth, median_depth = split_layers(picture, background, rows if depth else None, depths)
    return Rendering(colour, alpha, mean_depth, median_depth, all_centres, radii, gradients)


def split_layers(picture: Tensor, background: Tensor | None, median_rows: Tensor | None, depths: Tensor
                 ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return colour over the background, alpha, mean depth and median depth from a rasterized picture (height, width,
    5) of colour, alpha-weighted depth and alpha.

    background: (3,), None for black. median_rows: (height, width), the row in depths (n,) of each pixel's median depth,
    -1 for none; None leaves both depths empty, (0, 0).
    """
    colour, alpha = picture[..., :3], picture[..., 4]
    if background is not None:
        colour = colour + (1 - alpha)[..., None] * background
    if median_rows is None:
        mean_depth = median_depth = picture.new_empty(0, 0)
    else:
        mean_depth = picture[..., 3] / alpha.clamp(min=ALPHA_MIN / 2)
        median_depth = torch.cat([depths, depths.new_zeros(1)]).detach()[median_rows]  # row -1 is the appended 0
    return colour, alpha, mean_depth, median_depth


def splat(
    draw: DrawTiles, tile_size: int,
    centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, width: int, height: int,
    *, rings: Tensor | None, arcs: Tensor | None, blend: Blend,
) -> Splats:  # fmt: skip
    """Rasterize as `splat` of the package does at full resolution; the other arguments and the result are explained
    there.

    draw: draws the tiles; tile_size: side of a tile, px."""
    centres, covariances = _to_double(centres), _to_double(covariances)
    index = torch.nonzero(determinants(covariances) > 0)[:, 0]  # a degenerate ellipse covers nothing
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
        reach = cutoff_radii(peaks, blend, rings, None if arcs is None else arc_strengths(covariances, arcs))
    values = torch.cat([peaks[:, None], colours, torch.ones_like(colours[:, :1])], -1)
    whitening_factors = whitening(covariances)
    if arcs is not None:
        arcs = whiten_arcs(arcs, whitening_factors).to(values.dtype)
    gaussians = WhitenedGaussians(torch.cat([centres, whitening_factors], -1), values, rings, arcs)
    half_size = half_sizes(covariances.detach(), reach)
    picture, _ = draw_tiles(draw, tile_size, gaussians, reach, half_size, width, height, blend=blend)
    alpha = picture[..., 3]
    return Splats(picture[..., :3], 1 - alpha if blend == "over" else torch.ones_like(alpha))
