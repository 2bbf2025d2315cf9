# SPDX-License-Identifier: GPL-3.0-or-later
"""The library: .flare files with thumbnails, which the panel Library shows as previews.

The looks that come with the extension are in library_looks/ (`sample_scenes/make_library.py` makes them); those of the
user are in a folder of their own.
"""
from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.colour.srgb import linear_from_srgb, srgb_from_linear
from ..core.errors import FitFlareError, FlareFileError
from ..core.look import Look, LookEdits, draw, read_look
from ..core.look.look import ViewOfLight, write_annotated
from ..core.system.files import atomic_path, avoid_device_name
from .user_settings import library_path

THUMBNAIL_SIZE = 192  # pixels of a thumbnail
BOX = Path(__file__).parent / "library_looks"
"""Folder of the looks that come with the extension, each with its thumbnail; nothing is written to it."""

_previews: Any = None
_items: list[tuple[str, str, str, int, int]] = []
_notes: dict[str, str] = {}  # by path
_stamps: tuple[tuple[str, float], ...] | None = None
_chosen = 0  # number of the chosen item
_displayed = ""  # file of the item that the panel displays as chosen


def folder(create: bool = False) -> Path:
    """Return the folder of the library: the one of the preferences, else one in Blender's user folder.

    It is not in the folder of the extension, which Blender deletes when the extension is uninstalled.
    """
    path = Path(library_path() or bpy.utils.user_resource("DATAFILES", path="fit_flare/library"))
    if create:
        path.mkdir(parents=True, exist_ok=True)
    return path


def files() -> list[Path]:
    """Return the .flare files of the library: the user's, then those of the extension, each sorted by name."""
    return user_files() + _flares_of(BOX)


def user_files() -> list[Path]:
    """Return the .flare files of the user's folder, sorted by name."""
    return _flares_of(folder())


def _flares_of(directory: Path) -> list[Path]:
    try:
        return sorted(path for path in directory.glob("*.flare") if not path.name.startswith("."))
    except OSError:
        return []


def save_look(look: Look, edits: LookEdits, name: str, notes: str, licence: str) -> Path:
    """Save a look with edits of its lights to the library; return its file.

    Raises FlareFileError where the name is taken or not valid.
    """
    path = free_path(name)
    write_annotated(look.path, path, notes=notes, licence=licence, edits=edits)
    write_png(path.with_suffix(".png"), draw_thumbnail(read_look(path)))
    return path


def free_path(name: str) -> Path:
    """Return the file of a new entry, whose folder exists. Raises FlareFileError where the name is taken or not valid.
    """
    stem = "".join(letter for letter in name if letter.isalnum() or letter in " -_()").strip()
    if not stem:
        raise FlareFileError(f"{name!r} is not a valid file name; use letters and digits.")
    path = folder(create=True) / f"{avoid_device_name(stem)}.flare"
    if path.exists():
        raise FlareFileError(f"The library has {stem!r} already; choose another name.")
    return path


def draw_thumbnail(look: Look) -> NDArray[np.float32]:
    """Return display values (THUMBNAIL_SIZE, THUMBNAIL_SIZE, 3): all flares for the middle of their training cameras,
    with the edits of the file and the light at the upper left.

    The focal length is 1.1 times the width. The light is at (-0.24, -0.2) on the normalised plane, or nearer to the
    centre where no training view has it as far out.
    """
    focal, centre = 1.1 * THUMBNAIL_SIZE, THUMBNAIL_SIZE / 2
    intrinsics = np.array([[focal, 0, centre], [0, focal, centre], [0, 0, 1]])
    total = np.zeros((THUMBNAIL_SIZE, THUMBNAIL_SIZE, 3), np.float32)
    for light in look.lights:
        if not look.edits.is_visible(light.name, look.names):
            continue
        middle = (light.query_range.camera_low + light.query_range.camera_high) / 2
        _, light_position = light.query_range.clip(middle, np.array([-0.24, -0.2], np.float32))
        view = ViewOfLight(middle, np.eye(3, dtype=np.float32), light_position, 1.0)
        gaussians = light.evaluate(view, edits=look.edits)
        if gaussians is not None:
            picture = draw([gaussians], intrinsics, THUMBNAIL_SIZE, THUMBNAIL_SIZE, look.blend, look.pixel_grid)
            total += picture if look.blend == "add" else linear_from_srgb(picture)
    return np.clip(srgb_from_linear(np.maximum(total, 0)), 0, 1)


