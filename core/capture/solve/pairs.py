# SPDX-License-Identifier: GPL-3.0-or-later
"""Which frames to match with which.

Small sets: all with all. Videos: neighbours, near and at doubling distances. Both videos and large folders
also get the frames that look most alike by VLAD (Jegou et al. 2010: residuals of SIFT descriptors to a
small vocabulary, summed), which closes loops without a vocabulary file from elsewhere.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...choices import Matching

SMALL = 60    # frames; all pairs of as many are matched in two minutes on two cores
OVERLAP = 8   # neighbours of a video frame matched one by one; beyond them distances double
WORDS = 64    # of the vocabulary of descriptors


def choose_matching(matching: Matching, frames: int, video: bool) -> Matching:
    """What "auto" stands for."""
    if matching != "auto":
        return matching
    if video:
        return "sequential"
    return "exhaustive" if frames <= SMALL else "similar"


def choose_pairs(matching: Matching, frames: int, descriptors: Callable[[int], NDArray[np.uint8]],
                 seed: int = 0) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of frame numbers.

    `descriptors(i)` gives the SIFT descriptors (n, 128) of a frame; asked for only where needed.
    """
    if matching == "exhaustive":
        pairs = {(i, j) for i in range(frames) for j in range(i + 1, frames)}
    else:
        steps = {*range(1, OVERLAP + 1), *(2 ** k for k in range(4, 7))} if matching == "sequential" else {1, 2}
        pairs = {(i, i + step) for i in range(frames) for step in steps if i + step < frames}
        if frames > 2 * OVERLAP:
            alike = similarity(descriptors, frames, seed)
            number, apart = (5, 2 * OVERLAP) if matching == "sequential" else (24, 1)
            pairs |= most_alike(alike, number, apart)
    # By blocks: a batch of pairs then names few frames, and the matcher indexes each once.
    return sorted(pairs, key=lambda pair: (pair[0] // 12, pair[1] // 12, pair))


def most_alike(alike: NDArray[Any], number: int, apart: int) -> set[tuple[int, int]]:
    """For each frame the `number` most alike frames at least `apart` away."""
    frames = len(alike)
    away = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames))) >= apart
    ranked = np.argsort(-np.where(away, alike, -np.inf), axis=1)[:, :number]
    return {(min(i, int(j)), max(i, int(j))) for i in range(frames) for j in ranked[i] if away[i, j]}


def similarity(descriptors: Callable[[int], NDArray[np.uint8]], frames: int, seed: int = 0) -> NDArray[np.float32]:
    """(frames, frames) cosine of the frames' VLAD vectors."""
    rng = np.random.default_rng(seed)
    sample = np.concatenate([_some(descriptors(i), 200, rng) for i in range(frames)]).astype(np.float32)
    if len(sample) < WORDS:
        return np.eye(frames, dtype=np.float32)
    vocabulary = _k_means(_some(sample, 12000, rng), WORDS, rng)
    vectors = np.zeros((frames, WORDS * sample.shape[1]), np.float32)
    for i in range(frames):
        some = _some(descriptors(i), 2000, rng).astype(np.float32)
        if not len(some):
            continue
        nearest = _nearest(some, vocabulary)
        summed = _sums(some - vocabulary[nearest], nearest, WORDS)
        summed /= np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-9)
        vectors[i] = summed.ravel() / max(float(np.linalg.norm(summed)), 1e-9)
    return np.asarray(vectors @ vectors.T)


def _some(rows: NDArray[Any], number: int, rng: np.random.Generator) -> NDArray[Any]:
    return rows if len(rows) <= number else rows[rng.choice(len(rows), number, replace=False)]


def _nearest(rows: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.intp]:
    return np.argmax(rows @ centres.T - 0.5 * (centres ** 2).sum(axis=1), axis=1)


def _sums(rows: NDArray[np.float32], group: NDArray[np.intp], groups: int) -> NDArray[np.float32]:
    """The rows of each group, added up."""
    return np.asarray((np.arange(groups)[:, None] == group).astype(np.float32) @ rows)


def _k_means(rows: NDArray[np.float32], words: int, rng: np.random.Generator) -> NDArray[np.float32]:
    centres = _some(rows, words, rng).copy()
    for _ in range(12):
        nearest = _nearest(rows, centres)
        count = np.bincount(nearest, minlength=words)[:, None]
        centres = np.where(count > 0, _sums(rows, nearest, words) / np.maximum(count, 1), centres)
    return np.asarray(centres, np.float32)
