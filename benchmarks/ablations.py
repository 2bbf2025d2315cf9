# SPDX-License-Identifier: GPL-3.0-or-later
"""Takes the model's choices away one by one, on captures whose layers are known, and writes docs/ablations.md.

    python benchmarks/ablations.py                                  everything, on the sample; a night on two cores
    python benchmarks/ablations.py --captures A B --width 240       other captures, at another size
    python benchmarks/ablations.py --only comparison --variants default 2d

Studies:
  form            our form, and the same without one of its parts; the paper's form beside it
  comparison      the paper's table 1, with its form and loss
  robustness      its study of displaced lights: each moved once by Gaussian noise of sigma, with and without the
                  two corrections delta_l and delta_f
  known           the flare alone, over the exact scene: what the representation itself can do
  extrapolation   our form, with a stretch of the path held out instead of every n-th view

Each fit has a folder of its own under --out; finished ones are not repeated, broken ones go on where they were.
"""
from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from benchmarks.known_scene import KnownScene, score
from core.capture import Capture, Light
from core.files import write_json
from core.fit import fit
from core.fit.frames import Frames
from core.fit.run import Run
from core.fit.settings import FitSettings, changed, preset
from core.metrics.evaluation import evaluate
from core.progress import Progress, TerminalProgress

DOCUMENT = report.ROOT / "docs" / "ablations.md"
SAMPLE = report.ROOT / "sample_scenes" / "desk"
SIGMAS = (0.0, 0.1, 0.5, 1.0)
SCORES = "scores.json"


@dataclass(frozen=True)
class Experiment:
    """One fit of one capture. `lights`: displaced by Gaussian noise of this sigma, scene units."""

    study: str
    name: str
    settings: FitSettings
    displacement: float = 0.0
    known_scene: bool = False


def ours(length: str, **changes: Any) -> FitSettings:
    """Our form at a preset's length, with settings changed by dotted name (`__` for the dot)."""
    return changed(preset(length), {name.replace("__", "."): value for name, value in changes.items()})  # type: ignore[arg-type]


def papers(length: str, mode: str = "default", **changes: Any) -> FitSettings:
    """The paper's form and loss at the same length, with the same rates."""
    made = preset(length, model="paper", mode=mode)  # type: ignore[arg-type]
    return changed(made, {name.replace("__", "."): value for name, value in changes.items()})


def experiments(length: str) -> list[Experiment]:
    """All studies."""
    def of(study: str, variants: dict[str, FitSettings]) -> list[Experiment]:
        return [Experiment(study, name, settings) for name, settings in variants.items()]

    made = of("form", {
        "ours": ours(length),
        "without rings": ours(length, flare__form__rings=False),
        "without static offsets": ours(length, flare__form__static_offset=False),
        "without latent": ours(length, flare__form__latent=0),
        "without plane offsets": ours(length, flare__form__plane_offset=False),
        "without light correction": ours(length, flare__form__light_correction=False),
        "without occlusion": ours(length, flare__occlusion=False),
        "fine grids": ours(length, flare__form__levels=16, flare__form__base=16),
        "fitted jointly throughout": ours(length, apart=0.0),
        "fitted apart throughout": ours(length, apart=1.0),
        "the paper's": papers(length),
    })
    made += of("comparison", {
        "default": papers(length),
        "2d": papers(length, "2d"),
        "in-flare": papers(length, "in-flare"),
        "unsup": papers(length, "unsup"),
        "without delta_l": papers(length, flare__form__light_correction=False),
        "without delta_f": papers(length, flare__form__plane_offset=False),
        "without detection": papers(length, flare__detection=False),
        "3dgs": papers(length, "3dgs"),
    })
    for corrections, light, plane in (("both", True, True), ("delta_l", True, False), ("delta_f", False, True),
                                      ("neither", False, False)):
        settings = papers(length, flare__form__light_correction=light, flare__form__plane_offset=plane)
        made += [Experiment("robustness", f"{corrections}, sigma {sigma:g}", settings, sigma) for sigma in SIGMAS]
    alone = changed(ours(length), {"flare.count": 900, "flare.occlusion": False})
    made += [Experiment("known", "ours", alone, known_scene=True),
             Experiment("known", "the paper's", papers(length, flare__count=900), known_scene=True)]
    made += of("extrapolation", {"every n-th view": ours(length), "a stretch": ours(length)})
    return made


def displaced(capture: Capture, sigma: float, seed: int = 0) -> Capture:
    """The capture with each light moved once, by noise of this sigma along each axis."""
    if sigma:
        noise = np.random.default_rng(seed).normal(0, sigma, (len(capture.lights), 3))
        capture.lights = tuple(Light(light.name, np.asarray(light.xyz) + shift)
                               for light, shift in zip(capture.lights, noise, strict=True))
    return capture


def stretch(capture: Capture, share: float = 0.15) -> list[str]:
    """Names of the views in one stretch in the middle of the path."""
    count = max(round(share * len(capture.views)), 1)
    first = (len(capture.views) - count) // 2
    return [view.name for view in capture.views[first : first + count]]


def run(experiment: Experiment, folder: Path, capture: Path, width: int, progress: Progress) -> dict[str, Any]:
    """Scores of one experiment, from its folder if it was done before."""
    file = folder / SCORES
    if file.exists():
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return found
    opened = displaced(Capture.open(capture), experiment.displacement)
    settings = replace(experiment.settings, width=width)
    if experiment.name == "a stretch":
        split = folder.parent / "stretch.json"
        write_json(split, {"test": stretch(opened)})
        settings = replace(settings, holdout=str(split))
    began = time.monotonic()
    if experiment.known_scene:
        scores = _known(opened, settings, progress)
    else:
        made = fit(opened, settings, folder / "run", progress, resume=True)
        scores = _scores(made, capture, progress)
    scores["seconds"] = round(time.monotonic() - began)
    write_json(file, scores)
    return scores


