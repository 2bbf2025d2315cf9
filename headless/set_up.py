# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the engine and the weights of the removal network.

    set_up.py FOLDER [PACKAGE ...] [--weights URL FILE SHA256]    make a virtual environment in FOLDER and fill it
    set_up.py --weights URL FILE SHA256                           download the weights alone

The add-on runs it with Blender's own Python, so it uses the standard library alone. The packages are the group
"engine" of pyproject.toml, at the versions in constraints.txt. Events go to standard output, one JSON object per line
(core/system/progress.py). Every Python is started isolated (-I), so that none imports a module from the folder in
which it happens to start. An environment in FOLDER, also one that a stopped set-up left, is replaced.

The weights are downloaded from URL to FILE, and refused if their SHA-256 is another. An engine without them is
complete but for the removal network, so a failure leaves the engine, and the result says why in "weights_error".
"""
from __future__ import annotations

import argparse
import contextlib
import glob
import hashlib
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
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
WINDOWS = os.name == "nt"
MIN_MACOS = 14  # required by the wheels of torch and pycolmap in constraints.txt
RENAME_ATTEMPTS = 20  # 0.1 s apart
MAX_WEIGHTS_BYTES = 1 << 30
DOWNLOAD_TIMEOUT_S = 60
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

    Its output goes to standard error, the log; lines that name a download are emitted as events too. The reason is its
    first line that begins with "ERROR:", as pip and `--fetch` write one, else its last line.
    """
    reason, is_unreachable = "", False
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          text=True, errors="replace") as process:
        assert process.stdout is not None
        try:
            with _kill_on_stop_file(process):
                for line in process.stdout:
                    print(line, end="", file=sys.stderr, flush=True)
                    if line.strip().startswith(("Downloading ", "Installing collected")):
                        emit(type="say", text=line.strip()[:120])  # torch takes minutes
                    is_unreachable |= "Retrying (" in line  # pip's last line then speaks of versions
                    if not reason.startswith("ERROR:"):
                        reason = line.strip() or reason
        except BaseException:
            process.kill()
            raise
    if not process.returncode:
        return ""
    if is_unreachable:
        return "the network could not be reached"
    return reason.removeprefix("ERROR:").strip(" .")[:200] or f"status {process.returncode}"


