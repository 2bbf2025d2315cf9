# SPDX-License-Identifier: GPL-3.0-or-later
"""3DGS with a bilateral grid for each frame: the paper's other baseline for a scene behind flares.

Each training frame has a small grid over x, y and luma of affine colour transforms, which takes up what differs
between that frame and the others (Wang et al. 2024, "Bilateral Guided Radiance Field Processing"): rendered colours
are passed through it before they are compared with the frame. A held-out view has none: it is judged as rendered.
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
RATE, SMOOTHNESS = 2e-3, 10.0
"""Adam's rate, falling to a hundredth, and the weight of the total variation: the authors' choices."""
LUMA = (0.299, 0.587, 0.114)


class Grids(torch.nn.Module):
    """A grid (12, lumas, down, across) of 3x4 affine transforms for each of `views` frames, the identity at first."""

    def __init__(self, views: int) -> None:
        super().__init__()
        identity = torch.eye(3, 4).reshape(12, 1, 1, 1).expand(12, LUMAS, DOWN, ACROSS)
        self.cells = torch.nn.ParameterList(Parameter(identity.clone()) for _ in range(views))

    def forward(self, number: int, picture: Tensor) -> Tensor:
        """The picture (h, w, 3), display values, under the transforms of frame `number`."""
        height, width, _ = picture.shape
        y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        luma = (picture.detach() @ picture.new_tensor(LUMA)).clamp(0, 1) * 2 - 1
        where = torch.stack([x, y, luma], -1)[None, None]
        affine = functional.grid_sample(self.cells[number][None], where, align_corners=True, padding_mode="border")
        affine = affine[0, :, 0].permute(1, 2, 0).reshape(height, width, 3, 4)
        return (affine[..., :3] @ picture[..., None])[..., 0] + affine[..., 3]

    def roughness(self, number: int) -> Tensor:
        """Total variation of one frame's grid: mean squared differences along luma, y and x."""
        cells = self.cells[number]
        return torch.stack([cells.diff(dim=axis).square().mean() for axis in (1, 2, 3)]).sum()


class GradedScene(Trainer):
    """A fit of the scene alone (mode 3dgs), each frame with its grid."""

    def __init__(self, capture: Capture, settings: FitSettings) -> None:
        super().__init__(capture, settings)
        self.grids = Grids(len(self.views))
        self.graded = torch.optim.Adam(self.grids.parameters(), lr=RATE, eps=1e-15)
        self.falling = torch.optim.lr_scheduler.ExponentialLR(self.graded, 0.01 ** (1 / settings.iterations))

    def step(self) -> dict[str, float]:
        """One iteration on the next view, with the grid's own loss and step."""
        figures = super().step()
        number = self._number(self._view())
        (SMOOTHNESS * self.grids.roughness(number)).backward()
        self.graded.step()
        self.graded.zero_grad()
        self.falling.step()
        return figures

    def _behind_flare(self, targets: Targets, scene: Tensor,  # noqa: ARG002 - the trainer's own door
                      sources: Tensor | None) -> Tensor:  # noqa: ARG002
        return self.grids(self._number(self._view()), scene)

    def _number(self, view: View) -> int:
        views: Sequence[View] = self.views
        return views.index(view)
