# SPDX-License-Identifier: GPL-3.0-or-later
"""A progress that records the sentences reported to the user."""
from __future__ import annotations

from core.system.progress import Progress


class RecordingProgress(Progress):
    """texts: everything that was reported, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def say(self, text: str) -> None:
        self.texts.append(text)
