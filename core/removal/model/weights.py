# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes weights of the removal network: safetensors with their recipe in the header.

`training.run` writes them, `inference.remover` loads the network from them.
"""
from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ...errors import RunError
from ...system import tensor_files
from ...system.reading import parse_json
from .network import RemovalNetwork
from .weights_file import WEIGHTS_VARIABLE

_MAX_LEVELS, _MAX_SIZE = 16, 4096
"""Bounds of the resolutions of a network, and of the channels or blocks at each."""

RETIRED_NAMES = {"see": "input_convs", "enter": "encoder", "leave": "decoder", "between": "inner_attention",
                 "first": "conv1", "second": "conv2", "place": "pos_embed", "asked": "qkv", "told": "proj",
                 "begun": "initial"}
"""Parts of tensor names in files of format 0, and their present names."""


def write_weights(path: Path | str, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors, and text in the header, atomically."""
    tensor_files.write_tensors(path, tensors, metadata)


def read_weights(path: Path | str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors under their present names, and the text of the header. Raises RunError where the file is
    missing or damaged."""
    if not Path(path).is_file():
        raise RunError(f"The weights of the removal network are missing: {path}; name their file with "
                       f"{WEIGHTS_VARIABLE}, download them in the preferences of the extension, or train them with "
                       "train-removal.")
    try:
        tensors, metadata = tensor_files.read_tensors(path)
    except (OSError, ValueError) as problem:
        raise RunError(f"{path} is damaged ({problem}); get it again.") from problem
    return {_present_name(name): value for name, value in tensors.items()}, metadata


def _present_name(name: str) -> str:
    return ".".join(RETIRED_NAMES.get(part, part) for part in name.split("."))


class Architecture(NamedTuple):
    """The arguments of RemovalNetwork."""

    widths: tuple[int, ...]
    blocks: tuple[int, ...]
    attention: tuple[int, ...]


def read_architecture(path: Path | str, metadata: Mapping[str, str]) -> Architecture:
    """Return the architecture from the recipe in a file's header. The recipe's other settings, which may be those of
    another version, are not read. Raises RunError."""
    try:
        recipe = parse_json(metadata["recipe"])
        if not all(_is_size_list(recipe.get(name, [0])) for name in Architecture._fields):
            raise ValueError("sizes")
        # Without the setting a network has no attention between blocks.
        return Architecture(tuple(recipe["widths"]), tuple(recipe["blocks"]), tuple(recipe.get("attention", (0, 0))))
    except (KeyError, ValueError, TypeError, AttributeError) as problem:
        raise _not_weights_error(path) from problem


def _is_size_list(sizes: object) -> bool:
    """Return whether a value is a list of 1 to _MAX_LEVELS whole numbers of 0 to _MAX_SIZE."""
    return (isinstance(sizes, list) and 0 < len(sizes) <= _MAX_LEVELS
            and all(type(size) is int and 0 <= size <= _MAX_SIZE for size in sizes))


def _not_weights_error(path: Path | str) -> RunError:
    return RunError(f"{path} holds no weights of the removal network; train it with train-removal.")


@lru_cache(maxsize=2)
def load_network(path: Path) -> RemovalNetwork:
    """Load the network of a weights file on the CPU, in evaluation mode; the last two are cached. Raises RunError."""
    tensors, metadata = read_weights(path)
    if not all(bool(value.isfinite().all()) for value in tensors.values()):
        raise RunError(f"{path} holds weights that are no finite numbers; get it again, or train it anew.")
    architecture = read_architecture(path, metadata)
    try:
        # Shapes are compared without data first: a damaged header might ask for more memory than there is.
        with torch.device("meta"):
            expected = RemovalNetwork(*architecture).state_dict()
        if {name: value.shape for name, value in expected.items()} != {
                name: value.shape for name, value in tensors.items()}:
            raise _not_weights_error(path)
        network = RemovalNetwork(*architecture)
        network.load_state_dict({name: value.float() for name, value in tensors.items()})
    except (RuntimeError, TypeError, ValueError) as problem:
        raise _not_weights_error(path) from problem
    return network.eval()
