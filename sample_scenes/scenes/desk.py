# SPDX-License-Identifier: GPL-3.0-or-later
"""A desk in the evening: a warm lamp that leaves the frame, a cool lantern behind a vase and books."""
from __future__ import annotations

import numpy as np

from ..description import Array, LightSource, Pinhole, SceneDescription, look_at

LAMP = LightSource("lamp", (-1.72, 0.75, 2.28), (1.0, 0.72, 0.42), 0.085, 30.0, 130.0, 0.78)
LANTERN = LightSource("lantern", (1.15, 1.35, 1.42), (0.45, 0.72, 1.0), 0.075, 30.0, 80.0, 0.62)


def camera_path(numbers: Array) -> Array:
    """Return poses (n, 4, 4), world to camera, on a figure of eight in front of the desk.

    The path is 80 degrees wide and comes nearer and goes farther; a round takes 66 views.
    """
    poses = []
    for t in np.asarray(numbers) / 66 * 2 * np.pi:
        azimuth = np.radians(40) * np.sin(t)
        height = 1.75 + 0.75 * np.sin(2 * t + 0.4)
        distance = 5.6 + 0.55 * np.cos(t + 0.8)
        target = np.array([0.42 * np.sin(t + 0.9), 0.7, 0.92 + 0.34 * np.cos(t)])
        eye = np.array([distance * np.sin(azimuth), 0.7 - distance * np.cos(azimuth), height])
        poses.append(look_at(eye, target, np.radians(2.5) * np.sin(3 * t)))
    return np.array(poses)


def build_scene(scene: SceneDescription) -> None:
    """Build the desk in Blender: wall with posters, books, vase, globe, small things, lamp and lantern."""
    from .. import patterns as p
    from .. import stage as s

    rng = np.random.default_rng(scene.seed)
    s.empty_scene()

    wood = s.picture_material("table", p.planks(rng, 1400, 2000, ((60, 34, 20), (128, 80, 46), (176, 124, 78))))
    s.add_box("table", (7.6, 5.4, 0.16), (0, 0.4, -0.16), [wood])
    wall = p.tiles(rng, 1100, 3400, ((96, 112, 122), (116, 128, 132), (84, 98, 110), (132, 138, 134)), 12, 22,
                   (52, 60, 66), offset=True)
    s.add_sheet("wall", 20, 6.5, (0, 3.2, 1.7), s.picture_material("wall", wall, 0.9), tilt=(90, 0))
    rug = p.weave(rng, 900, 1500, p.PLUM)
    s.add_sheet("runner", 4.4, 2.5, (0.1, -0.25, 0.006), s.picture_material("runner", rug, 0.95), turn=4)

    frame = s.plain_material("frame", (0.05, 0.03, 0.02), 0.4)
    for index, (x, z, width, height, palette) in enumerate((
            (-2.9, 1.75, 1.5, 1.9, p.SEA), (-0.75, 2.05, 1.8, 1.35, p.WARM), (1.45, 2.35, 1.2, 1.6, p.MOSS),
            (3.35, 1.7, 1.7, 1.5, p.PLUM))):
        picture = p.framed(p.poster(rng, int(420 * height), int(420 * width), palette, 46))
        s.add_box(f"frame {index}", (width + 0.12, 0.07, height + 0.12), (x, 3.14, z - height / 2 - 0.06), [frame])
        s.add_sheet(f"poster {index}", width, height, (x, 3.09, z), s.picture_material(f"poster {index}", picture, 0.8),
                    tilt=(90, 0))

    _add_books(rng)
    _add_props(rng)
    _add_lamps(scene)
    s.add_softbox("window", (-4.5, -4.0, 5.0), (0, 0.8, 0.6), (3.0, 3.0), 215, (1.0, 0.96, 0.9))
    s.add_softbox("room", (5.0, -3.0, 4.5), (0, 0.8, 0.6), (4.0, 4.0), 100, (0.75, 0.86, 1.0))
    s.set_uniform_world((0.55, 0.65, 0.8), 0.14)


