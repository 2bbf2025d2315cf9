# SPDX-License-Identifier: GPL-3.0-or-later
"""A garden at dusk with one lamp between columns, through a lens whose flare is mostly rings."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..description import Array, LightSource, Pinhole, SceneDescription, look_at

LAMP = LightSource("lamp", (0.2, 1.2, 2.1), (0.95, 0.9, 1.0), 0.1, 40.0, 320.0, 1.0, reference_distance=6.0)


def camera_path(numbers: Array) -> Array:
    """Return poses (n, 4, 4), world to camera, on an arc of 120 degrees around the lamp.

    Height and distance change along it.
    """
    poses = []
    for t in np.asarray(numbers) / 40:
        azimuth = np.radians(-60 + 120 * t)
        distance = 6.3 + 0.9 * np.sin(2 * np.pi * t)
        height = 2.1 + 0.9 * np.sin(4 * np.pi * t)
        eye = np.array([distance * np.sin(azimuth), 1.2 - distance * np.cos(azimuth), height])
        target = np.array([0.9 * np.sin(6 * t), 1.2, 1.3 + 0.35 * np.cos(8 * t)])
        poses.append(look_at(eye, target))
    return np.array(poses)


def build_scene(scene: SceneDescription) -> None:
    """Build the garden in Blender: hedges, a ring of columns, pots, the sky and the lamp."""
    from .. import patterns as p
    from .. import stage as s

    rng = np.random.default_rng(scene.seed)
    s.empty_scene()
    greens = ((30, 48, 26), (64, 92, 44), (112, 132, 70), (150, 146, 90))
    grass = p.gradient_map(p.noise(rng, 1400, 1400, 120, 5), greens)
    s.add_sheet("lawn", 30, 30, (0, 2, 0), s.picture_material("lawn", grass, 1.0))
    paving = p.tiles(rng, 1200, 1200, p.STONE, 9, 9, (70, 74, 60))
    s.add_sheet("terrace", 6.4, 6.4, (0.2, 1.2, 0.02), s.picture_material("terrace", paving, 0.85), 10)
    hedge = p.gradient_map(p.noise(rng, 500, 2400, 60, 5), ((16, 34, 18), (44, 78, 36), (96, 120, 60)))
    for index in range(9):
        angle = np.radians(-20 + 27.5 * index)
        position = (0.2 + 8.5 * np.cos(angle), 1.2 + 8.5 * np.sin(angle), 1.1)
        leaves = s.picture_material(f"hedge {index}", np.roll(hedge, 260 * index, 1)[:, :900], 1.0)
        s.add_sheet(f"hedge {index}", 4.3, 2.2, position, leaves, np.degrees(angle) - 90, (90, 0))
    limestone = ((180, 170, 156), (150, 142, 130), (200, 190, 172))
    column = p.tiles(rng, 900, 600, limestone, 8, 6, (96, 90, 82), offset=True)
    shaft = [(0.3, 0.0), (0.3, 0.2), (0.17, 0.3), (0.15, 2.7), (0.28, 2.9), (0.28, 3.05), (1e-3, 3.05)]
    stone = s.picture_material("column", column, 0.85)
    for index in range(7):
        angle = np.radians(-90 + 360 / 7 * (index + 0.5))
        position = (0.2 + 2.5 * np.cos(angle), 1.2 + 2.5 * np.sin(angle), 0)
        s.add_lathe(f"column {index}", shaft, position, stone, turn=50 * index)
    for index in range(7):
        angle = np.radians(-90 + 360 / 7 * (index + 1))
        position = (0.2 + 2.3 * np.cos(angle), 1.2 + 2.3 * np.sin(angle), 3.05)
        s.add_poster_box(f"lintel {index}", rng, (2.3, 0.4, 0.3), position, p.STONE, np.degrees(angle) - 90)
    s.add_poster_box("pedestal", rng, (0.7, 0.7, 1.5), (0.2, 1.2, 0), p.SEA, 15)
    steel = s.plain_material("steel", (0.05, 0.05, 0.05), 0.4, 0.6)
    s.add_rod("lamp post", (0.2, 1.2, 1.5), (0.2, 1.2, 1.98), 0.035, steel)
    pot = [(1e-3, 0), (0.25, 0), (0.36, 0.5), (0.4, 0.5), (0.4, 0.6), (0.33, 0.6), (0.3, 0.45), (1e-3, 0.45)]
    for index in range(8):
        angle = np.radians(45 * index + 12)
        position = (0.2 + 3.7 * np.cos(angle), 1.2 + 3.7 * np.sin(angle), 0)
        palette = (p.WARM, p.SEA, p.PLUM, p.MOSS)[index % 4]
        glaze = s.picture_material(f"pot {index}", p.tiles(rng, 400, 900, palette, 5, 12), 0.7)
        s.add_lathe(f"pot {index}", pot, position, glaze)
        bush = p.gradient_map(p.noise(rng, 300, 600, 50, 4), ((24, 52, 24), (80, 124, 52), (196, 150, 90)))
        leaves = s.picture_material(f"bush {index}", bush, 1.0)
        s.add_ball(f"bush {index}", 0.38, (position[0], position[1], 0.85), leaves, 40 * index)
    s.add_monkey("head", 0.9, (-1.2, 0.1, 0.55), s.picture_material("head", p.marble(rng, 600, 600, p.STONE)), 25)
    s.add_poster_box("chest", rng, (0.9, 0.5, 0.45), (1.5, 0.0, 0.02), p.WARM, -20)
    s.add_dome(60, p.sky(rng, 900, 1800, (120, 100, 130), (26, 34, 70), (110, 84, 110)), 0.35)
    for light in scene.lights:
        s.add_lamp(light)
    s.add_softbox("dusk", (-6, -8, 9), (0, 1, 0.5), (6, 6), 900, (0.6, 0.7, 1.0))
    s.set_uniform_world((0.4, 0.5, 0.8), 0.2)


GARDEN = SceneDescription(
    name="garden", seed=63, first_number=0, views=40, camera=Pinhole(480, 270, 440.0, 440.0, 236.9, 137.4),
    camera_path=camera_path, build=build_scene, samples=24, lights=(LAMP,), lens="ringed")

RIMS = replace(GARDEN, name="rims", lens="rimmed")
"""The same views through a lens of thin rings; the garden's are broad bands of colour."""
