# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws tiles with NVIDIA Warp, which compiles these kernels at run time with its own compiler; for the set `cuda`.

Each pixel has a thread and each tile a block: all threads of a block read the same Gaussian at the same time. In the
backward pass a block sums each gradient over its pixels and then adds it to memory atomically. The order of these
additions is not fixed on a GPU: gradients of one picture differ by rounding from run to run.

Warp's CPU device, with one thread and blocks of one thread, runs the same kernels in tests without a GPU.
"""
# Kernels are written in Warp's language, not Python's: no static types, and no postponed annotations.
# mypy: ignore-errors
import functools
import logging
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..choices import Blend
from . import rendering
from .reference import RADIUS_MIN
from .tiled import TileLists, WhitenedGaussians

wp.config.log_level = logging.WARNING
wp.init()

TILE = 16
BLOCK = TILE * TILE
PLACES, SHAPES = 5, 5
"""Number of columns of a Gaussian's place (centre and whitening) and of its shape (ring and arc)."""

_Place = wp.types.vector(length=PLACES, dtype=wp.float32)
_Shape = wp.types.vector(length=SHAPES, dtype=wp.float32)
_ALPHA_MIN = wp.constant(rendering.ALPHA_MIN)
_PROFILE_MIN = wp.constant(rendering.PROFILE_MIN)
_TRANSMITTANCE_MIN = wp.constant(rendering.TRANSMITTANCE_MIN)
_RADIUS2_MIN = wp.constant(RADIUS_MIN**2)
_CHECK_INTERVAL = wp.constant(32)
"""Entries between two checks whether all pixels of a tile are finished."""


@wp.func
def _profile(dx: float, dy: float, place: _Place, shape: _Shape, rings: bool, arcs: bool) -> float:
    """Return the profile G of a Gaussian, ring or arc at the offset dx, dy from the centre.

    place: centre x, y and whitening xx, yx, yy; shape: r0 and w of the ring, and of the arc a_u and a_v, coefficients
    of the whitened offsets u and v, and m; rings, arcs: whether they are used."""
    u = place[2] * dx
    v = place[3] * dx + place[4] * dy
    q = u * u + v * v
    if rings:
        t = (wp.sqrt(wp.max(q, _RADIUS2_MIN)) - shape[0]) / shape[1]
        q = t * t
    log_g = -0.5 * q
    if arcs:
        log_g += shape[2] * u + shape[3] * v - shape[4]
    return wp.exp(log_g)