def _known(capture: Capture, settings: FitSettings, progress: Progress) -> dict[str, Any]:
    trainer = KnownScene(capture, settings)
    progress.stage("flare alone", settings.iterations)
    for _ in range(settings.iterations):
        trainer.step()
        progress.advance()
    return score(trainer, capture.split(settings.holdout)[1])


def _scores(made: Run, folder: Path, progress: Progress) -> dict[str, Any]:
    """Means over the held-out views, against the capture as it is: lights are displaced for the fit alone."""
    capture = Capture.open(folder)
    held_out = capture.split(made.settings.holdout)[1]
    frames = Frames(capture, made.settings.width)
    found = evaluate(made, capture, {view: frames.camera(view) for view in held_out}, progress)
    return {layer: part for layer, part in found.items() if isinstance(part, dict)}


# ---- tables ---------------------------------------------------------------------------------------

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("flare", "psnr", "flare, dB"), ("flare", "ssim", "SSIM"), ("flare", "flip", "FLIP"),
    ("flare_linear", "psnr", "linear flare, dB"), ("flare_linear", "relative_l2", "rel. L2"),
    ("scene", "psnr", "scene, dB"), ("scene", "ssim", "SSIM"), ("composite", "psnr", "composite, dB"),
    ("composite", "ssim", "SSIM"),
)  # fmt: skip


def _cell(values: Iterable[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.{digits}f}" if known else "–"


def tables(results: dict[str, dict[str, list[dict[str, Any]]]]) -> str:
    """A table for each study; figures are means over the captures."""
    parts = []
    for study, rows in results.items():
        shown = [column for column in COLUMNS
                 if any(value.get(column[0], {}).get(column[1]) is not None for row in rows.values() for value in row)]
        lines = []
        for name, scores in rows.items():
            cells = [_cell((one.get(layer, {}).get(key) for one in scores), 2 if key == "psnr" else 3)
                     for layer, key, _ in shown]
            lines.append([name, *cells, _cell((one.get("seconds") for one in scores), 0)])
        parts.append(f"### {study}\n\n" + report.table([study, *[title for *_, title in shown], "s"], lines))
    return "\n\n".join(parts)


def plot(results: dict[str, dict[str, list[dict[str, Any]]]], picture: Path) -> None:
    """The flare's PSNR against the displacement of its light."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = results.get("robustness", {})
    figure, axes = pyplot.subplots(figsize=(6, 3.6), layout="constrained")
    for corrections in dict.fromkeys(name.split(",")[0] for name in rows):
        points = [(float(name.rsplit(" ", 1)[1]), np.mean([one["flare"]["psnr"] for one in scores]))
                  for name, scores in rows.items() if name.split(",")[0] == corrections]
        axes.plot(*zip(*points, strict=True), "o-", label=corrections)
    axes.set(xlabel="displacement of the lights, sigma in scene units", ylabel="flare, dB")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(picture, dpi=150)
    pyplot.close(figure)


def _commit() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=report.ROOT, capture_output=True, text=True,
                          check=False)  # fmt: skip
    return done.stdout.strip() or "unknown"


def write(results: dict[str, dict[str, list[dict[str, Any]]]], captures: Sequence[Path], width: int, length: str,
          document: Path) -> str:
    """The tables, with what they were made of, into the document; returns them."""
    head = (f"Means over {', '.join(path.name for path in captures)}; preset {length}, width {width or 'as filmed'}, "
            f"commit {_commit()}. {report.conditions()}")
    text = f"## Figures\n\n{head}\n\n{tables(results)}"
    if "robustness" in results:
        picture = document.parent / "ablations-robustness.png"
        plot(results, picture)
        text += f"\n\n![The flare against the displacement of its light]({picture.name})"
    report.write_section(document, "ablations", text)
    return text


def main() -> None:
    """See the module's head."""
    parser = argparse.ArgumentParser(description="Takes the model's choices away one by one.")
    parser.add_argument("--captures", nargs="+", type=Path, default=[SAMPLE])
    parser.add_argument("--only", nargs="+", choices=("form", "comparison", "robustness", "known", "extrapolation"))
    parser.add_argument("--variants", nargs="+", metavar="NAME", help="of the studies' rows; all by default")
    parser.add_argument("--preset", choices=("draft", "standard", "high"), default="draft")
    parser.add_argument("--width", type=int, default=240, help="of the frames; 0: as filmed (default 240)")
    parser.add_argument("--out", type=Path, default=report.ROOT / "build" / "ablations")
    parser.add_argument("--document", type=Path, default=DOCUMENT)
    words = parser.parse_args()
    results: dict[str, dict[str, list[dict[str, Any]]]] = {}
    wanted: Callable[[Experiment], bool] = lambda one: (  # noqa: E731
        (not words.only or one.study in words.only) and (not words.variants or one.name in words.variants))
    progress = TerminalProgress()
    for experiment in filter(wanted, experiments(words.preset)):
        for capture in words.captures:
            progress.say(f"{experiment.study}: {experiment.name}, {capture.name}")
            folder = words.out / f"{words.preset}-{words.width}" / experiment.study / experiment.name / capture.name
            scores = run(experiment, folder, capture.resolve(), words.width, progress)
            results.setdefault(experiment.study, {}).setdefault(experiment.name, []).append(scores)
    progress.close()
    sys.stdout.write(write(results, words.captures, words.width, words.preset, words.document) + "\n")


if __name__ == "__main__":
    main()
