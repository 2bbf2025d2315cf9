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
from typing import Any, NamedTuple

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
from sample_scenes.raycast import Hits, average_rays, camera_rays, cast_rays, shade, visible_share
from sample_scenes.shot_scenes import FRAMES, SHOTS, FrameState, ShotScene

CACHE = Path(__file__).resolve().parents[1] / "build" / "sample_shots"


def draft_setup(name: str) -> LensSetup:
    """Return a lens setup with fewer ghosts, traced more coarsely, ten times as fast."""
    setup = LENS_SETUPS[name]
    return replace(setup, ghosts=replace(setup.ghosts, count=12, grid=24, bands=5, supersample=1))


def render_scene(scene: ShotScene, state: FrameState, fixed_hits: Hits | None) -> NDArray[np.float32]:
    """Return the scene layer of a frame, (height, width, 3), linear.

    fixed_hits: hits of the rectangles that do not move, if the camera does not move either; None to cast rays here.
    """
    rays = camera_rays(scene.camera, state.rotation)
    hits = fixed_hits if fixed_hits is not None else cast_rays(scene.quads, state.eye, rays)
    if state.moving:
        hits = cast_rays(state.moving, state.eye, rays).nearer(hits)
    return average_rays(shade(hits, state.eye, rays, list(state.lamps.values()), scene.ambient), scene.camera)


class LightInFrame(NamedTuple):
    """A light as one frame shows it."""

    camera_xyz: NDArray[np.float64]
    """(3,), in the camera's axes."""
    xy: tuple[float, float]
    """Pixels."""
    visible_share: float
    """Share of its disc that nothing hides, 0..1."""
    flare_strength: float


def lights_in_frame(scene: ShotScene, state: FrameState) -> dict[str, LightInFrame]:
    """Return, by name, where each light of a frame is, how much of it is visible, and the strength of its flare."""
    lights, camera = {}, scene.camera
    for name, lamp in state.lamps.items():
        camera_xyz = state.rotation @ (lamp.xyz - state.eye)
        x, y, z = camera_xyz
        share = visible_share(lamp, state.eye, [*scene.quads, *state.moving])
        falloff = (scene.reference_distance / float(np.linalg.norm(camera_xyz))) ** 2
        lights[name] = LightInFrame(camera_xyz, (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), share,
                                    share * state.strengths[name] * falloff)
    return lights


def make_shot(name: str, seed: int, out: Path, progress: Progress) -> None:
    """Render the frames and layers of a shot into its folder, with its truth; frames whose files all exist are kept.

    A frame and its clean frame have the same noise.
    """
    scene = SHOTS[name](seed)
    setup = draft_setup(scene.lens)
    stems = [f"{index + 1:04d}" for index in range(FRAMES)]
    states = [scene.frame_state(index) for index in range(FRAMES)]
    lights_by_frame = [lights_in_frame(scene, state) for state in states]
    write_truth(name, scene, states, lights_by_frame, out, stems)
    first_rays = camera_rays(scene.camera, states[0].rotation)
    fixed_hits = cast_rays(scene.quads, states[0].eye, first_rays) if scene.fixed_camera else None
    progress.stage("render", FRAMES)
    for index, (stem, state, lights) in enumerate(zip(stems, states, lights_by_frame, strict=True)):
        truth = out / "truth"
        layer_paths = {light: truth / f"flare_{light}" / f"{stem}.exr" for light in state.lamps}
        scene_path, flare_path = truth / "scene" / f"{stem}.exr", truth / "flare" / f"{stem}.exr"
        clean_path, frame_path = truth / "clean" / f"{stem}.png", out / "images" / f"{stem}.png"
        if not all(path.is_file() for path in (*layer_paths.values(), scene_path, flare_path, clean_path, frame_path)):
            write_layer(scene_path, render_scene(scene, state, fixed_hits), SCENE_LEVEL)
            layers = []
            for light, path in layer_paths.items():
                flare = render_flare(setup, scene.camera, lights[light].camera_xyz,
                                     colour=tuple(state.lamps[light].colour), intensity=lights[light].flare_strength)
                write_layer(path, flare, FLARE_LEVEL)
                layers.append(read_picture(path).pixels)
            write_layer(flare_path, np.sum(layers, axis=0, dtype=np.float32), FLARE_LEVEL)
            # The frames are made of the layers as stored, so that the files agree.
            flare, picture = (read_picture(path).pixels for path in (flare_path, scene_path))
            write_png(clean_path, expose(picture, np.random.default_rng((seed, index))))
            write_png(frame_path, expose(picture + flare, np.random.default_rng((seed, index))))
        progress.advance()


def write_truth(shot: str, scene: ShotScene, states: list[FrameState],
                lights_by_frame: list[dict[str, LightInFrame]], out: Path, stems: list[str]) -> None:
    """Write truth/lights.json, truth/camera.json and split.json.

    stems: file names of the frames, without suffix. "on" is the strength of a light's flare, relative to its largest in
    the shot.
    """
    lights = []
    for name in states[0].lamps:
        in_frames = [lights_of_frame[name] for lights_of_frame in lights_by_frame]
        largest = max(light.flare_strength for light in in_frames)
        frames = {f"{stem}.png": {"xy": [round(float(x), 3) for x in light.xy],
                                  "on": round(light.flare_strength / largest, 5),
                                  "visible": round(light.visible_share, 4)}
                  for stem, light in zip(stems, in_frames, strict=True)}
        lights.append({"name": name, "frames": frames})
    write_json(out / "truth" / "lights.json", {"lights": lights})
    camera: dict[str, Any] = {"focal_px": scene.camera.fx, "width": scene.camera.width, "height": scene.camera.height,
                              "cx": scene.camera.cx, "cy": scene.camera.cy}
    if shot == "pan":
        camera["pan"] = [state.rotation.tolist() for state in states]
    write_json(out / "truth" / "camera.json", camera)
    write_json(out / "split.json", {"test": [f"{stem}.png" for stem in stems[4::8]]})


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
