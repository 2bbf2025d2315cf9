# SPDX-License-Identifier: GPL-3.0-or-later
"""The pictures a fit looks at, at the size and in the encoding in which it does."""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..capture import Camera, Capture, View
from ..errors import CaptureError
from ..pictures import Picture
from .cache import MEMORY, PictureCache


class Targets(NamedTuple):
    """A view's camera and pictures in display space, (height, width, 3) float32 in 0..`display_white`."""

    camera: Camera
    frame: Tensor
    removed: Tensor | None


class Frames:
    """Frames of a capture at the working size, with the flare-free frame of each where there is one.

    display_white: display value at which they are clipped; above 1 for float frames that hold light above white.
    `reference` says where the flare-free frames come from: "removed" (files in removed/), "truth" (exact
    scene layers, when there is no removed/), or "" (none).
    """

    def __init__(self, capture: Capture, width: int = 0, memory: int = MEMORY, *,
                 display_white: float = 1.0) -> None:
        self.capture = capture
        self.display_white = display_white
        self._width = width
        self.cache = PictureCache(memory)
        self.reference = "removed" if capture.has_removed else "truth" if capture.has_truth else ""

    def camera(self, view: View) -> Camera:
        """The view's camera at the working size: never larger than the frame."""
        camera = view.camera
        if not self._width or camera.width <= self._width:
            return camera
        return camera.scaled(self._width)

    def targets(self, view: View) -> Targets:
        """Camera, frame and flare-free frame of a view."""
        return Targets(self.camera(view), self.frame(view), self.removed(view))

    def frame(self, view: View) -> Tensor:
        """The frame as filmed."""
        pixels = self._display(view, "frame", self.capture.frame)
        if pixels is None:
            raise CaptureError(f"{self.capture.folder} has no frame {view.name}.")
        return pixels

    def removed(self, view: View) -> Tensor | None:
        """The frame without flare, None where the capture has none."""
        if self.reference == "removed":
            return self._display(view, "removed", self.capture.removed)
        if self.reference == "truth":
            return self._display(view, "truth", self.capture.truth_scene)
        return None

    def _display(self, view: View, kind: str,
                 decode: Callable[[View, tuple[int, int]], Picture | None]) -> Tensor | None:
        name = f"{kind}/{view.name}"
        stored = self.cache.get(name)
        if stored is None:
            camera = self.camera(view)
            picture = decode(view, (camera.width, camera.height))
            if picture is None:
                return None
            # 16 bit keeps the smoothness of linear footage at half the size of float.
            stored = (picture.display(self.display_white) * (65535 / self.display_white) + 0.5).astype(np.uint16)
            self.cache.put(name, stored)
        return torch.from_numpy(stored.astype(np.float32)) / (65535 / self.display_white)
