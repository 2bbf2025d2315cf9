# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates, mattes and small networks for tests of the removal."""
from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from core.images.formats import tiff
from core.removal.model import weights
from core.removal.model.network import RemovalNetwork
from core.removal.model.recipe import Recipe, as_dict

TINY = Recipe(widths=(8, 8, 8, 8, 8))


def network_file(path: Path, seed: int = 0, bias: float = 0.0) -> Path:
    """Write a small network of random weights; return its path. `bias` makes it see flare everywhere (> 0) or nowhere
    (< 0)."""
    torch.manual_seed(seed)
    network = RemovalNetwork(TINY.widths, TINY.blocks, TINY.attention)
    with torch.no_grad():
        network.head.weight.mul_(0.1)
        network.head.bias[:3] = bias
    weights.write_weights(path, {name: value.half() for name, value in network.state_dict().items()},
                          {"recipe": json.dumps(as_dict(TINY)), "iteration": "0"})
    return path


def picture(height: int = 60, width: int = 90, max_code: int = 255, dtype: type = np.uint8) -> NDArray[np.generic]:
    random = np.random.default_rng(height)
    smooth = cv2.resize(random.random((6, 9, 3)), (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    return (smooth * max_code).astype(dtype)


def write_codes(path: Path, codes: NDArray[np.generic]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), codes[..., ::-1] if codes.ndim == 3 and codes.shape[2] == 3 else codes)
    return path


def with_no_glow(flare: NDArray[np.float32]) -> NDArray[np.float32]:
    """As `Remover._forward` returns it."""
    return np.concatenate([flare, np.zeros_like(flare)], -1)


def lit_street(size: int, level: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a dark street with a white square lamp in a glow, and the flare in it, each (160, 240, 3) display values.

    The flare is the glow, and what leaves the lamp, `size` pixels a side, at the value `level`, and its rim of one
    pixel at a third of that.
    """
    display, flare = np.full((160, 240, 3), 0.1, np.float32), np.zeros((160, 240, 3), np.float32)
    first = 60
    glow, rim = slice(first - 12, first + size + 12), slice(first, first + size)
    display[glow, glow], flare[glow, glow] = 0.5, 0.35
    display[rim, rim], flare[rim, rim] = 1, 1 - level / 3
    flare[first + 1:first + size - 1, first + 1:first + size - 1] = 1 - level
    return display, flare


def write_tiff(path: Path, codes: NDArray[np.generic], tags: dict[int, tiff.Tag]) -> Path:
    _, data = cv2.imencode(".tif", codes)
    path.write_bytes(tiff.with_tags(data.tobytes(), tags))
    return path
