# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows which element a row of the panel Look is: for a second, the camera view dims the rest of the flare and outlines
the element.

The properties call `touch` when a row is chosen; `overlay` draws with `highlighted`.
"""
from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from ..core.look import Edit, LookEdits, PlaneGaussians

DURATION_S = 1.2
DIMMED = 0.15
"""Factor on the light of everything but the touched element."""
OUTLINED = 0.1
"""Light of a Gaussian relative to the brightest of its element, from which on the outline goes around it."""
REACH = 1.5
"""Standard deviations of a Gaussian inside the outline."""


@dataclass(frozen=True)
class Touched:
    """The element whose row was chosen: names of scene, flare and element, and the time when its highlight ends."""

    scene: str
    flare: str
    element: str
    until: float


_touched: Touched | None = None


def touch(item: Any) -> None:
    """Highlight the chosen element of a flare for `DURATION_S`."""
    global _touched
    if not 0 <= item.element < len(item.elements):
        return
    _touched = Touched(item.id_data.name, item.name, item.elements[item.element].name, time.monotonic() + DURATION_S)
    if not bpy.app.background:
        if bpy.app.timers.is_registered(_end):
            bpy.app.timers.unregister(_end)
        bpy.app.timers.register(_end, first_interval=DURATION_S)
    _redraw()


def touched(scene: Any) -> Touched | None:
    """Return the element of a scene that is highlighted now; None without one."""
    if _touched is None or _touched.scene != scene.name or time.monotonic() > _touched.until:
        return None
    return _touched


def highlighted(edits: LookEdits, chosen: Touched, elements: Mapping[str, list[str]]) -> LookEdits:
    """Return edits that dim all but the touched element, and show it where it is muted.

    elements: names of the elements by name of the flare.
    """
    def dimmed(edit: Edit) -> Edit:
        return replace(edit, intensity=DIMMED * edit.intensity)

    lights = {name: edits.lights.get(name, Edit()) if name == chosen.flare else dimmed(edits.lights.get(name, Edit()))
              for name in elements}
    parts = {(name, part): edits.elements.get((name, part), Edit()) for name, parts in elements.items()
             for part in parts}
    for name in elements.get(chosen.flare, []):
        key = chosen.flare, name
        parts[key] = replace(parts[key], mute=False) if name == chosen.element else dimmed(parts[key])
    return LookEdits(edits.master, lights, parts)


def alone(chosen: Touched, edits: LookEdits) -> LookEdits:
    """Return edits that show the touched element alone, at its size and place, at full intensity."""
    key = chosen.flare, chosen.element
    part = replace(edits.elements.get(key, Edit()), mute=False, solo=True, intensity=1.0)
    whole = replace(edits.lights.get(chosen.flare, Edit()), mute=False, solo=True, intensity=1.0)
    return LookEdits(replace(edits.master, mute=False, intensity=1.0), {**edits.lights, chosen.flare: whole},
                     {**edits.elements, key: part})


def outline(gaussians: PlaneGaussians, centres: Any, covariances: Any) -> tuple[float, float, float, float] | None:
    """Return the box (left, top, right, bottom) around the brighter Gaussians, pixels; None where there are none.

    centres: (n, 2) px. covariances: (n, 3) xx, xy, yy, px².
    """
    light = gaussians.opacities * np.abs(gaussians.colours).max(-1)
    chosen = np.isfinite(centres).all(-1) & (light >= OUTLINED * light.max(initial=0.0)) & (light > 0)
    if not chosen.any():
        return None
    # Outer radius of a ring: r0 + w, Mahalanobis; 1 for a plain Gaussian.
    radii = np.ones(len(light)) if gaussians.rings is None else gaussians.rings.sum(-1)
    reach = REACH * radii[:, None] * np.sqrt(np.maximum(covariances[:, [0, 2]], 0))
    low, high = (centres - reach)[chosen].min(0), (centres + reach)[chosen].max(0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _end() -> None:
    """End the highlight."""
    global _touched
    _touched = None
    _redraw()


def _redraw() -> None:
    from .properties import redraw_viewports

    redraw_viewports()


def unregister() -> None:
    global _touched
    _touched = None
    if bpy.app.timers.is_registered(_end):
        bpy.app.timers.unregister(_end)


def register() -> None:
    """Do nothing: a highlight begins by `touch`."""
