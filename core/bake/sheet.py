# SPDX-License-Identifier: GPL-3.0-or-later
"""A contact sheet of baked layers: frame | composite | scene | flare, one row a view, as a screen shows them."""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..pictures import Picture, write_png
from .layers import FrameLayers

TITLES = ("frame", "composite", "scene", "flare")
_GAP, _HEAD = 4, 22


def contact_sheet(path: Path | str, rows: Iterable[tuple[str, Picture, FrameLayers]]) -> None:
    """Write a PNG. rows: the view's name, its frame, its layers; all of one size."""
    strips: list[NDArray[Any]] = []
    for name, frame, layers in rows:
        linear = (layers.composite, layers.scene, layers.flare)
        pictures = [frame.display(), *(Picture(np.maximum(layer, 0), "linear").display() for layer in linear)]
        heads = [_head(f"{title}  {name}", frame.size[0]) for title in TITLES]
        strips.append(np.concatenate([_side_by_side(heads), _side_by_side(pictures)], axis=0))
    if strips:
        write_png(path, np.concatenate(strips, axis=0))


def _side_by_side(pictures: list[NDArray[Any]]) -> NDArray[Any]:
    gap = np.zeros((pictures[0].shape[0], _GAP, 3), np.float32)
    return np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=1)


def _head(text: str, width: int) -> NDArray[Any]:
    import cv2

    head = np.zeros((_HEAD, width, 3), np.float32)
    cv2.putText(head, text, (4, _HEAD - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0.85,) * 3, 1, cv2.LINE_AA)
    return head
