# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights of a capture, from its frames: detect, gather, and where nothing is in frame, follow the ghosts."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..capture import LIGHTS, Capture
from ..errors import SettingsError
from ..system.files import write_json
from ..system.progress import Progress
from .detection import Detection, Detector
from .file import write_lights
from .gather import FAR, FoundLight, GatherSettings, gather
from .ghosts import find_blobs, gather_ghosts
from .lifted import lift

SHEETS, REPORT = "lights", "report.json"


@dataclass(frozen=True, eq=False)
class Findings:
    """What was found: lights, best supported first; doubtful ones, of too few views; detections of each view."""

    lights: list[FoundLight]
    doubtful: list[FoundLight]
    detections: list[list[Detection]]
    says: list[str]


def find_lights(capture: Capture, detector: Detector, progress: Progress | None = None,
                settings: GatherSettings | None = None, *,
                gaussians: tuple[ArrayLike, ArrayLike] | None = None) -> Findings:
    """Find the lights of a capture in its frames.

    With `gaussians`, the means (n, 3) and opacities (n,) of a fitted scene, the lights are lifted on to it, the
    paper's way; else the detections' rays are intersected. A capture in which no frame shows a light is
    searched for ghosts of one out of frame.
    """
    progress, settings = progress or Progress(), settings or GatherSettings()
    if settings.min_views < 1:
        raise SettingsError(f"A light needs at least 1 view, not {settings.min_views}.")
    views = [(view.name, view.camera) for view in capture.views]
    detections: list[list[Detection]] = []
    progress.stage("look for lights", len(views))
    for view in capture.views:
        detections.append(detector.detect(capture.frame(view)))
        progress.advance(1, found=sum(map(len, detections)))
    showing = sum(bool(some) for some in detections)
    says = [f"{sum(map(len, detections))} detections in {showing} of {len(views)} views."]
    enough = min(settings.min_views, len(views))
    if gaussians is not None:
        lights = lift(views, detections, *gaussians, capture.extent, max(enough, 2))
        doubtful: list[FoundLight] = []
    elif len(views) == 1:
        lights, doubtful = _from_one_view(capture, detections[0]), []
        if lights:
            says.append("One view gives directions only: distances are those of the points nearby, or a guess.")
    else:
        everything = replace(settings, min_views=2, accidents=np.inf, min_share=0.0)
        found = gather(views, detections, capture.extent, everything)
        lights = [light for light in found if _sure(light, enough, settings)]
        doubtful = [light for light in found if not _sure(light, enough, settings)]
    if not lights and len(views) > 1:
        lights = _follow_ghosts(capture, progress, settings.seed)
        if lights:
            says.append("No frame shows a light; one out of frame was found by its ghosts, its direction surer than "
                        "its distance.")
    if not lights and not doubtful:
        says.append("No light was found: none is in frame in enough views, or none is over-exposed.")
    return Findings(lights, doubtful, detections, says)


def _sure(light: FoundLight, min_views: int, settings: GatherSettings) -> bool:
    return (len(light.support) >= max(min_views, settings.min_share * light.visible)
            and light.accidents <= settings.accidents)


def record(capture: Capture, findings: Findings, keep: bool = False) -> dict[str, Any]:
    """Write lights.json, overlay sheets and a report into the capture; returns the report.

    lights/sheetN.png shows every view, lights/report.json lists support, residuals, and what was doubtful.
    """
    from .overlay import write_sheets

    views = [(view.name, view.camera) for view in capture.views]
    entries = write_lights(capture.folder / LIGHTS, findings.lights, views, keep)
    named = [(str(entry["name"]), _shown(entry, findings.lights)) for entry in entries]
    sheets = write_sheets(capture.folder / SHEETS, capture, findings.detections, named)
    report = {
        "lights": entries, "says": findings.says,
        "doubtful": [{"xyz": light.xyz.round(5).tolist(), "far": light.far, "support": list(light.support),
                      "residual_px": round(light.residual, 3), "uncertainty": _finite(light.uncertainty)}
                     for light in findings.doubtful],
        "support": {name: list(light.support) for name, light in named},
        "views": [{"name": view.name, "detections": [
            {"xy": one.xy.round(3).tolist(), "radius": round(one.radius, 2), "score": round(one.score, 3),
             "cut": one.cut} for one in some]}
            for view, some in zip(capture.views, findings.detections, strict=True)],
        "sheets": [str(path.relative_to(capture.folder)) for path in sheets],
    }
    write_json(capture.folder / SHEETS / REPORT, report)
    return report


def _finite(value: float) -> float | None:
    return round(value, 5) if np.isfinite(value) else None


def _shown(entry: dict[str, Any], lights: Sequence[FoundLight]) -> FoundLight:
    """The light an entry stands for; one made by hand has no support."""
    xyz = np.array(entry["xyz"], np.float64)
    for light in lights:
        if np.linalg.norm(light.xyz - xyz) <= 1e-4 * max(1.0, float(np.linalg.norm(xyz))):
            return light
    return FoundLight(xyz, False, (), 0, 0.0, 0.0, np.ones(3), 0.0, how="by hand")


def _from_one_view(capture: Capture, detections: Sequence[Detection]) -> list[FoundLight]:
    """Detections of a single view, at the depth of the points nearest in the picture, or far away."""
    view = capture.views[0]
    pixels, depth = view.camera.project(capture.points.xyz)
    seen = view.camera.contains(pixels, depth)
    reach = 0.05 * float(np.hypot(*view.camera.size))
    found = []
    for one in detections:
        near = seen & (np.linalg.norm(pixels - one.xy, axis=1) < reach)
        ray = view.camera.rays(one.xy)[0]
        far = not near.any()
        distance = FAR * capture.extent if far else float(np.median(depth[near])) / float(ray @ view.camera.forward)
        uncertainty = 0.0 if far else distance
        found.append(FoundLight(view.camera.position + distance * ray, far, (view.name,), 1, 0.0, uncertainty,
                                one.colour, one.radius, how="one view, distance guessed",
                                detections=((view.name, one),)))
    return found


def _follow_ghosts(capture: Capture, progress: Progress, seed: int) -> list[FoundLight]:
    progress.stage("follow ghosts", len(capture.views))
    blobs = []
    for view in capture.views:
        blobs.append(find_blobs(capture.frame(view), capture.removed(view)))
        progress.advance()
    return gather_ghosts([(view.name, view.camera) for view in capture.views], blobs, capture.extent, seed, progress)


def detector_for(method: str, threshold: float | None = None, boxes: str | Path | None = None,
                 masks: str | Path | None = None) -> Detector:
    """The detector of a method's name, "exposure" or "grounded". SettingsError for other names; EngineError where
    its weights or libraries are missing."""
    if threshold is not None and not 0 <= threshold <= 1:
        raise SettingsError(f"The threshold is a score within 0 and 1, not {threshold:g}.")
    if method == "exposure":
        from .exposure import Exposure

        # A low bar: what the views do not agree on falls away later, what is missed here is lost.
        return Exposure(0.3 if threshold is None else threshold)
    if method == "grounded":
        from .grounded import BOXES, MASKS, Grounded

        return Grounded(0.35 if threshold is None else threshold, boxes or BOXES, masks or MASKS)
    raise SettingsError(f"{method!r} is not a way to find lights; take exposure or grounded.")
