# SPDX-License-Identifier: GPL-3.0-or-later
"""The joint optimisation of scene and flare (paper, section "Reconstruction", eq. 5).

    L = lambda |I_s - I_o| + (1 - lambda)(1 - SSIM(I_s, I_o))          the scene against the flare-free frame
      + lambda |I - I_input| + (1 - lambda)(1 - SSIM(I, I_input))      both together against the frame

Every flare Gaussian lies in front of every scene Gaussian, so the scene is rasterised once for both.
All randomness is a function of (seed, iteration): a resumed fit goes on as if it had never stopped.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext

import torch
from torch import Tensor
from torch.nn import Parameter

from ..capture import Capture, View
from ..capture.discs import clipped_discs
from ..colour.srgb_torch import clipped
from ..errors import CaptureError, RunError
from ..flare.compositing import composite
from ..flare.density import clone_and_prune
from ..flare.visibility import clear_shares, uncovering
from ..gaussians import Splats
from ..gaussians.densification import Classic, Mcmc, Strategy
from ..gaussians.loss import l1_ssim
from ..gaussians.ordering import morton_order
from ..gaussians.spherical_harmonics import MAX_DEGREE
from ..system.progress import Progress
from ..thinning import thinned
from . import metering
from .checkpoint import State
from .frames import Frames, Targets
from .given import Given
from .initialise import first_flare, first_scene
from .optimisers import Optimisers
from .parallax_losses import (
    FOUND_WHOLLY,
    from_below,
    haze,
    head_start,
    scene_beside_flare,
    times_found,
    towards_estimate,
)
from .rendering import render_flare, render_scene
from .settings import FitSettings
from .warnings import doubts, moved_lights

CLEAR_EVERY = 50
"""Iterations between two looks at how much of the lights the scene leaves (`visibility.clear_shares`)."""
UNTOLD = 0.01
"""Difference of display values between frame and flare-free frame below which nothing is told of a flare."""
ASKED = 40
"""About as many views are asked there, and for whether a scene has been found (`splitting.times_found`)."""


class Trainer:
    """Scene and flare of a capture under optimisation: `step` by `step`, with `state` and `load_state`.

    Raises CaptureError where the capture lacks what the mode needs, Cancelled when asked to stop.
    """

    def __init__(self, capture: Capture, settings: FitSettings, exposures: Mapping[str, float] | None = None,
                 progress: Progress | None = None) -> None:
        """exposures: of the views, by name, where that is known already."""
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.frames = Frames(capture, settings.width, display_white=settings.display_white,
                             alone=not settings.looks_at_removed, truth=settings.supervised)
        if exposures is None:
            exposures = metering.found(capture, self.frames, progress) if settings.exposure == "found" else {}
        self.exposures = exposures
        """Times the usual light, by view; empty where all frames are exposed alike."""
        capture = capture.exposed(exposures)
        self.capture = capture
        self.views, _ = capture.split(settings.holdout)
        self.iteration = 0
        self.losses: dict[str, float] = {}
        """Of each view, by name, when it was last looked at."""
        self.scene_is_fitted = not settings.scene.frozen
        if settings.looks_at_removed and not self.frames.reference and self.scene_is_fitted:
            raise CaptureError(f"{capture.folder} has no flare-free frames (removed/); run remove on it first, "
                               "or fit with --mode split.")
        self.scene = first_scene(capture, settings, self.views, self.frames)
        self.flare = None if settings.mode == "3dgs" else first_flare(capture, self.views, self.frames, settings)
        self.says = (*self.frames.says, *metering.says(self.exposures),
                     *doubts(capture, settings, self.views, self.frames),
                     *(() if self.flare is None else moved_lights(capture, self.flare)))
        self.extent = capture.extent
        self._given = Given(capture, removed=self.frames.reference == "removed", lights=self.flare is not None)
        self._head_start = head_start(settings.split, len(self.views), settings.iterations)
        """Iterations in which a scene that is told from flare by parallax is fitted alone; then it is asked whether it
        has been found."""
        self._times_found = FOUND_WHOLLY
        """By what is asked then (`splitting.times_found`)."""
        self.optimisers = Optimisers(self.scene, self.flare, settings, self.extent, self.frames.display_white)
        self.strategy = self._strategy()

    # ---- one iteration ----------------------------------------------------------------------------

    def step(self) -> dict[str, float]:
        """One iteration on the next view; the loss of the composite, which there is none of while a scene is fitted
        alone, and that of the scene."""
        self.iteration += 1
        settings = self.settings
        view = self._view()
        targets = self.frames.targets(view)
        self.optimisers.set_rates(self.iteration)
        scene = render_scene(self.scene, targets.camera, settings.kernels, sh_degree=self._sh_degree(), depth=False)
        shown = self._as_filmed(scene.colour)
        self._look_for_lights()
        self._look_for_scene()
        alone = self._scene_alone(targets)
        flare = None if alone else render_flare(self.flare, settings.blend, targets.camera, settings.kernels,
                                                scene=self.scene, visibility=settings.flare.occluded_by_scene)
        sources = self._sources(targets)
        picture = composite(self._behind_flare(targets, shown, sources), flare, settings.blend,
                            self.frames.display_white)
        weight = 1 - settings.ssim_share
        loss = (shown.new_zeros(()) if alone else
                l1_ssim(picture, self._joint_target(targets, picture.detach(), sources), weight))
        figures = {} if alone else {"loss": float(loss.detach())}
        clean = self._scene_target(targets, picture, shown)
        if clean is not None and self.scene_is_fitted:
            scene_loss = l1_ssim(shown, clean, weight)
            figures["scene_loss"] = float(scene_loss.detach())
            loss = loss + scene_loss
        elif settings.by_parallax and self.scene_is_fitted:
            scene_loss = self._parallax_loss(targets, shown, flare, sources)
            figures["scene_loss"] = float(scene_loss.detach())
            loss = loss + scene_loss
        self.losses[view.name] = sum(figures.values())
        if not all(map(math.isfinite, figures.values())):
            raise RunError(f"The fit diverged at iteration {self.iteration}; start it anew with lower learning rates.")
        if self.scene_is_fitted:
            loss = loss + self.strategy.regulariser()
        if flare is not None and self.flare is not None and settings.flare.steady:
            pose = torch.from_numpy(targets.camera.world_to_camera)
            loss = loss + settings.flare.steady * self.flare.corrections(pose).square().sum()
        covered = self._covered(targets)
        if covered is not None:
            loss = loss + covered
        if loss.requires_grad:  # a frozen scene without a light in front of the camera teaches nothing
            with self.optimisers.scene.stepping() if self._rendered_once else nullcontext():
                loss.backward()
        if self.scene_is_fitted:
            self.strategy.observe(scene)
        self.optimisers.step(scene=self.scene_is_fitted)
        if self.scene_is_fitted:
            if self.iteration < settings.iterations:  # what the last would change nothing would learn
                self.strategy.update(self.iteration)
            self._keep_neighbours_together()
        if not alone:  # Gaussians that nothing has taught are neither many nor faint
            self._change_flare_density()
        return figures

    def _as_filmed(self, scene: Tensor) -> Tensor:
        """A scene's picture, clipped where that of another frame, exposed for less, is not."""
        return clipped(scene, self.frames.display_white) if self.exposures else scene

    @property
    def _rendered_once(self) -> bool:
        """Whether all that the scene learns in an iteration comes from one rendering, so that the backward pass may
        take its steps."""
        settings = self.settings
        return (self.scene_is_fitted and settings.scene.strategy == "classic"
                and settings.flare.occluded_by_scene is None)

    def _view(self) -> View:
        """Every view once in an order of its own for each round, a function of seed and iteration."""
        done = self.iteration - 1
        order = torch.randperm(len(self.views), generator=self._generator(done // len(self.views), 1))
        return self.views[int(order[done % len(self.views)])]

    def _look_for_lights(self) -> None:
        """What the scene leaves of each light where nothing hides it, anew every now and then."""
        visibility = self.settings.flare.occluded_by_scene
        if self.flare is None or visibility is None or self.iteration % CLEAR_EVERY != 1:
            return
        poses = [torch.from_numpy(view.camera.world_to_camera) for view in thinned(self.views, ASKED)]
        self.flare.clear.copy_(clear_shares(self.scene, self.flare, poses, visibility, self.settings.kernels))

    @torch.no_grad()
    def _look_for_scene(self) -> None:
        """By parallax it is asked whether the scene has been found when the flare is due."""
        if not self.settings.by_parallax or not 1 <= self._head_start == self.iteration - 1:
            return

        def missing(targets: Targets) -> Tensor:
            scene = render_scene(self.scene, targets.camera, self.settings.kernels, sh_degree=self._sh_degree(),
                                 depth=False)
            return targets.frame - self._as_filmed(scene.colour)

        asked = thinned(self.views, ASKED)
        residuals = (missing(self.frames.targets(view)) for view in asked)
        self._times_found = times_found(residuals)

    def _covered(self, targets: Targets) -> Tensor | None:
        """A loss where the scene hides a light from everywhere that the frame shows, until it lets some of it through.
        None where there is nothing of the kind."""
        visibility = self.settings.flare.occluded_by_scene
        if self.flare is None or visibility is None or not self.scene_is_fitted or bool((self.flare.clear > 0).all()):
            return None
        shown = [light for light in self.flare.positions[self.flare.clear <= 0]
                 if clipped_discs(targets.frame.numpy(), targets.camera, light[None].numpy()).any()]
        eye = torch.from_numpy(targets.camera.position)
        return uncovering(self.scene, eye, shown, visibility, self.settings.kernels)

    def _scene_alone(self, targets: Targets) -> bool:
        """Whether the scene is fitted alone as yet, so that it hides lights by the time their flares are fitted."""
        if self.settings.by_parallax:
            return self.iteration <= self._head_start
        begun = self.iteration > self.settings.flare.begin * self.settings.iterations
        return self.settings.supervised and self.scene_is_fitted and targets.removed is not None and not begun

    def _behind_flare(self, targets: Targets, scene: Tensor, sources: Tensor | None) -> Tensor:
        """What the flare is put before: the flare-free frame while both are fitted apart, then the scene.

        The faint and the small in a flare drown in the errors of a scene that is not learned yet. Later the
        scene, on which all views have agreed, is the better judge of what one flare-free frame has left over;
        but not above white, where its errors are larger than a flare to the end.
        """
        behind = scene
        if self.settings.supervised and targets.removed is not None and self.settings.apart:
            apart = self.iteration <= self.settings.apart * self.settings.iterations
            behind = targets.removed if apart else torch.where(targets.removed > 1, targets.removed, scene)
        return behind if sources is None else behind.masked_fill(sources[..., None], 0)

    def _sources(self, targets: Targets) -> Tensor | None:
        """(height, width): each light's own clipped disc, which is taken from behind the flare where light is added.

        Frame and flare-free frame are white there, so nothing would tell how bright the flare is in its middle, and
        over another shot a hole would show. Black behind it, it has to be white by itself. Above white they may tell.
        """
        settings = self.settings
        clean = targets.frame if settings.by_parallax else targets.removed if settings.supervised else None
        if settings.blend != "add" or self.flare is None or clean is None:
            return None
        discs = torch.from_numpy(clipped_discs(clean.numpy(), targets.camera, self.flare.positions.numpy()))
        return discs if self.frames.display_white == 1 else discs & (targets.frame - clean < UNTOLD).all(-1)

    def _joint_target(self, targets: Targets, picture: Tensor, sources: Tensor | None) -> Tensor:
        """The frame, which picture, scene and flare together, is to become. Above white a light's own disc says
        nothing of the flare but that white is the least of it."""
        if self.frames.display_white == 1 or sources is None:
            return targets.frame
        return torch.where(sources[..., None], picture.clamp_min(1), targets.frame)

    def _scene_target(self, targets: Targets, picture: Tensor, scene: Tensor) -> Tensor | None:
        if self.settings.supervised:
            return targets.removed
        if self.settings.mode == "in-flare":
            # Input minus the flare as reconstructed so far: the composite's gain over the scene.
            return (targets.frame - (picture - scene).detach()).clamp(0, self.frames.display_white)
        return None

    def _parallax_loss(self, targets: Targets, scene: Tensor, flare: Splats | None, sources: Tensor | None) -> Tensor:
        settings = self.settings
        if self.flare is None or self._scene_alone(targets):
            return from_below(scene, targets.frame, settings.split.excess)
        lights, progress = self.flare.positions.numpy(), self.iteration / settings.iterations
        loss = scene_beside_flare(scene, targets, lights, sources, settings.split, progress)
        if targets.removed is not None:
            loss = loss + towards_estimate(scene, targets.removed, settings.ssim_share, progress)
        if flare is None or self._times_found >= settings.split.found:
            return loss
        behind = scene.detach()
        added = composite(behind, flare, settings.blend, self.frames.display_white) - behind
        told = None if targets.removed is None else targets.frame - targets.removed
        return loss + haze(added, told, self._times_found, targets.camera, lights, settings.split)

    def _sh_degree(self) -> int:
        if self.settings.scene.start:
            return MAX_DEGREE  # it was trained before
        plain = self.settings.by_parallax and self.iteration <= self.settings.split.plain * self.settings.iterations
        most = self.settings.split.sh_degree if plain else MAX_DEGREE
        return min(most, self.iteration // self.settings.scene.sh_every)

    def _generator(self, number: int, purpose: int) -> torch.Generator:
        """A random stream of its own for each purpose and moment."""
        mixed = (self.settings.seed * 1_000_003 + purpose) * 1_000_003 + number
        return torch.Generator().manual_seed(mixed % (1 << 62))

    # ---- density ----------------------------------------------------------------------------------

    def _strategy(self) -> Strategy:
        settings, adam, generator = self.settings.scene, self.optimisers.scene, self._generator(0, 0)
        if settings.strategy == "mcmc":
            return Mcmc(self.scene, adam, generator, settings.mcmc)
        return Classic(self.scene, adam, self.extent, generator, settings.classic)

    def _keep_neighbours_together(self) -> None:
        if self.iteration % self.settings.scene.reorder_every == 0:
            order = morton_order(self.scene.means.detach())
            self.optimisers.scene.keep(order)
            self.strategy.reorder(order)

    def _change_flare_density(self) -> None:
        settings = self.settings.flare.density
        adam = self.optimisers.flare
        if self.flare is None or adam is None or not settings.due(self.iteration):
            return
        for number, light in enumerate(self.flare.lights):
            names = {name: f"{number}.gaussians.{name}" for name in light.gaussians}
            clone_and_prune(light, adam, names, settings, self._generator(self.iteration, 2 + number))

    def check_finite(self) -> None:
        """Raise RunError where a parameter has become NaN or infinite: rasterizers skip those and hide them."""
        models = (self.scene,) if self.flare is None else (self.scene, self.flare)
        for model in models:
            for name, parameter in model.named_parameters():
                if not parameter.detach().sum().isfinite():
                    raise RunError(f"The fit diverged before iteration {self.iteration} ({name} is not finite); start "
                                   "it anew with lower learning rates.")

    # ---- state ------------------------------------------------------------------------------------

    def state(self) -> State:
        """All that a resumed fit needs, as `checkpoint.save` takes it."""
        state: State = {"iteration": self.iteration, "times_found": self._times_found,
                        "losses": [[name, loss] for name, loss in self.losses.items()],
                        "scene": dict(self.scene.state_dict()), "strategy": self.strategy.state_dict(),
                        **self.optimisers.state(), **self._given.note()}
        if self.flare is not None:
            state["flare"] = dict(self.flare.state_dict())
        return state

    def load_state(self, state: State) -> None:
        """Go on from a state. Raises RunError where it does not fit the capture and settings, or what the fit was given
        has changed."""
        try:
            self._given.check(state)
            self.iteration = int(state["iteration"])
            was_found = state.get("scene_is_found", state.get("alone_until") == self._head_start)  # earlier versions
            self._times_found = float(state.get("times_found", FOUND_WHOLLY if was_found else 0))
            self.losses = {name: float(loss) for name, loss in state.get("losses", [])}
            _load_parameters(dict(self.scene.named_parameters()), state["scene"])
            if self.flare is not None:
                _load_parameters(dict(self.flare.named_parameters()), state["flare"])
                self.flare.positions.copy_(state["flare"]["positions"])
                self.flare.clear.copy_(state["flare"]["clear"])
            self.optimisers.load_state(state)
            self.strategy.load_state_dict(state["strategy"])
        except (KeyError, RuntimeError, TypeError, ValueError) as problem:
            raise RunError(f"The checkpoint does not fit this fit ({problem}); start it anew.") from problem


def _load_parameters(parameters: dict[str, Parameter], state: State) -> None:
    """Values of any number of rows: Gaussians come and go during a fit."""
    for name, parameter in parameters.items():
        parameter.data = state[name].clone().to(parameter.dtype)
