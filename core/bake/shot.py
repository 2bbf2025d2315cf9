# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes a shot (core/look/shot.py): a flare over any camera's frames, in a folder whose bake resumes after any stop.

Without a run, layers have a black scene; with the run of a fit they have its scene, which also hides the lights. The
add-on's bakes come here.
"""
from __future__ import annotations

from collections.abc import Container
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..choices import Device
from ..fit.rendering import render_scene, splat_look
from ..fit.run import Run, ViewLayers
from ..flare.compositing import linear_layers as linear_layers
from ..flare.visibility import visibility_behind
from ..gaussians.device import select_device
from ..look import LookEdits, PlacedLight
from ..look.shot import Shot, ShotFrame
from ..system.progress import Progress
from .shot_frames import ShotSource, bake_shot_frames


class ShotRenderer(ShotSource):
    """Renders the frames of a shot in the engine, with the scene of its run."""

    def __init__(self, shot: Shot, device: Device = "cpu") -> None:
        """device: of the rasterizer."""
        super().__init__(shot)
        self._device = select_device(device)
        self.run = Run.open(shot.run, device=device) if shot.run else None
        model = self.run.flare.model if self.run is not None and self.run.flare is not None else None
        # Visibility of each unoccluded light through the scene of the fit, by name.
        self._clear_visibilities = ({} if model is None else
                                    dict(zip(model.names, model.clear.tolist(), strict=True)))

    @property
    def fingerprint(self) -> str:
        """A digest of what all frames share; what belongs to one frame is in the fingerprint of its renderer."""
        return self.shot.fingerprint(self.run.fingerprint if self.run is not None else "")

    def render(self, shot_frame: ShotFrame, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        """Render the layers of a frame. camera: the frame's, at the size of the layers."""
        import torch

        placed = [self._occlude(light, camera) for light in shot_frame.lights]
        with torch.no_grad():
            gaussians_by_light = self.look.evaluate_lights(camera.world_to_camera, placed, edits, self.shot.query)
            flares = {name: splat_look(self.look, gaussians, camera, self._device)
                      for name, gaussians in gaussians_by_light.items()}
            black = torch.zeros(camera.height, camera.width, 3, device=self._device)
            scene, white = (None, 1.0) if self.run is None else (render_scene(self.run.gaussians, camera),
                                                                 self.run.gaussians.display_white)
            linear = linear_layers(black if scene is None else scene.colour, flares, self.look.blend, white).to(
                torch.device("cpu"))
        # Without a scene an added layer is light alone, as `draw_layers` draws it. With the blend "over" a layer is
        # negative where its light covers a brighter flare, since the layers sum to the picture.
        is_light_alone = scene is None and self.look.blend == "add"
        layers = {name: np.maximum(layer.numpy(), 0) if is_light_alone else layer.numpy()
                  for name, layer in linear.flares.items()}
        depth = black[..., 0] if scene is None else scene.depth
        dark = black.cpu().numpy()
        return ViewLayers(linear.scene.numpy(), {name: layers.get(name, dark) for name in self.lights},
                          depth.detach().cpu().numpy())

    def _occlude(self, light: PlacedLight, camera: Camera) -> PlacedLight:
        """Return the light with its visibility behind the fitted scene, computed as in the fit.

        A transfer to another scene rounds visibilities near 0 or 1. Here they stay as they are, since the flare was
        fitted with the visibilities of this very scene.
        """
        settings = self.run.settings.flare.active_visibility if self.run is not None else None
        if self.run is None or settings is None:
            return light
        visibility, shares = visibility_behind(self.run.gaussians, camera.world_to_camera, light, settings,
                                               self._clear_visibilities.get(light.source, 1.0))
        return replace(light, visibility=light.visibility * visibility, shares=shares)


def bake_shot(shot: Shot, out: Path | str, *, half: bool = True, overwrite: bool = False,
              progress: Progress | None = None, frame_numbers: Container[int] | None = None, space: str = "linear",
              config: str | None = None) -> dict[str, Any]:
    """Write the layers of a shot's frames under `out`: `layers.0001.exr` for one camera, a folder for each of several.

    frame_numbers: None for all. space: linear colour space of the layers; config: the OpenColorIO configuration that
    defines it. Returns the content of bake.json. Raises what `bake` raises, and FlareFileError.
    """
    return bake_shot_frames(ShotRenderer(shot), out, half=half, overwrite=overwrite, progress=progress,
                            frame_numbers=frame_numbers, space=space, config=config)
