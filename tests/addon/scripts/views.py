# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: what a camera view shows and what a render shows. Arguments: the zip, a capture, a .flare, a
folder to write."""
from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from start import artists_tree, empty, install, leave, object_in, part, scene_with

package, capture, flare, out = sys.argv[1:5]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
overlay, panels, trees, views, setup, footage, render_settings = (
    part(f"flare_addon.{name}") for name in ("overlay", "panels", "compositor.trees", "views", "compositor.setup",
                                             "compositor.footage", "render_settings"))
facts: dict[str, object] = {}

# ---- views that show the compositor's result ------------------------------------------------------------
scene, _ = scene_with()


def composited(scene, kind="RENDERED", use="CAMERA"):
    return overlay.is_composited(SimpleNamespace(shading=SimpleNamespace(type=kind, use_compositor=use)), scene)


facts["without a node"] = [composited(scene), trees.is_off_in_preview(scene)]
node = trees.new_tree(scene).nodes.new("CompositorNodeGroup")
node.name = trees.NODE
facts["composited"] = {f"{kind} {use}": composited(scene, kind, use)
                       for kind in ("WIREFRAME", "SOLID", "MATERIAL", "RENDERED")
                       for use in ("DISABLED", "CAMERA", "ALWAYS")}
node.mute = True
facts["composited, muted"] = composited(scene)
node.mute = False
facts["has effects"] = trees.HAS_EFFECTS
if trees.HAS_EFFECTS:
    effect = trees.effect_of(scene)
    effect.enable_for_preview = False
    facts["composited, off in preview"] = [composited(scene), trees.is_off_in_preview(scene),
                                           trees.is_off_in_renders(scene)]
    effect.enable_for_preview, effect.enable_for_render = True, False
    facts["composited, off in renders"] = [composited(scene), trees.is_off_in_preview(scene)]
    effect.enable_for_render = True
    other = scene.compositor_effects.new(name="Other")
    other.node_group, other.enable_for_preview = bpy.data.node_groups.new("Other", "CompositorNodeTree"), False
    facts["composited, another off"] = composited(scene)
else:
    scene.render.use_compositing = False
    facts["composited, no compositing of renders"] = composited(scene)

# ---- footage that bypasses the view transform -----------------------------------------------------------
scene, _ = scene_with()
camera, image = scene.camera, bpy.data.images.new("photo", 8, 4)
data = camera.data
data.show_background_images = True
background = data.background_images.new()
facts["bypassing"] = {"nothing": views.has_display_footage(camera)}
background.image = image
image.use_view_as_render = False
facts["bypassing"]["an image"] = views.has_display_footage(camera)
image.use_view_as_render = True
facts["bypassing"]["viewed as a render"] = views.has_display_footage(camera)
image.use_view_as_render, background.alpha = False, 0.0
facts["bypassing"]["transparent"] = views.has_display_footage(camera)
background.alpha, data.show_background_images = 1.0, False
facts["bypassing"]["hidden"] = views.has_display_footage(camera)
data.show_background_images = True
second = data.background_images.new()
second.source = "MOVIE_CLIP"
facts["bypassing"]["no clip"] = len(views.display_footage(camera))
facts["bypassing"]["an empty"] = views.has_display_footage(object_in(scene, "Empty", None, (0, 0, 0)))
clip = SimpleNamespace(source="MOVIE_CLIP", clip=object(), alpha=1.0)
filming = SimpleNamespace(type="CAMERA", data=SimpleNamespace(show_background_images=True, background_images=[clip]))
facts["bypassing"]["a clip"] = views.has_display_footage(filming)


def hints(scene, camera):
    """The labels and switches of the hint about a camera view."""
    layout = MagicMock()
    view = SimpleNamespace(type="VIEW_3D", region_3d=SimpleNamespace(view_perspective="CAMERA"), camera=camera,
                           overlay=SimpleNamespace(show_overlays=True), use_local_camera=True,
                           shading=SimpleNamespace(type="SOLID", use_compositor="DISABLED"))
    panels._draw_view_hint(layout, SimpleNamespace(scene=scene, space_data=view))
    text = " ".join(str(call.kwargs.get("text", "")) for call in layout.mock_calls
                    if call[0].rpartition(".")[2] == "label")
    return [text, [[call.args[0].name, call.args[1]] for call in layout.mock_calls if call[0] == "prop"]]


scene.view_settings.view_transform = "AgX"
facts["hint"] = hints(scene, camera)
facts["hint of a clip"] = hints(scene, filming)
image.use_view_as_render = True
facts["hint after the switch"] = hints(scene, camera)
image.use_view_as_render = False
render_settings.set_plain_view(scene)
facts["hint, plain view transform"] = hints(scene, camera)
scene.view_settings.exposure = 1.0
facts["hint, exposed"] = len(hints(scene, camera)[1])

# ---- the first render after an import -------------------------------------------------------------------
importer, looks, core_look, flare_node, warnings = (
    part(name) for name in ("flare_addon.capture.importer", "flare_addon.looks", "core.look",
                            "flare_addon.compositor.flare_node", "flare_addon.compositor.warnings"))
WIDTH, HEIGHT = 64, 40


def read(path):
    """Values (h, w, 3) of a picture as they are stored, row 0 on top."""
    picture = bpy.data.images.load(str(path))
    picture.colorspace_settings.is_data = True
    values = np.empty(4 * WIDTH * HEIGHT, np.float32)
    picture.pixels.foreach_get(values)
    bpy.data.images.remove(picture)
    return values.reshape(HEIGHT, WIDTH, 4)[::-1, :, :3]


def rendered(scene, suffix=".png"):
    """The render of the current frame: codes of the view transform, or linear light for ".exr"."""
    files = {}
    render_settings.render_frames(scene, [scene.frame_current],
                                  lambda _number, suffix: files.setdefault(suffix, Path(out) / f"rendered{suffix}"))
    return read(files[suffix]) * (255 if suffix == ".png" else 1)


def codes(number):
    """The codes of a frame of the capture."""
    return 255 * read(Path(capture) / "images" / f"{number:04d}.png")


def imported(**settings):
    scene = empty()
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.display.shading.light, scene.display.shading.color_type = "FLAT", "OBJECT"
    ops.import_capture(directory=capture, **settings)
    return scene


for kind in ("animated", "each"):
    scene = imported(cameras=kind)
    off = [float(np.abs(rendered(scene) - codes(0)).max())]
    if kind == "animated":
        scene.frame_set(2)
        off.append(float(np.abs(rendered(scene) - codes(2)).max()))
    facts[f"imported, {kind}"] = [scene.fit_flare.over, off, warnings.footage_note(scene)]
scene.camera = scene.objects["0001"]
facts["another camera"] = warnings.footage_note(scene)
ops.import_capture(directory=capture)
scene.frame_set(1)
facts["imported again"] = float(np.abs(rendered(scene) - codes(1)).max())
scene = imported(frames=False)
facts["imported without frames"] = [trees.tree_of(scene) is None, scene.fit_flare.over, scene.render.film_transparent]
scene = empty()
tree = artists_tree(scene)
count = len(tree.nodes)
notes = importer.import_capture(scene, capture).notes
facts["imported beside an artist's nodes"] = [setup.ARTISTS_COMPOSITOR in notes, len(tree.nodes) == count]
scene, steps = empty(), 0
for _ in importer.import_in_steps(scene, capture, importer.ImportSettings()):
    steps += 1
scene = empty()
cancelled = importer.import_in_steps(scene, capture, importer.ImportSettings())
for _ in range(steps):
    next(cancelled)
cancelled.close()
facts["cancelled"] = [trees.tree_of(scene) is None, scene.render.film_transparent, setup.STATE_PROPERTY in scene]

# ---- objects before the footage -------------------------------------------------------------------------
LEFT, RIGHT = slice(0, 31), slice(36, None)  # the board ends at column 33


def add_board(scene):
    """Add a coloured board before the left half of the scene's camera; return it."""
    board = object_in(scene, "Board", bpy.data.meshes.new("Board"), (0, 0, 0))
    board.data.from_pydata([(-9, -9, -1), (0, -9, -1), (0, 9, -1), (-9, 9, -1)], [], [(0, 1, 2, 3)])
    board.parent, board.color = scene.camera, (0.5, 0.25, 0.125, 1)
    return board


