# SPDX-License-Identifier: GPL-3.0-or-later
"""Place and brightness of each light in each frame of a shot.

A light that moves has a place in each frame, and one that is dimmed, switched or hidden has a brightness in each frame.
Places are inputs of a fit; brightness is an unknown. A `FlareModel` without these has lights that stand and stay on.
`core.fit` makes and optimises them, and writes them as the lights.json of a run.
"""
from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class FrameLights(nn.Module):
    """Places and brightness of lights by frame.

    positions: (frames, lights, 3) world units. brightness: (frames, lights) relative to the usual one, 1 at first where
    `prior` is NaN; a sparse table, so that a step changes only the frames that its loss uses. prior: (frames, lights)
    brightness in the lights' file, NaN where it has none.
    """

    positions: Tensor
    prior: Tensor

    def __init__(self, frames: Sequence[str], positions: Tensor, prior: Tensor) -> None:
        """Start with the brightness of `prior`, 1 where it is NaN.

        frames: names of n frames, in the order of the shot. positions, prior: of the lights in each frame, in the same
        order: (n, lights, 3), world units, and brightness (n, lights).
        """
        super().__init__()
        self.rows = {name: row for row, name in enumerate(frames)}
        """Row of each frame, by its name, in the order of the shot."""
        self.register_buffer("positions", positions.double())
        self.register_buffer("prior", prior.float())
        self.brightness = nn.Embedding(prior.shape[0], prior.shape[1], sparse=True)
        with torch.no_grad():
            self.brightness.weight.copy_(prior.nan_to_num(1.0))

    def _index(self, rows: int | list[int]) -> Tensor:
        """Return row numbers as an index of the brightness, on its device."""
        return torch.tensor(rows, device=self.brightness.weight.device)

    def brightness_in(self, frame: str) -> Tensor | None:
        """Return the brightness (lights,) of a frame, 0 or more; None for a frame that is not listed."""
        row = self.rows.get(frame)
        values: Tensor | None = None if row is None else self.brightness(self._index(row)).clamp_min(0)
        return values

    def positions_in(self, frame: str) -> Tensor | None:
        """Return the places (lights, 3) in a frame; None for a frame that is not listed."""
        row = self.rows.get(frame)
        return None if row is None else self.positions[row]

    def roughness(self, frame: str) -> Tensor:
        """Return the total variation at a frame: the sum of |change of brightness| from the frame before it and to the
        one after it.

        Absolute values allow steps, such as of a switch, and smooth the brightness where frames do not determine it.
        """
        row, last = self.rows[frame], len(self.rows) - 1
        values = self.brightness(self._index([max(row - 1, 0), row, min(row + 1, last)]))
        total: Tensor = values.diff(dim=0).abs().sum()
        return total

    def deviation(self, frame: str) -> Tensor:
        """Return the sum of squared differences of a frame's brightness from that in the lights' file."""
        row = self.rows[frame]
        prior = self.prior[row].to(self.brightness.weight.device)
        difference: Tensor = self.brightness(self._index(row)) - prior.nan_to_num(0)
        return difference.square()[prior.isfinite()].sum()
