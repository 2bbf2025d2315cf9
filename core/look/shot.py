# SPDX-License-Identifier: GPL-3.0-or-later
"""A shot: cameras, placed lights and edits by frame, in a JSON file that any program can write and `bake` renders.

    {"version": 1, "flare": "lamp.flare", "run": null, "width": 960, "height": 540, "query": "target",
     "frames": [{"frame": 1, "name": "Camera", "intrinsics": [fx, fy, cx, cy], "world_to_camera": [[…], …],
                 "lights": [{"name": "lamp", "source": "lamp", "xyz": [x, y, z], "share": 1.0,
                             "extent": {"shape": "sphere", "radius": 0.1}, "shares": [1.0, …],
                             "factor": [r, g, b], "reference_distance": 0.0}],
                 "edits": ["lamp.intensity=2"]}]}

A light of the shot shows the flare of the .flare's light `source`. Edits and layers use its own `name`, so that several
lights can share a source. `share` is its visibility, 0..1. `extent` and the three after it are optional
(`PlacedLight`). `apart` is true if the layers of a single camera have a folder of their own too. Each view of a stereo
scene is a camera of its own, by `name`. Coordinates are the capture's if the flare is shown in the scene of its fit,
else any.
"""
from __future__ import annotations

import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ..capture.camera import Camera
from ..capture.light_extent import LightExtent
from ..errors import SettingsError
from ..system.files import atomic_path, avoid_device_name, read_json
from ..system.reading import UTF8_SIG, parse_json, read_bytes, read_text
from ..system.steps import FRAMES_PER_STEP, Steps, finish
from .look import PlacedLight, Query

VERSION = 1
MAX_SIDE = 1 << 15  # pixels of a side
MAX_FRAME = 10**9
MAX_FACTOR = 1e9  # of a light
_FRAMES_BEGIN, _FRAMES_END = '"frames": [', "]}"
"""The end of the first line of a file of `Shot.write`, and its last line. Between them each frame has a line, so that
`Shot.read_in_steps` need not parse the file whole."""
LIGHT_RADIUS = 0.01
"""Default radius of a light, relative to its distance: the standard deviation of the soft disc whose visible part is
its visibility."""
LIGHT_MARGIN = 0.06
"""Distance from a light, relative to the camera's, within which surfaces belong to the lamp itself and hide nothing."""


@dataclass(frozen=True, eq=False)
class ShotFrame:
    """One camera at one frame, with the lights of that frame and the texts of the edits."""

    frame: int
    name: str
    camera: Camera
    lights: tuple[PlacedLight, ...]
    edits: tuple[str, ...] = ()

    def cache_key(self) -> str:
        """Return a text that changes whenever the frame's picture would, for the same .flare and query."""
        lights = ", ".join(light.cache_key() for light in self.lights)
        numbers = ", ".join(map(repr, (self.frame, self.name, self.edits, *self.camera.numbers)))
        return f"({numbers}, [{lights}])"  # the form of a tuple's repr, so that earlier layers stay valid


