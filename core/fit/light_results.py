# SPDX-License-Identifier: GPL-3.0-or-later
"""The results of a fit about its lights: their shares of the flare, and the run's lights.json.

The trainers call it before a run is written, and `run` reads the file.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..capture import Capture, View
from ..capture.discs import DISC_RADIUS, squared_light_distances
from ..flare.frame_lights import FrameLights
from ..flare.model import FlareModel
from ..system.files import round_for_text, write_json
from .frames import Frames, subsample
from .light_brightness import RenderView

MIN_SHARE = 0.005
"""Share of all flare light below which a light counts as one that does not flare."""
MIN_PEAK = 0.002
"""Linear light that a flare has to exceed somewhere outside its light's disc: about half a code of 8 bits."""
PEAK_QUANTILE = 0.999
"""Quantile of a flare's pixels that counts as its peak."""
SAMPLED_VIEWS = 40
"""Approximate number of views in which shares are measured."""
MIN_PRIOR_CONFIDENCE = 0.5
"""Confidence of a key of a light below which its brightness is only a first guess."""


class FlareShare(NamedTuple):
    """A light's share of all flare light, 0..1, and the peak of its flare in linear light."""

    share: float
    peak: float

    @property
    def is_visible(self) -> bool:
        """Return whether the light counts as one that flares."""
        return self.share >= MIN_SHARE and self.peak >= MIN_PEAK


@torch.no_grad()
def flare_shares(flare: FlareModel, views: Sequence[View], frames: Frames,
                 render_view: RenderView) -> dict[str, FlareShare]:
    """Return share and peak of each light's flare, by the light's name.

    Both are measured in some of the views, outside the lights' discs: the picture of a lamp itself is no flare.
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
    return {name: FlareShare(sums[name] / total if total else 0.0, peaks[name]) for name in flare.names}


def select_flaring(shares: Mapping[str, FlareShare]) -> list[str]:
    """Return the names of the lights that flare; the one with the largest share if none does."""
    flaring = [name for name, share in shares.items() if share.is_visible]
    return flaring or [max(shares, key=lambda name: shares[name])]


def share_messages(shares: Mapping[str, FlareShare], flaring: Sequence[str]) -> list[str]:
    """Return messages to the user on the lights' shares of the flare. flaring: names of the lights that the .flare
    keeps."""
    if not any(share.is_visible for share in shares.values()):
        return [f"No light of the capture flares: the flare of each is below {MIN_PEAK:g} of white everywhere. The "
                f"flare layers of this run are dark, and its .flare has {', '.join(flaring)} alone."]
    largest_first = sorted(shares, key=lambda name: -shares[name].share)
    listed = ", ".join(f"{name} {100 * shares[name].share:.1f} %" for name in largest_first)
    messages = [f"Shares of the flare by light: {listed}."]
    if left_out := [name for name in shares if name not in flaring]:
        messages.append(f"Left out of the .flare, since they do not flare (less than {100 * MIN_SHARE:g} % of the "
                        f"flare, or below {MIN_PEAK:g} of white everywhere): {', '.join(left_out)}.")
    return messages


def select_lights(flare: FlareModel, names: Sequence[str]) -> FlareModel:
    """Return the model with only the lights of these names, in the model's order."""
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
    model.move_to(model.device)
    return model


def write_frame_lights(path: Path, capture: Capture, flare: FlareModel) -> None:
    """Write lights.json of a run: the lights of the capture with their places and fitted brightness, by frame.

    A light that is not in `flare` gets no brightness. Nothing is written if all lights are static and always on.
    """
    lights = flare.frame_lights
    if lights is None:
        return
    brightness = lights.brightness.weight.detach().clamp(0, 1).cpu().numpy()
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


def make_frame_lights(capture: Capture, names: Sequence[str]) -> FrameLights:
    """Return places and brightness of these lights of a capture, in every view.

    A known brightness is start and prior of the fit; a doubtful one is the start, without a prior (NaN); an unknown one
    starts at 1 without a prior.
    """
    by_name = {light.name: light for light in capture.lights}
    states = [[capture.light_state(by_name[name], view) for name in names] for view in capture.views]
    positions = torch.tensor(np.array([[state.xyz for state in row] for row in states]), dtype=torch.float64)
    prior = torch.tensor([[np.nan if state.on is None else state.on for state in row] for row in states])
    lights = FrameLights([view.name for view in capture.views], positions, prior)
    doubtful = torch.tensor([[state.confidence < MIN_PRIOR_CONFIDENCE for state in row] for row in states])
    lights.prior.masked_fill_(doubtful, math.nan)
    return lights
