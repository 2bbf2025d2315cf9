# SPDX-License-Identifier: GPL-3.0-or-later
"""--keep-glare and --all-glare: what becomes of the glow round lights (`core.removal.inference.remover.Glow`)."""
from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..core.removal.inference.remover import Glow


def add_options(parser: argparse.ArgumentParser) -> None:
    """Of the two, one at most."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--keep-glare", action="store_true", help="leave the glow round the lights")
    either.add_argument("--all-glare", action="store_true",
                        help="take all of it, as a fit wants it; without this lamps at night keep a part, as a clean "
                             "lens has it")


def asked(words: argparse.Namespace) -> Glow:
    """What is asked for; where nothing is, lamps keep theirs."""
    return "kept" if words.keep_glare else "taken" if words.all_glare else "kept at lamps"


def is_asked(words: argparse.Namespace) -> bool:
    """Whether one of the two was given."""
    return bool(words.keep_glare or words.all_glare)
