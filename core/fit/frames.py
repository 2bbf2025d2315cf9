# SPDX-License-Identifier: GPL-3.0-or-later
"""Decodes a capture's frames for a fit, at its working size and in its display encoding, without black borders.

`initialise` and the measurements take them from `Frames.targets`, the trainers from `DeviceFrames.read`.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..capture import Camera, Capture, View
from ..errors import CaptureError
from ..images.borders import MAX_BORDER_LEVEL, MIN_BORDER_LINES, Borders, PictureArea
from ..images.picture import Picture
from .cache import MEMORY, PictureCache

SAMPLED_FRAMES = 12
"""Approximate number of frames in which black borders are measured."""
DEVICE_MEMORY = 4 << 30
"""Bytes of a GPU's memory for frames: 1380 frames of 480x270 with their clean frames, 86 of 1920x1080. On small GPUs it
is a quarter of what is free."""
HOST_MEMORY = 1 << 28
"""Bytes of the CPU's memory for frames as display values: 86 frames of 480x270 with their clean frames."""
BORDER_MARGIN = 1
"""Lines beside a border that resizing mixes with it."""


T = TypeVar("T")


def subsample(items: Sequence[T], number: int) -> Sequence[T]:
    """Return items at equal steps: `number` to 2 `number` - 1 of them, or all if there are fewer than `number`."""
    return items[:: max(len(items) // number, 1)]


def sample_colours(xyz: NDArray[Any], camera: Camera, picture: Tensor) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Return which (n,) of the world points (n, 3) lie on the camera's frame, and the pixels (m, ...) of a picture at
    those m points.

    picture: (height, width, ...) of the camera's size; it may be a mask.
    """
    pixels, depth = camera.project(xyz)
    inside = camera.contains(pixels, depth)
    x, y = np.minimum(pixels[inside].astype(int), np.array(camera.size) - 1).T
    return inside, picture.numpy()[y, x]


def masked(picture: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """Return a picture (height, width, 3) with its target's values where the mask (height, width) is False.

    A loss of the two ignores these pixels, and gives them no gradient.
    """
    return picture if mask is None else torch.where(mask[..., None], picture, target)


class Targets(NamedTuple):
    """Camera of a view with its frame and clean frame, display values (height, width, 3) float32 in 0..`display_white`.
    """

    camera: Camera
    frame: Tensor
    clean: Tensor | None

    def to(self, device: torch.device) -> Targets:
        """Return the targets with their pictures on a device."""
        return Targets(self.camera, self.frame.to(device), None if self.clean is None else self.clean.to(device))


MaskedTargets = tuple[Targets, Tensor | None]
"""Targets, and the mask (height, width) of the pixels that count in the losses; None if all do."""


class Frames:
    """The frames of a capture at the working size, with the clean frame of each where there is one.

    display_white: display value at which they are clipped; above 1 for float frames with light above white.
    clean_source: the source of the clean frames, "removed" (files in removed/), "truth" (exact scene layers, where
    there is no removed/), or "" (none).

    Black borders that all frames share are cut off: they stay with the camera, so the fit would take them for flare.
    """

    def __init__(self, capture: Capture, width: int = 0, memory: int = MEMORY, *,
                 display_white: float = 1.0, frames_only: bool = False, truth: bool = True) -> None:
        """Choose the source of clean frames, and begin with an empty cache.

        width: largest width of the pictures, pixels, 0 for that of the frames. memory: bytes for decoded pictures.
        display_white: largest display value of the frames. frames_only: ignore the capture's clean frames. truth: use
        exact layers where there are no other clean frames.
        """
        self.capture = capture
        self.display_white = display_white
        self._width, self._reduction = width, 1
        # Codes per display value: 16 bit keep the smoothness of linear footage at half the size of float.
        self._codes_per_value = 65535 / display_white
        self.cache = PictureCache(memory)
        self.clean_source = ("" if frames_only else "removed" if capture.has_clean_frames else
                             "truth" if truth and capture.has_truth else "")
        self.picture_area = self._find_picture_area()
        """The area inside the borders; None without borders."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences for the user of the fit."""
        if self.picture_area is None:
            return ()
        (width, height), inside = self.camera(self.capture.views[0]).size, self.picture_area
        return (f"The frames have black borders ({inside.top} and {height - inside.bottom} rows, {inside.left} and "
                f"{width - inside.right} columns of {width}x{height}), which are left out of the fit.",)

    def camera(self, view: View) -> Camera:
        """Return the view's camera at the working size, borders included, never larger than the frame."""
        camera = view.camera
        if self._width and camera.width > self._width:
            camera = camera.scaled(self._width)
        return camera if self._reduction == 1 else camera.scaled(max(round(camera.width / self._reduction), 1))

    def reduced(self, factor: int) -> Frames:
        """Return the same frames at a working size smaller by a factor. Both share one cache."""
        frames = copy(self)
        frames._reduction = factor
        if self.picture_area is not None:
            view = self.capture.views[0]  # all views have one size where there are borders
            (width, height), (small_width, small_height) = self.camera(view).size, frames.camera(view).size
            top, bottom, left, right = self.picture_area
            frames.picture_area = PictureArea(
                math.ceil(top * small_height / height) + BORDER_MARGIN,
                math.floor(bottom * small_height / height) - BORDER_MARGIN,
                math.ceil(left * small_width / width) + BORDER_MARGIN,
                math.floor(right * small_width / width) - BORDER_MARGIN)
        return frames

    def _find_picture_area(self) -> PictureArea | None:
        """Return the area inside the black borders that all frames share, at the working size; None without borders, or
        if frames differ in size.

        Some of the frames are measured; black ones are skipped.
        """
        sizes = {self.camera(view).size for view in self.capture.views}
        if len(sizes) != 1:
            return None
        size, shared_borders = sizes.pop(), None
        for view in subsample(self.capture.views, SAMPLED_FRAMES):
            codes = self._load_codes(view, "frame", self.capture.frame)
            if codes is None or codes.max() <= MAX_BORDER_LEVEL * self._codes_per_value:  # faded out
                continue
            borders = Borders.measure(codes, lambda line: line / self._codes_per_value)
            shared_borders = borders if shared_borders is None else shared_borders.intersection(borders)
            if max(shared_borders) < MIN_BORDER_LINES:
                return None
        inside = None if shared_borders is None else shared_borders.area(*size, BORDER_MARGIN)
        return None if inside is None or inside.size == size else inside

    def targets(self, view: View) -> Targets:
        """Return camera, frame and clean frame of a view, without borders.

        Where the view's mask is black the clean frame equals the frame: no flare is learned there.
        """
        camera, inside = self.camera(view), self.picture_area
        if inside is not None:
            camera = camera.cropped(inside.left, inside.top, *inside.size)
        frame, clean, mask = self.frame(view), self.clean(view), self.mask(view)
        return Targets(camera, frame, clean if clean is None else masked(clean, frame, mask))

    def frame(self, view: View) -> Tensor:
        """Return the frame as filmed, without borders. Raises CaptureError."""
        pixels = self._load_display(view, "frame", self.capture.frame)
        if pixels is None:
            raise CaptureError(f"{self.capture.folder} has no frame {view.name}.")
        return pixels

    def clean(self, view: View) -> Tensor | None:
        """Return the clean frame without borders; None where the capture has none."""
        if self.clean_source == "removed":
            return self._load_display(view, "removed", self.capture.clean_frame)
        if self.clean_source == "truth":
            return self._load_display(view, "truth", self.capture.truth_scene)
        return None

    def mask(self, view: View) -> Tensor | None:
        """Return (height, width), True for pixels of a view that count in the losses, without borders; None if all
        do."""
        if self.capture.mask_path(view) is None:
            return None
        name = self._cache_name("mask", view)
        codes = self.cache.get(name)
        if codes is None:
            mask = self.capture.mask(view, self.camera(view).size)
            assert mask is not None
            codes = mask.astype(np.uint16)
            self.cache.put(name, codes)
        return torch.from_numpy((codes if self.picture_area is None else codes[self.picture_area.slices]) > 0)

    def _cache_name(self, kind: str, view: View) -> str:
        """Return the name in the cache of a view's picture at the working size; kind: its first part."""
        return f"{kind}/{self._reduction}/{view.name}"

    def _load_display(self, view: View, kind: str,
                      decode: Callable[[View, tuple[int, int]], Picture | None]) -> Tensor | None:
        """Return a picture of a view without borders, display values (height, width, 3); None where there is none.

        kind: first part of the picture's name in the cache. decode: reads the picture of a view at a size (width,
        height).
        """
        codes = self._load_codes(view, kind, decode)
        if codes is None:
            return None
        if self.picture_area is not None:
            codes = codes[self.picture_area.slices]
        return torch.from_numpy(codes.astype(np.float32)) / self._codes_per_value

    def _load_codes(self, view: View, kind: str,
                    decode: Callable[[View, tuple[int, int]], Picture | None]) -> NDArray[np.uint16] | None:
        """Return the whole picture as 16 bit codes, from the cache or decoded and cached; None where there is none.

        kind: first part of the picture's name in the cache. decode: reads the picture of a view at a size (width,
        height).
        """
        name = self._cache_name(kind, view)
        codes = self.cache.get(name)
        if codes is None:
            picture = decode(view, self.camera(view).size)
            if picture is None:
                return None
            codes = (picture.display(self.display_white) * self._codes_per_value + 0.5).astype(np.uint16)
            self.cache.put(name, codes)
        return codes


class DeviceFrames:
    """The frames of a fit on its device, as display values. They stay there, up to `memory` bytes; the others are
    converted, and on a GPU copied, each time. Callers must not change them in place.

    A fit shows every view once in a round, in random order, so keeping the latest would keep few that are shown again.
    """

    def __init__(self, frames: Frames, device: torch.device, memory: int | None = None) -> None:
        """Take the frames, none of which is read yet. memory: bytes; None for the device's default."""
        if memory is None:
            memory = HOST_MEMORY
            if device.type == "cuda":
                memory = min(DEVICE_MEMORY, torch.cuda.mem_get_info(device)[0] // 4)
        self.device = device
        self._frames, self._free_bytes = frames, memory
        self._reduced = {1: frames}
        self._stored: dict[tuple[str, int], MaskedTargets] = {}
        """Frames that stay, by the view's name and the reduction."""

    def read(self, view: View, reduction: int = 1) -> MaskedTargets:
        """Return `Frames.targets` and `Frames.mask` of a view, on the device; at the working size divided by
        `reduction`."""
        key = view.name, reduction
        if key in self._stored:
            return self._stored[key]
        if reduction not in self._reduced:
            self._reduced[reduction] = self._frames.reduced(reduction)
        frames = self._reduced[reduction]
        targets, mask = frames.targets(view), frames.mask(view)
        copied = targets.to(self.device), None if mask is None else mask.to(self.device)
        num_bytes = _num_bytes(copied)
        for other in [other for other in self._stored if other[1] != reduction]:
            if num_bytes <= self._free_bytes:
                break
            self._free_bytes += _num_bytes(self._stored.pop(other))  # a size that the fit has left
        if num_bytes <= self._free_bytes:
            self._free_bytes -= num_bytes
            self._stored[key] = copied
        return copied


def _num_bytes(targets: MaskedTargets) -> int:
    """Return the size in memory of pictures and mask, bytes."""
    return sum(part.nbytes for part in (*targets[0][1:], targets[1]) if part is not None)
