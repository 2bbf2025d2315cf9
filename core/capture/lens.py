# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens distortion, in every camera model of COLMAP, and the pinhole view of undistorted frames.

A lens maps a direction, given as the pinhole coordinates (x, y) = (X/Z, Y/Z), to a pixel. Four families:

    perspective   D(x, y)                             Brown-Conrady polynomials, FOV
    fisheye       D(theta x/r, theta y/r)             r = |(x, y)|, theta = atan r; the same polynomials
    one-parameter (x, y) 2 / (1 + sqrt(1 - 4 k r^2))  division model (Fitzgibbon 2001)
    unified       (x, y) / (a sqrt(b r^2 + 1) + 1 - a)  EUCM (Khomutenko et al. 2016)

followed by focal length and principal point. An equirectangular panorama has no principal point; the pinhole view taken
from it looks straight ahead.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import CaptureError
from ..images.picture import Picture
from .camera import Camera, Floats

# COLMAP's number for each model, and its parameters in COLMAP's order.
MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    name: (number, tuple(parameters.split()))
    for number, name, parameters in (
        (0, "SIMPLE_PINHOLE", "f cx cy"),
        (1, "PINHOLE", "fx fy cx cy"),
        (2, "SIMPLE_RADIAL", "f cx cy k1"),
        (3, "RADIAL", "f cx cy k1 k2"),
        (4, "OPENCV", "fx fy cx cy k1 k2 p1 p2"),
        (5, "OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
        (6, "FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
        (7, "FOV", "fx fy cx cy omega"),
        (8, "SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
        (9, "RADIAL_FISHEYE", "f cx cy k1 k2"),
        (10, "THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx sy"),
        (11, "RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4"),
        (12, "SIMPLE_DIVISION", "f cx cy k"),
        (13, "DIVISION", "fx fy cx cy k"),
        (14, "SIMPLE_FISHEYE", "f cx cy"),
        (15, "FISHEYE", "fx fy cx cy"),
        (16, "EUCM", "fx fy cx cy alpha beta"),
        (17, "EQUIRECTANGULAR", "w h"),
    )
}
MODEL_NAMES = {number: name for name, (number, _) in MODELS.items()}
PINHOLES = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})

MAX_TAN_HALF_ANGLE = math.tan(math.radians(60.0))
"""Half diagonal that is kept of a fisheye, normalised coordinates; beyond it a plane stretches too far."""

_MAX_START_ANGLE = 1.5
"""Angle off the axis at which the search of `undistort` starts at most, radians: its tangent is finite."""
_MAX_UNDISTORTED = 57.0
"""Largest undistorted coordinate: the tangent of 89 degrees."""
_MAX_NEWTON_STEPS = 40
_MIN_ZOOM, _MAX_ZOOM = 0.05, 20.0
"""Factors on the focal length within which the undistorted view is searched."""

Parameters = dict[str, float]


