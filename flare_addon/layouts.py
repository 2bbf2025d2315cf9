# SPDX-License-Identifier: GPL-3.0-or-later
"""Layout elements of panels and preferences: wrapped sentences, progress bars, columns of settings."""
from __future__ import annotations

from typing import Any

import bpy

from . import jobs


def draw_progress(layout: Any, job: jobs.Job, text: str) -> None:
    """Draw a progress bar with the remaining time, and a button that cancels the job."""
    row = layout.row(align=True)
    row.progress(factor=job.fraction_done, text=f"{text}: {job.fraction_done:.0%}{_time_left(job)}")
    row.operator("fit_flare.cancel", text="", icon="X").folder = str(job.folder)
    if job.messages:
        label_lines(layout, job.messages[-1])


def _time_left(job: jobs.Job) -> str:
    """Format the remaining time as ", 3 min left"; "" where it is unknown."""
    if job.stage == "stopping":
        return ", stopping …"
    if not job.eta_s:
        return ""
    seconds = job.eta_s
    return f", {seconds / 60:.0f} min left" if seconds >= 90 else f", {seconds:.0f} s left"


def label_lines(layout: Any, text: str, icon: str = "NONE", width: int = 44) -> None:
    """Draw a sentence as several labels, since Blender cuts a label off at the edge of the panel.

    width: characters in a line where the width of the panel is not known.
    """
    region = bpy.context.region
    if region is not None and region.width > 1:
        scale = bpy.context.preferences.system.ui_scale
        # A character is about 6.4 px wide; icon and margins take 50 px.
        width = max(int((region.width - 50 * scale) / (6.4 * scale)), 16)
    column = layout.column(align=True)
    column.scale_y = 0.85
    for number, line in enumerate(_wrap(text, width)):
        # Further lines are indented by the width of the icon.
        column.label(text=line, icon=icon if number == 0 else "BLANK1" if icon != "NONE" else "NONE")


def _wrap(text: str, width: int) -> list[str]:
    """Return a text as lines of at most `width` characters; a longer word, such as a path, is cut into pieces, of which
    the last may have up to 4 characters more."""
    lines, line = [], ""
    for word in [*text.split(), ""]:  # the empty word ends the last line
        if word and len(line) + len(word) + 1 <= width:
            line = f"{line} {word}".strip()
            continue
        while len(line) > width + 4:  # up to four letters too many stay on the line
            lines.append(line[:width])
            line = line[width:]
        lines += [line] if line else []
        line = word
    return lines


def settings_column(layout: Any) -> Any:
    """Return a column for properties that are not animated."""
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    return column
