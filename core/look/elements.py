# SPDX-License-Identifier: GPL-3.0-or-later
"""The Gaussians of a light as elements that an artist knows: the glare at the source, ghosts, streaks, rings.

A fit groups its Gaussians at its end and writes the groups into the .flare (`Element.entry`); where a file has none,
`group` finds them from the canonical Gaussians alone: by kind (ring, streak, compact), and along the line where
their energy has valleys. Element names are unique within a light.
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

MOST = 12
"""Elements of a light at most: what is fainter joins its neighbour."""
RING = 1.0  # r0 in Mahalanobis radii from which on a profile has a hole
LONG = 4.0  # ratio of axes from which on a Gaussian is a streak
SOURCE = 0.15  # |mu - 1| within which compact light is the source's own glare
SMOOTH = 0.03  # of mu, the width at which energy along the line is looked at
VALLEY = 0.6  # a peak stands alone where the energy falls below this share of it


@dataclass(frozen=True, eq=False)
class Element:
    """One element of a light. members: (n,) rows of its Gaussians, ascending. mu: its place on the line
    (0 principal point, 1 light). energy: its share of the light's, 0..1. extent: root mean square distance of its
    light from its centre, normalised image units. colour: its mean, the largest channel 1."""

    name: str
    kind: Kind
    members: NDArray[np.int64]
    mu: float = 0.0
    energy: float = 0.0
    extent: float = 0.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def entry(self, light: str) -> dict[str, Any]:
        """What a .flare's description lists of it; `read` takes it."""
        return {"light": light, "name": self.name, "kind": self.kind, "members": self.members.tolist(),
                "mu": round(self.mu, 5), "energy": round(self.energy, 5), "extent": round(self.extent, 5),
                "colour": [round(value, 4) for value in self.colour]}


def read(entries: Sequence[Mapping[str, Any]], light: str, count: int) -> list[Element]:
    """The elements of `light` that a .flare's description lists; [] where it lists none that fit.

    An entry: see `Element.entry`; "light" and "members" it must have. Gaussians that no entry holds make the
    element "rest".
    """
    found: list[Element] = []
    free = np.ones(count, bool)
    for entry in entries:
        if not isinstance(entry, Mapping) or entry.get("light") != light or "members" not in entry:
            continue
        rows = np.unique(np.asarray(entry["members"], np.int64).reshape(-1))
        if len(rows) and (rows[0] < 0 or rows[-1] >= count):
            raise ValueError(f"the element {entry.get('name')!r} names Gaussians that are not there")
        rows = rows[free[rows]]
        free[rows] = False
        kind = entry.get("kind")
        found.append(Element(_free(str(entry.get("name", "element")), found), kind if kind in KINDS else "ghost", rows,
                             float(entry.get("mu", 0.0)), float(entry.get("energy", 0.0)),
                             float(entry.get("extent", 0.0)), _colour(entry.get("colour", (1, 1, 1)))))
    if found and free.any():
        found.append(Element(_free("rest", found), "ghost", np.flatnonzero(free)))
    return found


def group(gaussians: PlaneGaussians, mu: Floats | None) -> list[Element]:
    """Elements of a light's Gaussians as one view shows them, the brightest first.

    mu: (n,) places on the line; None for a form without the line, whose elements are its kinds.
    """
    energy = gaussians.energy + 1e-12
    kinds = _kinds(gaussians)
    parts: list[tuple[str, NDArray[np.int64]]] = []
    for kind in ("ring", "streak", "compact"):
        rows = np.flatnonzero(kinds == kind)
        if mu is None or len(rows) < 2:
            parts += [(kind, rows)] if len(rows) else []
        else:
            parts += [(kind, rows[part]) for part in _along(mu[rows], energy[rows])]
    parts = _strongest(parts, energy, mu)
    found: list[Element] = []
    for kind, rows in sorted(parts, key=lambda part: -float(energy[part[1]].sum())):
        place = float(np.average(mu[rows], weights=energy[rows])) if mu is not None else 0.0
        compact = "glare" if mu is not None and abs(place - 1) < SOURCE else "ghost"
        name = cast(Kind, compact if kind == "compact" else kind)
        found.append(Element(_free(name, found), name, rows, place, float(energy[rows].sum() / energy.sum()),
                             *_shape(gaussians.kept(rows), energy[rows])))
    return found


