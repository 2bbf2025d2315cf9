# SPDX-License-Identifier: GPL-3.0-or-later
"""An artist's edits of a look: definition, text form and application, for the overlay, bake and transfer.

An edit applies to all lights (`*`), to a light (`lamp`), or to one of its elements (`lamp/ghost 2`). The edits of the
three levels multiply; rotations add.

    intensity   factor of the linear light, 0 or more
    tint        factors of linear R, G, B, or #rrggbb
    saturation  0 grey, 1 unchanged, above 1 more saturated: L + s (c - L), L the luminance of Rec. 709
    scale       size of each element about its own centre
    spread      distance of each element's centre from the light: 0 at the light, 1 unchanged
    rotation    rotation of each element about its own centre, degrees, clockwise in the picture
    streak      length of the streaks: stretches elements of that kind along their long axis
    mute        1 turns it off
    solo        1 turns off the others of its level: the other lights, or the other elements of the light

Colour edits are linear, so for whole lights they can be applied to finished layers (`matrix`), whatever the blend. With
the blend "over", the light of an element is not additive: there an intensity below 1 makes it more transparent, above 1
brighter.
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
from .plane import Floats, PlaneGaussians, concatenate

Gain = tuple[float, float, float]

ALL = "*"
_WHITE: Gain = (1.0, 1.0, 1.0)
_HEX = re.compile(r"#[0-9A-Fa-f]{6}")
_FACTORS = ("intensity", "saturation", "scale", "spread", "streak")
_FLAGS = ("mute", "solo")
MAX_VALUE = 1e6


@dataclass(frozen=True)
class Edit:
    """One edit, with the properties of the module's head; the defaults change nothing."""

    intensity: float = 1.0
    tint: Gain = _WHITE
    saturation: float = 1.0
    scale: float = 1.0
    spread: float = 1.0
    rotation: float = 0.0
    streak: float = 1.0
    mute: bool = False
    solo: bool = False

    def combine(self, other: Edit) -> Edit:
        """Return both edits combined: factors multiply, rotations add, muted if either is. Solo acts within its level
        and is dropped."""
        r, g, b = (x * y for x, y in zip(self.tint, other.tint, strict=True))
        factors = {name: getattr(self, name) * getattr(other, name) for name in _FACTORS}
        return Edit(tint=(r, g, b), rotation=self.rotation + other.rotation, mute=self.mute or other.mute, **factors)

    @property
    def changes_colour(self) -> bool:
        """Return whether it changes colour or brightness."""
        return (self.intensity, self.tint, self.saturation) != (1.0, _WHITE, 1.0)

    @property
    def changes_shape(self) -> bool:
        """Return whether it changes shape or position."""
        return (self.scale, self.spread, self.rotation, self.streak) != (1.0, 1.0, 0.0, 1.0)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The matrix (3, 3) on linear R, G, B: saturation, then tint and intensity."""
        grey = np.tile(LUMINANCE, (3, 1))
        mixed = self.saturation * np.eye(3) + (1 - self.saturation) * grey
        return self.intensity * np.array(self.tint)[:, None] * mixed

    def without_colour(self) -> Edit:
        """Return the edit without its colour and brightness."""
        return replace(self, intensity=1.0, tint=_WHITE, saturation=1.0)


NEUTRAL = Edit()


@dataclass(frozen=True)
class LookEdits:
    """The edits of a look: of all lights (`master`), by light, and by (light, element)."""

    master: Edit = NEUTRAL
    lights: Mapping[str, Edit] = field(default_factory=dict)
    elements: Mapping[tuple[str, str], Edit] = field(default_factory=dict)

    # ---- meaning -----------------------------------------------------------------------------------

    def light_edit(self, name: str) -> Edit:
        """Return the edit of a light as a whole, combined with the master's."""
        return self.master.combine(self.lights.get(name, NEUTRAL))

    def is_visible(self, light: str, among: Iterable[str]) -> bool:
        """Return whether mute and solo leave a light of `among` on."""
        if self.light_edit(light).mute:
            return False
        solo = [name for name in among if self.lights.get(name, NEUTRAL).solo]
        return not solo or light in solo

    def hidden_elements(self, light: str, elements: Sequence[Element]) -> set[str]:
        """Return the names of the elements of `light` that mute and solo turn off."""
        edits = {element.name: self.elements.get((light, element.name), NEUTRAL) for element in elements}
        solo = any(edit.solo for edit in edits.values())
        return {name for name, edit in edits.items() if edit.mute or (solo and not edit.solo)}

    @property
    def is_neutral(self) -> bool:
        """Return whether no edit changes anything."""
        return all(edit == NEUTRAL for edit in (self.master, *self.lights.values(), *self.elements.values()))

    @property
    def changes_light_colours_only(self) -> bool:
        """Return whether no edit changes an element or a shape, so that finished layers of the lights suffice."""
        edits = (self.master, *self.lights.values())
        return all(edit == NEUTRAL for edit in self.elements.values()) and not any(edit.changes_shape for edit in edits)

    def without_light_colours(self) -> LookEdits:
        """Return the edits without the colours of whole lights, which `colour_matrices` applies to finished layers."""
        lights = {name: edit.without_colour() for name, edit in self.lights.items()}
        return LookEdits(self.master.without_colour(), lights, self.elements)

    def colour_matrices(self, names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return the linear colour matrix (3, 3) of each changed light; zeros for a light that is off."""
        result = {}
        for name in names:
            edit = self.light_edit(name)
            if not self.is_visible(name, names):
                result[name] = np.zeros((3, 3))
            elif edit.changes_colour:
                result[name] = edit.matrix
        return result

    def for_placed_lights(self, sources: Mapping[str, str]) -> LookEdits:
        """Return these edits for placed lights. sources: the look's light that each placed light shows, by name."""
        lights = {placed: self.lights[source] for placed, source in sources.items() if source in self.lights}
        elements = {(placed, element): edit for placed, source in sources.items()
                    for (light, element), edit in self.elements.items() if light == source}
        return LookEdits(self.master, lights, elements)

    # ---- as text -----------------------------------------------------------------------------------

    @classmethod
    def parse(cls, edits: Iterable[str], lights: Sequence[str],
              elements: Mapping[str, Sequence[str]] | None = None) -> LookEdits:
        """Parse texts `light.property=value` and `light/element.property=value`; edits of one target combine.

        lights: known names. elements: known names by light; None accepts any name.
        Raises SettingsError for an edit with an unknown light, element or property, or an invalid value.
        """
        edits_by_target: dict[tuple[str, str], Edit] = {}
        for text in edits:
            name, equals, value = text.rpartition("=")  # a light's name may hold an equals sign
            address, dot, property_name = name.rpartition(".")
            if not (equals and dot and address.strip()):
                raise SettingsError(f"The edit {text!r} is not of the form light.intensity=2 or light.tint=1,0.5,0.2.")
            change = _parse_change(text, property_name.rstrip(), value.strip())
            for target in _parse_targets(text, address, lights, elements):
                previous = edits_by_target.get(target, NEUTRAL)
                combined = previous.combine(change)  # without solo
                edits_by_target[target] = replace(combined, solo=previous.solo or change.solo)
        return cls(edits_by_target.pop((ALL, ""), NEUTRAL),
                   {light: edit for (light, part), edit in edits_by_target.items() if not part},
                   {pair: edit for pair, edit in edits_by_target.items() if pair[1]})

    def texts(self) -> list[str]:
        """Return the texts that `parse` reads as these edits; [] for edits that change nothing."""
        light_edits = [(ALL, self.master), *self.lights.items()]
        parts = [(f"{light}/{part}", edit) for (light, part), edit in self.elements.items()]
        return [f"{name}.{property_name}" for name, edit in (*light_edits, *parts) for property_name in _to_texts(edit)]

    def interpolate(self, other: LookEdits, share: float) -> LookEdits:
        """Interpolate linearly between these edits (share 0) and others (1); mute and solo change at share 1."""
        def interpolate_edit(a: Edit, b: Edit) -> Edit:
            if a == b:
                return a
            numbers = {name: getattr(a, name) + share * (getattr(b, name) - getattr(a, name))
                       for name in (*_FACTORS, "rotation")}
            red, green, blue = (x + share * (y - x) for x, y in zip(a.tint, b.tint, strict=True))
            flags = {name: getattr(b if share >= 1 else a, name) for name in _FLAGS}
            return Edit(tint=(red, green, blue), **numbers, **flags)

        lights = {name: interpolate_edit(self.lights.get(name, NEUTRAL), other.lights.get(name, NEUTRAL))
                  for name in {**self.lights, **other.lights}}
        elements = {pair: interpolate_edit(self.elements.get(pair, NEUTRAL), other.elements.get(pair, NEUTRAL))
                    for pair in {**self.elements, **other.elements}}
        return LookEdits(interpolate_edit(self.master, other.master), lights, elements)


def _parse_targets(text: str, address: str, lights: Sequence[str],
                   elements: Mapping[str, Sequence[str]] | None) -> list[tuple[str, str]]:
    """Return the (light, element or "") pairs that an edit applies to.

    text: the whole edit, for the SettingsError. address: its `light` or `light/element`. lights: known names.
    elements: known names by light; None accepts any name. Raises SettingsError for an unknown light or element."""
    if not any(address == light or address.startswith(f"{light}/") for light in lights):
        address = address.lstrip()  # only here, since a light's name may begin with a blank
    if address in lights:
        return [(address, "")]
    if address == ALL:
        return [(ALL, "")]
    # Names may hold slashes themselves: the longest light that fits.
    named_light = max((light for light in (*lights, ALL) if address.startswith(f"{light}/")), key=len, default=None)
    if named_light is None:
        known = ", ".join(lights) or "no lights at all"
        raise SettingsError(f"The edit {text!r} names the light {address!r}, but here there is {known}.")
    element = address[len(named_light) + 1:]
    named_lights = list(lights) if named_light == ALL else [named_light]
    if elements is None:
        return [(light, element) for light in named_lights]
    targets = [(light, name) for light in named_lights for name in elements.get(light, ()) if element in (ALL, name)]
    if not targets:
        names = dict.fromkeys(name for light in named_lights for name in elements.get(light, ()))
        known = ", ".join(names) or "none at all"
        raise SettingsError(f"The edit {text!r} names the element {element!r}, but {named_light} has {known}.")
    return targets


def _parse_change(text: str, property_name: str, value: str) -> Edit:
    """Return the edit of one `property=value`; text: the whole edit, for the SettingsError of an invalid one."""
    if property_name == "tint" and _HEX.fullmatch(value):
        channels = np.array([int(value[start:start + 2], 16) / 255 for start in (1, 3, 5)])
        red, green, blue = linear_from_srgb(channels).tolist()
        return Edit(tint=(red, green, blue))
    expected = 3 if property_name == "tint" else 1
    if property_name not in {entry.name for entry in fields(Edit)}:
        known = ", ".join(entry.name for entry in fields(Edit))
        raise SettingsError(f"The edit {text!r} sets {property_name!r}; there are {known}.")
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    signed = property_name == "rotation"
    if len(numbers) != expected or not all(abs(number) <= MAX_VALUE and (signed or number >= 0) for number in numbers):
        kind = "one number" if expected == 1 else "three numbers (or #rrggbb)"
        minimum = -MAX_VALUE if signed else 0
        raise SettingsError(f"The edit {text!r} needs {kind} from {minimum:g} to {MAX_VALUE:g} after the equals sign.")
    if property_name in _FLAGS and numbers[0] not in (0, 1):
        raise SettingsError(f"The edit {text!r} needs 0 or 1 after the equals sign.")
    parsed: Any = tuple(numbers) if expected == 3 else bool(numbers[0]) if property_name in _FLAGS else numbers[0]
    return replace(NEUTRAL, **{property_name: parsed})


def _to_texts(edit: Edit) -> list[str]:
    """Return the texts `property=value` of an edit's changed properties."""
    texts = []
    for entry in fields(Edit):
        value, default = getattr(edit, entry.name), getattr(NEUTRAL, entry.name)
        if value != default:
            numbers = value if isinstance(value, tuple) else (int(value) if isinstance(value, bool) else value,)
            # Seven digits: the precision of a slider's float32.
            texts.append(f"{entry.name}={','.join(f'{number:.7g}' for number in numbers)}")
    return texts


# ---- on Gaussians ---------------------------------------------------------------------------------


def apply_edits(gaussians: PlaneGaussians, light: str, light_position: NDArray[Any], elements: Sequence[Element],
                edits: LookEdits, blend: Blend) -> PlaneGaussians:
    """Apply the edits of one light to its Gaussians; preserves their order, drops those of hidden elements.

    light_position: (2,) on the normalised plane, with the learned correction delta_l. elements: those of the light,
    each with the rows of its Gaussians. blend: "add" for colours in linear light, "over" for display values.
    """
    light_edit = edits.light_edit(light)
    hidden = edits.hidden_elements(light, elements)
    element_edits = [edits.elements.get((light, element.name), NEUTRAL) for element in elements]
    if not hidden and light_edit == NEUTRAL and all(edit == NEUTRAL for edit in element_edits):
        return gaussians
    rows: list[NDArray[np.int64]] = []
    parts: list[PlaneGaussians] = []
    ungrouped = np.ones(len(gaussians), bool)
    for element, edit in zip(elements, element_edits, strict=True):
        ungrouped[element.members] = False
        if element.name not in hidden and len(element.members):
            combined = light_edit.combine(edit)
            part = _apply_shape(gaussians.select(element.members), combined, light_position, element.kind == "streak")
            parts.append(apply_colour(part, combined, blend))
            rows.append(element.members)
    if ungrouped.any():
        part = _apply_shape(gaussians.select(ungrouped), light_edit, light_position, False)
        parts.append(apply_colour(part, light_edit, blend))
        rows.append(np.flatnonzero(ungrouped))
    edited = concatenate(parts)
    if edited is None:
        return gaussians.select(np.zeros(0, np.int64))
    return edited.select(np.argsort(np.concatenate(rows), kind="stable"))


def apply_colour(gaussians: PlaneGaussians, edit: Edit, blend: Blend) -> PlaneGaussians:
    """Return the Gaussians with the colours and opacities of an edit.

    With the blend "over" an intensity below 1 lowers the opacities, one above 1 brightens the colours."""
    if not edit.changes_colour:
        return gaussians
    if blend == "add":
        # Not clipped, so that a sum of Gaussians changes as a finished layer would.
        return replace(gaussians, colours=gaussians.colours @ edit.matrix.T.astype(np.float32))
    dimmed, brighter = min(edit.intensity, 1.0), max(edit.intensity, 1.0)
    linear = linear_from_srgb(gaussians.colours) @ replace(edit, intensity=brighter).matrix.T
    return replace(gaussians, opacities=np.asarray(gaussians.opacities * dimmed, np.float32),
                   colours=srgb_from_linear(np.maximum(linear, 0)))


def _apply_shape(gaussians: PlaneGaussians, edit: Edit, light_position: NDArray[Any], is_streak: bool
                 ) -> PlaneGaussians:
    """Transform an element as a whole: x' = c' + A (x - c), covariance' = A covariance A^T, arc' = A arc.

    c is the element's centre, weighted by energy; c' = l + spread (c - l), with l the light. A stretches a streak along
    its long axis, then scales and rotates. is_streak: whether the element is a streak."""
    stretch = edit.streak if is_streak else 1.0
    if (edit.scale, edit.spread, edit.rotation, stretch) == (1.0, 1.0, 0.0, 1.0):
        return gaussians
    weights = gaussians.energy.astype(np.float64) + 1e-12
    centre = np.average(gaussians.means, axis=0, weights=weights)
    affine = edit.scale * np.eye(2)
    if stretch != 1.0:
        axis = _long_axis(gaussians, weights, centre)
        affine = affine @ (np.eye(2) + (stretch - 1) * np.outer(axis, axis))
    angle = math.radians(edit.rotation)
    affine = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]) @ affine
    new_centre = np.asarray(light_position, np.float64) + edit.spread * (centre - light_position)
    means = new_centre + (gaussians.means - centre) @ affine.T
    (a, b), (c, d) = affine
    xx, xy, yy = gaussians.covariances.T.astype(np.float64)
    covariances = np.stack([a * a * xx + 2 * a * b * xy + b * b * yy,
                            a * c * xx + (a * d + b * c) * xy + b * d * yy,
                            c * c * xx + 2 * c * d * xy + d * d * yy], -1)
    arcs = None if gaussians.arcs is None else np.asarray(gaussians.arcs @ affine.T, np.float32)
    return replace(gaussians, means=means.astype(np.float32), covariances=covariances.astype(np.float32), arcs=arcs)


def _long_axis(gaussians: PlaneGaussians, weights: Floats | NDArray[Any], centre: NDArray[Any]) -> NDArray[np.float64]:
    """Return the unit vector (2,) along the longest extent of the Gaussians as a whole: their first principal axis."""
    xx, xy, yy = np.average(gaussians.covariances, axis=0, weights=weights)
    offsets = gaussians.means - centre
    centre_covariance = (offsets * np.asarray(weights)[:, None]).T @ offsets / np.sum(weights)
    _, axes = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]) + centre_covariance)
    return np.asarray(axes[:, 1], np.float64)
