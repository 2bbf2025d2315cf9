# SPDX-License-Identifier: GPL-3.0-or-later
"""Transmittance of the Gaussians between cameras and lights, forward and backward; the definition is
`core.flare.visibility`.

A small camera looks along each line of sight. Each pixel of its picture gets the product of 1 - alpha over the
Gaussians that may hide the light. A product has no order, so nothing is sorted or put into tiles. The result is the
mean over a soft disk. `ellipse` has alpha and its gradients. With w the weight of a pixel in the disk, T its product,
and V the result,

    dV / d ln alpha = -w T alpha / (1 - alpha)

T is at least T_LEAST, the least that a rasterizer leaves behind opaque Gaussians. So behind many layers, which hide a
light altogether, the logarithm of V still has a gradient by each of them.

Arguments of the kernels:

    means, quats, scales, opacities   raw, see `rasterization`; flat
    lines      (m, LINE), see `_lines_of_sight`
    size       pixels of a side of the picture
    pixels     (2, p) x and y of the pixel centres, px; p: size² rounded up to whole vectors
"""
from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...conventions.pixel_grid import DILATION
from .. import rendering
from ..projection import FRUSTUM_MARGIN
from . import buffers
from .buffers import Array
from .compilation import inlined, kernel
from .ellipse import (
    CAMERA,
    CX,
    FX,
    HIGH_X,
    HIGH_Y,
    LOW_X,
    LOW_Y,
    NEAR,
    axes_backward,
    ellipses,
    load3,
    load4,
    load_opacities,
    mean_gradient,
    opacity_gradient,
    project_axes,
    store3,
    store4,
)
from .ellipse import DILATION as DILATION_AT
from .layout import ALPHA_MIN, ONE, OPACITY, OPACITY_MAX, RECORD, ZERO, A, D, G, K, X, Y
from .raster_forward import POWER_MIN
from .stepping import add_gradients
from .threads import parallel
from .tiles import flat
from .vector import (
    LANES,
    any_of,
    atomic_increment,
    exp,
    exp2_unclamped,
    fma,
    lane_index,
    load,
    load_rows,
    load_scalar,
    maximum,
    minimum,
    reduce_add_each,
    splat,
    sqrt,
    store,
    store_rows,
    transpose,
    where,
)

FAR_DEPTH, CONE_SLOPE, CENTRE, MAX_DISTANCE2, LINE = CAMERA, CAMERA + 1, CAMERA + 2, CAMERA + 5, CAMERA + 6
"""Offsets of a line behind its packed camera, and its length: depth beyond which nothing hides the light, slope of the
cone about the line, centre of the far sphere, squared distance from it beyond which nothing hides the light."""
HIDES = OPACITY + 1
"""Field of a record, here 1 for a Gaussian that may hide the light and 0 for others."""
REACH = np.float32(3)
"""Standard deviations up to which a Gaussian hides a light."""
CONE_RADII = 4
"""Slope of the cone about a line, in radii of the disk: the picture's corners are at 2 sqrt(2)."""
T_LEAST = np.float32(rendering.TRANSMITTANCE_MIN * (1 - rendering.OPACITY_MAX))
"""Least transmittance of a pixel."""
CHUNK = 1 << 12
"""Gaussians of a task."""
SQUARE = LANES * LANES


@inlined
def _find_occluders(means, scales, line, first, is_new):
    """Return which of the 16 Gaussians from `first` on may hide the light: those in front of it, near enough to the
    line. is_new: lanes that count."""
    x, y, z = load3(means, first)
    depth = fma(x, line[6], fma(y, line[7], fma(z, line[8], splat(line[11]))))
    across = fma(x, line[0], fma(y, line[1], fma(z, line[2], splat(line[9]))))
    down = fma(x, line[3], fma(y, line[4], fma(z, line[5], splat(line[10]))))
    scale_x, scale_y, scale_z = load3(scales, first)
    reach = exp(maximum(maximum(scale_x, scale_y), scale_z)) * REACH
    far_x, far_y, far_z = x - line[CENTRE], y - line[CENTRE + 1], z - line[CENTRE + 2]
    distance2 = fma(far_x, far_x, fma(far_y, far_y, far_z * far_z))
    is_between = (depth > line[NEAR]) & (depth < line[FAR_DEPTH]) & (distance2 <= line[MAX_DISTANCE2])
    is_near_line = sqrt(fma(across, across, down * down)) < fma(depth, splat(line[CONE_SLOPE]), reach)
    return is_between & is_near_line & is_new


