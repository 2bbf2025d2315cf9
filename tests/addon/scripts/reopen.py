# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside a Blender without Fit Flare: open a .blend, render its frames. Arguments: .blend, folder, numbers."""
from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import bpy

blend, out, *numbers = sys.argv[1:]
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
settings = scene.render.image_settings
if hasattr(settings, "media_type"):
    settings.media_type = "IMAGE"
settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
for number in map(int, numbers):
    scene.frame_set(number)
    scene.render.filepath = str(Path(out, f"{number}.exr"))
    bpy.ops.render.render(write_still=True)
settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGB", "8"
rendered = next(image for image in bpy.data.images if image.type == "RENDER_RESULT")
rendered.save_render(str(Path(out, "last.png")), scene=scene)
print(json.dumps({"frames": [scene.frame_start, scene.frame_end],
                  "size": [scene.render.resolution_x, scene.render.resolution_y]}))
sys.stdout.flush()
os._exit(0)
