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


def world(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of the room (x to the right, y away from the camera) in world coordinates."""
    cosine, sine = np.cos(TURN), np.sin(TURN)
    here = CENTRE + np.array([cosine * x - sine * y, sine * x + cosine * y, z])
    return float(here[0]), float(here[1]), float(here[2])


def path(numbers: Array) -> Array:
    """Return poses (n, 4, 4), world to camera, on an arc from left to right, rising and coming nearer, with a pan."""
    poses = []
    for t in np.asarray(numbers) / 31:
        azimuth, distance = np.radians(-33 + 66 * t), 5.9 - 0.5 * t
        eye = world(distance * np.sin(azimuth), 0.7 - distance * np.cos(azimuth), 1.3 + 0.9 * t)
        target = world(0.3 * np.cos(5 * t), 0.75, 1.0 + 0.25 * np.sin(4 * t))
        poses.append(look_at(np.array(eye), np.array(target), np.radians(2) * np.sin(6 * t)))
    return np.array(poses)


def build(scene: SceneDescription) -> None:
    """Build geometry, materials and lights in Blender."""
    from .. import patterns as p
    from .. import stage as s

    rng = np.random.default_rng(scene.seed)
    s.empty_scene()
    turn = float(np.degrees(TURN))
    floor = p.planks(rng, 1400, 1800, ((60, 52, 46), (120, 104, 90), (164, 146, 128)), 12)
    s.sheet("floor", 12, 11, world(0, 0.5, 0), s.picture_material("floor", floor, 0.8), turn)
    wall = p.tiles(rng, 900, 2600, ((120, 96, 84), (142, 118, 100), (104, 84, 76)), 10, 20, (70, 60, 54), offset=True)
    s.sheet("wall", 16, 6, world(0, 3.6, 2.0), s.picture_material("wall", wall, 0.9), turn, (90, 0))
    for index, (x, z, wide, tall) in enumerate(((-2.6, 1.5, 1.5, 1.3), (0.2, 1.9, 1.7, 1.5), (2.8, 1.6, 1.3, 1.7))):
        art = p.framed(p.poster(rng, int(400 * tall), int(400 * wide), (p.MOSS, p.PLUM, p.SEA)[index], 40))
        s.sheet(f"art {index}", wide, tall, world(x, 3.55, z), s.picture_material(f"art {index}", art, 0.8), turn,
                (90, 0))
    # Columns in front of either light from a part of the path; the last hides nothing.
    for index, (x, y, radius, tall) in enumerate(((-1.05, -0.75, 0.17, 2.7), (0.72, -0.5, 0.2, 2.5),
                                                  (2.5, 1.7, 0.2, 2.2))):
        profile = [(1e-3, 0.0), (radius * 1.5, 0.0), (radius * 1.5, 0.12), (radius, 0.18), (radius, tall - 0.15),
                   (radius * 1.35, tall), (1e-3, tall)]
        bark = p.tiles(rng, 900, 600, (p.WARM, p.STONE, p.SEA)[index], 16, 8, (60, 50, 44), offset=True)
        s.lathe(f"column {index}", profile, world(x, y, 0), s.picture_material(f"column {index}", bark, 0.7))
    for index, (x, y, side, tall) in enumerate(((-2.3, 0.4, 0.6, 0.8), (-0.3, 0.9, 0.7, 0.6), (1.9, 0.2, 0.5, 0.7),
                                               (0.2, -1.4, 0.4, 0.35))):
        s.poster_box(f"crate {index}", rng, (side, side, tall), world(x, y, 0),
                     (p.WARM, p.SEA, p.MOSS, p.PLUM)[index], turn + rng.uniform(-25, 25))
    s.monkey("bust", 0.5, world(-0.3, 0.9, 0.92), s.picture_material("bust", p.marble(rng, 500, 500, p.STONE)), turn)
    s.ball("globe", 0.3, world(1.9, 0.2, 1.0), s.picture_material("globe", p.map_of_islands(rng, 500, 1000), 0.6))
    steel = s.plain_material("steel", (0.06, 0.06, 0.07), 0.45, 0.6)
    for light in scene.lights:
        x, y, z = light.xyz
        s.rod(f"{light.name} cord", (x, y, z + 3), (x, y, z + light.radius * 1.3), 0.012, steel)
        s.lamp(light)
    s.softbox("window", world(-4.0, -4.0, 4.8), world(0, 0.8, 0.6), (3.0, 3.0), 160, (1.0, 0.95, 0.88))
    s.uniform_world((0.6, 0.6, 0.7), 0.16)


STUDIO = SceneDescription(
    name="studio", seed=71, first_number=0, views=32, camera=Pinhole(448, 280, 416.6, 416.6, 218.2, 145.6), path=path,
    build=build, samples=24, lens="fast",
    lights=(replace(LAMP, xyz=world(-1.6, 0.85, 2.2)), replace(LANTERN, xyz=world(1.2, 1.2, 1.5))))
