# SPDX-License-Identifier: GPL-3.0-or-later
"""The loop that writes clean frames: writing overlaps cleaning; errors and stops concern the right frames."""
from __future__ import annotations

import threading
from pathlib import Path

import pytest

from core.errors import Cancelled, FrameError
from core.removal.jobs.clean_frames import CleanFrame, PreparedResults, write_clean_frames
from core.removal.jobs.manifest import Manifest
from core.system.progress import Progress

DEADLINE_S = 20


class CountingProgress(Progress):
    """Progress that counts its steps."""

    steps = 0

    def advance(self, steps: int = 1, **figures: float) -> None:
        self.steps += steps
        super().advance(steps, **figures)


def frames_in(folder: Path, *names: str) -> list[CleanFrame]:
    """Return a frame for each name, whose source exists and whose result lies in `folder`/out."""
    (folder / "out").mkdir()
    for name in names:
        (folder / name).write_text(f"as filmed: {name}")
    return [CleanFrame(Path(name), folder / name, [folder / "out" / name]) for name in names]


def prepare_by_name(frame: CleanFrame) -> PreparedResults:
    """Return the result of a frame: a text with its name."""
    return PreparedResults(lambda: frame.results[0].write_text(f"clean: {frame.name}") and None)


def test_a_frame_is_written_while_the_next_is_cleaned(tmp_path: Path) -> None:
    frames = frames_in(tmp_path, "a", "b")
    next_has_started, written_in_time = threading.Event(), list[bool]()

    def clean(frame: CleanFrame) -> PreparedResults:
        if frame.name.name == "b":
            next_has_started.set()
            return prepare_by_name(frame)

        def write() -> None:
            written_in_time.append(next_has_started.wait(DEADLINE_S))
            frame.results[0].write_text("clean: a")
        return PreparedResults(write)

    written, kept_counts = write_clean_frames(frames, Manifest(tmp_path / "out"), Progress(), digest=lambda _: "1",
                                              clean=clean, keep_finished=True, overwrite=False)
    assert (written, kept_counts.total(), written_in_time) == (2, 0, [True])
    assert [path.read_text() for frame in frames for path in frame.results] == ["clean: a", "clean: b"]
    assert list(Manifest(tmp_path / "out").unedited_frames([Path("a"), Path("b")])) == [Path("a"), Path("b")]


def test_errors_of_cleaning_and_writing_are_reported_in_the_order_of_the_frames(tmp_path: Path) -> None:
    frames, failures, progress = frames_in(tmp_path, "a", "b", "c"), list[tuple[str, str]](), CountingProgress()

    def clean(frame: CleanFrame) -> PreparedResults:
        def fail() -> None:
            raise FrameError(f"cannot write {frame.name}")
        if frame.name.name == "a":
            return PreparedResults(fail)
        if frame.name.name == "b":
            raise FrameError("cannot read b")
        return prepare_by_name(frame)

    written, _ = write_clean_frames(frames, Manifest(tmp_path / "out"), progress, digest=lambda _: "1", clean=clean,
                                    keep_finished=True, overwrite=False,
                                    on_error=lambda frame, error: failures.append((frame.name.name, str(error))))
    assert written == 1
    assert failures == [("a", "cannot write a"), ("b", "cannot read b")]
    assert progress.steps == 3


def test_an_unlisted_file_in_the_place_of_a_result_fails_only_its_frame(tmp_path: Path) -> None:
    frames, failures, progress = frames_in(tmp_path, "a", "b", "c"), list[str](), CountingProgress()
    (tmp_path / "out" / "b").write_text("not in the manifest")
    written, _ = write_clean_frames(frames, Manifest(tmp_path / "out"), progress, digest=lambda _: "1",
                                    clean=prepare_by_name, keep_finished=True, overwrite=False,
                                    on_error=lambda frame, _: failures.append(frame.name.name))
    assert (written, failures, progress.steps) == (2, ["b"], 3)
    assert (tmp_path / "out" / "b").read_text() == "not in the manifest"


@pytest.mark.parametrize("stop", [Cancelled("stopped"), KeyboardInterrupt()], ids=["cancelled", "interrupted"])
def test_a_frame_that_is_being_written_at_a_stop_counts_as_written(tmp_path: Path, stop: BaseException) -> None:
    """Else a person would seem to have edited it."""
    frames = frames_in(tmp_path, "a", "b")

    def clean(frame: CleanFrame) -> PreparedResults:
        if frame.name.name == "b":
            raise stop
        return prepare_by_name(frame)

    with pytest.raises(type(stop)):
        write_clean_frames(frames, Manifest(tmp_path / "out"), Progress(), digest=lambda _: "1", clean=clean,
                           keep_finished=True, overwrite=False)
    written, kept_counts = write_clean_frames(frames, Manifest(tmp_path / "out"), Progress(), digest=lambda _: "1",
                                              clean=prepare_by_name, keep_finished=True, overwrite=False)
    assert (written, dict(kept_counts)) == (1, {"up to date": 1})
    assert list(Manifest(tmp_path / "out").unedited_frames([Path("a"), Path("b")])) == [Path("a"), Path("b")]
