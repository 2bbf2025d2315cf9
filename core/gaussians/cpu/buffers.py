# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory that is used again.

An iteration asks for the same large arrays each time. Fresh from the system each page of them costs a
fault, more than the kernels take to fill it. So a block goes back to a shelf when the last array or tensor
that looks at it is gone, and the next request of about its size gets it.
"""
from __future__ import annotations

import weakref
from collections import OrderedDict
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array = npt.NDArray[Any]

LINE = 64
"""Bytes of a cache line; where arrays start."""
SMALL = 1 << 15
"""Bytes below which the system's own memory is as good."""
KEPT = 1 << 30
"""Bytes kept on the shelves at most; those unused for longest go first."""

_shelf: OrderedDict[int, list[Array]] = OrderedDict()
_loans: dict[int, _Loan] = {}
_stored = 0


class _Loan(weakref.ref[Array]):
    """Watches an array; its block returns to the shelf with it."""

    __slots__ = ("block",)
    block: Array


def _give_back(loan: weakref.ref[Array]) -> None:
    global _stored
    assert isinstance(loan, _Loan)
    del _loans[id(loan)]
    size = loan.block.size
    _shelf.setdefault(size, []).append(loan.block)
    _shelf.move_to_end(size)
    _stored += size
    while _stored > KEPT:
        oldest, blocks = next(iter(_shelf.items()))
        blocks.pop()
        _stored -= oldest
        if not blocks:
            del _shelf[oldest]


def _capacity(size: int) -> int:
    """The next of 8 steps to each power of two."""
    step = 1 << (size.bit_length() - 4)
    return -(-size // step) * step


def _at_line(size: int) -> Array:
    array = np.empty(size + LINE, np.uint8)
    first = -array.__array_interface__["data"][0] % LINE
    return array[first : first + size]


def _block(capacity: int) -> Array:
    global _stored
    blocks = _shelf.get(capacity)
    if not blocks:
        return _at_line(capacity)
    _stored -= capacity
    block = blocks.pop()
    if not blocks:
        del _shelf[capacity]
    return block


def empty(count: int, dtype: npt.DTypeLike = np.float32) -> Array:
    """A flat array of undefined contents that starts at a cache line."""
    dtype = np.dtype(dtype)
    size = count * dtype.itemsize
    if size < SMALL:
        return _at_line(size).view(dtype)
    block = _block(_capacity(size))
    # frombuffer: an array that others refer to as their base, so that the block is free after all of them
    array = np.frombuffer(block.data, dtype, count)
    loan = _Loan(array, _give_back)
    loan.block = block
    _loans[id(loan)] = loan
    return array


def empties(*wanted: tuple[int, type[np.generic]]) -> list[Array]:
    """Several flat arrays, of counts and types, that are given back together: one loan is cheaper than many."""
    sizes = [-(-count * np.dtype(kind).itemsize // LINE) * LINE for count, kind in wanted]
    block, arrays, first = empty(sum(sizes), np.uint8), [], 0
    for (count, kind), size in zip(wanted, sizes, strict=True):
        arrays.append(block[first : first + size].view(kind)[:count])
        first += size
    return arrays


def zeros(count: int) -> Array:
    """The same, filled with zeros."""
    array = empty(count)
    array.fill(0)
    return array


def pair(*shape: int) -> tuple[Tensor, Array]:
    """A float32 tensor of undefined contents, and the same memory as a flat array."""
    count = 1
    for extent in shape:
        count *= extent
    array = empty(count)
    return torch.from_numpy(array.reshape(shape)), array
