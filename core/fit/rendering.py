# SPDX-License-Identifier: GPL-3.0-or-later
"""One view of a fitted model: the scene, each light's flare, and both together."""
from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ..capture import Camera
from ..choices import Blend, Kernels
from ..colour.srgb_torch import decode, encode, exposed
from ..conventions.pixel_grid import Sampling
from ..flare.compositing import Layers, joined, layers, splat_flare
from ..flare.model import FlareModel
from ..flare.placement import PlaneGaussians
from ..flare.visibility import VisibilitySettings, visible_shares
from ..gaussians import Rendering, Splats
from ..gaussians.scene import SceneGaussians
from ..look import Look, LookEdits
from ..look import PlaneGaussians as LookGaussians

LEAST_ALPHA = 1e-6  # by which a depth is divided: where nothing is it stays 0


class RenderedView(NamedTuple):
    """scene: its rendering in display space; flares: each light's splats, in the lights' order.

    composite: (height, width, 3) display values in 0..1; layers: the same in linear light, taken apart.
    """

    scene: Rendering
    flares: dict[str, Splats]
    composite: Tensor
    layers: Layers


def pose_and_intrinsics(camera: Camera) -> tuple[Tensor, Tensor]:
    """world_to_camera (4, 4) float64 and intrinsics (3, 3) float32 of a camera."""
    return torch.from_numpy(camera.world_to_camera).double(), torch.from_numpy(camera.intrinsics).float()


def render_flare(flare: FlareModel | None, blend: Blend, camera: Camera, kernels: Kernels = "auto", *,
                 scene: SceneGaussians | None = None, visibility: VisibilitySettings | None = None) -> Splats | None:
    """All lights' flares as one set of splats; None where there is no light in front of the camera.

    With `visibility` each flare is scaled by the share of its light that `scene` leaves visible.
    """
    if flare is None:
        return None
    pose, intrinsics = pose_and_intrinsics(camera)
    gaussians = joined(flare(pose, _shares(flare, pose, scene, visibility, kernels)))
    if gaussians is None:
        return None
    return splat_flare(gaussians, intrinsics, camera.width, camera.height, blend, kernels=kernels,
                       exposure=camera.exposure)


def _shares(flare: FlareModel, pose: Tensor, scene: SceneGaussians | None, visibility: VisibilitySettings | None,
            kernels: Kernels) -> dict[str, Tensor] | None:
    if scene is None or visibility is None:
        return None
    return visible_shares(scene, flare, pose, visibility, kernels)


@torch.no_grad()
def render(scene: SceneGaussians, flare: FlareModel | None, blend: Blend, camera: Camera,
           kernels: Kernels = "auto", *, visibility: VisibilitySettings | None = None,
           look: Look | None = None, edits: LookEdits | None = None, sampling: Sampling | None = None) -> RenderedView:
    """Everything a view has to give, without gradients. edits: changes of the flare, of which `look` is the reader.
    sampling: the grid on which the flare was learned."""
    rendering = render_scene(scene, camera, kernels)
    flares: dict[str, Splats] = {}
    if flare is not None:
        pose, intrinsics = pose_and_intrinsics(camera)
        shares = _shares(flare, pose, scene, visibility, kernels)
        gaussians = flare(pose, shares) if look is None or edits is None else _edited(look, edits, camera, shares)
        flares = {name: splat_flare(one, intrinsics, camera.width, camera.height, blend, kernels=kernels,
                                    sampling=sampling, exposure=camera.exposure)
                  for name, one in gaussians.items()}
    parts = layers(rendering.colour, flares, blend, scene.display_white)
    return RenderedView(rendering, flares, encode(parts.composite.clamp_min(0)).clamp(0, 1), parts)


def render_scene(scene: SceneGaussians, camera: Camera, kernels: Kernels = "auto", *, sh_degree: int | None = None,
                 depth: bool = True) -> Rendering:
    """A scene as the camera of the frames that it was fitted to would show it at this camera's size and exposure."""
    found = _sampled(scene, camera, kernels, sh_degree, depth)
    return found if camera.exposure == 1 else replace(found, colour=exposed(found.colour, camera.exposure))


def _sampled(scene: SceneGaussians, camera: Camera, kernels: Kernels, sh_degree: int | None,
             depth: bool) -> Rendering:
    """At the camera's size: where that is coarser than what the scene was fitted to, each pixel is the mean, in linear
    light, of those of a larger picture."""
    samples = 1 if scene.sampling is None else scene.sampling.samples(camera.focal_length, *camera.size)
    if samples == 1:
        return scene.render(camera, sh_degree, kernels=kernels, depth=depth)
    large = scene.render(camera.scaled(samples * camera.width, samples * camera.height), sh_degree, kernels=kernels,
                         depth=depth)

    def mean(picture: Tensor) -> Tensor:
        """(height, width, ...) of (samples height, samples width, ...)."""
        return picture.reshape(camera.height, samples, camera.width, samples, *picture.shape[2:]).mean((1, 3))

    alpha = mean(large.alpha)
    found = replace(large, colour=encode(mean(decode(large.colour.clamp_min(0)))), alpha=alpha,
                    centres=large.centres / samples, radii=large.radii / samples)
    if not depth:
        return found
    middle = slice(samples // 2, None, samples)
    return replace(found, depth=mean(large.alpha * large.depth) / alpha.clamp_min(LEAST_ALPHA),
                   median_depth=large.median_depth[middle, middle])


def _edited(look: Look, edits: LookEdits, camera: Camera,
            shares: dict[str, Tensor] | None) -> dict[str, PlaneGaussians]:
    """Each light's Gaussians as an artist has changed them."""
    visible = {name: float(share) for name, share in (shares or {}).items()}
    shown = look.evaluate(camera.world_to_camera, edits=edits, shares=visible)
    return {name: as_tensors(one) for name, one in shown.items()}


def splat_look(look: Look, gaussians: LookGaussians, camera: Camera) -> Splats:
    """Gaussians of a look laid on the camera's picture, as on the grid they were learned on."""
    _, intrinsics = pose_and_intrinsics(camera)
    return splat_flare(as_tensors(gaussians), intrinsics, *camera.size, look.blend, sampling=look.sampling,
                       exposure=camera.exposure)


def as_tensors(one: LookGaussians) -> PlaneGaussians:
    """A look's Gaussians as the rasterizer takes them."""
    means, covariances, opacities, colours = (
        torch.from_numpy(part).float() for part in (one.means, one.covariances, one.opacities, one.colours))
    rings, arcs = (None if part is None else torch.from_numpy(part).float() for part in (one.rings, one.arcs))
    return PlaneGaussians(means, covariances, opacities, colours, rings, arcs)
