# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the lights of a capture in its frames: detection, triangulation, and, where no light is in frame, its ghosts.

The command `lights` and the commands that need lights call it.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..capture import LIGHTS, Camera, Capture, read_lights
from ..errors import SettingsError
from ..system.files import write_json
from ..system.progress import Progress
from .detection import Detection, Detector, Mask
from .file import write_lights
from .found_light import FAR, FoundLight
from .ghosts import find_blobs, locate_by_ghosts
from .lifted import lift_to_gaussians
from .surfaces import split_surfaces
from .surroundings import brightness_map, clipped_area, split_gaps
from .tracks import TrackedLight, TrackFindings, track_lights
from .triangulation import TriangulationSettings, triangulate_lights

SHEETS, REPORT = "lights", "report.json"
MAX_POINT_DISTANCE = 0.05
"""Distance from a detection, diagonals, up to which points give the depth of a light in a single view."""
MIN_VIEWS_WITH_AREA = 6
"""Fewest views with a large clipped area for a search for a light in these areas."""
MAX_STATIC_DISTANCE = 0.006
"""Median distance of a light from the projections of one place, diagonals, below which it is static."""


@dataclass(frozen=True, eq=False)
class Findings:
    """The result of a search: lights, doubtful places, and the detections of each view.

    lights: best supported first. doubtful: each with the reason of its rejection. messages: sentences for the user.
    """

    lights: list[FoundLight]
    doubtful: list[FoundLight]
    detections: list[list[Detection]]
    messages: list[str]


def find_lights(capture: Capture, detector: Detector, progress: Progress | None = None,
                settings: TriangulationSettings | None = None, *,
                gaussians: tuple[ArrayLike, ArrayLike] | None = None) -> Findings:
    """Find the lights of a capture in its frames.

    With `gaussians`, the means (n, 3) and opacities (n,) of a fitted scene, detections are lifted on to its Gaussians,
    as in the paper; else their rays are triangulated. A light in a clipped sky is searched by its ghosts, as is one
    out of frame where no frame shows a light. Raises SettingsError for settings.min_views below 1.
    """
    progress, settings = progress or Progress(), settings or TriangulationSettings()
    if settings.min_views < 1:
        raise SettingsError(f"A light needs at least 1 view, not {settings.min_views}.")
    views = [(view.name, view.camera) for view in capture.views]
    detections, brightness_maps = _detect(capture, detector, progress)
    views_with_lights = sum(bool(in_view) for in_view in detections)
    messages = [f"{sum(map(len, detections))} detections in {views_with_lights} of {len(views)} views."]
    min_views = min(settings.min_views, len(views))
    if gaussians is not None:
        lights = lift_to_gaussians(views, detections, *gaussians, capture.extent, max(min_views, 2))
        doubtful: list[FoundLight] = []
    elif len(views) == 1:
        lights, doubtful = _lights_from_one_view(capture, detections[0]), []
        if lights:
            messages.append("A single view gives directions only; distances are those of nearby points, or guesses.")
    else:
        candidates = _triangulate_any(views, detections, capture.extent, settings)
        supported = [light for light in candidates if _is_well_supported(light, min_views, settings)]
        lights, gaps = split_gaps(supported, dict(views), brightness_maps)
        lights, surfaces = split_surfaces(lights, dict(views), brightness_maps)
        unsupported = [light for light in candidates if not _is_well_supported(light, min_views, settings)]
        doubtful = [replace(light, rejection=reason) for reason, places in
                    (("gap", gaps), ("surface", surfaces), ("few views", unsupported)) for light in places]
        if gaps:
            messages.append(f"{len(gaps)} places are no lights but gaps through which a bright far surrounding shows.")
        if surfaces:
            messages.append(f"{len(surfaces)} places are no lights but parts of bright surfaces, such as windows or "
                            "lit walls.")
    if len(views) > 1:
        lights_by_ghosts, message = _find_by_ghosts(capture, lights, brightness_maps, progress, settings.seed)
        lights += lights_by_ghosts
        messages += [message] if message else []
    if not lights and not doubtful:
        messages.append("No light was found: none is in frame in enough views, or none is over-exposed.")
    return Findings(lights, doubtful, detections, messages)


def _detect(capture: Capture, detector: Detector, progress: Progress
            ) -> tuple[list[list[Detection]], dict[str, NDArray[np.bool_]]]:
    """Return the detections of each view, and by the view's name a small map, true where the frame is bright."""
    detections: list[list[Detection]] = []
    brightness_maps: dict[str, NDArray[np.bool_]] = {}
    progress.stage("look for lights", len(capture.views))
    for view in capture.views:
        frame = capture.frame(view)
        detections.append(detector.detect(frame))
        brightness_maps[view.name] = brightness_map(frame)
        progress.advance(1, found=sum(map(len, detections)))
    return detections, brightness_maps


