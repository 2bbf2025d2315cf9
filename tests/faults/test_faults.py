# SPDX-License-Identifier: GPL-3.0-or-later
"""The short form of the attacks: a few injected faults and kills, and a few mutated files of every format.

The long forms are commands: `python tests/faults/attack.py` and `python tests/faults/fuzz.py`.
"""
from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from core.images.write import write_png
from tests.core.removal_cases import picture
from tests.faults import injection
from tests.faults.cases import why_not_whole

HERE = Path(__file__).parent
FILES_OF_EACH = 8

needs_injection = pytest.mark.skipif(bool(injection.reason_to_skip()), reason=injection.reason_to_skip())


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled library."""
    path = tmp_path_factory.mktemp("library") / "inject.so"
    subprocess.run(["cc", "-O1", "-Wall", "-shared", "-fPIC", str(injection.SOURCE), "-o", str(path), "-ldl"],
                   check=True)
    return path


def run_with_fault(library: Path, folder: Path, call: str, number: int, error: str) -> subprocess.CompletedProcess[str]:
    """Run a Python that writes and renames two files, with an error at call `number`; return how it ended."""
    counter = library.with_name("counter")
    counter.write_bytes(bytes(8 * len(injection.CALLS)))
    code = ("import os\nfor name in 'ab':\n with open(name, 'w') as file: file.write('whole')\n"
            " os.replace(name, name * 2)")
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False, env={
        **os.environ, "LD_PRELOAD": str(library), "FAULT_COUNTER": str(counter), "FAULT_FOLDER": str(folder),
        "FAULT_CALL": call, "FAULT_NUMBER": str(number), "FAULT_ERRNO": error})


@needs_injection
@pytest.mark.parametrize(("call", "number", "error", "left"), [
    ("write", 2, "ENOSPC", {"aa", "b"}), ("open", 2, "EACCES", {"aa"}), ("rename", 1, "EIO", {"a"}),
    ("unlink", 1, "EIO", {"aa", "bb"}), ("none", 0, "EIO", {"aa", "bb"})])
def test_the_chosen_call_fails(library: Path, tmp_path: Path, call: str, number: int, error: str,
                               left: set[str]) -> None:
    """The library makes exactly the chosen call fail, and the files written before it remain."""
    done = run_with_fault(library, tmp_path.resolve(), call, number, error)
    assert {path.name for path in tmp_path.iterdir()} == left
    assert bool(done.returncode) == (left != {"aa", "bb"})
    assert error != "ENOSPC" or "No space left" in done.stderr


@needs_injection
def test_the_chosen_call_kills(library: Path, tmp_path: Path) -> None:
    """The library kills the process at the chosen call."""
    done = run_with_fault(library, tmp_path.resolve(), "rename", 2, "kill")
    assert done.returncode == -signal.SIGKILL
    assert {path.name for path in tmp_path.iterdir()} == {"aa", "b"}


def test_a_file_that_is_cut_short_is_noticed(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", picture(24, 32).astype("float32") / 255)
    (tmp_path / "a.json").write_text('{"a": 1}')
    for name in ("a.png", "a.json"):
        assert not why_not_whole(tmp_path / name)
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[:len(data) - 5])
        assert why_not_whole(tmp_path / name)


@needs_injection
def test_commands_survive_faults_and_kills(tmp_path: Path) -> None:
    """A few of the long form's attempts, on the quick commands."""
    done = subprocess.run([sys.executable, str(HERE / "attack.py"), "--faults", "9", "--kills", "4", "--only",
                           "export", "export ply", "bake", "--folder", str(tmp_path)], capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| all | 9 | 4 |" in done.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="the time limit is a signal, which Windows lacks")
def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    from tests.faults.fuzz import formats, fuzz

    kinds = formats(tmp_path)
    failures = [text for one in kinds for text in fuzz(
        one, 2 if "2000" in one.name else FILES_OF_EACH, seed=1).failures]  # a process of its own decodes JPEG 2000
    assert not failures, "\n".join(failures)
    assert len({one.name for one in kinds}) > 25
