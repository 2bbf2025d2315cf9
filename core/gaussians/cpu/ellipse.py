# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry of projected Gaussians: from means, quaternions and scales to ellipses in the picture, and gradients back.

16 Gaussians at a time, one in each lane; `projection` and `transmittance` call it.

Forward (the definition is `..projection`): p = R m + t; with s = (p_x, p_y) / p_z, c = s held within the
frustum's margin, and V = R Q the Gaussian's axes seen by the camera, the rows of T = J R Q S are

    a = f_x / p_z (V_0 - c_x V_2) S,    b = f_y / p_z (V_1 - c_y V_2) S        covariance = T T^T + dilation I

Its determinant is |a x b|² + dilation (a² + b²) + dilation²: a sum of squares, without the cancellation that
xx yy - xy² suffers for needles. For the same reason the profile is not that of the conic but of its square completed:

    q / (-2 ln 2) = A (d_x + k d_y)² + D d_y²,   k = -xy / yy,  A = h yy / det,  D = h / yy,  h = -1 / (2 ln 2)

so alpha = opacity 2^(A u² + D d_y²), u = d_x + k d_y.

With `raw`, scales are logarithms and opacities logits, the form in which they are optimised.

In the backward pass the caller provides moments of g = dL / d ln alpha over the pixels: sums of g, g u, g d_y,
g u², g u d_y, g d_y². They give the gradients of centre and covariance (`_gradients_from_moments`).
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .. import rendering
from ..projection import FRUSTUM_MARGIN
from .compilation import inlined, kernel
from .layout import ALPHA_MIN, G_U, G_UU, G_UY, G_Y, G_YY, HALF, ONE, OPACITY_MAX, TWO, ZERO
from .vector import (
    exp,
    fma,
    load,
    load3,
    load4,
    log2,
    maximum,
    minimum,
    sigmoid,
    splat,
    sqrt,
    where,
)

# Offsets in the packed camera: rotation 0..8, translation 9..11, then
FX, FY, CX, CY, LOW_X, HIGH_X, LOW_Y, HIGH_Y, POSITION, NEAR, DILATION = 12, 13, 14, 15, 16, 17, 18, 19, 20, 23, 24
CAMERA = 25

H = np.float32(-0.5 / math.log(2))
TWO_LN2 = np.float32(2 * math.log(2))
ALPHA_MIN_INVERSE = np.float32(1 / rendering.ALPHA_MIN)
MARGIN = np.float32(1e-4)
"""Added to the reach, in powers of two, so that rounding loses no pixel at the rim, where alpha is tested again."""
NORM2_MIN = np.float32(1e-16)
"""Smallest squared length of a quaternion: the square of `..projection.QUATERNION_MIN`."""
MAX_INVERSE_NORM = np.float32(1e8)
"""Inverse length of the shortest quaternion that is normalised, the inverse root of NORM2_MIN."""
MAX_DETERMINANT = np.float32(1e30)
"""Determinant of a covariance, px^4, from which a Gaussian is not drawn: sums of it would overflow."""


@kernel
def pack_camera(world_to_camera, intrinsics, width, height, near, dilation, camera):
    """Write the packed camera (CAMERA,), at the offsets above, from the flat matrices (4, 4) and (3, 3).

    It includes the camera's position -R^T t and the bounds of x/z and y/z for J. near: smallest depth that is drawn;
    dilation: px², added to the variances."""
    for i in range(3):
        position = 0.0
        for j in range(3):
            camera[3 * i + j] = world_to_camera[4 * i + j]
            position -= np.float64(world_to_camera[4 * j + i]) * np.float64(world_to_camera[4 * j + 3])
        camera[9 + i] = world_to_camera[4 * i + 3]
        camera[POSITION + i] = position
    camera[NEAR], camera[DILATION] = near, dilation
    for axis in range(2):
        focal, principal = np.float64(intrinsics[4 * axis]), np.float64(intrinsics[3 * axis + 2])
        size = height if axis else width
        margin = FRUSTUM_MARGIN * size / (2 * focal)
        camera[FX + axis], camera[CX + axis] = focal, principal
        camera[LOW_X + 2 * axis] = -principal / focal - margin
        camera[HIGH_X + 2 * axis] = (size - principal) / focal + margin


@inlined
def dot(a, b):
    """Return the scalar product of two vectors in space."""
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@inlined
def scaled(s, a):
    """Return s a."""
    return a[0] * s, a[1] * s, a[2] * s


@inlined
def add_scaled(a, s, b):
    """Return a + s b."""
    return fma(s, b[0], a[0]), fma(s, b[1], a[1]), fma(s, b[2], a[2])


