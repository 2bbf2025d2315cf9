# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam (Kingma & Ba 2015) for parameters whose rows come and go.

The same steps as torch.optim.Adam, with three additions: a rate of its own for each parameter, or for each
column of one (the degrees of spherical harmonics); rows that are kept, re-ordered or appended together
with their moments, as densification asks; and the fused CPU kernel where there is one.

    m = b1 m + (1 - b1) g        v = b2 v + (1 - b2) g²
    p = p - rate / (1 - b1^t) * m / (sqrt(v) / sqrt(1 - b2^t) + epsilon)
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import Parameter

from ..errors import RunError, SettingsError
from .kernels import FusedKernels, fused

Rate = float | Tensor

BETA1, BETA2 = 0.9, 0.999
"""How much of the running means stays with each step, of the gradient and of its square."""


class Moments(NamedTuple):
    """Running means of the gradient and of its square, shaped as the parameter."""

    first: Tensor
    second: Tensor


class Adam:
    """Optimises named parameters.

    parameters  by name; the objects stay the same, whatever happens to their rows
    rates       one for all, or by name; a float, or a tensor of the shape of one row. `self.rates` may be
                changed between steps; a name that is missing there does not move
    kernels     "torch" leaves the fused CPU kernel unused
    """

    def __init__(
        self, parameters: Mapping[str, Parameter], rates: Rate | Mapping[str, Rate],
        *, epsilon: float = 1e-15, kernels: Literal["auto", "torch"] = "auto",
    ) -> None:  # fmt: skip
        self.parameters = dict(parameters)
        self.rates: dict[str, Rate] = (
            dict(rates) if isinstance(rates, Mapping) else dict.fromkeys(self.parameters, rates)
        )
        if unknown := self.rates.keys() - self.parameters.keys():
            raise SettingsError(f"There is no parameter {min(unknown)!r} to give a learning rate to.")
        self.epsilon = epsilon
        self.kernels = kernels
        self.moments = {name: _zeros(p) for name, p in self.parameters.items()}
        self.steps = dict.fromkeys(self.parameters, 0)

    @property
    def _options(self) -> dict[str, Any]:
        return {"beta1": BETA1, "beta2": BETA2, "epsilon": self.epsilon}

    @contextmanager
    def stepping(self) -> Iterator[None]:
        """Within it the backward pass may step the parameters of a scene itself, all of them together, as soon as it
        has their gradients, which then need not be written. The CPU kernels do so.

        The steps are the same; those gradients stay None, and `step` is for what is left. Only for a scene that gets
        its whole gradient from one `rasterization`: raises RunError if more comes after the steps.
        """
        cpu: FusedKernels | None = None
        steps: dict[str, Any] = {}
        for name, rate in self.rates.items():
            parameter = self.parameters[name]
            if found := self._kernels_for(parameter):
                cpu = found
                steps[name] = found.Step(parameter, None, *self.moments[name], self.steps[name] + 1, rate)
        if cpu is None:
            yield
            return
        with cpu.offered(steps, **self._options) as offers:
            yield
        for name in offers.taken:
            self.steps[name] += 1
            if self.parameters[name].grad is not None:
                raise RunError(f"{name} got a gradient after its step: the scene was rendered twice.")

    def _kernels_for(self, parameter: Tensor) -> FusedKernels | None:
        """The fused kernels if they can step this parameter, else None."""
        return fused(parameter) if self.kernels == "auto" and parameter.is_contiguous() else None

    @torch.no_grad()
    def step(self) -> None:
        """Moves every parameter that has a gradient and a rate."""
        options = self._options
        cpu: FusedKernels | None = None
        together: list[Any] = []
        for name, rate in self.rates.items():
            parameter = self.parameters[name]
            if parameter.grad is None or parameter.numel() == 0:
                continue
            self.steps[name] += 1
            data = parameter.data
            values = (data, parameter.grad.contiguous(), *self.moments[name], self.steps[name], rate)
            found = self._kernels_for(data)
            if found is None:
                adam_step(*values, **options)
            else:
                cpu = found
                together.append(found.Step(*values))
        if cpu is not None:
            cpu.adam_steps(together, **options)

    def zero_grad(self) -> None:
        """Forgets the gradients."""
        for parameter in self.parameters.values():
            parameter.grad = None

    @torch.no_grad()
    def keep(self, index: Tensor, names: Iterable[str] | None = None) -> None:
        """Keeps the rows of this index (a boolean mask, or row numbers: also a new order), moments included.

        names: which parameters; all by default. Their gradients are forgotten.
        """
        for name in self.parameters if names is None else names:
            parameter, moments = self.parameters[name], self.moments[name]
            replace_rows(parameter, parameter.data[index])
            self.moments[name] = Moments(moments.first[index], moments.second[index])

    @torch.no_grad()
    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Appends rows, by name of the parameter, with moments of zero; gradients are forgotten."""
        for name, new in rows.items():
            parameter, moments = self.parameters[name], self.moments[name]
            new = new.to(parameter)
            replace_rows(parameter, torch.cat([parameter.data, new]))
            self.moments[name] = Moments(*(torch.cat([m, torch.zeros_like(new)]) for m in moments))

    @torch.no_grad()
    def forget(self, name: str, index: Tensor | None = None) -> None:
        """Sets the moments of a parameter to zero, of all rows or of those of the index."""
        for moment in self.moments[name]:
            moment[slice(None) if index is None else index] = 0

    def state_dict(self) -> dict[str, Any]:
        """Tensors by "name.first" and "name.second", and the step counts under "steps"."""
        state: dict[str, Any] = {"steps": dict(self.steps)}
        for name, moments in self.moments.items():
            state[f"{name}.first"], state[f"{name}.second"] = moments
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes up what state_dict gave; the parameters themselves are restored by their owner first.

        Raises RunError if it does not fit the parameters.
        """
        for name, parameter in self.parameters.items():
            loaded = [state[key] for key in (f"{name}.first", f"{name}.second") if key in state]
            if len(loaded) < 2 or any(moment.shape != parameter.shape for moment in loaded):
                raise RunError(f"The saved optimiser does not fit {name}; start the fit anew, without resuming.")
            self.moments[name] = Moments(*(moment.to(parameter, copy=True).contiguous() for moment in loaded))
            self.steps[name] = int(state["steps"][name])


def replace_rows(parameter: Parameter, rows: Tensor) -> None:
    """Gives a parameter other rows, of any number; its gradient is forgotten.

    As long as an old graph is alive, autograd remembers the shape that the parameter had, and lets go of
    it only at a change of type: hence the step in between.
    """
    parameter.data = torch.empty(0, dtype=torch.float16, device=rows.device)
    parameter.data = rows
    parameter.grad = None


def adam_step(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: Rate,
    *, beta1: float, beta2: float, epsilon: float,
) -> None:  # fmt: skip
    """One step in place, in torch; `step` counts from 1, `rate` is a float or has the shape of a row."""
    first.lerp_(gradient, 1 - beta1)
    second.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    root = (second.sqrt() / math.sqrt(1 - beta2**step)).add_(epsilon)
    if isinstance(rate, Tensor):
        parameter.sub_(first / root * (rate / (1 - beta1**step)))
    else:
        parameter.addcdiv_(first, root, value=-rate / (1 - beta1**step))


def _zeros(parameter: Tensor) -> Moments:
    return Moments(*(torch.zeros_like(parameter, memory_format=torch.contiguous_format) for _ in range(2)))
