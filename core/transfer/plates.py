# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates with their colour space, and adding flares to them.

Pixels that the flare does not reach keep the exact numbers of their file.
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourSpace, colour_space
from ..colour.srgb import Pixels
from ..images.plates import Plate, read_plate, write_plate

AUTO = "auto"


@dataclass(frozen=True, eq=False)
class ColouredPlate:
    """A plate and its colour space."""

    plate: Plate
    space: ColourSpace

    @classmethod
    def read(cls, path: Path, space: str = AUTO, config: str | None = None) -> ColouredPlate:
        """Read a plate. space: a name, or "auto": for EXR by its chromaticities, linear Rec. 709 without them; sRGB for
        other files.

        Raises FrameError for an unreadable file, SettingsError for an unknown space.
        """
        plate = read_plate(path)
        return cls(plate, plate.space if space == AUTO else colour_space(space, config))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self.plate.codes.shape[1], self.plate.codes.shape[0]

    @property
    def values(self) -> Pixels:
        """(height, width, 3) in its own space, codes as 0..1."""
        return self.plate.values

    @property
    def linear(self) -> Pixels:
        """Scene-linear Rec. 709."""
        return self.space.to_linear(self.values)

    @property
    def is_full_float(self) -> bool:
        """Return whether the file has 32 bit floats, which 16 bit layers would round."""
        return bool(self.plate.codes.dtype == np.float32)

    def with_light(self, light: Pixels) -> NDArray[Any]:
        """Return the plate's codes with light (height, width, 3), scene-linear Rec. 709, added."""
        light = self.plate.to_plate_channels(light)
        if self.space.is_linear:
            values = self.values + self.space.from_linear(light)
        else:
            values = self.space.from_linear(self.linear + light)
        codes = self.plate.codes
        if codes.dtype.kind == "u":
            stored = np.clip(np.round(values * self.plate.max_code), 0, self.plate.max_code).astype(codes.dtype)
        else:
            limit = 65504 if codes.dtype == np.float16 else np.finfo(np.float32).max
            stored = np.clip(values, -limit, limit).astype(codes.dtype)
        is_lit = (light != 0).any(-1, keepdims=True)
        return np.where(is_lit, stored, codes)

    def write(self, path: Path, light: Pixels) -> None:
        """Write `with_light` in the plate's own file type, bit depth and colour space."""
        write_plate(path, self.plate, self.with_light(light))
