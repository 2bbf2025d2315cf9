# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes the flares from a list of plates, folders and shots; interrupted, it resumes.

`headless/commands/remove.py` calls `clean_plates`. Plates that cannot be read are reported at the end and do not stop
the others.
"""
from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...colour.srgb import Pixels
from ...errors import DISK_FULL, FrameError, SettingsError, join_failures, os_error_message
from ...images.exr import read_data_window
from ...images.formats.exif import read_exif
from ...images.listing import pictures_below, pictures_in, unlisted_entries
from ...images.plates import Plate, clean_name, is_plate_error
from ...images.views import write_view_results
from ...system.files import check_no_overwrite, real_path
from ...system.progress import Progress
from ...system.tally import Tally, list_first
from ..inference.neighbours import ShotPredictor, shot_sort_key
from ..inference.prediction import FlarePrediction
from ..inference.remover import Remover
from .clean_frames import CleanFrame, PreparedResults, write_clean_frames
from .manifest import MANIFEST, Manifest, digest_inputs
from .mattes import Mattes
from .video_frames import VIDEO_MANIFEST

MIN_CONFIDENCE = 0.5
"""Confidence of a prediction below which a message names the plate: a possible flare was kept."""


def collect_plates(inputs: Iterable[Path], exclude: Iterable[Path | None] = ()) -> list[tuple[Path, Path]]:
    """Return (file, name below the output folder) of every plate: the pictures among `inputs`, and all pictures in the
    folders among them.

    exclude: files and folders that hold no plates, such as the results of this run and mattes. Results of earlier runs,
    which their manifests list, are excluded too unless their own folder is an input. Raises SettingsError where no
    plate is left, and where two would be written to one name; on Windows and macOS a.png and A.png are one name.
    """
    plates: dict[str, tuple[Path, Path]] = {}
    excluded = [other for other in exclude if other is not None]
    for item in inputs:
        if item.is_dir():
            excluded_paths = _excluded_paths(item, excluded)
            for manifest in item.rglob(MANIFEST):
                if manifest.parent != item:
                    excluded_paths.update(Manifest(manifest.parent).result_paths())
            files = [(path, path.relative_to(item)) for path in pictures_below(item)
                     if excluded_paths.isdisjoint(_self_and_parents(path))]
            if not files:
                raise SettingsError(f"{item} holds no pictures besides results; give a folder with PNG, JPEG, "
                                    "TIFF or EXR files.")
        else:
            files = [(item, Path(item.name))]
        for path, name in files:
            key = clean_name(name).as_posix().casefold()
            if key in plates:
                raise SettingsError(f"{plates[key][0]} and {path} would be written to the same file, on Windows and "
                                    "macOS at least; clean them in separate runs.")
            plates[key] = path, name
    return list(plates.values())


def collect_with_neighbours(inputs: Sequence[Path], exclude: Iterable[Path | None] = ()) -> list[Path]:
    """Return the plates of `collect_plates` and, for each input that is a file, all other pictures in its folder.

    They are the frames that may be neighbours: with them, a frame that is cleaned by itself gets the same result as
    with its whole shot.
    """
    excluded_inputs = [other for other in exclude if other is not None]
    plates = dict.fromkeys(path for path, _ in collect_plates(inputs, excluded_inputs))
    for folder in dict.fromkeys(item.parent for item in inputs if not item.is_dir()):
        excluded_paths = _excluded_paths(folder, excluded_inputs)
        with contextlib.suppress(OSError):  # the folder cannot be listed, but its plate may be readable
            plates.update(dict.fromkeys(path for path in pictures_in(folder) if path.resolve() not in excluded_paths))
    return list(plates)


def _excluded_paths(folder: Path, excluded: Iterable[Path]) -> set[Path]:
    """Return files and folders that hold no plates of `folder`: the entries of `excluded` that lie in it, and all
    results that the manifests in `excluded` list."""
    excluded_paths = {other.resolve() for other in excluded if folder.resolve() in other.resolve().parents}
    return excluded_paths.union(*(Manifest(other).result_paths() for other in excluded))


def _self_and_parents(path: Path) -> list[Path]:
    """Return the resolved path and all folders that it is in."""
    resolved = real_path(path)
    return [resolved, *resolved.parents]


def left_out_files(inputs: Iterable[Path], exclude: Iterable[Path | None] = ()) -> dict[str, list[str]]:
    """Return the files in the folders among `inputs` that are left out because they are no plates: the names by reason.

    A name is the path below its input. exclude: files and folders to leave unmentioned, as manifests and hidden entries
    are.
    """
    names_by_reason: dict[str, list[str]] = {}
    for item in inputs:
        if not item.is_dir():
            continue
        excluded_paths = _excluded_paths(item, [other for other in exclude if other is not None])
        folders = [item, *(path for path in item.rglob("*") if path.is_dir())]
        for folder in folders:
            relative_folder = folder.relative_to(item)
            if any(part.startswith(".") for part in relative_folder.parts) or not excluded_paths.isdisjoint(
                    _self_and_parents(folder)):
                continue
            for reason, names in unlisted_entries(folder, subfolders=False):
                names_by_reason.setdefault(reason, []).extend(
                    (relative_folder / name).as_posix() for name in names
                    if name not in (MANIFEST, VIDEO_MANIFEST) and real_path(folder / name) not in excluded_paths)
    return {reason: names for reason, names in names_by_reason.items() if names}


def _check_creatable(folder: Path) -> None:
    """Raise SettingsError where a file or a dangling link lies in the place of a folder or of one of its parents."""
    nearest = next((path for path in (folder, *folder.parents) if os.path.lexists(path)), None)
    if nearest is not None and not nearest.is_dir():
        raise SettingsError(f"{nearest} is not a folder, so {folder} cannot be written to; choose another folder.")


class _PlateCleaner:
    """Predicts and removes the flare of one plate after the other, for `write_clean_frames`.

    mattes: where flares may be removed; None for everywhere. progress: receives the warnings about written plates.
    """

    def __init__(self, remover: Remover, predictor: ShotPredictor, mattes: Mattes | None, progress: Progress) -> None:
        self._remover, self._predictor, self._mattes, self._progress = remover, predictor, mattes, progress

    def digest(self, frame: CleanFrame) -> str:
        """Hash the remover's settings and all files that the clean plate depends on."""
        matte_files = [self._mattes.path(frame.name)] if self._mattes else []
        return digest_inputs(self._remover.cache_key,
                             [frame.source, *self._predictor.dependencies(frame.source), *matte_files])

    def clean(self, frame: CleanFrame) -> PreparedResults:
        """Predict a plate's flare, and prepare its results. With a matte, the flare has no confidence."""
        plate, prediction = self._predictor.predict(frame.source)
        matte = None
        if self._mattes:
            matte = self._mattes.read(frame.name, read_data_window(frame.source), read_exif(frame.source)[0])
        predictions = [prediction, *self._remover.predict_other_views(plate, prediction)]
        return PreparedResults(lambda: self._write(frame, plate, predictions, matte),
                               float(prediction.confidence) if matte is None else None)

    def _write(self, frame: CleanFrame, plate: Plate, predictions: Sequence[FlarePrediction],
               matte: Pixels | None) -> None:
        """Write the clean plate, and its flare where the frame has a second result. predictions: one for each view of
        the plate. matte: (height, width), 0..1."""
        write_view_results(frame.results, plate, self._remover.remove_views(plate, predictions, matte))
        if plate.warning:
            self._progress.say(plate.warning)