@inlined
def _rotation(w, x, y, z):
    """Return the rows of the rotation matrix of a unit quaternion w, x, y, z."""
    x2, y2, z2 = x * TWO, y * TWO, z * TWO
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return (
        (ONE - (yy + zz), xy - wz, xz + wy),
        (xy + wz, ONE - (xx + zz), yz - wx),
        (xz - wy, yz + wx, ONE - (xx + yy)),
    )


@inlined
def _rotation_backward(w, x, y, z, g):
    """Return the gradient by the unit quaternion w, x, y, z from g, the gradient by the rows of its rotation matrix."""
    # Sums and differences of mirrored elements.
    s01, s02, s12 = g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]
    d10, d02, d21 = g[1][0] - g[0][1], g[0][2] - g[2][0], g[2][1] - g[1][2]
    return (
        (x * d21 + y * d02 + z * d10) * TWO,
        (y * s01 + z * s02 + w * d21 - x * TWO * (g[1][1] + g[2][2])) * TWO,
        (x * s01 + z * s12 + w * d02 - y * TWO * (g[0][0] + g[2][2])) * TWO,
        (x * s02 + y * s12 + w * d10 - z * TWO * (g[0][0] + g[1][1])) * TWO,
    )


@inlined
def _normalise(q):
    """Return the quaternion at length 1, and the inverse of its length; zero stays zero."""
    inverse = ONE / sqrt(maximum(fma(q[0], q[0], dot((q[1], q[2], q[3]), (q[1], q[2], q[3]))), NORM2_MIN))
    return (q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse), inverse


@inlined
def to_camera(camera, mean):
    """Return the camera coordinates of points (x, y, z)."""
    x, y, z = mean
    return (
        fma(x, camera[0], fma(y, camera[1], fma(z, camera[2], splat(camera[9])))),
        fma(x, camera[3], fma(y, camera[4], fma(z, camera[5], splat(camera[10])))),
        fma(x, camera[6], fma(y, camera[7], fma(z, camera[8], splat(camera[11])))),
    )


@inlined
def _camera_rotation(camera):
    """Return the rows of R."""
    return (
        (camera[0], camera[1], camera[2]), (camera[3], camera[4], camera[5]), (camera[6], camera[7], camera[8]),
    )  # fmt: skip


@inlined
def _transposed(m):
    return (m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2])


@inlined
def _combine(weights, rows):
    """Return the sum of three rows, each times its weight."""
    return add_scaled(add_scaled(scaled(weights[0], rows[0]), weights[1], rows[1]), weights[2], rows[2])


@inlined
def _matrix_product(m, rows):
    """Return the rows of the product of two matrices (3, 3), from their rows."""
    return _combine(m[0], rows), _combine(m[1], rows), _combine(m[2], rows)


@inlined
def _multiply_elements(a, s):
    return a[0] * s[0], a[1] * s[1], a[2] * s[2]


@inlined
def _image_axes(camera, v, scales, slopes, inverse_z):
    """Return the rows a and b of T, and the held slopes c_x, c_y at which J is taken; v: rows of V."""
    cx = minimum(maximum(slopes[0], camera[LOW_X]), camera[HIGH_X])
    cy = minimum(maximum(slopes[1], camera[LOW_Y]), camera[HIGH_Y])
    a = scaled(inverse_z * camera[FX], _multiply_elements(add_scaled(v[0], -cx, v[2]), scales))
    b = scaled(inverse_z * camera[FY], _multiply_elements(add_scaled(v[1], -cy, v[2]), scales))
    return a, b, cx, cy


@inlined
def _covariance(a, b, dilation):
    """Return xx, xy, yy and the determinant of the covariance, from the rows a and b of T; see the module head."""
    aa, bb, ab = dot(a, a), dot(b, b), dot(a, b)
    n = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    determinant = dot(n, n) + (aa + bb + dilation) * dilation
    return aa + dilation, ab, bb + dilation, determinant


@inlined
def _load_scales(scales, first, raw):
    s = load3(scales, first)
    return (exp(s[0]), exp(s[1]), exp(s[2])) if raw else s


@inlined
def load_opacities(opacities, first, raw):
    """Return the opacities of the 16 Gaussians from `first` on."""
    o = load(opacities, first)
    return sigmoid(o) if raw else o


