# SPDX-License-Identifier: GPL-3.0-or-later
"""Broken input and failures end in one readable sentence, never in a traceback, and nothing is lost."""
from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import Blender
from test_work import a_flare

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers
from tests.core.flared import flared_capture

SCRIPTS = Path(__file__).parent / "scripts"

pytestmark = pytest.mark.skipif(os.name == "nt", reason="the sham engine is a shell script")


@pytest.fixture(scope="session")
def said(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("broken")
    sham = base / "sham_engine.sh"
    shutil.copy(SCRIPTS / "sham_engine.sh", sham)
    capture, flare = flared_capture(base / "capture", 4), a_flare(base / "lamp.flare")
    layer = np.ones((8, 16, 3), np.float32)
    write_layers(base / "out" / "real" / "layers.0001.exr", FrameLayers(layer, {"lamp": layer}, layer[..., 0]))
    return blender.run(SCRIPTS / "broken.py", package, capture, flare, base / "out", sham, user=base / "user")


def is_sentence(text: str) -> bool:
    return len(text) > 20 and text[-1] == "." and "Traceback" not in text and "Error" not in text


def test_an_empty_scene_offers_what_can_be_done_alone(said: Any) -> None:
    """Block of broken.py: "nothing there yet"."""
    possible = {name for name, can in said["polls of an empty scene"].items() if can}
    assert possible == {"import_capture", "add_light", "open_flare", "apply_flare"}  # the library in the box has looks


@pytest.mark.parametrize("what", ["import of nothing", "import of a broken capture", "cut flare", "newer flare",
                                  "absent flare", "flare deleted later", "save of a deleted flare", "orthographic",
                                  "bake of a deleted flare", "log of nothing", "folder of nothing", "layers of nothing",
                                  "library name", "bake on a full disk", "save on a full disk", "fit on a full disk",
                                  "no room for the last words"])
def test_refused_actions_report_one_sentence(said: Any, what: str) -> None:
    """Blocks of broken.py: "nothing there yet", ".flare files", "a full disk, and an engine that dies while it bakes",
    "cameras and scenes", "the rest"."""
    assert is_sentence(said[what]), said[what]


def test_refusals_leave_nothing_behind(said: Any) -> None:
    """Blocks of broken.py: "nothing there yet", ".flare files"."""
    assert said["objects after refusals"] == 0
    assert said["edits survive a refusal"] == 1


def test_without_an_engine_the_button_says_so(said: Any) -> None:
    """Blocks of broken.py: "nothing there yet", "engines that are none, or die"."""
    assert said["no engine"]
    assert said["engine named, not there"] == [False, False]
    why = "The engine named by FIT_FLARE_ENGINE is missing: gone."
    assert said["engine of the variable, not there"] == [False, why]
    assert said["engine of the variable"], "as for the commands, the variable goes before the preferences"


def test_every_panel_says_what_is_missing(said: Any) -> None:
    """Blocks of broken.py: "nothing there yet", "engines that are none, or die", "cameras and scenes"."""
    capture, lights, fit, look, bake, _, library = said["panels of an empty scene"]
    assert "Footage with a camera solve" in capture
    assert "No lights yet" in lights
    assert "No engine is set up" in fit
    assert "No flare yet" in look
    assert "Nothing to bake yet" in bake
    assert "The library is empty" in library
    assert "The engine named by the preferences is missing: " in said["panel without an engine"]
    assert "no camera" in said["panel without a camera"]


def test_a_full_disk_is_reported_and_finished_files_are_kept(said: Any) -> None:
    """Block of broken.py: "a full disk, and an engine that dies while it bakes"."""
    broken, filled, again = said["bakes"]
    assert "ended without a result" in broken[0]
    assert "disk is full" in filled[0]
    for text, panel, layers in (broken, filled):
        assert is_sentence(text)
        assert text.split(" (")[0].split("; ")[0] in panel
        assert layers == ["layers.0001.exr"]
    assert again[0] == ""
    assert "Layers of 2 frames are baked." in again[1]
    assert again[2] == ["layers.0001.exr", "layers.0002.exr"]
    for what in ("bake on a full disk", "save on a full disk", "fit on a full disk", "no room for the last words"):
        assert "full" in said[what]
    assert said["library after"] == []
    assert said["its engine is not left alone"]


def test_results_that_cannot_be_shown_are_reported(said: Any) -> None:
    """Block of broken.py: "a full disk, and an engine that dies while it bakes"."""
    state, fit, bake = said["done, and not shown"]
    assert state == "done"
    assert "It cannot be shown." in fit
    assert "It cannot be shown." in bake


def test_an_engine_that_dies_is_reported(said: Any) -> None:
    """Block of broken.py: "engines that are none, or die"."""
    fits = said["fits"]
    assert "out of memory" in fits["dies"]
    assert fits["refuses"] == "The frames are not there; put them back."
    assert is_sentence(fits["chatters"]) or fits["chatters"].startswith("The engine ended without a result")
    assert "without a result" in fits["ends"]
    for how in ("dies without a word", "dies without a word, found again"):
        assert said[how].startswith("The engine ended without a result; "), "an earlier one's words are not its own"
    assert {fits[f"{how}, state"] for how in ("dies", "refuses", "chatters", "ends")} == {"none"}


def test_a_stop_during_the_start_of_the_engine_counts_as_a_stop(said: Any) -> None:
    """Block of broken.py: "engines that are none, or die"."""
    assert said["stopped before it listened"] == ["stopped", "Stopped before it began."]


def test_an_engine_that_cannot_start_is_not_reported_as_a_folder_error(said: Any) -> None:
    """Block of broken.py: "engines that are none, or die"."""
    assert "python cannot be started (" in said["cannot be executed"]
    assert said["cannot be executed"].endswith("; set up the engine in the preferences.")


def test_a_successful_fit_shows_its_flare(said: Any) -> None:
    """Block of broken.py: "engines that are none, or die"."""
    assert said["a fit that ends well"] == ["", "finished", True]


def test_the_engine_test_reports_its_version(said: Any) -> None:
    """Block of broken.py: "engines that are none, or die"."""
    assert said["test of another engine"]
    assert said["test"] == ["", {"version": "1", "torch": "2", "device": "a sham"}]


def test_jobs_of_an_earlier_blender_are_found_and_cancelled(said: Any) -> None:
    """Block of broken.py: "work that goes on while Blender is closed, found again and cancelled"."""
    assert said["found again"] == ["running", "fit", 40, 100]
    assert said["state of the found"] == "running"
    assert said["cancelled"] == ["stopped", "Stopped during fit as asked; what is done is kept."]
    assert said["another program has the number"] != "running"
    assert said["asked by a file too"]


def test_paths_keep_the_letter_of_a_drive(said: Any) -> None:
    """Block of broken.py: "paths"."""
    assert said["written on Windows"]
    assert said["a linked drive"]


def test_missing_folders_are_reported(said: Any) -> None:
    """Blocks of broken.py: "work that goes on while Blender is closed, found again and cancelled", "a capture that
    moved"."""
    assert said["run folder deleted"] == ["lost", True, False]
    assert said["capture moved"] == [False, False]
    assert "does not exist any more: start a new fit" in said["panel of a lost run"]
    capture, fit = said["panels of a moved capture"]
    assert "does not exist any more" in capture
    assert "does not exist any more" in fit
    assert all(text and "Traceback" not in text for text in said["operators of a moved capture"])


def test_panels_accept_a_name_that_is_too_long_for_the_disk(said: Any) -> None:
    """Block of broken.py: "places that cannot be looked at"."""
    panels_by_case = {name: panels for name, *panels in said["a name too long for the disk"]}
    assert "does not exist any more" in panels_by_case["capture"][0]
    assert "does not exist any more: start a new fit" in panels_by_case["run"][2]
    assert len(panels_by_case) == 6


def test_deleted_cameras_and_lights_are_reported_and_scenes_stay_apart(said: Any) -> None:
    """Blocks of broken.py: ".flare files", "cameras and scenes"."""
    assert said["camera deleted"] == [False, True]
    known, message = said["light taken out of the scene"]
    assert known and "No flare has a light object" in message
    assert said["icon of its flare"] == "ERROR"
    assert said["light deleted"]
    assert said["second scene is empty"] == ["", False, 0]
    assert said["two scenes"] == [3.0, 1.0]


def test_every_operator_is_one_undo_step(said: Any) -> None:
    """Block of broken.py: "undo after each operator"."""
    assert [name for name, good in said["undone"].items() if not good] == []


def test_set_up_is_disabled_without_online_access(said: Any) -> None:
    """Block of broken.py: "the rest"."""
    online, offered = said["online"]
    assert offered == online


def test_uninstalling_leaves_nothing(said: Any) -> None:
    """Block of broken.py: "the rest"."""
    assert said["after disabling"] == [False, False]
    assert said["left behind"] == []
    assert not said["modules left"]


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="wants a file that may not be read")
def test_logs_show_their_end_or_why_they_cannot_be_read(said: Any) -> None:
    """Block of broken.py: "the rest"."""
    finished, text = said["shows logs"]
    assert finished == "FINISHED"
    assert "cannot be read" in text
    assert "last" in text
    assert "first" not in text


