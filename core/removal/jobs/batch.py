# SPDX-License-Identifier: GPL-3.0-or-later
"""Removal of many plates: one after the other, past those that cannot be read, resumable."""
from __future__ import annotations

import contextlib
import itertools
import os
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import Any

from ...errors import DISK_FULL, FrameError, SettingsError, refusal, spelled_out
from ...images.exr import window_of
from ...images.formats.exif import read_exif
from ...images.listing import pictures_below, pictures_in
from ...images.plates import is_of_the_plate, write_results
from ...system.files import check_apart, resolved
from ...system.progress import Progress
from ..inference.neighbours import Sequences, shot_order
from ..inference.remover import Remover
from .manifest import RECORD, Kept, Record, made_from
from .mattes import Mattes


def plates_of(inputs: Iterable[Path], apart_from: Iterable[Path | None] = ()) -> list[tuple[Path, Path]]:
    """(file, name below the output folder) of pictures, and of the pictures in folders.

    apart_from: files and folders in these folders that hold no plates: the results of this run, mattes. Clean plates
    and flares of an earlier one, which its record tells, are none either, unless their own folder is given. Raises
    SettingsError where there are none, or where two would be written to one name; on Windows and macOS a.png is A.png.
    """
    found: dict[str, tuple[Path, Path]] = {}
    apart = [other for other in apart_from if other is not None]
    for given in inputs:
        if given.is_dir():
            inner = _no_plates(given, apart)
            for record in given.rglob(RECORD):
                if record.parent != given:
                    inner.update(Record(record.parent).results())
            files = [(path, path.relative_to(given)) for path in pictures_below(given)
                     if inner.isdisjoint(_itself_and_its_folders(path))]
            if not files:
                raise SettingsError(f"{given} holds no pictures, or results alone; give a folder with PNG, JPEG, "
                                    "TIFF or EXR files.")
        else:
            files = [(given, Path(given.name))]
        for path, name in files:
            key = name.as_posix().casefold()
            if key in found:
                raise SettingsError(f"{found[key][0]} and {path} would be written to the same file, on Windows and "
                                    "macOS at least; remove them apart.")
            found[key] = path, name
    return list(found.values())


def with_neighbours(inputs: Sequence[Path], apart_from: Iterable[Path | None] = ()) -> list[Path]:
    """The plates of `plates_of`, and what lies beside those that were given by themselves: one frame of a shot comes
    out as it does with all of them."""
    apart = [other for other in apart_from if other is not None]
    found = dict.fromkeys(path for path, _ in plates_of(inputs, apart))
    for folder in dict.fromkeys(given.parent for given in inputs if not given.is_dir()):
        others = _no_plates(folder, apart)
        with contextlib.suppress(OSError):  # a plate may be read out of a folder that may not be
            found.update(dict.fromkeys(path for path in pictures_in(folder) if path.resolve() not in others))
    return list(found)


def _no_plates(folder: Path, apart: Iterable[Path]) -> set[Path]:
    """Files and folders in `folder` that hold no plates: those of `apart` that lie in it, and the results of an earlier
    run that wrote to one of them."""
    inner = {other.resolve() for other in apart if folder.resolve() in other.resolve().parents}
    return inner.union(*(Record(other).results() for other in apart))


def _itself_and_its_folders(path: Path) -> list[Path]:
    whole = resolved(path)
    return [whole, *whole.parents]


def _in_place_of(folder: Path) -> Path | None:
    """What bars a folder from being made: a file, or a link that leads nowhere, of its name or that of one it is in."""
    first = next((path for path in (folder, *folder.parents) if os.path.lexists(path)), None)
    return None if first is None or first.is_dir() else first


def remove_all(inputs: Sequence[Path], folder: Path, remover: Remover, progress: Progress, *,
               flare_folder: Path | None = None, mattes: Mattes | None = None, overwrite: bool = False,
               wanted: Container[Path] | None = None, stills: bool = False,
               left_out: Sequence[str] = ()) -> dict[str, Any]:
    """Clean every plate into `folder`; one whose result is there, made from the same plate, neighbours and matte in the
    same way (`Record`), is left as it is, and so is one that was worked on since it was made from the same plate.

    mattes: where the flares are; None to have them found anywhere. wanted: names below the output folder of those to be
    cleaned; None for all. stills: each by itself, in place of in line with its neighbours. left_out: what was said
    of inputs that turned out to be no plates (`footage.with_frames`), which have failed with it.

    Raises SettingsError before anything is written, FrameError at once where the folder may not be written to, and
    FrameError after everything was tried, with a list of the plates that failed.
    """
    for place in (folder, flare_folder):
        if place is not None and (other := _in_place_of(place)):
            raise SettingsError(f"{other} is no folder, and results are to go into {place}; name another.")
    apart = [folder, flare_folder, mattes.given if mattes else None]
    plates = plates_of(inputs, apart)
    results = {name: [folder / name, *([flare_folder / name.with_suffix(".exr")] if flare_folder else [])]
               for _, name in plates}
    check_apart([*(path for path, _ in plates), *(mattes.files if mattes else ())],
                itertools.chain.from_iterable(results.values()))
    record = Record(folder)
    sequences = Sequences(remover, [] if stills else with_neighbours(inputs, apart))
    if wanted is not None:
        plates = [(path, name) for path, name in plates if name in wanted]
    progress.stage("remove", len(plates))
    failed = list(left_out)
    made, doubted, kept = 0, 0, Counter[Kept]()
    for path, name in sorted(plates, key=lambda plate: shot_order(plate[0])):
        try:
            matte = [mattes.path(name)] if mattes else []
            how = made_from(remover.described, [path, *sequences.beside(path), *matte])
            if not overwrite and (why := record.keeps(name, path, how, results[name])):
                kept[why] += 1
            else:
                plate, told = sequences.read(path)
                marked = mattes.read(name, window_of(path), read_exif(path)[0]) if mattes else None
                record.begin(name, path, how, results[name], overwrite)  # once it can be read: what is there goes
                write_results(results[name], plate, *remover.remove(plate, marked, told))
                record.end(results[name])
                made += 1
                doubted += marked is None and bool(told.worth < 0.5)
        except Exception as problem:
            if not is_of_the_plate(problem):
                raise
            if isinstance(problem, OSError) and problem.errno in DISK_FULL:
                raise  # none of the others would fit either
            if isinstance(problem, OSError) and record.is_refused(problem):
                raise FrameError(f"{folder} cannot be written to ({problem.strerror}); choose another folder for the "
                                 "clean plates, or have the rights to this one.") from problem
            failed.append(refusal(problem) if isinstance(problem, OSError) else str(problem)
                          if isinstance(problem, FrameError) else f"{path} does not fit into memory.")
            progress.say(f"Left out: {failed[-1]}")
        progress.advance()
    record.tell_kept(kept, progress)
    if failed:
        raise FrameError(f"{len(failed)} of {len(plates) + len(left_out)} plates could not be cleaned: "
                         f"{spelled_out(failed)}")
    if doubted:
        progress.say(f"In {doubted} of them what may be a flare was left, since it may as well be the scene or its "
                     "grade; a matte, white all over, has it taken.")
    progress.say(f"{made + kept.total()} clean plates are in {folder}.")
    return {"plates": str(folder), "made": made, "kept": kept.total()}