@inlined
def _write_records(means, quats, scales, opacities, line, size, first, hides, records):
    """Write records of the 16 Gaussians from `first` on, seen by a line's camera; return their axes and opacities.

    Fields X, Y, A, K, D, OPACITY and HIDES alone. hides: from `_find_occluders`."""
    axes = project_axes(means, quats, scales, True, line, first)
    opacity = load_opacities(opacities, first, True)
    clamped = minimum(splat(OPACITY_MAX), opacity)
    e = ellipses(axes, clamped, line, size, size)
    zero = splat(ZERO)
    store_rows(records, 0, RECORD, transpose((
        e.x, e.y, e.major, e.k, e.minor, clamped, where(hides & e.is_visible, splat(ONE), zero),
        zero, zero, zero, zero, zero, zero, zero, zero, zero,
    )))  # fmt: skip
    return axes, opacity


@inlined
def _alphas(records, record, pixels, i):
    """Return alpha of a Gaussian at the 16 pixels from `i` on, and their u and d_y (`ellipse`)."""
    dy = load(pixels[1], i) - load_scalar(records, record + Y)
    u = fma(dy, splat(load_scalar(records, record + K)), load(pixels[0], i) - load_scalar(records, record + X))
    power = fma(u * load_scalar(records, record + A), u, load_scalar(records, record + D) * dy * dy)
    e = where(power > POWER_MIN, exp2_unclamped(power), ZERO) * load_scalar(records, record + OPACITY)
    return where(e >= ALPHA_MIN, e, ZERO), u, dy


@inlined
def _chunk_bounds(chunk, chunks, n):
    """Return the first Gaussian of a chunk, and the one after its last; a remainder below 16 joins the last chunk."""
    return chunk * CHUNK, n if chunk == chunks - 1 else (chunk + 1) * CHUNK


