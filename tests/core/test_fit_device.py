# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits, scores, bakes and transfers on a GPU: on a simulated one, whose kernels run on Warp's CPU device."""
from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from core.bake.shot import ShotRenderer
from core.capture import Capture
from core.errors import Cancelled, EngineError, SettingsError
from core.fit import FitSettings, Run, fit, preset
from core.fit.overrides import override_settings
from core.gaussians import tiled
from core.gaussians.device import select_device
from core.look import PlacedLight, read_look
from core.look.shot import Shot, ShotFrame
from core.metrics.evaluation import evaluate
from core.transfer.target import shot_target
from core.transfer.transfer import Transfer
from tests.core.flared import flared_capture
from tests.core.recording_progress import StopAfter
from tests.core.simulated_gpu import GPU, SimulatedGpu, simulate

MAX_DIFFERENCE_DB = 0.2
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture.open(flared_capture(tmp_path_factory.mktemp("capture")))


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> SimulatedGpu:
    warp_scene = pytest.importorskip("core.gaussians.warp_scene")
    warp_kernels = warp_scene.warp_kernels
    splat = partial(tiled.splat, warp_kernels.draw, warp_kernels.TILE)
    return simulate(monkeypatch, SimpleNamespace(rasterize_scene=warp_scene.rasterize_scene, splat=splat))


def quick(iterations: int, model: str = "ours", mode: str = "default", **changes: Any) -> FitSettings:
    """A short fit with every event of a long one; the lights are hidden by the scene."""
    return override_settings(preset("draft", iterations=iterations, model=model, mode=mode), {
        "flare.count": 60, "holdout": 4, "preview_every": 1000, "checkpoint_every_s": 1e6,
        "flare.density.start": 10, "flare.density.every": 10, "flare.density.stop": 30,
        "scene.classic.start": 5, "scene.classic.every": 10, "scene.classic.cap": 400,
        "scene.reorder_every": 12, "scene.sh_every": 8, **changes})


def scores(run: Run) -> dict[str, float]:
    """Return the PSNR, dB, of composite, scene and flare over the held-out views."""
    capture = run.open_capture()
    _, views = capture.split(run.settings.holdout)
    means = evaluate(run, capture, {view: view.camera for view in views})
    return {layer: means[layer]["psnr"] for layer in ("composite", "scene", "flare", "flare_linear")}


def test_a_fit_on_a_gpu_scores_as_one_on_the_processor(tmp_path: Path, capture: Capture, gpu: SimulatedGpu) -> None:
    on_cpu = scores(fit(capture, quick(40, device="cpu"), tmp_path / "cpu"))
    with gpu:
        fit(capture, quick(40, device="cuda"), tmp_path / "cuda")
        on_gpu = scores(Run.open(tmp_path / "cuda", device="cuda"))
    assert {path.name for path in (tmp_path / "cuda").iterdir()} == {path.name for path in (tmp_path / "cpu").iterdir()}
    assert on_gpu == pytest.approx(on_cpu, abs=MAX_DIFFERENCE_DB)
    assert scores(Run.open(tmp_path / "cuda")) == pytest.approx(on_gpu, abs=0.01), "a run's files belong to no device"


@pytest.mark.parametrize(("model", "mode", "changes"), [
    ("paper", "default", {}), ("ours", "split", {}), ("ours", "in-flare", {"scene.strategy": "mcmc"}),
    ("ours", "default", {"scene.kind": "plates", "flare.occlusion": False})])
def test_every_kind_of_fit_runs_on_a_gpu(model: str, mode: str, changes: dict[str, Any], tmp_path: Path,
                                         capture: Capture, gpu: SimulatedGpu) -> None:
    settings = quick(8, model, mode, **changes)
    on_cpu = fit(capture, override_settings(settings, {"device": "cpu"}), tmp_path / "cpu")
    with gpu:
        on_gpu = fit(capture, override_settings(settings, {"device": "cuda"}), tmp_path / "cuda")
    assert scores(on_gpu) == pytest.approx(scores(on_cpu), abs=MAX_DIFFERENCE_DB)


def test_a_fit_resumes_on_another_device(tmp_path: Path, capture: Capture, gpu: SimulatedGpu) -> None:
    with gpu, pytest.raises(Cancelled):
        fit(capture, quick(12, device="cuda"), tmp_path / "run", StopAfter(4, "fit"))
    with pytest.raises(Cancelled):
        fit(capture, quick(12), tmp_path / "run", StopAfter(4, "fit"), resume=True, device="cpu")
    with gpu:
        resumed = fit(capture, quick(12), tmp_path / "run", resume=True)
    whole = fit(capture, quick(12, device="cpu"), tmp_path / "whole")
    assert scores(resumed) == pytest.approx(scores(whole), abs=MAX_DIFFERENCE_DB)


def test_a_shot_and_a_transfer_are_rendered_on_a_gpu(tmp_path: Path, capture: Capture, gpu: SimulatedGpu) -> None:
    run = fit(capture, quick(4, device="cpu"), tmp_path / "run")
    flare, camera = run.folder / "flare.flare", capture.views[0].camera
    look = read_look(flare)
    light = PlacedLight("lamp", look.names[0], look.lights[0].xyz, 1.0)
    shot = Shot(flare, (ShotFrame(1, "Camera", camera, (light,)),), run=run.folder)

    def layers(device: str) -> list[np.ndarray[Any, Any]]:
        """Return scene and flare of the shot, and of its transfer in the scene of the run."""
        target = replace(shot_target(shot, look, {}, scene=run.folder / "scene.ply"), scene_is_background=True)
        transfer = Transfer(flare, target, device=device)  # type: ignore[arg-type]
        renderings = (ShotRenderer(shot, device).render(shot.frames[0], camera),  # type: ignore[arg-type]
                      transfer.frame_renderer(target.frames[0].frame).render(camera))
        return [part for each in renderings for part in (each.scene, each.flare_by_light["lamp"], each.depth)]

    on_cpu = layers("cpu")
    with gpu:
        on_gpu = layers("cuda")
    for expected, rendered in zip(on_cpu, on_gpu, strict=True):
        np.testing.assert_allclose(rendered, expected, atol=1e-4)
    assert on_cpu[3].max() > 0.1, "the transfer shows the scene"


def test_a_device_that_is_not_there_is_refused() -> None:
    assert select_device("cpu").type == "cpu"
    with pytest.raises(SettingsError, match="no device tpu"):
        select_device("tpu")  # type: ignore[arg-type]
    if not torch.cuda.is_available():
        assert select_device("auto").type == "cpu"
        with pytest.raises(EngineError, match="NVIDIA"):
            select_device("cuda")


def test_the_simulated_gpu_refuses_what_a_gpu_refuses(gpu: SimulatedGpu) -> None:
    with gpu:
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        assert there.device == GPU and not there.is_cpu and (there * 2)[:2].device == GPU
        for mix in (lambda: there + here, lambda: torch.stack([there[0], here[0]]), lambda: here[there > 0]):
            with pytest.raises(RuntimeError, match="on the CPU"):
                mix()
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(3, generator=torch.Generator(), device="cuda")
        with pytest.raises(RuntimeError, match="on the CPU"):
            _ = there * torch.from_numpy(np.ones(3, np.float32))[...]
        assert (there + here[0]).device == GPU and here[there.cpu() > 0].device.type == "cpu"
