# SPDX-License-Identifier: GPL-3.0-or-later
"""The lights of a capture or shot: fixed places, paths in the world or on the picture, and brightness by frame.

`read_lights` reads lights.json, and `LightPath.state` gives each light's place and brightness in a frame:

    {"name": "lamp", "xyz": [x, y, z]}                                            a fixed place in the world
    {"name": "lamp", "xyz": [x, y, z], "frames": {"0001.png": {"on": 0.5}}}       the same, switched or dimmed
    {"name": "car", "frames": {"0001.png": {"xyz": [x, y, z]}}}                   a path in the world
    {"name": "torch", "frames": {"0001.png": {"xy": [px, py], "on": 0.8, "confidence": 0.9}}}   a path on the picture
    {"name": "lamp", "xy": [px, py]}                                              one place on the picture
    {"name": "tube", "xyz": [x, y, z], "extent": {"shape": "sphere", "radius": 0.1}}            with an extent

`xy` is in pixels of the undistorted frame, pixel centres at +0.5, and may lie outside of the frame. `on` is the light
that reaches the lens, relative to the frame in which this light is brightest, 0..1. `confidence` is 0..1. Frames
without an entry are interpolated by frame number; beyond the first and last entry the nearest one holds. A transfer
sums the flare over an `extent` (light_extent.py); a fit learns it from the frames.
`core/lights/file.py` writes the file.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..conventions.frame_numbers import number_views
from ..errors import CaptureError, SettingsError
from ..system.file_names import canonical_name
from ..system.files import read_json
from ..system.tally import list_first
from .camera import Camera, Floats
from .light_extent import LightExtent

DOUBTFUL = 0.5
"""Confidence below which a light's place in a frame is doubtful."""


@dataclass(frozen=True, eq=False)
class LightKey:
    """A light in one frame: place in the world `xyz` (3,) or on the picture `xy` (2,), pixels; brightness `on`, 0..1.

    None where the file does not say.
    """

    xyz: Floats | None = None
    xy: Floats | None = None
    on: float | None = None
    confidence: float = 1.0

    @property
    def place(self) -> Floats | None:
        """The place (3,) or (2,), whichever the key has."""
        return self.xyz if self.xyz is not None else self.xy


@dataclass(frozen=True, eq=False)
class Light:
    """A light. xyz: (3,) its place in world coordinates, NaN where it has none or moves.

    xy: (2,) its one place on the picture, pixels. keys: places and brightness by the name of the frame. extent: around
    its place, world units; None for a point.
    """

    name: str
    xyz: Floats
    xy: Floats | None = None
    keys: Mapping[str, LightKey] = field(default_factory=dict)
    extent: LightExtent | None = None

    @property
    def moves(self) -> bool:
        """True for a light without one place in the world: on a path, or known on the picture alone."""
        return not bool(np.isfinite(self.xyz).all())

    @property
    def is_on_picture(self) -> bool:
        """Return whether the light's places are known on the picture alone."""
        return self.xy is not None or any(key.xy is not None for key in self.keys.values())

    @property
    def numbers(self) -> list[Any]:
        """All values of the light as plain data, for comparisons and hashes: [name, [x, y, z]] for a light at one
        place, with further values for any other."""
        plain: list[Any] = [self.name, None if self.moves else self.xyz.tolist()]
        if self.xy is not None:
            plain.append(self.xy.tolist())
        if self.keys:
            plain.append([[name, _to_list(key.xyz), _to_list(key.xy), key.on, key.confidence]
                          for name, key in sorted(self.keys.items())])
        if self.extent is not None:
            plain.append(self.extent.to_json())
        return plain


@dataclass(frozen=True, eq=False)
class LightState:
    """A light in one view.

    xyz: (3,) world; for a light known on the picture alone, a point on the ray through its pixel. camera_xyz: (3,) the
    same point in the camera's axes (x right, y down, z forward). xy: (2,) pixels, NaN behind the camera. on: brightness
    0..1, or None where it is unknown. interpolated: lights.json has no entry for the place in this view.
    """

    name: str
    xyz: Floats
    camera_xyz: Floats
    xy: Floats
    on: float | None
    confidence: float
    interpolated: bool


def read_lights(path: Path) -> tuple[Light, ...]:
    """Read the lights of a lights.json, none where the file is absent. Raises CaptureError where it is invalid."""
    if not path.exists():
        return ()
    data = read_json(path, CaptureError)
    entries = data.get("lights") if isinstance(data, dict) else None
    if not isinstance(entries, list):
        raise CaptureError(f'{path} should read {{"lights": [{{"name": "lamp", "xyz": [x, y, z]}}, …]}}.')
    lights: dict[str, Light] = {}
    for number, entry in enumerate(entries):
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str) or not name.strip():
            raise CaptureError(f"{path}, light {number}: the name is missing.")
        if name in lights:
            raise CaptureError(f"{path} has two lights with the name {name!r}; rename one.")
        lights[name] = _parse_light(entry, name, f"{path}, {name!r}")
    return tuple(lights.values())


