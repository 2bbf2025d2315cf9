# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits over plates on shots with exact layers, scored on held-out frames.

    python benchmarks/shots.py --out FOLDER [--shots torch drive pan] [--seeds 0 1] [--tracks lights|exact]
                               [--plates network|exact] [--iterations 1200] [--size 240]

Each shot is rendered by `sample_scenes/render_shot.py` into FOLDER, where results of an earlier call are used again.
`--tracks lights`: the lights are found by the command `lights`, and nothing is given. `--plates exact` gives the exact
scene layers: the bound of a fit over plates. It prints, for each shot: the flare of held-out frames in dB and its
relative error in linear light, for no flare, for the network on single frames, and for the fit; the largest error of
the brightness of lights in the frame; and the clean frames in dB, as filmed, by the network, and by the fit.
"""
from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from core.capture import Capture, View
from core.capture.lights import read_lights
from core.colour.srgb import linear_from_srgb
from core.conventions.run_files import FRAME_LIGHTS
from core.fit import Run, fit, preset
from core.fit.overrides import override_settings
from core.fit.settings import adapt_to_plates
from core.images.read import read_picture
from core.metrics.evaluation import displayed_flare, unscored_mask
from core.metrics.pictures import psnr, relative_l2
from core.removal.inference.remover import Remover
from core.removal.jobs.capture import clean_capture
from core.removal.jobs.fitted import remove_fitted_flare
from core.system.progress import Progress

Pixels = NDArray[np.float32]
SHOTS = "torch", "drive", "pan"
NETWORK = "network"
"""Folder in a shot with the clean frames that `remove` makes by itself."""
MIN_FLARE = 0.005
"""Linear light below which a frame shows no flare."""
COLUMNS = ("shot", "seed", "no flare", "network", "fit", "brightness", "filmed", "network clean", "fit clean")


def main() -> None:
    """Fit and score the shots that the arguments name, and print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--shots", nargs="+", choices=SHOTS, default=list(SHOTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--tracks", choices=("lights", "exact"), default="lights")
    parser.add_argument("--plates", choices=("network", "exact"), default="network")
    parser.add_argument("--iterations", type=int, default=1200)
    parser.add_argument("--size", type=int, default=240)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes")
    args = parser.parse_args()
    print("| " + " | ".join(COLUMNS) + " |\n|" + " --- |" * len(COLUMNS), flush=True)
    for name in args.shots:
        for seed in args.seeds:
            print("| " + " | ".join(score(args, name, seed)) + " |", flush=True)


def score(args: argparse.Namespace, name: str, seed: int) -> list[str]:
    """Fit one shot, clean it by the fit, and return the cells of `COLUMNS`.

    *no flare*, *network* and *fit* have two figures each: PSNR of the flare, dB, and its relative error.
    """
    folder = prepare(args.out, name, seed, args.tracks)
    capture = Capture.open(folder, need_cameras=False)
    mode: Any = "default" if args.plates == "exact" else "estimated"
    settings = adapt_to_plates(preset("standard", mode=mode, iterations=args.iterations))
    changes = dict(change.split("=", 1) for change in args.changes)
    settings = override_settings(settings, {"width": args.size, "seed": seed, **{
        key: float(value) for key, value in changes.items()}})
    label = "-".join((args.tracks, args.plates, str(args.iterations), str(args.size), *args.changes))
    if args.plates == "exact":  # a fit prefers removed/ to exact layers, so it gets a copy without
        capture = _with_exact_plates(folder)
    run = fit(capture, settings, folder / f"run-{label}", resume=True)
    run = Run.open(run.folder)
    opened = run.open_capture(capture.folder)
    remove_fitted_flare(run, opened, opened.views, folder / f"clean-{label}", Progress())
    held_out = opened.split(None)[1]
    rows = [row for view in held_out if (row := _score_view(run, opened, view, args.size, folder, label)) is not None]
    mean = np.nanmean(np.array(rows), 0)
    pairs = [f"{mean[i]:.1f} / {mean[i + 1]:.2f}" for i in (0, 2, 4)]
    return [name, str(seed), *pairs, f"{_brightness_error(run, opened, folder):.2f}",
            *(f"{value:.1f}" for value in mean[6:])]


