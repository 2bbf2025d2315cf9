# SPDX-License-Identifier: GPL-3.0-or-later
"""What takes a training's steps.

The weights of the convolutions between hidden planes take steps that are as long in every direction (Muon, Jordan
2024), and on average as long as AdamW's (Liu et al. 2025, "Muon is Scalable for LLM Training"), so that one learning
rate serves both; all else takes AdamW's. torch has a Muon, which is made for bfloat16: on processors that are slow at
that it takes thirty times as long as this one, and on those that are not it takes more than twice the processor's time.
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from .workers import ALONE, Learner

NOT_HIDDEN = ("see.", "head.", ".place.")
"""In the names of weights that are shown the frame, or places, and of those that give the answer."""
MOMENTUM, LENGTH = 0.95, 0.2
"""Of Muon's steps: how much of what they went by before counts; their length where AdamW's are of 1."""
ROUNDS, QUINTIC = 5, (3.4445, -4.7750, 2.0315)
"""Of the iteration that makes a matrix's singular values alike: x to a x + b x^3 + c x^5."""


class Optimiser:
    """Of all of a network's parameters, which keep where they lie in memory."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        """decay: of the weights in each step, in parts of its learning rate. Raises ValueError where the weights do not
        lie channels last."""
        self._decay = decay
        self._parameters = dict(network.named_parameters())
        self._matrices = {name: _rows(weight.detach()) for name, weight in self._parameters.items()
                          if weight.ndim > 1 and not any(part in name for part in NOT_HIDDEN)}
        if any(rows.data_ptr() != self._parameters[name].data_ptr() for name, rows in self._matrices.items()):
            raise ValueError("The network's weights do not lie channels last.")
        self._momenta = {name: torch.zeros_like(rows) for name, rows in self._matrices.items()}
        others = [weight for name, weight in self._parameters.items() if name not in self._matrices]
        self._adam = torch.optim.AdamW(others, weight_decay=decay, fused=True)

    @torch.no_grad()
    def step(self, rate: float, learner: Learner = ALONE) -> None:
        """One step by the gradients that the parameters have, which they have no more afterwards. Learners have the
        same gradients, and share the work of Muon's steps, which is nearly a third of an iteration's."""
        stepping = {name: rows for name, rows in self._matrices.items() if self._parameters[name].grad is not None}
        gradients = [_rows(cast(Tensor, self._parameters[name].grad)) for name in stepping]
        momenta = [self._momenta[name] for name in stepping]
        torch._foreach_lerp_(momenta, gradients, 1 - MOMENTUM)
        directions = [ahead.contiguous() for ahead in torch._foreach_lerp(gradients, momenta, MOMENTUM)]
        for together in _parcels(directions, filter(learner.makes, range(len(directions)))):
            made = orthogonalised(torch.stack([directions[number] for number in together]))
            for number, direction in zip(together, made.contiguous().unbind(), strict=True):
                directions[number] = direction
        learner.hand_round(directions)
        rows = list(stepping.values())
        torch._foreach_mul_(rows, 1 - rate * self._decay)
        torch._foreach_mul_(directions, [rate * LENGTH * math.sqrt(max(matrix.shape)) for matrix in rows])
        torch._foreach_sub_(rows, directions)
        for group in self._adam.param_groups:
            group["lr"] = rate
        self._adam.step()
        for parameter in self._parameters.values():
            parameter.grad = None

    def state(self) -> dict[str, Tensor]:
        """What a training needs to go on: `moment.`, which of a parameter's moments, `.` and its name."""
        found = {f"moment.momentum.{name}": value for name, value in self._momenta.items()}
        for name, parameter in self._parameters.items():
            found |= {f"moment.{moment}.{name}": value
                      for moment, value in self._adam.state.get(parameter, {}).items()}
        return found

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state; moments that it lacks begin anew."""
        for key, value in state.items():
            kind, _, rest = key.partition(".")
            moment, _, name = rest.partition(".")
            if kind != "moment" or name not in self._parameters:
                continue
            if moment == "momentum":
                self._momenta[name].copy_(value)
            elif name not in self._matrices:  # AdamW had all of them once
                parameter = self._parameters[name]
                # Laid as the parameter is: a fused step goes through both as they lie in memory.
                self._adam.state[parameter][moment] = (
                    torch.empty_like(parameter, requires_grad=False).copy_(value) if value.shape == parameter.shape
                    else value.to(parameter.device, copy=True))


def _parcels(matrices: Sequence[Tensor], numbers: Iterable[int]) -> Iterable[list[int]]:
    """The numbers, each alone on a processor; on a graphics card, which one does not keep busy, those of matrices of
    the same shape together."""
    found: dict[object, list[int]] = {}
    for number in numbers:
        matrix = matrices[number]
        found.setdefault(matrix.shape if matrix.is_cuda else number, []).append(number)
    return found.values()


def orthogonalised(matrices: Tensor) -> Tensor:
    """(k, n, m), float32: the same singular vectors, singular values between about 0.7 and 1.2.

    Each round multiplies a matrix by a polynomial of its square x x^T, and those of all rounds commute. So they are
    multiplied with each other first, as matrices of the shorter side alone, and the matrix itself comes in twice."""
    a, b, c = QUINTIC
    tall = matrices.shape[-2] > matrices.shape[-1]
    wide = matrices.mT if tall else matrices
    wide = wide / torch.linalg.matrix_norm(wide, keepdim=True).clamp(min=1e-7)
    square = torch.bmm(wide, wide.mT)
    factors = torch.eye(square.shape[-1], dtype=square.dtype, device=square.device).expand_as(square)
    for _ in range(ROUNDS):
        factor = torch.baddbmm(square, square, square, beta=b, alpha=c)
        factor.diagonal(dim1=-2, dim2=-1).add_(a)
        factors = torch.bmm(factors, factor)
        square = torch.bmm(torch.bmm(square, factor), factor)
    found = torch.bmm(factors, wide)
    return found.mT if tall else found


def has_bfloat16(on: torch.device) -> bool:
    """Whether it is fast there: on processors without it torch's convolutions take 9 times as long as in float32."""
    return on.type != "cpu" or bool(torch.cpu.get_capabilities().get("avx512_bf16"))


def _rows(weight: Tensor) -> Tensor:
    """A convolution's weights (out, in, height, width) as a matrix of `out` rows; no copy where they lie in memory
    channels last."""
    return weight.permute(0, 2, 3, 1).flatten(1)
