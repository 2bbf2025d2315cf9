# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: reads the words, runs the command's steps where they belong, ends with one sentence.

Status: 0 done; 1 it could not be done, and one sentence says why; 2 the words made no sense; 130 stopped.
"""
from __future__ import annotations

import argparse
import contextlib
import errno
import io
import os
import sys
import textwrap
import traceback
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn, TextIO

from ..core.errors import Cancelled, EngineError, FitFlareError, SettingsError, is_out_of_memory, refusal
from ..core.system.processes import DONE, FAILED, MISUSED, STOPPED, WINDOWS
from ..core.system.progress import JsonProgress, OpenJdProgress, Progress, TerminalProgress, flush_or_drop, stoppable
from . import hand_off
from .command import AfterAStop, Command, Step
from .commands import COMMANDS

_HINTS: dict[AfterAStop, str] = {
    "goes on": "Give the command again to go on.",
    "goes on with --resume": "Give the command again with --resume to go on.",
    "starts over": "Given again, it starts over.",
}

_DESCRIPTION = """\
Takes lens flares out of footage, learns them, and gives them back as layers.

  python headless/run.py COMMAND …
  blender -b -P headless/run.py -- COMMAND …"""

_EPILOGUE = """\
Status at the end: 0 done; 1 it could not be done, the last line says why; 2 the words made no sense; 130 stopped.
`COMMAND --help` tells more."""


class _Parser(argparse.ArgumentParser):
    """Options by their whole names alone: a part of one may be two options' in the next version, and is none to those
    who read words before this does."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        raise SettingsError(f"{message[0].upper()}{message[1:]} (see {self.prog} --help).")


