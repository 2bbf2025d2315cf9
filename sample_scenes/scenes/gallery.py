# SPDX-License-Identifier: GPL-3.0-or-later
"""A gallery with three lights of different kinds, one of them behind a partition from most places."""
from __future__ import annotations

import numpy as np

from ..description import Array, LightSource, Pinhole, SceneDescription, look_at

PENDANT = LightSource("pendant", (-1.3, 0.6, 2.55), (1.0, 0.8, 0.55), 0.11, 25.0, 150.0, 0.75)
SIGN = LightSource("sign", (2.45, 2.2, 1.75), (1.0, 0.25, 0.6), 0.05, 35.0, 40.0, 0.55)
STUDIO = LightSource("studio", (0.75, 3.1, 1.5), (0.7, 0.88, 1.0), 0.08, 50.0, 110.0, 0.9)


def camera_path(numbers: Array) -> Array:
    """Return poses (n, 4, 4), world to camera, on a slow arc of 75 degrees through the room, at heights from 1 to 2.

    numbers: the frames', 0..39.
    """
    poses = []
    for t in np.asarray(numbers) / 40:
        azimuth = np.radians(-36 + 74 * t)
        distance = 4.7 + 0.6 * np.sin(5 * t)
        eye = np.array([distance * np.sin(azimuth), 1.2 - distance * np.cos(azimuth), 1.5 + 0.5 * np.sin(7 * t)])
        target = np.array([0.5 * np.sin(4 * t + 1), 1.2, 1.35 + 0.25 * np.cos(6 * t)])
        poses.append(look_at(eye, target, np.radians(2) * np.sin(6 * t)))
    return np.array(poses)


def build_scene(scene: SceneDescription) -> None:
    """Build the gallery in Blender: walls with pictures, a partition, plinths, three lights."""
    from .. import patterns as p
    from .. import stage as s

    rng = np.random.default_rng(scene.seed)
    s.empty_scene()
    floor = p.planks(rng, 1600, 2000, ((70, 44, 28), (140, 96, 58), (190, 146, 98)), 14)
    s.add_sheet("floor", 13, 12, (0, 0.5, 0), s.picture_material("floor", floor, 0.6))
    plaster = ((176, 168, 158), (150, 146, 142), (190, 182, 168))
    for name, width, position, turn in (("back", 13, (0, 4.2, 1.8), 0), ("left", 10, (-4.6, 0, 1.8), 90),
                                        ("right", 10, (4.6, 0, 1.8), -90)):
        wall = p.tiles(rng, 700, 2400, plaster, 5, 12, (120, 112, 104))
        s.add_sheet(name, width, 3.8, position, s.picture_material(name, wall, 0.95), turn, (90, 0))
    dark = s.plain_material("frame", (0.03, 0.03, 0.035), 0.5)
    for index, (x, y, z, width, height, turn) in enumerate((
            (-3.0, 4.13, 1.8, 1.6, 1.2, 0), (-0.9, 4.13, 2.0, 1.1, 1.5, 0), (3.3, 4.13, 1.9, 1.5, 1.5, 0),
            (-4.53, 1.5, 1.8, 1.8, 1.3, 90), (-4.53, -0.9, 1.9, 1.2, 1.5, 90), (4.53, 1.4, 1.7, 1.5, 1.7, -90),
            (4.53, -0.9, 1.9, 1.4, 1.1, -90))):
        palette = (p.SEA, p.WARM, p.MOSS, p.PLUM)[index % 4]
        art = p.framed(p.poster(rng, int(400 * height), int(400 * width), palette, 40), 0.06)
        offset = np.array([np.sin(np.radians(turn)), -np.cos(np.radians(turn))]) * 0.05
        s.add_sheet(f"backing {index}", width + 0.12, height + 0.12, (x, y, z), dark, turn, (90, 0))
        s.add_sheet(f"art {index}", width, height, (x + offset[0], y + offset[1], z),
                    s.picture_material(f"art {index}", art, 0.8), turn, (90, 0))
    # The partition: the studio light stands behind it and shows past its edge and through its slot.
    panel = [s.picture_material(f"panel {i}", p.framed(p.poster(rng, 700, 420, p.STONE, 24), 0.05), 0.9)
             for i in range(2)]
    s.add_box("partition left", (1.3, 0.14, 2.4), (0.15, 2.3, 0), panel[:1])
    s.add_box("partition right", (0.75, 0.14, 2.4), (1.42, 2.3, 0), panel[1:])
    for index, (x, y, width, height) in enumerate(((-1.7, 1.4, 0.6, 1.0), (-0.2, 0.2, 0.5, 0.75), (1.7, 0.6, 0.6, 0.9),
                                                   (-3.1, 0.4, 0.55, 1.1), (3.1, -0.2, 0.5, 0.8))):
        s.add_poster_box(f"plinth {index}", rng, (width, width, height), (x, y, 0), (p.STONE, p.SEA, p.PLUM)[index % 3],
                         rng.uniform(-20, 20))
    vase = [(1e-3, 0), (0.16, 0), (0.26, 0.25), (0.2, 0.5), (0.08, 0.66), (0.13, 0.8), (0.1, 0.8)]
    s.add_lathe("vase", vase, (-1.7, 1.4, 1.0), s.picture_material("vase", p.tiles(rng, 500, 900, p.WARM, 7, 12), 0.5))
    s.add_monkey("bust", 0.55, (-0.2, 0.2, 1.03), s.picture_material("bust", p.marble(rng, 600, 600, p.STONE)), -8)
    s.add_ball("globe", 0.3, (1.7, 0.6, 1.2), s.picture_material("globe", p.map_of_islands(rng, 500, 1000), 0.6), 60)
    s.add_lathe("cone", [(1e-3, 0), (0.25, 0), (1e-3, 0.7)], (-3.1, 0.4, 1.1),
                s.picture_material("cone", p.tiles(rng, 500, 700, p.MOSS, 8, 10), 0.6))
    s.add_poster_box("block", rng, (0.34, 0.34, 0.34), (3.1, -0.2, 0.8), p.WARM, 25)
    s.add_poster_box("bench", rng, (1.6, 0.5, 0.42), (1.1, -0.9, 0), p.SEA, -14)
    steel = s.plain_material("steel", (0.06, 0.06, 0.07), 0.4, 0.7)
    s.add_rod("cord", (PENDANT.xyz[0], PENDANT.xyz[1], 3.7), (PENDANT.xyz[0], PENDANT.xyz[1], 2.68), 0.012, steel)
    s.add_rod("stand", (STUDIO.xyz[0], STUDIO.xyz[1], 0), (STUDIO.xyz[0], STUDIO.xyz[1], 1.4), 0.03, steel)
    s.add_rod("holder", (SIGN.xyz[0], SIGN.xyz[1], 0), (SIGN.xyz[0], SIGN.xyz[1], 1.68), 0.025, steel)
    for light in scene.lights:
        s.add_lamp(light)
    s.add_softbox("skylight", (0, -1, 3.7), (0, 0.5, 0), (5, 4), 70, (0.9, 0.95, 1.0))
    s.set_uniform_world((0.6, 0.65, 0.75), 0.15)


GALLERY = SceneDescription(
    name="gallery", seed=47, first_number=0, views=40, camera=Pinhole(480, 270, 395.0, 395.0, 243.1, 131.6),
    camera_path=camera_path, build=build_scene, samples=24, lights=(PENDANT, SIGN, STUDIO), lens="wide")
