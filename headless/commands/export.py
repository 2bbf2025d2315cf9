# SPDX-License-Identifier: GPL-3.0-or-later
"""export: writes a flare in the file formats of other tools."""
from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import RunError, SettingsError
from ...core.system.files import check_no_overwrite
from ...core.system.progress import Progress
from .. import frames
from ..command import Command, Step

if TYPE_CHECKING:
    from ...core.capture import Camera
    from ...core.conventions.frame_numbers import NumberedFrame
    from ...core.look import Look, LookEdits

KINDS = ("preset", "ply")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("flare", type=Path, metavar="RUN_OR_FLARE",
                        help="a run, the folder that `fit` writes; or a .flare")
    parser.add_argument("--as", choices=KINDS, required=True, dest="kind",
                        help="preset: the elements with offset, size, colour and shape, as JSON. ply: the flare's "
                             "Gaussians of each frame, in the layout of 3DGS")
    parser.add_argument("--out", type=Path, required=True, metavar="PATH",
                        help="preset: the JSON file; ply: a folder for flare.####.ply")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE",
                        help="capture whose cameras to use (default: the run's)")
    frames.add_option(parser, "frame numbers (default: all for ply, the first for a preset)")
    parser.add_argument("--set", action="append", default=[], metavar="LIGHT.WHAT=VALUE", dest="edit_texts",
                        help="an edit, as for `bake`; repeatable")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Write the preset of one frame, or a PLY for each frame. Raises SettingsError and RunError."""
    from ...core.capture import Capture
    from ...core.conventions.frame_numbers import number_views
    from ...core.conventions.run_files import FLARE
    from ...core.fit.run import Run
    from ...core.look import LookEdits, read_look

    folder = args.capture
    if args.flare.is_dir():
        folder = Run.open(args.flare).find_capture(folder)
        if not (args.flare / FLARE).is_file():
            raise RunError(Run.open(args.flare).missing_flare_message)
    if not args.flare.exists():
        raise RunError(f"{args.flare} is missing; name a .flare, or the folder of a run.")
    if folder is None:
        raise SettingsError(f"{args.flare} has no cameras; name a capture with --capture.")
    source = args.flare / FLARE if args.flare.is_dir() else args.flare
    check_no_overwrite([source], [args.out])
    look = read_look(source)
    edits = LookEdits.parse([*look.edits.texts(), *args.edit_texts], look.names, look.element_names)
    capture = Capture.open(folder, need_frames=False)
    if args.flare.is_dir():
        capture = capture.with_exposures(Run.open(args.flare).exposures)
    cameras = {view.name: view.camera for view in capture.views}
    selected = frames.select(number_views(cameras), args.frames, progress)
    if args.kind == "ply":
        return _write_plys(args.out, look, edits, selected, cameras, progress)
    if args.frames is not None and len(selected) > 1:
        raise SettingsError(f"A preset holds one frame, and --frames {args.frames} selects {len(selected)}; select "
                            "one.")
    _write_preset(args.out, look, edits, folder, selected[0].number, cameras[selected[0].view], progress)
    return {"preset": str(args.out)}


def _write_preset(path: Path, look: Look, edits: LookEdits, capture: Path, number: int, camera: Camera,
                  progress: Progress) -> None:
    """Write the preset of a frame, and report lights that are left out. Raises RunError if all are.

    capture, number: folder of the capture and number of the frame, for messages.
    """
    from ...core.look import ViewOfLight
    from ...core.transfer.export import write_preset

    views = {light.name: ViewOfLight.of(camera.world_to_camera, light.xyz) for light in look.lights}
    behind = [name for name, view in views.items() if view.depth <= 0]
    if len(behind) == len(views):
        raise RunError(f"No light is in front of the camera in frame {number} of {capture}; name another with "
                       "--frames.")
    write_preset(path, look, views, edits, camera)
    progress.say(f"The preset is {path}.")
    if behind:
        progress.say(f"Lights behind the camera in frame {number} are left out: {', '.join(behind)}.")


def _write_plys(out: Path, look: Look, edits: LookEdits, selected: Sequence[NumberedFrame],
                cameras: Mapping[str, Camera], progress: Progress) -> dict[str, Any]:
    """Write the flare of each selected frame as a PLY into the folder `out`; return the command's result.

    cameras: by the view's name.
    """
    from ...core.transfer.export import write_flare_ply

    progress.stage("export", len(selected))
    for frame in selected:
        camera = cameras[frame.view]
        flares = {light: gaussians.with_exposure(camera.exposure, look.blend)
                  for light, gaussians in look.evaluate(camera.world_to_camera, edits=edits).items()}
        write_flare_ply(out / frame.file.replace("layers.", "flare.").replace(".exr", ".ply"), flares, camera,
                        look.blend, look.pixel_grid)
        progress.advance()
    summary = "1 frame of Gaussians is" if len(selected) == 1 else f"{len(selected)} frames of Gaussians are"
    progress.say(f"{summary} in {out}.")
    return {"ply": str(out), "frames": len(selected)}


COMMAND = Command(
    "export", "Writes a flare as a preset (JSON) or as Gaussians (PLY), for other tools.",
    """A preset lists the lights, their elements and the parts of each for one frame: offset (0 at the light, 1 at the
centre), size, colour, shape. Procedural flare tools can be set up from it. The PLY holds the flare of a frame as 3D
Gaussians in front of the camera, in the layout of 3DGS with ring_r0 and ring_w added. docs/interop.md describes both.

  run.py export build/demo/run --as preset --out lamp.json --frames 20
  run.py export lamp.flare --capture my_capture --as ply --out build/flares""",
    arguments, (Step("export", "engine", run),))
