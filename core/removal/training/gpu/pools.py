# SPDX-License-Identifier: GPL-3.0-or-later
"""Pools of scenes and flares on the GPU, which CPU processes refill all the time.

Batches are composed of random samples of the pools; the newest item replaces the oldest.
"""
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
from ....optics.prescription import Prescription
from ...model.image_formation import GAMMA_RANGE
from ...model.recipe import Recipe
from ..backgrounds import Backgrounds
from ..flare_bank import MixedBank, SynthesisBank, UserFlares
from ..pairs import FlareSource
from ..workers import initialise_process, kill_processes
from .composition import FLARE_CHANNELS, MAX_LIGHTS, FlareBatch

SCENES_PER_BLOCK = 8
"""Scenes that a process draws and sends at a time."""
MAX_SCENES, MAX_FLARES = 16_000, 4_000
"""Scenes of all shapes together, and flares, on the GPU: some 13 and 11 GB."""
POOL_MEMORY_SHARE = 0.4
"""Share of the GPU's free memory for the pools; the network's activations need the rest."""
MIN_SCENES, MIN_FLARES = 4 * SCENES_PER_BLOCK, 200
"""Scenes of each shape, and flares, from which on a training begins."""
SLOTS_PER_PROCESS = 4
"""Items that each process may have drawn and not yet transferred."""
START_TIMEOUT_S = 300.0
"""How long to wait for the first items; the processes have the program to load."""
MAX_STORED_LIGHT = 6e4
"""Largest light that is stored in half precision."""
BYTES_PER_HALF = 2
METADATA_SIZE = 3 * MAX_LIGHTS + 3
"""Numbers per flare beside its layers: x and y of each light, whether each light exists, and a colour."""
FRAME_SHAPES = ((1.0, 1.5, 0.35), (0.8, 1.5, 0.2), (1.0, 1.85, 0.15), (1.0, 1 / 1.5, 0.12), (0.75, 1.0, 0.18))
"""Of each shape: long side relative to the recipe's largest, width divided by height, share of the iterations. Few,
since a CUDA graph is captured for each (`cuda_graphs.GraphedFunction`)."""


class FrameShape(NamedTuple):
    """Frames of one size: how many an iteration has, and in which share of the iterations."""

    width: int
    height: int
    frames: int
    share: float


class DrawnItem(NamedTuple):
    """A block of scenes of one shape, or a flare, that a process has drawn into a slot of its kind's file.

    kind: SCENE or FLARE. slot: row of the file. shape: index of the scenes' frame shape; 0 for a flare. metadata: the
    scenes' gammas, or METADATA_SIZE numbers of the flare.
    """

    kind: int
    slot: int
    shape: int
    metadata: NDArray[np.float32]


SCENE, FLARE = 0, 1
"""Kinds of items."""


def frame_shapes(recipe: Recipe, multiple: int) -> list[FrameShape]:
    """Return the frame shapes of the recipe's last stage; sides are multiples of `multiple`."""
    longest = recipe.size_stages[-1][2]
    shapes = []
    for relative_side, aspect, share in FRAME_SHAPES:
        width, height = (max(round(longest * relative_side * side / multiple), 2) * multiple
                         for side in (min(aspect, 1.0), min(1 / aspect, 1.0)))
        shapes.append(FrameShape(width, height, max(round(recipe.pixels_per_iteration / (width * height)), 1), share))
    return shapes


def pool_sizes(free_bytes: int, shapes: Sequence[FrameShape], canvas_size: int) -> tuple[int, int]:
    """Return how many scenes and flares fit into the pools' share of the free memory, at most MAX_SCENES and
    MAX_FLARES. canvas_size: side of a flare's canvas, pixels."""
    scene_bytes = 3 * BYTES_PER_HALF * sum(shape.width * shape.height * shape.share for shape in shapes)
    flare_bytes = FLARE_CHANNELS * BYTES_PER_HALF * canvas_size**2
    filled_share = min(free_bytes * POOL_MEMORY_SHARE / (MAX_SCENES * scene_bytes + MAX_FLARES * flare_bytes), 1.0)
    return max(int(MAX_SCENES * filled_share), SCENES_PER_BLOCK), max(int(MAX_FLARES * filled_share), 1)


