# SPDX-License-Identifier: GPL-3.0-or-later
"""Structure from motion: from frames or a video to a capture.

    source_frames.py  which frames; small pictures and masks of them
    pairs.py          which frames to match with which
    mapping.py        features, matches and incremental mapping, by pycolmap
    world.py          up direction, floor and scale
    develop.py        the model and the frames, undistorted, at full size
    report.py         figures, and a picture of cameras and points

Intermediate files are in OUT/.solve, from which the next run resumes; the capture itself appears whole at the end.
"""
from __future__ import annotations

import shutil
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from ...choices import Matching
from ...errors import CaptureError, SettingsError
from ...images.listing import pictures_in
from ...images.video import is_video
from ...system.child import ChildDied, run_in_child
from ...system.files import read_json, remove_file, remove_partials_below, write_json
from ...system.folder_lock import folder_lock
from ...system.progress import Progress
from ..capture import LIGHTS, REMOVED
from ..lens import MODELS

REPORT, PICTURE, WORK_FOLDER, REQUEST = "solve.json", "solve.png", ".solve", "request.json"


@dataclass(frozen=True)
class SolveSettings:
    """Settings of a solve.

    frames: how many to choose, 0 = all of a folder and 150 of a video.
    matching: which frames to match; "auto" chooses by their number (pairs.py).
    lens: COLMAP's camera model; one camera for all frames of one size. Without tangential terms by default: they
    imitate a shift of the principal point, about which flares turn.
    size: long side in pixels at which features are found.
    features: largest number of features of a frame.
    output_size: long side of the frames written; 0 = as filmed.
    principal_point: estimate it as well, since flares turn about it; the centre where the frames do not determine it.
    mask: exclude clipped pixels and their bloom from feature extraction.
    seed: of all randomness.
    plate_space: colour space of the frames, in place of what their files declare; "" for that. ocio: the OpenColorIO
    configuration that defines it.
    """

    frames: int = 0
    matching: Matching = "auto"
    lens: str = "RADIAL"
    size: int = 1000
    features: int = 4096
    output_size: int = 0
    principal_point: bool = True
    mask: bool = True
    seed: int = 0
    plate_space: str = ""
    ocio: str | None = None

    def __post_init__(self) -> None:
        """Raise SettingsError for an invalid setting."""
        if self.lens not in MODELS or self.lens == "EQUIRECTANGULAR":
            raise SettingsError(f"{self.lens!r} is not a camera model to solve with; take one of "
                                f"{', '.join(name for name in MODELS if name != 'EQUIRECTANGULAR')}.")
        if self.matching not in (choices := get_args(Matching)):
            raise SettingsError(f"{self.matching!r} is not a way of matching; take one of {', '.join(choices)}.")
        if self.frames < 0 or self.output_size < 0:
            raise SettingsError("Neither the number of frames nor their size can be negative; leave out what is to be "
                                "as it is.")
        if not 100 <= self.size <= 20000:
            raise SettingsError(f"Features are looked for at 100 to 20000 pixels, not at {self.size}.")
        if self.features < 100:
            raise SettingsError(f"A solve needs 100 features a frame or more, not {self.features}.")


def solve(source: Path | str, out: Path | str, settings: SolveSettings | None = None,
          progress: Progress | None = None) -> dict[str, Any]:
    """Solve the frames of a folder or video and write the capture `out`; returns the report, also solve.json.

    Frames that cannot be read, and frames without a place in the largest model, are left out and named. An
    interrupted run with the same source and settings resumes.

    Raises CaptureError where there is nothing to solve or no parallax, FrameError for a video that cannot be read,
    RunError where another process solves there, Cancelled on a stop request, EngineError without pycolmap.
    """
    source, out = Path(source), Path(out)
    if not source.exists():
        raise CaptureError(f"{source} is missing.")
    if out.exists() and not out.is_dir():
        raise CaptureError(f"{out} is a file; give a folder for the capture.")
    settings, progress = settings or SolveSettings(), progress or Progress()
    request = {"source": _fingerprint(source), "settings": asdict(settings)}
    finished = _read_report(out)
    if finished is not None and finished.get("request") == request:  # where nothing may be written, too
        progress.say(f"{out} is solved already.")
        shutil.rmtree(out / WORK_FOLDER, ignore_errors=True)
        return finished
    with folder_lock(out):  # two solves at once would damage the database
        return _solve(source, out, request, settings, progress)