def _add_books(rng: np.random.Generator) -> None:
    """Add books on the right, in front of the lantern from some places, and a pile with a head on the left."""
    from .. import patterns as p
    from .. import stage as s

    x = 1.42
    for index, height in enumerate((1.12, 1.28, 1.05, 1.22, 1.36)):
        width = 0.15 + 0.05 * (index % 3)
        palette = (p.SEA, p.WARM, p.MOSS, p.PLUM, p.STONE)[index]
        spine = p.framed(p.poster(rng, 640, int(640 * width / height), palette, 12), 0.1, palette[0])
        cover = p.framed(p.poster(rng, 640, 460, palette, 20), 0.08, palette[3])
        pages = p.noise(rng, 64, 460, 12, 2)[..., None] * 0.2 + np.array([0.75, 0.7, 0.6], np.float32)
        materials = [s.picture_material(f"book {index} {side}", texture, 0.75)
                     for side, texture in enumerate((spine, cover, spine, cover, pages))]
        turn = -4 + 2 * (index % 3)
        s.add_box(f"book {index}", (width, 0.85, height), (x + width / 2, 0.62, 0), materials, turn)
        x += width + 0.025
    pile_top = 0.0
    for index, (length, depth, height) in enumerate(((1.25, 0.9, 0.2), (1.1, 0.85, 0.16), (1.0, 0.7, 0.22))):
        palette = (p.WARM, p.SEA, p.PLUM)[index]
        spine = p.framed(p.poster(rng, int(700 * height / length) + 8, 700, palette, 12), 0.1, palette[0])
        cover = p.framed(p.poster(rng, 560, 700, palette, 26), 0.08, palette[3])
        materials = [s.picture_material(f"pile {index} {side}", texture, 0.75)
                     for side, texture in enumerate((spine, spine, spine, spine, cover))]
        turn = (12, -9, 24)[index]
        s.add_box(f"pile {index}", (length, depth, height), (-1.75, 0.05, pile_top), materials, turn)
        pile_top += height
    s.add_monkey("head", 0.78, (-1.72, 0.02, pile_top + 0.36),
                 s.picture_material("head", p.marble(rng, 700, 700, ((70, 60, 56), (190, 176, 160), (236, 228, 214)))),
                 turn=18)


