# SPDX-License-Identifier: GPL-3.0-or-later
"""A shot: cameras and placed lights frame by frame, as any program can write it down for a look to be rendered.

    {"version": 1, "flare": "lamp.flare", "run": null, "width": 960, "height": 540, "query": "target",
     "frames": [{"frame": 1, "name": "Camera", "intrinsics": [fx, fy, cx, cy], "world_to_camera": [[…], …],
                 "lights": [{"name": "lamp", "source": "lamp", "xyz": [x, y, z], "share": 1.0}],
                 "edits": ["lamp.intensity=2"]}]}

A light of the shot shows the look of the .flare's light `source`; `name` is its own, by which edits and
layers go, so one look may be used several times. Coordinates are the capture's where the flare is shown in
the scene it was learned from, else any.
"""
from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera
from ..errors import SettingsError
from ..system.files import plain_name, read_json, write_json
from .edits import LookEdits
from .look import Look, Query, ViewOfLight, asked
from .plane import PlaneGaussians

VERSION = 1
_LARGEST = 1 << 15  # pixels of a side
_MOST_FRAMES = 10**9
LIGHT_RADIUS = 0.01
"""Of a light's distance, unless another is told: the deviation of the soft disc of which a share is visible."""
LIGHT_MARGIN = 0.06
"""Of a light's distance: what stands nearer to the light is the lamp itself and hides nothing."""


@dataclass(frozen=True, eq=False)
class PlacedLight:
    """A light at xyz (3,) that shows the look of `source`; share: how much of it is visible, 0..1."""

    name: str
    source: str
    xyz: NDArray[np.float64]
    share: float = 1.0


@dataclass(frozen=True, eq=False)
class ShotFrame:
    """One camera at one frame, with the lights as they are there and the words of the edits."""

    frame: int
    name: str
    camera: Camera
    lights: tuple[PlacedLight, ...]
    edits: tuple[str, ...] = ()

    def described(self) -> str:
        """Changes whenever its picture would, with one .flare and query."""
        return repr((self.frame, self.name, self.edits, *self.camera.numbers,
                     [(light.name, light.source, light.xyz.tolist(), light.share) for light in self.lights]))


def evaluate(look: Look, world_to_camera: Any, lights: Sequence[PlacedLight], edits: LookEdits | None = None,
             query: Query = "target") -> dict[str, PlaneGaussians]:
    """The Gaussians of each placed light that is in front of the camera and not hidden, by the light's own name.

    Lights whose source the look does not have show nothing.
    """
    sources = {light.name: light for light in look.lights}
    names = [light.name for light in lights]
    shown: dict[str, PlaneGaussians] = {}
    for light in lights:
        source = sources.get(light.source)
        if source is None or light.share <= 0 or (edits is not None and not edits.shows(light.name, names)):
            continue
        view = ViewOfLight.of(world_to_camera, light.xyz)
        found = source.evaluate(view, query=asked(source, view, query), edits=edits, share=light.share, name=light.name)
        if found is not None:
            shown[light.name] = found
    return shown


