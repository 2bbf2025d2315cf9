# SPDX-License-Identifier: GPL-3.0-or-later
"""lights: finds the lights of a capture in its frames."""
from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.capture import LIGHTS
from ...core.capture.unsolved import CAMERA
from ...core.errors import CaptureError, SettingsError
from ...core.system.files import write_json
from ...core.system.progress import Progress
from .. import plate_space, tallies
from ..command import Command, Step, parse_seed

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.lights import TriangulationSettings
    from ...core.lights.detection import Detector

METHODS = ("exposure", "grounded")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder with images/; without a camera solve the "
                        "lights are followed from frame to frame")
    parser.add_argument("--keep", action="store_true",
                        help="keep the entries of lights.json, with what was renamed, moved, added or removed by hand; "
                             "add only lights that were never found before")
    parser.add_argument("--method", choices=METHODS, default="exposure",
                        help="detector (default exposure). exposure: compact over-exposed spots. grounded: "
                             "GroundingDINO and SAM 2, which need transformers and their weights")
    parser.add_argument("--threshold", type=float, metavar="SCORE",
                        help="minimum score of a detection, 0 to 1 (default 0.3 for exposure, 0.35 for grounded)")
    parser.add_argument("--boxes", metavar="FOLDER_OR_NAME", help="weights of GroundingDINO, for grounded")
    parser.add_argument("--masks", metavar="FOLDER_OR_NAME", help="weights of SAM 2, for grounded")
    parser.add_argument("--min-views", type=int, default=3, metavar="N",
                        help="number of views that must show a light (default 3)")
    parser.add_argument("--scene", type=Path, metavar="SCENE.PLY",
                        help="a fitted scene (RUN/scene.ply) on whose Gaussians to place the detections, as the paper "
                             "does")
    parser.add_argument("--follow", action="store_true",
                        help="in a capture with a camera solve, follow lights from frame to frame too: those that move "
                             "get a path; the frames must be consecutive")
    parser.add_argument("--focal", type=float, metavar="PIXELS",
                        help=f"focal length of frames without a camera solve (default: {CAMERA}, Exif data, or a usual "
                             f"one); {CAMERA} records it")
    plate_space.add_option(parser)
    parser.add_argument("--seed", type=parse_seed, default=0, metavar="N", help="random seed (default 0)")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Find the lights of the capture, and write lights.json and the sheets. Raises SettingsError and CaptureError."""
    from ...core.capture import Capture
    from ...core.lights import TriangulationSettings, make_detector
    from ...core.lights.file import check_replaceable

    if args.method != "grounded" and (args.boxes or args.masks):
        raise SettingsError(f"--{'boxes' if args.boxes else 'masks'} is for --method grounded; leave it out.")
    plate_space.record(args, args.capture)
    capture = Capture.open(args.capture, need_cameras=False, focal=args.focal)
    if capture.has_cameras and args.focal is not None:
        raise SettingsError("--focal is for frames without a camera solve, and this capture has one; leave it out.")
    tallies.report_capture(capture, progress)
    if not capture.has_cameras:
        return _run_without_solve(capture, args, progress)
    detector = make_detector(args.method, args.threshold, args.boxes, args.masks)
    settings = TriangulationSettings(min_views=args.min_views, seed=args.seed)
    gaussians = _read_gaussians(args.scene) if args.scene else None
    if not args.keep:
        check_replaceable(capture.folder / LIGHTS)
    report = _find_and_record(capture, detector, progress, settings, gaussians=gaussians, keep=args.keep,
                              follow=args.follow)
    return {"lights": report["lights"], "file": str(capture.folder / LIGHTS),
            "sheets": [str(capture.folder / sheet) for sheet in report["sheets"]],
            **tallies.report_tally(tallies.tally_capture(capture, "searched"), progress)}


def _run_without_solve(capture: Capture, args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Run the command on frames without a camera solve: record --focal in CAMERA, track the lights from frame to frame,
    return the command's result. Raises SettingsError for options that need a solve."""
    from ...core.lights.file import check_replaceable

    unusable_options = {"--method": args.method != "exposure", "--threshold": args.threshold is not None,
                        "--scene": args.scene is not None}
    if any(unusable_options.values()):
        option = next(name for name, is_set in unusable_options.items() if is_set)
        raise SettingsError(f"{option} needs a camera solve, and {capture.folder} has none; leave it out, or run solve "
                            "first.")
    if args.focal is not None:
        camera = capture.views[0].camera
        write_json(capture.folder / CAMERA, {"focal_px": args.focal, "width": camera.width, "height": camera.height})
    if not args.keep:
        check_replaceable(capture.folder / LIGHTS)
    report = _track_and_record(capture, progress, keep=args.keep)
    return {"lights": report["lights"], "file": str(capture.folder / LIGHTS),
            "sheets": [str(capture.folder / sheet) for sheet in report["sheets"]],
            **tallies.report_tally(tallies.tally_capture(capture, "searched"), progress)}


