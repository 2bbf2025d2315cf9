# SPDX-License-Identifier: GPL-3.0-or-later
"""A captured flare on other frames: one instance for each light that the target shows, merged and composited.

Everything is in normalised image coordinates, so the target's focal length, principal point, aspect and
resolution may be any. Lights behind the camera, and lights that are hidden, give no flare.
"""
from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..bake.bake import BakeSettings, bake_frames
from ..bake.layers import FrameLayers
from ..capture import Camera
from ..choices import Follows
from ..colour import ColourSpace, colour_space
from ..colour.srgb import Pixels
from ..colour.srgb_torch import decode, encode
from ..conventions.frame_numbers import Frame
from ..errors import SettingsError
from ..fit.rendering import render_scene, splat_look
from ..fit.run import ViewLayers
from ..flare.compositing import layers as linear_layers
from ..flare.visibility import VisibilitySettings, share_seen
from ..gaussians import Splats
from ..images.exr import window_of
from ..images.picture import Picture
from ..look import LookEdits, ViewOfLight, read
from ..look.shot import PlacedLight
from ..system.files import check_apart
from ..system.progress import Progress
from . import query as queries
from .plates import AUTO, ColouredPlate
from .target import Target, TargetFrame, background
from .visibility import smoothed

SURE = 0.02
"""Splats never hide all of a light, nor show all of it: a share so near to none or the whole is taken for that. Not so
in a bake (`core.bake.shot`), whose flare was fitted with the scene's shares as they are; here the scene is any."""

FRAMES = "frames"
"""Folder of the plates with their flares, beside the layers."""


@dataclass(frozen=True)
class TransferSettings:
    """query: what appearance follows (see `query`). scale: units of the target's world to one of the source's.
    smooth: frames over which a light's visibility is smoothed on either side, 0 for none. plate_space: of the
    plates, "auto" by their files. visibility: how the target's scene hides lights."""

    query: Follows = "blend"
    scale: float = 1.0
    smooth: int = 1
    plate_space: str = AUTO
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)