@dataclass(frozen=True, eq=False)
class Shot:
    """Frames to be rendered with a flare. run: the folder of the fit whose scene belongs under it, or None. live:
    whoever lays the layers over something applies the colour of whole lights, which the edits leave out. apart: one
    camera's layers, too, have a folder of their own."""

    flare: Path
    frames: tuple[ShotFrame, ...]
    query: Query = "target"
    run: Path | None = None
    live: bool = False
    apart: bool = False

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of all lights, in order of appearance."""
        return tuple(dict.fromkeys(light.name for frame in self.frames for light in frame.lights))

    @property
    def folders(self) -> dict[str, str]:
        """Of each camera the folder for its layers, "" where there is but one that is not to have its own; no two are
        one, on any file system."""
        found: dict[str, str] = {}
        for name in dict.fromkeys(frame.name for frame in self.frames):
            plain = re.sub(r"[^\w-]+", "_", name).strip("_") or "camera"
            plain = plain_name(plain)
            taken, folder, number = {other.casefold() for other in found.values()}, plain, 1
            while folder.casefold() in taken:
                number += 1
                folder = f"{plain}_{number}"
            found[name] = folder
        return found if len(found) > 1 or self.apart else dict.fromkeys(found, "")

    def fingerprint(self, run: str = "") -> str:
        """Changes whenever all its pictures would; what is a frame's alone, `ShotFrame.described` tells. run: the
        fingerprint of the fit whose scene belongs under it."""
        digest = hashlib.sha256(self.flare.read_bytes())
        digest.update(repr((self.query, self.live, self.lights)).encode())
        digest.update(run.encode())
        return digest.hexdigest()[:16]

    def write(self, path: Path | str) -> None:
        """Write what `read` reads."""
        frames = [{"frame": one.frame, "name": one.name, "width": one.camera.width, "height": one.camera.height,
                   "intrinsics": [one.camera.fx, one.camera.fy, one.camera.cx, one.camera.cy],
                   "world_to_camera": one.camera.world_to_camera.tolist(), "exposure": one.camera.exposure,
                   "edits": list(one.edits),
                   "lights": [{"name": light.name, "source": light.source, "xyz": light.xyz.tolist(),
                               "share": light.share} for light in one.lights]} for one in self.frames]
        write_json(path, {"version": VERSION, "flare": str(self.flare), "run": str(self.run) if self.run else None,
                          "query": self.query, "live": self.live, "apart": self.apart, "frames": frames})

    @classmethod
    def read(cls, path: Path | str) -> Shot:
        """Raises SettingsError where the file is missing, damaged or of another form."""
        data = read_json(path, SettingsError)
        try:
            if data["version"] != VERSION:
                raise ValueError(f"version {data['version']}")
            if data.get("query", "target") not in get_args(Query):
                raise ValueError(f"query {data['query']!r}")
            frames = tuple(_frame(entry, data) for entry in data["frames"])
            if not frames:
                raise ValueError("it has no frames")
            twice = [one for one, count in Counter((one.name, one.frame) for one in frames).items() if count > 1]
            if twice:
                raise ValueError(f"frame {twice[0][1]} of {twice[0][0]!r} is listed twice")
            here = Path(path).parent
            run = here / data["run"] if data.get("run") else None
            return cls(here / data["flare"], frames, data.get("query", "target"), run, bool(data.get("live")),
                       bool(data.get("apart")))
        except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError, np.linalg.LinAlgError) as problem:
            raise SettingsError(f"{path} is not a shot that can be rendered ({problem!r}); "
                                "export it again.") from problem

    def sized(self, width: int | None, height: int | None) -> Shot:
        """The same at another size in pixels; without a height the proportions stay."""
        if not width:
            return self
        return replace(self, frames=tuple(replace(one, camera=one.camera.scaled(width, height))
                                          for one in self.frames))


def _frame(entry: Mapping[str, Any], data: Mapping[str, Any]) -> ShotFrame:
    width, height = (_whole(entry.get(key, data.get(key))) for key in ("width", "height"))
    fx, fy, cx, cy = (_number(value) for value in entry["intrinsics"])
    pose = np.array([[_number(value) for value in row] for row in entry["world_to_camera"]])
    exposure = _number(entry.get("exposure", 1.0))
    if not (0 < width <= _LARGEST and 0 < height <= _LARGEST and fx > 0 and fy > 0 and pose.shape == (4, 4)
            and exposure > 0):
        raise ValueError(f"frame {entry['frame']} has no sensible camera")
    lights = tuple(PlacedLight(str(one["name"]), str(one["source"]), np.array([_number(x) for x in one["xyz"]]),
                               _number(one.get("share", 1.0))) for one in entry["lights"])
    if len({light.name for light in lights}) < len(lights):
        raise ValueError(f"frame {entry['frame']} has two lights of one name")
    if any(light.xyz.shape != (3,) for light in lights):
        raise ValueError("a light has no place")
    if not all(0 <= light.share <= 1 for light in lights):
        raise ValueError("the share of a light lies between 0 and 1")
    if not all(isinstance(word, str) for word in entry.get("edits", [])):
        raise ValueError("edits are a list of texts")
    number = _whole(entry["frame"])
    if not 0 <= number < _MOST_FRAMES:
        raise ValueError(f"the frame {number} is no number of a file")
    return ShotFrame(number, str(entry.get("name", "Camera")),
                     Camera(width, height, fx, fy, cx, cy, pose, exposure), lights, tuple(entry.get("edits", [])))


def _whole(value: Any) -> int:
    number = _number(value)
    if number != int(number):
        raise ValueError(f"{value!r} is no whole number")
    return int(number)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r:.100} is no number")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a number is not finite")
    return number
