# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: parses the arguments, runs each step of the command in the process that it needs, reports the end.

`headless/run.py` calls `main`. A step that needs the other side (torch or Blender) goes to `hand_off`.
Exit status: 0 done; 1 failed, the last line says why; 2 invalid arguments; 130 stopped.
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

from ..core.errors import Cancelled, EngineError, FitFlareError, SettingsError, is_out_of_memory, os_error_message
from ..core.system.processes import DONE, FAILED, STOPPED, USAGE_ERROR, WINDOWS
from ..core.system.progress import (
    JsonProgress,
    OpenJdProgress,
    Progress,
    TerminalProgress,
    flush_or_drop,
    stop_on_request,
)
from . import hand_off
from .command import Command, ResumeRule, Step
from .commands import COMMANDS

_RESUME_HINTS: dict[ResumeRule, str] = {
    "resumes": "Run the command again to resume.",
    "resumes with --resume": "Run the command again with --resume to resume.",
    "starts over": "Run again, the command starts over.",
}

OPTION_ALIASES = {"--keep-glare": "--keep-glow", "--all-glare": "--all-glow", "--most-lenses": "--max-lenses"}
"""The current name of each renamed option. The old names still work in this version and print the current one."""

_DESCRIPTION = """\
Removes lens flares from footage, learns them, and renders them as layers.

  python headless/run.py COMMAND …
  blender -b -P headless/run.py -- COMMAND …"""

_EPILOGUE = """\
Exit status: 0 done; 1 failed, the last line says why; 2 invalid arguments; 130 stopped.
`COMMAND --help` describes a command."""


