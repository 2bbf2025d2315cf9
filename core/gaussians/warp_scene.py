# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders scenes with NVIDIA Warp, for the kernel set `cuda`: one kernel projects the Gaussians and evaluates their
colours, its adjoint is the backward pass, and three kernels and a radix sort make the tile lists.

`tiled.rasterize_scene` computes the same by some hundred operations of torch, each of which a GPU launches by itself.
The geometry is in double precision, since the covariance of a needle cancels; what the rasterizer reads is in single
precision. `warp_kernels` draws the tiles.

A key of the sort is the number of the tile and, below it, the bits of the depth, which for positive floats have the
order of the numbers. The sort is stable: Gaussians of equal depth stay in the order of their rows.
"""
# Kernels are written in Warp's language, not Python's: no static types, and no postponed annotations.
# mypy: ignore-errors
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..conventions.splatting import C0, C1, C2, C3
from . import projection, tiled, warp_kernels
from .rendering import ALPHA_MIN, OPACITY_MAX, Rendering
from .tiled import REACH_MARGIN, TileLists, WhitenedGaussians

MAX_ENTRIES = 1 << 26
"""Most entries of all tile lists of a picture, 24 bytes each while they are sorted; pictures with more are drawn in
parts by `tiled`."""

_Place = wp.types.vector(length=warp_kernels.PLACES, dtype=wp.float32)
_Values = wp.types.vector(length=6, dtype=wp.float32)
"""Peak, colour, depth and 1 of a Gaussian, which blend to colour, depth and alpha."""
_ALPHA_MIN = wp.constant(ALPHA_MIN)
_OPACITY_MAX = wp.constant(wp.float64(OPACITY_MAX))
_QUATERNION_MIN = wp.constant(wp.float64(projection.QUATERNION_MIN))
_FRUSTUM_MARGIN = wp.constant(wp.float64(projection.FRUSTUM_MARGIN))
_DIRECTION_MIN = wp.constant(wp.float64(1e-12))
_LOGIT_MIN = wp.constant(wp.float64(-700.0))
"""Logit below which an opacity is 0; the exponential of its negative still is a number."""
_REACH_MARGIN = wp.constant(REACH_MARGIN)
_TILE = wp.constant(warp_kernels.TILE)
_C0, _C1 = wp.constant(C0), wp.constant(C1)
_C20, _C21, _C22 = (wp.constant(value) for value in C2)
_C30, _C31, _C32, _C33, _C34 = (wp.constant(value) for value in C3)


@wp.func
def _rotation(quaternion: wp.vec4d) -> wp.mat33d:
    """Return the rotation of a quaternion w, x, y, z of any length."""
    q = quaternion / wp.max(wp.length(quaternion), _QUATERNION_MIN)
    w, x, y, z = q[0], q[1], q[2], q[3]
    one, two = wp.float64(1.0), wp.float64(2.0)
    return wp.mat33d(
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@wp.func
def _colour(direction: wp.vec3, sh: wp.array(dtype=wp.vec3), first: int, degree: int) -> wp.vec3:
    """Return the colour of spherical harmonics, not negative, along a unit direction. first: index of the
    coefficients."""
    x, y, z = direction[0], direction[1], direction[2]
    colour = _C0 * sh[first]
    if degree >= 1:
        colour += -_C1 * y * sh[first + 1] + _C1 * z * sh[first + 2] - _C1 * x * sh[first + 3]
    if degree >= 2:
        colour += _C20 * x * y * sh[first + 4] - _C20 * y * z * sh[first + 5]
        colour += _C21 * (2.0 * z * z - x * x - y * y) * sh[first + 6]
        colour += -_C20 * x * z * sh[first + 7] + _C22 * (x * x - y * y) * sh[first + 8]
    if degree >= 3:
        colour += -_C30 * y * (3.0 * x * x - y * y) * sh[first + 9] + _C31 * x * y * z * sh[first + 10]
        colour += -_C32 * y * (4.0 * z * z - x * x - y * y) * sh[first + 11]
        colour += _C33 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * sh[first + 12]
        colour += -_C32 * x * (4.0 * z * z - x * x - y * y) * sh[first + 13]
        colour += _C34 * z * (x * x - y * y) * sh[first + 14] - _C30 * x * (x * x - 3.0 * y * y) * sh[first + 15]
    return wp.vec3(wp.max(colour[0] + 0.5, 0.0), wp.max(colour[1] + 0.5, 0.0), wp.max(colour[2] + 0.5, 0.0))


# Each thread projects one Gaussian by EWA splatting, as `projection.project` does; rows of Gaussians that the near
# plane culls are left as they are, 0. camera: world to camera; intrinsics: with gradient; fixed_intrinsics: the same
# without, for the bounds of the Jacobian; coefficients: of a Gaussian in sh; raw: scales are logarithms and opacities
# logits.
@wp.kernel(enable_backward=True, module="unique")
def project(
    means: wp.array(dtype=wp.vec3), quaternions: wp.array(dtype=wp.vec4), scales: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=wp.float32), sh: wp.array(dtype=wp.vec3), camera: wp.array(dtype=wp.mat44d),
    intrinsics: wp.array(dtype=wp.mat33d), fixed_intrinsics: wp.array(dtype=wp.mat33d), coefficients: int, degree: int,
    width: int, height: int, near: wp.float64, dilation: wp.float64, raw: bool,
    places: wp.array(dtype=_Place), values: wp.array(dtype=_Values),
):  # fmt: skip
    i = wp.tid()
    pose = camera[0]
    rotation = wp.mat33d(
        pose[0, 0], pose[0, 1], pose[0, 2], pose[1, 0], pose[1, 1], pose[1, 2], pose[2, 0], pose[2, 1], pose[2, 2]
    )
    translation = wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])
    mean = wp.vec3d(wp.float64(means[i][0]), wp.float64(means[i][1]), wp.float64(means[i][2]))
    position = rotation * mean + translation
    z = position[2]
    if z > near:
        k, fixed = intrinsics[0], fixed_intrinsics[0]
        fx, fy = k[0, 0], k[1, 1]
        slope_x, slope_y = position[0] / z, position[1] / z
        margin_x = _FRUSTUM_MARGIN * wp.float64(width) / (wp.float64(2.0) * fixed[0, 0])
        margin_y = _FRUSTUM_MARGIN * wp.float64(height) / (wp.float64(2.0) * fixed[1, 1])
        u_x = wp.clamp(slope_x, -fixed[0, 2] / fixed[0, 0] - margin_x,
                       (wp.float64(width) - fixed[0, 2]) / fixed[0, 0] + margin_x)
        u_y = wp.clamp(slope_y, -fixed[1, 2] / fixed[1, 1] - margin_y,
                       (wp.float64(height) - fixed[1, 2]) / fixed[1, 1] + margin_y)
        q, s = quaternions[i], scales[i]
        scale = wp.vec3d(wp.float64(s[0]), wp.float64(s[1]), wp.float64(s[2]))
        opacity = wp.float64(opacities[i])
        if raw:
            scale = wp.vec3d(wp.exp(scale[0]), wp.exp(scale[1]), wp.exp(scale[2]))
            opacity = wp.float64(1.0) / (wp.float64(1.0) + wp.exp(-wp.max(opacity, _LOGIT_MIN)))
        axes = rotation * _rotation(wp.vec4d(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))
        # Rows of J W R S, the projected axes.
        a = wp.vec3d(
            fx / z * (axes[0, 0] - u_x * axes[2, 0]) * scale[0], fx / z * (axes[0, 1] - u_x * axes[2, 1]) * scale[1],
            fx / z * (axes[0, 2] - u_x * axes[2, 2]) * scale[2],
        )
        b = wp.vec3d(
            fy / z * (axes[1, 0] - u_y * axes[2, 0]) * scale[0], fy / z * (axes[1, 1] - u_y * axes[2, 1]) * scale[1],
            fy / z * (axes[1, 2] - u_y * axes[2, 2]) * scale[2],
        )
        xx, xy, yy = wp.dot(a, a) + dilation, wp.dot(a, b), wp.dot(b, b) + dilation
        w_yy = wp.float64(1.0) / wp.sqrt(yy - xy * xy / xx)
        places[i] = _Place(
            wp.float32(slope_x * fx + k[0, 2]), wp.float32(slope_y * fy + k[1, 2]),
            wp.float32(wp.float64(1.0) / wp.sqrt(xx)), wp.float32(-xy / xx * w_yy), wp.float32(w_yy),
        )
        offset = mean + wp.transpose(rotation) * translation  # from the camera's place to the mean
        unit = offset / wp.max(wp.length(offset), _DIRECTION_MIN)
        direction = wp.vec3(wp.float32(unit[0]), wp.float32(unit[1]), wp.float32(unit[2]))
        colour = _colour(direction, sh, i * coefficients, degree)
        values[i] = _Values(
            wp.float32(wp.min(opacity, _OPACITY_MAX)), colour[0], colour[1], colour[2], wp.float32(z), 1.0
        )


@wp.func
def _tile_box(centre: float, half_size: float, tiles: int) -> wp.vec2i:
    """Return the first tile and the last along an axis that a bounding box touches; none if the last is lower."""
    low = wp.clamp(wp.floor((centre - half_size) / float(_TILE)), 0.0, float(tiles))
    high = wp.clamp(wp.floor((centre + half_size) / float(_TILE)), -1.0, float(tiles - 1))
    return wp.vec2i(int(low), int(high))


@wp.func
def _is_touched(place: _Place, reach: float, column: int, row: int) -> bool:
    """Return whether an ellipse at the Mahalanobis radius `reach` touches a tile; see `tiled._min_squared_distance`."""
    low_x, low_y = float(column * _TILE) - place[0], float(row * _TILE) - place[1]
    high_x, high_y = low_x + float(_TILE), low_y + float(_TILE)
    near_x, near_y = wp.clamp(0.0, low_x, high_x), wp.clamp(0.0, low_y, high_y)
    w_xx, w_yx, w_yy = place[2], place[3], place[4]
    y = wp.clamp(-w_yx / w_yy * near_x, low_y, high_y)
    x = wp.clamp(-w_yx * w_yy * near_y / (w_xx * w_xx + w_yx * w_yx), low_x, high_x)
    u, v = w_xx * near_x, w_yy * y + w_yx * near_x
    s, t = w_xx * x, w_yy * near_y + w_yx * x
    bound = reach * (1.0 + _REACH_MARGIN) + _REACH_MARGIN
    return wp.min(u * u + v * v, s * s + t * t) <= bound * bound


@wp.func
def _reach(peak: float) -> float:
    """Return the Mahalanobis radius beyond which a Gaussian is not drawn, 0 if it is not drawn at all; see
    `rendering.cutoff_radii`."""
    return wp.where(peak >= _ALPHA_MIN, wp.sqrt(2.0 * wp.log(wp.max(peak / _ALPHA_MIN, 1.0))), 0.0)


@wp.func
def _variances(place: _Place) -> wp.vec3:
    """Return the covariance xx, xy, yy, px², of a whitened Gaussian."""
    xx = 1.0 / (place[2] * place[2])
    xy = -place[3] / place[4] * xx
    return wp.vec3(xx, xy, 1.0 / (place[4] * place[4]) + xy * xy / xx)


# Each thread measures one Gaussian: radii get three standard deviations of the longer axis, 0 where it touches no
# pixel; counts get the number of tiles that it touches.
@wp.kernel(enable_backward=False, module="unique")
def count_tiles(
    places: wp.array(dtype=_Place), values: wp.array(dtype=_Values), width: int, height: int, columns: int, rows: int,
    radii: wp.array(dtype=wp.float32), counts: wp.array(dtype=wp.int32),
):  # fmt: skip
    i = wp.tid()
    place = places[i]
    reach = _reach(values[i][0])
    radius, count = wp.float32(0.0), wp.int32(0)
    if place[2] > 0.0 and reach > 0.0:
        variances = _variances(place)
        half_x, half_y = reach * wp.sqrt(variances[0]), reach * wp.sqrt(variances[2])
        if (place[0] + half_x > 0.0 and place[0] - half_x < float(width) and place[1] + half_y > 0.0
                and place[1] - half_y < float(height)):
            half_difference = 0.5 * (variances[0] - variances[2])
            root = wp.sqrt(half_difference * half_difference + variances[1] * variances[1])
            radius = 3.0 * wp.sqrt(0.5 * (variances[0] + variances[2]) + root)
            x, y = _tile_box(place[0], half_x, columns), _tile_box(place[1], half_y, rows)
            for row in range(y[0], y[1] + 1):
                for column in range(x[0], x[1] + 1):
                    if _is_touched(place, reach, column, row):
                        count += 1
    radii[i] = radius
    counts[i] = count


# Each thread writes the entries of one Gaussian to the lists, before they are sorted. ends: number of entries up to
# each Gaussian's last.
@wp.kernel(enable_backward=False, module="unique")
def write_entries(
    places: wp.array(dtype=_Place), values: wp.array(dtype=_Values), columns: int, rows: int,
    counts: wp.array(dtype=wp.int32), ends: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int64), entries: wp.array(dtype=wp.int32),
):  # fmt: skip
    i = wp.tid()
    if counts[i] > 0:
        place = places[i]
        reach = _reach(values[i][0])
        variances = _variances(place)
        x = _tile_box(place[0], reach * wp.sqrt(variances[0]), columns)
        y = _tile_box(place[1], reach * wp.sqrt(variances[2]), rows)
        depth_bits = wp.int64(wp.cast(values[i][4], wp.int32))
        slot = ends[i] - counts[i]
        for row in range(y[0], y[1] + 1):
            for column in range(x[0], x[1] + 1):
                if _is_touched(place, reach, column, row):
                    keys[slot] = (wp.int64(row * columns + column) << wp.int64(32)) | depth_bits
                    entries[slot] = i
                    slot += 1


# Each thread writes where the list of one tile starts, by a binary search in the sorted keys. starts: (tiles + 1,).
@wp.kernel(enable_backward=False, module="unique")
def find_starts(keys: wp.array(dtype=wp.int64), total: int, starts: wp.array(dtype=wp.int32)):
    tile = wp.tid()
    low, high = wp.int32(0), wp.int32(total)
    while low < high:
        middle = (low + high) // 2
        if (keys[middle] >> wp.int64(32)) < wp.int64(tile):
            low = middle + 1
        else:
            high = middle
    starts[tile] = low


KERNELS = (project, count_tiles, write_entries, find_starts)


def _launch(kernel: Any, dim: int, device: torch.device, inputs: list[Any], outputs: list[Any], **adjoint: Any) -> None:
    """Launch a kernel on the device and the stream of torch. adjoint: arguments of a launch backwards."""
    warp_device = wp.device_from_torch(device)
    stream = wp.stream_from_torch(device) if warp_device.is_cuda else None
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=warp_device, stream=stream, **adjoint)


def _with_whole_rows(matrix: Tensor) -> Tensor:
    """Return a matrix whose rows are contiguous, themselves apart or not; a copy only if they are not."""
    return matrix if matrix.stride(-1) == 1 else matrix.contiguous()


def _array(tensor: Tensor | None, dtype: Any) -> Any:
    """Return a Warp array of a tensor with contiguous rows, without a copy; None without a tensor."""
    return None if tensor is None else wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


_INPUT_TYPES = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec3, wp.mat44d, wp.mat33d)
"""Warp's types of the tensors that `project` has a gradient by."""