scene = imported()
plain = rendered(scene, ".exr")
board = add_board(scene)


def halves(picture):
    """How far a picture is from the board at the left, and from the footage at the right."""
    return [float(np.abs(picture[:, LEFT] - board.color[:3]).max()),
            float(np.abs(picture[:, RIGHT] - plain[:, RIGHT]).max())]


facts["board over footage"] = halves(rendered(scene, ".exr"))
ops.open_flare(filepath=flare)
scene.fit_flare.occlusion = False
ops.bake()
depsgraph = bpy.context.evaluated_depsgraph_get()
core = part("flare_addon.cameras").core_camera(scene.camera.data, scene.camera.evaluated_get(depsgraph).matrix_world,
                                               scene.render)
look = looks.look_of(scene)
light = core_look.draw(looks.evaluate_flares(scene, depsgraph, scene.camera).values(), core.intrinsics, WIDTH, HEIGHT,
                       look.blend, look.pixel_grid)
facts["flare over both"] = [float(light.max()), halves(rendered(scene, ".exr") - light)]
facts["transparent"] = warnings.footage_note(scene)
scene.render.film_transparent = False
facts["opaque"] = warnings.footage_note(scene)
ops.set_up_baked()
facts["set up, opaque"] = [warnings.footage_note(scene), float(np.abs(rendered(scene, ".exr") - light - plain).max()),
                           sorted(node.name for node in trees.tree_of(scene).nodes if "Render" in node.name)]
