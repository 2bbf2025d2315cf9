# SPDX-License-Identifier: GPL-3.0-or-later
"""Mattes: pictures in which an artist has marked where the flares of plates are, white on black."""
from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FrameError, SettingsError
from ...images.exr import window_of
from ...images.formats.exif import as_stored, read_exif, upright
from ...images.formats.tiff import UPRIGHT
from ...images.listing import pictures_below
from ...images.plates import read_plate
from ...images.window import DataWindow, crop_to_display_window

ASPECT = 0.01
"""By how much of it the aspect of a matte may differ from that of its plate: a smaller one has rounded sides."""


class Mattes:
    """One matte for all plates, or a folder with one for each, under the plate's name with any suffix."""

    def __init__(self, given: Path) -> None:
        """Raises SettingsError where there is nothing, or where a folder has two for one name."""
        self.given = given
        self._by_name: dict[Path, Path] | None = None
        if given.is_dir():
            self._by_name = _by_name(given)
        elif not given.is_file():
            raise SettingsError(f"{given} is missing; give a matte, or a folder with one for each plate.")

    @property
    def files(self) -> list[Path]:
        """All that there are."""
        return [self.given] if self._by_name is None else list(self._by_name.values())

    def path(self, name: Path) -> Path:
        """Of the plate of that name below its folder. Raises FrameError where it has none."""
        if self._by_name is None:
            return self.given
        found = self._by_name.get(name.with_suffix(""))
        if found is None:
            raise FrameError(f"{name} has no matte in {self.given}; add one (black, where no flare is to be taken).")
        return found

    def read(self, name: Path, plate: DataWindow, orientation: int = UPRIGHT) -> NDArray[np.float32]:
        """(height, width), 0..1: the brightest channel of the plate's matte, by its alpha where it has one, as the
        plate is stored. orientation: the plate's, by its Exif. Raises FrameError for a damaged one, and for one of
        another shape."""
        import cv2

        path = self.path(name)
        own, values = window_of(path), _painted(path)
        turned = as_stored(upright(values, read_exif(path)[0]), orientation)
        size = turned.shape[1], turned.shape[0]
        if own.is_frame and _is_of_the_shape(size, plate.frame):
            # Painted on the plate as viewers show it; else on its pixels, by a program that knows nothing of Exif.
            own, values = DataWindow(size, (0, 0), size), turned
        if own.is_frame and own.size == plate.size:  # painted on the very pixels of the plate, overscan and all
            return np.clip(values, 0, 1)
        (columns, rows), (width, height) = own.frame, plate.frame
        if not _is_of_the_shape(own.frame, plate.frame):
            raise FrameError(f"{path} is {columns} x {rows} pixels, another shape than its plate of {width} x "
                             f"{height}; make it for that plate.")
        values = crop_to_display_window(values, own)
        if (columns, rows) != (width, height):
            values = np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
        x, y = plate.origin
        values = crop_to_display_window(values, DataWindow(plate.frame, (-x, -y), plate.size))
        return np.clip(values, 0, 1)


def _is_of_the_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= ASPECT


def _painted(path: Path) -> NDArray[np.float32]:
    """(height, width): a matte's brightest channel by its alpha; what is painted on nothing counts as black."""
    matte = read_plate(path)
    values = np.nan_to_num(matte.codes.max(-1).astype(np.float32) / np.float32(matte.top), nan=0.0, posinf=1.0)
    alpha = matte.straight_alpha
    if alpha is not None:
        return values * alpha
    in_exr = matte.rest.get("channels", {}).get("A")
    if in_exr is None:
        return values
    alpha = np.nan_to_num(np.asarray(in_exr, np.float32), nan=0.0, posinf=1.0)
    if values.any():  # multiplied by alpha, as an EXR should be, or white beside it
        return np.minimum(values, alpha)
    return alpha if (alpha < 1).any() else values  # a roto may be in alpha alone


def _by_name(folder: Path) -> dict[Path, Path]:
    """Every matte of the folder, by its name there without the suffix."""
    found: dict[Path, Path] = {}
    for path in pictures_below(folder):
        name = path.relative_to(folder).with_suffix("")
        if name in found:
            raise SettingsError(f"{found[name]} and {path} are both mattes for {name}; keep one of them.")
        found[name] = path
    return found
