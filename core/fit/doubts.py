# SPDX-License-Identifier: GPL-3.0-or-later
"""What is told, before a fit begins, of footage that a flare can hardly be learned from."""
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..capture import Capture, View
from ..pictures import LUMINANCE, holds_floats, linear_from_srgb
from .frames import Frames, thinned
from .settings import FitSettings

FEW = 12
"""Views: of 6 the sample's flare comes to 28.8 dB, of 50 to 33.6."""
ASKED = 8
"""About as many frames are asked for their light."""
GREY, FAR_FROM_GREY = 0.18, 3.0
"""Scene-linear light in the middle of a usual frame, and stops from there at which a fit does badly: the sample's
frames as EXR times 16, or a sixteenth, leave nine tenths of the flare unfound."""


def doubts(capture: Capture, settings: FitSettings, views: Sequence[View], frames: Frames) -> tuple[str, ...]:
    """Sentences on footage that a flare can hardly be told from."""
    found = []
    if settings.mode == "split" and capture.only_turns:
        found.append("The camera only turns: without parallax scene and flare cannot be told apart; give flare-free "
                     "frames in removed/, or footage for which the camera moves.")
    if settings.mode != "3dgs" and len(views) < FEW:
        found.append(f"{len(views)} frames are few to learn a flare from, which shows itself by how it changes with "
                     "the lights' places in the picture; it will be worse than it could be from twenty or more.")
    if all(holds_floats(capture.frame_path(view)) for view in views):
        light = [linear_from_srgb(frames.frame(view).numpy()) @ LUMINANCE for view in thinned(views, ASKED)]
        middle = float(np.median([np.median(one) for one in light]))
        if middle > 0 and abs(math.log2(middle / GREY)) > FAR_FROM_GREY:
            found.append(f"The frames' light is {middle:.2g} in the middle, where a fit expects about {GREY:g}: what "
                         "is far brighter or darker is learned badly. Bring the files' exposure there first.")
    return tuple(found)
