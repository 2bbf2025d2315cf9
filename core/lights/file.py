# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes lights.json, and keeps what a person has changed in it.

    {"lights": [{"name": "light1", "xyz": [x, y, z], "colour": [r, g, b], "support": 36, "views": 60,
                 "residual_px": 0.6, "uncertainty": 0.006, "far": false, "how": "triangulated"}],
     "found": [[x, y, z], ...]}

`found` lists the places that earlier runs wrote. With `keep`, existing entries stay unchanged, including renamed, moved
and added ones; a light that exists is not added twice, and one that an earlier run wrote and a person deleted is not
added again.
"""
from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..capture import read_lights
from ..capture.camera import Camera
from ..capture.lights import is_point
from ..errors import CaptureError
from ..system.files import follow_link, read_json, round_for_text, write_json
from .found_light import FoundLight

SAME_PLACE = 0.02
"""Distance of two projections, in frame diagonals, below which they are one light."""


def check_replaceable(path: Path) -> None:
    """Raise CaptureError where lights.json has entries that a person has added, renamed or moved."""
    if not path.exists():
        return
    read_lights(path)  # checks it
    data = read_json(path, CaptureError)
    places = _read_earlier_places(data, path)
    by_hand = [str(entry["name"]) for number, entry in enumerate(data["lights"], 1) if not (
        "support" in entry and entry["name"] == f"light{number}"
        and "xyz" in entry and any(np.allclose(entry["xyz"], place, rtol=1e-3, atol=1e-5) for place in places))]
    if by_hand:
        raise CaptureError(f"{path} has lights that were added or changed by hand ({', '.join(by_hand)}); add --keep "
                           "to keep them, or remove the file to search for all lights again.")


def write_lights(path: Path, lights: Sequence[FoundLight], views: Sequence[tuple[str, Camera]],
                 keep: bool = False) -> list[dict[str, Any]]:
    """Write lights.json and return its entries. keep: see the module's head.

    Raises CaptureError where an existing file is to be kept and cannot be read.
    """
    entries: list[dict[str, Any]] = []
    found_before: list[Any] = []
    if keep and path.exists():
        read_lights(path)  # checks it
        data = read_json(path, CaptureError)
        entries, found_before = list(data["lights"]), _read_earlier_places(data, path)
        for entry in entries:
            _check_writable(entry, path)
    known = [*(entry["xyz"] for entry in entries if "xyz" in entry), *found_before]
    for light in lights:
        if any(_is_same_light(light.xyz, xyz, views) for xyz in known):
            continue
        entries.append(_to_entry(light, _free_name({entry["name"] for entry in entries})))
    places = [[round_for_text(float(x)) for x in light.xyz] for light in lights]
    places += [xyz for xyz in found_before if not any(_is_same_light(place, xyz, views) for place in places)]
    write_json(follow_link(path), {"lights": entries, "found": places})
    return entries


def _read_earlier_places(data: dict[str, Any], path: Path) -> list[list[float]]:
    """Return the places that earlier runs wrote. Raises CaptureError where the list is invalid."""
    places = data.get("found", [])
    if not isinstance(places, list) or not all(is_point(place) for place in places):
        raise CaptureError(f"{path}: found should be a list of places, each of three finite numbers; remove that "
                           "entry.")
    return places


def _check_writable(entry: dict[str, Any], path: Path) -> None:
    """Raise CaptureError for NaN and infinity, which can be read and not written."""
    try:
        json.dumps(entry, allow_nan=False)
    except ValueError as problem:
        raise CaptureError(f"{path}, {entry['name']!r}: one of the numbers is not finite; correct it or remove it."
                           ) from problem


def _to_entry(light: FoundLight, name: str) -> dict[str, Any]:
    return {"name": name, "xyz": [round_for_text(float(x)) for x in light.xyz],
            "colour": [round(float(c), 3) for c in light.colour], "support": len(light.support),
            "views": light.visible, "residual_px": round(light.residual, 3),
            "uncertainty": round(light.uncertainty, 5), "far": light.far, "how": light.how}


def _free_name(used_names: set[str]) -> str:
    number = 1
    while f"light{number}" in used_names:
        number += 1
    return f"light{number}"


def _is_same_light(xyz: Any, other: Any, views: Sequence[tuple[str, Camera]]) -> bool:
    """True if two places fall on one spot in most views that have either in frame."""
    same_views = other_views = 0
    for _, camera in views:
        pixels, depth = camera.project([xyz, other])
        if camera.contains(pixels, depth).any():
            is_near = (depth > 0).all() and np.linalg.norm(pixels[0] - pixels[1]) < SAME_PLACE * np.hypot(*camera.size)
            same_views += bool(is_near)
            other_views += not is_near
    return same_views > other_views
