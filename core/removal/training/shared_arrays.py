# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays in a file that several processes map and none holds a copy of: the photographs of a training."""
from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

ALIGNMENT = 64
"""Bytes; every array begins at a multiple of it."""


class _ArraySpan(NamedTuple):
    first: int
    shape: tuple[int, ...]
    dtype: str


class SharedArrays(Sequence[NDArray[Any]]):
    """Arrays in a file. A process that receives this object maps the file: the arrays are in memory once, and sending
    them takes no time.

    The process that writes the file must keep it for as long as any process reads.
    """

    def __init__(self, path: Path, arrays: Iterable[NDArray[Any]]) -> None:
        """Write the arrays, of any shapes and types, to the file `path`."""
        self._path, self._spans = path, []
        self._bytes: NDArray[np.uint8] | None = None
        with open(path, "wb") as file:
            for array in arrays:
                file.seek(-file.tell() % ALIGNMENT, 1)
                self._spans.append(_ArraySpan(file.tell(), array.shape, array.dtype.str))
                file.write(np.ascontiguousarray(array).data)

    def __len__(self) -> int:
        return len(self._spans)

    @overload
    def __getitem__(self, index: int) -> NDArray[Any]: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[NDArray[Any]]: ...

    def __getitem__(self, index: int | slice) -> NDArray[Any] | Sequence[NDArray[Any]]:
        """Return a read-only array, or a list of them."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        first, shape, dtype = self._spans[index]
        if self._bytes is None:
            self._bytes = np.memmap(self._path, np.uint8, "r").view(np.ndarray)
        size = math.prod(shape) * np.dtype(dtype).itemsize
        return self._bytes[first:first + size].view(dtype).reshape(shape)

    def close(self) -> None:
        """Release the mapping; Windows does not delete a mapped file."""
        self._bytes = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bytes": None}
