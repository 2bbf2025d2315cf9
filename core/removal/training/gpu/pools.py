# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes and flares on the card, which processes draw anew all the time: what is learned from is taken out of them at
random, and the oldest gives way to the newest."""
from __future__ import annotations

import multiprocessing
import os
import queue
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....errors import RunError
from ...model.image_formation import GAMMAS
from ...model.recipe import Recipe
from ...synthesis.prescription import Prescription
from ..backgrounds import Backgrounds
from ..flare_bank import Mixed, OwnFlares, SynthesisBank
from ..pairs import Bank
from ..workers import begin_process, end
from .composition import LIGHTS, Flares

BLOCK = 8
"""Scenes that a process draws and sends at a time."""
SCENES, FLARES = 16_000, 4_000
"""Of all shapes together, and flares on the card, at most: some 13 and 11 GB."""
POOLS_SHARE = 0.4
"""Of what is free on a card, for both; the rest is for what the network keeps of an iteration."""
FIRST_SCENES, FIRST_FLARES = 4 * BLOCK, 200
"""Of each shape, and flares, from which on a training begins."""
AHEAD = 4
"""Pieces of work that each process has drawn ahead at most."""
PATIENCE_S = 300.0
"""For the first of them: processes have the program to load."""
LARGEST = 6e4
"""Of light that fits half precision."""
SHAPES = ((1.0, 1.5, 0.35), (0.8, 1.5, 0.2), (1.0, 1.85, 0.15), (1.0, 1 / 1.5, 0.12), (0.75, 1.0, 0.18))
"""Of frames: the long side in parts of the recipe's largest, width by height, and how many are of that shape. Few, so
that a card's work on each is recorded (`recorded.Recorded`)."""


class Shape(NamedTuple):
    """Frames of one size: how many an iteration has of them, and in which share of the iterations."""

    width: int
    height: int
    frames: int
    share: float


class Piece(NamedTuple):
    """What a process has drawn into a slot of its kind's file: scenes of a shape with their gammas, or a flare, with
    `about` (3 LIGHTS + 3,) of it: where its lights are, which there are, its colour."""

    kind: int
    slot: int
    shape: int
    about: NDArray[np.float32]


SCENE, FLARE = 0, 1
"""Kinds of pieces."""


def shapes_of(recipe: Recipe, multiple: int) -> list[Shape]:
    """Of the recipe's last stage, sides multiples of `multiple`."""
    longest = recipe.stages[-1][2]
    found = []
    for part, aspect, share in SHAPES:
        width, height = (max(round(longest * part * side / multiple), 2) * multiple
                         for side in (min(aspect, 1.0), min(1 / aspect, 1.0)))
        found.append(Shape(width, height, max(round(recipe.pixels / (width * height)), 1), share))
    return found


def room(free: int, shapes: Sequence[Shape], canvas: int) -> tuple[int, int]:
    """How many scenes and flares to hold where so many bytes are free."""
    scene = 6 * sum(shape.width * shape.height * shape.share for shape in shapes)
    flare = 18 * canvas**2
    part = min(free * POOLS_SHARE / (SCENES * scene + FLARES * flare), 1.0)
    return max(int(SCENES * part), BLOCK), max(int(FLARES * part), 1)


