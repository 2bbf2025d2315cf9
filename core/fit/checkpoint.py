# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of an unfinished fit on disk, and the inputs that it was made from.

A state is a nested dictionary of tensors and JSON values, written whole or not at all as one safetensors file. Large
tables of which training has touched a few rows are stored as those rows. `run_loop` saves and loads it; `Trainer` makes
it, with `FitInputs`, and refuses one of other inputs.
"""
from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..capture import LIGHTS, Capture, View
from ..errors import RunError
from ..system import tensor_files
from ..system.files import content_hash
from ..system.reading import parse_json

VERSION = 1
_SPARSE_FROM_ROWS = 100_000
"""Number of rows above which a table is stored by its rows that are not 0, if those are less than a quarter."""
_MAX_TABLE = 1 << 32
"""Bound of the numbers in a table that is stored by its rows."""
LIGHT_TOLERANCE = 1e-5
"""Distance up to which a light counts as unmoved, relative to the capture's extent."""
State = dict[str, Any]


def save(path: Path, state: Mapping[str, Any]) -> None:
    """Write a state atomically as one safetensors file.

    Nested names become "table/.../name". Of a large table that is mostly 0 only the other rows are stored, as
    "name@rows" and "name@values".
    """
    tensors: dict[str, Tensor] = {}
    values: dict[str, Any] = {}
    shapes: dict[str, list[int]] = {}
    for name, value in _leaves(state, ""):
        if not isinstance(value, Tensor):
            values[name] = value
            continue
        tensor = value.detach().cpu().contiguous()
        if tensor.ndim == 2 and len(tensor) > _SPARSE_FROM_ROWS:
            rows = tensor.abs().amax(1).nonzero()[:, 0]
            if len(rows) < len(tensor) // 4:
                shapes[name] = list(tensor.shape)
                tensors[f"{name}@rows"], tensors[f"{name}@values"] = rows, tensor[rows]
                continue
        tensors[name] = tensor
    description = json.dumps({"version": VERSION, "values": values, "shapes": shapes})
    tensor_files.write_tensors(path, tensors, {"checkpoint": description})


def load(path: Path) -> State:
    """Read a state that `save` wrote. Raises RunError if the file is damaged or of another version."""
    try:
        tensors, metadata = tensor_files.read_tensors(path)
        description = parse_json(metadata["checkpoint"])
        if description["version"] != VERSION:
            raise RunError(f"{path} was written by another version of Fit Flare; start the fit anew.")
        for name, shape in description["shapes"].items():
            rows, values = tensors.pop(f"{name}@rows"), tensors.pop(f"{name}@values")
            if not _is_table_shape(shape) or shape[1:] != list(values.shape[1:]):
                raise ValueError(f"the table {name} has the shape {shape!r:.80}")
            tensors[name] = torch.zeros(shape, dtype=values.dtype).index_copy_(0, rows, values)
        flat = {**description["values"], **tensors}
        return _nest(flat)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, RuntimeError,
            OSError) as problem:
        raise RunError(f"{path} is damaged ({problem}); remove it and start the fit anew.") from problem


def _nest(flat: Mapping[str, Any]) -> State:
    """Return nested tables from values named "table/.../value". Raises ValueError if a name is both table and value."""
    state: State = {}
    for name, value in flat.items():
        *keys, last = name.split("/")
        table = state
        for key in keys:
            table = table.setdefault(key, {})
            if not isinstance(table, dict):
                raise ValueError(f"{name} lies in a value")
        if isinstance(table.get(last), dict):
            raise ValueError(f"{name} is a table and a value")
        table[last] = value
    return state


def _is_table_shape(shape: Any) -> bool:
    """Return whether a value is [rows, columns] of a table that memory may hold."""
    return (isinstance(shape, list) and len(shape) == 2 and all(type(size) is int and size > 0 for size in shape)
            and shape[0] * shape[1] <= _MAX_TABLE)


