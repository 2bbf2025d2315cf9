# SPDX-License-Identifier: GPL-3.0-or-later
"""What panels and preferences are laid out of: sentences, and bars of work that goes on."""
from __future__ import annotations

from typing import Any

import bpy

from . import jobs


def draw_progress(layout: Any, job: jobs.Job, text: str) -> None:
    """A bar with what is done and the time left, and Cancel."""
    row = layout.row(align=True)
    row.progress(factor=job.share, text=f"{text}: {job.share:.0%}{_time_left(job)}")
    row.operator("fit_flare.cancel", text="", icon="X").folder = str(job.folder)
    if job.said:
        lines(layout, job.said[-1])


def _time_left(job: jobs.Job) -> str:
    """", 3 min left"; nothing where it is not known."""
    if job.stage == "stopping":
        return ", stopping …"
    if not job.left_s:
        return ""
    left = job.left_s
    return f", {left / 60:.0f} min left" if left >= 90 else f", {left:.0f} s left"


def lines(layout: Any, text: str, icon: str = "NONE", width: int = 44) -> None:
    """A sentence broken into labels, since a label is cut off at the panel's edge."""
    region = bpy.context.region
    if region is not None and region.width > 1:
        scale = bpy.context.preferences.system.ui_scale
        width = max(int((region.width - 50 * scale) / (6.4 * scale)), 16)
    column = layout.column(align=True)
    column.scale_y = 0.85
    words, line, first = text.split(), "", True
    for word in [*words, ""]:
        if not word or len(line) + len(word) + 1 > width:
            while len(line) > width + 4:  # a path without blanks
                column.label(text=line[:width], icon=icon if first else "BLANK1" if icon != "NONE" else "NONE")
                line, first = line[width:], False
            if line:
                column.label(text=line, icon=icon if first else "BLANK1" if icon != "NONE" else "NONE")
                first = False
            line = word
        else:
            line = f"{line} {word}".strip()
