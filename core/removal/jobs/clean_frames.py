# SPDX-License-Identifier: GPL-3.0-or-later
"""The loop that writes clean frames and resumes where it was interrupted.

`batch`, `capture` and `fitted` call it; they differ in which frames there are, what each depends on and how it is
cleaned. The manifest decides which results are kept.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from ...system.progress import Progress
from .manifest import KeepReason, Manifest


class CleanFrame(NamedTuple):
    """One frame to clean.

    name: path of the clean frame below the output folder, which is its key in the manifest. source: path of the frame
    as filmed. results: paths of the files to write, the clean frame first, then its flare where one is requested.
    """

    name: Path
    source: Path
    results: list[Path]


class PreparedResults(NamedTuple):
    """The results of a frame before they are written.

    write: writes the files. confidence: how sure the remover is that the removed light is a flare, 0..1; None where a
    matte or a fit decided it.
    """

    write: Callable[[], None]
    confidence: float | None = None


def write_clean_frames(frames: Iterable[CleanFrame], manifest: Manifest, progress: Progress, *,
                       digest: Callable[[CleanFrame], str], clean: Callable[[CleanFrame], PreparedResults],
                       keep_finished: bool, overwrite: bool,
                       on_error: Callable[[CleanFrame, Exception], None] | None = None
                       ) -> tuple[int, Counter[KeepReason]]:
    """Write every frame that is not finished; return how many were written, and how many were kept for which reason.

    digest: a text that changes whenever the result would (`digest_inputs`). clean: reads and cleans a frame; nothing is
    deleted if it raises. keep_finished: keep results that are up to date, and edited ones unless `overwrite`.
    overwrite: replace files that are not in the manifest or were edited. on_error: called with a frame and its
    exception; it raises to stop, or returns to go on to the next frame. None: the first exception stops.
    """
    written, kept_counts = 0, Counter[KeepReason]()
    for frame in frames:
        try:
            key = digest(frame)
            reason = manifest.reason_to_keep(frame.name, frame.source, key, frame.results) if keep_finished else None
            if reason == "up to date":
                manifest.record_missing_results(frame.results)
            if reason is not None and not (overwrite and reason == "edited"):
                kept_counts[reason] += 1
            else:
                prepared = clean(frame)
                manifest.begin_frame(frame.name, frame.source, key, frame.results, overwrite, prepared.confidence)
                prepared.write()
                manifest.record_results(frame.results)
                written += 1
        except Exception as error:
            if on_error is None:
                raise
            on_error(frame, error)
        progress.advance()
    return written, kept_counts
