# SPDX-License-Identifier: GPL-3.0-or-later
"""The option --plate-space of the commands that read frames: solve, lights, fit, remove and eval."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ..core.colour import ColourSpace, colour_space
from ..core.errors import SettingsError
from ..core.system.progress import Progress

_MAX_FOLDERS = 4
"""Paths that may be the capture of a plate, from itself upwards: CAPTURE/images/camera/plate.dpx."""


def add_option(parser: argparse.ArgumentParser | argparse._ArgumentGroup, *, ocio: bool = True) -> None:
    """Add --plate-space, and --ocio where the command has none."""
    parser.add_argument("--plate-space", metavar="NAME",
                        help="colour space of the frames, in place of what their files declare: a camera's (logc3, "
                             "logc4, slog3, slog3-cine, vlog, log3g10, clog2, clog3, applelog), acescct, acescg, "
                             "rec709, pq, cineon and others (docs/file_formats.md), or one of an OpenColorIO "
                             "configuration. "
                             "A capture keeps it for later commands; auto removes it")
    if ocio:
        parser.add_argument("--ocio", metavar="CONFIG",
                            help="OpenColorIO configuration that defines NAME (default: the variable OCIO)")


def named_space(args: argparse.Namespace) -> ColourSpace | None:
    """Return the space that the option names; None without it, and for auto. Raises SettingsError."""
    if args.ocio is not None and args.plate_space is None:
        raise SettingsError("--ocio defines the space that --plate-space names; give both, or neither.")
    if args.plate_space is None or args.plate_space == "auto":
        return None
    return colour_space(args.plate_space, args.ocio)


def space_of_plates(args: argparse.Namespace, plates: Sequence[Path], progress: Progress) -> ColourSpace | None:
    """Return the space to read plates in: as the option names it, else as the plates' capture records it. None, also
    with the option "auto", for what the files declare. Reports a recorded space.

    Raises SettingsError where plates belong to captures that keep different spaces, and CaptureError for a damaged
    record.
    """
    from ..core.capture.plate_space import FILE, read_plate_space

    if args.plate_space is not None or args.ocio is not None:
        return named_space(args)
    folders = [_capture_with_space(path, FILE) for path in plates]
    spaces = {folder: None if folder is None else read_plate_space(folder) for folder in folders}
    if len({None if space is None else space.fingerprint for space in spaces.values()}) > 1:
        recorded = next(folder for folder in folders if folder is not None)
        raise SettingsError(f"{recorded / FILE} names the colour space of some of the plates only; clean them in "
                            "separate runs, or name one space with --plate-space.")
    folder, space = next(iter(spaces.items()))
    if folder is not None and space is not None:
        progress.say(f"The plates are read in the colour space {space.name}, which {folder / FILE} names.")
    return space


def _capture_with_space(plate: Path, file: str) -> Path | None:
    """Return the nearest folder, from a plate or a folder of plates upwards, that keeps a colour space; None without
    one."""
    resolved = plate.resolve()
    return next((folder for folder in (resolved, *resolved.parents)[:_MAX_FOLDERS] if (folder / file).is_file()), None)


def record(args: argparse.Namespace, capture: Path) -> None:
    """Record the space that the option names in the capture's folder; leave the record without the option.

    Raises SettingsError and CaptureError.
    """
    from ..core.capture.plate_space import record_plate_space

    named_space(args)
    if args.plate_space is not None:
        record_plate_space(capture, args.plate_space, args.ocio)
