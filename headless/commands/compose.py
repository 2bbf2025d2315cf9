# SPDX-License-Identifier: GPL-3.0-or-later
"""compose: combines baked layers in Blender's compositor and renders the frames."""
from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import SettingsError
from ...core.look import LookEdits
from ...core.system.files import retry_while_locked
from ...core.system.progress import Progress
from ...core.system.tally import Tally
from .. import frames
from ..command import Command, Step

if TYPE_CHECKING:
    from ...core.bake.folder import LayerFolder

BLEND = "compositor.blend"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("layers", type=Path, metavar="LAYERS", help="folder that `bake` wrote")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"folder for the frames and {BLEND}")
    frames.add_option(parser)
    frames.add_job_option(parser)
    parser.add_argument("--intensity", type=float, default=1.0, metavar="X", help="factor on the flare (default 1)")
    parser.add_argument("--tint", default="1,1,1", metavar="R,G,B",
                        help="colour on the flare, linear factors or #rrggbb (default 1,1,1)")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender step: write the compositor, and the frames that --frames selects, into the folder of --out."""
    from ...core.bake.folder import LayerFolder
    from ...core.conventions.frame_numbers import NumberedFrame

    if args.out.resolve() == args.layers.resolve():
        raise SettingsError(f"{args.out} holds the layers; choose another folder for the frames.")
    layers = LayerFolder.open(args.layers)
    available = [NumberedFrame(view="", number=number, file=str(path)) for number, path in layers.files.items()]
    selected = frames.select_task(available, args, progress)
    if not selected:
        return {"frames": str(args.out)}
    result = compose_frames(layers, args.out, progress, numbers=[frame.number for frame in selected],
                            intensity=args.intensity, tint=args.tint)
    progress.say(f"The frames are in {result['frames']}; {result['blend']} opens in Blender.")
    tally = Tally("frame", "composed", len(selected))
    progress.say(tally.summary())
    return {**result, **tally.as_result()}


def compose_frames(layers: LayerFolder, out: Path, progress: Progress, *, numbers: Sequence[int] | None = None,
                   intensity: float = 1.0, tint: str = "1,1,1") -> dict[str, Any]:
    """Build the compositor for the layers, save it as a .blend in `out`, and render the frames `numbers` there.

    numbers: None for all, [] for none. intensity: factor on the flare. tint: its colour, as text. Returns the command's
    result.
    """
    import bpy

    from ...flare_addon import cameras, render_settings
    from ...flare_addon.compositor import layer_nodes, setup

    if not 0 <= intensity < float("inf"):
        raise SettingsError(f"The intensity {intensity} is not a number of 0 or more.")
    colour = LookEdits.parse([f"flare.tint={tint}"], ["flare"]).light_edit("flare").tint
    numbers = list(layers.files) if numbers is None else numbers

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    node = setup.set_up_nodes(scene, layers)
    render_settings.match_scene(scene, layers, layers.size())
    render = scene.render
    render.pixel_aspect_x, render.pixel_aspect_y = cameras.pixel_aspect(1, layers.pixel_aspect())
    if not (window := layers.window()).is_frame:
        progress.say(f"The layers have overscan ({window.size[0]} x {window.size[1]} pixels for a frame of "
                     f"{window.frame[0]} x {window.frame[1]}), which Blender cannot show; its nodes cut it off.")
    for warning in (render_settings.set_plain_output(scene), layer_nodes.colour_space_warning(scene)):
        if warning:
            progress.say(warning)
    node.inputs["Intensity"].default_value = intensity
    node.inputs["Tint"].default_value = (*colour, 1.0)
    for name in _VARYING_METADATA:
        setattr(render, f"use_stamp_{name}", False)
    _back_up(out.resolve() / BLEND, progress)
    render_settings.save_blend(out.resolve() / BLEND)
    progress.stage("compose", len(numbers))
    render_settings.render_frames(scene, numbers, lambda number, suffix: out.resolve() / f"frame.{number:04d}{suffix}",
                                  lambda _number: progress.advance())
    return {"frames": str(out), "blend": str(out / BLEND), "blender": bpy.app.version_string}


_VARYING_METADATA = ("date", "render_time", "filename", "memory", "hostname")
"""What Blender would write into the frames' headers and is different each time."""


def _back_up(blend: Path, progress: Progress) -> None:
    """Rename an earlier .blend, in which somebody may have worked, to a free name as Blender numbers backups."""
    if blend.exists():
        names = (blend.with_suffix(f".blend{number}") for number in itertools.count(1))
        backup = next(name for name in names if not name.exists())
        retry_while_locked(blend.rename, backup)
        progress.say(f"{blend} existed already; it is now {backup.name}.")


COMMAND = Command(
    "compose", "Combines baked layers in Blender's compositor and renders the frames.",
    f"""Builds the node group "Fit Flare" over LAYERS and writes frame.####.exr (half float, scene-linear),
frame.####.png (sRGB) and {BLEND}, which opens in Blender and shows the same. An earlier .blend is kept beside
it as compositor.blend1, .blend2 and so on.

  run.py compose build/demo/layers --out build/frames --intensity 1.5 --tint 1,0.8,0.6""",
    arguments, (Step("compose", "blender", run),))
