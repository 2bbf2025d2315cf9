# SPDX-License-Identifier: GPL-3.0-or-later
"""A light in 3D with the evidence for it: what every search of this package returns and `file.py` writes."""
from __future__ import annotations

from dataclasses import dataclass, field

from ..capture.camera import Floats
from .detection import Detection

FAR = 1000.0
"""Distance at which a light of known direction alone is placed, in extents of the cameras' path."""


@dataclass(frozen=True, eq=False)
class FoundLight:
    """A light in 3D.

    xyz: (3,) world. far: only its direction is known, and xyz lies FAR extents away in it.
    support: names of the views that show it; visible: number of views that have it in frame.
    residual: median distance in pixels of its detections from its projections.
    uncertainty: one standard deviation, scene units along the worst direction; degrees of direction where far.
    nfa: number of false alarms, the expected number of lights of this support by chance.
    colour: (3,) linear, largest channel 1. radius: median of its detections, pixels. how: method that found it.
    rejection: reason why it is left out, "gap", "surface" or "few views"; "" for a light.
    """

    xyz: Floats
    far: bool
    support: tuple[str, ...]
    visible: int
    residual: float
    uncertainty: float
    colour: Floats
    radius: float
    nfa: float = 0.0
    how: str = "triangulated"
    rejection: str = ""
    detections: tuple[tuple[str, Detection], ...] = field(default=(), repr=False)
