# SPDX-License-Identifier: GPL-3.0-or-later
"""The manifest of a folder of clean frames: remove.json, which lists what each frame was made from.

With it `clean_frames` keeps the frames that are up to date, and never replaces a file that a person edited or put
there. `provenance` reads from it where a capture's clean frames come from.
"""
from __future__ import annotations

import contextlib
import errno
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

from ...errors import FrameError
from ...system.files import content_hash, file_lock, read_json, remove_file, write_json
from ...system.progress import Progress

MANIFEST = "remove.json"
LOCK = ".remove.lock"
KeepReason = Literal["up to date", "edited"]
_Tables = dict[str, dict[str, str]]
TABLES = ("plates", "flares", "flares_made", "sources", "written", "confidence")
"""By frame: digest of the clean frame; path of its flare relative to the folder; digest of the flare, since the frame
may have been made again without one; content hash of the frame as filmed. By path: content hash of each file as it was
written. By frame: confidence of the network that its flare is a flare, 0..1."""


def digest_inputs(maker: str, sources: Iterable[Path]) -> str:
    """Return a short text that changes whenever a clean frame would.

    maker: identifies the network or fit with its settings. sources: all files that the result depends on; the text
    "none" stands for the content of a file that cannot be read.
    """
    digest = hashlib.sha256(maker.encode())
    for path in sources:
        try:
            digest.update(content_hash(path).encode())
        except OSError:
            digest.update(b"none")
    return digest.hexdigest()[:16]


