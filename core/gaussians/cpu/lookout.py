# SPDX-License-Identifier: GPL-3.0-or-later
"""How threads wait for each other for a moment, without the interpreter (see `threads`)."""
from __future__ import annotations

from .compilation import kernel
from .vector import announce, glance


@kernel
def look_out_after(done, number, counter, turns):
    """Gives the word that call `number` is done, and says whether the counter leaves 0 before long."""
    announce(done, number)
    while turns > 0 and glance(counter) == 0:
        turns -= 1
    return turns > 0


@kernel
def look_for(done, number, turns):
    """Whether a worker says before long that call `number` is done."""
    while turns > 0 and glance(done) != number:
        turns -= 1
    return turns > 0
