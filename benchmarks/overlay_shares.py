# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of one redraw of the camera view: deformation network, rest of the evaluation, quads, upload, drawing by
level, sum pass.

    python benchmarks/blender.py --shares [--against TREE] [--rounds N] [--no-gpu]
    blender -b --python benchmarks/blender.py -- --shares …     from Blender 5.2 on: the parts on the GPU too

One light of 2,600 Gaussians at 1920 x 1080, with a camera that moves between the redraws. Each part is the fastest of
all its redraws. The GPU is waited for after each of its parts. --against measures another tree, such as an earlier
commit, in the same process, in turns with this one. A Blender that cannot draw on the GPU, as one without a window
below 5.2, gives the parts in numpy.
"""
from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from blender import ROOT, load_module, make_flare

COUNT, SMALLEST, SIZE = 2_600, 0.001, (1920, 1080)
Times = dict[str, float]


class Stopwatch:
    """Seconds of the parts of a redraw, each without the parts that are measured inside it."""

    def __init__(self) -> None:
        self.seconds: Times = {}
        self._inner: list[float] = [0.0]

    @contextlib.contextmanager
    def part(self, name: str, finish: Callable[[], None] = lambda: None) -> Iterator[None]:
        """Measure a block. finish: waits until it is done."""
        self._inner.append(0.0)
        began = time.perf_counter()
        try:
            yield
            finish()
        finally:
            whole = time.perf_counter() - began
            self.seconds[name] = self.seconds.get(name, 0.0) + whole - self._inner.pop()
            self._inner[-1] += whole

    def wrap(self, owner: Any, name: str, label: str, finish: Callable[[], None] = lambda: None) -> None:
        """Measure each call of the function or method `name` of `owner`."""
        inner = getattr(owner, name)

        def call(*values: Any, **named: Any) -> Any:
            with self.part(label, finish):
                return inner(*values, **named)

        setattr(owner, name, call)


def has_gpu_context() -> bool:
    """Return whether this Blender can draw on the GPU."""
    import bpy
    import gpu

    if not bpy.app.background:
        return True
    try:
        gpu.init()  # from Blender 5.2 on
    except (AttributeError, SystemError, RuntimeError):
        return False
    return True


def finish_gpu() -> None:
    """Wait for the GPU: read a pixel of the bound framebuffer."""
    import gpu

    gpu.state.active_framebuffer_get().read_color(0, 0, 1, 1, 4, 0, "FLOAT")


class _MeasuredBatch:
    """A batch of quads whose drawing is measured."""

    def __init__(self, batch: Any, watch: Stopwatch, label: str) -> None:
        self._batch, self._watch, self._label = batch, watch, label

    def draw(self, shader: Any) -> None:
        with self._watch.part(self._label, finish_gpu):
            self._batch.draw(shader)


def measure_tree(tree: Path, flare: Path, count: int, has_gpu: bool) -> Times:
    """Return the fewest seconds of each part of `count` redraws, as the code in `tree` draws."""
    import bpy

    for name in [name for name in sys.modules if name.partition(".")[0] == "fit_flare"]:
        del sys.modules[name]
    addon = load_module("flare_addon", tree)
    if bpy.app.background:
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    addon.register()
    looks, overlay, cameras, network = (load_module(name, tree) for name in (
        "flare_addon.looks", "flare_addon.overlay", "flare_addon.cameras", "core.look.network"))
    scene, watch = bpy.context.scene, Stopwatch()
    scene.camera = camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT"))
    for item in (camera, lamp):
        scene.collection.objects.link(item)
    lamp.location = 0.6, 0.4, -5
    looks.show_look(scene, flare, [lamp])
    bpy.context.view_layer.update()
    core = cameras.core_camera(camera.data, camera.matrix_world, scene.render)
    window = overlay.drawn_region(overlay.CameraFrame(0, 0, *SIZE), SIZE, core)
    watch.wrap(network.Network, "_concatenated_offsets", "deformation network")
    watch.wrap(looks, "place_lights", "places of the lights")
    watch.wrap(overlay, "quads_by_level", "quads")
    if has_gpu:
        _measure_gpu(overlay, watch)
    redraws: dict[str, list[float]] = {}
    for number in range(count + 2):
        camera.location.x = 1e-3 * number  # so that the network is needed again
        bpy.context.view_layer.update()
        watch.seconds.clear()
        _redraw(scene, camera, window, (looks, overlay), watch, has_gpu)
        if number >= 2:  # the first compile shaders and allocate buffers
            for label, seconds in watch.seconds.items():
                redraws.setdefault(label, []).append(seconds)
    addon.unregister()
    for item in (camera, lamp):
        bpy.data.objects.remove(item)
    return {label: min(seconds) for label, seconds in redraws.items()}


def _measure_gpu(overlay: Any, watch: Stopwatch) -> None:
    """Measure upload and drawing of each level."""
    upload, levels = overlay._upload_quads, dict.fromkeys(overlay.LEVELS, 0)

    def measured_upload(vertices: Any) -> _MeasuredBatch:
        divisor = next(divisor for divisor, quads in levels.items() if quads is vertices)
        with watch.part("upload"):
            batch = upload(vertices)
        return _MeasuredBatch(batch, watch, f"drawing, level 1/{divisor}")

    quads_by_level = overlay.quads_by_level

    def remembered_quads(*values: Any) -> Any:
        levels.clear()
        levels.update(quads_by_level(*values))
        return dict(levels)

    overlay._upload_quads, overlay.quads_by_level = measured_upload, remembered_quads


def _redraw(scene: Any, camera: Any, window: Any, modules: tuple[Any, Any], watch: Stopwatch, has_gpu: bool) -> None:
    """Redraw the flare of a scene once. modules: looks and overlay of the add-on."""
    import bpy

    looks, overlay = modules
    with watch.part("rest of the evaluation"):
        flares = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), camera)
        gaussians = overlay.concatenate(list(flares.values()))
    look = looks.look_of(scene)
    if not has_gpu:
        overlay.quads_by_level(gaussians, window, look, overlay._memory)
        return
    import gpu

    target = gpu.types.GPUOffScreen(*SIZE, format="RGBA16F")

    def finish_target() -> None:
        with target.bind():
            finish_gpu()

    with watch.part("clearing the levels", finish_target):
        levels = overlay.render_levels(gaussians, window, look)
    with watch.part("sum pass", finish_target), target.bind():
        overlay.composite_levels(levels, (0, 0, 1, 1), look.blend, window, np.eye(3))
    target.free()


def table(columns: dict[str, Times]) -> str:
    """Return a Markdown table of the parts: shares of the first tree's redraw, and ms."""
    names = list(dict.fromkeys(label for times in columns.values() for label in times))
    whole = sum(next(iter(columns.values())).values())
    lines = ["| part of a redraw | " + " | ".join(f"{tree}, % | ms" for tree in columns) + " |",
             "| --- |" + " --- | --- |" * len(columns)]
    for label, parts in [*((name, [name]) for name in names), ("all", names)]:
        cells = [sum(times.get(part, 0.0) for part in parts) for times in columns.values()]
        lines.append(f"| {label} | " + " | ".join(f"{100 * cell / whole:.1f} | {1e3 * cell:.2f}"
                                                  for cell in cells) + " |")
    return "\n".join(lines)


