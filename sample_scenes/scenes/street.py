# SPDX-License-Identifier: GPL-3.0-or-later
"""A street towards a low sun, through an anamorphic lens: a long streak, and pans that lose the sun."""
from __future__ import annotations

import numpy as np

from ..description import Array, LightSource, Pinhole, SceneDescription, look_at

SUN = LightSource("sun", (4.0, 118.0, 19.0), (1.0, 0.82, 0.6), 0.95, 60.0, 2.6, 0.9, distant=True)


def camera_path(numbers: Array) -> Array:
    """Return poses (n, 4, 4), world to camera, of a walk up the street.

    The camera sways from side to side and pans until the sun leaves the frame.
    """
    poses = []
    for t in np.asarray(numbers) / 40:
        eye = np.array([1.9 * np.sin(2 * np.pi * t), -9.5 + 4.5 * t, 1.7 + 0.45 * np.sin(4 * np.pi * t + 1)])
        pan = 5.6 * np.sin(2 * np.pi * t * 1.5 + 0.6)
        target = np.array([0.4 + pan, 1.5, 2.0 + 0.3 * np.cos(5 * t)])
        poses.append(look_at(eye, target, np.radians(1.5) * np.sin(9 * t)))
    return np.array(poses)


def build_scene(scene: SceneDescription) -> None:
    """Build the street in Blender: houses, crates, a column with a head, stalls, the sky and the sun."""
    from .. import patterns as p
    from .. import stage as s

    rng = np.random.default_rng(scene.seed)
    s.empty_scene()
    cobbles = p.tiles(rng, 1600, 1600, ((110, 104, 98), (134, 126, 116), (92, 88, 86), (150, 138, 122)), 26, 20,
                      (58, 54, 50), offset=True)
    s.add_sheet("ground", 16, 44, (0, 10, 0), s.picture_material("ground", cobbles, 0.8), repeat=(1, 3))
    for side in (-1, 1):
        y = -8.0
        for index in range(5):
            length, height = rng.uniform(3.6, 5.2), rng.uniform(3.6, 5.6)
            palette = (p.WARM, p.SEA, p.MOSS, p.PLUM, p.STONE)[(index * 2 + side) % 5]
            front = s.picture_material(f"house {side} {index}", p.facade(
                rng, int(150 * height), int(150 * length), palette, 2 + int(height > 4.6), 3), 0.9)
            gable = s.picture_material(f"end {side} {index}", p.tiles(rng, 500, 400, p.STONE, 14, 8, offset=True), 0.9)
            # The fronts face the street, and away from it.
            x = side * (5.0 + rng.uniform(-0.3, 0.3))
            s.add_box(f"house {side} {index}", (3.0, length, height), (x, y + length / 2, 0),
                      [gable, front, gable, front, gable])
            y += length
    for index, (x, y, turn, size) in enumerate(((-2.6, -4.6, 20, 0.7), (-2.0, -4.9, -12, 0.5), (2.5, -2.4, 8, 0.8),
                                                (2.9, -3.3, 40, 0.55), (-2.9, 0.4, 5, 0.9), (-2.4, -4.7, 3, 0.4))):
        s.add_poster_box(f"crate {index}", rng, (size, size, size), (x, y, 0.7 if index == 5 else 0),
                         (p.WARM, p.SEA, p.MOSS, p.PLUM)[index % 4], turn)
    # A column with a head upon it, which the sun passes behind.
    stone = s.picture_material("column", p.tiles(rng, 900, 600, p.STONE, 9, 6, offset=True), 0.85)
    s.add_poster_box("plinth", rng, (1.1, 1.1, 0.7), (0.9, 1.8, 0), p.STONE)
    s.add_lathe("column", [(0.34, 0.7), (0.28, 0.9), (0.26, 2.9), (0.36, 3.1), (1e-3, 3.1)], (0.9, 1.8, 0), stone)
    s.add_monkey("head", 0.75, (0.9, 1.8, 3.5), s.picture_material("head", p.marble(rng, 600, 600, p.STONE)), 10)
    post = s.plain_material("post", (0.05, 0.06, 0.05), 0.5)
    for index, (x, y) in enumerate(((-3.2, -1.5), (3.2, 1.0), (-3.2, 5.0))):
        s.add_rod(f"post {index}", (x, y, 0), (x, y, 2.7), 0.05, post)
        s.add_box(f"lantern {index}", (0.26, 0.26, 0.4), (x, y, 2.7), [s.plain_material("glass", (0.7, 0.6, 0.4))], 45)
    for index, (x, y) in enumerate(((-3.1, 2.6), (3.0, -5.6))):
        stripes = np.repeat(np.array([[0.8, 0.2, 0.15], [0.92, 0.88, 0.8]] * 6, np.float32), 40, axis=0)
        awning = s.picture_material(f"awning {index}", np.broadcast_to(stripes, (200, 480, 3)).copy(), 0.9)
        s.add_sheet(f"awning {index}", 1.8, 1.4, (x, y, 2.1), awning, 90, (18 if x > 0 else -18, 0))
        s.add_poster_box(f"counter {index}", rng, (0.8, 1.7, 0.9), (x, y, 0), p.WARM)
    s.add_dome(160, p.sky(rng, 1000, 2000, (255, 190, 120), (70, 100, 150), (235, 170, 150)), 0.9)
    for light in scene.lights:
        s.add_lamp(light)
    s.set_uniform_world((0.5, 0.6, 0.8), 0.4)


STREET = SceneDescription(
    name="street", seed=31, first_number=0, views=40, camera=Pinhole(480, 270, 415.0, 415.0, 238.4, 136.2),
    camera_path=camera_path, build=build_scene, samples=24, lights=(SUN,), lens="anamorphic")
