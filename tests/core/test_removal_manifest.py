# SPDX-License-Identifier: GPL-3.0-or-later
"""The manifest: which clean plates are kept and which are made again."""
from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from core.errors import FrameError
from core.images.write import write_exr
from core.removal.inference import remover as remover_module
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
from core.removal.jobs.manifest import MANIFEST, Manifest, digest_inputs
from core.removal.jobs.mattes import Mattes
from core.system.progress import Progress
from tests.core.recording_progress import RecordingProgress
from tests.core.removal_cases import picture, write_codes


def test_a_clean_plate_is_made_again_for_other_weights_options_or_mattes(
        tmp_path: Path, flare_everywhere: Path, no_flare: Path) -> None:
    """By other weights, options or mattes, whatever the times of their files."""
    for name in "ab":
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    remover = Remover(flare_everywhere, working_size=64)
    with pytest.raises(FrameError, match=r"c\.png is missing"):
        clean_plates([tmp_path / "in" / "c.png"], tmp_path / "none", remover, Progress())
    for name, values in (("left", 0), ("right", 255)):
        for plate in "ab":
            write_codes(tmp_path / name / f"{plate}.png", np.full((60, 90, 3), values, np.uint8))

    def made(remover: Remover, matte: str = "", **options: bool) -> int:
        mattes = Mattes(tmp_path / matte) if matte else None
        found = clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes, **options)
        return int(found["made"])

    first = Remover(flare_everywhere, working_size=64)
    assert [made(first), made(first)] == [2, 0]
    for remover in (Remover(no_flare, working_size=64), Remover(flare_everywhere, working_size=96),
                    Remover(flare_everywhere, working_size=64, glow="keep"),
                    Remover(flare_everywhere, working_size=64, glow="remove"), first):
        assert [made(remover), made(remover)] == [2, 0]
    assert [made(first, "left"), made(first, "left"), made(first, "right"), made(first),
            made(first, independent=True)] == [2, 0, 2, 2, 2]


def test_a_clean_plate_is_made_again_when_its_plate_or_a_neighbour_changes(
        tmp_path: Path, flare_everywhere: Path) -> None:
    """Whatever the times of the files: a plate may be replaced by an older one."""
    for number in range(1, 25):
        write_codes(tmp_path / "in" / f"{number}.png", picture())
    remover = Remover(flare_everywhere, working_size=64)

    def made(**options: bool) -> set[str]:
        before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("*.png")}
        clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress(), **options)
        return {path.stem for path in (tmp_path / "out").glob("*.png")
                if path.stat().st_mtime_ns != before.get(path.name)}

    assert len(made()) == 24
    os.utime(tmp_path / "in" / "3.png", (2e9, 2e9))
    assert not made(), "its content is what counts"
    write_codes(tmp_path / "in" / "3.png", np.full((60, 90, 3), 40, np.uint8))
    os.utime(tmp_path / "in" / "3.png", (1, 1))
    assert made() == {str(number) for number in range(1, 20)}, "as far as it is looked at"
    assert len(made(independent=True)) == 24
    write_codes(tmp_path / "in" / "3.png", picture())
    assert made(independent=True) == {"3"}


def test_a_foreign_file_is_not_overwritten(tmp_path: Path, flare_everywhere: Path) -> None:
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(flare_everywhere, working_size=64)
    work = write_codes(tmp_path / "out" / "a.png", np.zeros((60, 90, 3), np.uint8)).read_bytes()
    with pytest.raises(FrameError, match=r"a\.png exists and is not listed in .*remove\.json"):
        clean_plates([source], tmp_path / "out", remover, Progress())
    assert (tmp_path / "out" / "a.png").read_bytes() == work
    assert clean_plates([source], tmp_path / "out", remover, Progress(), overwrite=True)["made"] == 1
    assert clean_plates([source], tmp_path / "out", remover, Progress())["kept"] == 1
    (tmp_path / "out" / MANIFEST).unlink()
    with pytest.raises(FrameError, match="choose another folder"):
        clean_plates([source], tmp_path / "out", remover, Progress())


