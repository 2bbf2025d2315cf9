# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that the scripts share: install the extension, make an empty scene, return refusals as text."""
from __future__ import annotations

import contextlib
import importlib
import io
import json
import math
import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import bpy

NAME = "bl_ext.user_default.fit_flare"
deprecations: list[str] = []
"""What the extension uses although this Blender or its Python announces its end; `leave` fails with it."""


def _record(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
    is_ours = "fit_flare" in filename or "flare_addon" in filename
    if issubclass(category, DeprecationWarning | PendingDeprecationWarning) and is_ours:
        deprecations.append(f"{filename}:{lineno}: {message}")


warnings.showwarning = _record
warnings.simplefilter("always")


def install(package: str) -> None:
    """Into the (empty) profile of this process."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True,
                                             overwrite=True)
    assert NAME in bpy.context.preferences.addons


def part(name: str) -> Any:
    """A module of the installed extension."""
    return importlib.import_module(f"{NAME}.{name}")


def empty() -> Any:
    """A new file; its scene."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return bpy.context.scene


def object_in(scene: Any, name: str, data: Any, place: Any) -> Any:
    """A new object of the scene."""
    item = bpy.data.objects.new(name, data)
    scene.collection.objects.link(item)
    item.location = place
    return item


def scene_with(*lamps: Any) -> tuple[Any, list[Any]]:
    """Make an empty file with a camera that looks along +y, and lamps at these places; return the scene and the
    lamps."""
    scene = empty()
    scene.camera = object_in(scene, "Camera", bpy.data.cameras.new("Camera"), (0, 0, 0))
    scene.camera.rotation_euler = (math.pi / 2, 0, 0)
    made = [object_in(scene, f"Lamp {number}", bpy.data.lights.new("Lamp", "POINT"), place)
            for number, place in enumerate(lamps, 1)]
    bpy.context.view_layer.update()
    return scene, made


def select(scene: Any, *objects: Any) -> None:
    for item in scene.objects:
        item.select_set(item in objects)


def artists_tree(scene: Any) -> Any:
    """Give the scene a compositor tree of its own, without nodes; return the tree."""
    if bpy.app.version >= (5, 0, 0):
        tree = scene.compositing_node_group = bpy.data.node_groups.new("Mine", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
    return tree


def refusal(call: Callable[[], Any]) -> str:
    """Call an operator; return the error report with which it refuses, "" if it finishes. A traceback fails the
    script."""
    with contextlib.redirect_stderr(io.StringIO()) as noise:
        try:
            result = call()
        except RuntimeError as problem:  # how Blender hands on an operator's error report, or a poll that fails
            text = str(problem).removeprefix("Error: ").strip()
            assert "Traceback" not in text + noise.getvalue(), text + noise.getvalue()
            return text
    assert "Traceback" not in noise.getvalue(), noise.getvalue()
    return "" if result == {"FINISHED"} else str(result)


def leave(facts: dict[str, Any]) -> None:
    """Hand the facts to the test, and go. A use of what is deprecated fails the script."""
    assert not deprecations, "\n".join(sorted(set(deprecations)))
    print(json.dumps(facts))
    sys.stdout.flush()
    os._exit(0)
