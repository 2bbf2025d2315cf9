# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress for tests: one records the sentences reported to the user, one requests a stop."""
from __future__ import annotations

from core.system.progress import Progress


class RecordingProgress(Progress):
    """texts: everything that was reported, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def say(self, text: str) -> None:
        self.texts.append(text)


class StopAfter(Progress):
    """Requests a stop once a number of steps were made, of one stage or, with "", of all stages."""

    def __init__(self, steps: int, stage: str = "") -> None:
        super().__init__()
        self._steps_left, self._counted_stage = steps, stage

    def advance(self, steps: int = 1, **figures: float) -> None:
        if self._counted_stage in ("", self._stage):
            self._steps_left -= steps
            if self._steps_left <= 0:
                self.request_stop()
        super().advance(steps, **figures)
