# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes the frames of a shot (core/look/shot.py), and draws them with numpy alone.

`bake_shot_frames` takes any renderer of shots: `LookRenderer` here, which needs no engine, or `core.bake.shot`'s, which
is faster and also renders the scene of a fit. Both draw the same picture, so one continues what the other began.
"""
from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..capture.renderer import RenderedLayers
from ..colour.srgb import Pixels
from ..conventions.frame_numbers import NumberedFrame, layers_file
from ..errors import SettingsError
from ..look import LookEdits, read_look
from ..look.pyramid import draw_layers
from ..look.shot import Shot, ShotFrame
from ..system.progress import Progress
from .bake import BakeSettings, bake_frames
from .layers import FrameLayers


@dataclass(frozen=True)
class ShotLayers:
    """Scene-linear layers of a frame, as `RenderedLayers`."""

    scene: Pixels
    flare_by_light: Mapping[str, Pixels]
    depth: Pixels


class ShotSource(ABC):
    """A shot with its look, as a source of frames for `bake_frames`; subclasses render."""

    def __init__(self, shot: Shot) -> None:
        self.shot, self.look = shot, read_look(shot.flare)
        self.lights = shot.lights

    @property
    def elements(self) -> Mapping[str, list[str]]:
        """Names of each placed light's elements."""
        names_by_source = self.look.element_names
        return {light.name: names_by_source.get(light.source, [])
                for shot_frame in self.shot.frames for light in shot_frame.lights}

    @property
    def fingerprint(self) -> str:
        """A digest of what all frames share; what belongs to one frame is in the fingerprint of its renderer."""
        return self.shot.fingerprint()

    @abstractmethod
    def render(self, shot_frame: ShotFrame, camera: Camera, edits: LookEdits | None = None) -> RenderedLayers:
        """Render the layers of a frame, under its camera at the size of the layers."""


class LookRenderer(ShotSource):
    """Draws the frames of a shot over black with numpy. Raises SettingsError for a shot with the scene of a fit."""

    def __init__(self, shot: Shot) -> None:
        if shot.run is not None:
            raise SettingsError("The scene of a fit can be baked by the engine only; switch Fitted Scene Too off, or "
                                "leave --without-engine out.")
        super().__init__(shot)

    def render(self, shot_frame: ShotFrame, camera: Camera, edits: LookEdits | None = None) -> RenderedLayers:
        """Render the layers of a frame; scene and depth are 0, and a light without a flare has a black layer."""
        flares = self.look.evaluate_lights(camera.world_to_camera, shot_frame.lights, edits, self.shot.query)
        exposed = {name: gaussians.with_exposure(camera.exposure, self.look.blend)
                   for name, gaussians in flares.items()}
        black = np.zeros((camera.height, camera.width, 3), np.float32)
        layers = draw_layers(self.look, exposed, camera.intrinsics, camera.width, camera.height)
        return ShotLayers(black, {name: layers.get(name, black) for name in self.lights}, black[..., 0])


@dataclass(frozen=True)
class _ShotFrameRenderer:
    """The renderer of one frame of a shot."""

    renderer: ShotSource
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

    def render(self, camera: Camera, edits: LookEdits | None = None) -> RenderedLayers:
        return self.renderer.render(self.shot_frame, camera, edits)

    def finish(self, layers: FrameLayers, camera: Camera) -> FrameLayers:  # noqa: ARG002 - nothing to add
        return layers


def bake_shot_frames(renderer: ShotSource, out: Path | str, *, half: bool = True, overwrite: bool = False,
                     progress: Progress | None = None, frame_numbers: Container[int] | None = None,
                     space: str = "linear", config: str | None = None) -> dict[str, Any]:
    """Write the layers of a shot's frames under `out`: `layers.0001.exr` for one camera, a folder for each of several.

    frame_numbers: None for all. space: linear colour space of the layers; config: the OpenColorIO configuration that
    defines it. Returns the content of bake.json. Raises what `bake` raises, and FlareFileError.
    """
    shot = renderer.shot
    folders = shot.folders
    frame_of_view = {f"{shot_frame.name}/{shot_frame.frame}": shot_frame for shot_frame in shot.frames
                     if frame_numbers is None or shot_frame.frame in frame_numbers}
    frames = [NumberedFrame(view, shot_frame.frame, layers_file(folders[shot_frame.name], shot_frame.frame))
              for view, shot_frame in frame_of_view.items()]
    cameras = {view: shot_frame.camera for view, shot_frame in frame_of_view.items()}
    settings = BakeSettings(half=half, space=space, config=config)
    return bake_frames(renderer, frames, cameras, out,
                       lambda frame: _ShotFrameRenderer(renderer, frame_of_view[frame.view]), settings, progress,
                       overwrite=overwrite)
