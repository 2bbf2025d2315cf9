# SPDX-License-Identifier: GPL-3.0-or-later
"""The looks that come with the extension: files, thumbnails, entries."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from core.images.read import read_picture
from core.look import ViewOfLight, read_look
from sample_scenes import make_library
from sample_scenes.make_library import INDEX, LIBRARY, LOOKS, LibraryLook

MAX_BYTES = 15 << 20
ENTRIES = json.loads((LIBRARY / INDEX).read_text(encoding="utf-8"))["looks"]


def test_the_library_is_whole_and_small() -> None:
    names = {entry["name"] for entry in ENTRIES}
    assert names == {path.stem for path in LIBRARY.glob("*.flare")} == {path.stem for path in LIBRARY.glob("*.png")}
    assert names <= {look.name for look in LOOKS}
    assert sum(path.stat().st_size for path in LIBRARY.iterdir()) < MAX_BYTES


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry["name"])
def test_a_look_of_the_library_can_be_used(entry: dict[str, str]) -> None:
    look = read_look(LIBRARY / f"{entry['name']}.flare")
    assert look.licence == entry["licence"] == "CC0-1.0"
    assert look.notes.startswith(entry["text"]) and "Traced through" in look.notes
    assert look.blend == "add" and look.pixel_grid is not None and len(look.lights) == 1
    assert look.lights[0].evaluate(ViewOfLight(np.zeros(3, np.float32), np.eye(3, dtype=np.float32),
                                               np.array([0.05, 0.02], np.float32), 1.0)) is not None
    thumbnail = read_picture(LIBRARY / f"{entry['name']}.png").pixels
    assert thumbnail.shape == (192, 192, 3) and thumbnail.max() > 0.5


def test_all_looks_have_valid_settings_and_names_that_files_can_have() -> None:
    for look in LOOKS:
        look.settings.lens_setup()
        assert look.name.replace(" ", "").replace("-", "").isalnum()
    assert len({look.name for look in LOOKS}) == len(LOOKS)


def test_a_second_run_keeps_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = {"tracing.width": 48, "tracing.positions": 4, "tracing.bands": 1, "ghosts.count": 2, "fit.iterations": 3,
            "fit.gaussians": 30}
    looks = tuple(LibraryLook(name, f"Text of {name}.", {"lens": "US4099850", **tiny}) for name in ("One", "Two"))
    monkeypatch.setattr(make_library, "LOOKS", looks)
    make_library.make_library(tmp_path, ["One"], make_library.Progress())
    first = (tmp_path / "One.flare").stat().st_mtime_ns
    make_library.make_library(tmp_path, [], make_library.Progress())
    assert (tmp_path / "One.flare").stat().st_mtime_ns == first
    assert [entry["name"] for entry in json.loads((tmp_path / INDEX).read_text())["looks"]] == ["One", "Two"]
    changed = LibraryLook("One", "Text of One.", {"lens": "US4099850", **tiny, "glow.gain": 0.3})
    monkeypatch.setattr(make_library, "LOOKS", (changed, looks[1]))
    make_library.make_library(tmp_path, [], make_library.Progress())
    assert (tmp_path / "One.flare").stat().st_mtime_ns != first
