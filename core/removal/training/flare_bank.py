# SPDX-License-Identifier: GPL-3.0-or-later
"""Flares for training: a bank of synthesised ones that is renewed as training goes, and the user's own.

The user's folders follow the layout that Flare7K++ made common:

    Scattering_Flare/Compound_Flare/   flares on black, the light in them
    Scattering_Flare/Light_Source/     the same names: the light alone (optional)
    Reflective_Flare/                  ghosts on black

or are any folder of pictures on black, image sequences, or video clips (stock flares).
"""
from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...colour.srgb import linear_from_srgb
from ...errors import FrameError, SettingsError
from ...images.listing import SUFFIXES
from ...images.plates import read_plate
from ...images.read import read_picture
from ...images.video import VIDEOS, Video, displayed, is_video
from ...thinning import thinned
from ..synthesis.flare import flare, through_aspheres
from ..synthesis.prescription import Prescription
from .pairs import WHITE, Bank, Layers

Random = np.random.Generator
LOOKED_AT = 50
"""About as many of the user's flares are read before a training, to tell of those that cannot be."""
MOST_UNREADABLE = 20
"""Of the user's flares drawn one after the other; a folder of nothing else is told of."""


class SynthesisBank:
    """`count` flares of the seed, each made when it is first drawn; `renew_to` replaces the oldest, so that none is
    seen for ever.

    What a bank holds is a function of the seed and of how far it was renewed: a resumed training sees the same flares.
    Of its parts one is at hand at a time, in turn. A share `coloured` are of lights of one colour (traffic lights, tail
    lamps, neon), and a share `aspheric` have the ghosts of moulded lenses too, neither of which any class of flares
    has.
    """

    def __init__(self, seed: int, count: int, size: int, lenses: Sequence[Prescription], coloured: float = 0,
                 aspheric: float = 0, turns: int = 1) -> None:
        """turns: how many parts there are."""
        self._seed, self._size, self._lenses = seed, size, lenses
        self._coloured, self._aspheric = coloured, aspheric
        self._made: list[tuple[int, Layers] | None] = [None] * count
        self._end, self._turn, self._turns = count, 0, min(turns, count)

    def __len__(self) -> int:
        return len(self._made)

    def renew_to(self, end: int, turn: int = 0) -> None:
        """Hold the flares of the `count` serial numbers below `end`, and draw from the part whose turn it is."""
        self._end, self._turn = end, turn % self._turns

    def draw(self, random: Random) -> Layers:
        """One of the flares that are there."""
        at_hand = range(self._turn, len(self._made), self._turns)
        slot = at_hand[int(random.integers(len(at_hand)))]
        serial = self._end - 1 - (self._end - 1 - slot) % len(self._made)
        made = self._made[slot]
        if made is None or made[0] != serial:
            made = self._made[slot] = serial, self._make(serial)
        layers = made[1]
        return layers._replace(rest=_single(layers.rest), glare=_single(layers.glare), light=_single(layers.light))

    def _make(self, serial: int) -> Layers:
        one = flare((self._seed, serial), self._size, self._lenses)
        random = np.random.default_rng((self._seed, serial, 2))
        colour = one_colour(random) if random.random() < self._coloured else WHITE
        if random.random() < self._aspheric:
            one = through_aspheres(one, (self._seed, serial, 3))
        rest, glare, light = (np.minimum(layer, 6e4).astype(np.float16) for layer in (one.rest, one.glare, one.light))
        return Layers(rest, glare, light, one.lights, colour)


def one_colour(random: Random) -> NDArray[np.float32]:
    """(3,), of a light of one colour: one channel 1, little in one or both of the others."""
    least, middle = np.sort(random.uniform(0, 1, 2) ** 2)
    return random.permutation(np.array([1, middle, least * 0.3], np.float32))


def _single(half: NDArray[Any]) -> NDArray[np.float32]:
    """float16 as float32; by torch, which takes a tenth of numpy's time."""
    single: NDArray[np.float32] = torch.from_numpy(half).float().numpy()
    return single


class OneFlare:
    """A bank of a single flare of a class, for tests: seed and what it is drawn with make it."""

    def __init__(self, seed: Sequence[int], size: int, lenses: Sequence[Prescription], kind: str,
                 colour: NDArray[np.float32] = WHITE) -> None:
        self._seed, self._size, self._lenses, self._kind, self._colour = tuple(seed), size, lenses, kind, colour

    def draw(self, random: Random) -> Layers:
        """That flare."""
        made = flare((*self._seed, int(random.integers(1 << 30))), self._size, self._lenses, self._kind)
        return Layers(made.rest, made.glare, made.light, made.lights, self._colour)


