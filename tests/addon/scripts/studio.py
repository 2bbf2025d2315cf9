# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, under a studio's colour configuration. Arguments: zip, capture, .flare, layers, a folder to write."""
from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part

package, capture, flare, layers, out = sys.argv[1:6]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
compositor, rendering = part("flare_addon.compositor.setup"), part("flare_addon.render_settings")
facts: dict[str, object] = {}

scene = empty()
facts["import"] = [list(ops.import_capture(directory=capture)), scene.view_settings.view_transform]
ops.open_flare(filepath=flare)
scene.fit_flare.layers, scene.fit_flare.over = layers, "scene"
ops.set_up_baked()
facts["misread"] = compositor.colour_space_warning(scene)
rendering.render_frames(scene, [1], lambda _number, suffix: Path(out) / f"shown{suffix}")
leave(facts)
