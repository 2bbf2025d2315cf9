# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates with their colour space, alpha and orientation, and adding flares to them.

Pixels that the flare does not reach keep the exact numbers of their file. `transfer` reads and writes plates here.
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourSpace
from ..colour.srgb import Pixels
from ..images.formats.exif import apply_orientation, undo_orientation
from ..images.formats.tiff import UPRIGHT
from ..images.picture import Picture
from ..images.plates import Plate, read_plate, write_plate
from ..images.read import read_picture
from ..images.write import MAX_HALF

AUTO = "auto"


@dataclass(frozen=True, eq=False)
class ColouredPlate:
    """A plate, its colour space and its Exif orientation; all pixels are as viewers show them."""

    plate: Plate
    space: ColourSpace
    orientation: int = UPRIGHT

    @classmethod
    def read(cls, path: Path, space: ColourSpace | None = None, orientation: int = UPRIGHT) -> ColouredPlate:
        """Read a plate. space: None for that which its file declares.

        Raises FrameError for an unreadable file.
        """
        plate = read_plate(path, space)
        return cls(plate, plate.space, orientation)

    @property
    def values(self) -> Pixels:
        """(height, width, 3) in its own space, codes as 0..1."""
        return apply_orientation(self.plate.values, self.orientation)

    @property
    def alpha(self) -> Pixels | None:
        """(height, width), 0..1; None where the plate is opaque."""
        stored = self.plate.extras.get("channels", {}).get("A") if self.plate.alpha is None else self.plate.alpha
        if stored is None:
            return None
        max_value = np.float32(np.iinfo(stored.dtype).max if stored.dtype.kind == "u" else 1)
        alpha = np.nan_to_num(stored.astype(np.float32) / max_value, nan=1.0)
        return apply_orientation(np.clip(alpha, 0, 1), self.orientation)

    @property
    def has_straight_alpha(self) -> bool:
        """Return whether the plate is a PNG or TIFF with alpha, by which `linear` multiplies its light.

        An EXR's light is multiplied already."""
        return self.plate.alpha is not None

    @property
    def linear(self) -> Pixels:
        """Scene-linear Rec. 709 over black; what alpha hides is black."""
        alpha = self.alpha
        if not self.has_straight_alpha or alpha is None:
            return self.space.to_linear(self.values)
        return self.space.to_linear(self._straight_values(alpha)) * alpha[..., None]

    @property
    def is_full_float(self) -> bool:
        """Return whether the file has 32 bit floats, which 16 bit layers would round."""
        return bool(self.plate.codes.dtype == np.float32)

    def codes_with_light(self, light: Pixels) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """Return codes and alpha as stored, of the plate with light (height, width, 3) in linear Rec. 709.

        The light is added to the picture over black (premultiplied). Where a PNG or TIFF cannot show the sum at its
        alpha, the alpha grows as far as needed. An EXR keeps its alpha, so that the light covers nothing.
        """
        light = self.plate.to_plate_channels(light)
        is_lit = undo_orientation((light != 0).any(-1, keepdims=True), self.orientation)
        alpha, stored_alpha = self.alpha, self.plate.alpha
        if stored_alpha is not None and alpha is not None:
            values, lit_alpha = self._lit_values_and_alpha(light, alpha, stored_alpha.dtype)
            stored_alpha = np.where(is_lit[..., 0], np.maximum(lit_alpha, stored_alpha), stored_alpha)
        elif self.space.is_linear:
            values = self.values + self.space.from_linear(light)
        else:
            values = self.space.from_linear(self.linear + light)
        return np.where(is_lit, self._to_codes(values), self.plate.codes), stored_alpha

    def _lit_values_and_alpha(self, light: Pixels, alpha: Pixels, dtype: np.dtype[Any]) -> tuple[Pixels, NDArray[Any]]:
        """Return values (height, width, 3), and alpha as stored, of a PNG or TIFF whose alpha grows under the light.

        alpha: (height, width), 0..1, of the plate. dtype: type of the stored alpha.
        """
        lit_picture = np.maximum(self.linear + light, 0)
        lit_alpha = alpha_with_light(alpha, lit_picture)
        max_value = np.float32(np.iinfo(dtype).max if dtype.kind == "u" else 1)
        if dtype.kind == "u":  # the colours belong to the alpha as it is stored
            # A rounding error must not add a code.
            lit_alpha = np.ceil(lit_alpha * max_value - np.float32(1e-3)) / max_value
        values = self.space.from_linear(lit_picture / np.maximum(lit_alpha, 1e-6)[..., None])
        if self.plate.straight_alpha is None:  # the file's colours are multiplied by its alpha
            values = values * lit_alpha[..., None]
        stored_alpha = undo_orientation(lit_alpha, self.orientation) * max_value
        return values, (np.round(stored_alpha) if max_value > 1 else stored_alpha).astype(dtype)

    def _to_codes(self, values: Pixels) -> NDArray[Any]:
        """Return upright values in the plate's space as codes, in the orientation and type of the file, clipped to its
        range."""
        values, dtype = undo_orientation(values, self.orientation), self.plate.codes.dtype
        if dtype.kind == "u":
            return np.clip(np.round(values * self.plate.max_code), 0, self.plate.max_code).astype(dtype)
        limit = MAX_HALF if dtype == np.float16 else np.finfo(np.float32).max
        return np.clip(values, -limit, limit).astype(dtype)

    def write(self, path: Path, light: Pixels) -> None:
        """Write `codes_with_light` in the plate's own file type, bit depth, colour space and orientation."""
        codes, alpha = self.codes_with_light(light)
        write_plate(path, self.plate, codes, alpha)

    def _straight_values(self, alpha: Pixels) -> Pixels:
        """Return `values`, not multiplied with alpha. Colours under alpha 0 are no light, and are multiplied by it."""
        if self.plate.straight_alpha is not None:
            return self.values
        return np.asarray(np.clip(self.values / np.maximum(alpha, 1e-6)[..., None], 0, 1), np.float32)


def alpha_with_light(alpha: Pixels, lit: Pixels) -> Pixels:
    """Return the smallest alpha (height, width), 0..1, that a picture over black (height, width, 3) can have, at least
    `alpha`: no channel of premultiplied colour exceeds it."""
    return np.asarray(np.maximum(alpha, np.clip(lit.max(-1), 0, 1)), np.float32)


def upright_picture(path: Path, orientation: int = UPRIGHT, space: ColourSpace | None = None) -> Picture:
    """Read a picture as viewers show it: upright, and black where its alpha hides it. space: in place of what the file
    declares. Raises FrameError."""
    picture = read_picture(path, space=space, over_black=True)
    return Picture(apply_orientation(picture.pixels, orientation), picture.encoding)
