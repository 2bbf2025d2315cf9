# SPDX-License-Identifier: GPL-3.0-or-later
"""The joint optimisation of scene and flare (paper, section "Reconstruction", eq. 5), one iteration at a time.

    L = lambda |I_s - I_o| + (1 - lambda)(1 - SSIM(I_s, I_o))          the scene against the clean frame
      + lambda |I - I_input| + (1 - lambda)(1 - SSIM(I, I_input))      the composite against the frame

Every flare Gaussian lies in front of every scene Gaussian, so the scene is rasterized once for both. All randomness is
a function of (seed, iteration): a resumed fit equals an uninterrupted one. `run_loop` calls it.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor

from ..capture import Capture, View
from ..capture.discs import light_disc_mask
from ..colour.srgb_torch import clip_straight_through
from ..conventions.pixel_grid import PixelGrid
from ..conventions.run_files import SCENE
from ..errors import CaptureError, RunError
from ..flare.compositing import composite
from ..flare.visibility import clear_visibilities, occlusion_loss
from ..gaussians import Rendering, Splats
from ..gaussians.densification import Classic, Mcmc, Strategy
from ..gaussians.loss import l1_ssim
from ..gaussians.ordering import morton_order
from ..gaussians.ply import write_ply
from ..gaussians.scene import SceneGaussians
from ..gaussians.spherical_harmonics import MAX_DEGREE
from ..system.progress import Progress
from . import metering
from .checkpoint import FitInputs, State
from .far_layer import far_layer_messages
from .flare_trainer import FlareTrainer, load_parameters
from .frames import DeviceFrames, Frames, MaskedTargets, Targets, masked, subsample
from .initialise import has_frame_lights, initial_flare, initial_scene
from .optimisers import Optimisers
from .parallax_losses import (
    MAX_EXCESS_RATIO,
    estimate_loss,
    excess_ratio,
    far_flare_penalty,
    quantile_loss,
    scene_loss,
    scene_only_iterations,
)
from .rendering import render_flare, render_scene
from .settings import FitSettings
from .warnings import ambiguity_warnings, footage_warnings, moved_light_warnings

CLEAR_INTERVAL = 50
"""Iterations between two updates of the lights' clear visibility (`visibility.clear_visibilities`)."""
MIN_DIFFERENCE = 0.01
"""Difference in display values between frame and clean frame below which no flare is visible."""
SAMPLED_VIEWS = 40
"""Approximate number of views used for clear visibilities and the test of convergence."""