@dataclass(frozen=True, eq=False)
class Lens:
    """A COLMAP camera model, its parameters in COLMAP's order, and their image size in pixels."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    @property
    def parameters(self) -> Parameters:
        """The parameters by name."""
        return dict(zip(MODELS[self.model][1], self.params, strict=True))

    @property
    def focal(self) -> tuple[float, float]:
        """(fx, fy) in pixels."""
        parameters = self.parameters
        if self.model == "EQUIRECTANGULAR":
            return self.width / (2 * math.pi), self.height / math.pi
        return parameters.get("fx", parameters.get("f", 0.0)), parameters.get("fy", parameters.get("f", 0.0))

    @property
    def centre(self) -> tuple[float, float]:
        """(cx, cy), the principal point in pixels."""
        parameters = self.parameters
        return parameters.get("cx", self.width / 2), parameters.get("cy", self.height / 2)

    def distort(self, plane: ArrayLike) -> Floats:
        """Map directions (n, 2) as X/Z and Y/Z to pixels (n, 2); NaN where the model has no image."""
        x, y = np.asarray(plane, np.float64).reshape(-1, 2).T
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            bent = _EQUATIONS[self.model](x, y, self.parameters)
        return np.stack(bent, axis=1) * self.focal + self.centre

    def undistort(self, pixels: ArrayLike) -> Floats:
        """Map pixels (n, 2) to directions (n, 2) as X/Z and Y/Z: inverts `distort` by Newton's method.

        NaN where no direction within 89 degrees of the axis leads to the pixel.
        """
        target = np.asarray(pixels, np.float64).reshape(-1, 2)
        plane = (target - self.centre) / self.focal
        if self.model in _FISHEYES or self.model == "EQUIRECTANGULAR":  # the radius is an angle here
            angle = np.minimum(np.linalg.norm(plane, axis=1, keepdims=True), _MAX_START_ANGLE)
            plane = plane * np.tan(angle) / np.maximum(angle, 1e-12)
        for _ in range(_MAX_NEWTON_STEPS):
            error = self.distort(plane) - target
            step_size = 1e-6 * np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1.0)
            # Derivatives (n, 2) of the pixels by the direction's x and y, by central differences.
            by_x, by_y = (
                (self.distort(plane + step_size * axis) - self.distort(plane - step_size * axis)) / (2 * step_size)
                for axis in ((1, 0), (0, 1)))
            determinant = by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]
            with np.errstate(invalid="ignore", divide="ignore"):
                step = np.stack([by_y[:, 1] * error[:, 0] - by_y[:, 0] * error[:, 1],
                                 by_x[:, 0] * error[:, 1] - by_x[:, 1] * error[:, 0]], axis=1)
                step /= determinant[:, None]
            # A step longer than the place itself would throw the search over a fold of the polynomial.
            max_length = 0.5 * (1.0 + np.linalg.norm(plane, axis=1, keepdims=True))
            length = np.linalg.norm(step, axis=1, keepdims=True)
            step *= np.minimum(1.0, max_length / np.maximum(length, 1e-30))
            plane = plane - step
            if not (np.abs(error) > 1e-9).any():
                break
        converged = np.linalg.norm(self.distort(plane) - target, axis=1) < 1e-4
        plane[~converged | (np.linalg.norm(plane, axis=1) > _MAX_UNDISTORTED)] = np.nan
        return plane

    @cached_property
    def pinhole(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) of the undistorted view: same size and principal point, and the widest view that the frame
        covers.

        At most 60 degrees off the axis in the corners. Raises CaptureError where the distortion leaves no such view.
        """
        (fx, fy), (cx, cy) = self.focal, self.centre
        if self.model in PINHOLES:
            return fx, fy, cx, cy
        border = self.border - (cx, cy)
        # A zoom is a factor on the focal length. Bisection finds the smallest zoom whose view the frame covers; at
        # corner_zoom the farthest corner is 60 degrees off the axis.
        corner_zoom = float(np.linalg.norm(border / (fx, fy), axis=1).max()) / MAX_TAN_HALF_ANGLE
        widest, narrowest = max(corner_zoom, _MIN_ZOOM), _MAX_ZOOM
        if not (fx > 0 and fy > 0) or not self._is_covered(border / (fx, fy) / narrowest):
            raise CaptureError(f"The lens parameters {self.params} ({self.model}) bend the picture until "
                               "nothing is left of it; solve the cameras again with a simpler model.")
        if self._is_covered(border / (fx, fy) / widest):
            zoom = widest
        elif self._is_covered(border / (fx, fy)) and not self._is_covered(border / (fx, fy) / 0.9999):
            zoom = 1.0  # exactly, where bisection would end beside it: the lens's own focal length
        else:
            low, high = widest, narrowest
            while high / low > 1 + 1e-7:
                middle = math.sqrt(low * high)
                low, high = (low, middle) if self._is_covered(border / (fx, fy) / middle) else (middle, high)
            zoom = high
        return fx * zoom, fy * zoom, cx, cy

    def undistortion_maps(self, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the maps for `cv2.remap`: the pixel of the distorted frame for each pixel of `camera`'s view.

        `camera` may be of another size than the lens; the distorted frame is then of that size too.
        """
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        plane = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
        # OpenCV's pixel centres are whole numbers, this project's at +0.5.
        source = self.distort(plane) * (camera.width / self.width, camera.height / self.height) - 0.5
        source = source.reshape(camera.height, camera.width, 2).astype(np.float32)
        return np.ascontiguousarray(source[..., 0]), np.ascontiguousarray(source[..., 1])

    @property
    def max_distortion_px(self) -> float:
        """Largest distance, in pixels, between the lens's and a pinhole's image of a border point."""
        plane = (self.border - self.centre) / self.focal
        straight = plane * self.focal + self.centre
        return float(np.nan_to_num(np.linalg.norm(self.distort(plane) - straight, axis=1), nan=np.inf).max())

    @property
    def border(self) -> Floats:
        """Points (n, 2) along the edge of the frame, pixels."""
        t = np.linspace(0.0, 1.0, 33)
        x, y, zero, ones = t * self.width, t * self.height, np.zeros(33), np.ones(33)
        return np.concatenate([np.stack(side, axis=1) for side in (
            (x, zero), (x, ones * self.height), (zero, y), (ones * self.width, y))])

    def _is_covered(self, border: Floats) -> bool:
        """Return whether the frame covers a view with this border (n, 2), as X/Z and Y/Z.

        Along 16 points from the centre to each border point, the distorted radius must grow: a polynomial that folds
        back shows the frame a second time, mirrored.
        """
        fractions = np.linspace(0.0, 1.0, 17)[1:, None, None]
        pixels = self.distort((fractions * border).reshape(-1, 2)).reshape(16, -1, 2)
        radius = np.linalg.norm(pixels - self.distort(np.zeros((1, 2))), axis=2)
        inside = (pixels[-1] >= -1e-6) & (pixels[-1] <= np.array([self.width, self.height]) + 1e-6)
        is_outward = radius[-1] > 1e-9  # a border point on the principal point itself is not further out
        return bool(inside.all() and (np.diff(radius, axis=0) > 0)[:, is_outward].all())


def undistort_picture(picture: Picture, maps: tuple[NDArray[np.float32], NDArray[np.float32]]) -> Picture:
    """Remap a distorted picture by `Lens.undistortion_maps`."""
    import cv2

    # Cubic is sharper, but rings where linear light steps from 1 to 100.
    interpolation = cv2.INTER_CUBIC if picture.encoding == "srgb" else cv2.INTER_LINEAR
    pixels = np.asarray(cv2.remap(picture.pixels, *maps, interpolation, borderMode=cv2.BORDER_REPLICATE), np.float32)
    return Picture(np.clip(pixels, 0.0, 1.0) if picture.encoding == "srgb" else pixels, picture.encoding)


def _brown_conrady(x: Floats, y: Floats, p: Parameters, numerator: str, denominator: str = "") -> tuple[Floats, Floats]:
    """Distort coordinates by Brown and Conrady's terms: radial, tangential (p1, p2) and thin prism (sx, sy).

    x, y: normalised coordinates, (n,) each, as are the results. numerator, denominator: names of the coefficients of
    the radial quotient of polynomials; "" for no denominator. A coefficient that the lens does not have is 0.
    """
    r2 = x * x + y * y
    radial = _even_polynomial(r2, [p.get(name, 0.0) for name in numerator.split()])
    if denominator:
        radial = radial / _even_polynomial(r2, [p.get(name, 0.0) for name in denominator.split()])
    p1, p2, sx, sy = (p.get(name, 0.0) for name in ("p1", "p2", "sx", "sy"))
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + sx * r2,
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + sy * r2)


def _even_polynomial(r2: Floats, coefficients: list[float]) -> Floats:
    """Return 1 + c1 r^2 + c2 r^4 + ..., from r^2."""
    total = np.zeros_like(r2)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * r2
    return 1.0 + total


def _pinhole(x: Floats, y: Floats, _p: Parameters) -> tuple[Floats, Floats]:
    return x, y


def _perspective(x: Floats, y: Floats, p: Parameters) -> tuple[Floats, Floats]:
    return _brown_conrady(x, y, p, "k1 k2 k3", "k4 k5 k6")


def _equidistant(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Map directions to the plane on which the distance from the centre is the angle."""
    r = np.sqrt(x * x + y * y)
    ratio = np.where(r > 1e-8, np.arctan(r) / np.maximum(r, 1e-8), 1.0)
    return x * ratio, y * ratio


def _fisheye(x: Floats, y: Floats, p: Parameters) -> tuple[Floats, Floats]:
    return _brown_conrady(*_equidistant(x, y), p, "k1 k2 k3 k4")


def _project_aria(x: Floats, y: Floats, p: Parameters) -> tuple[Floats, Floats]:
    """Apply radial terms first, then tangential and prism terms of the result ("FISHEYE624" of Project Aria)."""
    x, y = _equidistant(x, y)
    radial = _even_polynomial(x * x + y * y, [p[f"k{i}"] for i in range(1, 7)])
    x, y = x * radial, y * radial
    r2 = x * x + y * y
    return (x + 2 * p["p2"] * x * y + p["p1"] * (r2 + 2 * x * x) + p["s1"] * r2 + p["s2"] * r2 * r2,
            y + 2 * p["p1"] * x * y + p["p2"] * (r2 + 2 * y * y) + p["s3"] * r2 + p["s4"] * r2 * r2)


def _fov(x: Floats, y: Floats, p: Parameters) -> tuple[Floats, Floats]:
    """Devernay and Faugeras 2001: r_d = atan(2 r tan(omega / 2)) / omega, from the radius r to the distorted r_d."""
    omega, r = p["omega"], np.sqrt(x * x + y * y)
    if abs(omega) < 1e-6:
        return x, y
    scale = 2 * math.tan(omega / 2)
    ratio = np.where(r > 1e-8, np.arctan(r * scale) / (np.maximum(r, 1e-8) * omega), scale / omega)
    return x * ratio, y * ratio


def _division(x: Floats, y: Floats, p: Parameters) -> tuple[Floats, Floats]:
    """Fitzgibbon 2001: r = r_d / (1 + k r_d^2), solved for r_d; r and r_d are the undistorted and distorted radius."""
    ratio = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * p["k"] * (x * x + y * y)))
    return x * ratio, y * ratio


def _eucm(x: Floats, y: Floats, p: Parameters) -> tuple[Floats, Floats]:
    rho = np.sqrt(p["beta"] * (x * x + y * y) + 1.0)
    denominator = p["alpha"] * rho + 1.0 - p["alpha"]
    denominator = np.where(denominator > 0, denominator, np.nan)
    return x / denominator, y / denominator


def _equirectangular(x: Floats, y: Floats, _p: Parameters) -> tuple[Floats, Floats]:
    return np.arctan(x), np.arctan(y / np.sqrt(1.0 + x * x))


_FISHEYES = frozenset({"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
                       "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"})
_EQUATIONS: dict[str, Callable[[Floats, Floats, Parameters], tuple[Floats, Floats]]] = {
    **dict.fromkeys(MODELS, _perspective),
    **dict.fromkeys(_FISHEYES, _fisheye),
    **dict.fromkeys(PINHOLES, _pinhole),
    "RAD_TAN_THIN_PRISM_FISHEYE": _project_aria,
    "FOV": _fov,
    "SIMPLE_DIVISION": _division,
    "DIVISION": _division,
    "EUCM": _eucm,
    "EQUIRECTANGULAR": _equirectangular,
}
