# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a fitted flare for the frames of a target: one instance for each light, composited over the background.

Flares are evaluated in normalised image coordinates, so the target may have any focal length, principal point, aspect
ratio and resolution. Lights that are hidden or behind the camera have no flare.
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
from ..choices import Device, Follows
from ..colour import ColourSpace, colour_space
from ..colour.srgb import Pixels
from ..colour.srgb_torch import decode, encode
from ..conventions.frame_numbers import NumberedFrame
from ..errors import SettingsError
from ..fit.rendering import render_scene, splat_look
from ..fit.run import ViewLayers
from ..flare.compositing import linear_layers as linear_layers
from ..flare.visibility import VisibilitySettings, visibility_behind
from ..gaussians import Splats
from ..gaussians.device import select_device
from ..images.picture import Picture
from ..images.window import DataWindow, crop_to_display_window, move_to_window
from ..lights.highlights import find_highlights
from ..look import LightLook, LookEdits, PlacedLight, PlaneGaussians, ViewOfLight, read_look
from ..look.placed_light import evaluate_placed
from ..system.files import check_no_overwrite
from ..system.progress import Progress
from ..system.reading import read_bytes
from . import query as queries
from .highlights import move_to_highlights
from .plates import AUTO, ColouredPlate, alpha_with_light
from .target import Target, TargetFrame, plate_window, undistorted_background
from .visibility import smooth_visibility

VISIBILITY_MARGIN = 0.02
"""Visibilities this close to 0 or 1 are set to 0 or 1, since splats never hide or show all of a light. A shot bake
(`core.bake.shot`) does not do so, since its flare was fitted with the visibilities of its own scene."""

PLATES_FOLDER = "frames"
"""Folder of the plates with their flares, beside the layers."""


@dataclass(frozen=True)
class TransferSettings:
    """Settings of a transfer. query: view that the appearance follows ("source", "target" or "blend"). scale: units of
    the target's world for one of the source's. smooth: frames on either side over which visibility is smoothed, 0 for
    none. plate_space: colour space of the plates, "auto" for that of their capture or files. visibility: how the
    target's scene hides lights. fall_off: reference distance of the inverse square fall-off, world units, 0 for the
    distance in the first frame, None for no fall-off; lights with a reference distance of their own keep it.
    highlights: luminance from which pixels of the plates are lights, instead of the target's; None for the target's.
    highlight_gain: factor of these."""

    query: Follows = "blend"
    scale: float = 1.0
    smooth: int = 1
    plate_space: str = AUTO
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)
    fall_off: float | None = field(default=None, repr=False)  # in the fingerprints of frames
    highlights: float | None = field(default=None, repr=False)  # in the fingerprint
    highlight_gain: float = field(default=1.0, repr=False)


