# SPDX-License-Identifier: GPL-3.0-or-later
"""One process hands a step to another: the engine's to a Python with torch, Blender's to a Blender.

torch never enters a process that has bpy. The other process is this same program with `--step NAME
--progress json`; its events become this process's own, a stop is passed on, and it is never left behind.
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
from ..core.system.processes import DONE, WINDOWS, environment, python_at
from ..core.system.progress import Progress, is_hangup, stop_signals
from .child import Child, joint_failure
from .command import Side

ROOT = Path(__file__).resolve().parents[1]
RUN = ROOT / "headless" / "run.py"


def here() -> Side | None:
    """The side this process can be; None where it has neither bpy loaded nor torch installed."""
    if "bpy" in sys.modules:
        return "blender"
    return "engine" if importlib.util.find_spec("torch") else None


# ---- who ------------------------------------------------------------------------------------------


def engine_command(named: str | None) -> list[str]:
    """How to start run.py in a Python with torch.

    Looked for in this order: `named` (--engine), FIT_FLARE_ENGINE, the add-on's preferences, what its Set Up Engine
    has made, `.venv` in the repository or beside it. One that is named has to work; EngineError where none does.
    """
    for where, place in (("--engine", named), ("FIT_FLARE_ENGINE", os.environ.get("FIT_FLARE_ENGINE")),
                         ("the add-on's preferences", _engine_in_preferences())):
        if place:
            python = python_at(Path(place).expanduser())
            if python is None or not _has_torch(python):
                raise EngineError(f"The engine that {where} names, {place}, is not a Python with torch; "
                                  "install the engine there or name another.")
            return [str(python), str(RUN)]
    for folder in (*_set_up_by_the_addon(), ROOT / ".venv", ROOT.parent / ".venv"):
        python = python_at(folder)
        if python is not None and _has_torch(python):
            return [str(python), str(RUN)]
    if not (ROOT / "Makefile").exists():  # the extension, as Blender installs it
        raise EngineError("This step needs a Python with torch, and none was found: press Set Up Engine in the "
                          "add-on's preferences, or name one with --engine or FIT_FLARE_ENGINE.")
    raise EngineError(f"This step needs a Python with torch, and none was found: run `make setup` in {ROOT}, or "
                      "`python -m pip install --group engine -c constraints.txt` there with a Python of yours, or name "
                      "one with --engine or FIT_FLARE_ENGINE.")


def _engine_in_preferences() -> str:
    if "bpy" not in sys.modules:
        return ""
    from ..flare_addon.preferences import engine_path

    return engine_path()


def _set_up_by_the_addon() -> list[Path]:
    if "bpy" not in sys.modules:
        return []
    from ..flare_addon import engine

    return [engine.virtual_environment()]


def _has_torch(python: Path) -> bool:
    code = "import importlib.util, sys; sys.exit(importlib.util.find_spec('torch') is None)"
    try:
        return subprocess.run([str(python), "-c", code], env=environment(), capture_output=True,
                              timeout=60, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def blender_command(named: str | None) -> list[str]:
    """How to start run.py in a Blender.

    Looked for in this order: `named` (--blender) and FIT_FLARE_BLENDER, each a program or a whole command
    line; Blender as a module of this Python; `blender` on the PATH; the system's usual places.
    EngineError where there is none.
    """
    script = ["-b", "--factory-startup", "-P", str(RUN), "--"]
    for where, text in (("--blender", named), ("FIT_FLARE_BLENDER", os.environ.get("FIT_FLARE_BLENDER"))):
        if text:
            words = _command_line(text)
            if not words or not shutil.which(words[0]):
                raise EngineError(f"The Blender that {where} names, {text}, is not a program; name another.")
            return [*words, *script]
    if importlib.util.find_spec("bpy"):
        return [sys.executable, str(RUN)]
    for program in (shutil.which("blender"), *_usual_places()):
        if program and Path(program).is_file():
            return [program, *script]
    raise EngineError("This step needs Blender, and none was found: name one with --blender or FIT_FLARE_BLENDER, "
                      "or install the bpy package beside the engine.")


def _command_line(text: str) -> list[str]:
    """The words of a program's path or of a command line; in the latter a path with spaces is quoted."""
    if Path(text.strip('"')).is_file():
        return [text.strip('"')]
    try:
        return [word.strip('"') if WINDOWS else word for word in shlex.split(text, posix=not WINDOWS)]
    except ValueError:  # a quotation mark without its other one
        return []


def _usual_places() -> Iterator[str]:
    if sys.platform == "darwin":
        yield "/Applications/Blender.app/Contents/MacOS/Blender"
    elif WINDOWS:
        folder = Path(os.environ.get("PROGRAMFILES", r"C:\Program Files"), "Blender Foundation")
        yield from (str(path) for path in sorted(folder.glob("Blender */blender.exe"), reverse=True))


# ---- how ------------------------------------------------------------------------------------------


def with_options(words: Sequence[str], *added: str) -> list[str]:
    """The command's words with options more, before the "--" after which there are none."""
    end = words.index("--") if "--" in words else len(words)
    return [*words[:end], *added, *words[end:]]


def run_there(command: Sequence[str], words: Sequence[str], step: str, progress: Progress) -> dict[str, Any]:
    """Run one step of the command `words` in another process and return its result.

    Raises Cancelled when that process was stopped, SettingsError and FitFlareError with its own sentence when it
    failed, and EngineError where it cannot be started or ends without a reason.
    """
    child = Child([*command, *with_options(words, "--step", step, "--progress", "json")], environment())
    try:
        with _stops_passed_on(child):
            result = _relayed(child, progress)
    except BaseException:  # this process is leaving early
        child.interrupt()
        raise
    finally:
        child.end()
    progress.check()
    if child.status != DONE:
        raise joint_failure([child], 1, step)
    return result


def _relayed(child: Child, progress: Progress) -> dict[str, Any]:
    """The child's result, with its other events made this process's own."""
    result: dict[str, Any] = {}
    done = 0
    for event in child.events():
        kind = event.get("type")
        with contextlib.suppress(Cancelled):  # the child has been told too, and is heard to its end
            if kind == "stage":
                done = event["done"]
                progress.stage(event["name"], event["total"], done)
            elif kind == "progress":
                done, before = event["done"], done
                progress.advance(done - before, **event["figures"])
            elif kind == "say":
                progress.say(event["text"])
            elif kind == "result":
                result.update(event["data"])
    return result


@contextlib.contextmanager
def _stops_passed_on(child: Child) -> Iterator[None]:
    """Signals that ask this process to stop reach the child too; it has a process group of its own."""
    before = {number: signal.getsignal(number) for number in stop_signals()}
    told: list[int] = []

    def pass_on(number: int, frame: FrameType | None) -> None:
        # A second stop ends the child at once, and a lost terminal's signal often comes with another.
        if not told or not is_hangup(number):
            child.interrupt()
        told.append(number)
        handler = before[number]
        if callable(handler):
            handler(number, frame)

    try:
        for number in before:
            signal.signal(number, pass_on)
    except ValueError:  # not the main thread, which alone may do this
        yield
        return
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
