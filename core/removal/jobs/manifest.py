# SPDX-License-Identifier: GPL-3.0-or-later
"""What each clean plate of a folder was made from and how, and where its flare is, in remove.json there, so that one is
kept as long as it would come out the same, and whatever else lies there, or was made of it by hand, is not taken for
one."""
from __future__ import annotations

import contextlib
import errno
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

from ...errors import FrameError
from ...system.files import content_of, locked, read_json, remove_file, write_json
from ...system.progress import Progress

RECORD = "remove.json"
LOCK = ".remove.lock"
Kept = Literal["made", "worked on"]
_TABLES = ("plates", "flares", "flares_made", "sources", "written")
"""Of each plate how it was made, where from here its flare is, and how that was made: the plate may have been made in
another way since, without one. The content of what it was made from; and by where it is, that of each file as it was
written."""


def made_from(maker: str, sources: Iterable[Path]) -> str:
    """A short text that changes whenever a plate would: what makes it, and the content of all files that it depends on.
    One that cannot be read counts as such."""
    digest = hashlib.sha256(maker.encode())
    for path in sources:
        try:
            digest.update(content_of(path).encode())
        except OSError:
            digest.update(b"none")
    return digest.hexdigest()[:16]


class Record:
    """The plates below a folder by their names there. Any number of processes may add to it, also ones that make the
    same plates: it is read anew each time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def is_made(self, name: Path, how: str, results: Sequence[Path]) -> bool:
        """Whether all files of a plate are there, made in this way (`made_from`)."""
        written = all(self._read(what).get(name.as_posix()) == value for what, value in self._row(how, results).items())
        return written and all(path.is_file() and path.stat().st_size for path in results)

    def begin(self, name: Path, source: Path, how: str, results: Sequence[Path], overwrite: bool) -> None:
        """Before the files of a plate are written, itself and maybe its flare: what was made there in another way goes,
        so that a kill leaves none under what is now written down. Raises FrameError for a plate or flare that is not
        from here, or was worked on since, unless `overwrite`."""
        key = name.as_posix()
        with locked(self._folder / LOCK):
            known = {what: self._read(what) for what in _TABLES}
            told = {what: {**rows} for what, rows in known.items()}
            for what, value in {**self._row(how, results), "sources": content_of(source)}.items():
                told[what][key] = value
            from_here = (key in known["plates"], known["flares"].get(key) == told["flares"].get(key))
            for path, is_known in zip(results, from_here, strict=False):
                if not overwrite and not is_known and path.exists():
                    raise FrameError(f"{path} is there, and {self._folder / RECORD} does not tell of it: it may be "
                                     "someone's work; choose another folder, or have it written over (--overwrite).")
            if not overwrite and (changed := self._worked_on(results)):
                raise FrameError(f"{changed[0]} was worked on since it was made, of another {source.name} than there "
                                 "is now; choose another folder, or have it written over (--overwrite).")
            for path in results:
                told["written"].pop(_from(self._folder, path), None)
            for path, what in zip(results, ("plates", "flares_made"), strict=False):
                if known[what].get(key) != how:
                    remove_file(path)
            if told != known:
                self._write(told)

    def end(self, results: Sequence[Path]) -> None:
        """After the files of a plate are written."""
        with locked(self._folder / LOCK):
            known = {what: self._read(what) for what in _TABLES}
            known["written"] |= {_from(self._folder, path): content_of(path) for path in results}
            self._write(known)

    def keeps(self, name: Path, source: Path, how: str, results: Sequence[Path]) -> Kept | None:
        """Why the files of a plate stay as they are: "made", as they would be now; or "worked on", by hand; None where
        they are to be made. Where a process was killed before it wrote down what these hold, that is done now, so that
        it is known of those that are worked on from here on."""
        if self.is_made(name, how, results):
            written = self._read("written")
            if not all(_from(self._folder, path) in written for path in results):  # a kill came before `end`
                with contextlib.suppress(OSError):  # a plate is kept in a folder that may not be written to, too
                    self.end(results)
            return "made"
        return "worked on" if self._is_worked_on(name, source, results) else None

    def tell_kept(self, kept: Mapping[Kept, int], progress: Progress) -> None:
        """How many plates stayed as they were, and why."""
        if count := kept.get("made"):
            progress.say(f"{count} plates were in {self._folder} already; --overwrite makes them again.")
        if count := kept.get("worked on"):
            progress.say(f"{count} plates in {self._folder} were worked on since they were made, and are kept; "
                         "--overwrite makes them again.")

    def _is_worked_on(self, name: Path, source: Path, results: Sequence[Path]) -> bool:
        """Whether someone has gone on by hand from a plate that was made here from what `source` still holds, or from
        its flare: that is theirs, and kept however plates are made now."""
        return bool(self._worked_on(results)) and self._read("sources").get(name.as_posix()) == content_of(source)

    def _worked_on(self, results: Sequence[Path]) -> list[Path]:
        """Those that hold something else than was written."""
        written = self._read("written")
        return [path for path in results
                if path.is_file() and written.get(_from(self._folder, path), content_of(path)) != content_of(path)]

    def _write(self, tables: Mapping[str, Mapping[str, str]]) -> None:
        write_json(self._folder / RECORD, {what: dict(sorted(rows.items())) for what, rows in tables.items()})

    def _row(self, how: str, results: Sequence[Path]) -> dict[str, str]:
        """What is written down of a plate, by table."""
        of_flare = {"flares": _from(self._folder, results[1]), "flares_made": how} if results[1:] else {}
        return {"plates": how, **of_flare}

    def made_from_others(self, sources: Mapping[Path, Path]) -> list[Path]:
        """Of plates by their names here, and what each is to be made from, those that were made from something else."""
        told = self._read("sources")
        return [name for name, source in sources.items()
                if name.as_posix() in told and told[name.as_posix()] != content_of(source)]

    def as_made(self, names: Iterable[Path]) -> Iterator[Path]:
        """Of plates by their names here, those that `remove` made and nobody has worked on since, one by one, since
        each is read for it."""
        made = self._read("plates")
        for name in names:
            path = self._folder / name
            if name.as_posix() in made and path.is_file() and not self._worked_on([path]):
                yield name

    def results(self) -> list[Path]:
        """The paths of the plates and flares that it lists, there or not."""
        return [(self._folder / name).resolve() for name in (*self._read("plates"), *self._read("flares").values())]

    def is_refused(self, problem: OSError) -> bool:
        """Whether it is the folder itself that may not be written, whichever plate is next."""
        if not isinstance(problem, PermissionError) and problem.errno != errno.EROFS:
            return False
        own = (self._folder / LOCK, self._folder / RECORD, self._folder, *self._folder.parents)
        return problem.filename is not None and Path(problem.filename) in own

    def _read(self, what: str) -> dict[str, str]:
        """Of each plate one of `_TABLES`; {} where it is not written down."""
        try:
            told = read_json(self._folder / RECORD, FrameError)[what]
            return {str(name): str(one) for name, one in told.items()}
        except (FrameError, AttributeError, KeyError, TypeError):
            return {}


def _from(folder: Path, path: Path) -> str:
    """A path as seen from a folder, which may be moved with it; as it is where that is on another drive."""
    path = path.resolve()
    try:
        return Path(os.path.relpath(path, folder.resolve())).as_posix()
    except ValueError:
        return path.as_posix()
