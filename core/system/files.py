# SPDX-License-Identifier: GPL-3.0-or-later
"""Safe writing and naming of files: results are whole or absent, names stay inside their folder, sources are not
overwritten.

Every module that writes goes through here; `reading.py` opens and parses what is there. `folder_lock.py` locks a folder
for the length of a job.
"""
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
from .processes import WINDOWS, is_running, machine_id
from .reading import UTF8_SIG, check_regular, open_regular, parse_json, read_bytes, read_text

_PARTIAL, _TRASH = ".partial-", ".old-"
"""Parts of the names of temporary files and of folders on their way out."""
_MAX_REFUSALS = 100
"""Failed attempts to create a lock, 0.01 s each, after which the folder counts as not writable."""
_SHARING_ERRORS = (5, 32, 33)
"""Error codes of Windows: access denied, sharing violation, lock violation."""
_RETRY_S = 2.0
"""Seconds for which a refused change is tried again."""
_WRITER_TAG = re.compile(r"-(?P<process>\d+)@(?P<machine>[0-9a-f]{8})-")
"""The process and machine in the name of a temporary file."""
_ABANDONED_AFTER_S = 3600.0
"""Age from which a temporary file of another machine counts as abandoned."""
_DRIVE = re.compile(r".*:" if WINDOWS else r"[A-Za-z]:")
"""Start of a path with a drive letter; on Windows any colon, which would name a stream of a file as well."""
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
"""File names that lead to no other folder on any system, unless they are links or devices of Windows."""
_DEVICE_NAME = re.compile(r"^(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[\d¹²³])\s*(\.|$)", re.IGNORECASE)
"""File names that Windows takes for a device: con, prn, aux, nul, com1 and their like, whatever suffix follows."""


@contextlib.contextmanager
def atomic_path(target: Path | str,
                commit_lock: contextlib.AbstractContextManager[None] | None = None) -> Iterator[Path]:
    """Yield a temporary path beside `target`; rename it to `target` when the block succeeds, remove it when it fails.

    commit_lock: held during the rename. The temporary name keeps the suffix, since writers choose their format by it. A
    symbolic link is replaced by a file: what it points to may belong to another run. Temporary files for `target`
    that a killed process left are removed.
    """
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    check_regular(target)  # do not replace a pipe or a device
    remove_partials_of(target)
    temporary = target
    try:
        handle, name = tempfile.mkstemp(prefix=_partial_prefix(target) + _writer_tag(), suffix=target.suffix,
                                        dir=target.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        _apply_umask(temporary, 0o666)
        with commit_lock or contextlib.nullcontext():
            retry_while_locked(temporary.replace, target)
    except OSError as problem:  # name the target: a failed write names no file, a failed rename the temporary one
        if problem.filename is None or _PARTIAL in str(problem.filename):
            problem.filename = str(target)
        raise
    finally:
        if temporary != target:
            with contextlib.suppress(OSError):  # the earlier failure is reported
                remove_file(temporary)


def follow_link(target: Path) -> Path:
    """Return the file that a symbolic link points to, existing or not; any other path unchanged.

    For files that people keep and link by hand. Raises OSError for a link that leads back to itself.
    """
    if not target.is_symlink():
        return target
    target_path = real_path(target)
    if target_path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(target))
    return target_path


def round_for_text(value: float) -> float:
    """Round a coordinate for a file that people read: to six decimals; values below 1 to about seven digits."""
    return round(value, 6 + max(0, -math.floor(math.log10(abs(value))))) if value and math.isfinite(value) else value


def retry_while_locked(change: Callable[..., object], *args: Any) -> None:
    """Call `change` with `args`; on Windows, repeat it for two seconds while another program holds the file.

    A virus scanner, an indexer or Blender may hold a file for a moment.
    """
    end = time.monotonic() + _RETRY_S
    while True:
        try:
            change(*args)
            return
        except PermissionError as problem:
            if getattr(problem, "winerror", None) not in _SHARING_ERRORS or time.monotonic() > end:
                raise
            time.sleep(0.02)


def remove_file(path: Path) -> None:
    """Remove a file if it exists, with `retry_while_locked`. Raises OSError."""
    retry_while_locked(path.unlink, True)


def remove_folder(folder: Path) -> None:
    """Remove a folder if it exists, with its contents.

    It disappears as a whole. Where a file of it is in use on Windows, it stays unchanged and OSError is raised.
    Contents that cannot be deleted after the folder was moved aside are deleted by the next call.
    """
    for trash in folder.parent.glob(f"{glob.escape(folder.name)}{_TRASH}*"):
        shutil.rmtree(trash, ignore_errors=True)
    if not folder.exists():
        return
    trash = Path(tempfile.mkdtemp(prefix=f"{folder.name}{_TRASH}", dir=folder.parent))
    try:
        retry_while_locked(folder.rename, trash / folder.name)
    finally:
        shutil.rmtree(trash, ignore_errors=True)


