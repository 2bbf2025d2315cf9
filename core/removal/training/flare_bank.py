# SPDX-License-Identifier: GPL-3.0-or-later
"""Banks that flares are drawn from in training: synthesised ones, renewed as the training goes, and the user's own.

The user's folders follow the layout that Flare7K++ made common:

    Scattering_Flare/Compound_Flare/   flares on black, with their lights
    Scattering_Flare/Light_Source/     the same names: the light alone (optional)
    Reflective_Flare/                  ghosts on black

or are any folder of pictures on black, image sequences, or videos (stock flares).
"""
from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import FrameError, SettingsError
from ...images.listing import SUFFIXES
from ...images.plates import read_plate
from ...images.read import read_picture
from ...images.video import VIDEOS, Video, is_video
from ...optics.prescription import Prescription
from ..synthesis.flare import add_aspheric_ghosts, synthesise_flare
from .pairs import WHITE, FlareLayers, FlareSource

Random = np.random.Generator
PROBED_FLARES = 50
"""Approximate number of the user's flares that are read before a training, to report unreadable ones."""
MIN_LIGHT_LEVEL = 0.3
"""Linear light above which a picture of a light shows one."""
MAX_UNREADABLE_DRAWS = 20
"""Number of successive unreadable flares of the user after which the training fails."""


class SynthesisBank:
    """`count` synthesised flares, each made when it is first drawn; `renew` replaces the oldest.

    The content is a function of the seed and of how far the bank was renewed, so a resumed training sees the same
    flares. The bank has parts, and `draw` uses one of them at a time.
    """

    def __init__(self, seed: int, count: int, size: int, lenses: Sequence[Prescription], coloured_share: float = 0,
                 aspheric_share: float = 0, part_count: int = 1) -> None:
        """Make an empty bank; flares are synthesised when they are drawn.

        count: number of flares. size: side of the canvas, pixels. part_count: number of parts of the bank.

        coloured_share: share of flares whose lights have a saturated colour (traffic lights, tail lamps, neon).
        aspheric_share: share of flares that also get the ghosts of moulded lenses. Both apply to every flare class.
        """
        self._seed, self._size, self._lenses = seed, size, lenses
        self._coloured_share, self._aspheric_share = coloured_share, aspheric_share
        self._entries: list[tuple[int, FlareLayers] | None] = [None] * count
        self._end_serial, self._part, self._part_count = count, 0, min(part_count, count)

    def __len__(self) -> int:
        return len(self._entries)

    def renew(self, end_serial: int, part: int = 0) -> None:
        """Make the bank hold the flares of the `count` serial numbers below `end_serial`, and draw from `part` (modulo
        the number of parts)."""
        self._end_serial, self._part = end_serial, part % self._part_count

    def draw(self, random: Random) -> FlareLayers:
        """Return a random flare of the current part."""
        slots = range(self._part, len(self._entries), self._part_count)
        slot = slots[int(random.integers(len(slots)))]
        # The greatest serial number below the end whose remainder by the bank's size is this slot.
        serial = self._end_serial - 1 - (self._end_serial - 1 - slot) % len(self._entries)
        entry = self._entries[slot]
        if entry is None or entry[0] != serial:
            entry = self._entries[slot] = serial, self._synthesise(serial)
        layers = entry[1]
        return layers._replace(rest=_to_float32(layers.rest), glow=_to_float32(layers.glow),
                               light=_to_float32(layers.light))

    def _synthesise(self, serial: int) -> FlareLayers:
        """Synthesise the flare of a serial number, in half precision, by chance coloured or with ghosts of aspheres."""
        synthesised = synthesise_flare((self._seed, serial), self._size, self._lenses)
        random = np.random.default_rng((self._seed, serial, 2))
        colour = draw_saturated_colour(random) if random.random() < self._coloured_share else WHITE
        if random.random() < self._aspheric_share:
            synthesised = add_aspheric_ghosts(synthesised, (self._seed, serial, 3))
        rest, glow, light = (np.minimum(layer, 6e4).astype(np.float16)
                             for layer in (synthesised.rest, synthesised.glow, synthesised.light))
        return FlareLayers(rest, glow, light, synthesised.lights, colour)


def draw_saturated_colour(random: Random) -> NDArray[np.float32]:
    """Return (3,), the colour of a saturated light: one channel 1, little in one or both of the others."""
    low, middle = np.sort(random.uniform(0, 1, 2) ** 2)
    return random.permutation(np.array([1, middle, low * 0.3], np.float32))


def _to_float32(half: NDArray[Any]) -> NDArray[np.float32]:
    """Convert float16 to float32 by torch, in a tenth of numpy's time."""
    single: NDArray[np.float32] = torch.from_numpy(half).float().numpy()
    return single


class SingleFlareBank:
    """A bank of flares of one class, for evaluation and tests; a flare is a function of the seed and of the generator
    it is drawn with."""

    def __init__(self, seed: Sequence[int], size: int, lenses: Sequence[Prescription], kind: str,
                 colour: NDArray[np.float32] = WHITE) -> None:
        self._seed, self._size, self._lenses, self._kind, self._colour = tuple(seed), size, lenses, kind, colour

    def draw(self, random: Random) -> FlareLayers:
        """Return the flare that `random` selects."""
        flares = synthesise_flare((*self._seed, int(random.integers(1 << 30))), self._size, self._lenses, self._kind)
        return FlareLayers(flares.rest, flares.glow, flares.light, flares.lights, self._colour)