def _parse_light(entry: Mapping[str, Any], name: str, where: str) -> Light:
    """Parse an entry of lights.json; `where` begins the message of a CaptureError."""
    frames = entry.get("frames")
    if frames is not None and not (isinstance(frames, dict) and frames):
        raise CaptureError(f'{where}: frames should read {{"0001.png": {{"xy": [x, y]}}, …}}.')
    keys = {frame: _parse_key(key, f"{where}, frame {frame!r}") for frame, key in (frames or {}).items()}
    place_kinds = {"xyz" if key.xyz is not None else "xy" for key in keys.values() if key.place is not None}
    place_kinds |= {label for label in ("xyz", "xy") if entry.get(label) is not None}
    if len(place_kinds) > 1:
        raise CaptureError(f"{where}: some places are in the world (xyz) and some on the picture (xy); give one kind.")
    if entry.get("xyz") is None and entry.get("xy") is None:
        if not place_kinds and not frames:
            raise CaptureError(f"{where}: xyz should be three finite numbers.")
        if not place_kinds:
            raise CaptureError(f"{where}: no frame has a place; add xyz or xy to the light or to its frames.")
    elif any(key.place is not None for key in keys.values()):
        raise CaptureError(f"{where}: it has one place and a path; remove one of them.")
    xyz = _parse_place(entry, "xyz", 3, where)
    try:
        extent = LightExtent.from_json(entry["extent"]) if entry.get("extent") is not None else None
    except ValueError as problem:
        raise CaptureError(f"{where}: {problem}; correct the extent, or remove it.") from problem
    return Light(name, np.full(3, np.nan) if xyz is None else xyz, _parse_place(entry, "xy", 2, where), keys, extent)


def _parse_key(key: Any, where: str) -> LightKey:
    """Parse a light's key at one frame. Raises CaptureError."""
    if not isinstance(key, dict) or not {"xyz", "xy", "on"} & key.keys():
        raise CaptureError(f"{where}: give its place (xyz or xy), its brightness (on), or both.")
    on, confidence = key.get("on"), key.get("confidence", 1.0)
    for label, value in (("on", 0.0 if on is None else on), ("confidence", confidence)):
        if not is_finite(value) or not 0 <= value <= 1:
            raise CaptureError(f"{where}: {label} should be a number within 0 and 1.")
    return LightKey(_parse_place(key, "xyz", 3, where), _parse_place(key, "xy", 2, where),
                    None if on is None else float(on), float(confidence))


def _parse_place(entry: Mapping[str, Any], label: str, count: int, where: str) -> Floats | None:
    value = entry.get(label)
    if value is None and label not in entry:
        return None
    if not (isinstance(value, list) and len(value) == count and all(map(is_finite, value))):
        raise CaptureError(f"{where}: {label} should be {'three' if count == 3 else 'two'} finite numbers.")
    return np.array(value, np.float64)


def is_point(xyz: Any) -> bool:
    """Return whether a value of JSON is a list of three finite numbers."""
    return isinstance(xyz, list) and len(xyz) == 3 and all(map(is_finite, xyz))


