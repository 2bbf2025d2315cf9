# SPDX-License-Identifier: GPL-3.0-or-later
"""A simulated GPU: tensors that claim to be on "cuda" while their numbers are on the CPU, for tests without a GPU.

Within `SimulatedGpu` every operation checks that its tensors are on one device, as CUDA does, and numpy refuses the
simulated ones. The kernel set `cuda` runs on Warp's CPU device. Tensors that autograd makes inside a backward pass have
no device of their own and go with all others.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from core.gaussians import kernels

GPU = torch.device("cuda")
GETTERS = {"device": torch.Tensor.device.__get__, "is_cpu": torch.Tensor.is_cpu.__get__,
           "is_cuda": torch.Tensor.is_cuda.__get__}
ACROSS_DEVICES = (torch.Tensor.copy_, torch.Tensor.data.__set__, torch.Tensor.grad.__set__)
"""Operations that take tensors of two devices."""
INDEXING = (torch.Tensor.__getitem__, torch.Tensor.__setitem__)
"""Operations whose indices may be on the CPU."""


def device_of(tensor: Tensor) -> str | None:
    """Return "cuda" or "cpu"; None for a tensor that autograd made."""
    return tensor.__dict__.get("simulated_device")


def tag(value: Any, device: str | None) -> Any:
    """Set the device of a tensor, or of all tensors of a list or tuple; return the value."""
    if isinstance(value, Tensor):
        if device is not None:
            value.__dict__["simulated_device"] = device
    elif isinstance(value, list | tuple):
        for part in value:
            tag(part, device)
    return value


def tensors_in(value: Any) -> Iterator[Tensor]:
    """Yield the tensors of nested lists, tuples and dictionaries."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from tensors_in(part)
    elif isinstance(value, dict):
        yield from tensors_in(list(value.values()))


class SimulatedGpu(TorchFunctionMode):
    """Within the context, "cuda" is a device."""

    def __torch_function__(self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.Tensor.to, torch.Tensor.cpu):
            return self._move(func, args, kwargs)
        if func == GETTERS["device"]:
            return GPU if device_of(args[0]) == "cuda" else func(*args)
        if func in GETTERS.values():
            return (device_of(args[0]) == "cuda") == (func == GETTERS["is_cuda"])
        if func in (torch.Tensor.numpy, torch.Tensor.__array__) and device_of(args[0]) == "cuda":
            raise TypeError("can't convert a simulated cuda tensor to numpy")
        requested = kwargs.pop("device", None)
        device = None if requested is None else torch.device(requested).type
        if device == "cuda" and kwargs.get("generator") is not None:
            raise RuntimeError("a generator of the CPU cannot fill a tensor on cuda")
        operands = list(tensors_in([args, kwargs]))
        if device is None:
            device = self._common_device(func, args, operands)
        elif device != "cuda":
            kwargs["device"] = requested
        result = func(*args, **kwargs)
        if func == torch.Tensor.data.__set__:
            tag(args[0], device_of(args[1]))
            return result
        if func is torch.Tensor.__iter__:
            return iter([tag(part, device) for part in result])
        if isinstance(result, Tensor) and any(result is operand for operand in operands):
            return result  # an operation in place keeps its device
        return tag(result, device if operands or device else "cpu")

    @staticmethod
    def _move(func: Callable[..., Any], args: Any, kwargs: dict[str, Any]) -> Tensor:
        """Move a tensor as `Tensor.to` and `Tensor.cpu` do."""
        tensor, *rest = args
        target = "cpu" if func is torch.Tensor.cpu else device_of(tensor)
        arguments = []
        for argument in rest:
            if isinstance(argument, Tensor):
                target = device_of(argument) or target
            elif isinstance(argument, str | torch.device):
                target, argument = torch.device(argument).type, torch.device("cpu")
            arguments.append(argument)
        if (device := kwargs.get("device")) is not None:
            target, kwargs["device"] = torch.device(device).type, torch.device("cpu")
        moved = func(tensor, *arguments, **kwargs)
        if moved is tensor and (target or "cpu") != (device_of(tensor) or "cpu"):
            moved = tensor.clone()
        return moved if moved is tensor else tag(moved, target or "cpu")

    @staticmethod
    def _common_device(func: Callable[..., Any], args: Any, operands: list[Tensor]) -> str | None:
        """Return the device of an operation's result; None if no operand has one. Raises RuntimeError if operands are
        on two devices."""
        on_gpu = [operand for operand in operands if device_of(operand) == "cuda"]
        on_cpu = [operand for operand in operands if device_of(operand) == "cpu"]
        if not on_gpu:
            return "cpu" if on_cpu or not operands else None
        joins = func in (torch.cat, torch.stack)
        mixed = [operand for operand in on_cpu if operand.ndim or joins]
        if func in INDEXING and device_of(args[0]) == "cuda":
            mixed = [] if func is torch.Tensor.__getitem__ else [
                value for value in tensors_in(args[2]) if device_of(value) == "cpu" and value.ndim]
        if mixed and func not in ACROSS_DEVICES:
            raise RuntimeError(f"{func.__name__}: a tensor of {tuple(mixed[0].shape)} is on the CPU, others on cuda")
        return device_of(args[0]) if func in ACROSS_DEVICES else "cuda"


def _on_warp_cpu(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a function of the kernel set `cuda` with the numbers on the CPU; the result is on the simulated GPU."""
    assert all(device_of(tensor) != "cpu" for tensor in tensors_in([args, kwargs])), "a kernel got a tensor of the CPU"
    with torch._C.DisableTorchFunction():
        result = function(*args, **kwargs)
    tag([getattr(result, entry.name) for entry in fields(result)], "cuda")
    return result


def simulate(monkeypatch: pytest.MonkeyPatch, kernel_set: Any) -> SimulatedGpu:
    """Let torch and the kernel sets find a GPU, whose kernels are those of `kernel_set`; return the context in which
    it computes."""
    stand_in = SimpleNamespace(rasterize_scene=partial(_on_warp_cpu, kernel_set.rasterize_scene),
                               splat=partial(_on_warp_cpu, kernel_set.splat))
    load = kernels._load_kernel_set
    monkeypatch.setattr(kernels, "_load_kernel_set", lambda name: stand_in if name == "cuda" else load(name))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _device: (4 << 30, 4 << 30))  # bytes free, and all
    from_numpy = torch.from_numpy  # a function that modes do not see
    monkeypatch.setattr(torch, "from_numpy", lambda array: tag(from_numpy(array), "cpu"))
    return SimulatedGpu()
