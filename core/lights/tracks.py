# SPDX-License-Identifier: GPL-3.0-or-later
"""Follows lights through the frames of a shot: places on the picture, brightness and confidence by frame.

`sources.py` finds candidates in each frame, `association.py` chains them. A chain is a light if its sources look like
lamps in most frames, and it is neither a ghost nor a reflection of another light. Between the frames that show a light
`path_interpolation.py` completes its path; beyond them it goes on at constant velocity until it is well out of the
frame. A static light goes with the background instead (`background_motion.py`). Each such place has an expected error,
which becomes its confidence.

Brightness is the height of the glow around the light's place in unclipped rings, with one profile for the whole shot:
I[t, r] = on[t] G[r] + background[t], by alternating least squares.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..capture.camera import Floats
from ..capture.lights import DOUBTFUL, LightKey
from ..system.progress import Progress
from .association import Chain, follow_sources
from .background_motion import BackgroundMotion, CarriedPlace
from .path_interpolation import interpolate_path
from .sources import CLIPPED, REFERENCE, Source, find_sources, measure_profile

MIN_EVIDENCE = 0.3
"""Evidence of a chain from which it is a light; chains down to half of it are doubtful."""
MIN_FRAMES = 4
"""Smallest number of frames that must show a light; in a long shot it is a tenth of the frames."""
GHOST_ERROR, MIN_GHOST_MOTION = 0.008, 0.03
"""Largest median distance of a ghost from the line through its light, and the least motion of that light, diagonals."""
MIN_SHARED = 0.7
"""Part of the frames of a ghost or a reflection in which its light must be followed too."""
REFLECTION_OFFSET, MIN_REFLECTION_DISTANCE = 0.025, 0.03
"""Largest horizontal distance (90 % of the frames) and least vertical distance (median) of a reflection from its light,
diagonals."""
REFLECTION_RADIUS, REFLECTION_HEIGHT = 0.6, 1.3
"""Radius of a reflection relative to its light's, below which it may have any shape, and ratio of height to width from
which any smaller radius will do."""
TOLERATED_ERROR = 3.0
"""Expected error, pixels of a frame with a diagonal of REFERENCE, at which a place is as good as doubtful."""
RECOVERY, MAX_RECOVERY = 0.012, 0.06
"""Distance from a light's path within which a spot is the light, in addition to the path's expected error, and the
largest sum of both; diagonals."""
MIN_RECOVERED_SCORE, RECOVERED_SIZES = 0.5, (0.4, 1.5)
"""Smallest score of such a spot, and the range of its radius relative to the median of the light's."""
PLACE_ERROR = 0.5
"""Expected error of a measured place, pixels."""
MAX_OUTLIER_SPAN, MAX_PARABOLA_SPAN = 4, 6
"""Largest number of frames from the neighbour before a place to the one after it over which an outlier is recognised,
and over which a parabola gives the velocity."""
MAX_BEYOND = 12
"""Number of frames by which a path continues before and after those that show the light."""
OUT_MARGIN = 0.25
"""Distance out of the frame, diagonals, at which a path ends."""
BRIGHTNESS_STEPS = 40
"""Alternations between the brightness of the frames and the profile."""
BACKGROUND_RINGS = 5
"""Outer rings whose median is the background."""
BACKGROUND_NOISE, GLOW_NOISE, PRIOR = 0.04, 0.15, 0.4
"""Standard deviations: of the background (linear light), of the glow (relative), and of the brightness over frames."""
CLIPPED_ON = 0.15
"""Least brightness of a light that clips: a bright background may hide its glow."""
DARK = 0.08
"""Brightness below which a light is out."""


@dataclass(frozen=True, eq=False)
class TrackedLight:
    """A light on a path on the picture.

    keys: place, brightness and confidence by the name of the frame. support: names of the frames that show it.
    evidence: 0..1, how much it looks like a lamp. colour: (3,) linear, largest channel 1. radius: median, pixels.
    """

    keys: dict[str, LightKey]
    support: tuple[str, ...]
    evidence: float
    colour: Floats
    radius: float
    how: str = "followed"

    @property
    def doubtful(self) -> list[str]:
        """Names of the frames in which the light's place is doubtful."""
        return [name for name, key in self.keys.items() if key.confidence < DOUBTFUL]


