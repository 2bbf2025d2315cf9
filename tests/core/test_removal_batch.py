# SPDX-License-Identifier: GPL-3.0-or-later
"""Removal of many plates: which files are plates, and which errors end the batch."""
from __future__ import annotations

import errno
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from core.errors import FrameError, SettingsError
from core.images.plates import Plate, read_plate
from core.images.write import write_exr
from core.removal.inference.remover import Remover
from core.removal.jobs import batch
from core.removal.jobs.batch import clean_plates, collect_plates
from core.removal.jobs.manifest import MANIFEST
from core.removal.jobs.mattes import Mattes
from core.system.progress import Progress
from tests.core.recording_progress import RecordingProgress
from tests.core.removal_cases import picture, write_codes


def write_bad_files(folder: Path) -> list[Path]:
    """Write files that are no pictures, are cut off, or have no colour; return their paths."""
    folder.mkdir(parents=True)
    (folder / "text.png").write_text("not a picture")
    (folder / "empty.jpg").write_bytes(b"")
    whole = write_codes(folder / "cut.png", picture())
    whole.write_bytes(whole.read_bytes()[:400])
    write_exr(folder / "cut.exr", dict.fromkeys("RGB", picture()[..., 0] / np.float32(255)))
    (folder / "cut.exr").write_bytes((folder / "cut.exr").read_bytes()[:-100])
    (folder / "bad.exr").write_bytes(b"\x76\x2f\x31\x01 and no more")
    write_exr(folder / "no_colour.exr", {"Z": np.ones((4, 4))})
    return sorted(folder.iterdir())


def test_unreadable_plates_do_not_stop_the_others(tmp_path: Path, flare_everywhere: Path) -> None:
    bad = write_bad_files(tmp_path / "in")
    write_codes(tmp_path / "in" / "good.png", picture())
    with pytest.raises(FrameError) as error:
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    assert f"{len(bad)} of {len(bad) + 1} plates" in str(error.value)
    assert all(path.name in str(error.value) for path in bad)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["good.png", MANIFEST]


@pytest.mark.parametrize(("kind", "named", "depth", "channels"), [
    (".png", "a.jpg", np.uint16, 3), (".png", "a.jpeg", np.uint8, 4), (".tiff", "a.png", np.float32, 3)])
