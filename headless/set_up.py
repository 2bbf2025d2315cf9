# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the engine: `python headless/set_up.py FOLDER` makes a virtual environment there and fills it.

The add-on runs it with Blender's own Python; it needs nothing but the standard library. The packages are those of
the group "engine" in pyproject.toml, at the versions of constraints.txt. Events go to standard output, one JSON
object a line (core/system/progress.py). A folder that a stopped set-up left is made anew.
"""
from __future__ import annotations

import contextlib
import glob
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
WINDOWS = os.name == "nt"
OLDEST_MACOS = 14  # that the wheels of torch and pycolmap in constraints.txt are made for
ATTEMPTS = 20  # a tenth of a second apart
TEST = "import cv2, numpy, torch, numba, OpenEXR, pycolmap"  # OpenCV before COLMAP, as in core/capture/solve


class Step(NamedTuple):
    """begins: what is told of it. fails: what is told where it does not end well, with why."""

    begins: str
    command: list[str]
    fails: str


def say(**event: object) -> None:
    print(json.dumps(event), flush=True)


def packages() -> list[str]:
    """Names of the engine's packages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return list(project["dependency-groups"]["engine"])


def python_in(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if WINDOWS else "bin/python")


def run(command: list[str]) -> str:
    """Run a command whose words go to the log, what it loads to the events too; "" where it ended well, else what it
    said was wrong."""
    last, unreached = "", False
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          text=True, errors="replace") as process:
        assert process.stdout is not None
        try:
            with _ended_by_file(process):
                for line in process.stdout:
                    print(line, end="", file=sys.stderr, flush=True)
                    if line.strip().startswith(("Downloading ", "Installing collected")):
                        say(type="say", text=line.strip()[:120])  # torch takes minutes
                    unreached |= "Retrying (" in line  # what pip makes of that in the end speaks of versions
                    if not last.startswith("ERROR:"):
                        last = line.strip() or last
        except BaseException:
            process.kill()
            raise
    if not process.returncode:
        return ""
    if unreached:
        return "the network could not be reached"
    return last.removeprefix("ERROR:").strip(" .")[:200] or f"status {process.returncode}"


@contextlib.contextmanager
def _ended_by_file(process: subprocess.Popen[str]) -> Iterator[None]:
    """End the process when the file that FIT_FLARE_STOP names is there (core/system/progress.py), and raise
    KeyboardInterrupt: on Windows the panel has no signal for it."""
    named, ended = os.environ.get("FIT_FLARE_STOP"), threading.Event()
    if not named:
        yield
        return
    file = Path(named)

    def look() -> None:
        while not ended.wait(0.3):
            if file.exists():
                process.kill()
                return

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()
    if file.exists():
        raise KeyboardInterrupt


def unsuitable() -> str:
    """Why torch cannot be had for this machine, as a sentence; "" where it can."""
    if sys.platform != "darwin":
        return ""
    if platform.machine() != "arm64":
        return "The engine needs torch, which is made no more for Macs with Intel processors; use another computer."
    version = platform.mac_ver()[0]
    if version and int(version.partition(".")[0]) < OLDEST_MACOS:
        return f"The engine needs macOS {OLDEST_MACOS} or later, and this is {version}; update the system."
    return ""


def base() -> str | None:
    """The Python to make the environment with: this one, else one on the PATH, that has what `venv` needs; a Blender of
    a Linux distribution often comes without. None where there is none."""
    ask = "import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))"
    places = [sys.executable, *(shutil.which(f"python3.{minor}") for minor in (13, 12, 11)), shutil.which("python3")]
    for python in filter(None, places):
        if subprocess.run([python, "-I", "-c", ask], capture_output=True, check=False).returncode == 0:
            return python
    return None


