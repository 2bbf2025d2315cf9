# SPDX-License-Identifier: GPL-3.0-or-later
"""What takes a training's steps.

The weights of the convolutions between hidden planes take steps that are as long in every direction (Muon, Jordan
2024), and on average as long as AdamW's (Liu et al. 2025, "Muon is Scalable for LLM Training"), so that one learning
rate serves both; all else takes AdamW's.
"""
from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn
from torch.optim import AdamW, Muon

NOT_HIDDEN = ("see.", "head.", ".place.")
"""In the names of weights that are shown the frame, or places, and of those that give the answer."""


class Optimiser:
    """Of all of a network's parameters, which keep where they lie in memory."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        """decay: of the weights in each step, in parts of its learning rate. Raises ValueError where the weights do not
        lie channels last."""
        self._parameters = dict(network.named_parameters())
        self._matrices = {name: nn.Parameter(_rows(weight.detach())) for name, weight in self._parameters.items()
                          if weight.ndim > 1 and not any(part in name for part in NOT_HIDDEN)}
        if any(rows.data_ptr() != self._parameters[name].data_ptr() for name, rows in self._matrices.items()):
            raise ValueError("The network's weights do not lie channels last.")
        others = [weight for name, weight in self._parameters.items() if name not in self._matrices]
        self._muon = Muon(self._matrices.values(), weight_decay=decay, adjust_lr_fn="match_rms_adamw")
        self._adam = AdamW(others, weight_decay=decay, fused=True)

    def step(self, rate: float) -> None:
        """One step by the gradients that the parameters have, which they have no more afterwards."""
        for name, matrix in self._matrices.items():
            gradient = self._parameters[name].grad
            matrix.grad = None if gradient is None else _rows(gradient)
        for optimiser in (self._muon, self._adam):
            for group in optimiser.param_groups:
                group["lr"] = rate
            optimiser.step()
        for parameter in (*self._parameters.values(), *self._matrices.values()):
            parameter.grad = None

    def state(self) -> dict[str, Tensor]:
        """What a training needs to go on: `moment.`, which of a parameter's moments, `.` and its name."""
        found: dict[str, Tensor] = {}
        for name in self._parameters:
            states, stepped = self._stepped(name)
            found |= {f"moment.{moment}.{name}": value for moment, value in states[stepped].items()}
        return found

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state; moments that it lacks begin anew."""
        for key, value in state.items():
            kind, _, rest = key.partition(".")
            moment, _, name = rest.partition(".")
            if kind == "moment" and name in self._parameters:
                states, stepped = self._stepped(name)
                if moment == "step" or value.shape == stepped.shape:  # those of AdamW for all weights have other shapes
                    states[stepped][moment] = value.to(stepped.device, copy=True)

    def _stepped(self, name: str) -> tuple[dict[Tensor, dict[str, Tensor]], Tensor]:
        """Where the moments of a parameter are kept, and under what."""
        if name in self._matrices:
            return self._muon.state, self._matrices[name]
        return self._adam.state, self._parameters[name]


def _rows(weight: Tensor) -> Tensor:
    """A convolution's weights (out, in, height, width) as a matrix of `out` rows; no copy where they lie in memory
    channels last."""
    return weight.permute(0, 2, 3, 1).flatten(1)
