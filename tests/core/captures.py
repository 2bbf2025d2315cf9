# SPDX-License-Identifier: GPL-3.0-or-later
"""Small captures, made on the spot for tests."""
from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from core.capture import Camera
from core.capture.camera import quaternion_from_rotation

SIZE = (64, 48)


def look_at(position: Sequence[float], target: Sequence[float] = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Return world_to_camera (4, 4) of a camera at `position` that looks at `target`; the world's y points down."""
    forward = np.subtract(target, position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def orbit(number: int, radius: float = 4.0, size: tuple[int, int] = SIZE, arc: float = 1.2) -> list[Camera]:
    """Return cameras on an arc about the origin, which they look at. arc: radians."""
    cameras = []
    for i in range(number):
        angle = arc * (i / max(number - 1, 1) - 0.5)
        pose = look_at((radius * np.sin(angle), -0.4 * np.sin(2 * angle), -radius * np.cos(angle)))
        width, height = size
        cameras.append(Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, pose))
    return cameras


def picture(seed: int, size: tuple[int, int] = SIZE, depth: type = np.uint8) -> NDArray[np.generic]:
    """A smooth random picture (h, w, 3), B G R."""
    coarse = np.random.default_rng(seed).uniform(0, 1, (6, 8, 3))
    fine = np.clip(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), 0, 1)
    return (fine * np.iinfo(depth).max + 0.5).astype(depth)


def make_capture(folder: Path, views: int = 4, *, size: tuple[int, int] = SIZE, model: str = "PINHOLE",
                 params: Sequence[float] | None = None, suffix: str = ".png", points: int = 20) -> Path:
    """Write a capture with a COLMAP text model; every frame is a smooth random picture. params: of the lens `model`; by
    default those of a pinhole."""
    width, height = size
    params = params or (0.9 * width, 0.9 * width, width / 2, height / 2)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (folder / "images").mkdir()
    words = " ".join(map(str, params))
    (sparse / "cameras.txt").write_text(f"# cameras\n1 {model} {width} {height} {words}\n")
    cloud = np.random.default_rng(1).uniform(-1, 1, (points, 3))
    lines = ["# images"]
    for i, camera in enumerate(orbit(views, size=size)):
        name = f"{i:04d}{suffix}"
        q, t = quaternion_from_rotation(camera.world_to_camera[:3, :3]), camera.world_to_camera[:3, 3]
        seen = [f"{x} {y} {number + 1}" for number, (x, y) in enumerate(camera.project(cloud)[0])]
        lines += [f"{i + 1} {' '.join(map(repr, map(float, (*q, *t))))} 1 {name}", " ".join(seen)]
        cv2.imwrite(str(folder / "images" / name), picture(i, size))
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "points3D.txt").write_text("".join(
        f"{i + 1} {x} {y} {z} {i % 256} 20 30 0.5 {' '.join(f'{v + 1} {i}' for v in range(views))}\n"
        for i, (x, y, z) in enumerate(cloud)))
    return folder


def make_transforms(folder: Path, views: int = 3, **extra: object) -> Path:
    """Write a capture with a transforms.json, whose poses have OpenGL axes. extra: further entries of that file."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, camera in enumerate(orbit(views)):
        pose = camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./images/{i:04d}.png", "transform_matrix": pose.tolist()})
        cv2.imwrite(str(folder / "images" / f"{i:04d}.png"), picture(i))
    meta = {"w": SIZE[0], "h": SIZE[1], "fl_x": 57.6, "fl_y": 57.6, "cx": 32.0, "cy": 24.0,
            "frames": frames, **extra}
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder
