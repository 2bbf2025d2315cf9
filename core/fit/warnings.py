# SPDX-License-Identifier: GPL-3.0-or-later
"""What is told of footage that a flare can hardly be learned from, before a fit begins and as it ends, and of lights
that it put elsewhere."""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..capture import Capture, View
from ..colour.srgb import LUMINANCE, linear_from_srgb
from ..flare.model import FlareModel
from ..images.read import holds_floats
from ..thinning import thinned
from .frames import Frames
from .settings import FitSettings

FEW = 12
"""Views: of 6 the sample's flare comes to 28.8 dB, of 50 to 33.6."""
ASKED = 8
"""About as many frames are asked for their light."""
GREY, FAR_FROM_GREY = 0.18, 3.0
"""Scene-linear light in the middle of a usual frame, and stops from there at which a fit does badly: the sample's
frames as EXR times 16, or a sixteenth, leave nine tenths of the flare unfound."""

ASTRAY = 1e4
"""Extents of the capture, at which the cameras' middle is too far from the world's origin: points are kept in 32 bits,
a thousandth of the extent and more apart there."""

UNLIKE, FEW_UNLIKE = 4.0, 0.1
"""Times the usual loss, at which a frame does not look like what the others make of it; in more than which part of the
frames it is the fit that is bad."""
SEEN = 0.01
"""Loss below which nothing is unlike."""
NAMED = 5
"""Of the frames that are unlike, so many are told by name."""


def doubts(capture: Capture, settings: FitSettings, views: Sequence[View], frames: Frames) -> tuple[str, ...]:
    """Sentences on footage that a flare can hardly be told from."""
    found = []
    if settings.by_parallax and capture.only_turns:
        found.append("The camera only turns: without parallax scene and flare cannot be told apart; give flare-free "
                     "frames in removed/, or footage for which the camera moves.")
    if settings.mode != "3dgs" and len(views) < FEW:
        found.append(f"{len(views)} frames are few to learn a flare from, which shows itself by how it changes with "
                     "the lights' places in the picture; it will be worse than it could be from twenty or more.")
    off, extent = float(np.linalg.norm(capture.centre)), capture.extent
    if off > ASTRAY * extent:
        found.append(f"The world's origin is far away: the cameras' middle lies {off:.3g} units from it, in a capture "
                     f"of {extent:.3g}, and what 32 bits hold of places there is too coarse. Move cameras, points and "
                     "lights to the middle first, by COLMAP's model_transformer or model_aligner for instance.")
    if all(holds_floats(capture.frame_path(view)) for view in views):
        light = [linear_from_srgb(frames.frame(view).numpy()) @ LUMINANCE for view in thinned(views, ASKED)]
        middle = float(np.median([np.median(one) for one in light]))
        if middle > 0 and abs(math.log2(middle / GREY)) > FAR_FROM_GREY:
            found.append(f"The frames' light is {middle:.2g} in the middle, where a fit expects about {GREY:g}: what "
                         "is far brighter or darker is learned badly. Bring the files' exposure there first.")
    return tuple(found)


def unlike(losses: Mapping[str, float]) -> tuple[str, ...]:
    """A sentence on the few frames, by name, whose loss at the end of a fit is many times that of most."""
    usual = float(np.median(list(losses.values()))) if losses else 0.0
    names = [name for name, loss in losses.items() if loss > max(UNLIKE * usual, SEEN)]
    if not names or len(names) > max(FEW_UNLIKE * len(losses), 1):
        return ()
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return (f"{', '.join(names[:NAMED])}{more}: what the fit makes of the shot does not look like it; it may be of "
            "another scene, or its camera be wrong. Take it out of the capture, and fit again.",)


def moved_lights(capture: Capture, flare: FlareModel) -> tuple[str, ...]:
    """A sentence for each light that is not where the capture has it."""
    away = [float(np.linalg.norm(xyz - light.xyz)) for light, xyz in
            zip(capture.lights, flare.positions.numpy(), strict=True)]
    return tuple(f"The light {light.name!r} was put where its flare is, {distance:.3g} from where it was given."
                 for light, distance in zip(capture.lights, away, strict=True) if distance > 0)
