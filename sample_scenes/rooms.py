# SPDX-License-Identifier: GPL-3.0-or-later
"""Clean pictures for `train-removal`: `python sample_scenes/rooms.py --out FOLDER --photos FOLDER --maps FOLDER`.

What is taken for a flare most often is bright and soft, and belongs to the scene: a lamp in a polished floor, coloured
light on a wall, mist. Of such rooms and yards there are none among photographs to be sure of; here Cycles renders them,
through no lens, so that whatever they show is no flare. Photographs are their pictures and textures, environment maps
their skies; those that are held out of trainings are left out here too. Every picture is a function of its number; one
that is there already is not made again.
"""
from __future__ import annotations

import argparse
import colorsys
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.errors import CaptureError, FitFlareError
from core.pictures import Pixels, read_exr, write_png
from core.progress import Progress, TerminalProgress, stoppable
from core.removal.backgrounds import MAPS, PHOTOS, kept_for_test
from sample_scenes import shots, stage
from sample_scenes.description import Pinhole
from sample_scenes.render import silent

SIZE = (480, 336)
SAMPLES = 10
Random = np.random.Generator
Colour = tuple[float, float, float]


def hue(random: Random, saturation: float | None = None) -> Colour:
    """A colour at its brightest, mostly a pale one."""
    return colorsys.hsv_to_rgb(random.random(), random.random() ** 1.5 if saturation is None else saturation, 1.0)