def cleared(folder: Path) -> bool:
    """Whether the folder is gone: as a whole, since nothing of an old engine may be left in a new one. It stays where
    Windows has a file of it in use for long. (core/system/files.py has the like, which may not be imported here.)"""
    for left in folder.parent.glob(f"{glob.escape(folder.name)}.old-*"):  # what was in use when it was removed
        shutil.rmtree(left, ignore_errors=True)
    old = folder.with_name(f"{folder.name}.old-{os.getpid()}")
    for _ in range(ATTEMPTS):
        if not folder.exists():
            break
        try:
            folder.rename(old)
        except OSError:  # a process of it that has just ended is held for a moment
            time.sleep(0.1)
    shutil.rmtree(old, ignore_errors=True)
    return not folder.exists()


def discard(folder: Path) -> None:
    """As far as that goes: a half of an engine would count as one."""
    if not cleared(folder):
        shutil.rmtree(folder, ignore_errors=True)


def placing(maker: str, folder: Path) -> Step:
    """A virtual environment, made by the Python `maker`."""
    return Step("Making a place for the engine", [maker, "-m", "venv", str(folder)],
                "The virtual environment for the engine could not be made ({why}); look at the log, check the free "
                "disk space, and set up again.")


def installing(folder: Path, package: str) -> Step:
    """Of a package by its name, or by its wheel's file."""
    pip = [str(python_in(folder)), "-m", "pip", "install", "--disable-pip-version-check", "--no-input",
           "--only-binary", ":all:"]  # building one takes a compiler, which an artist has not
    constraints = ROOT / "constraints.txt"
    if constraints.is_file():
        pip += ["-c", str(constraints)]
    return Step(f"Installing {package}", [*pip, package],
                f"{package} could not be installed ({{why}}); look at the log, check the network and the free disk "
                "space, and set up again.")


def testing(folder: Path) -> Step:
    """Everything is there: does it load?"""
    cure = "install the Microsoft Visual C++ Redistributable (vc_redist.x64)" if WINDOWS else "look at the log"
    return Step("Testing the engine", [str(python_in(folder)), "-c", TEST],
                f"The engine was installed, and cannot be loaded ({{why}}); {cure}, and set up again.")


def main(words: list[str]) -> int:
    if not words:
        print(__doc__, file=sys.stderr)
        return 2
    folder, wanted = Path(words[0]), words[1:] or packages()
    if not words[1:] and unsuitable():
        say(type="error", text=unsuitable())
        return 1
    maker = base()
    if maker is None:
        say(type="error", text=f"{sys.executable} has no ensurepip to make an environment with (Debian keeps it in "
                               "python3-venv); install it, or name a Python that has torch in the field Engine.")
        return 1
    if folder.exists() and not (folder / "pyvenv.cfg").is_file() and (not folder.is_dir() or any(folder.iterdir())):
        say(type="error", text=f"{folder} is there and is no virtual environment; name another folder, or remove it.")
        return 1
    steps = [placing(maker, folder), *(installing(folder, name) for name in wanted)]
    if not words[1:]:
        steps.append(testing(folder))
    say(type="stage", name="set up", total=len(steps), done=0)
    if not cleared(folder):
        say(type="error", text=f"The engine in {folder} is in use; close other Blenders and programs that work with "
                               "it, and set up again.")
        return 1
    for number, step in enumerate(steps):
        say(type="say", text=step.begins)
        try:
            why = run(step.command)
        except KeyboardInterrupt:
            discard(folder)
            raise
        if why:
            discard(folder)
            say(type="error", text=step.fails.replace("{why}", why))
            return 1
        say(type="progress", stage="set up", done=number + 1, total=len(steps), left_s=None, figures={})
    say(type="result", data={"engine": str(python_in(folder))})
    return 0


if __name__ == "__main__":
    # Where Blender was started in the background of a script it ignores SIGINT, and what it starts would too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGBREAK"):
        signal.signal(signal.SIGBREAK, signal.default_int_handler)
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        say(type="error", text="Stopped during set up as asked; set up again to go on.")
        sys.exit(130)