def test_a_foreign_file_is_not_overwritten_by_a_flare(tmp_path: Path, flare_everywhere: Path) -> None:
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(flare_everywhere, working_size=64)
    render = tmp_path / "renders" / "a.exr"
    write_exr(render, dict.fromkeys("RGB", np.zeros((60, 90))))
    work = render.read_bytes()
    with pytest.raises(FrameError, match=r"a\.exr exists and is not listed in .*remove\.json"):
        clean_plates([source], tmp_path / "out", remover, Progress(), flare_folder=render.parent)
    assert render.read_bytes() == work
    for another in (remover, Remover(flare_everywhere, working_size=64, glow="keep")):
        clean_plates([source], tmp_path / "out", another, Progress(), flare_folder=tmp_path / "flares")
    clean_plates([source], tmp_path / "out", remover, Progress(), flare_folder=render.parent, overwrite=True)
    assert render.read_bytes() != work


def test_a_clean_plate_of_another_process_stays(tmp_path: Path) -> None:
    """A farm may restart a task while its first worker runs: a clean plate made in the same way is neither deleted nor
    taken for an edited one."""
    plate = write_codes(tmp_path / "out" / "b.png", picture())
    plate.unlink()
    source = write_codes(tmp_path / "in" / "b.png", picture())
    second = Manifest(tmp_path / "out")
    first = Manifest(tmp_path / "out")
    first.begin_frame(Path("b.png"), source, "one way", [plate], overwrite=False)
    write_codes(plate, picture())
    assert second.is_up_to_date(Path("b.png"), "one way", [plate])
    for overwrite in (False, True):
        second.begin_frame(Path("b.png"), source, "one way", [plate], overwrite)
        assert plate.exists()
    second.begin_frame(Path("b.png"), source, "another way", [plate], overwrite=False)
    assert not plate.exists() and not first.is_up_to_date(Path("b.png"), "one way", [plate])


def test_a_clean_plate_of_an_earlier_revision_is_made_again(tmp_path: Path, flare_everywhere: Path,
                                                            monkeypatch: pytest.MonkeyPatch) -> None:
    source, out = write_codes(tmp_path / "in" / "a.png", picture()), tmp_path / "out"
    made = []
    for revision in (remover_module.REVISION, remover_module.REVISION, remover_module.REVISION + 1):
        monkeypatch.setattr(remover_module, "REVISION", revision)
        made.append(clean_plates([source], out, Remover(flare_everywhere, working_size=64), Progress())["made"])
    assert made == [1, 0, 1]


def test_a_clean_plate_that_was_begun_is_made(tmp_path: Path, flare_everywhere: Path) -> None:
    """A kill after the manifest, before the plate: an earlier clean plate is not taken for it."""
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(flare_everywhere, working_size=64)
    clean_plates([source], tmp_path / "out", remover, Progress())
    other = Remover(flare_everywhere, working_size=96)
    how = digest_inputs(other.cache_key, [source])
    Manifest(tmp_path / "out").begin_frame(Path("a.png"), source, how, [tmp_path / "out" / "a.png"], overwrite=False)
    assert not (tmp_path / "out" / "a.png").exists()
    assert clean_plates([source], tmp_path / "out", other, Progress())["made"] == 1


def test_a_clean_plate_whose_hash_a_kill_prevented_is_kept_once_edited(
         tmp_path: Path, flare_everywhere: Path, no_flare: Path) -> None:
    """A kill after the plate, before its hash is in the manifest: a later call adds it."""
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(flare_everywhere, working_size=64)
    clean, manifest = tmp_path / "out" / "a.png", tmp_path / "out" / MANIFEST
    clean_plates([source], tmp_path / "out", remover, Progress())
    complete = manifest.read_text()
    manifest.write_text(json.dumps({**json.loads(complete), "written": {}}))
    assert clean_plates([source], tmp_path / "out", remover, Progress())["kept"] == 1
    assert json.loads(manifest.read_text()) == json.loads(complete)
    work = write_codes(clean, picture() // 2).read_bytes()
    assert clean_plates([source], tmp_path / "out", Remover(no_flare, working_size=64), Progress())["kept"] == 1
    assert clean.read_bytes() == work


def test_a_clean_plate_stays_when_its_plate_can_no_longer_be_read(tmp_path: Path, flare_everywhere: Path) -> None:
    write_codes(tmp_path / "in" / "a.png", picture())
    remover = Remover(flare_everywhere, working_size=64)
    clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress())
    before = (tmp_path / "out" / "a.png").read_bytes()
    plate = tmp_path / "in" / "a.png"
    plate.write_bytes(plate.read_bytes()[:200])
    with pytest.raises(FrameError, match="1 of 1 plates could not be cleaned"):
        clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress())
    assert (tmp_path / "out" / "a.png").read_bytes() == before


