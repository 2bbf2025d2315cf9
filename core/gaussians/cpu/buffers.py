# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory that is used again.

An iteration asks for the same large arrays each time. Fresh from the system each page of them costs a
fault, more than the kernels take to fill it. So a block goes back to a shelf when the last array or tensor
that looks at it is gone, and the next request of about its size gets it.
"""
from __future__ import annotations

import weakref
from collections import defaultdict
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array = npt.NDArray[Any]

LINE = 64
"""Bytes of a cache line; where arrays start."""
KEPT = 6
"""Blocks of one size kept on the shelf."""

_shelves: dict[int, list[Array]] = defaultdict(list)


def _size_class(size: int) -> int:
    """The next of 8 steps to each power of two, at least 4096."""
    step = 1 << max(size.bit_length() - 4, 9)
    return max(-(-size // step) * step, 4096)


def _give_back(block: Array) -> None:
    shelf = _shelves[block.size]
    if len(shelf) < KEPT:
        shelf.append(block)


def empty(shape: tuple[int, ...] | int, dtype: Any = np.float32) -> Array:
    """An array of undefined contents that starts at a cache line."""
    shape = (shape,) if isinstance(shape, int) else shape
    dtype = np.dtype(dtype)
    size = dtype.itemsize
    for extent in shape:
        size *= extent
    capacity = _size_class(size + LINE)
    try:
        block = _shelves[capacity].pop()
    except IndexError:
        block = np.empty(capacity, np.uint8)
    offset = -block.ctypes.data % LINE
    # frombuffer: an array that others refer to as their base, so that the block is free after all of them
    array = np.frombuffer(block.data[offset : offset + size], dtype).reshape(shape)
    owner = array
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    weakref.finalize(owner, _give_back, block).atexit = False
    return array


def zeros(shape: tuple[int, ...] | int, dtype: Any = np.float32) -> Array:
    """The same, filled with zeros."""
    array = empty(shape, dtype)
    array.fill(0)
    return array


def empty_tensor(shape: tuple[int, ...]) -> Tensor:
    """The same as a float32 tensor."""
    return torch.from_numpy(empty(shape))
