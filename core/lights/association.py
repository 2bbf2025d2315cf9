# SPDX-License-Identifier: GPL-3.0-or-later
"""Follows the sources of consecutive frames: which source of a frame is which of the frames before.

A track predicts its next place by its velocity. The pair of track and source with the smallest cost is joined first;
the cost is the distance from the prediction, with the change of size and colour. A track that loses its source waits,
with a tolerance that grows as far as its own acceleration lets it go. Tracks that ended and tracks that began later are
then joined where extrapolations of both meet. `tracks.py` calls it.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..capture.camera import Floats
from .sources import Source

BASE_GATE, SPEED_GATE, FIRST_GATE = 0.032, 0.4, 0.15
"""Tolerance of a prediction: share of the diagonal, plus share of the speed; and that of a track of one frame."""
MAX_REACH = 0.35
"""Distance of a prediction, diagonals, beyond which no source is compared."""
FAINT_FIRST_GATE = 0.03
"""Tolerance of a track of one frame for a source that hardly looks like a lamp."""
MIN_ACCELERATION, MAX_ACCELERATION = 0.003, 0.03
"""Bounds of a track's acceleration, diagonals per frame²."""
UNLIKELY_GATE = 0.4
"""Factor on the tolerance where one of track and source looks like a lamp and the other hardly does."""
MAX_WAIT, MAX_GAP = 2, 24
"""Number of frames without a source after which a track still waits for the next one, and the largest gap, frames,
over which two tracks are joined."""
MAX_GROWTH = 1.3
"""Largest ratio of a source's radius to that of the lamp before it, where the source hardly looks like a lamp."""
SINGLE_COST = 0.2
"""Cost of joining a chain of one source, which predicts its place without a velocity."""
SIZE_COST, COLOUR_COST, EVIDENCE_COST, GAP_COST = 0.4, 0.3, 0.5, 0.06
"""Weights of the change of size (logarithm), colour and evidence, and of a frame without a source, beside distance over
gate."""
TYPICAL = 9
"""Number of sources at the end of a track whose median size is compared."""
DISTANCE_SCALE = 0.1
"""Distance, diagonals, that costs as much as the whole gate when tracks are joined: gates of fast lights are wide."""
JOIN_DISTANCE, JOIN_SPEED = 0.08, 0.75
"""Largest distance of the places that two joined tracks predict in the middle of the gap: diagonals, plus a share of
the way through the gap at the largest of the speeds next to the gap and the median speeds of both tracks."""
MAX_SINGLE_GAP = 6
"""Largest gap, frames, to a track of one frame."""
MAX_DIFFERENCE = 1.0
"""Largest sum of the weighted changes of size, colour and evidence."""
LIKELY = 0.25
"""Evidence from which a source looks like a lamp."""


@dataclass(eq=False)
class Chain:
    """The sources of one thing by frame index, in order."""

    frames: list[int] = field(default_factory=list)
    sources: list[Source] = field(default_factory=list)

    def append(self, frame: int, source: Source) -> None:
        """Add the source of a later frame."""
        self.frames.append(frame)
        self.sources.append(source)

    @property
    def places(self) -> Floats:
        """(n, 2) pixels."""
        return np.array([source.xy for source in self.sources])

    @property
    def evidence(self) -> float:
        """The 70th percentile of the sources' evidence: ghosts that cross a lamp spoil some frames."""
        return float(np.quantile([source.evidence for source in self.sources], 0.7))

    def velocity(self, at_end: bool) -> Floats:
        """Return (2,) pixels per frame, at the last frame if `at_end`, else at the first one; 0 for a single frame."""
        if len(self.frames) < 2:
            return np.zeros(2)
        later, earlier = (-1, -2) if at_end else (1, 0)
        step = self.frames[later] - self.frames[earlier]
        places = self.places
        return np.asarray((places[later] - places[earlier]) / step)

    def median_speed(self) -> float:
        """Return the median speed, pixels per frame; 0 for a single frame."""
        if len(self.frames) < 2:
            return 0.0
        return float(np.median(np.linalg.norm(self._velocities(), axis=1)))

    def _velocities(self) -> Floats:
        """Return (n - 1, 2) pixels per frame, from each source to the next."""
        return np.asarray(np.diff(self.places, axis=0) / np.diff(self.frames)[:, None])

    def predict(self, frame: int) -> Floats:
        """Return the place (2,) in a frame after the chain's last or before its first one, at constant velocity."""
        at_end = frame >= self.frames[-1]
        start = self.frames[-1] if at_end else self.frames[0]
        return np.asarray(self.places[-1 if at_end else 0] + (frame - start) * self.velocity(at_end))

    def acceleration(self, diagonal: float) -> float:
        """Return a high estimate of the acceleration, pixels per frame²: 1.5 times the 80th percentile of the changes
        of velocity.

        The result is clipped to MIN_ACCELERATION and MAX_ACCELERATION; for fewer than three frames it is the former.
        diagonal: length of the frames' diagonal, pixels.
        """
        frames = np.array(self.frames)
        low, high = MIN_ACCELERATION * diagonal, MAX_ACCELERATION * diagonal
        if len(frames) < 3:
            return low
        changes = np.linalg.norm(np.diff(self._velocities(), axis=0), axis=1) / (0.5 * (frames[2:] - frames[:-2]))
        return float(np.clip(1.5 * np.quantile(changes, 0.8), low, high))


