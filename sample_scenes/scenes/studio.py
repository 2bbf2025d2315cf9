# SPDX-License-Identifier: GPL-3.0-or-later
"""Another room for the desk's lens and lights, on which transfer is measured; flares are not fitted to it.

The world's origin is elsewhere and its axes are rotated, so that its coordinates share nothing with the desk's; the
camera's focal length, principal point and aspect differ; columns hide the lights from some places.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..description import Array, Pinhole, SceneDescription, look_at
from .desk import LAMP, LANTERN

CENTRE = np.array([40.0, -12.0, 3.0])
TURN = np.radians(117.0)
"""Place of the room's origin in the world, and the room's turn about z."""


def to_world(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of the room (x to the right, y away from the camera) in world coordinates."""
    cosine, sine = np.cos(TURN), np.sin(TURN)
    point = CENTRE + np.array([cosine * x - sine * y, sine * x + cosine * y, z])
    return float(point[0]), float(point[1]), float(point[2])


def camera_path(numbers: Array) -> Array:
    """Return poses (n, 4, 4), world to camera, on an arc from left to right, rising and coming nearer, with a pan."""
    poses = []
    for t in np.asarray(numbers) / 31:
        azimuth, distance = np.radians(-33 + 66 * t), 5.9 - 0.5 * t
        eye = to_world(distance * np.sin(azimuth), 0.7 - distance * np.cos(azimuth), 1.3 + 0.9 * t)
        target = to_world(0.3 * np.cos(5 * t), 0.75, 1.0 + 0.25 * np.sin(4 * t))
        poses.append(look_at(np.array(eye), np.array(target), np.radians(2) * np.sin(6 * t)))
    return np.array(poses)


def build_scene(scene: SceneDescription) -> None:
    """Build the studio in Blender: wall with pictures, columns, crates, the desk's lights."""
    from .. import patterns as p
    from .. import stage as s

    rng = np.random.default_rng(scene.seed)
    s.empty_scene()
    turn = float(np.degrees(TURN))
    floor = p.planks(rng, 1400, 1800, ((60, 52, 46), (120, 104, 90), (164, 146, 128)), 12)
    s.add_sheet("floor", 12, 11, to_world(0, 0.5, 0), s.picture_material("floor", floor, 0.8), turn)
    wall = p.tiles(rng, 900, 2600, ((120, 96, 84), (142, 118, 100), (104, 84, 76)), 10, 20, (70, 60, 54), offset=True)
    s.add_sheet("wall", 16, 6, to_world(0, 3.6, 2.0), s.picture_material("wall", wall, 0.9), turn, (90, 0))
    for index, (x, z, width, height) in enumerate(((-2.6, 1.5, 1.5, 1.3), (0.2, 1.9, 1.7, 1.5), (2.8, 1.6, 1.3, 1.7))):
        art = p.framed(p.poster(rng, int(400 * height), int(400 * width), (p.MOSS, p.PLUM, p.SEA)[index], 40))
        s.add_sheet(f"art {index}", width, height, to_world(x, 3.55, z), s.picture_material(f"art {index}", art, 0.8),
                    turn, (90, 0))
    # Columns in front of either light from a part of the path; the last hides nothing.
    for index, (x, y, radius, height) in enumerate(((-1.05, -0.75, 0.17, 2.7), (0.72, -0.5, 0.2, 2.5),
                                                    (2.5, 1.7, 0.2, 2.2))):
        profile = [(1e-3, 0.0), (radius * 1.5, 0.0), (radius * 1.5, 0.12), (radius, 0.18), (radius, height - 0.15),
                   (radius * 1.35, height), (1e-3, height)]
        bark = p.tiles(rng, 900, 600, (p.WARM, p.STONE, p.SEA)[index], 16, 8, (60, 50, 44), offset=True)
        s.add_lathe(f"column {index}", profile, to_world(x, y, 0), s.picture_material(f"column {index}", bark, 0.7))
    for index, (x, y, side, height) in enumerate(((-2.3, 0.4, 0.6, 0.8), (-0.3, 0.9, 0.7, 0.6), (1.9, 0.2, 0.5, 0.7),
                                                  (0.2, -1.4, 0.4, 0.35))):
        s.add_poster_box(f"crate {index}", rng, (side, side, height), to_world(x, y, 0),
                         (p.WARM, p.SEA, p.MOSS, p.PLUM)[index], turn + rng.uniform(-25, 25))
    bust = s.picture_material("bust", p.marble(rng, 500, 500, p.STONE))
    s.add_monkey("bust", 0.5, to_world(-0.3, 0.9, 0.92), bust, turn)
    globe = s.picture_material("globe", p.map_of_islands(rng, 500, 1000), 0.6)
    s.add_ball("globe", 0.3, to_world(1.9, 0.2, 1.0), globe)
    steel = s.plain_material("steel", (0.06, 0.06, 0.07), 0.45, 0.6)
    for light in scene.lights:
        x, y, z = light.xyz
        s.add_rod(f"{light.name} cord", (x, y, z + 3), (x, y, z + light.radius * 1.3), 0.012, steel)
        s.add_lamp(light)
    s.add_softbox("window", to_world(-4.0, -4.0, 4.8), to_world(0, 0.8, 0.6), (3.0, 3.0), 160, (1.0, 0.95, 0.88))
    s.set_uniform_world((0.6, 0.6, 0.7), 0.16)


STUDIO = SceneDescription(
    name="studio", seed=71, first_number=0, views=32, camera=Pinhole(448, 280, 416.6, 416.6, 218.2, 145.6),
    camera_path=camera_path, build=build_scene, samples=24, lens="fast",
    lights=(replace(LAMP, xyz=to_world(-1.6, 0.85, 2.2)), replace(LANTERN, xyz=to_world(1.2, 1.2, 1.5))))
