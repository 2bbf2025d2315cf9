# SPDX-License-Identifier: GPL-3.0-or-later
"""The layers of one frame and the channels that hold them.

All light is scene-linear (Rec. 709 unless another space is chosen), and scene + flare = composite in every pixel, for
either blend: for a flare fitted "over" the scene in display space, the flare's layer is the linear composite minus the
linear scene. The layers of the lights sum to the flare. So plain addition composites them (Add in Blender, plus in
Nuke), any number of them.

A flare layer is premultiplied, with alpha = max(R, G, B) in 0..1: over black it is the flare, and the alpha serves as
its matte. The root's alpha is 1, or, of a plate with alpha, the plate's, where the flare shines at least max(R, G, B);
the scene layer shows such a plate over black.
"""
from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..capture.renderer import RenderedLayers
from ..colour import ColourSpace
from ..colour.srgb import Pixels
from ..errors import SettingsError
from ..images.window import DataWindow

EMPTY_DEPTH = 1e10
"""Depth where nothing is, as Blender writes it."""
_MAX_NAME = 40  # Blender cuts a layer's name at 63 bytes


@dataclass(frozen=True)
class FrameLayers:
    """Scene (h, w, 3), one flare layer (h, w, 3) for each light, by the light's name, and depth (h, w).

    window: position of these pixels on the frame, for a plate with overscan; None if they are the frame. alpha: of the
    composite (h, w), 0..1; None for an opaque one.
    """

    scene: Pixels
    flares: Mapping[str, Pixels]
    depth: Pixels
    window: DataWindow | None = None
    alpha: Pixels | None = None

    @property
    def flare(self) -> Pixels:
        """The sum over lights; zeros without any."""
        return sum(self.flares.values(), np.zeros_like(self.scene))

    @property
    def composite(self) -> Pixels:
        """Scene plus flare."""
        return self.scene + self.flare

    def in_space(self, space: ColourSpace) -> FrameLayers:
        """Return the same light in another linear space. Raises SettingsError for one that is not linear."""
        if space.matrix is None:
            raise SettingsError(f"Layers add in linear light, and {space.name} is not linear; choose linear, acescg, "
                                "or another linear space.")
        flares = {light: space.from_linear(layer) for light, layer in self.flares.items()}
        return replace(self, scene=space.from_linear(self.scene), flares=flares)

    def channels(self) -> dict[str, Pixels]:
        """Return (h, w) by channel name, for one EXR part; at most one dot in a name.

        Blender would sort a channel `flare.lamp.R` into a layer that nodes cannot choose again, so a light's channels
        are named `flare_lamp.R`, with the light's name made safe by `layer_names`.
        """
        channels: dict[str, Pixels] = {}
        alpha, flare = np.ones_like(self.scene[..., 0]) if self.alpha is None else self.alpha, self.flare
        _add_channels(channels, "", self.scene + flare, alpha)
        _add_channels(channels, "scene.", self.scene)
        _add_channels(channels, "flare.", flare, flare_alpha(flare))
        for light, layer in layer_names(self.flares).items():
            _add_channels(channels, f"{layer}.", self.flares[light], flare_alpha(self.flares[light]))
        channels["depth.Z"] = np.where(self.depth > 0, self.depth, EMPTY_DEPTH).astype(np.float32)
        return channels


def _add_channels(channels: dict[str, Pixels], prefix: str, colour: Pixels, alpha: Pixels | None = None) -> None:
    """Add the channels R, G, B and, if given, A of one layer, with `prefix` before their names."""
    for index, name in enumerate("RGB"):
        channels[prefix + name] = colour[..., index]
    if alpha is not None:
        channels[prefix + "A"] = alpha


def _apply_colour(layer: Pixels, matrix: Any) -> Pixels:
    """Return a layer (h, w, 3) under a colour matrix (3, 3); a pixel without negative light does not get
    any."""
    matrix = np.asarray(matrix, np.float32)
    factors = matrix.diagonal()
    # A flare that covers something brighter has negative light, which is kept.
    if np.array_equal(matrix, np.diag(factors)):
        return np.asarray(layer * factors, np.float32)
    mixed = layer @ matrix.T
    return np.asarray(np.where((layer < 0).any(-1, keepdims=True), mixed, np.maximum(mixed, 0)), np.float32)


def flare_alpha(flare: Pixels) -> Pixels:
    """Return the alpha of premultiplied light on black: its brightest channel, in 0..1."""
    return np.clip(flare.max(-1), 0, 1)


def layer_names(lights: Iterable[str]) -> dict[str, str]:
    """Return the layer of each light: `flare_<light>` in letters, digits, `_` and `-`, unique also without regard to
    case."""
    names: dict[str, str] = {}
    used: set[str] = set()
    for light in lights:
        ascii_name = unicodedata.normalize("NFKD", light).encode("ascii", "ignore").decode()
        safe = re.sub(r"[^A-Za-z0-9_-]+", "_", ascii_name).strip("_")[:_MAX_NAME] or "light"
        name, count = safe, 1
        while name.casefold() in used:
            count += 1
            name = f"{safe}_{count}"
        used.add(name.casefold())
        names[light] = f"flare_{name}"
    return names


def to_layers(rendering: RenderedLayers, matrices: Mapping[str, Any] | None = None) -> FrameLayers:
    """Convert a rendering to layers, each light's flare under its colour matrix (3, 3) (`LookEdits.colour_matrices`).

    Light that saturation would make negative becomes 0.
    """
    matrices = matrices or {}
    flares = {light: _apply_colour(layer, matrices[light]) if light in matrices else np.asarray(layer, np.float32)
              for light, layer in rendering.flare_by_light.items()}
    return FrameLayers(np.asarray(rendering.scene, np.float32), flares, np.asarray(rendering.depth, np.float32))