def parser() -> argparse.ArgumentParser:
    """The parser of all commands, their options and the options that all share."""
    shared = _Parser(add_help=False)
    options = shared.add_argument_group("how it runs")
    options.add_argument("--progress", choices=("terminal", "json", "openjd"), default="terminal",
                         help="json: one JSON object a line on standard output, for programs that watch; openjd: "
                              "lines of the Open Job Description, for farms")
    options.add_argument("--engine", metavar="PYTHON",
                         help="the Python with torch, or the folder of its virtual environment (else this one where "
                              "it has torch, FIT_FLARE_ENGINE, from Blender the add-on's preferences and what its Set "
                              "Up Engine has made, .venv in the repository)")
    options.add_argument("--blender", metavar="PROGRAM",
                         help="the Blender for the steps that need one (else FIT_FLARE_BLENDER, the bpy package of "
                              "this Python, `blender` on the PATH, the system's usual places)")
    options.add_argument("--step", help=argparse.SUPPRESS)
    whole = _Parser(prog="run.py", description=_DESCRIPTION, epilog=f"{_after_a_stop()}\n{_EPILOGUE}",
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = whole.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS.values():
        one = commands.add_parser(command.name, parents=[shared], help=command.summary,
                                  description=f"{command.summary}\n\n{command.description}",
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
        command.arguments(one)
    return whole


def _after_a_stop() -> str:
    """What commands do that are given again after Ctrl-C."""
    ways = {way: [name for name, command in COMMANDS.items() if command.after_a_stop == way] for way in _HINTS}
    text = "; ".join(f"{', '.join(names)} {way.replace('goes', 'go')}" for way, names in ways.items()
                     if names and way != "starts over")
    return textwrap.fill(f"Stopped (Ctrl-C) and given again, {text}; the others start over.", 110)


def main(words: Sequence[str]) -> int:
    """Run the command that `words` ask for; returns the status the process should end with.

    An option with nothing behind its "=" counts as not given: the templates of farms cannot leave one out.
    """
    words = [word for word in words if not (word.startswith("--") and word.find("=") == len(word) - 1)]
    try:
        if words:
            with _progress(words) as progress:
                status = _status(words, progress)
        else:
            parser().print_help(sys.stderr)
            status = MISUSED
        flush_or_drop(sys.stdout)
        flush_or_drop(sys.stderr)
        return status
    except OSError:  # whoever listened has gone
        return FAILED


def _status(words: Sequence[str], progress: Progress) -> int:
    arguments = argparse.Namespace(words=list(words))
    try:
        if "" in words:
            raise SettingsError("One of the words is empty; leave it out, or name what it is to be.")
        arguments = parser().parse_args(words, arguments)
        with stoppable(progress):
            result = _run(COMMANDS[arguments.command], arguments, words, progress)
        progress.close()
        progress.result(**result)
        return DONE
    except SystemExit as end:  # --help
        return int(end.code or 0)
    except SettingsError as problem:
        progress.error(str(problem))
        return MISUSED
    except (Cancelled, KeyboardInterrupt) as stop:
        command = COMMANDS.get(getattr(arguments, "command", ""))
        hint = f" {_HINTS[command.after_a_stop]}" if command and isinstance(progress, TerminalProgress) else ""
        progress.error(f"{str(stop) or 'Stopped.'}{hint}")
        return STOPPED
    except FitFlareError as problem:
        progress.error(str(problem))
        return FAILED
    except BrokenPipeError:
        raise
    except OSError as problem:
        progress.error(refusal(problem))
        return FAILED
    except Exception as problem:
        looped = problem.__context__
        if isinstance(problem, RuntimeError) and isinstance(looped, OSError) and looped.errno == errno.ELOOP:
            progress.error(refusal(looped))  # as pathlib tells it before Python 3.13
            return FAILED
        if is_out_of_memory(problem):
            progress.error(f"It does not fit into the memory of this machine; {_memory_spared(arguments)}.")
            return FAILED
        traceback.print_exc()
        progress.error(f"A defect of Fit Flare, please report it: {type(problem).__name__}: {problem}.")
        return FAILED


def _memory_spared(arguments: argparse.Namespace) -> str:
    """What takes less memory, of what this command has."""
    ways = [way for option, way in (("size", "a smaller --size"), ("jobs", "fewer --jobs"),
                                    ("processes", "fewer --processes")) if hasattr(arguments, option)]
    return f"use {', or '.join(ways)}" if ways else "end other programs, or take a larger machine"


@contextlib.contextmanager
def _progress(words: Sequence[str]) -> Iterator[Progress]:
    """By --progress alone, read before the rest so that misuse is told in the same manner."""
    told = " ".join(words).replace("--progress=", "--progress ").split("--progress ")[1:]
    kind = told[-1].split(" ")[0] if told else ""
    if kind != "json" or "--help" in words:
        if kind == "openjd" and isinstance(sys.stdout, io.TextIOWrapper):  # read as UTF-8 by farms on every system
            sys.stdout.reconfigure(encoding="utf-8", errors="replace")
        progress: Progress = OpenJdProgress() if kind == "openjd" else TerminalProgress()
        try:
            yield progress
        finally:
            progress.close()
        return
    # Blender and libraries print as they like: standard output is for events alone, the rest goes to errors.
    with _pointed_at(2) as events, contextlib.redirect_stdout(sys.stderr):
        yield JsonProgress(events)


@contextlib.contextmanager
def _pointed_at(target: int) -> Iterator[TextIO]:
    """Point standard output at another file descriptor for a while; gives a stream to where it was."""
    sys.stdout.flush()
    before = os.dup(1)
    os.dup2(target, 1)
    try:
        with os.fdopen(os.dup(before), "w", encoding="utf-8") as stream:
            yield stream
            flush_or_drop(stream)
    finally:
        flush_or_drop(sys.stdout)
        os.dup2(before, 1)
        os.close(before)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence standard output, where Blender writes many lines a frame."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        with _pointed_at(nowhere):
            yield
    finally:
        os.close(nowhere)


@contextlib.contextmanager
def _torch_loaded() -> Iterator[None]:
    """Raises EngineError where torch is there and does not load: on Windows that is an OSError, as of a disk."""
    try:
        yield
    except OSError as problem:
        if not any(frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") == "torch"
                   for frame, _ in traceback.walk_tb(problem.__traceback__)):
            raise
        cure = "install the Microsoft Visual C++ Redistributable (vc_redist.x64) or " if WINDOWS else ""
        raise EngineError(f"torch of {sys.executable} cannot be loaded ({problem.strerror or problem}); {cure}"
                          "set the engine up anew.") from problem


def _run(command: Command, arguments: argparse.Namespace, words: Sequence[str], progress: Progress) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for step in command.steps:
        if arguments.step in (None, step.name) and step.wanted(arguments):
            result.update(_run_step(step, arguments, words, progress))
    return result


def _run_step(step: Step, arguments: argparse.Namespace, words: Sequence[str], progress: Progress) -> dict[str, Any]:
    if arguments.step and step.side == "blender" and "bpy" not in sys.modules:
        try:
            __import__("bpy")  # this process was started for it, in a Python that has Blender as a module
        except ImportError as problem:
            raise EngineError(f"Blender's module cannot be loaded here ({problem}). On Linux it wants libraries of "
                              "X11, on a server too: install what is named (see README.md), or name a Blender with "
                              "--blender.") from problem
    elsewhere = step.side == "engine" and arguments.engine is not None and not arguments.step
    if hand_off.here() == step.side and not elsewhere:
        with _quiet() if step.side == "blender" else _torch_loaded():
            return step.run(arguments, progress)
    if arguments.step:
        raise EngineError(f"The step {step.name} was handed to {sys.executable}, which has no {step.side} either.")
    try:
        there = (hand_off.engine_command(arguments.engine) if step.side == "engine"
                 else hand_off.blender_command(arguments.blender))
    except EngineError as problem:
        if not step.optional:
            raise
        progress.say(f"Left out: {step.name}. {problem}")
        return {}
    return hand_off.run_there(there, words, step.name, progress)
