# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiles kernels on their first call and caches the machine code on disk for the next start.

The cache lies in a folder of the user, so that the package itself may be read-only; the environment variable
FIT_FLARE_CACHE names another folder. The folder's last part is a fingerprint of all sources of this package, since
numba detects changes only in the file of a kernel and not in the files it calls, and of the package's full name, which
numba stores and which differs inside Blender.
"""
from __future__ import annotations

import atexit
import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

OPTIONS: dict[str, Any] = {
    # Division by zero gives infinity; products and sums may fuse; nothing is reordered.
    "error_model": "numpy",
    "fastmath": {"contract", "nsz"},
    # Without reference counts, which would cost more than some loops do: kernels allocate nothing.
    "_nrt": False,
}


def _user_folder() -> Path:
    """Return the platform's folder for caches."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = str(Path.home() / "Library" / "Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "fit_flare"


def _fingerprint() -> str:
    # The machine code names the modules it came from, and the tree may be imported under several names.
    digest = hashlib.sha256(f"{numba.__version__} {__package__}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Return a folder that only this user can write to, since machine code is loaded from it; a temporary folder of
    this process if there is none."""
    try:
        folder = Path(os.environ.get("FIT_FLARE_CACHE") or _user_folder()) / "kernels" / _fingerprint()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        return _temporary_folder()
    return folder if os.access(folder, os.W_OK) else _temporary_folder()


def _temporary_folder() -> Path:
    """Return a new folder, deleted at the end of the process."""
    folder = tempfile.mkdtemp(prefix="fit_flare_")
    atexit.register(shutil.rmtree, folder, True)
    return Path(folder)


CACHE_FOLDER = _cache_folder()


def kernel(function: Callable[..., Any]) -> Any:
    """Declare a function that Python calls; it runs without the interpreter's lock."""
    config: Any = numba.config  # numba reads the folder here, when a function is declared
    before, config.CACHE_DIR = config.CACHE_DIR, str(CACHE_FOLDER)
    try:
        dispatcher = numba.njit(nogil=True, cache=True, **OPTIONS)(function)
    finally:
        config.CACHE_DIR = before
    if hasattr(dispatcher, "_cache"):  # missing where NUMBA_DISABLE_JIT is set
        dispatcher._cache.save_overload = _ignore_os_errors(dispatcher._cache.save_overload)
    return dispatcher


def _ignore_os_errors(save: Callable[..., None]) -> Callable[..., None]:
    """Wrap `save` so that a full or unwritable disk only means compiling again at the next start."""

    def save_if_possible(*arguments: Any) -> None:
        with contextlib.suppress(OSError):
            save(*arguments)

    return save_if_possible


def inlined(function: Callable[..., Any]) -> Any:
    """Declare a function that is inlined into the kernels that call it."""
    options: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(**options, **OPTIONS)(function)
