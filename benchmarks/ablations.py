# SPDX-License-Identifier: GPL-3.0-or-later
"""Remove one choice of the model at a time on captures with exact layers and write docs/results/ablations.md.

    python benchmarks/ablations.py                                  everything, on the sample; a night on two cores
    python benchmarks/ablations.py --captures A B --width 240       other captures, at another size
    python benchmarks/ablations.py --only comparison --variants default 2d

Studies:
  form            our form, and the same without one of its parts; the paper's form beside it
  comparison      the paper's table 1, with its form and loss
  robustness      its study of displaced lights: each moved once by Gaussian noise of sigma, with and without the
                  two corrections delta_l and delta_f
  robustness-ours the same of our form
  supervision     our form taught by exact flare-free frames, by those that `remove` makes, taken for exact or for
                  estimates, and by none: split by parallax, or as the paper does without (unsup)
  known           the flare alone, over the exact scene, 900 Gaussians a light: what the representation itself can do
  extrapolation   our form, with a stretch of the path held out instead of every n-th view
  reconstruction  the paper's table 3: 3DGS trained on the frames, on the frames with a bilateral grid for each, and on
                  flare-free frames, judged on exact flare-free views; the scene of our form beside them
  far layer       our form with a far layer and without one, taught by exact flare-free frames and split by parallax

Each fit has a folder of its own under --out, named after its settings: finished ones are not repeated, not for another
study either, and broken ones go on where they were.
"""
from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from benchmarks.bilateral import BilateralTrainer
from benchmarks.hidden_lights import hidden_flare
from benchmarks.known_scene import KnownScene, score
from core.capture import Camera, Capture, Light
from core.choices import ITERATIONS, OUR_PRESETS, Preset
from core.fit import fit
from core.fit.frames import Frames
from core.fit.rendering import render
from core.fit.run import Run, ViewLayers
from core.fit.settings import FitSettings, override_settings, preset
from core.gaussians.scene import SceneGaussians
from core.metrics.evaluation import evaluate
from core.removal.inference.remover import Remover
from core.removal.jobs.capture import clean_capture
from core.system.files import write_json
from core.system.progress import Progress, TerminalProgress

DOCUMENT = report.RESULTS / "ablations.md"
SAMPLE = report.ROOT / "sample_scenes" / "desk"
SIGMAS = (0.0, 0.1, 0.5, 1.0)
SCORES = "scores.json"
Length = Callable[..., FitSettings]
"""A preset of a given number of iterations, for which form and mode are chosen."""
Results = dict[str, dict[str, dict[str, dict[str, Any]]]]
"""Scores by study, by row, by capture."""
STUDIES = ("form", "comparison", "robustness", "robustness-ours", "supervision", "known", "extrapolation",
           "reconstruction", "far layer")


@dataclass(frozen=True)
class Experiment:
    """One fit of each capture.

    displacement: of the lights, by Gaussian noise of this sigma, scene units. known_scene: the flare alone, over the
    exact scene. stretch: a stretch of the path is held out. frames: what the scene of a fit without flare is trained
    on, as filmed, as filmed with a bilateral grid for each, or without flare; "cleaned": with what `remove` makes for
    flare-free frames.
    """

    study: str
    name: str
    settings: FitSettings
    displacement: float = 0.0
    known_scene: bool = False
    stretch: bool = False
    frames: Literal["filmed", "graded", "removed", "cleaned"] = "filmed"

    def key(self) -> str:
        """Return a key that is equal for two experiments that are the same fit."""
        identity = {**asdict(self), "study": "", "name": ""}
        return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


def _seeded(seed: int, name: Preset, **form: Any) -> FitSettings:
    return replace(preset(name, **form), seed=seed)


def ours(length: Length, mode: str = "default", **changes: Any) -> FitSettings:
    """Return our form at this length, with settings changed by dotted name (`__` for the dot)."""
    return override_settings(length(mode=mode), {name.replace("__", "."): value for name, value in changes.items()})


def papers(length: Length, mode: str = "default", **changes: Any) -> FitSettings:
    """Return the paper's form and loss at this length, with our rates. changes: as for `ours`."""
    settings = length(model="paper", mode=mode)
    return override_settings(settings, {name.replace("__", "."): value for name, value in changes.items()})


