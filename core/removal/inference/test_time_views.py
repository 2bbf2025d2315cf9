# SPDX-License-Identifier: GPL-3.0-or-later
"""What a network tells of a frame in several views, and what is believed of it.

The frame is shown upright and upside down, in two sizes, and once more with its black at none: by how far those agree,
and more, it is judged whether there is a flare at all (`odds`). In the dark each channel is shown alone too, as a grey
picture: the glow of a traffic light is seldom told in colour, but in the red alone it is that of any lamp. Where what
is told so is of one colour, the more of the two counts. Of white lights it would not: where one channel is clipped and
another is not, their flare would leave with another colour than it came with. Of what they tell in the mean a part is
glow round lights, of which `lamps` leaves some.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ...colour.srgb import Pixels
from ..model.image_formation import GAMMA, flare_light
from ..model.image_formation import display as shown
from ..model.network import MULTIPLE
from . import confidence

Tell = Callable[[Pixels], Pixels]
"""By one pass of the network, of display values 0..1 (h, w, 3), h and w multiples of MULTIPLE: what a flare adds to
each, and behind those what of that is glow round lights, (h, w, 6)."""

SIZES, QUARTER_TURNS = (1.0, 0.8), (0, 2)
"""Of the views in colour: parts of the frame's size, quarter turns. Each counts by its pixels."""
ALONE_SIZE = 0.8
"""Of the views of a channel alone."""
ALONE_APART, DOUBT = (0.12, 0.2), (0.0, 2.5)
"""By how far the views of a channel alone are apart, as a part of what they tell (a tenth for the glow of a traffic
light, a fifth for neon that has none), and how much of that is then taken off what they tell: nothing of what they
agree on, nearly all of what they do not."""
DARK = (0.25, 0.4)
"""Median display value up to which a frame is dark, and from which on it is not."""
ONE_COLOUR = (0.15, 0.4)
"""Light of the channel that tells second most alone, in parts of that which tells most, up to which it is of one
colour, and from which on it is not."""
ALONE_SURE = 0.004
"""Mean over the frame of what the channels tell alone above what is told in colour, up to which they are not `trusted`.
"""


class Views(NamedTuple):
    """What a flare adds to a frame's display values as several views of it tell, each (h, w, 3): in the mean; what the
    channels tell alone, and how far, 0..1, that counts where it is more; which part of the mean, 0..1, is glow round
    lights; and by what it is judged whether there is one, where so much is told that it matters."""

    mean: Pixels
    alone: Pixels
    alone_counts: np.float32
    glow: Pixels
    signs: confidence.Signs | None = None


def told_in_views(display: Pixels, tell: Tell) -> Views:
    """Of display values 0..1 (h, w, 3), h and w multiples of MULTIPLE."""
    told, glow = map(np.concatenate, zip(*(_turned(tell, display, size) for size in SIZES), strict=True))
    pixels = np.repeat(np.square(SIZES), len(QUARTER_TURNS)).astype(np.float32)
    mean = np.average(told, 0, pixels)
    views = told_once(mean)._replace(glow=np.clip(np.average(glow, 0, pixels) / np.maximum(mean, 1e-9), 0, 1))
    dark = np.float32(np.interp(np.median(display), DARK, (1, 0)))
    if dark > 0:
        alone = np.stack([_told_alone(tell, display, channel) for channel in range(3)], -1)
        views = views._replace(alone=alone, alone_counts=dark * _is_of_one_colour(flare_light(display, alone)))
    if mean.mean() > confidence.ASKED:
        apart = np.sqrt(np.average(np.square(told - mean), 0, pixels))
        again, _ = _turned(tell, confidence.graded_back(display), SIZES[0])
        views = views._replace(signs=confidence.signs(display, mean, apart, again.mean(0)))
    return views


def told_once(added: Pixels) -> Views:
    """Of a frame of which there is a single view, in which nothing is glow."""
    none = np.zeros_like(added)
    return Views(added, none, np.float32(0), none)


def worth_of(frames: Sequence[tuple[Views, float]]) -> np.float32:
    """The part of what is told of a frame, 0..1, that is taken for a flare. Of several frames of a shot, each with a
    share, by the odds of all of them, so that a flare which is plain to see in those about a frame is believed in it
    too, and does not go and come back."""
    asked = [(views.signs.log_odds, share) for views, share in frames if views.signs is not None and share > 0]
    if not asked:
        return np.float32(1)
    log_odds, shares = zip(*asked, strict=True)
    return confidence.worth(float(np.average(log_odds, weights=shares)))


def believed(views: Views) -> Pixels:
    """What a flare adds to display values (h, w, 3), if there is one."""
    told = views.mean
    if views.alone_counts > 0:
        told = told + trusted(views.alone_counts * np.maximum(views.alone - told, 0), ALONE_SURE)
    return told


def trusted(added: Pixels, sure: float) -> Pixels:
    """None of it where its mean over the frame is `sure` or less, all from twice as much on."""
    return np.asarray(added * np.clip((added.mean() - sure) / max(sure, 1e-9), 0, 1), np.float32)


def _told_alone(tell: Tell, display: Pixels, channel: int) -> Pixels:
    """(h, w), of a channel shown as a grey picture, less what is in doubt."""
    grey = np.repeat(display[..., channel, None], 3, -1)
    told, _ = _turned(tell, grey, ALONE_SIZE)
    views = told.mean(-1)
    mean, apart = np.mean(views, 0), np.std(views, 0)
    doubt = np.float32(np.interp(apart.mean() / max(np.abs(mean).mean(), 1e-9), ALONE_APART, DOUBT))
    return np.asarray(np.maximum(mean - doubt * apart, 0), np.float32)


def _is_of_one_colour(light: Pixels) -> np.float32:
    """0..1, of light (h, w, 3)."""
    _, second, most = np.sort(light.mean((0, 1)))
    return np.float32(np.interp(second / max(most, 1e-9), ONE_COLOUR, (1, 0)))


def _turned(tell: Tell, display: Pixels, size: float) -> tuple[Pixels, Pixels]:
    """What a flare adds, and what of that is glow, as views of that part of the frame's size in QUARTER_TURNS tell:
    (turns, h, w, 3) each."""
    told = np.stack([_in_view(tell, display, size, turns) for turns in QUARTER_TURNS])
    return told[..., :3], told[..., 3:]


def _in_view(tell: Tell, display: Pixels, size: float, turns: int) -> Pixels:
    """(h, w, 6), what is told of a view, brought back to the frame's size and upright."""
    import cv2

    height, width = display.shape[:2]
    high, wide = (max(round(side * size / MULTIPLE), 2) * MULTIPLE for side in (height, width))
    view = display
    if (high, wide) != (height, width):
        view = shown(np.asarray(cv2.resize(display**GAMMA, (wide, high), interpolation=cv2.INTER_AREA)), GAMMA)
    told = np.ascontiguousarray(np.rot90(tell(np.rot90(view, turns)), -turns))
    return np.asarray(cv2.resize(told, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