@dataclass(frozen=True, eq=False)
class Shot:
    """Frames to render with a flare. run: folder of the fit whose scene is behind it, or None. live: the compositor
    applies the colour of whole lights, which the edits then omit. own_folder: the layers of a single camera have a
    folder of their own too."""

    flare: Path
    frames: tuple[ShotFrame, ...]
    query: Query = "target"
    run: Path | None = None
    live: bool = False
    own_folder: bool = False

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of all lights, in order of appearance."""
        return tuple(dict.fromkeys(light.name for frame in self.frames for light in frame.lights))

    @property
    def folders(self) -> dict[str, str]:
        """Folder of each camera's layers, "" for a single camera without `own_folder`; distinct on any file system."""
        return camera_folders((frame.name for frame in self.frames), self.own_folder)

    def fingerprint(self, run: str = "") -> str:
        """Return a hash of what all frames share: the .flare, the lights' names, the query, and `run`, the fingerprint
        of the fit whose scene is behind the flare. `ShotFrame.cache_key` covers the rest."""
        digest = hashlib.sha256(read_bytes(self.flare))
        digest.update(repr((self.query, self.live, self.lights)).encode())
        digest.update(run.encode())
        return digest.hexdigest()[:16]

    def write(self, path: Path | str) -> None:
        """Write the shot as the JSON file that `read` reads."""
        finish(self.write_in_steps(path))

    def write_in_steps(self, path: Path | str) -> Steps[None]:
        """Write the shot in steps of FRAMES_PER_STEP frames.

        The file appears, or replaces an earlier one, at the end.
        """
        head = {"version": VERSION, "flare": str(self.flare), "run": str(self.run) if self.run else None,
                "query": self.query, "live": self.live, "apart": self.own_folder, "frames": []}
        with atomic_path(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as stream:
            stream.write(json.dumps(head).removesuffix(_FRAMES_END))
            for index, frame in enumerate(self.frames):
                stream.write(("," if index else "") + "\n" + json.dumps(_frame_entry(frame), allow_nan=False))
                if index % FRAMES_PER_STEP == FRAMES_PER_STEP - 1:
                    yield
            stream.write(f"\n{_FRAMES_END}\n")

    @classmethod
    def read(cls, path: Path | str) -> Shot:
        """Read a shot; its relative paths start at the file's folder. Raises SettingsError for a missing or invalid
        file."""
        return finish(cls.read_in_steps(path))

    @classmethod
    def read_in_steps(cls, path: Path | str) -> Steps[Shot]:
        """Read a shot as `read` does, in steps of FRAMES_PER_STEP frames. Raises SettingsError.

        A file that `write` did not write is parsed in one step.
        """
        data = (yield from _parse_lines(Path(path), lambda entry: entry)) or read_json(path, SettingsError)
        try:
            if data["version"] != VERSION:
                raise ValueError(f"version {data['version']}")
            if data.get("query", "target") not in get_args(Query):
                raise ValueError(f"query {data['query']!r}")
            frames: list[ShotFrame] = []
            for entry in data["frames"]:
                frames.append(_read_frame(entry, data))
                if len(frames) % FRAMES_PER_STEP == 0:
                    yield
            if not frames:
                raise ValueError("it has no frames")
            counts = Counter((frame.name, frame.frame) for frame in frames)
            duplicates = [key for key, count in counts.items() if count > 1]
            if duplicates:
                raise ValueError(f"frame {duplicates[0][1]} of {duplicates[0][0]!r} is listed twice")
            folder_of_file = Path(path).parent
            run = folder_of_file / data["run"] if data.get("run") else None
            return cls(folder_of_file / data["flare"], tuple(frames), data.get("query", "target"), run,
                       bool(data.get("live")), bool(data.get("apart")))
        except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError, np.linalg.LinAlgError) as problem:
            raise SettingsError(f"{path} is not a shot that can be rendered ({problem!r}); "
                                "export it again.") from problem

    def resized(self, width: int | None, height: int | None) -> Shot:
        """Return the shot at another size, px; without a height the aspect ratio is preserved."""
        if not width:
            return self
        return replace(self, frames=tuple(replace(frame, camera=frame.camera.scaled(width, height))
                                          for frame in self.frames))


def camera_folders(names: Iterable[str], own_folder: bool) -> dict[str, str]:
    """Return the folder of each camera's layers, as `Shot.folders` does. names: of the cameras of all frames."""
    folder_by_name: dict[str, str] = {}
    for name in dict.fromkeys(names):
        base = re.sub(r"[^\w-]+", "_", name).strip("_") or "camera"
        base = avoid_device_name(base)
        used_folders, folder, suffix = {used.casefold() for used in folder_by_name.values()}, base, 1
        while folder.casefold() in used_folders:
            suffix += 1
            folder = f"{base}_{suffix}"
        folder_by_name[name] = folder
    return folder_by_name if len(folder_by_name) > 1 or own_folder else dict.fromkeys(folder_by_name, "")


def read_folders_in_steps(path: Path) -> Steps[tuple[dict[str, str], bool]]:
    """Read `Shot.folders` and `Shot.own_folder` of a file in steps of FRAMES_PER_STEP frames.

    It stores no frames: thousands of new objects start Python's garbage collector, which blocks a window longer than
    the reading does. Raises SettingsError for a missing or invalid file.
    """
    data = (yield from _parse_lines(path, _camera_name)) or read_json(path, SettingsError)
    try:
        names = [entry if isinstance(entry, str) else _camera_name(entry) for entry in data["frames"]]
        if data["version"] != VERSION or not names:
            raise ValueError(f"version {data['version']}, {len(names)} frames")
        return camera_folders(names, bool(data.get("apart"))), bool(data.get("apart"))
    except (AttributeError, KeyError, TypeError, ValueError) as problem:
        raise SettingsError(f"{path} is not a shot that can be rendered ({problem!r}); export it again.") from problem


def _camera_name(entry: Mapping[str, Any]) -> str:
    """Return the name of a frame's camera. Raises AttributeError for what is no frame."""
    return str(entry.get("name", "Camera"))


def _parse_lines(path: Path, convert: Callable[[Any], Any]) -> Steps[dict[str, Any] | None]:
    """Parse a file of `Shot.write` line by line, in steps of FRAMES_PER_STEP frames.

    Return its data, or None for a file with another layout. convert: returns what to store for a frame.
    """
    try:
        head, *lines = read_text(path, encoding=UTF8_SIG).rstrip("\n").split("\n")
        if not head.endswith(_FRAMES_BEGIN) or not lines or lines[-1] != _FRAMES_END:
            return None
        data = parse_json(head + _FRAMES_END)
        frames: list[Any] = []
        for line in lines[:-1]:
            is_last = len(frames) == len(lines) - 2
            if line.endswith(",") == is_last:
                return None
            frames.append(convert(parse_json(line.removesuffix(","))))
            if len(frames) % FRAMES_PER_STEP == 0:
                yield
    except (AttributeError, OSError, ValueError):
        return None
    return {**data, "frames": frames} if isinstance(data, dict) and data.get("frames") == [] else None


