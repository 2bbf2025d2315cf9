# SPDX-License-Identifier: GPL-3.0-or-later
"""Lay traced flares over a real capture: `python sample_scenes/over_photos.py CAPTURE --light X Y Z --out FOLDER`.

The capture has images/ and sparse/0; distorted frames are undistorted. A light is placed at a point in its world, or
with `--sun X Y Z` far away in a direction. Its flare is traced for every view and added in linear light, and the result
is clipped and stored as a frame. The flare is scaled by the exposure of each photograph. The new capture has those
frames in images/, the untouched photographs in removed/ and, in linear light, in truth/scene, the flares in
truth/flare, the light's visible shares in truth/visible_share.json, lights.json, and cameras scaled to the new size.

A sun shines where the photograph shows a bright sky: whatever is darker hides it. Out of the frame nothing hides it.
Nothing hides a light at a point.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.capture import LIGHTS, Camera, Capture
from core.capture.colmap import ObservedFrame, write_model
from core.capture.lens import Lens
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.fit import metering
from core.fit.frames import Frames
from core.images.read import read_picture
from core.images.write import write_png
from core.lights.exposure import open_by_disc
from core.lights.found_light import FAR
from core.system.files import write_json
from core.system.progress import Progress
from sample_scenes.capture_files import FLARE_LEVEL, write_layer
from sample_scenes.command import run_command
from sample_scenes.flares import LENS_SETUPS, LensSetup, render_flare

LIGHT = "light"
"""Name of the light in the new capture."""
SKY_LEVEL = 0.9
"""Display value of the largest channel from which a pixel of a photograph shows the sky."""
SUN_RADIUS = 0.008
"""Radius of the sun's disc in the frame, diagonals: larger than the real one, so that leaves and edges dim it
gradually."""


def add_flares(capture: Capture, out: Path, setup: LensSetup, light: NDArray[np.float64], colour: tuple[float, ...],
               intensity: float, width: int, progress: Progress, *, is_sun: bool = False) -> None:
    """Write the new capture; views that exist already are kept.

    light: its world coordinates (3,), or with `is_sun` its direction (3,) from the cameras. colour: the light's, linear
    R G B. intensity: factor on its flare in a frame of exposure 1. width: pixels of the new frames.
    """
    if is_sun:
        light = capture.centre + FAR * capture.extent * light / np.linalg.norm(light)
    shares = {}
    capture = capture.with_exposures(metering.measure_exposures(capture, Frames(capture, width)))
    progress.stage("flares", len(capture.views))
    for view in capture.views:
        name = f"{Path(view.name).stem}.png"
        frame_path, clean_path = out / "images" / name, out / "removed" / name
        scene_path, flare_path = ((out / "truth" / layer / name).with_suffix(".exr") for layer in ("scene", "flare"))
        camera, pose = view.camera.scaled(width), view.camera.world_to_camera
        photo = np.round(capture.frame(view, camera.size).display() * 255) / np.float32(255)  # as stored in 8 bits
        shares[name] = {LIGHT: measure_sky_share(photo, camera, light) if is_sun else 1.0}
        if not all(path.is_file() for path in (frame_path, clean_path, scene_path, flare_path)):
            flare = render_flare(setup, camera, pose[:3, :3] @ light + pose[:3, 3], colour=colour,
                                 intensity=intensity * camera.exposure, visible_share=shares[name][LIGHT])
            write_layer(flare_path, flare, FLARE_LEVEL)
            flare = read_picture(flare_path).pixels  # as stored, so that the files agree
            write_layer(scene_path, linear_from_srgb(photo), FLARE_LEVEL)
            write_png(clean_path, photo)
            write_png(frame_path, srgb_from_linear(np.clip(linear_from_srgb(photo) + flare, 0, 1)))
        progress.advance()
    write_json(out / "truth" / "visible_share.json", shares)
    write_json(out / LIGHTS, {"lights": [{"name": LIGHT, "xyz": light.tolist()}]})
    _write_model(capture, out / "sparse" / "0", width)


def measure_sky_share(photo: NDArray[np.float32], camera: Camera, light: NDArray[np.float64]) -> float:
    """Return the share, 0..1, of a sun's disc behind which a photograph shows the sky; 1 for a sun out of the frame.

    A bright patch smaller than the disc, such as a glint on bark, is no sky. photo: display values (height, width, 3).
    camera: of the photograph's size. light: the sun's place, world (3,).
    """
    pixels, depth = camera.project(light[None])
    if not camera.contains(pixels, depth)[0]:
        return 1.0
    v, u = np.mgrid[:camera.height, :camera.width] + 0.5
    radius = max(SUN_RADIUS * float(np.hypot(*camera.size)), 1.0)
    disc = np.hypot(u - pixels[0, 0], v - pixels[0, 1]) <= radius
    sky = open_by_disc((photo.max(axis=2) >= SKY_LEVEL).astype(np.uint8), int(radius))
    return round(float(sky[disc].mean()), 4)


def _write_model(capture: Capture, folder: Path, width: int) -> None:
    """Write cameras at `width`, the capture's points, and which photograph shows which points."""
    frames = []
    for view in capture.views:
        camera = view.camera.scaled(width)
        lens = Lens("PINHOLE", (camera.fx, camera.fy, camera.cx, camera.cy), *camera.size)
        pixels, _ = camera.project(capture.points.xyz[view.points])
        frames.append(ObservedFrame(f"{Path(view.name).stem}.png", lens, camera.world_to_camera, pixels, view.points))
    write_model(folder, frames, capture.points)


def main() -> int:
    """Make the capture that the arguments describe; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path, help="folder with images/ and sparse/0")
    parser.add_argument("--out", type=Path, required=True, help="capture folder to write")
    place = parser.add_mutually_exclusive_group(required=True)
    place.add_argument("--light", type=float, nargs=3, metavar=("X", "Y", "Z"),
                       help="the light's place, world coordinates")
    place.add_argument("--sun", type=float, nargs=3, metavar=("X", "Y", "Z"),
                       help="direction of a light far away, world coordinates; what is darker than the sky hides it")
    parser.add_argument("--colour", type=float, nargs=3, default=(1.0, 0.85, 0.65), metavar=("R", "G", "B"))
    parser.add_argument("--intensity", type=float, default=1.0)
    parser.add_argument("--lens", choices=sorted(LENS_SETUPS), default="fast")
    parser.add_argument("--width", type=int, default=640, help="of the new frames, pixels")
    args = parser.parse_args()
    return run_command(lambda progress: add_flares(
        Capture.open(args.capture), args.out, LENS_SETUPS[args.lens], np.array(args.sun or args.light),
        tuple(args.colour), args.intensity, args.width, progress, is_sun=args.sun is not None))


if __name__ == "__main__":
    raise SystemExit(main())
