# SPDX-License-Identifier: GPL-3.0-or-later
"""Groups the Gaussians of a light into elements that an artist can edit: glare at the light, ghosts, streaks, rings.

A fit groups its Gaussians at its end and writes the groups into the .flare (`Element.to_json`). For a file without
them, `group_elements` groups the canonical Gaussians: by kind (ring, streak, compact), and along the line at the
valleys of their energy. Element names are unique within a light.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from .plane import Floats, PlaneGaussians

Kind = Literal["glare", "ghost", "streak", "ring"]
KINDS: tuple[Kind, ...] = get_args(Kind)

MAX_ELEMENTS = 12
"""Most elements of a light; the faintest ones join their neighbours."""
MIN_ELEMENT_ENERGY = 1e-3
"""Smallest energy of an element, relative to the light's."""
MIN_RING_RADIUS = 1.0  # r0, Mahalanobis distance, from which a profile is a ring
MIN_STREAK_RATIO = 4.0  # ratio of axes from which a Gaussian is a streak
GLARE_WIDTH = 0.15  # |mu - 1| below which compact light is the light's glare
DENSITY_SIGMA = 0.03  # standard deviation of the blur of the energy along the line, units of mu
VALLEY_RATIO = 0.6  # energy of a valley between two elements, relative to the lower peak


@dataclass(frozen=True, eq=False)
class Element:
    """One element of a light. members: (n,) rows of its Gaussians, ascending. mu: position on the line
    (0 principal point, 1 light). energy: relative to the light's, 0..1. extent: root mean square distance of its light
    from its centre, normalised image units. colour: mean, largest channel 1."""

    name: str
    kind: Kind
    members: NDArray[np.int64]
    mu: float = 0.0
    energy: float = 0.0
    extent: float = 0.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def to_json(self, light: str) -> dict[str, Any]:
        """Return the element's entry in a .flare's description, for `read_elements`."""
        return {"light": light, "name": self.name, "kind": self.kind, "members": self.members.tolist(),
                "mu": round(self.mu, 5), "energy": round(self.energy, 5), "extent": round(self.extent, 5),
                "colour": [round(value, 4) for value in self.colour]}


def read_elements(entries: Sequence[Mapping[str, Any]], light: str, count: int) -> list[Element]:
    """Return the elements of `light` that a .flare's description lists; [] if it lists none.

    entries: as `Element.to_json` makes them; "light" and "members" are required. count: number of the light's
    Gaussians; those without an entry form the element "rest". Raises ValueError for invalid members.
    """
    elements: list[Element] = []
    is_unassigned = np.ones(count, bool)
    for entry in entries:
        if not isinstance(entry, Mapping) or entry.get("light") != light or "members" not in entry:
            continue
        rows = np.unique(np.asarray(entry["members"], np.int64).reshape(-1))
        if len(rows) and (rows[0] < 0 or rows[-1] >= count):
            raise ValueError(f"the element {entry.get('name')!r} names Gaussians that are not there")
        rows = rows[is_unassigned[rows]]  # a Gaussian belongs to the first element that names it
        is_unassigned[rows] = False
        kind = entry.get("kind")
        elements.append(Element(_unique_name(str(entry.get("name", "element")), elements),
                                kind if kind in KINDS else "ghost", rows, float(entry.get("mu", 0.0)),
                                float(entry.get("energy", 0.0)), float(entry.get("extent", 0.0)),
                                _colour(entry.get("colour", (1, 1, 1)))))
    if elements and is_unassigned.any():
        elements.append(Element(_unique_name("rest", elements), "ghost", np.flatnonzero(is_unassigned)))
    return elements


def group_elements(gaussians: PlaneGaussians, mu: Floats | None) -> list[Element]:
    """Group a light's Gaussians, as evaluated for one view, into elements, brightest first.

    mu: (n,) positions on the line, 0 at the principal point, 1 at the light; None for a form without the line, which
    gets one element for each kind.
    """
    energy = gaussians.energy + 1e-12
    kinds = _classify(gaussians)
    groups: list[tuple[str, NDArray[np.int64]]] = []
    for kind in ("ring", "streak", "compact"):
        rows = np.flatnonzero(kinds == kind)
        if mu is None or len(rows) < 2:
            groups += [(kind, rows)] if len(rows) else []
        else:
            groups += [(kind, rows[part]) for part in _split_at_valleys(mu[rows], energy[rows])]
    groups = _merge_faint(groups, energy, mu)
    elements: list[Element] = []
    for kind, rows in sorted(groups, key=lambda part: -float(energy[part[1]].sum())):
        position = float(np.average(mu[rows], weights=energy[rows])) if mu is not None else 0.0
        compact_name = "glare" if mu is not None and abs(position - 1) < GLARE_WIDTH else "ghost"
        name = cast(Kind, compact_name if kind == "compact" else kind)
        elements.append(Element(_unique_name(name, elements), name, rows, position,
                                float(energy[rows].sum() / energy.sum()),
                                *_extent_and_colour(gaussians.select(rows), energy[rows])))
    return elements


