# SPDX-License-Identifier: GPL-3.0-or-later
"""Edits by frame, in a JSON or TOML file.

    {"set": ["lamp.tint=1,0.8,0.6"], "frames": {"1": ["lamp.intensity=0"], "25": ["lamp.intensity=1"]}}

"set" applies to every frame, "frames" has keyframes with further edits. Values are interpolated linearly between
keyframes, and constant before the first and after the last.
"""
from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import SettingsError
from ..system.files import read_json, write_json
from ..system.reading import MAX_TOML_BYTES, UTF8_SIG, parse_toml, read_text
from .edits import LookEdits


@dataclass(frozen=True)
class KeyedEdits:
    """always: texts of the edits of every frame. frames: texts of the further edits by keyframe."""

    always: tuple[str, ...] = ()
    frames: Mapping[int, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path | str) -> KeyedEdits:
        """Read a file of edits. Raises SettingsError for a missing or invalid file."""
        data = _read_toml(Path(path)) if Path(path).suffix.lower() == ".toml" else read_json(path, SettingsError)
        try:
            if unknown := set(data) - {"set", "frames"}:
                raise ValueError(f"it has {', '.join(sorted(map(repr, unknown)))}")
            frames: dict[int, tuple[str, ...]] = {}
            for number, texts in data.get("frames", {}).items():
                if not re.fullmatch(r"-?\d{1,9}", number) or int(number) in frames:
                    raise ValueError(f"{number!r} is no frame number, or stands there twice")
                frames[int(number)] = _check_texts(texts)
            return cls(_check_texts(data.get("set", [])), dict(sorted(frames.items())))
        except (AttributeError, TypeError, ValueError) as problem:
            raise SettingsError(f'{path} should read {{"set": ["lamp.intensity=2"], "frames": {{"1": [...]}}}} '
                                f"({problem}).") from problem

    def write(self, path: Path | str) -> None:
        """Write a JSON file for `read`."""
        write_json(path, self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return {"set": list(self.always), "frames": {str(number): list(texts) for number, texts in self.frames.items()}}

    def with_always(self, texts: Sequence[str]) -> KeyedEdits:
        """Return the edits with further texts for every frame."""
        return KeyedEdits((*self.always, *texts), self.frames)

    def edits_at(self, frame: int, lights: Sequence[str],
                 elements: Mapping[str, Sequence[str]] | None = None) -> LookEdits:
        """Return the edits of a frame, interpolated between keyframes.

        lights: known names. elements: known names by light; None accepts any name. Raises SettingsError for an invalid
        edit.
        """
        def parse_keyframe(number: int) -> LookEdits:
            return LookEdits.parse((*self.always, *self.frames[number]), lights, elements)

        if not self.frames:
            return LookEdits.parse(self.always, lights, elements)
        numbers = sorted(self.frames)
        previous = max((number for number in numbers if number <= frame), default=numbers[0])
        following = min((number for number in numbers if number >= frame), default=numbers[-1])
        if previous >= following:  # on a keyframe, before the first or after the last
            return parse_keyframe(previous if previous in (frame, numbers[-1]) else following)
        share = (frame - previous) / (following - previous)
        return parse_keyframe(previous).interpolate(parse_keyframe(following), share)


def _read_toml(path: Path) -> Any:
    """Read a TOML file. Raises SettingsError."""
    try:
        return parse_toml(read_text(path, MAX_TOML_BYTES, UTF8_SIG))
    except OSError as problem:
        raise SettingsError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    except ValueError as problem:
        raise SettingsError(f"{path} is not valid TOML ({problem}); mend it.") from problem


def _check_texts(texts: Any) -> tuple[str, ...]:
    """Return a list of texts as a tuple. Raises ValueError for anything else."""
    if not isinstance(texts, list) or not all(isinstance(word, str) for word in texts):
        raise ValueError("edits are a list of texts")
    return tuple(texts)
