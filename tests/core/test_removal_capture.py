# SPDX-License-Identifier: GPL-3.0-or-later
"""Clean frames of a capture."""
from __future__ import annotations

import contextlib
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.capture import Capture
from core.errors import Cancelled, CaptureError
from core.removal.inference.prediction import single_prediction
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
from core.removal.jobs.capture import UNFINISHED_FOLDER, _clean_names, clean_capture
from core.removal.jobs.provenance import check_clean_frames_current, has_exact_clean_frames
from core.system.progress import Progress
from tests.core.captures import make_capture
from tests.core.recording_progress import StopAfter
from tests.core.removal_cases import lit_street
from tests.core.test_capture_neighbours import turned_capture


def test_a_capture_is_cleaned_as_its_remover_says(tmp_path: Path, flare_everywhere: Path,
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    """A remover of all glow leaves none, and a later run with the same settings keeps its clean frames."""
    display, flare = (one[:, :224] for one in lit_street(10, level=0.7))  # as the network is shown it
    capture = Capture.open(make_capture(tmp_path / "capture", views=3))
    shutil.rmtree(capture.folder / "removed", ignore_errors=True)
    frames = [capture.frame_path(view) for view in capture.views]
    for frame in frames:
        cv2.imwrite(str(frame), (display * 255 + 0.5).astype(np.uint8))
    views = single_prediction(flare)._replace(glow_fraction=np.ones_like(flare))
    monkeypatch.setattr(Remover, "predict_with_tta", lambda *_: views)
    whole = Remover(flare_everywhere, working_size=224, glow="remove")
    clean_plates(frames, tmp_path / "plates", Remover(flare_everywhere, working_size=224), Progress())
    ours, plates = (cv2.imread(str(folder / frames[0].name)) for folder in
                    (clean_capture(capture, whole, Progress()), tmp_path / "plates"))
    assert (ours[58, 55:59] < plates[58, 55:59] - 5).all() and (ours[65, 65] == plates[65, 65]).all()
    assert clean_plates([capture.folder / "images"], capture.folder / "removed", whole, Progress())["made"] == 0


@pytest.mark.parametrize("orientation", [3, 6])
def test_clean_frames_of_turned_photographs_stand_as_their_frames(orientation: int, tmp_path: Path,
                                                                 flare_everywhere: Path) -> None:
    """JPEGs become PNGs, which have to keep the orientation and the profile."""
    capture = Capture.open(turned_capture(tmp_path / "c", orientation))
    assert all(view.upright for view in capture.views[2:3])
    clean_capture(capture, Remover(flare_everywhere, working_size=64), Progress())
    capture = Capture.open(capture.folder)
    for view in capture.views:
        frame, clean = capture.frame(view), capture.clean_frame(view)
        assert clean is not None and clean.size == frame.size
        ours, other = (np.corrcoef(frame.pixels.ravel(), pixels.ravel())[0, 1]
                       for pixels in (clean.pixels, clean.pixels[::-1, ::-1]))
        assert ours > max(0.9, other)


@pytest.mark.parametrize("by_the_fit", [True, False])
def test_clean_frames_of_changed_frames_are_refused(by_the_fit: bool, tmp_path: Path, flare_everywhere: Path) -> None:
    """A regraded capture under its old names: what was removed/ then is no truth now."""
    capture = Capture.open(make_capture(tmp_path / "capture", views=4))
    remover = Remover(flare_everywhere, working_size=64)
    removed = capture.folder / "removed"
    shutil.rmtree(removed, ignore_errors=True)
    if by_the_fit:
        clean_capture(Capture.open(capture.folder), remover, Progress())
    else:
        clean_plates([capture.folder / "images"], removed, remover, Progress())
    check_clean_frames_current(Capture.open(capture.folder))
    frame = capture.frame_path(capture.views[2])
    cv2.imwrite(str(frame), 255 - cv2.imread(str(frame)))
    with pytest.raises(CaptureError, match=rf"1 of the 4 clean frames .*\({frame.stem}"):
        check_clean_frames_current(Capture.open(capture.folder))
    (removed / "remove.json").unlink()  # someone's own
    check_clean_frames_current(Capture.open(capture.folder))


def test_clean_frames_are_estimates_until_all_are_edited(tmp_path: Path, flare_everywhere: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "capture", views=4))
    clean_capture(capture, Remover(flare_everywhere, working_size=64), Progress())
    made = Capture.open(capture.folder)
    for view in made.views:
        assert not has_exact_clean_frames(made)
        path = made.clean_frame_path(view)
        cv2.imwrite(str(path), cv2.imread(str(path)) // 2)
    assert has_exact_clean_frames(made)
    shutil.copy(made.frame_path(made.views[0]), made.clean_frame_path(made.views[0]))
    assert has_exact_clean_frames(made)
    (capture.folder / "removed" / "remove.json").unlink()
    assert has_exact_clean_frames(made), "someone's own"


def test_two_fits_clean_one_capture_at_once(tmp_path: Path, flare_everywhere: Path) -> None:
    """Frame by frame in turns: whichever is first, removed/ is whole."""
    capture = Capture.open(make_capture(tmp_path / "capture", views=4))
    remover = Remover(flare_everywhere, working_size=64)
    turn, failed = threading.Barrier(2), []

    class InTurns(Progress):
        def advance(self, steps: int = 1, **figures: float) -> None:
            with contextlib.suppress(threading.BrokenBarrierError):
                turn.wait(5)
            super().advance(steps, **figures)

    def clean() -> None:
        try:
            clean_capture(capture, remover, InTurns())
        except Exception as problem:
            failed.append(problem)
        turn.abort()

    both = [threading.Thread(target=clean) for _ in range(2)]
    for one in both:
        one.start()
    for one in both:
        one.join()
    assert not failed and not (capture.folder / UNFINISHED_FOLDER).exists()
    assert len(list((capture.folder / "removed").glob("*.png"))) == 4
    assert Capture.open(capture.folder).has_clean_frames


def test_a_stopped_cleaning_of_a_capture_resumes(tmp_path: Path, flare_everywhere: Path) -> None:
    """Finished frames are kept, and `remove` continues the folder by its manifest."""
    capture = Capture.open(make_capture(tmp_path / "capture", views=3))
    remover = Remover(flare_everywhere, working_size=64)
    shutil.rmtree(capture.folder / "removed", ignore_errors=True)
    with pytest.raises(Cancelled):
        clean_capture(capture, remover, StopAfter(1))
    first = next((capture.folder / UNFINISHED_FOLDER).rglob("*.png"))
    begun = first.stat().st_mtime_ns
    made = clean_capture(capture, remover, Progress())
    assert (made / first.name).stat().st_mtime_ns == begun
    frames = [capture.frame_path(view) for view in capture.views]
    assert clean_plates(frames, made, remover, Progress())["kept"] == 3
    assert clean_plates(frames, made, Remover(flare_everywhere, working_size=96), Progress())["made"] == 3


def test_frames_without_leading_zeros_are_predicted_once_each(
        tmp_path: Path, flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are cleaned in the order of their numbers, and a frame's neighbours have the numbers beside its own."""
    folder = make_capture(tmp_path / "capture", views=24)
    model = folder / "sparse" / "0" / "images.txt"
    words = model.read_text()
    for number in range(24):
        (folder / "images" / f"{number:04d}.png").rename(folder / "images" / f"{number}.png")
        words = words.replace(f" {number:04d}.png", f" {number}.png")
    model.write_text(words)
    remover = Remover(flare_everywhere, working_size=64)
    names, predicted = [], []
    to_network_input, predict_with_tta = remover.to_network_input, remover.predict_with_tta
    monkeypatch.setattr(remover, "to_network_input",
                        lambda plate: names.append(plate.path.name) or to_network_input(plate))
    monkeypatch.setattr(remover, "predict_with_tta",
                        lambda display: predicted.append(1) or predict_with_tta(display))
    clean_capture(Capture.open(folder), remover, Progress())
    assert len(names) == len(set(names)) == len(predicted) == 24


def test_frames_that_differ_only_in_suffix_are_refused_at_once(
        tmp_path: Path, flare_everywhere: Path) -> None:
    """Both frames would have the same clean frame."""
    folder = make_capture(tmp_path / "capture", views=3)
    model, frames = folder / "sparse" / "0" / "images.txt", folder / "images"
    model.write_text(model.read_text().replace(" 0001.png", " 0000.jpg"))
    cv2.imwrite(str(frames / "0000.jpg"), cv2.imread(str(frames / "0001.png")))
    with pytest.raises(CaptureError, match=r"0000\.jpg and 0000\.png of .* both have removed/0000\.png; give one"):
        clean_capture(Capture.open(folder), Remover(flare_everywhere, working_size=64), Progress())
    assert not (folder / UNFINISHED_FOLDER).exists() and not (folder / "removed").exists()


def test_a_second_fit_uses_what_the_first_has_cleaned(tmp_path: Path, flare_everywhere: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "capture", views=3))
    shutil.rmtree(capture.folder / "removed", ignore_errors=True)
    remover = Remover(flare_everywhere, working_size=64)

    class Meanwhile(Progress):
        def advance(self, steps: int = 1, **figures: float) -> None:
            if not (capture.folder / "removed").exists():
                clean_capture(capture, remover, Progress())
            super().advance(steps, **figures)

    assert clean_capture(capture, remover, Meanwhile()) == capture.folder / "removed"
    assert not (capture.folder / UNFINISHED_FOLDER).exists()
    assert Capture.open(capture.folder).has_clean_frames


def test_frames_with_one_clean_name_on_windows_are_refused(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "capture", 2))
    capture.views = (replace(capture.views[0], name="a.jpg"), replace(capture.views[1], name="A.png"))
    with pytest.raises(CaptureError, match=r"The frames a\.jpg and A\.png of .* would both have removed/A\.png"):
        _clean_names(capture)