def _triangulate_any(views: Sequence[tuple[str, Camera]], detections: Sequence[Sequence[Detection]], extent: float,
                     settings: TriangulationSettings) -> list[FoundLight]:
    """Triangulate every place that two views agree on; the caller sorts out what lacks support."""
    return triangulate_lights(views, detections, extent, replace(settings, min_views=2, max_nfa=np.inf, min_share=0.0))


def _is_well_supported(light: FoundLight, min_views: int, settings: TriangulationSettings) -> bool:
    return (len(light.support) >= max(min_views, settings.min_share * light.visible)
            and light.nfa <= settings.max_nfa)


def track_moving_lights(capture: Capture, static_lights: Sequence[FoundLight], progress: Progress | None = None
                        ) -> TrackFindings:
    """Follow the lights of a solved capture whose frames are consecutive; return those that move.

    A light that keeps to the projections of one of `static_lights`, lights with one place in the world, is left out.
    """
    findings = track_lights(capture, progress)
    moving = [light for light in findings.lights if not _is_static(capture, light, static_lights)]
    left_out = len(findings.lights) - len(moving)
    message = f"{len(moving)} lights move and have a path; {left_out} that were followed stand."
    return replace(findings, lights=moving, messages=[message])


def _is_static(capture: Capture, light: TrackedLight, static_lights: Sequence[FoundLight]) -> bool:
    """Return whether a light that was followed keeps to the projections of one of the static lights."""
    views = [(view.name, view.camera) for view in capture.views if view.name in light.support]
    pixels = np.array([light.keys[name].xy for name, _ in views])
    for static_light in static_lights:
        distances = []
        for (_, camera), pixel in zip(views, pixels, strict=True):
            projected, depth = camera.project(static_light.xyz)
            distances.append(float(np.linalg.norm(projected[0] - pixel)) if depth[0] > 0 else np.inf)
        if np.median(distances) < MAX_STATIC_DISTANCE * float(np.hypot(*views[0][1].size)) + 0.5 * light.radius:
            return True
    return False


def write_findings(capture: Capture, findings: Findings, keep: bool = False, tracked: TrackFindings | None = None
                   ) -> dict[str, Any]:
    """Write lights.json, overlay sheets and a report into the capture; return the report.

    keep: leave the entries of an existing lights.json as they are. tracked: lights on paths. lights/sheetN.png shows
    every view; lights/report.json lists support, residuals, and doubtful lights.
    """
    from .overlay import write_overlay_sheets

    views = [(view.name, view.camera) for view in capture.views]
    entries = write_lights(capture.folder / LIGHTS, findings.lights, views, keep, tracked.lights if tracked else ())
    lights_by_name = [(str(entry["name"]), _light_of_entry(entry, findings.lights)) for entry in entries
                      if "xyz" in entry]
    if tracked is None:
        sheets = write_overlay_sheets(capture.folder / SHEETS, capture, findings.detections, lights_by_name)
    else:
        from .track_sheet import write_track_sheets

        lit_capture = capture.with_lights(read_lights(capture.folder / LIGHTS))
        sheets = write_track_sheets(capture.folder / SHEETS, lit_capture, tracked.sources)
    report = {
        "lights": entries, "says": findings.messages,
        "doubtful": [{"xyz": light.xyz.round(5).tolist(), "far": light.far, "rejection": light.rejection,
                      "support": list(light.support), "residual_px": round(light.residual, 3),
                      "uncertainty": _round_finite(light.uncertainty)}
                     for light in findings.doubtful],
        "support": {name: list(light.support) for name, light in lights_by_name},
        "views": [{"name": view.name, "detections": [
            {"xy": detection.xy.round(3).tolist(), "radius": round(detection.radius, 2),
             "score": round(detection.score, 3), "cut": detection.is_cut} for detection in in_view]}
                  for view, in_view in zip(capture.views, findings.detections, strict=True)],
        "sheets": [str(path.relative_to(capture.folder)) for path in sheets],
    }
    write_json(capture.folder / SHEETS / REPORT, report)
    return report


def write_tracks(capture: Capture, findings: TrackFindings, keep: bool = False) -> dict[str, Any]:
    """Write lights.json, sheets and a report of lights that were followed into the capture; return the report.

    keep: leave the entries of an existing lights.json as they are. lights/sheetN.png shows every frame;
    lights/report.json lists evidence, doubtful frames, and doubtful lights.
    """
    from .track_sheet import write_track_sheets

    views = [(view.name, view.camera) for view in capture.views]
    entries = write_lights(capture.folder / LIGHTS, (), views, keep, findings.lights)
    lit_capture = capture.with_lights(read_lights(capture.folder / LIGHTS))
    sheets = write_track_sheets(capture.folder / SHEETS, lit_capture, findings.sources)
    report = {
        "lights": entries, "says": findings.messages,
        "followed": [{"support": list(light.support), "evidence": round(light.evidence, 3),
                      "doubtful_frames": light.doubtful} for light in findings.lights],
        "doubtful": [{"support": list(light.support), "evidence": round(light.evidence, 3)}
                     for light in findings.doubtful],
        "views": [{"name": view.name, "sources": [
            {"xy": source.xy.round(2).tolist(), "radius": round(source.detection.radius, 2),
             "evidence": round(source.evidence, 3)} for source in in_view]}
            for view, in_view in zip(capture.views, findings.sources, strict=True)],
        "sheets": [str(path.relative_to(capture.folder)) for path in sheets],
    }
    write_json(capture.folder / SHEETS / REPORT, report)
    return report


