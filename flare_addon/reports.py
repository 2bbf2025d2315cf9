# SPDX-License-Identifier: GPL-3.0-or-later
"""Reports of operators: why a button is disabled, and what went wrong, as one sentence instead of a traceback."""
from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ..core.errors import FitFlareError, os_error_message


@dataclass
class Outcome:
    """The return value of an operator: FINISHED, or CANCELLED after an error."""

    status: set[str] = field(default_factory=lambda: {"FINISHED"})


@contextlib.contextmanager
def report_errors(operator: Any) -> Iterator[Outcome]:
    """Run a block; a FitFlareError or OSError becomes the operator's error report."""
    outcome = Outcome()
    try:
        yield outcome
    except FitFlareError as problem:
        operator.report({"ERROR"}, str(problem))
        outcome.status = {"CANCELLED"}
    except OSError as problem:
        operator.report({"ERROR"}, os_error_message(problem))
        outcome.status = {"CANCELLED"}


class GuardedOperator:
    """Mixin for operators: `why_not` disables the button, `act` does the work, and errors of it are reported."""

    changes_scene: ClassVar[bool] = True
    """Whether the operator changes the scene, which is not possible for a linked one."""

    @classmethod
    def why_not(cls, _context: Any) -> str:
        """Return why the operator cannot run now, for the tooltip; "" where it can."""
        return ""

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Return to Blender whether the button is enabled."""
        why = LINKED if cls.changes_scene and context.scene.library is not None else cls.why_not(context)
        if why:
            cls.poll_message_set(why)  # type: ignore[attr-defined]  # Operator's
        return not why

    def act(self, _context: Any) -> None:
        """Do the work. Raises FitFlareError and OSError."""

    def execute(self, context: Any) -> set[str]:
        """Do the work when Blender calls the operator, and report errors."""
        with report_errors(self) as outcome:
            self.act(context)
        return outcome.status


LINKED = "The scene is linked from another file and cannot be changed here: append it, or open that file"
NO_FLARE = "Fit or open a flare first"
NO_CAMERA = "The scene has no camera"
NO_CAPTURE = "Import a capture first"
