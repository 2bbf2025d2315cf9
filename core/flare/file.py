# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes the .flare file: one captured flare look, as safetensors with a JSON description.

The description (metadata key "fit_flare") is readable without the tensors: format version, blend, form, lights with
positions and the ranges they were trained on, training camera, elements, licence, notes. Hash tables are stored as the
rows that training touched; the others are zero. Nothing is unpickled. `core.look` reads it without torch.
"""
from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..choices import Blend
from ..conventions.pixel_grid import PixelGrid
from ..errors import FlareFileError
from ..look.form import FlareForm
from ..look.look import METADATA_KEY, VERSION, TrainedCamera, parse_description
from ..system import tensor_files
from .deformation import QueryRange
from .encoding import TABLE
from .model import FlareModel, LightFlare


@dataclass
class FlareFile:
    """A flare model with its description.

    training_views: by light, camera x, y, z (world) and light x, y (normalised) of each training view that had it in
    front. pixel_grid: the grid of the frames that it was fitted to, at their working size.
    """

    model: FlareModel
    blend: Blend
    camera: TrainedCamera
    licence: str = ""
    notes: str = ""
    elements: list[dict[str, Any]] = field(default_factory=list)
    training_views: dict[str, list[list[float]]] = field(default_factory=dict)
    pixel_grid: PixelGrid | None = None


def save(path: Path | str, flare: FlareFile) -> None:
    """Write a .flare atomically: the tensors as safetensors, the rest as a JSON description in their metadata."""
    forms = [asdict(light.form) for light in flare.model.lights]
    lights = [
        {"name": name, "xyz": xyz, "form": form, "range": asdict(light.query_range), "count": light.count,
         "clear": clear}
        for name, xyz, form, light, clear in zip(flare.model.names, flare.model.positions.tolist(), forms,
                                                 flare.model.lights, flare.model.clear.tolist(), strict=True)
    ]
    description = {"version": VERSION, "blend": flare.blend, "lights": lights, "camera": asdict(flare.camera),
                   "elements": flare.elements, "seen": flare.training_views, "licence": flare.licence,
                   "notes": flare.notes}
    if flare.pixel_grid is not None:
        description["sampling"] = flare.pixel_grid.to_entry()
    tensor_files.write_tensors(path, _pack(flare.model), {METADATA_KEY: json.dumps(description)})


def load(path: Path | str) -> FlareFile:
    """Read a .flare. Raises FlareFileError if it is missing, damaged, newer, or not a flare."""
    path = Path(path)
    if not path.is_file():
        raise FlareFileError(f"{path} is missing; choose a .flare file that a fit has written.")
    try:
        tensors, metadata = tensor_files.read_tensors(path)
    except (ValueError, OSError) as problem:
        raise FlareFileError(f"{path} is damaged or not a flare ({problem}); save it again.") from problem
    description = parse_description(path, metadata)
    try:
        return _unpack(description, tensors)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError, RuntimeError) as problem:
        raise FlareFileError(f"{path} is damaged: its tensors do not fit its description ({problem}).") from problem


def _to_triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _pack(model: FlareModel) -> dict[str, Tensor]:
    """Return the tensors of all lights by "light's number.parameter".

    Of a hash table only the rows that are not zero are returned, as "name.rows" and "name.values". `LightFlare.scale`
    is multiplied into the tensors, since the file does not store it.
    """
    packed: dict[str, Tensor] = {}
    states = {f"{number}.{name}": tensor for number, light in enumerate(model.lights)
              for name, tensor in light.state_without_scale().items()}
    for name, tensor in states.items():
        tensor = tensor.contiguous().cpu()
        if name.endswith(TABLE):
            rows = tensor.abs().amax(1).nonzero()[:, 0]
            packed[f"{name}.rows"], packed[f"{name}.values"] = rows.to(torch.int32), tensor[rows]
        else:
            packed[name] = tensor.clone()
    return packed


def _unpack(description: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> FlareFile:
    """Make the model from the description and tensors that `save` writes. Raises ValueError, KeyError or RuntimeError
    if they are damaged."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise ValueError(f"{name} holds values that are not finite")
    flares, names, positions, clear = [], [], [], []
    for light in description["lights"]:
        low, high, light_high = (_to_triple(light["range"][key]) for key in ("camera_low", "camera_high", "light_high"))
        # The generator draws initial values, which those of the file replace below.
        flares.append(LightFlare(FlareForm(**light["form"]), QueryRange(low, high, light_high), int(light["count"]),
                                 torch.Generator()))
        names.append(str(light["name"]))
        positions.append(_to_triple(light["xyz"]))
        clear.append(float(light.get("clear", 1.0)))
    model = FlareModel(names, torch.tensor(positions, dtype=torch.float64).reshape(-1, 3), flares)
    model.clear.copy_(torch.tensor(clear))
    state = model.flares.state_dict()
    for name in state:
        if name.endswith(TABLE):
            rows = tensors[f"{name}.rows"].long()
            state[name] = torch.zeros_like(state[name]).index_copy(0, rows, tensors[f"{name}.values"])
        else:
            state[name] = tensors[name]
    model.flares.load_state_dict(state)
    return FlareFile(model, description["blend"], TrainedCamera(**description["camera"]),
                     str(description.get("licence", "")), str(description.get("notes", "")),
                     list(description.get("elements", [])), dict(description.get("seen", {})),
                     PixelGrid.read(description.get("sampling")))
