# SPDX-License-Identifier: GPL-3.0-or-later
"""The library: a folder of .flare files, each with a thumbnail beside it, shown as previews."""
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
from ..core.look import Look, draw, read
from ..core.look.look import ViewOfLight, annotated
from ..core.system.files import atomic_path, plain_name
from . import preferences

SIDE = 192  # pixels of a thumbnail

_previews: Any = None
_items: list[tuple[str, str, str, int, int]] = []
_seen: tuple[tuple[str, float], ...] | None = None
_chosen = 0  # the number of an item


def folder(create: bool = False) -> Path:
    """The library's folder: the preferences' own, or one in Blender's user folder; not one of the extension's, which
    Blender deletes when the extension is uninstalled."""
    path = Path(preferences.library_path() or bpy.utils.user_resource("DATAFILES", path="fit_flare/library"))
    if create:
        path.mkdir(parents=True, exist_ok=True)
    return path


def files() -> list[Path]:
    """The .flare files there, by name."""
    try:
        return sorted(path for path in folder().glob("*.flare") if not path.name.startswith("."))
    except OSError:
        return []


def save(look: Look, name: str, notes: str, licence: str) -> Path:
    """Put a look into the library. Raises FlareFileError where the name is taken or cannot be a file's."""
    safe = "".join(letter for letter in name if letter.isalnum() or letter in " -_()").strip()
    if not safe:
        raise FlareFileError(f"{name!r} cannot be a file's name; use letters and digits.")
    path = folder(create=True) / f"{plain_name(safe)}.flare"
    if path.exists():
        raise FlareFileError(f"The library has {safe!r} already; choose another name.")
    annotated(look.path, path, notes=notes, licence=licence)
    write_png(path.with_suffix(".png"), thumbnail(look))
    return path


def thumbnail(look: Look) -> NDArray[np.float32]:
    """(SIDE, SIDE, 3) display values: each light's flare as the middle of its training saw it, light upper left."""
    k = np.array([[1.1 * SIDE, 0, SIDE / 2], [0, 1.1 * SIDE, SIDE / 2], [0, 0, 1]])
    total = np.zeros((SIDE, SIDE, 3), np.float32)
    for light in look.lights:
        middle = (light.query_range.camera_low + light.query_range.camera_high) / 2
        _, place = light.query_range.clipped(middle, np.array([-0.24, -0.2], np.float32))
        found = light.evaluate(ViewOfLight(middle, np.eye(3, dtype=np.float32), place, 1.0))
        if found is not None:
            shown = draw([found], k, SIDE, SIDE, look.blend, look.sampling)
            total += shown if look.blend == "add" else linear_from_srgb(shown)
    return np.clip(srgb_from_linear(np.maximum(total, 0)), 0, 1)


def write_png(path: Path, display: NDArray[np.float32]) -> None:
    """An 8 bit PNG of display values, without a library for it (Blender's Python has none)."""
    height, width = display.shape[:2]
    rows = (np.clip(display, 0, 1) * 255 + 0.5).astype(np.uint8).reshape(height, -1)
    raw = np.concatenate([np.zeros((height, 1), np.uint8), rows], 1).tobytes()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw))
                              + chunk(b"IEND", b""))


def items(_self: Any = None, _context: Any = None) -> list[tuple[str, str, str, int, int]]:
    """The library for a preview enum: file, name, notes, icon, number. Read again when a file changed."""
    global _previews, _items, _seen
    stamps = []
    for path in files():
        try:
            stamps.append((str(path), path.stat().st_mtime))
        except OSError:
            continue
    if tuple(stamps) == _seen:
        return _items
    if _previews is None:
        from bpy.utils import previews

        _previews = previews.new()
    _previews.clear()
    found = []
    for name, _ in stamps:
        number = zlib.crc32(name.encode("utf-8", "surrogateescape")) & 0x7FFFFFFF  # the same beside any others
        path = Path(name)
        try:
            look = read(path)
            if not path.with_suffix(".png").is_file():
                write_png(path.with_suffix(".png"), thumbnail(look))
            icon = _previews.load(name, str(path.with_suffix(".png")), "IMAGE").icon_id
            notes = f"{len(look.lights)} lights, {look.count} Gaussians. {look.notes}".strip()
        except (FitFlareError, OSError) as problem:
            icon, notes = 0, str(problem)
        found.append((name, path.stem, notes, icon, number))
    _items, _seen = found or [("", "Empty", "Save a flare into the library first", 0, 0)], tuple(stamps)
    return _items


def chosen(_self: Any = None) -> int:
    """The number of the chosen item; the first's where none was chosen yet, or what was is no longer there."""
    numbers = [item[-1] for item in items()]
    return _chosen if _chosen in numbers else numbers[0]


def choose(_self: Any, number: int) -> None:
    """Choose an item by its number."""
    global _chosen
    _chosen = number


def register() -> None:
    bpy.types.WindowManager.fit_flare_library = bpy.props.EnumProperty(
        name="Library", description="A flare from the library", items=items, get=chosen, set=choose)


def unregister() -> None:
    global _previews, _seen
    del bpy.types.WindowManager.fit_flare_library
    if _previews is not None:
        from bpy.utils import previews

        previews.remove(_previews)
        _previews = None
    _items.clear()
    _seen = None