class Transfer:
    """The transfer of a flare to a target; `frame_renderer` renders frames, `bake` writes them.

    training: poses (4, 4) of the training views, for a .flare that does not list them. config: OpenColorIO
    configuration with the space of the plates, if any.
    """

    def __init__(self, flare: Path, target: Target, settings: TransferSettings | None = None,
                 training: Sequence[ArrayLike] | None = None, config: str | None = None,
                 device: Device = "cpu") -> None:
        """Read the look of `flare`, and index the target's frames. device: of the rasterizer, to which the target's
        scene is moved. Raises FlareFileError."""
        self.device = select_device(device)
        if target.scene is not None:
            target.scene.to(self.device)
        self.flare, self.target, self.settings, self.config = flare, target, settings or TransferSettings(), config
        self.look = read_look(flare)
        self.sources = {light.name: light for light in self.look.lights}
        self.training_views = queries.training_views(flare, self.look.lights, training)
        self._visibilities: dict[tuple[int, str], tuple[float, tuple[float, ...] | None]] = {}
        """Results of `_frame_visibility`, by index of the frame and name of the light."""
        self._fixed_views_by_light = self._fixed_views() if self.settings.query == "source" else {}
        self._index_by_view = {target_frame.frame.view: index for index, target_frame in enumerate(target.frames)}

    # ---- the interface of `core.bake` -------------------------------------------------------------

    @cached_property
    def fingerprint(self) -> str:
        """A hash of what all frames share: the .flare, the target's scene and the settings. `frame_fingerprint` covers
        the rest."""
        digest = hashlib.sha256(read_bytes(self.flare))
        digest.update(self.target.fingerprint().encode())
        space_fingerprint = self.plate_space.fingerprint if self.plate_space is not None else ""
        digest.update(repr((self.settings, self.config, space_fingerprint, sorted(self.training_views))).encode())
        if self.settings.highlights is not None:
            digest.update(repr((self.settings.highlights, self.settings.highlight_gain)).encode())
        return digest.hexdigest()[:16]

    def frame_fingerprint(self, index: int) -> str:
        """Return a hash of a frame and of the neighbours that the visibility of its lights depends on."""
        radius = 2 * self.settings.smooth  # smoothing reaches so many frames
        neighbours = self.target.frames[max(index - radius, 0):index + radius + 1]
        fixed_views = [(name, view.camera.tolist(), view.light.tolist())
                       for name, view in self._fixed_views_by_light.items()]
        key_text = "".join(frame.cache_key() for frame in neighbours) + repr(fixed_views)
        if self.settings.fall_off is not None:
            key_text += repr([self._reference_distance(light) for light in self.target.frames[index].shot.lights])
        return hashlib.sha256(key_text.encode()).hexdigest()[:16]

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the target's lights."""
        return self.target.lights

    @property
    def elements(self) -> dict[str, list[str]]:
        """Names of each light's elements: those of its source."""
        names = self.look.element_names
        return {light.name: names.get(light.source, []) for frame in self.target.frames for light in frame.shot.lights}

    # ---- flares -----------------------------------------------------------------------------------

    def flares(self, index: int, camera: Camera, edits: LookEdits | None = None, scene: Pixels | None = None
               ) -> dict[str, Splats]:
        """Return the splats of each light with a flare in a frame, for a camera, by the light's name.

        scene (height, width, 3): linear light of the frame at the camera's size, in which highlights are found; None
        to use the target's lights."""
        lights: Sequence[PlacedLight] = self.target.frames[index].shot.lights
        if self.settings.highlights is not None and scene is not None:
            highlights = find_highlights(scene, self.settings.highlights, self.settings.highlight_gain)
            lights = [move_to_highlights(light, highlights, camera) for light in lights] if len(highlights) else []
        splats: dict[str, Splats] = {}
        for light, source in self.look.visible_lights(lights, edits):
            def evaluate(view: ViewOfLight, visibility: float, light: PlacedLight = light, source: LightLook = source
                         ) -> PlaneGaussians | None:
                return queries.evaluate(
                    source, view, light.xyz, self.settings.query, self.training_views.get(light.source),
                    visibility=visibility, edits=edits, name=light.name, scale=self.settings.scale,
                    fixed=self._fixed_views_by_light.get(light.name))

            placed = replace(light, visibility=self.visibility(index, light.name),
                             shares=self._shares(index, light.name),
                             reference_distance=self._reference_distance(light))
            gaussians = evaluate_placed(placed, camera.world_to_camera, self.look.blend, evaluate,
                                        self.look.pixel_grid)
            if gaussians is not None:
                splats[light.name] = splat_look(self.look, gaussians, camera, self.device)
        return splats

    def visibility(self, index: int, light: str) -> float:
        """Return the visibility of a light in a frame, 0..1, smoothed along the path."""
        frames = [frame.shot for frame in self.target.frames]
        return smooth_visibility(frames, index, light, self.settings.smooth,
                                 lambda neighbour: self._frame_visibility(neighbour, light)[0])

    def _frame_visibility(self, index: int, light: str) -> tuple[float, tuple[float, ...] | None]:
        """Return a light's visibility in one frame, 0..1, and the visible share of each cell of its extent, or None.

        The visibility is that in the shot, multiplied by that behind the target's scene, and not smoothed along the
        path. Results are cached.
        """
        key = (index, light)
        if key not in self._visibilities:
            shot = self.target.frames[index].shot
            placed = next((shot_light for shot_light in shot.lights if shot_light.name == light), None)
            visibility, shares = (0.0, None) if placed is None else (placed.visibility, placed.shares)
            if placed is not None and visibility > 0 and self.target.scene is not None:
                source = self.sources[placed.source]
                # If the light is exactly where it was in the fit, the scene is probably that of the fit.
                is_fit_scene = np.allclose(placed.xyz, source.xyz, rtol=1e-6, atol=1e-9)
                scene_visibility, shares = visibility_behind(self.target.scene, shot.camera.world_to_camera, placed,
                                                             self.settings.visibility,
                                                             source.clear_visibility if is_fit_scene else 1.0)
                visibility *= _without_margin(scene_visibility)
                shares = shares and tuple(map(_without_margin, shares))
            self._visibilities[key] = visibility, shares
        return self._visibilities[key]

    def _shares(self, index: int, light: str) -> tuple[float, ...] | None:
        """Return the visible shares of the cells of a light's extent in a frame, not smoothed: an extent is soft."""
        return self._frame_visibility(index, light)[1]

    def _reference_distance(self, light: PlacedLight) -> float:
        """Return the reference distance of a light's fall-off: the target's, else that of the settings, where 0 stands
        for the distance in the first frame that has the light; 0 for no fall-off."""
        fall_off = self.settings.fall_off
        if light.reference_distance or fall_off is None:
            return light.reference_distance
        return fall_off or self._first_distances.get(light.name, 0.0)

    @cached_property
    def _first_distances(self) -> dict[str, float]:
        """The distance of each light from the camera in the first frame that has it in front of the camera."""
        distances: dict[str, float] = {}
        for frame in self.target.frames:
            pose = frame.shot.camera.world_to_camera
            for light in frame.shot.lights:
                if light.name not in distances and ViewOfLight.of(pose, light.xyz).depth > 0:
                    distances[light.name] = float(np.linalg.norm(frame.shot.camera.position - light.xyz))
        return distances

    def _fixed_views(self) -> dict[str, ViewOfLight]:
        """Return the training view of each light for the query `source`, by name (`query.fixed_view`); lights that are
        never in front of the camera have none."""
        view_by_light = {}
        for name in self.lights:
            placed = [(frame.shot.camera, light) for frame in self.target.frames for light in frame.shot.lights
                      if light.name == name]
            views = [ViewOfLight.of(camera.world_to_camera, light.xyz) for camera, light in placed]
            distances = [float(np.linalg.norm(camera.position - light.xyz)) / self.settings.scale
                         for camera, light in placed]
            source = placed[0][1].source
            view = queries.fixed_view(self.sources[source], views, distances, self.training_views.get(source))
            if view is not None:
                view_by_light[name] = view
        return view_by_light

    # ---- frames -----------------------------------------------------------------------------------

    def frame_renderer(
        self, frame: NumberedFrame, space: ColourSpace | None = None, out: Path | None = None,
        progress: Progress | None = None
    ) -> _FrameRenderer:
        """Return the renderer of a frame; with `out` it also writes the plate with its flare there, and reports to
        `progress` what that cannot keep."""
        return _FrameRenderer(self, self._index_by_view[frame.view], space or colour_space("linear"), out, progress)

    def bake(self, out: Path | str, requested: Sequence[NumberedFrame] | None = None,
             settings: BakeSettings | None = None, progress: Progress | None = None, *,
             overwrite: bool = False) -> dict[str, Any]:
        """Write layers of the frames (`requested`, else all) under `out`, and plates with their flares to `out`/frames.

        Layers are 32 bit if a plate is. Returns the content of bake.json; raises the errors of `core.bake.bake.bake`.
        """
        settings = settings or BakeSettings()
        space = colour_space(settings.space, settings.config)
        targets = self.target.frames
        frames = list(requested) if requested is not None else [target.frame for target in targets]
        cameras = {target.frame.view: target.shot.camera for target in targets}
        if settings.half and self._has_full_float():
            settings = replace(settings, half=False)
        self._check_no_overwrite(Path(out))
        plates = Path(out) / PLATES_FOLDER
        return bake_frames(self, frames, cameras, out,
                           lambda frame: self.frame_renderer(frame, space, plates, progress),
                           settings, progress, overwrite=overwrite)

    def _check_no_overwrite(self, out: Path) -> None:
        """Raise SettingsError if results would overwrite plates, or lie in their folder, where the next transfer would
        read layers as plates."""
        plates = [frame.plate for frame in self.target.frames if frame.plate is not None]
        results = [out / frame.frame.file for frame in self.target.frames]
        results += [path for frame in self.target.frames if (path := frame.plate_with_flare_path(out / PLATES_FOLDER))]
        check_no_overwrite(plates, results)
        if out.resolve() in {path.resolve().parent for path in plates}:
            raise SettingsError(f"The layers would lie among the plates, in {out}; choose another folder for them.")

    def _has_full_float(self) -> bool:
        """Return whether a plate has 32 bit floats, judged by the first plate of each file type."""
        frame_by_suffix: dict[str, TargetFrame] = {}
        for frame in self.target.frames:
            if frame.plate is not None:
                frame_by_suffix.setdefault(frame.plate.suffix.lower(), frame)
        return any(self.plate(frame).is_full_float for frame in frame_by_suffix.values())

    def plate(self, frame: TargetFrame) -> ColouredPlate:
        """Read the frame's plate, in its space."""
        assert frame.plate is not None
        return ColouredPlate.read(frame.plate, self.plate_space or frame.space, frame.orientation)

    @property
    def plate_space(self) -> ColourSpace | None:
        """The space that the settings name for the plates; None for that of the capture or file. Raises SettingsError.
        """
        name = self.settings.plate_space
        return None if name == AUTO else colour_space(name, self.config)


