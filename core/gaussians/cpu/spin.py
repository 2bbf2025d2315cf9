# SPDX-License-Identifier: GPL-3.0-or-later
"""Spin-waits between threads, in machine code, without the interpreter's lock (see `threads`)."""
from __future__ import annotations

from .compilation import kernel
from .vector import load_acquire, store_release


@kernel
def finish_and_spin(done, number, counter, spins):
    """Publish that call `number` is done; return whether the next call's counter leaves 0 within `spins` reads."""
    store_release(done, number)
    while spins > 0 and load_acquire(counter) == 0:
        spins -= 1
    return spins > 0


@kernel
def spin_until(done, number, spins):
    """Return whether a worker publishes within `spins` reads that call `number` is done."""
    while spins > 0 and load_acquire(done) != number:
        spins -= 1
    return spins > 0
