# SPDX-License-Identifier: GPL-3.0-or-later
"""Options and final report of the commands that write EXR layers: `bake` and `transfer`."""
from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.conventions.frame_numbers import NumberedFrame
from ..core.errors import SettingsError
from ..core.system.progress import Progress
from ..core.system.tally import Tally

if TYPE_CHECKING:
    from ..core.bake.bake import BakeSettings


def add_options(parser: argparse.ArgumentParser | argparse._ArgumentGroup, *, edits: str, half: str,
                producer: str) -> None:
    """Add the options of edits, bit depth, colour space and overwriting.

    edits: help text of --set. half: when floats have 16 bit. producer: the command whose layers --overwrite replaces.
    """
    parser.add_argument("--set", action="append", default=[], metavar="LIGHT.WHAT=VALUE", dest="edit_texts", help=edits)
    parser.add_argument("--edits", type=Path, metavar="FILE", dest="keyed_edits",
                        help='edits by frame (JSON or TOML): {"frames": {"1": ["lamp.intensity=0"], '
                             '"25": ["lamp.intensity=1"]}}')
    parser.add_argument("--float", action="store_true", help=f"write 32 bit floats (default: 16 bit, {half})")
    parser.add_argument("--overwrite", action="store_true",
                        help=f"replace layers of another {producer} in DIR (complete files with the same settings are "
                             "kept)")
    parser.add_argument("--space", default="linear", metavar="NAME",
                        help="linear colour space of the layers: linear (Rec. 709, the default), acescg, aces2065-1, "
                             "rec2020, p3-d65, or one of an OpenColorIO configuration")
    parser.add_argument("--ocio", metavar="CONFIG",
                        help="OpenColorIO configuration that defines NAME (default: the variable OCIO)")


def bake_settings(args: argparse.Namespace, width: int | None = None, height: int | None = None) -> BakeSettings:
    """Return the settings of the layers from the options. Raises SettingsError."""
    from ..core.bake.bake import BakeSettings
    from ..core.look import KeyedEdits

    return BakeSettings(width, height, half=not args.float, edits=tuple(args.edit_texts),
                        keyed=KeyedEdits.read(args.keyed_edits) if args.keyed_edits else KeyedEdits(), space=args.space,
                        config=args.ocio)


def parse_size(text: str | None) -> tuple[int | None, int | None]:
    """Parse "960x540" as (960, 540), "960" as (960, None), and None as (None, None). Raises SettingsError."""
    if text is None:
        return None, None
    match = re.fullmatch(r"([1-9]\d{0,4})(?:x([1-9]\d{0,4}))?", text)
    if not match:
        raise SettingsError(f"--size {text} is not a width such as 960, or a size such as 960x540.")
    return int(match[1]), int(match[2]) if match[2] else None


def report_layers(frames: Sequence[NumberedFrame], folder: Path, total: int, progress: Progress,
                  skipped: Iterable[tuple[str, Iterable[str]]] = ()) -> dict[str, object]:
    """Report that the layers of `frames` are in a folder of `total` frames, and how many inputs were left out; return
    the command's result.

    skipped: names of what was left out, by reason.
    """
    total_note = "" if total == len(frames) else f", which holds {total}"
    progress.say(f"Layers of {len(frames)} frame{'s' * (len(frames) != 1)} are in {folder}{total_note}.")
    tally = Tally("frame", "rendered", len(frames))
    tally.merge(skipped)
    progress.say(tally.summary())
    return {"layers": str(folder), "frames": len(frames), "frames_in_folder": total, **tally.as_result()}


def empty_result(folder: Path) -> dict[str, object]:
    """Return the result of a task of a farm whose frames do not exist; the folder is not touched."""
    return {"layers": str(folder), "frames": 0}
