# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows which element a row of the panel Look is: for a second, the camera view dims the rest of the flare and outlines
the element.

The properties call `start_highlight` when a row is chosen; `overlay` draws with `emphasise`.
"""
from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from ..core.look import Edit, LookEdits, PlaneGaussians
from .views import redraw_viewports

DURATION_S = 1.2
DIMMED = 0.15
"""Factor on the light of everything but the highlighted element."""
OUTLINED = 0.1
"""Light of a Gaussian relative to the brightest of its element, from which on the outline goes around it."""
REACH = 1.5
"""Standard deviations of a Gaussian inside the outline."""


@dataclass(frozen=True)
class Highlight:
    """The element whose row was chosen: names of scene, flare and element, and the time when its highlight ends."""

    scene: str
    flare: str
    element: str
    until: float


_current: Highlight | None = None


def start_highlight(item: Any) -> None:
    """Highlight the chosen element of a flare for `DURATION_S`."""
    global _current
    if not 0 <= item.element < len(item.elements) or item.elements[item.element].is_absent:
        return
    _current = Highlight(item.id_data.name, item.name, item.elements[item.element].name, time.monotonic() + DURATION_S)
    if not bpy.app.background:
        if bpy.app.timers.is_registered(_end_highlight):
            bpy.app.timers.unregister(_end_highlight)
        bpy.app.timers.register(_end_highlight, first_interval=DURATION_S)
    redraw_viewports()


def current_highlight(scene: Any) -> Highlight | None:
    """Return the element of a scene that is highlighted now; None without one."""
    if _current is None or _current.scene != scene.name or time.monotonic() > _current.until:
        return None
    return _current


def emphasise(edits: LookEdits, highlight: Highlight, elements: Mapping[str, list[str]]) -> LookEdits:
    """Return edits that dim all but the highlighted element, and show it where it is muted.

    elements: names of the elements by name of the flare.
    """
    def dimmed(edit: Edit) -> Edit:
        return replace(edit, intensity=DIMMED * edit.intensity)

    lights = {name: edits.lights.get(name, Edit()) for name in elements}
    lights = {name: edit if name == highlight.flare else dimmed(edit) for name, edit in lights.items()}
    element_edits = {(flare, name): edits.elements.get((flare, name), Edit()) for flare, names in elements.items()
                     for name in names}
    for name in elements.get(highlight.flare, []):
        key = highlight.flare, name
        edit = element_edits[key]
        element_edits[key] = replace(edit, mute=False) if name == highlight.element else dimmed(edit)
    return LookEdits(edits.master, lights, element_edits)


def isolate(highlight: Highlight, edits: LookEdits) -> LookEdits:
    """Return edits that show the highlighted element alone, at its size and place, at full intensity."""
    key = highlight.flare, highlight.element
    element_edit = replace(edits.elements.get(key, Edit()), mute=False, solo=True, intensity=1.0)
    flare_edit = replace(edits.lights.get(highlight.flare, Edit()), mute=False, solo=True, intensity=1.0)
    return LookEdits(replace(edits.master, mute=False, intensity=1.0), {**edits.lights, highlight.flare: flare_edit},
                     {**edits.elements, key: element_edit})


def outline_box(gaussians: PlaneGaussians, centres: Any, covariances: Any) -> tuple[float, float, float, float] | None:
    """Return the box (left, top, right, bottom) around the brighter Gaussians, pixels; None where there are none.

    centres: (n, 2) px. covariances: (n, 3) xx, xy, yy, px².
    """
    light = gaussians.opacities * np.abs(gaussians.colours).max(-1)
    is_bright = np.isfinite(centres).all(-1) & (light >= OUTLINED * light.max(initial=0.0)) & (light > 0)
    if not is_bright.any():
        return None
    # Outer radius of a ring: r0 + w, Mahalanobis; 1 for a plain Gaussian.
    radii = np.ones(len(light)) if gaussians.rings is None else gaussians.rings.sum(-1)
    half_sizes = REACH * radii[:, None] * np.sqrt(np.maximum(covariances[:, [0, 2]], 0))
    lower, upper = (centres - half_sizes)[is_bright].min(0), (centres + half_sizes)[is_bright].max(0)
    return float(lower[0]), float(lower[1]), float(upper[0]), float(upper[1])


def _end_highlight() -> None:
    """End the highlight."""
    global _current
    _current = None
    redraw_viewports()


def unregister() -> None:
    global _current
    _current = None
    if bpy.app.timers.is_registered(_end_highlight):
        bpy.app.timers.unregister(_end_highlight)


def register() -> None:
    """Do nothing: a highlight begins by `start_highlight`."""
