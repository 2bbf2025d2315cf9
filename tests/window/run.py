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
import contextlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = 77
VIEW, PREFERENCES = (0, 28, 1313, 908), (168, 55, 1313, 640)
PICTURES = {
    "preferences": ("01_preferences", PREFERENCES), "setting_up": ("11_setting_up", (168, 335, 1313, 520)),
    "imported": ("03_imported", VIEW), "fitting": ("04_fitting", VIEW), "flare": ("05_flare", VIEW),
    "look": ("06_look_and_bake", (325, 75, 1312, 600)),
    "compositor": ("07_compositor", (0, 0, 1600, 1000)),
    "library": ("05_another_look", VIEW), "first_render": ("first_render", (0, 0, 960, 540)),
    "transferred": ("08_transferred", VIEW), "hidden": ("09_hidden", VIEW)}
"""The handbook's pictures: of which screenshot, and which part (left, top, right, bottom) at 1600x1000."""


def main() -> int:
    """Run a script in a Blender with a window, on a fresh profile; return its exit status, LEFT_OUT without a
    Blender."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--blender", default=os.environ.get("FIT_FLARE_BLENDER") or shutil.which("blender"))
    parser.add_argument("--command", default=os.environ.get("FIT_FLARE_WINDOW_COMMAND", ""))
    parser.add_argument("--engine", default=os.environ.get("FIT_FLARE_ENGINE") or str(ROOT / ".venv"))
    parser.add_argument("--script", type=Path, default=ROOT / "tests" / "window" / "flow.py")
    parser.add_argument("--size", default="1600x1000")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="cut the handbook's pictures out of the shots")
    words = parser.parse_args()
    if not words.blender and not words.command:
        print("left out: no Blender here; name one with --blender or FIT_FLARE_BLENDER.", file=sys.stderr)
        return LEFT_OUT
    out = words.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    with base_folder(words.pictures is not None) as folder:
        subprocess.run([sys.executable, str(ROOT / "headless" / "package.py"), str(folder)], check=True)
        shutil.copytree(ROOT / "sample_scenes" / "desk", folder / "desk")
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "profile"),
                       "FIT_FLARE_ZIP": str(next(folder.glob("*.zip"))), "FIT_FLARE_CAPTURE": str(folder / "desk"),
                       "FIT_FLARE_ENGINE": words.engine, "FIT_FLARE_OUT": str(out)}
        environment.setdefault("FIT_FLARE_WEIGHTS", str(ROOT / "core" / "removal" / "box" / "removal.safetensors"))
        if words.pictures and words.engine:  # their paths are to say nothing of this machine
            (folder / "engine").symlink_to(Path(words.engine).resolve())
            environment["FIT_FLARE_ENGINE"] = str(folder / "engine")
        if words.pictures:
            weights = Path(environment["FIT_FLARE_WEIGHTS"])
            environment["FIT_FLARE_WEIGHTS"] = str(shutil.copy(weights, folder / weights.name))
        script = words.script.resolve()
        command = [words.blender, "--enable-event-simulate", "--window-geometry", "0", "0", *words.size.split("x"),
                   "-noaudio", "--python-exit-code", "1", "--python", str(script)]
        if words.command:
            places = {"script": script, "profile": folder / "profile", "size": words.size, "out": out, "base": folder}
            command = [word.format(**places) for word in shlex.split(words.command)]
        status = subprocess.run(command, env=environment, check=False).returncode
    if not status and (out / "overlay.npy").is_file():
        print(f"overlay against the baked layer: {agreement(out):.1f} dB")
    if not status and words.pictures:
        cut(out, words.pictures)
    return status


@contextlib.contextmanager
def base_folder(plain: bool) -> Iterator[Path]:
    """Make a temporary folder for a run. plain: one of a plain name, for paths that pictures show."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(tempfile.gettempdir()) / "fit_flare" if plain else Path(made)
        folder.mkdir(exist_ok=True)
        try:
            yield folder
        finally:
            if plain:
                shutil.rmtree(folder)


def cut(shots: Path, pictures: Path) -> None:
    """Cut the handbook's pictures out of the screenshots that exist: JPEG, at most 1200 pixels wide."""
    import cv2

    for name, (shot, (left, top, right, bottom)) in PICTURES.items():
        if not (shots / f"{shot}.png").is_file():
            continue
        part = cv2.imread(str(shots / f"{shot}.png"))[top:bottom, left:right]
        width = min(part.shape[1], 1200)
        size = width, round(part.shape[0] * width / part.shape[1])
        cv2.imwrite(str(pictures / f"{name}.jpg"), cv2.resize(part, size, interpolation=cv2.INTER_AREA),
                    [cv2.IMWRITE_JPEG_QUALITY, 80])


def agreement(out: Path) -> float:
    """Return the PSNR, dB in linear light, of the overlay that the GPU drew against the baked flare layer."""
    import numpy as np

    sys.path.insert(0, str(ROOT))
    from core.bake.exr import read_layers

    drawn = np.load(out / "overlay.npy")
    baked = read_layers(min((out / "layers").glob("layers.*.exr"))).flare
    return float(10 * np.log10(1 / np.mean((drawn - baked) ** 2)))


if __name__ == "__main__":
    sys.exit(main())
