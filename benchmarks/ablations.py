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
from benchmarks.exact_scene import ExactSceneTrainer, score_flare
from benchmarks.hidden_lights import hidden_flare
from core.capture import Camera, Capture, Light
from core.choices import ITERATIONS, OUR_PRESETS, Preset
from core.fit import fit
from core.fit.frames import Frames
from core.fit.overrides import override_settings
from core.fit.rendering import render
from core.fit.run import Run, ViewLayers
from core.fit.settings import FitSettings, preset
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
PresetFactory = Callable[..., FitSettings]
"""Makes a preset of a given number of iterations from form and mode."""
Results = dict[str, dict[str, dict[str, dict[str, Any]]]]
"""Scores by study, by row, by capture."""
STUDIES = ("form", "comparison", "robustness", "robustness-ours", "supervision", "known", "extrapolation",
           "reconstruction", "far layer")


@dataclass(frozen=True)
class Experiment:
    """One fit of each capture.

    displacement: sigma, scene units, of the Gaussian noise that moves the lights. known_scene: the flare alone is
    fitted, over the exact scene. stretch: a stretch of the path is held out. frames: what a fit is trained on:
    "filmed", the frames as they are; "graded", the same with a bilateral grid for each; "removed", the flare-free
    frames in place of them; "cleaned", the frames, with what `remove` makes of them as flare-free frames.
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


def _seeded_preset(seed: int, name: Preset, **form: Any) -> FitSettings:
    return replace(preset(name, **form), seed=seed)


def our_settings(make_preset: PresetFactory, mode: str = "default", **changes: Any) -> FitSettings:
    """Return our form's settings, changed by dotted name (`__` for the dot). make_preset: sets the length."""
    return override_settings(make_preset(mode=mode), _dotted(changes))


def paper_settings(make_preset: PresetFactory, mode: str = "default", **changes: Any) -> FitSettings:
    """Return the settings of the paper's form and loss, with our rates. Parameters: as for `our_settings`."""
    return override_settings(make_preset(model="paper", mode=mode), _dotted(changes))


def _dotted(changes: dict[str, Any]) -> dict[str, Any]:
    return {name.replace("__", "."): value for name, value in changes.items()}


def _variants(study: str, settings_by_name: dict[str, FitSettings]) -> list[Experiment]:
    return [Experiment(study, name, settings) for name, settings in settings_by_name.items()]


def experiments(make_preset: PresetFactory) -> list[Experiment]:
    """Return the experiments of all studies, which the head of this file explains.

    make_preset: makes settings of a form and a mode, with the length and the seed of the fits.
    """
    ours, papers = partial(our_settings, make_preset), partial(paper_settings, make_preset)
    result = _variants("form", {
        "ours": ours(),
        "without rings": ours(flare__form__rings=False),
        "with arcs": ours(flare__form__arcs=True),
        "without static offsets": ours(flare__form__static_offset=False),
        "without latent": ours(flare__form__latent=0),
        "without plane offsets": ours(flare__form__plane_offset=False),
        "without light correction": ours(flare__form__light_correction=False),
        "without the line (2d)": ours("2d"),
        "without occlusion": ours(flare__occlusion=False),
        "fine grids": ours(flare__form__levels=16, flare__form__base=16),
        "fitted jointly throughout": ours(separate_until=0.0),
        "fitted apart throughout": ours(separate_until=1.0),
        "the paper's": papers(),
    })
    result += _variants("comparison", {
        "default": papers(),
        "2d": papers("2d"),
        "in-flare": papers("in-flare"),
        "unsup": papers("unsup"),
        "without delta_l": papers(flare__form__light_correction=False),
        "without delta_f": papers(flare__form__plane_offset=False),
        "without detection": papers(flare__detection=False),
        "3dgs": papers("3dgs"),
    })
    result += _robustness_experiments(make_preset)
    result += _variants("supervision", {"exact flare-free frames": ours(), "none: split": ours("split"),
                                        "none: unsup": ours("unsup")})
    result += [Experiment("supervision", "what remove makes, for exact", ours(), frames="cleaned"),
               Experiment("supervision", "what remove makes: estimated", ours("estimated"), frames="cleaned")]
    for mode, title in (("default", "exact flare-free frames"), ("split", "none: split")):
        result += _variants("far layer", {
            title: ours(mode), f"{title}, without a far layer": ours(mode, scene__far_layer=False)})
    result += _exact_scene_experiments(make_preset)
    result += [Experiment("extrapolation", "every n-th view", ours()),
               Experiment("extrapolation", "a stretch", ours(), stretch=True),
               Experiment("extrapolation", "a stretch, the paper's", papers(), stretch=True)]
    scene_only = papers("3dgs")
    result += [Experiment("reconstruction", "3dgs on the frames", scene_only),
               Experiment("reconstruction", "3dgs on the frames, bilateral grids", scene_only, frames="graded"),
               Experiment("reconstruction", "3dgs on flare-free frames", scene_only, frames="removed"),
               Experiment("reconstruction", "our joint fit", ours())]
    return result


