# SPDX-License-Identifier: GPL-3.0-or-later
"""Some of many, where looking at all would take too long."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


def thinned(items: Sequence[T], number: int) -> Sequence[T]:
    """About so many of them, evenly: fewer than twice as many."""
    return items[:: max(len(items) // number, 1)]