def test_a_plate_under_the_suffix_of_another_format_keeps_depth_and_alpha(
        tmp_path: Path, flare_everywhere: Path, kind: str, named: str, depth: type, channels: int) -> None:
    """The format of the suffix would bring its numbers to 8 bit, or leave its alpha out."""
    codes = np.full((48, 64, channels), 0.7, np.float32) if depth is np.float32 else np.full(
        (48, 64, channels), np.iinfo(depth).max * 2 // 3, depth)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / named).write_bytes(cv2.imencode(kind, codes)[1].tobytes())
    said = RecordingProgress()
    clean_plates([tmp_path / "in"], tmp_path / "out", Remover(flare_everywhere, working_size=64), said)
    before, after = (read_plate(tmp_path / folder / named) for folder in ("in", "out"))
    assert after.codes.dtype == before.codes.dtype == depth and (after.codes < before.codes).any()
    assert (after.alpha is None) == (channels == 3)
    assert any(f"{named} holds {'PNG' if kind == '.png' else 'TIFF'} data, whatever its name" in sentence
               for sentence in said.texts)


@pytest.mark.skipif(os.name == "nt", reason="links want rights on Windows")
def test_a_broken_link_is_reported_as_a_missing_plate(tmp_path: Path, flare_everywhere: Path) -> None:
    """A disk that is not mounted would leave a hole in the shot, and all would be said to be well."""
    for name in ("a.1", "a.3"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    (tmp_path / "in" / "a.2.png").symlink_to(tmp_path / "away" / "a.2.png")
    with pytest.raises(FrameError, match=r"1 of 3 plates could not be cleaned: .*a\.2\.png is missing"):
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    assert (tmp_path / "out" / "a.3.png").exists()


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_results_are_refused_where_a_file_is(tmp_path: Path, flare_everywhere: Path, place: str) -> None:
    """A file in place of the output folder is an error before the network runs on any plate."""
    source = write_codes(tmp_path / "in" / "a.png", picture())
    (tmp_path / "file").touch()
    for folders in ({"folder": tmp_path / place}, {"folder": tmp_path / "out", "flare_folder": tmp_path / place}):
        with pytest.raises(SettingsError, match=r"file is not a folder, so .* cannot be written to; choose another"):
            clean_plates([source], remover=Remover(flare_everywhere, working_size=64), progress=Progress(), **folders)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name == "nt", reason="links want rights on Windows")
def test_a_link_to_itself_does_not_stop_the_others(tmp_path: Path, flare_everywhere: Path) -> None:
    write_codes(tmp_path / "in" / "a.1.png", picture())
    (tmp_path / "in" / "a.0.png").symlink_to(tmp_path / "in" / "a.0.png")
    with pytest.raises(FrameError, match=r"1 of 2 plates could not be cleaned: .*a\.0\.png is missing: it is a link"):
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    assert (tmp_path / "out" / "a.1.png").exists()


def test_a_full_disk_ends_the_batch(tmp_path: Path, no_flare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other refusals of the system are reported for each plate."""
    for name in ("a", "b", "c"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    tried: list[str] = []

    def refused(number: int) -> Any:
        def write(results: Sequence[Path], *_: object) -> None:
            tried.append(results[0].name)
            raise OSError(number, os.strerror(number), str(results[0]))
        return write

    monkeypatch.setattr(batch, "write_view_results", refused(errno.ENOSPC))
    with pytest.raises(OSError) as full:
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(no_flare, working_size=64), Progress())
    assert (full.value.errno, tried) == (errno.ENOSPC, ["a.png"])
    monkeypatch.setattr(batch, "write_view_results", refused(errno.EACCES))
    with pytest.raises(FrameError, match=r"3 of 3 plates could not be cleaned: The system refused: Permission denied"):
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(no_flare, working_size=64), Progress())


@pytest.mark.parametrize("short", [
    MemoryError("Unable to allocate 3.00 GiB for an array"),
    cv2.error("OpenCV(5.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 9000000000 bytes"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory")])
def test_a_plate_that_does_not_fit_into_memory_is_left_out(tmp_path: Path, no_flare: Path, short: Exception,
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    to_network_input = Remover.to_network_input

    def network_input_or_error(remover: Remover, plate: Plate) -> Any:
        if plate.path.name == "a.png":
            raise short
        return to_network_input(remover, plate)

    monkeypatch.setattr(Remover, "to_network_input", network_input_or_error)
    with pytest.raises(FrameError, match=r"1 of 2 plates could not be cleaned: \S*a\.png does not fit into memory"):
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(no_flare, working_size=64), Progress())
    assert (tmp_path / "out" / "b.png").exists()


def test_what_is_left_out_is_counted_and_named(tmp_path: Path, no_flare: Path) -> None:
    for name in ("a", "b", "sub/c"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    (tmp_path / "in" / "damaged.png").write_bytes((tmp_path / "in" / "a.png").read_bytes()[:100])
    (tmp_path / "in" / "clip.mp4").write_bytes(b"")
    (tmp_path / "in" / "sub" / "notes.txt").write_text("notes")
    progress, sentences = Progress(), list[str]()
    progress.say = sentences.append  # type: ignore[method-assign]
    remover = Remover(no_flare, working_size=64)
    with pytest.raises(FrameError, match="1 of 4 plates"):
        clean_plates([tmp_path / "in"], tmp_path / "in" / "out", remover, progress)
    assert sentences[-1].startswith("3 plates cleaned; 3 left out: ")
    for text in ("clip.mp4", "sub/notes.txt", "damaged.png (could not be cleaned)"):
        assert text in sentences[-1]
    (tmp_path / "in" / "damaged.png").unlink()
    done = clean_plates([tmp_path / "in"], tmp_path / "in" / "out", remover, progress)  # its own results are no inputs
    assert (done["used"], done["left_out"]) == (3, 2)


def test_a_programming_error_is_not_taken_for_a_bad_plate(tmp_path: Path, no_flare: Path,
                                                          monkeypatch: pytest.MonkeyPatch) -> None:
    write_codes(tmp_path / "in" / "a.png", picture())
    monkeypatch.setattr(Remover, "to_network_input", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(no_flare, working_size=64), Progress())


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS])
def test_a_read_only_folder_ends_the_batch(tmp_path: Path, no_flare: Path, number: int,
                                           monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b", "c"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    opened, tried = os.open, []

    def refuse(path: Any, flags: int, *args: Any, **options: Any) -> int:
        if Path(path).parent != tmp_path / "out" or not flags & (os.O_WRONLY | os.O_RDWR):  # reading is possible
            return opened(path, flags, *args, **options)
        tried.append(path)
        raise OSError(number, os.strerror(number), path)

    monkeypatch.setattr("core.system.files._MAX_REFUSALS", 0)
    monkeypatch.setattr("core.system.files.os.open", refuse)
    with pytest.raises(FrameError, match=r"^[^ ]*out cannot be written to \([^)]*\); choose another folder"):
        clean_plates([tmp_path / "in"], tmp_path / "out", Remover(no_flare, working_size=64), Progress())
    assert len(tried) == 1


def test_inputs_without_plates_or_with_one_name_are_refused(tmp_path: Path, flare_everywhere: Path) -> None:
    source = write_codes(tmp_path / "plate.png", picture())
    remover = Remover(flare_everywhere, working_size=64)
    with pytest.raises(SettingsError, match="overwritten"):
        clean_plates([source], tmp_path, remover, Progress())
    (tmp_path / "other").mkdir()
    with pytest.raises(SettingsError, match="no pictures"):
        collect_plates([tmp_path / "other"])
    twin = write_codes(tmp_path / "other" / "plate.png", picture())
    with pytest.raises(SettingsError, match="same file"):
        collect_plates([source, twin])
    with pytest.raises(SettingsError, match="same file"):  # on Windows and macOS
        collect_plates([source, twin.rename(twin.with_name("Plate.PNG"))])


def test_no_input_is_overwritten_and_no_result_written_twice(tmp_path: Path, no_flare: Path) -> None:
    shot, remover = tmp_path / "shot", Remover(no_flare, working_size=64)
    write_exr(shot / "a.exr", dict.fromkeys("RGB", np.full((60, 90), 0.5)))
    before = (shot / "a.exr").read_bytes()
    with pytest.raises(SettingsError, match=r"a\.exr would be overwritten"):
        clean_plates([shot], tmp_path / "out", remover, Progress(), flare_folder=shot)
    with pytest.raises(SettingsError, match="Two results"):
        clean_plates([shot], tmp_path / "out", remover, Progress(), flare_folder=tmp_path / "out")
    write_codes(shot / "a.png", picture())
    with pytest.raises(SettingsError, match="Two results"):
        clean_plates([shot], tmp_path / "out", remover, Progress(), flare_folder=tmp_path / "flare")
    assert (shot / "a.exr").read_bytes() == before and not (tmp_path / "out").exists()
    matte = write_codes(tmp_path / "roto" / "a.png", picture())
    for roto in (matte.parent, matte):
        with pytest.raises(SettingsError, match=r"a\.png would be overwritten"):
            clean_plates([shot], matte.parent, remover, Progress(), mattes=Mattes(roto), overwrite=True)


def test_results_mattes_and_hidden_files_below_a_folder_are_no_plates(tmp_path: Path, flare_everywhere: Path) -> None:
    shot = tmp_path / "shot"
    for name in ("a.png", ".thumbs/a.png", "roto/a.png"):
        (shot / name).parent.mkdir(parents=True, exist_ok=True)
        write_codes(shot / name, picture())
    for _ in range(2):
        found = clean_plates([shot], shot / "clean", Remover(flare_everywhere, working_size=64), Progress(),
                             flare_folder=shot / "flare", mattes=Mattes(shot / "roto"))
        assert found["made"] + found["kept"] == 1
    assert sorted(path.name for path in (shot / "clean").rglob("*")) == ["a.png", MANIFEST]


def test_clean_plates_of_an_earlier_run_are_no_plates_of_the_next(tmp_path: Path, flare_everywhere: Path) -> None:
    shot, remover = tmp_path / "shot", Remover(flare_everywhere, working_size=64)
    write_codes(shot / "day" / "a.png", picture())
    for out in ("clean", "day/clean2"):
        assert clean_plates([shot], shot / out, remover, Progress())["made"] == 1
        assert [path.name for path in (shot / out).rglob("*.png")] == ["a.png"]
    again = clean_plates([shot / "clean"], tmp_path / "again", remover, Progress())
    assert again["made"] == 1, "they are where their folder is given"
    write_codes(shot / "clean" / "own.png", picture())
    assert {name for _, name in collect_plates([shot])} == {Path("day/a.png"), Path("clean/own.png")}, "no result"
    for name in ("day/a.png", "clean/own.png"):
        (shot / name).unlink()
    with pytest.raises(SettingsError, match="no pictures besides results"):
        collect_plates([shot])


def test_a_long_shot_with_results_below_it_is_searched_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names, resolved = [f"{number:04d}.png" for number in range(40)], 0
    (tmp_path / "clean").mkdir()
    for name in names:
        for folder in (tmp_path, tmp_path / "clean"):
            (folder / name).touch()
    (tmp_path / "clean" / MANIFEST).write_text(json.dumps({"plates": dict.fromkeys(names, "so"), "flares": {}}))
    resolve = Path.resolve

    def counted(path: Path, strict: bool = False) -> Path:
        nonlocal resolved
        resolved += 1
        return resolve(path, strict)

    monkeypatch.setattr(Path, "resolve", counted)
    assert len(collect_plates([tmp_path])) == 40
    assert resolved < 4 * len(names)


def test_flares_of_an_earlier_run_are_no_plates_of_the_next(tmp_path: Path, flare_everywhere: Path) -> None:
    shot, remover = tmp_path / "shot", Remover(flare_everywhere, working_size=64)
    write_codes(shot / "day" / "a.png", picture())
    clean_plates([shot], shot / "clean", remover, Progress())
    clean_plates([shot], shot / "clean", remover, Progress(), flare_folder=shot / "flare")
    assert (shot / "flare" / "day" / "a.exr").is_file()
    shot = shot.rename(tmp_path / "moved")
    assert {name for _, name in collect_plates([shot])} == {Path("day/a.png")}, "wherever they were moved together"
    assert {name for _, name in collect_plates([shot / "flare"])} == {Path("day/a.exr")}, "where they are given"
