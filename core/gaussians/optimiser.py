# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam (Kingma & Ba 2015) for parameters whose rows are added, removed and reordered.

Makes the steps of torch.optim.Adam, with three additions: a learning rate for each parameter, or for each column of one
(the degrees of spherical harmonics); rows that are selected, reordered or appended together with their moments, for
densification; and the fused CPU kernel where it is available.

    m = b1 m + (1 - b1) g        v = b2 v + (1 - b2) g²
    p = p - rate / (1 - b1^t) * m / (sqrt(v) / sqrt(1 - b2^t) + epsilon)
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import Parameter

from ..errors import RunError, SettingsError
from .kernels import FusedKernels, fused_kernels

Rate = float | Tensor

BETA1, BETA2 = 0.9, 0.999
"""Decay of the running means of the gradient and of its square."""


class Moments(NamedTuple):
    """Running means of the gradient and of its square, shaped as the parameter."""

    first: Tensor
    second: Tensor


class TorchStep(NamedTuple):
    """A step of one parameter: the arguments of `adam_step`."""

    parameter: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    step: int
    rate: Rate


class Adam:
    """Optimises named parameters.

    parameters  by name; the Parameter objects stay the same when their rows change
    rates       learning rate of all parameters, or by name; a float, or a tensor of the shape of one row. `self.rates`
                may be changed between steps; a parameter without a rate is not stepped
    kernels     "torch" disables the fused CPU kernel
    """

    def __init__(
        self, parameters: Mapping[str, Parameter], rates: Rate | Mapping[str, Rate],
        *, epsilon: float = 1e-15, kernels: Literal["auto", "torch"] = "auto",
    ) -> None:  # fmt: skip
        """Start with moments of zero. epsilon: added to the root of the second moment. Raises SettingsError for a rate
        without a parameter."""
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
    def step_in_backward(self) -> Iterator[None]:
        """Within the context, a backward pass may step a scene's parameters as soon as it has their gradients, which it
        then need not write to memory. The CPU kernels do so.

        These steps equal those of `step`, which afterwards steps the other parameters; gradients of stepped parameters
        stay None. Only for a scene whose whole gradient comes from one `rasterization`, and from visibilities of lights
        that were computed after it: raises RunError if a parameter gets a gradient after its step.
        """
        fused: FusedKernels | None = None
        offered_steps: dict[str, Any] = {}
        for name, rate in self.rates.items():
            parameter = self.parameters[name]
            if kernels := self._kernels_for(parameter):
                fused = kernels
                offered_steps[name] = kernels.AdamStep(parameter, None, *self.moments[name], self.steps[name] + 1, rate)
        if fused is None:
            yield
            return
        with fused.offer_steps(offered_steps, **self._options) as offer:
            yield
        for name in offer.claimed:
            self.steps[name] += 1
            if self.parameters[name].grad is not None:
                raise RunError(f"{name} got a gradient after its step: the scene was rendered twice, "
                               "or a visibility was computed before the rendering.")

    def _kernels_for(self, parameter: Tensor) -> FusedKernels | None:
        """Return the fused kernels if they can step this parameter, else None."""
        return fused_kernels(parameter) if self.kernels == "auto" and parameter.is_contiguous() else None

    @torch.no_grad()
    def step(self) -> None:
        """Make an Adam step on every parameter that has a gradient and a rate, by the fused kernels where possible."""
        options = self._options
        fused: FusedKernels | None = None
        fused_steps: list[Any] = []
        gpu_steps: list[TorchStep] = []
        for name, rate in self.rates.items():
            parameter = self.parameters[name]
            if parameter.grad is None or parameter.numel() == 0:
                continue
            self.steps[name] += 1
            data = parameter.data
            values = TorchStep(data, parameter.grad.contiguous(), *self.moments[name], self.steps[name], rate)
            kernels = self._kernels_for(data)
            if kernels is None and data.is_cpu:
                adam_step(*values, **options)
            elif kernels is None:
                gpu_steps.append(values)
            else:
                fused = kernels
                fused_steps.append(kernels.AdamStep(*values))
        if fused is not None:
            fused.adam_steps(fused_steps, **options)
        if gpu_steps:
            adam_steps(gpu_steps, **options)

    @torch.no_grad()
    def last_step(self, name: str, rows: Tensor) -> Tensor:
        """Return by how much the last step changed rows (m,) of a parameter, (m, ...).

        It is computed from the moments, since a difference of large parameter values would lose digits."""
        first, second = (moment[rows] for moment in self.moments[name])
        count = max(self.steps[name], 1)
        root = (second.sqrt() / math.sqrt(1 - BETA2**count)).add_(self.epsilon)
        return first / root * (-self.rates[name] / (1 - BETA1**count))

    def zero_grad(self) -> None:
        """Set all gradients to None."""
        for parameter in self.parameters.values():
            parameter.grad = None

    @torch.no_grad()
    def keep_rows(self, index: Tensor, names: Iterable[str] | None = None) -> None:
        """Keep only some rows of the parameters, with their moments; sets the gradients to None.

        index: boolean mask, or row numbers, which may be a new order. names: names of these parameters; None for all.
        """
        for name in self.parameters if names is None else names:
            parameter, moments = self.parameters[name], self.moments[name]
            replace_rows(parameter, parameter.data[index])
            self.moments[name] = Moments(moments.first[index], moments.second[index])

    @torch.no_grad()
    def append_rows(self, rows: Mapping[str, Tensor]) -> None:
        """Append rows, by name of the parameter, with zero moments; sets the gradients to None."""
        for name, new in rows.items():
            parameter, moments = self.parameters[name], self.moments[name]
            new = new.to(parameter)
            replace_rows(parameter, torch.cat([parameter.data, new]))
            self.moments[name] = Moments(*(torch.cat([m, torch.zeros_like(new)]) for m in moments))

    @torch.no_grad()
    def reset_moments(self, name: str, index: Tensor | None = None) -> None:
        """Set the moments of a parameter to zero, for all rows or those of the index."""
        for moment in self.moments[name]:
            moment[slice(None) if index is None else index] = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the moments as "name.first" and "name.second", and the step counts as "steps"."""
        state: dict[str, Any] = {"steps": dict(self.steps)}
        for name, moments in self.moments.items():
            state[f"{name}.first"], state[f"{name}.second"] = moments
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`, after the parameters themselves have been restored.

        Raises RunError for a state that does not fit the parameters.
        """
        for name, parameter in self.parameters.items():
            loaded = [state[key] for key in (f"{name}.first", f"{name}.second") if key in state]
            if len(loaded) < 2 or any(moment.shape != parameter.shape for moment in loaded):
                raise RunError(f"The saved optimiser does not fit {name}; start the fit anew, without resuming.")
            self.moments[name] = Moments(*(moment.to(parameter, copy=True).contiguous() for moment in loaded))
            self.steps[name] = int(state["steps"][name])


