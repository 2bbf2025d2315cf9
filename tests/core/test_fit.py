# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit separates a known flare, goes on after any stop as if there had been none, and refuses bad captures."""
from __future__ import annotations

import copy
import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from core.capture import Capture, Light
from core.conventions.run_files import CHECKPOINT, FLARE, SCENE
from core.errors import Cancelled, CaptureError, FlareFileError, RunError, SettingsError
from core.fit import FitSettings, Run, checkpoint, fit, preset
from core.fit.frames import Frames
from core.fit.initialise import NEAR_PLANE_FACTOR, nearest_depth
from core.fit.overrides import override_settings
from core.fit.parallax_losses import (
    MAX_EXCESS_RATIO,
    excess_ratio,
    far_flare_penalty,
    light_proximity,
    quantile_loss,
    scene_loss,
    scene_only_iterations,
)
from core.fit.rendering import render_flare
from core.fit.settings import SplitSettings
from core.fit.sky import SKY_POINTS, add_sky_points
from core.fit.trainer import Trainer
from core.flare.compositing import composite
from core.flare.model import OURS, PAPER
from core.gaussians.rendering import NEAR
from core.images.read import read_picture
from core.images.write import write_png
from core.look import LookEdits, draw
from core.look.form import FORM_BOUNDS
from core.system.folder_lock import folder_lock
from tests.core.flared import flared_capture
from tests.core.recording_progress import RecordingProgress, StopAfter

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture.open(flared_capture(tmp_path_factory.mktemp("capture")))


def quick(iterations: int = 40, **changes: Any) -> FitSettings:
    """A short fit with every event of a long one: cloning, densification, re-ordering, previews.

    Without occlusion: in this capture the light shines through whatever stands before it.
    """
    settings = preset("draft", iterations=iterations)
    return override_settings(settings, {
        "flare.count": 60, "flare.occlusion": False, "holdout": 4, "preview_every": 15, "flare.density.start": 10,
        "flare.density.every": 10, "flare.density.stop": 30, "scene.classic.start": 5, "scene.classic.every": 10,
        "scene.reorder_every": 12, "scene.sh_every": 8, **changes})


def tensors_of(run: Run) -> dict[str, torch.Tensor]:
    assert run.flare is not None
    return {**{f"scene.{k}": v for k, v in run.scene.state_dict().items()},
            **{f"flare.{k}": v for k, v in run.flare.model.state_dict().items()}}


def flare_psnr(run: Run, capture: Capture) -> tuple[float, float]:
    """Return the PSNR, dB, of the linear flare over the held-out views, and that of an empty flare."""
    _, views = capture.split(run.settings.holdout)
    errors, empty = [], []
    for view in views:
        truth = capture.truth_flare(view)
        assert truth is not None
        layer = sum(run.render(view.camera).flare_by_light.values())
        errors.append(np.square(layer - truth.pixels).mean())
        empty.append(np.square(truth.pixels).mean())
    return -10 * float(np.log10(np.mean(errors))), -10 * float(np.log10(np.mean(empty)))


def test_a_fit_separates_the_flare_from_the_scene(tmp_path: Path, capture: Capture) -> None:
    run = fit(capture, quick(400, **{"flare.density.stop": 200, "flare.density.every": 50}), tmp_path / "run")
    fitted, empty = flare_psnr(run, capture)
    assert fitted > empty + 6
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names >= {"config.toml", "flare.flare", "scene.ply", "metrics.jsonl", "preview.png", "log.txt"}
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["iteration"] == 400
    assert lines[-1]["scene_loss"] < lines[0]["scene_loss"]
    assert lines[-1]["flare_gaussians"] > 60


def test_sh_degree_rises_during_a_fit(capture: Capture) -> None:
    trainer = Trainer(capture, quick())
    degrees = []
    for trainer.iteration in (0, 7, 8, 20, 39):
        degrees.append(trainer._sh_degree())
    assert degrees == [0, 0, 1, 2, 3]


def test_a_light_disc_is_black_behind_its_additive_flare(capture: Capture) -> None:
    trainer = Trainer(capture, quick())
    targets = trainer.frames.targets(trainer.views[0])
    assert targets.clean is not None
    (x, y), = targets.camera.project(capture.lights[0].xyz)[0].astype(int)
    white = targets.clean.clone()
    white[y, x] = white[0, 0] = 1
    clean, scene = targets._replace(clean=white), torch.full_like(white, 0.25)
    for progress, behind in ((1, white), (trainer.settings.iterations, scene)):
        trainer.iteration = progress
        background, discs = trainer._flare_background(clean, scene), trainer._light_discs_of(trainer.views[0], clean)
        seen = composite(background, None, "add", black=discs)
        assert not seen[y, x].any()
        expected = behind.clone()
        expected[y, x] = 0
        assert torch.equal(seen, expected)


