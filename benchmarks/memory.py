# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory of long and large work: a bake of 4K layers, and fits of ever more frames.

    python benchmarks/memory.py [bake] [fit] [--run RUN] [--frames 100 200 400] [--size 960x540]

Each is a process of its own, as a farm would start it; what is told is the most memory it held (resident), less
what the same program holds before any frame. A fit's captures are made here: noise over dots, which is as hard to
keep as film. Every view is looked at once.
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


def most_memory(words: list[object]) -> tuple[float, float]:
    """(MiB held at most, seconds) of a process. RuntimeError where it fails."""
    began = time.monotonic()
    with tempfile.TemporaryFile() as noise:
        child = subprocess.Popen(list(map(str, words)), stdout=subprocess.DEVNULL, stderr=noise)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            noise.seek(0)
            raise RuntimeError(noise.read().decode()[-2000:])
    return usage.ru_maxrss / (1024 if sys.platform != "darwin" else 1 << 20), time.monotonic() - began


def look_from(angle: float, width: int, height: int) -> Camera:
    """A camera on an arc about the origin."""
    position = np.array([4 * np.sin(angle), -0.3, -4 * np.cos(angle)])
    forward = -position / np.linalg.norm(position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, pose)


def make_capture(folder: Path, count: int, width: int, height: int) -> Path:
    """A capture of noisy frames with their flare-free pairs, and 2,000 points."""
    random = np.random.default_rng(0)
    xyz, rgb = random.uniform(-1.2, 1.2, (2000, 3)), random.integers(20, 235, (2000, 3))
    model = folder / "sparse" / "0"
    lines = []
    noise = random.integers(0, 24, (height, width, 3), np.uint8)
    for kind in ("images", "removed"):
        (folder / kind).mkdir(parents=True)
    for number in range(count):
        camera = look_from(1.2 * (number / max(count - 1, 1) - 0.5), width, height)
        picture = np.roll(noise, 31 * number, 1) + np.uint8(40)
        for (x, y), colour in zip(camera.project(xyz)[0], rgb, strict=True):
            cv2.circle(picture, (int(x), int(y)), width // 120, colour.tolist(), -1)
        for kind in ("images", "removed"):
            cv2.imwrite(str(folder / kind / f"{number:04d}.jpg"), picture)
        pose = camera.world_to_camera
        words = " ".join(map(str, (*quaternion_from_rotation(pose[:3, :3]), *pose[:3, 3])))
        lines.append(f"{number + 1} {words} 1 {number:04d}.jpg\n\n")
    lens = f"{0.9 * width} {0.9 * width} {width / 2} {height / 2}"
    write_text(model / "cameras.txt", f"1 PINHOLE {width} {height} {lens}\n")
    write_text(model / "images.txt", "".join(lines))
    write_text(model / "points3D.txt", "".join(
        f"{i + 1} {p[0]} {p[1]} {p[2]} {c[0]} {c[1]} {c[2]} 0.5\n"
        for i, (p, c) in enumerate(zip(xyz, rgb, strict=True))))
    write_json(folder / "lights.json", {"lights": [{"name": "lamp", "xyz": [0.3, -0.6, 1.5]}]})
    return folder


def measure_bake(run: Path, size: str) -> None:
    """One frame and several, at one size."""
    with tempfile.TemporaryDirectory() as folder:
        for frames in ("10", "10-12", "10-15"):
            most, seconds = most_memory([sys.executable, RUN, "bake", run, "--out", Path(folder) / frames, "--frames",
                                         frames, "--size", size])
            print(f"bake {size}, frames {frames:5}: {most:6.0f} MiB, {seconds:5.0f} s", flush=True)


def measure_fit(counts: list[int], size: str) -> None:
    """A look at every view once."""
    width, height = map(int, size.split("x"))
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            capture = make_capture(Path(folder) / "capture", count, width, height)
            most, seconds = most_memory([
                sys.executable, RUN, "fit", capture, "--out", Path(folder) / "run", "--preset", "draft", "--iterations",
                count, "--holdout", "0", "--set", f"preview_every={10 * count}", "--set", "flare.occlusion=false",
                "--set", "scene.classic.cap=3000"])
            print(f"fit {size}, {count:4} frames: {most:6.0f} MiB, {seconds:5.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["bake", "fit"])
    parser.add_argument("--run", type=Path, default=ROOT / "build" / "demo" / "run")
    parser.add_argument("--layers", default="3840x2160")
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 200, 400])
    parser.add_argument("--size", default="960x540")
    words = parser.parse_args()
    idle, _ = most_memory([sys.executable, "-c", "import torch, numba, cv2, OpenEXR"])
    print(f"the libraries alone: {idle:.0f} MiB")
    if "bake" in words.what:
        measure_bake(words.run, words.layers)
    if "fit" in words.what:
        measure_fit(words.frames, words.size)


if __name__ == "__main__":
    main()
