# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiles kernels on their first call and keeps the machine code on disk for the next start.

The folder is one of the user's own, so that the package itself may be read-only; the environment variable
FIT_FLARE_CACHE names another. Its last part is a fingerprint of all sources of this package, since numba looks
for changes only in the file that a kernel stands in, not in those that it calls; and of the package's full name,
which is another inside Blender, and which numba stores.
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
    """Where this platform keeps what can be computed again."""
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
    """A folder that can be written to, by this user only: machine code is loaded from it. Where there is none,
    one for this process alone."""
    try:
        folder = Path(os.environ.get("FIT_FLARE_CACHE") or _user_folder()) / "kernels" / _fingerprint()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # of a user without a home
        return _own_folder()
    return folder if os.access(folder, os.W_OK) else _own_folder()


def _own_folder() -> Path:
    """Of this process alone, gone with it."""
    folder = tempfile.mkdtemp(prefix="fit_flare_")
    atexit.register(shutil.rmtree, folder, True)
    return Path(folder)


CACHE_FOLDER = _cache_folder()


def kernel(function: Callable[..., Any]) -> Any:
    """A function called from Python; runs without the interpreter's lock."""
    config: Any = numba.config  # numba asks for the folder here, when a function is declared
    before, config.CACHE_DIR = config.CACHE_DIR, str(CACHE_FOLDER)
    try:
        made = numba.njit(nogil=True, cache=True, **OPTIONS)(function)
    finally:
        config.CACHE_DIR = before
    if hasattr(made, "_cache"):  # not where numba is told to compile nothing
        made._cache.save_overload = _where_there_is_room(made._cache.save_overload)
    return made


def _where_there_is_room(save: Callable[..., None]) -> Callable[..., None]:
    """A folder that is full, or that the system refuses, costs the next start its time, not this one its work."""
    def saved(*words: Any) -> None:
        with contextlib.suppress(OSError):
            save(*words)

    return saved


def inlined(function: Callable[..., Any]) -> Any:
    """A part of a kernel, with a name of its own and no cost."""
    options: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(**options, **OPTIONS)(function)
