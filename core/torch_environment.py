# SPDX-License-Identifier: GPL-3.0-or-later
"""The environment variables that torch reads once, when it is loaded."""
from __future__ import annotations

import os


def prepare_for_torch() -> None:
    """Before torch is imported. What the user has set stays.

    Threads of torch that wait for work sleep rather than spin: where other programs, or our own kernels, want the cores
    too, a fit otherwise takes several times as long. And large tensors lie in large pages where the system (Linux) has
    them: a training iteration passes over all of its memory, and takes 3 to 4 % less.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
