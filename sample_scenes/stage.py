# SPDX-License-Identifier: GPL-3.0-or-later
"""Building blocks for scenes in Blender: textured boxes, lathed shapes, lamps."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from .description import LightSource
from .patterns import Palette, Texture, framed, poster

Vec = Sequence[float] | NDArray[np.float64]


def empty_scene() -> Any:
    """Remove everything from Blender's startup scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def picture_material(name: str, texture: Texture, roughness: float = 0.7) -> Any:
    """Return a matt material that shows `texture` (h, w, 3), sRGB 0..1, by the UV map."""
    height, width = texture.shape[:2]
    image = bpy.data.images.new(name, width, height)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = texture[::-1]  # Blender's rows begin at the bottom
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Specular IOR Level"].default_value = 0.25
    texture_node = nodes.new("ShaderNodeTexImage")
    texture_node.image = image
    links.new(texture_node.outputs["Color"], shader.inputs["Base Color"])
    return material


def plain_material(name: str, colour: Vec, roughness: float = 0.5, metallic: float = 0.0) -> Any:
    """Return a material of one linear colour."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Metallic"].default_value = metallic
    return material


def _add_mesh(name: str, mesh: bmesh.types.BMesh, materials: Sequence[Any], smooth: bool = False) -> Any:
    """Add a mesh with these materials to the scene; return its object. smooth: shade its faces as one surface."""
    data = bpy.data.meshes.new(name)
    for face in mesh.faces:
        face.smooth = smooth
    mesh.to_mesh(data)
    mesh.free()
    for material in materials:
        data.materials.append(material)
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def place(obj: Any, location: Vec, turn: float = 0.0, tilt: Vec = (0.0, 0.0)) -> Any:
    """Put an object at `location`, turned by `turn` degrees about z after `tilt` degrees about x and y."""
    obj.rotation_euler = tuple(np.radians((*tilt, turn)))
    obj.location = location
    return obj


def add_box(name: str, size: Vec, location: Vec, materials: Sequence[Any], turn: float = 0.0,
            tilt: Vec = (0.0, 0.0), bevel: float = 0.0) -> Any:
    """Add a box of `size`, its base centre at `location`.

    materials: one for all faces, or one each for the sides (-y, +x, +y, -x) and top; the bottom has the last one. Each
    face shows its whole texture. turn: degrees about z, after `tilt`: degrees about x and y. bevel: width of the
    rounded edges, 0 for none.
    """
    half_x, half_y, height = size[0] / 2, size[1] / 2, size[2]
    mesh = bmesh.new()
    uv = mesh.loops.layers.uv.new("UVMap")
    corners = [(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)]
    faces = [[(*corners[i], 0.0), (*corners[(i + 1) % 4], 0.0), (*corners[(i + 1) % 4], height), (*corners[i], height)]
             for i in range(4)]
    faces.append([(*corner, height) for corner in corners])
    faces.append([(*corner, 0.0) for corner in corners[::-1]])
    for index, face in enumerate(faces):
        mesh_face = mesh.faces.new([mesh.verts.new(corner) for corner in face])
        mesh_face.material_index = min(index, len(materials) - 1)
        for loop, corner in zip(mesh_face.loops, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
            loop[uv].uv = corner
    bmesh.ops.remove_doubles(mesh, verts=mesh.verts, dist=1e-6)
    obj = place(_add_mesh(name, mesh, materials), location, turn, tilt)
    if bevel > 0:
        modifier = obj.modifiers.new("Bevel", "BEVEL")
        modifier.width, modifier.segments = bevel, 2
    return obj


def add_sheet(name: str, width: float, height: float, location: Vec, material: Any, turn: float = 0.0,
              tilt: Vec = (0.0, 0.0), repeat: Vec = (1.0, 1.0)) -> Any:
    """Add a rectangle in x and y about its centre; tilt (90, 0) stands it up.

    repeat: how often the texture is repeated across and up. turn: degrees about z, after `tilt`: degrees about x and y.
    """
    mesh = bmesh.new()
    uv = mesh.loops.layers.uv.new("UVMap")
    face = mesh.faces.new([mesh.verts.new((sign_x * width / 2, sign_y * height / 2, 0.0))
                           for sign_x, sign_y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    for loop, corner in zip(face.loops, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
        loop[uv].uv = (corner[0] * repeat[0], corner[1] * repeat[1])
    return place(_add_mesh(name, mesh, [material]), location, turn, tilt)


def add_lathe(name: str, profile: Sequence[tuple[float, float]], location: Vec, material: Any,
              segments: int = 48, turn: float = 0.0, tilt: Vec = (0.0, 0.0), repeat: Vec = (1.0, 1.0)) -> Any:
    """Add a surface of revolution about z: `profile` is (radius, height) from below to the top.

    segments: quads around. repeat: how often the texture is repeated around the axis and along the profile. turn:
    degrees about z, after `tilt`: degrees about x and y.
    """
    mesh = bmesh.new()
    uv = mesh.loops.layers.uv.new("UVMap")
    angles = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    rings = [[mesh.verts.new((radius * np.cos(angle), radius * np.sin(angle), height)) for angle in angles]
             for radius, height in profile]
    lengths = np.hypot(*np.diff(np.array(profile), axis=0).T)
    profile_v = np.concatenate([[0.0], np.cumsum(lengths)]) / max(lengths.sum(), 1e-9)
    for low in range(len(profile) - 1):  # quads from the ring `low` to the next above
        for side in range(segments):
            next_side = (side + 1) % segments
            corners = [rings[low][side], rings[low][next_side], rings[low + 1][next_side], rings[low + 1][side]]
            face = mesh.faces.new(corners)
            uv_indices = ((side, low), (side + 1, low), (side + 1, low + 1), (side, low + 1))
            for loop, (u, v) in zip(face.loops, uv_indices, strict=True):
                loop[uv].uv = (u / segments * repeat[0], profile_v[v] * repeat[1])
    return place(_add_mesh(name, mesh, [material], smooth=True), location, turn, tilt)


def add_ball(name: str, radius: float, location: Vec, material: Any, turn: float = 0.0,
             tilt: Vec = (0.0, 0.0)) -> Any:
    """Add a sphere about `location`."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 33)
    # At the poles a tiny radius keeps the vertices of a ring apart.
    profile = [(max(radius * float(np.cos(angle)), 1e-4), radius * float(np.sin(angle))) for angle in angles]
    return add_lathe(name, profile, location, material, 64, turn, tilt)