def _robustness_experiments(make_preset: PresetFactory) -> list[Experiment]:
    """Return fits of both forms with displaced lights, for each choice of corrections and each sigma.

    The corrections move the lights (delta_l) and the flare on its plane (delta_f).
    """
    result = []
    for corrections, light, plane in (("both", True, True), ("delta_l", True, False), ("delta_f", False, True),
                                      ("neither", False, False)):
        for study, form_settings in (("robustness", paper_settings), ("robustness-ours", our_settings)):
            settings = form_settings(make_preset, flare__form__light_correction=light, flare__form__plane_offset=plane)
            if not light:  # the lights then stay where they were moved to
                settings = override_settings(settings, {"flare.snap_lights": False})
            result += [Experiment(study, f"{corrections}, sigma {sigma:g}", settings, sigma) for sigma in SIGMAS]
    return result


def _exact_scene_experiments(make_preset: PresetFactory) -> list[Experiment]:
    """Return fits of the flare alone over the exact scene, with 900 Gaussians for each light in all iterations."""
    counts = {"flare.count": 900, "flare.density.max_gaussians": 900}
    ours = override_settings(our_settings(make_preset), {**counts, "flare.occlusion": False})
    return [Experiment("known", name, settings, known_scene=True) for name, settings in (
        ("ours", ours), ("with arcs", override_settings(ours, {"flare.form.arcs": True})),
        ("without rings", override_settings(ours, {"flare.form.rings": False})),
        ("the paper's", override_settings(paper_settings(make_preset), counts)))]


def displace_lights(capture: Capture, sigma: float, seed: int = 0) -> Capture:
    """Move each light of the capture once, by noise of this sigma (scene units) along each axis; return the capture."""
    if sigma:
        noise = np.random.default_rng(seed).normal(0, sigma, (len(capture.lights), 3))
        capture.lights = tuple(Light(light.name, np.asarray(light.xyz) + shift)
                               for light, shift in zip(capture.lights, noise, strict=True))
    return capture


def middle_stretch(capture: Capture, share: float = 0.15) -> list[str]:
    """Return the names of the views in one stretch in the middle of the path. share: of all views."""
    count = max(round(share * len(capture.views)), 1)
    first = (len(capture.views) - count) // 2
    return [view.name for view in capture.views[first : first + count]]


def run_experiment(experiment: Experiment, folder: Path, capture: Path, width: int,
                   progress: Progress) -> dict[str, Any]:
    """Return the scores of one experiment: read from `folder` if it is finished, else fitted and written there.

    folder: the one of this experiment and capture. width: pixels of the frames that are fitted.
    """
    score_file = folder / SCORES
    if score_file.exists():
        stored: dict[str, Any] = json.loads(score_file.read_text(encoding="utf-8"))
        return stored
    fit_capture = displace_lights(Capture.open(capture), experiment.displacement)
    settings = replace(experiment.settings, width=width)
    if experiment.stretch:
        split = folder / "stretch.json"
        write_json(split, {"test": middle_stretch(fit_capture)})
        settings = replace(settings, holdout=str(split))
    start = time.monotonic()
    if experiment.known_scene:
        scores = _fit_over_exact_scene(fit_capture, settings, progress)
    elif experiment.frames == "graded":
        scores = _fit_with_grids(fit_capture, settings, progress)
    else:
        if experiment.frames == "removed":
            fit_capture = _link_capture(folder / "capture", capture, images="removed")
        elif experiment.frames == "cleaned":
            fit_capture = _clean_copy(folder / "capture", capture, progress)
        fitted = fit(fit_capture, settings, folder / "run", progress, resume=True)
        scores = _score_held_out(fitted, capture, settings, progress)
    scores["seconds"], scores["commit"] = round(time.monotonic() - start), _current_commit()
    write_json(score_file, scores)
    return scores


