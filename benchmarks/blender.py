# SPDX-License-Identifier: GPL-3.0-or-later
"""Times of the add-on in Blender: import of a large capture, polling of a fit's events, and the overlay.

    python benchmarks/blender.py                             in a Python that has bpy; prints a table
    python benchmarks/blender.py --shares [--against TREE]   prints the parts of a redraw
    blender [-b] --python benchmarks/blender.py -- ARGUMENTS the same in Blender

Import: 400 cameras, 100,000 points. Events: polled in the window's thread, with 400 cameras in the scene. Overlay: one
light of 2,000 Gaussians at 1920 x 1080, without the drawing on the GPU. Parts of a redraw: see `overlay_shares.py`.
"""
from __future__ import annotations

import importlib
import importlib.util
import json
import os
import struct
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
CAMERAS, POINTS, GAUSSIANS, LEVELS, LAMPS = 400, 100_000, 2_000, 16, 100


def load_module(name: str, tree: Path = ROOT) -> Any:
    """Import the module of this name in a tree, as a part of the package that its run.py registers."""
    spec = importlib.util.spec_from_file_location("run", tree / "headless" / "run.py")
    assert spec is not None
    assert spec.loader is not None
    run = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run)
    return importlib.import_module(f"{run.register_package()}.{name}")


def make_capture(folder: Path, cameras: int = CAMERAS) -> Path:
    """Write a capture: a binary COLMAP model of cameras on a circle, grey frames of 96 x 54, and points."""
    import zlib

    model, images = folder / "sparse" / "0", folder / "images"
    model.mkdir(parents=True)
    images.mkdir()
    # One grey PNG, written by hand: 54 rows, each a filter byte and 96 pixels.
    pixels = zlib.compress(b"".join(b"\0" + b"\x80" * 3 * 96 for _ in range(54)))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 96, 54, 8, 2, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    lens = struct.pack("<Q", 1) + struct.pack("<iiQQ4d", 1, 1, 96, 54, 90.0, 90.0, 47.0, 28.0)
    (model / "cameras.bin").write_bytes(lens)
    records = [struct.pack("<Q", cameras)]
    for number in range(cameras):
        angle = 0.01 * number
        name = f"{number + 1:04d}.png"
        (images / name).write_bytes(png)
        records.append(struct.pack("<i7di", number + 1, np.cos(angle), 0, np.sin(angle), 0, 0, 0, 4, 1) + name.encode()
                       + b"\0" + struct.pack("<Q", 0))
    (model / "images.bin").write_bytes(b"".join(records))
    xyz = np.random.default_rng(0).normal(size=(POINTS, 3))
    points = [struct.pack("<Q", POINTS)]
    points += [struct.pack("<Q3d3BdQ", number, *place, 200, 100, 50, 0.5, 0) for number, place in enumerate(xyz)]
    (model / "points3D.bin").write_bytes(b"".join(points))
    (folder / "lights.json").write_text(json.dumps({"lights": [{"name": "lamp", "xyz": [0.3, -0.2, 1.0]}]}))
    return folder


