# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays that several processes read and none holds: the photographs of a training."""
from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

ALIGNED = 64
"""Bytes; no array begins between multiples of these."""


class _Place(NamedTuple):
    first: int
    shape: tuple[int, ...]
    dtype: str


class Mapped(Sequence[NDArray[Any]]):
    """Arrays in a file, which a process that is sent them maps: they are in memory once, however many have them, and
    sent in no time. Who makes them keeps the file for as long as anyone reads."""

    def __init__(self, path: Path, arrays: Iterable[NDArray[Any]]) -> None:
        """Written to `path`."""
        self._path, self._places = path, []
        self._bytes: NDArray[np.uint8] | None = None
        with open(path, "wb") as file:
            for array in arrays:
                file.seek(-file.tell() % ALIGNED, 1)
                self._places.append(_Place(file.tell(), array.shape, array.dtype.str))
                file.write(np.ascontiguousarray(array).data)

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, at: int) -> NDArray[Any]: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[NDArray[Any]]: ...

    def __getitem__(self, at: int | slice) -> NDArray[Any] | Sequence[NDArray[Any]]:
        """Read-only."""
        if isinstance(at, slice):
            return [self[number] for number in range(*at.indices(len(self)))]
        first, shape, dtype = self._places[at]
        if self._bytes is None:
            self._bytes = np.memmap(self._path, np.uint8, "r").view(np.ndarray)
        size = math.prod(shape) * np.dtype(dtype).itemsize
        return self._bytes[first:first + size].view(dtype).reshape(shape)

    def clear(self) -> None:
        """Let go of the file, which Windows does not delete before."""
        self._bytes = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bytes": None}
