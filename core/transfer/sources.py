# SPDX-License-Identifier: GPL-3.0-or-later
"""Which light of a look each light of the target shows."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..errors import SettingsError


def assigned(targets: Sequence[str], sources: Sequence[str], wanted: Mapping[str, str] | None = None) -> dict[str, str]:
    """Source by target: as `wanted`, else the source of the same name, else the sources in turn.

    Raises SettingsError where `wanted` names a light that is not there, or the look has none.
    """
    wanted = wanted or {}
    if not sources:
        raise SettingsError("The flare has no lights; choose another.")
    for target, source in wanted.items():
        if target not in targets:
            raise SettingsError(f"The target has no light {target!r}; it has {', '.join(targets) or 'none'}.")
        if source not in sources:
            raise SettingsError(f"The flare has no light {source!r}; it has {', '.join(sources)}.")
    chosen: dict[str, str] = {}
    turn = 0
    for target in targets:
        if target in wanted:
            chosen[target] = wanted[target]
        elif target in sources:
            chosen[target] = target
        else:
            chosen[target] = sources[turn % len(sources)]
            turn += 1
    return chosen


def parsed(words: Sequence[str]) -> dict[str, str]:
    """"target=source" as pairs. Raises SettingsError."""
    pairs = {}
    for word in words:
        target, equals, source = word.partition("=")
        if not equals or not target.strip() or not source.strip():
            raise SettingsError(f"{word!r} is not of the form light-of-the-target=light-of-the-flare.")
        pairs[target.strip()] = source.strip()
    return pairs
