# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes a shot (core/look/shot.py): a flare over any camera's frames, in a folder whose bake resumes after any stop.

Without a run, layers have a black scene; with the run of a fit they have its scene, which also hides the lights. The
add-on's bakes come here.
"""
from __future__ import annotations

import hashlib
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..conventions.frame_numbers import NumberedFrame, layers_file
from ..fit.rendering import render_scene, splat_look
from ..fit.run import Run, ViewLayers
from ..flare.compositing import linear_layers as linear_layers
from ..flare.visibility import visibility_from
from ..look import LookEdits, PlacedLight, read
from ..look.shot import Shot, ShotFrame
from ..system.progress import Progress
from .bake import BakeSettings, bake_frames
from .layers import FrameLayers


class ShotRenderer:
    """Renders the frames of a shot, for `bake_frames`."""

    def __init__(self, shot: Shot) -> None:
        self.shot, self.look = shot, read(shot.flare)
        self.run = Run.open(shot.run) if shot.run else None
        self.lights = shot.lights
        model = self.run.flare.model if self.run is not None and self.run.flare is not None else None
        self._clear = dict(zip(model.names, model.clear.tolist(), strict=True)) if model is not None else {}

    @property
    def elements(self) -> Mapping[str, list[str]]:
        """Names of each placed light's elements."""
        of_source = self.look.element_names
        return {light.name: of_source.get(light.source, [])
                for shot_frame in self.shot.frames for light in shot_frame.lights}

    @property
    def fingerprint(self) -> str:
        """A digest that changes with all pictures; what belongs to one frame is in its renderer's."""
        return self.shot.fingerprint(self.run.fingerprint if self.run is not None else "")

    def render(self, shot_frame: ShotFrame, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        """Render the layers of a frame, under its camera at the size of the layers."""
        import torch

        placed = [self._occlude(light, camera) for light in shot_frame.lights]
        with torch.no_grad():
            by_light = self.look.evaluate_lights(camera.world_to_camera, placed, edits, self.shot.query)
            flares = {name: splat_look(self.look, gaussians, camera) for name, gaussians in by_light.items()}
            dark = torch.zeros(camera.height, camera.width, 3)
            scene, white = (None, 1.0) if self.run is None else (render_scene(self.run.scene, camera),
                                                                 self.run.scene.display_white)
            parts = linear_layers(dark if scene is None else scene.colour, flares, self.look.blend, white)
        layers = {name: np.maximum(layer.numpy(), 0) if scene is None else layer.numpy()
                  for name, layer in parts.flares.items()}
        depth = dark[..., 0] if scene is None else scene.depth
        return ViewLayers(parts.scene.numpy(), {name: layers.get(name, dark.numpy()) for name in self.lights},
                          depth.detach().numpy())

    def _occlude(self, light: PlacedLight, camera: Camera) -> PlacedLight:
        """Return the light with its visibility behind the fitted scene, as in the fit.

        Over any other scene a visibility near 0 or 1 is rounded (`core.transfer.transfer.VISIBILITY_MARGIN`); here the
        flare has learned what a few hundredths of a light show.
        """
        settings = self.run.settings.flare.active_visibility if self.run is not None else None
        if self.run is None or settings is None:
            return light
        clear = self._clear.get(light.source, 1.0)
        visibility = visibility_from(self.run.scene, camera.position, light.xyz, settings, clear)
        return PlacedLight(light.name, light.source, light.xyz, light.visibility * visibility)


@dataclass(frozen=True)
class _ShotFrameRenderer:
    """The renderer of one frame of a shot."""

    renderer: ShotRenderer
    shot_frame: ShotFrame
    extra_files = ()

    @property
    def fingerprint(self) -> str:
        """Digest of the frame's camera, lights and edits."""
        return hashlib.sha256(self.shot_frame.cache_key().encode()).hexdigest()[:16]

    @property
    def edit_texts(self) -> Sequence[str]:
        """The shot's own edits."""
        return self.shot_frame.edits

    def render(self, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        return self.renderer.render(self.shot_frame, camera, edits)

    def finish(self, layers: FrameLayers, camera: Camera) -> FrameLayers:  # noqa: ARG002 - nothing to add
        return layers


def bake_shot(shot: Shot, out: Path | str, *, half: bool = True, overwrite: bool = False,
              progress: Progress | None = None, frame_numbers: Container[int] | None = None, space: str = "linear",
              config: str | None = None) -> dict[str, Any]:
    """Write the layers of a shot's frames under `out`: `layers.0001.exr` for one camera, a folder for each of several.

    frame_numbers: None for all. space, config: see `BakeSettings`. Returns the content of bake.json. Raises what `bake`
    raises, and FlareFileError.
    """
    folders = shot.folders
    frame_of_view = {f"{shot_frame.name}/{shot_frame.frame}": shot_frame for shot_frame in shot.frames
                     if frame_numbers is None or shot_frame.frame in frame_numbers}
    frames = [NumberedFrame(view, shot_frame.frame, layers_file(folders[shot_frame.name], shot_frame.frame))
              for view, shot_frame in frame_of_view.items()]
    cameras = {view: shot_frame.camera for view, shot_frame in frame_of_view.items()}
    renderer = ShotRenderer(shot)
    settings = BakeSettings(half=half, space=space, config=config)
    return bake_frames(renderer, frames, cameras, out,
                       lambda frame: _ShotFrameRenderer(renderer, frame_of_view[frame.view]), settings, progress,
                       overwrite=overwrite)
