# SPDX-License-Identifier: GPL-3.0-or-later
"""Which folders of layers are put together."""
from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.bake.exr import write_layers
from core.bake.folder import LayerFolder
from core.bake.layers import FrameLayers
from core.errors import FrameError
from core.images.window import DataWindow
from core.system.steps import finish


def frame(folder: Path, number: int, lights: Sequence[str]) -> Path:
    black = np.zeros((4, 6, 3), np.float32)
    path = folder / f"layers.{number:04d}.exr"
    write_layers(path, FrameLayers(black, dict.fromkeys(lights, black), np.ones((4, 6), np.float32)))
    return path


def test_frames_with_equal_layers_form_a_sequence_with_or_without_gaps(tmp_path: Path) -> None:
    files = {number: frame(tmp_path, number, ["sun", "lamp"]) for number in (0, 3, 4)}
    layers = LayerFolder.open(tmp_path)
    assert (layers.files, layers.first, layers.last, layers.size()) == (files, 0, 4, (6, 4))


def test_frames_with_other_layers_are_refused(tmp_path: Path) -> None:
    """Blender goes by the layers of the first: the lamp would be gone in silence."""
    frame(tmp_path, 1, ["sun"])
    frame(tmp_path, 2, ["sun"])
    frame(tmp_path, 3, ["sun", "lamp"])
    with pytest.raises(FrameError, match=r"two bakes.*layers\.0001\.exr has no others, layers\.0003\.exr .*lamp"):
        LayerFolder.open(tmp_path)


@pytest.mark.parametrize(("windows", "message"), [
    ([((6, 4), (-1, -1), (4, 2)), ((6, 4), (-2, -1), (4, 2))], "data windows differ"),
    ([((6, 4), (0, 0), (6, 4)), ((6, 4), (0, -1), (6, 3))], "data windows differ"),
    ([((6, 4), (1, 0), (8, 4))], "a part of its frame"),
    ([((6, 4), (-1, -1), (4, 2)), ((6, 4), (-1, -1), (4, 2))], ""),
    ([((6, 4), (0, 0), (6, 4)), ((3, 2), (0, 0), (3, 2))], ""),  # pictures of several sizes
])
def test_layers_that_blender_would_show_elsewhere_are_refused(tmp_path: Path, windows: Sequence[Any],
                                                              message: str) -> None:
    for number, window in enumerate(windows, 1):
        (width, height), _, _ = window
        black = np.zeros((height, width, 3), np.float32)
        write_layers(tmp_path / f"layers.{number:04d}.exr",
                     FrameLayers(black, {"sun": black}, np.ones((height, width), np.float32), DataWindow(*window)))
    with pytest.raises(FrameError, match=message) if message else contextlib.nullcontext():
        assert LayerFolder.open(tmp_path).window() == DataWindow(*windows[0])


def test_layers_in_subfolders_are_named(tmp_path: Path) -> None:
    (tmp_path / "cam0").mkdir()
    frame(tmp_path / "cam0", 1, ["sun"])
    with pytest.raises(FrameError, match=r"holds its layers in cam0; choose"):
        LayerFolder.open(tmp_path)
    with pytest.raises(FrameError, match="holds no baked layers"):
        LayerFolder.open(tmp_path / "absent")


def test_a_damaged_frame_is_named(tmp_path: Path) -> None:
    frame(tmp_path, 1, ["sun"])
    frame(tmp_path, 2, ["sun"]).write_bytes(b"torn")
    with pytest.raises(FrameError, match=r"layers\.0002\.exr is not an EXR"):
        LayerFolder.open(tmp_path)
    whole = frame(tmp_path, 2, ["sun"]).read_bytes()
    (tmp_path / "layers.0002.exr").write_bytes(whole[:-20])
    with pytest.raises(FrameError, match=r"layers\.0002\.exr ends before its last lines"):
        LayerFolder.open(tmp_path)


def test_a_folder_is_opened_in_steps_of_some_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.bake.folder.FRAMES_PER_STEP", 2)
    files = {number: frame(tmp_path, number, ["sun"]) for number in range(1, 6)}
    assert sum(1 for _ in LayerFolder.open_in_steps(tmp_path)) == 2
    assert finish(LayerFolder.open_in_steps(tmp_path)).files == files
    steps = LayerFolder.open_in_steps(tmp_path)
    next(steps)
    files[5].unlink()  # by a bake that begins anew
    with pytest.raises(FrameError, match=r"layers\.0005\.exr cannot be read"):
        finish(steps)
