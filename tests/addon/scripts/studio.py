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
layer_nodes, rendering, overlay = (
    part(f"flare_addon.{name}") for name in ("compositor.layer_nodes", "render_settings", "overlay"))
facts: dict[str, object] = {}

scene = empty()
facts["import"] = [list(ops.import_capture(directory=capture)), scene.view_settings.view_transform]
if space and hasattr(bpy.data, "colorspace"):
    bpy.ops.wm.set_working_color_space(working_space=space[0])
facts["working space"] = bpy.data.colorspace.working_space if hasattr(bpy.data, "colorspace") else ""
ops.open_flare(filepath=flare)
scene.fit_flare.layers, scene.fit_flare.over = layers, "scene"
ops.set_up_baked()
facts["misread"] = layer_nodes.colour_space_warning(scene)
facts["red in the camera view"] = overlay.working_space()[:, 0].tolist()
rendering.render_frames(scene, [1], lambda _number, suffix: Path(out) / f"shown{suffix}")
leave(facts)
