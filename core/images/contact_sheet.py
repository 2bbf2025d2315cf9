# SPDX-License-Identifier: GPL-3.0-or-later
"""Contact sheets: labelled pictures side by side, (height, width, 3), display values."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..colour.srgb import Pixels

GAP, LABEL_HEIGHT = 4, 22
"""Pixels between two pictures, and of a label above one."""


def side_by_side(pictures: Sequence[Pixels]) -> Pixels:
    """Place pictures of one height in a row."""
    gap = np.zeros((len(pictures[0]), GAP, 3), np.float32)
    return np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=1)


def add_label(text: str, picture: Pixels) -> Pixels:
    """Add a line of text above a picture."""
    import cv2

    label = np.zeros((LABEL_HEIGHT, picture.shape[1], 3), np.float32)
    cv2.putText(label, text, (4, LABEL_HEIGHT - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0.85,) * 3, 1, cv2.LINE_AA)
    return np.concatenate([label, picture])
