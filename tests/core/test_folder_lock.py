# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder at work is one process's, and nobody's when that is gone."""
from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from core.errors import RunError
from core.system.folder_lock import folder_lock

ROOT = Path(__file__).resolve().parents[2]

HOLD = """
import sys
from core.system.folder_lock import folder_lock
with folder_lock(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_folder_lock_has_one_holder_and_ends_with_its_process(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], cwd=ROOT, text=True,
                             stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with pytest.raises(RunError, match="Another process is using"), folder_lock(folder):
            pass
    finally:
        other.kill()
        other.communicate()
    with folder_lock(folder):
        (folder / "result").touch()
    assert [path.name for path in folder.iterdir()] == ["result"]
    with pytest.raises(ZeroDivisionError), folder_lock(tmp_path / "new"):
        raise ZeroDivisionError
    assert not (tmp_path / "new").exists()


def test_a_folder_lock_on_a_disk_without_locks_is_granted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(descriptor: int) -> None:
        del descriptor
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("core.system.folder_lock._lock", refuses)
    with folder_lock(tmp_path), folder_lock(tmp_path):
        pass