def write_png(path: Path, display: NDArray[np.float32]) -> None:
    """Write display values (h, w, 3) as an 8 bit PNG; Blender's Python has no library for it."""
    height, width = display.shape[:2]
    rows = (np.clip(display, 0, 1) * 255 + 0.5).astype(np.uint8).reshape(height, -1)
    # Each row begins with the number of its filter, 0 for none.
    filtered_rows = np.concatenate([np.zeros((height, 1), np.uint8), rows], 1).tobytes()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    # 8 bits a channel, colour type 2 (RGB), the standard compression and filters, no interlacing
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(filtered_rows))
                              + chunk(b"IEND", b""))


def menu_items(_self: Any = None, _context: Any = None) -> list[tuple[str, str, str, int, int]]:
    """Return the items of the preview menu: file, name, notes, icon, number. They are cached until a file changes.

    Also writes the missing thumbnails of the user's flares. number: identifies the entry, whatever other files there
    are.
    """
    global _previews, _items, _stamps
    stamps = []
    for path in files():
        try:
            stamps.append((str(path), path.stat().st_mtime))
        except OSError:
            continue
    if tuple(stamps) == _stamps:
        return _items
    if _previews is None:
        from bpy.utils import previews

        _previews = previews.new()
    _previews.clear()
    entries = []
    for name, _ in stamps:
        number = zlib.crc32(name.encode("utf-8", "surrogateescape")) & 0x7FFFFFFF  # of the name alone, so it stays
        path = Path(name)
        try:
            look = read_look(path)
            if not path.with_suffix(".png").is_file() and path.parent != BOX:
                write_png(path.with_suffix(".png"), draw_thumbnail(look))
            icon = _previews.load(name, str(path.with_suffix(".png")), "IMAGE").icon_id
            _notes[name] = look.notes.partition(". ")[0]
            tip = f"{len(look.lights)} lights, {look.count} Gaussians. {look.notes}".strip()
        except (FitFlareError, OSError) as problem:
            icon, tip, _notes[name] = 0, str(problem), str(problem)
        entries.append((name, path.stem, tip, icon, number))
    _items, _stamps = entries or [("", "Empty", "Save a flare to the library first", 0, 0)], tuple(stamps)
    return _items


def notes(path: str) -> str:
    """Return the first sentence of the notes of an entry."""
    return _notes.get(path, "")


def chosen(_self: Any = None) -> int:
    """Return the number of the chosen item; that of the first where none is chosen or the chosen one was deleted."""
    global _displayed
    items = menu_items()
    item = next((item for item in items if item[-1] == _chosen), items[0])
    _displayed = item[0]
    return item[-1]


def choose(_self: Any, number: int) -> None:
    """Choose the item with this number."""
    global _chosen, _displayed
    _chosen, _displayed = number, ""


def chosen_path() -> str:
    """Return the file of the chosen item.

    Raises FlareFileError where the library has none, and where the file that the panel displays was deleted or renamed.
    """
    if _displayed and not Path(_displayed).is_file():
        name = Path(_displayed).stem
        chosen()  # displays the first one
        raise FlareFileError(f"{name} was deleted from the library or renamed; choose another look.")
    path = str(bpy.context.window_manager.fit_flare_library)
    if not path:
        raise FlareFileError("The library has no flare that can be read; save one to it first.")
    return path


def register() -> None:
    bpy.types.WindowManager.fit_flare_library = bpy.props.EnumProperty(
        name="Library", description="A flare from the library", items=menu_items, get=chosen, set=choose)


def unregister() -> None:
    """Remove the menu's property, and free the thumbnails."""
    global _previews, _stamps
    del bpy.types.WindowManager.fit_flare_library
    if _previews is not None:
        from bpy.utils import previews

        previews.remove(_previews)
        _previews = None
    _items.clear()
    _stamps = None
