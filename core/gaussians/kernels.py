# SPDX-License-Identifier: GPL-3.0-or-later
"""Kernel sets and their selection.

A kernel set is a module with the functions of `KernelSet`. All kernel sets render the picture that
`reference.py` defines; they differ in speed and device:

    torch   reference.py   the definition; any device, any precision
    tiles   tiles.py       torch, tile by tile, analytic gradients; the fallback
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
    """The functions of a kernel set, with the arguments of `rasterization` and `splat`, which check them; arcs (n, 3)
    come from `rendering.normalise_arcs`."""

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
def _load_kernel_set(name: str) -> KernelSet | ImportError:
    """Return the kernel set of this name, or the error of its import."""
    try:
        module = importlib.import_module(MODULES[name], __package__)
    except ImportError as error:
        return error
    return module if isinstance(module, KernelSet) else ImportError(f"{module.__name__} is incomplete")


def is_available(name: str) -> bool:
    """Return whether this kernel set can be imported."""
    return not isinstance(_load_kernel_set(name), ImportError)


@cache
def _warn_once(message: str) -> None:
    log.warning(message)


class StepsInBackward(Protocol):
    """Steps that a backward pass may make; claimed: names of the parameters whose steps it made."""

    claimed: set[str]


class FusedKernels(Protocol):
    """Functions of the CPU kernels beyond a kernel set. A step is made by `AdamStep`, the layout of a
    hash grid by `GridLayout`; both are otherwise opaque.

    PLACED_COLUMNS: names and widths of the network's offsets that `place` takes."""

    PLACED_COLUMNS: tuple[tuple[str, int], ...]

    def l1_ssim(self, image: Tensor, target: Tensor, lam: float) -> Tensor: ...
    def interpolate_grid(self, table: Tensor, point: Tensor, layout: Any) -> Tensor: ...
    def GridLayout(self, resolutions: Any, starts: Any, rows: Any, primes: Any, corners: Any) -> Any: ...
    def sparse_adam_step(
        self, parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: float,
        beta1: float, beta2: float, epsilon: float,
    ) -> None: ...  # fmt: skip
    def place(
        self, deltas: Tensor, light: Tensor, scale: float, positions: Tensor, log_scales: Tensor, rotations: Tensor,
        opacity_logits: Tensor, sh: Tensor, rings: Tensor, offsets: Tensor,
    ) -> tuple[Tensor, ...] | None: ...  # fmt: skip
    def over(self, colour: Tensor, t: Tensor, behind: Tensor) -> Tensor | None: ...
    def add_light(self, scene: Tensor, light: Tensor, white: float, black: Tensor | None) -> Tensor | None: ...
    def deform(
        self, positions: Tensor, latent: Tensor | None, bands: int, view: Tensor, encoded_weight: Tensor,
        layers: Sequence[tuple[Tensor, Tensor]],
    ) -> Tensor | None: ...  # fmt: skip
    def mean_transmittances(
        self, means: Tensor, quaternions: Tensor, log_scales: Tensor, opacity_logits: Tensor, poses: Tensor,
        intrinsics: Tensor, weights: Tensor, depths: Tensor, slope: float, centre: tuple[float, ...],
        max_distance: float,
    ) -> Tensor | None: ...  # fmt: skip
    def upsample(
        self, colour: Tensor, t: Tensor, factor: int, width: int, height: int
    ) -> tuple[Tensor, Tensor] | None: ...
    def AdamStep(
        self, parameter: Tensor, gradient: Tensor | None, first: Tensor, second: Tensor, step: int,
        rate: float | Tensor,
    ) -> Any: ...  # fmt: skip
    def adam_steps(self, steps: Sequence[Any], *, beta1: float, beta2: float, epsilon: float) -> None: ...
    def offer_steps(
        self, steps: Mapping[str, Any], *, beta1: float, beta2: float, epsilon: float
    ) -> AbstractContextManager[StepsInBackward]: ...


def fused_kernels(like: Tensor) -> FusedKernels | None:
    """Return the CPU kernels if they support tensors of the device and type of `like`, else None.

    Each has a definition in torch, which callers use in place of None."""
    if not like.is_cpu or like.dtype != torch.float32:
        return None
    kernels = _load_kernel_set("cpu")
    return None if isinstance(kernels, ImportError) else cast(FusedKernels, kernels)


def select_kernels(name: str, like: Tensor) -> KernelSet:
    """Return the kernel set of this name; for "auto", the fastest one for the device and type of the tensor `like`.

    Raises SettingsError for an unknown name, EngineError for a kernel set that is not installed.
    """
    if name == "auto":
        name = _fastest_kernel_set(like)
    if name not in MODULES:
        raise SettingsError(
            f"Gaussians are rasterized by the kernels {', '.join(MODULES)} or auto, not {name!r}; choose one of those."
        )
    kernels = _load_kernel_set(name)
    if isinstance(kernels, ImportError):
        raise EngineError(
            f"The {name} kernels cannot be used here ({kernels}); choose auto to do without them."
        )
    return kernels


def _fastest_kernel_set(like: Tensor) -> str:
    """Return the name of the fastest usable kernel set for the device and type of `like`; logs a warning, once, if the
    one for the device cannot be imported."""
    preferred = {"cuda": "cuda", "cpu": "cpu"}.get(like.device.type, "tiles")
    if like.dtype != torch.float32:
        return "tiles"  # the faster ones compute in float32 alone
    kernels = _load_kernel_set(preferred)
    if isinstance(kernels, ImportError):
        _warn_once(f"The {preferred} kernels cannot be used here ({kernels}); slower torch ones take their place.")
        return "tiles"
    return preferred
