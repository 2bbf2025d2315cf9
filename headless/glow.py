# SPDX-License-Identifier: GPL-3.0-or-later
"""--keep-glow and --all-glow: whether the glow around lights is removed (`core.removal.inference.remover.Glow`)."""
from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..core.removal.inference.remover import Glow


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the two options, which exclude each other."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--keep-glow", action="store_true", help="keep the glow around the lights")
    group.add_argument("--all-glow", action="store_true",
                       help="remove all glow, as a fit needs it (default: lamps at night keep a part of theirs, as a "
                            "clean lens would show it)")


def glow_mode(args: argparse.Namespace) -> Glow:
    """Return the remover's setting; lamps keep a part of their glow without either option."""
    return "keep" if args.keep_glow else "remove" if args.all_glow else "keep at lights"


def is_set(args: argparse.Namespace) -> bool:
    """Return whether one of the two options was given."""
    return bool(args.keep_glow or args.all_glow)
