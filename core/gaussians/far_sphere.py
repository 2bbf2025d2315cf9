# SPDX-License-Identifier: GPL-3.0-or-later
"""The sphere on which a scene shows what lies beyond the parallax of its capture: only the directions of its Gaussians
matter.

A Gaussian farther from the centre than half the radius is far. It hides no light, and densification measures it by the
angle that it covers: `SceneGaussians.units` returns by how much larger the world units of far Gaussians are.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

FAR_RATIO = 0.5
"""Distance from the centre, relative to the radius, above which a Gaussian is far."""


@dataclass(frozen=True)
class FarSphere:
    """A sphere about `centre`, world coordinates, of a radius in world units."""

    centre: tuple[float, ...]
    radius: float

    @classmethod
    def parse(cls, x: float, y: float, z: float, radius: float) -> FarSphere | None:
        """Return the sphere that numbers from a file describe; None if one is not finite or the radius is not
        positive."""
        if not all(map(math.isfinite, (x, y, z, radius))) or radius <= 0:
            return None
        return cls((x, y, z), radius)

    @property
    def min_distance(self) -> float:
        """Distance from the centre above which a Gaussian is far, world units."""
        return FAR_RATIO * self.radius

    def contains(self, means: Tensor) -> Tensor:
        """Return (n,) which Gaussians at `means` (n, 3) are far."""
        offsets = means.detach() - torch.tensor(self.centre, dtype=means.dtype, device=means.device)
        return offsets.square().sum(-1) > self.min_distance**2

    def move(self, means: Tensor, steps: Tensor) -> Tensor:
        """Return means (m, 3) moved by steps (m, 3), world units, and put back on the sphere along its radius."""
        centre = torch.tensor(self.centre, dtype=means.dtype, device=means.device)
        offsets = means + steps - centre
        # The clamp bounds the factor, for a step that leads close to the centre.
        return centre + offsets * (self.radius / offsets.norm(dim=-1, keepdim=True).clamp(min=self.min_distance))
