# SPDX-License-Identifier: GPL-3.0-or-later
"""What buttons tell people: why they cannot be pressed, and what went wrong, in a sentence, never a traceback."""
from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

from ..core.errors import FitFlareError, refusal


@dataclass
class Outcome:
    """What an operator returns: FINISHED, or CANCELLED once something went wrong."""

    status: set[str] = field(default_factory=lambda: {"FINISHED"})


@contextlib.contextmanager
def reported(operator: Any) -> Iterator[Outcome]:
    """Run a block; what goes wrong in a way meant for the user becomes the operator's error report."""
    outcome = Outcome()
    try:
        yield outcome
    except FitFlareError as problem:
        operator.report({"ERROR"}, str(problem))
        outcome.status = {"CANCELLED"}
    except OSError as problem:
        operator.report({"ERROR"}, refusal(problem))
        outcome.status = {"CANCELLED"}


class Action:
    """For an operator to inherit beside bpy.types.Operator: `why_not` greys its button out, `act` does the work."""

    changes_scene: ClassVar[bool] = True
    """Whether it needs a scene that can be changed, which a linked one cannot."""

    @classmethod
    def why_not(cls, _context: Any) -> str:
        """Why it cannot run now, as its tooltip says it; "" where it can."""
        return ""

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Blender's question whether the button can be pressed."""
        why = LINKED if cls.changes_scene and context.scene.library is not None else cls.why_not(context)
        if why:
            cls.poll_message_set(why)  # type: ignore[attr-defined]  # Operator's
        return not why

    def act(self, _context: Any) -> None:
        """The work; what goes wrong is raised."""

    def execute(self, context: Any) -> set[str]:
        """Blender's call: the work, and a report of what went wrong."""
        with reported(self) as outcome:
            self.act(context)
        return outcome.status


LINKED = "The scene is linked from another file, and nothing in it can be changed here: append it, or open that file"
NO_FLARE = "Fit or open a flare first"
NO_CAMERA = "The scene has no camera"
NO_CAPTURE = "Import a capture first"
