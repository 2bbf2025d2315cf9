# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer against exact flares: the sample's lens and lights on another path, through another scene.

    python benchmarks/transfer.py RUN [--world moved] [--frames 40] [--query blend] [--out FOLDER]
    python benchmarks/transfer.py RUN --to CAPTURE --scene PLY [--query blend] [--out FOLDER]

The target is made here: a camera path that the capture does not have, its focal length, principal point and
aspect other than the capture's, a plain background, and lights that are hidden in known frames. Its flares come
from the generator of the sample (traced ghosts, diffraction), at the target's own views. `--world moved` turns and
shifts the whole target, so that nothing in its coordinates is the source's. Scored are views whose lights stand
where training saw lights, in the frame's terms: inside the range of their place and distance.

With `--to` the target is a rendered capture whose layers are known, with the same lens and lights
(`sample_scenes/render.py --scene studio`), and PLY its scene as splats (`fit --mode 3dgs` of its flare-free frames),
which alone says what hides a light.
"""
from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.capture import Camera, Capture
from core.colour.srgb import srgb_from_linear
from core.conventions.run_files import FLARE
from core.errors import CaptureError
from core.fit.run import Run
from core.images.write import write_png
from core.look import Look, PlacedLight, ViewOfLight, read_look
from core.look.shot import Shot, ShotFrame
from core.metrics.evaluation import displayed_flare
from core.system.files import read_json, write_json
from core.transfer.target import Target, capture_target, shot_target
from core.transfer.transfer import Transfer, TransferSettings
from sample_scenes.description import look_at
from sample_scenes.flares import LENS_SETUPS, render_flare
from sample_scenes.scenes.desk import DESK

Pixels = NDArray[np.float32]
SHEET_ROWS = 6
"""Frames on the picture of a transfer, about."""


@dataclass(frozen=True)
class ExactFrame:
    """A target's frame: what it is, with the exact share of each light; the exact flare and scene, scene-linear."""

    shot: ShotFrame
    flare: Pixels
    scene: Pixels


class FrameScores(NamedTuple):
    """Scores by frame, and figures of the whole transfer."""

    rows: list[dict[str, Any]]
    """By frame: "flare" and "flare_linear" are PSNR of the transferred flare, "empty" that of none, dB. "inside": the
    frame's lights are in the trained range."""
    max_hidden_light: float
    """Largest value in the flare of a light that is hidden."""
    sheet: Pixels
    """Some frames, display values: the exact one beside the transferred one."""


def camera_path(number: int, count: int) -> NDArray[np.float64]:
    """Return the pose (4, 4), world to camera, of frame `number` of `count` on a path that the capture does not have.

    It is a slow arc from left to right, rising and coming nearer, with a pan.
    """
    t = number / max(count - 1, 1)
    azimuth = np.radians(-32 + 64 * t)
    distance = 5.9 - 0.5 * t
    eye = np.array([distance * np.sin(azimuth), 0.7 - distance * np.cos(azimuth), 1.3 + 0.9 * t])
    target = np.array([0.3 * np.cos(5 * t), 0.75, 1.0 + 0.25 * np.sin(4 * t)])
    return look_at(eye, target, np.radians(2) * np.sin(6 * t))


