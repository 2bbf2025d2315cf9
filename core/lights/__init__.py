# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights of a capture: detected in frames and located in 3D.

    exposure.py, grounded.py   two detectors behind one interface (detection.py)
    triangulation.py           detections of many views to places, near or far, by way of observations.py,
                               candidates.py, refinement.py and merging.py
    surroundings.py, surfaces.py   tell gaps before a bright sky, windows and lit walls from lamps
    lifted.py                  the same by way of a fitted scene's Gaussians
    ghosts.py                  a light out of frame, from its ghosts
    file.py, overlay.py        lights.json, and pictures of the result
    find.py                    all of it, for a capture
    snap.py                    moves inaccurate lights to their flares, for a fit
"""
from __future__ import annotations

from .detection import Detection, Detector, union_mask
from .exposure import ExposureDetector
from .find import Findings, find_lights, make_detector, write_findings
from .found_light import FoundLight
from .triangulation import TriangulationSettings, triangulate_lights

__all__ = [
           "Detection",
           "Detector",
           "ExposureDetector",
           "Findings",
           "FoundLight",
           "TriangulationSettings",
           "find_lights",
           "make_detector",
           "triangulate_lights",
           "union_mask",
           "write_findings",
]
