# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps decoded frames for as long as a fit uses them: in memory up to a limit, then on disk.

`frames` fills it. Decoding a 4K frame and reducing it takes far longer than an iteration of a fit at 960 pixels.
"""
from __future__ import annotations

import contextlib
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

MEMORY = 1 << 29
"""Bytes kept in memory: 86 frames of 960x540 with their clean frames."""
MIN_FREE_DISK = 1 << 31
"""Bytes left free on the disk."""

Codes = NDArray[np.uint16]


class _Place(NamedTuple):
    """Where an array lies in the file: offset in bytes, and shape."""

    offset: int
    shape: tuple[int, ...]


class PictureCache:
    """Caches 16 bit arrays by name. `get` returns None for an array that fitted neither in memory nor on disk."""

    def __init__(self, memory: int = MEMORY) -> None:
        self._free_bytes = memory  # of the memory
        self._in_memory: dict[str, Codes] = {}
        self._on_disk: dict[str, _Place] = {}
        self._file: BinaryIO | None = None
        self._folder: Path | None = None

    @contextlib.contextmanager
    def overflowing_into(self, folder: Path) -> Iterator[None]:
        """Within the context, keep arrays that do not fit in memory in a temporary file in `folder`.

        The file is deleted at the end, even if the process is killed: except on Windows it has no name.
        """
        # If no file can be made, what does not fit in memory is decoded again each time.
        with contextlib.suppress(OSError):
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 - closed below
            self._folder = folder
        try:
            yield
        finally:
            self._close()

    def get(self, name: str) -> Codes | None:
        """Return the array stored under a name; None if it was not stored, or if the disk fails, which also closes the
        file."""
        place = self._on_disk.get(name)
        if place is None or self._file is None:
            return self._in_memory.get(name)
        try:
            self._file.seek(place.offset)
            data = self._file.read(2 * math.prod(place.shape))
            return np.frombuffer(data, np.uint16).reshape(place.shape)
        except (OSError, ValueError):  # a disk that went away
            self._close()
            return None

    def put(self, name: str, codes: Codes) -> None:
        """Store an array under a name: in memory, or else on disk; without room on either it is silently not stored."""
        if codes.nbytes <= self._free_bytes:
            self._free_bytes -= codes.nbytes
            self._in_memory[name] = codes
        elif self._file is not None and self._folder is not None:
            try:
                if shutil.disk_usage(self._folder).free - codes.nbytes < MIN_FREE_DISK:
                    return
                offset = self._file.seek(0, os.SEEK_END)
                if self._file.write(codes.tobytes()) < codes.nbytes:
                    return  # the disk or the user's quota is full
            except OSError:
                self._close()
                return
            self._on_disk[name] = _Place(offset, codes.shape)

    def _close(self) -> None:
        file, self._file = self._file, None
        self._on_disk.clear()
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()
