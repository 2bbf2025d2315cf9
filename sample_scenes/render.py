# SPDX-License-Identifier: GPL-3.0-or-later
"""Make a sample capture: `python sample_scenes/render.py [--scene desk] [--out FOLDER] [--width PX] [--every N]`.

Renders the scene with Cycles, traces the flares, adds them in linear light, exposes the frames, matches features and
triangulates the points. Views that exist already are kept, so an interrupted run resumes; delete truth/flare, images
and removed to make the flares again.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.capture import LIGHTS
from core.errors import CaptureError
from core.images.read import read_picture
from core.system.files import read_json, write_json
from core.system.progress import Progress
from sample_scenes.capture_files import FLARE_LEVEL, FRAME_SUFFIX, SCENE_LEVEL, write_frame, write_layer
from sample_scenes.command import exit_process, run_command, silence_blender
from sample_scenes.description import SceneDescription, camera_positions
from sample_scenes.flares import LENS_SETUPS, render_flare
from sample_scenes.scenes import SCENES

CACHE = Path(__file__).resolve().parents[1] / "build" / "sample_scenes"


def render_scene(scene: SceneDescription, out: Path, progress: Progress) -> None:
    """Render truth/scene and compute truth/visible_share.json in Blender; views that exist are kept."""
    layer_folder, share_file = out / "truth" / "scene", out / "truth" / "visible_share.json"
    names, poses = scene.stems, scene.poses
    missing = [i for i, name in enumerate(names) if not (layer_folder / f"{name}.exr").is_file()]
    if not missing and share_file.is_file():
        return
    from sample_scenes import shots

    scene.build(scene)
    camera = shots.set_up_render(scene.camera, scene.samples)
    eyes = camera_positions(poses)
    shares = {f"{name}{FRAME_SUFFIX}": {light.name: shots.visible_share(light, eye) for light in scene.lights}
              for name, eye in zip(names, eyes, strict=True)}
    write_json(share_file, shares)
    progress.stage("render", len(names), len(names) - len(missing))
    for index in missing:
        with silence_blender():
            pixels = shots.render_view(camera, poses[index], scene.seed * 1000 + int(scene.numbers[index]))
        write_layer(layer_folder / f"{names[index]}.exr", pixels, SCENE_LEVEL)
        progress.advance()


def add_flares(scene: SceneDescription, out: Path, progress: Progress) -> None:
    """Write the flare layer, the frame (images) and the clean frame (removed) of each view that lacks one of the three.

    A frame and its clean frame have the same noise.
    """
    names, poses = scene.stems, scene.poses
    shares = read_json(out / "truth" / "visible_share.json", CaptureError)
    setup = LENS_SETUPS[scene.lens]
    progress.stage("flares", len(names))
    for index, name in enumerate(names):
        layer_path = out / "truth" / "flare" / f"{name}.exr"
        frame_path, clean_path = (out / folder / f"{name}{FRAME_SUFFIX}" for folder in ("images", "removed"))
        if not (layer_path.is_file() and frame_path.is_file() and clean_path.is_file()):
            flare = np.zeros((scene.camera.height, scene.camera.width, 3), np.float32)
            for light in scene.lights:
                light_position = poses[index][:3, :3] @ np.array(light.xyz) + poses[index][:3, 3]
                flare += render_flare(setup, scene.camera, light_position, colour=light.colour,
                                      intensity=light.flare_strength(float(np.linalg.norm(light_position))),
                                      visible_share=shares[f"{name}{FRAME_SUFFIX}"][light.name])
            write_layer(layer_path, flare, FLARE_LEVEL)
            # The frames are made of the layers as stored, so that the files agree to the last bit.
            flare = read_picture(layer_path).pixels
            picture = read_picture(out / "truth" / "scene" / f"{name}.exr").pixels
            write_frame(clean_path, picture, (scene.seed, int(scene.numbers[index])))
            write_frame(frame_path, picture + flare, (scene.seed, int(scene.numbers[index])))
        progress.advance()


def write_lights_and_split(scene: SceneDescription, out: Path) -> None:
    """Write lights.json, and split.json: every eighth view is held out, and those of `scene.held_out`."""
    write_json(out / LIGHTS, {"lights": [
        {"name": light.name, "xyz": list(light.xyz), "radius": light.radius, "colour": list(light.colour)}
        for light in scene.lights]})
    held_out = sorted(set(scene.stems[4::8]) | {f"{number:04d}" for number in scene.held_out} & set(scene.stems))
    write_json(out / "split.json", {"test": [f"{stem}{FRAME_SUFFIX}" for stem in held_out]})


def _check_size(scene: SceneDescription, out: Path) -> None:
    """Raise CaptureError if the folder has a layer of another size, since views that exist are kept."""
    for layer in sorted((out / "truth" / "scene").glob("*.exr"))[:1]:
        height, width = read_picture(layer).pixels.shape[:2]
        if (width, height) != (scene.camera.width, scene.camera.height):
            raise CaptureError(f"{layer} has {width}x{height} pixels, not the {scene.camera.width}x"
                               f"{scene.camera.height} of this capture; name another folder with --out.")


def make_capture(scene: SceneDescription, out: Path, progress: Progress) -> None:
    """Make the whole capture folder."""
    from sample_scenes.colmap_model import write_model

    _check_size(scene, out)
    render_scene(scene, out, progress)
    add_flares(scene, out, progress)
    write_lights_and_split(scene, out)
    write_model(scene, out, progress)


def _at_least(least: int) -> Callable[[str], int]:
    """Return the reader of an argument that is a whole number of at least `least`."""
    def number(text: str) -> int:
        if int(text) < least:
            raise argparse.ArgumentTypeError(f"{text} is less than {least}")
        return int(text)
    return number


def main() -> int:
    """Make the capture that the arguments name; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="capture folder to write; else build/sample_scenes/SCENE")
    parser.add_argument("--scene", choices=sorted(SCENES), default="desk")
    parser.add_argument("--width", type=_at_least(32), metavar="PX", help="width of the pictures; else the scene's")
    parser.add_argument("--every", type=_at_least(1), default=1, metavar="N", help="render only every N-th view")
    args = parser.parse_args()
    out = args.out or CACHE / args.scene
    scene = SCENES[args.scene].resampled(args.width, args.every)
    return run_command(lambda progress: make_capture(scene, out, progress))


if __name__ == "__main__":
    exit_process(main())