def test_a_flare_of_an_outdated_clean_plate_is_made_again(tmp_path: Path, flare_everywhere: Path) -> None:
    """The old flare would not belong to the new clean plate."""
    write_codes(tmp_path / "in" / "a.png", picture())
    one, other = (Remover(flare_everywhere, working_size=size) for size in (64, 96))
    args = ([tmp_path / "in"], tmp_path / "out")
    clean_plates(*args, one, Progress(), flare_folder=tmp_path / "flares")
    stale = (tmp_path / "flares" / "a.exr").read_bytes()
    clean_plates(*args, other, Progress())
    assert clean_plates(*args, other, Progress(), flare_folder=tmp_path / "flares")["made"] == 1
    assert (tmp_path / "flares" / "a.exr").read_bytes() != stale
    assert clean_plates(*args, other, Progress(), flare_folder=tmp_path / "flares")["kept"] == 1


def test_an_edited_clean_plate_is_kept(tmp_path: Path, flare_everywhere: Path) -> None:
    """Changed settings leave an edited clean plate, unless `overwrite`; a changed plate is refused."""
    for name in ("a", "b"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    one, other = (Remover(flare_everywhere, working_size=size) for size in (64, 96))
    plates, out = [tmp_path / "in"], tmp_path / "out"
    clean_plates(plates, out, one, Progress(), flare_folder=tmp_path / "flares")
    retouched = write_codes(out / "a.png", picture()[:, ::-1]).read_bytes()
    heard = RecordingProgress()
    found = clean_plates(plates, out, other, heard, flare_folder=tmp_path / "flares")
    assert (found["made"], found["kept"]) == (1, 1) and any("were edited" in text for text in heard.texts)
    assert (out / "a.png").read_bytes() == retouched
    write_codes(tmp_path / "in" / "a.png", 255 - picture())
    with pytest.raises(FrameError, match=r"a\.png was edited after it was made"):
        clean_plates(plates, out, other, Progress())
    assert (out / "a.png").read_bytes() == retouched
    clean_plates(plates, out, other, Progress(), overwrite=True)
    assert (out / "a.png").read_bytes() != retouched
    assert clean_plates(plates, out, one, Progress())["made"] == 2  # and it is no one's work any more


def test_a_foreign_flare_is_not_taken_for_the_plates(tmp_path: Path, flare_everywhere: Path) -> None:
    write_codes(tmp_path / "in" / "a.png", picture())
    remover = Remover(flare_everywhere, working_size=64)
    clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress())
    (tmp_path / "flares").mkdir()
    (tmp_path / "flares" / "a.exr").write_bytes(b"another's")
    with pytest.raises(FrameError, match="someone's work"):
        clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress(), flare_folder=tmp_path / "flares")
    assert (tmp_path / "flares" / "a.exr").read_bytes() == b"another's"


def test_an_existing_clean_plate_is_kept(tmp_path: Path, flare_everywhere: Path) -> None:
    source = write_codes(tmp_path / "plate.png", picture())
    remover = Remover(flare_everywhere, working_size=64)
    assert clean_plates([source], tmp_path / "out", remover, Progress())["made"] == 1
    assert clean_plates([source], tmp_path / "out", remover, Progress())["kept"] == 1
    assert clean_plates([source], tmp_path / "out", remover, Progress(), overwrite=True)["made"] == 1
    (tmp_path / "out" / "plate.png").unlink()
    assert clean_plates([source], tmp_path / "out", remover, Progress())["made"] == 1
