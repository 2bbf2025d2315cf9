# SPDX-License-Identifier: GPL-3.0-or-later
"""Rooms without flare for trainings: of what they may show, the same again, and not made twice."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.images.read import read_picture
from core.images.write import write_png
from core.removal.training.backgrounds import is_held_out

ROOT = Path(__file__).parents[2]
SMALL = """
import sys
from sample_scenes import random_room, rooms
random_room.SIZE, random_room.SAMPLES = (64, 48), 2
sys.exit(rooms.main())
"""


def made(*args: str | Path) -> subprocess.CompletedProcess[str]:
    """`rooms.py` with smaller pictures, in a process of its own: Blender's module does not like others beside it."""
    return subprocess.run([sys.executable, "-W", "ignore", "-c", SMALL, *map(str, args)], cwd=ROOT,
                          capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    photos, maps = tmp_path_factory.mktemp("photos"), tmp_path_factory.mktemp("maps")
    random = np.random.default_rng(1)
    for number in range(3):
        write_png(photos / f"{number}.png", random.random((40, 60, 3), np.float32))
    for number in range(2):
        cv2.imwrite(str(maps / f"{number}.hdr"), random.random((16, 32, 3), np.float32) * 2)
    return photos, maps


def test_rooms_are_functions_of_their_numbers_and_none_is_rendered_twice(sources: tuple[Path, Path],
                                                                         tmp_path: Path) -> None:
    photos, maps = sources
    args = ("--photos", photos, "--maps", maps)
    first = made("--out", tmp_path / "one", "--count", 3, *args)
    assert first.returncode == 0, first.stderr
    names = [f"room_{number:05d}.png" for number in range(3)]
    one = [read_picture(tmp_path / "one" / name).pixels for name in names]
    for picture in one:
        assert sorted(picture.shape) == [3, 48, 64]
    assert max(float(picture.std()) for picture in one) > 0.05
    assert not np.array_equal(one[0], one[1])

    kept, worked_on = (tmp_path / "one" / name for name in names[:2])
    before = kept.stat().st_mtime_ns
    worked_on.unlink()
    assert made("--out", tmp_path / "one", "--count", 3, *args).returncode == 0
    assert kept.stat().st_mtime_ns == before
    assert np.abs(read_picture(worked_on).pixels - one[1]).mean() < 0.02  # but for the order of sums


def test_rooms_use_no_held_out_pictures_and_refuse_an_empty_folder(sources: tuple[Path, Path],
                                                                   tmp_path: Path) -> None:
    held_out = next(name for name in (f"{number}.png" for number in range(1000)) if is_held_out(name))
    write_png(tmp_path / held_out, np.zeros((40, 60, 3), np.float32))
    refused = made("--out", tmp_path / "out", "--photos", tmp_path, "--maps", sources[1])
    assert refused.returncode == 1
    assert f"{tmp_path} holds none of .jpeg, .jpg" in refused.stderr
    assert not (tmp_path / "out").exists()


def test_rooms_refuse_unreadable_pictures_and_a_count_of_0(sources: tuple[Path, Path],
                                                           tmp_path: Path) -> None:
    broken = tmp_path / "photos" / "broken.png"
    broken.parent.mkdir()
    broken.write_bytes(b"no picture")
    args = ("--out", tmp_path / "out", "--photos", broken.parent, "--maps", sources[1])
    refused = made(*args, "--count", 8)  # of eight rooms one shows a photograph for certain
    assert refused.returncode == 1
    assert f"{broken} cannot be read" in refused.stderr
    assert "1 or more, not 0" in made(*args, "--count", 0).stderr
