# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens prescriptions: the surfaces of a lens as its patent lists them, and the paraxial ghosts that follow from them.

A prescription is text, one line per surface from the front to the sensor's side:

    radius  thickness  index  Abbe number  clear diameter

Lengths are mm. Thickness and glass are those behind the surface; radius 0 is a plane, a positive radius has its centre
towards the sensor; `stop` in place of a radius is the aperture stop. `#` starts a comment; lines with a colon, and
columns after the fifth, are ignored. (Collections of prescriptions on the web often head the last column "semi
aperture" although it holds diameters; compare it with f / N.)

Ghosts follow Lee and Eisemann 2013, "Practical Real-Time Lens-Flare Rendering": light that is reflected at surface j
and then at surface i < j crosses the lens by a product of 2x2 matrices that act on height and reduced slope. One
product leads to the stop, one to the sensor; both are linear in the ray's height at the entrance and in the slope of
the beam, so a ghost is the stop's shape, scaled and moved along the line through the principal point.

`trace` follows real rays through the same prescriptions; `core.removal.synthesis` uses the paraxial ghosts.
"""
from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingsError
from ..system.reading import read_text

Array = NDArray[np.float64]

INDEX, DIAMETER = 2, 4
"""Columns of a surface's line."""
LINE_F, LINE_D, LINE_C = 0.4861, 0.5876, 0.6563
"""Fraunhofer lines, micrometres."""
CHANNEL_WAVELENGTHS = (0.61, 0.54, 0.46)
"""Of the red, green and blue channel, micrometres."""
MAGNESIUM_FLUORIDE_INDEX = 1.38
MAX_AIR_INDEX = 1.01
"""Refractive index above which a medium is glass; a surface between two glasses is cemented."""
HALF_DIAGONAL = 21.6
"""Half the diagonal of the 24 x 36 mm frame, mm: the unit of the canvas."""


@dataclass(frozen=True, eq=False)
class Prescription:
    """Surfaces from front to back; arrays of length n, lengths in mm. stop: index of the aperture stop's plane."""

    name: str
    curvature: Array
    thickness: Array
    index: Array
    abbe: Array
    semi_aperture: Array
    stop: int

    def indices(self, wavelength: float) -> Array:
        """Return the refractive index (n,) behind each surface at a wavelength in micrometres.

        By Cauchy's equation, a + b / wavelength^2, with a and b from the index at the d line and the Abbe number; Abbe
        number 0 stands for glass without dispersion.
        """
        mean_dispersion = (self.index - 1) / np.maximum(self.abbe, 1e-6)
        dispersion = np.where(self.abbe > 0, mean_dispersion / (LINE_F**-2 - LINE_C**-2), 0.0)
        return self.index + dispersion * (wavelength**-2 - LINE_D**-2)

    def focal_length(self) -> float:
        """Return the paraxial focal length, mm, at the d line; infinite for an afocal system."""
        system = self._system_matrix(self.indices(LINE_D))
        return math.inf if abs(system[1, 0]) < 1e-9 else float(-1.0 / system[1, 0])

    def back_focus(self) -> float:
        """Return the distance from the last surface to the paraxial focus, mm, at the d line."""
        system = self._system_matrix(self.indices(LINE_D))
        return float(-system[0, 0] / system[1, 0])

    def widest_f_number(self) -> float:
        """Return the f-number with the stop fully open: focal length / diameter of the entrance pupil, paraxially."""
        system, index_before, index = np.eye(2), 1.0, self.indices(LINE_D)
        for k in range(self.stop):  # in the end system[0, 0] is the height at the stop of a parallel ray of height 1
            refraction = _refraction(index_before, index[k], self.curvature[k])
            system = _transfer(self.thickness[k], index[k]) @ refraction @ system
            index_before = index[k]
        pupil_radius = float(self.semi_aperture[self.stop] / max(abs(system[0, 0]), 1e-9))
        return self.focal_length() / (2 * min(pupil_radius, float(self.semi_aperture[0])))

    def scaled(self, factor: float) -> Prescription:
        """Return the lens with all lengths multiplied by a factor."""
        return replace(self, curvature=self.curvature / factor, thickness=self.thickness * factor,
                       semi_aperture=self.semi_aperture * factor)

    @property
    def vertices(self) -> Array:
        """z of each surface's vertex, the first at 0."""
        return np.concatenate([[0.0], np.cumsum(self.thickness[:-1])])

    def _system_matrix(self, index: Array) -> Array:
        """Return the ray transfer matrix (2, 2) from before the first surface to behind the last.

        It acts on (height, index times slope). index: (n,), refractive index behind each surface.
        """
        system, index_before = np.eye(2), 1.0
        for k in range(len(index)):
            system = _refraction(index_before, index[k], self.curvature[k]) @ system
            if k + 1 < len(index):
                system = _transfer(self.thickness[k], index[k]) @ system
            index_before = index[k]
        return system


@dataclass(frozen=True)
class GhostPath:
    """One pair of reflections; arrays over the three channel wavelengths, lengths in mm, slopes in radians.

    A ray that enters at height h with slope u meets the stop at `stop[:, 0] h + stop[:, 1] u` at its first passage, by
    `last_stop` at its last, and the sensor at `sensor[:, 0] h + sensor[:, 1] u`. surfaces: (i, j). contrast: (3, 4), by
    wavelength, the indices before and behind each of the two, for `reflectance`.
    """

    surfaces: tuple[int, int]
    stop: Array
    last_stop: Array
    sensor: Array
    contrast: Array


def _refraction(index_before: float, index_after: float, curvature: float) -> Array:
    """Return the matrix (2, 2) of a surface on (height, reduced slope: index times slope)."""
    return np.array([[1.0, 0.0], [-(index_after - index_before) * curvature, 1.0]])


def _transfer(length: float, index: float) -> Array:
    """Return the matrix (2, 2) of a gap of this length, mm, on (height, reduced slope)."""
    return np.array([[1.0, length / index], [0.0, 1.0]])


def trace_ghost_pairs(lens: Prescription) -> list[GhostPath]:
    """Return the paraxial ghost of every pair of reflecting surfaces i < j, traced at each channel's wavelength."""
    focus = lens.back_focus()
    indices_by_channel = [lens.indices(wavelength) for wavelength in CHANNEL_WAVELENGTHS]
    # The stop, and surfaces between equal indices, reflect nothing.
    reflecting = [k for k in range(len(lens.index)) if abs(lens.index[k] - _index_before(lens.index, k)) > 1e-3]
    paths = []
    for i in reflecting:
        for j in reflecting:
            if j > i:
                systems = [_trace_path(lens, index, i, j, focus) for index in indices_by_channel]
                contrast = np.array([[_index_before(index, i), index[i], _index_before(index, j), index[j]]
                                     for index in indices_by_channel])
                stop, last_stop, sensor = (np.array(system) for system in zip(*systems, strict=True))
                paths.append(GhostPath((i, j), stop, last_stop, sensor, contrast))
    return paths


def _index_before(index: Array, k: int) -> float:
    """Return the index before surface k; air before the first."""
    return float(index[k - 1]) if k else 1.0


def _trace_path(lens: Prescription, index: Array, i: int, j: int, focus: float) -> tuple[Array, Array, Array]:
    """Trace a ghost paraxially; return (a, b) at the first and last passage of the stop and at the sensor.

    A ray that enters at height h with slope u has the height a h + b u there. i < j: the surfaces that reflect. index:
    refractive index behind each surface. focus: distance from the last surface to the sensor, mm."""
    system = np.eye(2)
    crossings = []
    curvature, thickness, last = lens.curvature, lens.thickness, len(index) - 1

    def forward(system: Array, first: int, end: int) -> Array:
        """Refract at `first`..`end` - 1, each followed by its gap; note the passages of the stop in `crossings`."""
        for k in range(first, end):
            system = _refraction(_index_before(index, k), index[k], curvature[k]) @ system
            if k == lens.stop:
                crossings.append(system[0])
            if k < last:
                system = _transfer(thickness[k], index[k]) @ system
        return system

    system = forward(system, 0, j)
    # Reflected at j, back to i, reflected there, and on to the sensor. Backwards, curvatures change their signs.
    system = np.array([[1.0, 0.0], [2 * _index_before(index, j) * curvature[j], 1.0]]) @ system
    for k in range(j - 1, i, -1):
        system = _transfer(thickness[k], index[k]) @ system
        if k == lens.stop:
            crossings.append(system[0])
        system = _refraction(index[k], _index_before(index, k), -curvature[k]) @ system
    system = _transfer(thickness[i], index[i]) @ system
    system = np.array([[1.0, 0.0], [-2 * index[i] * curvature[i], 1.0]]) @ system
    if i < last:
        system = _transfer(thickness[i], index[i]) @ system
    system = forward(system, i + 1, last + 1)
    sensor = (_transfer(focus, 1.0) @ system)[0]
    return crossings[0], crossings[-1], sensor


def reflectance(n0: Array, n2: Array, wavelengths: Array, coating: float) -> Array:
    """Return the reflectance, at normal incidence, of a surface between indices n0 and n2; arrays by wavelength.

    By Fresnel's equations, with the interference of one thin film. coating: wavelength, micrometres, for which a layer
    of magnesium fluoride is a quarter wave thick; 0 for bare glass. It is ignored between two glasses.
    """
    bare: Array = np.square((n0 - n2) / (n0 + n2))
    if coating <= 0 or min(float(np.min(n0)), float(np.min(n2))) > MAX_AIR_INDEX:
        return bare
    n1 = MAGNESIUM_FLUORIDE_INDEX
    r01, r12 = (n0 - n1) / (n0 + n1), (n1 - n2) / (n1 + n2)
    phase = np.cos(np.pi * coating / wavelengths)
    numerator = r01**2 + r12**2 + 2 * r01 * r12 * phase
    return numerator / (1 + (r01 * r12) ** 2 + 2 * r01 * r12 * phase)


def read_prescription(path: Path | str) -> Prescription:
    """Read the text format of the module's head. Raises SettingsError where the file is no prescription."""
    path = Path(path)
    try:
        text = read_text(path, errors="replace")
    except OSError as problem:
        raise SettingsError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    return parse_prescription(text, path.stem, str(path))


def parse_prescription(text: str, name: str, source: str = "The lens") -> Prescription:
    """Parse the text format of the module's head; lengths stay in mm. Raises SettingsError for what is no lens.

    name: of the lens. source: beginning of the error's message.
    """
    surfaces: list[list[float]] = []
    stop = -1
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#")[0]
        columns = content.split()
        if not columns or ":" in content:
            continue
        if columns[0] == "stop":
            stop, columns[0] = len(surfaces), "0"
        try:
            surface = [float(column) for column in columns[:5]]
        except ValueError:
            surface = []
        if len(surface) < 5 or not all(map(math.isfinite, surface)) or surface[INDEX] < 0.9 or surface[DIAMETER] <= 0:
            raise SettingsError(f"{source}, line {number}, is not a surface; give radius, thickness, index, Abbe "
                                "number, clear diameter.")
        surfaces.append(surface)
    if len(surfaces) < 3:
        raise SettingsError(f"{source} is not a lens; it needs two surfaces at least and a line that starts with stop.")
    if stop < 0:
        raise SettingsError(f"{source} has no line that starts with stop, like converters, attachments and mirror "
                            "lenses; add the aperture stop, or choose another lens.")
    radius, thickness, index, abbe, diameter = np.array(surfaces).T
    curvature = np.divide(1.0, radius, out=np.zeros_like(radius), where=radius != 0)
    return Prescription(name, curvature, thickness, index, abbe, diameter / 2, stop)


def read_lenses(folder: Path | str, max_count: int = 0) -> list[Prescription]:
    """Return the photographic lenses of a folder, in the order of their files' names.

    Files that are no prescription, mirror lenses, converters, and focal lengths outside 5 to 800 mm are skipped.
    max_count: number of files to read at most, evenly spread; 0 for all. Raises SettingsError if no lens is left.
    """
    paths = sorted(Path(folder).glob("*.lens"))
    if max_count and len(paths) > max_count:
        paths = [paths[k * len(paths) // max_count] for k in range(max_count)]
    lenses = []
    for path in paths:
        try:
            lens = read_prescription(path)
        except SettingsError:
            continue
        if 5 < lens.focal_length() < 800 and (lens.index >= 1).all() and (lens.thickness >= -1e-6).all():
            lenses.append(lens)
    if not lenses:
        raise SettingsError(f"There are no lens prescriptions (.lens) in {folder}; name a folder that has some, or "
                            "none for those that come with the program.")
    return lenses


# As patents publish them, at the d line: radius, thickness, index, Abbe number, clear diameter.
_PATENTS = {
    "FR 1 066 698": "19.655 5.15 1.67786 55.5 19.8 | 0 3.05 1 0 19.8 | -35.52 1.45 1.612 37.2 17.4 | "
                    "16.8175 2.445 1 0 14.5 | stop 1.28 1 0 14.4 | 381.775 1.195 1.5738 42.5 16.6 | "
                    "16.4835 5 1.6608 50.8 17.3 | -24.523 40 1 0 17.3",
    "GB 850 117": "28.95 4.6 1.662 56.1 28.8 | 87.45 0.1 1 0 28.8 | 21.75 3.35 1.662 56.1 24.6 | "
                  "26.75 4.2 1.67246 32.3 24.6 | 13.35 5.3 1 0 19.2 | stop 4.65 1 0 17.1 | "
                  "-15.05 1.9 1.60156 35.2 17.5 | 68.5 7.05 1.662 56.1 21.3 | -21.4 0.3 1 0 21.3 | "
                  "113.65 4.75 1.662 56.1 24.2 | -48 36.86 1 0 24.2",
    "GB 978 797": "64.4 5.39 1.6935 53.6 55.3 | 144.68 0.094 1 0 55.3 | 23.81 2.08 1.6935 53.6 34.5 | "
                  "13.566 5.862 1 0 25 | 33.52 1.892 1.6935 53.6 25.9 | 10.402 5.2 1 0 18.2 | "
                  "126.04 2.836 1.62 60.3 18.5 | 17.02 12.198 1.55 45.4 18.5 | 0 0.472 1 0 12.3 | "
                  "14.534 2.174 1.728 38 12 | 8.52 4.444 1.61 38 12 | -20.538 0.511 1 0 12 | stop 1.239 1 0 8.95 | "
                  "-15.356 0.992 1.678 32.2 9.8 | 8.464 2.08 1.516 56.8 10.1 | 29.786 3.168 1.678 50.8 10.1 | "
                  "-14.732 36.13 1 0 10.1",
    "US 4 333 714": "61.85 3.08 1.564 60.8 31.5 | 525.96 0.2 1 0 31.5 | 43.704 2 1.658 57.3 26 | "
                    "10.686 13.51 1 0 19.3 | 27.96 5 1.723 38 16.7 | -88.64 1.38 1 0 16.7 | -51.1 4 1.613 58.6 16.8 | "
                    "-19.674 0.22 1 0 16.8 | stop 4 1 0 14.5 | -15.412 1.5 1.785 26.1 13.4 | 56.41 0.85 1 0 14.6 | "
                    "-71.028 2.6 1.72 50.3 14.6 | -17.375 0.2 1 0 15.5 | -239.3 2.46 1.697 55.5 16.8 | "
                    "-26.573 39.04 1 0 16.8",
    "US 1 998 704": "57 8 1.6185 60.5 66.3 | 146.3 0.4 1 0 66.3 | 36.2 10 1.6711 47.3 53 | 110 6 1.4645 65.7 53 | "
                    "-300 6.8 1.689 31.2 40.2 | 23.7 10.9 1 0 30.7 | stop 4.1 1 0 29.1 | 200 2 1.5647 55.8 40.4 | "
                    "30.7 12 1.6711 47.3 40.4 | -152.64 48.37 1 0 40.4",
    "US 3 856 386": "34.928 2.728 1.72 50.3 45 | 20.756 5.34 1 0 34.4 | 36.546 1.91 1.717 47.9 34.8 | "
                    "21.296 4.38 1 0 30.5 | 42.402 7.622 1.6968 55.6 29.8 | -169.14 0.194 1 0 29.8 | "
                    "24.02 1.052 1.72 50.3 20.3 | 11.466 4.484 1 0 17 | -106.36 1.12 1.70154 41.1 16.8 | "
                    "12.032 9.24 1.6727 32.2 16.8 | -100.74 0.098 1 0 16.8 | 27.754 8.186 1.60717 40.2 12.5 | "
                    "-20.524 1.18 1 0 12.5 | stop 2.63 1 0 10.1 | -12.846 1.452 1.74 28.2 10.3 | "
                    "16.292 2.476 1.58144 40.8 11.3 | -111.44 0.946 1 0 11.3 | -25.644 2.572 1.691 54.8 12.8 | "
                    "-12.886 0.098 1 0 12.8 | -698.2 2.856 1.64 60.2 16 | -24.62 37.05 1 0 16",
}


def built_in_lenses() -> list[Prescription]:
    """Return a few photographic lenses as their patents list them, so that ghosts need no data."""
    return [parse_prescription(text.replace("|", "\n"), name) for name, text in _PATENTS.items()]
