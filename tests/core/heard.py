# SPDX-License-Identifier: GPL-3.0-or-later
"""A progress that remembers what it was told to say."""
from __future__ import annotations

from core.system.progress import Progress


class Heard(Progress):
    """texts: everything that was said, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def say(self, text: str) -> None:
        self.texts.append(text)
