# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens prescriptions: the surfaces of a lens as its patent lists them, and what follows paraxially.

A prescription is text, one surface a line from the front to the sensor's side:

    radius  thickness  index  Abbe number  clear diameter

Lengths are mm. Thickness and glass are those behind the surface; radius 0 is a plane, a positive radius
has its centre towards the sensor; `stop` in place of a radius is the aperture stop. `#` starts a comment;
lines with a colon, and columns after the fifth, are left unread. (Collections of prescriptions on the web
often head the last column "semi aperture" although it holds diameters; compare it with f / N.)
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import SettingsError

Array = NDArray[np.float64]

FOLDER = Path(__file__).parent / "lenses"
LINE_F, LINE_D, LINE_C = 0.4861, 0.5876, 0.6563
"""Fraunhofer lines, micrometres."""


@dataclass(frozen=True)
class Prescription:
    """Surfaces in order; arrays of length n. `stop` is the index of the aperture stop's plane."""

    name: str
    curvature: Array
    thickness: Array
    index: Array
    abbe: Array
    semi_aperture: Array
    stop: int

    def indices(self, wavelength: float) -> Array:
        """Refractive index behind each surface at `wavelength` (micrometres): Cauchy's two terms through
        the index at the d line and the Abbe number."""
        glass = self.abbe > 0
        slope = np.zeros_like(self.index)
        slope[glass] = (self.index[glass] - 1) / self.abbe[glass] / (LINE_F**-2 - LINE_C**-2)
        return self.index + slope * (wavelength**-2 - LINE_D**-2)

    def paraxial(self) -> tuple[float, float]:
        """(focal length, distance from the last surface to the focus), mm, at the d line."""
        height, slope, before = 1.0, 0.0, 1.0
        for curvature, gap, after in zip(self.curvature, self.thickness, self.index, strict=True):
            slope = (before * slope - height * (after - before) * curvature) / after
            before = after
            last = height
            height += slope * gap
        return -1.0 / slope, -last / slope

    @property
    def vertices(self) -> Array:
        """z of each surface's vertex, the first at 0."""
        return np.concatenate([[0.0], np.cumsum(self.thickness[:-1])])


def read_prescription(path: Path | str) -> Prescription:
    """Read a prescription. Raises SettingsError where the file is none."""
    path = Path(path)
    rows: list[list[float]] = []
    stop = -1
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as problem:
        raise SettingsError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split()
        if not words or ":" in line.split("#")[0]:
            continue
        if words[0] == "stop":
            stop, words[0] = len(rows), "0"
        try:
            row = [float(word) for word in words[:5]]
        except ValueError as problem:
            raise SettingsError(f"{path}, line {number}, is not a surface; give five numbers.") from problem
        if len(row) < 5:
            raise SettingsError(f"{path}, line {number}, has {len(row)} columns; give five numbers.")
        rows.append(row)
    if stop < 0 or len(rows) < 3:
        raise SettingsError(f"{path} is not a lens: it needs at least two surfaces and a line that starts with stop.")
    radius, thickness, index, abbe, diameter = np.array(rows).T
    curvature = np.divide(1.0, radius, out=np.zeros_like(radius), where=radius != 0)
    return Prescription(path.stem, curvature, thickness, index, abbe, diameter / 2, stop)
