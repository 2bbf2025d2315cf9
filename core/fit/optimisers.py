# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimisers of scene and flare, and their learning rates along a fit; `trainer` steps them."""
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from ..flare.encoding import TABLE
from ..flare.model import FlareModel
from ..gaussians.kernels import fused_kernels
from ..gaussians.optimiser import Adam
from ..gaussians.scene import COEFFICIENTS, SceneGaussians
from .checkpoint import State
from .settings import FitSettings, FlareRates

COLOUR_RATE_FACTOR = 3.0
"""Factor on the learning rate of the scene's constant colours where frames go above white, which is farther to go.
Lamps of 32 times white end a sixth off instead of three fifths (`desk`, preset draft)."""

PLANE_ROWS = ("offsets",)
"""Rows of a flare's Gaussians whose values are lengths in the normalised plane."""


class Optimisers:
    """The optimisers of the scene, of the flare (networks and Gaussians) and of its grids; the last two are None
    without a flare."""

    def __init__(self, scene: SceneGaussians | None, flare: FlareModel | None, settings: FitSettings, extent: float,
                 display_white: float) -> None:
        """Make an optimiser for each kind of parameter.

        scene: None for plates, which a fit does not change. extent: of the capture, world units. display_white: largest
        display value of the frames.
        """
        self._settings, self._extent = settings, extent
        rates = settings.scene.rates
        sh_rates = torch.full((COEFFICIENTS, 1), rates.features_rest)
        # Coefficient 0 is the constant colour; the others change it with direction, and learn more slowly.
        sh_rates[0] = rates.features * (COLOUR_RATE_FACTOR if display_white > 1 else 1)
        rate_by_name: dict[str, float | Tensor] = {
            "means": self._means_rate(0.0), "log_scales": rates.scale, "quaternions": rates.rotation,
            "opacity_logits": rates.opacity,
            "sh": sh_rates.expand(COEFFICIENTS, 3).contiguous().to("cpu" if scene is None else scene.means.device),
        }
        self.scene = Adam({} if scene is None else dict(scene.named_parameters()),
                          {} if scene is None else rate_by_name)
        self._flare_optimisers = None if flare is None else FlareOptimisers(flare, settings.flare.rates)
        self.flare = None if self._flare_optimisers is None else self._flare_optimisers.dense
        self.grids = None if self._flare_optimisers is None else self._flare_optimisers.grids

    def set_rates(self, iteration: int) -> None:
        """Set the learning rates of an iteration, from 1."""
        progress = iteration / self._settings.iterations
        if self.scene.parameters:
            self.scene.rates["means"] = self._means_rate(progress)
        if self._flare_optimisers is not None:
            self._flare_optimisers.set_rates(progress)

    def _means_rate(self, progress: float) -> float:
        """Return the learning rate of the scene's positions, world units, after a share 0..1 of the fit."""
        rates = self._settings.scene.rates
        return _decay(rates.position, rates.position_final, progress) * self._extent

    def step(self, *, scene: bool) -> None:
        """Step all optimisers, the scene's only if `scene` is True, and clear their gradients."""
        for optimiser in (self.scene if scene else None, self.flare, self.grids, self._brightness):
            if optimiser is not None:
                optimiser.step()
                optimiser.zero_grad()

    @property
    def _brightness(self) -> torch.optim.SparseAdam | None:
        return None if self._flare_optimisers is None else self._flare_optimisers.brightness

    def state(self) -> State:
        """Return the moments, in the form of `checkpoint.save`."""
        state: State = {"scene_adam": self.scene.state_dict()}
        if self.flare is not None and self.grids is not None:
            state["flare_adam"] = self.flare.state_dict()
            state["grid_adam"] = _moments(self.grids)
        if self._brightness is not None:
            state["brightness_adam"] = _moments(self._brightness)
        return state

    def load_state(self, state: State) -> None:
        """Restore the moments. Raises KeyError, RuntimeError, TypeError or ValueError where they do not fit."""
        if self.scene.parameters:  # a checkpoint leaves out what is empty
            self.scene.load_state_dict(state["scene_adam"])
        if self.flare is not None and self.grids is not None:
            self.flare.load_state_dict(state["flare_adam"])
            _load_moments(self.grids, state.get("grid_adam", {}))
        if self._brightness is not None:
            _load_moments(self._brightness, state.get("brightness_adam", {}))


