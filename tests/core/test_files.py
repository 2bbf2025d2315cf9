# SPDX-License-Identifier: GPL-3.0-or-later
"""Files are whole or absent, and names stay inside their folder."""
from __future__ import annotations

import contextlib
import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from core.errors import CaptureError, SettingsError, os_error_message
from core.system.files import (
    atomic_folder,
    atomic_path,
    avoid_device_name,
    check_names,
    check_no_overwrite,
    content_hash,
    file_lock,
    follow_link,
    read_json,
    remove_file,
    remove_folder,
    remove_partials_below,
    remove_partials_of,
    retry_while_locked,
    round_for_text,
    safe_join,
    write_json,
    write_text,
)

ROOT = Path(__file__).resolve().parents[2]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with pytest.raises(ZeroDivisionError), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_refused_write_raises_an_error_that_names_the_file(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with pytest.raises(OSError) as full, atomic_path(target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as a write to an open file says it
    assert os_error_message(full.value) == (
        f"The disk is full ({target}); make room and start it again, what is finished is kept.")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]
    assert os_error_message(PermissionError(errno.EACCES, "Permission denied", "/a")) == (
        "The system refused: Permission denied (/a).")
    assert os_error_message(OSError(errno.ELOOP, os.strerror(errno.ELOOP), "/a")) == (
        "A symbolic link leads back to itself (/a); remove it or choose another path.")


def test_a_write_replaces_the_file_and_makes_its_folder(tmp_path: Path) -> None:
    target = tmp_path / "new" / "a.json"
    write_json(target, {"a": 1})
    write_json(target, {"a": 2})
    assert read_json(target, CaptureError) == {"a": 2}
    assert [path.name for path in target.parent.iterdir()] == ["a.json"]


def refused_by_windows() -> PermissionError:
    """As Windows says that another program holds the file."""
    problem = PermissionError(errno.EACCES, "The process cannot access the file")
    problem.winerror = 32  # type: ignore[attr-defined]
    return problem


def test_a_write_waits_for_a_file_that_windows_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusals, replace = [refused_by_windows() for _ in range(3)], Path.replace

    def held(path: Path, target: Path) -> Path:
        if refusals:
            raise refusals.pop()
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", held)
    write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "new"
    assert not refusals
    attempts = []

    def forbidden() -> None:
        attempts.append(1)
        raise PermissionError(errno.EACCES, "Permission denied")

    with pytest.raises(PermissionError):
        retry_while_locked(forbidden)
    assert len(attempts) == 1, "what stays forbidden is reported at once"
    monkeypatch.setattr("core.system.files._RETRY_S", 0.1)
    refusals[:] = [refused_by_windows() for _ in range(100)]
    with pytest.raises(PermissionError):
        write_text(tmp_path / "a.txt", "newer")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_removal_waits_for_a_file_that_windows_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusals, unlink = [refused_by_windows() for _ in range(3)], Path.unlink

    def held(path: Path, missing_ok: bool = False) -> None:
        if refusals:
            raise refusals.pop()
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", held)
    (tmp_path / "a.txt").touch()
    remove_file(tmp_path / "a.txt")
    remove_file(tmp_path / "a.txt")  # it need not be there
    assert (list(tmp_path.iterdir()), refusals) == ([], [])


def test_a_failed_clean_up_does_not_hide_the_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(ZeroDivisionError), atomic_path(tmp_path / "a.txt"):
        raise ZeroDivisionError
    (tmp_path / ".partial-b.txt-").touch()
    remove_partials_of(tmp_path / "b.txt")
    remove_partials_below(tmp_path)


def test_a_folder_is_removed_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, rename = tmp_path / "engine", Path.rename
    (folder / "python").mkdir(parents=True)
    (tmp_path / "engine.old-1" / "engine").mkdir(parents=True)  # what was in use when it was removed

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Access is denied")

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(PermissionError):
        remove_folder(folder)
    assert list(tmp_path.rglob("*")) == [folder, folder / "python"]
    monkeypatch.setattr(Path, "rename", rename)
    remove_folder(folder)
    remove_folder(folder)  # it need not be there
    assert list(tmp_path.iterdir()) == []


def test_a_disk_without_permissions_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_path: Path, _mode: int) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "chmod", refuse)
    write_text(tmp_path / "a.txt", "new")
    with atomic_folder(tmp_path / "folder") as made:
        (made / "b.txt").touch()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert (tmp_path / "folder" / "b.txt").is_file()


