# SPDX-License-Identifier: GPL-3.0-or-later
"""Solves the brightness of lights by frame over a fitted flare, and normalises it.

The plate trainer solves it at times during a fit; `flare_trainer` solves and normalises it at the end, in frames that
the fit has not seen too.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ..capture import View
from ..capture.discs import CLIP_LEVEL
from ..colour.srgb import linear_from_srgb
from ..conventions.splatting import C0
from ..flare.frame_lights import FrameLights
from ..flare.model import FlareModel
from ..system.least_squares import robust_bounded_fit
from .frames import Frames, Targets
from .rendering import RenderedView

RenderView = Callable[[View], RenderedView]

MAX_BRIGHTNESS = 4.0
"""Largest brightness that a frame may give a light, relative to its usual one."""
PRIOR_WEIGHT = 1e-6
"""Weight per pixel of the present brightness."""
CORRELATION_SHARE = 0.005
"""Share of a frame's pixels whose errors count as one, because neighbouring errors of a plate are alike."""
STEP_SCALE = 0.2
"""Change of brightness from frame to frame that counts as usual."""
MIN_CERTAINTY = 1e-3
"""Certainty of a brightness that a frame does not show."""
FLARE_ERROR, OUTSIDE_ERROR, PRIOR_ERROR = 0.1, 2.0, 0.25
"""Standard deviations of a brightness by the flare, at the least, of one by the flare of a light outside the frame, and
of one in the lights' file: a plate that holds part of the flare biases the first, the second has only ghosts, and
clipping and glow bias the third."""
EDGE_SHARE = 0.03
"""Distance from the frame's edge, as a share of its width, within which a light counts as outside for its brightness:
its core may be cut off."""
TV_REWEIGHTINGS, TV_EPSILON = 30, 1e-3


@torch.no_grad()
def solve_brightness(flare: FlareModel, views: Sequence[View], frames: Frames, render_view: RenderView) -> None:
    """Set the brightness of the lights in these views, which are in the order of the shot.

    In each view the brightness is fitted, by robust least squares, so that the flares explain frame - scene. It is then
    averaged with the brightness in the lights' file by certainty, and smoothed over the frames by total variation. The
    rest of the flare is unchanged: held-out frames give the brightness of lights, and nothing else.
    """
    lights = flare.frame_lights
    if lights is None:
        return
    brightness = lights.brightness.weight
    rows = [lights.rows[view.name] for view in views]
    solved, certainty = np.zeros((2, len(views), len(flare.names)))
    for number, (view, row) in enumerate(zip(views, rows, strict=True)):
        start = brightness[row].clamp(0, MAX_BRIGHTNESS).cpu().numpy().astype(np.float64)
        brightness[row] = 1.0  # so that the layers have their usual strength
        rendered = render_view(view)
        columns = [rendered.layers.flares[name].numpy() if name in rendered.layers.flares else None
                   for name in flare.names]
        scene = rendered.layers.scene.numpy()
        solved[number], certainty[number] = _solve_frame(frames.targets(view), scene, columns, start)
    prior = lights.prior[rows].numpy().astype(np.float64)
    prior_certainty = np.isfinite(prior) / PRIOR_ERROR**2
    inside = np.array([_lights_in_frame(lights, view, EDGE_SHARE) for view in views])
    certainty = np.minimum(certainty, 1 / np.where(inside, FLARE_ERROR, OUTSIDE_ERROR) ** 2)
    total_certainty = certainty + prior_certainty
    solved = (certainty * solved + prior_certainty * np.nan_to_num(prior)) / np.maximum(total_certainty, 1e-9)
    for light in range(len(flare.names)):
        smooth = smooth_with_steps(solved[:, light], total_certainty[:, light])
        brightness[rows, light] = torch.from_numpy(smooth.clip(0, MAX_BRIGHTNESS)).to(brightness)


def _lights_in_frame(lights: FrameLights, view: View, edge: float = 0.0) -> NDArray[np.bool_]:
    """Return (lights,), True for lights on the frame of a view. edge: width of a border of the frame that does not
    count, as a share of the frame's width."""
    camera = view.camera
    pixels, depth = camera.project(lights.positions[lights.rows[view.name]].numpy())
    margin = edge * camera.width
    return camera.contains(pixels, depth) & camera.contains(pixels - margin, depth) & camera.contains(
        pixels + margin, depth)