def move_world(pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a rigid motion of the world (4, 4), and the pose (4, 4), world to camera, in the moved world."""
    angle = np.radians(117.0)
    motion = np.eye(4)
    motion[:3, :3] = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    motion[:3, 3] = (40.0, -12.0, 3.0)
    return motion, pose @ np.linalg.inv(motion)


def synthetic_target(count: int, world: str, size: tuple[int, int], look: Look) -> list[ExactFrame]:
    """Synthesise `count` frames with exact flares on a new camera path. size: width and height, pixels.

    world: "same" keeps the capture's coordinates, "moved" turns and shifts the target. Each light is hidden in some
    frames, and partly hidden in those next to them.
    """
    sources = nearest_sources(look)
    width, height = size
    frames = []
    for number in range(count):
        pose, motion = camera_path(number, count), np.eye(4)
        camera = Camera(width, height, 0.93 * width, 0.93 * width, 0.487 * width, 0.52 * height, pose)
        if world == "moved":
            motion, moved_pose = move_world(pose)
            camera = Camera(width, height, camera.fx, camera.fy, camera.cx, camera.cy, moved_pose)
        lights, flare = [], np.zeros((height, width, 3), np.float32)
        for index, light in enumerate(DESK.lights):
            centre = count * (0.35 + 0.3 * index)
            share = float(np.clip((abs(number - centre) - 2.5) / 3, 0, 1))
            xyz = np.array(light.xyz)
            camera_xyz = pose[:3, :3] @ xyz + pose[:3, 3]
            flare += render_flare(LENS_SETUPS[DESK.lens], camera, camera_xyz, colour=light.colour, visible_share=share,
                                  intensity=light.flare_strength(float(np.linalg.norm(camera_xyz))))
            lights.append(PlacedLight(light.name, sources[light.name], motion[:3, :3] @ xyz + motion[:3, 3], share))
        frames.append(ExactFrame(ShotFrame(number + 1, "Camera", camera, tuple(lights)), flare, background(camera)))
    return frames


def rendered_target(folder: Path, scene: Path, look: Look) -> tuple[list[ExactFrame], Target]:
    """Return the frames of a capture with exact layers, and the capture as a target.

    The target has its cameras, the places of its lights and the splats `scene`, but nothing that only the truth knows.
    """
    capture = Capture.open(folder)
    shares = read_json(folder / "truth" / "visible_share.json", CaptureError)
    transfer_target = capture_target(capture, look, nearest_sources(look), scene=scene)
    views = {view.name: view for view in capture.views}
    frames = []
    for frame in transfer_target.frames:
        view = views[frame.frame.view]
        flare, scene_layer = capture.truth_flare(view), capture.truth_scene(view)
        if flare is None or scene_layer is None:
            raise CaptureError(f"{folder} has no exact layers; make it with sample_scenes/render.py.")
        lights = tuple(replace(light, visibility=shares[view.name][light.name]) for light in frame.shot.lights)
        frames.append(ExactFrame(replace(frame.shot, lights=lights), flare.pixels, scene_layer.pixels))
    return frames, transfer_target


def nearest_sources(look: Look) -> dict[str, str]:
    """Return the nearest light of the look for each of the desk's lights, by name."""
    return {light.name: min(look.lights, key=lambda source: float(np.linalg.norm(source.xyz - light.xyz))).name
            for light in DESK.lights}


def background(camera: Camera) -> Pixels:
    """Return a plain scene (h, w, 3), scene-linear: dim, and brighter to the right."""
    ramp = np.linspace(0.02, 0.12, camera.width, dtype=np.float32)
    return np.broadcast_to(ramp[None, :, None] * np.array([1.0, 0.9, 0.8], np.float32),
                           (camera.height, camera.width, 3)).copy()


def psnr(first: Pixels, second: Pixels) -> float:
    """Return the PSNR of two pictures whose white is 1, dB, at most 120."""
    return float(-10 * np.log10(max(float(((first - second) ** 2).mean()), 1e-12)))


def score_frames(transfer: Transfer, frames: list[ExactFrame], look: Look) -> FrameScores:
    """Compare the transferred flares with the exact ones, and print a line for each frame."""
    ranges = {light.name: transfer.training_views[light.name] for light in look.lights}
    rows: list[dict[str, Any]] = []
    max_hidden_light, pictures = 0.0, []
    for index, exact in enumerate(frames):
        camera, scene = exact.shot.camera, exact.scene
        layers = transfer.frame_renderer(transfer.target.frames[index].frame).render(camera)
        flare = sum(layers.flare_by_light.values())
        for light in exact.shot.lights:
            if light.visibility == 0:
                max_hidden_light = max(max_hidden_light, float(np.abs(layers.flare_by_light[light.name]).max()))
        inside = all(is_in_trained_range(ranges[light.source], ViewOfLight.of(camera.world_to_camera, light.xyz),
                                         float(np.linalg.norm(camera.position - light.xyz)))
                     for light in exact.shot.lights)
        clipped = np.clip(scene + exact.flare, 0, 1), np.clip(scene + flare, 0, 1)
        displayed = displayed_flare(scene + exact.flare, scene)
        rows.append({"frame": exact.shot.frame, "inside": inside,
                     "shares": [light.visibility for light in exact.shot.lights],
                     "flare": psnr(displayed, displayed_flare(scene + flare, scene)), "flare_linear": psnr(*clipped),
                     "empty": psnr(displayed, 0 * displayed)})
        if index % max(len(frames) // SHEET_ROWS, 1) == 0:
            pictures.append(np.concatenate([srgb_from_linear(picture) for picture in clipped], 1))
        print(f"frame {rows[-1]['frame']:3}  inside {inside!s:5}  shares "
              + " ".join(f"{share:.2f}" for share in rows[-1]["shares"])
              + "".join(f"  {name} {rows[-1][name]:.2f}" for name in ("flare", "flare_linear", "empty")),
              flush=True)
    return FrameScores(rows, max_hidden_light, np.concatenate(pictures))


def main() -> None:
    """Transfer the flare of the run to the target, and print and write the scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--world", choices=("same", "moved"), default="same")
    parser.add_argument("--query", choices=("source", "target", "blend"), default="blend")
    parser.add_argument("--smooth", type=int, default=1)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--to", type=Path, metavar="CAPTURE", help="a rendered target with exact layers")
    parser.add_argument("--scene", type=Path, metavar="PLY", help="of the rendered target")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()

    run = Run.open(args.run)
    look = read_look(args.run / FLARE)
    capture = Capture.open(run.capture_folder if run.capture_folder.is_dir() else "sample_scenes/desk",
                           need_frames=False)
    training = [view.camera.world_to_camera for view in capture.split(run.settings.holdout)[0]]
    if args.to:
        exact_frames, transfer_target = rendered_target(args.to, args.scene, look)
    else:
        exact_frames = synthetic_target(args.frames, args.world, (args.width, args.width * 5 // 8), look)
        transfer_target = shot_target(Shot(args.run / FLARE, tuple(exact.shot for exact in exact_frames)), look, {})
    settings = TransferSettings(query=args.query, smooth=args.smooth)
    transfer = Transfer(args.run / FLARE, transfer_target, settings, training)
    rows, max_hidden_light, sheet = score_frames(transfer, exact_frames, look)
    scored = [row for row in rows if row["inside"]]
    means = {name: float(np.mean([row[name] for row in scored])) for name in ("flare", "flare_linear", "empty")}
    worst = min(scored, key=lambda row: row["flare"])
    print(f"{len(scored)} of {len(rows)} views inside the trained range: flare {means['flare']:.2f} dB (worst "
          f"{worst['flare']:.2f}, frame {worst['frame']}), in linear light {means['flare_linear']:.2f}, empty "
          f"{means['empty']:.2f}; most light of a hidden light: {max_hidden_light:g}")
    if args.out:
        name = f"transfer_{args.to.name if args.to else args.world}_{args.query}"
        write_png(args.out / f"{name}.png", sheet)
        write_json(args.out / f"{name}.json", {"means": means, "views": rows})


def is_in_trained_range(training: object, view: ViewOfLight, distance: float) -> bool:
    """Return whether a light is in the range of the training views.

    The range has two parts: the light's place in the frame, up to mirroring, and its distance from the camera.
    training: the value of `Transfer.training_views` for the light's source.
    """
    lights, distances = np.abs(training.lights), training.distances  # type: ignore[attr-defined]
    position = np.abs(view.light)
    return bool((position <= lights.max(0)).all() and distances.min() <= distance <= distances.max())


if __name__ == "__main__":
    main()