class _Project(torch.autograd.Function):
    """Projects a scene: places (n, 5) and values (n, 6) from means (n, 3), quaternions (n, 4), scales (n, 3), opacities
    (n,), sh (n * k, 3), camera (1, 4, 4) and intrinsics (1, 3, 3), both float64. options: the scalars of `project`."""

    @staticmethod
    def forward(ctx: Any, options: tuple[Any, ...], *tensors: Tensor) -> tuple[Tensor, Tensor]:
        means = tensors[0]
        places = means.new_zeros(len(means), warp_kernels.PLACES)
        values = means.new_zeros(len(means), 6)
        ctx.options = options
        ctx.save_for_backward(places, values, *tensors)
        arrays = [_array(tensor, kind) for tensor, kind in zip(tensors, _INPUT_TYPES, strict=True)]
        _launch(project, len(means), means.device, [*arrays, arrays[-1], *options],
                [_array(places, _Place), _array(values, _Values)])
        return places, values

    @staticmethod
    def backward(ctx: Any, d_places: Tensor, d_values: Tensor) -> Any:
        places, values, *tensors = ctx.saved_tensors
        gradients = [torch.zeros_like(tensor) if needed else None
                     for tensor, needed in zip(tensors, ctx.needs_input_grad[1:], strict=True)]
        arrays = [_array(tensor, kind) for tensor, kind in zip(tensors, _INPUT_TYPES, strict=True)]
        adjoints = [_array(gradient, kind) for gradient, kind in zip(gradients, _INPUT_TYPES, strict=True)]
        _launch(
            project, len(places), places.device, [*arrays, arrays[-1], *ctx.options],
            [_array(places, _Place), _array(values, _Values)],
            adj_inputs=[*adjoints, None, *[None] * len(ctx.options)],
            adj_outputs=[_array(_with_whole_rows(d_places), _Place), _array(_with_whole_rows(d_values), _Values)],
            adjoint=True,
        )  # fmt: skip
        return None, *gradients


