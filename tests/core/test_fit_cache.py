# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of a fit are decoded once, whether they fit memory or not, and nothing goes wrong with a disk that does."""
from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from core.capture import Capture, View
from core.fit.cache import MIN_FREE_DISK, PictureCache
from core.fit.frames import Frames
from core.images.picture import Picture
from tests.core.captures import make_capture


def codes(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 65536, (6, 5, 3), np.uint16)


ROOM = 2 * codes(0).nbytes


def test_arrays_beyond_the_memory_limit_are_on_disk(tmp_path: Path) -> None:
    cache = PictureCache(ROOM)
    with cache.overflowing_into(tmp_path):
        for number in range(5):
            cache.put(f"{number}", codes(number))
        for number in (4, 0, 3, 1, 2):
            np.testing.assert_array_equal(cache.get(f"{number}"), codes(number))
        assert cache.get("5") is None
        assert os.name == "nt" or not list(tmp_path.iterdir()), "the file has no name"
    assert not list(tmp_path.iterdir())
    assert [cache.get(f"{number}") is None for number in range(5)] == [False, False, True, True, True]


def test_arrays_beyond_the_memory_limit_are_dropped_without_a_folder() -> None:
    cache = PictureCache(ROOM)
    for number in range(3):
        cache.put(f"{number}", codes(number))
    assert [cache.get(f"{number}") is None for number in range(3)] == [False, False, True]


def test_the_cache_leaves_free_space_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = MIN_FREE_DISK + codes(0).nbytes
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: SimpleNamespace(free=free))
    cache = PictureCache(0)
    with cache.overflowing_into(tmp_path):
        cache.put("fits", codes(0))
        free -= 1
        cache.put("does not", codes(1))
        np.testing.assert_array_equal(cache.get("fits"), codes(0))
        assert cache.get("does not") is None


def test_a_failing_disk_empties_the_cache_without_an_error(tmp_path: Path) -> None:
    cache = PictureCache(0)
    with cache.overflowing_into(tmp_path / "none"):
        cache.put("a", codes(0))
        assert cache.get("a") is None
    with cache.overflowing_into(tmp_path):
        cache.put("a", codes(0))
        assert cache._file is not None
        cache._file.truncate(10)
        assert cache.get("a") is None, "cut short"
        cache.put("b", codes(1))
        assert cache.get("b") is None, "and it is not asked again"


@pytest.mark.skipif(os.name == "nt", reason="limits of files are POSIX's")
@pytest.mark.parametrize("short", [1, 100, codes(0).nbytes])
def test_a_picture_cut_off_by_a_quota_is_not_cached(short: int, tmp_path: Path) -> None:
    import resource

    cache, before = PictureCache(0), resource.getrlimit(resource.RLIMIT_FSIZE)
    with cache.overflowing_into(tmp_path):
        cache.put("a", codes(0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (2 * codes(0).nbytes - short, before[1]))
        try:
            cache.put("b", codes(1))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert cache.get("b") is None


def test_a_frame_is_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture.open(make_capture(tmp_path / "c"))
    decode, decoded = capture.frame, []

    def counted(view: View, size: tuple[int, int] | None = None) -> Picture:
        decoded.append(view.name)
        return decode(view, size)

    monkeypatch.setattr(capture, "frame", counted)
    names = [view.name for view in capture.views]
    for memory, again in ((0, names[:1]), (1 << 20, [])):
        frames = Frames(capture, memory=memory)
        assert decoded == names[:1], "for its borders, of which it has none"
        with frames.cache.overflowing_into(tmp_path):
            first, second = ([frames.frame(view) for view in capture.views] for _ in range(2))
        assert all(map(torch.equal, first, second))
        assert decoded == names[:1] + again + names[1:]
        decoded.clear()
