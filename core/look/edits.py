# SPDX-License-Identifier: GPL-3.0-or-later
"""What an artist changes of a look. The one definition: the overlay, bake and transfer all go by it.

An edit belongs to all lights (`*`), to a light (`lamp`), or to one of its elements (`lamp/ghost 2`); what
belongs to an element in the end is the product of the three (rotations add up).

    intensity   factor on the linear light, 0 or more
    tint        factors on linear R, G, B, or #rrggbb
    saturation  0 grey, 1 as it is, above 1 stronger: L + s (c - L), L the luminance of Rec. 709
    scale       size of each element about its own centre
    spread      distance of each element's centre from the light: 0 all at the light, 1 as it is
    rotation    degrees that each element turns about its own centre, clockwise as the picture is seen
    streak      length of the streaks: stretches elements of that kind along their long axis
    mute        1 leaves it out; solo: 1 leaves out the others (lights beside lights, elements beside elements)

Colour is linear in the light, so for whole lights it can be applied to finished layers (`matrix`), whatever
was fitted. Where the flare covers ("over"), an element's light is not a sum: there intensity below 1 makes
it more transparent and above 1 brighter.
"""
from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..choices import Blend
from ..colour.srgb import LUMINANCE, linear_from_srgb, srgb_from_linear
from ..errors import SettingsError
from .elements import Element
from .plane import Floats, PlaneGaussians, joined

Gain = tuple[float, float, float]

ALL = "*"
_WHITE: Gain = (1.0, 1.0, 1.0)
_HEX = re.compile(r"#[0-9A-Fa-f]{6}")
_FACTORS = ("intensity", "saturation", "scale", "spread", "streak")
_FLAGS = ("mute", "solo")
_LARGEST = 1e6


