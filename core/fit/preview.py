# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview pictures of a fit: frame | composite | scene | flare, one row for each of some views. `run_loop` writes them.
"""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ..colour.srgb_torch import encode
from ..images.picture import Picture
from ..images.write import write_png
from .rendering import RenderedView

GAP = 4
MAX_SMALL_SIDE = 512  # pixels of the longer side of a small preview


def preview_row(frame: torch.Tensor, view: RenderedView) -> NDArray[np.float32]:
    """Return one view as a strip of frame, composite, scene and flare side by side, with grey gaps, display values.

    The flare is shown as light on black. frame: (height, width, 3). Returns (height, 4 width + 3 GAP, 3).
    """
    flare = encode(view.layers.flare.clamp_min(0)).clamp(0, 1)
    pictures = [frame, view.composite, view.scene.colour.clamp(0, 1), flare]
    gap = np.full((frame.shape[0], GAP, 3), 0.5, np.float32)
    strips = [part for picture in pictures for part in (picture.numpy(), gap)]
    return np.concatenate(strips[:-1], axis=1)


def write_preview(path: Path, rows: Sequence[NDArray[np.float32]]) -> None:
    """Write rows below each other as PNG; their widths may differ by a pixel or two of rounding."""
    if not rows:
        return
    width = min(row.shape[1] for row in rows)
    gap = np.full((GAP, width, 3), 0.5, np.float32)
    strips = [part for row in rows for part in (row[:, :width], gap)]
    write_png(path, np.concatenate(strips[:-1], axis=0))


def write_small_preview(path: Path, strip: NDArray[np.float32]) -> None:
    """Write one view's composite above its flare, small enough for a panel that reads the file again and again.

    strip: the view's frame, composite, scene and flare side by side, from `preview_row`.
    """
    width = (strip.shape[1] - 3 * GAP) // 4
    composite, flare = (strip[:, index * (width + GAP):index * (width + GAP) + width] for index in (1, 3))
    pictures = np.ascontiguousarray(np.concatenate([composite, flare]), np.float32)
    scale = min(MAX_SMALL_SIDE / max(pictures.shape[:2]), 1.0)
    height, width = (max(round(size * scale), 1) for size in pictures.shape[:2])
    write_png(path, Picture(pictures, "srgb").resized(width, height).pixels)


def spread_indices(count: int, number: int) -> list[int]:
    """Return at most `number` indices, evenly spread over `count`."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(number, count))})