def test_json_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    (tmp_path / "lights.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_json(tmp_path / "lights.json", CaptureError) == {"a": 1}


@pytest.mark.parametrize(("name", "expected"), [
    ("Aux", "Aux_"), ("con.flare", "con_.flare"), ("COM1", "COM1_"), ("nul .png", "nul_.png"), ("lpt²", "lpt²_"),
    ("conin$", "conin$_"), ("Camera", "Camera"), ("console", "console"), ("com", "com"), ("a.con", "a.con"),
    ("conin", "conin")])
def test_device_names_of_windows_get_an_underscore(name: str, expected: str) -> None:
    assert avoid_device_name(name) == expected


def test_a_device_name_is_refused_on_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for windows in (False, True):
        monkeypatch.setattr("core.system.files.WINDOWS", windows)
        for name in ("images/nul.png", "con/0001.png"):
            with pytest.raises(CaptureError, match="device") if windows else contextlib.nullcontext():
                assert safe_join(tmp_path, name, CaptureError) == tmp_path / name
        assert safe_join(tmp_path, "console/0001.png", CaptureError) == tmp_path / "console" / "0001.png"


def test_a_file_is_recognised_by_each_of_its_names(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        (tmp_path / name).touch()
    check_no_overwrite([tmp_path / "a.png"], [tmp_path / "b.png"])
    (tmp_path / "A.png").hardlink_to(tmp_path / "a.png")  # what macOS would find below that name
    with pytest.raises(SettingsError, match="overwritten by a result"):
        check_no_overwrite([tmp_path / "a.png"], [tmp_path / "A.png"])


def test_json_refuses_nan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"a": float("nan")})
    assert not (tmp_path / "a.json").exists()


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000])
def test_invalid_json_raises_an_error_that_names_the_file(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "split.json"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=r"split\.json"):
        read_json(path, CaptureError)


@pytest.mark.parametrize("name", ["", "/etc/passwd", "../a", "a/../../b", "C:/a", "c:\\a", "..\\a", "a\0b"])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(CaptureError):
        safe_join(tmp_path, name, CaptureError)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
def test_a_name_with_a_colon_is_no_drive(tmp_path: Path) -> None:
    assert safe_join(tmp_path, "12:30.png", CaptureError) == tmp_path / "12:30.png"


def test_names_beyond_utf_8_are_accepted_and_too_long_ones_refused(tmp_path: Path) -> None:
    assert safe_join(tmp_path, os.fsdecode(b"pl\xe9.png"), CaptureError).parent == tmp_path
    for name in (256 * "a", 128 * "\u00e9", "\ud800"):
        if os.name == "nt" and name == "\ud800":
            continue  # of which Windows makes a name
        with pytest.raises(CaptureError, match="not inside the folder"):
            safe_join(tmp_path, name, CaptureError)


def test_links_that_leave_the_folder_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    (tmp_path / "secret.png").touch()
    (folder / "a.png").symlink_to(tmp_path / "secret.png")
    (folder / "b.png").symlink_to(folder / "c.png")
    with pytest.raises(CaptureError, match="leads out"):
        safe_join(folder, "a.png", CaptureError)
    assert safe_join(folder, "b.png", CaptureError) == folder / "b.png"
    assert safe_join(folder, "sub/c.png", CaptureError) == folder / "sub/c.png"


def test_check_names_agrees_with_safe_join(tmp_path: Path) -> None:
    folder = tmp_path / "layers"
    (folder / "sub").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    (folder / "link.exr").symlink_to(tmp_path / "secret")
    (folder / "away").symlink_to(tmp_path / "out")
    (tmp_path / "out" / "home.exr").symlink_to(folder / "c.exr")
    harmless = ["a.exr", "sub/a.exr", "sub/b.exr", "c.exr", "un\u00efcode.exr", "away/home.exr"]
    assert sum(1 for _ in check_names(folder, harmless, CaptureError)) == len(harmless)
    for name in ("link.exr", "sub/../../b", "sub/..", "..", "", "/etc/a", "sub/a\0b", "away/b.exr", "sub\\..\\..\\a",
                 "sub/" + 256 * "a"):
        with pytest.raises(CaptureError):
            list(check_names(folder, [*harmless, name], CaptureError))


def test_a_write_replaces_a_link_unless_it_is_followed(tmp_path: Path) -> None:
    """A frame that one bake has linked from another is not the other's any more."""
    link, file = tmp_path / "link.json", tmp_path / "elsewhere" / "a.json"
    file.parent.mkdir()
    link.symlink_to(Path("elsewhere", "a.json"))
    for text in ("first", "second"):  # of a file that is not there yet, too
        write_text(follow_link(link), text)
        assert (link.is_symlink(), file.read_text()) == (True, text)
    write_text(link, "third")
    assert (link.is_symlink(), link.read_text(), file.read_text()) == (False, "third", "second")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(OSError, match="loop"):
        follow_link(tmp_path / "loop")


