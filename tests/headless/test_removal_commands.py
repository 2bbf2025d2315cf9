# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands remove, train-removal, eval-removal, and fit for a capture without clean frames."""
from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_flare.core.capture import Capture
from fit_flare.core.images.picture import Picture
from fit_flare.core.images.read import read_picture
from fit_flare.core.images.write import write_png
from fit_flare.core.removal.jobs import provenance
from fit_flare.core.removal.jobs.manifest import MANIFEST
from fit_flare.core.removal.jobs.provenance import has_no_visible_flare
from fit_flare.core.removal.training.run import read_recipe
from fit_flare.core.system.progress import Progress
from fit_flare.headless import cli

from tests.core.removal_cases import network_file

RUN = Path(__file__).resolve().parents[2] / "headless" / "run.py"
SMALL = [word for change in ("widths=[8,8,8,8,8]", "size_stages=[[1.0,64,64]]", "pixels_per_iteration=1",
                             "bank_size=2", "canvas_size=64")
         for word in ("--set", change)]


@pytest.fixture(scope="module")
def backgrounds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("backgrounds")
    x, y = np.meshgrid(np.linspace(0, 0.6, 120), np.linspace(0.1, 0.5, 80))
    for name in ("a.png", "b.png"):  # neither is one of those that are kept for tests
        write_png(folder / name, np.stack([x, y, 0.5 - y], -1))
    return folder


def test_training_stops_at_its_length_and_resumes(backgrounds: Path, tmp_path: Path,
                                                  capsys: pytest.CaptureFixture[str]) -> None:
    torch.set_num_threads(1)
    args = ["train-removal", "--backgrounds", str(backgrounds), "--out", str(tmp_path / "made"), *SMALL]
    subprocess.run([sys.executable, RUN, *args, "--iterations", "2"], check=True)  # as many processes as is usual
    args += ["--processes", "1"]
    assert cli.main([*args, "--iterations", "3"]) == 1
    assert "--resume" in capsys.readouterr().err
    assert cli.main([*args, "--iterations", "3", "--resume"]) == 0
    made = tmp_path / "made"
    shorter = ["train-removal", "--backgrounds", str(backgrounds), "--out", str(made), "--resume", "--processes", "1"]
    assert cli.main([*shorter, "--set", "clean_share=0.5"]) == 0
    recipe = read_recipe(made)  # with its own settings, not the default length and size
    assert recipe is not None and (recipe.iterations, recipe.bank_size, recipe.clean_share) == (3, 2, 0.5)
    weights = str(tmp_path / "made" / "removal.safetensors")
    assert cli.main(["remove", str(backgrounds), "--out", str(tmp_path / "clean"), "--weights", weights]) == 0
    assert {path.name for path in (tmp_path / "clean").iterdir()} == {"a.png", "b.png", "remove.json"}
    assert cli.main(["train-removal", "--backgrounds", str(backgrounds), "--out", str(tmp_path / "x"),
                     "--set", "speed=3"]) == 2
    assert "speed" in capsys.readouterr().err


