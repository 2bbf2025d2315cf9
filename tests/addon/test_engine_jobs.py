# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that another machine or Blender started: their state is right, and no other process is stopped."""
from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from blenders import Blender

pytestmark = pytest.mark.skipif(os.name == "nt", reason="what stands for an engine hears signals, not files")

SCRIPTS = Path(__file__).parent / "scripts"


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("jobs")
    return blender.run(SCRIPTS / "jobs.py", package, base / "out", user=base / "user")


def test_the_state_of_a_remote_job_follows_from_its_events(facts: Any) -> None:
    """Block of jobs.py: "another machine"."""
    assert facts["ended elsewhere"] == "done"
    assert facts["goes on elsewhere"] == ["running", 4]
    assert facts["asked elsewhere"] == [True, "stopping"]
    assert facts["stopped elsewhere"] == [False, "stopped", ["goes on elsewhere"]]
    state, error = facts["silent elsewhere"]
    assert state == "failed"
    assert error.startswith("The engine on another has reported nothing for an hour")
    assert facts["silent on a Mac"].startswith("The engine on studio-mac has reported nothing")


def test_strange_events_are_ignored_and_a_pipe_is_not_waited_for(facts: Any) -> None:
    """Block of jobs.py: "events that no engine writes"."""
    assert facts["strange events"] == ["running", 4, 8]
    assert facts["events from a pipe"] == 0


def test_an_exception_for_one_job_does_not_stop_the_polling_of_others(facts: Any) -> None:
    """Block of jobs.py: "what is done in the scenes with one goes wrong"."""
    again, state, error, is_traced, other = facts["ends badly"]
    assert again and other == "running"
    assert state == "done"
    assert error.endswith("ends badly (pop from empty list); report it with the text in the console.")
    assert is_traced


def test_another_process_with_the_same_number_is_not_stopped(facts: Any) -> None:
    """Block of jobs.py: "this machine"."""
    assert facts["the stranger lives"] and facts["asked by the file alone"]
    assert facts["its number is an older process's"] == "failed"
    assert facts["written by the version before"] == ["running", True]


def test_jobs_without_a_scene_are_shown(facts: Any) -> None:
    """Block of jobs.py: "of this scene, and of none"."""
    assert facts["of the scene"] == ["own"]
    assert facts["of none"] == ["other", "layers"]


def test_escape_stops_the_jobs_of_the_scene_unless_an_animation_plays(facts: Any) -> None:
    """Block of jobs.py: "of this scene, and of none"."""
    assert not facts["ESC while it plays"]
    assert facts["ESC"]
    assert facts["stopped by ESC"] == [True, False, False]
    assert not facts["ESC without work of its own"]
