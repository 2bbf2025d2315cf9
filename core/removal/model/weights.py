# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights on disk: safetensors with their recipe in the header, and the network that comes of them."""
from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from ...errors import RunError
from ...system import tensor_files as on_disk
from .network import RemovalNetwork

IN_THE_BOX = Path(__file__).parents[1] / "box" / "removal.safetensors"


def write(path: Path | str, tensors: Mapping[str, Tensor], about: Mapping[str, str]) -> None:
    """Tensors and text about them, whole or not at all."""
    on_disk.write(path, tensors, about)


def read(path: Path | str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """(tensors, what is said about them). Raises RunError where the file is missing or damaged."""
    if not Path(path).is_file():
        raise RunError(f"{path} is missing; train it with train-removal, or install the program again.")
    try:
        return on_disk.read(path)
    except (OSError, ValueError) as problem:
        raise RunError(f"{path} is damaged ({problem}); get it again.") from problem


class Form(NamedTuple):
    """What RemovalNetwork is made with."""

    widths: tuple[int, ...]
    blocks: tuple[int, ...]
    attention: tuple[int, ...]


def form(path: Path | str, about: Mapping[str, str]) -> Form:
    """Of the recipe in the header of a file, the rest of which may be of an older program. Raises RunError."""
    try:
        recipe = json.loads(about["recipe"])
        # Recipes of before had none between blocks.
        return Form(tuple(recipe["widths"]), tuple(recipe["blocks"]), tuple(recipe.get("attention", (0, 0))))
    except (KeyError, ValueError, TypeError) as problem:
        raise _foreign(path) from problem


def _foreign(path: Path | str) -> RunError:
    return RunError(f"{path} holds no weights of the removal network; train it with train-removal.")


@lru_cache(maxsize=2)
def load(path: Path = IN_THE_BOX) -> RemovalNetwork:
    """The network of a weights file, on the processor, ready to tell flares. Raises RunError."""
    tensors, about = read(path)
    if not all(bool(value.isfinite().all()) for value in tensors.values()):
        raise RunError(f"{path} holds weights that are no finite numbers; get it again, or train it anew.")
    made_with = form(path, about)
    try:
        network = RemovalNetwork(*made_with)
        network.load_state_dict({name: value.float() for name, value in tensors.items()})
    except (RuntimeError, TypeError, ValueError) as problem:
        raise _foreign(path) from problem
    return network.eval()
