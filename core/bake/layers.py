# SPDX-License-Identifier: GPL-3.0-or-later
"""The layers of one frame and the channels that hold them.

All light is scene-linear (Rec. 709 where no other space is asked for), and scene + flare = composite in
every pixel, whatever blend was fitted: for a flare that was fitted "over" the scene in display space, the
flare's layer is the linear composite less the linear scene. The layers of the lights sum to the flare. So
the way to put them together is plain addition (Add in Blender, plus in Nuke), of as many of them as wanted.

A flare layer is premultiplied, with alpha = max(R, G, B) in 0..1: laid over black it is the flare, and
the alpha serves as its matte. The root's alpha is 1.
"""
from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ..colour import ColourSpace
from ..colour.srgb import Pixels
from ..errors import SettingsError
from ..images.window import DataWindow

FARTHEST = 1e10
"""Depth where there is nothing, as Blender writes it."""
_LONGEST_NAME = 40  # Blender cuts a layer's name at 63 bytes


class Rendering(Protocol):
    """What a renderer gives for one view, scene-linear, height x width.

    scene (h, w, 3); flare_by_light: (h, w, 3) each; depth (h, w) along the camera's axis, world units,
    0 where there is nothing.
    """

    @property
    def scene(self) -> Pixels: ...
    @property
    def flare_by_light(self) -> Mapping[str, Pixels]: ...
    @property
    def depth(self) -> Pixels: ...


@dataclass(frozen=True)
class FrameLayers:
    """Scene (h, w, 3), one flare layer (h, w, 3) for each light, by the light's name, and depth (h, w).

    window: where these pixels lie on the frame, those of a plate with overscan or cut to a part; None where they are
    the frame.
    """

    scene: Pixels
    flares: Mapping[str, Pixels]
    depth: Pixels
    window: DataWindow | None = None

    @property
    def flare(self) -> Pixels:
        """The sum over lights; zeros without any."""
        return sum(self.flares.values(), np.zeros_like(self.scene))

    @property
    def composite(self) -> Pixels:
        """Scene and flare together."""
        return self.scene + self.flare

    def in_space(self, space: ColourSpace) -> FrameLayers:
        """The same light in another linear space."""
        if space.matrix is None:
            raise SettingsError(f"Layers add in linear light, and {space.name} is not linear; choose linear, acescg, "
                                "or another linear space.")
        flares = {light: space.from_linear(layer) for light, layer in self.flares.items()}
        return replace(self, scene=space.from_linear(self.scene), flares=flares)

    def channels(self) -> dict[str, Pixels]:
        """Channel name to (h, w), for one EXR part. One dot in a name at most.

        Blender files `flare.lamp.R` under a layer that cannot be chosen again, so a light's layer is
        `flare_lamp.R`, with the light's name made safe by `layer_names`.
        """
        channels: dict[str, Pixels] = {}
        opaque, flare = np.ones_like(self.scene[..., 0]), self.flare
        _add(channels, "", self.scene + flare, opaque)
        _add(channels, "scene.", self.scene)
        _add(channels, "flare.", flare, matte(flare))
        for light, layer in layer_names(self.flares).items():
            _add(channels, f"{layer}.", self.flares[light], matte(self.flares[light]))
        channels["depth.Z"] = np.where(self.depth > 0, self.depth, FARTHEST).astype(np.float32)
        return channels


def _add(channels: dict[str, Pixels], prefix: str, colour: Pixels, alpha: Pixels | None = None) -> None:
    for index, name in enumerate("RGB"):
        channels[prefix + name] = colour[..., index]
    if alpha is not None:
        channels[prefix + "A"] = alpha


def _coloured(layer: Pixels, matrix: Any) -> Pixels:
    matrix = np.asarray(matrix, np.float32)
    factors = matrix.diagonal()
    # What is negative, as differences of layers are where a flare covers what is brighter, stays so.
    if np.array_equal(matrix, np.diag(factors)):
        return np.asarray(layer * factors, np.float32)
    mixed = layer @ matrix.T
    return np.asarray(np.where((layer < 0).any(-1, keepdims=True), mixed, np.maximum(mixed, 0)), np.float32)


def matte(flare: Pixels) -> Pixels:
    """The alpha of premultiplied light on black: its brightest channel, in 0..1."""
    return np.clip(flare.max(-1), 0, 1)


def layer_names(lights: Iterable[str]) -> dict[str, str]:
    """Light to layer: `flare_<light>` in letters, digits, `_` and `-`, no two the same whatever the case."""
    names: dict[str, str] = {}
    taken: set[str] = set()
    for light in lights:
        plain = unicodedata.normalize("NFKD", light).encode("ascii", "ignore").decode()
        safe = re.sub(r"[^A-Za-z0-9_-]+", "_", plain).strip("_")[:_LONGEST_NAME] or "light"
        name, count = safe, 1
        while name.casefold() in taken:
            count += 1
            name = f"{safe}_{count}"
        taken.add(name.casefold())
        names[light] = f"flare_{name}"
    return names


def layers_of(rendering: Rendering, colours: Mapping[str, Any] | None = None) -> FrameLayers:
    """The layers of a rendering, each light's flare under its colour matrix (3, 3) (`LookEdits.matrices`).

    Light that saturation would make negative is none.
    """
    colours = colours or {}
    flares = {light: _coloured(layer, colours[light]) if light in colours else np.asarray(layer, np.float32)
              for light, layer in rendering.flare_by_light.items()}
    return FrameLayers(np.asarray(rendering.scene, np.float32), flares, np.asarray(rendering.depth, np.float32))