def test_a_displaced_light_is_snapped_to_its_flare(tmp_path: Path) -> None:
    capture = Capture.open(flared_capture(tmp_path / "capture"))
    lamp = capture.lights[0]
    for view in capture.views:  # the lamp itself, which the painted flare lacks
        (x, y), = view.camera.project(lamp.xyz)[0].astype(int)
        for folder in ("images", "removed"):
            path = capture.folder / folder / view.name
            picture = read_picture(path).display()
            picture[max(y - 1, 0):y + 2, max(x - 1, 0):x + 2] = 1
            write_png(path, picture)
    capture.lights = (Light(lamp.name, lamp.xyz + np.array([0.2, 0.15, 0.3])),)
    heard = RecordingProgress()
    for snap in (True, False):
        run = fit(capture, quick(4, **{"flare.snap_lights": snap}), tmp_path / f"run {snap}", heard)
        off = np.linalg.norm(run.flare.model.positions.numpy()[0] - lamp.xyz)
        assert off < 0.1 if snap else off > 0.35
        assert np.linalg.norm(run.open_capture().lights[0].xyz - run.flare.model.positions.numpy()[0]) < 1e-6
    assert [text.split(" was moved")[0] for text in heard.texts if " was moved" in text] == ["The light 'lamp'"]


def test_a_resumed_fit_equals_the_uninterrupted_one_bit_for_bit(tmp_path: Path, capture: Capture) -> None:
    whole = fit(capture, quick(), tmp_path / "whole")
    for steps in (7, 11, 13):
        with pytest.raises(Cancelled):
            fit(capture, quick(), tmp_path / "broken", StopAfter(steps, "fit"), resume=True)
    broken = fit(capture, quick(), tmp_path / "broken", resume=True)
    assert json.loads((tmp_path / "broken/metrics.jsonl").read_text().splitlines()[-1])["iteration"] == 40
    expected, got = tensors_of(whole), tensors_of(broken)
    assert expected.keys() == got.keys()
    for name, tensor in expected.items():
        assert torch.equal(tensor, got[name]), name


def test_a_second_fit_in_one_folder_is_refused(tmp_path: Path, capture: Capture) -> None:
    with pytest.raises(Cancelled):
        fit(capture, quick(), tmp_path / "run", StopAfter(2, "fit"))
    with folder_lock(tmp_path / "run"):
        for resume in (True, False):
            with pytest.raises(RunError, match="Another process"):
                fit(capture, quick(), tmp_path / "run", resume=resume)
    assert fit(capture, quick(), tmp_path / "run", resume=True).finished


def test_a_killed_fit_resumes_and_leaves_no_partial_file(tmp_path: Path, capture: Capture) -> None:
    folder = tmp_path / "run"
    script = (f"import torch; torch.set_num_threads(1)\n"
              f"from core.capture import Capture; from core.fit import fit\n"
              f"from tests.core.test_fit import quick\n"
              f"fit(Capture.open({str(capture.folder)!r}), quick(80, checkpoint_every_s=0.0), {str(folder)!r}, "
              f"resume=True)\n")
    order = random.Random(5)
    kills = 0
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)
        begun = time.monotonic()
        before = (folder / "checkpoint/state.safetensors").stat().st_mtime_ns if kills else 0
        state = folder / "checkpoint/state.safetensors"
        while process.poll() is None and time.monotonic() - begun < 60:
            if state.exists() and state.stat().st_mtime_ns != before:
                time.sleep(order.uniform(0.0, 0.3))
                break
            time.sleep(0.005)
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        process.wait()
    assert kills >= 1
    run = fit(capture, quick(80), folder, resume=True)
    assert run.finished
    assert not [path for path in folder.rglob("*") if path.name.startswith(".")]
    whole = fit(capture, quick(80), tmp_path / "whole")
    for name, tensor in tensors_of(whole).items():
        assert torch.equal(tensor, tensors_of(run)[name]), name


