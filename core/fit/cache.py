# SPDX-License-Identifier: GPL-3.0-or-later
"""Decoded pictures, kept for as long as a fit looks at them: in memory as far as that goes, then on disk.

To decode a frame of 4K and make it small takes far longer than an iteration of a fit at 960 pixels.
"""
from __future__ import annotations

import contextlib
import math
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

MEMORY = 1 << 29
"""Bytes that are kept in memory: 86 frames of 960x540 with their flare-free pairs."""
DISK_LEFT = 1 << 31
"""Bytes that stay free on the disk."""

Codes = NDArray[np.uint16]


class _Place(NamedTuple):
    offset: int
    shape: tuple[int, ...]


class PictureCache:
    """Arrays of 16 bit by name. What fits neither memory nor disk is not kept, and `get` knows nothing of it."""

    def __init__(self, memory: int = MEMORY) -> None:
        self._left = memory
        self._in_memory: dict[str, Codes] = {}
        self._on_disk: dict[str, _Place] = {}
        self._file: BinaryIO | None = None
        self._folder: Path | None = None

    @contextlib.contextmanager
    def overflowing_into(self, folder: Path) -> Iterator[None]:
        """Within it, keep what exceeds memory in a file in `folder`, which is gone afterwards, however this process
        ends; but for Windows it has no name even before."""
        # Without a file, as without room in it, pictures are decoded again.
        with contextlib.suppress(OSError):
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 - closed below
            self._folder = folder
        try:
            yield
        finally:
            self._close()

    def get(self, name: str) -> Codes | None:
        """What was put under a name, if it is there."""
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
        """Keep an array."""
        if codes.nbytes <= self._left:
            self._left -= codes.nbytes
            self._in_memory[name] = codes
        elif self._file is not None and self._folder is not None:
            try:
                if shutil.disk_usage(self._folder).free - codes.nbytes < DISK_LEFT:
                    return
                offset = self._file.seek(0, 2)
                if self._file.write(codes.tobytes()) < codes.nbytes:
                    return  # the disk, or what one may have of it, is full
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