def measure(arguments: Sequence[str]) -> None:
    """Measure the trees in turns, and print the table."""
    import bpy

    parser = argparse.ArgumentParser(prog="blender.py --shares")
    parser.add_argument("--against", type=Path, metavar="TREE", help="the tree to compare with")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--redraws", type=int, default=8, help="redraws of a tree in a round")
    parser.add_argument("--no-gpu", action="store_true", help="measure the parts in numpy alone")
    options = parser.parse_args(arguments)
    trees = {} if options.against is None else {"earlier tree": options.against.resolve()}
    trees["this tree"] = ROOT
    columns: dict[str, Times] = {}
    has_gpu = not options.no_gpu and has_gpu_context()
    with tempfile.TemporaryDirectory() as folder:
        flare = make_flare(Path(folder) / "lamp.flare", COUNT, SMALLEST)
        for _ in range(options.rounds):
            for name, tree in trees.items():
                times = measure_tree(tree, flare, options.redraws, has_gpu)
                fastest = columns.setdefault(name, {})
                fastest.update({part: min(seconds, fastest.get(part, seconds)) for part, seconds in times.items()})
    if has_gpu:
        import gpu

        print(f"GPU: {gpu.platform.renderer_get()}, {gpu.platform.backend_type_get()}")
    print(f"Blender {bpy.app.version_string}, numpy {np.__version__}, {os.cpu_count()} cores, {COUNT} Gaussians, "
          f"{SIZE[0]} x {SIZE[1]}; shares of the first tree's redraw")
    print(table(columns))
    sys.stdout.flush()


def main(arguments: Sequence[str]) -> None:
    """Measure in this process, in a window once Blender has opened it, and end the process."""
    import bpy

    def measure_and_leave() -> None:
        status = 1
        try:
            measure(arguments)
            status = 0
        finally:
            if status:
                traceback.print_exc()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)  # Blender as a module may crash at the end of its process

    if bpy.app.background:
        measure_and_leave()
    bpy.app.timers.register(measure_and_leave, first_interval=1.0)
