# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare-free frames of a capture, made once and kept in its folder removed/."""
from __future__ import annotations

import shutil
from pathlib import Path

from ...capture import REMOVED, Capture
from ...errors import CaptureError
from ...images.plates import write_plate
from ...system.files import inside, patiently
from ...system.progress import Progress
from ..inference.neighbours import Sequences, shot_order
from ..inference.remover import Remover
from .manifest import Record, made_from

UNFINISHED = "removed.unfinished"
"""Where they are until they are all there: half a removed/ would be taken for a whole one."""
_LOSSY = frozenset({".jpg", ".jpeg"})


def remove_from(capture: Capture, remover: Remover, progress: Progress) -> Path:
    """Clean every frame into the capture's removed/, JPEG frames as PNG; what an earlier call has made is kept.

    remover: one that takes all of a glow, where the frames are for a fit.

    Raises CaptureError where there is a removed/ already, where the folder cannot be written or two frames would have
    one clean picture, FrameError for a frame that cannot be read, and Cancelled when asked to stop.
    """
    target, work = capture.folder / REMOVED, capture.folder / UNFINISHED
    if target.exists():
        raise CaptureError(f"{target} is there already; remove it, and the frames are cleaned again.")
    names = _names(capture)
    progress.stage("remove", len(capture.views))
    sequences = Sequences(remover, [capture.frame_path(view) for view in capture.views])
    record, results = Record(work), []
    try:
        for view in sorted(capture.views, key=lambda one: shot_order(capture.frame_path(one))):
            frame, name = capture.frame_path(view), names[view.name]
            result = inside(work, str(name), CaptureError)
            results.append(result)
            how = made_from(remover.described, [frame, *sequences.beside(frame)])
            if not record.is_made(name, how, [result]):
                record.begin(name, frame, how, [result], overwrite=True)
                plate, told = sequences.read(frame)
                write_plate(result, plate, remover.remove(plate, told=told)[0])
                record.end([result])
            progress.advance()
        # In this order: what is missing because another has just renamed its folder is in `target` by then.
        if not all(path.is_file() for path in results) and not target.exists():
            raise CaptureError(f"Another fit cleans the frames of {capture.folder} in another way at the same time; "
                               "wait for it, and start this one again.")
        patiently(work.rename, target)
    except OSError as problem:
        if target.is_dir():  # another fit of this capture was first
            shutil.rmtree(work, ignore_errors=True)
            return target
        raise CaptureError(f"{work} cannot be written ({problem.strerror or problem}); copy the capture to where it "
                           "can, or fit it without clean frames (--mode split).") from problem
    return target


def _names(capture: Capture) -> dict[str, Path]:
    """Of every view's clean picture, below the folder. Raises CaptureError where two would be one, on any file system.
    """
    names: dict[str, Path] = {}
    views: dict[str, str] = {}
    for view in capture.views:
        name = Path(view.name)
        name = name.with_suffix(".png") if name.suffix.lower() in _LOSSY else name
        key = name.as_posix().casefold()
        if key in views:
            raise CaptureError(f"The frames {views[key]} and {view.name} of {capture.folder} would both have "
                               f"{REMOVED}/{name.as_posix()}; give one of them another name, in the model too.")
        names[view.name], views[key] = name, view.name
    return names
