# SPDX-License-Identifier: GPL-3.0-or-later
"""What scores and bakes need from a renderer of a capture's views.

`core.metrics` and `core.bake` take any renderer of this form; `core.fit.run.Run` is the usual one.
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from ..colour.srgb import Pixels
from .camera import Camera


class RenderedLayers(Protocol):
    """Scene-linear layers of one view, float32: scene (height, width, 3), the flare of each light (height, width, 3),
    and depth (height, width) along the camera's axis, world units, 0 where nothing is."""

    @property
    def scene(self) -> Pixels: ...
    @property
    def flare_by_light(self) -> Mapping[str, Pixels]: ...
    @property
    def depth(self) -> Pixels: ...


class ViewRenderer(Protocol):
    """A renderer of the layers that a camera sees."""

    def render(self, camera: Camera) -> RenderedLayers: ...
