# SPDX-License-Identifier: GPL-3.0-or-later
"""Drives the whole flow (flow.py) in a real Blender with its window.

    python tests/window/run.py --out DIR [--blender PROGRAM] [--engine PYTHON] [--script FILE] [--size 1600x1000]
    python tests/window/run.py --out DIR --command "WORDS with {script} {profile} {size} {out} {base}"

Needs a screen, or a virtual one (xvfb-run). The profile is an empty one of its own. DIR gets screenshots and
facts.json. Where no Blender is found it says so and ends with status 77, the sign for a test left out.

--command names a whole command line in place of a Blender: one that brings its own screen, and may drive it with real X
events through a module `ui_driver`. {base} is the folder with the package and the capture, {profile} the empty profile.
"""
from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = 77


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--blender", default=os.environ.get("FIT_FLARE_BLENDER") or shutil.which("blender"))
    parser.add_argument("--command", default=os.environ.get("FIT_FLARE_WINDOW_COMMAND", ""))
    parser.add_argument("--engine", default=os.environ.get("FIT_FLARE_ENGINE") or str(ROOT / ".venv"))
    parser.add_argument("--script", type=Path, default=ROOT / "tests" / "window" / "flow.py")
    parser.add_argument("--size", default="1600x1000")
    words = parser.parse_args()
    if not words.blender and not words.command:
        print("left out: no Blender here; name one with --blender or FIT_FLARE_BLENDER.", file=sys.stderr)
        return LEFT_OUT
    out = words.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as base:
        folder = Path(base)
        subprocess.run([sys.executable, str(ROOT / "headless" / "package.py"), str(folder)], check=True)
        shutil.copytree(ROOT / "sample_scenes" / "desk", folder / "desk")
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "profile"),
                       "FIT_FLARE_ZIP": str(next(folder.glob("*.zip"))), "FIT_FLARE_CAPTURE": str(folder / "desk"),
                       "FIT_FLARE_ENGINE": words.engine, "FIT_FLARE_OUT": str(out)}
        script = words.script.resolve()
        command = [words.blender, "--enable-event-simulate", "--window-geometry", "0", "0", *words.size.split("x"),
                   "-noaudio", "--python-exit-code", "1", "--python", str(script)]
        if words.command:
            places = {"script": script, "profile": folder / "profile", "size": words.size, "out": out, "base": folder}
            command = [word.format(**places) for word in shlex.split(words.command)]
        status = subprocess.run(command, env=environment, check=False).returncode
    if not status and (out / "overlay.npy").is_file():
        print(f"overlay against the baked layer: {agreement(out):.1f} dB")
    return status


def agreement(out: Path) -> float:
    """PSNR of what the GPU drew over the viewport against the flare layer that the engine baked, linear light."""
    import numpy as np

    sys.path.insert(0, str(ROOT))
    from core.bake.exr import read_layers

    drawn = np.load(out / "overlay.npy")
    baked = read_layers(min((out / "layers").glob("layers.*.exr"))).flare
    return float(10 * np.log10(1 / np.mean((drawn - baked) ** 2)))


if __name__ == "__main__":
    sys.exit(main())
