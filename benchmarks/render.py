# SPDX-License-Identifier: GPL-3.0-or-later
"""Time the stages of rendering a fitted scene with its flares and write docs/results/rasterizer.md.

    python benchmarks/render.py               a synthetic scene of the paper's size
    python benchmarks/render.py --run FOLDER  the scene and flares of a run; its first light, again, for more lights

The paper (an RTX 4090, 1920x1080, 162,283 scene and 10,965 flare Gaussians): 3.92 ms deformation, 6.86 ms
rasterization, 10.79 ms a frame; 3.9, 6.8 and 11.1 ms deformation for one, two and three lights.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.system.thread_environment import set_thread_environment

set_thread_environment()

import numpy as np
import torch
from torch import Tensor

from benchmarks import report, workload
from benchmarks.report import milliseconds, table
from benchmarks.timing import median_times
from core.capture import Camera
from core.choices import Blend
from core.fit.run import Run
from core.flare.compositing import composite, concatenate
from core.flare.deformation import QueryRange
from core.flare.model import OURS, PAPER, FlareModel, LightFlare
from core.flare.placement import PlaneGaussians, arcs_to_pixels, to_pixels
from core.gaussians import SceneGaussians, kernels, splat
from core.look.form import FlareForm

SIZES = ((1920, 1080), (3840, 2160))
PAPER_SCENE_COUNT, PAPER_FLARE_COUNT = 162_283, 10_965
"""The paper's numbers of scene Gaussians, and of flare Gaussians for each light."""
PAPER_DEFORMATION_MS = {1: 3.9, 2: 6.8, 3: 11.1}
PAPER_FRAME_MS = "10.79"
"""The paper's measurements at 1920x1080: of the deformation by the number of lights, and of a frame with one light."""
STAGES = ("deformation", "projection", "flare raster", "flare raster, mixed", "scene", "composite")


class RenderedScene(NamedTuple):
    """A scene, and a flare for each light, in the order in which lights are added."""

    scene: SceneGaussians
    flares: list[LightFlare]
    positions: Tensor
    blend: Blend
    pose: np.ndarray
    focal: float
    """Focal length of a picture one pixel wide."""


def synthetic_scene(
    form: FlareForm, blend: Blend, scene_count: int = PAPER_SCENE_COUNT, flare_count: int = PAPER_FLARE_COUNT
) -> RenderedScene:
    """Return a scene and three lights in front of the workload's camera, with untrained flares.

    scene_count, flare_count: numbers of scene Gaussians, and of flare Gaussians for each light.
    """
    generator = torch.Generator().manual_seed(0)
    positions = torch.tensor([[0.6, -0.4, 3.0], [-1.0, 0.3, 4.0], [0.2, 0.8, 5.0]], dtype=torch.float64)
    query = QueryRange((-1, -1, -1), (1, 1, 1), (1, 1, 1))
    flares = [LightFlare(form, query, flare_count, generator) for _ in positions]
    scene = SceneGaussians(*workload.make_scene(scene_count))
    return RenderedScene(scene, flares, positions, blend, np.eye(4), 0.5 / workload.TAN_HALF_ANGLE)


def load_run(folder: Path) -> RenderedScene:
    """Return a run's scene and flares, for its capture's first camera with all lights in front of it.

    Where the run has fewer than three lights, its first one is repeated.
    """
    from core.capture import Capture

    run = Run.open(folder)
    if run.flare is None:
        raise SystemExit(f"{folder} has no flare.")
    flares, positions = list(run.flare.model.lights), run.flare.model.positions
    while len(flares) < 3:
        flares, positions = [*flares, flares[0]], torch.cat([positions, positions[:1]])
    for view in Capture.open(run.capture_folder, need_frames=False).views:
        pose = torch.from_numpy(view.camera.world_to_camera)
        if all(light_view.depth > 0 for light_view in run.flare.model.views(pose)):
            camera = view.camera
            return RenderedScene(
                run.scene, flares, positions, run.flare.blend, camera.world_to_camera, camera.fx / camera.width
            )
    raise SystemExit(f"No camera of {run.capture_folder} has all lights in front of it.")