class Transfer:
    """A flare on a target; `of_frame` renders, `bake` writes.

    training: poses (4, 4) of the views the flare was learned from, for a .flare that does not tell.
    """

    def __init__(self, flare: Path, target: Target, settings: TransferSettings | None = None,
                 training: Sequence[ArrayLike] | None = None, config: str | None = None) -> None:
        self.flare, self.target, self.settings, self.config = flare, target, settings or TransferSettings(), config
        self.look = read(flare)
        self.sources = {light.name: light for light in self.look.lights}
        self.seen = queries.seen_by(flare, self.look.lights, training)
        self._shares: dict[tuple[int, str], float] = {}
        self._fixed = self._fixed_views() if self.settings.query == "source" else {}
        self._index = {one.frame.view: index for index, one in enumerate(target.frames)}

    # ---- what `bake` asks for ---------------------------------------------------------------------

    @cached_property
    def fingerprint(self) -> str:
        """Changes whenever all pictures would; what is a frame's alone, its renderer's fingerprint tells."""
        digest = hashlib.sha256(self.flare.read_bytes())
        digest.update(self.target.fingerprint().encode())
        plates = self.settings.plate_space
        meaning = "" if plates == AUTO else colour_space(plates, self.config).meaning
        digest.update(repr((self.settings, self.config, meaning, sorted(self.seen))).encode())
        return digest.hexdigest()[:16]

    def fingerprint_of(self, index: int) -> str:
        """Of a frame, and of the neighbours that its lights' visibility depends on."""
        reach = 2 * self.settings.smooth
        near = self.target.frames[max(index - reach, 0):index + reach + 1]
        fixed = [(name, view.camera.tolist(), view.light.tolist()) for name, view in self._fixed.items()]
        told = "".join(one.described() for one in near) + repr(fixed)
        return hashlib.sha256(told.encode()).hexdigest()[:16]

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the target's lights."""
        return self.target.lights

    @property
    def elements(self) -> dict[str, list[str]]:
        """Names of each light's elements, which are its source's."""
        names = self.look.element_names
        return {light.name: names.get(light.source, []) for one in self.target.frames for light in one.shot.lights}

    # ---- flares -----------------------------------------------------------------------------------

    def flares(self, index: int, camera: Camera, edits: LookEdits | None = None) -> dict[str, Splats]:
        """Each light's splats in a frame, under `camera`; of the lights that show something."""
        shot = self.target.frames[index].shot
        names = [light.name for light in shot.lights]
        shown: dict[str, Splats] = {}
        for light in shot.lights:
            if edits is not None and not edits.shows(light.name, names):
                continue
            view = ViewOfLight.of(camera.world_to_camera, light.xyz)
            found = queries.evaluate(
                self.sources[light.source], view, light.xyz, self.settings.query, self.seen.get(light.source),
                share=self.share(index, light.name) if view.depth > 0 else 0.0, edits=edits, name=light.name,
                scale=self.settings.scale, fixed=self._fixed.get(light.name))
            if found is not None:
                shown[light.name] = splat_look(self.look, found, camera)
        return shown

    def share(self, index: int, light: str) -> float:
        """How much of a light is to be seen in a frame, 0..1, smooth along the path."""
        frames = [one.shot for one in self.target.frames]
        return smoothed(frames, index, light, self.settings.smooth, lambda at: self._share(at, light))

    def _share(self, index: int, light: str) -> float:
        """As the frame alone has it: the shot's own figure, and what the target's scene hides."""
        key = (index, light)
        if key not in self._shares:
            shot = self.target.frames[index].shot
            placed = next((one for one in shot.lights if one.name == light), None)
            share = placed.share if placed is not None else 0.0
            if placed is not None and share > 0 and self.target.scene is not None:
                source = self.sources[placed.source]
                own = np.allclose(placed.xyz, source.xyz, rtol=1e-6, atol=1e-9)  # the splats it was learned in
                seen = share_seen(self.target.scene, shot.camera.position, placed.xyz, self.settings.visibility,
                                  source.clear if own else 1.0)
                share *= min(max((seen - SURE) / (1 - 2 * SURE), 0.0), 1.0)
            self._shares[key] = share
        return self._shares[key]

    def _fixed_views(self) -> dict[str, ViewOfLight]:
        """What each light asks for throughout the shot, by its name."""
        fixed = {}
        for name in self.lights:
            placed: list[tuple[ViewOfLight, float, PlacedLight]] = []
            for one in self.target.frames:
                for light in one.shot.lights:
                    if light.name == name:
                        far = float(np.linalg.norm(one.shot.camera.position - light.xyz)) / self.settings.scale
                        placed.append((ViewOfLight.of(one.shot.camera.world_to_camera, light.xyz), far, light))
            source = placed[0][2].source
            view = queries.fixed_view(self.sources[source], [each[0] for each in placed],
                                      [each[1] for each in placed], self.seen.get(source))
            if view is not None:
                fixed[name] = view
        return fixed

    # ---- frames -----------------------------------------------------------------------------------

    def of_frame(self, frame: Frame, space: ColourSpace | None = None, out: Path | None = None) -> _OfFrame:
        """What renders one frame; with `out` it writes the plate with its flare there too."""
        return _OfFrame(self, self._index[frame.view], space or colour_space("linear"), out)

    def bake(self, out: Path | str, wanted: Sequence[Frame] | None = None, settings: BakeSettings | None = None,
             progress: Progress | None = None, *, overwrite: bool = False) -> dict[str, Any]:
        """Write layers of the frames (`wanted`, else all) under `out`, and plates with their flares to `out`/frames.

        Layers are 32 bit where a plate is. Returns the content of bake.json; raises what `bake` raises.
        """
        settings = settings or BakeSettings()
        space = colour_space(settings.space, settings.config)
        frames = list(wanted) if wanted is not None else [one.frame for one in self.target.frames]
        cameras = {one.frame.view: one.shot.camera for one in self.target.frames}
        if settings.half and self._has_full_float():
            settings = replace(settings, half=False)
        self._check_apart(Path(out))
        return bake_frames(self, frames, cameras, out, lambda frame: self.of_frame(frame, space, Path(out) / FRAMES),
                           settings, progress, overwrite=overwrite)

    def _check_apart(self, out: Path) -> None:
        """Raises SettingsError where results would be written over plates, or among them: layers in a folder of plates
        would be plates the next time."""
        plates = [one.plate for one in self.target.frames if one.plate is not None]
        flared = [path for one in self.target.frames if (path := one.flared(out / FRAMES)) is not None]
        check_apart(plates, [*flared, *(out / one.frame.file for one in self.target.frames)])
        if out.resolve() in {path.resolve().parent for path in plates}:
            raise SettingsError(f"The layers would lie among the plates, in {out}; choose another folder for them.")

    def _has_full_float(self) -> bool:
        """By the first plate of each kind of file."""
        first: dict[str, TargetFrame] = {}
        for one in self.target.frames:
            if one.plate is not None:
                first.setdefault(one.plate.suffix.lower(), one)
        return any(self.plate(one).is_full_float for one in first.values())

    def plate(self, one: TargetFrame) -> ColouredPlate:
        """The frame's plate in its own space."""
        assert one.plate is not None
        return ColouredPlate.read(one.plate, self.settings.plate_space, self.config)