def follow_sources(sources: Sequence[Sequence[Source]], diagonal: float) -> list[Chain]:
    """Return the chains of the sources of consecutive frames, the longest first.

    In each frame chains and sources are paired greedily, the pair with the smallest cost first. sources: those of each
    frame. diagonal: length of the frames' diagonal, pixels.
    """
    open_chains: list[Chain] = []
    closed: list[Chain] = []
    for frame, frame_sources in enumerate(sources):
        pairs = sorted((cost, chain_index, source_index) for chain_index, chain in enumerate(open_chains)
                       for source_index, source in enumerate(frame_sources)
                       if (cost := _link_cost(chain, frame, source, diagonal)) is not None)
        used_chains: set[int] = set()
        used_sources: set[int] = set()
        for _, chain_index, source_index in pairs:
            if chain_index not in used_chains and source_index not in used_sources:
                used_chains.add(chain_index)
                used_sources.add(source_index)
                open_chains[chain_index].append(frame, frame_sources[source_index])
        closed += [chain for chain in open_chains if frame - chain.frames[-1] > _patience(chain)]
        open_chains = [chain for chain in open_chains if frame - chain.frames[-1] <= _patience(chain)]
        open_chains += [Chain([frame], [source]) for source_index, source in enumerate(frame_sources)
                        if source_index not in used_sources]
    return _join_chains(closed + open_chains, diagonal)


def _patience(chain: Chain) -> int:
    """Return the number of frames that a chain waits for its source; longer gaps are closed by `_join_chains`."""
    return MAX_WAIT if chain.evidence >= LIKELY else 1


def _link_cost(chain: Chain, frame: int, source: Source, diagonal: float) -> float | None:
    """Return the cost of joining a chain to a source of a later frame; None beyond the gate.

    The gate is the largest distance, pixels, of a source from the predicted place. diagonal: length of the frames'
    diagonal, pixels.
    """
    gap = frame - chain.frames[-1]
    last = chain.sources[-1]
    distance = float(np.linalg.norm(chain.predict(frame) - source.xy))
    if distance > MAX_REACH * diagonal:
        return None
    if len(chain.frames) < 2:
        likely = min(last.evidence, source.evidence) >= LIKELY
        gate = (FIRST_GATE if likely else FAINT_FIRST_GATE) * diagonal * gap
    else:
        speed = float(np.linalg.norm(chain.velocity(at_end=True)))
        previous_gap = chain.frames[-1] - chain.frames[-2]
        # Acceleration adds to the gate where frames are missing, in this gap or in the one that gave the velocity.
        gate = (BASE_GATE * diagonal + SPEED_GATE * speed
                + 0.5 * chain.acceleration(diagonal) * (gap * gap - 1 + (previous_gap - 1) * gap))
    if chain.evidence >= LIKELY > source.evidence:
        # A lamp that something begins to hide looks less like one: such a source counts only in the very next frame,
        # near the predicted place, and if it has not grown.
        if gap > 1 or source.detection.radius > MAX_GROWTH * last.detection.radius:
            return None
        gate *= UNLIKELY_GATE
    elif source.evidence >= LIKELY > chain.evidence:
        gate *= UNLIKELY_GATE
    difference = _appearance_difference(last, source)
    if distance > gate or difference > MAX_DIFFERENCE:
        return None
    return distance / gate + difference + GAP_COST * (gap - 1) + SINGLE_COST * (len(chain.frames) < 2)


