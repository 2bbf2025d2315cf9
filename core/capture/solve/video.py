# SPDX-License-Identifier: GPL-3.0-or-later
"""The frames of a video, upright and in the colours that players show.

OpenCV (4.11) reads the colours of every video by the matrix of standard definition (ITU-R BT.601), whatever its file
says; those of a high definition one come out up to a tenth off. So they are brought from there to the matrix that the
file names or, where it names none, to the one that its size stands for.
"""
from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import CaptureError

HIGH_DEFINITION = 720
"""Lines from which on a video that does not say otherwise is of BT.709."""
WEIGHTS = {"BT.601": (0.299, 0.114), "BT.709": (0.2126, 0.0722), "BT.2020": (0.2627, 0.0593)}
"""Of red and blue in the luma."""
MATRICES = {1: "BT.709", 5: "BT.601", 6: "BT.601", 9: "BT.2020"}
HIGH_RANGE = {16: "PQ", 18: "HLG"}
"""By the numbers of ITU-T H.273: matrix coefficients, transfer characteristics."""


class Video:
    """The frames of a video, (h, w, 3) uint8 B G R, in order. Raises CaptureError where there are none to be had."""

    def __init__(self, path: Path) -> None:
        import cv2

        self._reader = cv2.VideoCapture(str(path))
        if not self._reader.isOpened():
            raise CaptureError(f"{path} cannot be decoded: it is cut off, or not a video that this program knows; copy "
                               "it again, or convert it to MP4 (H.264).")
        self._reader.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # a telephone held upright
        self.length = max(int(self._reader.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        transfer, matrix = _told(path)
        short = min(self._reader.get(cv2.CAP_PROP_FRAME_WIDTH), self._reader.get(cv2.CAP_PROP_FRAME_HEIGHT))
        standard = MATRICES.get(matrix, "BT.709" if short >= HIGH_DEFINITION else "BT.601")
        self._colours = None if standard == "BT.601" else _from_601(*WEIGHTS[standard])
        self.says = () if transfer not in HIGH_RANGE else (
            f"{path} is of high dynamic range ({HIGH_RANGE[transfer]}), and is read as if it were not: a flare fitted "
            "to it is not that of the lens; convert it to EXR frames, or to standard range, first.",)
        """Sentences for the person who gave it."""

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.release()

    def __iter__(self) -> Iterator[Any]:
        import cv2

        while True:
            good, frame = self._reader.read()
            if not good:
                return
            yield frame if self._colours is None else cv2.transform(frame, self._colours)


def _told(path: Path) -> tuple[int, int]:
    """Transfer characteristics and matrix coefficients that an MP4's or QuickTime's `colr` box names; 2, which stands
    for unspecified, where there is none."""
    with open(path, "rb") as stream:
        if not stream.seek(0, 2):
            return 2, 2
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for kind in (b"colrnclx", b"colrnclc"):
                at = data.find(kind)
                if 0 <= at <= len(data) - 14:
                    return int.from_bytes(data[at + 10:at + 12], "big"), int.from_bytes(data[at + 12:at + 14], "big")
    return 2, 2


def _from_601(red: float, blue: float) -> NDArray[np.float32]:
    """(3, 3), B G R: from what BT.601 makes of luma and colour differences to what these weights make of them."""
    def differences(red: float, blue: float) -> NDArray[np.float64]:
        luma = np.array([red, 1 - red - blue, blue])
        return np.stack([luma, (np.array([0, 0, 1]) - luma) / (2 - 2 * blue),
                         (np.array([1, 0, 0]) - luma) / (2 - 2 * red)])

    matrix = np.linalg.inv(differences(red, blue)) @ differences(*WEIGHTS["BT.601"])
    return matrix[::-1, ::-1].astype(np.float32)
