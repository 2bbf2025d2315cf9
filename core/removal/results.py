# SPDX-License-Identifier: GPL-3.0-or-later
"""What a removal writes: over nothing that it reads, nothing twice, and nothing again that is there."""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..errors import SettingsError


def check_apart(sources: Iterable[Path], results: Iterable[Path]) -> None:
    """Raises SettingsError where a result would be written over a source, or two would be the same file."""
    read, written = {path.resolve() for path in sources}, set()
    for path in results:
        whole = path.resolve()
        if whole in read:
            raise SettingsError(f"{path} would be overwritten by a result; choose another folder for the results.")
        if whole in written:
            raise SettingsError(f"Two results would be written to the same file, {path}; choose another folder for "
                                "one kind of them, or take plates that differ by their suffix alone apart.")
        written.add(whole)


def are_newer(results: Iterable[Path], sources: Iterable[Path]) -> bool:
    """Whether all results are there, and none older than a source."""
    results, sources = list(results), list(sources)
    if not all(path.is_file() for path in [*results, *sources]):
        return False
    return min(path.stat().st_mtime for path in results) >= max(path.stat().st_mtime for path in sources)
