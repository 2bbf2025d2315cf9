# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes lights.json, and keeps what a person has changed in it.

    {"lights": [{"name": "light1", "xyz": [x, y, z], "colour": [r, g, b], "support": 36, "views": 60,
                 "residual_px": 0.6, "uncertainty": 0.006, "far": false, "how": "triangulated"},
                {"name": "light2", "frames": {"0001.png": {"xy": [px, py], "on": 0.8, "confidence": 0.9}, ...},
                 "colour": [r, g, b], "support": 30, "views": 40, "how": "followed"}],
     "found": [[x, y, z], ...], "found_paths": [{"0001.png": [px, py], ...}, ...]}

`core/capture/lights.py` says what the places mean, and reads them.
`found` and `found_paths` list the places and paths that earlier runs wrote. With `keep`, existing entries stay
unchanged, including renamed, moved and added ones; a light that exists is not added twice, and one that an earlier run
wrote and a person deleted is not added again.
"""
from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..capture import read_lights
from ..capture.camera import Camera
from ..capture.lights import is_finite, is_point
from ..errors import CaptureError
from ..system.files import follow_link, read_json, round_for_text, write_json
from .found_light import FoundLight
from .tracks import TrackedLight

SAME_PLACE = 0.02
"""Distance of two projections, in frame diagonals, below which they are one light."""


def check_replaceable(path: Path) -> None:
    """Raise CaptureError if lights.json has entries that a person has added, renamed or moved."""
    if not path.exists():
        return
    read_lights(path)  # checks it
    data = read_json(path, CaptureError)
    places, paths = _read_earlier_places(data, path), _read_earlier_paths(data, path)

    def is_unchanged(entry: dict[str, Any]) -> bool:
        """Return whether an earlier run wrote the entry's place or path."""
        if "xyz" in entry:
            return any(np.allclose(entry["xyz"], place, rtol=1e-3, atol=1e-5) for place in places)
        return any(_places_by_frame(entry) == earlier for earlier in paths)

    # An entry that a search wrote has a support, and is named light1, light2, ... by its position in the list.
    by_hand = [str(entry["name"]) for number, entry in enumerate(data["lights"], 1)
               if not ("support" in entry and entry["name"] == f"light{number}" and is_unchanged(entry))]
    if by_hand:
        raise CaptureError(f"{path} has lights that were added or changed by hand ({', '.join(by_hand)}); add --keep "
                           "to keep them, or remove the file to search for all lights again.")


def write_lights(path: Path, lights: Sequence[FoundLight], views: Sequence[tuple[str, Camera]],
                 keep: bool = False, tracked: Sequence[TrackedLight] = ()) -> list[dict[str, Any]]:
    """Write lights.json and return its entries: the existing ones if `keep`, and the lights that are not among them.

    keep: existing entries stay, and what a person deleted is not added again. views: names and cameras; lights that
    fall on one spot in most of them are the same. tracked: lights on paths. Raises CaptureError if an existing file is
    to be kept and cannot be read.
    """
    earlier = _read_earlier(path) if keep and path.exists() else _EarlierLights([], [], [])
    entries = list(earlier.entries)
    known_places = [*(entry["xyz"] for entry in entries if "xyz" in entry), *earlier.places]
    for light in lights:
        if not any(_is_same_light(light.xyz, xyz, views) for xyz in known_places):
            entries.append(_to_entry(light, _free_name({entry["name"] for entry in entries})))
    # For `found`: all places of this run, written or not, and those of earlier ones that it did not find again.
    places = [[round_for_text(float(x)) for x in light.xyz] for light in lights]
    places += [xyz for xyz in earlier.places if not any(_is_same_light(place, xyz, views) for place in places)]
    paths = [*earlier.paths, *_add_tracks(entries, tracked, earlier, views)]
    contents: dict[str, Any] = {"lights": entries, "found": places}
    write_json(follow_link(path), {**contents, "found_paths": paths} if paths else contents)
    return entries


class _EarlierLights(NamedTuple):
    """An existing lights.json: its entries, and the places and paths that earlier runs wrote."""

    entries: list[dict[str, Any]]
    places: list[list[float]]
    paths: list[dict[str, Any]]


def _read_earlier(path: Path) -> _EarlierLights:
    """Read a lights.json whose entries are to be kept. Raises CaptureError if it is invalid or not writable."""
    read_lights(path)  # checks it
    data = read_json(path, CaptureError)
    earlier = _EarlierLights(data["lights"], _read_earlier_places(data, path), _read_earlier_paths(data, path))
    for entry in earlier.entries:
        _check_writable(entry, path)
    return earlier


