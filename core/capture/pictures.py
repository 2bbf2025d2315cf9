# SPDX-License-Identifier: GPL-3.0-or-later
"""Decodes the pictures of a capture's views, turned, undistorted and resized, and keeps the last ones in memory."""
from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colour import ColourSpace
from ..errors import FrameError
from ..images.exr import is_exr
from ..images.formats.exif import apply_orientation, read_exif
from ..images.picture import Picture, same_aspect
from ..images.plates import read_plate
from ..images.read import read_picture
from .lens import undistort_picture

if TYPE_CHECKING:
    from .capture import View

MAX_CACHED_MAPS = 4
"""Number of undistortion maps in memory."""


def read_mask(path: Path) -> Picture:
    """Read a mask as 0 and 1: 1 where it is light and opaque. A mask painted in black on transparent ground is 1 where
    it is transparent. Raises FrameError."""
    values = read_picture(path).display()
    alpha = None if is_exr(path) else read_plate(path).straight_alpha
    if alpha is not None:
        visible = values * alpha[..., None]
        values = visible if visible.max() > 0 else np.repeat(np.float32(1) - alpha[..., None], 3, -1)
    # Relative to the largest value, so that a mask with values 0 and 1 of 255 is one too.
    return Picture((values / max(float(values.max()), 1e-6) > 0.5).astype(np.float32), "linear")


class PictureCache:
    """Decoded, undistorted, resized pictures; evicts the least recently used above `capacity`, bytes."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._used = 0
        self._pictures: OrderedDict[tuple[Path, tuple[int, int]], Picture] = OrderedDict()
        self._maps: OrderedDict[tuple[int, tuple[int, int], float], Any] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, path: Path, view: View, size: tuple[int, int], space: ColourSpace | None = None) -> Picture:
        """Return a view's picture at `size` (width, height), over black where it is transparent; read-only pixels.

        space: colour space in which the file is read, in place of the one that it declares. Raises FrameError.
        """
        key = (path, size)
        with self._lock:
            if key in self._pictures:
                self._pictures.move_to_end(key)
                return self._pictures[key]
        picture = self.upright(read_picture(path, space=space, over_black=True), view, path)
        if view.lens is not None:
            picture = self.undistorted(picture, view, path)
        elif not same_aspect(picture.size, view.camera.size):
            raise FrameError(f"{path} is {picture.size[0]} x {picture.size[1]} pixels, not "
                             f"{view.camera.width} x {view.camera.height}.")
        picture = picture.resized(*size)
        picture.pixels.flags.writeable = False
        self._store(key, picture)
        return picture

    def _store(self, key: tuple[Path, tuple[int, int]], picture: Picture) -> None:
        """Keep a picture, and evict the least recently used ones above the capacity."""
        with self._lock:
            if key in self._pictures or picture.pixels.nbytes > self._capacity:
                return
            self._pictures[key] = picture
            self._used += picture.pixels.nbytes
            while self._used > self._capacity:
                _, old = self._pictures.popitem(last=False)
                self._used -= old.pixels.nbytes

    def undistorted(self, picture: Picture, view: View, path: Path) -> Picture:
        """Undistort a picture of a view whose lens has distortion. Raises FrameError for another aspect.

        The maps of the last MAX_CACHED_MAPS lenses and sizes are cached: most frames of a capture share a lens.
        """
        assert view.lens is not None
        if not same_aspect(picture.size, view.camera.size):
            raise FrameError(f"{path} is {picture.size[0]} x {picture.size[1]} pixels, not "
                             f"{view.camera.width} x {view.camera.height}.")
        camera = view.camera.scaled(*picture.size)
        key = (id(view.lens), picture.size, camera.fx)
        with self._lock:
            maps = self._maps.get(key)
        if maps is None:
            maps = view.lens.undistortion_maps(camera)
            with self._lock:
                self._maps[key] = maps
                while len(self._maps) > MAX_CACHED_MAPS:
                    self._maps.popitem(last=False)
        return undistort_picture(picture, maps)

    def upright(self, picture: Picture, view: View, path: Path) -> Picture:
        """Turn a picture of a view's file by its Exif orientation where the view was solved from pixels as shown."""
        orientation = read_exif(path)[0] if view.upright else 1
        return picture if orientation == 1 else replace(picture, pixels=apply_orientation(picture.pixels, orientation))
