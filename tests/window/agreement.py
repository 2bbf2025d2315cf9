# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare in the camera view against the one in a render, in Blender's real window: display codes of both, under view
transforms and render engines, over a scene, over footage, and in a shot with movement.

Started by tests/window/run.py --engine "" --script tests/window/agreement.py. Writes agreement.json, and the table
agreement.md: for each case the largest and the mean difference in codes, where neither clips. Fails where the largest
is above MAX_DIFFERENCE. FIT_FLARE_VIEWS: view transforms to compare, separated by commas, such as those of the
configuration that OCIO names.
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
FRAMES = {"moving": (1, 3, 5)}
"""Frames that are compared, by scene; else the first."""
MAX_DIFFERENCE = 2  # codes
UNCHANGED = 10  # screenshots alike, after which a view that differs from the render counts as finished
MARGIN = 2  # pixels at the edge of the frame, where the camera's border is drawn

DARK = 0.05  # light of the planks
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
    for over in ("present", "fence", "plate", "moving"):
        scene = yield from prepare(over)
        for engine in ("CYCLES", "BLENDER_WORKBENCH"):
            yield from compare(scene, engine, over, results)
            (flow.out / "agreement.json").write_text(json.dumps(results, indent=1))
    (flow.out / "agreement.md").write_text(table(results))
    ui.screenshot(str(flow.out / "last.png"))
    done("agreement", **{key: value["largest"] for key, value in results.items()})
    assert not (differing := [key for key, value in results.items() if largest(value) > MAX_DIFFERENCE]), differing
    assert all(value["compared"] > 0.5 for value in results.values()), "most pixels were left out"
    shares = [value["share"] for key, value in results.items() if key.startswith("moving")]
    assert max(shares) > 0.99 and min(shares) < 0.9, "the lamp was not both free and behind the fence"


def largest(result) -> float:
    """The largest difference of a case, also of its viewport render."""
    return max(result["largest"], result.get("viewport_render", result)["largest"])


def table(results) -> str:
    """The results as a table of Markdown."""
    lines = ["| case | engine | view transform | largest | mean | largest of the viewport render |",
             "| --- | --- | --- | --- | --- | --- |"]
    for name, result in results.items():
        over, engine, transform, *frame = name.split()
        drawn = f"{result['viewport_render']['largest']:.0f}" if "viewport_render" in result else ""
        lines.append(f"| {' '.join([over, *frame])} | {engine} | {transform} | {result['largest']:.0f} "
                     f"| {result['mean']} | {drawn} |")
    return "\n".join(lines) + "\n"


