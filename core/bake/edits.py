# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes asked for on the command line as `light.property=value`, e.g. `lamp.intensity=2`.

Properties of a light: `intensity`, a factor of 0 or more; `tint`, three of them (R,G,B) or `#rrggbb`.
The light `*` stands for all. Light adds, so an edit is a factor on the light's linear layer.
"""
from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import numpy as np

from ..errors import SettingsError
from ..pictures import linear_from_srgb

Gain = tuple[float, float, float]

_HEX = re.compile(r"#[0-9A-Fa-f]{6}")


def gains(edits: Iterable[str], lights: Sequence[str]) -> dict[str, Gain]:
    """Linear R, G, B factors by light, of the lights that an edit names; edits of one light multiply.

    Raises SettingsError for an edit that names no light or property, or has no sensible value.
    """
    result: dict[str, Gain] = {}
    for edit in edits:
        name, equals, value = edit.partition("=")
        light, dot, what = name.strip().rpartition(".")
        if not (equals and dot and light):
            raise SettingsError(f"The edit {edit!r} is not of the form light.intensity=2 or light.tint=1,0.5,0.2.")
        if light != "*" and light not in lights:
            known = ", ".join(lights) or "no lights at all"
            raise SettingsError(f"The edit {edit!r} names the light {light!r}, but here there is {known}.")
        factor = _factor(edit, what, value.strip())
        for each in lights if light == "*" else (light,):
            before = result.get(each, (1.0, 1.0, 1.0))
            result[each] = (before[0] * factor[0], before[1] * factor[1], before[2] * factor[2])
    return result


def _factor(edit: str, what: str, value: str) -> Gain:
    if what == "tint" and _HEX.fullmatch(value):
        red, green, blue = linear_from_srgb(np.array([int(value[at:at + 2], 16) / 255 for at in (1, 3, 5)])).tolist()
        return red, green, blue
    wanted = {"intensity": 1, "tint": 3}.get(what)
    if wanted is None:
        raise SettingsError(f"The edit {edit!r} sets {what!r}; a light has intensity and tint.")
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != wanted or not all(math.isfinite(number) and number >= 0 for number in numbers):
        kind = "one number" if wanted == 1 else "three numbers (or #rrggbb)"
        raise SettingsError(f"The edit {edit!r} needs {kind} of 0 or more after the equals sign.")
    red, green, blue = numbers * 3 if wanted == 1 else numbers
    return red, green, blue
