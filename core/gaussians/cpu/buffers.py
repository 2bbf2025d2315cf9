# SPDX-License-Identifier: GPL-3.0-or-later
"""A pool of memory blocks for the kernels' arrays.

Each iteration allocates the same large arrays. Memory fresh from the system costs a fault for each page, which takes
longer than the kernels take to fill it. So a block returns to the pool when the last array or tensor that refers to it
is freed, and serves the next request of about its size.
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

CACHE_LINE = 64
"""Bytes of a cache line, to which arrays are aligned."""
MIN_POOLED_BYTES = 1 << 15
"""Size in bytes from which arrays come from the pool; smaller ones come from the system."""
MAX_FREE_BYTES = 1 << 30
"""Bound of the bytes in the pool; the blocks that were unused for longest are freed first."""

_free_blocks: OrderedDict[int, list[Array]] = OrderedDict()
_references: dict[int, _BlockReference] = {}
_free_bytes = 0


class _BlockReference(weakref.ref[Array]):
    """A weak reference to an array, which returns the array's block to the pool when the array is freed."""

    __slots__ = ("block",)
    block: Array


def _release(reference: weakref.ref[Array]) -> None:
    """Return the block of a freed array to the pool, and free the oldest blocks above MAX_FREE_BYTES."""
    global _free_bytes
    assert isinstance(reference, _BlockReference)
    del _references[id(reference)]
    size = reference.block.size
    _free_blocks.setdefault(size, []).append(reference.block)
    _free_blocks.move_to_end(size)
    _free_bytes += size
    while _free_bytes > MAX_FREE_BYTES:
        oldest_size, blocks = next(iter(_free_blocks.items()))
        blocks.pop()
        _free_bytes -= oldest_size
        if not blocks:
            del _free_blocks[oldest_size]


def _capacity(size: int) -> int:
    """Round a size in bytes up to one of 8 sizes per power of two."""
    step = 1 << (size.bit_length() - 4)
    return -(-size // step) * step


def _allocate_aligned(size: int) -> Array:
    """Return uninitialised bytes of this size that start at a cache line."""
    array = np.empty(size + CACHE_LINE, np.uint8)
    padding = -array.__array_interface__["data"][0] % CACHE_LINE
    return array[padding : padding + size]


def _take_block(capacity: int) -> Array:
    """Return a block of this capacity, bytes, from the pool, or a new one."""
    global _free_bytes
    blocks = _free_blocks.get(capacity)
    if not blocks:
        return _allocate_aligned(capacity)
    _free_bytes -= capacity
    block = blocks.pop()
    if not blocks:
        del _free_blocks[capacity]
    return block


def empty(count: int, dtype: npt.DTypeLike = np.float32) -> Array:
    """Return a flat, uninitialised array that starts at a cache line."""
    dtype = np.dtype(dtype)
    size = count * dtype.itemsize
    if size < MIN_POOLED_BYTES:
        return _allocate_aligned(size).view(dtype)
    block = _take_block(_capacity(size))
    # frombuffer: views refer to this array as their base, so the block is released after all of them
    array = np.frombuffer(block.data, dtype, count)
    reference = _BlockReference(array, _release)
    reference.block = block
    _references[id(reference)] = reference
    return array


def empty_many(*requests: tuple[int, type[np.generic]]) -> list[Array]:
    """Return several flat, uninitialised arrays of (count, type) in one block: one reference is cheaper than many."""
    sizes = [-(-count * np.dtype(dtype).itemsize // CACHE_LINE) * CACHE_LINE for count, dtype in requests]
    block, arrays, offset = empty(sum(sizes), np.uint8), [], 0
    for (count, dtype), size in zip(requests, sizes, strict=True):
        arrays.append(block[offset : offset + size].view(dtype)[:count])
        offset += size
    return arrays


def zeros(count: int) -> Array:
    """Return a flat float32 array of zeros that starts at a cache line."""
    array = empty(count)
    array.fill(0)
    return array


def tensor_and_array(*shape: int) -> tuple[Tensor, Array]:
    """Return an uninitialised float32 tensor, and the same memory as a flat array."""
    count = 1
    for extent in shape:
        count *= extent
    array = empty(count)
    return torch.from_numpy(array.reshape(shape)), array
