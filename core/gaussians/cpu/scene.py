# SPDX-License-Identifier: GPL-3.0-or-later
"""`rasterize_scene` on the CPU: runs the kernels in order, as one autograd function."""
from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..rendering import Rendering
from . import buffers, ellipse, layout, projection, raster_backward, raster_forward, stepping
from .buffers import Array
from .threads import parallel
from .tiles import EMPTY, TileGrid, bin_gaussians, flat
from .vector import LANES

_BLACK, _NO_DEPTH = torch.zeros(3), torch.empty(0, 0)


@dataclass(frozen=True)
class _RasterOptions(TileGrid):
    """Inputs and results that are not differentiated; for the inputs see `rasterization`."""

    sh_degree: int
    near: float
    dilation: float
    depth: bool
    raw: bool
    projected: list[Tensor] = field(default_factory=list)
    """Centres and radii, which bypass autograd."""


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
        world_to_camera: Tensor, intrinsics: Tensor, background: Tensor, options: _RasterOptions,
        centre_gradients: Tensor,
    ) -> tuple[Tensor | None, ...]:  # fmt: skip
        """Return colour, alpha, mean depth and median depth, the last two None without depth; the inputs are those of
        `rasterization`.

        Puts centres and radii into options.projected, and zeros into centre_gradients (n, 2). colour_slopes are written
        for the backward pass alone."""
        n, w, h = len(means), options.width, options.height
        camera = np.empty(ellipse.CAMERA, np.float32)
        ellipse.pack_camera(
            flat(world_to_camera), flat(intrinsics), w, h, options.near, options.dilation, camera
        )
        records, gaussian_depths, max_tiles, first_slots, small_tiles, small_rows = buffers.empty_many(
            (n * layout.RECORD, np.float32), (n, np.float32), *[(n, np.int32)] * 4
        )
        centres, centres_flat = buffers.tensor_and_array(n, 2)
        radii, radii_flat = buffers.tensor_and_array(n)
        inputs = [flat(t) for t in (means, quats, scales, opacities)]
        blocks = -(-n // LANES) if any(ctx.needs_input_grad) else 0
        colour_slopes = buffers.empty(blocks * LANES * projection.SLOPES)
        chunk_max_tiles = np.zeros(-(-n // layout.CHUNK), np.int64)
        parallel(
            projection.project, *inputs, flat(sh), sh.shape[1] * 3,
            options.sh_degree, options.raw, camera, w, h, records, centres_flat, radii_flat, gaussian_depths,
            max_tiles, small_tiles, small_rows, first_slots, chunk_max_tiles, flat(centre_gradients), colour_slopes,
            scratch=projection.SCRATCH, limit=len(chunk_max_tiles),
        )  # fmt: skip
        keys = gaussian_depths.view(np.uint32)  # the bits of a positive number sort as the number
        bins = bin_gaussians(
            records, keys, small_tiles, small_rows, max_tiles, first_slots, chunk_max_tiles, options
        )

        image, image_flat = buffers.tensor_and_array(h, w, 3)
        alpha, alpha_flat = buffers.tensor_and_array(h, w)
        (depth, depth_flat), (median, median_flat) = (
            buffers.tensor_and_array(h, w) if options.depth else (None, EMPTY) for _ in range(2)
        )
        ends, background_flat = np.empty(options.num_tiles, np.int64), flat(background)
        parallel(
            raster_forward.raster, bins.entries, bins.starts, records, background_flat, w, h, options.tiles_x,
            image_flat, alpha_flat, depth_flat, median_flat, ends, scratch=raster_forward.STATE,
            limit=options.num_tiles,
        )  # fmt: skip
        ctx.save_for_backward(means, quats, scales, opacities, sh, image, alpha, depth)
        ctx.options, ctx.bins, ctx.centre_gradients, ctx.is_first_backward = options, bins, centre_gradients, True
        ctx.arrays = records, camera, colour_slopes, ends, background_flat, inputs, (image_flat, alpha_flat, depth_flat)
        ctx.set_materialize_grads(False)
        options.projected.extend((centres, radii))
        if median is not None:
            ctx.mark_non_differentiable(median)
        return image, alpha, depth, median

    @staticmethod
    def backward(ctx: Any, d_image: Tensor | None, d_alpha: Tensor | None, d_depth: Tensor | None, *_: Any) -> Any:
        """Return the gradients of all inputs. If Adam steps of the parameters are pending (`stepping`), make these
        steps and return None for the parameters."""
        means, quats, scales, opacities, sh, _, alpha, _ = ctx.saved_tensors  # raises if they were changed in place
        options, bins = ctx.options, ctx.bins
        records, camera, colour_slopes, ends, background_flat, inputs, pictures = ctx.arrays
        n, w, h = len(means), options.width, options.height
        v_image = buffers.zeros(h * w * 3) if d_image is None else flat(d_image)
        v_alpha = EMPTY if d_alpha is None else flat(d_alpha)
        v_depth = EMPTY if d_depth is None else flat(d_depth)
        rows = buffers.empty(bins.num_slots * layout.RECORD)
        parallel(
            raster_backward.raster_backward, bins.entries, bins.starts, ends, records, background_flat, w, h,
            options.tiles_x, *pictures, v_image, v_alpha, v_depth, rows, scratch=raster_backward.SCRATCH,
            limit=options.num_tiles,
        )  # fmt: skip
        parameters = (means, quats, scales, opacities, sh)
        steps = stepping.claim_steps(parameters)
        if steps is None:
            gradients, gradients_flat = zip(*(buffers.tensor_and_array(*t.shape) for t in parameters), strict=True)
        else:
            gradients, gradients_flat = (None,) * len(parameters), (EMPTY,) * len(parameters)
        # the first backward writes centre_gradients directly; a second one adds to them
        is_first, ctx.is_first_backward = ctx.is_first_backward, False
        d_centres = flat(ctx.centre_gradients) if is_first else buffers.empty(2 * n)
        with_camera = ctx.needs_input_grad[5] or ctx.needs_input_grad[6]
        sums = np.zeros((-(-n // layout.CHUNK) if with_camera else 0, projection.CAMERA_SUMS), np.float32)
        parallel(
            projection.project_backward, (*inputs, flat(sh) if steps else EMPTY), sh.shape[1] * 3, options.sh_degree,
            options.raw, camera, records, colour_slopes, rows, bins.first_slots, bins.slot_counts, gradients_flat,
            d_centres, sums, with_camera, *(steps or stepping.NO_STEPS),
            scratch=projection.STEP_SCRATCH if steps else projection.SCRATCH, limit=-(-n // layout.CHUNK),
        )  # fmt: skip
        if not is_first:
            flat(ctx.centre_gradients)[:] += d_centres
        d_world_to_camera, d_intrinsics = _camera_gradients(sums, camera) if with_camera else (None, None)
        d_background = None
        if ctx.needs_input_grad[7] and d_image is not None:
            d_background = (d_image * (1 - alpha)[..., None]).sum((0, 1))
        return (*gradients, d_world_to_camera, d_intrinsics, d_background, None, None)


def _camera_gradients(sums: Array, camera: Array) -> tuple[Tensor, Tensor]:
    """Return the gradients of world_to_camera (4, 4) and intrinsics (3, 3), from the sums (chunks, CAMERA_SUMS) and the
    packed camera."""
    total = sums.astype(np.float64).sum(0)
    rotation, translation = camera[:9].reshape(3, 3).astype(np.float64), camera[9:12].astype(np.float64)
    position = total[projection.POSITION_SUM : projection.POSITION_SUM + 3]  # gradient by the position, -R^T t
    d_rotation = total[:9].reshape(3, 3) - np.outer(translation, position)
    d_translation = total[9:12] - rotation @ position
    pose = np.zeros((4, 4))
    pose[:3, :3], pose[:3, 3] = d_rotation, d_translation
    fx, fy, cx, cy = total[12:16]
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 0]])
    return torch.from_numpy(pose.astype(np.float32)), torch.from_numpy(intrinsics.astype(np.float32))


def rasterize_scene(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
    *, background: Tensor | None, sh_degree: int, near: float, dilation: float, depth: bool, raw: bool,
) -> Rendering:  # fmt: skip
    """Render as `rasterization` of the package does, which explains arguments and results."""
    n = len(means)
    inputs = [_to_float32(t) for t in (means, quats, scales, opacities, sh)]
    if n < LANES:  # the kernels process 16 at a time; pad with Gaussians of opacity 0
        fill_values = [0.0, 0.0, 0.0, -math.inf if raw else 0.0, 0.0]
        inputs = [
            torch.cat([t, t.new_full((LANES - n, *t.shape[1:]), value)])
            for t, value in zip(inputs, fill_values, strict=True)
        ]
    if background is None:
        background = _BLACK
    centre_gradients, _ = buffers.tensor_and_array(len(inputs[0]), 2)
    options = _RasterOptions(width, height, sh_degree, near, dilation, depth, raw)
    image, alpha, depths, median = _Rasterize.apply(
        *inputs, _to_float32(world_to_camera), _to_float32(intrinsics), background, options, centre_gradients
    )
    if not depth:
        depths, median = _NO_DEPTH, _NO_DEPTH
    per_gaussian = (*options.projected, centre_gradients)
    if n < LANES:
        per_gaussian = tuple(t[:n] for t in per_gaussian)
    return Rendering(image, alpha, depths, median, *per_gaussian)


def _to_float32(tensor: Tensor) -> Tensor:
    return tensor if tensor.dtype == torch.float32 else tensor.to(torch.float32)
