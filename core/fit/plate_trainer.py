# SPDX-License-Identifier: GPL-3.0-or-later
"""The fit of a flare over plates, for shots whose cameras are not solved, or in which something moves.

    L = |P_t + sum_l b_lt F(x_lt) - I_t|        frame t: plate P, flare F at the light's place x, brightness b

The loss starts with squares: with absolute values from the start, the flare vanishes, since most pixels have none. The
plates are estimates of the removal network, or exact clean frames; the brightness of each light in each frame is an
unknown. `run_loop` calls it where `settings.uses_plates`.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ..capture import Camera, Capture, View
from ..capture.discs import CLIP_LEVEL, light_disc_mask
from ..colour.srgb import Pixels
from ..colour.srgb_torch import decode, encode
from ..conventions.pixel_grid import PixelGrid
from ..conventions.run_files import PLATES
from ..errors import CaptureError, RunError
from ..flare.compositing import composite
from ..flare.model import FlareModel
from ..gaussians.loss import l1_ssim
from ..images.picture import Picture
from ..removal.jobs.fitted import remove_fitted_flare
from ..system.progress import Progress
from .checkpoint import FitInputs, State
from .flare_trainer import FlareTrainer
from .frames import DeviceFrames, Frames, Targets, masked
from .initialise import initial_flare
from .light_brightness import solve_brightness
from .optimisers import Optimisers
from .plate_estimates import PlateEstimator, ShotFrames
from .plate_scene import PlateScene
from .rendering import render, render_flare
from .settings import FitSettings
from .warnings import footage_warnings

MIN_BRIGHTNESS = 0.01
"""Brightness up to which a light counts as out."""
PLATE_CODES = 65535
"""Steps of a plate's display values from 0 to 1."""