def _without_margin(visibility: float) -> float:
    """Return 0 or 1 for a visibility nearer to them than VISIBILITY_MARGIN, and the range between stretched to 0..1."""
    return min(max((visibility - VISIBILITY_MARGIN) / (1 - 2 * VISIBILITY_MARGIN), 0.0), 1.0)


class _FrameRenderer:
    """The renderer of one frame of a transfer, for `core.bake.bake.bake_frames`."""

    def __init__(self, transfer: Transfer, index: int, space: ColourSpace, out: Path | None,
                 progress: Progress | None) -> None:
        self._transfer, self._index, self._space, self._out = transfer, index, space, out
        self._progress = progress or Progress()
        self._frame = transfer.target.frames[index]
        self._plate: ColouredPlate | None = None

    @property
    def fingerprint(self) -> str:
        """See `Transfer.frame_fingerprint`."""
        return self._transfer.frame_fingerprint(self._index)

    @property
    def edit_texts(self) -> Sequence[str]:
        """Texts of the shot's own edits."""
        return self._frame.shot.edits

    @property
    def extra_files(self) -> Sequence[Path]:
        """Path of the plate with its flare, if one is written."""
        path = self._frame.plate_with_flare_path(self._out) if self._out is not None else None
        return [] if path is None else [path]

    def render(self, camera: Camera, edits: LookEdits | None = None) -> ViewLayers:
        """Render scene, flare of each light, and depth; scene-linear Rec. 709."""
        with torch.no_grad():
            scene, depth = self._background(camera)
            flares = self._transfer.flares(self._index, camera, edits, scene)
            # The blend "over" works in display space, over the clipped scene; the scene layer stays unclipped.
            display = encode(torch.from_numpy(np.clip(scene, 0, 1)).to(self._transfer.device))
            parts = linear_layers(display, flares, self._transfer.look.blend)
        black = np.zeros_like(scene)
        return ViewLayers(scene, {name: parts.flares[name].cpu().numpy() if name in parts.flares else black
                                  for name in self._transfer.lights}, depth)

    def _background(self, camera: Camera) -> tuple[Pixels, Pixels]:
        """Return scene light (h, w, 3) and depth (h, w) behind the flare: the plate, the rendered scene, or black.

        Keeps a plate of the layers' size for `finish`."""
        target, frame = self._transfer.target, self._frame
        no_depth = np.zeros((camera.height, camera.width), np.float32)
        if frame.plate is not None:
            undistorted = undistorted_background(frame, camera.size, self._transfer.plate_space)
            if undistorted is not None:
                return undistorted, no_depth
            plate = self._transfer.plate(frame)
            stored_window = plate_window(frame.plate, frame.orientation)
            if frame.window is not None and frame.window.size == camera.size:
                self._plate = plate
                return move_to_window(plate.linear, stored_window, frame.window), no_depth
            picture = Picture(crop_to_display_window(plate.linear, stored_window), "linear")
            return np.asarray(picture.resized(*camera.size).pixels, np.float32), no_depth
        if target.scene is not None and target.scene_is_background:
            rendering = render_scene(target.scene, camera)
            light = decode(rendering.colour.clamp(0, target.scene.display_white))
            return light.cpu().numpy(), rendering.depth.cpu().numpy()
        return np.zeros((camera.height, camera.width, 3), np.float32), no_depth

    def finish(self, layers: FrameLayers, camera: Camera) -> FrameLayers:
        """Write the plate with its flare; return the layers in the window of the plate, with its alpha.

        Layers without a plate of their size are returned unchanged.
        """
        frame, plate = self._frame, self._plate
        if plate is None or frame.plate is None or frame.window is None or frame.window.size != camera.size:
            return layers
        stored_window = plate_window(frame.plate, frame.orientation)
        self._write_plate(plate, layers, frame.window, stored_window)
        return self._with_plate_window(plate, layers, frame.window, stored_window)

    def _write_plate(self, plate: ColouredPlate, layers: FrameLayers, window: DataWindow,
                     stored_window: DataWindow) -> None:
        """Write the plate with its flare, if the renderer has a folder for it. window: data window of the layers.
        stored_window: data window of the plate's file."""
        path = self._frame.plate_with_flare_path(self._out) if self._out is not None else None
        if path is None:
            return
        plate.write(path, move_to_window(self._space.to_linear(layers.flare), window, stored_window))
        if plate.plate.warning:
            self._progress.say(plate.plate.warning)

    def _with_plate_window(self, plate: ColouredPlate, layers: FrameLayers, window: DataWindow,
                           stored_window: DataWindow) -> FrameLayers:
        """Return the layers with their window, with the plate's alpha, and with its values as scene where both have one
        colour space. window: data window of the layers. stored_window: data window of the plate's file."""
        layers = replace(layers, window=window)
        plate_matrix, matrix = plate.space.matrix, self._space.matrix  # None for a space that is not linear
        if plate_matrix is not None and matrix is not None and np.allclose(plate_matrix, matrix, atol=1e-9)\
                and not plate.has_straight_alpha:
            layers = replace(layers, scene=move_to_window(plate.values, stored_window, window))
        if plate.alpha is None:
            return layers
        alpha = alpha_with_light(move_to_window(plate.alpha, stored_window, window), layers.composite)
        return replace(layers, alpha=alpha)