@functools.cache
def _kernels(channels: int) -> tuple[Any, Any]:
    """Return the forward and backward kernel for pictures with this number of channels."""
    Values = wp.types.vector(length=channels, dtype=wp.float32)
    Gradients = wp.types.vector(length=1 + channels + PLACES + SHAPES, dtype=wp.float32)
    VALUES, PLACE, SHAPE = 1, 1 + channels, 1 + channels + PLACES  # offsets in Gradients

    # Both kernels run a thread for each pixel. entries: Gaussians' rows, tile by tile. starts: offset of each tile's
    # entries. columns: tiles in a row. add: the blend is "add", else "over".
    @wp.kernel(enable_backward=False, module="unique")
    def forward(
        entries: wp.array(dtype=wp.int32), starts: wp.array(dtype=wp.int32), columns: int,
        places: wp.array(dtype=_Place), peaks: wp.array(dtype=wp.float32), values: wp.array(dtype=Values),
        shapes: wp.array(dtype=_Shape), rings: bool, arcs: bool, add: bool,
        picture: wp.array(dtype=Values), median_rows: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Draw one pixel, front to back; store its values, and the row at which transmittance falls below 1/2."""
        i = wp.tid()
        tile, pixel = i // BLOCK, i % BLOCK
        x = float((tile % columns) * TILE + pixel % TILE) + 0.5
        y = float((tile // columns) * TILE + pixel // TILE) + 0.5
        total = Values()
        transmittance = wp.float32(1.0)
        median_row = wp.int32(-1)
        for j in range(starts[tile], starts[tile + 1]):
            row = entries[j]
            place = places[row]
            shape = _Shape()
            if rings or arcs:
                shape = shapes[row]
            g = _profile(x - place[0], y - place[1], place, shape, rings, arcs)
            if add:
                if g >= _PROFILE_MIN:
                    total += g * values[row]
            else:
                alpha = peaks[row] * g
                if alpha >= _ALPHA_MIN:
                    total += alpha * transmittance * values[row]
                    if transmittance >= 0.5 and transmittance * (1.0 - alpha) < 0.5:
                        median_row = row
                    transmittance *= 1.0 - alpha
                    if transmittance < _TRANSMITTANCE_MIN:
                        break
        picture[i] = total
        median_rows[i] = median_row

    @wp.kernel(enable_backward=False, module="unique")
    def backward(
        entries: wp.array(dtype=wp.int32), starts: wp.array(dtype=wp.int32), columns: int,
        places: wp.array(dtype=_Place), peaks: wp.array(dtype=wp.float32), values: wp.array(dtype=Values),
        shapes: wp.array(dtype=_Shape), rings: bool, arcs: bool, add: bool,
        picture: wp.array(dtype=Values), upstream: wp.array(dtype=Values), sums: wp.array(dtype=Gradients),
    ):  # fmt: skip
        """Add the gradients of one pixel to each Gaussian's row of `sums`, whose columns are: peak, values, place,
        shape. upstream: gradient of the picture."""
        i = wp.tid()
        tile, pixel = i // BLOCK, i % BLOCK
        x = float((tile % columns) * TILE + pixel % TILE) + 0.5
        y = float((tile // columns) * TILE + pixel // TILE) + 0.5
        upstream_here = upstream[i]
        remaining = float(wp.dot(upstream_here, picture[i]))  # S: what lies behind contributes
        transmittance = wp.float32(1.0)
        start = starts[tile]
        # Every thread of a block runs the whole loop, since the block sums together.
        for j in range(start, starts[tile + 1]):
            if (j - start) % _CHECK_INTERVAL == _CHECK_INTERVAL - 1:
                alive = wp.where(transmittance >= _TRANSMITTANCE_MIN, 1.0, 0.0)
                if wp.tile_extract(wp.tile_sum(wp.tile(alive)), 0) == 0.0:
                    break
            row = entries[j]
            place = places[row]
            shape = _Shape()
            if rings or arcs:
                shape = shapes[row]
            dx, dy = x - place[0], y - place[1]
            g = _profile(dx, dy, place, shape, rings, arcs)
            dot = wp.dot(upstream_here, values[row])
            weight = wp.float32(0.0)
            h = wp.float32(0.0)  # dL/dlog g
            d_peak = wp.float32(0.0)
            if add:
                if g >= _PROFILE_MIN:
                    weight = g
                    h = g * dot
            else:
                alpha = peaks[row] * g
                if alpha >= _ALPHA_MIN and transmittance >= _TRANSMITTANCE_MIN:
                    weight = alpha * transmittance
                    remaining -= weight * dot
                    h = weight * dot - remaining * alpha / (1.0 - alpha)
                    d_peak = h / peaks[row]
                    transmittance *= 1.0 - alpha
            gradient_row = Gradients()
            gradient_row[0] = d_peak
            for c in range(channels):
                gradient_row[VALUES + c] = weight * upstream_here[c]
            u = place[2] * dx
            v = place[3] * dx + place[4] * dy
            scaled = float(h)  # -2 dL/dq
            if rings:
                r = wp.sqrt(wp.max(u * u + v * v, _RADIUS2_MIN))
                t = (r - shape[0]) / shape[1]
                gradient_row[SHAPE] = h * t / shape[1]
                gradient_row[SHAPE + 1] = gradient_row[SHAPE] * t
                scaled = gradient_row[SHAPE] / r
            scaled_u, scaled_v = scaled * u, scaled * v
            if arcs:
                gradient_row[SHAPE + 2] = h * u
                gradient_row[SHAPE + 3] = h * v
                gradient_row[SHAPE + 4] = -h
                scaled_u -= h * shape[2]
                scaled_v -= h * shape[3]
            gradient_row[PLACE] = place[2] * scaled_u + place[3] * scaled_v
            gradient_row[PLACE + 1] = place[4] * scaled_v
            gradient_row[PLACE + 2] = -scaled_u * dx
            gradient_row[PLACE + 3] = -scaled_v * dx
            gradient_row[PLACE + 4] = -scaled_v * dy
            wp.tile_atomic_add(sums, wp.tile_sum(wp.tile(gradient_row, preserve_type=True)), offset=(row,))

    return forward, backward


class _DrawTiles(torch.autograd.Function):
    """Draws tiles; see `tiled.DrawTiles`."""

    @staticmethod
    def forward(ctx: Any, lists: TileLists, blend: Blend, *parts: Tensor | None) -> Any:
        """Return the tiles' pictures (tiles, pixels, c) and median rows (tiles, pixels); parts: the fields of
        `WhitenedGaussians`."""
        ctx.lists, ctx.blend = lists, blend
        _, values, _, _ = parts
        assert values is not None
        channels = values.shape[1] - 1
        picture = values.new_empty(lists.rows * lists.columns, BLOCK, channels)
        median_rows = torch.empty(picture.shape[:2], dtype=torch.int32, device=picture.device)
        outputs = [_as_warp_array(picture.view(-1, channels)), _as_warp_array(median_rows.view(-1))]
        _launch(_kernels(channels)[0], lists, blend, parts, outputs)
        ctx.save_for_backward(picture, *parts)
        ctx.mark_non_differentiable(median_rows)
        return picture, median_rows

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, _: Tensor) -> Any:
        """Return the gradients by `parts` from `gradient`, that by the pictures."""
        picture, *parts = ctx.saved_tensors
        places, values, rings, arcs = parts
        channels = values.shape[1] - 1
        sums = values.new_zeros(len(values), 1 + channels + PLACES + SHAPES)
        arrays = [_as_warp_array(part.contiguous().view(-1, channels)) for part in (picture, gradient)]
        _launch(_kernels(channels)[1], ctx.lists, ctx.blend, parts, [*arrays, _as_warp_array(sums)])
        d_values, d_places, d_rings, d_arcs = sums.split([1 + channels, PLACES, 2, 3], 1)
        return (
            None, None, d_places.to(places.dtype), d_values,
            None if rings is None else d_rings, None if arcs is None else d_arcs,
        )  # fmt: skip


def _as_warp_array(tensor: Tensor) -> Any:
    """Return a Warp array of a tensor's rows, without a copy; rows may be apart, their numbers are not."""
    if tensor.ndim == 1:
        return wp.from_torch(tensor.detach(), requires_grad=False)
    kind = wp.types.vector(length=tensor.shape[1], dtype=wp.float32)
    return wp.from_torch(tensor.detach(), dtype=kind, requires_grad=False)


def _launch(kernel: Any, lists: TileLists, blend: Blend, parts: Any, other_arrays: list[Any]) -> None:
    """Launch a kernel with one thread for each pixel of each tile. parts: the fields of `WhitenedGaussians`; absent
    rings and arcs are passed as zeros. other_arrays: the kernel's last arguments, which include its outputs."""
    places, values, rings, arcs = parts
    shapes = values.new_zeros(len(values) if rings is not None or arcs is not None else 1, SHAPES)
    if rings is not None:
        shapes[:, :2] = rings
    if arcs is not None:
        shapes[:, 2:] = arcs
    device = wp.device_from_torch(values.device)
    inputs = [
        _as_warp_array(lists.entries.int()), _as_warp_array(lists.starts.int()), lists.columns,
        _as_warp_array(places.float().contiguous()), _as_warp_array(values[:, 0]), _as_warp_array(values[:, 1:]),
        _as_warp_array(shapes), rings is not None, arcs is not None,
        blend == "add", *other_arrays,
    ]  # fmt: skip
    stream = wp.stream_from_torch(values.device) if device.is_cuda else None
    wp.launch(
        kernel, dim=lists.rows * lists.columns * BLOCK, inputs=inputs, device=device, stream=stream, block_dim=BLOCK
    )


def draw(
    lists: TileLists, blend: Blend, median: bool, gaussians: WhitenedGaussians  # noqa: ARG001
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Draw the tiles of `lists`; return their pictures and median rows, in the form of `tiled.DrawTiles`."""
    return _DrawTiles.apply(lists, blend, *gaussians)