def experiments(length: Length) -> list[Experiment]:
    """Return the experiments of all studies."""
    def variants_of(study: str, variants: dict[str, FitSettings]) -> list[Experiment]:
        return [Experiment(study, name, settings) for name, settings in variants.items()]

    result = variants_of("form", {
        "ours": ours(length),
        "without rings": ours(length, flare__form__rings=False),
        "with arcs": ours(length, flare__form__arcs=True),
        "without static offsets": ours(length, flare__form__static_offset=False),
        "without latent": ours(length, flare__form__latent=0),
        "without plane offsets": ours(length, flare__form__plane_offset=False),
        "without light correction": ours(length, flare__form__light_correction=False),
        "without the line (2d)": ours(length, "2d"),
        "without occlusion": ours(length, flare__occlusion=False),
        "fine grids": ours(length, flare__form__levels=16, flare__form__base=16),
        "fitted jointly throughout": ours(length, separate_until=0.0),
        "fitted apart throughout": ours(length, separate_until=1.0),
        "the paper's": papers(length),
    })
    result += variants_of("comparison", {
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
        for study, form in (("robustness", papers), ("robustness-ours", ours)):
            settings = form(length, flare__form__light_correction=light, flare__form__plane_offset=plane)
            if not light:  # as they are given, then
                settings = override_settings(settings, {"flare.snap_lights": False})
            result += [Experiment(study, f"{corrections}, sigma {sigma:g}", settings, sigma) for sigma in SIGMAS]
    result += variants_of("supervision", {"exact flare-free frames": ours(length), "none: split": ours(length, "split"),
                               "none: unsup": ours(length, "unsup")})
    result += [Experiment("supervision", "what remove makes, for exact", ours(length), frames="cleaned"),
             Experiment("supervision", "what remove makes: estimated", ours(length, "estimated"), frames="cleaned")]
    for mode, title in (("default", "exact flare-free frames"), ("split", "none: split")):
        result += variants_of("far layer", {
            title: ours(length, mode), f"{title}, without a far layer": ours(length, mode, scene__far_layer=False)})
    many = {"flare.count": 900, "flare.density.max_gaussians": 900}  # of each light, from the beginning to the end
    alone = override_settings(ours(length), {**many, "flare.occlusion": False})
    result += [Experiment("known", "ours", alone, known_scene=True),
             Experiment("known", "with arcs", override_settings(alone, {"flare.form.arcs": True}), known_scene=True),
             Experiment("known", "without rings", override_settings(alone, {"flare.form.rings": False}),
                        known_scene=True),
             Experiment("known", "the paper's", override_settings(papers(length), many), known_scene=True)]
    result += [Experiment("extrapolation", "every n-th view", ours(length)),
             Experiment("extrapolation", "a stretch", ours(length), stretch=True),
             Experiment("extrapolation", "a stretch, the paper's", papers(length), stretch=True)]
    plain = papers(length, "3dgs")
    result += [Experiment("reconstruction", "3dgs on the frames", plain),
             Experiment("reconstruction", "3dgs on the frames, bilateral grids", plain, frames="graded"),
             Experiment("reconstruction", "3dgs on flare-free frames", plain, frames="removed"),
             Experiment("reconstruction", "our joint fit", ours(length))]
    return result


def displaced(capture: Capture, sigma: float, seed: int = 0) -> Capture:
    """Move each light of the capture once, by noise of this sigma (scene units) along each axis; return the capture."""
    if sigma:
        noise = np.random.default_rng(seed).normal(0, sigma, (len(capture.lights), 3))
        capture.lights = tuple(Light(light.name, np.asarray(light.xyz) + shift)
                               for light, shift in zip(capture.lights, noise, strict=True))
    return capture


def stretch(capture: Capture, share: float = 0.15) -> list[str]:
    """Return the names of the views in one stretch in the middle of the path. share: of all views."""
    count = max(round(share * len(capture.views)), 1)
    first = (len(capture.views) - count) // 2
    return [view.name for view in capture.views[first : first + count]]


def run(experiment: Experiment, folder: Path, capture: Path, width: int, progress: Progress) -> dict[str, Any]:
    """Return the scores of one experiment, read from `folder` if it was done before, else written there.

    folder: of this experiment and capture. width: of the frames that are fitted, pixels.
    """
    file = folder / SCORES
    if file.exists():
        stored: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return stored
    opened = displaced(Capture.open(capture), experiment.displacement)
    settings = replace(experiment.settings, width=width)
    if experiment.stretch:
        split = folder / "stretch.json"
        write_json(split, {"test": stretch(opened)})
        settings = replace(settings, holdout=str(split))
    began = time.monotonic()
    if experiment.known_scene:
        scores = _known(opened, settings, progress)
    elif experiment.frames == "graded":
        scores = _graded(opened, settings, progress)
    else:
        if experiment.frames == "removed":
            opened = _capture_of(folder / "capture", capture, images="removed")
        elif experiment.frames == "cleaned":
            opened = _cleaned(folder / "capture", capture, progress)
        fitted = fit(opened, settings, folder / "run", progress, resume=True)
        scores = _scores(fitted, capture, settings, progress)
    scores["seconds"], scores["commit"] = round(time.monotonic() - began), _commit()
    write_json(file, scores)
    return scores


def _train(trainer: KnownScene | BilateralTrainer, stage: str, iterations: int, progress: Progress) -> None:
    progress.stage(stage, iterations)
    for _ in range(iterations):
        trainer.step()
        progress.advance()


def _known(capture: Capture, settings: FitSettings, progress: Progress) -> dict[str, Any]:
    """Fit the flare alone over the exact scene; return its scores."""
    trainer = KnownScene(capture, settings)
    _train(trainer, "flare alone", settings.iterations, progress)
    return score(trainer, capture.split(settings.holdout)[1])


@dataclass(frozen=True)
class _SceneAlone:
    """A scene without flare, as `evaluate` renders it."""

    scene: SceneGaussians

    def render(self, camera: Camera) -> ViewLayers:
        view = render(self.scene, None, "over", camera)
        return ViewLayers(view.layers.scene.numpy(), {}, view.scene.depth.numpy())


def _graded(capture: Capture, settings: FitSettings, progress: Progress) -> dict[str, Any]:
    """Fit the scene with a bilateral grid for each frame; return its scores."""
    trainer = BilateralTrainer(capture, settings)
    _train(trainer, "scene with grids", settings.iterations, progress)
    return _scores(_SceneAlone(trainer.scene), capture.folder, settings, progress)


def _capture_of(folder: Path, capture: Path, **origins: str) -> Capture:
    """Make a capture of links to another's frames, cameras and lights, without its clean frames.

    origins: the file or folder of `capture` that a name links to instead.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("images", "sparse", "split.json", "lights.json"):
        link, origin = folder / name, capture / origins.get(name, name)
        if not link.is_symlink() and origin.exists():
            link.symlink_to(origin.resolve())
    return Capture.open(folder)


def _cleaned(folder: Path, capture: Path, progress: Progress) -> Capture:
    """Return a copy of the capture, in `folder`, whose clean frames `remove` made."""
    copy = _capture_of(folder, capture)
    if not copy.has_removed:
        clean_capture(copy, Remover(glow="remove"), progress)
    return Capture.open(folder)


def _scores(renderer: Run | _SceneAlone, folder: Path, settings: FitSettings, progress: Progress) -> dict[str, Any]:
    """Return means over the held-out views of the unchanged capture: lights are displaced for the fit alone.

    folder: of the capture. `hidden`: see `hidden_lights`, over all views, since few of those held out hide a light.
    """
    capture = Capture.open(folder)
    held_out = capture.split(settings.holdout)[1]
    frames = Frames(capture, settings.width)
    evaluated = evaluate(renderer, capture, {view: frames.camera(view) for view in held_out}, progress,
                         frames.picture_area)
    scores: dict[str, Any] = {layer: part for layer, part in evaluated.items() if isinstance(part, dict)}
    if settings.mode == "3dgs":  # it has no flare to score
        scores = {layer: part for layer, part in scores.items() if not layer.startswith("flare")}
    else:
        hidden = hidden_flare(renderer, folder, {view: frames.camera(view) for view in capture.views})
        if hidden is not None:
            scores["hidden"] = hidden
    return scores


# ---- tables ---------------------------------------------------------------------------------------

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("flare", "psnr", "flare, dB"), ("flare", "ssim", "SSIM"), ("flare", "flip", "FLIP"),
    ("flare_linear", "psnr", "linear flare, dB"), ("flare_linear", "relative_l2", "rel. L2"),
    ("scene", "psnr", "scene, dB"), ("scene", "ssim", "SSIM"), ("composite", "psnr", "composite, dB"),
    ("composite", "ssim", "SSIM"), ("hidden", "residual", "hidden / visible"),
)  # fmt: skip


def _cell(values: Iterable[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.{digits}f}" if known else "–"


def tables(results: Results) -> str:
    """Return a Markdown table for each study; figures are means over the captures that all of its rows have."""
    parts = []
    for study, rows in results.items():
        names = shared(rows)
        scores = {name: [row[capture] for capture in names] for name, row in rows.items()}
        all_scores = [scored for row in scores.values() for scored in row]
        columns = [(layer, key, title) for layer, key, title in COLUMNS
                   if any(scored.get(layer, {}).get(key) is not None for scored in all_scores)]
        lines = []
        for name, row in scores.items():
            cells = [_cell((scored.get(layer, {}).get(key) for scored in row), 2 if key == "psnr" else 3)
                     for layer, key, _ in columns]
            lines.append([name, *cells, _cell((scored.get("seconds") for scored in row), 0)])
        table = report.table([study, *[title for *_, title in columns], "s"], lines)
        parts.append(f"### {study}\n\nMeans over {', '.join(names)}.\n\n{table}")
    return "\n\n".join(parts)


def shared(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the names of the captures that every row of a study has, in the first row's order."""
    first, *others = rows.values()
    return [name for name in first if all(name in other for other in others)]


def by_capture(rows: Mapping[str, Mapping[str, dict[str, Any]]]) -> str:
    """Return a table of one study by capture: the flare in dB, and the linear flare's relative error."""
    names = shared(rows)
    lines = []
    for title, row in rows.items():
        cells = [(row[name].get("flare", {}).get("psnr"), row[name].get("flare_linear", {}).get("relative_l2"))
                 for name in names]
        lines.append([title, *[f"{_cell([decibels], 2)}; {_cell([error], 3)}" for decibels, error in cells]])
    return report.table(["flare, dB; rel. L2", *names], lines)


def plot(rows: Mapping[str, Mapping[str, dict[str, Any]]], picture: Path) -> None:
    """Plot the flare's PSNR against the displacement of its light, a line for each choice of corrections.

    rows: of a study of robustness, named "CORRECTIONS, sigma S".
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = shared(rows)
    figure, axes = pyplot.subplots(figsize=(6, 3.6), layout="constrained")
    for corrections in dict.fromkeys(name.split(",")[0] for name in rows):
        points = [(float(name.rsplit(" ", 1)[1]), np.mean([scores[capture]["flare"]["psnr"] for capture in names]))
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


def write(results: Results, section: str, length: str, document: Path) -> str:
    """Write the tables, with commit and settings, into a section of the document; return the text.

    length: a phrase on preset, iterations and size, for the heading.
    """
    commits = {result["commit"]: None for rows in results.values() for row in rows.values() for result in row.values()}
    head = f"Fitted at commit {', '.join(commits)}; times include other load on the machine. {report.conditions()}"
    text = f"## Figures: {length[0].lower()}{length[1:]}\n\n{head}\n\n{tables(results)}"
    for study in ("form", "known", "extrapolation"):
        if study in results and len(shared(results[study])) > 1:
            text += f"\n\n### {study}, by capture\n\n" + by_capture(results[study])
    for study in ("robustness", "robustness-ours"):
        if study in results:
            picture = document.parent / f"{section}-{study}.png"
            plot(results[study], picture)
            text += f"\n\n![The flare against the displacement of its light]({picture.name})"
    report.write_section(document, section, text)
    return text


def main() -> None:
    """Fit and score the experiments that the arguments select, and write their tables."""
    parser = argparse.ArgumentParser(description="Takes the model's choices away one by one.")
    parser.add_argument("--captures", nargs="+", type=Path, default=[SAMPLE])
    parser.add_argument("--only", nargs="+", choices=STUDIES)
    parser.add_argument("--variants", nargs="+", metavar="NAME", help="of the studies' rows; all by default")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft")
    parser.add_argument("--iterations", type=int, help="of each fit, with every schedule stretched to it")
    parser.add_argument("--seed", type=int, default=0, help="of every fit (default 0)")
    parser.add_argument("--width", type=int, default=240, help="of the frames; 0: as filmed (default 240)")
    parser.add_argument("--finished", action="store_true", help="write down what is finished, and fit nothing")
    parser.add_argument("--out", type=Path, default=report.ROOT / "build" / "ablations")
    parser.add_argument("--document", type=Path, default=DOCUMENT)
    args = parser.parse_args()
    results: Results = {}

    def is_selected(experiment: Experiment) -> bool:
        return ((not args.only or experiment.study in args.only)
                and (not args.variants or experiment.name in args.variants))

    # All fits of a study have one length, also those by parallax, which presets make longer.
    length = partial(_seeded, args.seed, args.preset, iterations=args.iterations or ITERATIONS[args.preset])
    result = length()
    seed = f"-seed-{args.seed}" if args.seed else ""
    section = f"ablations-{args.preset}-{result.iterations}-{args.width}{seed}"
    progress = TerminalProgress()
    for experiment in filter(is_selected, experiments(length)):
        for capture in args.captures:
            folder = args.out / section / experiment.key() / capture.name
            if args.finished and not (folder / SCORES).is_file():
                continue
            progress.say(f"{experiment.study}: {experiment.name}, {capture.name}")
            scores = run(experiment, folder, capture.resolve(), args.width, progress)
            results.setdefault(experiment.study, {}).setdefault(experiment.name, {})[capture.name] = scores
    progress.close()
    size = f"{args.width} pixels wide" if args.width else "at the size of the frames"
    size += f", seed {args.seed}" if args.seed else ""
    text = write(results, section, f"Preset {args.preset} of {result.iterations} iterations, {size}", args.document)
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