@pytest.mark.parametrize(("mode", "changes"), [
    ("estimated", {}), ("split", {}), ("unsup", {}), ("in-flare", {}), ("2d", {}), ("3dgs", {}),
    ("default", {"flare.detection": False}),
    ("default", {"flare.form.light_correction": False}), ("default", {"flare.form.plane_offset": False}),
    ("default", {"scene.strategy": "mcmc", "scene.mcmc.start": 5, "scene.mcmc.every": 5}),
])
def test_every_mode_runs_and_renders(tmp_path: Path, capture: Capture, mode: Any, changes: dict[str, Any]) -> None:
    settings = override_settings(preset("draft", mode=mode, iterations=12),
                                 {"flare.count": 40, "holdout": 4, **changes})
    run = fit(capture, settings, tmp_path / "run")
    reopened = Run.open(tmp_path / "run")
    assert reopened.settings == run.settings == replace(settings, white=1.0)
    assert reopened.finished
    layers = reopened.render(capture.views[0].camera)
    assert layers.scene.shape == (40, 64, 3)
    assert list(layers.flare_by_light) == ([] if mode == "3dgs" else ["lamp"])


def test_mode_split_separates_scene_and_flare_without_clean_frames(tmp_path: Path, capture: Capture) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(capture.folder, bare, ignore=shutil.ignore_patterns("removed", "truth"))

    def found(mode: str) -> tuple[float, float]:
        """Means of two seeds, between which fits this short and small differ by more than a dB."""
        fits = []
        for seed in range(2):
            settings = override_settings(quick(400), {"mode": mode, "flare.density.stop": 120, "seed": seed})
            fits.append(flare_psnr(fit(Capture.open(bare), settings, tmp_path / f"{mode} {seed}"), capture))
        return float(np.mean([one for one, _ in fits])), fits[0][1]

    split, empty = found("split")
    unsup, _ = found("unsup")
    assert split > empty + 4 and split > unsup + 1.5, (split, unsup, empty)
    shutil.copytree(capture.folder / "removed", bare / "removed")
    estimated, _ = found("estimated")
    assert estimated > split + 2, (estimated, split)


def test_the_quantile_loss_fits_the_quantile_of_several_frames() -> None:
    frames = torch.tensor([0.2, 0.2, 0.2, 0.3, 0.9])[:, None]
    levels = torch.linspace(0, 1, 101)
    costs = torch.stack([quantile_loss(level.expand(5, 1), frames, excess_weight=0.25) for level in levels])
    assert levels[costs.argmin()] == pytest.approx(0.2, abs=0.01)
    evenly = torch.stack([quantile_loss(level.expand(5, 1), frames, excess_weight=1.0) for level in levels])
    assert torch.allclose(evenly, (levels[:, None] - frames[:, 0]).abs().mean(-1), atol=1e-6)


def test_the_excess_ratio_is_high_where_residuals_are_mostly_flare() -> None:
    errors = torch.randn(4, 20, 30, 3, generator=torch.Generator().manual_seed(0)) * 0.02
    flare = torch.zeros(20, 30, 3)
    flare[5:15, 5:15] = 0.3
    assert excess_ratio(errors) == pytest.approx(1, abs=0.1)
    assert excess_ratio(errors + flare) > 5
    assert excess_ratio(errors - flare) < 0.1
    assert excess_ratio(iter(())) == excess_ratio([flare]) == MAX_EXCESS_RATIO, "nothing is missing"


def test_far_flare_light_falls_where_the_scene_has_not_converged(capture: Capture) -> None:
    def away(found: float) -> float:
        """Fit, interrupt and go on; return the light of the flare that is away from the lights, summed over the views.

        found: ratio at which the scene counts as converged.
        """
        settings = override_settings(quick(120), {"mode": "split", "split.scene_only_rounds": 1, "split.few_views": 0,
                                                  "split.converged_ratio": found, "split.far_flare_penalty": 3.0})
        trainer = Trainer(capture, settings)
        for _ in range(len(trainer.views) + 5):
            trainer.step()
        state, trainer = copy.deepcopy(trainer.state()), Trainer(capture, settings)
        trainer.load_state(state)
        for _ in range(60):
            trainer.step()
        lights, light = np.array([light.xyz for light in capture.lights]), 0.0
        for view in trainer.views:
            camera = view.camera
            black = torch.zeros(camera.height, camera.width, 3)
            alone = composite(black, render_flare(trainer.flare, settings.blend, camera), settings.blend).detach()
            light += float((alone.mean(-1) * (1 - light_proximity(camera, lights, settings.split.light_radius))).sum())
        return light

    assert away(found=1e9) < 0.5 * away(found=0.0)


def test_the_far_flare_penalty_grows_with_light_and_distance(capture: Capture) -> None:
    camera, lights = capture.views[0].camera, np.array([light.xyz for light in capture.lights])
    added = torch.full((camera.height, camera.width, 3), 0.1, requires_grad=True)
    settings = SplitSettings(far_flare_penalty=2.0, light_radius=0.05)
    loss = far_flare_penalty(added, None, 0.0, camera, lights, settings)
    far = torch.from_numpy(1 - light_proximity(camera, lights, 0.05))
    assert float(loss.detach()) == pytest.approx(2 * 0.1 * float(far.mean()), rel=1e-4)
    loss.backward()
    assert added.grad is not None
    assert torch.allclose(added.grad * added.numel() / 2, far[..., None].expand_as(added), atol=1e-5)