def replace_rows(parameter: Parameter, rows: Tensor) -> None:
    """Replace the rows of a parameter by any number of new ones; clears its gradient.

    While an old graph is alive, autograd requires that the shape stays the same, unless the type changes: hence the
    empty tensor of another type in between.
    """
    parameter.data = torch.empty(0, dtype=torch.float16, device=rows.device)
    parameter.data = rows
    parameter.grad = None


def adam_step(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: Rate,
    *, beta1: float, beta2: float, epsilon: float,
) -> None:  # fmt: skip
    """Step a parameter and its moments `first` and `second` in place, in torch, by the formula of the module head.

    step: number of this step, from 1; rate: learning rate, a float or a tensor of the shape of one row."""
    first.lerp_(gradient, 1 - beta1)
    second.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    root = (second.sqrt() / math.sqrt(1 - beta2**step)).add_(epsilon)
    if isinstance(rate, Tensor):
        parameter.sub_(first / root * (rate / (1 - beta1**step)))
    else:
        parameter.addcdiv_(first, root, value=-rate / (1 - beta1**step))


def adam_steps(steps: Sequence[TorchStep], *, beta1: float, beta2: float, epsilon: float) -> None:
    """Make the steps of `adam_step` on many parameters, each operation on all of them at once: on a GPU a fit's
    parameters take ten launches in place of seven each."""
    parameters, gradients, firsts, seconds, counts, rates = (list(column) for column in zip(*steps, strict=True))
    torch._foreach_lerp_(firsts, gradients, 1 - beta1)
    torch._foreach_mul_(seconds, beta2)
    torch._foreach_addcmul_(seconds, gradients, gradients, 1 - beta2)
    roots = torch._foreach_sqrt(seconds)
    torch._foreach_div_(roots, [math.sqrt(1 - beta2**count) for count in counts])
    torch._foreach_add_(roots, epsilon)
    changes = list(torch._foreach_div(firsts, roots))
    torch._foreach_div_(changes, [1 - beta1**count for count in counts])
    for change, rate in zip(changes, rates, strict=True):
        if isinstance(rate, Tensor):
            change.mul_(rate)
    torch._foreach_mul_(changes, [1.0 if isinstance(rate, Tensor) else rate for rate in rates])
    torch._foreach_sub_(parameters, changes)


def _zeros(parameter: Tensor) -> Moments:
    return Moments(*(torch.zeros_like(parameter, memory_format=torch.contiguous_format) for _ in range(2)))