@dataclass(frozen=True)
class Edit:
    """See the module's head; the defaults change nothing."""

    intensity: float = 1.0
    tint: Gain = _WHITE
    saturation: float = 1.0
    scale: float = 1.0
    spread: float = 1.0
    rotation: float = 0.0
    streak: float = 1.0
    mute: bool = False
    solo: bool = False

    def then(self, other: Edit) -> Edit:
        """Both together. mute: of either; solo is a matter of each level alone and is left out."""
        r, g, b = (x * y for x, y in zip(self.tint, other.tint, strict=True))
        factors = {name: getattr(self, name) * getattr(other, name) for name in _FACTORS}
        return Edit(tint=(r, g, b), rotation=self.rotation + other.rotation, mute=self.mute or other.mute, **factors)

    @property
    def coloured(self) -> bool:
        """Whether it changes colour or brightness."""
        return (self.intensity, self.tint, self.saturation) != (1.0, _WHITE, 1.0)

    @property
    def moved(self) -> bool:
        """Whether it changes shape or place."""
        return (self.scale, self.spread, self.rotation, self.streak) != (1.0, 1.0, 0.0, 1.0)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) from linear R, G, B to linear R, G, B: saturation, then tint and intensity."""
        grey = np.tile(LUMINANCE, (3, 1))
        mixed = self.saturation * np.eye(3) + (1 - self.saturation) * grey
        return self.intensity * np.array(self.tint)[:, None] * mixed

    def of_shape(self) -> Edit:
        """All but its colour."""
        return replace(self, intensity=1.0, tint=_WHITE, saturation=1.0)


NEUTRAL = Edit()


@dataclass(frozen=True)
class LookEdits:
    """Edits of all lights together, by light, and by (light, element)."""

    master: Edit = NEUTRAL
    lights: Mapping[str, Edit] = field(default_factory=dict)
    elements: Mapping[tuple[str, str], Edit] = field(default_factory=dict)

    # ---- what it means -----------------------------------------------------------------------------

    def light(self, name: str) -> Edit:
        """The edit of a light as a whole, the master's included."""
        return self.master.then(self.lights.get(name, NEUTRAL))

    def shows(self, light: str, among: Iterable[str]) -> bool:
        """Whether a light of those in `among` is left in by mute and solo."""
        if self.light(light).mute:
            return False
        solo = [name for name in among if self.lights.get(name, NEUTRAL).solo]
        return not solo or light in solo

    def hidden(self, light: str, elements: Sequence[Element]) -> set[str]:
        """Names of the elements of `light` that mute and solo leave out."""
        edits = {element.name: self.elements.get((light, element.name), NEUTRAL) for element in elements}
        solo = any(edit.solo for edit in edits.values())
        return {name for name, edit in edits.items() if edit.mute or (solo and not edit.solo)}

    @property
    def neutral(self) -> bool:
        """Whether nothing at all is changed."""
        return all(edit == NEUTRAL for edit in (self.master, *self.lights.values(), *self.elements.values()))

    @property
    def colour_of_lights_only(self) -> bool:
        """Whether finished layers, one for each light, suffice: no element and no shape is changed."""
        whole = (self.master, *self.lights.values())
        return all(edit == NEUTRAL for edit in self.elements.values()) and not any(edit.moved for edit in whole)

    def without_colour_of_lights(self) -> LookEdits:
        """What is left for the Gaussians once the lights' colours are applied to finished layers."""
        lights = {name: edit.of_shape() for name, edit in self.lights.items()}
        return LookEdits(self.master.of_shape(), lights, self.elements)

    def matrices(self, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """The linear colour matrix (3, 3) of each light that is changed; zeros where it is left out."""
        result = {}
        for name in names:
            edit = self.light(name)
            if not self.shows(name, names):
                result[name] = np.zeros((3, 3))
            elif edit.coloured:
                result[name] = edit.matrix
        return result

    # ---- as text -----------------------------------------------------------------------------------

    @classmethod
    def parse(cls, edits: Iterable[str], lights: Sequence[str],
              elements: Mapping[str, Sequence[str]] | None = None) -> LookEdits:
        """From `light.property=value` and `light/element.property=value`; later ones add to earlier ones.

        lights: the names there are. elements: by light; None where they are not known and any is taken.
        Raises SettingsError for an edit that names no light, element or property, or has no sensible value.
        """
        made: dict[tuple[str, str], Edit] = {}
        for text in edits:
            name, equals, value = text.rpartition("=")  # a light's name may hold one itself
            whom, dot, what = name.rpartition(".")
            if not (equals and dot and whom.strip()):
                raise SettingsError(f"The edit {text!r} is not of the form light.intensity=2 or light.tint=1,0.5,0.2.")
            change = _change(text, what.rstrip(), value.strip())
            for target in _targets(text, whom, lights, elements):
                before = made.get(target, NEUTRAL)
                after = before.then(change)
                made[target] = replace(after, solo=before.solo or change.solo)
        return cls(made.pop((ALL, ""), NEUTRAL), {light: edit for (light, part), edit in made.items() if not part},
                   {pair: edit for pair, edit in made.items() if pair[1]})

    def words(self) -> list[str]:
        """The same as text that `parse` takes; nothing where nothing is changed."""
        whole = [(ALL, self.master), *self.lights.items()]
        parts = [(f"{light}/{part}", edit) for (light, part), edit in self.elements.items()]
        return [f"{name}.{what}" for name, edit in (*whole, *parts) for what in _words(edit)]

    def towards(self, other: LookEdits, share: float) -> LookEdits:
        """Between these (0) and others (1), number by number; mute and solo change at 1."""
        def between(a: Edit, b: Edit) -> Edit:
            if a == b:
                return a
            numbers = {name: getattr(a, name) + share * (getattr(b, name) - getattr(a, name))
                       for name in (*_FACTORS, "rotation")}
            red, green, blue = (x + share * (y - x) for x, y in zip(a.tint, b.tint, strict=True))
            flags = {name: getattr(b if share >= 1 else a, name) for name in _FLAGS}
            return Edit(tint=(red, green, blue), **numbers, **flags)

        lights = {name: between(self.lights.get(name, NEUTRAL), other.lights.get(name, NEUTRAL))
                  for name in {**self.lights, **other.lights}}
        elements = {pair: between(self.elements.get(pair, NEUTRAL), other.elements.get(pair, NEUTRAL))
                    for pair in {**self.elements, **other.elements}}
        return LookEdits(between(self.master, other.master), lights, elements)


def _targets(text: str, whom: str, lights: Sequence[str],
             elements: Mapping[str, Sequence[str]] | None) -> list[tuple[str, str]]:
    """(light, element or "") that an edit is for."""
    if not any(whom == light or whom.startswith(f"{light}/") for light in lights):
        whom = whom.lstrip()  # only here, since a light's name may begin with a blank
    if whom in lights:
        return [(whom, "")]
    if whom == ALL:
        return [(ALL, "")]
    # Names may hold slashes themselves: the longest light that fits.
    owner = max((light for light in (*lights, ALL) if whom.startswith(f"{light}/")), key=len, default=None)
    if owner is None:
        known = ", ".join(lights) or "no lights at all"
        raise SettingsError(f"The edit {text!r} names the light {whom!r}, but here there is {known}.")
    part = whom[len(owner) + 1:]
    owners = list(lights) if owner == ALL else [owner]
    if elements is None:
        return [(light, part) for light in owners]
    found = [(light, name) for light in owners for name in elements.get(light, ()) if part in (ALL, name)]
    if not found:
        known = ", ".join(dict.fromkeys(name for light in owners for name in elements.get(light, ()))) or "none at all"
        raise SettingsError(f"The edit {text!r} names the element {part!r}, but {owner} has {known}.")
    return found


def _change(text: str, what: str, value: str) -> Edit:
    if what == "tint" and _HEX.fullmatch(value):
        channels = np.array([int(value[at:at + 2], 16) / 255 for at in (1, 3, 5)])
        red, green, blue = linear_from_srgb(channels).tolist()
        return Edit(tint=(red, green, blue))
    wanted = 3 if what == "tint" else 1
    if what not in {entry.name for entry in fields(Edit)}:
        known = ", ".join(entry.name for entry in fields(Edit))
        raise SettingsError(f"The edit {text!r} sets {what!r}; there are {known}.")
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    signed = what == "rotation"
    if len(numbers) != wanted or not all(abs(number) <= _LARGEST and (signed or number >= 0) for number in numbers):
        kind = "one number" if wanted == 1 else "three numbers (or #rrggbb)"
        least = -_LARGEST if signed else 0
        raise SettingsError(f"The edit {text!r} needs {kind} from {least:g} to {_LARGEST:g} after the equals sign.")
    if what in _FLAGS and numbers[0] not in (0, 1):
        raise SettingsError(f"The edit {text!r} needs 0 or 1 after the equals sign.")
    value_of: Any = tuple(numbers) if what == "tint" else bool(numbers[0]) if what in _FLAGS else numbers[0]
    return replace(NEUTRAL, **{what: value_of})


def _words(edit: Edit) -> list[str]:
    words = []
    for entry in fields(Edit):
        value, usual = getattr(edit, entry.name), getattr(NEUTRAL, entry.name)
        if value != usual:
            numbers = value if isinstance(value, tuple) else (int(value) if isinstance(value, bool) else value,)
            # Seven digits: all that a slider's 32 bits hold.
            words.append(f"{entry.name}={','.join(f'{number:.7g}' for number in numbers)}")
    return words


# ---- on Gaussians ---------------------------------------------------------------------------------


def edited(gaussians: PlaneGaussians, light: str, place: NDArray[Any], elements: Sequence[Element], edits: LookEdits,
           blend: Blend) -> PlaneGaussians:
    """One light's Gaussians with the edits applied; order kept, hidden ones gone.

    place: (2,) the light on the normalised plane, delta_l included. elements: groups of the rows.
    blend: "add", where colours are linear light, or "over", where they are display values.
    """
    whole = edits.light(light)
    hidden = edits.hidden(light, elements)
    own = [edits.elements.get((light, element.name), NEUTRAL) for element in elements]
    if not hidden and whole == NEUTRAL and all(edit == NEUTRAL for edit in own):
        return gaussians
    rows: list[NDArray[np.int64]] = []
    parts: list[PlaneGaussians] = []
    loose = np.ones(len(gaussians), bool)
    for element, edit in zip(elements, own, strict=True):
        loose[element.members] = False
        if element.name not in hidden and len(element.members):
            part = _shaped(gaussians.kept(element.members), whole.then(edit), place, element.kind == "streak")
            parts.append(_coloured(part, whole.then(edit), blend))
            rows.append(element.members)
    if loose.any():
        parts.append(_coloured(_shaped(gaussians.kept(loose), whole, place, False), whole, blend))
        rows.append(np.flatnonzero(loose))
    every = joined(parts)
    if every is None:
        return gaussians.kept(np.zeros(0, np.int64))
    return every.kept(np.argsort(np.concatenate(rows), kind="stable"))


def _coloured(part: PlaneGaussians, edit: Edit, blend: Blend) -> PlaneGaussians:
    if not edit.coloured:
        return part
    if blend == "add":
        # Not clipped: a sum of Gaussians then is changed as a finished layer would be.
        return replace(part, colours=np.asarray(part.colours @ edit.matrix.T, np.float32))
    dimmed, brighter = min(edit.intensity, 1.0), max(edit.intensity, 1.0)
    linear = linear_from_srgb(part.colours) @ replace(edit, intensity=brighter).matrix.T
    return replace(part, opacities=np.asarray(part.opacities * dimmed, np.float32),
                   colours=srgb_from_linear(np.maximum(linear, 0)))


def _shaped(part: PlaneGaussians, edit: Edit, place: NDArray[Any], streak: bool) -> PlaneGaussians:
    """Moved and turned as one: x' = c' + A (x - c), covariance' = A covariance A^T, arc' = A arc."""
    length = edit.streak if streak else 1.0
    if (edit.scale, edit.spread, edit.rotation, length) == (1.0, 1.0, 0.0, 1.0):
        return part
    weights = part.energy.astype(np.float64) + 1e-12
    centre = np.average(part.means, axis=0, weights=weights)
    affine = edit.scale * np.eye(2)
    if length != 1.0:
        axis = _long_axis(part, weights, centre)
        affine = affine @ (np.eye(2) + (length - 1) * np.outer(axis, axis))
    angle = math.radians(edit.rotation)
    affine = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]) @ affine
    moved = np.asarray(place, np.float64) + edit.spread * (centre - place)
    means = moved + (part.means - centre) @ affine.T
    (a, b), (c, d) = affine
    xx, xy, yy = part.covariances.T.astype(np.float64)
    covariances = np.stack([a * a * xx + 2 * a * b * xy + b * b * yy,
                            a * c * xx + (a * d + b * c) * xy + b * d * yy,
                            c * c * xx + 2 * c * d * xy + d * d * yy], -1)
    arcs = None if part.arcs is None else np.asarray(part.arcs @ affine.T, np.float32)
    return replace(part, means=means.astype(np.float32), covariances=covariances.astype(np.float32), arcs=arcs)


def _long_axis(part: PlaneGaussians, weights: Floats | NDArray[Any], centre: NDArray[Any]) -> NDArray[np.float64]:
    """Unit vector along the longest extent of all the Gaussians together."""
    xx, xy, yy = np.average(part.covariances, axis=0, weights=weights)
    away = part.means - centre
    spread = (away * np.asarray(weights)[:, None]).T @ away / np.sum(weights)
    _, axes = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]) + spread)
    return np.asarray(axes[:, 1], np.float64)