def test_training_reports_unreadable_files(backgrounds: Path, tmp_path: Path,
                                           capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "pictures"
    shutil.copytree(backgrounds, folder)
    (folder / "0_bad.png").write_bytes(b"no picture")
    args = ["train-removal", "--backgrounds", str(folder), "--out", str(tmp_path / "made"), *SMALL]
    assert cli.main([*args, "--processes", "1", "--iterations", "1"]) == 0
    assert f"Left out: 1 of the pictures, {folder / '0_bad.png'} first" in "".join(capsys.readouterr())


def test_bad_plates_are_listed_at_the_end(backgrounds: Path, tmp_path: Path,
                                          capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "plates"
    shutil.copytree(backgrounds, folder)
    (folder / "0_bad.png").write_bytes(b"no picture")
    assert cli.main(["remove", str(folder), "--out", str(tmp_path / "clean"), "--progress", "json"]) == 1
    events = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert events[-1]["type"] == "error"
    assert "1 of 3 plates" in events[-1]["text"]
    assert "0_bad.png" in events[-1]["text"]
    assert {path.name for path in (tmp_path / "clean").iterdir()} == {"a.png", "b.png", "remove.json"}


def test_an_unreadable_video_is_reported_once(backgrounds: Path, tmp_path: Path,
                                              capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "take.mov").touch()
    args = ["remove", str(backgrounds / "a.png"), str(tmp_path / "take.mov"), "--out", str(tmp_path / "clean"),
             "--progress", "json"]
    assert cli.main(args) == 1
    messages = [event["text"] for line in capfd.readouterr().out.splitlines()
                if "take.mov" in (event := json.loads(line)).get("text", "")]
    assert [text.count("take.mov") for text in messages] == [1, 1]  # when it is left out, and at the end
    assert all("cannot be decoded" in text for text in messages) and "1 of 2 plates" in messages[-1]
    assert (tmp_path / "clean" / "a.png").exists()


@pytest.mark.parametrize(("more", "status"), [(["--frames", "1-2"], 0), (["--jobs", "2"], 1)])
def test_an_unreadable_video_does_not_fail_a_range_of_frames(more: list[str], status: int, backgrounds: Path,
                                                             tmp_path: Path,
                                                             capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "take.mov").touch()
    for number in (1, 2):
        shutil.copyfile(backgrounds / "a.png", tmp_path / f"f{number}.png")
    args = ["remove", *(str(tmp_path / name) for name in ("f1.png", "f2.png", "take.mov"))]
    assert cli.main([*args, "--out", str(tmp_path / "clean"), *more]) == status
    said = capsys.readouterr().err
    assert said.count("Left out:") == 1 and "plates could not be cleaned" not in said
    assert {path.name for path in (tmp_path / "clean").iterdir()} == {"f1.png", "f2.png", "remove.json"}


def test_bad_plates_do_not_stop_other_processes(backgrounds: Path, tmp_path: Path,
                                                capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "plates"
    folder.mkdir()
    for number in range(1, 7):
        shutil.copyfile(backgrounds / "a.png", folder / f"f{number}.png")
    for number in (1, 4):  # the first of either process
        (folder / f"f{number}.png").write_bytes(b"no picture")
    assert cli.main(["remove", str(folder), "--out", str(tmp_path / "clean"), "--jobs", "2"]) == 1
    said = capsys.readouterr().err
    assert "f1.png" in said and "f4.png" in said
    assert sorted(path.name for path in (tmp_path / "clean").iterdir()) == [
        "f2.png", "f3.png", "f5.png", "f6.png", "remove.json"]


def test_missing_weights_are_reported_with_their_variable(backgrounds: Path, tmp_path: Path,
                                                          capsys: pytest.CaptureFixture[str],
                                                          monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIT_FLARE_WEIGHTS", str(tmp_path / "nowhere.safetensors"))
    assert cli.main(["remove", str(backgrounds), "--out", str(tmp_path / "clean")]) == 1
    said = capsys.readouterr().err
    assert "nowhere.safetensors; name their file with FIT_FLARE_WEIGHTS" in said and "Traceback" not in said


def test_diffusion_needs_a_base_and_its_packages(backgrounds: Path, tmp_path: Path,
                                                 capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["remove", str(backgrounds), "--out", str(tmp_path), "--model", "diffusion"]) == 1
    message = capsys.readouterr().err
    assert "--base" in message or "needs diffusers" in message


def test_pairs_are_scored(tmp_path: Path, backgrounds: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("input", "gt"):
        shutil.copytree(backgrounds, tmp_path / "pairs" / kind)
    weights = ["--weights", str(network_file(tmp_path / "net.safetensors", bias=0.1))]
    assert cli.main(["eval-removal", str(tmp_path / "pairs"), "--out", str(tmp_path / "eval"), *weights]) == 0
    assert "LPIPS is not computed" in capsys.readouterr().err
    scores = json.loads((tmp_path / "eval" / "eval.json").read_text(encoding="utf-8"))
    assert scores["mean"]["count"] == 2
    assert (tmp_path / "eval" / "worst.png").exists()
    assert cli.main(["eval-removal", "--out", str(tmp_path)]) == 2
    assert "--synthetic" in capsys.readouterr().err
    assert cli.main(["eval-removal", "--out", str(tmp_path / "made"), "--synthetic", "1", "--size", "96", "64",
                     "--backgrounds", str(backgrounds), "--all-backgrounds", *weights]) == 0
    assert len(json.loads((tmp_path / "made" / "eval.json").read_text(encoding="utf-8"))["categories"]) == 8


def test_unreadable_pairs_do_not_stop_the_scores_of_others(tmp_path: Path, backgrounds: Path,
                                                           capsys: pytest.CaptureFixture[str]) -> None:
    pairs = tmp_path / "pairs"
    for kind in ("input", "gt"):
        shutil.copytree(backgrounds, pairs / kind)
    args = ["--out", str(tmp_path / "eval"), "--weights", str(network_file(tmp_path / "net.safetensors", bias=0.1))]
    (pairs / "gt" / "b.png").write_bytes((pairs / "gt" / "b.png").read_bytes()[:60])
    assert cli.main(["eval-removal", str(pairs), *args]) == 1
    assert "1 of 2 pairs could not be read; the scores of the others are in" in capsys.readouterr().err
    scores = json.loads((tmp_path / "eval" / "eval.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in scores["pictures"]] == ["a"] and "b.png" in scores["failed"][0]
    (pairs / "gt" / "a.png").write_bytes(b"none")
    assert cli.main(["eval-removal", str(pairs), *args]) == 1
    assert "None of 2 pairs could be read" in capsys.readouterr().err
    (pairs / "input" / "a.jpg").touch()
    for given, said in ((pairs, "a under two suffixes"), (pairs / "input", "holds no pairs"),
                        (tmp_path / "nowhere", "is missing")):
        assert cli.main(["eval-removal", str(given), *args]) == 2
        assert said in capsys.readouterr().err


def test_a_fit_in_mode_split_makes_no_clean_frames(capture: Path, tmp_path: Path,
                                                   capsys: pytest.CaptureFixture[str]) -> None:
    bare, run = tmp_path / "bare", tmp_path / "run"
    shutil.copytree(capture, bare, ignore=shutil.ignore_patterns("removed", "truth"))
    assert cli.main(["fit", str(bare), "--out", str(run), "--iterations", "2", "--mode", "split"]) == 0
    assert not (bare / "removed").exists()
    assert 'mode = "split"' in (run / "config.toml").read_text(encoding="utf-8")
    clean = tmp_path / "clean"
    assert cli.main(["remove", "--run", str(run), "--out", str(clean), "--frames", "0-1"]) == 0
    filmed = sorted(path.name for path in (bare / "images").iterdir())
    assert sorted(path.name for path in clean.iterdir()) == [*filmed[:2], MANIFEST]
    for args in (["remove", "--out", str(clean)], ["remove", str(bare), "--run", str(run), "--out", str(clean)],
                  ["remove", "--run", str(run), "--out", str(clean), "--keep-glare"],
                  ["remove", "--run", str(run), "--out", str(clean), "--all-glare"]):
        assert cli.main(args) == 2
        assert "--run" in capsys.readouterr().err


def test_a_fit_of_frames_without_flare_stays_dark(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    """The network removes nothing: parallax alone would make flares of what the scene leaves."""
    net = network_file(tmp_path / "net.safetensors", bias=-1.0)
    monkeypatch.setenv("FIT_FLARE_WEIGHTS", str(net))
    bare, run = tmp_path / "bare", tmp_path / "run"
    shutil.copytree(capture, bare, ignore=shutil.ignore_patterns("removed", "truth"))
    lights = json.loads((bare / "lights.json").read_text(encoding="utf-8"))["lights"]
    other = {**lights[0], "name": "other", "xyz": [0.5, 1.5, 0.2]}
    (bare / "lights.json").write_text(json.dumps({"lights": [lights[0], other]}), encoding="utf-8")
    fit_args = ["fit", str(bare), "--out", str(run), "--iterations", "2"]
    assert cli.main(fit_args) == 0
    messages = capsys.readouterr().err
    assert "found no flare in the frames" in messages
    assert f"Of the 2 lights, the fit uses only {lights[0]['name']}." in messages
    assert 'mode = "default"' in (run / "config.toml").read_text(encoding="utf-8")
    assert cli.main([*fit_args, "--resume"]) == 0
    assert cli.main([*fit_args[:3], str(tmp_path / "estimated"), *fit_args[4:], "--mode", "estimated"]) == 0
    assert 'mode = "default"' in (tmp_path / "estimated" / "config.toml").read_text(encoding="utf-8")


def test_a_fit_makes_missing_clean_frames(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                          monkeypatch: pytest.MonkeyPatch) -> None:
    net = network_file(tmp_path / "net.safetensors", bias=0.5)
    monkeypatch.setenv("FIT_FLARE_WEIGHTS", str(net))
    bare = tmp_path / "bare"
    shutil.copytree(capture, bare, ignore=shutil.ignore_patterns("removed", "truth"))
    args = ["fit", str(bare), "--out", str(tmp_path / "run"), "--iterations", "2"]
    assert cli.main(args) == 0
    said = capsys.readouterr().err
    assert "has no removed/" in said and "the mode is estimated" in said
    frames = {path.stem: path for path in (bare / "images").iterdir()}
    made = {path.stem: path for path in (bare / "removed").glob("*.png")}
    assert frames.keys() == made.keys()
    for name, path in made.items():
        assert (read_picture(path).pixels <= read_picture(frames[name]).pixels + 1e-6).all()
    shutil.rmtree(tmp_path / "run")
    assert cli.main(args) == 0
    said = capsys.readouterr().err
    assert "has no removed/" not in said and "the mode is estimated" in said, "they are kept, and known for estimates"
    assert 'mode = "estimated"' in (tmp_path / "run" / "config.toml").read_text(encoding="utf-8")
    by_hand = ["remove", str(bare / "images"), "--out", str(bare / "removed"), "--all-glare"]
    assert cli.main(by_hand) == 0
    assert f"{len(made)} clean frames in" in capsys.readouterr().err, "as the panel has them made"
    for path in made.values():
        write_png(path, read_picture(path).pixels * 0.9)
    assert cli.main(["fit", str(bare), "--out", str(tmp_path / "worked on"), "--iterations", "2"]) == 0
    assert 'mode = "default"' in (tmp_path / "worked on" / "config.toml").read_text(encoding="utf-8")
    assert "mode estimated" not in capsys.readouterr().err, "someone has gone on from them by hand"


@pytest.mark.parametrize(("codes", "expected"), [(0, True), (4, True), (5, False)])
def test_a_flare_of_a_few_codes_in_one_frame_is_none(capture: Path, tmp_path: Path, codes: int, expected: bool) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(capture, bare, ignore=shutil.ignore_patterns("removed", "truth"))
    shutil.copytree(bare / "images", bare / "removed")
    path = sorted((bare / "removed").iterdir())[-1]
    clean = read_picture(path).display()
    clean[3, 4, 1] += (codes if clean[3, 4, 1] < 0.5 else -codes) / 255
    write_png(path, clean)
    assert has_no_visible_flare(Capture.open(bare), Progress()) is expected


def test_pixels_without_a_value_do_not_hide_a_flare_beside_them(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_with_nan(path: Path) -> Picture:
        """Return a grey picture with a NaN; the frame is brighter than the clean frame."""
        pixels = np.full((4, 6, 3), 0.2 if "removed" in path.parts else 0.5, np.float32)
        pixels[1, 2] = np.nan
        return Picture(pixels, "linear")

    monkeypatch.setattr(provenance, "read_picture", read_with_nan)
    assert not has_no_visible_flare(Capture.open(capture), Progress())
