# SPDX-License-Identifier: GPL-3.0-or-later
"""The looks of the library in the Asset Browser: a .blend with an empty for each look, listed as an asset library.

Blender lists no .flare files, and no files inside an extension, so the .blend is in Blender's user folder. Preferences
belong to the artist: only their button lists the library. A look that is dropped into a scene gets its flare where the
empty is. Blender reports dropped assets from 4.3 on.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.errors import FitFlareError, FlareFileError
from ..core.look import read_look
from ..core.system.files import atomic_path, write_text
from . import library, looks, overlay

NAME = "Fit Flare"
ASSETS, CATALOGS = "looks.blend", "blender_assets.cats.txt"
CATALOG = "5d0f3f0e-6f0c-4c57-9b8e-6f2f2b1d7a41"
EMPTY_SIZE = 0.2

_dropped: list[str] = []  # names of objects that were imported and not handled yet


def folder() -> Path:
    """Return the folder of the asset library."""
    return Path(bpy.utils.user_resource("DATAFILES", path="fit_flare/assets"))


def why_not() -> str:
    """Return why looks cannot be offered as assets, for the tooltip; "" where they can."""
    if not hasattr(bpy.app.handlers, "blend_import_post"):
        return "Looks as assets need Blender 4.3 or later: earlier versions do not report a dropped asset"
    return "" if library.files() else "The library is empty: save a flare to it first"


def library_entry() -> Any:
    """Return the entry of the asset library in Blender's preferences; None without one."""
    return next((entry for entry in bpy.context.preferences.filepaths.asset_libraries
                 if Path(entry.path).resolve() == folder().resolve()), None)


def add_asset_library() -> int:
    """Write the asset library, and add it to Blender's preferences; return the number of looks.

    Raises FlareFileError where no look can be read.
    """
    count = write_assets()
    if library_entry() is None:
        libraries = bpy.context.preferences.filepaths.asset_libraries
        entry = libraries.new(name=NAME, directory=str(folder()))
        entry.import_method = "APPEND"  # a light object of its own for each drop
    return count


def remove_asset_library() -> None:
    """Remove the asset library from Blender's preferences."""
    entry = library_entry()
    if entry is not None:
        bpy.context.preferences.filepaths.asset_libraries.remove(entry)


def update_assets() -> None:
    """Write the asset library again where it is listed, because the library of looks has changed."""
    if not why_not() and library_entry() is not None:
        write_assets()


def write_assets() -> int:
    """Write the .blend with an asset for each look of the library; return their number.

    Raises FlareFileError where no look can be read.
    """
    library.menu_items()  # writes the missing thumbnails
    # Reversed, so that the user's look, which comes first, replaces the extension's of the same name.
    paths = {path.stem: path for path in reversed(library.files()) if _is_usable(path)}
    if not paths:
        raise FlareFileError("The library has no look that can be read; save one to it first.")
    write_text(folder() / CATALOGS, f"VERSION 1\n\n{CATALOG}:Lens Flares:Lens Flares\n")
    assets = [_make_asset(path) for path in paths.values()]
    try:
        with atomic_path(folder() / ASSETS) as temporary:
            bpy.data.libraries.write(str(temporary), set(assets), fake_user=True)
    finally:
        for item in assets:
            bpy.data.objects.remove(item)
    return len(assets)


def _is_usable(path: Path) -> bool:
    """Return whether a look can be read and has a thumbnail."""
    try:
        read_look(path)
    except FitFlareError:
        return False
    return path.with_suffix(".png").is_file()


def _make_asset(path: Path) -> Any:
    """Return a new empty that is the asset of a look, with the look's thumbnail as its preview."""
    item = bpy.data.objects.new(path.stem, None)
    item.empty_display_type, item.empty_display_size = "SPHERE", EMPTY_SIZE
    item.fit_flare.asset_look = path.stem
    item.asset_mark()
    item.asset_data.catalog_id = CATALOG
    item.asset_data.description = f"{library.notes(str(path))}. Dropped into a scene, it shows its flare"
    item.asset_data.tags.new("lens flare")
    image = bpy.data.images.load(str(path.with_suffix(".png")))
    try:
        pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
        image.pixels.foreach_get(pixels)
        preview = item.preview_ensure()
        preview.image_size = image.size
        preview.image_pixels_float.foreach_set(pixels)
    finally:
        bpy.data.images.remove(image)
    return item


@bpy.app.handlers.persistent
def _on_import(context: Any, *_: Any) -> None:
    """Remember the assets of looks among imported objects; their flares are added when the drop has ended."""
    names = [entry.id.name for entry in context.import_items
             if isinstance(entry.id, bpy.types.Object) and entry.id.fit_flare.asset_look]
    if names:
        _dropped.extend(names)
        if not bpy.app.timers.is_registered(add_dropped):
            bpy.app.timers.register(add_dropped, first_interval=0.0)


def add_dropped() -> None:
    """Show the flares of dropped assets in the scene of the window, each as an undo step.

    An error is shown in the panel Look. A timer calls this once after a drop.
    """
    scene, names = bpy.context.scene, tuple(_dropped)
    _dropped.clear()
    paths = {path.stem: path for path in reversed(library.files())}
    for name in names:
        item = scene.objects.get(name)
        look = "" if item is None else item.fit_flare.asset_look
        if look not in paths:
            continue
        try:
            looks.show_look(scene, paths[look], [item], add=True)
        except FitFlareError as problem:
            overlay.last_error = str(problem)
            continue
        scene.fit_flare.show = True
        item.fit_flare.asset_look = ""  # a copy of the object is no asset
        if item.asset_data is not None and item.library is None:
            item.asset_clear()
        if not bpy.app.background:
            bpy.ops.ed.undo_push(message="Add Flare")


def register() -> None:
    if hasattr(bpy.app.handlers, "blend_import_post"):
        bpy.app.handlers.blend_import_post.append(_on_import)


def unregister() -> None:
    if hasattr(bpy.app.handlers, "blend_import_post"):
        bpy.app.handlers.blend_import_post.remove(_on_import)
    if bpy.app.timers.is_registered(add_dropped):
        bpy.app.timers.unregister(add_dropped)
    _dropped.clear()
