# SPDX-License-Identifier: GPL-3.0-or-later
"""A terrace on a hill before a far town, trees and clouds, towards a low sun: no far point has parallax."""
from __future__ import annotations

import numpy as np

from ..description import Array, LightSource, Pinhole, SceneDescription, look_at

AZIMUTH, ELEVATION, DISTANCE = np.radians(4.0), np.radians(9.5), 120.0
"""Of the sun: from +y towards +x, above the horizon, and from the origin in scene units."""
SUN = LightSource("sun", (float(DISTANCE * np.sin(AZIMUTH) * np.cos(ELEVATION)),
                          float(DISTANCE * np.cos(AZIMUTH) * np.cos(ELEVATION)), float(DISTANCE * np.sin(ELEVATION))),
                  (1.0, 0.82, 0.6), 0.95, 60.0, 3.0, 1.8, distant=True)


def camera_path(numbers: Array) -> Array:
    """Return poses (n, 4, 4), world to camera, of a walk along the terrace: to either side and back in 60 views.

    The camera faces the terrace's centre as it walks, and pans, so that the sun leaves the frame at times.
    """
    poses = []
    for t in np.asarray(numbers) / 60:
        azimuth = np.radians(48 * np.sin(2 * np.pi * t))
        distance = 6.0 + 0.8 * np.cos(4 * np.pi * t)
        eye = np.array([distance * np.sin(azimuth), -distance * np.cos(azimuth), 1.9 + 0.5 * np.sin(6 * np.pi * t)])
        pan = 2.6 * np.sin(6 * np.pi * t + 0.8)
        target = np.array([pan * np.cos(azimuth), pan * np.sin(azimuth), 1.55 + 0.3 * np.cos(10 * np.pi * t)])
        poses.append(look_at(eye, target, np.radians(1.5) * np.sin(9 * t)))
    return np.array(poses)


def build_scene(scene: SceneDescription) -> None:
    """Build the terrace in Blender: columns, a trellis, crates, pots, the far surrounding and the sun."""
    from .. import patterns as p
    from .. import stage as s
    from ..panorama import panorama

    rng = np.random.default_rng(scene.seed)
    s.empty_scene()
    flags = p.tiles(rng, 1500, 1500, p.STONE, 13, 13, (70, 66, 60), offset=True)
    rim = s.picture_material("rim", p.marble(rng, 600, 1200, p.STONE), 0.9)
    s.add_lathe("terrace", [(4.9, -0.5), (4.9, 0.0), (1e-3, 0.0)], (0, 0, -0.01), rim, repeat=(6, 2))
    s.add_sheet("flags", 6.8, 6.8, (0, 0, 0), s.picture_material("flags", flags, 0.85), 12)
    stone = s.picture_material("column", p.tiles(rng, 900, 600, p.STONE, 9, 6, offset=True), 0.85)
    shaft = [(0.34, 0.0), (0.34, 0.2), (0.2, 0.3), (0.18, 3.2), (0.3, 3.4), (0.3, 3.55), (1e-3, 3.55)]
    for index, (x, y) in enumerate(((-2.5, 1.9), (-0.9, 2.7), (1.1, 2.7), (2.7, 1.7))):
        s.add_lathe(f"column {index}", shaft, (x, y, 0), stone, turn=50 * index)
    s.add_poster_box("lintel", rng, (2.5, 0.4, 0.3), (0.1, 2.7, 3.55), p.STONE)
    # A trellis: the bright sky shows through its gaps.
    wood = s.picture_material("wood", p.planks(rng, 300, 600, ((94, 48, 35), (140, 90, 50), (190, 150, 100))), 0.8)
    for index in range(7):
        s.add_box(f"lath {index}", (0.07, 0.05, 1.7), (-2.35 + 0.22 * index, 2.3, 0.05), [wood], 8)
    for index in range(4):
        s.add_box(f"rail {index}", (1.6, 0.04, 0.06), (-1.7, 2.33, 0.3 + 0.42 * index), [wood], 8)
    for index, (x, y, turn, size) in enumerate(((-1.5, -0.3, 20, 0.7), (-0.9, -0.8, -12, 0.5), (1.6, 0.4, 8, 0.8),
                                                (2.1, -0.5, 40, 0.55), (-2.6, 0.5, 5, 0.6), (1.7, 0.4, 30, 0.45))):
        s.add_poster_box(f"crate {index}", rng, (size, size, size), (x, y, 0.8 if index == 5 else 0),
                         (p.WARM, p.SEA, p.MOSS, p.PLUM)[index % 4], turn)
    s.add_poster_box("plinth", rng, (0.8, 0.8, 1.0), (0.25, 0.5, 0), p.SEA, 15)
    s.add_monkey("head", 0.8, (0.25, 0.5, 1.62), s.picture_material("head", p.marble(rng, 600, 600, p.STONE)), 10)
    pot = [(1e-3, 0), (0.25, 0), (0.36, 0.5), (0.4, 0.5), (0.4, 0.6), (0.33, 0.6), (0.3, 0.45), (1e-3, 0.45)]
    for index, (x, y) in enumerate(((-0.4, 1.7), (3.0, 0.4), (-2.9, -0.6))):
        glaze = s.picture_material(f"pot {index}", p.tiles(rng, 400, 900, (p.WARM, p.SEA, p.PLUM)[index], 5, 12), 0.7)
        s.add_lathe(f"pot {index}", pot, (x, y, 0), glaze)
        bush = p.gradient_map(p.noise(rng, 300, 600, 50, 4), ((24, 52, 24), (80, 124, 52), (196, 150, 90)))
        s.add_ball(f"bush {index}", 0.4, (x, y, 0.85), s.picture_material(f"bush {index}", bush, 1.0), 40 * index)
    s.set_environment_map(panorama(rng, 1536, (float(AZIMUTH), float(ELEVATION))))
    for light in scene.lights:
        s.add_lamp(light)


HILL = SceneDescription(
    name="hill", seed=58, first_number=0, views=60, camera=Pinhole(480, 270, 415.0, 415.0, 238.2, 136.4),
    camera_path=camera_path, build=build_scene, samples=12, lights=(SUN,), lens="normal")