def test_an_atomic_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), atomic_folder(tmp_path / "made") as folder:
        (folder / "a").write_text("half")
        raise RuntimeError
    assert not list(tmp_path.iterdir())
    with atomic_folder(tmp_path / "made") as folder:
        (folder / "a").write_text("whole")
    assert (tmp_path / "made" / "a").read_text() == "whole"
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_partial_files_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    """The partial files of living processes stay: a farm may give a task again while its first worker still writes."""
    target = tmp_path / "layers.0001.exr"
    writes = ("import sys, time\nfrom core.system.files import atomic_path\n"
              "with atomic_path(sys.argv[1]):\n    print('begun', flush=True)\n    time.sleep(60)")
    other = subprocess.Popen([sys.executable, "-c", writes, str(target)], cwd=ROOT, stdout=subprocess.PIPE)
    assert other.stdout is not None and other.stdout.readline() == b"begun\n"
    with atomic_path(target) as mine, atomic_path(tmp_path / "layers.0002.exr") as next_one:
        assert mine.suffix == ".exr"
        remove_partials_of(target)
        remove_partials_below(tmp_path)
        assert len(list(tmp_path.iterdir())) == 3, "mine, theirs, and the next one"
        other.kill()
        other.communicate()
        remove_partials_of(target)
        assert sorted(tmp_path.iterdir()) == sorted([mine, next_one])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["layers.0001.exr", "layers.0002.exr"]


def test_a_new_write_removes_the_partial_file_of_a_killed_process(tmp_path: Path) -> None:
    """The partial file of the same target goes; that of another target stays."""
    dies = "import os, sys\nfrom core.system.files import atomic_path\nwith atomic_path(sys.argv[1]):\n    os._exit(9)"
    for name in ("eval.json", "report.json"):
        assert subprocess.run([sys.executable, "-c", dies, str(tmp_path / name)], cwd=ROOT, check=False).returncode == 9
    assert len(list(tmp_path.iterdir())) == 2
    write_json(tmp_path / "eval.json", {})
    left = sorted(path.name for path in tmp_path.iterdir())
    assert len(left) == 2 and left[0].startswith(".partial-report.json-") and left[1] == "eval.json"


