# SPDX-License-Identifier: GPL-3.0-or-later
"""export: a flare as files that other tools take."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...core.errors import RunError, SettingsError
from ...core.system.files import check_apart
from ...core.system.progress import Progress
from .. import frames
from ..command import Command, Step

KINDS = ("preset", "ply")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flare", type=Path, metavar="RUN_OR_FLARE", help="folder that `fit` has written, or a .flare")
    parser.add_argument("--as", choices=KINDS, required=True, dest="kind",
                        help="preset: elements with offset, size, colour, shape, in JSON; ply: the flare's Gaussians "
                             "of each frame, 3DGS layout")
    parser.add_argument("--out", type=Path, required=True, metavar="PATH",
                        help="preset: the JSON file; ply: a folder for flare.####.ply")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE", help="whose cameras to use (default: the run's own)")
    frames.add_option(parser, "frame numbers; all for ply, the first for a preset")
    parser.add_argument("--set", action="append", default=[], metavar="LIGHT.WHAT=VALUE", dest="edits",
                        help="edits, as of `bake`; repeatable")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.capture import Capture
    from ...core.conventions.frame_numbers import numbered
    from ...core.conventions.run_files import FLARE
    from ...core.fit.run import Run
    from ...core.look import LookEdits, ViewOfLight, read
    from ...core.transfer.export import write_flare_ply, write_preset

    folder = words.capture
    if words.flare.is_dir():
        folder = Run.open(words.flare).find_capture(folder)
        if not (words.flare / FLARE).is_file():
            raise RunError(Run.open(words.flare).without_flare)
    if not words.flare.exists():
        raise RunError(f"{words.flare} is missing; name a .flare, or the folder of a run.")
    if folder is None:
        raise SettingsError(f"{words.flare} says nothing of cameras; name a capture with --capture.")
    source = words.flare / FLARE if words.flare.is_dir() else words.flare
    check_apart([source], [words.out])
    look = read(source)
    edits = LookEdits.parse(words.edits, look.names, look.element_names)
    capture = Capture.open(folder, need_frames=False)
    if words.flare.is_dir():
        capture = capture.exposed(Run.open(words.flare).exposures)
    cameras = {view.name: view.camera for view in capture.views}
    wanted = frames.asked(numbered(cameras), words.frames, progress)
    if words.kind == "preset":
        if words.frames is not None and len(wanted) > 1:
            raise SettingsError(f"A preset is of one frame, and --frames {words.frames} are {len(wanted)}; name one.")
        number, camera = wanted[0].number, cameras[wanted[0].view]
        seen = {light.name: ViewOfLight.of(camera.world_to_camera, light.xyz) for light in look.lights}
        behind = [name for name, view in seen.items() if view.depth <= 0]
        if len(behind) == len(seen):
            raise RunError(f"No light is in front of the camera in frame {number} of {folder}; name another with "
                           "--frames.")
        write_preset(words.out, look, seen, edits, camera)
        progress.say(f"The preset is {words.out}.")
        if behind:
            progress.say(f"Lights behind the camera in frame {number} are not in it: {', '.join(behind)}.")
        return {"preset": str(words.out)}
    progress.stage("export", len(wanted))
    for frame in wanted:
        camera = cameras[frame.view]
        flares = {light: one.exposed(camera.exposure, look.blend)
                  for light, one in look.evaluate(camera.world_to_camera, edits=edits).items()}
        write_flare_ply(words.out / frame.file.replace("layers.", "flare.").replace(".exr", ".ply"), flares, camera,
                        look.blend, look.sampling)
        progress.advance()
    made = "1 frame of Gaussians is" if len(wanted) == 1 else f"{len(wanted)} frames of Gaussians are"
    progress.say(f"{made} in {words.out}.")
    return {"ply": str(words.out), "frames": len(wanted)}


COMMAND = Command(
    "export", "Writes a flare as a preset (JSON) or as Gaussians (PLY), for other tools.",
    """A preset is lights, their elements and the parts of each, for one frame: offset (0 at the light, 1 at
the centre), size, colour, shape; procedural flare tools can be fed from it. The PLY has a frame's flare
as 3D Gaussians before the camera, in 3DGS's layout, with ring_r0 and ring_w besides. docs/interop.md has both.

  run.py export build/demo/run --as preset --out lamp.json --frames 20
  run.py export lamp.flare --capture my_capture --as ply --out build/flares""",
    arguments, (Step("export", "engine", run),))