def make_tile_lists(places: Tensor, values: Tensor, width: int, height: int) -> tuple[TileLists | None, Tensor]:
    """Return the tile lists of projected Gaussians, and their radii (n,), px.

    places (n, 5), values (n, 6): from `project`. The lists are None if they would have more than MAX_ENTRIES entries.
    """
    device, n = places.device, len(places)
    columns, rows = -(-width // warp_kernels.TILE), -(-height // warp_kernels.TILE)
    radii = places.new_empty(n)
    counts, ends = (torch.empty(n, dtype=torch.int32, device=device) for _ in range(2))
    projected = [_array(places, _Place), _array(values, _Values)]
    _launch(count_tiles, n, device, [*projected, width, height, columns, rows],
            [_array(radii, wp.float32), _array(counts, wp.int32)])
    torch.cumsum(counts, 0, dtype=torch.int32, out=ends)
    total = int(ends[-1]) if n else 0
    if not 0 <= total <= MAX_ENTRIES:
        return None, radii
    # The sort needs twice the room.
    keys = torch.empty(2 * total, dtype=torch.int64, device=device)
    entries = torch.empty(2 * total, dtype=torch.int32, device=device)
    starts = torch.zeros(columns * rows + 1, dtype=torch.int32, device=device)
    if total:
        _launch(write_entries, n, device, [*projected, columns, rows, _array(counts, wp.int32), _array(ends, wp.int32)],
                [_array(keys, wp.int64), _array(entries, wp.int32)])
        with wp.ScopedStream(wp.stream_from_torch(device) if device.type == "cuda" else None):
            wp.utils.radix_sort_pairs(_array(keys, wp.int64), _array(entries, wp.int32), total,
                                      end_bit=32 + (columns * rows).bit_length())
        _launch(find_starts, len(starts), device, [_array(keys, wp.int64), total], [_array(starts, wp.int32)])
    return TileLists(entries[:total], starts, columns, rows, warp_kernels.TILE), radii


def _record_gradient(places: Tensor) -> Tensor:
    """Return (n, 2) zeros, to which the backward pass will add the gradients by the centres of `places` (n, 5)."""
    gradients = places.new_zeros(len(places), 2)

    def record(gradient: Tensor) -> None:
        gradients.add_(gradient[:, :2])

    if places.requires_grad:
        places.register_hook(record)
    return gradients


def rasterize_scene(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
    *, background: Tensor | None, sh_degree: int, near: float, dilation: float, depth: bool, raw: bool,
) -> Rendering:  # fmt: skip
    """Render as `rasterization` of the package does; arguments and result are explained there."""
    tensors = [part.float().contiguous() for part in (means, quats, scales, opacities)]
    harmonics = sh.float().contiguous()
    places, values = _Project.apply(
        (sh.shape[1], sh_degree, width, height, near, dilation, raw), *tensors, harmonics.view(-1, 3),
        world_to_camera.double().contiguous()[None], intrinsics.double().contiguous()[None],
    )  # fmt: skip
    lists, radii = make_tile_lists(places.detach(), values.detach(), width, height)
    if lists is None:
        return tiled.rasterize_scene(
            warp_kernels.draw, warp_kernels.TILE, means, quats, scales, opacities, sh, world_to_camera, intrinsics,
            width, height, background=background, sh_degree=sh_degree, near=near, dilation=dilation, depth=depth,
            raw=raw,
        )  # fmt: skip
    gradients = _record_gradient(places)
    parts, median_rows = warp_kernels.draw(lists, "over", depth, WhitenedGaussians(places, values, None, None))
    picture = tiled.assemble(parts, lists)[:height, :width]
    colour, alpha, mean_depth, median_depth = tiled.split_layers(
        picture, background, tiled.assemble(median_rows, lists)[:height, :width].long() if depth else None,
        values[:, 4],
    )  # fmt: skip
    return Rendering(colour, alpha, mean_depth, median_depth, places.detach()[:, :2], radii, gradients)
