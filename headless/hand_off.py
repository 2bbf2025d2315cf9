# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a step in another process: an engine step in a Python with torch, a Blender step in a Blender.

torch never enters a process that has bpy. The child is this same program with `--step NAME --progress json`. Its events
are forwarded as this process's own, stop signals are forwarded to it, and it always ends before this process does.
"""
from __future__ import annotations

import contextlib
import importlib.util
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from ..core.errors import Cancelled, EngineError
from ..core.system.processes import DONE, WINDOWS, child_environment, find_python
from ..core.system.progress import Progress, is_hangup, stop_signals
from .child import Child, combined_error
from .command import Side

ROOT = Path(__file__).resolve().parents[1]
RUN_SCRIPT = ROOT / "headless" / "run.py"


def current_side() -> Side | None:
    """Return the side of this process: "blender" with bpy loaded, "engine" with torch installed, else None."""
    if "bpy" in sys.modules:
        return "blender"
    return "engine" if importlib.util.find_spec("torch") else None


# ---- finding the engine and Blender ---------------------------------------------------------------


def engine_command(path: str | None) -> list[str]:
    """Return the command line that starts run.py in a Python with torch.

    Searched in this order: `path` (--engine), FIT_FLARE_ENGINE, the add-on's preferences, the engine that its Set Up
    Engine installed, `.venv` in the repository or beside it. Raises EngineError where a named one has no torch, and
    where none is found.
    """
    for source, place in (("--engine", path), ("FIT_FLARE_ENGINE", os.environ.get("FIT_FLARE_ENGINE")),
                          ("the add-on's preferences", _engine_in_preferences())):
        if place:
            python = find_python(Path(place).expanduser())
            if python is None or not _has_torch(python):
                raise EngineError(f"The engine that {source} names, {place}, is not a Python with torch; "
                                  "install the engine there or name another.")
            return [str(python), str(RUN_SCRIPT)]
    for folder in (*_addon_environments(), ROOT / ".venv", ROOT.parent / ".venv"):
        python = find_python(folder)
        if python is not None and _has_torch(python):
            return [str(python), str(RUN_SCRIPT)]
    if not (ROOT / "Makefile").exists():  # the extension, as Blender installs it
        raise EngineError("This step needs a Python with torch, and none was found: press Set Up Engine in the "
                          "add-on's preferences, or name one with --engine or FIT_FLARE_ENGINE.")
    raise EngineError(f"This step needs a Python with torch, and none was found: run `make setup` in {ROOT}, or "
                      "`python -m pip install --group engine -c constraints.txt` there with your own Python, or name "
                      "one with --engine or FIT_FLARE_ENGINE.")


def _engine_in_preferences() -> str:
    """Return the engine that the add-on's preferences name; "" outside Blender."""
    if "bpy" not in sys.modules:
        return ""
    from ..flare_addon.user_settings import engine_path

    return engine_path()


def _addon_environments() -> list[Path]:
    """Return the environment that the add-on's Set Up Engine installs; none outside Blender."""
    if "bpy" not in sys.modules:
        return []
    from ..flare_addon import engine

    return [engine.virtual_environment()]


