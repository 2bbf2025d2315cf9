# SPDX-License-Identifier: GPL-3.0-or-later
"""The colour space of a capture's frames where the user names one: `plate_space.json` in its folder.

The commands write it (`--plate-space`), and `Capture.open` reads it, so that lights, fit, scores, clean frames and
layers see the same light. Without it the frames are read as their files declare.
"""
from __future__ import annotations

from pathlib import Path

from ..colour import ColourSpace, colour_space
from ..errors import CaptureError, os_error_message
from ..system.files import read_json, write_json

FILE = "plate_space.json"
AUTO = "auto"
"""The name for reading each frame as its file declares."""


def read_plate_space(folder: Path) -> ColourSpace | None:
    """Return the space of a capture's frames; None where their files decide.

    Raises CaptureError for a damaged record, SettingsError for an unknown space, EngineError without OpenColorIO.
    """
    record = _read_record(folder / FILE)
    return None if record is None else colour_space(*record)


def recorded_name(folder: Path) -> str:
    """Return the name of the space of a capture's frames, without loading OpenColorIO; "" where their files decide,
    or where the record is damaged."""
    try:
        record = _read_record(folder / FILE)
    except CaptureError:
        return ""
    return "" if record is None else record[0]


def _read_record(path: Path) -> tuple[str, str | None] | None:
    """Return the name of the space and the path of the OpenColorIO configuration that defines it; None without a
    record. The path is None for a built-in space, and for one of the configuration that the variable OCIO names.
    Raises CaptureError."""
    if not path.is_file():
        return None
    data = read_json(path, CaptureError)
    name, config = (data.get(key) for key in ("space", "ocio")) if isinstance(data, dict) else (None, None)
    if not isinstance(name, str) or not isinstance(config, str | None):
        raise CaptureError(f'{path} should read {{"space": "logc4"}}; name the space again with --plate-space.')
    return name, config


def record_plate_space(folder: Path, name: str, config: str | None) -> None:
    """Write the space of a capture's frames to its plate_space.json; AUTO removes the file.

    config: the OpenColorIO configuration that defines the space; None for the usual one. A missing folder is left
    missing. Raises CaptureError where the folder cannot be written, SettingsError for an unknown space.
    """
    path = folder / FILE
    try:
        if name == AUTO:
            path.unlink(missing_ok=True)
        elif folder.is_dir():
            colour_space(name, config)
            write_json(path, {"space": name, "ocio": config})
    except OSError as problem:
        raise CaptureError(f"The space of the frames cannot be recorded: {os_error_message(problem)}") from problem
