# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory of long and large work: a bake of 4K layers, and fits of ever more frames.

    python benchmarks/memory.py [bake] [fit] [--run RUN] [--frames 100 200 400] [--size 960x540]

Each measurement is a separate process, as on a farm; the figure is its peak resident memory, beside that of the imports
alone. The captures of the fits are generated: noise over dots, which compresses as badly as film. A fit visits every
view once.
"""
from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.capture import Camera
from core.capture.camera import quaternion_from_rotation
from core.system.files import write_json, write_text

ROOT = Path(__file__).resolve().parents[1]
RUN = ROOT / "headless" / "run.py"


def measure_process(args: list[object]) -> tuple[float, float]:
    """Run a process; return its peak resident memory, MiB, and its seconds. Raises RuntimeError if it fails."""
    start = time.monotonic()
    with tempfile.TemporaryFile() as error_output:
        child = subprocess.Popen(list(map(str, args)), stdout=subprocess.DEVNULL, stderr=error_output)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            error_output.seek(0)
            raise RuntimeError(error_output.read().decode()[-2000:])
    # In KiB, on macOS in bytes.
    return usage.ru_maxrss / (1024 if sys.platform != "darwin" else 1 << 20), time.monotonic() - start


def camera_on_arc(angle: float, width: int, height: int) -> Camera:
    """Return a camera on an arc about the origin, 4 units away, that looks at it. angle: radians; y points down."""
    position = np.array([4 * np.sin(angle), -0.3, -4 * np.cos(angle)])
    forward = -position / np.linalg.norm(position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, pose)


def make_capture(folder: Path, count: int, width: int, height: int) -> Path:
    """Write a capture of `count` noisy frames with equal clean frames, and 2,000 points."""
    random = np.random.default_rng(0)
    xyz, rgb = random.uniform(-1.2, 1.2, (2000, 3)), random.integers(20, 235, (2000, 3))
    model = folder / "sparse" / "0"
    image_lines = []
    noise = random.integers(0, 24, (height, width, 3), np.uint8)
    for folder_name in ("images", "removed"):
        (folder / folder_name).mkdir(parents=True)
    for number in range(count):
        camera = camera_on_arc(1.2 * (number / max(count - 1, 1) - 0.5), width, height)
        picture = np.roll(noise, 31 * number, 1) + np.uint8(40)
        for (x, y), colour in zip(camera.project(xyz)[0], rgb, strict=True):
            cv2.circle(picture, (int(x), int(y)), width // 120, colour.tolist(), -1)
        for folder_name in ("images", "removed"):
            cv2.imwrite(str(folder / folder_name / f"{number:04d}.jpg"), picture)
        pose = camera.world_to_camera
        pose_text = " ".join(map(str, (*quaternion_from_rotation(pose[:3, :3]), *pose[:3, 3])))
        image_lines.append(f"{number + 1} {pose_text} 1 {number:04d}.jpg\n\n")
    lens = f"{0.9 * width} {0.9 * width} {width / 2} {height / 2}"
    write_text(model / "cameras.txt", f"1 PINHOLE {width} {height} {lens}\n")
    write_text(model / "images.txt", "".join(image_lines))
    write_text(model / "points3D.txt", "".join(
        f"{index + 1} {point[0]} {point[1]} {point[2]} {colour[0]} {colour[1]} {colour[2]} 0.5\n"
        for index, (point, colour) in enumerate(zip(xyz, rgb, strict=True))))
    write_json(folder / "lights.json", {"lights": [{"name": "lamp", "xyz": [0.3, -0.6, 1.5]}]})
    return folder


def measure_bake(run: Path, size: str) -> None:
    """Print memory and time of bakes of one frame and of several, at one size."""
    with tempfile.TemporaryDirectory() as folder:
        for frames in ("10", "10-12", "10-15"):
            peak, seconds = measure_process([sys.executable, RUN, "bake", run, "--out", Path(folder) / frames,
                                             "--frames", frames, "--size", size])
            print(f"bake {size}, frames {frames:5}: {peak:6.0f} MiB, {seconds:5.0f} s", flush=True)


def measure_fit(counts: list[int], size: str) -> None:
    """Print memory and time of fits that visit every view once. counts: numbers of frames. size: WIDTHxHEIGHT.

    There is no preview and no occlusion, and few scene Gaussians, so that the frames make the difference.
    """
    width, height = map(int, size.split("x"))
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            capture = make_capture(Path(folder) / "capture", count, width, height)
            peak, seconds = measure_process([
                sys.executable, RUN, "fit", capture, "--out", Path(folder) / "run", "--preset", "draft", "--iterations",
                count, "--holdout", "0", "--set", f"preview_every={10 * count}", "--set", "flare.occlusion=false",
                "--set", "scene.classic.cap=3000"])
            print(f"fit {size}, {count:4} frames: {peak:6.0f} MiB, {seconds:5.0f} s", flush=True)


def main() -> None:
    """Measure what the arguments name, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["bake", "fit"])
    parser.add_argument("--run", type=Path, default=ROOT / "build" / "demo" / "run")
    parser.add_argument("--layers", default="3840x2160")
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 200, 400])
    parser.add_argument("--size", default="960x540")
    args = parser.parse_args()
    idle, _ = measure_process([sys.executable, "-c", "import torch, numba, cv2, OpenEXR"])
    print(f"the libraries alone: {idle:.0f} MiB")
    if "bake" in args.what:
        measure_bake(args.run, args.layers)
    if "fit" in args.what:
        measure_fit(args.frames, args.size)


if __name__ == "__main__":
    main()
