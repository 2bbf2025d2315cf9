# SPDX-License-Identifier: GPL-3.0-or-later
"""Spatial order: Morton codes, and a search for nearest neighbours that uses them.

Gaussians near each other in space belong to the same tiles. In Morton order (Morton 1966: the interleaved bits of the
three coordinates) they are near each other in memory too.
"""
from __future__ import annotations

import torch
from torch import Tensor

BITS = 20
"""Bits of a code for each axis."""
BLOCK = 128
"""Points of a block in the search for neighbours."""


def morton_codes(points: Tensor) -> Tensor:
    """Return (n,) int64 Morton codes of (n, 3) finite points, relative to their bounding box: the bits of x, y and z,
    BITS each, interleaved."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.int64, device=points.device)
    low, high = points.aminmax(dim=0)
    cells = ((points - low) / (high - low).clamp(min=1e-30) * ((1 << BITS) - 1)).to(torch.int64)
    spread = cells.clamp(0, (1 << BITS) - 1)
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
    ):  # fmt: skip
        spread = (spread | spread << shift) & mask  # in the end two zeros lie between each bit and the next
    x, y, z = spread.unbind(-1)
    return x | y << 1 | z << 2


def morton_order(points: Tensor) -> Tensor:
    """Return (n,) row numbers that put (n, 3) points in Morton order; stable, so a second application changes
    nothing."""
    return torch.argsort(morton_codes(points.detach()), stable=True)


def nearest_distances(points: Tensor, neighbours: int = 3) -> Tensor:
    """Return (n, k) distances from each of (n, 3) points to its k nearest others, ascending; exact.

    k is `neighbours`, or n - 1 for fewer points. Blocks of points along the Morton curve are compact: a block is
    compared only with blocks whose bounding box is nearer than an upper bound on the distance of the k-th neighbour.
    """
    points = points.detach()
    k = min(neighbours, len(points) - 1)
    result = points.new_zeros(len(points), max(k, 0))
    if k < 1:
        return result
    order = morton_order(points)
    starts = range(0, len(points), BLOCK)
    blocks = [points[order[start : start + BLOCK]] for start in starts]
    lows = torch.stack([block.amin(0) for block in blocks])
    highs = torch.stack([block.amax(0) for block in blocks])
    half_width = BLOCK + 2 * k
    for block_number, (start, block) in enumerate(zip(starts, blocks, strict=True)):
        candidates = points[order[max(0, start - half_width) : start + half_width]]  # at least k + 1 points
        # An upper bound on the distance of the k-th neighbour for all points of this block.
        bound = _other_distances(block, candidates, k)[:, -1].amax()
        # Along each axis, between this block's box and all boxes; 0 where they overlap.
        gaps = (lows - highs[block_number]).clamp(min=0) + (lows[block_number] - highs).clamp(min=0)
        near_blocks = torch.nonzero(torch.linalg.vector_norm(gaps, dim=-1) <= bound)[:, 0].tolist()
        distances = _other_distances(block, torch.cat([blocks[number] for number in near_blocks]), k)
        result[order[start : start + BLOCK]] = distances
    return result


def _other_distances(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Return (q, k) distances from each query (q, 3) to its k nearest points (p, 3), ascending.

    The points contain every query, at distance 0, which does not count."""
    distances = torch.cdist(queries, points, compute_mode="donot_use_mm_for_euclid_dist")
    return distances.topk(min(k + 1, len(points)), largest=False).values[:, 1:]