def _run_iterations(trainer: ExactSceneTrainer | BilateralTrainer, stage: str, iterations: int,
                    progress: Progress) -> None:
    progress.stage(stage, iterations)
    for _ in range(iterations):
        trainer.step()
        progress.advance()


def _fit_over_exact_scene(capture: Capture, settings: FitSettings, progress: Progress) -> dict[str, Any]:
    """Fit the flare alone over the exact scene; return its scores."""
    trainer = ExactSceneTrainer(capture, settings)
    _run_iterations(trainer, "flare alone", settings.iterations, progress)
    return score_flare(trainer, capture.split(settings.holdout)[1])


@dataclass(frozen=True)
class _SceneRenderer:
    """A scene without flare, as `evaluate` renders it."""

    scene: SceneGaussians

    def render(self, camera: Camera) -> ViewLayers:
        view = render(self.scene, None, "over", camera)
        return ViewLayers(view.layers.scene.numpy(), {}, view.scene.depth.numpy())


def _fit_with_grids(capture: Capture, settings: FitSettings, progress: Progress) -> dict[str, Any]:
    """Fit the scene with a bilateral grid for each frame; return its scores."""
    trainer = BilateralTrainer(capture, settings)
    _run_iterations(trainer, "scene with grids", settings.iterations, progress)
    return _score_held_out(_SceneRenderer(trainer.scene), capture.folder, settings, progress)


def _link_capture(folder: Path, capture: Path, **origins: str) -> Capture:
    """Make a capture of links to another's frames, cameras and lights, without its clean frames.

    origins: by name of a link, the file or folder of `capture` that it leads to if that has another name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("images", "sparse", "split.json", "lights.json"):
        link, origin = folder / name, capture / origins.get(name, name)
        if not link.is_symlink() and origin.exists():
            link.symlink_to(origin.resolve())
    return Capture.open(folder)


def _clean_copy(folder: Path, capture: Path, progress: Progress) -> Capture:
    """Return a copy of the capture, in `folder`, whose clean frames `remove` made."""
    linked = _link_capture(folder, capture)
    if not linked.has_clean_frames:
        clean_capture(linked, Remover(glow="remove"), progress)
    return Capture.open(folder)


def _score_held_out(renderer: Run | _SceneRenderer, folder: Path, settings: FitSettings,
                    progress: Progress) -> dict[str, Any]:
    """Return mean scores over the held-out views of the unchanged capture: lights are displaced for the fit alone.

    folder: the capture's. `hidden`, the flare of lights that geometry hides, is measured over all views, since few of
    those held out hide a light.
    """
    capture = Capture.open(folder)
    held_out = capture.split(settings.holdout)[1]
    frames = Frames(capture, settings.width)
    evaluation = evaluate(renderer, capture, {view: frames.camera(view) for view in held_out}, progress,
                          frames.picture_area)
    scores: dict[str, Any] = {layer: values for layer, values in evaluation.items() if isinstance(values, dict)}
    if settings.mode == "3dgs":  # it has no flare to score
        scores = {layer: layer_scores for layer, layer_scores in scores.items() if not layer.startswith("flare")}
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


def _mean_cell(values: Iterable[float | None], digits: int) -> str:
    present = [value for value in values if value is not None]
    return f"{np.mean(present):.{digits}f}" if present else "–"


def study_tables(results: Results) -> str:
    """Return a Markdown table for each study; figures are means over the captures that all of its rows have."""
    parts = []
    for study, rows in results.items():
        names = shared_captures(rows)
        scores = {name: [row[capture] for capture in names] for name, row in rows.items()}
        all_scores = [result for row in scores.values() for result in row]
        columns = [(layer, key, title) for layer, key, title in COLUMNS
                   if any(result.get(layer, {}).get(key) is not None for result in all_scores)]
        lines = []
        for name, row in scores.items():
            cells = [_mean_cell((result.get(layer, {}).get(key) for result in row), 2 if key == "psnr" else 3)
                     for layer, key, _ in columns]
            lines.append([name, *cells, _mean_cell((result.get("seconds") for result in row), 0)])
        table = report.table([study, *[title for *_, title in columns], "s"], lines)
        parts.append(f"### {study}\n\nMeans over {', '.join(names)}.\n\n{table}")
    return "\n\n".join(parts)


def shared_captures(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the names of the captures that every row of a study has, in the first row's order."""
    first, *others = rows.values()
    return [name for name in first if all(name in other for other in others)]