@inlined
def _gradients_from_moments(fields, xy, yy, determinant):
    """Return the gradients of the centre and of the covariance xx, xy (which stands for both places), yy.

    fields: the summed gradient rows, one vector per field. With e = covariance^-1 d: dL/dcentre = sum g e,
    dL/dcovariance = sum g e e^T / 2. In terms of u and d_y, e = (beta u, beta k u + d_y / yy) where beta = yy / det."""
    inverse_y = ONE / yy
    k = -xy * inverse_y
    beta = yy / determinant
    beta_k = beta * k
    d_x = beta * fields[G_U]
    d_y = fma(beta_k, fields[G_U], inverse_y * fields[G_Y])
    uu, uy, dd = beta * fields[G_UU], inverse_y * fields[G_UY], inverse_y * inverse_y * fields[G_YY]
    d_xx = beta * uu * HALF
    d_xy = fma(beta_k, uu, beta * uy)
    d_yy = fma(beta_k * k, uu, fma(beta_k * TWO, uy, dd)) * HALF
    return d_x, d_y, d_xx, d_xy, d_yy


class Axes(NamedTuple):
    """The axes of 16 Gaussians seen by a camera, a vector or a tuple of vectors each; the module head has the letters.

    mean, point: m and p. is_in_front: whether p_z is beyond the near plane; inverse_z: 1 / p_z, 1 if not. slopes,
    held_slopes: s and c. quaternion, inverse_norm: at length 1, and the inverse of its length. rotation: rows of Q.
    seen: rows of V. scale: standard deviations. a, b: rows of T.
    """

    mean: Any
    point: Any
    is_in_front: Any
    inverse_z: Any
    slopes: Any
    held_slopes: Any
    quaternion: Any
    inverse_norm: Any
    rotation: Any
    seen: Any
    scale: Any
    a: Any
    b: Any


