# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds random rooms in Blender with what resembles a flare but is none: lamps in a polished floor, coloured light on
walls, mist, lights out of focus."""
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
from .command import silence_blender
from .description import Pinhole, look_at

SIZE = (480, 336)
"""Width and height of a landscape picture, pixels."""
SAMPLES = 10
"""Samples of Cycles for each pixel."""
Random = np.random.Generator
Colour = tuple[float, float, float]
Position = tuple[float, float, float]


def random_colour(random: Random, saturation: float | None = None) -> Colour:
    """Return a colour of full value and random hue, mostly a pale one. saturation: 0..1, or None for a random one."""
    return colorsys.hsv_to_rgb(random.random(), random.random() ** 1.5 if saturation is None else saturation, 1.0)


def load_image(path: Path) -> Any:
    """Load a picture into Blender. Raises FrameError if it cannot be read, which Blender would render as pink."""
    image = bpy.data.images.load(str(path), check_existing=True)
    if not image.size[0]:
        raise FrameError(f"{path} cannot be read; take it out of its folder.")
    return image


class Room:
    """A room, or a yard under a sky, with objects and lamps: floor at z = 0, the camera looks along y.

    photos: textures. maps: environment maps. The constructor builds the scene in Blender, at random.
    """

    def __init__(self, random: Random, photos: Sequence[Path], maps: Sequence[Path]) -> None:
        """Build the room: sky, walls, 2 to 9 objects, up to 7 lamps, and half of the time a light on the ceiling."""
        self.random, self.photos, self.maps = random, photos, maps
        self.scene = stage.empty_scene()
        self.width, self.depth, self.height = random.uniform((4, 6, 2.5), (10, 16, 5))
        self.indoors, self.dark = random.random() < 0.6, random.random() < 0.55
        self._add_sky()
        self._add_floor_and_walls()
        for _ in range(int(random.integers(2, 10))):
            self._add_object()
        for _ in range(int(random.integers(1, 8) if self.dark else random.integers(0, 4))):
            self._add_lamp()
        if random.random() < 0.5:
            self._add_light("AREA", self._random_position(self.height * 0.97), math.exp(random.uniform(2, 6)))

    def _add_sky(self) -> None:
        """Set a random environment map as the world; half of the indoor rooms get one even pale light instead."""
        random = self.random
        if self.indoors and random.random() < 0.5:
            stage.set_uniform_world(random_colour(random, 0.3), 0.01 if self.dark else 0.2)
            return
        stage.set_uniform_world((0, 0, 0), 1)
        nodes, links = self.scene.world.node_tree.nodes, self.scene.world.node_tree.links
        background = nodes["Background"]
        texture = nodes.new("ShaderNodeTexEnvironment")
        texture.image = load_image(random.choice(self.maps))
        coordinates, mapping = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
        mapping.inputs["Rotation"].default_value[2] = random.uniform(0, 2 * math.pi)
        links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
        links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
        links.new(texture.outputs["Color"], background.inputs["Color"])
        background.inputs["Strength"].default_value = random.uniform(0, 0.02) if self.dark else random.uniform(0.3, 1)

    def _add_floor_and_walls(self) -> None:
        """Add a floor; indoors also the side and back walls and the ceiling, each left out now and then."""
        # The room reaches from y = -2, behind the camera, to y = depth.
        random, middle = self.random, self.depth / 2 - 1
        polished = random.random() < 0.65
        floor_size = (self.width, self.depth + 2) if self.indoors else (60, 60)
        roughness = random.uniform(0.03, 0.28) if polished else random.uniform(0.3, 1)
        stage.add_sheet("floor", *floor_size, (0, middle, 0), self._surface_material(roughness))
        if not self.indoors:
            return
        side_length, half_width, half_height = self.depth + 2, self.width / 2, self.height / 2
        for name, length, position, rotation in (("left", side_length, (-half_width, middle, half_height), 90),
                                                 ("right", side_length, (half_width, middle, half_height), -90),
                                                 ("back", self.width, (0, self.depth, half_height), 0)):
            if random.random() < 0.92:
                material = self._surface_material(random.uniform(0.25, 1))
                stage.add_sheet(name, length, self.height, position, material, rotation, (90, 0))
        if random.random() < 0.85:
            stage.add_sheet("ceiling", self.width, side_length, (0, middle, self.height), self._surface_material(0.8),
                            tilt=(180, 0))

    def _add_object(self) -> None:
        """Add a random solid at a random place."""
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
        obj = bpy.context.object
        obj.location = self._random_position(size * random.uniform(0.3, 0.6), min_distance=1.5)
        obj.rotation_euler = (*random.normal(0, 0.2, 2), random.uniform(0, 2 * math.pi))
        obj.scale = random.uniform(0.5, (1.5, 1.5, 2))
        obj.data.materials.append(self._material(
            photo=random.random() < 0.5, colour=random_colour(random), roughness=random.uniform(0.05, 1),
            metallic=float(random.random() < 0.2), glass=random.random() < 0.08))

    def _add_lamp(self) -> None:
        """Add a lamp: a bulb, a screen or a tube that is seen, or a spot, which only lights.

        A visible lamp emits its power divided by roughly its surface; the constant added to the surface bounds the
        radiance of the smallest lamps.
        """
        random = self.random
        position = self._random_position(random.uniform(0.6, self.height * 0.95), min_distance=2)
        size = math.exp(random.uniform(-3.2, -0.9))
        colour = random_colour(random, random.random() ** 2 * 0.9)
        power = math.exp(random.uniform(2, 5)) * (1 if self.dark else 2)
        match random.choice(["bulb", "screen", "tube", "spot"]):
            case "bulb":
                bpy.ops.mesh.primitive_uv_sphere_add(radius=size, location=position)
                material = self._emissive_material(colour, power / (size * size * 12 + 0.02))
                bpy.context.object.data.materials.append(material)
            case "screen":
                rotation = math.degrees(random.uniform(-0.6, 0.6))
                width, height = size * random.uniform(1, (6, 4))
                material = self._emissive_material(colour, power / (size * size * 6 + 0.05),
                                                   photo=random.random() < 0.5)
                stage.add_sheet("screen", width, height, position, material, rotation, (90, 0))
            case "tube":
                bpy.ops.mesh.primitive_cylinder_add(radius=size / 5, depth=size * 8, location=position,
                                                    rotation=(*random.choice([0, math.pi / 2], 2), 0))
                material = self._emissive_material(colour, power / (size * size * 4 + 0.02))
                bpy.context.object.data.materials.append(material)
            case "spot":
                self._add_light("SPOT", position, power * 8, colour)

    def _add_light(self, kind: str, position: Position, power: float, colour: Colour | None = None) -> None:
        """Add one of Blender's lights, SPOT or AREA, without a visible shape.

        power: watts. colour: None for a random one.
        """
        random = self.random
        bpy.ops.object.light_add(type=kind, location=position)
        light = bpy.context.object
        light.data.energy, light.data.color = power, colour or random_colour(random, random.random() ** 2)
        if kind == "SPOT":
            light.rotation_euler = (*random.normal(0, 0.7, 2), 0)
            light.data.spot_size, light.data.shadow_soft_size = random.uniform(0.4, 1.8), 0.05
        else:
            light.data.size = random.uniform(0.3, 3)

    def _random_position(self, height: float, min_distance: float = 0.0) -> Position:
        x = self.random.uniform(-self.width / 2, self.width / 2) * 0.9
        return x, self.random.uniform(min_distance, self.depth * 0.95), height

    def _surface_material(self, roughness: float) -> Any:
        random = self.random
        colour = np.array(random_colour(random)) * random.uniform(0.05, 0.8, 3)
        return self._material(photo=random.random() < 0.6, colour=colour, roughness=roughness,
                              metallic=float(random.random() < 0.08), repeat=float(random.choice([1, 1, 2, 4])))

    def _emissive_material(self, colour: Colour, power: float, photo: bool = False) -> Any:
        """Return a material that emits light; power: approximately per unit of its surface."""
        return self._material(photo=photo, colour=colour, strength=power / 8)

    def _material(self, *, photo: bool, colour: Sequence[float], roughness: float = 0.5, metallic: float = 0.0,
                  strength: float = 0.0, glass: bool = False, repeat: float = 1.0) -> Any:
        """Return a material, half of the time with a bumpy surface.

        photo: show a random photograph in place of `colour`. strength: of the emission, 0 for none; it has
        the surface's colours. repeat: how often the photograph is repeated.
        """
        random = self.random
        material = bpy.data.materials.new("Surface")
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        shader = nodes["Principled BSDF"]
        inputs = shader.inputs
        inputs["Roughness"].default_value, inputs["Metallic"].default_value = roughness, metallic
        inputs["Transmission Weight"].default_value = float(glass)
        inputs["Base Color"].default_value = inputs["Emission Color"].default_value = (*colour, 1)
        inputs["Emission Strength"].default_value = strength
        if photo:
            texture, coordinates, mapping = (nodes.new(f"ShaderNode{name}")
                                             for name in ("TexImage", "TexCoord", "Mapping"))
            texture.image = load_image(random.choice(self.photos))
            texture.extension = "MIRROR"
            mapping.inputs["Scale"].default_value = (repeat,) * 3
            links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
            links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
            for name in ("Base Color", "Emission Color"):
                links.new(texture.outputs["Color"], inputs[name])
        if random.random() < 0.5:
            noise, bump = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeBump")
            noise.inputs["Scale"].default_value = math.exp(random.uniform(1, 5))
            bump.inputs["Strength"].default_value = random.uniform(0.02, 0.3)
            links.new(noise.outputs[0], bump.inputs["Height"])
            links.new(bump.outputs["Normal"], inputs["Normal"])
        return material

    def render(self) -> Pixels:
        """Return scene-linear light (height, width, 3) of a random view.

        Three of ten views have a small depth of field, and one of seven has mist.
        """
        random = self.random
        width, height = SIZE if random.random() < 0.75 else SIZE[::-1]
        focal = max(width, height) * random.uniform(16, 45) / 36  # a lens of 16 to 45 mm on a sensor of 36 mm
        camera = shots.set_up_render(Pinhole(width, height, focal, focal, width / 2, height / 2), SAMPLES)
        eye = np.array([random.uniform(-0.25, 0.25) * self.width, random.uniform(-1, 0.5),
                        random.uniform(0.4, min(2.2, self.height * 0.8))])
        target = np.array([random.uniform(-0.33, 0.33) * self.width, self.depth * random.uniform(0.4, 1),
                           random.uniform(0, self.height * 0.7)])
        shots.set_pose(camera, look_at(eye, target))
        if random.random() < 0.3:
            camera.data.dof.use_dof = True
            camera.data.dof.aperture_fstop = math.exp(random.uniform(-1, 1.2))
            camera.data.dof.focus_distance = random.uniform(1.5, 6)
        self.scene.cycles.denoising_prefilter = "FAST"
        self.scene.view_layers[0].use_pass_z = True
        settings = self.scene.render.image_settings
        settings.media_type, settings.file_format = "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER"
        with silence_blender():
            channels = shots.render_and_read(read_exr)
        light = np.stack([_channel_with_suffix(channels, f"Combined.{name}") for name in "RGB"], -1)
        if random.random() < 0.15:
            light = self._add_mist(light, _channel_with_suffix(channels, ".Z"))
        return np.asarray(light, np.float32)

    def _add_mist(self, light: Pixels, depth: Pixels) -> Pixels:
        """Return light (height, width, 3) through a mist of random density and colour: light * t + airlight * (1 - t).

        The transmission t falls exponentially with `depth` (height, width), the distance of what each pixel shows.
        """
        random, depth = self.random, np.minimum(depth, self.depth * 6)
        transmission = np.exp(depth * (-math.exp(random.uniform(-2.5, 0.5)) / self.depth))[..., None]
        colour = np.array(random_colour(random, random.random() * 0.4), np.float32)
        # The mist has the brightness of a random percentile of the frame.
        airlight = colour * np.percentile(light.mean(-1), random.uniform(50, 97))
        return light * transmission + airlight * (1 - transmission)


def _channel_with_suffix(channels: dict[str, Pixels], suffix: str) -> Pixels:
    """Return the channel whose name ends with `suffix`; its layer and view stand before it."""
    return next(pixels for name, pixels in channels.items() if name.endswith(suffix))
