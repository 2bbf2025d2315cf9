# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of an unfinished fit on disk: one safetensors file, whole or absent.

A state is a nested dictionary of tensors and of what JSON holds: numbers, strings, and lists, nested ones too.
Big tables of which training has touched a few rows are stored as those rows. Nothing is pickled.
"""
from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..errors import RunError
from ..system import tensor_files as on_disk

VERSION = 1
_MANY_ROWS = 100_000
State = dict[str, Any]


def save(path: Path, state: Mapping[str, Any]) -> None:
    """Write a state atomically."""
    tensors: dict[str, Tensor] = {}
    values: dict[str, Any] = {}
    shapes: dict[str, list[int]] = {}
    for name, value in _leaves(state, ""):
        if not isinstance(value, Tensor):
            values[name] = value
            continue
        tensor = value.detach().cpu().contiguous()
        if tensor.ndim == 2 and len(tensor) > _MANY_ROWS:
            rows = tensor.abs().amax(1).nonzero()[:, 0]
            if len(rows) < len(tensor) // 4:
                shapes[name] = list(tensor.shape)
                tensors[f"{name}@rows"], tensors[f"{name}@values"] = rows, tensor[rows]
                continue
        tensors[name] = tensor
    description = json.dumps({"version": VERSION, "values": values, "shapes": shapes})
    on_disk.write(path, tensors, {"checkpoint": description})


def load(path: Path) -> State:
    """Read what `save` wrote. Raises RunError where the file is damaged or of another version."""
    try:
        tensors, about = on_disk.read(path)
        description = json.loads(about["checkpoint"])
        if description["version"] != VERSION:
            raise RunError(f"{path} was written by another version of Fit Flare; start the fit anew.")
        for name, shape in description["shapes"].items():
            rows, values = tensors.pop(f"{name}@rows"), tensors.pop(f"{name}@values")
            tensors[name] = torch.zeros(shape, dtype=values.dtype).index_copy_(0, rows, values)
        flat = {**description["values"], **tensors}
    except (KeyError, TypeError, ValueError, RuntimeError, OSError) as problem:
        raise RunError(f"{path} is damaged ({problem}); remove it and start the fit anew.") from problem
    state: State = {}
    for name, value in flat.items():
        *keys, last = name.split("/")
        table = state
        for key in keys:
            table = table.setdefault(key, {})
        table[last] = value
    return state


def _leaves(table: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", value
