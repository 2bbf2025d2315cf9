# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the scene and the flare that a fit starts from, for `trainer`; lights are moved to their flares first."""
from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from ..capture import LIGHTS, Capture, View
from ..capture.camera import check_in_view
from ..errors import CaptureError
from ..flare.deformation import QueryRange
from ..flare.frame_lights import FrameLights
from ..flare.model import FlareModel, LightFlare, ViewOfLight, plane_scale
from ..gaussians.ply import read_ply
from ..gaussians.scene import SceneGaussians
from ..images.picture import Picture
from ..lights.snap import FlareView, flare_view, snap_lights
from .far_layer import find_far_layer
from .frames import Frames, subsample
from .light_results import make_frame_lights
from .settings import FitSettings
from .sky import add_sky_points

NEAREST_QUANTILE, NEAR_PLANE_FACTOR = 0.01, 0.5
"""Quantile of the points' depths that counts as the nearest, and the factor on it at which Gaussians are culled, if
that is less than the usual near plane: captures in small units, such as metres around a watch, need it."""
SAMPLED_POINTS = 10_000
"""Approximate number of points whose depths are computed."""
CAMERA_RANGE = 1e6
"""Half the side of the model's camera range in a fit over plates, world units: so large that all cameras fall on one
point of the grid, and appearance follows only the place of the light in the picture."""
SNAP_WIDTH, SNAP_VIEWS = 160, 40
"""Width in pixels of the frames by which lights are moved, and the approximate number of frames."""


def initial_scene(capture: Capture, settings: FitSettings, views: tuple[View, ...], frames: Frames) -> SceneGaussians:
    """Return the scene that a fit starts from: a scene trained elsewhere, or one Gaussian for each point of the
    capture. Its near plane and white are set for the capture's frames."""
    if settings.scene.start:
        scene = _load_scene(settings, views)
    else:
        scene = _scene_from_points(capture, settings, views, frames)
    scene.near = min(scene.near, NEAR_PLANE_FACTOR * nearest_depth(capture))
    scene.display_white = settings.display_white
    return scene