def smooth_with_steps(values: NDArray[np.float64], certainty: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x (n,) that minimises sum certainty (x - values)^2 / 2 + sum |change of x| / STEP_SCALE.

    This is total variation denoising, by iteratively reweighted least squares. certainty: 1 / variance of each value.
    """
    smooth = values.copy()
    if len(values) < 2:
        return smooth
    for _ in range(TV_REWEIGHTINGS):
        springs = 1 / (STEP_SCALE * (np.abs(np.diff(smooth)) + TV_EPSILON))
        smooth = _solve_tridiagonal(certainty + MIN_CERTAINTY, springs, (certainty + MIN_CERTAINTY) * values)
    return smooth


def _solve_tridiagonal(weights: NDArray[np.float64], springs: NDArray[np.float64],
                       target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve (diag(weights) + L) x = target by elimination (Thomas algorithm).

    L is the Laplacian of a chain: spring i pulls x[i] and x[i + 1] together. weights, target, x: (n,). springs:
    (n - 1,) stiffnesses.
    """
    diagonal = weights.copy()
    diagonal[:-1] += springs
    diagonal[1:] += springs
    rhs = target.copy()
    for index in range(1, len(target)):
        factor = springs[index - 1] / diagonal[index - 1]
        diagonal[index] -= factor * springs[index - 1]
        rhs[index] += factor * rhs[index - 1]
    solution = rhs / diagonal
    for index in range(len(target) - 2, -1, -1):
        solution[index] += springs[index] * solution[index + 1] / diagonal[index]
    return solution


def _solve_frame(targets: Targets, scene: NDArray[np.float32], flares: Sequence[NDArray[np.float32] | None],
                 start: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the strengths (lights,) at which the flares explain frame - scene, and their certainty, 1 / variance.

    scene: (height, width, 3), linear light. flares: (height, width, 3) each, linear light, None for a light behind the
    camera. start: (lights,) present strengths; a light without flare in the frame keeps its own, with certainty 0.
    """
    solved, certainty = start.copy(), np.zeros(len(start))
    present = [number for number, flare in enumerate(flares) if flare is not None and flare.max() > 0]
    frame = targets.frame.numpy()
    usable = (frame < CLIP_LEVEL).all(-1)
    if not present or not usable.any():
        return solved, certainty
    light = (linear_from_srgb(frame) - scene)[usable].ravel().astype(np.float64)
    columns = np.stack([np.asarray(flares[number])[usable].ravel() for number in present], 1).astype(np.float64)
    solved[present] = robust_bounded_fit(columns, light, start[present], 0.0, MAX_BRIGHTNESS, PRIOR_WEIGHT)
    residual = light - columns @ solved[present]
    energies = np.square(columns).sum(0)
    # White's (1980) estimate of a strength's variance, from the squared error at each pixel, is variances / energies.
    # It expects independent errors; here `area` pixels count as one. The last term keeps the certainty finite.
    variances = (np.square(columns) * residual[:, None] ** 2).sum(0) / np.maximum(energies, 1e-12)
    area = CORRELATION_SHARE * len(light)
    certainty[present] = energies / (area * variances + 1e-6 * area)
    return solved, certainty


@torch.no_grad()
def normalise_brightness(flare: FlareModel, views: Sequence[View]) -> None:
    """Scale each light's brightness to 1 in the brightest of these views, and its flare's colours by the inverse.

    Only views with the light in the frame count, if there are any: in others its brightness is uncertain.
    """
    lights = flare.frame_lights
    if lights is None:
        return
    for number, light in enumerate(flare.lights):
        rows_in_frame = [lights.rows[view.name] for view in views if _lights_in_frame(lights, view)[number]]
        rows = rows_in_frame or [lights.rows[view.name] for view in views]
        brightest = float(lights.brightness.weight[rows, number].max())
        if brightest <= 0:
            continue
        lights.brightness.weight[:, number] /= brightest
        _scale_colours(light.gaussians["sh"], light.network.head, light.network.names, light.network.widths, brightest)


def _scale_colours(sh: torch.Tensor, head: nn.Linear, names: Sequence[str], widths: Sequence[int],
                   factor: float) -> None:
    """Multiply the colours of Gaussians by a factor, in place.

    A colour is 0.5 + C0 (sh + change) + ..., where the network's output `change` varies with the light's position. sh:
    (n, 3 k) coefficients. head: last layer of the network. names, widths: names and widths of the parts of its output.
    """
    sh *= factor
    sh[:, :3] += (factor - 1) * 0.5 / C0
    start = sum(widths[:names.index("sh")])
    rows = slice(start, start + widths[names.index("sh")])
    head.weight[rows] *= factor
    head.bias[rows] *= factor
