# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds, installs and tests the engine, the Python with torch, and starts its commands in a process of their own.

`fits` and `shots` start their work through `run`; the preferences set the engine up, test and remove it.
"""
from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..core.errors import EngineError, FitFlareError
from ..core.system.files import remove_folder, write_text
from ..core.system.processes import child_environment, find_python
from . import jobs, weights
from .jobs import Job
from .user_settings import check_online_access, configured_path, user_folder

ROOT = Path(__file__).resolve().parents[1]
RUN_SCRIPT = ROOT / "headless" / "run.py"
ENGINE_FOLDER = "engine"
ENGINE_VARIABLE = "FIT_FLARE_ENGINE"
TESTED_FILE = "python.txt"  # holds the path of the Python that was tested last


def engine_folder() -> Path:
    """Return the folder of the engine that Set Up Engine installs.

    On Windows it is not in Blender's user folder, whose long path would push torch's files over the limit of 260
    characters.
    """
    local = os.environ.get("LOCALAPPDATA")
    if os.name != "nt" or not local:
        return user_folder(ENGINE_FOLDER)
    return Path(local, "fit_flare", "{}.{}".format(*bpy.app.version))


def virtual_environment() -> Path:
    """Return the virtual environment that Set Up Engine makes; it may not exist yet."""
    return engine_folder() / "python"


def configured_engine() -> tuple[str, str]:
    """Return the source and the path of a configured engine: FIT_FLARE_ENGINE, else the preferences, else ("", "")."""
    return configured_path(ENGINE_VARIABLE, "engine")


def find_engine() -> Path | None:
    """Return the engine's Python: the configured one, else the installed one, else .venv in the extension's source.

    None where there is none. It only looks at the disk and starts no Python, so that a panel can call it at each
    redraw; unlike the commands it does not test for torch.
    """
    _, path = configured_engine()
    if path:
        return find_python(Path(path).expanduser())
    for folder in (virtual_environment(), ROOT / ".venv"):
        python = find_python(folder)
        if python is not None:
            return python
    return None


def missing_reason() -> str:
    """Return why there is no engine and what to do, without a full stop; "" where there is one."""
    if find_engine() is not None:
        return ""
    source, path = configured_engine()
    if path:
        return f"The engine named by {source} is missing: {path}. Name a Python that has torch, or name none"
    return "No engine is set up. Open the preferences of Fit Flare and set one up, or name a Python that has torch"


def command(*args: object) -> list[str]:
    """Return the command line of a run.py command in the engine. Raises EngineError where there is no engine."""
    python = find_engine()
    if python is None:
        raise EngineError(f"{missing_reason()}.")
    return [str(python), str(RUN_SCRIPT), *map(str, args), "--progress", "json"]


def run(kind: str, folder: Path, args: Sequence[object]) -> Job:
    """Start a command of run.py whose events go to `folder`; see `jobs.start_job`."""
    return jobs.start_job(kind, folder, command(*args), {**child_environment(), **weights.environment()}, args=args)


def run_without_engine(kind: str, folder: Path, args: Sequence[object]) -> Job:
    """Start a command of run.py that needs numpy alone in Blender's own Python; see `jobs.start_job`."""
    command_line = [sys.executable, *bpy.app.python_args, str(RUN_SCRIPT), *map(str, args), "--progress", "json"]
    return jobs.start_job(kind, folder, command_line, child_environment(), args=args)


# ---- test, set-up and removal ------------------------------------------------------------------------------------


def test_engine() -> Job:
    """Start the command `engine`; the job's result has version, python, torch and device."""
    folder = user_folder("test", create=True)
    write_text(folder / TESTED_FILE, str(find_engine()))
    return run("test", folder, ["engine"])


def last_test() -> Job | None:
    """Return the last test, if it tested the engine that is used now."""
    folder, python = user_folder("test"), find_engine()
    try:
        is_current = python is not None and (folder / TESTED_FILE).read_text(encoding="utf-8") == str(python)
    except (OSError, ValueError):
        return None
    return jobs.find_job(folder) if is_current else None


def set_up_engine() -> Job:
    """Install the engine into a virtual environment in `engine_folder`, and the weights where they are offered.

    Raises EngineError where Blender's online access is off, or where a damaged earlier engine cannot be removed.
    """
    check_online_access("set up")
    if is_set_up() and not (virtual_environment() / "pyvenv.cfg").is_file():  # damaged
        _remove_environment(virtual_environment())
    command_line = [*weights.SET_UP, str(virtual_environment()), *weights.download_args()]
    return jobs.start_job("set up", engine_folder(), command_line, child_environment())


def is_set_up() -> bool:
    """Return whether Set Up Engine has installed an engine."""
    return virtual_environment().is_dir()


def set_up_job() -> Job | None:
    """Return the job of the current or last set-up; None without one."""
    return jobs.find_job(engine_folder())


def remove_engine() -> None:
    """Remove the installed engine. Raises FitFlareError while a job runs, EngineError where a file is in use."""
    if any(job.running for job in jobs.running()):
        raise FitFlareError("The engine is running; wait for it, or cancel it before you remove it.")
    folder = engine_folder()
    _remove_environment(folder)
    jobs.stop_watching(folder)


def _remove_environment(folder: Path) -> None:
    """Remove the folder of an engine. Raises EngineError where a file of it is in use."""
    try:
        remove_folder(folder)
    except OSError as problem:
        raise EngineError(f"The engine in {folder} is in use or cannot be removed ({problem.strerror or problem}); "
                          "close other Blenders and programs that use it, and try again.") from problem
