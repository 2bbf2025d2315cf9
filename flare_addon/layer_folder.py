# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder of baked layers as Blender reads it: one numbered sequence of EXR files."""
from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import FrameError
from ..core.pictures import picture_size

_NUMBERED = re.compile(r"(.*?)(\d+)\.exr", re.IGNORECASE)


@dataclass(frozen=True)
class LayerFolder:
    """Frame numbers, in order, and the file of each. Numbers may leave gaps."""

    folder: Path
    files: dict[int, Path]

    @classmethod
    def open(cls, folder: Path | str) -> LayerFolder:
        """Raises FrameError where the folder holds no numbered EXR files, or more than one sequence."""
        folder = Path(folder).resolve()
        sequences: dict[str, dict[int, Path]] = {}
        for path in sorted(folder.glob("*")):
            match = _NUMBERED.fullmatch(path.name)
            if match and not path.name.startswith("."):
                sequences.setdefault(match[1], {})[int(match[2])] = path
        if not sequences:
            raise FrameError(f"{folder} holds no baked layers (files such as layers.0001.exr); bake into it first.")
        if len(sequences) > 1:
            heads = " and ".join(f"{head}*.exr" for head in sorted(sequences)[:2])
            raise FrameError(f"{folder} holds more than one sequence ({heads}); keep each in a folder of its own.")
        files = next(iter(sequences.values()))
        return cls(folder, dict(sorted(files.items())))

    @property
    def first(self) -> int:
        return min(self.files)

    @property
    def last(self) -> int:
        return max(self.files)

    def size(self) -> tuple[int, int]:
        """(width, height) of the first frame, from its header."""
        return picture_size(self.files[self.first])
