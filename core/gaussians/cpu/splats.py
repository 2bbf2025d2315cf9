# SPDX-License-Identifier: GPL-3.0-or-later
"""`splat` on the CPU: runs the kernels of `flare` in order, as one autograd function."""
from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...choices import Blend
from ..rendering import Splats
from . import buffers, flare, layout, raster_backward, raster_forward
from .threads import parallel
from .tiles import EMPTY, TileGrid, bin_gaussians, flat

BLACK = np.zeros(3, np.float32)


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor,
        rings: Tensor | None, arcs: Tensor | None, add: bool, grid: TileGrid,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Return colour (h, w, 3) and alpha (h, w), over black; inputs as for `splat`, except arcs (n, 3): b_x, b_y, m.

        Rings, arcs and the blend "add" have kernels of their own; other Gaussians use the scene's."""
        n, h, w = len(centres), grid.height, grid.width
        has_shapes = rings is not None or arcs is not None
        inputs = [flat(t) for t in (centres, covariances, opacities, colours)]
        shape_inputs = [EMPTY if t is None else flat(t) for t in (rings, arcs)]
        records, shapes = buffers.empty(n * layout.RECORD), buffers.empty(n * flare.SHAPE)
        keys, max_tiles, first_slots = (buffers.empty(n, kind) for kind in (np.uint32, np.int32, np.int32))
        chunk_max_tiles = np.empty(-(-n // layout.CHUNK), np.int64)
        flare.prepare_records(
            *inputs, *shape_inputs, w, h, add, records, shapes, keys, max_tiles, first_slots, chunk_max_tiles
        )
        no_small_tiles = np.full(n, -1, np.int32)  # no small footprints: most flare Gaussians are large
        bins = bin_gaussians(
            records, keys, no_small_tiles, no_small_tiles, max_tiles, first_slots, chunk_max_tiles, grid
        )

        image, image_flat = buffers.tensor_and_array(h, w, 3)
        alpha, alpha_flat = buffers.tensor_and_array(h, w)
        ends = np.empty(grid.num_tiles, np.int64)
        tiles = (bins.entries, bins.starts, records)
        if has_shapes or add:
            parallel(
                flare.raster, *tiles, shapes, BLACK, w, h, grid.tiles_x, has_shapes, arcs is not None, add,
                image_flat, alpha_flat, ends, scratch=raster_forward.STATE,
            )  # fmt: skip
        else:
            parallel(
                raster_forward.raster, *tiles, BLACK, w, h, grid.tiles_x, image_flat, alpha_flat, EMPTY, EMPTY, ends,
                scratch=raster_forward.STATE,
            )  # fmt: skip
        ctx.save_for_backward(centres, covariances, opacities, colours, rings, arcs, image, alpha)
        ctx.state = (add, grid, bins, ends, records, shapes)
        ctx.set_materialize_grads(False)
        return image, alpha

    @staticmethod
    def backward(ctx: Any, d_image: Tensor | None, d_alpha: Tensor | None) -> Any:
        """Return the gradients of the inputs; None arrives for a result that was not used."""
        *inputs, image, alpha = ctx.saved_tensors
        add, grid, bins, ends, records, shapes = ctx.state
        covariances, opacities, colours, rings, arcs = inputs[1:]
        h, w = grid.height, grid.width
        v_image = buffers.zeros(h * w * 3) if d_image is None else flat(d_image)
        v_alpha = EMPTY if d_alpha is None else flat(d_alpha)
        rows = buffers.empty(bins.num_slots * layout.RECORD)
        tiles = (bins.entries, bins.starts, ends, records)
        pictures = (flat(image), flat(alpha))
        has_shapes = rings is not None or arcs is not None
        if has_shapes or add:
            parallel(
                flare.raster_backward, *tiles, shapes, BLACK, w, h, grid.tiles_x, has_shapes, arcs is not None, add,
                *pictures, v_image, v_alpha, rows, scratch=raster_backward.SCRATCH,
            )  # fmt: skip
        else:
            parallel(
                raster_backward.raster_backward, *tiles, BLACK, w, h, grid.tiles_x, *pictures, EMPTY,
                v_image, v_alpha, EMPTY, rows, scratch=raster_backward.SCRATCH,
            )  # fmt: skip
        gradients = [None if t is None else torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs]
        flare.sum_gradients(
            np.empty(layout.RECORD, np.float32), flat(covariances), flat(opacities), flat(colours),
            EMPTY if arcs is None else flat(arcs), rows, bins.first_slots, bins.slot_counts, add,
            *(EMPTY if t is None else flat(t) for t in gradients),
        )  # fmt: skip
        return (*gradients, None, None)


def splat(
    centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, width: int, height: int,
    *, rings: Tensor | None, arcs: Tensor | None, blend: Blend,
) -> Splats:  # fmt: skip
    """Rasterize as `splat` of the package does at full resolution; it explains arguments and result."""
    inputs_or_none = (centres, covariances, opacities, colours, rings, arcs)
    inputs = (None if t is None else t.to(torch.float32) for t in inputs_or_none)
    colour, alpha = _Splat.apply(*inputs, blend == "add", TileGrid(width, height))
    return Splats(colour, torch.ones_like(alpha) if blend == "add" else 1 - alpha)