class Pools:
    """Scenes by shape with their gammas, and flares with their metadata, in half precision on `device`."""

    def __init__(self, shapes: Sequence[FrameShape], canvas_size: int, device: torch.device, scene_count: int,
                 flare_count: int) -> None:
        """Allocate the pools. scene_count, flare_count: how many to hold. Each frame shape has its share of the scenes,
        in whole blocks.

        A flare has FLARE_CHANNELS planes of canvas_size x canvas_size pixels and METADATA_SIZE numbers.
        """
        self.shapes, self._device = shapes, device
        blocks = [max(round(scene_count * shape.share / SCENES_PER_BLOCK), 1) for shape in shapes]
        self._scenes = [torch.zeros(count * SCENES_PER_BLOCK, 3, shape.height, shape.width, dtype=torch.half,
                                    device=device)
                        for count, shape in zip(blocks, shapes, strict=True)]
        self._gammas = [torch.ones(len(pool), device=device) for pool in self._scenes]
        self._flares = torch.zeros(flare_count, FLARE_CHANNELS, canvas_size, canvas_size, dtype=torch.half,
                                   device=device)
        self._flare_metadata = torch.zeros(flare_count, METADATA_SIZE, device=device)
        self.scenes_stored, self.flares_stored = [0] * len(shapes), 0
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    def store(self, item: DrawnItem, values: NDArray[np.float16]) -> None:
        """Copy an item to the GPU in place of the oldest, on a stream of its own.

        values: the numbers in the item's slot. An iteration that samples this place during the copy sees parts of both
        items.
        """
        with torch.cuda.stream(self._stream):  # does nothing for None, on a CPU
            tensor = torch.from_numpy(values)
            if item.kind == SCENE:
                pool = self._scenes[item.shape]
                first_slot = self.scenes_stored[item.shape] % len(pool)
                slots = slice(first_slot, first_slot + SCENES_PER_BLOCK)
                # The slot has room for the largest shape.
                pool[slots].copy_(tensor[:pool[slots].numel()].view(SCENES_PER_BLOCK, *pool.shape[1:]))
                self._gammas[item.shape][slots].copy_(torch.from_numpy(item.metadata))
            else:
                index = self.flares_stored % len(self._flares)
                self._flares[index].copy_(tensor.view(self._flares.shape[1:]))
                self._flare_metadata[index].copy_(torch.from_numpy(item.metadata))
        if self._stream is not None:
            self._stream.synchronize()  # the copy must end before the slot is reused
        if item.kind == SCENE:
            self.scenes_stored[item.shape] += SCENES_PER_BLOCK
        else:
            self.flares_stored += 1

    def is_ready(self) -> bool:
        """Return whether there are enough scenes and flares to begin with."""
        return (all(stored >= min(MIN_SCENES, len(pool))
                    for stored, pool in zip(self.scenes_stored, self._scenes, strict=True))
                and self.flares_stored >= min(MIN_FLARES, len(self._flares)))

    def sample_scenes(self, random: np.random.Generator, shape: int) -> tuple[Tensor, Tensor]:
        """Return random scenes of a shape, as many as its iterations have: (n, 3, h, w) linear light, and the gammas
        (n,)."""
        pool = self._scenes[shape]
        index = self._random_indices(random, self.shapes[shape].frames, min(self.scenes_stored[shape], len(pool)))
        return pool[index], self._gammas[shape][index]

    def sample_flares(self, random: np.random.Generator, count: int) -> FlareBatch:
        """Return `count` random flares."""
        index = self._random_indices(random, count, min(self.flares_stored, len(self._flares)))
        lights, is_light, colour = self._flare_metadata[index].split((2 * MAX_LIGHTS, MAX_LIGHTS, 3), 1)
        return FlareBatch(self._flares[index], lights.reshape(count, MAX_LIGHTS, 2), is_light > 0, colour)

    def _random_indices(self, random: np.random.Generator, count: int, stored: int) -> Tensor:
        index = torch.from_numpy(random.integers(stored, size=count))
        return index.pin_memory().to(self._device, non_blocking=True) if self._stream is not None else index


