# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes picture files: PNG by OpenCV, EXR by OpenEXR or, where that is missing, by numpy; each is whole or absent."""
from __future__ import annotations

import errno
import importlib.util
import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..system.files import atomic_path
from ..typed import is_utf8
from .exr import is_exr_truncated, non_utf8_names, non_utf8_strings
from .formats import exr_header, exr_writer

MAX_HALF = 65504
"""Greatest finite value of a 16 bit float."""


def write_exr(path: Path | str, channels: Mapping[str, NDArray[Any]], *, half: bool = True,
              header: Mapping[str, Any] | None = None, commit_lock: AbstractContextManager[None] | None = None) -> None:
    """Write one part, scanlines, ZIP; each channel (height, width), under its full name ("scene.R").

    half: store 16 bit floats, clipped to their range; depth ("Z" and "*.Z") stays 32 bit, since it needs more. header:
    more attributes. commit_lock: held while the finished file is renamed to `path`.
    """
    def convert(name: str, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return a channel in the type that is stored."""
        if half and not name.endswith(".Z") and name != "Z":
            return np.ascontiguousarray(np.clip(pixels, -MAX_HALF, MAX_HALF), np.float16)
        return np.ascontiguousarray(pixels, np.float32)

    stored_channels = {name: convert(name, pixels) for name, pixels in channels.items()}
    if importlib.util.find_spec("OpenEXR") is None:  # Blender's own Python
        with atomic_path(path, commit_lock) as temporary:
            exr_writer.write_scanlines(temporary, stored_channels, header or {})
        return
    import OpenEXR

    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(header or {})}
    save_exr(path, attributes, stored_channels, commit_lock)


def save_exr(path: Path | str, header: Mapping[str, Any], channels: Mapping[str, NDArray[Any]],
             commit_lock: AbstractContextManager[None] | None = None) -> None:
    """Write one part with this header and these channels; see `save_exr_parts`."""
    save_exr_parts(path, [(header, channels)], commit_lock)


def save_exr_parts(path: Path | str, parts: Sequence[tuple[Mapping[str, Any], Mapping[str, NDArray[Any]]]],
                   commit_lock: AbstractContextManager[None] | None = None, source: Path | None = None) -> None:
    """Write parts, each with its header and channels.

    commit_lock: held while the finished file is renamed to `path`. source: the EXR that the parts were read from; None
    for new parts. `exr.py` replaces texts and names that are not UTF-8 by others of the same lengths; here the original
    bytes are written over the replacements.

    Raises OSError where the system refuses, for instance for a full disk, and FrameError for a path that is not UTF-8.
    """
    import OpenEXR

    if not is_utf8(str(path)):
        raise FrameError(f"The path {str(path)!r} is not UTF-8, and no EXR can be written there; rename its folder.")
    strings, names = (non_utf8_strings(source), non_utf8_names(source)) if source is not None else ({}, {})
    first_header, first_channels = (dict(items) for items in parts[0])
    exr_file = (OpenEXR.File(first_header, first_channels) if len(parts) == 1 else
                OpenEXR.File([OpenEXR.Part(dict(header), dict(channels)) for header, channels in parts]))
    with atomic_path(path, commit_lock) as temporary, exr_file as file:
        try:
            file.write(str(temporary))
        except RuntimeError as problem:  # the library reports a refusal of the system as text
            is_disk_full = os.strerror(errno.ENOSPC) in str(problem)
            raise OSError(errno.ENOSPC if is_disk_full else errno.EIO, str(problem), str(path)) from problem
        if strings or names:
            _restore_bytes(temporary, strings, names)
        # OpenEXR reports no error on closing a file, so a full disk shows as a file that is empty or cut short.
        if not temporary.stat().st_size or is_exr_truncated(temporary):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _restore_bytes(path: Path, strings: Mapping[str, bytes], names: Mapping[bytes, bytes]) -> None:
    """Overwrite texts and names in an EXR's headers with bytes of the same lengths.

    strings: the bytes of each text, by the names of `exr_header.locate_strings`; a text whose length has changed stays.
    names: the original names of attributes and channels, by their names in the file.
    """
    with open(path, "r+b") as stream:
        replacements = [(offset, strings[name]) for name, (offset, text) in exr_header.locate_strings(stream).items()
                        if len(strings.get(name, b"")) == len(text)]
        replacements += [(offset, names[name]) for _, offset, name in exr_header.locate_names(stream) if name in names]
        for offset, content in replacements:
            stream.seek(offset)
            stream.write(content)


def write_png(path: Path | str, display: NDArray[Any], bits: Literal[8, 16] = 8) -> None:
    """Write display values 0..1, (height, width, 3) or (height, width), as PNG."""
    import cv2

    max_code = (1 << bits) - 1
    pixels = np.clip(np.nan_to_num(display), 0.0, 1.0) * max_code + 0.5
    stored: NDArray[Any] = pixels.astype(np.uint8 if bits == 8 else np.uint16)
    is_encoded, data = cv2.imencode(".png", stored[..., ::-1] if stored.ndim == 3 else stored)
    if not is_encoded:
        raise FrameError(f"{path} could not be encoded as PNG.")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
