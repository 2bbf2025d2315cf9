# SPDX-License-Identifier: GPL-3.0-or-later
"""Render a sample shot: `python sample_scenes/render_shot.py --shot torch --seed 0 --out FOLDER`.

    images/0001.png           frames: sRGB(clip(scene + flare + noise)), 8 bit
    truth/scene/, truth/flare/    exact layers, scene-linear half-float EXR; truth/flare_NAME/ the flare of one light
    truth/clean/              exact clean frames, with the noise of the frames
    truth/lights.json         the path of each light on the picture, and its brightness
    truth/camera.json         focal length; for the pan also world_to_camera rotations by frame
    split.json                held-out frames: every eighth

The folder has no lights.json, no camera solve and no removed/, so that nothing is known in advance.
"""
from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.images.read import read_picture
from core.images.write import write_png
from core.system.files import write_json
from core.system.progress import Progress
from sample_scenes.capture_files import FLARE_LEVEL, SCENE_LEVEL, expose, write_layer
from sample_scenes.command import run_command
from sample_scenes.flares import LENS_SETUPS, LensSetup, render_flare
from sample_scenes.raycast import Hits, average, camera_rays, cast, shade, visible_share
from sample_scenes.shot_scenes import FRAMES, SHOTS, FrameState, ShotScene

CACHE = Path(__file__).resolve().parents[1] / "build" / "sample_shots"


def draft_setup(name: str) -> LensSetup:
    """Return a lens setup with fewer ghosts, traced more coarsely, ten times as fast."""
    setup = LENS_SETUPS[name]
    return replace(setup, ghosts=replace(setup.ghosts, count=12, grid=24, bands=5, supersample=1))


def render_scene(scene: ShotScene, state: FrameState, standing: Hits | None) -> NDArray[np.float32]:
    """Return the scene layer of a frame, (height, width, 3), linear.

    standing: hits of the rectangles that do not move, where the camera stands too; None to cast their rays here.
    """
    rays = camera_rays(scene.camera, state.rotation)
    hits = standing if standing is not None else cast(scene.quads, state.eye, rays)
    if state.moving:
        hits = cast(state.moving, state.eye, rays).nearer(hits)
    return average(shade(hits, state.eye, rays, list(state.lamps.values()), scene.ambient), scene.camera)


def light_values(scene: ShotScene, state: FrameState) -> dict[str, dict[str, Any]]:
    """Return values of each light in a frame, by its name.

    local: place (3,) in camera axes. xy: pixels. share: visible part of its disc, 0..1. strength: of its flare.
    """
    values = {}
    for name, lamp in state.lamps.items():
        local = state.rotation @ (lamp.xyz - state.eye)
        camera = scene.camera
        share = visible_share(lamp, state.eye, [*scene.quads, *state.moving])
        values[name] = {
            "local": local, "share": share,
            "xy": [camera.fx * local[0] / local[2] + camera.cx, camera.fy * local[1] / local[2] + camera.cy],
            "strength": share * state.strengths[name] * (scene.reference / float(np.linalg.norm(local))) ** 2}
    return values


def make_shot(name: str, seed: int, out: Path, progress: Progress) -> None:
    """Make the whole folder; frames whose files all exist are kept.

    A frame and its clean frame have the same noise.
    """
    scene = SHOTS[name](seed)
    setup = draft_setup(scene.lens)
    names = [f"{index + 1:04d}" for index in range(FRAMES)]
    states = [scene.state(index) for index in range(FRAMES)]
    values = [light_values(scene, state) for state in states]
    write_truth(name, scene, states, values, out, names)
    first_rays = camera_rays(scene.camera, states[0].rotation)
    standing = cast(scene.quads, states[0].eye, first_rays) if scene.standing else None
    progress.stage("render", FRAMES)
    for index, (stem, state) in enumerate(zip(names, states, strict=True)):
        truth = out / "truth"
        lights = {light: truth / f"flare_{light}" / f"{stem}.exr" for light in state.lamps}
        files = [*lights.values(), truth / "scene" / f"{stem}.exr", truth / "flare" / f"{stem}.exr",
                 truth / "clean" / f"{stem}.png", out / "images" / f"{stem}.png"]
        if not all(path.is_file() for path in files):
            write_layer(truth / "scene" / f"{stem}.exr", render_scene(scene, state, standing), SCENE_LEVEL)
            layers = []
            for light, path in lights.items():
                value = values[index][light]
                flare = render_flare(setup, scene.camera, value["local"], colour=tuple(state.lamps[light].colour),
                                     intensity=value["strength"])
                write_layer(path, flare, FLARE_LEVEL)
                layers.append(read_picture(path).pixels)
            flare = np.sum(layers, axis=0, dtype=np.float32)
            write_layer(truth / "flare" / f"{stem}.exr", flare, FLARE_LEVEL)
            # The frames are made of the layers as stored, so that the files agree.
            flare, picture = (read_picture(truth / layer / f"{stem}.exr").pixels for layer in ("flare", "scene"))
            write_png(truth / "clean" / f"{stem}.png", expose(picture, np.random.default_rng((seed, index))))
            write_png(out / "images" / f"{stem}.png", expose(picture + flare, np.random.default_rng((seed, index))))
        progress.advance()


def write_truth(name: str, scene: ShotScene, states: list[FrameState], values: list[dict[str, dict[str, Any]]],
                out: Path, names: list[str]) -> None:
    """Write truth/lights.json, truth/camera.json and split.json.

    values: of `light_values`, by frame. names: stems of the frames. "on" is the strength of a light's flare,
    relative to its largest in the shot.
    """
    lights = []
    for light in states[0].lamps:
        largest = max(value[light]["strength"] for value in values)
        frames = {f"{stem}.png": {"xy": [round(float(x), 3) for x in value[light]["xy"]],
                                  "on": round(value[light]["strength"] / largest, 5),
                                  "visible": round(value[light]["share"], 4)}
                  for stem, value in zip(names, values, strict=True)}
        lights.append({"name": light, "frames": frames})
    write_json(out / "truth" / "lights.json", {"lights": lights})
    camera: dict[str, Any] = {"focal_px": scene.camera.fx, "width": scene.camera.width, "height": scene.camera.height,
                              "cx": scene.camera.cx, "cy": scene.camera.cy}
    if name == "pan":
        camera["pan"] = [state.rotation.tolist() for state in states]
    write_json(out / "truth" / "camera.json", camera)
    write_json(out / "split.json", {"test": [f"{stem}.png" for stem in names[4::8]]})


def main() -> int:
    """Make the shot that the arguments name; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shot", choices=sorted(SHOTS), required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder to write; else build/sample_shots/SHOT_SEED")
    args = parser.parse_args()
    out = args.out or CACHE / f"{args.shot}_{args.seed}"
    return run_command(lambda progress: make_shot(args.shot, args.seed, out, progress))


if __name__ == "__main__":
    raise SystemExit(main())
