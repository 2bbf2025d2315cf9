# SPDX-License-Identifier: GPL-3.0-or-later
"""What the commands that write EXR layers have in common: their options, what those mean, what is told in the end."""
from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.conventions.frame_numbers import Frame
from ..core.errors import SettingsError
from ..core.system.progress import Progress

if TYPE_CHECKING:
    from ..core.bake.bake import BakeSettings


def add_options(parser: argparse.ArgumentParser | argparse._ArgumentGroup, *, edited: str, halfs: str,
                overwritten: str) -> None:
    """Their edits, space, depth, and whether others may go. edited: what --set is of; halfs: when floats have 16 bit;
    overwritten: what other layers in DIR are of."""
    parser.add_argument("--set", action="append", default=[], metavar="LIGHT.WHAT=VALUE", dest="edits", help=edited)
    parser.add_argument("--edits", type=Path, metavar="FILE", dest="keyed",
                        help='edits by frame (JSON or TOML): {"frames": {"1": ["lamp.intensity=0"], '
                             '"25": ["lamp.intensity=1"]}}')
    parser.add_argument("--float", action="store_true", help=f"32 bit floats (default: 16 bit, {halfs})")
    parser.add_argument("--overwrite", action="store_true",
                        help=f"replace layers of another {overwritten} in DIR (whole ones of the same settings are "
                             "kept)")
    parser.add_argument("--space", default="linear", metavar="NAME",
                        help="linear colour space of the layers: linear (Rec. 709, the default), acescg, aces2065-1, "
                             "rec2020, p3-d65, or one of an OpenColorIO configuration")
    parser.add_argument("--ocio", metavar="CONFIG",
                        help="OpenColorIO configuration to look names up in (else the variable OCIO, for other names)")


def settings(words: argparse.Namespace, width: int | None = None, height: int | None = None) -> BakeSettings:
    """Of layers, as the options say. Raises SettingsError."""
    from ..core.bake.bake import BakeSettings
    from ..core.look import KeyedEdits

    return BakeSettings(width, height, half=not words.float, edits=tuple(words.edits),
                        keyed=KeyedEdits.read(words.keyed) if words.keyed else KeyedEdits(), space=words.space,
                        config=words.ocio)


def size(text: str | None) -> tuple[int | None, int | None]:
    """"960x540" as (960, 540), "960" as (960, None), None as (None, None)."""
    if text is None:
        return None, None
    match = re.fullmatch(r"([1-9]\d{0,4})(?:x([1-9]\d{0,4}))?", text)
    if not match:
        raise SettingsError(f"--size {text} is not a width such as 960, or a size such as 960x540.")
    return int(match[1]), int(match[2]) if match[2] else None


def told(frames: Sequence[Frame], folder: Path, of_folder: int, progress: Progress) -> dict[str, object]:
    """Tell that the layers of `frames` are in a folder, which has `of_folder`; what a command's result says of it."""
    besides = "" if of_folder == len(frames) else f", which holds {of_folder}"
    progress.say(f"Layers of {len(frames)} frame{'s' * (len(frames) != 1)} are in {folder}{besides}.")
    return {"layers": str(folder), "frames": len(frames), "frames_in_folder": of_folder}