def make_flare(path: Path, count: int = GAUSSIANS, smallest: float = 0.01) -> Path:
    """Write a .flare of one light with numpy alone: random weights, hash tables with their coarsest level alone.

    count: number of Gaussians. smallest, 0.06: bounds of their standard deviations, normalised coordinates."""
    random = np.random.default_rng(1)
    widths = {"positions": 1, "log_scales": 2, "rotations": 2, "opacity_logits": 1, "sh": 3, "rings": 2}
    arrays = {f"0.gaussians.{name}": random.normal(size=(count, width)) for name, width in widths.items()}
    arrays["0.gaussians.log_scales"] = np.log(random.uniform(smallest, 0.06, (count, 2)))
    arrays["0.gaussians.opacity_logits"] -= 3
    arrays["0.gaussians.rings"] = np.zeros((count, 2))
    arrays["0.gaussians.offsets"], arrays["0.gaussians.latent"] = np.zeros((count, 2)), random.normal(size=(count, 4))
    # features: two for each level of both hash grids. outputs: offsets of all parameters and of the place on the plane.
    features, outputs = 4 * LEVELS, sum(widths.values()) + 2
    shapes = {"view_layer": (128, features), "layers.0": (128, 128), "layers.1": (128, 128), "head": (outputs, 128),
              "correction.0": (128, features), "correction.2": (2, 128)}
    for name, shape in shapes.items():
        arrays[f"0.network.{name}.weight"] = random.normal(size=shape) * 0.02
        arrays[f"0.network.{name}.bias"] = np.zeros(shape[0])
    arrays["0.network.gaussian_layer.weight"] = random.normal(size=(128, 10)) * 0.02
    for grid in ("light_grid", "camera_grid"):
        # The coarsest level, so that the features differ from view to view.
        arrays[f"0.network.{grid}.table.weight.rows"] = np.arange(17**3)
        arrays[f"0.network.{grid}.table.weight.values"] = random.normal(size=(17**3, 2)) * 0.1
    header: dict[str, Any] = {}
    body = b""
    for name, array in arrays.items():
        kind, letters = ("I32", "<i4") if name.endswith(".rows") else ("F32", "<f4")
        data = np.ascontiguousarray(array, letters).tobytes()
        header[name] = {"dtype": kind, "shape": list(array.shape), "data_offsets": [len(body), len(body) + len(data)]}
        body += data
    form = {"line": True, "light_correction": True, "plane_offset": True, "solid": False, "sh_degree": 0,
            "static_offset": True, "rings": True, "latent": 4, "levels": LEVELS}
    query_range = {"camera_low": [-5, -5, -5], "camera_high": [5, 5, 5], "light_high": [0.6, 0.4, 0.7]}
    camera = {"width": 96, "height": 54, "fx": 90.0, "fy": 90.0, "cx": 47.0, "cy": 28.0}
    light = {"name": "lamp", "xyz": [0.3, -0.2, 1.0], "form": form, "range": query_range, "count": count}
    description = {"version": 1, "blend": "add", "camera": camera, "lights": [light]}
    header["__metadata__"] = {"fit_flare": json.dumps(description)}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)  # the tensors are aligned, as in a .flare of a fit
    path.write_bytes(len(text).to_bytes(8, "little") + text + body)
    return path


def time_range(call: Any, repeats: int = 10) -> tuple[float, float]:
    """Return the fastest and the slowest of `repeats` calls, ms."""
    times_ms = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times_ms.append(1e3 * (time.perf_counter() - start))
    return min(times_ms), max(times_ms)


def time_lamp_overlay(looks: Any, overlay: Any, look: Path, window: Any) -> list[str]:
    """Return lines on the overlay of a hundred lamps with one look, with a camera that moves and one that stands.

    A moving camera is timed twice: as the camera view draws it, where lamps take turns within a budget of time, and
    with all lamps exact. For a camera that stands the camera view finds that nothing has changed.

    looks, overlay: modules of the add-on. look: a .flare. window: the region that is drawn.
    """
    import bpy

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene, random = bpy.context.scene, np.random.default_rng(0)
    scene.camera = camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.rotation_euler = (np.pi / 2, 0, 0)
    lamps = [bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "POINT")) for _ in range(LAMPS)]
    for lamp in lamps:
        scene.collection.objects.link(lamp)
        lamp.location = random.uniform(-4, 4), 10, random.uniform(-2, 2)
    looks.show_look(scene, look, lamps, add=True)
    lines = []
    context = SimpleNamespace(view_layer=bpy.context.view_layer, region=None)
    render_levels = overlay.render_levels
    overlay.render_levels = lambda gaussians, window, look, _view: [
        overlay.quads_by_level(gaussians, window, look, overlay._memory)]

    def draw_view(moves: bool) -> None:
        if moves:
            camera.location.x += 0.01
        bpy.context.view_layer.update()
        overlay._render_region(context, scene, camera, window, looks.look_of(scene))

    def draw_exact() -> None:
        camera.location.x += 0.01
        bpy.context.view_layer.update()
        flares = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), camera)
        overlay.quads_by_level(overlay.concatenate(list(flares.values())), window, looks.look_of(scene))

    for state, draw in (("moves", lambda: draw_view(True)), ("moves, exact", draw_exact),
                        ("stands", lambda: draw_view(False))):
        for _ in range(12):  # until a camera that stands has exact flares
            draw()
        fast, slow = time_range(draw, 5)
        lines.append(f"overlay of {LAMPS} lamps with one look, all but the GPU, camera "
                     f"{state}: {fast:.0f} to {slow:.0f} ms")
    overlay.render_levels = render_levels
    return lines


