# SPDX-License-Identifier: GPL-3.0-or-later
"""The deformation network: how the canonical flare changes with light and camera (paper, eq. 1 to 4).

delta_x = f_x(mu, c, l) for every parameter x of a Gaussian, delta_f on the plane, and delta_l(c, l), one
correction of the light's position for the whole view. One backbone of three hidden layers, one head for
each parameter. The first layer is split: the view's share is computed once, the Gaussians' apart.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..look.network import BANDS, CAMERA_BITS, CAMERA_GROWTH, LIGHT_BITS, LIGHT_GROWTH
from .encoding import HashGrid, frequency_encoding

WIDTH, HIDDEN = 128, 3
"""Of the backbone: width of its layers, and how many there are."""
BESIDE = 1.5
"""Times as far out as the frame's corners, or as a light comes nearest, from where on its flare is taken to change no
more: what is left of one there is little."""


@dataclass(frozen=True)
class QueryRange:
    """What the network was trained on: the boxes that map its inputs on to the unit cube.

    `camera_low`, `camera_high`: camera positions, world units. `light_high`: the largest |x|, |y| and
    norm of the light's offset from the principal point, normalised image coordinates.
    """

    camera_low: tuple[float, float, float]
    camera_high: tuple[float, float, float]
    light_high: tuple[float, float, float]

    @classmethod
    def of(cls, cameras: Tensor, lights: Tensor, reach: float = math.inf) -> QueryRange:
        """The range of training views: camera positions (v, 3), normalised light positions (v, 2).

        reach: of the frame from the principal point, normalised. A light that passes the camera's plane comes to lie
        at a hundred of these; the grid over all of that would leave the frame itself a part of one cell.
        """
        low, high = cameras.amin(0), cameras.amax(0)
        # A camera that hardly moves along an axis must not have its noise stretched over the whole grid.
        margin = (high - low).max().clamp_min(1e-3) * 0.05
        nearest = float(lights.norm(dim=-1).min())
        light = light_input(lights).amax(0).clamp(max=BESIDE * max(reach, nearest)) * 1.05 + 1e-3
        return cls(*(tuple(values.tolist()) for values in (low - margin, high + margin, light)))


def light_input(light: Tensor) -> Tensor:
    """(…, 2) offsets of the light from the principal point to (…, 3): |x|, |y|, norm (paper, appendix).

    The absolute value folds the four quadrants on to one, since a lens is symmetric about its axis.
    """
    return torch.cat([light.abs(), light.norm(dim=-1, keepdim=True)], -1)


class DeformationNetwork(nn.Module):
    """Offsets of `heads` (name: width) for n Gaussians, and delta_l, from one light and one camera.

    `positions` is the width of the canonical position (1 on the line, 2 for the free plane of mode `2d`);
    `latent` the width of a per-Gaussian code, 0 in the paper's form.
    """

    camera_low: Tensor
    camera_extent: Tensor
    light_high: Tensor

    def __init__(self, heads: Mapping[str, int], query_range: QueryRange, *, positions: int = 1, latent: int = 0,
                 levels: int = 16, base: int = 16) -> None:
        super().__init__()
        self.light_grid = HashGrid(LIGHT_BITS, LIGHT_GROWTH, levels, base=base)
        self.camera_grid = HashGrid(CAMERA_BITS, CAMERA_GROWTH, levels, base=base)
        view = 2 * 2 * levels
        self.view_layer = nn.Linear(view, WIDTH)
        self.gaussian_layer = nn.Linear(2 * BANDS * positions + latent, WIDTH, bias=False)
        self.layers = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(HIDDEN - 1))
        self.names, self.widths = list(heads), list(heads.values())
        # One matrix holds every head: the same function, one product instead of many.
        self.head = nn.Linear(WIDTH, sum(self.widths))
        shift = nn.Linear(WIDTH, 2)
        self.correction = nn.Sequential(nn.Linear(view, WIDTH), nn.ReLU(), shift)
        # All offsets start at nothing: the first picture is the canonical flare.
        for layer in (self.head, shift):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.register_buffer("camera_low", torch.tensor(query_range.camera_low), persistent=False)
        extent = torch.tensor(query_range.camera_high) - torch.tensor(query_range.camera_low)
        self.register_buffer("camera_extent", extent, persistent=False)
        self.register_buffer("light_high", torch.tensor(query_range.light_high), persistent=False)

    def view_features(self, camera: Tensor, light: Tensor) -> Tensor:
        """Features (4 levels,) of a camera position (3,), world units, and a light (2,), normalised coordinates."""
        # A wide extent along one axis and none along another still maps by one scale for each axis.
        where = (camera - self.camera_low) / self.camera_extent
        return torch.cat([self.light_grid(light_input(light) / self.light_high), self.camera_grid(where)])

    def forward(self, positions: Tensor, latent: Tensor | None, features: Tensor) -> dict[str, Tensor]:
        """Offsets by name, (n, width) each, for canonical positions (n, 1 or 2) and latent codes (n, d)."""
        encoded = frequency_encoding(positions, BANDS)
        if latent is not None:
            encoded = torch.cat([encoded, latent], -1)
        x = functional.relu(self.gaussian_layer(encoded) + self.view_layer(features))
        for layer in self.layers:
            x = functional.relu(layer(x))
        return dict(zip(self.names, self.head(x).split(self.widths, -1), strict=True))

    def light_correction(self, features: Tensor) -> Tensor:
        """delta_l (2,), normalised coordinates (paper, eq. 4)."""
        return self.correction(features)