@contextmanager
def keep_pools_filled(pools: Pools, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                      user_flares: UserFlares | None, process_count: int) -> Iterator[None]:
    """Keep `process_count` processes drawing into the pools within this context: half draw scenes, half flares.

    The context is entered when the pools hold enough to begin with. Raises RunError where the processes draw nothing.
    """
    spawning = multiprocessing.get_context("spawn")
    process_counts = (max(process_count // 2, 1), max(process_count - process_count // 2, 1))
    # numbers in one slot, for scenes and for flares
    lengths = (SCENES_PER_BLOCK * 3 * max(shape.width * shape.height for shape in pools.shapes),
               FLARE_CHANNELS * recipe.canvas_size**2)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        # Items pass through mapped files: containers often have little shared memory, and pickling would cost a copy.
        files = [Path(folder) / str(kind) for kind in (SCENE, FLARE)]
        memories = [np.memmap(path, np.float16, "w+", shape=(SLOTS_PER_PROCESS * count, length))
                    for path, count, length in zip(files, process_counts, lengths, strict=True)]
        free_slots, drawn = [spawning.Queue() for _ in files], spawning.Queue()
        for slots, memory in zip(free_slots, memories, strict=True):
            for slot in range(len(memory)):
                slots.put(slot)
        kind_args = ((backgrounds, pools.shapes), (recipe, lenses, user_flares))
        processes_drawing = [
            spawning.Process(target=(_draw_scenes, _draw_flares)[kind], daemon=True,
                             args=((recipe.seed, number), files[kind], memories[kind].shape, free_slots[kind], drawn,
                                   *kind_args[kind]))
            for kind in (SCENE, FLARE) for number in range(process_counts[kind])]
        ended, ready = threading.Event(), threading.Event()
        transfer_thread = threading.Thread(target=_transfer_drawn, daemon=True,
                                           args=(pools, memories, free_slots, drawn, ended, ready))
        try:
            for process in processes_drawing:
                process.start()
            transfer_thread.start()
            _wait_until_ready(ready, processes_drawing)
            yield
        finally:
            ended.set()
            kill_processes(processes_drawing)
            transfer_thread.join()
            memories.clear()


def _wait_until_ready(ready: threading.Event, drawing: Sequence[BaseProcess]) -> None:
    """Wait for `ready`. Raises RunError where a process ends before that, and after START_TIMEOUT_S."""
    for _ in range(round(START_TIMEOUT_S / 0.5)):
        if ready.wait(0.5):
            return
        if not all(process.is_alive() for process in drawing):
            break
    raise RunError("The processes that draw pictures for the training ended or drew none; if memory is short, give "
                   "fewer --processes.")


def _transfer_drawn(pools: Pools, memories: Sequence[Any], free_slots: Sequence[Any], drawn: Any,
                    ended: threading.Event, ready: threading.Event) -> None:
    """Copy drawn items into the pools until `ended` is set, and set `ready` once the pools hold enough.

    memories, free_slots: by kind of item. drawn: queue of DrawnItems.
    """
    while not ended.is_set():
        try:
            item: DrawnItem = drawn.get(timeout=0.2)
        except queue.Empty:
            continue
        pools.store(item, memories[item.kind][item.slot])
        free_slots[item.kind].put(item.slot)
        if pools.is_ready():
            ready.set()


def _initialise_drawing() -> None:
    """Prepare a process that draws: one thread, and lower priority than the one that feeds the GPU."""
    initialise_process()
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(10)


def _draw_scenes(seed: tuple[int, int], path: Path, memory_shape: tuple[int, int], free_slots: Any, drawn: Any,
                 backgrounds: Backgrounds, shapes: Sequence[FrameShape]) -> None:
    """Draw blocks of scenes into free slots of a memory-mapped file, without end; the main function of a process.

    seed: of the training, and number of the process. path, memory_shape: the file and its shape, a row of float16 for
    each slot: SCENES_PER_BLOCK scenes (3, height, width) of one of the shapes. free_slots: queue of slots to draw into.
    drawn: queue that gets a DrawnItem for each block, with the gammas of its scenes.
    """
    _initialise_drawing()
    memory = np.memmap(path, np.float16, "r+", shape=memory_shape)
    random = np.random.default_rng((*seed, SCENE))
    while True:
        slot = free_slots.get()
        shape_index = int(random.choice(len(shapes), p=[shape.share for shape in shapes]))
        width, height = shapes[shape_index].width, shapes[shape_index].height
        gammas = random.uniform(*GAMMA_RANGE, SCENES_PER_BLOCK).astype(np.float32)
        block = memory[slot, :SCENES_PER_BLOCK * 3 * height * width].reshape(SCENES_PER_BLOCK, 3, height, width)
        for planes, gamma in zip(block, gammas, strict=True):
            planes[:] = _to_half_planes(backgrounds.draw(random, width, height, float(gamma)))
        drawn.put(DrawnItem(SCENE, slot, shape_index, gammas))


def _draw_flares(seed: tuple[int, int], path: Path, memory_shape: tuple[int, int], free_slots: Any, drawn: Any,
                 recipe: Recipe, lenses: Sequence[Prescription], user_flares: UserFlares | None) -> None:
    """Draw random flares into free slots of a memory-mapped file, without end; the main function of a process.

    seed: of the training, and number of the process. path, memory_shape: the file and its shape, a row of float16 for
    each slot: planes (9, size, size) of the layers rest, glow and light. free_slots: queue of slots to draw into.
    drawn: queue that gets a DrawnItem for each flare, with its lights and its colour. user_flares: a share of
    `recipe.user_flare_share` is drawn from them.
    """
    _initialise_drawing()
    memory = np.memmap(path, np.float16, "r+", shape=memory_shape)
    random = np.random.default_rng((*seed, FLARE))
    synthesis_bank = SynthesisBank(int(random.integers(1 << 40)), 1, recipe.canvas_size, lenses, recipe.coloured_share,
                                   recipe.aspheric_share)
    bank: FlareSource = (MixedBank(synthesis_bank, user_flares, recipe.user_flare_share) if user_flares
                         else synthesis_bank)
    size, serial = recipe.canvas_size, 0
    while True:
        slot = free_slots.get()
        serial += 1
        synthesis_bank.renew(serial)
        layers = bank.draw(random)
        canvas = memory[slot].reshape(3, 3, size, size)
        for planes, layer in zip(canvas, (layers.rest, layers.glow, layers.light), strict=True):
            planes[:] = _to_half_planes(layer)
        metadata = np.zeros(METADATA_SIZE, np.float32)
        for light, position in enumerate(layers.lights[:MAX_LIGHTS]):
            metadata[2 * light:2 * light + 2] = position
            metadata[2 * MAX_LIGHTS + light] = 1
        metadata[3 * MAX_LIGHTS:] = layers.colour
        drawn.put(DrawnItem(FLARE, slot, 0, metadata))


def _to_half_planes(picture: NDArray[np.float32]) -> NDArray[np.float16]:
    """Return (h, w, 3) as (3, h, w) float16; by torch, in a tenth of numpy's time."""
    planes = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)
    return np.asarray(planes.clamp(max=MAX_STORED_LIGHT).half().numpy())
