# SPDX-License-Identifier: GPL-3.0-or-later
"""What is opened is looked at first: nothing waits for a pipe, reads a device, or takes values that no code can use."""
from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from core.bake.bake import read_manifest
from core.capture import Capture, read_lights
from core.colour.ocio import ocio_space
from core.conventions import exposures
from core.errors import FitFlareError, SpecialFileError, os_error_message
from core.fit.run import Run
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.video import Video
from core.look import read_look
from core.look.keyed import KeyedEdits
from core.system import reading, tensor_files
from core.system.files import atomic_path, file_lock, read_json, write_text
from core.system.reading import append_text, open_regular, parse_json, parse_toml, read_bytes, read_text
from tests.core.flared import flared_capture

TIME_LIMIT_S = 20.0
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pipes among files")


def outcome(action: Callable[[], Any]) -> BaseException | None:
    """Return what a call raises, or None; fails if the call still waits after `TIME_LIMIT_S`."""
    raised: list[BaseException | None] = []

    def call() -> None:
        try:
            action()
            raised.append(None)
        except BaseException as problem:
            raised.append(problem)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(TIME_LIMIT_S)
    assert raised, "the call waits"
    return raised[0]


def special(path: Path, kind: str) -> Path:
    """Put a pipe, a socket or a link to an endless device at the path; return the path."""
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            here = Path.cwd()
            os.chdir(path.parent)  # a socket's name may not be long
            try:
                bound.bind(path.name)
            finally:
                os.chdir(here)
    else:
        path.symlink_to("/dev/zero")
    return path


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_a_special_file_is_refused_by_name(tmp_path: Path, kind: str) -> None:
    path = special(tmp_path / "x", kind)
    for action in (lambda: open_regular(path), lambda: read_bytes(path), lambda: read_text(path),
                   lambda: append_text(path, "line\n"), lambda: tensor_files.read_tensors(path),
                   lambda: write_text(path, "result")):
        problem = outcome(action)
        assert isinstance(problem, SpecialFileError)
        assert str(path) in os_error_message(problem)
    assert path.is_fifo() or path.is_socket() or path.is_symlink()


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_every_reader_refuses_a_special_file(tmp_path: Path, kind: str) -> None:
    readers: dict[str, Callable[[Path], Any]] = {
        "a.png": read_plate, "b.tif": read_plate, "c.exr": read_picture, "d.mp4": Video,
        "lights.json": read_lights, "look.flare": read_look, "edits.toml": KeyedEdits.read,
        "edits.json": KeyedEdits.read,
        "config.ocio": lambda path: ocio_space("linear", path), "exposures.json": lambda path: exposures.read_exposures(
            path.parent), "bake.json": lambda path: read_manifest(path.parent)}
    for name, reader in readers.items():
        path = special(tmp_path / name, kind)
        problem = outcome(lambda reader=reader, path=path: reader(path))  # type: ignore[misc]
        assert isinstance(problem, FitFlareError | SpecialFileError), name
        assert str(path) in str(problem), name


@pytest.mark.parametrize("name", ["lights.json", "split.json", "transforms.json", "images/0001.png"])
def test_a_pipe_in_a_capture_is_no_hang(tmp_path: Path, name: str) -> None:
    capture = flared_capture(tmp_path / "capture", count=4, dots=20)
    path = capture / name
    if not path.parent.is_dir():
        pytest.skip(f"the capture has no {name}")
    frame = next((capture / "images").iterdir())
    special(frame if name.startswith("images") else path, "pipe")

    def use() -> None:
        opened = Capture.open(capture)
        for view in opened.views:
            opened.frame(view)

    problem = outcome(use)
    assert isinstance(problem, FitFlareError | SpecialFileError) or name == "transforms.json"


def test_a_pipe_in_a_run_is_no_hang(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text('mode = "split"\n')
    os.mkfifo(tmp_path / "capture.txt")
    assert isinstance(outcome(lambda: Run.open(tmp_path)), FitFlareError)


def test_a_text_has_a_bound(tmp_path: Path) -> None:
    """A text file of a terabyte is refused, and not read into memory."""
    path = tmp_path / "large.json"
    with open(path, "wb") as stream:
        stream.truncate(1 << 40)
    problem = outcome(lambda: read_json(path, FitFlareError))
    assert isinstance(problem, FitFlareError)
    assert "bytes" in str(problem)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, r'["\u0000"]', r'["\ud800"]', r'{"\ud800": 1}',
                                  '{"a": 1, "a": 2}'])
def test_text_that_no_code_can_use_is_refused(text: str) -> None:
    """JSON that nests too deeply, holds a NUL or half a surrogate pair, or repeats a key is refused."""
    with pytest.raises(ValueError, match=" "):
        parse_json(text)


def test_a_name_that_is_not_utf8_survives() -> None:
    assert parse_json(r'["\udcff", "\ud83d\ude00"]') == ["\udcff", "\U0001f600"]


def test_a_number_beyond_floats_is_infinite() -> None:
    assert parse_json("[1" + "0" * 400 + ", 12]") == [float("inf"), 12]


def test_toml_that_nests_deeply_is_refused() -> None:
    with pytest.raises(ValueError, match=" "):
        parse_toml("a = " + "[" * 100_000)


def test_a_lock_that_cannot_be_removed_does_not_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock = tmp_path / ".bake.lock"
    with monkeypatch.context() as patched:
        def refuse(*_: Any) -> None:
            raise PermissionError(13, "denied")

        patched.setattr(Path, "unlink", refuse)
        with file_lock(lock):
            pass
    assert lock.exists()

    def take() -> None:
        with file_lock(lock, stale_s=TIME_LIMIT_S * 2):
            pass

    assert outcome(take) is None
    assert not lock.exists()


def test_a_pipe_that_lies_where_a_result_goes_stays(tmp_path: Path) -> None:
    path = tmp_path / "result.png"
    os.mkfifo(path)
    with pytest.raises(SpecialFileError), atomic_path(path) as temporary:
        cv2.imwrite(str(temporary), np.zeros((2, 2), np.uint8))
    assert path.is_fifo()
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs a file that states no size")
def test_a_file_without_a_size_is_whole_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = read_bytes("/proc/self/status")
    assert len(whole) > 100
    monkeypatch.setattr(reading, "_MAX_UNSIZED_BYTES", 100)
    for limit in (None, 10**6):
        with pytest.raises(OSError, match="more than 100 bytes"):
            read_bytes("/proc/self/status", limit)
