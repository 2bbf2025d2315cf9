# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the frames of a video, upright and in the colours that players show.

OpenCV (4.11) converts luma and colour differences by the matrix of standard definition (ITU-R BT.601), whatever the
file says, so that the colours of high definition are up to a tenth off. Frames are converted from there to the matrix
that the file names or, where it names none, to the usual one of its size. Motion JPEG is BT.601 at any size, and some
files hold RGB: those are left unchanged.
"""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..system.reading import check_regular, open_regular

VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".wmv"})
"""Suffixes of video files."""
MIN_709_WIDTH, MAX_601_HEIGHT = 1280, 576
"""A video without colour tags is BT.709 from this long side, or above this short side, px."""
LUMA_WEIGHTS = {"BT.601": (0.299, 0.114), "BT.709": (0.2126, 0.0722), "BT.2020": (0.2627, 0.0593)}
"""Weights of red and blue in the luma."""
MATRICES = {1: "BT.709", 5: "BT.601", 6: "BT.601", 9: "BT.2020"}
"""Names by the numbers of ITU-T H.273: matrix coefficients, transfer characteristics."""
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
"""Names by the numbers of ITU-T H.273: matrix coefficients, transfer characteristics."""
UNSPECIFIED = 2
MAX_MOOV_BYTES = 1 << 24
"""Bytes of a file's description that are searched."""


def is_video(path: Path) -> bool:
    """True if a file's name is a video's."""
    return path.suffix.lower() in VIDEOS


def truncated_message(path: Path, length: int, read: int) -> str:
    """Sentence for a video of which fewer frames could be read than its header promises."""
    return f"The header of {path} promises {length} frames, and {read} could be read; if it is cut off, copy it again."


def frame_to_display(frame: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Convert a video's frame to display values 0..1, R G B."""
    return frame[..., ::-1].astype(np.float32) / np.float32(255)


class Video:
    """The frames of a video, (h, w, 3) uint8 B G R, in order. Raises FrameError where it cannot be decoded."""

    length: int
    """Number of frames by the file's header, which may be too large; 0 where unknown."""
    aspect: float
    """Pixel aspect ratio (width / height); 1 where unknown."""

    def __init__(self, path: Path) -> None:
        import cv2

        check_regular(path)
        self._reader = cv2.VideoCapture(str(path))
        if not self._reader.isOpened():
            raise FrameError(f"{path} cannot be decoded: it is cut off, or not a video that this program knows; copy "
                               "it again, or convert it to MP4 (H.264).")
        self._reader.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # upright phone footage
        self.length = max(int(self._reader.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        self.aspect = self._aspect()
        transfer, matrix = _read_colour_tags(path)
        standard = MATRICES.get(matrix) or self._usual_standard()
        self._colours = None if self._is_as_read() else _matrix_from_601(standard)
        self.warnings = () if transfer not in HDR_TRANSFERS else (
            f"{path} has high dynamic range ({HDR_TRANSFERS[transfer]}), which is read as standard range: a flare "
            "fitted to it is not that of the lens; convert it to EXR frames, or to standard range, first.",)
        """Sentences for the user."""

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
        """Continue from frame `number`, counted from 0."""
        import cv2

        self._reader.set(cv2.CAP_PROP_POS_FRAMES, number)

    def _aspect(self) -> float:
        """Return the aspect of upright frames; the file's value is of frames as recorded."""
        import cv2

        wide, high, turned = (self._reader.get(name) for name in (
            cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN, cv2.CAP_PROP_ORIENTATION_META))
        if wide <= 0 or high <= 0:
            return 1.0
        return high / wide if turned % 180 else wide / high

    def _is_as_read(self) -> bool:
        """True if OpenCV's colours are those of the file: it holds RGB, or Motion JPEG."""
        import cv2

        pixels, codec = (int(self._reader.get(name)).to_bytes(8, "little", signed=True).upper()
                         for name in (cv2.CAP_PROP_CODEC_PIXEL_FORMAT, cv2.CAP_PROP_FOURCC))
        return b"RGB" in pixels or b"BGR" in pixels or codec[:4] in (b"MJPG", b"JPEG", b"MJPA", b"MJPB")

    def _usual_standard(self) -> str:
        """Return the usual standard of the video's size."""
        import cv2

        sides = [self._reader.get(name) for name in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        return "BT.709" if max(sides) >= MIN_709_WIDTH or min(sides) > MAX_601_HEIGHT else "BT.601"


def _read_colour_tags(path: Path) -> tuple[int, int]:
    """Read transfer characteristics and matrix coefficients from the `colr` box of an MP4 or QuickTime; UNSPECIFIED
    without."""
    movie = _read_moov_box(path) if path.suffix.lower() in (".mp4", ".mov", ".m4v") else b""
    for kind in (b"colrnclx", b"colrnclc"):
        at = movie.find(kind)
        if 0 <= at <= len(movie) - 14:
            return int.from_bytes(movie[at + 10:at + 12], "big"), int.from_bytes(movie[at + 12:at + 14], "big")
    return UNSPECIFIED, UNSPECIFIED


def _read_moov_box(path: Path) -> bytes:
    """Read the start of the `moov` box, which describes the tracks; empty where there is none.

    Cameras write it after the pictures, which are skipped.
    """
    with open_regular(path) as stream:
        at, end = 0, stream.seek(0, 2)
        while at + 8 <= end:
            stream.seek(at)
            size, kind = int.from_bytes(stream.read(4), "big"), stream.read(4)
            if kind == b"moov":
                return stream.read(min(size, MAX_MOOV_BYTES))
            size = int.from_bytes(stream.read(8), "big") if size == 1 else size
            if size < 8:  # 0 reaches to the end
                break
            at += size
    return b""


def _matrix_from_601(standard: str) -> NDArray[np.float32] | None:
    """(3, 3), B G R: corrects colours that were decoded by BT.601 to a standard; None where that is the same."""
    if standard == "BT.601":
        return None

    def differences(red: float, blue: float) -> NDArray[np.float64]:
        luma = np.array([red, 1 - red - blue, blue])
        return np.stack([luma, (np.array([0, 0, 1]) - luma) / (2 - 2 * blue),
                         (np.array([1, 0, 0]) - luma) / (2 - 2 * red)])

    matrix = np.linalg.inv(differences(*LUMA_WEIGHTS[standard])) @ differences(*LUMA_WEIGHTS["BT.601"])
    return matrix[::-1, ::-1].astype(np.float32)