def table_by_capture(rows: Mapping[str, Mapping[str, dict[str, Any]]]) -> str:
    """Return a table of a study, a column for each capture: the flare's PSNR and the linear flare's relative error."""
    names = shared_captures(rows)
    lines = []
    for title, row in rows.items():
        cells = [(row[name].get("flare", {}).get("psnr"), row[name].get("flare_linear", {}).get("relative_l2"))
                 for name in names]
        lines.append([title, *[f"{_mean_cell([decibels], 2)}; {_mean_cell([error], 3)}" for decibels, error in cells]])
    return report.table(["flare, dB; rel. L2", *names], lines)


def plot_displacements(rows: Mapping[str, Mapping[str, dict[str, Any]]], picture: Path) -> None:
    """Plot the flare's PSNR against the displacement of its light, a line for each choice of corrections.

    rows: scores of a robustness study, by row and capture; a row's name is "CORRECTIONS, sigma S".
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = shared_captures(rows)
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


def _current_commit() -> str:
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=report.ROOT, capture_output=True, text=True,
                          check=False)  # fmt: skip
    return done.stdout.strip() or "unknown"


def write_results(results: Results, section: str, conditions: str, document: Path) -> str:
    """Write the tables, with commit and settings, into a section of the document, and plots beside it; return the text.

    conditions: a phrase on preset, iterations and size, for the heading.
    """
    commits = {result["commit"]: None for rows in results.values() for row in rows.values() for result in row.values()}
    head = f"Fitted at commit {', '.join(commits)}; times include other load on the machine. {report.conditions()}"
    text = f"## Figures: {conditions[0].lower()}{conditions[1:]}\n\n{head}\n\n{study_tables(results)}"
    for study in ("form", "known", "extrapolation"):
        if study in results and len(shared_captures(results[study])) > 1:
            text += f"\n\n### {study}, by capture\n\n" + table_by_capture(results[study])
    for study in ("robustness", "robustness-ours"):
        if study in results:
            picture = document.parent / f"{section}-{study}.png"
            plot_displacements(results[study], picture)
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
    make_preset = partial(_seeded_preset, args.seed, args.preset, iterations=args.iterations or ITERATIONS[args.preset])
    settings = make_preset()
    seed = f"-seed-{args.seed}" if args.seed else ""
    section = f"ablations-{args.preset}-{settings.iterations}-{args.width}{seed}"
    progress = TerminalProgress()
    for experiment in filter(is_selected, experiments(make_preset)):
        for capture in args.captures:
            folder = args.out / section / experiment.key() / capture.name
            if args.finished and not (folder / SCORES).is_file():
                continue
            progress.say(f"{experiment.study}: {experiment.name}, {capture.name}")
            scores = run_experiment(experiment, folder, capture.resolve(), args.width, progress)
            results.setdefault(experiment.study, {}).setdefault(experiment.name, {})[capture.name] = scores
    progress.close()
    size = f"{args.width} pixels wide" if args.width else "at the size of the frames"
    size += f", seed {args.seed}" if args.seed else ""
    conditions = f"Preset {args.preset} of {settings.iterations} iterations, {size}"
    text = write_results(results, section, conditions, args.document)
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
