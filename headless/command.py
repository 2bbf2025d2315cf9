# SPDX-License-Identifier: GPL-3.0-or-later
"""What a command is: its words on the command line, and its steps with the side each one runs on.

A step of the "engine" side needs torch, one of the "blender" side needs bpy, and no process ever has
both: see `hand_off`. Steps hand results on through files; what a step returns (paths and figures,
JSON-able) becomes part of the command's result.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from ..core.errors import SettingsError
from ..core.system.progress import Progress
from ..core.typed import MOST_SEED

Side = Literal["engine", "blender"]
AfterAStop = Literal["starts over", "goes on", "goes on with --resume"]
Run = Callable[[argparse.Namespace, Progress], dict[str, Any]]


def seed(text: str) -> int:
    """Of all randomness: a whole number that every library takes."""
    if not text.isdecimal() or int(text) > MOST_SEED:
        raise argparse.ArgumentTypeError(f"a seed is a whole number from 0 to {MOST_SEED}, not {text!r}")
    return int(text)


def from_1(option: str, value: int) -> None:
    """Raises SettingsError for an option's number below 1."""
    if value < 1:
        raise SettingsError(f"{option} {value} makes no sense; give a number from 1.")


def refuse_useless(words: argparse.Namespace, defaults: Mapping[str, Any], goes_with: str) -> None:
    """Raises SettingsError for an option that was given and does nothing: who gives it believes that it does.

    defaults: of such options by their names in `words`, where they are as if not given. goes_with: what they are for.
    """
    for name, usual in defaults.items():
        if getattr(words, name) != usual:
            raise SettingsError(f"--{name.replace('_', '-')} goes with {goes_with}; leave it out.")


@dataclass(frozen=True)
class Step:
    """optional: left out, with a sentence, on a machine that lacks its side. wanted: whether these words ask for it."""

    name: str
    side: Side
    run: Run
    optional: bool = False
    wanted: Callable[[argparse.Namespace], bool] = lambda _words: True


@dataclass(frozen=True)
class Command:
    """summary: one line of the list of commands. description: the head of its own help. after_a_stop: what it does
    when it is given again after it was stopped."""

    name: str
    summary: str
    description: str
    arguments: Callable[[argparse.ArgumentParser], None]
    steps: tuple[Step, ...]
    after_a_stop: AfterAStop = "starts over"