class Room:
    """One room, or one yard under a sky, with things and lamps in it: floor at z = 0, the camera looks along y."""

    def __init__(self, random: Random, photos: Sequence[Path], maps: Sequence[Path]) -> None:
        self.random, self.photos, self.maps = random, photos, maps
        self.scene = stage.empty_scene()
        self.width, self.depth, self.height = random.uniform((4, 6, 2.5), (10, 16, 5))
        self.inside, self.dark = random.random() < 0.6, random.random() < 0.55
        self._sky()
        self._shell()
        for _ in range(int(random.integers(2, 10))):
            self._thing()
        for _ in range(int(random.integers(1, 8) if self.dark else random.integers(0, 4))):
            self._lamp()
        if random.random() < 0.5:
            self._light("AREA", self._place(self.height * 0.97), math.exp(random.uniform(2, 6)))

    def _sky(self) -> None:
        random = self.random
        world = self.scene.world = bpy.data.worlds.new("Sky")
        world.use_nodes = True
        nodes, links = world.node_tree.nodes, world.node_tree.links
        background = nodes["Background"]
        if self.inside and random.random() < 0.5:
            background.inputs["Color"].default_value = (*hue(random, 0.3), 1)
            background.inputs["Strength"].default_value = 0.01 if self.dark else 0.2
            return
        picture = nodes.new("ShaderNodeTexEnvironment")
        picture.image = bpy.data.images.load(str(random.choice(self.maps)), check_existing=True)
        place, turn = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
        turn.inputs["Rotation"].default_value[2] = random.uniform(0, 2 * math.pi)
        links.new(place.outputs["Generated"], turn.inputs["Vector"])
        links.new(turn.outputs["Vector"], picture.inputs["Vector"])
        links.new(picture.outputs["Color"], background.inputs["Color"])
        background.inputs["Strength"].default_value = random.uniform(0, 0.02) if self.dark else random.uniform(0.3, 1)

    def _shell(self) -> None:
        random, middle = self.random, self.depth / 2 - 1
        polished = random.random() < 0.65
        reach = (self.width, self.depth + 2) if self.inside else (60, 60)
        roughness = random.uniform(0.03, 0.28) if polished else random.uniform(0.3, 1)
        self._plane((0, middle, 0), (0, 0, 0), reach, self._surface(roughness))
        if not self.inside:
            return
        right, half = math.pi / 2, self.width / 2
        for place, turn, size in (((-half, middle, self.height / 2), (right, 0, right), (self.depth + 2, self.height)),
                                  ((half, middle, self.height / 2), (right, 0, -right), (self.depth + 2, self.height)),
                                  ((0, self.depth, self.height / 2), (right, 0, 0), (self.width, self.height))):
            if random.random() < 0.92:
                self._plane(place, turn, size, self._surface(random.uniform(0.25, 1)))
        if random.random() < 0.85:
            self._plane((0, middle, self.height), (math.pi, 0, 0), (self.width, self.depth + 2), self._surface(0.8))

    def _thing(self) -> None:
        random, mesh = self.random, bpy.ops.mesh
        size = math.exp(random.uniform(-1.5, 0.6))
        made = [lambda: mesh.primitive_cube_add(size=size), lambda: mesh.primitive_uv_sphere_add(radius=size / 2),
                lambda: mesh.primitive_cylinder_add(radius=size / 4, depth=size * 2),
                lambda: mesh.primitive_torus_add(major_radius=size / 2, minor_radius=size / 6),
                lambda: mesh.primitive_monkey_add(size=size),
                lambda: mesh.primitive_cone_add(radius1=size / 2, depth=size * 1.5)]
        kind = int(random.integers(len(made)))
        made[kind]()
        if kind not in (0, 5):
            bpy.ops.object.shade_smooth()
        thing = bpy.context.object
        thing.location = self._place(size * random.uniform(0.3, 0.6), nearest=1.5)
        thing.rotation_euler = (*random.normal(0, 0.2, 2), random.uniform(0, 2 * math.pi))
        thing.scale = random.uniform(0.5, (1.5, 1.5, 2))
        thing.data.materials.append(self._material(
            photo=random.random() < 0.5, colour=hue(random), roughness=random.uniform(0.05, 1),
            metallic=float(random.random() < 0.2), glass=random.random() < 0.08))

    def _lamp(self) -> None:
        random = self.random
        place = self._place(random.uniform(0.6, self.height * 0.95), nearest=2)
        size = math.exp(random.uniform(-3.2, -0.9))
        colour = hue(random, random.random() ** 2 * 0.9)
        power = math.exp(random.uniform(2, 5)) * (1 if self.dark else 2)
        kind = int(random.integers(4))
        if kind == 0:
            bpy.ops.mesh.primitive_uv_sphere_add(radius=size, location=place)
            area = size * size * 12 + 0.02
        elif kind == 1:
            self._plane(place, (math.pi / 2, 0, random.uniform(-0.6, 0.6)), size * random.uniform(1, (6, 4)), None)
            area = size * size * 6 + 0.05
        elif kind == 2:
            bpy.ops.mesh.primitive_cylinder_add(radius=size / 5, depth=size * 8, location=place,
                                                rotation=(*random.choice([0, math.pi / 2], 2), 0))
            area = size * size * 4 + 0.02
        else:
            self._light("SPOT", place, power * 8, colour)
            return
        bpy.context.object.data.materials.append(self._material(
            photo=kind == 1 and random.random() < 0.5, colour=colour, strength=power / area / 8))

    def _light(self, kind: str, place: Colour, power: float, colour: Colour | None = None) -> None:
        random = self.random
        bpy.ops.object.light_add(type=kind, location=place)
        light = bpy.context.object
        light.data.energy, light.data.color = power, colour or hue(random, random.random() ** 2)
        if kind == "SPOT":
            light.rotation_euler = (*random.normal(0, 0.7, 2), 0)
            light.data.spot_size, light.data.shadow_soft_size = random.uniform(0.4, 1.8), 0.05
        else:
            light.data.size = random.uniform(0.3, 3)

    def _place(self, height: float, nearest: float = 0.0) -> Colour:
        across = self.random.uniform(-self.width / 2, self.width / 2) * 0.9
        return across, self.random.uniform(nearest, self.depth * 0.95), height

    def _plane(self, place: Sequence[float], turn: Sequence[float], size: Sequence[float], material: Any) -> None:
        bpy.ops.mesh.primitive_plane_add(size=1, location=place, rotation=turn)
        bpy.context.object.scale = (*size, 1)
        if material is not None:
            bpy.context.object.data.materials.append(material)

    def _surface(self, roughness: float) -> Any:
        random = self.random
        colour = np.array(hue(random)) * random.uniform(0.05, 0.8, 3)
        return self._material(photo=random.random() < 0.6, colour=colour, roughness=roughness,
                              metallic=float(random.random() < 0.08), repeated=float(random.choice([1, 1, 2, 4])))

    def _material(self, *, photo: bool, colour: Sequence[float], roughness: float = 0.5, metallic: float = 0.0,
                  strength: float = 0.0, glass: bool = False, repeated: float = 1.0) -> Any:
        """strength: of what it gives off, in its colour or that of its photograph."""
        random = self.random
        material = bpy.data.materials.new("Surface")
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        shader = nodes["Principled BSDF"]
        given = shader.inputs
        given["Roughness"].default_value, given["Metallic"].default_value = roughness, metallic
        given["Transmission Weight"].default_value = float(glass)
        given["Base Color"].default_value = given["Emission Color"].default_value = (*colour, 1)
        given["Emission Strength"].default_value = strength
        if photo:
            picture, place, size = (nodes.new(f"ShaderNode{name}") for name in ("TexImage", "TexCoord", "Mapping"))
            picture.image = bpy.data.images.load(str(random.choice(self.photos)), check_existing=True)
            picture.extension = "MIRROR"
            size.inputs["Scale"].default_value = (repeated,) * 3
            links.new(place.outputs["Generated"], size.inputs["Vector"])
            links.new(size.outputs["Vector"], picture.inputs["Vector"])
            for name in ("Base Color", "Emission Color"):
                links.new(picture.outputs["Color"], given[name])
        if random.random() < 0.5:
            noise, bump = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeBump")
            noise.inputs["Scale"].default_value = math.exp(random.uniform(1, 5))
            bump.inputs["Strength"].default_value = random.uniform(0.02, 0.3)
            links.new(noise.outputs[0], bump.inputs["Height"])
            links.new(bump.outputs["Normal"], given["Normal"])
        return material

    def filmed(self) -> Pixels:
        """Scene-linear light (height, width, 3), through the air of the room, which is misty in one of seven."""
        random = self.random
        width, height = SIZE if random.random() < 0.75 else SIZE[::-1]
        focal = max(width, height) * random.uniform(16, 45) / 36
        camera = shots.set_up(Pinhole(width, height, focal, focal, width / 2, height / 2), SAMPLES)
        camera.location = (random.uniform(-0.25, 0.25) * self.width, random.uniform(-1, 0.5),
                           random.uniform(0.4, min(2.2, self.height * 0.8)))
        towards = Vector((random.uniform(-0.33, 0.33) * self.width, self.depth * random.uniform(0.4, 1),
                          random.uniform(0, self.height * 0.7)))
        camera.rotation_euler = (towards - camera.location).to_track_quat("-Z", "Y").to_euler()
        if random.random() < 0.3:
            camera.data.dof.use_dof = True
            camera.data.dof.aperture_fstop = math.exp(random.uniform(-1, 1.2))
            camera.data.dof.focus_distance = random.uniform(1.5, 6)
        self.scene.cycles.denoising_prefilter = "FAST"
        self.scene.view_layers[0].use_pass_z = True
        settings = self.scene.render.image_settings
        settings.media_type, settings.file_format = "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER"
        with tempfile.TemporaryDirectory() as folder, silent():
            self.scene.render.filepath = str(Path(folder) / "room.exr")
            bpy.ops.render.render(write_still=True)
            channels = read_exr(self.scene.render.filepath)
        light = np.stack([_ending(channels, f"Combined.{name}") for name in "RGB"], -1)
        if random.random() < 0.15:
            far = np.minimum(_ending(channels, ".Z"), self.depth * 6)
            through = np.exp(far * (-math.exp(random.uniform(-2.5, 0.5)) / self.depth))[..., None]
            air = np.array(hue(random, random.random() * 0.4), np.float32)
            light = light * through + air * np.percentile(light.mean(-1), random.uniform(50, 97)) * (1 - through)
        return np.asarray(light, np.float32)