@contextlib.contextmanager
def _kill_on_stop_file(process: subprocess.Popen[str]) -> Iterator[None]:
    """Kill the process when the file that FIT_FLARE_STOP names appears, and raise KeyboardInterrupt then.

    The add-on's panel creates the file to stop the set-up, since on Windows it cannot send a signal."""
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
    """Return the Python that makes the environment: the first that has `ensurepip`, of this one and those on the PATH.

    None where none has it. The Blender of a Linux distribution often lacks `ensurepip`.
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


def weights_step(url: str, file: Path, digest: str) -> Step:
    """Return the step that downloads the weights from `url` to `file`, of this SHA-256 in hexadecimal digits."""
    return Step("Downloading the weights of the removal network",
                [sys.executable, "-I", str(Path(__file__).resolve()), "--fetch", url, str(file), digest],
                f"The weights of the removal network could not be downloaded from {url} ({{why}}); name their file in "
                "the field Removal Weights, or try again.")


def fetch(url: str, file: Path, digest: str) -> None:
    """Download `url` to `file`, whole or not at all.

    Raises OSError, and ValueError for a file that is too large or has another SHA-256 than `digest`.
    """
    print(f"Downloading {url}", flush=True)
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}.{os.getpid()}")
    checksum, size = hashlib.sha256(), 0
    try:
        with urllib.request.urlopen(url, timeout=DOWNLOAD_TIMEOUT_S) as source, open(partial, "wb") as target:
            while chunk := source.read(1 << 20):
                size += len(chunk)
                if size > MAX_WEIGHTS_BYTES:
                    raise ValueError("the file is too large")
                checksum.update(chunk)
                target.write(chunk)
        if checksum.hexdigest() != digest.lower():
            raise ValueError("the file is not the one of this version: its SHA-256 differs")
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def download_weights(url: str, file: Path, digest: str) -> str:
    """Run the step of the weights (`weights_step`); return "" on success, else a sentence on its failure."""
    step = weights_step(url, file, digest)
    emit(type="say", text=step.message)
    try:
        reason = run_logged(step.command)
    finally:
        for partial in file.parent.glob(f".{glob.escape(file.name)}.*"):  # of a download that was killed
            partial.unlink(missing_ok=True)
    return step.failure.replace("{why}", reason) if reason else ""


def set_up_weights(url: str, file: Path, digest: str) -> int:
    """Download the weights alone; return the exit status."""
    emit(type="stage", name="weights", total=1, done=0)
    if problem := download_weights(url, file, digest):
        emit(type="error", text=problem)
        return 1
    emit(type="progress", stage="weights", done=1, total=1, eta_s=None, figures={})
    emit(type="result", data={"weights": str(file)})
    return 0


def main(argv: list[str]) -> int:
    """Set the engine up, download the weights, or both, as the arguments say; return the exit status."""
    parser = argparse.ArgumentParser(description="Installs the engine and the weights of the removal network.")
    parser.add_argument("folder", nargs="?", type=Path, help="folder of the virtual environment")
    parser.add_argument("packages", nargs="*", help="packages instead of those of the engine")
    parser.add_argument("--weights", nargs=3, metavar=("URL", "FILE", "SHA256"), help="weights to download")
    parser.add_argument("--fetch", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.fetch:
        try:
            url, file, digest = args.fetch
            fetch(url, Path(file), digest)
        except (OSError, ValueError) as problem:
            # `run_logged` in the parent process takes the reason from this line.
            print(f"ERROR: {getattr(problem, 'reason', None) or problem}", flush=True)
            return 1
        return 0
    if args.folder is None:
        if args.weights is None:
            parser.print_usage(sys.stderr)
            return 2
        url, file, digest = args.weights
        return set_up_weights(url, Path(file), digest)
    return set_up_engine(args.folder, args.packages, args.weights)


def set_up_engine(folder: Path, packages: list[str], weights: list[str] | None = None) -> int:
    """Set the engine up in a folder, and emit events; return the exit status.

    packages: to install in place of the engine's, without a test of the engine; [] for the engine's. weights: URL, FILE
    and SHA256 of the weights to download; a failure of theirs is reported, and leaves the engine.
    """
    names = packages or engine_packages()
    if not packages and unsupported_reason():
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
    if not packages:
        steps.append(test_step(folder))
    total = len(steps) + (weights is not None)
    emit(type="stage", name="set up", total=total, done=0)
    if not remove_environment(folder):
        emit(type="error", text=f"The engine in {folder} is in use; close other Blenders and programs that use it, "
                               "and set up again.")
        return 1
    if problem := _run_steps(steps, folder, total):
        emit(type="error", text=problem)
        return 1
    result = {"engine": str(environment_python(folder))}
    if weights is not None:
        url, file, digest = weights
        if problem := download_weights(url, Path(file), digest):
            emit(type="say", text=problem)
            result["weights_error"] = problem
        emit(type="progress", stage="set up", done=total, total=total, eta_s=None, figures={})
    emit(type="result", data=result)
    return 0


def _run_steps(steps: list[Step], folder: Path, total: int) -> str:
    """Run the steps of a set-up in `folder`, and emit their events; return "" on success, else a sentence.

    After a failure or a stop the environment is discarded. total: number of steps, with that of the weights.
    """
    for number, step in enumerate(steps):
        emit(type="say", text=step.message)
        try:
            reason = run_logged(step.command)
        except KeyboardInterrupt:
            discard_environment(folder)
            raise
        if reason:
            discard_environment(folder)
            return step.failure.replace("{why}", reason)
        emit(type="progress", stage="set up", done=number + 1, total=total, eta_s=None, figures={})
    return ""


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