scene.render.film_transparent = True
ops.set_up_baked()
facts["set up, transparent again"] = halves(rendered(scene, ".exr") - light)
scene.fit_flare.over = "scene"
ops.set_up_baked()
facts["over the baked scene"] = sorted(node.name for node in trees.tree_of(scene).nodes
                                       if node.name in (footage.RENDER, footage.OBJECTS))
scene.fit_flare.over = "plate"
ops.set_up_baked()
ops.remove_compositor()
facts["objects removed"] = trees.tree_of(scene) is None

# ---- a film that is made transparent after an import ----------------------------------------------------
scene = imported(match_scene=False)
scene.frame_set(0)
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
board = add_board(scene)
tree = trees.tree_of(scene)
end = next(node for node in tree.nodes if node.bl_idname == trees.OUTPUT_TYPE)
reroute = tree.nodes.new("NodeReroute")  # of the artist, after the footage
tree.links.new(tree.nodes[footage.SIZE].outputs[0], reroute.inputs[0])
tree.links.new(reroute.outputs[0], end.inputs[0])
facts["film"] = {"opaque": [warnings.footage_note(scene), float(np.abs(rendered(scene, ".exr") - plain).max())]}


def film(name, is_transparent):
    """Note and render after a switch of the film, then of an import of the capture again."""
    scene.render.film_transparent = is_transparent
    note = warnings.footage_note(scene)
    ops.import_capture(directory=capture, match_scene=False)
    board.parent = scene.camera
    picture = rendered(scene, ".exr")
    facts["film"][name] = [note, warnings.footage_note(scene), halves(picture), float(np.abs(picture - plain).max()),
                           trees.depends_on(end, reroute), footage.RENDER in tree.nodes]


film("transparent", True)
film("opaque again", False)
tree.links.new(reroute.inputs[0].links[0].from_socket, end.inputs[0])
tree.nodes.remove(reroute)
ops.open_flare(filepath=flare)
scene.frame_end = scene.frame_start
ops.bake()
ops.set_up_baked()
scene.render.film_transparent = True
facts["film"]["set up, transparent later"] = warnings.footage_note(scene)
ops.set_up_baked()
facts["film"]["set up again"] = warnings.footage_note(scene)
scene = imported(frames=False, match_scene=False)
tree = artists_tree(scene)
scene.render.film_transparent = True
mine = tree.nodes.new("CompositorNodeImage")
mine.image = bpy.data.images.new("mine", 8, 4)
output = tree.nodes.new(trees.OUTPUT_TYPE)
tree.links.new(mine.outputs[0], output.inputs[0])
ops.import_capture(directory=capture)
ops.open_flare(filepath=flare)
ops.bake()
scene.fit_flare.over = "plate"
ops.set_up_baked()
facts["film"]["over an artist's picture"] = [footage.PLATE in tree.nodes, warnings.footage_note(scene)]

# ---- views that turn to the camera ----------------------------------------------------------------------
turned = []
for name in ("library", "capture"):
    module = part(f"flare_addon.operators.{name}")
    module.look_through_camera = lambda context: turned.append(context.scene.camera.name)
scene = empty()
ops.shot_from_picture(filepath=str(Path(capture) / "images" / "0001.png"))
ops.import_capture(directory=capture)
facts["turned"] = turned
region = SimpleNamespace(type="WINDOW")


def view(width):
    space = SimpleNamespace(use_local_camera=True, region_3d=SimpleNamespace(view_perspective="PERSP"))
    return SimpleNamespace(type="VIEW_3D", width=width, height=9, regions=[region],
                           spaces=SimpleNamespace(active=space))


small, large = view(3), view(5)
context = SimpleNamespace(scene=scene, screen=SimpleNamespace(areas=[small, large, SimpleNamespace(type="INFO")]))
facts["through the camera"] = [views.look_through_camera(context), *(
    [area.spaces.active.region_3d.view_perspective, area.spaces.active.use_local_camera] for area in (small, large))]
scene.camera = None
facts["nothing to look through"] = [views.look_through_camera(context), views.look_through_camera(
    SimpleNamespace(scene=scene, screen=None))]

leave(facts)