class _OfFrame:
    """One frame of a transfer."""

    def __init__(self, transfer: Transfer, index: int, space: ColourSpace, out: Path | None) -> None:
        self._transfer, self._index, self._space, self._out = transfer, index, space, out
        self._one = transfer.target.frames[index]
        self._plate: ColouredPlate | None = None

    @property
    def fingerprint(self) -> str:
        """See `Transfer.fingerprint_of`."""
        return self._transfer.fingerprint_of(self._index)

    @property
    def words(self) -> Sequence[str]:
        """The shot's own edits."""
        return self._one.shot.edits

    @property
    def rest(self) -> Sequence[Path]:
        """The plate with its flare, where one is written."""
        target = self._one.flared(self._out) if self._out is not None else None
        return [] if target is None else [target]

    def render(self, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        """Scene, flare of each light, depth; scene-linear Rec. 709."""
        with torch.no_grad():
            scene, depth = self._background(camera)
            flares = self._transfer.flares(self._index, camera, edits)
            # What covers does so in display space, over what a screen shows of the scene; the scene stays unclipped.
            display = encode(torch.from_numpy(np.clip(scene, 0, 1)))
            parts = linear_layers(display, flares, self._transfer.look.blend)
        dark = np.zeros_like(scene)
        return ViewLayers(scene, {name: parts.flares[name].numpy() if name in parts.flares else dark
                                  for name in self._transfer.lights}, depth)

    def _background(self, camera: Camera) -> tuple[Pixels, Pixels]:
        target, one = self._transfer.target, self._one
        nothing = np.zeros((camera.height, camera.width), np.float32)
        if one.plate is not None:
            space = self._transfer.settings.plate_space
            straight = background(one, camera.size,
                                  None if space == AUTO else colour_space(space, self._transfer.config))
            if straight is not None:
                return straight, nothing
            plate = self._transfer.plate(one)
            if plate.size == camera.size:
                self._plate = plate
                return plate.linear, nothing
            return np.asarray(Picture(plate.linear, "linear").resized(*camera.size).pixels, np.float32), nothing
        if target.scene is not None and target.shown:
            rendering = render_scene(target.scene, camera)
            return decode(rendering.colour.clamp(0, target.scene.display_white)).numpy(), rendering.depth.numpy()
        return np.zeros((camera.height, camera.width, 3), np.float32), nothing

    def finished(self, layers: FrameLayers, camera: Camera) -> FrameLayers:
        """The layers where their plate lies, with its own numbers where the spaces are one; writes the plate with its
        flare."""
        if self._plate is None or self._plate.size != camera.size:
            return layers
        target = self._one.flared(self._out) if self._out is not None else None
        if target is not None:
            self._plate.write(target, self._space.to_linear(layers.flare))
        layers = replace(layers, window=window_of(self._plate.plate.path))
        own = self._plate.space.matrix
        if own is not None and self._space.matrix is not None and np.allclose(own, self._space.matrix, atol=1e-9):
            return replace(layers, scene=self._plate.values)
        return layers