def prepare(out: Path, name: str, seed: int, tracks: str) -> Path:
    """Render a shot, find its lights and clean its frames, each where it is missing; return the shot's folder.

    tracks: "lights" for those that the command finds, "exact" for the exact ones.
    """
    folder = out / f"{name}_{seed}_{tracks}"
    if not (folder / "split.json").is_file():
        subprocess.run([sys.executable, ROOT / "sample_scenes" / "render_shot.py", "--shot", name, "--seed", str(seed),
                        "--out", folder], check=True, stdout=subprocess.DEVNULL)
    if not (folder / "lights.json").is_file():
        if tracks == "exact":
            shutil.copyfile(folder / "truth" / "lights.json", folder / "lights.json")
        else:
            subprocess.run([sys.executable, ROOT / "headless" / "run.py", "lights", folder], check=True,
                           stdout=subprocess.DEVNULL)
    capture = Capture.open(folder, need_cameras=False)
    if not (folder / NETWORK).is_dir():
        clean_capture(capture, Remover(glow="remove"), Progress()).rename(folder / NETWORK)
    if not (folder / "removed").is_dir():  # only frames in which a light may be on are cleaned
        flared = [view.name for view in capture.views
                  if any(capture.light_state(light, view).on != 0 for light in capture.lights)]
        clean_capture(capture, Remover(glow="remove"), Progress(), flared)
    return folder


def _with_exact_plates(folder: Path) -> Capture:
    """Copy the shot to exact/, once, without removed/: a fit of mode default then takes the exact scene layers."""
    exact = folder / "exact"
    if not exact.is_dir():
        shutil.copytree(folder, exact, ignore=shutil.ignore_patterns("removed", NETWORK, "run-*", "clean-*", "exact"))
    return Capture.open(exact, need_cameras=False)


def _score_view(run: Run, capture: Capture, view: View, size: int, folder: Path, label: str) -> list[float] | None:
    """Return nine scores of a view; None where it shows no flare.

    First the flare's PSNR, dB, and its relative error in linear light: for no flare, for the network, for the fit.
    Then the PSNR against the exact scene: of the frame, of the network's clean frame and of the fit's. size: width of
    the pictures, pixels. folder: the shot's. label: ends the name of the folder with the fit's clean frames.
    """
    camera = view.camera.scaled(size)
    frame = capture.frame(view, camera.size)
    truth, flare_truth = capture.truth_scene(view, camera.size), capture.truth_flare(view, camera.size)
    assert truth is not None and flare_truth is not None
    scene, exact = np.clip(truth.display(), 0, 1), flare_truth.linear()
    reference = np.abs(frame.display() - scene)
    if exact.max() < MIN_FLARE:
        return None
    mask = ~unscored_mask(capture, view, camera.size)
    layers = run.render(camera)
    flare = np.asarray(sum(layers.flare_by_light.values()), np.float32)
    network = _read(folder / NETWORK / view.name, camera.size)
    fitted = displayed_flare(layers.scene + flare, layers.scene)
    black = np.zeros_like(reference)
    clean = _read(folder / f"clean-{label}" / view.name, camera.size)
    return [psnr(black, reference), relative_l2(black, exact, mask) or 1.0,
            psnr(np.abs(frame.display() - network), reference),
            relative_l2(frame.linear() - linear_from_srgb(network), exact, mask) or 0.0,
            psnr(fitted, reference), relative_l2(flare, exact, mask) or 0.0,
            psnr(frame.display(), scene), psnr(network, scene), psnr(clean, scene)]


def _read(path: Path, size: tuple[int, int]) -> Pixels:
    return read_picture(path).resized(*size).display()


def _brightness_error(run: Run, capture: Capture, folder: Path) -> float:
    """Return the largest error of the brightness of a light in the frame, over the shot.

    Each fitted light is compared with the exact light whose path is nearest, in the frames that contain the latter.
    Brightness has no unit, so each fitted light's is scaled to the exact one's by least squares.
    """
    exact = capture.with_lights(read_lights(folder / "truth" / "lights.json"))
    fitted = capture.with_lights(read_lights(run.folder / FRAME_LIGHTS))
    worst = 0.0
    for light in fitted.lights:
        if light.name not in run.lights:
            continue
        states = [fitted.light_state(light, view) for view in capture.views]
        paths = [[exact.light_state(other, view) for view in capture.views] for other in exact.lights]
        distances = [np.median([np.linalg.norm(a.xy - b.xy) for a, b in zip(states, path, strict=True)])
                     for path in paths]
        path = paths[int(np.argmin(distances))]
        inside = [bool(view.camera.contains(state.xy)[0]) for view, state in zip(capture.views, path, strict=True)]
        ours, true = (np.array([state.on or 0.0 for state, is_inside in zip(each, inside, strict=True) if is_inside])
                      for each in (states, path))
        if len(ours):
            scale = float(ours @ true / max(float(ours @ ours), 1e-9))
            worst = max(worst, float(np.abs(scale * ours - true).max()))
    return worst


if __name__ == "__main__":
    main()
