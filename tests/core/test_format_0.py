# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of format 0 open and give the results that the program gave which wrote them.

`tests/data/format_0` holds runs, a checkpoint of a fit and one of a training, weights, a `.flare`, a shot, and clean
frames with their manifest, all written under the names that settings, recipes and tensors had then; and what that
program made of them.
"""
from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from core.capture import Capture
from core.fit import fit
from core.fit.run import Run
from core.fit.settings import preset
from core.gaussians.ply import read_ply
from core.look import LookEdits, read_look
from core.look.shot import Shot
from core.optics.prescription import built_in_lenses
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
from core.removal.model import weights
from core.removal.training import run as training_run
from core.system.progress import Progress
from tests.core.test_removal_training import backgrounds

FILES = Path(__file__).parents[1] / "data" / "format_0"


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A copy that may be written to; its runs name its capture."""
    copy = shutil.copytree(FILES, tmp_path / "format_0")
    for record in copy.glob("*/capture.txt"):
        record.write_text(f"{copy / 'capture'}\n", encoding="utf-8")
    return copy


@pytest.mark.usefixtures("one_thread")
def test_a_fit_stopped_in_format_0_resumes_to_the_same_flare_and_scene(files: Path) -> None:
    run = fit(Capture.open(files / "capture"), preset("draft"), files / "stopped_split", resume=True)
    assert run.finished
    made, expected = (load_file(files / folder / "flare.flare") for folder in ("stopped_split", "finished_split"))
    assert made.keys() == expected.keys()
    for name, tensor in expected.items():  # rounding differs from processor to processor
        torch.testing.assert_close(made[name], tensor, rtol=1e-2, atol=1e-4, msg=name)
    scene, expected_scene = (read_ply(files / folder / "scene.ply") for folder in ("stopped_split", "finished_split"))
    torch.testing.assert_close(scene.means, expected_scene.means, rtol=1e-2, atol=1e-3)


def test_the_settings_of_a_run_of_format_0_have_the_values_that_were_set(files: Path) -> None:
    settings = Run.open(files / "stopped_split").settings
    flat = repr(settings)
    for value in (0.6, 24.0, 17.0, 0.2, 0.3, 0.1):
        assert f"={value}" in flat


def test_a_finished_run_of_format_0_opens(files: Path) -> None:
    run = Run.open(files / "finished_default")
    assert run.finished
    assert run.capture_folder == files / "capture"
    assert len(run.scene.means) > 0


def test_a_look_and_a_shot_of_format_0_evaluate_to_the_same_gaussians(files: Path) -> None:
    shot, expected = Shot.read(files / "shot.json"), np.load(files / "expected.npz")
    look = read_look(shot.flare)
    compared = 0
    for number, frame in enumerate(shot.frames):
        edits = LookEdits.parse(list(frame.edits), look.names, look.element_names)
        (gaussians,) = look.evaluate_lights(frame.camera.world_to_camera, frame.lights, edits).values()
        for name in ("means", "covariances", "opacities", "colours", "rings"):
            np.testing.assert_allclose(getattr(gaussians, name), expected[f"look/{number}/{name}"], rtol=1e-4,
                                       atol=1e-6)
            compared += 1
    assert compared == 10


def test_clean_frames_of_format_0_are_made_again_to_the_same_bytes(files: Path, monkeypatch: pytest.MonkeyPatch
                                                                   ) -> None:
    """The revision of removal has changed since. The manifest still shows that the program made them, so they are
    replaced without --overwrite. Without the correction of streaks, which came later, they are the same."""
    monkeypatch.setattr("core.removal.inference.remover.correct_streaks", lambda *arguments: arguments[1])
    before = {name: (files / "clean" / name).read_bytes() for name in ("0000.png", "0001.png")}
    remover = Remover(files / "weights.safetensors", working_size=64)
    counts = clean_plates([files / "plates"], files / "clean", remover, Progress())
    assert (counts["made"], counts["kept"]) == (2, 0)
    assert {name: (files / "clean" / name).read_bytes() for name in before} == before
    counts = clean_plates([files / "plates"], files / "clean", remover, Progress())
    assert (counts["made"], counts["kept"]) == (0, 2)



def test_a_training_stopped_in_format_0_resumes_to_the_same_weights(files: Path) -> None:
    recipe = training_run.read_recipe(files / "training")
    path = training_run.train(recipe, files / "training", backgrounds(), built_in_lenses(), processes=1, resume=True)
    made, expected = load_file(path), load_file(files / "expected_weights.safetensors")
    assert len(made) == len(expected)
    network, reference = weights.load_network(path), weights.load_network(files / "expected_weights.safetensors")
    for ours, theirs in zip(network.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=2e-2, atol=1e-3)
