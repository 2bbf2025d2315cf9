# SPDX-License-Identifier: GPL-3.0-or-later
"""A shot (core/look/shot.py) rendered to layers: a flare over any camera's frames, in a folder that can be
gone on with after any stop.

Layers of the flare alone have a black scene; with the run of a fit, the scene it learned and how that scene
hides the lights come along.
"""
from __future__ import annotations

import hashlib
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..conventions.frame_numbers import Frame, layers_file
from ..fit.rendering import render_scene, splat_look
from ..fit.run import Run, ViewLayers
from ..flare.compositing import layers as linear_layers
from ..flare.visibility import share_seen
from ..look import LookEdits, read
from ..look.shot import PlacedLight, Shot, ShotFrame, evaluate
from ..system.progress import Progress
from .bake import BakeSettings, bake_frames
from .layers import FrameLayers


class ShotRenderer:
    """Renders the frames of a shot; what `bake_frames` wants."""

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
        return {light.name: of_source.get(light.source, []) for one in self.shot.frames for light in one.lights}

    @property
    def fingerprint(self) -> str:
        """Changes whenever all pictures would; what is a frame's alone, its renderer's tells."""
        return self.shot.fingerprint(self.run.fingerprint if self.run is not None else "")

    def render(self, one: ShotFrame, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        """The layers of a frame, under its camera at the size asked for."""
        import torch

        placed = [self._behind_the_scene(light, camera) for light in one.lights]
        with torch.no_grad():
            seen = evaluate(self.look, camera.world_to_camera, placed, edits, self.shot.query)
            flares = {name: splat_look(self.look, found, camera) for name, found in seen.items()}
            dark = torch.zeros(camera.height, camera.width, 3)
            scene, white = (None, 1.0) if self.run is None else (render_scene(self.run.scene, camera),
                                                                 self.run.scene.display_white)
            parts = linear_layers(dark if scene is None else scene.colour, flares, self.look.blend, white)
        found = {name: np.maximum(layer.numpy(), 0) if scene is None else layer.numpy()
                 for name, layer in parts.flares.items()}
        depth = dark[..., 0] if scene is None else scene.depth
        return ViewLayers(parts.scene.numpy(), {name: found.get(name, dark.numpy()) for name in self.lights},
                          depth.detach().numpy())

    def _behind_the_scene(self, light: PlacedLight, camera: Camera) -> PlacedLight:
        """The light with what the fitted scene hides of it: the very share that the flare was fitted with. Over any
        other scene a share near none or the whole says nothing (`core.transfer.transfer.SURE`); here the flare has
        learned what a few hundredths of a light show."""
        settings = self.run.settings.flare.occluded_by_scene if self.run is not None else None
        if self.run is None or settings is None:
            return light
        seen = share_seen(self.run.scene, camera.position, light.xyz, settings, self._clear.get(light.source, 1.0))
        return PlacedLight(light.name, light.source, light.xyz, light.share * seen)


@dataclass(frozen=True)
class _OfFrame:
    """A frame of a shot."""

    renderer: ShotRenderer
    one: ShotFrame
    rest = ()

    @property
    def fingerprint(self) -> str:
        """Of the frame's camera, lights and edits."""
        return hashlib.sha256(self.one.described().encode()).hexdigest()[:16]

    @property
    def words(self) -> Sequence[str]:
        """The shot's own edits."""
        return self.one.edits

    def render(self, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        return self.renderer.render(self.one, camera, edits)

    def finished(self, layers: FrameLayers, camera: Camera) -> FrameLayers:  # noqa: ARG002 - nothing to add
        return layers


def bake_shot(shot: Shot, out: Path | str, *, half: bool = True, overwrite: bool = False,
              progress: Progress | None = None, wanted: Container[int] | None = None, space: str = "linear",
              config: str | None = None) -> dict[str, Any]:
    """Write the layers of a shot's frames under `out`: `layers.0001.exr` for one camera, in a folder for each of
    several. wanted: frame numbers, None for all. space, config: see `BakeSettings`. Returns the content of bake.json.
    Raises what `bake` raises, and FlareFileError."""
    folders = shot.folders
    shown = {f"{one.name}/{one.frame}": one for one in shot.frames if wanted is None or one.frame in wanted}
    frames = [Frame(view, one.frame, layers_file(folders[one.name], one.frame)) for view, one in shown.items()]
    cameras = {view: one.camera for view, one in shown.items()}
    renderer = ShotRenderer(shot)
    settings = BakeSettings(half=half, space=space, config=config)
    return bake_frames(renderer, frames, cameras, out, lambda frame: _OfFrame(renderer, shown[frame.view]), settings,
                       progress, overwrite=overwrite)
