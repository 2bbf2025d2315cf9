# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that are whole or absent, names that stay inside their folder, and results that are written over nothing."""
from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import json
import math
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..errors import FitFlareError, SettingsError
from .processes import WINDOWS, machine, runs

WRITTEN_BY_HAND = "utf-8-sig"
"""Encoding to read what people write: UTF-8, before which Windows' editors put a mark."""
_PARTIAL, _OLD = ".partial-", ".old-"
_REFUSALS = 100  # a hundredth of a second apart
_HELD = (5, 32, 33)  # Windows: access denied, sharing violation, lock violation
_PATIENCE_S = 2.0
_WRITER = re.compile(r"-(?P<process>\d+)@(?P<machine>[0-9a-f]{8})-")
_ABANDONED_S = 3600.0
_DRIVE = re.compile(r".*:" if WINDOWS else r"[A-Za-z]:")
"""As the first part of a name begins; on Windows any colon, which would name a stream of a file as well."""
_OF_DEVICES = re.compile(r"^(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[\d¹²³])\s*(\.|$)", re.IGNORECASE)


@contextlib.contextmanager
def atomic_path(target: Path | str, turn: contextlib.AbstractContextManager[None] | None = None) -> Iterator[Path]:
    """A temporary path beside `target`, renamed on to it when the block ends well and removed when not. turn: held
    while it is renamed.

    The temporary name keeps the suffix, since writers choose their format by it. A symbolic link becomes a file of its
    own: what it names may be another run's. What a killed process left of the file goes, see `remove_partial_of`.
    """
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_partial_of(target)
    temporary = target
    try:
        handle, name = tempfile.mkstemp(prefix=_partial_of(target) + _writer(), suffix=target.suffix, dir=target.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        _share(temporary, 0o666)
        with turn or contextlib.nullcontext():
            patiently(temporary.replace, target)
    except OSError as problem:  # a write to an open file does not say which
        if problem.filename is None or _PARTIAL in str(problem.filename):
            problem.filename = str(target)
        raise
    finally:
        if temporary != target:
            with contextlib.suppress(OSError):  # what failed before is what is to be told
                remove_file(temporary)


def named_by(target: Path) -> Path:
    """The file that a symbolic link names, there or not; any other path as it is. For what people keep and link by
    hand. Raises OSError for a link that leads back to itself."""
    if not target.is_symlink():
        return target
    named = resolved(target)
    if named.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(target))
    return named


def rounded(value: float) -> float:
    """For a file that people read: six decimals, and more where the world's unit is so large that it takes them."""
    return round(value, 6 + max(0, -math.floor(math.log10(abs(value))))) if value and math.isfinite(value) else value


def patiently(change: Callable[..., object], *words: Any) -> None:
    """Make a change of the disk, where Windows refuses again and again for two seconds: a virus scanner, an indexer or
    Blender may hold the file for a moment."""
    end = time.monotonic() + _PATIENCE_S
    while True:
        try:
            change(*words)
            return
        except PermissionError as problem:
            if getattr(problem, "winerror", None) not in _HELD or time.monotonic() > end:
                raise
            time.sleep(0.02)


def remove_file(path: Path) -> None:
    """Remove a file that need not be there, as patiently as Windows wants it. Raises OSError."""
    patiently(path.unlink, True)


def remove_folder(folder: Path) -> None:
    """Remove a folder that need not be there, and all that is in it: by its name it is gone as a whole, or OSError is
    raised and it is as it was, since Windows has something in it in use. What cannot be removed of it after that goes
    with the next."""
    for old in folder.parent.glob(f"{glob.escape(folder.name)}{_OLD}*"):
        shutil.rmtree(old, ignore_errors=True)
    if not folder.exists():
        return
    old = Path(tempfile.mkdtemp(prefix=f"{folder.name}{_OLD}", dir=folder.parent))
    try:
        patiently(folder.rename, old / folder.name)
    finally:
        shutil.rmtree(old, ignore_errors=True)


