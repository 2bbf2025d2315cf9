# SPDX-License-Identifier: GPL-3.0-or-later
"""The store of computed offsets in core.look.network."""
from __future__ import annotations

import numpy as np

from core.look.network import _OffsetsCache


def test_offsets_are_computed_once_until_the_store_is_full() -> None:
    """The entry that was not used for longest is dropped."""
    cache, computed = _OffsetsCache(3 * 40), []

    def offsets(number: int) -> float:
        def compute() -> np.ndarray:
            computed.append(number)
            return np.full(10, number, np.float32)

        return float(cache.get((0, bytes([number])), compute)[0])

    assert [offsets(number) for number in (1, 2, 3, 1, 4, 1, 2)] == [1, 2, 3, 1, 4, 1, 2]
    assert computed == [1, 2, 3, 4, 2]
    assert cache.get((1, bytes([1])), lambda: np.zeros(10, np.float32))[0] == 0, "of another network"


def test_an_entry_larger_than_the_store_is_returned_and_not_kept() -> None:
    cache = _OffsetsCache(8)
    assert cache.get((0, b""), lambda: np.ones(10, np.float32)).sum() == 10
    assert cache.get((0, b""), lambda: np.zeros(10, np.float32)).sum() == 0
