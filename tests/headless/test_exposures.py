# SPDX-License-Identifier: GPL-3.0-or-later
"""Every command that renders the views of a run applies the exposures that the fit found."""
from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_flare.headless import cli

from core.bake.exr import read_layers
from core.capture import Capture
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.fit import Run, fit, preset
from core.fit.overrides import override_settings
from core.gaussians.ply import read_ply
from core.images.read import read_picture
from core.images.write import write_png

TIMES = 1.6


@pytest.fixture(scope="module")
def runs(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run of a capture with one darker frame, and a copy of the run with that frame's exposure noted, as a fit
    does."""
    base = tmp_path_factory.mktemp("exposed")
    shutil.copytree(capture, base / "capture", ignore=shutil.ignore_patterns("removed", "truth"))
    frame = base / "capture" / "images" / "0001.png"
    write_png(frame, srgb_from_linear(linear_from_srgb(read_picture(frame).pixels) / TIMES))
    settings = override_settings(preset("draft", iterations=60, mode="split"), {"flare.count": 60,
                                                                                "flare.occlusion": False,
                                                                      "holdout": 4})
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    plain = fit(Capture.open(base / "capture"), settings, base / "plain").folder
    torch.set_num_threads(before)
    shutil.copytree(plain, base / "exposed")
    (base / "exposed" / "exposures.json").write_text(json.dumps({"0001.png": 1 / TIMES}))
    return plain, base / "exposed"


def test_baked_layers_have_the_exposure_of_each_frame(runs: tuple[Path, Path], tmp_path: Path) -> None:
    for run in runs:
        assert cli.main(["bake", str(run), "--out", str(tmp_path / run.name), "--frames", "1-2", "--float"]) == 0
    plain, exposed = ([read_layers(tmp_path / run.name / f"layers.000{number}.exr").flare for number in (1, 2)]
                      for run in runs)
    assert plain[0].max() > 1e-3
    np.testing.assert_allclose(exposed[0] * TIMES, plain[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(exposed[1], plain[1])


def test_scores_are_those_at_the_exposure_of_each_frame(runs: tuple[Path, Path]) -> None:
    scores = []
    for run in runs:
        assert cli.main(["eval", str(run), "--views", "train"]) == 0
        scores.append({view["name"]: view["composite"]["psnr"]
                       for view in json.loads((run / "eval.json").read_text())["views"]})
    plain, exposed = scores
    assert exposed["0001.png"] > plain["0001.png"] + 1
    assert {name: score for name, score in exposed.items() if name != "0001.png"} == {
        name: score for name, score in plain.items() if name != "0001.png"}


def test_removed_flares_have_the_exposure_of_each_frame(runs: tuple[Path, Path], tmp_path: Path) -> None:
    for run in runs:
        args = ["remove", "--run", str(run), "--out", str(tmp_path / run.name), "--frames", "1-2", "--flare",
                 str(tmp_path / run.name / "flares")]
        assert cli.main(args) == 0
    plain, exposed = ([read_picture(tmp_path / run.name / "flares" / f"000{number}.exr").pixels for number in (1, 2)]
                      for run in runs)
    assert np.abs(exposed[0] - plain[0]).max() > 1e-3
    np.testing.assert_array_equal(exposed[1], plain[1])


def test_exported_splats_have_the_exposure_of_each_frame(runs: tuple[Path, Path], tmp_path: Path) -> None:
    for run in runs:
        assert cli.main(["export", str(run), "--as", "ply", "--out", str(tmp_path / run.name), "--frames", "1-2"]) == 0
    plain, exposed = ([read_ply(tmp_path / run.name / f"flare.000{number}.ply").sh for number in (1, 2)]
                      for run in runs)
    assert not torch.allclose(exposed[0], plain[0], atol=1e-4)
    assert torch.equal(exposed[1], plain[1])


@pytest.mark.parametrize(("frame", "times"), [(1, TIMES), (2, 1.0)])
def test_intensities_of_a_preset_have_the_exposure_of_the_frame(runs: tuple[Path, Path], tmp_path: Path, frame: int,
                                                                times: float) -> None:
    intensities = []
    for run in runs:
        file = tmp_path / f"{run.name}.json"
        assert cli.main(["export", str(run), "--as", "preset", "--out", str(file), "--frames", str(frame)]) == 0
        (light,) = json.loads(file.read_text())["lights"]
        intensities.append([part["intensity"] for element in light["elements"] for part in element["parts"]])
    plain, exposed = intensities
    np.testing.assert_allclose(np.multiply(exposed, times), plain, rtol=1e-5)


def test_a_preset_does_not_replace_its_flare(runs: tuple[Path, Path], tmp_path: Path,
                                             capsys: pytest.CaptureFixture[str]) -> None:
    flare = tmp_path / "sun.flare"
    shutil.copy(runs[0] / "flare.flare", flare)
    before = flare.read_bytes()
    assert cli.main(["export", str(flare), "--as", "preset", "--out", str(flare), "--capture",
                     (runs[0] / "capture.txt").read_text().strip()]) == 2
    assert "would be overwritten by a result" in capsys.readouterr().err
    assert flare.read_bytes() == before


def test_a_fit_resumes_in_its_own_mode(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """A --mode of the command is ignored, so no clean frames are made that the fit does not use."""
    folder = tmp_path / "capture"
    shutil.copytree((runs[0] / "capture.txt").read_text().strip(), folder)
    args = ["fit", str(folder), "--out", str(tmp_path / "run"), "--resume", "--set", "iterations=2"]
    run = Run.create(tmp_path / "run", override_settings(Run.open(runs[0]).settings, {"iterations": 2}), folder)
    assert not run.finished
    assert cli.main([*args, "--mode", "default"]) == 0
    assert Run.open(tmp_path / "run").settings.mode == "split"
    assert not list(folder.glob("removed*"))


def test_a_transfer_to_a_run_has_the_exposure_of_each_frame(runs: tuple[Path, Path], tmp_path: Path) -> None:
    for run in runs:
        assert cli.main(["transfer", str(runs[0] / "flare.flare"), "--to", str(run), "--out", str(tmp_path / run.name),
                         "--frames", "1-2", "--float"]) == 0
    plain, exposed = ([read_layers(tmp_path / run.name / f"layers.000{number}.exr").scene for number in (1, 2)]
                      for run in runs)
    assert 1.2 < plain[0].mean() / exposed[0].mean() < 1.8
    np.testing.assert_array_equal(exposed[1], plain[1])