class Pools:
    """Half precision, on `device`."""

    def __init__(self, shapes: Sequence[Shape], canvas: int, device: torch.device, scenes: int, flares: int) -> None:
        """scenes, flares: how many there is room for."""
        self.shapes, self._device = shapes, device
        blocks = [max(round(scenes * shape.share / BLOCK), 1) for shape in shapes]
        self._scenes = [torch.zeros(count * BLOCK, 3, shape.height, shape.width, dtype=torch.half, device=device)
                        for count, shape in zip(blocks, shapes, strict=True)]
        self._gammas = [torch.ones(len(some), device=device) for some in self._scenes]
        self._flares = torch.zeros(flares, 9, canvas, canvas, dtype=torch.half, device=device)
        self._about = torch.zeros(flares, 3 * LIGHTS + 3, device=device)
        self.scenes_made, self.flares_made = [0] * len(shapes), 0
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    def take_in(self, piece: Piece, drawn: NDArray[np.float16]) -> None:
        """What lies in the piece's slot, in place of the oldest, and beside what the card is at: an iteration that
        looks at one just then has some of both."""
        with torch.cuda.stream(self._stream):  # of None: nothing
            here = torch.from_numpy(drawn)
            if piece.kind == SCENE:
                some = self._scenes[piece.shape]
                first = self.scenes_made[piece.shape] % len(some)
                some[first:first + BLOCK].copy_(here[:some[0].numel() * BLOCK].view(BLOCK, *some.shape[1:]))
                self._gammas[piece.shape][first:first + BLOCK].copy_(torch.from_numpy(piece.about))
            else:
                at = self.flares_made % len(self._flares)
                self._flares[at].copy_(here.view(self._flares.shape[1:]))
                self._about[at].copy_(torch.from_numpy(piece.about))
        if self._stream is not None:
            self._stream.synchronize()  # before the slot is drawn to again
        if piece.kind == SCENE:
            self.scenes_made[piece.shape] += BLOCK
        else:
            self.flares_made += 1

    def begun(self) -> bool:
        """Whether there are enough to begin with."""
        room = [len(some) for some in self._scenes]
        return (all(made >= min(FIRST_SCENES, most) for made, most in zip(self.scenes_made, room, strict=True))
                and self.flares_made >= min(FIRST_FLARES, len(self._flares)))

    def scenes(self, random: np.random.Generator, shape: int) -> tuple[Tensor, Tensor]:
        """As many of a shape as its iterations have: (n, 3, h, w) linear light, and the gammas (n,)."""
        some = self._scenes[shape]
        at = self._any(random, self.shapes[shape].frames, min(self.scenes_made[shape], len(some)))
        return some[at], self._gammas[shape][at]

    def flares(self, random: np.random.Generator, count: int) -> Flares:
        """Any `count` of them."""
        at = self._any(random, count, min(self.flares_made, len(self._flares)))
        lights, there, colour = self._about[at].split((2 * LIGHTS, LIGHTS, 3), 1)
        return Flares(self._flares[at], lights.reshape(count, LIGHTS, 2), there > 0, colour)

    def _any(self, random: np.random.Generator, count: int, there: int) -> Tensor:
        at = torch.from_numpy(random.integers(there, size=count))
        return at.pin_memory().to(self._device, non_blocking=True) if self._stream is not None else at