class Trainer(FlareTrainer):
    """Scene and flare of a capture under optimisation: `step` by `step`, with `state` and `load_state`.

    Raises CaptureError where the capture lacks what the mode needs, Cancelled after a requested stop.
    """

    def __init__(self, capture: Capture, settings: FitSettings, exposures: Mapping[str, float] | None = None,
                 progress: Progress | None = None) -> None:
        """Decode and meter the frames, and make scene, flare and optimisers.

        exposures: exposure of each view, by name; None to measure them.
        """
        super().__init__(settings)
        self.fits_scene = not settings.scene.frozen
        self._excess_ratio = MAX_EXCESS_RATIO
        """`parallax_losses.excess_ratio` of the scene after the passes that fit it alone, in a fit by parallax."""

        # Inputs. Exposures are measured on the frames, and belong to the cameras of all that follows.
        self.frames = Frames(capture, settings.width, display_white=settings.display_white,
                             frames_only=not settings.needs_clean_frames, truth=settings.supervised)
        if exposures is None:
            is_measured = settings.exposure == "measured"
            exposures = metering.measure_exposures(capture, self.frames, progress) if is_measured else {}
        self.exposures = exposures
        capture = capture.with_exposures(exposures)
        # The cameras name their frames only where lights have a place or brightness by frame.
        self.capture = capture = capture.with_frame_names() if has_frame_lights(capture) else capture
        self.views, _ = capture.split(settings.holdout)
        self.extent = capture.extent
        if settings.needs_clean_frames and not self.frames.clean_source and self.fits_scene:
            raise CaptureError(f"{capture.folder} has no clean frames (removed/); run remove on it first, "
                               "or fit with --mode split.")

        # Models, made from the inputs.
        self._scene = initial_scene(capture, settings, self.views, self.frames)
        self.flare = None if settings.mode == "3dgs" else initial_flare(capture, self.views, self.frames, settings)
        self.warnings = (*self.frames.warnings, *far_layer_messages(self.scene),
                         *metering.exposure_warnings(self.exposures),
                         *footage_warnings(capture, settings, self.views, self.frames),
                         *(() if self.flare is None else moved_light_warnings(capture, self.flare)))
        self._inputs = FitInputs(capture, clean_frames=self.frames.clean_source == "removed",
                                 lights=self.flare is not None)

        # Moved before the optimisers take the parameters.
        self._device_frames = DeviceFrames(self.frames, self.device)
        self._scene.to(self.device)
        if self.flare is not None:
            self.flare.move_to(self.device)
        self._disc_pixels: dict[tuple[str, int], Tensor] = {}
        """Numbers of the pixels in the light discs of views that were used, on the CPU, by name and width of the
        picture."""

        # Optimisers and strategy hold the parameters of the models.
        self.optimisers = Optimisers(self.scene, self.flare, settings, self.extent, self.frames.display_white)
        self.strategy = self._make_strategy()

    @property
    def scene(self) -> SceneGaussians:
        """The Gaussians of the scene."""
        return self._scene

    @property
    def scene_size(self) -> int:
        """Number of Gaussians in the scene."""
        return len(self._scene.means)

    def finish(self, folder: Path, pixel_grid: PixelGrid, progress: Progress) -> None:  # noqa: ARG002
        """Write the scene; a frozen one keeps the pixel grid that it was trained at."""
        if not self.settings.scene.frozen:
            self._scene.pixel_grid = pixel_grid
        write_ply(folder / SCENE, self._scene)

    def final_warnings(self) -> tuple[str, ...]:
        """Return the warnings of any fit, and one where parallax hardly decides between scene and flare."""
        warnings = super().final_warnings()
        if not self.settings.uses_parallax:
            return warnings
        return warnings + ambiguity_warnings(self.settings.split, len(self.views), self._excess_ratio)

    # ---- one iteration ----------------------------------------------------------------------------

    def step(self) -> dict[str, float]:
        """Run one iteration on the next view; return its losses by name.

        "loss" is that of the composite, absent while the scene is fitted alone; "scene_loss" that of the scene, absent
        if only the composite supervises it. Raises RunError if either is not finite.
        """
        self.iteration += 1
        settings = self.settings
        view = self._pick_view()
        (targets, mask), (flare_targets, flare_mask) = self._load_targets_of_step(view)
        self.optimisers.set_rates(self.iteration)
        rendering = render_scene(self.scene, targets.camera, settings.kernels, sh_degree=self._sh_degree(), depth=False)
        scene_picture = self._clip_as_filmed(rendering.colour)
        self._update_clear_visibility()
        self._measure_excess_ratio()
        scene_only = self._is_scene_only(targets)
        flare = None if scene_only else render_flare(self.flare, settings.blend, flare_targets.camera,
                                                     settings.kernels, scene=self.scene,
                                                     visibility=settings.flare.active_visibility,
                                                     opacity_floor=self._opacity_floor)
        light_discs = self._light_discs_of(view, flare_targets)
        background = self._flare_background(flare_targets, scene_picture)
        composite_picture = composite(background, flare, settings.blend, self.frames.display_white, light_discs)
        # The losses of composite and scene, and the penalties.
        l1_weight = 1 - settings.ssim_share
        composite_target = self._composite_target(flare_targets, composite_picture.detach(), light_discs)
        loss = (scene_picture.new_zeros(()) if scene_only else
                l1_ssim(masked(composite_picture, composite_target, flare_mask), composite_target, l1_weight))
        metrics = {} if scene_only else {"loss": float(loss.detach())}
        scene_term = self._scene_term(targets, mask, composite_picture, scene_picture, flare, light_discs)
        if scene_term is not None:
            metrics["scene_loss"] = float(scene_term.detach())
            loss = loss + scene_term
        self.losses[view.name] = sum(metrics.values())
        if not all(map(math.isfinite, metrics.values())):
            raise RunError(f"The fit diverged at iteration {self.iteration}; start it anew with lower learning rates.")
        if self.fits_scene:
            loss = loss + self.strategy.regulariser()
        if flare is not None and self.flare is not None:
            pose = torch.from_numpy(targets.camera.world_to_camera)
            loss = loss + self._flare_penalty(pose, targets.camera.frame)
        occlusion_loss = self._occlusion_loss(view)
        if occlusion_loss is not None:
            loss = loss + occlusion_loss
        self._optimise(loss, rendering)
        if not scene_only:  # flare Gaussians are untrained until then, and their opacities say nothing
            self._change_flare_density()
        return metrics

    def _load_targets_of_step(self, view: View) -> tuple[MaskedTargets, MaskedTargets]:
        """Return targets and mask of this iteration, for the loss of the scene and for that of the composite.

        They differ in size only while the flare is composited over the clean frame of the view.
        """
        schedule, size = self.settings.coarse_to_fine, self.frames.camera(view).size
        progress = self.iteration / self.settings.iterations
        # A scene that starts from a PLY has fine detail, which small pictures would destroy.
        is_coarse = self.settings.supervised and self.fits_scene and not self.settings.scene.start
        scene_reduction = schedule.scene_reduction(size, progress) if is_coarse else 1
        scene_targets = self._device_frames.read(view, scene_reduction)
        if not self._is_separate or scene_targets[0].clean is None:
            return scene_targets, scene_targets
        flare_reduction = schedule.flare_reduction(size, progress) if schedule.flare_width else scene_reduction
        return scene_targets, self._device_frames.read(view, flare_reduction)

    @property
    def _is_separate(self) -> bool:
        """True while flares are composited over exact clean frames instead of the scene: until `separate_until`."""
        return self.settings.supervised and self.iteration <= self.settings.separate_until * self.settings.iterations

    def _optimise(self, loss: Tensor, rendering: Rendering) -> None:
        """Backpropagate a loss, make the optimisers' steps, and densify and reorder the scene at intervals.

        rendering: the scene's rendering that the loss was computed from.
        """
        # The step moves far Gaussians, too; `_turn_far_layer` puts them back on their sphere.
        far_rows = self.scene.far_rows()
        far_means = self.scene.means.detach()[far_rows]
        if loss.requires_grad:  # False with a frozen scene and no light in front of the camera
            with self.optimisers.scene.step_in_backward() if self._steps_in_backward else nullcontext():
                loss.backward()
        if self.fits_scene:
            self.strategy.observe(rendering)
        self.optimisers.step(scene=self.fits_scene)
        self._turn_far_layer(far_rows, far_means)
        if self.fits_scene:
            if self.iteration < self.settings.iterations:  # the last iteration's Gaussians would stay untrained
                self.strategy.update(self.iteration)
            self._reorder_scene()

    @torch.no_grad()
    def _turn_far_layer(self, rows: Tensor, old_means: Tensor) -> None:
        """Put the far Gaussians `rows`, which the optimiser moved off their sphere, back on it, turned by the step.

        The angle is that of the same step at the distance of one extent. old_means: (m, 3), their means before the
        step.
        """
        if self.scene.far is not None and self.fits_scene and len(rows):
            steps = self.optimisers.scene.last_step("means", rows) * (self.scene.far.radius / self.extent)
            self.scene.means[rows] = self.scene.far.move(old_means, steps)

    def _clip_as_filmed(self, scene: Tensor) -> Tensor:
        """Clip a scene's picture where the frame clips; with equal exposures the picture already does."""
        return clip_straight_through(scene, self.frames.display_white) if self.exposures else scene

    @property
    def _min_scene_only_iterations(self) -> int:
        """Number of iterations in which every fit by parallax fits the scene alone."""
        return scene_only_iterations(self.settings.split, len(self.views), self.settings.iterations)

    @property
    def _scene_only_iterations(self) -> int:
        """Number of iterations, from the first, in which a fit by parallax fits the scene alone; more once an excess
        ratio was measured that demands it."""
        return scene_only_iterations(self.settings.split, len(self.views), self.settings.iterations,
                                     self._excess_ratio)

    @property
    def _steps_in_backward(self) -> bool:
        """Return whether all gradients of the scene come from one rendering and the visibilities of the lights, so that
        the backward pass may take the optimiser's step."""
        return self.fits_scene and self.settings.scene.strategy == "classic"

    def _update_clear_visibility(self) -> None:
        """Update the lights' clear visibility (that behind the scene where nothing hides them) every CLEAR_INTERVAL
        iterations, from the first on; else do nothing."""
        visibility = self.settings.flare.active_visibility
        if self.flare is None or visibility is None or self.iteration % CLEAR_INTERVAL != 1:
            return
        cameras = [view.camera for view in subsample(self.views, SAMPLED_VIEWS)]
        poses = [torch.from_numpy(camera.world_to_camera) for camera in cameras]
        self.flare.clear.copy_(clear_visibilities(self.scene, self.flare, poses, visibility, self.settings.kernels,
                                                  [camera.frame for camera in cameras]))

    @torch.no_grad()
    def _measure_excess_ratio(self) -> None:
        """In a fit by parallax, after the passes over the views that fit the scene alone, measure `_excess_ratio`,
        which tells whether the scene has converged; else do nothing."""
        if not self.settings.uses_parallax or not 1 <= self._min_scene_only_iterations == self.iteration - 1:
            return

        def residual(view: View) -> Tensor:
            """Return frame minus scene of a view, (height, width, 3) display values, 0 where the mask is black."""
            targets, mask = self._device_frames.read(view)
            scene = render_scene(self.scene, targets.camera, self.settings.kernels, sh_degree=self._sh_degree(),
                                 depth=False)
            return targets.frame - masked(self._clip_as_filmed(scene.colour), targets.frame, mask)

        self._excess_ratio = excess_ratio(residual(view) for view in subsample(self.views, SAMPLED_VIEWS))

    def _occlusion_loss(self, view: View) -> Tensor | None:
        """Return the loss that makes the scene transparent in front of lights that the frame of a view shows although
        the scene hides them from every view; None if there is no such light.

        It looks for them at full size, where the disc of a small lamp is clipped.
        """
        visibility = self.settings.flare.active_visibility
        if self.flare is None or visibility is None or not self.fits_scene or bool((self.flare.clear > 0).all()):
            return None
        targets = self.frames.targets(view)
        frame = targets.frame.numpy()
        visible_lights = [light for light in self.flare.positions_in(targets.camera.frame)[self.flare.clear <= 0]
                          if light_disc_mask(frame, targets.camera, light[None].numpy()).any()]
        eye = torch.from_numpy(targets.camera.position)
        return occlusion_loss(self.scene, eye, visible_lights, visibility, self.settings.kernels)

    def _is_scene_only(self, targets: Targets) -> bool:
        """Return whether the scene is still fitted alone, so that it hides lights by the time their flares are
        fitted."""
        if self.settings.uses_parallax:
            return self.iteration <= self._scene_only_iterations
        flare_started = self.iteration > self.settings.flare.scene_only_until * self.settings.iterations
        return self.settings.supervised and self.fits_scene and targets.clean is not None and not flare_started

    def _flare_background(self, targets: Targets, scene: Tensor) -> Tensor:
        """Return what the flare is composited over, except in the lights' discs, where it is black: the clean frame
        until `separate_until`, then the scene.

        At first the faint parts of a flare would drown in the errors of the scene. Later the scene, on which all views
        agree, is better than one clean frame with its residual flare, except above white, where the scene's errors stay
        larger than a flare.
        """
        if not (self.settings.supervised and targets.clean is not None and self.settings.separate_until):
            return scene
        if self._is_separate:
            return targets.clean
        return scene if self.frames.display_white == 1 else torch.where(targets.clean > 1, targets.clean, scene)

    def _light_discs_of(self, view: View, targets: Targets) -> Tensor | None:
        """Return `_light_disc_mask` of a view, None where no pixel is in a disc.

        The mask is computed once for each size, since nothing in it changes; the numbers of its few pixels are kept.
        """
        key = view.name, targets.camera.width
        if key not in self._disc_pixels:
            mask = self._light_disc_mask(targets)
            self._disc_pixels[key] = (torch.zeros(0, dtype=torch.int64) if mask is None else
                                      mask.flatten().nonzero()[:, 0].cpu())
        pixels = self._disc_pixels[key]
        if not len(pixels):
            return None
        discs = torch.zeros(targets.frame.shape[:2], dtype=torch.bool)
        discs.view(-1)[pixels] = True
        return discs.to(self.device)

    def _light_disc_mask(self, targets: Targets) -> Tensor | None:
        """Return (height, width), True in the clipped disc of each light; None if the blend or the mode uses no discs.

        Frame and clean frame are white in a disc, so the flare's brightness there would be undetermined, and over
        another shot the flare would have a hole. So it is composited over black there, and has to be white by itself.
        If frames go above white, only pixels where frame and clean frame are alike count.
        """
        settings = self.settings
        clean = targets.frame if settings.uses_parallax else targets.clean if settings.supervised else None
        if settings.blend != "add" or self.flare is None or clean is None:
            return None
        discs = torch.from_numpy(light_disc_mask(clean.cpu().numpy(), targets.camera,
                                                 self.flare.positions_in(targets.camera.frame).numpy())).to(clean.device)
        return discs if self.frames.display_white == 1 else discs & (targets.frame - clean < MIN_DIFFERENCE).all(-1)

    def _composite_target(self, targets: Targets, picture: Tensor, light_discs: Tensor | None) -> Tensor:
        """Return the display values that the composite (`picture`) is compared with, (height, width, 3).

        They are those of the frame. In frames with values above white, a light's disc (height, width) is the exception:
        it only has to be white or brighter, so its target is the composite itself, but 1 at least.
        """
        if self.frames.display_white == 1 or light_discs is None:
            return targets.frame
        return torch.where(light_discs[..., None], picture.clamp_min(1), targets.frame)

    def _scene_term(self, targets: Targets, mask: Tensor | None, composite_picture: Tensor, scene_picture: Tensor,
                    flare: Splats | None, light_discs: Tensor | None) -> Tensor | None:
        """Return the loss of the scene's rendering, a scalar; None if the scene is frozen or only the composite
        supervises it.

        composite_picture, scene_picture: display values (height, width, 3). mask: (height, width), true for pixels that
        count; None for all. flare, light_discs: as for `_parallax_loss`.
        """
        if not self.fits_scene:
            return None
        target = self._scene_target(targets, composite_picture, scene_picture)
        if target is not None:
            return l1_ssim(masked(scene_picture, target, mask), target, 1 - self.settings.ssim_share)
        if self.settings.uses_parallax:
            return self._parallax_loss(targets, masked(scene_picture, targets.frame, mask), flare, light_discs)
        return None

    def _scene_target(self, targets: Targets, picture: Tensor, scene: Tensor) -> Tensor | None:
        """Return the display values that the scene's rendering is compared with, (height, width, 3), or None.

        They are those of the clean frame in supervised modes, those of the frame minus the flare as reconstructed so
        far in mode `in-flare`; other modes have none. picture: the composite. scene: the scene's rendering.
        """
        if self.settings.supervised:
            return targets.clean
        if self.settings.mode == "in-flare":
            # The flare so far is what the composite has more than the scene.
            return (targets.frame - (picture - scene).detach()).clamp(0, self.frames.display_white)
        return None

    def _parallax_loss(self, targets: Targets, scene: Tensor, flare: Splats | None,
                       light_discs: Tensor | None) -> Tensor:
        """Return the loss of a scene in a fit by parallax, without exact clean frames.

        While the scene is fitted alone, it is a quantile loss. Later it has terms near the lights, against an estimated
        clean frame, and on flare far from the lights as well. scene: the scene's rendering, display values (height,
        width, 3). flare: splats of all lights, None without any. light_discs: mask (height, width) or None.
        """
        settings = self.settings
        progress = self.iteration / settings.iterations
        if self.flare is None or self._is_scene_only(targets):
            loss = quantile_loss(scene, targets.frame, settings.split.excess_weight)
            if targets.clean is not None and self.iteration > self._min_scene_only_iterations:
                loss = loss + estimate_loss(scene, targets.clean, settings.ssim_share, progress)
            return loss
        lights = self.flare.positions_in(targets.camera.frame).numpy()
        loss = scene_loss(scene, targets, lights, light_discs, settings.split, progress)
        if targets.clean is not None:
            loss = loss + estimate_loss(scene, targets.clean, settings.ssim_share, progress)
        if flare is None or self._excess_ratio >= settings.split.converged_ratio:
            return loss
        behind = scene.detach()
        added = composite(behind, flare, settings.blend, self.frames.display_white) - behind
        estimated_flare = None if targets.clean is None else targets.frame - targets.clean
        return loss + far_flare_penalty(added, estimated_flare, self._excess_ratio, targets.camera, lights,
                                        settings.split)

    @property
    def _opacity_floor(self) -> float:
        """Least opacity of flare Gaussians in this iteration, 0 with exact clean frames.

        It is 0 after their number has changed for the last time, so that the model that is written is the one that was
        fitted.
        """
        settings = self.settings
        has_floor = settings.uses_parallax and self.iteration <= settings.flare.density.stop
        return settings.split.opacity_floor if has_floor else 0.0

    def _sh_degree(self) -> int:
        """Return the degree of the scene's spherical harmonics in this iteration.

        It grows by one every `sh_every` iterations, up to a limit that is lower at first in a fit by parallax; a scene
        trained elsewhere has the highest from the start.
        """
        if self.settings.scene.start:
            return MAX_DEGREE  # it was trained before
        split = self.settings.split
        is_low = self.settings.uses_parallax and self.iteration <= split.low_sh_until * self.settings.iterations
        return min(split.sh_degree if is_low else MAX_DEGREE, self.iteration // self.settings.scene.sh_every)

    # ---- density ----------------------------------------------------------------------------------

    def _make_strategy(self) -> Strategy:
        settings, adam, generator = self.settings.scene, self.optimisers.scene, self._generator(0, 0)
        if settings.strategy == "mcmc":
            return Mcmc(self.scene, adam, generator, settings.mcmc, self.extent)
        return Classic(self.scene, adam, self.extent, generator, settings.classic)

    def _reorder_scene(self) -> None:
        """Sort the scene's Gaussians along the Morton curve at intervals, which keeps neighbours together in memory."""
        if self.iteration % self.settings.scene.reorder_every == 0:
            order = morton_order(self.scene.means.detach())
            self.optimisers.scene.keep_rows(order)
            self.strategy.reorder(order)

    # ---- state ------------------------------------------------------------------------------------

    def state(self) -> State:
        """Return all that a resumed fit needs, in the form of `checkpoint.save`."""
        return {**self._flare_state(), "excess_ratio": self._excess_ratio, "scene": dict(self.scene.state_dict()),
                "strategy": self.strategy.state_dict(), **self._inputs.state()}

    def _read_excess_ratio(self, state: State) -> float:
        """Return the excess ratio of a state.

        Formats before 1 name it `times_found`, or store only whether the scene had converged.
        """
        for name in ("excess_ratio", "times_found"):
            if name in state:
                return float(state[name])
        has_converged = state.get("scene_is_found", state.get("alone_until") == self._scene_only_iterations)
        return MAX_EXCESS_RATIO if has_converged else 0.0

    def load_state(self, state: State) -> None:
        """Restore a state. Raises RunError if it does not fit the capture and settings, or the inputs have changed."""
        try:
            self._inputs.check(state)
            load_parameters(dict(self.scene.named_parameters()), state["scene"])
            self._load_flare_state(state)
            self._excess_ratio = self._read_excess_ratio(state)
            self.strategy.load_state_dict(state["strategy"])
        except (KeyError, RuntimeError, TypeError, ValueError) as problem:
            raise RunError(f"The checkpoint does not fit this fit ({problem}); start it anew.") from problem
