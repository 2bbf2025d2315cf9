# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the Gaussians that may stand between a camera and a light; the definition is `core.flare.visibility`."""
from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from . import buffers
from .compilation import inlined, kernel
from .threads import parallel
from .tiles import flat
from .vector import (
    LANES,
    any_of,
    atomic_increment,
    deinterleave,
    exp,
    fma,
    lane_index,
    load,
    load_scalar,
    maximum,
    splat,
    sqrt,
    store,
    where,
)

ROWS_PER_TASK = 1 << 12
"""Gaussians that a thread tests at a time."""
REACH = np.float32(3)
"""Standard deviations up to which a Gaussian hides a light."""
ONE, ZERO = np.float32(1), np.float32(0)


@inlined
def _load_points(array, first):
    """Return x, y and z of 16 rows of an array (n, 3), flat, from row `first` on."""
    return deinterleave((load(array, 3 * first), load(array, 3 * first + LANES), load(array, 3 * first + 2 * LANES)))


@kernel
def find_occluders_kernel(counter, flags, means, log_scales, line, rows, counts):
    """Write the rows of Gaussians that may hide a light, in ascending order within each task, and their number by task.

    counter: index of the next task. flags: workspace of 16. means, log_scales: flat, (n, 3), n at least 16. line: rows
    of the pose, world to camera (12), then near and far depth, slope of the cone about the line, centre of the far
    sphere (3) and the squared distance from it beyond which a Gaussian hides nothing. rows (n,): those of a task begin
    at its first Gaussian. counts (tasks,).
    """
    n = means.size // 3
    while True:
        task = atomic_increment(counter)
        if task >= counts.size:
            break
        start, end, found = task * ROWS_PER_TASK, min((task + 1) * ROWS_PER_TASK, n), task * ROWS_PER_TASK
        for block in range(start, end, LANES):
            first = min(block, n - LANES)  # the last block overlaps the one before
            x, y, z = _load_points(means, first)
            depth = fma(x, line[8], fma(y, line[9], fma(z, line[10], splat(line[11]))))
            across = fma(x, line[0], fma(y, line[1], fma(z, line[2], splat(line[3]))))
            down = fma(x, line[4], fma(y, line[5], fma(z, line[6], splat(line[7]))))
            scale_x, scale_y, scale_z = _load_points(log_scales, first)
            reach = exp(maximum(maximum(scale_x, scale_y), scale_z)) * REACH
            off_axis = sqrt(fma(across, across, down * down))
            far_x, far_y, far_z = x - line[15], y - line[16], z - line[17]
            far = fma(far_x, far_x, fma(far_y, far_y, far_z * far_z))
            hides = where(off_axis < fma(depth, splat(line[14]), reach), splat(ONE), ZERO)
            hides = where(depth > line[12], hides, ZERO)
            hides = where(depth < line[13], hides, ZERO)
            hides = where(far <= line[18], hides, ZERO)
            hides = where(lane_index() >= np.float32(block - first), hides, ZERO)
            if any_of(hides > ZERO):
                store(flags, 0, hides)
                for lane in range(LANES):
                    if load_scalar(flags, lane) > ZERO:
                        rows[found] = first + lane
                        found += 1
        counts[task] = found - start


def find_occluders(means: Tensor, log_scales: Tensor, pose: Tensor, depths: tuple[float, float], slope: float,
                   centre: tuple[float, ...], max_distance: float) -> Tensor | None:
    """Return the ascending rows (m,) of Gaussians that may hide a light; None for fewer than 16 Gaussians.

    These are the ones between two depths whose distance from the line of sight is less than `slope` times their depth
    plus three of their largest standard deviations, and that lie no farther than max_distance from `centre`. means,
    log_scales: (n, 3), world units. pose: (4, 4), world to a camera that looks along the line.
    """
    n = len(means)
    if n < LANES:
        return None
    line = np.array([*pose[:3].flatten().tolist(), *depths, slope, *centre, max_distance**2], np.float32)
    rows, counts = buffers.empty(n, np.int64), np.empty(-(-n // ROWS_PER_TASK), np.int64)
    parallel(find_occluders_kernel, flat(means), flat(log_scales), line, rows, counts, scratch=LANES,
             limit=len(counts))
    parts = [rows[task * ROWS_PER_TASK:][:count] for task, count in enumerate(counts.tolist())]
    return torch.from_numpy(np.concatenate(parts))
