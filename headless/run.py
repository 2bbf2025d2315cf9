# SPDX-License-Identifier: GPL-3.0-or-later
"""The door for scripts and farms.

    python headless/run.py COMMAND …
    blender -b -P headless/run.py -- COMMAND …

Both do the same; `COMMAND --help` says what. The file finds its own tree, whatever the working folder,
and puts nothing on sys.path.
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


def load() -> str:
    """Make this tree importable as a package and return its name: an enabled extension's own, or PACKAGE."""
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


def words() -> list[str]:
    """The command's own words; Blender passes on what stands after the first --."""
    if "bpy" in sys.modules:
        return sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else []
    return sys.argv[1:]


def open_streams() -> None:
    """What a daemon or a scheduler has closed leads nowhere, and what a terminal cannot show is shown as "?"."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def hand_over(package: str, words: list[str]) -> int:
    """In a Python without numpy, which even reading the words takes: the engine's goes on in place of this one, and its
    status is ours."""
    errors = importlib.import_module(f"{package}.core.errors")
    named = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    named.add_argument("--engine")
    try:
        engine = named.parse_known_args(words)[0].engine
        command = importlib.import_module(f"{package}.headless.hand_off").engine_command(engine)
    except (errors.FitFlareError, argparse.ArgumentError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1 if isinstance(problem, errors.FitFlareError) else 2
    if os.name != "nt":
        os.execv(command[0], [*command, *words])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other hears it too
    return subprocess.call([*command, *words])


def leave(status: int) -> None:
    """End the process. Blender as a Python module may hang at interpreter exit (seen with 4.5)."""
    sys.stdout.flush()
    sys.stderr.flush()
    bpy = sys.modules.get("bpy")
    if bpy is not None and not bpy.app.binary_path:
        os._exit(status)
    sys.exit(status)


if __name__ == "__mp_main__":  # a process that one of ours has spawned, which looks up our modules by name
    load()
if __name__ == "__main__":
    open_streams()
    package = load()
    if importlib.util.find_spec("numpy") is None:
        leave(hand_over(package, words()))
    importlib.import_module(f"{package}.core.numeric_environment").prepare_for_numpy_and_torch()
    leave(importlib.import_module(f"{package}.headless.cli").main(words()))
