# SPDX-License-Identifier: GPL-3.0-or-later
"""Spin-waits of the threads for each other, in machine code, without the interpreter (see `threads`)."""
from __future__ import annotations

from .compilation import kernel
from .vector import load_acquire, store_release


@kernel
def finish_and_spin(done, number, counter, spins):
    """Says that call `number` is done, then whether the next call's counter leaves 0 within so many looks at it."""
    store_release(done, number)
    while spins > 0 and load_acquire(counter) == 0:
        spins -= 1
    return spins > 0


@kernel
def spin_until(done, number, spins):
    """Whether a worker says within so many looks that call `number` is done."""
    while spins > 0 and load_acquire(done) != number:
        spins -= 1
    return spins > 0