@contextmanager
def filled(pools: Pools, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
           own: OwnFlares | None, processes: int) -> Iterator[None]:
    """While `processes` draw into the pools, half of them scenes and half flares; there are enough to begin with.
    Raises RunError where none come."""
    spawning = multiprocessing.get_context("spawn")
    drawing = (max(processes // 2, 1), max(processes - processes // 2, 1))
    lengths = (BLOCK * 3 * max(shape.width * shape.height for shape in pools.shapes), 9 * recipe.canvas**2)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        # Files, since containers often have little memory to share; and no pickles, which would cost a copy.
        files = [Path(folder) / str(kind) for kind in (SCENE, FLARE)]
        memories = [np.memmap(path, np.float16, "w+", shape=(AHEAD * count, length))
                    for path, count, length in zip(files, drawing, lengths, strict=True)]
        free, done = [spawning.Queue() for _ in files], spawning.Queue()
        for slots, memory in zip(free, memories, strict=True):
            for slot in range(len(memory)):
                slots.put(slot)
        words = ((backgrounds, pools.shapes), (recipe, lenses, own))
        drawers = [spawning.Process(target=(_draw_scenes, _draw_flares)[kind], daemon=True,
                                    args=((recipe.seed, number), files[kind], memories[kind].shape, free[kind], done,
                                          *words[kind]))
                   for kind in (SCENE, FLARE) for number in range(drawing[kind])]
        ended, enough = threading.Event(), threading.Event()
        filler = threading.Thread(target=_fill, args=(pools, memories, free, done, ended, enough), daemon=True)
        try:
            for process in drawers:
                process.start()
            filler.start()
            _wait_for_enough(enough, drawers)
            yield
        finally:
            ended.set()
            end(drawers)
            filler.join()
            memories.clear()


def _wait_for_enough(enough: threading.Event, drawers: Sequence[BaseProcess]) -> None:
    for _ in range(round(PATIENCE_S / 0.5)):
        if enough.wait(0.5):
            return
        if not all(process.is_alive() for process in drawers):
            break
    raise RunError("The processes that draw pictures for the training ended or drew none; where memory is short, give "
                   "fewer --processes.")


def _fill(pools: Pools, memories: Sequence[Any], free: Sequence[Any], done: Any, ended: threading.Event,
          enough: threading.Event) -> None:
    """What has been drawn into the pools, until the training has ended."""
    while not ended.is_set():
        try:
            piece: Piece = done.get(timeout=0.2)
        except queue.Empty:
            continue
        pools.take_in(piece, memories[piece.kind][piece.slot])
        free[piece.kind].put(piece.slot)
        if pools.begun():
            enough.set()


def _begin_drawing() -> None:
    """A process that draws gives way to the one that keeps a card busy, and has one thread."""
    begin_process()
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(10)


def _draw_scenes(seed: tuple[int, int], path: Path, shape: tuple[int, int], free: Any, done: Any,
                 backgrounds: Backgrounds, shapes: Sequence[Shape]) -> None:
    """Blocks of scenes without end, each of one of the shapes."""
    _begin_drawing()
    memory = np.memmap(path, np.float16, "r+", shape=shape)
    random = np.random.default_rng((*seed, SCENE))
    while True:
        slot = free.get()
        number = int(random.choice(len(shapes), p=[one.share for one in shapes]))
        width, height = shapes[number].width, shapes[number].height
        gammas = random.uniform(*GAMMAS, BLOCK).astype(np.float32)
        block = memory[slot, :BLOCK * 3 * height * width].reshape(BLOCK, 3, height, width)
        for place, gamma in zip(block, gammas, strict=True):
            place[:] = _half(backgrounds.draw(random, width, height, float(gamma)))
        done.put(Piece(SCENE, slot, number, gammas))


def _draw_flares(seed: tuple[int, int], path: Path, shape: tuple[int, int], free: Any, done: Any, recipe: Recipe,
                 lenses: Sequence[Prescription], own: OwnFlares | None) -> None:
    """Flares without end."""
    _begin_drawing()
    memory = np.memmap(path, np.float16, "r+", shape=shape)
    random = np.random.default_rng((*seed, FLARE))
    made = SynthesisBank(int(random.integers(1 << 40)), 1, recipe.canvas, lenses, recipe.coloured, recipe.aspheric)
    bank: Bank = Mixed(made, own, recipe.own_share) if own else made
    size, serial = recipe.canvas, 0
    while True:
        slot = free.get()
        serial += 1
        made.renew_to(serial)
        layers = bank.draw(random)
        canvas = memory[slot].reshape(3, 3, size, size)
        for place, layer in zip(canvas, (layers.rest, layers.glare, layers.light), strict=True):
            place[:] = _half(layer)
        about = np.zeros(3 * LIGHTS + 3, np.float32)
        for light, where in enumerate(layers.lights[:LIGHTS]):
            about[2 * light:2 * light + 2] = where
            about[2 * LIGHTS + light] = 1
        about[3 * LIGHTS:] = layers.colour
        done.put(Piece(FLARE, slot, 0, about))


def _half(picture: NDArray[np.float32]) -> NDArray[np.float16]:
    """(h, w, 3) as (3, h, w), by torch, which takes a tenth of numpy's time."""
    planes = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)
    return np.asarray(planes.clamp(max=LARGEST).half().numpy())