def _leaves(table: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", value


class FitInputs:
    """The lights of a capture, and a digest of each view's camera, frame, mask and, with `clean_frames`, clean frame.

    A checkpoint holds both; a fit resumes only with the same inputs. clean_frames: True if the fit uses the clean
    frames in removed/. lights: False for a fit without flare.
    """

    def __init__(self, capture: Capture, *, clean_frames: bool, lights: bool) -> None:
        self._capture, self._uses_clean_frames = capture, clean_frames
        self._lights = [light.numbers for light in capture.lights] if lights else None
        self._views: list[list[str]] | None = None

    def state(self) -> dict[str, Any]:
        """Return the entries for the checkpoint: "views", a list of [name, digest], and, if the fit has lights,
        "lights", a list of [name, [x, y, z]], with the paths of those that move.

        The lights' positions are those in the capture, even if the fit has moved the lights.
        """
        if self._views is None:
            self._views = [[view.name, self._digest(view)] for view in self._capture.views]
        return {"views": self._views, **({} if self._lights is None else {"lights": self._lights})}

    def check(self, stored: dict[str, Any]) -> None:
        """Raise RunError if the entries `stored` in a checkpoint differ from these inputs.

        A flare belongs to a light by its number, so a resumed fit needs the same lights in the same order. An entry
        that an older format lacks is not checked.
        """
        current = self.state()
        tolerance = LIGHT_TOLERANCE * self._capture.extent
        if "lights" in current and stored.get("lights") is not None and (
                light_change := _describe_light_change(stored["lights"], current["lights"], tolerance)):
            raise RunError(f"{self._capture.folder / LIGHTS} has changed since the fit began ({light_change}); put "
                           "the old one back, or begin the fit anew in another folder.")
        before, after = dict(stored.get("views") or []), dict(current["views"])
        changed_views = [name for name in {**before, **after} if before.get(name) != after.get(name)]
        if before and changed_views:
            raise RunError(f"{self._capture.folder} has changed since the fit began ({len(changed_views)} of "
                           f"{len(after)} views have another frame, clean frame or camera, {changed_views[0]} first); "
                           "put the old ones back, or begin the fit anew in another folder.")

    def _digest(self, view: View) -> str:
        """Hash the camera and the files of a view: frame, mask and, if the fit uses it, clean frame."""
        capture, camera = self._capture, view.camera
        mask = capture.mask_path(view)
        files = [capture.frame_path(view), *([capture.clean_frame_path(view)] if self._uses_clean_frames else []),
                 *([] if mask is None else [mask])]
        rotation, position = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        # Adding 0 turns -0, which has another text, into 0.
        numbers = [*np.round(rotation, 5).ravel() + 0.0, *position, camera.fx, camera.fy, camera.cx, camera.cy]
        inputs = [*map(content_hash, files), *(f"{number:.5g}" for number in numbers), str(view.lens)]
        return hashlib.blake2b(" ".join(inputs).encode(), digest_size=8).hexdigest()


def _describe_light_change(old: list[Any], new: list[Any], tolerance: float) -> str:
    """Return a clause for the user on what differs between two lists of lights; "" if nothing does.

    A light is [name, position or None if it moves, other values...]. The clause is on the names if they differ, else on
    the first light whose position or other values differ. Positions may differ by `tolerance`, world units, plus
    Blender's rounding to single precision.
    """
    old_names, new_names = ([name for name, *_ in lights] for lights in (old, new))
    if old_names != new_names:
        return f"its lights were {', '.join(map(repr, old_names))}, and are {', '.join(map(repr, new_names))} now"
    for (name, old_position, *old_path), (_, new_position, *new_path) in zip(old, new, strict=True):
        if None in (old_position, new_position):
            moved = old_position != new_position
        else:
            moved = not np.allclose(old_position, new_position, rtol=1e-6, atol=tolerance)
        if moved:
            return f"{name!r} was at {old_position}, and is at {new_position} now"
        if old_path != new_path:
            return f"the path or the brightness of {name!r} has changed"
    return ""
