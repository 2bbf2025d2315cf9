# SPDX-License-Identifier: GPL-3.0-or-later
"""Kernel sets, and which one to use.

A kernel set is a module with the functions of `KernelSet`. All of them compute the picture that
`reference.py` defines; they differ in speed and in where they run:

    torch   reference.py   the definition; any device, any precision
    tiles   tiles.py       torch, tile by tile, analytic gradients; where there is nothing faster
    cpu     cpu/           numba with explicit SIMD; float32
    cuda    cuda.py        NVIDIA; float32
"""
from __future__ import annotations

import importlib
import logging
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from functools import cache
from typing import Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor

from ..choices import Blend
from ..errors import EngineError, SettingsError
from .rendering import Rendering, Splats

MODULES = {"torch": ".reference", "tiles": ".tiles", "cpu": ".cpu", "cuda": ".cuda"}

log = logging.getLogger(__name__)


@runtime_checkable
class KernelSet(Protocol):
    """Arguments as the functions of the same purpose in `rasterizer.py` take them, checked there; arcs (n, 3), as
    `levelled` of `rendering.py` makes them."""

    def rasterize_scene(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
        world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
        *, background: Tensor | None, sh_degree: int, near: float, dilation: float, depth: bool, raw: bool,
    ) -> Rendering: ...  # fmt: skip

    def splat(
        self, centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor,
        width: int, height: int, *, rings: Tensor | None, arcs: Tensor | None, blend: Blend,
    ) -> Splats: ...  # fmt: skip


@cache
def _load(name: str) -> KernelSet | ImportError:
    try:
        module = importlib.import_module(MODULES[name], __package__)
    except ImportError as error:
        return error
    return module if isinstance(module, KernelSet) else ImportError(f"{module.__name__} is incomplete")


def available(name: str) -> bool:
    """Whether this kernel set can be imported here."""
    return not isinstance(_load(name), ImportError)


@cache
def _say_once(sentence: str) -> None:
    log.warning(sentence)


class Offers(Protocol):
    """Steps that a backward pass may take, and the names of the parameters whose steps it took."""

    taken: set[str]


class FusedKernels(Protocol):
    """What the CPU kernels have beside those of a kernel set; a step is `Step` for all but themselves."""

    def l1_ssim(self, image: Tensor, target: Tensor, lam: float) -> Tensor: ...
    def over(self, colour: Tensor, t: Tensor, behind: Tensor) -> Tensor | None: ...
    def enlarged(
        self, colour: Tensor, t: Tensor, factor: int, width: int, height: int
    ) -> tuple[Tensor, Tensor] | None: ...
    def Step(
        self, parameter: Tensor, gradient: Tensor | None, first: Tensor, second: Tensor, step: int,
        rate: float | Tensor,
    ) -> Any: ...  # fmt: skip
    def adam_steps(self, steps: Sequence[Any], *, beta1: float, beta2: float, epsilon: float) -> None: ...
    def offered(
        self, steps: Mapping[str, Any], *, beta1: float, beta2: float, epsilon: float
    ) -> AbstractContextManager[Offers]: ...


def fused(like: Tensor) -> FusedKernels | None:
    """The CPU kernels if they can take tensors such as `like`, else None: for the loss and the optimiser,
    which have a plain torch form of their own."""
    if not like.is_cpu or like.dtype != torch.float32:
        return None
    kernels = _load("cpu")
    return None if isinstance(kernels, ImportError) else cast(FusedKernels, kernels)


def choose(name: str, like: Tensor) -> KernelSet:
    """The kernel set of this name, or the fastest for tensors such as `like` if the name is "auto".

    Raises SettingsError for an unknown name, EngineError for one that is not installed here.
    """
    if name == "auto":
        name = _fastest(like)
    if name not in MODULES:
        raise SettingsError(
            f"Gaussians are rasterized by the kernels {', '.join(MODULES)} or auto, not {name!r}; choose one of those."
        )
    kernels = _load(name)
    if isinstance(kernels, ImportError):
        raise EngineError(
            f"The {name} kernels cannot be used here ({kernels}); choose auto to do without them."
        )
    return kernels


def _fastest(like: Tensor) -> str:
    wanted = {"cuda": "cuda", "cpu": "cpu"}.get(like.device.type, "tiles")
    if like.dtype != torch.float32:
        return "tiles"
    reason = _load(wanted)
    if isinstance(reason, ImportError):
        _say_once(f"The {wanted} kernels cannot be used here ({reason}); slower torch ones take their place.")
        return "tiles"
    return wanted
