# SPDX-License-Identifier: GPL-3.0-or-later
"""Tensors on disk: safetensors with text in their header, whole or absent."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from .files import atomic_path


def write(path: Path | str, tensors: Mapping[str, Tensor], about: Mapping[str, str]) -> None:
    """Tensors and text about them."""
    from safetensors.torch import save

    with atomic_path(path) as temporary:
        # As bytes: its own writer makes a temporary file of another name, which a kill would leave behind.
        temporary.write_bytes(save({name: value.cpu().contiguous() for name, value in tensors.items()}, dict(about)))


def read(path: Path | str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """(tensors, the text about them). Raises OSError, and ValueError where the file is damaged.

    Copies: what safetensors gives are views of the file, and while one of them is held Windows lets nobody replace it.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), "pt") as file:
            return ({name: file.get_tensor(name).clone() for name in file.keys()},  # noqa: SIM118 - not a mapping
                    dict(file.metadata() or {}))
    except SafetensorError as problem:
        raise ValueError(str(problem)) from problem
