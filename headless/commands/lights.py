# SPDX-License-Identifier: GPL-3.0-or-later
"""lights: the light sources of a capture, found in its frames."""
from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.capture import LIGHTS
from ...core.errors import CaptureError, SettingsError
from ...core.system.progress import Progress
from ..command import Command, Step, seed

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.lights import GatherSettings
    from ...core.lights.detection import Detector

METHODS = ("exposure", "grounded")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder with images/ and a camera solve")
    parser.add_argument("--keep", action="store_true",
                        help="leave what lights.json has as it is: what was renamed, moved, added or taken out by "
                             "hand stays so; only lights not found before are added")
    parser.add_argument("--method", choices=METHODS, default="exposure",
                        help="exposure: over-exposed compact spots; grounded: GroundingDINO and SAM 2, if transformers "
                             "and weights are at hand (default exposure)")
    parser.add_argument("--threshold", type=float, metavar="SCORE",
                        help="of a detection, 0 to 1 (default 0.3 for exposure, 0.35 for grounded)")
    parser.add_argument("--boxes", metavar="FOLDER_OR_NAME", help="GroundingDINO's weights, for grounded")
    parser.add_argument("--masks", metavar="FOLDER_OR_NAME", help="SAM 2's weights, for grounded")
    parser.add_argument("--min-views", type=int, default=3, metavar="N",
                        help="views that must show a light (default 3)")
    parser.add_argument("--scene", type=Path, metavar="SCENE.PLY",
                        help="a fitted scene (RUN/scene.ply): lift detections on to its Gaussians, as the paper does")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="of all randomness (default 0)")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.capture import Capture
    from ...core.lights import GatherSettings, detector_for
    from ...core.lights.file import check_replaceable

    if words.method != "grounded" and (words.boxes or words.masks):
        raise SettingsError(f"--{'boxes' if words.boxes else 'masks'} is for --method grounded; leave it out.")
    capture = Capture.open(words.capture)
    detector = detector_for(words.method, words.threshold, words.boxes, words.masks)
    settings = GatherSettings(min_views=words.min_views, seed=words.seed)
    gaussians = _gaussians(words.scene) if words.scene else None
    if not words.keep:
        check_replaceable(capture.folder / LIGHTS)
    report = _find(capture, detector, progress, settings, gaussians=gaussians, keep=words.keep)
    return {"lights": report["lights"], "file": str(capture.folder / LIGHTS),
            "sheets": [str(capture.folder / sheet) for sheet in report["sheets"]]}


def with_lights(capture: Capture, progress: Progress) -> Capture:
    """The capture with its lights, which are found and written into its folder if no lights.json is there."""
    from ...core.lights import detector_for

    if capture.lights or (capture.folder / LIGHTS).exists():
        return capture
    progress.say(f"{capture.folder} has no {LIGHTS}: its lights are looked for.")
    _find(capture, detector_for("exposure"), progress)
    return capture.reopened()


def _find(capture: Capture, detector: Detector, progress: Progress, settings: GatherSettings | None = None, *,
          gaussians: tuple[Any, Any] | None = None, keep: bool = False) -> dict[str, Any]:
    """Finds, writes down, and says what was found; returns the report. Raises CaptureError, before it looks, where
    nothing may be written down."""
    from ...core.lights import find_lights, record
    from ...core.lights.find import REPORT, SHEETS

    if not os.access(capture.folder, os.W_OK):
        raise CaptureError(f"{capture.folder} cannot be written to, where {LIGHTS} belongs; copy the capture to where "
                           "it can, or have the rights to it.")
    sheets = capture.folder / SHEETS
    if sheets.exists() and not sheets.is_dir():
        raise CaptureError(f"{sheets} is a file, where the pictures of what is found belong; move it away.")
    findings = find_lights(capture, detector, progress, settings, gaussians=gaussians)
    report = record(capture, findings, keep=keep)
    for sentence in findings.says:
        progress.say(sentence)
    for light in report["lights"]:
        progress.say(_sentence(light))
    if findings.doubtful:
        progress.say(f"Left out as doubtful: {len(findings.doubtful)}, which too few of the views show that should, or "
                     "so few that chance could have put them there. For adding them by hand, "
                     f"{capture.folder / SHEETS / REPORT} lists them.")
    progress.say(f"Look at {capture.folder / report['sheets'][0]}; {LIGHTS} can be edited, and `lights --keep` "
                 "respects it.")
    return report


def _sentence(light: dict[str, Any]) -> str:
    """One light, for a person."""
    x, y, z = light["xyz"]
    if "support" not in light:
        return f"{light['name']}: at {x:.3g}, {y:.3g}, {z:.3g}, by hand."
    sure = (f"direction within {light['uncertainty']:.2g} degrees, far away" if light["far"]
            else f"within {light['uncertainty']:.2g} units")
    return (f"{light['name']}: at {x:.3g}, {y:.3g}, {z:.3g}, {sure}; {light['support']} of {light['views']} views, "
            f"{light['residual_px']:.2f} px; {light['how']}.")


def _gaussians(path: Path) -> tuple[Any, Any]:
    """Means (n, 3) and opacities (n,) of a scene in the standard 3DGS PLY."""
    from ...core.gaussians.ply import read_ply

    scene = read_ply(path)
    return scene.means.detach().numpy(), scene.opacities.detach().numpy()


COMMAND = Command(
    "lights", "Finds the light sources of a capture.",
    """Writes CAPTURE/lights.json and pictures of every view with what was found, CAPTURE/lights/sheetN.png.
Detections of all views are gathered into places in 3D; far lights keep their direction. A light that is
never in frame is found by its ghosts, if many views show one.

  run.py lights captures/shot""",
    arguments, (Step("lights", "engine", run),))