def _round_finite(value: float) -> float | None:
    return round(value, 5) if np.isfinite(value) else None


def _light_of_entry(entry: dict[str, Any], lights: Sequence[FoundLight]) -> FoundLight:
    """Return the found light at an entry's place; for an entry made by hand, a new one without support."""
    xyz = np.array(entry["xyz"], np.float64)
    for light in lights:
        if np.linalg.norm(light.xyz - xyz) <= 1e-4 * max(1.0, float(np.linalg.norm(xyz))):
            return light
    return FoundLight(xyz, False, (), 0, 0.0, 0.0, np.ones(3), 0.0, how="by hand")


def _lights_from_one_view(capture: Capture, detections: Sequence[Detection]) -> list[FoundLight]:
    """Place each detection of a single view at the median depth of the points around it in the picture.

    A detection without a point within MAX_POINT_DISTANCE is placed far away. The uncertainty of a light is as large as
    its guessed distance, and 0 if it is far.
    """
    view = capture.views[0]
    pixels, depth = view.camera.project(capture.points.xyz)
    in_frame = view.camera.contains(pixels, depth)
    reach = MAX_POINT_DISTANCE * float(np.hypot(*view.camera.size))
    lights = []
    for detection in detections:
        near = in_frame & (np.linalg.norm(pixels - detection.xy, axis=1) < reach)
        ray = view.camera.rays(detection.xy)[0]
        far = not near.any()
        # A depth is measured along the camera's axis, a distance along the ray.
        distance = FAR * capture.extent if far else float(np.median(depth[near])) / float(ray @ view.camera.forward)
        uncertainty = 0.0 if far else distance
        lights.append(FoundLight(view.camera.position + distance * ray, far, (view.name,), 1, 0.0, uncertainty,
                                 detection.colour, detection.radius, how="one view, distance guessed",
                                 detections=((view.name, detection),)))
    return lights


def _find_by_ghosts(capture: Capture, lights: Sequence[FoundLight], brightness_maps: Mapping[str, Mask],
                    progress: Progress, seed: int) -> tuple[list[FoundLight], str]:
    """Return at most one light found by its ghosts, and a sentence about it for the user, "" for none.

    Such a light is in a clipped area larger than a light's disc (a sun in a bright sky); if no other light was found,
    it may also be out of frame. lights: those found before. brightness_maps: by the view's name (`brightness_map`).
    """
    views = [(view.name, view.camera) for view in capture.views]
    areas = [clipped_area(brightness_maps[name], camera, lights) for name, camera in views]
    search_clipped = sum(bool(area.any()) for area in areas) >= MIN_VIEWS_WITH_AREA
    if lights and not search_clipped:
        return [], ""
    progress.stage("follow ghosts", len(capture.views))
    blobs = []
    for view in capture.views:
        blobs.append(find_blobs(capture.frame(view), capture.clean_frame(view)))
        progress.advance()
    if search_clipped:
        in_area = locate_by_ghosts(views, blobs, capture.extent, seed, progress, areas)
        if in_area:
            return in_area, "One light lies in a clipped area, such as a bright sky; its ghosts give its direction."
    if not lights:
        out_of_frame = locate_by_ghosts(views, blobs, capture.extent, seed, progress)
        if out_of_frame:
            return out_of_frame, ("No frame shows a light; one out of frame was found by its ghosts, its direction "
                                  "more exactly than its distance.")
    return [], ""


def make_detector(method: str, threshold: float | None = None, boxes: str | Path | None = None,
                  masks: str | Path | None = None) -> Detector:
    """Make the detector "exposure" or "grounded".

    threshold: least score of a detection, 0..1; None for the method's default. boxes, masks: weights of "grounded",
    folders or names on the hub; None for the defaults. Raises SettingsError for any other method or a threshold outside
    0..1; EngineError if weights or libraries are missing.
    """
    if threshold is not None and not 0 <= threshold <= 1:
        raise SettingsError(f"The threshold is a score within 0 and 1, not {threshold:g}.")
    if method == "exposure":
        from .exposure import ExposureDetector

        # A low threshold: triangulation drops false detections, but cannot recover missed ones.
        return ExposureDetector(0.3 if threshold is None else threshold)
    if method == "grounded":
        from .grounded import BOX_WEIGHTS, MASK_WEIGHTS, GroundedDetector

        return GroundedDetector(0.35 if threshold is None else threshold, boxes or BOX_WEIGHTS, masks or MASK_WEIGHTS)
    raise SettingsError(f"{method!r} is not a way to find lights; take exposure or grounded.")
