# SPDX-License-Identifier: GPL-3.0-or-later
"""Environment variables that numpy and torch read once, when they are imported; each entry point sets them first."""
from __future__ import annotations

import os

VARIABLES = {
    # Threads of torch that wait for work sleep rather than spin: where other programs, or our own kernels, want the
    # cores too, a fit otherwise takes several times as long.
    "OMP_WAIT_POLICY": "PASSIVE",
    # Large tensors lie in large pages where the system (Linux) has them: a training iteration passes over all of its
    # memory, and takes 3 to 4 % less.
    "THP_MEM_ALLOC_ENABLE": "1",
    # numpy's matrix products round by how many threads share them. On one, a frame comes out the same to the last bit
    # whatever part of a machine its task has; they are small, and lose nothing.
    "OPENBLAS_NUM_THREADS": "1",
}


def set_thread_environment() -> None:
    """Set VARIABLES, but none that the user has set. Call before numpy or torch is imported."""
    for name, value in VARIABLES.items():
        os.environ.setdefault(name, value)
