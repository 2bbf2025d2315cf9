# SPDX-License-Identifier: GPL-3.0-or-later
"""The farm's templates are valid, run chunk by chunk, and a task that was killed and run again leaves the same files.

Checked and run by openjd-cli, which does what a farm's worker does.
"""
from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from fit_flare.headless import cli

from core.bake.bake import read_manifest
from core.capture import Capture
from core.fit import fit, preset
from core.fit.overrides import override_settings
from core.look import PlacedLight, read_look
from core.look.shot import Shot, ShotFrame
from core.removal.jobs.manifest import MANIFEST
from core.removal.model.weights_file import IN_THE_BOX
from tests.core.removal_cases import picture, write_codes

ROOT = Path(__file__).resolve().parents[2]
RUN = ROOT / "headless" / "run.py"
TEMPLATES = sorted((ROOT / "headless" / "farm").glob("*.yaml"))
FRAMES = "0-8"

openjd = pytest.importorskip("openjd.cli", reason="openjd-cli is not installed")


@pytest.fixture(scope="module")
def made(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, hardly fitted, of the tiny capture."""
    settings = override_settings(preset("draft", iterations=3), {"flare.count": 20, "holdout": 0})
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    folder = fit(Capture.open(capture), settings, tmp_path_factory.mktemp("run") / "run").folder
    torch.set_num_threads(before)
    return folder


def job(template: str, step: str, *options: str, **parameters: object) -> str:
    """Run a step of a job template by `openjd run`; return its log."""
    args = [sys.executable, "-m", "openjd", "run", str(ROOT / "headless" / "farm" / template), "--step", step]
    for name, value in {"RunScript": RUN, "Python": sys.executable, **parameters}.items():
        args += ["-p", f"{name}={value}"]
    ended = subprocess.run([*args, *options], capture_output=True, text=True, timeout=300, check=False,
                           env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-2000:]
    return ended.stdout


def contents(folder: Path) -> dict[str, str]:
    """Every file below a folder, hidden ones too, and the hash of what is in it."""
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def whole(capture: Path, made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All frames by one command: what any number of tasks must come to."""
    out = tmp_path_factory.mktemp("whole") / "layers"
    assert cli.main(["bake", str(made), "--capture", str(capture), "--out", str(out), "--set", "*.intensity=1"]) == 0
    return out


def test_templates_are_valid() -> None:
    """`openjd check` accepts every job template."""
    checks = [subprocess.Popen([sys.executable, "-m", "openjd", "check", path], stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True) for path in TEMPLATES]
    for check in checks:
        said, _ = check.communicate(timeout=120)
        assert check.returncode == 0, said


def test_there_is_a_template_for_each_job() -> None:
    assert {path.stem for path in TEMPLATES} == {"bake", "fit", "remove", "transfer"}


def test_three_chunks_make_what_one_command_makes(capture: Path, made: Path, whole: Path, tmp_path: Path) -> None:
    """Three chunks of frames, run in any order, make the same files as one command."""
    parameters = {"Run": made, "Capture": capture, "Out": tmp_path / "out", "Frames": FRAMES, "FramesPerTask": 3}
    chunks = json.dumps([{"Frame": text} for text in ("6-8", "0-2", "3-5")])
    log = job("bake.yaml", "Bake", "--tasks", chunks, **parameters)
    assert re.findall(r"openjd_progress: (\d+)", log).count("100") == 3
    assert "openjd_status: bake 0/3" in log
    assert contents(tmp_path / "out") == contents(whole)


def test_a_task_that_is_killed_and_run_again_leaves_the_same_files(capture: Path, made: Path, whole: Path,
                                                                   tmp_path: Path) -> None:
    out = tmp_path / "out"
    args = [sys.executable, RUN, "bake", made, "--capture", capture, "--out", out, "--set", "*.intensity=1",
             "--frames", FRAMES, "--progress", "openjd"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    task = subprocess.Popen(args, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    begun = time.monotonic()
    while len(list(out.glob("layers.*.exr"))) < 3 and time.monotonic() - begun < 120:
        time.sleep(0.001)
    task.send_signal(getattr(signal, "SIGKILL", signal.SIGTERM))
    task.wait(timeout=60)
    assert 3 <= len(list(out.glob("layers.*.exr"))) < 9, "it was not killed half way"
    # What a kill in the middle of writing leaves: a file begun, a frame cut short, a list without it.
    (out / ".partial-layers.0006.exr-x.exr").write_bytes(b"half")
    (out / "layers.0007.exr").write_bytes((whole / "layers.0007.exr").read_bytes()[:500])
    again = subprocess.run(args, capture_output=True, text=True, timeout=300, check=False, env=environment)
    assert again.returncode == 0, again.stderr
    found = contents(out)
    assert found == contents(whole)


def test_several_processes_share_the_frames(capture: Path, made: Path, whole: Path, tmp_path: Path) -> None:
    assert cli.main(["bake", str(made), "--capture", str(capture), "--out", str(tmp_path / "out"), "--set",
                     "*.intensity=1", "--jobs", "2"]) == 0
    assert contents(tmp_path / "out") == contents(whole)
    assert len(read_manifest(tmp_path / "out")["frames"]) == 9


def test_a_job_that_fails_says_why_and_stops_the_others(capture: Path, made: Path, tmp_path: Path,
                                                        capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("a file where the folder should be")
    assert cli.main(["bake", str(made), "--capture", str(capture), "--out", str(tmp_path / "out"), "--jobs", "2",
                     "--progress", "openjd"]) == 1
    assert "openjd_fail: The path of a folder to create is a file" in capfd.readouterr().out


def test_every_capture_of_a_list_is_fitted(capture: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    listed = tmp_path / "captures.txt"
    listed.write_text(f"# the shoot\n{capture}\n{tmp_path / 'absent'}\n")
    job("fit.yaml", "Fit", "--tasks", '[{"Entry": "1"}]', Captures=listed, Entries="1-2", Out=tmp_path / "runs",
        Preset="draft", Set="iterations=3")
    assert (tmp_path / "runs" / capture.name / "flare.flare").is_file()
    args = [sys.executable, RUN, "fit", "--list", listed, "--out", tmp_path / "runs", "--resume"]
    assert cli.main([*map(str, args[2:]), "--entry", "3"]) == 2
    assert "lists 2 captures; --entry 3 is none of them" in capfd.readouterr().err
    # All of the list, one after the other: the first cannot be, the second is made all the same.
    listed.write_text(f"{tmp_path / 'absent'}\n{capture}\n")
    assert cli.main(["fit", "--list", str(listed), "--out", str(tmp_path / "all"), "--preset", "draft", "--set",
                     "iterations=3"]) == 1
    assert "absent is missing" in capfd.readouterr().err
    assert (tmp_path / "all" / capture.name / "flare.flare").is_file()


def test_a_transfer_runs_in_chunks(capture: Path, made: Path, tmp_path: Path) -> None:
    """A transfer to a shot runs as two tasks and writes its record."""
    flare = made / "flare.flare"
    name = read_look(flare).names[0]
    views = Capture.open(capture).views[:4]
    shot = Shot(flare, tuple(ShotFrame(number, "Camera", view.camera, (
        PlacedLight("sun", name, read_look(flare).lights[0].xyz + 3.0 * number),))
        for number, view in enumerate(views, 1)))
    shot.write(tmp_path / "shot.json")
    job("transfer.yaml", "Record", "--run-dependencies", Flare=flare, To=tmp_path / "shot.json", Out=tmp_path / "out",
        Frames="1-4", FramesPerTask=2, Query="blend", Set="")
    record = read_manifest(tmp_path / "out")
    assert [entry["frame"] for entry in record["frames"]] == [1, 2, 3, 4]
    assert not list((tmp_path / "out").rglob(".*"))


def test_plates_are_cleaned_in_chunks(tmp_path: Path) -> None:
    if not IN_THE_BOX.is_file():
        pytest.skip("the weights of removal are not there")
    for number in (2, 3, 4):  # few and small, since the network is the one in the box
        write_codes(tmp_path / "plates" / f"{number:04d}.png", picture(24, 32))
    log = job("remove.yaml", "Remove", "--tasks", '[{"Frame": "2-3"}, {"Frame": "4-4"}]', Plates=tmp_path / "plates",
              Out=tmp_path / "clean", Flares=tmp_path / "flares", Frames="2-4")
    assert re.findall(r"openjd_progress: (\d+)", log).count("100") == 2
    assert sorted(path.name for path in (tmp_path / "clean").iterdir()) == ["0002.png", "0003.png", "0004.png",
                                                                            MANIFEST]
    assert len(list((tmp_path / "flares").iterdir())) == 3
