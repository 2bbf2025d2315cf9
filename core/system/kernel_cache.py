# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiles functions with numba on their first call, and caches the machine code on disk for the next start.

The cache lies in a folder of the user, so that the package itself may be read-only; the environment variable
FIT_FLARE_CACHE names another folder. The folder's last part is a fingerprint. It covers all sources beside the function
and those whose constants the machine code contains, since numba detects changes only in the function's own file. It
also covers the package's full name, which numba stores and which differs inside Blender.
"""
from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

PROGRAM = Path(__file__).resolve().parents[1]
"""Folder of the package `core`."""
CONSTANT_PACKAGES = ("conventions", "colour")
"""Packages whose constants kernels contain, beside those of the package above the kernels."""


def compile_cached(function: Callable[..., Any], **options: Any) -> Any:
    """Return a dispatcher that compiles `function` without the interpreter's lock, by numba's `options`."""
    folder = cache_folder(function.__module__.rpartition(".")[0], Path(function.__code__.co_filename).parent)
    config: Any = numba.config  # numba reads the folder here, when a function is declared
    default_folder, config.CACHE_DIR = config.CACHE_DIR, str(folder)
    try:
        dispatcher = numba.njit(nogil=True, cache=True, **options)(function)
    finally:
        config.CACHE_DIR = default_folder
    if hasattr(dispatcher, "_cache"):  # missing where NUMBA_DISABLE_JIT is set
        dispatcher._cache.save_overload = _ignore_os_errors(dispatcher._cache.save_overload)
    return dispatcher


@functools.cache
def cache_folder(package: str, sources: Path) -> Path:
    """Return a folder that only this user can write to, since machine code is loaded from it; a temporary folder of
    this process if there is none. package: full name; sources: the folder of its modules."""
    try:
        folder = Path(os.environ.get("FIT_FLARE_CACHE") or _user_folder()) / "kernels" / _fingerprint(package, sources)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        return _temporary_folder()
    return folder if os.access(folder, os.W_OK) else _temporary_folder()


def _user_folder() -> Path:
    """Return the platform's folder for caches."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = str(Path.home() / "Library" / "Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "fit_flare"


def _fingerprint(package: str, sources: Path) -> str:
    """Return a hash of numba's version, the package's name, its sources and those of its constants."""
    # The machine code names the modules it came from, and the tree may be imported under several names.
    digest = hashlib.sha256(f"{numba.__version__} {package}".encode())
    for folder in (sources, sources.parent, *(PROGRAM / name for name in CONSTANT_PACKAGES)):
        for source in sorted(folder.glob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _temporary_folder() -> Path:
    """Return a new folder, deleted at the end of the process."""
    folder = tempfile.mkdtemp(prefix="fit_flare_")
    atexit.register(shutil.rmtree, folder, True)
    return Path(folder)


def _ignore_os_errors(save: Callable[..., None]) -> Callable[..., None]:
    """Wrap `save` so that a full or unwritable disk only means compiling again at the next start."""

    def save_if_possible(*arguments: Any) -> None:
        with contextlib.suppress(OSError):
            save(*arguments)

    return save_if_possible
