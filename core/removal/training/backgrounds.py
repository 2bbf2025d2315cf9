# SPDX-License-Identifier: GPL-3.0-or-later
"""Clean pictures to lay flares over: photographs, and views into environment maps in true linear light."""
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
from ...images.read import decoded
from ..synthesis.canvas import uniform_log
from . import background_augmentation
from .shared_arrays import Mapped

Part = Literal["train", "test", "all"]
Random = np.random.Generator

PHOTOS = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})
MAPS = frozenset({".hdr", ".exr"})
LEAST_SIDE = 64
"""Pixels of a photograph's shorter side."""
HELD_OUT = 10  # one in so many, by name, is kept for tests


def kept_for_test(name: str) -> bool:
    """Whether a picture or lens of this name is kept out of training: by its name alone, on every machine."""
    return zlib.crc32(name.encode()) % HELD_OUT == 0


@dataclass(frozen=True)
class Backgrounds:
    """Decoded pictures: photos as uint8 (h, w, 3) display values, maps as float16 equirectangular light.

    varied: for training, to which few pictures are to look like many (`variety`). left_out: files in the folders that
    are of no use.
    """

    photos: Sequence[NDArray[np.uint8]]
    maps: Sequence[NDArray[np.float16]]
    varied: bool = False
    left_out: Sequence[Path] = ()

    def draw(self, random: Random, width: int, height: int, gamma: float) -> Pixels:
        """(height, width, 3) linear light: a random window of a random picture, at a random scale; one in eight out
        of focus, so that what is bright and soft is no flare for that alone."""
        def film(random: Random, width: int, height: int) -> Pixels:
            return self._filmed(random, width, height, gamma)

        scene = (background_augmentation.varied(random, film, width, height) if self.varied
                 else film(random, width, height))
        return _defocused(random, scene) if random.random() < 0.125 else scene

    def _filmed(self, random: Random, width: int, height: int, gamma: float) -> Pixels:
        photos = len(self.photos)
        share = len(self.maps) * 3 / (photos + len(self.maps) * 3)
        if random.random() < share:
            return _view(random, self.maps[int(random.integers(len(self.maps)))], width, height)
        return _window(random, self.photos[int(random.integers(photos))], width, height, gamma)


def told_left_out(paths: Sequence[Path]) -> str | None:
    """A sentence for the user about pictures that were left out, where some were."""
    if not paths:
        return None
    return (f"Left out: {len(paths)} of the pictures, {paths[0]} first; each cannot be read, has a side below "
            f"{LEAST_SIDE} pixels, or is .hdr or .exr and not twice as wide as high.")


def read_backgrounds(folders: Iterable[Path | str], part: Part = "all", longest: int = 720, *,
                     varied: bool = False) -> Backgrounds:
    """Read every photograph and environment map below the folders, photographs reduced to `longest` pixels.

    Environment maps are .hdr, or .exr twice as wide as high. Pictures that cannot be read are left out, and told in
    `left_out`. Raises SettingsError for what is no folder, and where nothing is found; EngineError where `varied` ones
    are wanted and OpenCV lacks what varies them.
    """
    import cv2

    if varied:
        background_augmentation.need()
    photos, maps, looked = [], [], []
    left_out: list[Path] = []
    for folder in folders:
        looked.append(str(folder))
        for path in pictures_of(Path(folder), PHOTOS | MAPS, part):
            if path.suffix.lower() in PHOTOS:
                picture = decoded(path, cv2.IMREAD_COLOR)
                if picture is None or min(picture.shape[:2]) < LEAST_SIDE:
                    left_out.append(path)
                    continue
                scale = longest / max(picture.shape[:2])
                if scale < 1:
                    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                photos.append(np.ascontiguousarray(picture[..., ::-1]))
            else:
                light = _environment(path)
                if light is None:
                    left_out.append(path)
                else:
                    maps.append(light)
    if not photos and not maps:
        raise SettingsError(f"There are no pictures in {', '.join(looked) or 'no folder'}; name a folder of clean "
                            "photographs or environment maps.")
    return Backgrounds(photos, maps, varied, left_out)


