# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: install the built extension, use it, remove it. Arguments: the zip, a folder of layers."""
from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path

import bpy

package, layers = sys.argv[1:]
NAME = "bl_ext.user_default.fit_flare"


def ours() -> list[str]:
    kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.AddonPreferences, bpy.types.PropertyGroup)
    return sorted(c.__name__ for kind in kinds for c in kind.__subclasses__() if c.__name__.startswith("FITFLARE")
                  and getattr(c, "is_registered", False))


bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
path, modules = list(sys.path), set(sys.modules)
bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True, overwrite=True)
facts = {"enabled": NAME in bpy.context.preferences.addons, "classes": ours()}
settings = importlib.import_module(f"{NAME}.flare_addon.user_settings")
facts["engine"] = [settings.engine_path()]
bpy.context.preferences.addons[NAME].preferences.engine = sys.executable
facts["engine"].append(settings.engine_path())
facts["python"] = sys.executable

facts["set up"] = list(bpy.ops.fit_flare.set_up_compositor(directory=layers))
scene = bpy.context.scene
facts["size"] = [scene.render.resolution_x, scene.render.resolution_y, scene.frame_start, scene.frame_end]
try:
    bpy.ops.fit_flare.set_up_compositor(directory=str(Path(package).parent))
    facts["refusal"] = ""
except RuntimeError as problem:  # how Blender hands on an operator's error report
    facts["refusal"] = str(problem)

facts["sys.path"] = [entry for entry in sys.path if entry not in path]
facts["strays"] = sorted(name for name in set(sys.modules) - modules
                         if name.split(".")[0] in ("core", "flare_addon", "headless", "fit_flare", "torch"))
bpy.ops.preferences.addon_disable(module=NAME)
facts["left"] = ours()
facts["operator left"] = hasattr(bpy.types, "FIT_FLARE_OT_set_up_compositor")
print(json.dumps(facts))
sys.stdout.flush()
os._exit(0)
