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


pages = {panel.page for panel in panels._CLASSES}
facts["pages"] = [sorted(pages), [path_of(handbook.url(page)).is_file() for page in sorted(pages)]]
prefix, topics = handbook._manual_map()
identifiers = {"bpy.ops.fit_flare.bake": "editing", "bpy.ops.fit_flare.set_up_engine": "install",
               "bpy.ops.fit_flare.import_capture": "first_fit", "bpy.types.fitflare_pg_light.follow_power": "editing"}
facts["online manual"] = [next(page for pattern, page in topics if fnmatch.fnmatch(name, pattern)) == f"{page}.html"
                          for name, page in identifiers.items()]
facts["topics"] = all(path_of(prefix + page).is_file() for _, page in topics)
index = path_of(handbook.url()).read_text(encoding="utf-8")
facts["index"] = ['href="editing.html"' in index, ".md" in index]

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
leave(facts)