def _moments(optimiser: torch.optim.SparseAdam) -> State:
    return {str(key): dict(value) for key, value in optimiser.state_dict()["state"].items()}


def _load_moments(optimiser: torch.optim.SparseAdam, state: State) -> None:
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": {int(key): value for key, value in state.items()}, "param_groups": groups})


def _decay(first: float, last: float, progress: float) -> float:
    """Decay exponentially from `first` to `last` as progress goes from 0 to 1."""
    return first * (last / first) ** min(max(progress, 0.0), 1.0)


class GridAdam(torch.optim.SparseAdam):
    """SparseAdam, by the fused CPU kernel where it is available."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Step the rows that the gradients hold."""
        tables = [(group, table) for group in self.param_groups for table in group["params"] if table.grad is not None]
        fused = fused_kernels(tables[0][1]) if tables and closure is None else None
        if fused is None:
            return super().step(closure)
        for group, table in tables:
            state = self.state[table]
            if not state:
                state["step"] = 0
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(table), torch.zeros_like(table)
            state["step"] += 1
            beta1, beta2 = group["betas"]
            fused.sparse_adam_step(table.data, table.grad, state["exp_avg"], state["exp_avg_sq"], state["step"],
                                   float(group["lr"]), beta1, beta2, group["eps"])
        return None


class FlareOptimisers:
    """The optimisers of a flare: `dense` for networks and Gaussians, `grids`, which updates only the rows of the hash
    grids that a view touched, and `brightness`, None for lights that stay on."""

    def __init__(self, flare: FlareModel, rates: FlareRates) -> None:
        """Group the parameters of all lights by their learning rates.

        rates: of the settings; those of lengths in the plane are multiplied by `LightFlare.scale`.
        """
        self._rates = rates
        gaussian_rates = {
            "positions": rates.position, "log_scales": rates.scale, "rotations": rates.rotation,
            "opacity_logits": rates.opacity, "sh": rates.features, "offsets": rates.offset, "rings": rates.ring,
            "arcs": rates.arc, "latent": rates.latent,
        }
        dense: dict[str, Parameter] = {}
        tables: list[Parameter] = []
        rate_by_name: dict[str, float | Tensor] = {}
        for name, parameter in flare.flares.named_parameters():
            if name.endswith(TABLE):
                tables.append(parameter)
                continue
            dense[name] = parameter
            # Names are "light's number.gaussians.rows" and "light's number.network.…".
            row_name = name.rsplit(".", 1)[1]
            rate = gaussian_rates[row_name] if ".gaussians." in name else rates.network
            rate_by_name[name] = rate * (flare.lights[int(name.split(".")[0])].scale if row_name in PLANE_ROWS else 1)
        self.dense = Adam(dense, rate_by_name)
        self.grids = GridAdam(tables, lr=rates.grids)
        lights = flare.frame_lights
        self.brightness = (None if lights is None else
                           torch.optim.SparseAdam([lights.brightness.weight], lr=rates.brightness))
        self._initial_rates = dict(self.dense.rates)

    def set_rates(self, progress: float) -> None:
        """Set the learning rates at a share of the fit, 0 to 1.

        Positions decay exponentially all along, the others from the middle of the fit on.
        """
        rates = self._rates
        decay = _decay(1.0, rates.final_ratio, 2 * progress - 1)  # 1 until the middle of the fit
        for name, rate in self._initial_rates.items():
            is_position = name.endswith("gaussians.positions")
            new_rate = _decay(rates.position, rates.position_final, progress) if is_position else rate * decay
            self.dense.rates[name] = new_rate
        for group in self.grids.param_groups:
            group["lr"] = rates.grids * decay
        for group in () if self.brightness is None else self.brightness.param_groups:
            group["lr"] = rates.brightness * decay

    def step(self) -> None:
        """Step networks, Gaussians and grids by the gradients and clear these; traced flares have no `brightness`."""
        for optimiser in (self.dense, self.grids):
            optimiser.step()
            optimiser.zero_grad()
