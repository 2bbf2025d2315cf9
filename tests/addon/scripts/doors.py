# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: the menus, file handlers, links and buttons through which people come in. Arguments: the zip, a
capture, a .flare of its light, a folder to write."""
from __future__ import annotations

import fnmatch
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock
from urllib.parse import urlparse
from urllib.request import url2pathname

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from panel_drawing import draw_panel, subclasses
from start import NAME, install, leave, object_in, part, refusal, scene_with, select

package, capture, flare, out = sys.argv[1:5]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
panels, menus, handbook, setup = (part(f"flare_addon.{name}")
                                  for name in ("panels", "operators.menus", "handbook", "compositor.setup"))
facts: dict[str, object] = {}


def entries(draw):
    """The operators and texts that a menu draws."""
    layout = MagicMock()
    draw(SimpleNamespace(layout=layout), bpy.context)
    return [[call.args[0], call.kwargs.get("text", "")] for call in layout.mock_calls
            if call[0].rpartition(".")[2] in ("operator", "menu")]


def ours(menu):
    """The functions of the extension that draw in a menu of Blender."""
    found = getattr(bpy.types, menu)._dyn_ui_initialize()
    return [function.__name__ for function in found if function.__module__.startswith(NAME)]


# ---- menus ----------------------------------------------------------------------------------------------
facts["menus"] = {menu: ours(menu) for menu, _ in menus._MENUS}
facts["import"] = entries(menus._draw_import)
scene, (lamp, other) = scene_with((0.4, 8, 0.3), (1, 8, 0.3))
bpy.context.view_layer.objects.active = object_in(scene, "Mesh", bpy.data.meshes.new("Mesh"), (0, 0, 0))
facts["of a mesh"] = entries(menus._draw_context)
bpy.context.view_layer.objects.active = lamp
facts["of a lamp"] = [name for name, _ in entries(menus._draw_context)]
facts["no flare yet"] = [entries(menus._draw_render), refusal(ops.choose_flare)]
select(scene, lamp)
ops.open_flare(filepath=flare)
select(scene, other)
ops.add_flare()
scene.fit_flare.light = 1
facts["of a lamp with a flare"] = [name for name, _ in entries(menus._draw_context)]
ops.choose_flare()
facts["chosen"] = scene.fit_flare.lights[scene.fit_flare.light].target.name
facts["render"] = entries(menus._draw_render)
layouts = [MagicMock(), MagicMock()]
for layout, path in zip(layouts, ("", flare), strict=True):
    state = SimpleNamespace(fit_flare=SimpleNamespace(flare=path))
    menus.FITFLARE_MT_object.draw(SimpleNamespace(layout=layout), SimpleNamespace(scene=state))
facts["adds at selected"] = [layout.operator.return_value.add for layout in layouts]
words = [[name, text or getattr(ops, name.removeprefix("fit_flare.")).get_rna_type().name]
         for name, text in entries(menus.FITFLARE_MT_object.draw)]
facts["words"] = [text for _, text in words]
facts["unknown"] = [name for name, _ in words if not name.startswith(("fit_flare.", "wm.url_open"))]

# ---- files that are dropped or imported -----------------------------------------------------------------
handlers = {cls.bl_label: cls for cls in bpy.types.FileHandler.__subclasses__() if cls.__module__.startswith(NAME)}
facts["handlers"] = {name: [cls.bl_import_operator, cls.bl_file_extensions] for name, cls in handlers.items()}
view = SimpleNamespace(area=SimpleNamespace(type="VIEW_3D"))
facts["dropped on"] = [all(cls.poll_drop(view) for cls in handlers.values()),
                       any(cls.poll_drop(SimpleNamespace(area=SimpleNamespace(type="TEXT_EDITOR")))
                           for cls in handlers.values())]
scene, _ = scene_with()
facts["a file of a capture"] = [list(ops.import_capture(filepath=str(next(Path(capture).rglob("cameras.*"))))),
                                scene.fit_flare.root is not None]
facts["a flare"] = [list(ops.open_flare(filepath=flare)), len(scene.fit_flare.lights)]

# ---- links to the handbook ------------------------------------------------------------------------------
def path_of(url):
    return Path(url2pathname(urlparse(url).path))


def header_link(panel):
    """The page that the header of a panel opens."""
    layout = MagicMock()
    getattr(panel, "draw_header_preset", lambda _self, _context: None)(SimpleNamespace(
        layout=layout, page=getattr(panel, "page", "")), bpy.context)
    return path_of(layout.operator.return_value.url) if layout.operator.call_args == (
        ("wm.url_open",), {"text": "", "icon": "HELP", "emboss": False}) else None


links = {panel.bl_idname: header_link(panel) for panel in subclasses(bpy.types.Panel)}
facts["pages"] = {name: path.stem if path is not None and path.is_file() else "" for name, path in links.items()}
prefix, topics = handbook._manual_map()


def online_manual(identifier):
    """The name of the page that the entry Online Manual opens."""
    return next((page.removesuffix(".html") for pattern, page in topics if fnmatch.fnmatchcase(identifier, pattern)),
                "")


operators = {cls.bl_idname.removeprefix("fit_flare."): cls.bl_label for cls in subclasses(bpy.types.Operator)}
facts["operators"] = {name: [label, online_manual(f"bpy.ops.fit_flare.{name}")] for name, label in operators.items()}
properties = [f"bpy.types.{cls.__name__.lower()}.{item.identifier}"
              for kind in (bpy.types.PropertyGroup, bpy.types.AddonPreferences) for cls in subclasses(kind)
              for item in cls.bl_rna.properties if item.identifier not in kind.bl_rna.properties]
facts["pages of properties"] = {name.removeprefix("bpy.types.fitflare_"): online_manual(name) for name in properties}
known = {*(f"bpy.ops.fit_flare.{name}" for name in operators), *properties,
         "bpy.types.windowmanager.fit_flare_library"}
facts["stray topics"] = [pattern for pattern, _ in topics if not fnmatch.filter(known, pattern)]
facts["topics"] = all(path_of(prefix + page).is_file() for _, page in topics)
index = path_of(handbook.url()).read_text(encoding="utf-8")
facts["index"] = ['href="editing.html"' in index, ".md" in index]

# ---- what panels draw -----------------------------------------------------------------------------------
picture = str(Path(out) / "picture.png")
image = bpy.data.images.new("Picture", 8, 4)
image.filepath_raw, image.file_format = picture, "PNG"
image.save()


def draw_everything(where):
    """Draw every panel in its editor, with or without what it works on; note which were drawn in facts."""
    nodes = [SimpleNamespace(type="NODE_EDITOR", tree_type=kind) for kind in ("CompositorNodeTree", "ShaderNodeTree")]
    clips = [None, bpy.data.movieclips.load(picture)]
    spaces = {"VIEW_3D": [None], "NODE_EDITOR": nodes, "PROPERTIES": [None],
              "IMAGE_EDITOR": [SimpleNamespace(type="IMAGE_EDITOR", image=item)
                               for item in (None, bpy.data.images.load(picture), bpy.data.images.new("Made", 4, 4))],
              "CLIP_EDITOR": [SimpleNamespace(type="CLIP_EDITOR", clip=clip) for clip in clips]}
    drawn = {}
    for cls in subclasses(bpy.types.Panel):
        drawn[cls.bl_idname.removeprefix("FITFLARE_PT_")] = [
            draw_panel(cls, space_data=space, edit_movieclip=getattr(space, "clip", None)) is not None
            for space in spaces[cls.bl_space_type]]
    facts[f"drawn {where}"] = drawn


scene, (lamp, _) = scene_with((0.4, 8, 0.3), (1, 8, 0.3))
draw_everything("without a flare")
select(scene, lamp)
ops.open_flare(filepath=flare)
draw_everything("with a flare")
scene.fit_flare.lights[0].show_elements = True
headings = [subject for function, subject in draw_panel(panels.FITFLARE_PT_look)
            if (function, subject) != ("label", "") and (function == "label" or subject.endswith(".intensity"))]
item = scene.fit_flare.lights[0]
facts["headings"] = [headings, item.name, item.elements[item.element].name]

# ---- bake and composite ---------------------------------------------------------------------------------
trees, flare_node, shots = (part(f"flare_addon.{name}") for name in ("compositor.trees", "compositor.flare_node",
                                                                     "shots"))
scene, (lamp, other) = scene_with((0.4, 8, 0.3), (1, 8, 0.3))
scene.render.resolution_x, scene.render.resolution_y, scene.frame_end = 64, 36, 1
scene.fit_flare.layers = str(Path(out) / "layers")
select(scene, lamp)
ops.open_flare(filepath=flare)
layout = MagicMock()
panels.FITFLARE_PT_bake.draw(SimpleNamespace(layout=layout, _draw_compositor=lambda *_: None), bpy.context)
facts["button"] = [call.kwargs["text"] for call in layout.mock_calls if call.args == ("fit_flare.bake",)]
scene.fit_flare.bake_composite = False
ops.bake(composite=True)


def layer_sockets():
    """The layers that the compositor reads."""
    return sorted(socket.name for node in flare_node.tree_of(scene).nodes if node.bl_idname == "CompositorNodeImage"
                  for socket in node.outputs if socket.is_linked)


facts["one button"] = [flare_node.find_node(scene) is not None, scene.fit_flare.bake_composite]
one = layer_sockets()
select(scene, other)
ops.add_flare()
ops.bake(replace=True)
kept = layer_sockets()
ops.bake(replace=True, composite=True)
facts["anew"] = [kept == one, len(layer_sockets()) - len(one)]
draw_everything("with a node")
leave(facts)
