# SPDX-License-Identifier: GPL-3.0-or-later
"""The results of a fit about its lights: brightness in held-out frames, shares of the flare, the run's lights.json.

The trainers call it before a run is written, and `run` reads the file.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ..capture import Capture, View
from ..capture.discs import CLIP_LEVEL, DISC_RADIUS, squared_light_distances
from ..colour.srgb import linear_from_srgb
from ..conventions.splatting import C0
from ..flare.frame_lights import FrameLights
from ..flare.model import FlareModel
from ..system.files import round_for_text, write_json
from ..system.least_squares import robust_bounded_fit
from .frames import Frames, Targets, subsample
from .rendering import RenderedView

RenderView = Callable[[View], RenderedView]

MIN_SHARE = 0.005
"""Share of all flare light below which a light counts as one that does not flare."""
MIN_PEAK = 0.002
"""Linear light that a flare has to exceed somewhere outside its light's disc: about half a code of 8 bits."""
PEAK_QUANTILE = 0.999
"""Quantile of a flare's pixels that counts as its peak."""
SAMPLED_VIEWS = 40
"""Approximate number of views in which shares are measured."""
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
FLARE_ERROR, OUTSIDE_ERROR, PRIOR_ERROR = 0.1, 2.0, 0.1
"""Standard deviations of a brightness by the flare, at the least, of one by the flare of a light outside the frame, and
of one in the lights' file: a plate that holds part of the flare biases the first, the second has only ghosts, and
clipping and glare bias the third."""
EDGE_SHARE = 0.03
"""Distance from the frame's edge, as a share of its width, within which a light counts as outside for its brightness:
its core may be cut off."""
MIN_PRIOR_CONFIDENCE = 0.5
"""Confidence of a key of a light below which its brightness is only a first guess."""
TV_REWEIGHTINGS, TV_EPSILON = 30, 1e-3


@torch.no_grad()
def solve_brightness(flare: FlareModel, views: Sequence[View], frames: Frames, render_view: RenderView) -> None:
    """Set the brightness of the lights in these views, which are in the order of the shot.

    The present flares at that brightness explain frame - scene best. Where a frame leaves it uncertain, the brightness
    in the lights' file and that of the neighbouring frames decide (`smooth_with_steps`). The flare stays as it is:
    held-out frames give the places and the brightness of lights, and nothing else.
    """
    lights = flare.frame_lights
    if lights is None:
        return
    weight = lights.brightness.weight
    rows = [lights.rows[view.name] for view in views]
    solved, certainty = np.zeros((2, len(views), len(flare.names)))
    for number, (view, row) in enumerate(zip(views, rows, strict=True)):
        start = weight[row].clamp(0, MAX_BRIGHTNESS).numpy().astype(np.float64)
        weight[row] = 1.0  # so that the layers have their usual strength
        rendered = render_view(view)
        columns = [rendered.layers.flares[name].numpy() if name in rendered.layers.flares else None
                   for name in flare.names]
        solved[number], certainty[number] = _solve(frames.targets(view), rendered.layers.scene.numpy(), columns, start)
    prior = lights.prior[rows].numpy().astype(np.float64)
    prior_certainty = np.isfinite(prior) / PRIOR_ERROR**2
    inside = np.array([_lights_in_frame(lights, view, EDGE_SHARE) for view in views])
    certainty = np.minimum(certainty, 1 / np.where(inside, FLARE_ERROR, OUTSIDE_ERROR) ** 2)
    total = certainty + prior_certainty
    solved = (certainty * solved + prior_certainty * np.nan_to_num(prior)) / np.maximum(total, 1e-9)
    for light in range(len(flare.names)):
        smooth = smooth_with_steps(solved[:, light], total[:, light])
        weight[rows, light] = torch.from_numpy(smooth.clip(0, MAX_BRIGHTNESS)).float()


def _lights_in_frame(lights: FrameLights, view: View, edge: float = 0.0) -> NDArray[np.bool_]:
    """Return (lights,) which lights lie on the frame of a view. edge: width of its border that does not count, as a
    share of the frame's width."""
    camera = view.camera
    pixels, depth = camera.project(lights.positions[lights.rows[view.name]].numpy())
    margin = edge * camera.width
    return camera.contains(pixels, depth) & camera.contains(pixels - margin, depth) & camera.contains(
        pixels + margin, depth)


