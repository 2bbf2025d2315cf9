# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the engine is, and how its commands are started: a Python with torch, never Blender's own process."""
from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy

from ..core.errors import EngineError, FitFlareError
from ..core.system.files import remove_folder, write_text
from ..core.system.processes import environment, python_at
from . import jobs
from .jobs import Job

ROOT = Path(__file__).resolve().parents[1]
RUN = ROOT / "headless" / "run.py"
PACKAGE = (__package__ or "").rpartition(".")[0]  # "bl_ext.user_default.fit_flare", by which Blender knows it
FOLDER = "engine"
VARIABLE = "FIT_FLARE_ENGINE"
TESTED = "python.txt"  # which Python the last test was of


def user_folder(name: str, create: bool = False) -> Path:
    """A folder of the extension's own, in Blender's user folder."""
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path=name, create=create))
    except (ValueError, AttributeError):  # loaded from source, not installed as an extension
        folder = Path(bpy.utils.user_resource("CONFIG", path="fit_flare", create=create)) / name
        if create:
            folder.mkdir(parents=True, exist_ok=True)
        return folder


def home() -> Path:
    """Where a click sets the engine up. On Windows not in Blender's user folder: its path is so long that those of
    torch's files would have more than the 260 characters that are allowed."""
    local = os.environ.get("LOCALAPPDATA")
    if os.name != "nt" or not local:
        return user_folder(FOLDER)
    return Path(local, "fit_flare", "{}.{}".format(*bpy.app.version))


def virtual_environment() -> Path:
    """What a click sets up; it need not be there."""
    return home() / "python"


def named() -> tuple[str, str]:
    """What names an engine, and which: the variable FIT_FLARE_ENGINE, or else the preferences; of none ("", "")."""
    from .preferences import engine_path

    for who, place in ((VARIABLE, os.environ.get(VARIABLE, "")), ("the preferences", engine_path())):
        if place:
            return who, place
    return "", ""


def find() -> Path | None:
    """The engine's Python: the one that is named, else the one that was set up by a click, or .venv in the extension's
    source, in the order of the commands (headless/hand_off.py). None where there is none.

    A look at the disk, cheap enough for a panel. The commands start what they find, to see whether it has torch, and so
    may take a .venv in the folder above, too, which is anybody's.
    """
    _, place = named()
    if place:
        return python_at(Path(place).expanduser())
    for folder in (virtual_environment(), ROOT / ".venv"):
        python = python_at(folder)
        if python is not None:
            return python
    return None


def missing() -> str:
    """Why there is none, and what to do, without a full stop; "" where there is one."""
    if find() is not None:
        return ""
    who, place = named()
    if place:
        return f"The engine named by {who} is not there: {place}. Name a Python that has torch, or none"
    return "No engine is set up. Open the preferences of Fit Flare and set one up, or name a Python that has it"


def command(*words: object) -> list[str]:
    """A command of run.py as the engine runs it. Raises EngineError where no engine is set up."""
    python = find()
    if python is None:
        raise EngineError(f"{missing()}.")
    return [str(python), str(RUN), *map(str, words), "--progress", "json"]


def run(kind: str, folder: Path, words: Sequence[object]) -> Job:
    """Start a command of run.py whose events go to `folder`; see `jobs.start`."""
    return jobs.start(kind, folder, command(*words), environment(), words=words)


# ---- its state ------------------------------------------------------------------------------------


def test() -> Job:
    """Ask the engine what it is; the answer is the job's result (version, python, torch, device)."""
    folder = user_folder("test", create=True)
    write_text(folder / TESTED, str(find()))
    return run("test", folder, ["engine"])


def tested() -> Job | None:
    """The last test, if it was of the engine that is there now."""
    folder, python = user_folder("test"), find()
    try:
        same = python is not None and (folder / TESTED).read_text(encoding="utf-8") == str(python)
    except (OSError, ValueError):
        return None
    return jobs.find(folder) if same else None


def set_up() -> Job:
    """Make a virtual environment in the extension's own folder and install the engine into it.

    Raises EngineError where Blender's online access is not granted, or what is left of an engine cannot be removed.
    """
    if not bpy.app.online_access:
        raise EngineError("Blender's online access is off; allow it in Preferences > System > Network, then set up.")
    if was_set_up() and not (virtual_environment() / "pyvenv.cfg").is_file():  # half of it was removed
        _clear(virtual_environment())
    script = ROOT / "headless" / "set_up.py"
    words = [sys.executable, *bpy.app.python_args, str(script), str(virtual_environment())]
    return jobs.start("set up", home(), words, environment())


def was_set_up() -> bool:
    """Whether there is one that a click has set up."""
    return virtual_environment().is_dir()


def setting_up() -> Job | None:
    """The set-up that runs or ran."""
    return jobs.find(home())


def remove() -> None:
    """Remove the engine that a click set up. Raises FitFlareError while it works, EngineError where a file of it is in
    use otherwise."""
    if any(job.running for job in jobs.running()):
        raise FitFlareError("The engine is at work; wait for it or cancel it before removing it.")
    folder = home()
    _clear(folder)
    jobs.forget(folder)


def _clear(folder: Path) -> None:
    try:
        remove_folder(folder)
    except OSError as problem:
        raise EngineError(f"The engine in {folder} is in use or cannot be removed ({problem.strerror or problem}); "
                          "close other Blenders and programs that work with it, and try again.") from problem
