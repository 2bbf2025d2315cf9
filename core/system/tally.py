# SPDX-License-Identifier: GPL-3.0-or-later
"""Counts the files or frames that a command used and those that it left out, for the last line of the command.

Readers and jobs fill a `Tally`; the command prints `Tally.summary` last and puts `Tally.as_result` into its result.
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from .file_names import natural_key

MAX_NAMES = 3
"""Number of names that the summary spells out for each reason."""
MAX_REASONS = 4
"""Number of reasons that the summary spells out."""
MAX_RESULT_NAMES = 1000
"""Number of names in the result for other programs."""


@dataclass
class Tally:
    """Number of used items, and the names of the items left out, by reason.

    noun: name of one item, such as "frame" or "plate". verb: past participle of what was done with the used items.
    """

    noun: str = "frame"
    verb: str = "used"
    used: int = 0
    skipped: dict[str, list[str]] = field(default_factory=dict)
    """Names by reason; the reason is a clause without subject, such as "has no pose"."""

    def use(self, number: int = 1) -> None:
        """Count used items."""
        self.used += number

    def skip(self, reason: str, *names: str) -> None:
        """Record items that are left out; a name is recorded once per reason."""
        if names:
            recorded = self.skipped.setdefault(reason, [])
            recorded += [name for name in dict.fromkeys(names) if name not in set(recorded)]

    def merge(self, skipped: Iterable[tuple[str, Iterable[str]]]) -> None:
        """Record items that another part left out, by reason."""
        for reason, names in skipped:
            self.skip(reason, *names)

    @property
    def left_out(self) -> int:
        """Number of items that are left out."""
        return len({name for names in self.skipped.values() for name in names})

    def summary(self) -> str:
        """Return one sentence for the user: the two counts, and the first names of each reason.

        "14 frames used; 5 left out: 10.heic, 11.heic, 12.heic and 1 more (HEIC needs pillow-heif), cut.mov (a video)."
        """
        start = f"{self.used} {self.noun}{'' if self.used == 1 else 's'} {self.verb}"
        if not self.skipped:
            return f"{start}, none left out."
        reasons = sorted(self.skipped.items(), key=lambda item: -len(item[1]))
        parts = [f"{list_first(names)} ({reason})" for reason, names in reasons[:MAX_REASONS]]
        more_names = len({name for _, names in reasons[MAX_REASONS:] for name in names})
        more_text = f", and {more_names} for other reasons" if more_names else ""
        return f"{start}; {self.left_out} left out: {', '.join(parts)}{more_text}."

    def as_result(self) -> dict[str, Any]:
        """Return the counts and the names with their reasons, JSON-able, for the result of a command."""
        names = [{"name": name, "reason": reason} for reason, names in self.skipped.items()
                 for name in sorted(names, key=natural_key)]
        return {"used": self.used, "left_out": self.left_out, "skipped": names[:MAX_RESULT_NAMES]}


def list_first(names: list[str]) -> str:
    """Return the first names in natural order, and how many more there are."""
    ordered = sorted(names, key=natural_key)
    more = len(ordered) - MAX_NAMES
    return ", ".join(ordered[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")
