# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders one view of a fitted model: the scene, the flare of each light, and the composite.

`trainer` uses the parts with gradients; `run`, `preview` and `core.bake` use `render`.
"""
from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from ..capture import Camera
from ..choices import Blend, Kernels
from ..colour.srgb_torch import decode, encode, expose
from ..conventions.pixel_grid import PixelGrid
from ..flare.compositing import LinearLayers, concatenate, linear_layers, splat_flare
from ..flare.model import FlareModel
from ..flare.placement import PlaneGaussians
from ..flare.visibility import VisibilitySettings, light_visibilities
from ..gaussians import Rendering, Splats
from ..gaussians.scene import SceneGaussians
from ..look import Look, LookEdits
from ..look import PlaneGaussians as LookGaussians
from .plate_scene import PlateScene

Scene = SceneGaussians | PlateScene
"""The scene of a fit: Gaussians, or one plate per frame."""

T = TypeVar("T", Rendering, Splats)

MIN_ALPHA = 1e-6
"""Smallest alpha by which a depth is divided: where nothing is, it stays 0."""


class RenderedView(NamedTuple):
    """A rendered view. scene: rasterized in display space; flares: splats of each light, in the lights' order.

    composite: (height, width, 3), display values 0..1; layers: the same in linear light, separated. All are on the CPU.
    """

    scene: Rendering
    flares: dict[str, Splats]
    composite: Tensor
    layers: LinearLayers


def pose_and_intrinsics(camera: Camera) -> tuple[Tensor, Tensor]:
    """Return world_to_camera (4, 4) float64 and intrinsics (3, 3) float32 of a camera."""
    return torch.from_numpy(camera.world_to_camera).double(), torch.from_numpy(camera.intrinsics).float()


def render_flare(flare: FlareModel | None, blend: Blend, camera: Camera, kernels: Kernels = "auto", *,
                 scene: Scene | None = None, visibility: VisibilitySettings | None = None,
                 opacity_floor: float = 0.0) -> Splats | None:
    """Render the flares of all lights as one set of splats; None if no light is in front of the camera.

    With `visibility`, each flare is scaled by the visibility of its light behind `scene`. opacity_floor: least opacity
    of a Gaussian, before that scaling.
    """
    if flare is None:
        return None
    pose, intrinsics = pose_and_intrinsics(camera)
    visibilities = _visibilities(flare, camera, scene, visibility, kernels)
    gaussians = concatenate(flare(pose, visibilities, camera.frame, opacity_floor))
    if gaussians is None:
        return None
    return splat_flare(gaussians, intrinsics, camera.width, camera.height, blend, kernels=kernels,
                       exposure=camera.exposure)


def _visibilities(flare: FlareModel, camera: Camera, scene: Scene | None, visibility: VisibilitySettings | None,
                  kernels: Kernels) -> dict[str, Tensor] | None:
    """Return the visibility of each light behind a scene, by its name; None if nothing hides lights: without
    `visibility`, and in a scene of plates."""
    if visibility is None or not isinstance(scene, SceneGaussians):
        return None
    pose, _ = pose_and_intrinsics(camera)
    return light_visibilities(scene, flare, pose, visibility, kernels, camera.frame)


@torch.no_grad()
def render(scene: Scene, flare: FlareModel | None, blend: Blend, camera: Camera,
           kernels: Kernels = "auto", *, visibility: VisibilitySettings | None = None,
           look: Look | None = None, edits: LookEdits | None = None,
           pixel_grid: PixelGrid | None = None) -> RenderedView:
    """Render scene, flares and composite of a view, without gradients.

    visibility: how the scene hides lights; None if it does not. look, edits: with both, `look` evaluates the flare
    under these edits, in place of `flare`. pixel_grid: the grid at which the flare was fitted; None in the fit itself.
    """
    device = _device_of(scene, flare)
    if isinstance(scene, PlateScene):
        rendering = _move(scene.render_frame(camera), device)
    else:
        rendering = render_scene(scene, camera, kernels)
    flares: dict[str, Splats] = {}
    if flare is not None:
        pose, intrinsics = pose_and_intrinsics(camera)
        visibilities = _visibilities(flare, camera, scene, visibility, kernels)
        if look is None or edits is None:
            gaussians = flare(pose, visibilities, camera.frame)
        else:
            gaussians = {name: as_tensors(plane, device) for name, plane in
                         _evaluate_look_with_edits(look, flare, edits, camera, visibilities).items()}
        flares = {name: splat_flare(light_gaussians, intrinsics, camera.width, camera.height, blend, kernels=kernels,
                                    pixel_grid=pixel_grid, exposure=camera.exposure)
                  for name, light_gaussians in gaussians.items()}
    layers = linear_layers(rendering.colour, flares, blend, scene.display_white)
    composite = encode(layers.composite.clamp_min(0)).clamp(0, 1)
    cpu = torch.device("cpu")
    return RenderedView(_move(rendering, cpu), {name: _move(splats, cpu) for name, splats in flares.items()},
                        composite.to(cpu), layers.to(cpu))


def _device_of(scene: Scene, flare: FlareModel | None) -> torch.device:
    """Return the device of a fitted model: that of its scene, or of its flare over plates."""
    if isinstance(scene, SceneGaussians):
        return scene.means.device
    return torch.device("cpu") if flare is None else flare.device


def _move(pictures: T, device: torch.device) -> T:
    """Return a `Rendering` or `Splats` with its tensors on a device."""
    return type(pictures)(**{entry.name: getattr(pictures, entry.name).to(device) for entry in fields(pictures)})


def render_scene(scene: SceneGaussians, camera: Camera, kernels: Kernels = "auto", *, sh_degree: int | None = None,
                 depth: bool = True) -> Rendering:
    """Render a scene at the size and exposure of a camera, supersampled where that is coarser than the fitted frames.

    sh_degree: degree of the colours' harmonics; None for all. depth: whether to render depth too.
    """
    rendering = _render_supersampled(scene, camera, kernels, sh_degree, depth)
    return rendering if camera.exposure == 1 else replace(rendering, colour=expose(rendering.colour, camera.exposure))


def _render_supersampled(scene: SceneGaussians, camera: Camera, kernels: Kernels, sh_degree: int | None,
                         depth: bool) -> Rendering:
    """Render a scene at the camera's size, exposure 1. Where that is coarser than the fitted frames, pixels are means,
    in linear light, of a larger picture. sh_degree: degree of the colours' harmonics; None for all."""
    grid = scene.pixel_grid
    samples = 1 if grid is None else grid.supersampling_factor(camera.focal_length, *camera.size)
    if samples == 1:
        return scene.render(camera, sh_degree, kernels=kernels, depth=depth)
    large = scene.render(camera.scaled(samples * camera.width, samples * camera.height), sh_degree, kernels=kernels,
                         depth=depth)

    def mean(picture: Tensor) -> Tensor:
        """Reduce (samples height, samples width, ...) to (height, width, ...)."""
        return picture.reshape(camera.height, samples, camera.width, samples, *picture.shape[2:]).mean((1, 3))

    alpha = mean(large.alpha)
    rendering = replace(large, colour=encode(mean(decode(large.colour.clamp_min(0)))), alpha=alpha,
                        centres=large.centres / samples, radii=large.radii / samples)
    if not depth:
        return rendering
    middle = slice(samples // 2, None, samples)  # a mean of two surfaces would lie on neither
    return replace(rendering, depth=mean(large.alpha * large.depth) / alpha.clamp_min(MIN_ALPHA),
                   median_depth=large.median_depth[middle, middle])


def _evaluate_look_with_edits(look: Look, flare: FlareModel, edits: LookEdits, camera: Camera,
                              visibilities: dict[str, Tensor] | None) -> dict[str, LookGaussians]:
    """Return the look's Gaussians of each light under an artist's edits, by the light's name.

    `flare` gives the lights' positions and brightness for the camera's frame. visibilities: 0..1 by light, None where
    nothing hides them; times brightness they scale the flare.
    """
    visible_brightness = flare.shares(visibilities, camera.frame) or {}
    positions = dict(zip(flare.names, flare.positions_in(camera.frame).numpy(), strict=True))
    return look.evaluate(camera.world_to_camera, lights=positions, edits=edits,
                         visibilities={name: float(value) for name, value in visible_brightness.items()})


def splat_look(look: Look, gaussians: LookGaussians, camera: Camera, device: torch.device | None = None) -> Splats:
    """Splat Gaussians of a look on the camera's picture, at the pixel grid that they were fitted at.

    device: of the rasterizer and of the result; None for the CPU.
    """
    _, intrinsics = pose_and_intrinsics(camera)
    return splat_flare(as_tensors(gaussians, device), intrinsics, *camera.size, look.blend, pixel_grid=look.pixel_grid,
                       exposure=camera.exposure)


def as_tensors(gaussians: LookGaussians, device: torch.device | None = None) -> PlaneGaussians:
    """Convert a look's Gaussians to those of the rasterizer, on a device, None for the CPU."""
    means, covariances, opacities, colours = (
        torch.from_numpy(part).float().to(device)
        for part in (gaussians.means, gaussians.covariances, gaussians.opacities, gaussians.colours))
    rings, arcs = (None if part is None else torch.from_numpy(part).float().to(device)
                   for part in (gaussians.rings, gaussians.arcs))
    return PlaneGaussians(means, covariances, opacities, colours, rings, arcs)
