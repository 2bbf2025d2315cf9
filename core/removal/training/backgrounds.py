# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and draws backgrounds, the clean pictures that flares are laid over: photographs, and views into environment
maps in linear light.

`train-removal` and `eval-removal` read them; `pairs` and `gpu.pools` draw from them.
"""
from __future__ import annotations

import math
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ...errors import RunError, SettingsError
from ...images.read import decode_by_opencv
from ..synthesis.canvas import log_uniform
from . import background_augmentation
from .shared_arrays import SharedArrays

Part = Literal["train", "test", "all"]
Random = np.random.Generator

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})
MAP_SUFFIXES = frozenset({".hdr", ".exr"})
MIN_SIDE = 64
"""Pixels of a photograph's shorter side."""
HELD_OUT_ONE_IN = 10
"""One picture or lens in so many, by name, is kept out of training."""


def is_held_out(name: str) -> bool:
    """Return whether a picture or lens of this name is kept out of training: by its name alone, on every machine."""
    return zlib.crc32(name.encode()) % HELD_OUT_ONE_IN == 0


@dataclass(frozen=True)
class Backgrounds:
    """Decoded pictures: photos as uint8 (h, w, 3) display values, maps as float16 equirectangular linear light.

    augmented: change the pictures when they are drawn, so that few look like many (`background_augmentation`).
    unusable: files in the folders that cannot be used.
    """

    photos: Sequence[NDArray[np.uint8]]
    maps: Sequence[NDArray[np.float16]]
    augmented: bool = False
    unusable: Sequence[Path] = ()

    def draw(self, random: Random, width: int, height: int, gamma: float) -> Pixels:
        """Return (height, width, 3) linear light: a random crop of a random picture, at a random scale.

        One in eight is out of focus, so that the network does not take everything bright and soft for flare. gamma: the
        gamma of the photographs' display values.
        """
        def draw_view(random: Random, width: int, height: int) -> Pixels:
            return self._draw_view(random, width, height, gamma)

        scene = (background_augmentation.augment(random, draw_view, width, height) if self.augmented
                 else draw_view(random, width, height))
        return _defocus_by_disc(random, scene) if random.random() < 0.125 else scene

    def _draw_view(self, random: Random, width: int, height: int, gamma: float) -> Pixels:
        """Return (height, width, 3) linear light: a view of a random picture. A map is drawn as often as three
        photographs, since it has views all round. gamma: the gamma of the photographs' display values."""
        photos = len(self.photos)
        share = len(self.maps) * 3 / (photos + len(self.maps) * 3)
        if random.random() < share:
            return _perspective_view(random, self.maps[int(random.integers(len(self.maps)))], width, height)
        return _crop_photo(random, self.photos[int(random.integers(photos))], width, height, gamma)


def describe_unusable(paths: Sequence[Path]) -> str | None:
    """Return a message about pictures that were left out, or None if there are none."""
    if not paths:
        return None
    return (f"Left out: {len(paths)} of the pictures, {paths[0]} first; each cannot be read, has a side below "
            f"{MIN_SIDE} pixels, or is .hdr or .exr and not twice as wide as high.")


def read_backgrounds(folders: Iterable[Path | str], part: Part = "all", max_side: int = 720, *,
                     augmented: bool = False) -> Backgrounds:
    """Read every photograph and environment map below the folders.

    part: pictures for training, held-out ones or all (`is_held_out`). max_side: long side in pixels that larger
    photographs are reduced to. Environment
    maps are .hdr, or .exr twice as wide as high. Pictures that cannot be used are listed in `unusable`.

    Raises SettingsError for a path that is no folder and where no picture is found; EngineError where `augmented` is
    set and OpenCV lacks a module for it.
    """
    if augmented:
        background_augmentation.require_ximgproc()
    photos, maps, searched = [], [], []
    unusable: list[Path] = []
    for folder in folders:
        searched.append(str(folder))
        for path in list_pictures(Path(folder), PHOTO_SUFFIXES | MAP_SUFFIXES, part):
            if path.suffix.lower() in PHOTO_SUFFIXES:
                if (photo := _read_photo(path, max_side)) is not None:
                    photos.append(photo)
                    continue
            elif (light := _read_environment_map(path)) is not None:
                maps.append(light)
                continue
            unusable.append(path)
    if not photos and not maps:
        raise SettingsError(f"There are no pictures in {', '.join(searched) or 'no folder'}; name a folder of clean "
                            "photographs or environment maps.")
    return Backgrounds(photos, maps, augmented, unusable)