@pytest.mark.parametrize(("found", "believed"), [(5.0, 0), (10.0, 0), (15.0, 0.5), (19.9, 0.99), (25.0, 1)])
def test_the_far_flare_penalty_exempts_more_of_an_estimate_the_nearer_convergence(
        capture: Capture, found: float, believed: float) -> None:
    camera, lights = capture.views[0].camera, np.array([light.xyz for light in capture.lights])
    added = torch.full((camera.height, camera.width, 3), 0.1)
    estimated_flare = torch.linspace(-0.1, 0.3, added.numel()).reshape(added.shape)
    settings = SplitSettings(far_flare_penalty=2.0, diverged_ratio=10.0, converged_ratio=20.0)
    far = torch.from_numpy(1 - light_proximity(camera, lights, settings.light_radius))
    expected = 2 * ((0.1 - believed * estimated_flare.clamp(min=0)).clamp(min=0) * far[..., None]).mean()
    penalty = far_flare_penalty(added, estimated_flare, found, camera, lights, settings)
    assert float(penalty) == pytest.approx(float(expected), rel=1e-4)


def test_the_scene_of_few_views_that_has_not_converged_is_fitted_alone_for_longer() -> None:
    settings = SplitSettings(scene_only_rounds=2, few_views=30, diverged_ratio=10.0, converged_ratio=20.0)
    assert [scene_only_iterations(settings, views, 750, 5.0) for views in (1, 9, 15, 30, 60, 500)] == [
        250, 250, 250, 60, 120, 250]
    assert scene_only_iterations(settings, 20, 750, 5.0) == 40 + (250 - 40) // 2, "half as sparse as 15 views"
    assert scene_only_iterations(settings, 9, 750, 15.0) == 18 + (250 - 18) // 2, "half as far from convergence"
    assert scene_only_iterations(settings, 9, 750, 20.0) == scene_only_iterations(settings, 9, 750) == 18


@pytest.mark.parametrize(("ratio", "iterations"), [(0.0, 40), (MAX_EXCESS_RATIO, 9)])
def test_the_flare_of_a_sparse_capture_starts_later_unless_the_scene_has_converged(
        capture: Capture, monkeypatch: pytest.MonkeyPatch, ratio: float, iterations: int) -> None:
    monkeypatch.setattr("core.fit.trainer.excess_ratio", lambda _residuals: ratio)
    settings = override_settings(quick(120), {"mode": "split", "split.scene_only_rounds": 1})
    trainer = Trainer(capture, settings)
    assert len(trainer.views) == 9
    first = next(count for count in range(120) if "loss" in trainer.step())
    assert first == iterations
    assert any("hardly tell" in text for text in trainer.final_warnings()) == (ratio == 0)
    resumed = Trainer(capture, settings)
    resumed.load_state(trainer.state())
    assert resumed._scene_only_iterations == iterations


def test_ambiguous_light_goes_to_the_flare_but_a_light_disc_to_the_scene(capture: Capture) -> None:
    view = capture.views[0]
    targets, lights = Frames(capture).targets(view), np.array([light.xyz for light in capture.lights])
    (x, y), = view.camera.project(lights)[0].astype(int)
    near = light_proximity(targets.camera, lights, 0.05)
    assert near[y, x] > 0.9 and near[y, x] == near.max() and near.min() < 0.05
    half = round(0.05 * targets.camera.width)
    assert near[y, x + half if x + half < near.shape[1] else x - half] == pytest.approx(0.5, abs=0.15)
    discs = torch.zeros(near.shape, dtype=torch.bool)
    discs[y, x] = True

    def slope(scene: torch.Tensor) -> torch.Tensor:
        scene = scene.clone().requires_grad_()
        scene_loss(scene, targets, lights, discs, SplitSettings(), progress=1.0).backward()
        assert scene.grad is not None
        return scene.grad.sum(-1)

    darker, brighter = slope(targets.frame - 0.1), slope(targets.frame + 0.1)
    assert (darker[~discs] > 0).all(), "what the frame has more is the flare's, and costs the scene near the light"
    assert darker[discs].item() < 0 < brighter[discs].item(), "but the disc is the scene's"
    assert (brighter[~discs] > darker[~discs] * 1.5).all(), "no frame is darker than the scene"


