# SPDX-License-Identifier: GPL-3.0-or-later
"""Assigns a light of the look to each light of the target."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..errors import SettingsError


def assign_sources(
    targets: Sequence[str], sources: Sequence[str], requested: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return the source of each target: as `requested`, else the source of the same name, else the sources in turn.

    Raises SettingsError if `requested` names an unknown light, or the look has no lights.
    """
    requested = requested or {}
    if not sources:
        raise SettingsError("The flare has no lights; choose another.")
    for target, source in requested.items():
        if target not in targets:
            raise SettingsError(f"The target has no light {target!r}; it has {', '.join(targets) or 'none'}.")
        if source not in sources:
            raise SettingsError(f"The flare has no light {source!r}; it has {', '.join(sources)}.")
    source_by_target: dict[str, str] = {}
    next_source = 0
    for target in targets:
        if target in requested:
            source_by_target[target] = requested[target]
        elif target in sources:
            source_by_target[target] = target
        else:
            source_by_target[target] = sources[next_source % len(sources)]
            next_source += 1
    return source_by_target


def parse_assignments(texts: Sequence[str]) -> dict[str, str]:
    """Parse texts "target=source" to a dictionary. Raises SettingsError."""
    pairs = {}
    for text in texts:
        target, equals, source = text.partition("=")
        if not equals or not target.strip() or not source.strip():
            raise SettingsError(f"{text!r} is not of the form light-of-the-target=light-of-the-flare.")
        pairs[target.strip()] = source.strip()
    return pairs