@contextmanager
def mapped_backgrounds(folders: Iterable[Path | str], part: Part = "all", longest: int = 720, *,
                       varied: bool = False) -> Iterator[Backgrounds]:
    """What `read_backgrounds` reads, out of temporary files: in memory once, however many processes share it. Raises
    RunError too, where they cannot be written."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        found = read_backgrounds(folders, part, longest, varied=varied)
        try:
            photos, maps = Mapped(Path(folder) / "photos", found.photos), Mapped(Path(folder) / "maps", found.maps)
        except OSError as problem:
            raise RunError(f"The clean pictures cannot be laid down in {tempfile.gettempdir()} ({problem.strerror}); "
                           "make room there, or name another folder in TMPDIR.") from problem
        found = Backgrounds(photos, maps, varied, found.left_out)
        try:
            yield found
        finally:
            photos.clear()
            maps.clear()


def pictures_of(folder: Path, suffixes: Set[str], part: Part) -> list[Path]:
    """The files below a folder that have one of these suffixes and are of that part, in order. Raises SettingsError for
    what is no folder."""
    if not folder.is_dir():
        raise SettingsError(f"{folder} is no folder; name one with clean photographs or environment maps.")
    return [path for path in sorted(folder.rglob("*"))
            if path.suffix.lower() in suffixes and path.is_file() and not path.name.startswith(".")
            and (part == "all" or kept_for_test(path.name) == (part == "test"))]


def _environment(path: Path) -> NDArray[np.float16] | None:
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
        found = decoded(path, cv2.IMREAD_UNCHANGED)
        if found is None:
            return None
        light = found[..., ::-1]
    if light.shape[1] != 2 * light.shape[0]:
        return None
    if light.shape[1] > 1024:
        light = cv2.resize(light, (1024, 512), interpolation=cv2.INTER_AREA)
    light = np.clip(light / max(float(np.median(light.mean(-1))) / 0.18, 1e-6), 0, 6e4)
    return light.astype(np.float16)


def _window(random: Random, photo: NDArray[np.uint8], width: int, height: int, gamma: float) -> Pixels:
    import cv2

    h, w = photo.shape[:2]
    fit = min(w / width, h / height)
    scale = fit * random.uniform(0.3, 1.0) if fit > 0.7 else fit
    cw, ch = min(int(width * scale), w), min(int(height * scale), h)
    x, y = int(random.integers(w - cw + 1)), int(random.integers(h - ch + 1))
    how = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
    window = cv2.resize(photo[y:y + ch, x:x + cw], (width, height), interpolation=how)
    if random.random() < 0.5:
        window = window[:, ::-1]
    table = np.power(np.arange(256, dtype=np.float32) / 255, np.float32(gamma))
    return table[window]


def _view(random: Random, light: NDArray[np.float16], width: int, height: int) -> Pixels:
    """A perspective view of 35 to 100 degrees, level but for a few degrees, exposed to a random grey."""
    import cv2

    field = math.tan(math.radians(random.uniform(35, 100)) / 2)
    x = (np.arange(width, dtype=np.float32) + 0.5 - width / 2) / (width / 2) * field
    y = (np.arange(height, dtype=np.float32) + 0.5 - height / 2) / (width / 2) * field
    turn, tilt = random.uniform(0, 2 * math.pi), math.radians(random.normal(0, 15))
    dx, dy = np.meshgrid(x, y)
    up = dy * math.cos(tilt) + math.sin(tilt)
    ahead = math.cos(tilt) - dy * math.sin(tilt)
    rows, columns = light.shape[:2]
    u = ((np.arctan2(dx, ahead) + turn) / (2 * math.pi) % 1) * columns
    v = (np.arctan2(up, np.hypot(dx, ahead)) / math.pi + 0.5) * rows
    seen = cv2.remap(light.astype(np.float32), u.astype(np.float32) - 0.5, v.astype(np.float32) - 0.5,
                     cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    exposure = math.exp(random.normal(math.log(0.18), 0.5)) / max(float(np.median(seen)), 1e-4)
    return np.asarray(seen * min(exposure, 20.0), np.float32)


def _defocused(random: Random, scene: Pixels) -> Pixels:
    """Under a disc of 1 to 8 % of the width."""
    radius = scene.shape[1] * uniform_log(random, 0.005, 0.04)
    reach = math.ceil(radius)
    y, x = np.mgrid[-reach:reach + 1, -reach:reach + 1]
    disc = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1).astype(np.float32)
    return background_augmentation.seen_through(scene, disc)