def test_the_penalty_near_a_light_falls_when_the_scenes_colours_change_freely(capture: Capture) -> None:
    """Of a scene that is darker than the frame, only the penalty near the lights has a gradient."""
    targets, lights = Frames(capture).targets(capture.views[0]), np.array([light.xyz for light in capture.lights])
    settings = SplitSettings(low_sh_until=0.7, final_near_share=0.5)

    def slope(progress: float) -> float:
        scene = (targets.frame - 0.1).requires_grad_()
        scene_loss(scene, targets, lights, None, settings, progress).backward()
        assert scene.grad is not None
        return float(scene.grad.sum())

    assert slope(0.7) > 0
    assert slope(0.71) == slope(1.0) == pytest.approx(0.5 * slope(0.7), rel=1e-4)


@pytest.mark.parametrize(("mode", "floor"), [("estimated", 0.004), ("split", 0.004), ("default", 0.0)])
def test_opacities_have_a_floor_while_a_scene_without_clean_frames_could_take_the_flares_light(
        capture: Capture, mode: Any, floor: float) -> None:
    settings = preset("draft", mode=mode, iterations=100)
    trainer = Trainer(capture, settings)
    trainer.iteration = settings.flare.density.stop
    assert trainer._opacity_floor == floor
    trainer.iteration += 1
    assert trainer._opacity_floor == 0, "the model that is written is the one that was fitted"


