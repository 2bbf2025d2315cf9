# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the engine: `python headless/set_up.py FOLDER` makes a virtual environment there and fills it.

The add-on runs it with Blender's own Python, so it uses the standard library alone. The packages are the group
"engine" of pyproject.toml, at the versions in constraints.txt. Events go to standard output, one JSON object per line
(core/system/progress.py). Every Python is started isolated (-I), so that none imports a module from the folder in
which it happens to start. An environment in FOLDER, also one that a stopped set-up left, is replaced.
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
MIN_MACOS = 14  # required by the wheels of torch and pycolmap in constraints.txt
RENAME_ATTEMPTS = 20  # 0.1 s apart
IMPORT_TEST = "import cv2, numpy, torch, numba, OpenEXR, pycolmap"  # OpenCV before COLMAP, as in core/capture/solve


class Step(NamedTuple):
    """One command of the set-up. message: reported at its start. failure: reported where it fails; {why} in it is
    replaced by the reason."""

    message: str
    command: list[str]
    failure: str


def emit(**event: object) -> None:
    """Write one event to standard output."""
    print(json.dumps(event), flush=True)


def engine_packages() -> list[str]:
    """Return the names of the engine's packages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return list(project["dependency-groups"]["engine"])


def environment_python(folder: Path) -> Path:
    """Return the interpreter of the virtual environment in `folder`."""
    return folder / ("Scripts/python.exe" if WINDOWS else "bin/python")


def run_logged(command: list[str]) -> str:
    """Run a command; return "" on success, else the reason of the failure.

    Its output goes to the log, and the lines that name a download also to the events.
    """
    last, unreached = "", False
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          text=True, errors="replace") as process:
        assert process.stdout is not None
        try:
            with _killed_by_stop_file(process):
                for line in process.stdout:
                    print(line, end="", file=sys.stderr, flush=True)
                    if line.strip().startswith(("Downloading ", "Installing collected")):
                        emit(type="say", text=line.strip()[:120])  # torch takes minutes
                    unreached |= "Retrying (" in line  # pip's last line then speaks of versions
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
def _killed_by_stop_file(process: subprocess.Popen[str]) -> Iterator[None]:
    """Kill the process when the file that FIT_FLARE_STOP names appears (core/system/progress.py); raise
    KeyboardInterrupt then. On Windows the panel cannot send a signal."""
    stop_file, ended = os.environ.get("FIT_FLARE_STOP"), threading.Event()
    if not stop_file:
        yield
        return
    file = Path(stop_file)

    def watch() -> None:
        while not ended.wait(0.3):
            if file.exists():
                process.kill()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()
    if file.exists():
        raise KeyboardInterrupt


def unsupported_reason() -> str:
    """Return why torch has no build for this machine, as a sentence; "" where it has one."""
    if sys.platform != "darwin":
        return ""
    if platform.machine() != "arm64":
        return "The engine needs torch, which no longer supports Macs with Intel processors; use another computer."
    version = platform.mac_ver()[0]
    if version and int(version.partition(".")[0]) < MIN_MACOS:
        return f"The engine needs macOS {MIN_MACOS} or later, and this is {version}; update the system."
    return ""


def find_base_python() -> str | None:
    """Return the Python that makes the environment: this one, else one on the PATH that has `ensurepip`; None without.

    The Blender of a Linux distribution often lacks it.
    """
    check = "import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))"
    candidates = [sys.executable, *(shutil.which(f"python3.{minor}") for minor in (13, 12, 11)),
                  shutil.which("python3")]
    for python in filter(None, candidates):
        if subprocess.run([python, "-I", "-c", check], capture_output=True, check=False).returncode == 0:
            return python
    return None


def remove_environment(folder: Path) -> bool:
    """Remove the folder as a whole; return whether it is gone. It stays where Windows keeps a file of it in use.

    core/system/files.py has a similar function, which cannot be imported here.
    """
    for stale in folder.parent.glob(f"{glob.escape(folder.name)}.old-*"):  # was in use at an earlier removal
        shutil.rmtree(stale, ignore_errors=True)
    old = folder.with_name(f"{folder.name}.old-{os.getpid()}")
    for _ in range(RENAME_ATTEMPTS):
        if not folder.exists():
            break
        try:
            folder.rename(old)
        except OSError:  # Windows holds the files of a process that has just ended
            time.sleep(0.1)
    shutil.rmtree(old, ignore_errors=True)
    return not folder.exists()


def discard_environment(folder: Path) -> None:
    """Remove the folder, or as much of it as possible: a partial engine would be taken for a complete one."""
    if not remove_environment(folder):
        shutil.rmtree(folder, ignore_errors=True)


def venv_step(base: str, folder: Path) -> Step:
    """Return the step that makes a virtual environment with the Python `base`."""
    return Step("Making the virtual environment", [base, "-I", "-m", "venv", str(folder)],
                "The virtual environment for the engine could not be made ({why}); look at the log, check the free "
                "disk space, and set up again.")


def install_step(folder: Path, package: str) -> Step:
    """Return the step that installs a package, named by its name or the file of its wheel."""
    pip = [str(environment_python(folder)), "-I", "-m", "pip", "install", "--disable-pip-version-check", "--no-input",
           "--only-binary", ":all:"]  # building one needs a compiler
    constraints = ROOT / "constraints.txt"
    if constraints.is_file():
        pip += ["-c", str(constraints)]
    return Step(f"Installing {package}", [*pip, package],
                f"{package} could not be installed ({{why}}); look at the log, check the network and the free disk "
                "space, and set up again.")


def test_step(folder: Path) -> Step:
    """Return the step that imports every package of the engine."""
    cure = "install the Microsoft Visual C++ Redistributable (vc_redist.x64)" if WINDOWS else "look at the log"
    return Step("Testing the engine", [str(environment_python(folder)), "-I", "-c", IMPORT_TEST],
                f"The engine was installed but cannot be loaded ({{why}}); {cure}, and set up again.")


def main(argv: list[str]) -> int:
    """Set the engine up in the folder argv[0], with the packages of the rest or all; return the exit status."""
    if not argv:
        print(__doc__, file=sys.stderr)
        return 2
    folder, names = Path(argv[0]), argv[1:] or engine_packages()
    if not argv[1:] and unsupported_reason():
        emit(type="error", text=unsupported_reason())
        return 1
    base = find_base_python()
    if base is None:
        emit(type="error", text=f"{sys.executable} has no ensurepip to make an environment with (Debian keeps it in "
                               "python3-venv); install it, or name a Python that has torch in the field Engine.")
        return 1
    if folder.exists() and not (folder / "pyvenv.cfg").is_file() and (not folder.is_dir() or any(folder.iterdir())):
        emit(type="error",
             text=f"{folder} exists and is not a virtual environment; choose another folder, or remove it.")
        return 1
    steps = [venv_step(base, folder), *(install_step(folder, name) for name in names)]
    if not argv[1:]:
        steps.append(test_step(folder))
    emit(type="stage", name="set up", total=len(steps), done=0)
    if not remove_environment(folder):
        emit(type="error", text=f"The engine in {folder} is in use; close other Blenders and programs that use it, "
                               "and set up again.")
        return 1
    for number, step in enumerate(steps):
        emit(type="say", text=step.message)
        try:
            why = run_logged(step.command)
        except KeyboardInterrupt:
            discard_environment(folder)
            raise
        if why:
            discard_environment(folder)
            emit(type="error", text=step.failure.replace("{why}", why))
            return 1
        emit(type="progress", stage="set up", done=number + 1, total=len(steps), eta_s=None, figures={})
    emit(type="result", data={"engine": str(environment_python(folder))})
    return 0


if __name__ == "__main__":
    # A Blender that a script started in the background ignores SIGINT, and its child processes inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGBREAK"):
        signal.signal(signal.SIGBREAK, signal.default_int_handler)
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        emit(type="error", text="Stopped during the set-up; set up again to start over.")
        sys.exit(130)
