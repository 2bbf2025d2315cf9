# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads mattes: pictures in which an artist has marked in white where flares may be removed."""
from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FrameError, SettingsError
from ...images.exr import read_data_window
from ...images.formats.exif import apply_orientation, read_exif, undo_orientation
from ...images.formats.tiff import UPRIGHT
from ...images.listing import pictures_below
from ...images.plates import read_plate
from ...images.window import DataWindow, crop_to_display_window

ASPECT_TOLERANCE = 0.01
"""Relative difference of aspect that a matte and its plate may have; a smaller matte has rounded sides."""


class Mattes:
    """One matte for all plates, or a folder with one for each plate under its name with any suffix."""

    def __init__(self, source: Path) -> None:
        """Index the mattes by name. source: the matte or the folder. Raises SettingsError where nothing exists there,
        and where a folder has two mattes for one name."""
        self.source = source
        self._by_name: dict[Path, Path] | None = None
        if source.is_dir():
            self._by_name = _index_by_name(source)
        elif not source.is_file():
            raise SettingsError(f"{source} is missing; give a matte, or a folder with one for each plate.")

    @property
    def files(self) -> list[Path]:
        """All mattes."""
        return [self.source] if self._by_name is None else list(self._by_name.values())

    def path(self, name: Path) -> Path:
        """Return the matte of the plate of that name below its folder. Raises FrameError where it has none."""
        if self._by_name is None:
            return self.source
        matte = self._by_name.get(name.with_suffix(""))
        if matte is None:
            raise FrameError(f"{name} has no matte in {self.source}; add one, all black to remove nothing.")
        return matte

    def read(self, name: Path, plate_window: DataWindow, orientation: int = UPRIGHT) -> NDArray[np.float32]:
        """Read a plate's matte, (height, width) of the pixels that the plate's file stores, 0..1.

        name: path of the plate below its folder. plate_window: where the plate's stored pixels lie in its frame.
        orientation: the plate's Exif orientation.

        The matte may have the size of the plate's frame, another size of the same aspect, or the stored pixels' size.
        Raises FrameError for a damaged matte, and for one of another aspect.
        """
        import cv2

        path = self.path(name)
        window, values = read_data_window(path), _read_matte_values(path)
        oriented = undo_orientation(apply_orientation(values, read_exif(path)[0]), orientation)
        size = oriented.shape[1], oriented.shape[0]
        if window.is_frame and _is_same_aspect(size, plate_window.frame):
            # The matte was painted on the plate as viewers show it. If the aspects differ after the turn, it was
            # painted on the stored pixels, in a program that ignores Exif.
            window, values = DataWindow(size, (0, 0), size), oriented
        if window.is_frame and window.size == plate_window.size:  # painted on the stored pixels, with their overscan
            return np.clip(values, 0, 1)
        (matte_width, matte_height), (width, height) = window.frame, plate_window.frame
        if not _is_same_aspect(window.frame, plate_window.frame):
            raise FrameError(f"{path} is {matte_width} x {matte_height} pixels, another shape than its plate of "
                             f"{width} x {height}; make it for that plate.")
        values = crop_to_display_window(values, window)
        if (matte_width, matte_height) != (width, height):
            values = np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
        x, y = plate_window.origin
        # Crop to the plate's stored pixels: the plate's data window is passed as the display window of the matte.
        values = crop_to_display_window(values, DataWindow(plate_window.frame, (-x, -y), plate_window.size))
        return np.clip(values, 0, 1)


def _is_same_aspect(size: tuple[int, int], other_size: tuple[int, int]) -> bool:
    """Return whether two sizes (width, height) have the same aspect, within ASPECT_TOLERANCE."""
    return abs(size[0] * other_size[1] / (size[1] * other_size[0]) - 1) <= ASPECT_TOLERANCE


def _read_matte_values(path: Path) -> NDArray[np.float32]:
    """Return (height, width), 0..1: the matte's brightest channel; transparent counts as black.

    A straight alpha multiplies it. An EXR's alpha, whose colours are premultiplied, only limits it; where the colours
    of an EXR are black everywhere, its alpha is the matte, unless it is opaque everywhere.
    """
    matte = read_plate(path)
    values = np.nan_to_num(matte.codes.max(-1).astype(np.float32) / np.float32(matte.max_code), nan=0.0, posinf=1.0)
    alpha = matte.straight_alpha
    if alpha is not None:
        return values * alpha
    exr_alpha = matte.extras.get("channels", {}).get("A")
    if exr_alpha is None:
        return values
    alpha = np.nan_to_num(np.asarray(exr_alpha, np.float32), nan=0.0, posinf=1.0)
    if values.any():  # premultiplied, as an EXR should be, or white outside the alpha
        return np.minimum(values, alpha)
    return alpha if (alpha < 1).any() else values  # a roto may be in the alpha alone


def _index_by_name(folder: Path) -> dict[Path, Path]:
    """Return the mattes below a folder, by their path below it without suffix. Raises SettingsError where two mattes
    have one name."""
    mattes: dict[Path, Path] = {}
    for path in pictures_below(folder):
        name = path.relative_to(folder).with_suffix("")
        if name in mattes:
            raise SettingsError(f"{mattes[name]} and {path} are both mattes for {name}; keep one of them.")
        mattes[name] = path
    return mattes
