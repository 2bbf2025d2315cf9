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
    """A small network of random weights; `bias` makes it see flare flare_everywhere (> 0) or no_flare (< 0)."""
    torch.manual_seed(seed)
    network = RemovalNetwork(TINY.widths, TINY.blocks, TINY.attention)
    with torch.no_grad():
        network.head.weight.mul_(0.1)
        network.head.bias[:3] = bias
    weights.write(path, {name: value.half() for name, value in network.state_dict().items()},
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


def with_no_glow(added: NDArray[np.float32]) -> NDArray[np.float32]:
    """As `Remover._forward` returns it."""
    return np.concatenate([added, np.zeros_like(added)], -1)


def lit_street(lamp: int, left: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(160, 240, 3) each: a dark street with a white lamp `lamp` pixels a side in a glow, and as a flare the glow and
    of the lamp what leaves it at the display value `left`, a third of that in its rim of a pixel."""
    display, added = np.full((160, 240, 3), 0.1, np.float32), np.zeros((160, 240, 3), np.float32)
    first = 60
    glow, rim = slice(first - 12, first + lamp + 12), slice(first, first + lamp)
    display[glow, glow], added[glow, glow] = 0.5, 0.35
    display[rim, rim], added[rim, rim] = 1, 1 - left / 3
    added[first + 1:first + lamp - 1, first + 1:first + lamp - 1] = 1 - left
    return display, added


def write_tiff(path: Path, codes: NDArray[np.generic], tags: dict[int, tiff.Tag]) -> Path:
    _, data = cv2.imencode(".tif", codes)
    path.write_bytes(tiff.with_tags(data.tobytes(), tags))
    return path