class Manifest:
    """The manifest of one output folder; its keys are the frames' names below the folder.

    Arguments of the methods: name, source and results are those of a `clean_frames.CleanFrame`; digest is a text of
    `digest_inputs`.

    Any number of processes may add to it, also for the same frames: every method reads the file anew.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def is_up_to_date(self, name: Path, digest: str, results: Sequence[Path]) -> bool:
        """Return whether all files of a frame exist and were made with this digest (`digest_inputs`)."""
        return self._is_up_to_date(self._read_tables(), name, digest, results)

    def reason_to_keep(self, name: Path, source: Path, digest: str, results: Sequence[Path]) -> KeepReason | None:
        """Return why the files of a frame are kept, or None if they are to be made.

        "up to date": making them again would give the same files. "edited": someone changed them after they were made,
        and `source` has not changed since.
        """
        tables = self._read_tables()
        if self._is_up_to_date(tables, name, digest, results):
            return "up to date"
        is_edited = (bool(self._edited_files(tables, results))
                     and tables["sources"].get(name.as_posix()) == content_hash(source))
        return "edited" if is_edited else None

    def begin_frame(self, name: Path, source: Path, digest: str, results: Sequence[Path], overwrite: bool,
                    confidence: float | None = None) -> None:
        """Enter a frame before its files are written, and delete its old files that were made with another digest.

        confidence: how sure the remover is that the removed light is a flare, 0..1; None where it did not judge.

        A process that is killed afterwards leaves no old file under the new digest. Raises FrameError for a file that
        the manifest does not list or that was edited, unless `overwrite`.
        """
        key = name.as_posix()
        with file_lock(self._folder / LOCK):
            old = self._read_tables()
            new = {table: {**rows} for table, rows in old.items()}
            for table, value in {**self._entries(digest, results), "sources": content_hash(source)}.items():
                new[table][key] = value
            # For the clean frame, then for its flare: the order of `results`.
            is_listed = (key in old["plates"], old["flares"].get(key) == new["flares"].get(key))
            for path, listed in zip(results, is_listed, strict=False):
                if not overwrite and not listed and path.exists():
                    raise FrameError(f"{path} exists and is not listed in {self._folder / MANIFEST}, so it may be "
                                     "someone's work; choose another folder, or replace it with --overwrite.")
            if not overwrite and (changed := self._edited_files(old, results)):
                raise FrameError(f"{changed[0]} was edited after it was made, from another {source.name} than there is "
                                 "now; choose another folder, or replace it with --overwrite.")
            for path in results:
                new["written"].pop(_relative_path(self._folder, path), None)
            new["confidence"].pop(key, None)
            if confidence is not None:
                new["confidence"][key] = f"{confidence:.2f}"
            for path, table in zip(results, ("plates", "flares_made"), strict=False):
                if old[table].get(key) != digest:
                    remove_file(path)
            if new != old:
                self._write_tables(new)

    def record_results(self, results: Sequence[Path]) -> None:
        """Enter the content of a frame's files after they were written."""
        with file_lock(self._folder / LOCK):
            tables = self._read_tables()
            tables["written"] |= {_relative_path(self._folder, path): content_hash(path) for path in results}
            self._write_tables(tables)

    def record_missing_results(self, results: Sequence[Path]) -> None:
        """Enter the content of a frame's files that are up to date, where a process was killed before it did so; else
        later edits would not be noticed. A folder that cannot be written to is left as it is."""
        written = self._read_tables()["written"]
        if not all(_relative_path(self._folder, path) in written for path in results):
            with contextlib.suppress(OSError):
                self.record_results(results)

    def confidence(self, names: Iterable[Path]) -> dict[str, float]:
        """Return the recorded confidence in each frame's flare, 0..1, by the frame's name. Frames without a record are
        left out: those cleaned with a matte or from a fit."""
        table = self._read_tables()["confidence"]
        values: dict[str, float] = {}
        for name in names:
            with contextlib.suppress(KeyError, ValueError):  # none recorded, or edited by hand
                values[name.as_posix()] = float(table[name.as_posix()])
        return values

    def report_kept(self, counts: Mapping[KeepReason, int], progress: Progress) -> None:
        """Say how many frames were kept, and why."""
        if count := counts.get("up to date"):
            progress.say(f"{count} clean frames in {self._folder} are up to date; --overwrite makes them again.")
        if count := counts.get("edited"):
            progress.say(f"{count} clean frames in {self._folder} were edited after they were made, and are kept; "
                         "--overwrite makes them again.")

    def changed_sources(self, sources: Mapping[Path, Path]) -> list[Path]:
        """Return the names of the frames whose source has changed since they were made. sources: files by frame
        name."""
        recorded = self._read_tables()["sources"]
        return [name for name, source in sources.items()
                if name.as_posix() in recorded and recorded[name.as_posix()] != content_hash(source)]

    def unedited_frames(self, names: Iterable[Path]) -> Iterator[Path]:
        """Yield the names of the frames that `remove` made and nobody has edited since.

        A frame's file is read only when its turn comes, so a caller may stop early.
        """
        tables = self._read_tables()
        for name in names:
            path = self._folder / name
            if name.as_posix() in tables["plates"] and path.is_file() and not self._edited_files(tables, [path]):
                yield name

    def result_paths(self) -> list[Path]:
        """Return the paths of the clean frames and flares that are listed, whether they exist or not."""
        tables = self._read_tables()
        return [(self._folder / name).resolve() for name in (*tables["plates"], *tables["flares"].values())]

    def is_write_error(self, error: OSError) -> bool:
        """Return whether the folder itself cannot be written to, so that every other frame would fail too."""
        if not isinstance(error, PermissionError) and error.errno != errno.EROFS:
            return False
        paths = (self._folder / LOCK, self._folder / MANIFEST, self._folder, *self._folder.parents)
        return error.filename is not None and Path(error.filename) in paths

    def _is_up_to_date(self, tables: _Tables, name: Path, digest: str, results: Sequence[Path]) -> bool:
        """Return whether a frame is entered with this digest and no file is missing or empty."""
        entered = all(tables[table].get(name.as_posix()) == value
                      for table, value in self._entries(digest, results).items())
        return entered and all(path.is_file() and path.stat().st_size for path in results)

    def _edited_files(self, tables: _Tables, results: Sequence[Path]) -> list[Path]:
        """Return the files among `results` whose content differs from the recorded one; unrecorded files are left
        out."""
        written = tables["written"]
        return [path for path in results if path.is_file()
                and written.get(_relative_path(self._folder, path), content_hash(path)) != content_hash(path)]

    def _entries(self, digest: str, results: Sequence[Path]) -> dict[str, str]:
        """Return the entries, by table, that a frame gets before its files are written: digests and the flare's
        path."""
        flare = ({"flares": _relative_path(self._folder, results[1]), "flares_made": digest} if results[1:] else {})
        return {"plates": digest, **flare}

    def _read_tables(self) -> _Tables:
        """Return all tables; a missing or damaged table is empty."""
        try:
            data = read_json(self._folder / MANIFEST, FrameError)
        except FrameError:
            data = {}
        tables: _Tables = {}
        for table in TABLES:
            try:
                tables[table] = {str(name): str(value) for name, value in data[table].items()}
            except (AttributeError, KeyError, TypeError):
                tables[table] = {}
        return tables

    def _write_tables(self, tables: _Tables) -> None:
        write_json(self._folder / MANIFEST, {table: dict(sorted(rows.items())) for table, rows in tables.items()})


def _relative_path(folder: Path, path: Path) -> str:
    """Return a path relative to a folder, which may be moved with it; the absolute path on another drive."""
    path = path.resolve()
    try:
        return Path(os.path.relpath(path, folder.resolve())).as_posix()
    except ValueError:
        return path.as_posix()