def clean_plates(inputs: Sequence[Path], folder: Path, remover: Remover, progress: Progress, *,
                 flare_folder: Path | None = None, mattes: Mattes | None = None, overwrite: bool = False,
                 only: Container[Path] | None = None, independent: bool = False,
                 failed_inputs: Sequence[str] = ()) -> dict[str, Any]:
    """Clean every plate into `folder`; return the result of the command for other programs: the folder, the counts of
    plates made, kept and left out, and the confidence of each plate's flare, 0..1, by name.

    An existing result is kept if it is up to date (same plate, neighbours, matte and remover), or if someone edited it
    and the plate has not changed since (`Manifest`).

    flare_folder: where to write the removed flares, if at all. mattes: where flares may be removed; None for
    everywhere. overwrite: make every frame again. only: names below the output folder of the plates to clean; None for
    all. independent: predict each plate without its neighbours. failed_inputs: messages about inputs that turned out to
    be no plates (`video_frames.expand_videos`); they count as failed.

    Raises SettingsError before anything is written, FrameError at once where the folder cannot be written to, and
    FrameError at the end with a list of the plates that failed.
    """
    for output_folder in filter(None, (folder, flare_folder)):
        _check_creatable(output_folder)
    excluded = [folder, flare_folder, mattes.source if mattes else None]
    plates = collect_plates(inputs, excluded)
    results = {name: [folder / clean_name(name), *([flare_folder / name.with_suffix(".exr")] if flare_folder else [])]
               for _, name in plates}
    check_no_overwrite([*(path for path, _ in plates), *(mattes.files if mattes else ())],
                       itertools.chain.from_iterable(results.values()))
    manifest = Manifest(folder)
    predictor = ShotPredictor(remover, [] if independent else collect_with_neighbours(inputs, excluded))
    cleaner = _PlateCleaner(remover, predictor, mattes, progress)
    if only is not None:
        plates = [(path, name) for path, name in plates if name in only]
    progress.stage("remove", len(plates))
    failed, failed_names = list(failed_inputs), list[str]()

    def leave_out(frame: CleanFrame, error: Exception) -> None:
        """Record a plate that cannot be cleaned; raise an error that concerns all plates."""
        _raise_if_fatal(error, manifest, folder)
        failed.append(_failure_message(frame.source, error))
        failed_names.append(frame.name.as_posix())
        progress.say(f"Left out: {failed[-1]}")

    frames = (CleanFrame(name, path, results[name])
              for path, name in sorted(plates, key=lambda plate: shot_sort_key(plate[0])))
    written, kept_counts = write_clean_frames(frames, manifest, progress, digest=cleaner.digest,
                                              clean=cleaner.clean, keep_finished=not overwrite, overwrite=overwrite,
                                              on_error=leave_out)
    manifest.report_kept(kept_counts, progress)
    tally = Tally("plate", "cleaned", written + kept_counts.total(), left_out_files(inputs, excluded))
    tally.skip("could not be cleaned", *failed_names)
    if failed:
        progress.say(tally.summary())
        raise FrameError(f"{len(failed)} of {len(plates) + len(failed_inputs)} plates could not be cleaned: "
                         f"{join_failures(failed)}")
    confidence = manifest.confidence(name for _, name in plates)
    _report_low_confidence(confidence, progress)
    progress.say(f"{written + kept_counts.total()} clean frames are in {folder}.")
    progress.say(tally.summary())
    return {"plates": str(folder), "made": written, "kept": kept_counts.total(), "confidence": confidence,
            **tally.as_result()}