def _extent_and_colour(gaussians: PlaneGaussians, energy: Floats) -> tuple[float, tuple[float, float, float]]:
    """Return the root mean square distance of a group's light from its centre, and its mean colour, largest channel 1.

    energy (n,): light of each Gaussian of the group.
    """
    weights = energy / energy.sum()
    offsets = gaussians.means - weights @ gaussians.means
    spread = gaussians.covariances[:, 0] + gaussians.covariances[:, 2]
    if gaussians.rings is not None:
        # Over a ring of radius r0 and width w (Mahalanobis), the mean of r² is approximately r0² + 2 w² (exact for
        # r0 = 0); a plain Gaussian has 2.
        r0, w = np.maximum(gaussians.rings[:, 0], 0), gaussians.rings[:, 1]
        spread = spread * (r0 * r0 + 2 * w * w) / 2
    extent = float(np.sqrt(weights @ ((offsets * offsets).sum(-1) + spread)))
    colour = weights @ np.maximum(gaussians.colours, 0)
    return extent, _colour(colour / max(float(colour.max()), 1e-12))


def _colour(values: Any) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _classify(gaussians: PlaneGaussians) -> NDArray[np.str_]:
    """Return "ring", "streak" or "compact" for each Gaussian (n,)."""
    xx, xy, yy = gaussians.covariances.T
    # The variances along the axes are the mean plus and minus half their difference.
    mean_variance, half_difference = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    axis_ratios = np.sqrt((mean_variance + half_difference) / np.maximum(mean_variance - half_difference, 1e-12))
    is_long = axis_ratios >= MIN_STREAK_RATIO
    kinds = np.where(is_long, "streak", "compact")
    if gaussians.rings is not None:
        kinds = np.where(gaussians.rings[:, 0] >= MIN_RING_RADIUS, "ring", kinds)
    return kinds


def _split_at_valleys(mu: Floats, energy: Floats) -> list[NDArray[np.int64]]:
    """Split Gaussians at the valleys of their energy along the line; return the indices of each part.

    mu (n,): positions on the line. energy (n,): light of each Gaussian. The energy is summed in bins along the line and
    blurred; a valley is a minimum below VALLEY_RATIO times the peaks on both sides."""
    low, high = float(mu.min()), float(mu.max())
    if high - low < 2 * DENSITY_SIGMA:
        return [np.arange(len(mu))]
    # Four bins to a standard deviation; the blur reaches 12 bins, three deviations, to either side.
    bins = min(max(int((high - low) / DENSITY_SIGMA * 4), 8), 2048)
    edges = np.linspace(low, high, bins + 1)
    density, _ = np.histogram(mu, edges, weights=energy)
    offsets = np.arange(-12, 13) * (high - low) / bins
    density = np.convolve(density, np.exp(-0.5 * (offsets / DENSITY_SIGMA) ** 2))[12:-12]
    cuts: list[float] = []
    peak, valley, valley_index = density[0], density[0], 0
    for index, value in enumerate(density):
        if value < valley:
            valley, valley_index = value, index
        if valley < VALLEY_RATIO * peak and value > valley / VALLEY_RATIO:  # up again: a new peak began
            cuts.append((edges[valley_index] + edges[valley_index + 1]) / 2)
            peak = valley = value
        elif value > peak:
            peak = valley = value
    part_numbers = np.searchsorted(np.array(cuts), mu)
    return [rows for index in range(len(cuts) + 1) if len(rows := np.flatnonzero(part_numbers == index))]


def _merge_faint(groups: list[tuple[str, NDArray[np.int64]]], energy: Floats,
                 mu: Floats | None) -> list[tuple[str, NDArray[np.int64]]]:
    """Merge the faintest group into the nearest group on the line, of its own kind if there is one; repeat.

    groups: kind and rows of each. energy, mu (n,): light of each Gaussian, and place on the line. Ends with at most
    MAX_ELEMENTS groups, each with MIN_ELEMENT_ENERGY of the light's energy or more."""
    groups = list(groups)

    def position(rows: NDArray[np.int64]) -> float:
        return 0.0 if mu is None else float(np.average(mu[rows], weights=energy[rows]))

    def group_energy(group: tuple[str, NDArray[np.int64]]) -> float:
        return float(energy[group[1]].sum())

    min_energy = MIN_ELEMENT_ENERGY * float(energy.sum())
    while len(groups) > 1 and (len(groups) > MAX_ELEMENTS or group_energy(min(groups, key=group_energy)) < min_energy):
        faintest = min(range(len(groups)), key=lambda index: group_energy(groups[index]))
        kind, rows = groups.pop(faintest)
        position_of_faintest = position(rows)
        nearest = min(range(len(groups)), key=lambda index: (groups[index][0] != kind,
                                                             abs(position(groups[index][1]) - position_of_faintest)))
        groups[nearest] = groups[nearest][0], np.sort(np.concatenate([groups[nearest][1], rows]))
    return groups


def _unique_name(name: str, elements: Sequence[Element]) -> str:
    """Return `name`, with a number if an element has it already: ghost, ghost 2, ghost 3."""
    names = {element.name for element in elements}
    if name not in names:
        return name
    number = 2
    while f"{name} {number}" in names:
        number += 1
    return f"{name} {number}"
