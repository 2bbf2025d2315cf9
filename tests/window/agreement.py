# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare in the camera view against the one in a render, in Blender's real window: display codes of both, under view
transforms and render engines, over a scene and over footage.

Started by tests/window/run.py --engine "" --script tests/window/agreement.py. Writes agreement.json: for each case the
largest and the mean difference in codes, where neither clips, and the share of pixels within two codes.
FIT_FLARE_VIEWS: view transforms to compare, separated by commas, such as those of the configuration that OCIO names.
"""
from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from flow import done, wait
from measure import module

WIDTH, HEIGHT = 480, 270
VIEWS = os.environ.get("FIT_FLARE_VIEWS", "Standard,AgX,Filmic").split(",")
MARGIN = 2  # pixels at the edge of the frame, where the camera's border is drawn

EDGE = 12  # codes between neighbours, above which a pixel counts as the edge of an object, whose place is rounded
NEIGHBOURS = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]


def steps():
    """Compare view and render over each scene, with each engine, and write agreement.json."""
    settings = bpy.context.preferences
    settings.view.show_splash = False
    yield 1
    bpy.ops.extensions.package_install_files(filepath=flow.ZIP, repo="user_default", enable_on_install=True,
                                             overwrite=True)
    yield 1
    results = {}
    for over in ("present", "fence", "plate"):
        scene = yield from prepare(over)
        for engine in ("CYCLES", "BLENDER_WORKBENCH"):
            if (over, engine) in (("plate", "BLENDER_WORKBENCH"), ("fence", "CYCLES")):
                continue
            yield from compare(scene, engine, over, results)
    (flow.out / "agreement.json").write_text(json.dumps(results, indent=1))
    ui.screenshot(str(flow.out / "last.png"))
    done("agreement", **{key: value["within_2"] for key, value in results.items()})


def prepare(over: str):
    """Make a scene with a flare, bake it, and let its layers into the compositor. Steps; their value is the scene.

    over: what the flare lies over. "present": flat greys. "fence": greys, and an area light behind a fence. "plate": a
    photograph.
    """
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    yield 1
    scene = bpy.context.scene
    for item in [item for item in scene.objects if item.type != "CAMERA"]:
        bpy.data.objects.remove(item)
    if over == "plate":
        photo = bpy.data.images.new("photo", WIDTH, HEIGHT)
        ramp = np.ones((HEIGHT, WIDTH, 4), np.float32)
        ramp[..., :3] = np.linspace(0.05, 0.7, WIDTH, dtype=np.float32)[None, :, None]
        photo.pixels.foreach_set(ramp.ravel())
        photo.filepath_raw, photo.file_format = str(flow.out / "photo.png"), "PNG"
        photo.save()
        bpy.ops.fit_flare.shot_from_picture(filepath=photo.filepath_raw)
    else:
        for place, value in ((-1.5, 0.05), (0.5, 0.3), (2.5, 0.9)):
            add_grey(scene, place, value)
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.render.dither_intensity = 0
    scene.frame_end = 1
    library = {item[1]: item[0] for item in module("library").menu_items()}
    if over == "fence":
        add_fenced_lamp(scene)
        bpy.ops.fit_flare.add_library_flare(look=library["Vintage Ring"])
        assert scene.fit_flare.lights[0].target.type == "LIGHT"
    else:
        bpy.ops.fit_flare.add_library_flare(look=library["Vintage Ring"], light="new")
    with ui.override():
        bpy.ops.fit_flare.bake("EXEC_DEFAULT")
    jobs, shots, flare_node = module("jobs"), module("shots"), module("compositor.flare_node")
    yield from wait(lambda: flare_node.find_node(scene) is not None, 120)
    assert jobs.find_job(shots.layers_folder(scene)).state == "done"
    return scene


def add_grey(scene, x: float, value: float) -> None:
    """Add a rectangle of constant light `value` before the camera; x: of its middle, in the camera's axes."""
    mesh = bpy.data.meshes.new("Grey")
    mesh.from_pydata([(-1, -9, -12), (1, -9, -12), (1, 9, -12), (-1, 9, -12)], [], [(0, 1, 2, 3)])
    item = bpy.data.objects.new("Grey", mesh)
    scene.collection.objects.link(item)
    item.parent, item.location = scene.camera, (x, 0, 0)
    item.color = (value, value, value, 1)
    material = bpy.data.materials.new("Grey")
    if not material.node_tree:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    emission, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = (value, value, value, 1)
    tree.links.new(emission.outputs[0], out.inputs[0])
    mesh.materials.append(material)


def add_fenced_lamp(scene) -> None:
    """Add an area light of two by one units before the camera, and planks that hide half of it; select the light."""
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "AREA"))
    lamp.data.shape, lamp.data.size, lamp.data.size_y = "RECTANGLE", 2.0, 1.0
    mesh = bpy.data.meshes.new("Fence")
    mesh.from_pydata([(0.3 * plank + x, y, 0) for plank in range(-8, 9) for x, y in (
        (0, -2), (0.15, -2), (0.15, 2), (0, 2))], [], [tuple(range(4 * plank, 4 * plank + 4)) for plank in range(17)])
    fence = bpy.data.objects.new("Fence", mesh)
    for item, place in ((lamp, (-1.0, 0.8, -11)), (fence, (0.07, 0, -8))):
        scene.collection.objects.link(item)
        item.parent, item.location = scene.camera, place
    lamp.rotation_euler = (math.pi, 0, 0)  # its -Z looks at the camera
    fence.color = (0.05, 0.05, 0.05, 1)
    lamp.select_set(True)
    bpy.context.view_layer.update()


