# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits that change from frame to frame, in a small JSON or TOML file.

    {"set": ["lamp.tint=1,0.8,0.6"], "frames": {"1": ["lamp.intensity=0"], "25": ["lamp.intensity=1"]}}

"set" holds for every frame; "frames" gives more for some of them. Between two frames that are given,
numbers run in straight lines; before the first and after the last they stay.
"""
from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import SettingsError
from ..system.files import WRITTEN_BY_HAND, read_json, write_json
from .edits import LookEdits


@dataclass(frozen=True)
class KeyedEdits:
    """always: words that hold for every frame. frames: by frame number, words added to them there."""

    always: tuple[str, ...] = ()
    frames: Mapping[int, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path | str) -> KeyedEdits:
        """Raises SettingsError where the file is missing, damaged or of another form."""
        data = _toml(Path(path)) if Path(path).suffix.lower() == ".toml" else read_json(path, SettingsError)
        try:
            if strange := set(data) - {"set", "frames"}:
                raise ValueError(f"it has {', '.join(sorted(map(repr, strange)))}")
            frames: dict[int, tuple[str, ...]] = {}
            for number, words in data.get("frames", {}).items():
                if not re.fullmatch(r"-?\d{1,9}", number) or int(number) in frames:
                    raise ValueError(f"{number!r} is no frame number, or stands there twice")
                frames[int(number)] = _words(words)
            return cls(_words(data.get("set", [])), dict(sorted(frames.items())))
        except (AttributeError, TypeError, ValueError) as problem:
            raise SettingsError(f'{path} should read {{"set": ["lamp.intensity=2"], "frames": {{"1": [...]}}}} '
                                f"({problem}).") from problem

    def write(self, path: Path | str) -> None:
        """Write what `read` reads."""
        write_json(path, self.described())

    def described(self) -> dict[str, Any]:
        """JSON-able."""
        return {"set": list(self.always), "frames": {str(number): list(words) for number, words in self.frames.items()}}

    def and_always(self, words: Sequence[str]) -> KeyedEdits:
        """These and words that hold for every frame."""
        return KeyedEdits((*self.always, *words), self.frames)

    def at(self, frame: int, lights: Sequence[str], elements: Mapping[str, Sequence[str]] | None = None) -> LookEdits:
        """The edits of a frame; see `LookEdits.parse` for the rest."""
        def parsed(number: int) -> LookEdits:
            return LookEdits.parse((*self.always, *self.frames[number]), lights, elements)

        if not self.frames:
            return LookEdits.parse(self.always, lights, elements)
        numbers = sorted(self.frames)
        before = max((number for number in numbers if number <= frame), default=numbers[0])
        after = min((number for number in numbers if number >= frame), default=numbers[-1])
        if before >= after:
            return parsed(before if before in (frame, numbers[-1]) else after)
        return parsed(before).towards(parsed(after), (frame - before) / (after - before))


def _toml(path: Path) -> Any:
    try:
        return tomllib.loads(path.read_text(encoding=WRITTEN_BY_HAND))
    except OSError as problem:
        raise SettingsError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    except ValueError as problem:
        raise SettingsError(f"{path} is not valid TOML ({problem}); mend it.") from problem


def _words(words: Any) -> tuple[str, ...]:
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise ValueError("edits are a list of texts")
    return tuple(words)
