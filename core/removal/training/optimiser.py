# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimiser of the removal network: Muon for the hidden convolutions, AdamW for everything else.

Muon (Jordan 2024) takes steps of equal length in every direction of a weight matrix. They are scaled to the average
length of AdamW's (Liu et al. 2025, "Muon is Scalable for LLM Training"), so that one learning rate serves both. torch's
own Muon computes in bfloat16: on processors that are slow at it this takes thirty times as long as here, on others more
than twice.
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from .workers import SINGLE_WORKER, Worker

INPUT_AND_OUTPUT_LAYERS = ("input_convs.", "head.", ".pos_embed.")
"""Parts of the names of weights next to the input, the positions and the output, which AdamW optimises."""
MUON_MOMENTUM, MUON_UPDATE_RMS = 0.95, 0.2
"""Momentum of Muon's steps, and their root mean square where AdamW's is 1."""
NEWTON_SCHULZ_STEPS, NEWTON_SCHULZ_COEFFICIENTS = 5, (3.4445, -4.7750, 2.0315)
"""The Newton-Schulz iteration: number of steps, and a, b, c of x -> a x + b x^3 + c x^5 on the singular values."""


class MuonAdamW:
    """Optimises all parameters of a network in place, without moving them in memory."""

    def __init__(self, network: nn.Module, weight_decay: float) -> None:
        """Assign the parameters to Muon or AdamW. weight_decay: per step, relative to the learning rate. Raises
        ValueError where the weights are not channels last in memory."""
        self._weight_decay = weight_decay
        self._parameters = dict(network.named_parameters())
        self._matrices = {name: _as_matrix(weight.detach()) for name, weight in self._parameters.items()
                          if weight.ndim > 1 and not any(part in name for part in INPUT_AND_OUTPUT_LAYERS)}
        if any(rows.data_ptr() != self._parameters[name].data_ptr() for name, rows in self._matrices.items()):
            raise ValueError("The network's weights are not channels last in memory.")
        self._momenta = {name: torch.zeros_like(rows) for name, rows in self._matrices.items()}
        others = [weight for name, weight in self._parameters.items() if name not in self._matrices]
        self._adam = torch.optim.AdamW(others, weight_decay=weight_decay, fused=True)

    @torch.no_grad()
    def step(self, learning_rate: float, worker: Worker = SINGLE_WORKER) -> None:
        """Take one step with the parameters' gradients, and clear them. Workers have the same gradients and share the
        work of Muon's steps, nearly a third of an iteration's."""
        matrices_to_step = {name: matrix for name, matrix in self._matrices.items()
                            if self._parameters[name].grad is not None}
        gradients = [_as_matrix(cast(Tensor, self._parameters[name].grad)) for name in matrices_to_step]
        momenta = [self._momenta[name] for name in matrices_to_step]
        torch._foreach_lerp_(momenta, gradients, 1 - MUON_MOMENTUM)
        # Nesterov momentum: mix the momentum with the present gradient once more.
        directions = [direction.contiguous() for direction in torch._foreach_lerp(gradients, momenta, MUON_MOMENTUM)]
        for group in _group_same_shapes(directions, filter(worker.is_responsible_for, range(len(directions)))):
            orthogonal = orthogonalise(torch.stack([directions[number] for number in group]))
            for number, direction in zip(group, orthogonal.contiguous().unbind(), strict=True):
                directions[number] = direction
        worker.all_gather(directions)
        weights = list(matrices_to_step.values())
        torch._foreach_mul_(weights, 1 - learning_rate * self._weight_decay)
        # An orthogonal matrix has a root mean square of 1 / sqrt(longer side).
        torch._foreach_mul_(directions, [learning_rate * MUON_UPDATE_RMS * math.sqrt(max(matrix.shape))
                                         for matrix in weights])
        torch._foreach_sub_(weights, directions)
        for param_group in self._adam.param_groups:
            param_group["lr"] = learning_rate
        self._adam.step()
        for parameter in self._parameters.values():
            parameter.grad = None

    def state(self) -> dict[str, Tensor]:
        """Return what a resumed training needs: keys are `moment.`, the name of the moment, `.` and the parameter."""
        result = {f"moment.momentum.{name}": value for name, value in self._momenta.items()}
        for name, parameter in self._parameters.items():
            result |= {f"moment.{moment}.{name}": value
                       for moment, value in self._adam.state.get(parameter, {}).items()}
        return result

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Load what `state` returned; moments that are missing in it begin at zero."""
        for key, value in state.items():
            kind, _, rest = key.partition(".")
            moment, _, name = rest.partition(".")
            if kind != "moment" or name not in self._parameters:
                continue
            if moment == "momentum":
                self._momenta[name].copy_(value)
            elif name not in self._matrices:  # some checkpoints have AdamW's moments of all parameters
                parameter = self._parameters[name]
                # In the parameter's memory layout: a fused step walks through both in memory order.
                self._adam.state[parameter][moment] = (
                    torch.empty_like(parameter, requires_grad=False).copy_(value) if value.shape == parameter.shape
                    else value.to(parameter.device, copy=True))


def _group_same_shapes(matrices: Sequence[Tensor], numbers: Iterable[int]) -> Iterable[list[int]]:
    """Group the matrices that are orthogonalised together; return lists of their indices, out of `numbers`. On a CPU
    each is alone; on a GPU, which a single matrix does not keep busy, matrices of the same shape form a group."""
    groups: dict[object, list[int]] = {}
    for number in numbers:
        matrix = matrices[number]
        groups.setdefault(matrix.shape if matrix.is_cuda else number, []).append(number)
    return groups.values()


def orthogonalise(matrices: Tensor) -> Tensor:
    """Return matrices (k, n, m), float32, with the same singular vectors and singular values between about 0.7 and 1.2,
    by the Newton-Schulz iteration.

    Each step multiplies a matrix by a polynomial of its square x x^T, and the polynomials of all steps commute. So they
    are multiplied with each other first, as matrices of the shorter side alone, and the matrix itself is multiplied
    twice.
    """
    a, b, c = NEWTON_SCHULZ_COEFFICIENTS
    tall = matrices.shape[-2] > matrices.shape[-1]
    wide = matrices.mT if tall else matrices
    # No singular value exceeds the Frobenius norm, and the iteration needs them at 1 at most.
    wide = wide / torch.linalg.matrix_norm(wide, keepdim=True).clamp(min=1e-7)
    square = torch.bmm(wide, wide.mT)
    factors = torch.eye(square.shape[-1], dtype=square.dtype, device=square.device).expand_as(square)
    for _ in range(NEWTON_SCHULZ_STEPS):
        # factor: a + b s + c s^2, where s is the square; a step turns s into factor s factor
        factor = torch.baddbmm(square, square, square, beta=b, alpha=c)
        factor.diagonal(dim1=-2, dim2=-1).add_(a)
        factors = torch.bmm(factors, factor)
        square = torch.bmm(torch.bmm(square, factor), factor)
    result = torch.bmm(factors, wide)
    return result.mT if tall else result


def has_bfloat16(on: torch.device) -> bool:
    """Return whether bfloat16 is fast on a device; on processors without it torch's convolutions take 9 times as long
    as in float32."""
    return on.type != "cpu" or bool(torch.cpu.get_capabilities().get("avx512_bf16"))


def _as_matrix(weight: Tensor) -> Tensor:
    """Return a convolution's weights (out, in, height, width) as a matrix of `out` rows; no copy if they are channels
    last in memory."""
    return weight.permute(0, 2, 3, 1).flatten(1)