def compare(scene, engine: str, over: str, results) -> None:
    """Compare the rendered view with the render of one engine, under each view transform. Steps.

    Differences go into `results` by scene, engine and transform. Left out are edges, clipped values and the margin.
    """
    scene.render.engine = engine
    if engine == "CYCLES":
        scene.cycles.samples = scene.cycles.preview_samples = 8
        scene.cycles.use_denoising = scene.cycles.use_preview_denoising = False
    else:
        scene.display.shading.light, scene.display.shading.color_type = "FLAT", "OBJECT"
        scene.display.render_aa = scene.display.viewport_aa = "OFF"
    space = ui.area().spaces.active
    space.shading.type = "RENDERED"
    space.show_region_ui = space.show_region_toolbar = False
    space.show_gizmo = False
    for name in ("show_floor", "show_axis_x", "show_axis_y", "show_text", "show_cursor", "show_extras",
                 "show_object_origins", "show_outline_selected", "show_relationship_lines"):
        setattr(space.overlay, name, False)
    scene.camera.data.passepartout_alpha = 0
    if engine == "BLENDER_WORKBENCH":
        space.shading.light, space.shading.color_type = "FLAT", "OBJECT"
    space.region_3d.view_perspective = "CAMERA"
    with ui.override():
        bpy.ops.view3d.zoom_camera_1_to_1()
    align(scene)
    for item in scene.objects:
        item.select_set(False)
    yield 1
    for transform in VIEWS:
        scene.view_settings.view_transform = transform
        bpy.ops.render.render(scene=scene.name)
        rendered = saved(scene, flow.out / f"{over}_{engine}_{transform}_render.png")
        path, before = flow.out / f"{over}_{engine}_{transform}_view.png", None
        for _ in range(12):  # until the viewport's render is finished
            yield 3
            ui.screenshot(str(path))
            yield 0.5
            if before is not None and np.array_equal(before, pixels(path)):
                break
            before = pixels(path)
        with ui.override():
            frame = module("overlay").camera_frame(bpy.context, module("stereo").eye_camera(
                scene.camera, scene.render))
        region = ui.region("WINDOW")
        left, bottom = round(region.x + frame.left), round(region.y + frame.bottom)
        assert (round(frame.width), round(frame.height)) == (WIDTH, HEIGHT), frame
        window = pixels(path)
        view = window[bottom:bottom + HEIGHT, left:left + WIDTH]
        inner = slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN)
        best = None
        for y in (-1, 0, 1):  # the frame's corner is rounded
            for x in (-1, 0, 1):
                moved = np.roll(rendered, (y, x), (0, 1))[inner]
                steep = np.maximum(*(np.abs(moved - np.roll(moved, 1, axis)).max(-1) for axis in (0, 1))) > EDGE
                edge = np.logical_or.reduce([np.roll(steep, shift, (0, 1)) for shift in NEIGHBOURS])
                away = np.abs(moved - view[inner])[(moved < 254) & (view[inner] < 254) & ~edge[..., None]]
                if best is None or away.mean() < best.mean():
                    best = away
        results[f"{over} {engine} {transform}"] = {
            "largest": float(best.max()), "mean": round(float(best.mean()), 3),
            "within_2": round(float((best <= 2).mean()), 5), "brightest": float(rendered.max())}
        if engine == "BLENDER_WORKBENCH":
            results[f"{over} {engine} {transform}"]["viewport_render"] = viewport_render(scene, rendered)
        print(over, engine, transform, results[f"{over} {engine} {transform}"], flush=True)


def viewport_render(scene, rendered) -> dict[str, float]:
    """Make a viewport render with the flare; return its differences from the render, without edges and clipped
    values."""
    scene.render.filepath = str(flow.out / "viewport_####")
    bpy.ops.fit_flare.viewport_render("EXEC_DEFAULT")
    drawn = pixels(module("viewport_render").output_path(scene, scene.frame_current))
    steep = np.maximum(*(np.abs(rendered - np.roll(rendered, 1, axis)).max(-1) for axis in (0, 1))) > EDGE
    edge = np.logical_or.reduce([np.roll(steep, shift, (0, 1)) for shift in NEIGHBOURS])
    away = np.abs(rendered - drawn)[(rendered < 254) & (drawn < 254) & ~edge[..., None]]
    return {"largest": float(away.max()), "mean": round(float(away.mean()), 3),
            "within_2": round(float((away <= 2).mean()), 5)}


def align(scene) -> None:
    """Move the camera's frame to whole pixels of the region, by Newton's method with measured slopes."""
    view = ui.area().spaces.active.region_3d

    def corner():
        with ui.override():
            frame = module("overlay").camera_frame(bpy.context, module("stereo").eye_camera(
                scene.camera, scene.render))
        return np.array([frame.left, frame.bottom])

    for _ in range(3):
        start, offset = corner(), np.array(view.view_camera_offset)
        for axis in (0, 1):
            moved = offset.copy()
            moved[axis] += 0.01
            view.view_camera_offset = moved
            ui.redraw()
            slope = (corner()[axis] - start[axis]) / 0.01
            moved[axis] = offset[axis] + (round(start[axis]) - start[axis]) / slope
            view.view_camera_offset = offset = moved
            ui.redraw()


def saved(scene, path: Path):
    """Codes of the last render as its view transform shows it, row 0 at the bottom."""
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGB", "8"
    bpy.data.images["Render Result"].save_render(str(path), scene=scene)
    return pixels(path)


def pixels(path: Path):
    """Codes (height, width, 3) of a PNG, row 0 at the bottom."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return np.round(values.reshape(height, width, 4)[..., :3] * 255)


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