def test_a_flare_is_made_from_a_lens(said: Any) -> None:
    """Block of broken.py: "engines that are none, or die"."""
    refused, panel = said["a flare from a lens, refused"]
    assert "not there" in refused or any("not there" in text for text in panel)
    said_nothing, chosen, args = said["a flare from a lens"]
    assert (said_nothing, chosen) == ("", "From a Lens")
    assert args[0].endswith(tuple("0123456789"))
    assert [args[args.index(name) + 1] for name in ("--f-number", "--squeeze", "--blades")] == ["4", "1.8", "8"]
    assert all(is_sentence(text) for text in said["a lens that is none"])
    assert is_sentence(said["a name that is taken"])
    assert "35 mm f/1.3 (US3576360)" in said["lenses"]
    assert said["lenses"][-1] == "Lens File"


def test_flare_from_footage_runs_shot_on_the_clip(said: Any) -> None:
    """Block of broken.py: "Flare from Footage"."""
    missing, refused = said["footage"]
    assert "none.mp4 is missing; choose a video" in missing
    assert "The frames are not there; put them back." in refused
    assert said["footage that failed changes no run"] and said["footage in the panel"]
    assert said["footage's command"] == ["shot", "X/clip.mp4", "--out", "X/clip_flare_1", "--preset", "high"]
