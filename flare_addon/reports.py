# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors as Blender shows them: one sentence in the report, never a traceback."""
from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from ..core.errors import FitFlareError


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
        where = f" ({problem.filename})" if problem.filename else ""
        operator.report({"ERROR"}, f"The system refused: {problem.strerror or problem}{where}.")
        outcome.status = {"CANCELLED"}
