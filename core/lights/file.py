# SPDX-License-Identifier: GPL-3.0-or-later
"""lights.json, and what a hand has changed in it.

    {"lights": [{"name": "light1", "xyz": [x, y, z], "colour": [r, g, b], "support": 36, "views": 60,
                 "residual_px": 0.6, "uncertainty": 0.006, "far": false, "how": "triangulated"}],
     "found": [[x, y, z], ...]}

`found` remembers the places an earlier run wrote. With `keep`, entries stay as they are, whatever was renamed,
moved or added; a light found again is not added twice, and one that was found before and is gone from the
list was taken out by hand and stays out.
"""
from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..capture import read_lights
from ..capture.camera import Camera
from ..capture.capture import is_place
from ..errors import CaptureError
from ..system.files import named_by, read_json, rounded, write_json
from .gather import FoundLight

NEAR = 0.02  # of the frame's diagonal: projections nearer than this are one light


def check_replaceable(path: Path) -> None:
    """Raises CaptureError where lights.json has what a person has put there: entries that no search has found, renamed
    or moved ones."""
    if not path.exists():
        return
    read_lights(path)  # checks it
    data = read_json(path, CaptureError)
    places = _places_in(data, path)
    own = [str(entry["name"]) for number, entry in enumerate(data["lights"], 1) if not (
        "support" in entry and entry["name"] == f"light{number}"
        and any(np.allclose(entry["xyz"], place, rtol=1e-3, atol=1e-5) for place in places))]
    if own:
        raise CaptureError(f"{path} has lights that were not found here ({', '.join(own)}); add --keep to leave them "
                           "as they are, or remove the file to look for all anew.")


def write_lights(path: Path, found: Sequence[FoundLight], views: Sequence[tuple[str, Camera]],
                 keep: bool = False) -> list[dict[str, Any]]:
    """Write lights.json and return its entries. `keep`: see the module's head.

    Raises CaptureError where an existing file is to be kept and cannot be read.
    """
    entries: list[dict[str, Any]] = []
    found_before: list[Any] = []
    if keep and path.exists():
        read_lights(path)  # checks it
        data = read_json(path, CaptureError)
        entries, found_before = list(data["lights"]), _places_in(data, path)
        for entry in entries:
            _check_writable(entry, path)
    known = [*(entry["xyz"] for entry in entries), *found_before]
    for light in found:
        if any(_one(light.xyz, xyz, views) for xyz in known):
            continue
        entries.append(_entry(light, _free_name({entry["name"] for entry in entries})))
    places = [[rounded(float(x)) for x in light.xyz] for light in found]
    places += [xyz for xyz in found_before if not any(_one(place, xyz, views) for place in places)]
    write_json(named_by(path), {"lights": entries, "found": places})
    return entries


def _places_in(data: dict[str, Any], path: Path) -> list[list[float]]:
    """What an earlier run found. Raises CaptureError where that is no list of places."""
    places = data.get("found", [])
    if not isinstance(places, list) or not all(is_place(place) for place in places):
        raise CaptureError(f"{path}: found should be a list of places, each of three finite numbers; remove that "
                           "entry.")
    return places


def _check_writable(entry: dict[str, Any], path: Path) -> None:
    """Raises CaptureError for NaN and infinity, which are read and cannot be written again."""
    try:
        json.dumps(entry, allow_nan=False)
    except ValueError as problem:
        raise CaptureError(f"{path}, {entry['name']!r}: one of the numbers is not finite; mend it or remove it."
                           ) from problem


def _entry(light: FoundLight, name: str) -> dict[str, Any]:
    return {"name": name, "xyz": [rounded(float(x)) for x in light.xyz],
            "colour": [round(float(c), 3) for c in light.colour], "support": len(light.support),
            "views": light.visible, "residual_px": round(light.residual, 3),
            "uncertainty": round(light.uncertainty, 5), "far": light.far, "how": light.how}


def _free_name(taken: set[str]) -> str:
    number = 1
    while f"light{number}" in taken:
        number += 1
    return f"light{number}"


def _one(xyz: Any, other: Any, views: Sequence[tuple[str, Camera]]) -> bool:
    """Whether two places fall on one spot in most views that have either in frame."""
    together = apart = 0
    for _, camera in views:
        pixels, depth = camera.project([xyz, other])
        if camera.contains(pixels, depth).any():
            near = (depth > 0).all() and np.linalg.norm(pixels[0] - pixels[1]) < NEAR * np.hypot(*camera.size)
            together += bool(near)
            apart += not near
    return together > apart