def _track_and_record(capture: Capture, progress: Progress, keep: bool = False) -> dict[str, Any]:
    """Follow the lights of a shot, write lights.json and the sheets, and report them; return the report.

    keep: keep the entries of lights.json. Raises CaptureError where the folder cannot be written.
    """
    from ...core.lights.find import write_tracks
    from ...core.lights.tracks import track_lights

    _check_writable(capture)
    progress.say(f"{capture.folder} has no camera solve; its lights are followed from frame to frame.")
    findings = track_lights(capture, progress)
    report = write_tracks(capture, findings, keep=keep)
    for message in findings.messages:
        progress.say(message)
    progress.say(f"Look at {capture.folder / report['sheets'][0]}. You can edit {LIGHTS}; `lights --keep` keeps your "
                 "changes.")
    return report


def with_lights(capture: Capture, progress: Progress) -> Capture:
    """Return the capture with its lights; they are found and written to its folder where lights.json is missing."""
    from ...core.lights import make_detector

    if capture.lights or (capture.folder / LIGHTS).exists():
        return capture
    progress.say(f"{capture.folder} has no {LIGHTS}; searching for its lights.")
    if not capture.has_cameras:
        _track_and_record(capture, progress)
        return capture.reopen()
    _find_and_record(capture, make_detector("exposure"), progress)
    return capture.reopen()


def _find_and_record(capture: Capture, detector: Detector, progress: Progress,
                     settings: TriangulationSettings | None = None, *, gaussians: tuple[Any, Any] | None = None,
                     keep: bool = False, follow: bool = False) -> dict[str, Any]:
    """Find the lights, write lights.json and the sheets, and report them; return the report.

    gaussians: means (n, 3) and opacities (n,) of a scene on which to place the detections. keep: keep the entries of
    lights.json. follow: follow lights that move from frame to frame as well.

    Raises CaptureError, before the search, where the folder cannot be written.
    """
    from ...core.lights import find_lights, write_findings
    from ...core.lights.find import REPORT, SHEETS, track_moving_lights

    _check_writable(capture)
    findings = find_lights(capture, detector, progress, settings, gaussians=gaussians)
    tracked = track_moving_lights(capture, findings.lights, progress) if follow else None
    report = write_findings(capture, findings, keep=keep, tracked=tracked)
    for message in [*findings.messages, *(tracked.messages if tracked else [])]:
        progress.say(message)
    for light in report["lights"]:
        progress.say(_describe_light(light))
    if findings.doubtful:
        unsupported = sum(light.rejection == "few views" for light in findings.doubtful)
        progress.say(f"Left out as doubtful: {len(findings.doubtful)} places, {unsupported} of them since too few "
                     f"views show them. {capture.folder / SHEETS / REPORT} lists them; add them by hand where they are "
                     "lights.")
    progress.say(f"Look at {capture.folder / report['sheets'][0]}. You can edit {LIGHTS}; `lights --keep` keeps your "
                 "changes.")
    return report


def _check_writable(capture: Capture) -> None:
    """Raise CaptureError where the lights of a capture cannot be written to its folder."""
    from ...core.lights.find import SHEETS

    if not os.access(capture.folder, os.W_OK):
        raise CaptureError(f"{capture.folder} cannot be written, and {LIGHTS} belongs there; change the permissions, "
                           "or copy the capture to another folder.")
    sheets = capture.folder / SHEETS
    if sheets.exists() and not sheets.is_dir():
        raise CaptureError(f"{sheets} is a file where a folder for the sheets is needed; move it away.")


def _describe_light(light: dict[str, Any]) -> str:
    """Return a sentence on one light: position, uncertainty, number of views."""
    if "xyz" not in light:
        return f"{light['name']}: on a path, with places in {len(light.get('frames', ()))} frames."
    x, y, z = light["xyz"]
    if "support" not in light:
        return f"{light['name']}: at {x:.3g}, {y:.3g}, {z:.3g}, by hand."
    uncertainty = (f"direction within {light['uncertainty']:.2g} degrees, far away" if light["far"]
                   else f"within {light['uncertainty']:.2g} units")
    return (f"{light['name']}: at {x:.3g}, {y:.3g}, {z:.3g}, {uncertainty}; {light['support']} of {light['views']} "
            f"views, {light['residual_px']:.2f} px; {light['how']}.")


def _read_gaussians(path: Path) -> tuple[Any, Any]:
    """Read means (n, 3) and opacities (n,) of a scene from a 3DGS PLY."""
    from ...core.gaussians.ply import read_ply

    scene = read_ply(path)
    return scene.means.detach().numpy(), scene.opacities.detach().numpy()


COMMAND = Command(
    "lights", "Finds the lights of a capture.",
    """Writes CAPTURE/lights.json, and contact sheets of the views with the detections, CAPTURE/lights/sheetN.png. The
detections of all views are triangulated; of far lights only the direction is used. A light that is never in frame is
found by its ghosts, if many views show one.

Frames without a camera solve count as consecutive frames of a shot. The lights are followed from frame to frame, and
lights.json lists their path, brightness and confidence by frame. The sheets show the paths.

  run.py lights captures/room
  run.py lights shots/night_drive""",
    arguments, (Step("lights", "engine", run),))
