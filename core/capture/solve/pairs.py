# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses which frames to match with which.

Small sets: all pairs. Videos: neighbours, near and at doubling distances. Videos and large folders also get the most
similar frames by VLAD (Jegou et al. 2010: residuals of SIFT descriptors to a small vocabulary, summed), which closes
loops without an external vocabulary file.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...choices import Matching

MAX_EXHAUSTIVE = 60
"""Number of frames up to which all pairs are matched: two minutes on two cores."""
SEQUENCE_OVERLAP = 8
"""Number of neighbours matched with each frame of a video; beyond them distances double."""
VOCABULARY_SIZE = 64
"""Words of the vocabulary of descriptors."""
MAX_DESCRIPTORS = 2000
"""Descriptors of a frame that its VLAD vector sums."""
FRAME_SAMPLE, VOCABULARY_SAMPLE = 200, 12000
"""Descriptors of a frame, and of all frames, from which the vocabulary is learned."""
K_MEANS_ROUNDS = 12


def choose_matching(matching: Matching, frames: int, video: bool) -> Matching:
    """Return how to match that many frames; resolves "auto". video: they are of a video."""
    if matching != "auto":
        return matching
    if video:
        return "sequential"
    return "exhaustive" if frames <= MAX_EXHAUSTIVE else "similar"


def choose_pairs(matching: Matching, frames: int, descriptors: Callable[[int], NDArray[np.uint8]],
                 seed: int = 0) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of frame indices below `frames`, in an order that is fast to match.

    "sequential" pairs each frame with its neighbours and, to close loops, with the 5 most similar frames farther away.
    "similar" pairs each frame with the 24 most similar frames, and with the next two, since many folders are in the
    order of filming. `descriptors(i)` gives the SIFT descriptors (n, 128) of a frame; called only where needed.
    """
    if matching == "exhaustive":
        pairs = {(i, j) for i in range(frames) for j in range(i + 1, frames)}
    else:
        neighbours = {*range(1, SEQUENCE_OVERLAP + 1), *(2 ** k for k in range(4, 7))}  # 1 to 8, 16, 32, 64
        steps = neighbours if matching == "sequential" else {1, 2}
        pairs = {(i, i + step) for i in range(frames) for step in steps if i + step < frames}
        if frames > 2 * SEQUENCE_OVERLAP:
            number, min_distance = (5, 2 * SEQUENCE_OVERLAP) if matching == "sequential" else (24, 1)
            pairs |= most_similar_pairs(vlad_similarity(descriptors, frames, seed), number, min_distance)
    # By blocks of 12 x 12 frames: a batch of pairs then names few frames, and the matcher indexes each once.
    return sorted(pairs, key=lambda pair: (pair[0] // 12, pair[1] // 12, pair))


def most_similar_pairs(similarity: NDArray[Any], number: int, min_distance: int) -> set[tuple[int, int]]:
    """Pair each frame with the `number` most similar frames at least `min_distance` away."""
    frames = len(similarity)
    is_far = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames))) >= min_distance
    ranked = np.argsort(-np.where(is_far, similarity, -np.inf), axis=1)[:, :number]
    return {(min(i, int(j)), max(i, int(j))) for i in range(frames) for j in ranked[i] if is_far[i, j]}


def vlad_similarity(descriptors: Callable[[int], NDArray[np.uint8]], frames: int, seed: int = 0) -> NDArray[np.float32]:
    """Return (frames, frames) cosines between the VLAD vectors of the frames (Jegou et al. 2010).

    descriptors: returns those of a frame, (n, d), by its index. The vocabulary is learned from a sample of all
    descriptors. A frame without descriptors is similar to none. With too few descriptors for a vocabulary, each frame
    is similar to itself alone.
    """
    rng = np.random.default_rng(seed)
    frame_samples = [_random_rows(descriptors(i), FRAME_SAMPLE, rng) for i in range(frames)]
    samples = np.concatenate(frame_samples).astype(np.float32)
    if len(samples) < VOCABULARY_SIZE:
        return np.eye(frames, dtype=np.float32)
    vocabulary = _k_means(_random_rows(samples, VOCABULARY_SAMPLE, rng), VOCABULARY_SIZE, rng)
    vectors = np.zeros((frames, VOCABULARY_SIZE * samples.shape[1]), np.float32)
    for i in range(frames):
        frame_rows = _random_rows(descriptors(i), MAX_DESCRIPTORS, rng).astype(np.float32)
        if not len(frame_rows):
            continue
        nearest = _nearest_centre(frame_rows, vocabulary)
        residuals = _sum_by_group(frame_rows - vocabulary[nearest], nearest, VOCABULARY_SIZE)
        # Each word of the vocabulary counts alike, so that a repeated texture does not outweigh the rest.
        residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-9)
        vectors[i] = residuals.ravel() / max(float(np.linalg.norm(residuals)), 1e-9)
    return np.asarray(vectors @ vectors.T)


def _random_rows(rows: NDArray[Any], number: int, rng: np.random.Generator) -> NDArray[Any]:
    return rows if len(rows) <= number else rows[rng.choice(len(rows), number, replace=False)]


def _nearest_centre(rows: NDArray[np.float32], centres: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return (n,), the index of the centre nearest to each row: |r - c|² without |r|², times -1/2."""
    return np.argmax(rows @ centres.T - 0.5 * (centres ** 2).sum(axis=1), axis=1)


def _sum_by_group(rows: NDArray[np.float32], group: NDArray[np.intp], groups: int) -> NDArray[np.float32]:
    """Sum the rows of each group."""
    return np.asarray((np.arange(groups)[:, None] == group).astype(np.float32) @ rows)


def _k_means(rows: NDArray[np.float32], number: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return centres (number, d) of rows (n, d) by Lloyd's algorithm; a centre without rows stays in place."""
    centres = _random_rows(rows, number, rng).copy()
    for _ in range(K_MEANS_ROUNDS):
        nearest = _nearest_centre(rows, centres)
        count = np.bincount(nearest, minlength=number)[:, None]
        centres = np.where(count > 0, _sum_by_group(rows, nearest, number) / np.maximum(count, 1), centres)
    return np.asarray(centres, np.float32)