def smooth_with_steps(values: NDArray[np.float64], certainty: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x (n,) that minimises sum certainty (x - values)^2 / 2 + sum |change of x| / STEP_SCALE.

    certainty: 1 / variance of each value. It is total variation denoising, by reweighted least squares.
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
    """Solve (diag(weights) + the Laplacian of a chain with these springs) x = target, by elimination."""
    diagonal = weights.copy()
    diagonal[:-1] += springs
    diagonal[1:] += springs
    right = target.copy()
    for index in range(1, len(target)):
        factor = springs[index - 1] / diagonal[index - 1]
        diagonal[index] -= factor * springs[index - 1]
        right[index] += factor * right[index - 1]
    solution = right / diagonal
    for index in range(len(target) - 2, -1, -1):
        solution[index] += springs[index] * solution[index + 1] / diagonal[index]
    return solution


def _solve(targets: Targets, scene: NDArray[np.float32], flares: Sequence[NDArray[np.float32] | None],
           start: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the strengths (lights,) of flares (height, width, 3), linear light, in a frame over its scene, and their
    certainty, 1 / variance.

    flares: None for a light behind the camera. start: (lights,) present strengths, which stay, with a certainty of 0,
    where a light has no flare in the frame.
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
    # If errors were independent, the variance of a strength would be variances / energies, by the squared errors at
    # each pixel (White 1980); but `area` pixels count as one. The last term keeps the certainty finite.
    variances = (np.square(columns) * residual[:, None] ** 2).sum(0) / np.maximum(energies, 1e-12)
    area = CORRELATION_SHARE * len(light)
    certainty[present] = energies / (area * variances + 1e-6 * area)
    return solved, certainty


@torch.no_grad()
def normalise_brightness(flare: FlareModel, views: Sequence[View]) -> None:
    """Scale each light so that its brightness is 1 in the brightest of these views, and its flare to match.

    Views with the light in the frame decide, if there are any: elsewhere its brightness is uncertain.
    """
    lights = flare.frame_lights
    if lights is None:
        return
    for number, light in enumerate(flare.lights):
        inside = [lights.rows[view.name] for view in views if _lights_in_frame(lights, view)[number]]
        rows = inside or [lights.rows[view.name] for view in views]
        brightest = float(lights.brightness.weight[rows, number].max())
        if brightest <= 0:
            continue
        lights.brightness.weight[:, number] /= brightest
        _scale_colours(light.gaussians["sh"], light.network.head, light.network.names, light.network.widths, brightest)


def _scale_colours(sh: torch.Tensor, head: nn.Linear, names: Sequence[str], widths: Sequence[int],
                   factor: float) -> None:
    """Multiply the colours 0.5 + C0 (sh + change) + ... of Gaussians by a factor, `change` the network's offset.

    names, widths: the parts of the output of `head`, the network's last layer.
    """
    sh *= factor
    sh[:, :3] += (factor - 1) * 0.5 / C0
    first = sum(widths[:names.index("sh")])
    rows = slice(first, first + widths[names.index("sh")])
    head.weight[rows] *= factor
    head.bias[rows] *= factor


@torch.no_grad()
def flare_shares(flare: FlareModel, views: Sequence[View], frames: Frames,
                 render_view: RenderView) -> dict[str, tuple[float, float]]:
    """Return (share of all flare light 0..1, peak in linear light) of each light's flare, by the light's name.

    Both are measured outside the lights' discs: the picture of a lamp is no flare.
    """
    sums, peaks = dict.fromkeys(flare.names, 0.0), dict.fromkeys(flare.names, 0.0)
    for view in subsample(views, SAMPLED_VIEWS):
        camera = frames.targets(view).camera
        outside = squared_light_distances(camera, flare.positions_in(camera.frame).numpy()) > DISC_RADIUS**2
        for name, layer in render_view(view).layers.flares.items():
            light = np.abs(layer.numpy()).mean(-1)[outside]
            if light.size:
                sums[name] += float(light.mean())
                peaks[name] = max(peaks[name], float(np.quantile(light, PEAK_QUANTILE)))
    total = sum(sums.values())
    return {name: (sums[name] / total if total else 0.0, peaks[name]) for name in flare.names}


def select_flaring(shares: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the names of the lights that flare; the one with the largest share if none does."""
    flaring = [name for name in shares if _flares(shares[name])]
    return flaring or [max(shares, key=lambda name: shares[name])]


def _flares(share_and_peak: tuple[float, float]) -> bool:
    """Return whether a light with this share of all flare light, and this peak, flares."""
    share, peak = share_and_peak
    return share >= MIN_SHARE and peak >= MIN_PEAK


def share_sentences(shares: Mapping[str, tuple[float, float]], flaring: Sequence[str]) -> list[str]:
    """Return sentences for the user about the lights' shares. flaring: the lights that the .flare has."""
    if not any(map(_flares, shares.values())):
        return [f"No light of the capture flares: the flare of each is below {MIN_PEAK:g} of white everywhere. The "
                f"flare layers of this run are dark, and its .flare has {', '.join(flaring)} alone."]
    listed = ", ".join(f"{name} {100 * share:.1f} %" for name, (share, _) in
                       sorted(shares.items(), key=lambda item: -item[1][0]))
    sentences = [f"Shares of the flare by light: {listed}."]
    if left_out := [name for name in shares if name not in flaring]:
        sentences.append(f"Left out of the .flare, since they do not flare (less than {100 * MIN_SHARE:g} % of the "
                         f"flare, or below {MIN_PEAK:g} of white everywhere): {', '.join(left_out)}.")
    return sentences


def without_other_lights(flare: FlareModel, names: Sequence[str]) -> FlareModel:
    """Return the model with only these lights, in the model's order."""
    rows = [row for row, name in enumerate(flare.names) if name in names]
    lights = flare.frame_lights
    if lights is not None:
        selected = FrameLights(list(lights.rows), lights.positions[:, rows], lights.prior[:, rows])
        with torch.no_grad():
            selected.brightness.weight.copy_(lights.brightness.weight[:, rows])
        lights = selected
    model = FlareModel([flare.names[row] for row in rows], flare.positions[rows],
                       [flare.lights[row] for row in rows], lights)
    model.clear.copy_(flare.clear[rows])
    return model


def write_frame_lights(path: Path, capture: Capture, flare: FlareModel) -> None:
    """Write lights.json of a run: the lights of the capture with their places and fitted brightness, by frame.

    Lights that are not in `flare` have no brightness. Nothing is written where all lights are static and always on.
    """
    lights = flare.frame_lights
    if lights is None:
        return
    brightness = lights.brightness.weight.detach().clamp(0, 1).numpy()
    entries: list[dict[str, Any]] = []
    for light in capture.lights:
        entry: dict[str, Any] = {"name": light.name}
        frames: dict[str, Any] = {}
        for name, row in lights.rows.items():
            state = capture.light_state(light, capture.view(name))
            place = "xy" if light.is_on_picture else "xyz"
            frames[name] = {place: [round_for_text(float(value)) for value in getattr(state, place)]}
            if light.name in flare.names:
                frames[name]["on"] = round_for_text(float(brightness[row, flare.names.index(light.name)]))
            if state.confidence < 1:
                frames[name]["confidence"] = state.confidence
        entries.append({**entry, "frames": frames})
    write_json(path, {"lights": entries})


def read_frame_lights(capture: Capture, names: Sequence[str]) -> FrameLights:
    """Return places and brightness of these lights of a capture, in every view.

    An unknown brightness starts at 1. A fit starts from a doubtful one, but it has no prior (NaN), as an unknown one.
    """
    by_name = {light.name: light for light in capture.lights}
    states = [[capture.light_state(by_name[name], view) for name in names] for view in capture.views]
    positions = torch.tensor(np.array([[state.xyz for state in row] for row in states]), dtype=torch.float64)
    prior = torch.tensor([[np.nan if state.on is None else state.on for state in row] for row in states])
    lights = FrameLights([view.name for view in capture.views], positions, prior)
    doubtful = torch.tensor([[state.confidence < MIN_PRIOR_CONFIDENCE for state in row] for row in states])
    lights.prior.masked_fill_(doubtful, math.nan)
    return lights
