# SPDX-License-Identifier: GPL-3.0-or-later
"""A room as chance has it, with what is taken for a flare and is none: lamps in a polished floor, coloured light on
walls, mist, lights out of focus. Runs where bpy is."""
from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from core.colour.srgb import Pixels
from core.errors import FrameError
from core.images.exr import read_exr

from . import shots, stage
from .command import silent
from .description import Pinhole, looking_at

SIZE = (480, 336)
SAMPLES = 10
Random = np.random.Generator
Colour = tuple[float, float, float]


def hue(random: Random, saturation: float | None = None) -> Colour:
    """A colour at its brightest, mostly a pale one."""
    return colorsys.hsv_to_rgb(random.random(), random.random() ** 1.5 if saturation is None else saturation, 1.0)


def loaded(path: Path) -> Any:
    """The picture in Blender. Raises FrameError where it cannot be read, which Blender would show as pink."""
    image = bpy.data.images.load(str(path), check_existing=True)
    if not image.size[0]:
        raise FrameError(f"{path} cannot be read; take it out of its folder.")
    return image


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
        if self.inside and random.random() < 0.5:
            stage.surroundings(hue(random, 0.3), 0.01 if self.dark else 0.2)
            return
        stage.surroundings((0, 0, 0), 1)
        nodes, links = self.scene.world.node_tree.nodes, self.scene.world.node_tree.links
        background = nodes["Background"]
        picture = nodes.new("ShaderNodeTexEnvironment")
        picture.image = loaded(random.choice(self.maps))
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
        stage.sheet("floor", *reach, (0, middle, 0), self._surface(roughness))
        if not self.inside:
            return
        long, half, high = self.depth + 2, self.width / 2, self.height / 2
        for name, length, place, turn in (("left", long, (-half, middle, high), 90),
                                          ("right", long, (half, middle, high), -90),
                                          ("back", self.width, (0, self.depth, high), 0)):
            if random.random() < 0.92:
                stage.sheet(name, length, self.height, place, self._surface(random.uniform(0.25, 1)), turn, (90, 0))
        if random.random() < 0.85:
            stage.sheet("ceiling", self.width, long, (0, middle, self.height), self._surface(0.8), tilt=(180, 0))

    def _thing(self) -> None:
        random, mesh = self.random, bpy.ops.mesh
        size = math.exp(random.uniform(-1.5, 0.6))
        kind = random.choice(["cube", "ball", "pillar", "ring", "monkey", "cone"])
        match kind:
            case "cube":
                mesh.primitive_cube_add(size=size)
            case "ball":
                mesh.primitive_uv_sphere_add(radius=size / 2)
            case "pillar":
                mesh.primitive_cylinder_add(radius=size / 4, depth=size * 2)
            case "ring":
                mesh.primitive_torus_add(major_radius=size / 2, minor_radius=size / 6)
            case "monkey":
                mesh.primitive_monkey_add(size=size)
            case "cone":
                mesh.primitive_cone_add(radius1=size / 2, depth=size * 1.5)
        if kind not in ("cube", "cone"):
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
        match random.choice(["bulb", "screen", "tube", "spot"]):
            case "bulb":
                bpy.ops.mesh.primitive_uv_sphere_add(radius=size, location=place)
                bpy.context.object.data.materials.append(self._shining(colour, power / (size * size * 12 + 0.02)))
            case "screen":
                turn = math.degrees(random.uniform(-0.6, 0.6))
                width, height = size * random.uniform(1, (6, 4))
                shining = self._shining(colour, power / (size * size * 6 + 0.05), photo=random.random() < 0.5)
                stage.sheet("screen", width, height, place, shining, turn, (90, 0))
            case "tube":
                bpy.ops.mesh.primitive_cylinder_add(radius=size / 5, depth=size * 8, location=place,
                                                    rotation=(*random.choice([0, math.pi / 2], 2), 0))
                bpy.context.object.data.materials.append(self._shining(colour, power / (size * size * 4 + 0.02)))
            case "spot":
                self._light("SPOT", place, power * 8, colour)

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

    def _surface(self, roughness: float) -> Any:
        random = self.random
        colour = np.array(hue(random)) * random.uniform(0.05, 0.8, 3)
        return self._material(photo=random.random() < 0.6, colour=colour, roughness=roughness,
                              metallic=float(random.random() < 0.08), repeated=float(random.choice([1, 1, 2, 4])))

    def _shining(self, colour: Colour, power: float, photo: bool = False) -> Any:
        """power: for each unit of its surface, or of about as much."""
        return self._material(photo=photo, colour=colour, strength=power / 8)

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
            picture.image = loaded(random.choice(self.photos))
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
        eye = np.array([random.uniform(-0.25, 0.25) * self.width, random.uniform(-1, 0.5),
                        random.uniform(0.4, min(2.2, self.height * 0.8))])
        target = np.array([random.uniform(-0.33, 0.33) * self.width, self.depth * random.uniform(0.4, 1),
                           random.uniform(0, self.height * 0.7)])
        shots.aim(camera, looking_at(eye, target))
        if random.random() < 0.3:
            camera.data.dof.use_dof = True
            camera.data.dof.aperture_fstop = math.exp(random.uniform(-1, 1.2))
            camera.data.dof.focus_distance = random.uniform(1.5, 6)
        self.scene.cycles.denoising_prefilter = "FAST"
        self.scene.view_layers[0].use_pass_z = True
        settings = self.scene.render.image_settings
        settings.media_type, settings.file_format = "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER"
        with silent():
            channels = shots.rendered(read_exr)
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