def _appearance_difference(first: Source, second: Source) -> float:
    """Return the weighted differences of two sources in size, colour and evidence; size does not count if the frame's
    edge cuts either."""
    first_detection, second_detection = first.detection, second.detection
    is_cut = first_detection.is_cut or second_detection.is_cut
    size = 0.0 if is_cut else abs(float(np.log(first_detection.radius / second_detection.radius)))
    return (SIZE_COST * size + COLOUR_COST * float(np.abs(first_detection.colour - second_detection.colour).mean())
            + EVIDENCE_COST * abs(first.evidence - second.evidence))


def _join_chains(chains: list[Chain], diagonal: float) -> list[Chain]:
    """Join chains where one ends before another begins and both extrapolations meet, the best pair first.

    Only chains that look like lamps are joined; joined chains may be joined again. Returns all chains, the longest
    first. diagonal: length of the frames' diagonal, pixels.
    """
    likely = {number: chain for number, chain in enumerate(chains) if chain.evidence >= LIKELY}
    others = [chain for number, chain in enumerate(chains) if number not in likely]
    costs = {(i, j): cost for i, first in likely.items() for j, second in likely.items()
             if i != j and (cost := _join_cost(first, second, diagonal)) is not None}
    next_number = len(chains)  # number of the next joined chain
    while costs:
        i, j = min(costs, key=lambda pair: (costs[pair], pair))
        first, second = likely.pop(i), likely.pop(j)
        joined = Chain(first.frames + second.frames, first.sources + second.sources)
        costs = {pair: cost for pair, cost in costs.items() if i not in pair and j not in pair}
        for number, chain in likely.items():
            for pair, ends in (((next_number, number), (joined, chain)), ((number, next_number), (chain, joined))):
                if (cost := _join_cost(*ends, diagonal)) is not None:
                    costs[pair] = cost
        likely[next_number] = joined
        next_number += 1
    return sorted([*likely.values(), *others], key=lambda chain: -len(chain.frames))


def _join_cost(first: Chain, second: Chain, diagonal: float) -> float | None:
    """Return the cost of taking two chains for one thing; None where that cannot be.

    `first` must end before `second` begins; both are extrapolated to the middle of the gap, where they must meet.
    diagonal: length of the frames' diagonal, pixels.
    """
    gap = second.frames[0] - first.frames[-1]
    if not 0 < gap <= MAX_GAP:
        return None
    is_single = 1 in (len(first.frames), len(second.frames))
    # A single frame joins only a chain of three or more, which has a velocity and an acceleration.
    if is_single and (gap > MAX_SINGLE_GAP or len(first.frames) + len(second.frames) < 4):
        return None
    acceleration = max(first.acceleration(diagonal), second.acceleration(diagonal))
    # Each half of the gap may miss acceleration * gap² / 8; a third leaves some room.
    gate = BASE_GATE * diagonal + acceleration * gap * gap / 3
    speeds = [float(np.linalg.norm(chain.velocity(at_end))) for chain, at_end in ((first, True), (second, False))]
    if is_single:  # a single frame has no velocity; it may have the other's
        gate += 0.5 * gap * max(speeds)
    speed = max(*speeds, first.median_speed(), second.median_speed())
    gate = min(gate, JOIN_DISTANCE * diagonal + JOIN_SPEED * gap * speed)
    # Each is extrapolated over half the gap: the velocities need not agree, only the places in its middle.
    middle = first.frames[-1] + gap / 2
    middle_by_first = first.places[-1] + first.velocity(at_end=True) * (middle - first.frames[-1])
    middle_by_second = second.places[0] - second.velocity(at_end=False) * (second.frames[0] - middle)
    distance = float(np.linalg.norm(middle_by_first - middle_by_second))
    difference = _appearance_difference(_typical_source(first, at_end=True), _typical_source(second, at_end=False))
    if distance > gate or difference > MAX_DIFFERENCE:
        return None
    return distance / gate + distance / (DISTANCE_SCALE * diagonal) + difference + GAP_COST * gap


def _typical_source(chain: Chain, at_end: bool) -> Source:
    """Return the source of median size among the last TYPICAL of a chain if `at_end`, else the first: the very last may
    be half hidden."""
    near = chain.sources[-TYPICAL:] if at_end else chain.sources[:TYPICAL]
    return sorted(near, key=lambda source: source.detection.radius)[len(near) // 2]