def _share(temporary: Path, mode: int) -> None:
    """mkstemp makes private files; the result gets the permissions that any new one here would have, where the disk
    has permissions at all and lets them be changed (Windows' disks in WSL and some network shares do not)."""
    with contextlib.suppress(PermissionError):
        temporary.chmod(mode & ~_umask())


def _partial_of(target: Path) -> str:
    return f"{_PARTIAL}{os.fsencode(target.name)[:80].decode(errors='ignore')}-"


def _writer() -> str:
    """This process, for the name of what it writes: its number and its machine's."""
    return f"{os.getpid()}@{_machine()}-"


@lru_cache(maxsize=1)
def _machine() -> str:
    return hashlib.sha256(machine().encode()).hexdigest()[:8]


def _is_being_written(partial: Path) -> bool:
    """Whether the process that its name tells still runs. Of another machine it is taken to for an hour."""
    told = _WRITER.search(partial.name)
    if told is None:
        return False
    if told["machine"] != _machine():
        with contextlib.suppress(OSError):
            return time.time() - partial.stat().st_mtime < _ABANDONED_S
        return False
    return int(told["process"]) == os.getpid() or runs(int(told["process"]))


def _remove_abandoned(partial: Path) -> None:
    """A file or a folder, unless it is being written, where the system lets it."""
    if _is_being_written(partial):
        return
    if partial.is_dir():
        shutil.rmtree(partial, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            remove_file(partial)


def remove_partial_of(target: Path | str) -> None:
    """Remove what a killed process left of `target`, a file or a folder, half written, where the system lets it. What
    another one is writing stays: on a farm a task may be given again while its first worker still lives."""
    target = Path(target)
    for path in target.parent.glob(f"{glob.escape(_partial_of(target))}*"):
        _remove_abandoned(path)


@contextlib.contextmanager
def locked(lock: Path | str, stale_s: float = 10.0) -> Iterator[None]:
    """Hold a lock file while a short block runs, so that processes of one folder take turns, on shared disks too.

    A lock older than `stale_s` belonged to a process that was killed, and is taken over; so is one that stays the same
    for so long, whatever the clocks say.
    """
    lock = Path(lock)
    lock.parent.mkdir(parents=True, exist_ok=True)
    refused, seen, since = 0, 0, time.monotonic()
    while True:
        try:
            os.close(os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
            own = lock.stat().st_mtime_ns
            break
        except (FileExistsError, PermissionError) as problem:
            time.sleep(0.01)
            try:
                state = lock.stat()
                if state.st_mtime_ns != seen:
                    seen, since = state.st_mtime_ns, time.monotonic()
                if max(time.time() - state.st_mtime, time.monotonic() - since) > stale_s:
                    with locked(lock.with_name(lock.name + ".taken_over"), stale_s):  # another may wait for the same
                        _remove_lock(lock, state.st_mtime_ns)
            except FileNotFoundError:
                # Windows refuses while another one is removing it; a folder that may not be written refuses for ever.
                refused += isinstance(problem, PermissionError)
                if refused > _REFUSALS:
                    raise problem from None
    try:
        yield
    finally:
        patiently(_remove_lock, lock, own)


def _remove_lock(lock: Path, made_ns: int) -> None:
    """The one that was made at that time: who was slow enough to be taken for dead has lost it to another."""
    with contextlib.suppress(FileNotFoundError):
        if lock.stat().st_mtime_ns == made_ns:
            lock.unlink()


@contextlib.contextmanager
def atomic_folder(target: Path | str) -> Iterator[Path]:
    """A temporary folder beside `target`, which must not be there yet, renamed to it when the block ends well and
    removed when not. What a killed process left of it goes, too."""
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_partial_of(target)
    temporary = Path(tempfile.mkdtemp(prefix=_partial_of(target) + _writer(), dir=target.parent))
    try:
        yield temporary
        _share(temporary, 0o777)
        patiently(temporary.rename, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_partial(folder: Path | str) -> None:
    """Remove what a killed process left half written below `folder`; only for whom the folder belongs to alone."""
    for path in Path(folder).rglob(f"{_PARTIAL}*"):
        _remove_abandoned(path)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text atomically, with Unix line ends on every system."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path | str, data: Any) -> None:
    """Write JSON atomically. NaN and infinity are refused: other readers would choke on them."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def read_json(path: Path | str, error: type[FitFlareError]) -> Any:
    """The content of a JSON file; `error` with one sentence where it cannot be had."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding=WRITTEN_BY_HAND), object_pairs_hook=_without_doubles)
    except OSError as problem:
        raise error(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    except (ValueError, RecursionError) as problem:
        raise error(f"{path} is not valid JSON ({problem}); mend it or make it again.") from problem


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Raises ValueError for a name that is given twice, of which json keeps the last."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has {next(name for name in names if names.count(name) > 1)!r} twice")
    return found


def plain_name(name: str) -> str:
    """`name`, with "_" after the part that Windows takes for a device, whatever suffix follows: con, aux, nul, com1 and
    their like."""
    return _OF_DEVICES.sub(r"\1_\3", name, count=1)


def _is_file_name(part: str) -> bool:
    """Whether any file system would take it: 255 bytes at most, and as Python has the names that are not UTF-8."""
    try:
        return len(os.fsencode(part)) <= 255
    except UnicodeEncodeError:
        return False


def inside(folder: Path | str, name: str, error: type[FitFlareError]) -> Path:
    """`folder / name`, refused with `error` where the name would lead out of the folder.

    Absolute names, drive letters, `..` and symbolic links that point outside are refused, on Windows those of devices
    too; what a file from elsewhere names must not reach the rest of the disk.
    """
    folder = Path(folder)
    parts = Path(name.replace("\\", "/"))
    if (not parts.parts or "\0" in name or parts.is_absolute() or _DRIVE.match(parts.parts[0])
            or ".." in parts.parts or not all(map(_is_file_name, parts.parts))):
        raise error(f"{folder} names the file {name!r:.150}, which is not inside the folder; remove that entry.")
    if WINDOWS and any(map(_OF_DEVICES.match, parts.parts)):
        raise error(f"{folder} names the file {name!r:.150}, which Windows takes for a device; give it another name.")
    path = folder / parts
    if not path.resolve().is_relative_to(folder.resolve()):
        raise error(f"{path} is a link that leads out of {folder}; put the file itself there.")
    return path


def check_apart(sources: Iterable[Path], results: Iterable[Path]) -> None:
    """Raises SettingsError where a result would be written over a source, or two would be the same file."""
    read, written = {_file_of(path) for path in sources}, set()
    for path in results:
        whole = _file_of(path)
        if whole in read:
            raise SettingsError(f"{path} would be overwritten by a result; choose another folder for the results.")
        if whole in written:
            raise SettingsError(f"Two results would be written to the same file, {path}; choose another folder for "
                                "one kind of them, or take plates that differ by their suffix alone apart.")
        written.add(whole)


def resolved(path: Path) -> Path:
    """`Path.resolve`, which before Python 3.13 raises for a link that leads back to itself; that stays as it is."""
    return Path(os.path.realpath(path))


def _file_of(path: Path) -> object:
    """The same of every name that a file has: of one that is there its place on the disk, which file systems that do
    not tell Plates from plates know by both names."""
    whole = resolved(path)
    try:
        folder, file = whole.parent.stat(), whole.stat()
    except OSError:
        return whole
    return (folder.st_dev, folder.st_ino, file.st_ino) if folder.st_ino and file.st_ino else whole


def digest_of(paths: Iterable[Path]) -> str:
    """Changes whenever what these files hold together does; those that are not there are left out."""
    digest = hashlib.sha256()
    for path in paths:
        if path.is_file():
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def content_of(path: Path) -> str:
    """A digest of a file's content. Asked for again it is known, as long as the file's size and time stay."""
    state = path.stat()
    return _content(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=64)
def _content(path: Path, _size: int, _time: int) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:16]