class OwnFlares:
    """Flare layers that the user has, as pictures or video frames, read when they are drawn."""

    def __init__(self, folder: Path | str, size: int) -> None:
        """Raises SettingsError where the folder holds neither pictures nor clips, or none that can be read."""
        folder = Path(folder)
        # Beside the folder of its flares, as Flare7K++ has them: another set may have flares of the same names.
        lights = {(path.parent.parent, path.stem): path for path in folder.glob("**/Light_Source/*")
                  if path.suffix.lower() in SUFFIXES}
        self._size = size
        self._files: list[tuple[Path, Path | None]] = []
        for path in sorted(folder.rglob("*")):
            if "Light_Source" in path.parts or path.suffix.lower() not in SUFFIXES | VIDEOS:
                continue
            if not path.is_file() or path.name.startswith("."):
                continue
            self._files.append((path, lights.get((path.parent.parent, path.stem))))
        if not self._files:
            raise SettingsError(f"{folder} holds no flare layers; give pictures or clips of flares on black.")
        self.left_out: list[str] = []
        """What is wrong with those that cannot be read, a sentence each, among about `LOOKED_AT` that are looked at."""
        self._leave_out_unreadable()
        if not self._files:
            raise SettingsError(f"None of the flares in {folder} can be read; {self.left_out[0]}")
        compound = {beside for beside, _ in lights}
        self.without_light = [path for path, light in self._files if light is None and path.parent.parent in compound]
        """Those whose folder has the others' lights beside it but not theirs: their lights are taken for flare."""

    def __len__(self) -> int:
        return len(self._files)

    def _leave_out_unreadable(self) -> None:
        for file in thinned(self._files, LOOKED_AT):
            try:
                self._read(file, np.random.default_rng(0))
            except FrameError as problem:
                self.left_out.append(str(problem))
                self._files.remove(file)

    def draw(self, random: Random) -> Layers:
        """A random layer; the middle of the picture is taken for the principal point. One that cannot be read is passed
        over: a training of days does not end for it. Raises FrameError where many cannot."""
        for _ in range(MOST_UNREADABLE - 1):
            with contextlib.suppress(FrameError):
                return self._drawn(random)
        return self._drawn(random)

    def _drawn(self, random: Random) -> Layers:
        flare, light = map(self._square, self._read(self._files[int(random.integers(len(self._files)))], random))
        light = np.minimum(light, flare)
        lights: tuple[tuple[float, float], ...] = ()
        if float(light.max()) > 0.3:
            y, x = np.unravel_index(int(light.sum(-1).argmax()), light.shape[:2])
            lights = (((float(x) + 0.5) / self._size * 2 - 1, (float(y) + 0.5) / self._size * 2 - 1),)
        return Layers(flare - light, np.zeros_like(flare), light * 4, lights)

    @staticmethod
    def _read(file: tuple[Path, Path | None], random: Random) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Linear light of a flare or a random frame of its clip, and of its light. Raises FrameError."""
        path, light_path = file
        flare = _frame_of(path, random)
        return flare, np.zeros_like(flare) if light_path is None else _light_of(light_path)

    def _square(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Reduced so that the diagonal is the canvas' side, and set in its middle."""
        import cv2

        height, width = pixels.shape[:2]
        scale = self._size / float(np.hypot(height, width))
        size = (max(round(width * scale), 1), max(round(height * scale), 1))
        small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        canvas = np.zeros((self._size, self._size, 3), np.float32)
        y, x = (self._size - size[1]) // 2, (self._size - size[0]) // 2
        canvas[y:y + size[1], x:x + size[0]] = np.maximum(small, 0)
        return canvas


def _light_of(path: Path) -> NDArray[np.float32]:
    """Of a picture, linear, over black where it is painted on nothing."""
    light = read_picture(path).linear()
    alpha = None if path.suffix.lower() == ".exr" else read_plate(path).straight_alpha
    return light if alpha is None else np.asarray(light * alpha[..., None], np.float32)


def _frame_of(path: Path, random: Random) -> NDArray[np.float32]:
    """A picture's linear light, or that of a random frame of a clip."""
    if not is_video(path):
        return _light_of(path)
    with Video(path) as clip:
        clip.seek(int(random.integers(max(clip.length, 1))))
        frame = next(iter(clip), None)
    if frame is None:  # past its end: files whose sound is longer claim more frames than they have
        with Video(path) as clip:
            frame = next(iter(clip), None)
    if frame is None:
        raise FrameError(f"{path} is no clip that can be read; convert it to pictures.")
    return np.asarray(linear_from_srgb(displayed(frame)), np.float32)


class Mixed:
    """A share of the user's flares among the synthesised ones."""

    def __init__(self, made: Bank, own: Bank, share: float) -> None:
        self._made, self._own, self._share = made, own, share

    def draw(self, random: Random) -> Layers:
        """From the one or the other."""
        return (self._own if random.random() < self._share else self._made).draw(random)
