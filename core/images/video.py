# SPDX-License-Identifier: GPL-3.0-or-later
"""The frames of a video, upright and in the colours that players show.

OpenCV (4.11) reads luma and colour differences by the matrix of standard definition (ITU-R BT.601), whatever the file
says; the colours of a high definition video come out up to a tenth off. So they are brought from there to the matrix
that the file names or, where it names none, to the one that its size stands for. Motion JPEG is BT.601 at any size, and
some files hold RGB itself: those are left as they are.
"""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError

VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".wmv"})
"""Suffixes."""
WIDE, HIGH = 1280, 576
"""Pixels of the long side from which on, or of the short one above which, a video that says nothing is of BT.709."""
WEIGHTS = {"BT.601": (0.299, 0.114), "BT.709": (0.2126, 0.0722), "BT.2020": (0.2627, 0.0593)}
"""Of red and blue in the luma."""
MATRICES = {1: "BT.709", 5: "BT.601", 6: "BT.601", 9: "BT.2020"}
HIGH_RANGE = {16: "PQ", 18: "HLG"}
"""By the numbers of ITU-T H.273: matrix coefficients, transfer characteristics."""
UNSPECIFIED = 2
MOVIE_BYTES = 1 << 24
"""Of a file's description that are looked at."""


def is_video(path: Path) -> bool:
    """Whether a file's name is a video's."""
    return path.suffix.lower() in VIDEOS


def told_short(path: Path, length: int, read: int) -> str:
    """A sentence for the user about a video of which fewer frames could be read than it tells of."""
    return f"{path} tells of {length} frames, and {read} could be read; if it is cut off, copy it again."


def displayed(frame: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Display values 0..1, R G B, of a video's frame."""
    return frame[..., ::-1].astype(np.float32) / np.float32(255)


class Video:
    """The frames of a video, (h, w, 3) uint8 B G R, in order. Raises FrameError where there are none to be had."""

    length: int
    """Frames, as the file has it, which may be too many; 0 where it does not say."""
    aspect: float
    """A pixel's width by its height; 1 where the file does not say."""

    def __init__(self, path: Path) -> None:
        import cv2

        self._reader = cv2.VideoCapture(str(path))
        if not self._reader.isOpened():
            raise FrameError(f"{path} cannot be decoded: it is cut off, or not a video that this program knows; copy "
                               "it again, or convert it to MP4 (H.264).")
        self._reader.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # a telephone held upright
        self.length = max(int(self._reader.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        self.aspect = self._aspect()
        transfer, matrix = _told(path)
        self._colours = None if self._is_as_read() else _from_601(MATRICES.get(matrix) or self._usual())
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

    def seek(self, number: int) -> None:
        """Go on from that frame, counted from 0."""
        import cv2

        self._reader.set(cv2.CAP_PROP_POS_FRAMES, number)

    def _aspect(self) -> float:
        """Of frames turned upright: the file's own is that of frames as they were recorded."""
        import cv2

        wide, high, turned = (self._reader.get(name) for name in (
            cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN, cv2.CAP_PROP_ORIENTATION_META))
        if wide <= 0 or high <= 0:
            return 1.0
        return high / wide if turned % 180 else wide / high

    def _is_as_read(self) -> bool:
        """Whether OpenCV's colours are those of the file: it holds RGB, or Motion JPEG."""
        import cv2

        pixels, codec = (int(self._reader.get(name)).to_bytes(8, "little", signed=True).upper()
                         for name in (cv2.CAP_PROP_CODEC_PIXEL_FORMAT, cv2.CAP_PROP_FOURCC))
        return b"RGB" in pixels or b"BGR" in pixels or codec[:4] in (b"MJPG", b"JPEG", b"MJPA", b"MJPB")

    def _usual(self) -> str:
        """The standard of its size."""
        import cv2

        sides = [self._reader.get(name) for name in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        return "BT.709" if max(sides) >= WIDE or min(sides) > HIGH else "BT.601"


def _told(path: Path) -> tuple[int, int]:
    """Transfer characteristics and matrix coefficients that an MP4's or QuickTime's `colr` box names; UNSPECIFIED where
    there is none."""
    movie = _movie(path) if path.suffix.lower() in (".mp4", ".mov", ".m4v") else b""
    for kind in (b"colrnclx", b"colrnclc"):
        at = movie.find(kind)
        if 0 <= at <= len(movie) - 14:
            return int.from_bytes(movie[at + 10:at + 12], "big"), int.from_bytes(movie[at + 12:at + 14], "big")
    return UNSPECIFIED, UNSPECIFIED


def _movie(path: Path) -> bytes:
    """The box `moov`, which describes the tracks, with its first megabytes; empty where there is none. It stands behind
    the pictures in what cameras write, which are passed over."""
    with open(path, "rb") as stream:
        at, end = 0, stream.seek(0, 2)
        while at + 8 <= end:
            stream.seek(at)
            size, kind = int.from_bytes(stream.read(4), "big"), stream.read(4)
            if kind == b"moov":
                return stream.read(min(size, MOVIE_BYTES))
            size = int.from_bytes(stream.read(8), "big") if size == 1 else size
            if size < 8:  # 0 reaches to the end
                break
            at += size
    return b""


def _from_601(standard: str) -> NDArray[np.float32] | None:
    """(3, 3), B G R: from what BT.601 makes of luma and colour differences to what a standard makes of them; None where
    that is the same."""
    if standard == "BT.601":
        return None

    def differences(red: float, blue: float) -> NDArray[np.float64]:
        luma = np.array([red, 1 - red - blue, blue])
        return np.stack([luma, (np.array([0, 0, 1]) - luma) / (2 - 2 * blue),
                         (np.array([1, 0, 0]) - luma) / (2 - 2 * red)])

    matrix = np.linalg.inv(differences(*WEIGHTS[standard])) @ differences(*WEIGHTS["BT.601"])
    return matrix[::-1, ::-1].astype(np.float32)