def prepare(over: str):
    """Make a scene with a flare, bake it, and let its layers into the compositor. Steps; their value is the scene.

    over: what the flare lies over. "present": flat greys. "fence": greys, and an area light behind a fence. "plate": a
    photograph. "moving": greys, and a lamp of keyed power that a moving empty carries behind a fence, for a moving
    camera.
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
    scene.frame_end = FRAMES.get(over, (1,))[-1]
    library = {item[1]: item[0] for item in module("library").menu_items()}
    if over in ("fence", "moving"):
        (add_fenced_lamp if over == "fence" else add_carried_lamp)(scene)
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
    mesh.materials.append(emission(value))


def add_fenced_lamp(scene) -> None:
    """Add an area light of two by one units before the camera, and planks that hide half of it; select the light."""
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "AREA"))
    lamp.data.shape, lamp.data.size, lamp.data.size_y = "RECTANGLE", 2.0, 1.0
    scene.collection.objects.link(lamp)
    lamp.parent, lamp.location = scene.camera, (-1.0, 0.8, -11)
    lamp.rotation_euler = (math.pi, 0, 0)  # its -Z looks at the camera
    add_fence(scene, scene.camera)
    lamp.select_set(True)
    bpy.context.view_layer.update()


def add_carried_lamp(scene) -> None:
    """Add a lamp whose power is keyed, on an empty that moves behind standing planks; key the camera; select the
    lamp."""
    camera = scene.camera
    stand, carrier = bpy.data.objects.new("Stand", None), bpy.data.objects.new("Carrier", None)
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    lamp.data.shadow_soft_size = 0.3
    lamp.visible_camera = False
    for item in (stand, carrier, lamp):
        scene.collection.objects.link(item)
    stand.matrix_world = camera.matrix_world
    carrier.parent, lamp.parent = stand, carrier
    lamp.location = (0, 0.4, 0)
    last = FRAMES["moving"][-1]
    for frame, x, power, turn in ((1, -2.0, 1000.0, -0.02), (last, 1.5, 400.0, 0.03)):
        carrier.location = (x, 0.4, -11)
        carrier.keyframe_insert("location", frame=frame)
        lamp.data.energy = power
        lamp.data.keyframe_insert("energy", frame=frame)
        camera.rotation_euler.z += turn
        camera.location.x += 5 * turn
        camera.keyframe_insert("rotation_euler", frame=frame)
        camera.keyframe_insert("location", frame=frame)
    add_fence(scene, stand, 2.0)  # in the first frame the lamp is beside it
    scene.frame_set(1)
    lamp.select_set(True)
    bpy.context.view_layer.update()


def add_fence(scene, parent, right: float = 0.07) -> None:
    """Add dark planks, half as wide as their distance, eight units before `parent`; right: of the middle, units."""
    mesh = bpy.data.meshes.new("Fence")
    mesh.from_pydata([(0.3 * plank + x, y, 0) for plank in range(-8, 9) for x, y in (
        (0, -2), (0.15, -2), (0.15, 2), (0, 2))], [], [tuple(range(4 * plank, 4 * plank + 4)) for plank in range(17)])
    mesh.materials.append(emission(DARK))
    fence = bpy.data.objects.new("Fence", mesh)
    scene.collection.objects.link(fence)
    fence.parent, fence.location = parent, (right, 0, -8)
    fence.color = (DARK, DARK, DARK, 1)


def emission(value: float):
    """Material of constant light `value` in all channels."""
    material = bpy.data.materials.new("Grey")
    if not material.node_tree:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    light, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    light.inputs["Color"].default_value = (value, value, value, 1)
    tree.links.new(light.outputs[0], out.inputs[0])
    return material


def compare(scene, engine: str, over: str, results) -> None:
    """Compare the rendered view with the render of one engine, under each view transform. Steps.

    Differences go into `results` by scene, engine and transform. Left out are edges, clipped values and the margin.
    """
    scene.render.engine = engine
    if engine == "CYCLES":
        scene.cycles.samples = scene.cycles.preview_samples = 8
        scene.cycles.use_denoising = scene.cycles.use_preview_denoising = False
        scene.cycles.pixel_filter_type = "BOX"  # an edge blurs its own pixels alone
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
        for frame in FRAMES.get(over, (1,)):
            scene.frame_set(frame)
            name = f"{over} {engine} {transform}" + (f" {frame}" if over in FRAMES else "")
            path = str(flow.out / name.replace(" ", "_"))
            bpy.ops.render.render(scene=scene.name)
            rendered = saved(scene, Path(f"{path}_render.png"))
            view = yield from view_at_rest(scene, Path(f"{path}_view.png"), rendered)
            results[name] = differences(rendered, view)
            placed = module("looks").place_lights(scene, bpy.context.evaluated_depsgraph_get(), scene.camera)[1]
            results[name]["share"] = round(float(placed[0].visibility), 3)
            if engine == "BLENDER_WORKBENCH":
                results[name]["viewport_render"] = viewport_render(scene, rendered)
            print(name, results[name], flush=True)


def view_at_rest(scene, path: Path, rendered):
    """Take screenshots into `path` until the view no longer changes; return the camera's frame in it, a generator of
    steps.

    A view that differs from the render may be one of coarse pixels, whose next pass is late on a busy machine: it has
    to be unchanged for longer.
    """
    before, unchanged = None, 0
    for _ in range(30):
        yield 1.5
        ui.screenshot(str(path))
        yield 0.5
        window = pixels(path)
        unchanged = unchanged + 1 if before is not None and np.array_equal(before, window) else 0
        before = window
        view = camera_part(scene, window)
        if unchanged >= UNCHANGED or (unchanged and differences(rendered, view)["largest"] <= MAX_DIFFERENCE):
            break
    return view


def camera_part(scene, window):
    """The camera's frame in a screenshot of the window."""
    with ui.override():
        frame = module("overlay").camera_frame(bpy.context, module("stereo").eye_camera(scene.camera, scene.render))
    region = ui.region("WINDOW")
    left, bottom = round(region.x + frame.left), round(region.y + frame.bottom)
    assert (round(frame.width), round(frame.height)) == (WIDTH, HEIGHT), frame
    return window[bottom:bottom + HEIGHT, left:left + WIDTH]


def differences(rendered, view) -> dict[str, float]:
    """Differences in codes between render and view, without edges, clipped values and the margin; "compared" is the
    share of values that is left."""
    inner = slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN)
    best = None
    for y in (-1, 0, 1):  # the frame's corner is rounded
        for x in (-1, 0, 1):
            moved = np.roll(rendered, (y, x), (0, 1))[inner]
            away = np.abs(moved - view[inner])[comparable(moved, view[inner])]
            if best is None or away.mean() < best.mean():
                best = away
    return {"largest": float(best.max()), "mean": round(float(best.mean()), 3),
            "within_2": round(float((best <= 2).mean()), 5), "compared": round(best.size / view[inner].size, 2),
            "brightest": float(rendered.max())}


def comparable(rendered, other):
    """Mask (height, width, 3) of the values that neither clip nor lie at an edge of either picture."""
    steep = np.maximum.reduce([np.abs(picture - np.roll(picture, 1, axis)).max(-1)
                               for picture in (rendered, other) for axis in (0, 1)]) > EDGE
    edge = np.logical_or.reduce([np.roll(steep, shift, (0, 1)) for shift in NEIGHBOURS])
    return (rendered < 254) & (other < 254) & ~edge[..., None]


def viewport_render(scene, rendered) -> dict[str, float]:
    """Make a viewport render with the flare; return its differences from the render, without edges and clipped
    values."""
    scene.render.filepath = str(flow.out / "viewport_####")
    bpy.ops.fit_flare.viewport_render("EXEC_DEFAULT")
    drawn = pixels(module("viewport_render").output_path(scene, scene.frame_current))
    away = np.abs(rendered - drawn)[comparable(rendered, drawn)]
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
