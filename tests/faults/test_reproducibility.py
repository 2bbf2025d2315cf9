# SPDX-License-Identifier: GPL-3.0-or-later
"""The first table of docs/reproducibility.md: the same command gives the same bytes, whatever the environment."""
from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers
from core.images.write import write_png
from tests.core.flared import flared_capture
from tests.core.removal_cases import network_file, picture
from tests.faults.cases import Snapshot, fit_argv, snapshot

ROOT = Path(__file__).resolve().parents[2]
VARY = {"run/metrics.jsonl", "run/log.txt", "trained/training.jsonl"}
"""Files with times."""
TRAINING = ["--set", "widths=[8,8,8,8,8]", "--set", "size_stages=[[1.0,64,64]]", "--set", "pixels_per_iteration=1",
            "--set", "bank_size=2", "--set", "canvas_size=64", "--iterations", "2", "--processes", "1", "--threads",
            "1"]
CODE = """import importlib.util, json, sys, torch
spec = importlib.util.spec_from_file_location("fit_flare_run", sys.argv[1])
run = importlib.util.module_from_spec(spec)
spec.loader.exec_module(run)
run.register_package()
torch.set_num_threads(1)
from fit_flare.headless import cli
sys.exit(max(cli.main(argv) for argv in json.loads(sys.argv[2])))"""


def results(out: Path, capture: Path, weights: Path, backgrounds: Path, working_folder: Path,
            **environment: str) -> Snapshot:
    """Fit, bake, export, transfer, clean and train in one process; return the hashes of all files but those that vary.

    working_folder: the process's. environment: variables of the process to set.
    """
    import json

    run = f"{out}/run"
    commands = [fit_argv(capture, out / "run"), ["bake", run, "--out", f"{out}/layers", "--frames", "1-2"],
                ["export", run, "--as", "preset", "--out", f"{out}/lamp.json"],
                ["export", run, "--as", "ply", "--out", f"{out}/ply", "--frames", "1"],
                ["transfer", f"{run}/flare.flare", "--to", str(capture), "--out", f"{out}/added", "--frames", "1"],
                ["remove", str(capture / "images"), "--out", f"{out}/clean", "--weights", str(weights), "--frames",
                 "1", "--stills", "--working-size", "256"],
                ["remove", "--run", run, "--out", f"{out}/subtracted", "--frames", "1"],
                ["train-removal", "--backgrounds", str(backgrounds), "--out", f"{out}/trained", *TRAINING]]
    working_folder.mkdir(exist_ok=True)
    done = subprocess.run([sys.executable, "-P", "-c", CODE, str(ROOT / "headless" / "run.py"), json.dumps(commands)],
                          cwd=working_folder, env={**os.environ, **environment}, capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stderr
    return {name: value for name, value in snapshot(out).items() if name not in VARY}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no TZ")
def test_the_same_commands_give_the_same_bytes(tmp_path: Path) -> None:
    """Two processes with another hash seed, time zone, language and working folder write to the same place."""
    capture, weights = flared_capture(tmp_path / "capture", count=7, dots=60), tmp_path / "weights.safetensors"
    network_file(weights, bias=0.2)
    backgrounds = tmp_path / "backgrounds"
    write_png(backgrounds / "a.png", picture(200, 300).astype("float32") / 255)
    out = tmp_path / "out"
    first = results(out, capture, weights, backgrounds, tmp_path, PYTHONHASHSEED="1", TZ="UTC")
    out.rename(tmp_path / "first")
    second = results(out, capture, weights, backgrounds, tmp_path / "elsewhere", PYTHONHASHSEED="2", TZ="Asia/Tokyo",
                     LANG="C", LC_ALL="C")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    assert {"run/flare.flare", "run/scene.ply", "lamp.json", "layers/layers.0001.exr",
            "trained/removal.safetensors", "trained/checkpoint.safetensors"} <= first.keys()


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="there is no bpy package (`make setup`)")
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no TZ")
def test_the_same_layers_give_the_same_frames(tmp_path: Path) -> None:
    """Two Blenders with another hash seed, time zone and working folder write to the same place."""
    random = np.random.default_rng(0)
    light = random.random((2, 12, 16, 3), np.float32)
    write_layers(tmp_path / "layers" / "layers.0001.exr", FrameLayers(light[0], {"lamp": light[1]},
                                                                      np.ones((12, 16), np.float32)))
    out, found = tmp_path / "frames", []
    for seed, zone in (("1", "UTC"), ("2", "Asia/Tokyo")):
        (tmp_path / zone).mkdir(parents=True)
        done = subprocess.run([sys.executable, str(ROOT / "headless" / "run.py"), "compose", str(tmp_path / "layers"),
                               "--out", str(out), "--step", "compose"], cwd=tmp_path / zone, capture_output=True,
                              env={**os.environ, "PYTHONHASHSEED": seed, "TZ": zone}, text=True, check=False)
        assert done.returncode in (0, -11), done.stderr  # Blender as a module may crash at its end
        found.append({name: value for name, value in snapshot(out).items() if not name.startswith("compositor")})
        out.rename(tmp_path / f"frames of {seed}")
    assert found[0] == found[1]
    assert found[0].keys() == {"frame.0001.exr", "frame.0001.png"}


def test_the_table_names_tests_that_exist() -> None:
    import re

    text = (ROOT / "docs" / "reproducibility.md").read_text(encoding="utf-8")
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)
    assert len(named) >= 4
    for file, name in named:
        assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8"), f"{file}::{name}"