def _frame_entry(frame: ShotFrame) -> dict[str, Any]:
    """Return the JSON form of a frame."""
    camera = frame.camera
    return {"frame": frame.frame, "name": frame.name, "width": camera.width, "height": camera.height,
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "world_to_camera": camera.world_to_camera.tolist(), "exposure": camera.exposure,
            "edits": list(frame.edits), "lights": [_light_entry(light) for light in frame.lights]}


def _read_frame(entry: Mapping[str, Any], data: Mapping[str, Any]) -> ShotFrame:
    """Parse one frame of a shot. data: the whole file, whose size holds where the frame has none.

    Raises ValueError, KeyError or TypeError where it is invalid."""
    width, height = (_to_int(entry.get(key, data.get(key))) for key in ("width", "height"))
    fx, fy, cx, cy = (_to_float(value) for value in entry["intrinsics"])
    pose = np.array([[_to_float(value) for value in row] for row in entry["world_to_camera"]])
    exposure = _to_float(entry.get("exposure", 1.0))
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and fx > 0 and fy > 0 and pose.shape == (4, 4)
            and exposure > 0):
        raise ValueError(f"frame {entry['frame']} has no sensible camera")
    lights = tuple(_read_light(light) for light in entry["lights"])
    if len({light.name for light in lights}) < len(lights):
        raise ValueError(f"frame {entry['frame']} has two lights of one name")
    if not all(isinstance(text, str) for text in entry.get("edits", [])):
        raise ValueError("edits are a list of texts")
    frame_number = _to_int(entry["frame"])
    if not 0 <= frame_number < MAX_FRAME:
        raise ValueError(f"the frame {frame_number} is no number of a file")
    camera = Camera(width, height, fx, fy, cx, cy, pose, exposure)
    return ShotFrame(frame_number, _camera_name(entry), camera, lights, tuple(entry.get("edits", [])))


def _light_entry(light: PlacedLight) -> dict[str, Any]:
    """Return the JSON form of a light; numbers that change nothing are omitted."""
    entry: dict[str, Any] = {"name": light.name, "source": light.source, "xyz": light.xyz.tolist(),
                             "share": light.visibility}
    if light.extent is not None:
        entry["extent"] = light.extent.to_json()
        if light.shares is not None:
            entry["shares"] = [round(float(share), 6) for share in light.shares]
    if light.factor != (1.0, 1.0, 1.0):
        entry["factor"] = list(light.factor)
    if light.reference_distance:
        entry["reference_distance"] = light.reference_distance
    return entry


def _read_light(entry: Mapping[str, Any]) -> PlacedLight:
    """Parse one light. Raises ValueError, KeyError or TypeError where it is invalid."""
    def read_numbers(name: str) -> tuple[float, ...]:
        return tuple(_to_float(value) for value in entry[name])

    xyz, factor = np.array(read_numbers("xyz")), read_numbers("factor") if "factor" in entry else (1.0, 1.0, 1.0)
    if len(factor) != 3 or not all(0 <= value <= MAX_FACTOR for value in factor):
        raise ValueError(f"the factor of a light has three numbers from 0 to {MAX_FACTOR:g}")
    red, green, blue = factor
    extent = LightExtent.from_json(entry["extent"]) if entry.get("extent") is not None else None
    shares = read_numbers("shares") if extent is not None and entry.get("shares") is not None else None
    light = PlacedLight(str(entry["name"]), str(entry["source"]), xyz, _to_float(entry.get("share", 1.0)), extent,
                        shares, (red, green, blue), _to_float(entry.get("reference_distance", 0.0)))
    if xyz.shape != (3,):
        raise ValueError("a light has no place")
    if not all(0 <= share <= 1 for share in (light.visibility, *(shares or ()))):
        raise ValueError("the share of a light lies between 0 and 1")
    if extent is not None and shares is not None and len(shares) != extent.cell_count:
        raise ValueError(f"the extent of a light needs {extent.cell_count} shares")
    if light.reference_distance < 0:
        raise ValueError("the reference distance of a light is not negative")
    return light


def _to_int(value: Any) -> int:
    """Return a whole number of JSON. Raises TypeError or ValueError for anything else."""
    number = _to_float(value)
    if number != int(number):
        raise ValueError(f"{value!r} is no whole number")
    return int(number)


def _to_float(value: Any) -> float:
    """Return a finite number of JSON. Raises TypeError or ValueError for anything else, True and False included."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r:.100} is no number")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a number is not finite")
    return number
