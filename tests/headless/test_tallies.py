# SPDX-License-Identifier: GPL-3.0-or-later
"""The last line of a command counts what it used and what it left out, and names the first few with the reason."""
from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from fit_flare.headless.tallies import tally_capture, tally_solve

from core.capture import Capture
from core.images.listing import unlisted_entries
from tests.core.captures import make_transforms, picture
from tests.core.flared import flared_capture

RUN = Path(__file__).resolve().parents[2] / "headless" / "run.py"


def run(*args: object) -> tuple[int, list[dict[str, Any]]]:
    """Exit status and events."""
    done = subprocess.run([sys.executable, str(RUN), *map(str, args), "--progress", "json"], capture_output=True,
                          text=True, check=False)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def test_what_is_passed_over_in_a_folder_has_a_reason(tmp_path: Path) -> None:
    for name in ("f1.png", "f10.png", "f2.png", "a/b/g.png", ".hidden.png", "Thumbs.db"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture(0))
        (tmp_path / f"{name}.png").rename(tmp_path / name)
    for name in ("notes.txt", "cut.mov", "sidecar.xmp", "README"):
        (tmp_path / name).write_text("")
    (tmp_path / "empty").mkdir()
    (tmp_path / "gone.png").symlink_to("nowhere.png")
    assert sorted(unlisted_entries(tmp_path)) == sorted([
        ("a subfolder with 1 picture", ["a"]), ("a video, which is read by its own name", ["cut.mov"]),
        ("a link to a missing file", ["gone.png"]), ("TXT is not read here", ["notes.txt"]),
        ("not a picture", ["README"]), ("XMP is not read here", ["sidecar.xmp"])])


def test_a_solve_counts_frames_and_other_files(tmp_path: Path) -> None:
    (tmp_path / "in a" / "second").mkdir(parents=True)
    for name in ("f 1.png", "f 2.png", "second/f3.png"):
        cv2.imwrite(str(tmp_path / "in a" / name), picture(0))
    (tmp_path / "in a" / "cut.mov").write_text("")
    report = {"registered": 8, "unregistered": ["f9.png"],
              "left_out": [f"{tmp_path / 'in a' / 'f 2.png'} is damaged or truncated (in its "
                           "header); export it again."]}
    tally = tally_solve(report, tmp_path / "in a")
    assert tally.summary() == ("8 frames placed; 4 left out: f9.png (no place in the model), f 2.png (is damaged or "
                                "truncated), cut.mov (a video, which is read by its own name), second (a subfolder "
                                "with 1 picture).")


def test_the_commands_of_a_capture_count_its_frames_last(tmp_path: Path) -> None:
    folder = flared_capture(tmp_path / "c", 8)
    names = [path.name for path in sorted((folder / "images").iterdir())]
    cv2.imwrite(str(folder / "images" / "extra.png"), np.zeros((40, 64, 3), np.uint8))
    status, events = run("fit", folder, "--out", tmp_path / "run", "--preset", "draft", "--iterations", 3,
                         "--set", "flare.count=20", "--set", "flare.occlusion=false")
    assert status == 0, events
    texts = [event["text"] for event in events if event["type"] == "say"]
    assert texts[0].startswith("8 of 9 frames in") and "not extra.png" in texts[0], "before the work"
    assert texts[-1] == "8 frames used; 1 left out: extra.png (no pose)."
    assert events[-1]["data"]["tally"] == {"used": 8, "left_out": 1,
                                           "skipped": [{"name": "extra.png", "reason": "no pose"}]}
    status, events = run("eval", tmp_path / "run", "--views", "all")
    assert status == 0 and [event["text"] for event in events if event["type"] == "say"][-1] == (
        "8 frames scored; 1 left out: extra.png (no pose).")
    (folder / "lights.json").unlink()
    (folder / "images" / names[3]).unlink()
    _, events = run("lights", folder)
    texts = [event["text"] for event in events if event["type"] == "say"]
    assert "1 poses have no frame" in texts[0]
    if events[-1]["type"] == "result":
        assert texts[-1].startswith("7 frames searched; 2 left out:")


def test_views_in_no_list_are_left_out(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "c", 5, train_filenames=["images/0000.png", "images/0001.png"],
                             test_filenames=["images/0003.png"])
    capture = Capture.open(folder)
    train, held_out = capture.split(None)
    assert len(train) == 2 and len(held_out) == 1
    assert tally_capture(capture, "searched").summary() == "5 frames searched, none left out."