def _shape(gaussians: PlaneGaussians, energy: Floats) -> tuple[float, tuple[float, float, float]]:
    """Extent and colour of some Gaussians together."""
    weights = energy / energy.sum()
    away = gaussians.means - weights @ gaussians.means
    spread = gaussians.covariances[:, 0] + gaussians.covariances[:, 2]
    if gaussians.rings is not None:  # the mean of r² over a ring, that of the plain profile for r0 = 0
        r0, w = np.maximum(gaussians.rings[:, 0], 0), gaussians.rings[:, 1]
        spread = spread * (r0 * r0 + 2 * w * w) / 2
    extent = float(np.sqrt(weights @ ((away * away).sum(-1) + spread)))
    colour = weights @ np.maximum(gaussians.colours, 0)
    return extent, _colour(colour / max(float(colour.max()), 1e-12))


def _colour(values: Any) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _kinds(gaussians: PlaneGaussians) -> NDArray[np.str_]:
    xx, xy, yy = gaussians.covariances.T
    half, root = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    long = np.sqrt((half + root) / np.maximum(half - root, 1e-12)) >= LONG
    kinds = np.where(long, "streak", "compact")
    if gaussians.rings is not None:
        kinds = np.where(gaussians.rings[:, 0] >= RING, "ring", kinds)
    return kinds


def _along(mu: Floats, energy: Floats) -> list[NDArray[np.int64]]:
    """Groups of rows, cut in the valleys of the energy along the line."""
    low, high = float(mu.min()), float(mu.max())
    if high - low < 2 * SMOOTH:
        return [np.arange(len(mu))]
    bins = min(max(int((high - low) / SMOOTH * 4), 8), 2048)
    edges = np.linspace(low, high, bins + 1)
    density, _ = np.histogram(mu, edges, weights=energy)
    reach = np.arange(-12, 13) * (high - low) / bins
    density = np.convolve(density, np.exp(-0.5 * (reach / SMOOTH) ** 2))[12:-12]
    cuts: list[float] = []
    peak, valley, at = density[0], density[0], 0
    for number, value in enumerate(density):
        if value < valley:
            valley, at = value, number
        if valley < VALLEY * peak and value > valley / VALLEY:  # up again: a new peak began
            cuts.append((edges[at] + edges[at + 1]) / 2)
            peak = valley = value
        elif value > peak:
            peak = valley = value
    owner = np.searchsorted(np.array(cuts), mu)
    return [rows for number in range(len(cuts) + 1) if len(rows := np.flatnonzero(owner == number))]


def _strongest(parts: list[tuple[str, NDArray[np.int64]]], energy: Floats,
               mu: Floats | None) -> list[tuple[str, NDArray[np.int64]]]:
    """At most MOST groups: the faintest joins the nearest of its kind, or of any kind."""
    parts = list(parts)

    def place(rows: NDArray[np.int64]) -> float:
        return 0.0 if mu is None else float(np.average(mu[rows], weights=energy[rows]))

    def faint(part: tuple[str, NDArray[np.int64]]) -> float:
        return float(energy[part[1]].sum())

    floor = 1e-3 * float(energy.sum())
    while len(parts) > 1 and (len(parts) > MOST or faint(min(parts, key=faint)) < floor):
        least = min(range(len(parts)), key=lambda number: faint(parts[number]))
        kind, rows = parts.pop(least)
        here = place(rows)
        nearest = min(range(len(parts)), key=lambda number: (parts[number][0] != kind,
                                                             abs(place(parts[number][1]) - here)))
        parts[nearest] = parts[nearest][0], np.sort(np.concatenate([parts[nearest][1], rows]))
    return parts


def _free(name: str, taken: Sequence[Element]) -> str:
    """`name`, numbered where an element has it already: ghost, ghost 2, ghost 3."""
    names = {element.name for element in taken}
    if name not in names:
        return name
    number = 2
    while f"{name} {number}" in names:
        number += 1
    return f"{name} {number}"
