# SPDX-License-Identifier: GPL-3.0-or-later
"""A picture of how a fit stands: frame | composite | scene | flare, one row for each of some views."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ..flare.compositing import encode
from ..pictures import write_png
from .rendering import RenderedView

GAP = 4


def row(frame: torch.Tensor, view: RenderedView) -> NDArray[np.float32]:
    """One view as a strip (height, 4 widths and gaps, 3), display values. The flare is shown as light on black."""
    flare = encode(view.layers.flare.clamp_min(0)).clamp(0, 1)
    pictures = [frame, view.composite, view.scene.colour.clamp(0, 1), flare]
    gap = np.full((frame.shape[0], GAP, 3), 0.5, np.float32)
    strips = [part for picture in pictures for part in (picture.numpy(), gap)]
    return np.concatenate(strips[:-1], axis=1)


def write_preview(path: Path, rows: Sequence[NDArray[np.float32]]) -> None:
    """Rows below each other as PNG; they may differ in width by a pixel or two of rounding."""
    if not rows:
        return
    width = min(one.shape[1] for one in rows)
    gap = np.full((GAP, width, 3), 0.5, np.float32)
    strips = [part for one in rows for part in (one[:, :width], gap)]
    write_png(path, np.concatenate(strips[:-1], axis=0))


def spread(count: int, wanted: int) -> list[int]:
    """At most `wanted` indices, evenly spread over `count`."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(wanted, count))})
