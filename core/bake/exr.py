# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes one frame as one multilayer EXR file.

One part; root R G B A = composite, then scene.*, flare.*, flare_<light>.*, depth.Z (see `layers`). The header has
`software`, the `chromaticities` of the linear space, and `fitFlare`, a JSON text with the version, the view, the frame
number, and the light of each flare layer.
"""
from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from ..colour import REC_709, Chromaticities
from ..colour.srgb import Pixels
from ..errors import FrameError
from ..images.exr import read_data_window, read_exr
from ..images.formats import exr_header
from ..images.write import write_exr
from ..system.reading import open_regular, parse_json
from .layers import FrameLayers, layer_names

HEADER_ATTRIBUTE = "fitFlare"
VERSION = 1


def write_layers(path: Path | str, layers: FrameLayers, *, half: bool = True,
                 notes: Mapping[str, Any] | None = None, chromaticities: Chromaticities | None = REC_709,
                 pixel_aspect: float = 1.0, commit_lock: AbstractContextManager[None] | None = None) -> None:
    """Write a frame's layers atomically, ZIP compressed; depth stays 32 bit when the rest is `half`.

    notes: JSON-able entries for the header (view, frame, ...). chromaticities: of the layers' linear space.
    pixel_aspect: width of a pixel over its height. commit_lock: held while the finished file takes its name.
    """
    lights = {layer: light for light, layer in layer_names(layers.flares).items()}
    description = json.dumps({"version": VERSION, "lights": lights, **(notes or {})})
    header: dict[str, Any] = {"software": "Fit Flare", HEADER_ATTRIBUTE: description,
                              "pixelAspectRatio": pixel_aspect}
    if chromaticities is not None:
        header["chromaticities"] = chromaticities
    if layers.window is not None:
        header |= layers.window.header()
    write_exr(path, layers.channels(), half=half, header=header, commit_lock=commit_lock)


def read_description(path: Path | str) -> dict[str, Any]:
    """Return the header entries that `write_layers` wrote. Raises FrameError if the file is not a baked one."""
    try:
        with open_regular(path) as stream:
            if stream.read(4) != exr_header.MAGIC or exr_header.is_truncated(stream):
                raise FrameError(f"{path} is damaged or truncated; bake it again.")
            text = exr_header.locate_strings(stream).get(HEADER_ATTRIBUTE, (0, b""))[1]
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    try:
        description = parse_json(text) if text else None
    except (TypeError, ValueError, RecursionError) as problem:
        raise FrameError(f"{path} has a damaged header ({problem}); bake it again.") from problem
    if not isinstance(description, dict) or not isinstance(description.get("lights"), dict):
        raise FrameError(f"{path} holds no layers of Fit Flare; choose a file that `bake` has written.")
    return description


def read_layers(path: Path | str) -> FrameLayers:
    """Read the layers of a file that `write_layers` made, without the alpha of the composite.

    Raises FrameError if it is damaged or not one."""
    import numpy as np

    lights = read_description(path)["lights"]
    channels = read_exr(path)

    def stack_colour(layer: str) -> Pixels:
        return np.stack([channels[f"{layer}.{name}"] for name in "RGB"], axis=-1)

    try:
        return FrameLayers(stack_colour("scene"), {light: stack_colour(layer) for layer, light in lights.items()},
                           channels["depth.Z"], read_data_window(path))
    except KeyError as problem:
        raise FrameError(f"{path} lacks the channel {problem}; bake it again.") from problem
