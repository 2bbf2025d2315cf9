# SPDX-License-Identifier: GPL-3.0-or-later
"""The deformation network: how the canonical flare changes with light and camera (paper, eq. 1 to 4).

delta_x = f_x(mu, c, l) for every parameter x of a Gaussian, delta_f on the plane, and delta_l(c, l), one correction of
the light's position for the whole view. One backbone of three hidden layers, one head for each parameter. The first
layer is split: the view's part is computed once, the Gaussians' part for each. `model.LightFlare` calls it.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..gaussians.kernels import fused_kernels
from ..look.network import BANDS, CAMERA_BITS, CAMERA_GROWTH, LIGHT_BITS, LIGHT_GROWTH
from .encoding import HashGrid, frequency_encoding

HIDDEN_WIDTH, HIDDEN_LAYERS = 128, 3
"""Width and number of the backbone's layers."""
RANGE_FACTOR = 1.5
"""Distance, relative to the frame's corners or to the nearest light, beyond which a light's flare is taken to be
constant: little of it is left there."""


@dataclass(frozen=True)
class QueryRange:
    """The range of the training views: the boxes that map the network's inputs to the unit cube.

    `camera_low`, `camera_high`: camera positions, world units. `light_high`: the largest |x|, |y| and norm of the
    light's offset from the principal point, normalised image coordinates.
    """

    camera_low: tuple[float, float, float]
    camera_high: tuple[float, float, float]
    light_high: tuple[float, float, float]

    @classmethod
    def of(cls, cameras: Tensor, lights: Tensor, reach: float = math.inf) -> QueryRange:
        """Return the range of training views: camera positions (v, 3), normalised light positions (v, 2).

        reach: distance of the frame's corners from the principal point, normalised. `light_high` is at most
        RANGE_FACTOR times this, or times the nearest light's distance if that is larger: a light that passes the
        camera's plane lies a hundred times as far away, and on a grid over all of this the frame would be a part of one
        cell. Boxes are 5 % larger than the range on each side.
        """
        low, high = cameras.amin(0), cameras.amax(0)
        # A camera that hardly moves along an axis must not have its noise stretched over the whole grid.
        margin = (high - low).max().clamp_min(1e-3) * 0.05
        nearest = float(lights.norm(dim=-1).min())
        light = light_input(lights).amax(0).clamp(max=RANGE_FACTOR * max(reach, nearest)) * 1.05 + 1e-3
        return cls(*(tuple(values.tolist()) for values in (low - margin, high + margin, light)))


def light_input(light: Tensor) -> Tensor:
    """Convert offsets (..., 2) of the light from the principal point to (..., 3): |x|, |y|, norm (paper, appendix).

    The absolute value folds the four quadrants into one, since a lens is symmetric about its axis.
    """
    return torch.cat([light.abs(), light.norm(dim=-1, keepdim=True)], -1)


class DeformationNetwork(nn.Module):
    """Offsets of `heads` (name: width) for n Gaussians, and delta_l, from one light and one camera.

    position_width: of the canonical position, 1 on the line, 2 for the free plane of mode `2d`. latent_width: of a code
    for each Gaussian, 0 in the paper's form. levels, base: number of levels and coarsest resolution of both hash grids.
    """

    camera_low: Tensor
    camera_extent: Tensor
    light_high: Tensor

    def __init__(self, heads: Mapping[str, int], query_range: QueryRange, *, position_width: int = 1,
                 latent_width: int = 0, levels: int = 16, base: int = 16) -> None:
        """Make grids, backbone and heads. heads: width of each parameter's offset, by the parameter's name."""
        super().__init__()
        self.light_grid = HashGrid(LIGHT_BITS, LIGHT_GROWTH, levels, base=base)
        self.camera_grid = HashGrid(CAMERA_BITS, CAMERA_GROWTH, levels, base=base)
        view_width = 2 * 2 * levels  # two grids of two features on each level
        # The two halves of the first layer add up, so one bias is enough.
        self.view_layer = nn.Linear(view_width, HIDDEN_WIDTH)
        self.gaussian_layer = nn.Linear(2 * BANDS * position_width + latent_width, HIDDEN_WIDTH, bias=False)
        self.layers = nn.ModuleList(nn.Linear(HIDDEN_WIDTH, HIDDEN_WIDTH) for _ in range(HIDDEN_LAYERS - 1))
        self.names, self.widths = list(heads), list(heads.values())
        # One matrix holds every head: the same function, one product instead of many.
        self.head = nn.Linear(HIDDEN_WIDTH, sum(self.widths))
        correction_head = nn.Linear(HIDDEN_WIDTH, 2)
        self.correction = nn.Sequential(nn.Linear(view_width, HIDDEN_WIDTH), nn.ReLU(), correction_head)
        # All offsets start at nothing: the first picture is the canonical flare.
        for layer in (self.head, correction_head):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.register_buffer("camera_low", torch.tensor(query_range.camera_low), persistent=False)
        extent = torch.tensor(query_range.camera_high) - torch.tensor(query_range.camera_low)
        self.register_buffer("camera_extent", extent, persistent=False)
        self.register_buffer("light_high", torch.tensor(query_range.light_high), persistent=False)

    def view_features(self, camera: Tensor, light: Tensor) -> Tensor:
        """Return features (4 * levels,) of a camera position (3,), world units, and a light (2,), normalised
        coordinates.

        They are the light's and the camera's hash grid, interpolated there.
        """
        # One scale for each axis; `QueryRange.of` makes every extent larger than 0.
        camera_input = (camera - self.camera_low) / self.camera_extent
        return torch.cat([self.light_grid(light_input(light) / self.light_high), self.camera_grid(camera_input)])

    def forward(self, positions: Tensor, latent: Tensor | None, features: Tensor) -> dict[str, Tensor]:
        """Return offsets by name, (n, width) each, for canonical positions (n, 1 or 2) and latent codes (n, d).

        features: of the view, from `view_features`.
        """
        return dict(zip(self.names, self.offsets(positions, latent, features).split(self.widths, -1), strict=True))

    def offsets(self, positions: Tensor, latent: Tensor | None, features: Tensor, *,
                kernels: Literal["auto", "torch"] = "auto") -> Tensor:
        """Return the offsets of all heads (n, sum of the widths), in their order; the inputs are those of `forward`.

        kernels: "torch" disables the fused CPU kernel."""
        view = self.view_layer(features)
        fused = fused_kernels(positions) if kernels == "auto" else None
        if fused is not None:
            layers = [(layer.weight, layer.bias) for layer in (*self.layers, self.head)]
            offsets = fused.deform(positions, latent, BANDS, view, self.gaussian_layer.weight, layers)
            if offsets is not None:
                return offsets
        encoded = frequency_encoding(positions, BANDS)
        if latent is not None:
            encoded = torch.cat([encoded, latent], -1)
        x = functional.relu(self.gaussian_layer(encoded) + view)
        for layer in self.layers:
            x = functional.relu(layer(x))
        return cast(Tensor, self.head(x))

    def light_correction(self, features: Tensor) -> Tensor:
        """Return delta_l (2,), the correction of the light's place (paper, eq. 4).

        In normalised coordinates divided by `LightFlare.scale`. features: of the view, from `view_features`.
        """
        return self.correction(features)
