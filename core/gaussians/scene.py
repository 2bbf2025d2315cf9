# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene as 3D Gaussians, with the unconstrained parameters that a fit optimises."""
from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ..capture import Camera, PointCloud
from ..choices import Kernels
from ..conventions.pixel_grid import PixelGrid, dilation
from ..errors import SettingsError
from . import spherical_harmonics
from .far_sphere import FarSphere
from .ordering import nearest_distances
from .projection import determinants, project
from .rasterizer import rasterization
from .rendering import NEAR, Rendering

COEFFICIENTS = (spherical_harmonics.MAX_DEGREE + 1) ** 2
INITIAL_OPACITY = 0.1
MIN_FILTER_RATIO = 1e-8
"""Smallest squared ratio of a Gaussian's projected area to that with the low-pass filter; its square root has a
gradient."""
MIN_SIZE = 1e-7 ** 0.5
"""Smallest initial standard deviation (3DGS), unless the world's unit is so large that MIN_SIZE_RATIO is smaller."""
MIN_SIZE_RATIO = 0.1
"""Smallest initial standard deviation relative to the median one, in worlds of a large unit."""


class SceneGaussians(nn.Module):
    """n Gaussians, with the parameters of 3DGS:

    means           (n, 3) world coordinates
    log_scales      (n, 3) log of the standard deviations
    quaternions     (n, 4) w, x, y, z, not normalised
    opacity_logits  (n,)
    sh              (n, 16, 3) spherical harmonics, degree 0 first
    """

    def __init__(
        self, means: Tensor, log_scales: Tensor, quaternions: Tensor, opacity_logits: Tensor, sh: Tensor
    ) -> None:
        super().__init__()
        self.means = nn.Parameter(means)
        self.log_scales = nn.Parameter(log_scales)
        self.quaternions = nn.Parameter(quaternions)
        self.opacity_logits = nn.Parameter(opacity_logits)
        self.sh = nn.Parameter(sh)
        self.display_white = 1.0
        """Display value at which pictures of the scene are clipped; above 1 for frames with values above white."""
        self.near = NEAR
        """Camera depth up to which Gaussians are culled, world units; smaller in a world of a large unit."""
        self.antialiased = False
        """True for a scene that was trained with a mip filter: a Gaussian that the low-pass filter enlarges loses
        opacity by the same factor (Yu et al. 2024; gsplat's rasterize_mode "antialiased")."""
        self.pixel_grid: PixelGrid | None = None
        """Pixel grid of the frames that the scene was fitted to, or None if unknown; see `conventions.pixel_grid`."""
        self.far: FarSphere | None = None
        """The sphere of the Gaussians that stand for directions, beyond all parallax; None without a far layer."""

    @classmethod
    def from_points(cls, points: PointCloud) -> SceneGaussians:
        """Initialise a Gaussian at each point as 3DGS does: isotropic, as large as the root mean square distance to the
        three nearest neighbours, opacity 0.1, the point's colour in all directions.

        Raises SettingsError without points.
        """
        if len(points.xyz) == 0:
            raise SettingsError("The capture has no points to start the scene from; solve it again.")
        means = torch.tensor(np.asarray(points.xyz), dtype=torch.float32)
        colours = torch.tensor(np.asarray(points.rgb), dtype=torch.float32) / 255
        n = len(means)
        distances = nearest_distances(means)
        # A single point has no neighbours; duplicates may have a median of 0.
        size = distances.square().mean(-1).sqrt() if distances.shape[1] else torch.ones(n)
        min_size = min(MIN_SIZE, MIN_SIZE_RATIO * float(size.median()) or MIN_SIZE)
        sh = torch.zeros(n, COEFFICIENTS, 3)
        sh[:, 0] = spherical_harmonics.dc_from_colour(colours)
        quaternions = torch.zeros(n, 4)
        quaternions[:, 0] = 1
        return cls(
            means,
            size.clamp(min=min_size).log()[:, None].repeat(1, 3),
            quaternions,
            torch.logit(torch.full((n,), INITIAL_OPACITY)),
            sh,
        )

    @torch.no_grad()
    def add_far_layer(self, points: PointCloud, sphere: FarSphere, opacity: float | Tensor = INITIAL_OPACITY
                      ) -> None:
        """Add a far layer: a Gaussian at each point, as `from_points` makes them, but of this opacity; sets `far`.

        points: on the sphere. opacity: of all, or (n,) of each."""
        layer = SceneGaussians.from_points(points)
        layer.opacity_logits.copy_(torch.logit(torch.as_tensor(opacity, dtype=torch.float64)))
        for name, parameter in self.named_parameters():
            parameter.data = torch.cat([parameter.data, layer.get_parameter(name).data])
        self.far = sphere

    def far_rows(self) -> Tensor:
        """Return the numbers (m,) of the rows that are on the far sphere."""
        if self.far is None:
            return torch.zeros(0, dtype=torch.int64, device=self.means.device)
        return torch.nonzero(self.far.contains(self.means))[:, 0]

    def units(self, extent: float) -> Tensor | float:
        """Return factors (n,) by which densification divides scales and steps, so that far Gaussians count by the angle
        that they cover; 1.0 without a far layer.

        The factor is 1 for near Gaussians, and the radius of the far sphere over `extent` for far ones. extent: size of
        the near scene, world units.
        """
        if self.far is None:
            return 1.0
        return 1 + self.far.contains(self.means) * (self.far.radius / extent - 1)

    @classmethod
    def empty(cls, n: int = 0) -> SceneGaussians:
        """Return n Gaussians whose parameters are zero."""
        return cls(*(torch.zeros(n, *shape) for shape in ((3,), (3,), (4,), (), (COEFFICIENTS, 3))))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Tensor:
        """(n, 3) standard deviations, world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """(n,) 0..1."""
        return self.opacity_logits.sigmoid()

    def render(
        self, camera: Camera, sh_degree: int | None = None, background: Tensor | None = None,
        *, kernels: Kernels = "auto", depth: bool = True,
    ) -> Rendering:  # fmt: skip
        """Render the scene for a camera, with the scene's low-pass filter and near plane; differentiable by the
        Gaussians.

        sh_degree: degree of harmonics that is used, None for all. background: (3,), None for black. depth: whether to
        render depth too.
        """
        scales: Tensor = self.log_scales
        opacities: Tensor = self.opacity_logits
        world_to_camera = torch.as_tensor(camera.world_to_camera).to(self.means)
        intrinsics = torch.as_tensor(camera.intrinsics).to(self.means)
        filter_size = dilation(self.pixel_grid, camera.focal_length)
        if self.antialiased:
            scales, opacities = self.scales, self.opacities * self._filter_ratios(
                world_to_camera, intrinsics, camera.width, camera.height, filter_size)
        return rasterization(
            self.means, self.quaternions, scales, opacities, self.sh, world_to_camera, intrinsics,
            camera.width, camera.height, background=background, sh_degree=sh_degree, kernels=kernels,
            near=self.near, dilation=filter_size, depth=depth, raw=not self.antialiased,
        )  # fmt: skip

    def _filter_ratios(self, world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
                       filter_size: float) -> Tensor:
        """Return (n,) ratios of each Gaussian's projected area without to that with the low-pass filter; 1 if culled.

        An area is the root of the projected covariance's determinant. filter_size: variance of the filter, px²."""
        projected = project(self.means, self.quaternions, self.scales, world_to_camera, intrinsics, width, height,
                            self.near, 0.0)
        plain = determinants(projected.covariances).clamp(min=0)
        added = torch.tensor([filter_size, 0.0, filter_size]).to(plain)
        ratios = (plain / determinants(projected.covariances + added)).clamp(min=MIN_FILTER_RATIO).sqrt()
        return torch.ones(len(self)).to(plain).index_put((projected.indices,), ratios)