@inlined
def project_axes(means, quats, scales, raw, camera, first):
    """Return the Axes of the 16 Gaussians from `first` on."""
    mean, scale = load3(means, first), _load_scales(scales, first, raw)
    point = to_camera(camera, mean)
    is_in_front = point[2] > camera[NEAR]
    inverse_z = ONE / where(is_in_front, point[2], ONE)
    slopes = (point[0] * inverse_z, point[1] * inverse_z)
    quaternion, inverse_norm = _normalise(load4(quats, first))
    rotation = _rotation(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    seen = _matrix_product(_camera_rotation(camera), rotation)
    a, b, cx, cy = _image_axes(camera, seen, scale, slopes, inverse_z)
    return Axes(mean, point, is_in_front, inverse_z, slopes, (cx, cy), quaternion, inverse_norm, rotation, seen, scale,
                a, b)


class Ellipses(NamedTuple):
    """The ellipses of 16 Gaussians in a picture, a vector each; the module head has the letters.

    x, y: centres, px. xx, xy, yy: covariances, px². reach: half the squared radius at which alpha falls below its
    threshold, over ln 2. half_x, half_y: half sizes of the bounding boxes, px. is_visible: whether they may touch the
    picture. k, major, minor: k, A and D.
    """

    x: Any
    y: Any
    xx: Any
    xy: Any
    yy: Any
    reach: Any
    half_x: Any
    half_y: Any
    is_visible: Any
    k: Any
    major: Any
    minor: Any


@inlined
def ellipses(axes, opacity, camera, width, height):
    """Return the Ellipses of Axes in a picture of this size. opacity: at most OPACITY_MAX."""
    x = where(axes.is_in_front, fma(axes.slopes[0], camera[FX], splat(camera[CX])), ZERO)
    y = where(axes.is_in_front, fma(axes.slopes[1], camera[FY], splat(camera[CY])), ZERO)
    xx, xy, yy, determinant = _covariance(axes.a, axes.b, camera[DILATION])
    reach = log2(maximum(opacity, ALPHA_MIN) * ALPHA_MIN_INVERSE)
    radius2 = reach * TWO_LN2
    half_x, half_y = sqrt(radius2 * xx), sqrt(radius2 * yy)
    is_drawable = axes.is_in_front & (determinant > ZERO) & (determinant < MAX_DETERMINANT) & (opacity >= ALPHA_MIN)
    is_in_frame = (x + half_x > ZERO) & (x - half_x < np.float32(width))
    is_in_frame = is_in_frame & (y + half_y > ZERO) & (y - half_y < np.float32(height))
    is_visible = is_drawable & is_in_frame & (yy > ZERO)
    inverse_y = ONE / where(is_visible, yy, ONE)
    k = -xy * inverse_y
    major = yy * H / where(is_visible, determinant, ONE)
    return Ellipses(x, y, xx, xy, yy, reach, half_x, half_y, is_visible, k, major, inverse_y * H)


class AxesGradients(NamedTuple):
    """Gradients of 16 Gaussians, a vector or a tuple of vectors each.

    centre: by x and y, px^-1. scale, quaternion: by the parameters. point: by p. seen: by the rows of V. focal: sums
    that belong to f_x and f_y, over these.
    """

    centre: Any
    scale: Any
    quaternion: Any
    point: Any
    seen: Any
    focal: Any


@inlined
def axes_backward(axes, fields, camera, raw, d_depth):
    """Return the AxesGradients from the summed moments `fields`, one vector per field, and the gradient of the depths.
    """
    a, b, inverse_z, slopes, scale, v = axes.a, axes.b, axes.inverse_z, axes.slopes, axes.scale, axes.seen
    _, xy, yy, determinant = _covariance(a, b, camera[DILATION])
    is_drawable = axes.is_in_front & (determinant > ZERO) & (determinant < MAX_DETERMINANT) & (yy > ZERO)
    yy, determinant = where(is_drawable, yy, ONE), where(is_drawable, determinant, ONE)
    dx, dy, d_xx, d_xy, d_yy = _gradients_from_moments(fields, xy, yy, determinant)

    # covariance -> a, b -> V, scales, slopes, depth; na, nb, n2: gradients of V_0 S, V_1 S, V_2 S
    da = add_scaled(scaled(d_xx * TWO, a), d_xy, b)
    db = add_scaled(scaled(d_yy * TWO, b), d_xy, a)
    a_da, b_db = dot(a, da), dot(b, db)
    na, nb = scaled(inverse_z * camera[FX], da), scaled(inverse_z * camera[FY], db)
    n2 = add_scaled(scaled(-axes.held_slopes[0], na), -axes.held_slopes[1], nb)
    v2s = _multiply_elements(v[2], scale)
    d_cx, d_cy = -dot(na, v2s), -dot(nb, v2s)
    d_scale = (
        fma(na[0], v[0][0], fma(nb[0], v[1][0], n2[0] * v[2][0])),
        fma(na[1], v[0][1], fma(nb[1], v[1][1], n2[1] * v[2][1])),
        fma(na[2], v[0][2], fma(nb[2], v[1][2], n2[2] * v[2][2])),
    )
    if raw:
        d_scale = _multiply_elements(d_scale, scale)
    dv = (_multiply_elements(na, scale), _multiply_elements(nb, scale), _multiply_elements(n2, scale))
    qw, qx, qy, qz = axes.quaternion
    d_rotation = _matrix_product(_transposed(_camera_rotation(camera)), dv)  # Q from V = R Q
    gw, gx, gy, gz = _rotation_backward(qw, qx, qy, qz, d_rotation)
    radial = fma(gw, qw, dot((gx, gy, gz), (qx, qy, qz)))
    radial = where(axes.inverse_norm < MAX_INVERSE_NORM, radial, ZERO)  # shorter ones were scaled by a constant
    d_quaternion = (
        (gw - qw * radial) * axes.inverse_norm, (gx - qx * radial) * axes.inverse_norm,
        (gy - qy * radial) * axes.inverse_norm, (gz - qz * radial) * axes.inverse_norm,
    )  # fmt: skip

    inside_x = (slopes[0] >= camera[LOW_X]) & (slopes[0] <= camera[HIGH_X])
    inside_y = (slopes[1] >= camera[LOW_Y]) & (slopes[1] <= camera[HIGH_Y])
    d_sx = fma(dx, camera[FX], where(inside_x, d_cx, ZERO))
    d_sy = fma(dy, camera[FY], where(inside_y, d_cy, ZERO))
    d_pz = d_depth - inverse_z * (fma(d_sx, slopes[0], d_sy * slopes[1]) + a_da + b_db)
    d_point = (d_sx * inverse_z, d_sy * inverse_z, d_pz)
    return AxesGradients((dx, dy), d_scale, d_quaternion, d_point, dv, (a_da, b_db))


@inlined
def opacity_gradient(opacity, d_log_opacity, raw):
    """Return the gradient of opacities, by logits with `raw`, from that of their logarithms; 0 where they are clamped.
    """
    is_unclamped = (opacity <= OPACITY_MAX) & (opacity >= ALPHA_MIN)
    d_opacity = d_log_opacity * (ONE - opacity) if raw else d_log_opacity / where(is_unclamped, opacity, ONE)
    return where(is_unclamped, d_opacity, ZERO)


@inlined
def mean_gradient(d_point, camera, offset):
    """Return R^T d_point + offset."""
    return (
        fma(d_point[0], camera[0], fma(d_point[1], camera[3], fma(d_point[2], camera[6], offset[0]))),
        fma(d_point[0], camera[1], fma(d_point[1], camera[4], fma(d_point[2], camera[7], offset[1]))),
        fma(d_point[0], camera[2], fma(d_point[1], camera[5], fma(d_point[2], camera[8], offset[2]))),
    )