def is_finite(value: Any) -> bool:
    """Return whether a value of JSON is a number below 1e30 in size."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e30


class LightPath:
    """The keys of one light over the frames of a capture, interpolated. `state` evaluates it in a view."""

    def __init__(self, light: Light, names: Sequence[str]) -> None:
        """Match the keys of a light to views. names: the names of the capture's views."""
        self.light = light
        self._times = _frame_times(names)
        views_by_name = {_canonical(name): name for name in names}
        self._keys = {views_by_name[_canonical(name)]: key for name, key in light.keys.items()
                      if _canonical(name) in views_by_name}
        self.unknown_frames = [name for name in light.keys if _canonical(name) not in views_by_name]
        """Names of frames in the file that are not among the views."""
        keys = self._keys.items()
        self._place_keys = sorted((self._times[name], name) for name, key in keys if key.place is not None)
        self._brightness_keys = sorted((self._times[name], key.on) for name, key in keys if key.on is not None)

    @property
    def has_place(self) -> bool:
        """Return whether the light's place is known in some view."""
        return bool(self._place_keys) or not self.light.moves or self.light.xy is not None

    def interpolated_views(self) -> list[str]:
        """Return the names of the views whose place is interpolated."""
        placed = {name for _, name in self._place_keys}
        return [name for name in self._times if name not in placed] if placed else []

    def state(self, name: str, camera: Camera, distance: float = 1.0) -> LightState:
        """Return the light in the view of that name. distance: depth of a light that is known on the picture alone.

        Raises CaptureError for a light whose place is known in none of the views.
        """
        place, confidence, interpolated = self._place_in_view(name)
        if len(place) == 3:
            xyz = place
            local = camera.world_to_camera[:3, :3] @ xyz + camera.world_to_camera[:3, 3]
            pixel = camera.project(xyz)[0][0] if local[2] > 0 else np.full(2, np.nan)
        else:
            pixel = place
            local = distance * np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0])
            xyz = camera.world_to_camera[:3, :3].T @ (local - camera.world_to_camera[:3, 3])
        return LightState(self.light.name, xyz, local, pixel, self._brightness_in_view(name), confidence, interpolated)

    def _place_in_view(self, name: str) -> tuple[Floats, float, bool]:
        """Return place (3,) or (2,), confidence, and whether the place is interpolated. Raises CaptureError."""
        key = self._keys.get(name)
        if not self._place_keys:
            constant = self.light.xyz if self.light.xy is None else self.light.xy
            if not np.isfinite(constant).all():
                raise CaptureError(f"The light {self.light.name!r} has a place in none of the frames; correct the "
                                   "names of the frames in lights.json.")
            return constant, 1.0 if key is None else key.confidence, False
        if key is not None and key.place is not None:
            return key.place, key.confidence, False
        # Between the keys before and after; beyond the ends both are the nearest key.
        times = np.array([time for time, _ in self._place_keys])
        after = int(np.searchsorted(times, self._times[name]))
        (time_before, name_before), (time_after, name_after) = (
            self._place_keys[min(max(index, 0), len(times) - 1)] for index in (after - 1, after))
        fraction = 0.0 if time_after == time_before else (self._times[name] - time_before) / (time_after - time_before)
        previous_key, next_key = self._keys[name_before], self._keys[name_after]
        assert previous_key.place is not None and next_key.place is not None
        place = (1 - fraction) * previous_key.place + fraction * next_key.place
        return place, min(previous_key.confidence, next_key.confidence), True

    def _brightness_in_view(self, name: str) -> float | None:
        if not self._brightness_keys:
            return None
        times, values = zip(*self._brightness_keys, strict=True)
        return float(np.interp(self._times[name], times, values))

    def warnings(self) -> list[str]:
        """Return sentences for the user on frames in which the place is interpolated, and on frames of lights.json that
        the capture lacks."""
        interpolated, warnings = self.interpolated_views(), []
        if interpolated:
            warnings.append(f"The light {self.light.name!r} has no place in {len(interpolated)} of {len(self._times)} "
                            f"frames ({list_first(interpolated)}); it is interpolated there.")
        if self.unknown_frames:
            warnings.append(f"lights.json has entries of the light {self.light.name!r} for {len(self.unknown_frames)} "
                            f"frames that are not in the capture ({list_first(self.unknown_frames)}); they are left "
                            "out.")
        return warnings


def light_paths(lights: Iterable[Light], names: Sequence[str]) -> dict[str, LightPath]:
    """Return the paths of lights by name, over the views of these names."""
    return {light.name: LightPath(light, names) for light in lights}


def check_places(lights: Iterable[Light], path: Path, names: Sequence[str], has_cameras: bool) -> None:
    """Raise CaptureError for a light none of whose frames is in the capture, and for a place in the world where the
    frames have no cameras. path: lights.json, for the message. names: the names of the capture's views."""
    for light in lights:
        if not LightPath(light, names).has_place:
            raise CaptureError(f"{path}, {light.name!r}: none of its frames is in the capture, such as {names[0]}; "
                               "correct the names of the frames.")
        if not has_cameras and not light.is_on_picture:
            raise CaptureError(f"{path}, {light.name!r}: its places are in the world (xyz), and the frames have no "
                               "camera solve; give them on the picture (xy), or run solve.")


def check_standing(lights: Iterable[Light], purpose: str) -> None:
    """Raise CaptureError for the first light that moves. purpose: what needs lights that do not move, a noun phrase."""
    for light in lights:
        if light.moves:
            raise CaptureError(f"The light {light.name!r} has a path, and {purpose} needs one place (xyz) in the "
                               "world; correct lights.json.")


def _frame_times(names: Sequence[str]) -> dict[str, float]:
    """Return the time of each frame: the number in its name, if all names lie in one folder and have one; else its
    index."""
    folders = {PurePosixPath(name).parent for name in names}
    if len(folders) == 1:
        try:
            numbers = {frame.view: float(frame.number) for frame in number_views(names)}
        except SettingsError:  # a number below 0
            numbers = {}
        if len(numbers) == len(names):
            return {name: numbers[name] for name in names}
    return {name: float(index) for index, name in enumerate(names)}


def _canonical(name: str) -> str:
    """Return a frame's name in one form: separators and accents unified, without "images/" and its suffix."""
    text = canonical_name(name)
    text = text[len("images/"):] if text.casefold().startswith("images/") else text
    return str(PurePosixPath(text).with_suffix("")) if PurePosixPath(text).name else text


def _to_list(values: Floats | None) -> list[float] | None:
    return None if values is None else values.tolist()
