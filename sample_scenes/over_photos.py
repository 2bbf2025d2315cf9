# SPDX-License-Identifier: GPL-3.0-or-later
"""Lay traced flares over a real capture: `python sample_scenes/over_photos.py CAPTURE --light X Y Z --out FOLDER`.

The capture has images/ and sparse/0; distorted frames are undistorted. A light is placed at a point in its world, its
flare is traced for every view and added in linear light, and the result is clipped and stored as a frame. The flare is
scaled by the exposure of each photograph. The new capture has those frames in images/, the untouched
photographs in removed/, the flares in truth/flare, lights.json, and cameras scaled to the new size. Objects in front of
the light do not hide it: the visible share is 1 in every view.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.capture import LIGHTS, Capture
from core.capture.colmap import ObservedFrame, write_model
from core.capture.lens import Lens
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.fit import metering
from core.fit.frames import Frames
from core.images.read import read_picture
from core.images.write import write_png
from core.system.files import write_json
from core.system.progress import Progress
from sample_scenes.capture_files import FLARE_LEVEL, write_layer
from sample_scenes.command import run_command
from sample_scenes.flares import LENS_SETUPS, LensSetup, render_flare


def add_flares(capture: Capture, out: Path, setup: LensSetup, light: NDArray[np.float64], colour: tuple[float, ...],
               intensity: float, width: int, progress: Progress) -> None:
    """Write the new capture; views that exist already are kept.

    light: its world coordinates (3,). colour: the light's, linear R G B. intensity: factor on its flare in a frame of
    exposure 1. width: pixels of the new frames.
    """
    capture = capture.with_exposures(metering.measure_exposures(capture, Frames(capture, width)))
    progress.stage("flares", len(capture.views))
    for view in capture.views:
        stem = Path(view.name).stem
        frame_path, clean_path, layer_path = (out / "images" / f"{stem}.png", out / "removed" / f"{stem}.png",
                                              out / "truth" / "flare" / f"{stem}.exr")
        if not (frame_path.is_file() and clean_path.is_file() and layer_path.is_file()):
            camera = view.camera.scaled(width)
            photo = np.round(capture.frame(view, camera.size).display() * 255) / np.float32(255)  # as stored in 8 bits
            pose = view.camera.world_to_camera
            flare = render_flare(setup, camera, pose[:3, :3] @ light + pose[:3, 3], colour=colour,
                                 intensity=intensity * camera.exposure)
            write_layer(layer_path, flare, FLARE_LEVEL)
            flare = read_picture(layer_path).pixels  # as stored, so that the files agree
            write_png(clean_path, photo)
            write_png(frame_path, srgb_from_linear(np.clip(linear_from_srgb(photo) + flare, 0, 1)))
        progress.advance()
    write_json(out / LIGHTS, {"lights": [{"name": "light", "xyz": light.tolist()}]})
    _write_model(capture, out / "sparse" / "0", width)


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
    parser.add_argument("--light", type=float, nargs=3, required=True, metavar=("X", "Y", "Z"),
                        help="the light's place, world coordinates")
    parser.add_argument("--colour", type=float, nargs=3, default=(1.0, 0.85, 0.65), metavar=("R", "G", "B"))
    parser.add_argument("--intensity", type=float, default=1.0)
    parser.add_argument("--lens", choices=sorted(LENS_SETUPS), default="fast")
    parser.add_argument("--width", type=int, default=640, help="of the new frames, pixels")
    args = parser.parse_args()
    return run_command(lambda progress: add_flares(
        Capture.open(args.capture), args.out, LENS_SETUPS[args.lens], np.array(args.light), tuple(args.colour),
        args.intensity, args.width, progress))


if __name__ == "__main__":
    raise SystemExit(main())
