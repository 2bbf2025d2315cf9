# SPDX-License-Identifier: GPL-3.0-or-later
"""3DGS with a bilateral grid for each frame: the paper's other baseline for a scene behind flares; used by `ablations`.

Each training frame has a small grid over x, y and luma of affine colour transforms, which models the differences of
that frame from the others (Wang et al. 2024, "Bilateral Guided Radiance Field Processing"): rendered colours pass
through it before they are compared with the frame. A held-out view has no grid and is scored as rendered.
"""
from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import Parameter, functional

from core.capture import Capture, View
from core.fit.frames import Targets
from core.fit.settings import FitSettings
from core.fit.trainer import Trainer

ACROSS, DOWN, LUMAS = 16, 16, 8
"""Cells of a grid along x, y and luma."""
LEARNING_RATE, TOTAL_VARIATION_WEIGHT = 2e-3, 10.0
"""The authors' choices of Adam's learning rate, which falls to a hundredth, and the weight of the total variation."""
LUMA = (0.299, 0.587, 0.114)


class BilateralGrids(torch.nn.Module):
    """A grid (12, lumas, down, across) of 3x4 affine transforms for each of `views` frames, initially the identity."""

    def __init__(self, views: int) -> None:
        super().__init__()
        identity = torch.eye(3, 4).reshape(12, 1, 1, 1).expand(12, LUMAS, DOWN, ACROSS)
        self.cells = torch.nn.ParameterList(Parameter(identity.clone()) for _ in range(views))

    def forward(self, index: int, picture: Tensor) -> Tensor:
        """Return the picture (h, w, 3), display values, with the transforms of frame `index` applied.

        Each pixel has a transform of its own, interpolated from the grid at its x, y and luma. Gradients do not pass
        through the luma.
        """
        height, width, _ = picture.shape
        y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        luma = (picture.detach() @ picture.new_tensor(LUMA)).clamp(0, 1) * 2 - 1
        coordinates = torch.stack([x, y, luma], -1)[None, None]
        affine = functional.grid_sample(
            self.cells[index][None], coordinates, align_corners=True, padding_mode="border"
        )
        affine = affine[0, :, 0].permute(1, 2, 0).reshape(height, width, 3, 4)
        return (affine[..., :3] @ picture[..., None])[..., 0] + affine[..., 3]

    def total_variation(self, index: int) -> Tensor:
        """Return the total variation of one frame's grid: mean squared differences along luma, y and x."""
        cells = self.cells[index]
        return torch.stack([cells.diff(dim=axis).square().mean() for axis in (1, 2, 3)]).sum()


class BilateralTrainer(Trainer):
    """A trainer of the scene alone (mode 3dgs), with a grid for each frame."""

    def __init__(self, capture: Capture, settings: FitSettings) -> None:
        super().__init__(capture, settings)
        self.grids = BilateralGrids(len(self.views))
        self.grid_optimiser = torch.optim.Adam(self.grids.parameters(), lr=LEARNING_RATE, eps=1e-15)
        self.schedule = torch.optim.lr_scheduler.ExponentialLR(self.grid_optimiser, 0.01 ** (1 / settings.iterations))

    def step(self) -> dict[str, float]:
        """Make one iteration on the next view, with a step of its grid and the penalty of its total variation."""
        figures = super().step()
        index = self._view_index(self._pick_view())
        (TOTAL_VARIATION_WEIGHT * self.grids.total_variation(index)).backward()
        self.grid_optimiser.step()
        self.grid_optimiser.zero_grad()
        self.schedule.step()
        return figures

    def _flare_background(self, targets: Targets,  # noqa: ARG002 - the base class calls it with it
                          scene: Tensor) -> Tensor:
        """Return the scene through the grid of its view, which the trainer compares with the frame."""
        return self.grids(self._view_index(self._pick_view()), scene)

    def _view_index(self, view: View) -> int:
        views: Sequence[View] = self.views
        return views.index(view)
