# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether frames are exposed alike, as a fit takes them to be: by how bright each shows the capture's points."""
from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..capture import Capture, View
from ..pictures import LUMINANCE, linear_from_srgb
from .frames import Frames, colours_at, thinned

UNLIKE = 0.5
"""Stops, the spread over the frames, from which on it is told. Captures of one exposure have 0.05 to 0.2, with flares
that come and go; the sample with 0.7 stops to either side has 1.3, and loses 5 dB of its flare by that."""
ASKED, POINTS, FEWEST = 24, 4000, 50
"""Frames and points that are looked at, and of how many points at least a frame has to show."""
DARK, BRIGHT = 0.05, 0.9
"""Display values between which pixels tell."""
RARE = 0.1
"""Share of the frames, to either side, that do not count."""


def spread(capture: Capture, views: Sequence[View], frames: Frames) -> float:
    """Stops by which the frames' exposures differ, but for the darkest and the brightest tenth of the frames. 0 where
    too few points or frames tell, or points have no colours."""
    points = capture.points
    chosen = slice(None, None, max(len(points) // POINTS, 1))
    known = linear_from_srgb(points.rgb[chosen] / np.float32(255)) @ LUMINANCE
    xyz, known = points.xyz[chosen][known > 0], known[known > 0]
    if not len(known) or not np.ptp(known) > 0:  # a cloud without colours
        return 0.0
    stops = []
    for view in thinned(views, ASKED):
        camera, frame, removed = frames.targets(view)
        seen, shown = colours_at(xyz, camera, frame if removed is None else removed)
        tells = ((shown > DARK) & (shown < BRIGHT)).all(-1)
        if tells.sum() >= FEWEST:
            stops.append(float(np.median(np.log2(linear_from_srgb(shown[tells]) @ LUMINANCE / known[seen][tells]))))
    if len(stops) < 3:
        return 0.0
    low, high = np.quantile(stops, (RARE, 1 - RARE))
    return float(high - low)


def says(capture: Capture, views: Sequence[View], frames: Frames) -> tuple[str, ...]:
    """Sentences for the person who asked for the fit."""
    stops = spread(capture, views, frames)
    if not (math.isfinite(stops) and stops >= UNLIKE):
        return ()
    return (f"The frames' exposure seems to change, by about {stops:.1f} stops; a fit takes it to be fixed, and finds "
            "a flare in the difference: bring the frames to one exposure first.",)
