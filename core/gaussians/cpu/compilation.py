# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiler options of the kernels, which `system.kernel_cache` compiles and caches."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

from ...system.kernel_cache import compile_cached

OPTIONS: dict[str, Any] = {
    # Division by zero gives infinity; products and sums may fuse; nothing is reordered.
    "error_model": "numpy",
    "fastmath": {"contract", "nsz"},
    # Without reference counts, which would cost more than some loops do: kernels allocate nothing.
    "_nrt": False,
}


def kernel(function: Callable[..., Any]) -> Any:
    """Declare a function that Python calls; it runs without the interpreter's lock."""
    return compile_cached(function, **OPTIONS)


def inlined(function: Callable[..., Any]) -> Any:
    """Declare a function that is inlined into the kernels that call it."""
    options: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(**options, **OPTIONS)(function)