def _ending(channels: dict[str, Pixels], end: str) -> Pixels:
    """The channel whose name ends so."""
    return next(pixels for name, pixels in channels.items() if name.endswith(end))


def developed(random: Random, light: Pixels) -> Pixels:
    """Display values 0..1, exposed by all but the brightest twentieth."""
    grey = light.mean(-1)
    level = (np.percentile(grey, 60) + np.minimum(grey, np.percentile(grey, 95)).mean()) / 2
    light = light * min(math.exp(random.normal(math.log(0.13), 0.55)) / max(float(level), 1e-4), 500)
    if random.random() < 0.5:  # a soft shoulder
        light = light * (1 + light / 9) / (1 + light) * 1.2
    return np.asarray(np.clip(light, 0, 1) ** (1 / random.choice([1.8, 2.0, 2.2])), np.float32)


def pictures(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    """Those of a folder that trainings may see. Raises CaptureError where there are none."""
    found = [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in suffixes
             and path.is_file() and not path.name.startswith(".") and not kept_for_test(path.name)]
    if not found:
        raise CaptureError(f"{folder} holds none of {', '.join(sorted(suffixes))}; name a folder of clean pictures.")
    return found


def make(folder: Path, photos: Sequence[Path], maps: Sequence[Path], count: int, progress: Progress) -> None:
    """The first `count` pictures of all, those that are not in the folder yet."""
    paths = [folder / f"room_{number:05d}.png" for number in range(count)]
    missing = [number for number, path in enumerate(paths) if not path.is_file()]
    folder.mkdir(parents=True, exist_ok=True)
    progress.stage("rooms", count, count - len(missing))
    for number in missing:
        random = np.random.default_rng(number)
        write_png(paths[number], developed(random, Room(random, photos, maps).filmed()))
        progress.advance()


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to write the pictures to")
    parser.add_argument("--photos", type=Path, required=True, help="folder of clean photographs")
    parser.add_argument("--maps", type=Path, required=True, help="folder of environment maps")
    parser.add_argument("--count", type=int, default=100)
    chosen = parser.parse_args()
    progress = TerminalProgress()
    try:
        with stoppable(progress):
            make(chosen.out, pictures(chosen.photos, PHOTOS), pictures(chosen.maps, MAPS), chosen.count, progress)
    except FitFlareError as problem:
        progress.error(str(problem))
        return 1
    finally:
        progress.close()
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # Blender's library may hang when its interpreter winds down
