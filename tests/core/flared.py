# SPDX-License-Identifier: GPL-3.0-or-later
"""A tiny capture with a known flare: coloured dots in space, and discs on the line through the light.

The flare is painted by a formula that knows nothing of Gaussians: flat discs with soft rims at fixed
places of the line, in linear light.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from core.capture import Camera
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.gaussians import rasterization
from core.images.write import write_exr, write_png
from core.system.files import write_json, write_text

WIDTH, HEIGHT = 64, 40
LIGHT = np.array([0.3, -0.6, 1.5])
GHOSTS = ((1.0, 0.10, (0.9, 0.8, 0.6)), (0.45, 0.05, (0.1, 0.3, 0.1)), (-0.6, 0.08, (0.25, 0.1, 0.3)))


def cameras(count: int) -> list[Camera]:
    """Return cameras on a short path 4 units from the origin, which they look at."""
    result = []
    for step in np.linspace(-1, 1, count):
        position = np.array([1.2 * step, 0.4 * step * step - 0.1, -4.0])
        forward = -position / np.linalg.norm(position)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
        result.append(Camera(WIDTH, HEIGHT, 70.0, 70.0, 33.0, 19.5, pose))
    return result


def flare(camera: Camera) -> NDArray[np.float32]:
    """Return the flare of LIGHT as a camera sees it, (height, width, 3) linear: soft discs on the line from the light
    through the optical axis."""
    plane, depth = camera.project_normalised(LIGHT)
    if depth[0] <= 0:
        return np.zeros((HEIGHT, WIDTH, 3), np.float32)
    x = (np.arange(WIDTH) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(HEIGHT)[:, None] + 0.5 - camera.cy) / camera.fy
    picture = np.zeros((HEIGHT, WIDTH, 3))
    for mu, radius, colour in GHOSTS:
        away = np.hypot(x - mu * plane[0, 0], y - mu * plane[0, 1]) / radius
        picture += 0.5 / (1 + np.exp((away - 1) * 8))[..., None] * np.array(colour)
    return picture.astype(np.float32)


def flared_capture(folder: Path, count: int = 12, dots: int = 150, *, float_gain: float | None = None) -> Path:
    """Write a whole capture, with removed/, truth/ and lights.json; return its folder. dots: number of the scene's
    Gaussians.

    float_gain: None for PNG frames; else frames and removed/ are EXR files that keep light above white, and scene and
    flare are multiplied by this gain.
    """
    random = np.random.default_rng(0)
    xyz = random.uniform(-1.2, 1.2, (dots, 3)).astype(np.float32)
    rgb = random.uniform(0.1, 0.9, (dots, 3)).astype(np.float32)
    splats = (torch.from_numpy(xyz), torch.tensor([1.0, 0, 0, 0]).repeat(dots, 1), torch.full((dots, 3), 0.16),
             torch.full((dots,), 0.9), ((torch.from_numpy(rgb) - 0.5) / 0.28209479)[:, None])
    lines = []
    for number, camera in enumerate(cameras(count)):
        name = f"{number:04d}.{'png' if float_gain is None else 'exr'}"
        view = torch.from_numpy(camera.world_to_camera).float(), torch.from_numpy(camera.intrinsics).float()
        clean = rasterization(*splats, *view, WIDTH, HEIGHT, kernels="torch").colour.clamp(0, 1).numpy()
        gain = np.float32(1 if float_gain is None else float_gain)
        scene_light, light = linear_from_srgb(clean) * gain, flare(camera) * gain
        for kind, picture in (("removed", scene_light), ("images", scene_light + light)):
            if float_gain is None:
                write_png(folder / kind / name, srgb_from_linear(picture))
            else:
                write_light(folder / kind / name, picture)
        for kind, picture in (("scene", scene_light), ("flare", light)):
            write_light(folder / "truth" / kind / f"{number:04d}.exr", picture)
        w, x, y, z = _quaternion(camera.world_to_camera[:3, :3])
        place = " ".join(map(str, camera.world_to_camera[:3, 3]))
        lines.append(f"{number + 1} {w} {x} {y} {z} {place} 1 {name}\n\n")
    model = folder / "sparse" / "0"
    write_text(model / "cameras.txt", f"1 PINHOLE {WIDTH} {HEIGHT} 70 70 33 19.5\n")
    write_text(model / "images.txt", "".join(lines))
    write_text(model / "points3D.txt", "".join(
        f"{i + 1} {p[0]} {p[1]} {p[2]} {' '.join(str(int(c * 255)) for c in rgb[i])} 0.5\n" for i, p in enumerate(xyz)))
    write_json(folder / "lights.json", {"lights": [{"name": "lamp", "xyz": LIGHT.tolist()}]})
    return folder


def write_light(path: Path, light: NDArray[np.float32]) -> None:
    """Scene-linear light (height, width, 3) as EXR."""
    write_exr(path, {channel: light[..., index] for index, channel in enumerate("RGB")})


def _quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    w = float(np.sqrt(1 + np.trace(rotation)) / 2)
    skew = rotation - rotation.T
    return w, float(skew[2, 1] / (4 * w)), float(skew[0, 2] / (4 * w)), float(skew[1, 0] / (4 * w))
