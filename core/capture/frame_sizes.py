# SPDX-License-Identifier: GPL-3.0-or-later
"""The size of a frame's picture, checked against its camera; `Capture` uses it."""
from __future__ import annotations

from pathlib import Path

from ..errors import FrameError
from ..images.listing import SUFFIXES
from ..images.picture import same_aspect
from ..images.size import picture_size
from ..images.unsupported import unsupported_file_error
from .lens import Lens
from .orientation import TurnedFrame


def matching_size(path: Path, lens: Lens, turned: TurnedFrame | None = None) -> tuple[int, int]:
    """Return the size (width, height) of a frame's picture, turned as it was for the camera solve.

    turned: given where the solve saw the picture turned by its Exif orientation; None where it saw the stored pixels.
    Raises FrameError where its aspect is not the lens's, and for a kind of file that is not read.
    """
    size = turned.upright_size if turned else picture_size(path)
    if not same_aspect(size, (lens.width, lens.height)):
        raise FrameError(f"{path} is {size[0]} x {size[1]} pixels and its camera {lens.width} x {lens.height}, "
                         "which is another shape; use the frames that were solved.")
    if path.suffix.lower() not in SUFFIXES:
        raise unsupported_file_error(path)
    return size


def size_or_model_size(path: Path, lens: Lens, turned: TurnedFrame | None = None) -> tuple[int, int]:
    """Return the picture's size, or the model's where the picture is missing or unusable."""
    try:
        return matching_size(path, lens, turned)
    except FrameError:
        return lens.width, lens.height