def _add_props(rng: np.random.Generator) -> None:
    """Add a vase that the lantern passes behind, a globe, a mug, cubes, pages and a plant."""
    from .. import patterns as p
    from .. import stage as s

    outline = [(1e-3, 0.0), (0.24, 0.0), (0.27, 0.05), (0.36, 0.3), (0.4, 0.55), (0.36, 0.82), (0.2, 1.12),
               (0.13, 1.3), (0.13, 1.52), (0.2, 1.68), (0.17, 1.68), (0.1, 1.5)]
    glaze = p.tiles(rng, 900, 1400, p.SEA, 9, 16, (222, 214, 190), offset=True)
    s.add_lathe("vase", outline, (0.62, 0.1, 0), s.picture_material("vase", glaze, 0.45), 64)

    globe = s.picture_material("globe", p.map_of_islands(rng, 700, 1400), 0.55)
    brass = s.plain_material("brass", (0.5, 0.36, 0.16), 0.4, 0.8)
    s.add_ball("globe", 0.52, (-0.38, 0.95, 0.82), globe, turn=40, tilt=(18, 0))
    s.add_lathe("globe foot", [(1e-3, 0), (0.34, 0), (0.32, 0.05), (0.06, 0.1), (0.05, 0.32), (1e-3, 0.32)],
                (-0.38, 0.95, 0), brass)

    mug = p.tiles(rng, 420, 900, p.WARM, 4, 10, (240, 232, 214))
    s.add_lathe("mug", [(1e-3, 0.0), (0.19, 0.0), (0.2, 0.02), (0.2, 0.42), (0.175, 0.42), (0.17, 0.05), (1e-3, 0.05)],
                (-0.52, -0.75, 0), s.picture_material("mug", mug, 0.5), 48)
    for index, (x, y, turn, side) in enumerate(((1.5, -0.95, 28, 0.36), (1.95, -0.75, -14, 0.36),
                                                (1.7, -0.82, 8, 0.32), (-2.7, -0.6, 33, 0.44))):
        sides = [s.picture_material(f"cube {index} {face}", p.framed(
            p.poster(rng, 300, 300, (p.WARM, p.SEA, p.MOSS, p.PLUM)[(index + face) % 4], 9), 0.1), 0.7)
                 for face in range(5)]
        s.add_box(f"cube {index}", (side, side, side), (x, y, 0.36 if index == 2 else 0), sides, turn)
    for index, (x, y, turn) in enumerate(((0.35, -1.25, -12), (-1.15, -1.35, 17), (2.6, 0.0, -20))):
        page = p.writing(rng, 700, 520, (238, 232, 216), (40, 44, 66), 30)
        s.add_sheet(f"page {index}", 0.7, 0.95, (x, y, 0.012 + 0.002 * index),
                    s.picture_material(f"page {index}", page, 0.9), turn)
    s.add_lathe("pot", [(1e-3, 0), (0.2, 0), (0.28, 0.45), (0.3, 0.45), (0.3, 0.52), (0.25, 0.52), (0.22, 0.4),
                        (1e-3, 0.4)], (2.75, 1.35, 0),
                s.picture_material("pot", p.marble(rng, 400, 800, p.STONE), 0.8))
    leaf = s.picture_material("leaf", p.gradient_map(p.noise(rng, 256, 256, 40, 4), ((28, 54, 30), (76, 116, 58),
                                                                                     (140, 160, 90))), 0.7)
    for index in range(15):
        lean, azimuth = rng.uniform(20, 60), index * 137.5
        leaf_offset = 0.32 * np.sin(np.radians(lean))
        position = (2.75 + leaf_offset * np.cos(np.radians(azimuth)), 1.35 + leaf_offset * np.sin(np.radians(azimuth)),
                    0.62 + 0.4 * np.cos(np.radians(lean)) + 0.12 * (index % 3))
        s.add_sheet(f"leaf {index}", 0.66, 0.2, position, leaf, azimuth, (rng.uniform(-20, 20), -(90 - lean)))


def _add_lamps(scene: SceneDescription) -> None:
    """Add the desk lamp (a foot, two arms, a bulb without shade), and the lantern on a bracket on the wall."""
    from .. import stage as s

    steel = s.plain_material("steel", (0.06, 0.06, 0.07), 0.45, 0.6)
    lamp, lantern = (np.array(light.xyz) for light in scene.lights)
    foot, elbow = np.array([-2.55, 1.3, 0.0]), np.array([-2.75, 1.25, 1.6])
    s.add_lathe("lamp foot", [(1e-3, 0), (0.34, 0), (0.32, 0.06), (0.05, 0.09), (1e-3, 0.09)], tuple(foot), steel)
    s.add_rod("lamp arm", foot, elbow, 0.035, steel)
    neck = lamp + (elbow - lamp) / np.linalg.norm(elbow - lamp) * 0.12
    s.add_rod("lamp neck", elbow, neck, 0.03, steel)
    s.add_rod("bracket", (lantern[0], 3.2, 2.0), (lantern[0], lantern[1], 2.0), 0.025, steel)
    s.add_rod("chain", (lantern[0], lantern[1], 2.0), lantern + np.array([0, 0, 0.1]), 0.012, steel)
    for light in scene.lights:
        s.add_lamp(light)


DESK = SceneDescription(
    name="desk", seed=20, views=60, first_number=6, camera=Pinhole(480, 270, 470.0, 470.0, 242.3, 133.1),
    camera_path=camera_path, build=build_scene, lights=(LAMP, LANTERN), lens="fast", held_out=(37, 40, 60))
