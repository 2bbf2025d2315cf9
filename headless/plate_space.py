# SPDX-License-Identifier: GPL-3.0-or-later
"""The option --plate-space of the commands that read frames: solve, lights, fit, remove and eval."""
from __future__ import annotations

import argparse
from pathlib import Path

from ..core.colour import ColourSpace, colour_space
from ..core.errors import SettingsError


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


def record(args: argparse.Namespace, capture: Path) -> None:
    """Record the space that the option names in the capture's folder; leave the record without the option.

    Raises SettingsError and CaptureError.
    """
    from ..core.capture.plate_space import record_plate_space

    named_space(args)
    if args.plate_space is not None:
        record_plate_space(capture, args.plate_space, args.ocio)
