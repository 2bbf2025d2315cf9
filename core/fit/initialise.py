# SPDX-License-Identifier: GPL-3.0-or-later
"""What a fit begins with: a scene, and a flare for each light, which is put in its place first."""
from __future__ import annotations

import math

import numpy as np
import torch

from ..capture import LIGHTS, Capture, View
from ..errors import CaptureError
from ..flare.deformation import QueryRange
from ..flare.model import FlareModel, LightFlare, ViewOfLight
from ..gaussians.ply import read_ply
from ..gaussians.scene import SceneGaussians
from ..images.picture import Picture
from ..lights.snap import Sight, sight, snapped
from ..thinning import thinned
from .frames import Frames
from .settings import FitSettings
from .sky import with_sky

NEAREST, NEAREST_PART = 0.01, 0.5
"""Quantile of the depths of points that counts as the nearest, and the part of it at which Gaussians are culled, where
that is less than usual: worlds of small units, metres about a watch, are fitted as others are."""
NEAREST_POINTS = 10_000  # that are looked at
SNAP_WIDTH, SNAP_VIEWS = 160, 40
"""Pixels of the pictures that lights are placed by, and about how many of them."""


def first_scene(capture: Capture, settings: FitSettings, views: tuple[View, ...], frames: Frames) -> SceneGaussians:
    """The scene a fit begins with: one that was trained elsewhere, or a Gaussian at each point."""
    scene = _scene(capture, settings, views, frames)
    scene.near = min(scene.near, NEAREST_PART * nearest_depth(capture))
    scene.display_white = settings.display_white
    return scene


def nearest_depth(capture: Capture) -> float:
    """Camera depth, world units, of the points that are nearest in the views: the hundredth part of all that are on the
    frame. Infinity where no view has any."""
    points = capture.points.xyz[:: max(len(capture.points) // NEAREST_POINTS, 1)]
    depths = []
    for camera in (view.camera for view in capture.views):
        pixels, depth = camera.project(points)
        depths.append(depth[camera.contains(pixels, depth)])
    every = np.concatenate(depths) if depths else np.zeros(0)
    return float(np.quantile(every, NEAREST)) if len(every) else math.inf


def _scene(capture: Capture, settings: FitSettings, views: tuple[View, ...], frames: Frames) -> SceneGaussians:
    if settings.scene.start:
        scene = read_ply(settings.scene.start)
        if not len(scene):
            raise CaptureError(f"{settings.scene.start} holds no Gaussians; export it again.")
        for parameter in scene.parameters():
            parameter.requires_grad_(not settings.scene.frozen)
        if not settings.scene.frozen:
            scene.sampling = None  # it learns another grid
        return scene
    if not len(capture.points):
        raise CaptureError(f"{capture.folder} has no 3D points to start from; solve it again.")
    sky = settings.by_parallax and settings.split.sky
    return SceneGaussians.from_points(with_sky(capture, views, frames) if sky else capture.points)


def first_flare(capture: Capture, views: tuple[View, ...], frames: Frames, settings: FitSettings) -> FlareModel:
    """The flares a fit begins with. Raises CaptureError where there are no lights, or one is behind all cameras."""
    if not capture.lights:
        there = (capture.folder / LIGHTS).exists()
        raise CaptureError(f"{capture.folder / LIGHTS} lists no light; add one by hand, or fit with --mode 3dgs."
                           if there else
                           f"{capture.folder} has no lights.json; run lights on it first, or fit with --mode 3dgs.")
    generator = torch.Generator().manual_seed(settings.seed)
    positions = torch.tensor([list(map(float, light.xyz)) for light in capture.lights], dtype=torch.float64)
    if not settings.flare.detection:
        # Paper, appendix: the centroid of the points, offset by uniform noise in [0, 1) along each axis.
        centroid = torch.from_numpy(capture.points.xyz).double().mean(0)
        positions = centroid + torch.rand(positions.shape, generator=generator, dtype=torch.float64)
    elif settings.flare.snap and frames.reference:
        positions = torch.from_numpy(snapped(_sights(views, frames), positions.numpy()))
    poses = [torch.from_numpy(view.camera.world_to_camera) for view in views]
    reach = max(view.camera.reach for view in views)
    flares = []
    for light, xyz in zip(capture.lights, positions, strict=True):
        seen = [one for one in (ViewOfLight.of(pose, xyz) for pose in poses) if one.depth > 0]
        if not seen:
            raise CaptureError(f"The light {light.name!r} is behind the camera in every view of {capture.folder}; "
                               "correct or remove it in lights.json.")
        cameras, places = (torch.stack([getattr(one, name) for one in seen]) for name in ("camera", "light"))
        query = QueryRange.of(cameras, places, reach)
        flares.append(LightFlare(settings.flare.form, query, settings.flare.count, generator, settings.flare.opacity))
    return FlareModel([light.name for light in capture.lights], positions, flares)


def _sights(views: tuple[View, ...], frames: Frames) -> list[Sight]:
    """Of some of the views with flare-free frames, small, which is all that placing lights takes. The frames are those
    that the fit looks at, so that none is decoded twice."""
    found = []
    for view in thinned(views, SNAP_VIEWS):
        camera, frame, removed = frames.targets(view)
        if removed is not None:
            small = camera.scaled(min(SNAP_WIDTH, camera.width))
            shrunk = (Picture(part.numpy(), "srgb").resized(*small.size).display() for part in (frame, removed))
            found.append(sight(small, *shrunk))
    return found