class PlateTrainer(FlareTrainer):
    """Fits the flare of a shot, composited over its plates. Raises CaptureError without clean frames or lights."""

    def __init__(self, capture: Capture, settings: FitSettings, exposures: Mapping[str, float] | None = None,
                 progress: Progress | None = None) -> None:
        """Read the frames and clean frames, make the initial flare, and estimate the first plates.

        exposures: exposure of each view, by name; a plate has the exposure of its frame."""
        super().__init__(settings)
        self.exposures = exposures or {}
        self.capture = capture = capture.with_frame_names()
        self.frames = Frames(capture, settings.width, display_white=settings.display_white, truth=settings.supervised)
        if not self.frames.clean_source:
            raise CaptureError(f"{capture.folder} has no clean frames (removed/); run remove on it first.")
        self.views, _ = capture.split(settings.holdout)
        self.flare = initial_flare(capture, self.views, self.frames, settings)
        self.warnings = (*self.frames.warnings, *footage_warnings(capture, settings, self.views, self.frames))
        self._inputs = FitInputs(capture, clean_frames=self.frames.clean_source == "removed", lights=True)
        self._device_frames = DeviceFrames(self.frames, self.device)
        self.flare.move_to(self.device)
        self.optimisers = Optimisers(scene=None, flare=self.flare, settings=settings, extent=capture.extent,
                                     display_white=self.frames.display_white)
        self._progress = progress or Progress()
        self._plates: dict[str, Tensor] = {}
        """Estimated plates by frame, where they are other than the clean frames."""
        self._estimator = self._make_estimator() if settings.plates.aligned and not settings.supervised else None
        self._estimate_plates()

    def _make_estimator(self) -> PlateEstimator:
        """Return an estimator over the capture's frames and clean frames."""
        frames = {view.name: self.frames.frame(view).numpy() for view in self.capture.views}
        plates = {view.name: clean.numpy() for view in self.capture.views
                  if (clean := self.frames.clean(view)) is not None}
        return PlateEstimator(ShotFrames(frames, plates))

    @torch.no_grad()
    def _estimate_plates(self, *, subtract_flare: bool = False) -> None:
        """Estimate the plates of all frames from neighbouring frames; does nothing without an estimator.

        Neighbours show the background by their clean frames, or with `subtract_flare` by the frames minus the fitted
        flare. A frame whose lights are all out is its own plate.
        """
        if self._estimator is None:
            return
        cleaned = {view.name: self._without_flare(view) for view in self.capture.views} if subtract_flare else None
        self._progress.stage("estimate plates", len(self.capture.views))
        for view in self.capture.views:
            if not self._is_lit(view):  # the frame as filmed has no flare
                self._plates[view.name] = self.frames.frame(view)
                self._progress.advance()
                continue
            plate = torch.from_numpy(self._estimator.estimate(view.name, cleaned))
            self._plates[view.name] = (plate * PLATE_CODES).round() / PLATE_CODES  # as a checkpoint stores it
            self._progress.advance()

    def _is_lit(self, view: View) -> bool:
        """Return whether at least one light is lit in a view."""
        assert self.flare is not None and self.flare.frame_lights is not None
        brightness = self.flare.frame_lights.brightness_in(view.name)
        return brightness is None or bool((brightness > MIN_BRIGHTNESS).any())

    def _without_flare(self, view: View) -> Pixels:
        """Return a frame minus the fitted flare, display values; where the frame is clipped, its plate."""
        layers = self.render_view(view).layers
        frame = self.frames.frame(view)
        clean = encode((decode(frame) - layers.flare).clamp_min(0))
        clipped = (frame >= CLIP_LEVEL * self.frames.display_white).any(-1, keepdim=True)
        return torch.where(clipped, self._plate(view), clean).numpy()

    def _plate(self, view: View) -> Tensor:
        """Return the plate of a view, display values."""
        plate = self._plates.get(view.name)
        if plate is not None:
            return plate
        clean = self.frames.clean(view)
        assert clean is not None
        return clean

    @property
    def scene(self) -> PlateScene:
        """The plates as a scene: one for each frame, by the frame's name."""
        cameras = {view.name: self.frames.camera(view) for view in self.capture.views}
        views = {view.name: view for view in self.capture.views}

        def read(frame: str) -> Picture:
            return Picture(self._plate(views[frame]).numpy(), "srgb")

        return PlateScene(cameras, read, self.frames.display_white)

    def step(self) -> dict[str, float]:
        """Run one iteration on the next view; return "loss", that of the composite, or nothing if no light is in front
        of the camera. Raises RunError if it is not finite."""
        self.iteration += 1
        assert self.flare is not None
        settings, view = self.settings, self._pick_view()
        targets, mask = self._device_frames.read(view)
        self.optimisers.set_rates(self.iteration)
        flare = render_flare(self.flare, settings.blend, targets.camera, settings.kernels)
        if flare is None:  # no light is in front of the camera
            return {}
        picture = composite(self._background(view, targets), flare, settings.blend, self.frames.display_white)
        loss = self._loss(masked(picture, targets.frame, mask), targets.frame)
        metrics = {"loss": float(loss.detach())}
        self.losses[view.name] = metrics["loss"]
        if not math.isfinite(metrics["loss"]):
            raise RunError(f"The fit diverged at iteration {self.iteration}; start it anew with lower learning rates.")
        pose = torch.from_numpy(targets.camera.world_to_camera)
        (loss + self._flare_penalty(pose, targets.camera.frame)).backward()
        self.optimisers.step(scene=False)
        self._change_flare_density()
        self._update_brightness_and_plates()
        return metrics

    def _update_brightness_and_plates(self) -> None:
        """At intervals, solve the brightness of the lights in all frames and, from `refine_at` of the fit on, estimate
        the plates again with the flare subtracted; in other iterations do nothing."""
        every = max(round(self.settings.brightness.solve_every * self.settings.iterations), 1)
        if self.iteration % every == 0 and self.iteration < self.settings.iterations:
            assert self.flare is not None
            solve_brightness(self.flare, self.capture.views, self.frames, self.render_view)
            if self.iteration >= self.settings.plates.refine_at * self.settings.iterations:
                self._estimate_plates(subtract_flare=True)

    def _loss(self, picture: Tensor, frame: Tensor) -> Tensor:
        """Return the loss of a composite against its frame: squares alone at first, then with L1 and SSIM.

        Squares count less where the composite is brighter: estimated plates more often contain flare than lack light.
        picture: the composite; both (height, width, 3), display values.
        """
        settings = self.settings.plates
        error = picture - frame
        weight = torch.where(error > 0, 1 / settings.excess_weight, 1.0)
        squares = (weight * error.square()).mean() * settings.squares_weight
        if self.iteration <= settings.squares_until * self.settings.iterations:
            return squares
        return squares + l1_ssim(picture, frame, 1 - self.settings.ssim_share) * settings.l1_weight

    def _background(self, view: View, targets: Targets) -> Tensor:
        """Return the plate, black in the lights' clipped discs: there the flare has to be white by itself."""
        assert self.flare is not None
        plate = self._plate(view)
        if self.settings.blend != "add":
            return plate.to(self.device)
        lights = self.flare.positions_in(targets.camera.frame).numpy()
        discs = torch.from_numpy(light_disc_mask(plate.numpy(), targets.camera, lights))
        return plate.masked_fill(discs[..., None], 0).to(self.device)

    def finish(self, folder: Path, pixel_grid: PixelGrid, progress: Progress) -> None:
        """Write the plates: the frames without the fitted flare, and where they are clipped the plates of the fit."""
        assert self.flare is not None
        capture = self.capture
        renderer = _FitRenderer(self.scene, self.flare, self.settings, pixel_grid)
        remove_fitted_flare(renderer, capture, capture.views, folder / PLATES, progress, overwrite=True,
                            above_white=self.settings.display_white > 1)

    def state(self) -> State:
        """Return all that a resumed fit needs, in the form of `checkpoint.save`."""
        plates = {str(number): (self._plates[view.name] * PLATE_CODES).round().to(torch.int32)
                  for number, view in enumerate(self.capture.views) if view.name in self._plates}
        return {**self._flare_state(), **self._inputs.state(), "plates": plates}

    def load_state(self, state: State) -> None:
        """Restore a state. Raises RunError if it does not fit the capture and settings, or the inputs have changed."""
        try:
            self._inputs.check(state)
            self._load_flare_state(state)
            for number, plate in state.get("plates", {}).items():
                self._plates[self.capture.views[int(number)].name] = plate.float() / PLATE_CODES
        except (KeyError, RuntimeError, TypeError, ValueError) as problem:
            raise RunError(f"The checkpoint does not fit this fit ({problem}); start it anew.") from problem


@dataclass(frozen=True)
class _Layers:
    """Layers of a view, see `core.capture.renderer.RenderedLayers`."""

    scene: Pixels
    flare_by_light: Mapping[str, Pixels]
    depth: Pixels


@dataclass(frozen=True)
class _FitRenderer:
    """Renders the layers of a fit that is no run yet."""

    scene: PlateScene
    flare: FlareModel
    settings: FitSettings
    pixel_grid: PixelGrid

    def render(self, camera: Camera) -> _Layers:
        view = render(self.scene, self.flare, self.settings.blend, camera, self.settings.kernels,
                      pixel_grid=self.pixel_grid)
        flares = {name: layer.numpy() for name, layer in view.layers.flares.items()}
        return _Layers(view.layers.scene.numpy(), flares, view.scene.depth.numpy())