@contextmanager
def open_shared_backgrounds(folders: Iterable[Path | str], part: Part = "all", max_side: int = 720, *,
                            augmented: bool = False) -> Iterator[Backgrounds]:
    """Read backgrounds as `read_backgrounds` does, into temporary files that all processes map, so that one copy is in
    memory. Raises also RunError where the files cannot be written."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        backgrounds = read_backgrounds(folders, part, max_side, augmented=augmented)
        try:
            photos = SharedArrays(Path(folder) / "photos", backgrounds.photos)
            maps = SharedArrays(Path(folder) / "maps", backgrounds.maps)
        except OSError as problem:
            raise RunError(f"The clean pictures cannot be written to {tempfile.gettempdir()} ({problem.strerror}); "
                           "free space there, or set TMPDIR to another folder.") from problem
        backgrounds = Backgrounds(photos, maps, augmented, backgrounds.unusable)
        try:
            yield backgrounds
        finally:
            photos.close()
            maps.close()


def list_pictures(folder: Path, suffixes: Set[str], part: Part) -> list[Path]:
    """Return the sorted files below a folder that have one of these suffixes and belong to the part. Raises
    SettingsError for a path that is no folder."""
    if not folder.is_dir():
        raise SettingsError(f"{folder} is no folder; name one with clean photographs or environment maps.")
    return [path for path in sorted(folder.rglob("*"))
            if path.suffix.lower() in suffixes and path.is_file() and not path.name.startswith(".")
            and (part == "all" or is_held_out(path.name) == (part == "test"))]


def _read_photo(path: Path, max_side: int) -> NDArray[np.uint8] | None:
    """Return a photograph, (height, width, 3) display codes, its long side at most `max_side` pixels; None if it is
    unusable."""
    import cv2

    picture = decode_by_opencv(path, cv2.IMREAD_COLOR)
    if picture is None or min(picture.shape[:2]) < MIN_SIDE:
        return None
    scale = max_side / max(picture.shape[:2])
    if scale < 1:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture[..., ::-1])


def _read_environment_map(path: Path) -> NDArray[np.float16] | None:
    """Return an environment map, (height, width, 3) linear light, at most 1024 x 512 pixels, scaled to a median of
    0.18; None if it is unusable."""
    import cv2

    if path.suffix.lower() == ".exr":
        from ...errors import FrameError
        from ...images.exr import read_exr

        try:
            channels = read_exr(path)
        except FrameError:
            return None
        if not all(name in channels for name in "RGB"):
            return None
        light: NDArray[Any] = np.stack([channels[name] for name in "RGB"], -1)
    else:
        pixels = decode_by_opencv(path, cv2.IMREAD_UNCHANGED)
        if pixels is None:
            return None
        light = pixels[..., ::-1]
    if light.shape[1] != 2 * light.shape[0]:
        return None
    if light.shape[1] > 1024:
        light = cv2.resize(light, (1024, 512), interpolation=cv2.INTER_AREA)
    light = np.clip(light / max(float(np.median(light.mean(-1))) / 0.18, 1e-6), 0, 6e4)  # below float16's greatest
    return light.astype(np.float16)


def _crop_photo(random: Random, photo: NDArray[np.uint8], width: int, height: int, gamma: float) -> Pixels:
    """Return a random crop of a photograph, (height, width, 3) linear light, mirrored in half of the cases. gamma:
    the gamma of the photograph's display values."""
    import cv2

    photo_height, photo_width = photo.shape[:2]
    # scale: pixels of the photograph per pixel of the result. A photograph that is much too small is not cropped
    # further.
    fit = min(photo_width / width, photo_height / height)
    scale = fit * random.uniform(0.3, 1.0) if fit > 0.7 else fit
    crop_width, crop_height = min(int(width * scale), photo_width), min(int(height * scale), photo_height)
    x, y = int(random.integers(photo_width - crop_width + 1)), int(random.integers(photo_height - crop_height + 1))
    interpolation = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
    crop = cv2.resize(photo[y:y + crop_height, x:x + crop_width], (width, height), interpolation=interpolation)
    if random.random() < 0.5:
        crop = crop[:, ::-1]
    linear_of_code = np.power(np.arange(256, dtype=np.float32) / 255, np.float32(gamma))
    return linear_of_code[crop]


def _perspective_view(random: Random, light: NDArray[np.float16], width: int, height: int) -> Pixels:
    """Return a perspective view, (height, width, 3) linear light: 35 to 100 degrees wide, pitched by some degrees,
    exposed to a random median about 0.18. light: an equirectangular map, (h, w, 3)."""
    import cv2

    # Directions of the pixels: x to the right, y down, on a plane at a distance of 1.
    half_field = math.tan(math.radians(random.uniform(35, 100)) / 2)
    x = (np.arange(width, dtype=np.float32) + 0.5 - width / 2) / (width / 2) * half_field
    y = (np.arange(height, dtype=np.float32) + 0.5 - height / 2) / (width / 2) * half_field
    yaw, pitch = random.uniform(0, 2 * math.pi), math.radians(random.normal(0, 15))
    right, down_on_plane = np.meshgrid(x, y)
    down = down_on_plane * math.cos(pitch) + math.sin(pitch)
    forward = math.cos(pitch) - down_on_plane * math.sin(pitch)
    rows, columns = light.shape[:2]
    u = ((np.arctan2(right, forward) + yaw) / (2 * math.pi) % 1) * columns
    v = (np.arctan2(down, np.hypot(right, forward)) / math.pi + 0.5) * rows
    pixels = cv2.remap(light.astype(np.float32), u.astype(np.float32) - 0.5, v.astype(np.float32) - 0.5,
                       cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    exposure = math.exp(random.normal(math.log(0.18), 0.5)) / max(float(np.median(pixels)), 1e-4)
    return np.asarray(pixels * min(exposure, 20.0), np.float32)


def _defocus_by_disc(random: Random, scene: Pixels) -> Pixels:
    """Blur by a disc with a diameter of 1 to 8 % of the width."""
    radius = scene.shape[1] * log_uniform(random, 0.005, 0.04)
    reach = math.ceil(radius)
    y, x = np.mgrid[-reach:reach + 1, -reach:reach + 1]
    disc = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1).astype(np.float32)
    return background_augmentation.defocus(scene, disc)
