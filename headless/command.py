# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of a command: its arguments on the command line, and its steps with the side that each one runs on.

A step of the "engine" side needs torch, one of the "blender" side needs bpy, and no process ever has both (see
`hand_off`). One of the side "any" needs numpy alone and runs where the command was started. Steps pass data on through
files. What a step returns (paths and figures, serialisable as JSON) becomes part of the command's result. The modules
in `commands` build a `Command` each; `cli` runs them.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from ..core.errors import SettingsError
from ..core.system.progress import Progress
from ..core.typed import MAX_SEED

Side = Literal["engine", "blender", "any"]
ResumeRule = Literal["starts over", "resumes", "resumes with --resume"]
StepFunction = Callable[[argparse.Namespace, Progress], dict[str, Any]]


def parse_seed(text: str) -> int:
    """Parse a random seed: a whole number that every library accepts. Raises ArgumentTypeError."""
    if not text.isdecimal() or int(text) > MAX_SEED:
        raise argparse.ArgumentTypeError(f"a seed is a whole number from 0 to {MAX_SEED}, not {text!r}")
    return int(text)


def check_at_least_one(option: str, value: int) -> None:
    """Raise SettingsError where the number of an option is below 1."""
    if value < 1:
        raise SettingsError(f"{option} {value} is out of range; give a whole number of 1 or more.")


def reject_unused_options(args: argparse.Namespace, defaults: Mapping[str, Any], goes_with: str) -> None:
    """Raise SettingsError for an option that would have no effect with these arguments.

    defaults: the default values of such options, by their names in `args`. goes_with: the option or input that they
    need.
    """
    for name, default in defaults.items():
        if getattr(args, name) != default:
            raise SettingsError(f"--{name.replace('_', '-')} is only for {goes_with}; leave it out.")


@dataclass(frozen=True)
class Step:
    """One step of a command. optional: skipped, with a message, on a machine that lacks its side. is_needed: whether
    these arguments require the step."""

    name: str
    side: Side
    run: StepFunction
    optional: bool = False
    is_needed: Callable[[argparse.Namespace], bool] = lambda _args: True


@dataclass(frozen=True)
class Command:
    """One command. summary: its line in the list of commands. description: the text of its own help. arguments: adds
    its options to a parser. resume_rule: what it does when it is run again after a stop."""

    name: str
    summary: str
    description: str
    arguments: Callable[[argparse.ArgumentParser], None]
    steps: tuple[Step, ...]
    resume_rule: ResumeRule = "starts over"