def _solve(source: Path, out: Path, request: dict[str, Any], settings: SolveSettings,
           progress: Progress) -> dict[str, Any]:
    """Carry out `solve` in the locked folder `out`; return the report."""
    from . import develop, mapping, report, source_frames, world

    start = time.monotonic()
    _prepare_output(source, out, request, progress)
    work = out / WORK_FOLDER
    chosen, left_out = source_frames.prepare_frames(source, work, settings.frames, settings.size, progress,
                                                    (settings.plate_space, settings.ocio))
    try:
        solved = run_in_child(mapping.solve, chosen, work, settings, is_video(source), progress=progress)
    except ChildDied as problem:  # pycolmap aborts where its database cannot be written
        raise CaptureError(f"COLMAP ended by itself ({problem}); mostly the disk of {work} is full or fails: make room "
                           "and solve again, finished steps are kept.") from problem
    world.align(solved.model)
    missing = sorted(set(range(len(chosen))) - {frame.index for frame in solved.frames})
    if missing:
        names = ", ".join(Path(chosen[i].file).name for i in missing[:12]) + (", …" if len(missing) > 12 else "")
        progress.say(f"{len(missing)} of {len(chosen)} frames found no place in the model and are left out: {names}.")
    remove_file(out / REPORT)  # describes the capture that is about to be replaced
    develop.write_capture(chosen, solved, out, work, settings.output_size, progress)
    data = report.make_report(chosen, solved, left_out, request, time.monotonic() - start)
    report.draw_model(solved, out / PICTURE)
    write_json(out / REPORT, data)
    shutil.rmtree(work, ignore_errors=True)
    return data


def _fingerprint(source: Path) -> list[Any]:
    """Return a JSON-able identity of a source: its path, and names, lengths and times of its files."""
    files = pictures_in(source) if source.is_dir() else [source]
    stats = [(path.name, path.stat()) for path in files]
    return [str(source.resolve()), *([name, stat.st_size, stat.st_mtime_ns] for name, stat in stats)]


def _read_report(out: Path) -> dict[str, Any] | None:
    """Read the report of a finished solve; None where there is none."""
    if not (out / REPORT).is_file():
        return None
    report = read_json(out / REPORT, CaptureError)
    if not isinstance(report, dict):
        raise CaptureError(f"{out / REPORT} is not the report of a solve; choose another folder for the capture.")
    return dict(report)


def _prepare_output(source: Path, out: Path, request: dict[str, Any], progress: Progress) -> None:
    """Check `out`, and keep or replace the work folder of an interrupted solve in it.

    Raises CaptureError where `out` holds another capture or the source frames.
    """
    if source.resolve() in (out.resolve(), (out / "images").resolve()):
        raise CaptureError(f"The frames in {source} would be overwritten by their undistorted selves; give another "
                           "folder for the capture.")
    capture_parts = [name for name in ("images", "sparse", "transforms.json") if (out / name).exists()]
    if (out / REPORT).is_file():
        dependents = [name for name in (LIGHTS, REMOVED, "split.json", "truth") if (out / name).exists()]
        if dependents:
            raise CaptureError(f"{out} holds {' and '.join(dependents)} of an earlier solve, which fit no other; "
                               "choose another folder for the capture, or remove them.")
    elif capture_parts and not (out / WORK_FOLDER).is_dir():
        raise CaptureError(f"{out} holds {capture_parts[0]} that did not come from a solve; give another folder.")
    if _can_resume(out / WORK_FOLDER, request, progress):
        remove_partials_below(out / WORK_FOLDER)
        progress.say("The interrupted solve is resumed.")
    else:
        shutil.rmtree(out / WORK_FOLDER, ignore_errors=True)
        write_json(out / WORK_FOLDER / REQUEST, request)


def _can_resume(work: Path, request: dict[str, Any], progress: Progress) -> bool:
    """Return whether an interrupted solve of the same request left intact files here."""
    from . import mapping, source_frames

    try:
        if not (work / REQUEST).is_file() or read_json(work / REQUEST, CaptureError) != request:
            return False
        source_frames.read_record(work)
        mapping.check_intermediate_files(work)
    except CaptureError as problem:
        progress.say(f"The solve starts over: {problem}")
        return False
    return True


__all__ = ["SolveSettings", "solve"]