def _raise_if_fatal(error: Exception, manifest: Manifest, folder: Path) -> None:
    """Raise an error that concerns all plates: a defect, a full disk, or an output folder that cannot be written to."""
    if not is_plate_error(error):
        raise error
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        raise error  # the disk is full, so every later frame would fail too
    if isinstance(error, OSError) and manifest.is_write_error(error):
        raise FrameError(f"{folder} cannot be written to ({error.strerror}); choose another folder for the clean "
                         "frames, or get write permission for this one.") from error


def _failure_message(path: Path, error: Exception) -> str:
    """Return a sentence about a plate that cannot be cleaned. error: one that `is_plate_error` accepts."""
    if isinstance(error, OSError):
        return os_error_message(error)
    return str(error) if isinstance(error, FrameError) else f"{path} does not fit into memory."


def _report_low_confidence(confidence: Mapping[str, float], progress: Progress) -> None:
    """Say in which plates a possible flare was kept. confidence: by name, 0..1."""
    doubtful = [f"{name} ({value:.2f})" for name, value in confidence.items() if value < MIN_CONFIDENCE]
    if doubtful:
        progress.say(f"In {len(doubtful)} of them a possible flare was kept, because it may be part of the scene or of "
                     f"its grade: {list_first(doubtful)}. --sensitivity high or an all-white matte removes it.")
