# SPDX-License-Identifier: GPL-3.0-or-later
"""`rasterize_scene` on the CPU: the kernels in their order, as one function of autograd."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..projection import FRUSTUM_MARGIN
from ..rendering import Rendering
from . import buffers, layout, projection, raster_backward, raster_forward
from .buffers import Array
from .threads import parallel
from .tiles import EMPTY, Grid, bin_gaussians, flat
from .vector import LANES


@dataclass(frozen=True)
class _Frame(Grid):
    """What is not differentiated."""

    sh_degree: int
    near: float
    dilation: float
    depth: bool


def camera_numbers(world_to_camera: Tensor, intrinsics: Tensor, frame: _Frame) -> Array:
    """The camera as `projection` wants it."""
    matrix, k = world_to_camera.detach().double().numpy(), intrinsics.detach().double().numpy()
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    focal, principal, size = k.diagonal()[:2], k[:2, 2], np.array([frame.width, frame.height])
    margin = FRUSTUM_MARGIN * size / (2 * focal)
    low, high = -principal / focal - margin, (size - principal) / focal + margin
    return np.concatenate(
        [
            rotation.reshape(-1), translation, focal, principal, [low[0], high[0], low[1], high[1]],
            -rotation.T @ translation, [frame.near, frame.dilation],
        ]
    ).astype(np.float32)  # fmt: skip


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
        world_to_camera: Tensor, intrinsics: Tensor, background: Tensor, frame: _Frame, centre_gradients: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        n = len(means)
        inputs = [flat(t) for t in (means, quats, scales, opacities, sh)]
        sh_width = sh.shape[1] * 3
        camera = camera_numbers(world_to_camera, intrinsics, frame)
        records, bounds = buffers.empty((n, layout.RECORD)), buffers.empty(n, np.int32)
        centres, radii = buffers.empty_tensor((n, 2)), buffers.empty_tensor((n,))
        blocks = -(-n // LANES) if any(ctx.needs_input_grad) else 0
        slopes = buffers.empty(blocks * LANES * projection.SLOPES)
        chunk_bounds = np.zeros(-(-n // projection.CHUNK), np.int64)
        parallel(
            projection.project, *inputs, sh_width, frame.sh_degree, camera, frame.width, frame.height,
            records.reshape(-1), flat(centres), flat(radii), bounds, chunk_bounds, slopes,
            scratch=projection.SCRATCH,
        )  # fmt: skip
        bins = bin_gaussians(records, bounds, chunk_bounds, frame)

        h, w = frame.height, frame.width
        image, alpha = buffers.empty_tensor((h, w, 3)), buffers.empty_tensor((h, w))
        shape = (h, w) if frame.depth else (0, 0)
        depth, median = buffers.empty_tensor(shape), buffers.empty_tensor(shape)
        ends = np.empty(frame.tiles, np.int64)
        behind = flat(background)
        parallel(
            raster_forward.raster, bins.entries, bins.starts, records.reshape(-1), behind, w, h, frame.tiles_x,
            flat(image), flat(alpha), flat(depth), flat(median), ends, scratch=raster_forward.STATE,
        )  # fmt: skip
        ctx.save_for_backward(means, quats, scales, opacities, sh, image, alpha, depth)
        ctx.slopes = slopes
        ctx.frame, ctx.bins, ctx.ends, ctx.records, ctx.camera, ctx.behind = frame, bins, ends, records, camera, behind
        ctx.centre_gradients = centre_gradients
        ctx.mark_non_differentiable(median, centres, radii)
        ctx.set_materialize_grads(False)
        return image, alpha, depth, median, centres, radii

    @staticmethod
    def backward(ctx: Any, d_image: Tensor | None, d_alpha: Tensor | None, d_depth: Tensor | None, *_: Any) -> Any:
        means, quats, scales, opacities, sh, image, alpha, depth = ctx.saved_tensors
        frame, bins, records = ctx.frame, ctx.bins, ctx.records
        n, h, w = len(means), frame.height, frame.width
        v_image = buffers.zeros(h * w * 3) if d_image is None else flat(d_image)
        v_alpha = buffers.zeros(h * w) if d_alpha is None else flat(d_alpha)
        v_depth = EMPTY if d_depth is None else flat(d_depth)
        rows = buffers.empty((bins.slots, layout.RECORD))
        parallel(
            raster_backward.raster_backward, bins.entries, bins.starts, ctx.ends, records.reshape(-1), ctx.behind, w, h,
            frame.tiles_x, flat(image), flat(alpha), flat(depth), v_image, v_alpha, v_depth, rows.reshape(-1),
            scratch=raster_backward.SCRATCH,
        )  # fmt: skip
        inputs = (means, quats, scales, opacities, sh)
        gradients = [buffers.empty_tensor(tuple(t.shape)) for t in inputs]
        d_centres = buffers.empty_tensor((n, 2))
        with_camera = ctx.needs_input_grad[5] or ctx.needs_input_grad[6]
        sums = np.zeros((-(-n // projection.CHUNK), projection.CAMERA_SUMS), np.float32)
        parallel(
            projection.project_backward, *(flat(t) for t in inputs[:4]), sh.shape[1] * 3, frame.sh_degree, ctx.camera,
            records.reshape(-1), ctx.slopes, rows.reshape(-1), bins.firsts, bins.counts, *(flat(t) for t in gradients),
            flat(d_centres), sums, with_camera, scratch=projection.SCRATCH,
        )  # fmt: skip
        ctx.centre_gradients.add_(d_centres)
        d_world_to_camera, d_intrinsics = _camera_gradients(sums, ctx.camera) if with_camera else (None, None)
        d_background = None
        if ctx.needs_input_grad[7] and d_image is not None:
            d_background = (d_image * (1 - alpha)[..., None]).sum((0, 1))
        return (*gradients, d_world_to_camera, d_intrinsics, d_background, None, None)


def _camera_gradients(sums: Array, camera: Array) -> tuple[Tensor, Tensor]:
    """Of world_to_camera (4, 4) and of intrinsics (3, 3), from the sums of all chunks."""
    total = sums.astype(np.float64).sum(0)
    rotation, translation = camera[:9].reshape(3, 3).astype(np.float64), camera[9:12].astype(np.float64)
    position = total[projection.POSITION_SUM : projection.POSITION_SUM + 3]  # of -R^T t
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
    *, background: Tensor | None, sh_degree: int, near: float, dilation: float, depth: bool = True,
) -> Rendering:  # fmt: skip
    """See `rasterization`. depth=False leaves depth and median_depth empty (0, 0), and is faster."""
    n = len(means)
    inputs = [t.to(torch.float32) for t in (means, quats, scales, opacities, sh)]
    if n < LANES:  # the kernels work on 16 at a time; opacity 0 is never seen
        inputs = [torch.cat([t, t.new_zeros(LANES - n, *t.shape[1:])]) for t in inputs]
    if background is None:
        background = inputs[0].new_zeros(3)
    centre_gradients = torch.zeros(len(inputs[0]), 2)
    frame = _Frame(width, height, sh_degree, near, dilation, depth)
    image, alpha, depths, median, centres, radii = _Rasterize.apply(
        *inputs, world_to_camera, intrinsics, background, frame, centre_gradients
    )
    return Rendering(image, alpha, depths, median, centres[:n], radii[:n], centre_gradients[:n])