class _Parser(argparse.ArgumentParser):
    """Accepts options by their full names only; raises SettingsError for invalid arguments.

    An abbreviation may become ambiguous in the next version, and code that reads argv before the parser misses it.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        raise SettingsError(f"{message[0].upper()}{message[1:]} (see {self.prog} --help).")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands, with their options and the options that all commands share."""
    shared = _Parser(add_help=False)
    options = shared.add_argument_group("general")
    options.add_argument("--progress", choices=("terminal", "json", "openjd"), default="terminal",
                         help="how progress is written (default terminal). json: one JSON object per line on "
                              "standard output, for other programs. openjd: lines of the Open Job Description, for "
                              "render farms")
    options.add_argument("--engine", metavar="PYTHON",
                         help="the Python with torch, or the folder of its virtual environment (default, in this "
                              "order: this Python if it has torch, FIT_FLARE_ENGINE, in Blender the add-on's "
                              "preferences and the engine that Set Up Engine installed, .venv in the repository)")
    options.add_argument("--blender", metavar="PROGRAM",
                         help="the Blender for steps that need one (default, in this order: FIT_FLARE_BLENDER, the bpy "
                              "package of this Python, `blender` on the PATH, the system's usual places)")
    options.add_argument("--step", help=argparse.SUPPRESS)
    parser = _Parser(prog="run.py", description=_DESCRIPTION, epilog=f"{_resume_summary()}\n{_EPILOGUE}",
                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS.values():
        subparser = commands.add_parser(command.name, parents=[shared], help=command.summary,
                                        description=f"{command.summary}\n\n{command.description}",
                                        formatter_class=argparse.RawDescriptionHelpFormatter)
        command.arguments(subparser)
    return parser


def _resume_summary() -> str:
    """Return the sentence of the help that says which commands resume after Ctrl-C."""
    by_rule = {rule: [name for name, command in COMMANDS.items() if command.resume_rule == rule]
               for rule in _RESUME_HINTS}
    text = "; ".join(f"{', '.join(names)} {rule.replace('resumes', 'resume')}" for rule, names in by_rule.items()
                     if names and rule != "starts over")
    return textwrap.fill(f"If you stop a command with Ctrl-C and run it again, {text}. The others start over.", 110,
                         break_on_hyphens=False)


def main(argv: Sequence[str]) -> int:
    """Run the command that `argv` names; return the exit status of the process.

    An option with nothing behind its "=" is ignored, since job templates of farms cannot leave an option out.
    """
    argv = [arg for arg in argv if not (arg.startswith("--") and arg.find("=") == len(arg) - 1)]
    try:
        if argv:
            argv, renamed = _current_options(argv)
            with _open_progress(argv) as progress:
                for old, new in renamed.items():
                    progress.say(f"{old} is now {new}; the old name still works in this version.")
                status = _run_command(argv, progress)
        else:
            build_parser().print_help(sys.stderr)
            status = USAGE_ERROR
        flush_or_drop(sys.stdout)
        flush_or_drop(sys.stderr)
        return status
    except OSError:  # the reader of our output has gone
        return FAILED


def _current_options(argv: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Return `argv` with renamed options by their current names, and the old names that were used with the new ones."""
    end = argv.index("--") if "--" in argv else len(argv)
    current, renamed = list(argv), {}
    for index, arg in enumerate(argv[:end]):
        name, equals, value = arg.partition("=")
        if name in OPTION_ALIASES:
            renamed[name] = OPTION_ALIASES[name]
            current[index] = OPTION_ALIASES[name] + equals + value
    return current, renamed


def _run_command(argv: Sequence[str], progress: Progress) -> int:
    """Run the command that `argv` names, report its result or error, and return the exit status."""
    arguments = argparse.Namespace(argv=list(argv))
    try:
        if "" in argv:
            raise SettingsError("One of the arguments is empty; leave it out, or give it a value.")
        arguments = build_parser().parse_args(argv, arguments)
        with stop_on_request(progress):
            result = _run_steps(COMMANDS[arguments.command], arguments, argv, progress)
        progress.close()
        progress.result(**result)
        return DONE
    except SystemExit as end:  # --help
        return int(end.code or 0)
    except SettingsError as problem:
        progress.error(str(problem))
        return USAGE_ERROR
    except (Cancelled, KeyboardInterrupt) as stop:
        command = COMMANDS.get(getattr(arguments, "command", ""))
        # Other programs, which read JSON, run the command again in a way of their own.
        hint = f" {_RESUME_HINTS[command.resume_rule]}" if command and isinstance(progress, TerminalProgress) else ""
        progress.error(f"{str(stop) or 'Stopped.'}{hint}")
        return STOPPED
    except FitFlareError as problem:
        progress.error(str(problem))
        return FAILED
    except BrokenPipeError:
        raise
    except OSError as problem:
        progress.error(os_error_message(problem))
        return FAILED
    except Exception as problem:
        context = problem.__context__
        if isinstance(problem, RuntimeError) and isinstance(context, OSError) and context.errno == errno.ELOOP:
            progress.error(os_error_message(context))  # a loop of links, as pathlib reports it before Python 3.13
            return FAILED
        if is_out_of_memory(problem):
            progress.error(f"This machine has not enough memory for it; {_memory_advice(arguments)}.")
            return FAILED
        traceback.print_exc()
        progress.error(f"A defect of Fit Flare, please report it: {type(problem).__name__}: {problem}.")
        return FAILED


def _memory_advice(arguments: argparse.Namespace) -> str:
    """Return the advice for a command that ran out of memory, from the options that it has."""
    advice = [text for option, text in (("size", "a smaller --size"), ("jobs", "fewer --jobs"),
                                        ("processes", "fewer --processes")) if hasattr(arguments, option)]
    return f"use {', or '.join(advice)}" if advice else "close other programs, or use a machine with more memory"


@contextlib.contextmanager
def _open_progress(argv: Sequence[str]) -> Iterator[Progress]:
    """Open the progress output that --progress names, before the other arguments are parsed.

    Thus invalid arguments are reported in the chosen format too.
    """
    # As in argparse, the last --progress counts.
    values = " ".join(argv).replace("--progress=", "--progress ").split("--progress ")[1:]
    output_format = values[-1].split(" ")[0] if values else ""
    if output_format != "json" or "--help" in argv:  # the help is text on standard output
        if output_format == "openjd" and isinstance(sys.stdout, io.TextIOWrapper):  # farms read UTF-8 on every system
            sys.stdout.reconfigure(encoding="utf-8", errors="replace")
        progress: Progress = OpenJdProgress() if output_format == "openjd" else TerminalProgress()
        try:
            yield progress
        finally:
            progress.close()
        return
    # Blender and libraries print to standard output, which is for events alone: their text goes to standard error.
    with _redirect_stdout(2) as events, contextlib.redirect_stdout(sys.stderr):
        yield JsonProgress(events)


@contextlib.contextmanager
def _redirect_stdout(target: int) -> Iterator[TextIO]:
    """Point standard output at another file descriptor within the block; yield a stream to the original one."""
    sys.stdout.flush()
    original = os.dup(1)
    os.dup2(target, 1)
    try:
        with os.fdopen(os.dup(original), "w", encoding="utf-8") as stream:
            yield stream
            flush_or_drop(stream)
    finally:
        flush_or_drop(sys.stdout)
        os.dup2(original, 1)
        os.close(original)


@contextlib.contextmanager
def _silence_stdout() -> Iterator[None]:
    """Discard standard output within the block, since Blender writes many lines per frame."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        with _redirect_stdout(nowhere):
            yield
    finally:
        os.close(nowhere)


@contextlib.contextmanager
def _report_torch_load_errors() -> Iterator[None]:
    """Raise EngineError in place of the OSError by which Windows reports that torch cannot be loaded."""
    try:
        yield
    except OSError as problem:
        # Only an error during the import of torch counts: then torch's own module code is on the stack.
        if not any(frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") == "torch"
                   for frame, _ in traceback.walk_tb(problem.__traceback__)):
            raise
        cure = "install the Microsoft Visual C++ Redistributable (vc_redist.x64) or " if WINDOWS else ""
        raise EngineError(f"torch of {sys.executable} cannot be loaded ({problem.strerror or problem}); {cure}"
                          "set the engine up again.") from problem


def _run_steps(command: Command, arguments: argparse.Namespace, argv: Sequence[str],
               progress: Progress) -> dict[str, Any]:
    """Run the steps of a command that these arguments need; return their results in one dictionary.

    `arguments.step`: name of the one step to run, in a child process; None for all.
    """
    result: dict[str, Any] = {}
    for step in command.steps:
        if arguments.step in (None, step.name) and step.is_needed(arguments):
            result.update(_run_step(step, arguments, argv, progress))
    return result


def _run_step(step: Step, arguments: argparse.Namespace, argv: Sequence[str], progress: Progress) -> dict[str, Any]:
    """Run a step here, or in a child process where this one lacks its side; return its result.

    `arguments.step` is set in such a child, which has to run the step itself. An optional step whose side this machine
    lacks is skipped, with result {}.
    """
    if arguments.step and step.side == "blender" and "bpy" not in sys.modules:
        try:
            __import__("bpy")  # this process was started for the step, in a Python that has Blender as a module
        except ImportError as problem:
            raise EngineError(f"Blender's module cannot be loaded here ({problem}). On Linux it needs libraries of "
                              "X11, on a server too: install the one that is missing (see README.md), or name a "
                              "Blender with --blender.") from problem
    # An engine that --engine names is used even where this Python has torch.
    uses_named_engine = step.side == "engine" and arguments.engine is not None and not arguments.step
    if step.side == "any" or (hand_off.current_side() == step.side and not uses_named_engine):
        with _silence_stdout() if step.side == "blender" else _report_torch_load_errors():
            return step.run(arguments, progress)
    if arguments.step:
        raise EngineError(f"The step {step.name} was handed to {sys.executable}, which has no {step.side} either.")
    try:
        command = (hand_off.engine_command(arguments.engine) if step.side == "engine"
                   else hand_off.blender_command(arguments.blender))
    except EngineError as problem:
        if not step.optional:
            raise
        progress.say(f"Skipped: {step.name}. {problem}")
        return {}
    return hand_off.run_in_child(command, argv, step.name, progress)