def _add_tracks(entries: list[dict[str, Any]], tracked: Sequence[TrackedLight], earlier: _EarlierLights,
                views: Sequence[tuple[str, Camera]]) -> list[dict[str, Any]]:
    """Append to `entries`, in place, the tracked lights whose paths are not known yet; return these paths, places by
    frame."""
    known_paths = [*(_places_by_frame(entry) for entry in entries if "frames" in entry), *earlier.paths]
    new_paths = []
    for track in tracked:
        entry = _to_track_entry(track, _free_name({entry["name"] for entry in entries}))
        path = _places_by_frame(entry)
        if not any(_is_same_path(path, known_path, views[0][1]) for known_path in known_paths):
            entries.append(entry)
            new_paths.append(path)
    return new_paths


def _places_by_frame(entry: dict[str, Any]) -> dict[str, Any]:
    """Return the path of an entry: its place, [px, py] or [x, y, z], by the name of the frame."""
    keys = entry.get("frames") or {}
    return {name: key.get("xy", key.get("xyz")) for name, key in keys.items() if {"xy", "xyz"} & key.keys()}


def _is_same_path(path: dict[str, Any], other: dict[str, Any], camera: Camera) -> bool:
    """Return whether two paths on the picture are close to each other in most frames that they share.

    They must share at least half the frames of the shorter path. camera: gives the size of the frames.
    """
    shared = [name for name in path if name in other and len(path[name]) == len(other[name]) == 2]
    if len(shared) < 0.5 * min(len(path), len(other)) or not shared:
        return False
    distances = np.linalg.norm(np.subtract([path[name] for name in shared], [other[name] for name in shared]), axis=1)
    return bool(np.median(distances) < SAME_PLACE * np.hypot(*camera.size))


def _read_earlier_paths(data: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """Return the paths that earlier runs wrote, from the contents `data` of lights.json. Raises CaptureError if their
    list is invalid."""
    paths = data.get("found_paths", [])
    valid = isinstance(paths, list) and all(
        isinstance(each, dict) and all(isinstance(place, list) and len(place) in (2, 3) and all(map(is_finite, place))
                                       for place in each.values()) for each in paths)
    if not valid:
        raise CaptureError(f"{path}: found_paths should be a list of places by frame; remove that entry.")
    return list(paths)


def _read_earlier_places(data: dict[str, Any], path: Path) -> list[list[float]]:
    """Return the places that earlier runs wrote, from the contents `data` of lights.json. Raises CaptureError if their
    list is invalid."""
    places = data.get("found", [])
    if not isinstance(places, list) or not all(is_point(place) for place in places):
        raise CaptureError(f"{path}: found should be a list of places, each of three finite numbers; remove that "
                           "entry.")
    return places


def _check_writable(entry: dict[str, Any], path: Path) -> None:
    """Raise CaptureError if the entry contains NaN or infinity, which json reads but must not write here."""
    try:
        json.dumps(entry, allow_nan=False)
    except ValueError as problem:
        raise CaptureError(f"{path}, {entry['name']!r}: one of the numbers is not finite; correct it or remove it."
                           ) from problem


def _to_entry(light: FoundLight, name: str) -> dict[str, Any]:
    """Return the entry in lights.json of a light with one place in the world."""
    return {"name": name, "xyz": [round_for_text(float(x)) for x in light.xyz],
            "colour": [round(float(c), 3) for c in light.colour], "support": len(light.support),
            "views": light.visible, "residual_px": round(light.residual, 3),
            "uncertainty": round(light.uncertainty, 5), "far": light.far, "how": light.how}


def _to_track_entry(light: TrackedLight, name: str) -> dict[str, Any]:
    """Return the entry in lights.json of a light with a path on the picture: its places and brightness by frame."""
    frames = {}
    for frame, key in light.keys.items():
        place = key.place
        assert place is not None
        on = {} if key.on is None else {"on": round(key.on, 3)}
        frames[frame] = {"xy": [round(float(x), 2) for x in place], **on, "confidence": round(key.confidence, 2)}
    return {"name": name, "frames": frames, "colour": [round(float(c), 3) for c in light.colour],
            "support": len(light.support), "views": len(frames), "how": light.how}


def _free_name(used_names: set[str]) -> str:
    number = 1
    while f"light{number}" in used_names:
        number += 1
    return f"light{number}"


def _is_same_light(xyz: Any, other: Any, views: Sequence[tuple[str, Camera]]) -> bool:
    """Return whether two places in the world fall on one spot in most of the views that have either in frame."""
    matching_views = differing_views = 0
    for _, camera in views:
        pixels, depth = camera.project([xyz, other])
        if camera.contains(pixels, depth).any():
            is_near = (depth > 0).all() and np.linalg.norm(pixels[0] - pixels[1]) < SAME_PLACE * np.hypot(*camera.size)
            matching_views += bool(is_near)
            differing_views += not is_near
    return matching_views > differing_views
