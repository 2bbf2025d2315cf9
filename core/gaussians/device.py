# SPDX-License-Identifier: GPL-3.0-or-later
"""Selects the device on which Gaussians are rasterized and optimised; fits, bakes, scores and transfers use it."""
from __future__ import annotations

from typing import get_args

import torch

from ..choices import Device
from ..errors import EngineError, SettingsError
from .kernels import select_kernels


def select_device(name: Device = "auto") -> torch.device:
    """Return the device of that name; "auto" is an NVIDIA GPU that the `cuda` kernels can use, else the processor.

    Raises SettingsError for an unknown name, EngineError for a GPU that is not there or that the kernels cannot use.
    """
    if name not in get_args(Device):
        raise SettingsError(f"There is no device {name}; choose one of {', '.join(get_args(Device))}.")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    device = torch.device("cuda")
    try:
        select_kernels("cuda", torch.empty(0))
    except EngineError as problem:
        if name == "auto":
            return torch.device("cpu")
        raise EngineError("--device cuda needs an NVIDIA GPU, a torch that finds it, and warp-lang; use --device "
                          "cpu, or install them.") from problem
    return device
