# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, under a studio's colour configuration. Arguments: zip, capture, .flare, layers, a folder to write,
and optionally a working space to set for the .blend."""
from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part

package, capture, flare, layers, out, *space = sys.argv[1:]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
layer_nodes, rendering, working_space = (
    part(f"flare_addon.{name}") for name in ("compositor.layer_nodes", "render_settings", "working_space"))
facts: dict[str, object] = {}
PICKED = 0.8, 0.5, 0.4
"""A tint, components in the working space."""

scene = empty()
facts["import"] = [list(ops.import_capture(directory=capture)), scene.view_settings.view_transform]
if space and hasattr(bpy.data, "colorspace"):
    bpy.ops.wm.set_working_color_space(working_space=space[0])
facts["working space"] = bpy.data.colorspace.working_space if hasattr(bpy.data, "colorspace") else ""
ops.open_flare(filepath=flare)
scene.fit_flare.layers, scene.fit_flare.over = layers, "scene"
ops.set_up_baked()
facts["misread"] = layer_nodes.colour_space_warning(scene)
facts["red in the camera view"] = working_space.working_space()[:, 0].tolist()
rendering.render_frames(scene, [1], lambda _number, suffix: Path(out) / f"shown{suffix}")

# ---- the tint that an artist picks ------------------------------------------------------------------------
looks, shots, core_look = (part(name) for name in ("flare_addon.looks", "flare_addon.shots", "core.look"))
state, neutral = scene.fit_flare, looks.edits_of(scene.fit_flare)
item = state.lights[0]
element = item.elements[0]
element.tint = PICKED
shot = shots.read_scene_shot(scene, [], [1], Path(flare), None)
stored = looks.edits_to_store(state, looks.look_of(scene))  # by Save to Library, for transfers
tints = {"camera view": looks.edits_of(state).elements[item.name, element.name].tint}
for name, texts, light in (("bake", shot.frames[0].edits, item.name), ("transfer", stored.texts(), item.source)):
    tints[name] = core_look.LookEdits.parse(texts, [light]).elements[light, element.name].tint
facts["tints"] = {name: (working_space.working_space() @ tint).tolist() for name, tint in tints.items()}
part("flare_addon.properties").set_slider(element, "tint", tints["bake"])
facts["tint of a file"] = list(element.tint)
element.tint = (1, 1, 1)
facts["white"] = looks.edits_of(state) == neutral
leave(facts)