def nearest_depth(capture: Capture) -> float:
    """Return the depth, world units, of the nearest points that the views show: the 1 % quantile over all views;
    infinity if no view shows a point."""
    points = capture.points.xyz[:: max(len(capture.points) // SAMPLED_POINTS, 1)]
    depths = []
    for camera in (view.camera for view in capture.views):
        pixels, depth = camera.project(points)
        depths.append(depth[camera.contains(pixels, depth)])
    all_depths = np.concatenate(depths) if depths else np.zeros(0)
    return float(np.quantile(all_depths, NEAREST_QUANTILE)) if len(all_depths) else math.inf


def _load_scene(settings: FitSettings, views: tuple[View, ...]) -> SceneGaussians:
    """Read the scene to start from; a frozen one gets no gradients. Raises CaptureError for a scene that is empty or
    lies in another world than the cameras."""
    scene = read_ply(settings.scene.start)
    if not len(scene):
        raise CaptureError(f"{settings.scene.start} holds no Gaussians; export it again.")
    _check_in_view(scene, views, settings.scene.start)
    for parameter in scene.parameters():
        parameter.requires_grad_(not settings.scene.frozen)
    if not settings.scene.frozen:
        scene.pixel_grid = None  # the fit adapts it to the pixel grid of its own frames
    return scene


def _scene_from_points(capture: Capture, settings: FitSettings, views: tuple[View, ...], frames: Frames
                       ) -> SceneGaussians:
    """Return a scene of one Gaussian for each point of the capture, plus far ones if the settings ask for them: the far
    layer, or, where none is found and the fit is by parallax, a sky. Raises CaptureError without points.
    """
    if not len(capture.points):
        raise CaptureError(f"{capture.folder} has no 3D points to start from; solve it again.")
    layer = find_far_layer(capture, views, frames) if settings.scene.far_layer else None
    sky = layer is None and settings.uses_parallax and settings.split.sky
    scene = SceneGaussians.from_points(add_sky_points(capture, views, frames) if sky else capture.points)
    if layer is not None:
        scene.add_far_layer(layer.points, layer.sphere, torch.from_numpy(layer.opacities))
    return scene


def _check_in_view(scene: SceneGaussians, views: tuple[View, ...], path: str) -> None:
    """Raise CaptureError where few views have a Gaussian of the scene on their frames: it is of another world."""
    check_in_view([view.camera for view in views], scene.means.detach().numpy(), path, "the capture",
                  " (for nerfstudio: --orientation-method none --center-method none --auto-scale-poses False)")


def _check_has_lights(capture: Capture) -> None:
    """Raise CaptureError for a capture without lights."""
    if capture.lights:
        return
    if (capture.folder / LIGHTS).exists():
        raise CaptureError(f"{capture.folder / LIGHTS} lists no light; add one by hand, or fit with --mode 3dgs.")
    raise CaptureError(f"{capture.folder} has no lights.json; run lights on it first, or fit with --mode 3dgs.")


def initial_flare(capture: Capture, views: tuple[View, ...], frames: Frames, settings: FitSettings) -> FlareModel:
    """Return the flare model that a fit starts from. Raises CaptureError without lights, or if one is behind all
    cameras."""
    _check_has_lights(capture)
    generator = torch.Generator().manual_seed(settings.seed)
    names = [light.name for light in capture.lights]
    frame_lights = None
    if settings.uses_plates or has_frame_lights(capture):
        frame_lights = make_frame_lights(capture, names)
    if frame_lights is None:
        positions = _static_positions(capture, views, frames, settings, generator)
    else:
        # The lights' places in the middle frame, for cameras that belong to no frame.
        positions = frame_lights.positions[len(frame_lights.positions) // 2].clone()
    cameras = [view.camera for view in views]
    corner_radius = max(camera.corner_radius for camera in cameras)
    scale = plane_scale(max(camera.width / 2 / camera.fx for camera in cameras))
    flares = []
    for number, light in enumerate(capture.lights):
        in_front = _views_in_front(number, views, positions, frame_lights)
        if not in_front:
            raise CaptureError(f"The light {light.name!r} is behind the camera in every view of {capture.folder}; "
                               "correct or remove it in lights.json.")
        query_range = QueryRange.of(torch.stack([view.camera for view in in_front]),
                                    torch.stack([view.light for view in in_front]), corner_radius)
        if settings.uses_plates:
            query_range = replace(query_range, camera_low=(-CAMERA_RANGE,) * 3, camera_high=(CAMERA_RANGE,) * 3)
        flares.append(LightFlare(settings.flare.form, query_range, settings.flare.count, generator,
                                 settings.flare.opacity, scale))
    return FlareModel(names, positions, flares, frame_lights)


def _views_in_front(light_index: int, views: tuple[View, ...], positions: torch.Tensor, frame_lights: FrameLights | None
                    ) -> list[ViewOfLight]:
    """Return how each view sees a light, for the views that have it in front of the camera.

    light_index: number of the light, from 0. positions: (lights, 3), world units, used if `frame_lights` is None.
    frame_lights: the lights' positions by frame.
    """
    light_views = []
    for view in views:
        xyz = (positions if frame_lights is None else frame_lights.positions[frame_lights.rows[view.name]])[light_index]
        light_views.append(ViewOfLight.of(torch.from_numpy(view.camera.world_to_camera), xyz))
    return [light_view for light_view in light_views if light_view.depth > 0]


def has_frame_lights(capture: Capture) -> bool:
    """Return whether a light moves, or has a brightness by frame."""
    return any(light.moves or light.keys for light in capture.lights)


def _static_positions(capture: Capture, views: tuple[View, ...], frames: Frames, settings: FitSettings,
                      generator: torch.Generator) -> torch.Tensor:
    """Return the places (lights, 3) of static lights, world units, moved to their flares if the settings say so.

    Without `flare.detection`, an ablation, every light is at the centroid of the points plus uniform noise.
    """
    positions = torch.tensor([list(map(float, light.xyz)) for light in capture.lights], dtype=torch.float64)
    if not settings.flare.detection:
        # Paper, appendix: the centroid of the points, offset by uniform noise in [0, 1) along each axis.
        centroid = torch.from_numpy(capture.points.xyz).double().mean(0)
        return centroid + torch.rand(positions.shape, generator=generator, dtype=torch.float64)
    if settings.flare.snap_lights and frames.clean_source:
        return torch.from_numpy(snap_lights(_snap_views(views, frames), positions.numpy()))
    return positions


def _snap_views(views: tuple[View, ...], frames: Frames) -> list[FlareView]:
    """Return the flares of some of the views that have clean frames, at a small size, for `snap_lights`.

    They come from the frames that the fit uses, so none is decoded twice.
    """
    flare_views = []
    for view in subsample(views, SNAP_VIEWS):
        camera, frame, clean = frames.targets(view)
        if clean is not None:
            small = camera.scaled(min(SNAP_WIDTH, camera.width))
            shrunk = (Picture(part.numpy(), "srgb").resized(*small.size).display() for part in (frame, clean))
            flare_views.append(flare_view(small, *shrunk))
    return flare_views