def _apply_umask(temporary: Path, mode: int) -> None:
    """Give a file or folder that tempfile made, which only its owner may use, the permissions of any new one.

    mode: permissions before the umask. A refusal is ignored: Windows' disks in WSL and some network shares keep no
    permissions.
    """
    with contextlib.suppress(PermissionError):
        temporary.chmod(mode & ~_umask())


def _partial_prefix(target: Path) -> str:
    """Return the start of the names of all temporary files for `target`. If `target` is temporary itself, return that
    of its final name, so that the next write of the final name removes what a kill left."""
    if target.name.startswith(_PARTIAL) and (writer := _WRITER_TAG.search(target.name)):
        return target.name[:writer.start() + 1]
    # File systems limit a name to 255 bytes.
    return f"{_PARTIAL}{os.fsencode(target.name)[:80].decode(errors='ignore')}-"


def _writer_tag() -> str:
    """Identify this process in the name of a file that it writes: process id and a hash of its machine."""
    return f"{os.getpid()}@{_machine_hash()}-"


@lru_cache(maxsize=1)
def _machine_hash() -> str:
    return hashlib.sha256(machine_id().encode()).hexdigest()[:8]


def _is_being_written(partial: Path) -> bool:
    """Return whether the process in the name of a temporary file still runs or, for a process of another machine, if
    the file is younger than an hour."""
    writer = _WRITER_TAG.search(partial.name)
    if writer is None:
        return False
    if writer["machine"] != _machine_hash():
        with contextlib.suppress(OSError):
            return time.time() - partial.stat().st_mtime < _ABANDONED_AFTER_S
        return False
    return int(writer["process"]) == os.getpid() or is_running(int(writer["process"]))


