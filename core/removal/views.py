# SPDX-License-Identifier: GPL-3.0-or-later
"""What a network tells of a frame in several views, and what is believed of it: the less they agree, the less.

A flare is one in every view; what is taken for one in some alone seldom is. So the frame is shown upright and upside
down, in two sizes. In the dark each channel is shown alone too, as a grey picture: the glow of a traffic light is
seldom told in colour, but in the red alone it is that of any lamp. Where what is told so is of one colour, the more of
the two counts. Of white lights it would not: where one channel is clipped and another is not, their flare would leave
with another colour than it came with. And the frame is shown once more with its black at none, for what is told may be
how it was graded (`graded`). Of what they tell in the mean a part is glow round lights, of which `lamps` leaves some.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..pictures import Pixels
from . import graded
from .formation import GAMMA, flare_light
from .formation import display as shown
from .network import MULTIPLE

Tell = Callable[[Pixels], Pixels]
"""By one pass of the network, of display values 0..1 (h, w, 3), h and w multiples of MULTIPLE: what a flare adds to
each, and behind those what of that is glow round lights, (h, w, 6)."""

SIZES, QUARTER_TURNS = (1.0, 0.8), (0, 2)
"""Of the views in colour: parts of the frame's size, quarter turns. Each counts by its pixels."""
ALONE_SIZE = 0.8
"""Of the views of a channel alone."""
APART, ALONE_APART, DOUBT = (0.4, 0.6), (0.12, 0.2), (0.0, 2.5)
"""By how far the views are apart, as a part of what they tell, and how much of that is then taken off what they tell:
nothing of what they agree on, as they do on most flares, nearly all of what they do not. Of flares it is a sixth in
the median, of haze in a scene that is taken for one a quarter to three quarters. Of what a channel tells alone they are
nearer: a tenth for the glow of a traffic light, a fifth for neon that has none."""
DARK = (0.25, 0.4)
"""Median display value up to which a frame is dark, and from which on it is not."""
ONE_COLOUR = (0.15, 0.4)
"""Light of the channel that tells second most alone, in parts of that which tells most, up to which it is of one
colour, and from which on it is not."""
ALONE_SURE = 0.004
"""Mean over the frame of what the channels tell alone above what is told in colour, up to which they are not `trusted`.
"""


class Views(NamedTuple):
    """What a flare adds to a frame's display values as several views of it tell, each (h, w, 3): in the mean, and how
    far the views are apart from that (standard deviation); what the channels tell alone, and how far, 0..1, that
    counts where it is more; which part of the mean, 0..1, is glow round lights; and what tells it from a grade of the
    picture, where so much is told that it may be one."""

    mean: Pixels
    apart: Pixels
    alone: Pixels
    alone_counts: np.float32
    glow: Pixels
    signs: graded.Signs | None = None


def told_in_views(display: Pixels, tell: Tell) -> Views:
    """Of display values 0..1 (h, w, 3), h and w multiples of MULTIPLE."""
    told, glow = map(np.concatenate, zip(*(_turned(tell, display, size) for size in SIZES), strict=True))
    pixels = np.repeat(np.square(SIZES), len(QUARTER_TURNS)).astype(np.float32)
    mean = np.average(told, 0, pixels)
    views = told_once(mean)._replace(apart=np.sqrt(np.average(np.square(told - mean), 0, pixels)),
                                     glow=np.clip(np.average(glow, 0, pixels) / np.maximum(mean, 1e-9), 0, 1))
    dark = np.float32(np.interp(np.median(display), DARK, (1, 0)))
    if dark > 0:
        alone = np.stack([_told_alone(tell, display, channel) for channel in range(3)], -1)
        views = views._replace(alone=alone, alone_counts=dark * _is_of_one_colour(flare_light(display, alone)))
    if graded.may_be(mean) > 0:
        again, _ = _turned(tell, graded.graded_back(display), SIZES[0])
        views = views._replace(signs=graded.signs(display, mean, again.mean(0)))
    return views


def told_once(added: Pixels) -> Views:
    """Of a frame of which there is a single view, in which nothing is glow."""
    none = np.zeros_like(added)
    return Views(added, none, none, np.float32(0), none)


def doubt_of(frames: Sequence[tuple[Views, float]]) -> np.float32:
    """How many times their deviation is taken off what views of a frame tell: by how far they are apart in parts of
    what they tell. Of several frames of a shot, each with a share, by that of all of them, so that a flare which is
    plain to see in those about a frame is believed in it too, and does not go and come back."""
    apart = sum(share * views.apart.mean() for views, share in frames)
    told = sum(share * np.abs(views.mean).mean() for views, share in frames)
    return _doubt(apart, told, APART)


def worth_of(frames: Sequence[tuple[Views, float]]) -> np.float32:
    """The part of what is told of a frame, 0..1, that is taken for a flare and not for the picture's grade. Of several
    frames of a shot, each with a share, by the odds of all of them: a shot is graded as one."""
    asked = [(views.signs.log_odds, share * graded.may_be(views.mean)) for views, share in frames
             if views.signs is not None]
    if not asked:
        return np.float32(1)
    odds, shares = np.transpose(asked)
    counts = shares.sum() / sum(share for _, share in frames)
    return np.float32(1 - counts * (1 - graded.worth(np.average(odds, weights=shares))))


def believed(views: Views, doubt: np.float32) -> Pixels:
    """What a flare adds to display values (h, w, 3), after a doubt (`doubt_of`)."""
    told = _less_doubt(views.mean, views.apart, doubt)
    if views.alone_counts > 0:
        told += trusted(views.alone_counts * np.maximum(views.alone - told, 0), ALONE_SURE)
    return told


def trusted(added: Pixels, sure: float) -> Pixels:
    """None of it where its mean over the frame is `sure` or less, all from twice as much on."""
    return np.asarray(added * np.clip((added.mean() - sure) / max(sure, 1e-9), 0, 1), np.float32)


def _told_alone(tell: Tell, display: Pixels, channel: int) -> Pixels:
    """(h, w), of a channel shown as a grey picture."""
    grey = np.repeat(display[..., channel, None], 3, -1)
    told, _ = _turned(tell, grey, ALONE_SIZE)
    views = told.mean(-1)
    mean, apart = np.mean(views, 0), np.std(views, 0)
    return _less_doubt(mean, apart, _doubt(apart.mean(), np.abs(mean).mean(), ALONE_APART))


def _doubt(apart: Any, told: Any, bounds: tuple[float, float]) -> np.float32:
    """Of views that tell `told` and are `apart`, both in the mean over a frame."""
    return np.float32(np.interp(apart / max(told, 1e-9), bounds, DOUBT))


def _less_doubt(mean: Pixels, apart: Pixels, doubt: np.float32) -> Pixels:
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
