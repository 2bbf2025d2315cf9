# SPDX-License-Identifier: GPL-3.0-or-later
"""Light sources: found in frames, gathered into 3D.

    exposure.py, grounded.py   two detectors behind one interface (detection.py)
    gather.py                  detections of many views to places, near or far
    lifted.py                  the same by way of a fitted scene's Gaussians
    ghosts.py                  a light out of frame, from its ghosts
    file.py, overlay.py        lights.json, and pictures of what was found
    find.py                    all of it, for a capture
"""
from __future__ import annotations

from .detection import Detection, Detector, union
from .exposure import Exposure
from .find import Findings, detector_for, find_lights, record
from .gather import FoundLight, GatherSettings, gather

__all__ = ["Detection", "Detector", "Exposure", "Findings", "FoundLight", "GatherSettings", "detector_for",
           "find_lights", "gather", "record", "union"]
