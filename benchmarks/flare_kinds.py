# SPDX-License-Identifier: GPL-3.0-or-later
"""Which kinds of light the error of a fitted flare is made of: `python benchmarks/flare_kinds.py RUN --scene NAME`.

RUN is a fit of the sample capture NAME, whose flare is traced kind by kind: ghosts, starburst, glow, rings, streaks.
The squared error of the linear flare, without clipped pixels, is shared out in each pixel of the held-out views by the
light of each kind there. Ghosts are divided into their edges and their faces, starburst and glow into their core and
what lies beyond. Prints a table for Markdown.
"""
from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.hidden_lights import SHARES
from core.capture import Camera
from core.capture.discs import squared_light_distances
from core.errors import CaptureError
from core.fit.run import Run
from core.metrics.evaluation import unscored_mask
from core.optics.flare import LensSetup, render_flare
from core.system.files import read_json
from sample_scenes.description import LightSource, SceneDescription
from sample_scenes.flares import LENS_SETUPS
from sample_scenes.scenes import SCENES

Layer = NDArray[np.float64]

CORE = 0.02
"""Radius of the core of starburst and glow, share of the frame's width."""
EDGE = 0.25
"""A ghost's pixel lies on an edge where the light changes, over one pixel, by more than this share of its own."""


def kinds_of(setup: LensSetup) -> dict[str, LensSetup]:
    """Return a setup for each kind of light, which draws that kind alone; kinds that the lens lacks are left out."""
    nothing = replace(setup, ghosts=replace(setup.ghosts, gain=0.0), rings=(), streaks=(),
                      starburst=replace(setup.starburst, gain=0.0),
                      glow=replace(setup.glow, gain=0.0, wide_gain=0.0, floor=0.0))
    kinds = {"ghosts": replace(nothing, ghosts=setup.ghosts), "starburst": replace(nothing, starburst=setup.starburst),
             "glow": replace(nothing, glow=setup.glow), "rings": replace(nothing, rings=setup.rings),
             "streaks": replace(nothing, streaks=setup.streaks)}
    return {name: kind for name, kind in kinds.items() if kind != nothing}


def draw_kinds(setup: LensSetup, camera: Camera, lights: tuple[LightSource, ...], shares: dict[str, float]
               ) -> dict[str, Layer]:
    """Return the light of each kind, (height, width), the mean of the channels.

    shares: visible share of each light, by name.
    """
    layers = {name: np.zeros((camera.height, camera.width)) for name in kinds_of(setup)}
    for light in lights:
        position = camera.world_to_camera[:3, :3] @ np.array(light.xyz) + camera.world_to_camera[:3, 3]
        strength = light.flare_strength(float(np.linalg.norm(position)))
        for name, kind in kinds_of(setup).items():
            layers[name] += render_flare(kind, camera, position, colour=light.colour, intensity=strength,
                                         visible_share=shares[light.name]).mean(axis=2)
    return layers


def partition(layers: dict[str, Layer], near_light: NDArray[np.bool_]) -> dict[str, Layer]:
    """Return the light of each kind, (height, width), with ghosts, starburst and glow partitioned by place.

    near_light: (height, width), true in the core of starburst and glow.
    """
    parts = {}
    for name, layer in layers.items():
        if name == "ghosts":
            is_first = np.hypot(*np.gradient(layer)) > EDGE * np.maximum(layer, 1e-6)
            first, second = "ghosts, edges", "ghosts, faces"
        elif name in ("starburst", "glow"):
            is_first, first, second = near_light, f"{name}, core", f"{name}, beyond"
        else:
            parts[name] = layer
            continue
        parts[first], parts[second] = layer * is_first, layer * ~is_first
    return parts


def measure(run: Run, scene: SceneDescription) -> dict[str, tuple[float, float, float]]:
    """Return for each kind its share of the light, its share of the squared error, and the mean signed error relative
    to its light, over the held-out views."""
    capture = run.open_capture()
    _, held_out = capture.split(run.settings.holdout)
    setup = LENS_SETUPS[scene.lens]
    shares = read_json(capture.folder / SHARES, CaptureError)
    light: dict[str, float] = {}
    error: dict[str, float] = {}
    bias: dict[str, float] = {}
    for view in held_out:
        camera = view.camera.scaled(min(run.settings.width or view.camera.width, view.camera.width))
        truth = capture.truth_flare(view, camera.size)
        if truth is None:
            raise CaptureError(f"{capture.folder} has no exact flare layers; make it with sample_scenes/render.py.")
        exact = truth.linear().astype(np.float64)
        layers = run.render(camera).flare_by_light.values()
        fitted = sum((layer.astype(np.float64) for layer in layers), np.zeros_like(exact))
        scored = ~unscored_mask(capture, view, camera.size)
        lights = np.array([light.xyz for light in scene.lights])
        kinds = partition(draw_kinds(setup, camera, scene.lights, shares[view.name]),
                          squared_light_distances(camera, lights) < CORE**2)
        total = np.maximum(sum(kinds.values()), 1e-6)
        for name, layer in kinds.items():
            weight = layer / total * scored
            light[name] = light.get(name, 0) + float((exact.mean(axis=2) * weight).sum())
            error[name] = error.get(name, 0) + float((((fitted - exact) ** 2).mean(axis=2) * weight).sum())
            bias[name] = bias.get(name, 0) + float(((fitted - exact).mean(axis=2) * weight).sum())
    all_light, all_error = sum(light.values()), sum(error.values())
    return {name: (light[name] / all_light, error[name] / all_error, bias[name] / max(light[name], 1e-9))
            for name in light}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("run", type=Path, help="folder of a fit of a sample capture")
    parser.add_argument("--scene", default="desk", choices=sorted(SCENES), help="name of the sample capture")
    arguments = parser.parse_args()
    rows = measure(Run.open(arguments.run), SCENES[arguments.scene])
    print("| kind | share of the light | share of the squared error | mean error |\n| --- | ---: | ---: | ---: |")
    for name, (light, error, bias) in sorted(rows.items(), key=lambda row: -row[1][1]):
        print(f"| {name} | {light:.0%} | {error:.0%} | {bias:+.0%} |")


if __name__ == "__main__":
    main()
