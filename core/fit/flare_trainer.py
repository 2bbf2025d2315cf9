# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of a fit that do not depend on the kind of its scene: order of the frames, flare, density, checks.

`trainer` fits the flare with a scene of Gaussians, `plate_trainer` over plates. All randomness is a function of (seed,
iteration): a resumed fit equals an uninterrupted one.
"""
from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from ..capture import Capture, View
from ..conventions.pixel_grid import PixelGrid
from ..conventions.run_files import FRAME_LIGHTS
from ..errors import RunError
from ..flare.density import clone_and_prune
from ..flare.model import FlareModel
from ..gaussians.device import select_device
from ..system.progress import Progress
from .checkpoint import State
from .frames import Frames
from .light_brightness import normalise_brightness, solve_brightness
from .light_results import (
    flare_shares,
    select_flaring,
    select_lights,
    share_messages,
    write_frame_lights,
)
from .optimisers import Optimisers
from .rendering import RenderedView, Scene, render
from .settings import FitSettings
from .warnings import outlier_warnings


class FlareTrainer(abc.ABC):
    """Scene and flare of a capture under optimisation: `step` by `step`, with `state` and `load_state`."""

    frames: Frames
    capture: Capture
    views: tuple[View, ...]
    """The training views."""
    exposures: Mapping[str, float]
    """Exposure of each view relative to the median frame; empty if all are equal."""
    flare: FlareModel | None
    optimisers: Optimisers
    warnings: Sequence[str]

    def __init__(self, settings: FitSettings) -> None:
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.device = select_device(settings.device)
        """The device that parameters and frames of an iteration are on; inputs are read and prepared on the CPU."""
        self.iteration = 0
        self.losses: dict[str, float] = {}
        """Last loss of each view, by name."""

    @property
    @abc.abstractmethod
    def scene(self) -> Scene:
        """The scene as `rendering.render` takes it."""

    @property
    def scene_size(self) -> int:
        """Number of Gaussians in the scene."""
        return 0

    @abc.abstractmethod
    def step(self) -> dict[str, float]:
        """Run one iteration on the next view; return its losses by name."""

    @abc.abstractmethod
    def finish(self, folder: Path, pixel_grid: PixelGrid, progress: Progress) -> None:
        """Write the scene into the folder of the run, before the flare."""

    @abc.abstractmethod
    def state(self) -> State:
        """Return all that a resumed fit needs, in the form of `checkpoint.save`."""

    @abc.abstractmethod
    def load_state(self, state: State) -> None:
        """Restore a state. Raises RunError if it does not fit the capture and settings, or the inputs have changed."""

    def render_view(self, view: View) -> RenderedView:
        """Render scene, flare of each light and composite of a view, at the size of the fit."""
        return render(self.scene, self.flare, self.settings.blend, self.frames.targets(view).camera,
                      self.settings.kernels, visibility=self.settings.flare.active_visibility)

    def finish_lights(self, folder: Path) -> Sequence[str]:
        """Normalise the lights' brightness, drop lights that do not flare from `flare`, and write the lights by frame
        into the folder, if any moves or changes; return messages to the user on the lights' shares of the flare.

        In a fit over plates, the brightness is first solved once more for all views, held-out ones too.
        """
        if self.flare is None:
            return ()
        if self.settings.uses_plates:
            solve_brightness(self.flare, self.capture.views, self.frames, self.render_view)
        normalise_brightness(self.flare, self.views)
        shares = flare_shares(self.flare, self.views, self.frames, self.render_view)
        flaring = select_flaring(shares)
        self.flare = select_lights(self.flare, flaring)
        write_frame_lights(folder / FRAME_LIGHTS, self.capture, self.flare)
        return share_messages(shares, flaring)

    def final_warnings(self) -> tuple[str, ...]:
        """Return sentences for the user on what is doubtful after the last iteration."""
        every_view_used = len(self.losses) == len(self.views)
        return outlier_warnings(self.losses, self.settings.uses_plates) if every_view_used else ()

    def _pick_view(self) -> View:
        """Return the view of this iteration: each view once per round, in a random order that depends on seed and
        round."""
        done = self.iteration - 1
        order = torch.randperm(len(self.views), generator=self._generator(done // len(self.views), 1))
        return self.views[int(order[done % len(self.views)])]

    def _generator(self, number: int, purpose: int) -> torch.Generator:
        """Return a random generator for one purpose and one number, such as an iteration.

        Purposes: 0 the scene's density, 1 the order of the views, 2 + n the density of the n-th flare.
        """
        # A large prime keeps the seeds of different purposes and numbers apart.
        seed = (self.settings.seed * 1_000_003 + purpose) * 1_000_003 + number
        return torch.Generator().manual_seed(seed % (1 << 62))

    def _change_flare_density(self) -> None:
        """Clone and prune the Gaussians of each light's flare, in iterations that the settings name; else do
        nothing."""
        settings = self.settings.flare.density
        adam = self.optimisers.flare
        if self.flare is None or adam is None or not settings.is_due(self.iteration):
            return
        for number, light in enumerate(self.flare.lights):
            names = {name: f"{number}.gaussians.{name}" for name in light.gaussians}
            clone_and_prune(light, adam, names, settings, self._generator(self.iteration, 2 + number))

    def _flare_penalty(self, pose: Tensor, frame: str) -> Tensor:
        """Return the penalties on delta_l, the learned correction of each light's place, at a pose (4, 4), and on the
        brightness of the lights in its frame."""
        assert self.flare is not None
        settings, penalty = self.settings, torch.zeros((), device=self.device)
        if settings.flare.correction_weight:
            corrections = self.flare.light_corrections(pose, frame)
            penalty = penalty + settings.flare.correction_weight * corrections.square().sum()
        if (lights := self.flare.frame_lights) is not None:
            penalty = penalty + settings.brightness.roughness_weight * lights.roughness(frame)
            penalty = penalty + settings.brightness.prior_weight * lights.deviation(frame)
        return penalty

    def check_finite(self) -> None:
        """Raise RunError if a parameter is NaN or infinite: rasterizers skip such Gaussians, so the pictures hide
        it."""
        for model in (self.scene, self.flare):
            for name, parameter in model.named_parameters() if isinstance(model, nn.Module) else ():
                if not parameter.detach().sum().isfinite():
                    raise RunError(f"The fit diverged before iteration {self.iteration} ({name} is not finite); start "
                                   "it anew with lower learning rates.")

    def _flare_state(self) -> State:
        """Return the entries of a checkpoint for flare, losses and moments."""
        state: State = {"iteration": self.iteration,
                        "losses": [[name, loss] for name, loss in self.losses.items()], **self.optimisers.state()}
        if self.flare is not None:
            state["flare"] = dict(self.flare.state_dict())
        return state

    def _load_flare_state(self, state: State) -> None:
        """Restore iteration, losses, flare and moments from a state with the entries of `_flare_state`."""
        self.iteration = int(state["iteration"])
        self.losses = {name: float(loss) for name, loss in state.get("losses", [])}
        if self.flare is not None:
            load_parameters(dict(self.flare.named_parameters()), state["flare"])
            self.flare.positions.copy_(state["flare"]["positions"])
            self.flare.clear.copy_(state["flare"]["clear"])
        self.optimisers.load_state(state)


def load_parameters(parameters: dict[str, Parameter], state: State) -> None:
    """Load values of any number of rows: Gaussians are added and removed during a fit."""
    for name, parameter in parameters.items():
        parameter.data = state[name].clone().to(parameter)