class UserFlares:
    """The user's flare layers, as pictures or video frames, read when they are drawn."""

    def __init__(self, folder: Path | str, size: int) -> None:
        """List the flares below a folder, and try to read some. size: side of the canvas, pixels. Raises SettingsError
        where the folder holds neither pictures nor videos, or none that can be read."""
        folder = Path(folder)
        # Keyed by the parent of Light_Source/ too: another set of flares may have the same names.
        light_paths = {(path.parent.parent, path.stem): path for path in folder.glob("**/Light_Source/*")
                       if path.suffix.lower() in SUFFIXES}
        self._size = size
        self._files: list[tuple[Path, Path | None]] = []  # the flare, and its light alone if there is a picture of it
        for path in sorted(folder.rglob("*")):
            if "Light_Source" in path.parts or path.suffix.lower() not in SUFFIXES | VIDEOS:
                continue
            if not path.is_file() or path.name.startswith("."):
                continue
            self._files.append((path, light_paths.get((path.parent.parent, path.stem))))
        if not self._files:
            raise SettingsError(f"{folder} holds no flare layers; give pictures or videos of flares on black.")
        self.unreadable: list[str] = []
        """A sentence about each unreadable file among the about PROBED_FLARES that are checked."""
        self._drop_unreadable()
        if not self._files:
            raise SettingsError(f"None of the flares in {folder} can be read; {self.unreadable[0]}")
        folders_with_lights = {folder_of_light for folder_of_light, _ in light_paths}
        self.missing_light = [path for path, light in self._files
                              if light is None and path.parent.parent in folders_with_lights]
        """Flares without a light's picture in a folder whose other flares have one: their lights count as flare."""

    def __len__(self) -> int:
        return len(self._files)

    def _drop_unreadable(self) -> None:
        """Try about PROBED_FLARES files, evenly over the list; drop and report those that cannot be read."""
        for file in self._files[:: max(len(self._files) // PROBED_FLARES, 1)]:
            try:
                self._read(file, np.random.default_rng(0))
            except FrameError as problem:
                self.unreadable.append(str(problem))
                self._files.remove(file)

    def draw(self, random: Random) -> FlareLayers:
        """Return a random layer; the middle of its picture is taken as the principal point.

        Unreadable files are skipped, so that one does not end a long training. Raises FrameError after
        MAX_UNREADABLE_DRAWS in succession.
        """
        for _ in range(MAX_UNREADABLE_DRAWS - 1):
            with contextlib.suppress(FrameError):
                return self._draw_layers(random)
        return self._draw_layers(random)

    def _draw_layers(self, random: Random) -> FlareLayers:
        """Return the layers of a random file; its light is placed where the picture of the light is brightest.

        All but the light is `rest`: the pictures do not separate the glow.
        """
        file = self._files[int(random.integers(len(self._files)))]
        flare, light = map(self._fit_to_canvas, self._read(file, random))
        light = np.minimum(light, flare)
        lights: tuple[tuple[float, float], ...] = ()
        if float(light.max()) > MIN_LIGHT_LEVEL:
            y, x = np.unravel_index(int(light.sum(-1).argmax()), light.shape[:2])
            lights = (((float(x) + 0.5) / self._size * 2 - 1, (float(y) + 0.5) / self._size * 2 - 1),)
        # Pictures clip a light at white; in the scene it is brighter.
        return FlareLayers(flare - light, np.zeros_like(flare), light * 4, lights)

    @staticmethod
    def _read(file: tuple[Path, Path | None], random: Random) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the linear light (h, w, 3) of a flare, or of a random frame if it is a video, and that of the light
        alone, 0 without a picture of it. Raises FrameError."""
        path, light_path = file
        flare = _read_random_frame(path, random)
        return flare, np.zeros_like(flare) if light_path is None else _read_linear(light_path)

    def _fit_to_canvas(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a picture on the canvas (size, size, 3), black beside it: scaled so that its diagonal is the canvas'
        side, and centred."""
        import cv2

        height, width = pixels.shape[:2]
        scale = self._size / float(np.hypot(height, width))
        size = (max(round(width * scale), 1), max(round(height * scale), 1))
        scaled = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        canvas = np.zeros((self._size, self._size, 3), np.float32)
        y, x = (self._size - size[1]) // 2, (self._size - size[0]) // 2
        canvas[y:y + size[1], x:x + size[0]] = np.maximum(scaled, 0)
        return canvas


def _read_linear(path: Path) -> NDArray[np.float32]:
    """Return a picture's linear light (h, w, 3), over black where it is transparent."""
    light = read_picture(path).linear()
    # An EXR is premultiplied, so it is over black already.
    alpha = None if path.suffix.lower() == ".exr" else read_plate(path).straight_alpha
    return light if alpha is None else np.asarray(light * alpha[..., None], np.float32)


def _read_random_frame(path: Path, random: Random) -> NDArray[np.float32]:
    """Return the linear light (h, w, 3) of a picture, or of a random frame of a video. Raises FrameError."""
    if not is_video(path):
        return _read_linear(path)
    with Video(path) as clip:
        clip.seek(int(random.integers(max(clip.estimated_length, 1))))
        frame = next(iter(clip), None)
    if frame is None:  # past the end: the header of a file with longer sound claims more frames than it has
        with Video(path) as clip:
            frame = next(iter(clip), None)
    if frame is None:
        raise FrameError(f"{path} cannot be read as a video; convert it to pictures.")
    light, alpha = frame.picture().linear(), frame.straight_alpha()
    return np.maximum(light if alpha is None else light * alpha[..., None], 0)


class MixedBank:
    """A bank that draws a share of its flares from the user's bank, and the others from a synthesised one."""

    def __init__(self, synthesised: FlareSource, user_flares: FlareSource, share: float) -> None:
        self._synthesised, self._user_flares, self._share = synthesised, user_flares, share

    def draw(self, random: Random) -> FlareLayers:
        """Return a flare of either source."""
        return (self._user_flares if random.random() < self._share else self._synthesised).draw(random)