def _has_torch(python: Path) -> bool:
    """Return whether a Python has torch, without loading it."""
    code = "import importlib.util, sys; sys.exit(importlib.util.find_spec('torch') is None)"
    try:
        return subprocess.run([str(python), "-I", "-c", code], env=child_environment(), capture_output=True,
                              timeout=60, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def blender_command(program: str | None) -> list[str]:
    """Return the command line that starts run.py in a Blender.

    Searched in this order: `program` (--blender) and FIT_FLARE_BLENDER, each a program or a whole command line; Blender
    as a module of this Python; `blender` on the PATH; the system's usual places. Raises EngineError where a named one
    is not a program, and where none is found.
    """
    script = ["-b", "--factory-startup", "-P", str(RUN_SCRIPT), "--"]
    for source, text in (("--blender", program), ("FIT_FLARE_BLENDER", os.environ.get("FIT_FLARE_BLENDER"))):
        if text:
            command = _split_command_line(text)
            if not command or not shutil.which(command[0]):
                raise EngineError(f"The Blender that {source} names, {text}, is not a program; name another.")
            return [*command, *script]
    if importlib.util.find_spec("bpy"):
        return [sys.executable, str(RUN_SCRIPT)]
    for path in (shutil.which("blender"), *_default_locations()):
        if path and Path(path).is_file():
            return [path, *script]
    raise EngineError("This step needs Blender, and none was found: name one with --blender or FIT_FLARE_BLENDER, "
                      "or install the bpy package beside the engine.")


def _split_command_line(text: str) -> list[str]:
    """Split a command line, in which paths with spaces are quoted; the path of one program stays whole."""
    if Path(text.strip('"')).is_file():
        return [text.strip('"')]
    try:
        return [argument.strip('"') if WINDOWS else argument for argument in shlex.split(text, posix=not WINDOWS)]
    except ValueError:  # an unclosed quotation mark
        return []


def _default_locations() -> Iterator[str]:
    """Yield the programs where the system's installers put Blender."""
    if sys.platform == "darwin":
        yield "/Applications/Blender.app/Contents/MacOS/Blender"
    elif WINDOWS:
        folder = Path(os.environ.get("PROGRAMFILES", r"C:\Program Files"), "Blender Foundation")
        yield from (str(path) for path in sorted(folder.glob("Blender */blender.exe"), reverse=True))


# ---- running a step in a child --------------------------------------------------------------------


def add_options(argv: Sequence[str], *added: str) -> list[str]:
    """Return `argv` with more options, before the "--" that ends the options."""
    end = argv.index("--") if "--" in argv else len(argv)
    return [*argv[:end], *added, *argv[end:]]


def run_in_child(command: Sequence[str], argv: Sequence[str], step: str, progress: Progress) -> dict[str, Any]:
    """Run one step of the command line `argv` in a child process; return the step's result.

    Raises Cancelled where the child was stopped, SettingsError or FitFlareError with its message where it failed, and
    EngineError where it cannot be started or ends without a message.
    """
    child = Child([*command, *add_options(argv, "--step", step, "--progress", "json")], child_environment())
    try:
        with _forward_signals(child):
            result = _relay_events(child, progress)
    except BaseException:  # this process ends early
        child.interrupt()
        raise
    finally:
        child.wait_or_kill()
    progress.check()
    if child.status != DONE:
        raise combined_error([child], 1, step)
    return result


def _relay_events(child: Child, progress: Progress) -> dict[str, Any]:
    """Forward the child's events to `progress`; return the data of its result event."""
    result: dict[str, Any] = {}
    done = 0
    for event in child.events():
        kind = event.get("type")
        with contextlib.suppress(Cancelled):  # the child stops as well; its events are read to the end
            if kind == "stage":
                done = event["done"]
                progress.stage(event["name"], event["total"], done)
            elif kind == "progress":
                done, done_before = event["done"], done
                progress.advance(done - done_before, **event["figures"])
            elif kind == "say":
                progress.say(event["text"])
            elif kind == "result":
                result.update(event["data"])
    return result


@contextlib.contextmanager
def _forward_signals(child: Child) -> Iterator[None]:
    """Forward stop signals of this process to the child within the block; its own handlers run too.

    The child has its own process group, so the terminal does not send it any.
    """
    previous_handlers = {number: signal.getsignal(number) for number in stop_signals()}
    received: list[int] = []

    def forward(number: int, frame: FrameType | None) -> None:
        # A second stop ends the child at once, and a lost terminal's signal often comes with another.
        if not received or not is_hangup(number):
            child.interrupt()
        received.append(number)
        handler = previous_handlers[number]
        if callable(handler):
            handler(number, frame)

    try:
        for number in previous_handlers:
            signal.signal(number, forward)
    except ValueError:  # only the main thread may set handlers
        yield
        return
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