def test_a_new_folder_removes_the_partial_folder_of_a_killed_process(tmp_path: Path) -> None:
    """The partial folder of a living process stays."""
    makes = ("import os, sys\nfrom core.system.files import atomic_folder\n"
             "with atomic_folder(sys.argv[1]) as folder:\n    (folder / 'a').touch()\n    ")
    args = [sys.executable, "-c", f"{makes}os._exit(9)", str(tmp_path / "frames")]
    assert subprocess.run(args, cwd=ROOT, check=False).returncode == 9
    args[2] = f"{makes}print('begun', flush=True)\n    sys.stdin.read()"
    other = subprocess.Popen(args, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert other.stdout is not None and other.stdout.readline() == b"begun\n"
    assert len(list(tmp_path.iterdir())) == 1, "what the killed one left is gone"
    with atomic_folder(tmp_path / "frames"):
        assert len(list(tmp_path.iterdir())) == 2, "theirs and mine"
    assert len(list(tmp_path.iterdir())) == 2, "theirs, and the whole one"
    other.kill()
    other.communicate()


def test_a_partial_file_of_another_machine_is_kept_for_an_hour(tmp_path: Path) -> None:
    target, theirs = tmp_path / "a.exr", tmp_path / f".partial-a.exr-{os.getpid()}@01234567-abc.exr"
    theirs.touch()
    remove_partials_of(target)
    assert theirs.exists()
    os.utime(theirs, (time.time() - 4000,) * 2)
    remove_partials_of(target)
    assert not theirs.exists()


def test_a_temporary_file_of_a_temporary_file_has_its_final_name(tmp_path: Path) -> None:
    """Both are named after the final file, so that the next process to write that file removes them after a kill."""
    with atomic_path(tmp_path / "a.flare") as outer, atomic_path(outer) as inner:
        assert inner != outer
        assert inner.name[:17] == outer.name[:17] == ".partial-a.flare-"
        assert outer.exists()
        inner.write_text("1")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.flare", "1")]


def test_a_long_name_leaves_room_for_its_partial_one(tmp_path: Path) -> None:
    target = tmp_path / ("\u6f22" * 80 + ".png")  # three bytes each, of 255 that a name may have
    with atomic_path(target) as partial:
        assert len(os.fsencode(partial.name)) < 200
    assert target.exists()


def test_equal_content_has_an_equal_hash(tmp_path: Path) -> None:
    path, copy = tmp_path / "a", tmp_path / "b"
    for one in (path, copy):
        one.write_bytes(b"one")
    assert content_hash(path) == content_hash(copy)
    path.write_bytes(b"another")
    os.utime(path, (1, 1))
    assert content_hash(path) != content_hash(copy)


def test_a_file_lock_has_one_holder_and_expires(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    with file_lock(lock):
        assert lock.exists()
        started = time.monotonic()
        with file_lock(lock, stale_s=0.05):  # as if the holder had been killed
            assert time.monotonic() - started >= 0.04
    assert not lock.exists()


def test_a_slow_process_leaves_the_lock_that_replaced_its_own(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    with contextlib.ExitStack() as next_one:
        with file_lock(lock):
            next_one.enter_context(file_lock(lock, stale_s=0.05))
        assert lock.exists()
    assert not lock.exists()


def test_two_processes_that_take_over_a_stale_lock_get_it_in_turn(tmp_path: Path,
                                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    """Both processes have seen that the lock is stale before either removes it."""
    lock = tmp_path / ".lock"
    lock.touch()
    os.utime(lock, (1, 1))
    dead, unlink = lock.stat().st_mtime_ns, Path.unlink
    both_have_seen = threading.Barrier(2)
    inside: list[str] = []

    def unlink_late(path: Path, missing_ok: bool = False) -> None:
        if path == lock and path.stat().st_mtime_ns == dead:
            with contextlib.suppress(threading.BrokenBarrierError):
                time.sleep(0.1 * both_have_seen.wait(0.5))
        unlink(path, missing_ok)

    def wait(name: str) -> None:
        with file_lock(lock, stale_s=2.0):
            inside.append(name)
            time.sleep(0.3)
            inside.append(name)

    monkeypatch.setattr(Path, "unlink", unlink_late)
    waiters = [threading.Thread(target=wait, args=(name,)) for name in ("one", "other")]
    for waiter in waiters:
        waiter.start()
    for waiter in waiters:
        waiter.join()
    assert inside in (["one", "one", "other", "other"], ["other", "other", "one", "one"])
    assert list(tmp_path.iterdir()) == []


def test_a_lock_dated_in_the_future_expires(tmp_path: Path) -> None:
    """A clock was set back, or another machine's goes before."""
    lock = tmp_path / ".lock"
    lock.touch()
    os.utime(lock, (time.time() + 3600, time.time() + 3600))
    started = time.monotonic()
    with file_lock(lock, stale_s=0.1):
        assert 0.09 <= time.monotonic() - started < 5


def test_a_duplicate_key_in_json_is_reported(tmp_path: Path) -> None:
    """Without an error the first of the two values would be lost."""
    (tmp_path / "a.json").write_text('{"frames": {"6": [1], "7": [], "6": [2]}}')
    with pytest.raises(CaptureError, match="it has '6' twice"):
        read_json(tmp_path / "a.json", CaptureError)


def test_the_commit_lock_is_held_during_the_rename(tmp_path: Path) -> None:
    seen = []

    @contextlib.contextmanager
    def turn() -> Iterator[None]:
        seen.append((tmp_path / "a").exists())
        yield
        seen.append((tmp_path / "a").exists())

    with atomic_path(tmp_path / "a", turn()) as temporary:
        temporary.write_text("whole")
        assert seen == []
    assert seen == [False, True]


def test_an_error_in_a_read_only_folder_names_the_target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / ".partial-eval.json-1"))

    monkeypatch.setattr("core.system.files.tempfile.mkstemp", refuse)
    with pytest.raises(PermissionError) as problem, atomic_path(tmp_path / "eval.json"):
        pytest.fail("there is nothing to write to")
    assert problem.value.filename == str(tmp_path / "eval.json")


def test_a_lock_in_a_read_only_folder_raises_after_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / ".lock"))

    monkeypatch.setattr("core.system.files._MAX_REFUSALS", 3)
    monkeypatch.setattr("core.system.files.os.open", refuse)
    with pytest.raises(PermissionError), file_lock(tmp_path / ".lock"):
        pass


def test_rounding_keeps_significant_digits_at_any_scale() -> None:
    assert [round_for_text(value) for value in (0.0, 1.23456789, -5e6 - 0.123456789, 0.123456789)] == [
        0.0, 1.234568, -5000000.123457, 0.1234568]
    assert round_for_text(-1.52345678e-5) == pytest.approx(-1.52345678e-5, rel=1e-6)
    assert round_for_text(float("inf")) == float("inf")


@pytest.mark.skipif(os.name == "nt", reason="rights are another matter on Windows")
def test_written_files_have_the_permissions_of_the_umask(tmp_path: Path) -> None:
    """Temporary files are their owner's alone; other workers of a farm have to read the results."""
    mask = os.umask(0o022)
    try:
        write_json(tmp_path / "a.json", {})
        with atomic_folder(tmp_path / "folder"):
            pass
    finally:
        os.umask(mask)
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o644
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o755
