# SPDX-License-Identifier: GPL-3.0-or-later
"""The loop that writes clean frames and resumes where it was interrupted.

`batch`, `capture` and `fitted` call it; they differ in which frames there are, what each depends on and how it is
cleaned. The manifest decides which results are kept.
"""
from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

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

    write: writes the files; it runs in another thread. confidence: how sure the remover is that the removed light is a
    flare, 0..1; None where a matte or a fit decided it.
    """

    write: Callable[[], None]
    confidence: float | None = None


def write_clean_frames(frames: Iterable[CleanFrame], manifest: Manifest, progress: Progress, *,
                       digest: Callable[[CleanFrame], str], clean: Callable[[CleanFrame], PreparedResults],
                       keep_finished: bool, overwrite: bool,
                       on_error: Callable[[CleanFrame, Exception], None] | None = None
                       ) -> tuple[int, Counter[KeepReason]]:
    """Write every frame that is not finished; return how many were written, and how many were kept for which reason.

    The results of a frame are written while the next frame is cleaned.

    digest: a text that changes whenever the result would (`digest_inputs`). clean: reads and cleans a frame; nothing is
    deleted if it raises. keep_finished: keep results that are up to date, and edited ones unless `overwrite`.
    overwrite: replace files that are not in the manifest or were edited. on_error: called with a frame and its
    exception; it raises to stop, or returns to go on to the next frame. None: the first exception stops.
    """
    kept_counts = Counter[KeepReason]()
    with _BackgroundWriter(manifest, progress, on_error) as writer:
        for frame in frames:
            prepared = None
            with writer.errors_of(frame):
                key = digest(frame)
                reason = (manifest.reason_to_keep(frame.name, frame.source, key, frame.results) if keep_finished
                          else None)
                if reason == "up to date":
                    manifest.record_missing_results(frame.results)
                if reason is not None and not (overwrite and reason == "edited"):
                    kept_counts[reason] += 1
                else:
                    prepared = clean(frame)
            if prepared is None:
                progress.advance()
            else:
                writer.start(frame, key, prepared, overwrite=overwrite)
        writer.finish()
    return writer.written, kept_counts


class _BackgroundWriter:
    """Writes the results of one frame at a time in another thread, and enters them in the manifest.

    Leaving its context waits for the thread. on_error: as in `write_clean_frames`. written: the number of frames whose
    results were written.
    """

    def __init__(self, manifest: Manifest, progress: Progress,
                 on_error: Callable[[CleanFrame, Exception], None] | None) -> None:
        self._manifest, self._progress, self._on_error = manifest, progress, on_error
        self._thread = ThreadPoolExecutor(1, "clean-frames")
        self._unfinished: tuple[CleanFrame, Future[None]] | None = None
        self.written = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self._thread.shutdown()
        if self._unfinished is not None:
            # An exception ended the loop. Record the finished files, so that the manifest does not take them for edits
            # of a person.
            with contextlib.suppress(Exception):
                self._record(*self._unfinished)

    def start(self, frame: CleanFrame, digest: str, prepared: PreparedResults, *, overwrite: bool) -> None:
        """Finish the previous frame, and begin to write the results of this one.

        digest, overwrite: as in `Manifest.begin_frame`.
        """
        self.finish()
        with self.errors_of(frame):
            self._manifest.begin_frame(frame.name, frame.source, digest, frame.results, overwrite, prepared.confidence)
            self._unfinished = frame, self._thread.submit(prepared.write)
        if self._unfinished is None:
            self._progress.advance()

    def finish(self) -> None:
        """Wait for the results that are being written, if any, and enter them in the manifest."""
        if self._unfinished is None:
            return
        (frame, writing), self._unfinished = self._unfinished, None
        with self.errors_of(frame):
            self._record(frame, writing)
        self._progress.advance()

    def _record(self, frame: CleanFrame, writing: Future[None]) -> None:
        """Wait until the results of a frame are written, then enter them in the manifest. Raises what `writing`
        raised."""
        writing.result()
        self._manifest.record_results(frame.results)
        self.written += 1

    @contextlib.contextmanager
    def errors_of(self, frame: CleanFrame) -> Iterator[None]:
        """Pass an exception of the body to `on_error` as one of this frame, after the results of the previous frame
        are finished."""
        try:
            yield
        except Exception as error:
            if self._on_error is None:
                raise
            self.finish()
            self._on_error(frame, error)
