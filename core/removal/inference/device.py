# SPDX-License-Identifier: GPL-3.0-or-later
"""Selects the device that a removal model runs on; `remover` and `headless/commands/remove.py` use it."""
from __future__ import annotations

import torch

from ...errors import SettingsError

DEVICES = ("auto", "cpu", "cuda", "mps")
"""Names that a person can choose. auto: the first of cuda and mps that this machine has, else the processor."""


def select_device(name: str = "auto") -> torch.device:
    """Return the device of that name. Raises SettingsError where torch does not find it on this machine."""
    if name not in DEVICES:
        raise SettingsError(f"There is no device {name}; choose one of {', '.join(DEVICES)}.")
    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if name == "auto":
        return torch.device(next(kind for kind, is_available in available.items() if is_available))
    if not available[name]:
        raise SettingsError(f"torch finds no {name} device on this machine; use --device auto, or install torch with "
                            f"{name}.")
    return torch.device(name)