@kernel
def transmittance_kernel(counter, records, means, quats, scales, opacities, lines, size, pixels, chunks, products):
    """Write the product of 1 - alpha of each chunk of Gaussians at each pixel, for each line; (m, chunks, p), flat.

    counter: index of the next task; records: workspace of SQUARE numbers. The module head lists the others."""
    n, width = opacities.size, pixels.shape[1]
    while True:
        task = atomic_increment(counter)
        if task >= len(lines) * chunks:
            break
        line, target = lines[task // chunks], task * width
        for i in range(0, width, LANES):
            store(products, target + i, splat(ONE))
        start, end = _chunk_bounds(task % chunks, chunks, n)
        for block in range(start, end, LANES):
            first = min(block, n - LANES)  # the last block overlaps the one before
            hides = _find_occluders(means, scales, line, first, lane_index() >= np.float32(block - first))
            if any_of(hides):
                _write_records(means, quats, scales, opacities, line, size, first, hides, records)
                for record in range(0, SQUARE, RECORD):
                    if load_scalar(records, record + HIDES) > ZERO:
                        for i in range(0, width, LANES):
                            alpha, _, _ = _alphas(records, record, pixels, i)
                            store(products, target + i, load(products, target + i) * (ONE - alpha))


@inlined
def _moments(records, record, pixels, weights):
    """Return a row of gradients of one Gaussian (`layout`), from G_U to G; weights (p,): dL/dT T by pixel."""
    zero = splat(ZERO)
    s_u, s_y, s_uu, s_uy, s_yy, s = zero, zero, zero, zero, zero, zero
    for i in range(0, pixels.shape[1], LANES):
        alpha, u, dy = _alphas(records, record, pixels, i)
        g = -load(weights, i) * alpha / (ONE - alpha)
        g_u, g_y = g * u, g * dy
        s_u, s_y, s = s_u + g_u, s_y + g_y, s + g
        s_uu, s_uy, s_yy = fma(g_u, u, s_uu), fma(g_u, dy, s_uy), fma(g_y, dy, s_yy)
    return reduce_add_each((s_u, s_y, s_uu, s_uy, s_yy, s))


@inlined
def _masked(mask, values):
    return where(mask, values[0], ZERO), where(mask, values[1], ZERO), where(mask, values[2], ZERO)


@inlined
def _add3(array, first, values):
    x, y, z = load3(array, first)
    store3(array, first, (x + values[0], y + values[1], z + values[2]))


@kernel
def transmittance_backward_kernel(
    counter, scratch, means, quats, scales, opacities, lines, size, pixels, chunks, weights,
    d_means, d_quats, d_scales, d_opacities,
):  # fmt: skip
    """Write the gradients d_... of the parameters; weights (m, p): dL/dT T of each line and pixel.

    counter: index of the next chunk; scratch: workspace of 2 SQUARE numbers. The module head lists the others."""
    n = opacities.size
    records, rows = scratch[:SQUARE], scratch[SQUARE : 2 * SQUARE]
    zero = splat(ZERO)
    while True:
        chunk = atomic_increment(counter)
        if chunk >= chunks:
            break
        start, end = _chunk_bounds(chunk, chunks, n)
        d_means[3 * start : 3 * end], d_quats[4 * start : 4 * end] = ZERO, ZERO
        d_scales[3 * start : 3 * end], d_opacities[start:end] = ZERO, ZERO
        for number in range(len(lines)):
            line = lines[number]
            for block in range(start, end, LANES):
                first = min(block, n - LANES)
                hides = _find_occluders(means, scales, line, first, lane_index() >= np.float32(block - first))
                if any_of(hides):
                    axes, opacity = _write_records(
                        means, quats, scales, opacities, line, size, first, hides, records
                    )
                    for record in range(0, SQUARE, RECORD):
                        is_occluder = load_scalar(records, record + HIDES) > ZERO
                        store(rows, record, _moments(records, record, pixels, weights[number]) if is_occluder else zero)
                    fields = transpose(load_rows(rows, 0, LANES))
                    gradients = axes_backward(axes, fields, line, True, zero)
                    _add3(d_means, first, _masked(hides, mean_gradient(gradients.point, line, (zero, zero, zero))))
                    _add3(d_scales, first, _masked(hides, gradients.scale))
                    w, x, y, z = load4(d_quats, first)
                    q = gradients.quaternion
                    store4(d_quats, first, (w + where(hides, q[0], ZERO), x + where(hides, q[1], ZERO),
                                            y + where(hides, q[2], ZERO), z + where(hides, q[3], ZERO)))
                    d_opacity = where(hides, opacity_gradient(opacity, fields[G], True), ZERO)
                    store(d_opacities, first, load(d_opacities, first) + d_opacity)


class _MeanTransmittances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lines: Array, disk: Tensor, *parameters: Tensor) -> Tensor:
        """Return (m,), the mean transmittances; lines (m, LINE), disk (size, size), parameters of the Gaussians."""
        n, size = len(parameters[0]), len(disk)
        chunks = max(1, n // CHUNK + (n % CHUNK >= LANES))
        pixels, weights = _pixel_centres(size), _pad(disk.numpy().ravel())
        arrays = tuple(map(flat, parameters))
        products = buffers.empty(len(lines) * chunks * len(weights))
        parallel(transmittance_kernel, *arrays, lines, size, pixels, chunks, products, scratch=SQUARE,
                 limit=len(lines) * chunks)
        weighted = np.maximum(products.reshape(len(lines), chunks, len(weights)).prod(1), T_LEAST) * weights
        ctx.save_for_backward(*parameters)
        ctx.lines, ctx.size, ctx.chunks, ctx.weighted = lines, size, chunks, weighted
        return torch.from_numpy(weighted.sum(1))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        parameters = ctx.saved_tensors
        weights = ctx.weighted * gradient.numpy()[:, None]
        gradients, arrays = zip(*(buffers.tensor_and_array(*part.shape) for part in parameters), strict=True)
        parallel(transmittance_backward_kernel, *map(flat, parameters), ctx.lines, ctx.size, _pixel_centres(ctx.size),
                 ctx.chunks, weights, *arrays, scratch=2 * SQUARE, limit=ctx.chunks)
        if add_gradients(parameters, gradients):
            return (None,) * (2 + len(parameters))
        return (None, None, *gradients)


def mean_transmittances(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, opacity_logits: Tensor, eyes: Tensor, lights: Tensor,
    disk: Tensor, *, near: float, margin: float, radius: float, centre: tuple[float, ...], max_distance: float,
) -> Tensor | None:  # fmt: skip
    """Return the transmittances (m,), 0..1, of n Gaussians between m cameras and lights; None for fewer than 16.

    means (n, 3), quaternions (n, 4), log_scales (n, 3), opacity_logits (n,): as of `SceneGaussians`. eyes, lights: (m,
    3). disk (size, size): weights of the pixels of a light's disk, whose radius at the picture's edge is 2 `radius`,
    relative to the distance. A Gaussian counts if its depth is above the smaller of `near` and a thousandth of the
    light's distance. It must lie before the last `margin`, a share, of that distance, and within max_distance of
    `centre`. Lengths are in world units. Differentiable by the Gaussians.
    """
    if len(means) < LANES:
        return None
    lines = _lines_of_sight(eyes.double().numpy(), lights.double().numpy(), len(disk), near, margin, radius)
    lines[:, CENTRE : CENTRE + 3], lines[:, MAX_DISTANCE2] = centre, max_distance**2
    result: Tensor = _MeanTransmittances.apply(lines, disk, means, quaternions, log_scales, opacity_logits)
    return result


def _lines_of_sight(eyes: Array, lights: Array, size: int, near: float, margin: float, radius: float) -> Array:
    """Return the lines (m, LINE) from eyes to lights (m, 3), without the far sphere; see `mean_transmittances`.

    A light at the eye gets a line on which nothing lies.
    """
    forward = lights - eyes
    distances = np.linalg.norm(forward, axis=1)
    forward /= np.where(distances > 0, distances, 1)[:, None]
    # The roll of the camera is free: its right is perpendicular to the axis that is least along the line.
    right = np.cross(np.eye(3)[np.abs(forward).argmin(1)], forward)
    right /= np.linalg.norm(right, axis=1).clip(1e-12)[:, None]
    rotations = np.stack([right, np.cross(forward, right), forward], 1)
    focal = size / (4 * radius)  # the picture's edge is at twice the disk's radius
    bound = size / (2 * focal) * (1 + FRUSTUM_MARGIN)
    lines = np.zeros((len(eyes), LINE), np.float32)
    lines[:, :9] = rotations.reshape(-1, 9)
    lines[:, 9:12] = -np.einsum("mij,mj->mi", rotations, eyes)
    lines[:, FX : FX + 2], lines[:, CX : CX + 2], lines[:, DILATION_AT] = focal, size / 2, DILATION
    lines[:, [LOW_X, LOW_Y]], lines[:, [HIGH_X, HIGH_Y]] = -bound, bound
    lines[:, NEAR], lines[:, CONE_SLOPE] = np.minimum(1e-3 * distances, near), CONE_RADII * radius
    lines[:, FAR_DEPTH] = np.where(distances > 0, (1 - margin) * distances, -1)
    return lines


def _pad(values: Array) -> Array:
    """Return an array with zeros behind it, up to whole vectors."""
    return np.pad(values, (0, -values.size % LANES)).astype(np.float32)


@lru_cache(8)
def _pixel_centres(size: int) -> Array:
    """Return (2, p), x and y of the pixel centres of a square picture, row by row, px."""
    y, x = np.mgrid[:size, :size] + 0.5
    return np.stack([_pad(x.ravel()), _pad(y.ravel())])