def test_a_visible_light_hidden_by_the_scene_from_everywhere_is_uncovered(
        capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(capture, quick(**{"flare.occlusion": True}))
    assert trainer.flare is not None
    view = trainer.views[0]
    targets = trainer.frames.targets(view)
    white, black = (targets._replace(frame=torch.full_like(targets.frame, value)) for value in (1.0, 0.0))
    with torch.no_grad():  # as if everything stood before the light, in layers that each hide it
        camera, light = torch.from_numpy(targets.camera.position).float(), trainer.flare.positions[0].float()
        along = torch.linspace(0.3, 0.7, len(trainer.scene.means))[:, None]
        trainer.scene.means.copy_(camera + along * (light - camera))
        trainer.scene.opacity_logits.fill_(3.0)
    monkeypatch.setattr(trainer.frames, "targets", lambda _view: white)
    assert trainer._occlusion_loss(view) is None, "as long as some views see the light"
    trainer.flare.clear.zero_()
    monkeypatch.setattr(trainer.frames, "targets", lambda _view: black)
    assert trainer._occlusion_loss(view) is None, "it is not visible"
    monkeypatch.setattr(trainer.frames, "targets", lambda _view: white)
    loss = trainer._occlusion_loss(view)
    assert loss is not None
    loss.backward()
    slopes = trainer.scene.opacity_logits.grad
    assert slopes is not None and (slopes >= 0).all() and (slopes > 0).any()


def test_sky_points_surround_the_capture_in_colours_of_the_frames(capture: Capture) -> None:
    views, frames = capture.views, Frames(capture)
    found = add_sky_points(capture, views, frames)
    added = found.xyz[len(capture.points):]
    assert 20 < len(added) < SKY_POINTS, "only what some view sees"
    middle = np.mean([view.camera.position for view in views], 0)
    away = np.linalg.norm(added - middle, axis=1)
    assert away.min() > np.linalg.norm(capture.points.xyz - middle, axis=1).max()
    np.testing.assert_allclose(away, away[0], rtol=1e-4)
    brightest = max(float(frames.frame(view).max()) for view in views)
    assert found.rgb[len(capture.points):].max() <= round(255 * brightest)
    seen = [view.camera.contains(*view.camera.project(added)) for view in views]
    assert np.any(seen, 0).all()


@pytest.mark.parametrize("model", ["paper", "ours"])
def test_a_fully_hidden_light_has_no_flare(tmp_path: Path, capture: Capture, model: Any) -> None:
    """A lamp without a flare: all its Gaussians fade and are pruned."""
    settings = replace(quick(40), flare=replace(quick(40).flare, form=PAPER if model == "paper" else OURS))
    settings = override_settings(settings, {"flare.density.prune_below": 1.0})
    run = fit(capture, settings, tmp_path / "run")
    assert run.flare is not None and run.look is not None and run.flare.model.count == 0
    camera = capture.views[0].camera
    assert not run.render(camera).flare_by_light["lamp"].any()
    assert run.elements == {"lamp": []}
    edited = run.render(camera, LookEdits.parse(["lamp.scale=2"], run.lights, run.elements))
    assert not edited.flare_by_light["lamp"].any()
    assert not draw(run.look.evaluate(camera.world_to_camera).values(), camera.intrinsics, *camera.size).any()


def test_ours_runs_in_linear_light(tmp_path: Path, capture: Capture) -> None:
    """A fit of our form adds its flare in linear light (blend "add"), and no layer is negative."""
    settings = override_settings(preset("draft", model="ours", iterations=12), {"flare.count": 40, "holdout": 4})
    assert settings.blend == "add"
    run = fit(capture, settings, tmp_path / "run")
    assert run.flare is not None and run.flare.blend == "add"
    assert all((layer >= 0).all() for layer in run.render(capture.views[0].camera).flare_by_light.values())


def test_a_capture_without_the_inputs_of_a_mode_is_refused_before_writing(tmp_path: Path, capture: Capture) -> None:
    for missing, word, modes in (("removed", "removed", ["default"]), ("lights.json", "lights", ["default", "unsup"])):
        folder = tmp_path / f"without {missing}"
        shutil.copytree(capture.folder, folder)
        shutil.rmtree(folder / "truth")
        (shutil.rmtree if (folder / missing).is_dir() else os.unlink)(folder / missing)
        for mode in modes:
            with pytest.raises(CaptureError, match=word):
                fit(Capture.open(folder), preset("draft", mode=mode, iterations=2), tmp_path / "run")  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()


def test_a_diverging_fit_fails_and_writes_no_result(tmp_path: Path, capture: Capture) -> None:
    settings = quick(120, **{"scene.rates.features": 1e30})
    with pytest.raises(RunError, match="diverged"):
        fit(capture, settings, tmp_path / "run")
    assert not (tmp_path / "run" / "scene.ply").exists()


@pytest.mark.parametrize(("end", "name"), [(end, name) for name in FORM_BOUNDS for end in ("minimum", "maximum")])
def test_a_form_at_its_bounds_is_fitted_and_read(tmp_path: Path, capture: Capture, end: str, name: str) -> None:
    value = getattr(FORM_BOUNDS[name], end)
    run = fit(capture, quick(1, **{f"flare.form.{name}": value}), tmp_path / "run")
    assert run.flare is not None and run.look is not None
    assert getattr(run.flare.model.lights[0].form, name) == getattr(run.look.lights[0].form, name) == value


def test_invalid_settings_are_refused_before_anything_is_written(tmp_path: Path, capture: Capture) -> None:
    with pytest.raises(SettingsError, match="preview_every"):
        fit(capture, replace(quick(), preview_every=0), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["cap ", " cap", "cap\n"])
def test_a_run_finds_its_capture_by_any_name(tmp_path: Path, capture: Capture, name: str) -> None:
    made = Run.create(tmp_path / "run", quick(), shutil.copytree(capture.folder, tmp_path / name))
    found = Run.open(made.folder)
    assert found.find_capture(None).samefile(tmp_path / name)


@pytest.mark.parametrize("damage", [b"", b"\n", b"/cap\xff\n"])
def test_a_run_without_a_capture_name_is_refused(tmp_path: Path, capture: Capture, damage: bytes) -> None:
    made = Run.create(tmp_path / "run", quick(), capture.folder)
    (made.folder / "capture.txt").write_bytes(damage)
    with pytest.raises(RunError, match=r"capture\.txt (names no capture|is not UTF-8)"):
        Run.open(made.folder)


def test_a_capture_whose_name_cannot_be_written_down_is_refused(tmp_path: Path, capture: Capture) -> None:
    try:
        folder = Path(shutil.copytree(capture.folder, tmp_path / os.fsdecode(b"cap\xff")))
    except OSError:
        pytest.skip("this disk has no such names")
    with pytest.raises(RunError, match="not UTF-8"):
        fit(Capture.open(folder), quick(2), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_fit_finishes_while_another_program_holds_its_checkpoint(tmp_path: Path, capture: Capture,
                                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    unlink = Path.unlink

    def held(path: Path, missing_ok: bool = False) -> None:
        if path == tmp_path / "run" / CHECKPOINT:
            raise PermissionError(errno.EACCES, "The process cannot access the file", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", held)
    assert fit(capture, quick(2), tmp_path / "run").finished


def test_a_run_folder_is_not_overwritten(tmp_path: Path, capture: Capture) -> None:
    with pytest.raises(Cancelled):
        fit(capture, quick(), tmp_path / "run", StopAfter(2, "fit"))
    with pytest.raises(RunError, match="resume"):
        fit(capture, quick(), tmp_path / "run")
    with pytest.raises(RunError, match="scene"):
        _ = Run.open(tmp_path / "run").scene


def test_a_run_resumes_only_with_its_own_capture(tmp_path: Path, capture: Capture) -> None:
    other = Capture.open(shutil.copytree(capture.folder, tmp_path / "other"))
    with pytest.raises(Cancelled):
        fit(capture, quick(), tmp_path / "run", StopAfter(2, "fit"))
    with pytest.raises(RunError, match=r"holds a fit of .*, not of .*other"):
        fit(other, quick(), tmp_path / "run", resume=True)
    (tmp_path / "run" / "capture.txt").write_text(str(tmp_path / "gone"))  # it moved: here it lies elsewhere
    with pytest.raises(Cancelled):
        fit(other, quick(), tmp_path / "run", StopAfter(1, "fit"), resume=True)


def test_a_fit_resumes_only_with_unchanged_lights(tmp_path: Path, capture: Capture) -> None:
    """Flares are kept by the order of their lights, which keep the names and places that lights.json has."""
    (lamp,) = capture.lights
    both = (lamp, Light("sun", lamp.xyz + 0.1))

    def with_lights(*lights: Light) -> Capture:
        own = copy.copy(capture)
        own.lights = lights
        return own

    with pytest.raises(Cancelled):
        fit(with_lights(*both), quick(), tmp_path / "run", StopAfter(2, "fit"))
    for lights, what in (
            (both[::-1], "were 'lamp', 'sun', and are 'sun', 'lamp' now"), (both[:1], "are 'lamp' now"),
            ((lamp, Light("moon", both[1].xyz)), "are 'lamp', 'moon' now"),
            ((lamp, Light("sun", lamp.xyz + 0.2)), "'sun' was at .*, and is at .* now")):
        with pytest.raises(RunError, match=rf"lights\.json has changed .*{what}.*; put the old one back"):
            fit(with_lights(*lights), quick(), tmp_path / "run", resume=True)
    as_blender_has_it = (lamp, Light("sun", both[1].xyz.astype(np.float32) + 1e-6))
    with pytest.raises(Cancelled):
        fit(with_lights(*as_blender_has_it), quick(), tmp_path / "run", StopAfter(1, "fit"), resume=True)


@pytest.mark.parametrize("what", ["images", "removed", "the camera"])
def test_a_fit_resumes_only_with_unchanged_views(what: str, tmp_path: Path, capture: Capture) -> None:
    own = Capture.open(shutil.copytree(capture.folder, tmp_path / "own"))
    with pytest.raises(Cancelled):
        fit(own, quick(), tmp_path / "run", StopAfter(1, "fit"))
    view = own.views[1]
    if what == "the camera":
        turned = replace(view, camera=replace(view.camera, fx=view.camera.fx * 1.01))
        own.views = tuple(turned if one == view else one for one in own.views)
    else:
        path = own.frame_path(view) if what == "images" else own.clean_frame_path(view)
        write_png(path, 1 - read_picture(path).pixels)
    with pytest.raises(RunError, match=rf"1 of {len(own.views)} views have another frame.*, {view.name} first"):
        fit(own, quick(), tmp_path / "run", resume=True)


def test_a_fit_resumes_after_it_moved_a_light(capture: Capture) -> None:
    first, second = (Trainer(capture, quick()) for _ in range(2))
    assert first.flare is not None
    first.flare.positions += 0.25
    second.load_state(first.state())
    assert second.flare is not None and torch.equal(second.flare.positions, first.flare.positions)


def test_a_checkpoint_without_inputs_resumes(capture: Capture) -> None:
    """A checkpoint of an earlier version does not record the lights and frames that the fit was given."""
    earlier = Trainer(capture, quick())
    earlier.step()
    state = earlier.state()
    del state["lights"], state["views"]
    moved = copy.copy(capture)
    moved.lights = (Light("sun", capture.lights[0].xyz + 0.1),)
    trainer = Trainer(moved, quick())
    trainer.load_state(state)
    assert trainer.iteration == 1
    assert trainer.flare is not None and torch.equal(trainer.flare.positions, state["flare"]["positions"])
    assert all(torch.equal(value, state["scene"][name]) for name, value in trainer.scene.state_dict().items())


def test_a_capture_in_small_units_has_a_nearer_near_plane(capture: Capture) -> None:
    """Gaussians are culled before what the frames show, however small its units."""
    assert Trainer(capture, quick()).scene.near == NEAR
    for scale in (0.1, 0.01):
        views = []
        for view in capture.views:
            pose = view.camera.world_to_camera.copy()
            pose[:3, 3] *= scale
            views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
        points = replace(capture.points, xyz=capture.points.xyz * scale)
        small = copy.copy(capture)
        small.views, small.points = tuple(views), points
        near, nearest = Trainer(small, quick()).scene.near, nearest_depth(small)
        assert near <= NEAR_PLANE_FACTOR * nearest
        assert near == pytest.approx(min(NEAR, NEAR_PLANE_FACTOR * nearest_depth(capture) * scale), rel=1e-3)


def test_a_damaged_checkpoint_or_result_is_one_line(tmp_path: Path, capture: Capture) -> None:
    folder = tmp_path / "run"
    with pytest.raises(Cancelled):
        fit(capture, quick(), folder, StopAfter(2, "fit"))
    state = folder / "checkpoint/state.safetensors"
    whole = state.read_bytes()
    for data in (b"", whole[: len(whole) // 2], b"\x80\x04pickle"):
        state.write_bytes(data)
        with pytest.raises(RunError, match=r"state\.safetensors"):
            fit(capture, quick(), folder, resume=True)
    state.write_bytes(whole)
    fit(capture, quick(), folder, resume=True)
    (folder / "flare.flare").write_bytes(b"nonsense")
    with pytest.raises(FlareFileError, match=r"flare\.flare"):
        _ = Run.open(folder).flare
    with pytest.raises(RunError, match="not the folder"):
        Run.open(tmp_path)


def test_a_fingerprint_changes_with_scene_and_flare(tmp_path: Path) -> None:
    def fingerprint(scene: bytes, flare: bytes) -> str:
        (tmp_path / SCENE).write_bytes(scene)
        (tmp_path / FLARE).write_bytes(flare)
        return Run(tmp_path, FitSettings(), tmp_path).fingerprint

    assert len({fingerprint(b"a", b"x"), fingerprint(b"b", b"x"), fingerprint(b"a", b"y")}) == 3


def test_a_view_that_the_light_passes_leaves_other_views_unchanged(capture: Capture) -> None:
    """What the network tells of places in the frame is as fine as without that view."""
    camera = capture.views[5].camera
    beside = camera.position + camera.world_to_camera[:3].T[:3] @ np.array([3.0, 0.0, 0.03])
    trainer = Trainer(capture.with_lights_at({"lamp": beside}), quick(1, **{"flare.snap_lights": False}))
    assert trainer.flare is not None
    seen = [float(light.light.norm()) for view in trainer.views
            for light in trainer.flare.views(torch.from_numpy(view.camera.world_to_camera)) if light.depth > 0]
    assert max(seen) > 90
    assert trainer.flare.lights[0].query_range.light_high[2] < 2 * max(camera.corner_radius, min(seen))


def test_a_scene_only_iteration_has_no_composite_loss(tmp_path: Path) -> None:
    """The loss is absent, since a loss of 0 would pass for a perfect fit."""
    settings = quick(120, mode="split", **{"split.few_views": 0})
    trainer = Trainer(Capture.open(flared_capture(tmp_path / "c", 5)), settings)
    figures_of_steps = [trainer.step() for _ in range(trainer._scene_only_iterations + 1)]
    assert all("loss" not in figures and figures["scene_loss"] > 0 for figures in figures_of_steps[:-1])
    assert figures_of_steps[-1]["loss"] > 0


@pytest.mark.parametrize("converged", [True, False])
def test_checkpoints_of_older_formats_restore_the_excess_ratio(capture: Capture, converged: bool) -> None:
    """The oldest hold the last scene-only iteration, later ones whether the scene converged, then `times_found`."""
    settings = override_settings(quick(120), {"mode": "split", "split.scene_only_rounds": 1, "split.few_views": 0})
    earlier, trainer = (Trainer(capture, settings) for _ in range(2))
    state = earlier.state()
    del state["excess_ratio"]
    alone_until = len(earlier.views) if converged else settings.iterations // 3
    for entry in ({"alone_until": alone_until}, {"scene_is_found": converged}):
        trainer._excess_ratio = 13.5
        trainer.load_state({**state, **entry})
        assert trainer._excess_ratio == (MAX_EXCESS_RATIO if converged else 0)
    trainer.load_state({**state, "times_found": 7.25})
    assert trainer._excess_ratio == 7.25


def test_a_checkpoint_restores_state_outside_the_optimisers(tmp_path: Path) -> None:
    """How clear each view is, where the lights are, and whether the scene was found."""
    capture = Capture.open(flared_capture(tmp_path / "c", 5))
    first, second = (Trainer(capture, quick(mode="split")) for _ in range(2))
    assert first.flare is not None
    assert second.flare is not None
    first.flare.clear.fill_(0.3)
    first.flare.positions += 0.25
    first._excess_ratio = 13.5
    checkpoint.save(tmp_path / "state.safetensors", first.state())
    second.load_state(checkpoint.load(tmp_path / "state.safetensors"))
    assert torch.equal(second.flare.clear, first.flare.clear)
    assert torch.equal(second.flare.positions, first.flare.positions)
    assert second._excess_ratio == 13.5
