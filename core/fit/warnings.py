# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings on footage that a flare can hardly be learned from, on outlier frames, and on lights that were moved.

`trainer` collects those before a fit and those after it; `run_loop` reports them.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..capture import Capture, View
from ..colour.srgb import LUMINANCE, linear_from_srgb
from ..flare.model import FlareModel
from .frames import Frames, subsample
from .parallax_losses import ambiguity
from .settings import FitSettings, SplitSettings

MIN_VIEWS = 12
"""Views below which a fit warns: with 6 the sample's flare reaches 28.8 dB, with 50 33.6."""
SAMPLED_VIEWS = 8
"""Approximate number of frames whose light is measured."""
MIDDLE_GREY, MAX_STOPS_FROM_GREY = 0.18, 3.0
"""Scene-linear median of a usual frame, and the distance from it in stops above which a fit does badly: with the
sample's frames as EXR times 16, or a sixteenth, nine tenths of the flare are missed."""

MAX_ORIGIN_DISTANCE = 1e4
"""Distance of the cameras' centre from the world's origin, in extents of the capture, above which 32 bit positions are
too coarse: they are a thousandth of the extent or more apart there."""

OUTLIER_RATIO, MAX_OUTLIER_SHARE = 4.0, 0.1
"""Factor on the median loss above which a frame is an outlier, and the largest share of the frames that may be
outliers; with more the fit itself is bad."""
MIN_OUTLIER_LOSS = 0.01
"""Loss below which no frame is an outlier."""
MAX_NAMES = 5
"""Number of outlier frames that are named."""


def footage_warnings(capture: Capture, settings: FitSettings, views: Sequence[View], frames: Frames) -> tuple[str, ...]:
    """Return sentences for the user on what makes it hard to separate a flare in this footage; () if nothing does."""
    warnings = []
    if settings.uses_parallax and not settings.uses_plates and capture.is_rotation_only:
        warnings.append("The camera only turns: without parallax scene and flare cannot be told apart; give clean "
                        "frames in removed/, or footage in which the camera moves.")
    if settings.mode != "3dgs" and len(views) < MIN_VIEWS:
        warnings.append(f"{len(views)} frames are few to learn a flare from: it shows in how it changes with the "
                        "lights' positions in the frame; with twenty or more it will be better.")
    distance, extent = float(np.linalg.norm(capture.centre)), capture.extent
    if distance > MAX_ORIGIN_DISTANCE * extent:
        warnings.append(f"The world's origin is far away: the cameras' centre lies {distance:.3g} units from it, in a "
                        f"capture of {extent:.3g}, and 32 bit positions are too coarse there. Move cameras, points "
                        "and lights to the origin first, with COLMAP's model_transformer or model_aligner for "
                        "instance.")
    if all(capture.holds_light_above_white(view) for view in views):
        light = [linear_from_srgb(frames.frame(view).numpy()) @ LUMINANCE for view in subsample(views, SAMPLED_VIEWS)]
        median = float(np.median([np.median(luminances) for luminances in light]))
        if median > 0 and abs(math.log2(median / MIDDLE_GREY)) > MAX_STOPS_FROM_GREY:
            warnings.append(f"The frames' median light is {median:.2g}, and a fit expects about {MIDDLE_GREY:g}: "
                            "frames that are far brighter or darker are fitted badly. Change the files' exposure "
                            "first.")
    return tuple(warnings)


def ambiguity_warnings(settings: SplitSettings, views: int, ratio: float) -> tuple[str, ...]:
    """Return a sentence if the `ambiguity` of a capture was above 0 when its flare was to start; else ()."""
    if ambiguity(settings, views, ratio) == 0:
        return ()
    return (f"{views} frames hardly tell scene and flare apart here, so the flare may hold parts of the scene: check "
            "preview.png. More frames, or clean frames in removed/, give a better flare.",)


def outlier_warnings(losses: Mapping[str, float], uses_plates: bool = False) -> tuple[str, ...]:
    """Return a sentence that names the frames whose last loss is many times the median; () if none or too many are.

    losses: last loss of each frame, by name. uses_plates: whether the scene is plates.
    """
    median = float(np.median(list(losses.values()))) if losses else 0.0
    names = [name for name, loss in losses.items() if loss > max(OUTLIER_RATIO * median, MIN_OUTLIER_LOSS)]
    if not names or len(names) > max(MAX_OUTLIER_SHARE * len(losses), 1):
        return ()
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    advice = ("the place of a light may be wrong there, or the plate. Correct the light in lights.json, or put a clean "
              "frame in removed/, and fit again." if uses_plates else
              "it may be of another scene, or its camera may be wrong. Take it out of the capture, and fit again.")
    return (f"{', '.join(names[:MAX_NAMES])}{more}: the fit does not reproduce the shot; {advice}",)


def moved_light_warnings(capture: Capture, flare: FlareModel) -> tuple[str, ...]:
    """Return a sentence for each light that the fit moved from its position in the capture; () if lights have places
    by frame, which are never moved."""
    if flare.frame_lights is not None:
        return ()
    distances = [float(np.linalg.norm(xyz - light.xyz))
                 for light, xyz in zip(capture.lights, flare.positions.numpy(), strict=True)]
    return tuple(f"The light {light.name!r} was moved to its flare, {distance:.3g} units from where lights.json has it."
                 for light, distance in zip(capture.lights, distances, strict=True) if distance > 0)