def stage_functions(
    rendered: RenderedScene, lights: int, width: int, height: int, kernel_set: str, device: str
) -> dict[str, Callable[[], object]]:
    """Return each of STAGES of a frame as a function to time; the first `lights` lights have flares."""
    focal = rendered.focal * width
    camera = Camera(width, height, focal, focal, width / 2, height / 2, rendered.pose)
    pose = torch.from_numpy(camera.world_to_camera)
    intrinsics = torch.from_numpy(camera.intrinsics).float().to(device)
    model = FlareModel([str(i) for i in range(lights)], rendered.positions[:lights], rendered.flares[:lights])
    scene = rendered.scene.to(device)

    def evaluate_flares() -> PlaneGaussians:
        gaussians = concatenate(model(pose))
        assert gaussians is not None
        return PlaneGaussians(*(None if values is None else values.to(device) for values in gaussians))

    def flare_raster(resolution: str) -> Callable[[], object]:
        return lambda: splat(
            *pixel_gaussians, flare.opacities, flare.colours, width, height, rings=flare.rings, arcs=arcs,
            blend=rendered.blend, resolution=resolution, kernels=kernel_set,  # type: ignore[arg-type]
        )  # fmt: skip

    def render_scene() -> Tensor:
        return scene.render(camera, kernels=kernel_set, depth=False).colour  # type: ignore[arg-type]

    flare = evaluate_flares()
    pixel_gaussians = to_pixels(flare, intrinsics)
    arcs = None if flare.arcs is None else arcs_to_pixels(flare.arcs, pixel_gaussians[1], intrinsics)
    # What `composite` is timed on; rings and arcs do not change its time.
    scene_colour, flare_splats = render_scene(), splat(
        *pixel_gaussians, flare.opacities, flare.colours, width, height, blend=rendered.blend, kernels=kernel_set  # type: ignore[arg-type]
    )
    functions: tuple[Callable[[], object], ...] = (
        evaluate_flares, lambda: to_pixels(flare, intrinsics), flare_raster("full"), flare_raster("mixed"),
        render_scene, lambda: composite(scene_colour, flare_splats, rendered.blend),
    )  # fmt: skip
    return dict(zip(STAGES, functions, strict=True))


def stage_table(rendered: RenderedScene, kernel_set: str, device: str, rounds: int) -> str:
    """Return the table of the stages of a frame; a frame's time is their sum, with one of the two flare rasters."""
    rows = []
    for width, height in SIZES:
        for lights in (1, 2, 3):
            times = median_times(stage_functions(rendered, lights, width, height, kernel_set, device), rounds)
            shared = sum(times[stage] for stage in ("deformation", "projection", "scene", "composite"))
            full, mixed = shared + times["flare raster"], shared + times["flare raster, mixed"]
            paper = ("–", "–")
            if width == 1920:
                paper = (str(PAPER_DEFORMATION_MS[lights]), PAPER_FRAME_MS if lights == 1 else "–")
            cells = [milliseconds(seconds) for seconds in (*times.values(), full, mixed)]
            rows.append([f"{width}x{height}, {lights}", *cells, f"{1 / mixed:.1f}", *paper])
    head = ["ms; picture, lights", *STAGES, "frame", "frame, mixed", "frames/s, mixed"]
    return table([*head, "paper's deformation (RTX 4090)", "paper's frame"], rows)


def main() -> None:
    """Time the stages and write the table."""
    parser = argparse.ArgumentParser(description="Frames per second of a fitted scene, and the time of each stage.")
    parser.add_argument("--run", type=Path, help="folder of a run; a synthetic scene without it")
    parser.add_argument("--form", choices=("paper", "ours"), default="paper", help="of the synthetic flares")
    parser.add_argument("--blend", choices=("over", "add"), default="over", help="of the synthetic flares")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--kernels", default="auto", choices=["auto", *kernels.MODULES])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=report.RESULTS / "rasterizer.md")
    args = parser.parse_args()
    form = PAPER if args.form == "paper" else OURS
    rendered = load_run(args.run) if args.run else synthetic_scene(form, args.blend)
    conditions = report.conditions()
    with torch.no_grad():
        text = stage_table(rendered, args.kernels, args.device, args.rounds)
    description = (
        f"{len(rendered.scene):,} scene Gaussians, {rendered.flares[0].count:,} for each light, "
        f"blend {rendered.blend}, "
        f"{'a run' if args.run else f'synthetic, untrained flares of the form {args.form!r}'}, "
        f"on {args.device.upper()}, {torch.get_num_threads()} threads. Scene: projection, sorting and raster."
    )
    name = "a run" if args.run else f"{args.form}, {args.blend}"
    text = f"## Rendering: {name}\n\n{description}\n\n{text}\n\n{conditions}"
    report.write_section(args.out, f"render {name}", text)
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