def time_import(importing: Any, capture: Path, kind: str) -> str:
    """Return a line on the import of a capture into an empty file. kind: "each" or "animated" cameras.

    importing: module of the add-on.
    """
    import bpy

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    start = time.perf_counter()
    importing.import_capture(bpy.context.scene, capture, importing.ImportSettings(cameras=kind))
    return f"import of {CAMERAS} cameras ({kind}), {POINTS} points: {time.perf_counter() - start:.2f} s"


def time_events(jobs: Any, run: Path) -> str:
    """Return a line on reading 3,000 events of a fit. jobs: module of the add-on. run: a new folder."""
    run.mkdir()
    event = {"type": "progress", "stage": "fit", "done": 1, "total": 3000, "left_s": 9.0, "figures": {"loss": 0.1}}
    (run / jobs.EVENTS).write_text("".join(json.dumps({**event, "done": number}) + "\n" for number in range(3000)))
    job = jobs.Job("fit", run, jobs.Origin(os.getpid()))
    job._is_alive = lambda: True  # the process that is watched is this one
    fast, slow = time_range(job.poll, 20)
    return f"reading a fit's events, at most {jobs.READ_CHUNK >> 10} kB a time: {fast:.2f} to {slow:.2f} ms"


def time_overlay(looks: Any, overlay: Any, window: Any) -> str:
    """Return a line on the overlay of the scene's flare, with a camera that moves.

    looks, overlay: modules of the add-on. window: the region that is drawn.
    """
    import bpy

    scene, depsgraph = bpy.context.scene, bpy.context.evaluated_depsgraph_get()
    look = looks.look_of(scene)

    def draw_frame() -> None:
        scene.camera.delta_location.x += 1e-4  # so that the network is needed again
        bpy.context.view_layer.update()
        gaussians = overlay.concatenate(list(looks.evaluate_flares(scene, depsgraph, scene.camera).values()))
        overlay.quads_by_level(gaussians, window, look)

    draw_frame()
    fast, slow = time_range(draw_frame, 20)
    count = sum(map(len, looks.evaluate_flares(scene, depsgraph, scene.camera).values()))
    return f"overlay of {count} Gaussians, all but the GPU: {fast:.1f} to {slow:.1f} ms"


def main() -> None:
    """Time the import of a capture, the reading of events, and the overlay, inside Blender."""
    import bpy

    arguments = sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else sys.argv[1:]
    if "--shares" in arguments:
        sys.path.insert(0, str(Path(__file__).parent))
        import overlay_shares

        overlay_shares.main([argument for argument in arguments if argument != "--shares"])
        return
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    load_module("flare_addon").register()
    importing, looks, overlay, cameras, jobs, library = (load_module(f"flare_addon.{name}") for name in (
        "capture.importer", "looks", "overlay", "cameras", "jobs", "library"))
    lines = [f"Blender {bpy.app.version_string}, {os.cpu_count()} cores"]
    with tempfile.TemporaryDirectory() as base:
        folder = Path(base)
        capture, flare = make_capture(folder / "capture"), make_flare(folder / "lamp.flare")
        lines += [time_import(importing, capture, kind) for kind in ("each", "animated")]
        scene = bpy.context.scene
        looks.show_look(scene, flare)
        bpy.context.view_layer.update()
        lines.append(time_events(jobs, folder / "run"))
        bpy.context.view_layer.update()
        camera = cameras.core_camera(scene.camera.data, scene.camera.matrix_world, scene.render)
        window = overlay.drawn_region(overlay.CameraFrame(0, 0, 1920, 1080), (1920, 1080), camera)
        lines.append(time_overlay(looks, overlay, window))
        lines += time_lamp_overlay(looks, overlay, library.BOX / "Anamorphic Blue.flare", window)
    print("\n".join(lines))
    sys.stdout.flush()
    os._exit(0)  # Blender as a module may crash at the end of its process


if __name__ == "__main__":
    main()
