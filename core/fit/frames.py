# SPDX-License-Identifier: GPL-3.0-or-later
"""The pictures a fit looks at, at the size and in the encoding in which it does."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..capture import Camera, Capture, View
from ..errors import CaptureError
from ..images.borders import DARKEST, LEAST, Borders, Inside
from ..images.picture import Picture
from ..thinning import thinned
from .cache import MEMORY, PictureCache

ASKED = 12
"""Frames, about, that are asked for their borders."""
SOFT = 1
"""Lines beside a border that hold some of it at another size."""


def colours_at(xyz: NDArray[Any], camera: Camera, picture: Tensor) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which (n,) of the points (n, 3), in the world, lie on the camera's frame, and what a picture of it shows there,
    (m, 3)."""
    pixels, depth = camera.project(xyz)
    inside = camera.contains(pixels, depth)
    x, y = np.minimum(pixels[inside].astype(int), np.array(camera.size) - 1).T
    return inside, picture.numpy()[y, x]


class Targets(NamedTuple):
    """A view's camera and pictures in display space, (height, width, 3) float32 in 0..`display_white`."""

    camera: Camera
    frame: Tensor
    removed: Tensor | None


class Frames:
    """Frames of a capture at the working size, with the flare-free frame of each where there is one.

    display_white: display value at which they are clipped; above 1 for float frames that hold light above white.
    `reference` says where the flare-free frames come from: "removed" (files in removed/), "truth" (exact
    scene layers, when there is no removed/), or "" (none). Black borders that all frames have are cut off: they stay
    with the camera, and would be put before it as a part of the scene.
    """

    def __init__(self, capture: Capture, width: int = 0, memory: int = MEMORY, *,
                 display_white: float = 1.0, alone: bool = False, truth: bool = True) -> None:
        """alone: flare-free frames are not looked at, whatever the capture has; truth: exact layers are, where it has
        no others."""
        self.capture = capture
        self.display_white = display_white
        self._width = width
        self._codes = 65535 / display_white  # 16 bit keeps the smoothness of linear footage at half the size of float
        self.cache = PictureCache(memory)
        self.reference = ("" if alone else "removed" if capture.has_removed else
                          "truth" if truth and capture.has_truth else "")
        self.inside = self._inside()
        """What lies inside the borders; None where there are none."""

    @property
    def says(self) -> tuple[str, ...]:
        """Sentences for the person who asked for the fit."""
        if self.inside is None:
            return ()
        (width, height), inside = self.camera(self.capture.views[0]).size, self.inside
        return (f"The frames have black borders ({inside.top} and {height - inside.bottom} rows, {inside.left} and "
                f"{width - inside.right} columns of {width}x{height}), which are left out of the fit.",)

    def camera(self, view: View) -> Camera:
        """The view's camera at the working size, never larger than the frame; with the borders."""
        camera = view.camera
        if not self._width or camera.width <= self._width:
            return camera
        return camera.scaled(self._width)

    def _inside(self) -> Inside | None:
        """What lies inside the borders that all frames have, at the working size; None where they have none, or are of
        several sizes."""
        sizes = {self.camera(view).size for view in self.capture.views}
        if len(sizes) != 1:
            return None
        size, found = sizes.pop(), None
        for view in thinned(self.capture.views, ASKED):
            stored = self._stored(view, "frame", self.capture.frame)
            if stored is None or stored.max() <= DARKEST * self._codes:  # faded out
                continue
            borders = Borders.of(stored, lambda line: line / self._codes)
            found = borders if found is None else found.common(borders)
            if max(found) < LEAST:
                return None
        inside = None if found is None else found.inside(*size, SOFT)
        return None if inside is None or inside.size == size else inside

    def targets(self, view: View) -> Targets:
        """Camera, frame and flare-free frame of a view, without the borders."""
        camera, inside = self.camera(view), self.inside
        if inside is not None:
            camera = camera.cropped(inside.left, inside.top, *inside.size)
        return Targets(camera, self.frame(view), self.removed(view))

    def frame(self, view: View) -> Tensor:
        """The frame as filmed, without the borders."""
        pixels = self._display(view, "frame", self.capture.frame)
        if pixels is None:
            raise CaptureError(f"{self.capture.folder} has no frame {view.name}.")
        return pixels

    def removed(self, view: View) -> Tensor | None:
        """The frame without flare and borders, None where the capture has none."""
        if self.reference == "removed":
            return self._display(view, "removed", self.capture.removed)
        if self.reference == "truth":
            return self._display(view, "truth", self.capture.truth_scene)
        return None

    def _display(self, view: View, kind: str,
                 decode: Callable[[View, tuple[int, int]], Picture | None]) -> Tensor | None:
        stored = self._stored(view, kind, decode)
        if stored is None:
            return None
        if self.inside is not None:
            stored = stored[self.inside.part]
        return torch.from_numpy(stored.astype(np.float32)) / self._codes

    def _stored(self, view: View, kind: str,
                decode: Callable[[View, tuple[int, int]], Picture | None]) -> NDArray[np.uint16] | None:
        """The whole picture, as it is kept; None where there is none."""
        name = f"{kind}/{view.name}"
        stored = self.cache.get(name)
        if stored is None:
            picture = decode(view, self.camera(view).size)
            if picture is None:
                return None
            stored = (picture.display(self.display_white) * self._codes + 0.5).astype(np.uint16)
            self.cache.put(name, stored)
        return stored