def add_rod(name: str, start: Vec, end: Vec, radius: float, material: Any) -> Any:
    """Add a cylinder from `start` to `end`."""
    direction = Vector(end) - Vector(start)
    obj = add_lathe(name, [(1e-4, 0.0), (radius, 0.0), (radius, direction.length), (1e-4, direction.length)],
                    (0, 0, 0), material, 24)
    obj.matrix_world = Matrix.Translation(Vector(start)) @ direction.to_track_quat("Z", "Y").to_matrix().to_4x4()
    return obj


def add_monkey(name: str, size: float, location: Vec, material: Any, turn: float = 0.0) -> Any:
    """Add Blender's monkey head, subdivided once. turn: degrees about z."""
    bpy.ops.mesh.primitive_monkey_add(size=size, location=location, rotation=(0, 0, np.radians(turn)))
    obj = bpy.context.object
    obj.name = name
    modifier = obj.modifiers.new("Smooth", "SUBSURF")
    modifier.levels = modifier.render_levels = 1
    for face in obj.data.polygons:
        face.use_smooth = True
    obj.data.materials.append(material)
    return obj


def add_lamp(light: LightSource) -> Any:
    """Add a light: a sphere that only the camera sees, and, if it has power, a lamp at its place (a sun, if distant).

    The sphere has the property `light_source`, so that the ray casts of the visible share can skip it.
    """
    material = bpy.data.materials.new(light.name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    emission = nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (*light.colour, 1.0)
    emission.inputs["Strength"].default_value = light.emission
    links.new(emission.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    bulb = add_ball(light.name, light.radius, light.xyz, material)
    bulb["light_source"] = True
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(bulb, f"visible_{ray}", False)
    if light.power > 0:
        data = bpy.data.lights.new(light.name, "SUN" if light.distant else "POINT")
        data.energy, data.color = light.power, light.colour
        lamp_object = bpy.data.objects.new(f"{light.name} lamp", data)
        lamp_object.location = light.xyz
        if light.distant:
            data.angle = 2 * np.arctan(light.radius / np.linalg.norm(light.xyz))  # the apparent diameter
            lamp_object.rotation_euler = (-Vector(light.xyz)).to_track_quat("-Z", "Y").to_euler()
        else:
            data.shadow_soft_size = light.radius
        lamp_object.visible_camera = False
        bpy.context.scene.collection.objects.link(lamp_object)
    return bulb


def add_softbox(name: str, location: Vec, target: Vec, size: Vec, power: float, colour: Vec) -> Any:
    """Add an area light that faces `target` and is invisible to cameras. size: width and height. power: watts."""
    data = bpy.data.lights.new(name, "AREA")
    data.shape, data.size, data.size_y = "RECTANGLE", size[0], size[1]
    data.energy, data.color = power, colour
    obj = bpy.data.objects.new(name, data)
    obj.location = location
    obj.rotation_euler = (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()
    obj.visible_camera = False
    bpy.context.scene.collection.objects.link(obj)
    return obj


def set_uniform_world(colour: Vec, strength: float) -> None:
    """Set a world of one linear colour, times `strength`, in all directions."""
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (*colour, 1.0)
    background.inputs["Strength"].default_value = strength


def set_environment_map(texture: Texture) -> None:
    """Set a world that shows a panorama (h, 2 h, 3) in linear light and lights the scene by it.

    It is infinitely far, so it has no parallax.
    """
    height, width = texture.shape[:2]
    image = bpy.data.images.new("surrounding", width, height, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = texture[::-1]
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    map_node = nodes.new("ShaderNodeTexEnvironment")
    map_node.image = image
    background = next(node for node in nodes if node.type == "BACKGROUND")
    links.new(map_node.outputs["Color"], background.inputs["Color"])


def add_dome(radius: float, texture: Texture, strength: float) -> Any:
    """Add a sky: a sphere about the origin that emits `texture` times `strength`."""
    material = picture_material("sky", texture)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    emission = nodes.new("ShaderNodeEmission")
    emission.inputs["Strength"].default_value = strength
    texture_node = next(node for node in nodes if node.type == "TEX_IMAGE")
    links.new(texture_node.outputs["Color"], emission.inputs["Color"])
    output = next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
    links.new(emission.outputs[0], output.inputs["Surface"])
    shell = add_ball("sky", radius, (0, 0, 0), material)
    shell.visible_shadow = False  # the light of a sun, which stands outside, passes
    return shell


def add_poster_box(name: str, rng: np.random.Generator, size: Vec, location: Vec, palette: Palette,
                   turn: float = 0.0) -> Any:
    """Add a box with a different drawing on each side, as crates, cubes and plinths have."""
    x, y, z = size
    sides = [(x, z), (y, z), (x, z), (y, z), (x, y)]
    pixels_per_unit = 420 / max(size)  # the longest edge has a texture of 420 pixels
    textures = []
    for width, height in sides:
        rows, columns = (max(int(pixels_per_unit * length), 60) for length in (height, width))
        textures.append(framed(poster(rng, rows, columns, palette, 12), 0.08))
    materials = [picture_material(f"{name} {i}", texture, 0.75) for i, texture in enumerate(textures)]
    return add_box(name, size, location, materials, turn)