def _remove_abandoned(partial: Path) -> None:
    """Remove a temporary file or folder unless it is being written, where the system lets it."""
    if _is_being_written(partial):
        return
    if partial.is_dir():
        shutil.rmtree(partial, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            remove_file(partial)


def remove_partials_of(target: Path | str) -> None:
    """Remove the temporary files and folders for `target` that killed processes left, where the system permits it.

    Those of a running process stay: a farm may start a task again while its first worker still lives.
    """
    target = Path(target)
    for path in target.parent.glob(f"{glob.escape(_partial_prefix(target))}*"):
        _remove_abandoned(path)


@contextlib.contextmanager
def file_lock(lock: Path | str, stale_s: float = 10.0) -> Iterator[None]:
    """Hold a lock file while a short block runs, so that processes that share a folder take turns, on network disks
    too.

    A lock older than `stale_s` seconds belonged to a killed process and is taken over; so is a lock that this process
    sees unchanged for that long, in case the clocks of two machines differ.
    """
    lock = Path(lock)
    lock.parent.mkdir(parents=True, exist_ok=True)
    refusals, last_mtime, unchanged_since = 0, 0, time.monotonic()
    while True:
        try:
            os.close(os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
            created_ns = lock.stat().st_mtime_ns
            break
        except (FileExistsError, PermissionError) as problem:
            time.sleep(0.01)
            try:
                status = lock.stat()
                if status.st_mtime_ns != last_mtime:
                    last_mtime, unchanged_since = status.st_mtime_ns, time.monotonic()
                if max(time.time() - status.st_mtime, time.monotonic() - unchanged_since) > stale_s:
                    with file_lock(lock.with_name(lock.name + ".taken_over"), stale_s):  # one process takes it over
                        _remove_lock(lock, status.st_mtime_ns)
            except FileNotFoundError:
                # Windows refuses while another process removes the lock; an unwritable folder refuses for ever.
                refusals += isinstance(problem, PermissionError)
                if refusals > _MAX_REFUSALS:
                    raise problem from None
    try:
        yield
    finally:
        try:
            retry_while_locked(_remove_lock, lock, created_ns)
        except OSError:  # the block is done; age the lock, so that it is taken over at once
            with contextlib.suppress(OSError):
                os.utime(lock, (0, 0))


def _remove_lock(lock: Path, created_ns: int) -> None:
    """Remove the lock if it was created at that time; a lock of another time belongs to a process that took over."""
    with contextlib.suppress(FileNotFoundError):
        if lock.stat().st_mtime_ns == created_ns:
            lock.unlink()


@contextlib.contextmanager
def atomic_folder(target: Path | str) -> Iterator[Path]:
    """Yield a temporary folder beside `target`, which must not exist; rename it to `target` when the block succeeds,
    remove it when it fails.

    Temporary folders for `target` that a killed process left are removed.
    """
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_partials_of(target)
    temporary = Path(tempfile.mkdtemp(prefix=_partial_prefix(target) + _writer_tag(), dir=target.parent))
    try:
        yield temporary
        _apply_umask(temporary, 0o777)
        retry_while_locked(temporary.rename, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_partials_below(folder: Path | str) -> None:
    """Remove all abandoned temporary files below `folder`; only for the process that has the folder to itself."""
    for path in Path(folder).rglob(f"{_PARTIAL}*"):
        _remove_abandoned(path)


def _umask() -> int:
    """Return this process's umask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text atomically, with Unix line ends on every system."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: Path | str, data: Any) -> None:
    """Write JSON atomically. Raises ValueError for NaN and infinity, which other readers reject."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def read_json(path: Path | str, error: type[FitFlareError]) -> Any:
    """Read a JSON file; raises `error` with one sentence if it cannot be read."""
    path = Path(path)
    try:
        return parse_json(read_text(path, encoding=UTF8_SIG))
    except OSError as problem:
        raise error(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    except ValueError as problem:
        raise error(f"{path} is not valid JSON ({problem}); correct it or make it again.") from problem


def avoid_device_name(name: str) -> str:
    """Return `name` with "_" after a part that Windows takes for a device (con, aux, nul, com1, ...), whatever suffix
    follows."""
    return _DEVICE_NAME.sub(r"\1_\3", name, count=1)


def _is_file_name(part: str) -> bool:
    """Return whether any file system accepts the name: at most 255 bytes, in Python's encoding of names that are not
    UTF-8."""
    try:
        return len(os.fsencode(part)) <= 255
    except UnicodeEncodeError:
        return False


def safe_join(folder: Path | str, name: str, error: type[FitFlareError]) -> Path:
    """Return `folder / name`; raises `error` where the name would lead out of the folder.

    Absolute names, drive letters, `..` and symbolic links that point outside are refused, on Windows device names too:
    a name in a file from elsewhere must not reach the rest of the disk.
    """
    folder = Path(folder)
    relative = Path(name.replace("\\", "/"))
    if (not relative.parts or "\0" in name or relative.is_absolute() or _DRIVE.match(relative.parts[0])
            or ".." in relative.parts or not all(map(_is_file_name, relative.parts))):
        raise error(f"{folder} names the file {name!r:.150}, which is not inside the folder; remove that entry.")
    if WINDOWS and any(map(_DEVICE_NAME.match, relative.parts)):
        raise error(f"{folder} names the file {name!r:.150}, which Windows takes for a device; give it another name.")
    path = folder / relative
    if not path.resolve().is_relative_to(folder.resolve()):
        raise error(f"{path} is a link that leads out of {folder}; put the file itself there.")
    return path


def check_names(folder: Path | str, names: Iterable[str], error: type[FitFlareError]) -> Iterator[None]:
    """Check each name as `safe_join` does, with one iteration a name; raises `error` where one leads out of the folder.

    A subfolder is resolved once, so that this is fast for the names of many files.
    """
    inside: set[str] = set()
    for name in names:
        parent, _, file = name.rpartition("/")
        is_plain = bool(_PLAIN_NAME.fullmatch(file)) and not Path(folder, parent, file).is_symlink()
        if not (is_plain and parent in inside) or (WINDOWS and _DEVICE_NAME.match(file)):
            safe_join(folder, name, error)
            if is_plain:
                inside.add(parent)
        yield


def check_no_overwrite(sources: Iterable[Path], results: Iterable[Path]) -> None:
    """Raise SettingsError where a result would overwrite a source, or two results would be the same file."""
    source_files, result_files = {_file_identity(path) for path in sources}, set()
    for path in results:
        identity = _file_identity(path)
        if identity in source_files:
            raise SettingsError(f"{path} would be overwritten by a result; choose another folder for the results.")
        if identity in result_files:
            raise SettingsError(f"Two results would be written to the same file, {path}; choose another folder for "
                                "one kind of them, or separate plates that differ only by their suffix.")
        result_files.add(identity)


def real_path(path: Path) -> Path:
    """Resolve links like `Path.resolve`, which before Python 3.13 raises for a link to itself; such a link stays
    unchanged."""
    return Path(os.path.realpath(path))


def _file_identity(path: Path) -> object:
    """Return a value that is equal for all names of one file: device and inode of an existing one, else its resolved
    path.

    File systems that ignore case know one file as both Plates and plates.
    """
    resolved = real_path(path)
    try:
        parent, file = resolved.parent.stat(), resolved.stat()
    except OSError:
        return resolved
    return (parent.st_dev, parent.st_ino, file.st_ino) if parent.st_ino and file.st_ino else resolved


def hash_files(paths: Iterable[Path]) -> str:
    """Return a hash of the joint content of these files, 16 hexadecimal digits; missing ones are left out."""
    digest = hashlib.sha256()
    for path in paths:
        if path.is_file():
            digest.update(read_bytes(path))
    return digest.hexdigest()[:16]


def content_hash(path: Path) -> str:
    """Return a hash of a file's content, 16 hexadecimal digits; cached while its size and time stay the same."""
    state = path.stat()
    return _cached_hash(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=64)
def _cached_hash(path: Path, _size: int, _time: int) -> str:
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:16]
