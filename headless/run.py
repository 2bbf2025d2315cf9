# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point of the command line, for scripts and render farms.

    python headless/run.py COMMAND …
    blender -b -P headless/run.py -- COMMAND …

Both run the same commands; `COMMAND --help` describes each. The file finds its own tree from any working folder and
adds nothing to sys.path. It registers the package and calls `headless/cli.py`.
"""
from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "fit_flare"


def register_package() -> str:
    """Make this tree importable as a package; return its name.

    The name is that of the enabled Blender extension where this tree is one, else PACKAGE.
    """
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.rpartition(".")[2] == PACKAGE and file and Path(file).resolve() == ROOT / "__init__.py":
            return name
    spec = importlib.util.spec_from_file_location(PACKAGE, ROOT / "__init__.py",
                                                  submodule_search_locations=[str(ROOT)])
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[PACKAGE] = module
    spec.loader.exec_module(module)
    return PACKAGE


def command_argv() -> list[str]:
    """Return the arguments of the command; in Blender those are the ones after the first "--"."""
    if "bpy" in sys.modules:
        return sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else []
    return sys.argv[1:]


def open_streams() -> None:
    """Reopen standard streams that a daemon or scheduler has closed; print characters that a terminal lacks as "?"."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # a file opened takes the lowest free number: this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def exec_engine(package: str, argv: list[str]) -> int:
    """Replace this process, whose Python has no numpy, by the engine's Python with the same arguments.

    Parsing the arguments already needs numpy. Returns the exit status where the process could not be replaced.
    """
    errors = importlib.import_module(f"{package}.core.errors")
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--engine")
    try:
        engine = parser.parse_known_args(argv)[0].engine
        command = importlib.import_module(f"{package}.headless.hand_off").engine_command(engine)
    except (errors.FitFlareError, argparse.ArgumentError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1 if isinstance(problem, errors.FitFlareError) else 2
    if os.name != "nt":
        os.execv(command[0], [*command, *argv])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the child receives it as well
    return subprocess.call([*command, *argv])


def exit_process(status: int) -> None:
    """Flush the streams and exit. Blender as a Python module may hang at interpreter exit (seen with 4.5)."""
    sys.stdout.flush()
    sys.stderr.flush()
    bpy = sys.modules.get("bpy")
    if bpy is not None and not bpy.app.binary_path:  # Blender as a module, which has no program
        os._exit(status)
    sys.exit(status)


if __name__ == "__mp_main__":  # a process spawned by multiprocessing, which imports our modules by name
    register_package()
if __name__ == "__main__":
    open_streams()
    os.environ["PYTHONSAFEPATH"] = "1"  # no child imports a module from the folder in which it happens to start
    package = register_package()
    if importlib.util.find_spec("numpy") is None:
        exit_process(exec_engine(package, command_argv()))
    importlib.import_module(f"{package}.core.system.thread_environment").set_thread_environment()
    exit_process(importlib.import_module(f"{package}.headless.cli").main(command_argv()))