@dataclass(frozen=True, eq=False)
class TrackFindings:
    """The result of following: lights, the longest first; doubtful ones; sources of each frame; sentences for the
    user."""

    lights: list[TrackedLight]
    doubtful: list[TrackedLight]
    sources: list[list[Source]]
    messages: list[str]


def track_lights(capture: Capture, progress: Progress | None = None) -> TrackFindings:
    """Follow the lights of a capture's frames, which are taken for consecutive. Raises FrameError and Cancelled."""
    progress = progress or Progress()
    views = capture.views
    progress.stage("look for lights", len(views))
    clip_value = clip_level(capture)
    sources: list[list[Source]] = []
    for view in views:
        sources.append(find_sources(capture.frame(view), clip_value))
        progress.advance(1, found=sum(map(len, sources)))
    camera = views[0].camera
    diagonal = float(np.hypot(*camera.size))
    chains = follow_sources(sources, diagonal)
    recover_sources(chains, sources, np.array(camera.size, np.float64), diagonal)
    # A shot shorter than MIN_FRAMES cannot show a light in so many.
    min_frames = max(MIN_FRAMES, len(views) // 10) if len(views) >= MIN_FRAMES else 1
    long_chains = [chain for chain in chains if len(chain.frames) >= min_frames]
    lamps = [chain for chain in long_chains if chain.evidence >= MIN_EVIDENCE]
    ghosts = [chain for chain in lamps if _is_ghost(chain, lamps, np.array([camera.cx, camera.cy]), diagonal)]
    lamps = [chain for chain in lamps if chain not in ghosts]
    reflections = [chain for chain in lamps if _is_reflection(chain, lamps, diagonal)]
    lamps = [chain for chain in lamps if chain not in reflections]
    doubtful_chains = [chain for chain in long_chains if MIN_EVIDENCE > chain.evidence >= 0.5 * MIN_EVIDENCE]
    progress.stage("follow lights", len(lamps) + len(doubtful_chains))
    tracked, motion = [], BackgroundMotion(capture)
    for chain in [*lamps, *doubtful_chains]:
        tracked.append(_to_light(chain, capture, diagonal, motion if chain in lamps else None))
        progress.advance()
    lights, doubtful = tracked[:len(lamps)], tracked[len(lamps):]
    return TrackFindings(lights, doubtful, sources, _messages(lights, doubtful, len(ghosts), len(reflections), sources))


def clip_level(capture: Capture) -> float:
    """Return the display value from which pixels of a shot are clipped: a little below the largest, CLIPPED at most.

    The largest value of a frame is that of its 12th brightest pixel, so that single hot pixels do not count. Footage
    with a limited range or a soft shoulder never reaches white.
    """
    peaks = []
    for view in capture.views[::max(len(capture.views) // 12, 1)]:
        value = capture.frame(view).display().max(axis=2)
        peaks.append(float(np.partition(value.ravel(), -12)[-12]) if value.size > 12 else float(value.max()))
    return min(CLIPPED, 0.985 * max(peaks))


def _messages(lights: Sequence[TrackedLight], doubtful: Sequence[TrackedLight], ghosts: int, reflections: int,
              sources: Sequence[Sequence[Source]]) -> list[str]:
    """Return the sentences for the user. ghosts, reflections: numbers of chains that are ghosts or reflections."""
    number = sum(map(len, sources))
    messages = [f"{number} bright spots in {sum(map(bool, sources))} of {len(sources)} frames, of which "
                f"{len(lights)} {'is a light' if len(lights) == 1 else 'are lights'} that could be followed."]
    for index, light in enumerate(lights, 1):
        frames = light.doubtful
        if frames:
            messages.append(f"light{index} is hidden, out of the frame or out in {len(frames)} of {len(light.keys)} "
                            f"frames where its place is doubtful (first {frames[0]}).")
    if ghosts:
        messages.append(f"{ghosts} more follow another light through the middle of the picture and are its ghosts.")
    if reflections:
        messages.append("1 more stays below another light and is its reflection on the ground." if reflections == 1 else
                        f"{reflections} more stay below another light and are its reflections on the ground.")
    if doubtful:
        messages.append(f"{len(doubtful)} moving bright things look too little like lamps and are left out.")
    if not lights:
        messages.append("No light was found: none is in frame for long enough, or none is over-exposed.")
    return messages


def _is_ghost(chain: Chain, lights: Sequence[Chain], centre: Floats, diagonal: float) -> bool:
    """Return whether a chain is a ghost of another one of `lights`, whose spots are larger and move.

    A ghost keeps to one ratio of the way from the principal point to its light. centre: principal point (2,), pixels.
    diagonal: length of the frame's diagonal, pixels.
    """
    for light in lights:
        ghost_sources, light_sources = _shared_sources(chain, light)
        if not ghost_sources:
            continue
        ghost, source = (np.array([spot.xy for spot in sources]) - centre for sources in (ghost_sources, light_sources))
        radius, light_radius = (np.median([spot.detection.radius for spot in sources])
                                for sources in (ghost_sources, light_sources))
        if radius > 0.9 * light_radius or np.ptp(source, axis=0).max() < MIN_GHOST_MOTION * diagonal:
            continue
        # To third order in the field angle, a ghost lies at (a + b field²) of the way to its light.
        field = (source ** 2).sum(axis=1, keepdims=True) / diagonal ** 2
        terms = np.stack([source.ravel(), (field * source).ravel()], axis=1)
        ratios = np.linalg.lstsq(terms, ghost.ravel(), rcond=None)[0]
        residual = (ghost.ravel() - terms @ ratios).reshape(-1, 2)
        error = float(np.median(np.linalg.norm(residual, axis=1)))
        # What lies at a ratio of 1 is part of the light itself.
        if error < GHOST_ERROR * diagonal and abs(ratios[0] - 1) > 0.05:
            return True
    return False


def _is_reflection(chain: Chain, lights: Sequence[Chain], diagonal: float) -> bool:
    """Return whether a chain is the reflection of another one of `lights` on wet ground, water or a floor.

    A reflection stays straight below its light, in a picture that is not tilted. It is much smaller than the light, or
    smaller and drawn out in height. diagonal: length of the frame's diagonal, pixels.
    """
    for light in lights:
        sources, light_sources = _shared_sources(chain, light)
        if not sources:
            continue
        offsets = np.array([source.xy - above.xy for source, above in zip(sources, light_sources, strict=True)])
        aside, below = np.quantile(abs(offsets[:, 0]), 0.9), np.median(offsets[:, 1])
        radius, light_radius = (np.median([source.detection.radius for source in each])
                                for each in (sources, light_sources))
        height = np.median([source.detection.mask.shape[0] / source.detection.mask.shape[1] for source in sources])
        is_straight_below = aside < REFLECTION_OFFSET * diagonal and below > MIN_REFLECTION_DISTANCE * diagonal
        max_radius = light_radius if height > REFLECTION_HEIGHT else REFLECTION_RADIUS * light_radius
        if is_straight_below and radius < max_radius:
            return True
    return False


def _shared_sources(chain: Chain, other: Chain) -> tuple[list[Source], list[Source]]:
    """Return the sources of two chains in the frames that both have; two empty lists if `other` lacks too many of the
    frames of `chain`, or is `chain` itself."""
    shared = sorted(set(chain.frames) & set(other.frames))
    if other is chain or len(shared) < max(3, MIN_SHARED * len(chain.frames)):
        return [], []
    first, second = ([each.sources[each.frames.index(frame)] for frame in shared] for each in (chain, other))
    return first, second


def _to_light(chain: Chain, capture: Capture, diagonal: float, motion: BackgroundMotion | None) -> TrackedLight:
    """Return the light of a chain with its keys in all frames that its path reaches.

    diagonal: length of the frame's diagonal, pixels. motion: carries a static light to frames that do not show it.
    """
    size = np.array(capture.views[0].camera.size, np.float64)
    frames, places, errors = _fill_path(chain, len(capture.views), size, diagonal, motion)
    source_by_frame = dict(zip(chain.frames, chain.sources, strict=True))
    is_inside = ((places > 0) & (places < size)).all(axis=1)
    profiles = []
    for frame, place, inside in zip(frames, places, is_inside, strict=True):
        if frame in source_by_frame:
            profiles.append(source_by_frame[frame].profile)
        elif inside:
            pixels = np.minimum(capture.frame(capture.views[frame]).linear(), 1).mean(axis=2)
            profiles.append(measure_profile(pixels, place))
        else:
            profiles.append(np.full(len(chain.sources[0].profile), np.nan))
    brightness = fit_brightness(np.array(profiles), np.array([frame in source_by_frame for frame in frames]))
    tolerated = TOLERATED_ERROR * diagonal / REFERENCE
    keys = {}
    for frame, place, error, value, inside in zip(frames, places, errors, brightness, is_inside, strict=True):
        confidence = 1 / (1 + (error / tolerated) ** 2)
        resolved = _resolve_brightness(value, source_by_frame.get(frame), confidence, inside)
        keys[capture.views[frame].name] = LightKey(None, place, resolved, float(confidence))
    colour = np.median([source.detection.colour for source in chain.sources], axis=0)
    return TrackedLight(keys, tuple(capture.views[frame].name for frame in chain.frames), chain.evidence,
                        colour / max(float(colour.max()), 1e-6),
                        float(np.median([source.detection.radius for source in chain.sources])))


def _resolve_brightness(fitted: float, source: Source | None, confidence: float, is_inside: bool) -> float | None:
    """Return the brightness of a light in a frame; None where it is not known.

    fitted: brightness from the light's profile, NaN if unknown. source: the light's source in the frame, None if it was
    not detected. confidence: of the light's place, 0..1. is_inside: True if the place is in the frame.
    """
    brightness = None if np.isnan(fitted) else float(fitted) if fitted >= DARK else 0.0
    if source is not None:
        # A detected light clips, so it is on; the profile of one that the edge cuts is not known.
        return None if brightness is None or source.detection.is_cut else max(brightness, CLIPPED_ON)
    if not is_inside:
        return None
    # At a doubtful place the glow may be another light's, so the light counts as out.
    return 0.0 if brightness is None or confidence < DOUBTFUL else brightness


class _Recovery(NamedTuple):
    """A source that a chain may take in a frame. distance: from the chain's path, relative to the largest one."""

    distance: float
    frame: int
    source: Source


def recover_sources(chains: Sequence[Chain], sources: Sequence[Sequence[Source]], size: Floats, diagonal: float
                    ) -> None:
    """Add to chains of lamps, in place, the unused sources that lie on their paths, such as half hidden lamps.

    The source nearest to a chain's path is added first. sources: those of each frame of the shot. size (2,), diagonal:
    size of the frames and length of their diagonal, pixels.
    """
    lamps = [chain for chain in chains if chain.evidence >= MIN_EVIDENCE and len(chain.frames) >= MIN_FRAMES]
    used_ids = {id(source) for chain in lamps for source in chain.sources}
    for chain in lamps:
        radius = float(np.median([source.detection.radius for source in chain.sources]))
        while True:  # each source makes the path to the next one more certain
            frames, places, errors = _fill_path(chain, len(sources), size, diagonal)
            nearest: _Recovery | None = None
            for frame, place, error in zip(frames, places, errors, strict=True):
                if frame in chain.frames:
                    continue
                reach = min(RECOVERY * diagonal + error, MAX_RECOVERY * diagonal)
                for source in sources[frame]:
                    spot = source.detection
                    distance = float(np.linalg.norm(source.xy - place)) / reach
                    is_alike = spot.score >= MIN_RECOVERED_SCORE and (
                        spot.is_cut or RECOVERED_SIZES[0] * radius < spot.radius < RECOVERED_SIZES[1] * radius)
                    is_nearest = distance < 1 and (nearest is None or distance < nearest.distance)
                    if id(source) not in used_ids and is_alike and is_nearest:
                        nearest = _Recovery(distance, frame, source)
            if nearest is None:
                break
            used_ids.add(id(nearest.source))
            index = int(np.searchsorted(chain.frames, nearest.frame))
            chain.frames.insert(index, nearest.frame)
            chain.sources.insert(index, nearest.source)


def _fill_path(chain: Chain, count: int, size: Floats, diagonal: float,
               motion: BackgroundMotion | None = None) -> tuple[list[int], Floats, Floats]:
    """Return the frames of a chain's path, places (n, 2) and expected errors (n,) in pixels.

    count: number of frames of the shot. size (2,), diagonal: size of the frames and length of their diagonal, pixels.
    motion: carries a static light to frames that do not show it; None uses the chain's own motion alone. Sources that
    the frame's edge cuts count as missing if at least two others are left.
    """
    uncut = _without_cut(chain)
    acceleration = chain.acceleration(diagonal)
    measured = dict(zip(chain.frames, chain.sources, strict=True))
    first, last = max(chain.frames[0] - MAX_BEYOND, 0), min(chain.frames[-1] + MAX_BEYOND, count - 1)
    frames, places, errors = [], [], []
    knots, points = np.array(uncut.frames), uncut.places
    between = interpolate_path(knots, points, PLACE_ERROR)
    carried: Mapping[int, CarriedPlace] = {}
    if motion is not None:
        carried = motion.carry(uncut.frames, points, sorted({*range(first, last + 1)} - {*uncut.frames}))
    for frame in range(first, last + 1):
        index = int(np.searchsorted(knots, frame))  # of the first knot that is not before the frame
        if index < len(knots) and knots[index] == frame:
            place, error = points[index], _expected_error(uncut, index, acceleration)
        elif frame in carried:
            place, error = carried[frame]
        elif 0 < index < len(knots):  # between two knots; else before the first or after the last
            span = float(knots[index] - knots[index - 1])
            place = between[frame]
            error = acceleration * span * span / 16  # half of what a straight line would miss in the middle
        else:
            end = -1 if index else 0
            step = float(frame - knots[end])
            place, error = points[end] + step * _velocity_at_end(knots, points, end), 0.5 * acceleration * step * step
        source = measured.get(frame)
        if source is not None and source.detection.is_cut and frame not in carried:
            # The part within the frame bounds the place: more than three of its radii away, the path is wrong.
            place = source.xy if np.linalg.norm(place - source.xy) > 3 * source.detection.radius else place
            error = max(error, 0.5 * source.detection.radius)
        outside = float(np.maximum(np.maximum(-place, place - size), 0).max())
        if outside > OUT_MARGIN * diagonal and not chain.frames[0] <= frame <= chain.frames[-1]:
            continue
        frames.append(frame)
        places.append(place)
        errors.append(error)
    return frames, np.array(places), np.array(errors)


def _without_cut(chain: Chain) -> Chain:
    """Return the chain without sources that the frame's edge cuts; the whole chain where too few are left."""
    uncut = [(frame, source) for frame, source in zip(chain.frames, chain.sources, strict=True)
             if not source.detection.is_cut]
    if len(uncut) < 2:
        return chain
    return Chain([frame for frame, _ in uncut], [source for _, source in uncut])


def _velocity_at_end(frames: Floats, places: Floats, end: int) -> Floats:
    """Return the velocity (2,), pixels per frame, at the first or last measured place.

    The velocity is that of the parabola through the three places nearest to the end, or, if they span more than
    MAX_PARABOLA_SPAN frames, of the line through the nearest two; 0 for a single place. frames: (n,) numbers of the
    measured frames. places: (n, 2), pixels. end: 0 for the first place, -1 for the last.
    """
    nearest = slice(None, 3) if end == 0 else slice(-3, None)
    if np.ptp(frames[nearest]) > MAX_PARABOLA_SPAN:
        nearest = slice(None, 2) if end == 0 else slice(-2, None)
    if len(frames) < 2:
        return np.zeros(2)
    times = (frames[nearest] - frames[end]).astype(np.float64)
    linear_term = -2  # of the coefficients, highest first: the derivative at time 0
    return np.asarray(np.polyfit(times, places[nearest], len(times) - 1)[linear_term])


def _expected_error(chain: Chain, index: int, acceleration: float) -> float:
    """Return the expected error, pixels, of the measured place `index` of a chain.

    PLACE_ERROR, plus how much farther the place is from the straight line between its neighbours than this acceleration
    (pixels per frame²) can bend a path. Without neighbours within MAX_OUTLIER_SPAN frames it is PLACE_ERROR.
    """
    frames, places = chain.frames, chain.places
    if not 0 < index < len(frames) - 1 or frames[index + 1] - frames[index - 1] > MAX_OUTLIER_SPAN:
        return PLACE_ERROR
    part = (frames[index] - frames[index - 1]) / (frames[index + 1] - frames[index - 1])
    middle = (1 - part) * places[index - 1] + part * places[index + 1]
    span = frames[index + 1] - frames[index - 1]
    return PLACE_ERROR + max(float(np.linalg.norm(places[index] - middle)) - acceleration * span * span / 8, 0.0)


def fit_brightness(profiles: Floats, is_detected: NDArray[np.bool_]) -> Floats:
    """Return the brightness (n,) of a light from its profiles (n, rings): 0..1, NaN where no ring is usable.

    Alternating least squares fit brightness times one common profile plus a background to the profiles.

    is_detected: (n,) frames in which the light was detected; only they shape the common profile, and the 90th
    percentile of their brightness is 1. The background is the median of the outer rings. Where the glow hardly exceeds
    the background, the brightness is drawn to the median of the frames with a detection, or to 0 in a frame without
    one. If no frame with a detection has a usable ring, the brightness is 1 wherever a ring is usable.
    """
    outer = profiles[:, -BACKGROUND_RINGS:]
    has_background = np.isfinite(outer).any(axis=1)
    background = np.full(len(profiles), np.nan)
    background[has_background] = np.nanmedian(outer[has_background], axis=1)
    light = profiles[:, :-BACKGROUND_RINGS] - background[:, None]
    usable = np.isfinite(light)
    brightness = np.where(usable.any(axis=1), 1.0, np.nan)
    if not (usable & is_detected[:, None]).any():
        return brightness
    filled = np.where(usable, light, 0.0)
    # Inverse variance of each ring, and in the loop `precision`: that of each frame's brightness.
    weight = usable / (BACKGROUND_NOISE ** 2 + (GLOW_NOISE * filled) ** 2)
    profile_weight = weight * is_detected[:, None]
    profile = np.full(light.shape[1], 0.1)
    precision = np.zeros(len(profiles))
    for _ in range(BRIGHTNESS_STEPS):
        gain = np.nan_to_num(brightness)[:, None]
        energy = np.maximum((profile_weight * gain * gain).sum(0), 1e-9)
        profile = np.maximum((profile_weight * gain * filled).sum(0) / energy, 0)
        precision = (weight * profile * profile).sum(1)
        with np.errstate(invalid="ignore", divide="ignore"):
            fitted = np.maximum((weight * filled * profile).sum(1), 0) / np.maximum(precision, 1e-9)
            brightness = np.where(usable.any(axis=1), fitted, np.nan)
        brightest = brightness[is_detected & np.isfinite(brightness)]
        brightness = brightness / max(float(np.quantile(brightest, 0.9)) if len(brightest) else 1.0, 1e-9)
    prior = np.where(is_detected, float(np.nanmedian(np.where(is_detected, brightness, np.nan))), 0.0)
    shrunk = (precision * np.minimum(brightness, 1.2) + prior / PRIOR ** 2) / (precision + 1 / PRIOR ** 2)
    return np.where(np.isfinite(brightness), np.clip(shrunk, 0, 1), np.nan)
