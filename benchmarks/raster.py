# SPDX-License-Identifier: GPL-3.0-or-later
"""Times the kernel sets on the workload of `workload.py` and writes docs/results/rasterizer.md.

    python benchmarks/raster.py                 all of it, some minutes on two cores
    python benchmarks/raster.py --quick         fewer rounds
    python benchmarks/raster.py --only raster curve
    python benchmarks/raster.py --rasterizer mine=package.module:render
    python benchmarks/raster.py --only peer --opensplat FOLDER

`--rasterizer` adds a column for another rasterizer: a function of (means, quats, scales, opacities, sh,
world_to_camera, intrinsics, width, height) that returns the colour (h, w, 3), differentiable. gsplat has a column if it
is installed and there is a GPU. OpenSplat is built from a checkout (`opensplat.py`).

Times include all that a user calls: projection, spherical harmonics of degree 3, sorting and rasterization; an
iteration adds L1 + SSIM, the backward pass and Adam.
"""
from __future__ import annotations

import argparse
import importlib
import json
import statistics
import sys
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Literal, NamedTuple

START = time.perf_counter()
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.system.thread_environment import set_thread_environment

set_thread_environment()

import torch
from torch import Tensor

from benchmarks import opensplat, report, workload
from benchmarks.raster_processes import process_section
from benchmarks.report import milliseconds, plot_times, table
from benchmarks.resident import peak_memory, resident_memory
from benchmarks.timing import median_times, on_threads, time_once, torch_threads
from core.fit.optimisers import Optimisers
from core.fit.settings import FitSettings
from core.gaussians import Adam, SceneGaussians, kernels, l1_ssim, over, rasterization, splat
from core.gaussians.spherical_harmonics import colours

Rasterizer = Callable[..., Tensor]
DOCUMENT = report.RESULTS / "rasterizer.md"


class Case(NamedTuple):
    """Numbers of scene and flare Gaussians, size of the picture, and the resolution that flares are drawn at."""

    gaussians: int
    width: int
    height: int
    flares: int = 0
    resolution: Literal["full", "mixed"] = "full"

    def __str__(self) -> str:
        flares = f" + {self.flares} flares" if self.flares else ""
        flares += f" ({self.resolution})" if self.resolution != "full" else ""
        return f"{self.gaussians // 1000}k{flares}, {self.width}x{self.height}"


RASTER_CASES = (
    Case(10_000, 480, 270), Case(50_000, 480, 270), Case(150_000, 480, 270), Case(50_000, 960, 540),
    Case(150_000, 960, 540), Case(50_000, 480, 270, 2000),
)  # fmt: skip
ITERATION_CASES = (
    Case(50_000, 480, 270), Case(50_000, 480, 270, 2000), Case(50_000, 480, 270, 2000, "mixed"),
    Case(150_000, 960, 540),
)  # fmt: skip
PEER_CASES = RASTER_CASES[:5]
CURVE = (10_000, 20_000, 50_000, 100_000, 200_000, 350_000, 500_000)
TILES_LIMIT = 150_000
"""Number of Gaussians or pixels from which the kernel set `tiles` is omitted, since it takes too long."""


def our_rasterizer(name: str) -> Rasterizer:
    """Return the kernel set of this name as a rasterizer."""

    def render(*args: object) -> Tensor:
        return rasterization(*args, kernels=name, depth=False).colour  # type: ignore[arg-type]

    return render


def gsplat_rasterizer(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
) -> Tensor:  # fmt: skip
    """Return the colour (h, w, 3) by gsplat's CUDA rasterizer, with the near plane of our kernels."""
    import gsplat

    colour, _, _ = gsplat.rasterization(
        means, quats, scales, opacities, sh, world_to_camera[None], intrinsics[None], width, height,
        near_plane=0.2, sh_degree=3,
    )  # fmt: skip
    return colour[0]


class Raster:
    """Forward, and forward with backward, of one case by one rasterizer. kernel_set: draws the flares, if any."""

    def __init__(self, case: Case, rasterizer: Rasterizer, kernel_set: str | None, device: str) -> None:
        self.case, self.rasterizer, self.kernel_set = case, rasterizer, kernel_set
        raw = workload.make_scene(case.gaussians)
        values = (raw.means, raw.quaternions, raw.log_scales.exp(), raw.opacity_logits.sigmoid(), raw.sh)
        self.inputs = [value.to(device).requires_grad_() for value in values]
        self.camera = [torch.eye(4, device=device), workload.intrinsics(case.width, case.height).to(device)]
        flares = workload.make_flares(case.flares, case.width, case.height)
        self.flares = [value.to(device).requires_grad_() for value in flares]
        self.upstream = torch.randn(case.height, case.width, 3, generator=torch.Generator().manual_seed(0)).to(device)

    def picture(self) -> Tensor:
        """Return the picture of the scene, with the flares over it if there are any."""
        size = (self.case.width, self.case.height)
        colour = self.rasterizer(*self.inputs, *self.camera, *size)
        if not self.case.flares:
            return colour
        splats = splat(*self.flares, *size, kernels=self.kernel_set)  # type: ignore[arg-type]
        return over(splats, colour)

    def forward(self) -> None:
        with torch.no_grad():
            self.picture()

    def forward_backward(self) -> None:
        for value in (*self.inputs, *self.flares):
            value.grad = None
        self.picture().backward(self.upstream)


class Iteration:
    """A training iteration with one kernel set, at learning rates of zero, so that the work does not change: trained on
    noise for some hundred steps, the Gaussians would cover a third fewer tiles."""

    def __init__(self, case: Case, kernel_set: str, device: str = "cpu") -> None:
        self.case, self.kernel_set = case, kernel_set
        self.scene = SceneGaussians(*workload.make_scene(case.gaussians)).to(device)
        flares = workload.make_flares(case.flares, case.width, case.height)
        self.flares = [torch.nn.Parameter(value.to(device)) for value in flares]
        self.camera = (torch.eye(4).to(device), workload.intrinsics(case.width, case.height).to(device))
        self.target = torch.rand(case.height, case.width, 3, generator=torch.Generator().manual_seed(0)).to(device)
        parameters = dict(self.scene.named_parameters())
        rates = Optimisers(self.scene, flare=None, settings=FitSettings(), extent=1.0, display_white=1.0).scene.rates
        if case.flares:
            parameters |= {f"flare{i}": p for i, p in enumerate(self.flares)}
            rates |= {f"flare{i}": 1e-6 for i in range(len(self.flares))}
        rates = {name: rate * 0 for name, rate in rates.items()}
        self.fused_kernels = "auto" if kernel_set == "cpu" else "torch"
        self.optimiser = Adam(parameters, rates, kernels=self.fused_kernels)  # type: ignore[arg-type]

    def step(self) -> None:
        """Make one iteration: render, L1 + SSIM, backward and Adam."""
        scene, size = self.scene, (self.case.width, self.case.height)
        picture = rasterization(
            scene.means, scene.quaternions, scene.log_scales, scene.opacity_logits, scene.sh, *self.camera, *size,
            kernels=self.kernel_set, depth=False, raw=True,  # type: ignore[arg-type]
        ).colour  # fmt: skip
        if self.case.flares:
            splats = splat(
                *self.flares, *size, kernels=self.kernel_set, resolution=self.case.resolution,  # type: ignore[arg-type]
            )  # fmt: skip
            picture = over(splats, picture)
        self.optimiser.zero_grad()
        loss = l1_ssim(picture, self.target, 0.8, kernels=self.fused_kernels)  # type: ignore[arg-type]
        with self.optimiser.step_in_backward():  # as the trainer does where the scene is rendered once
            loss.backward()
        self.optimiser.step()


def is_too_slow(name: str, case: Case) -> bool:
    """Return whether a case takes too long for the kernel set `torch` or `tiles`."""
    size = max(case.gaussians, case.width * case.height)
    return (name == "torch" and size > 20_000) or (name == "tiles" and size >= TILES_LIMIT)


def raster_section(rasterizers: dict[str, Rasterizer], thread_counts: list[int], rounds: int, device: str) -> str:
    """Return tables of forward, and of forward + backward. Keys of times: "CASE|RASTERIZER|THREADS|KIND"."""
    work: dict[str, Callable[[], object]] = {}
    for case in RASTER_CASES:
        for name, rasterizer in rasterizers.items():
            if is_too_slow(name, case) or (case.flares and name not in kernels.MODULES):
                continue
            raster = Raster(case, rasterizer, name if name in kernels.MODULES else None, device)
            for count in thread_counts:
                work[f"{case}|{name}|{count}|forward"] = on_threads(count, raster.forward)
                work[f"{case}|{name}|{count}|both"] = on_threads(count, raster.forward_backward)
    times = median_times(work, rounds)
    names = [name for name in rasterizers if any(f"|{name}|" in key for key in times)]
    parts = []
    for kind, title in (("forward", "Forward, ms"), ("both", "Forward + backward, ms")):
        head = [title, *[f"{name}, {_thread_label(count)}" for name in names for count in thread_counts]]
        min_threads, max_threads = thread_counts[0], thread_counts[-1]
        head += [f"cpu, {min_threads} to {max_threads} threads", f"tiles / cpu, {_thread_label(max_threads)}"]
        rows = []
        for case in RASTER_CASES:
            cells = {(name, c): times.get(f"{case}|{name}|{c}|{kind}") for name in names for c in thread_counts}
            speedup = _ratio_text(cells.get(("cpu", min_threads)), cells.get(("cpu", max_threads)))
            relative_to_tiles = _ratio_text(cells.get(("tiles", max_threads)), cells.get(("cpu", max_threads)))
            rows.append([str(case), *[milliseconds(value) for value in cells.values()], speedup, relative_to_tiles])
        parts.append(table(head, rows))
    return "\n\n".join(parts)


GPU_CASES = (*RASTER_CASES, Case(1_000_000, 1920, 1080))


def gpu_section(rounds: int) -> str:
    """Return a table of forward, and forward + backward, on an NVIDIA GPU and on all threads of the processor."""
    rasterizers = {"cuda": "cuda", "tiles": "cuda", "cpu": "cpu"}
    work: dict[str, Callable[[], object]] = {}
    for case in GPU_CASES:
        for name, device in rasterizers.items():
            if not is_too_slow(name, case):
                raster = Raster(case, our_rasterizer(name), name, device)
                work |= {f"{case}|{name}|forward": raster.forward, f"{case}|{name}|both": raster.forward_backward}
    times = median_times(work, rounds)
    head = [
        f"ms; {torch.cuda.get_device_name()}, {_thread_label(torch.get_num_threads())}",
        *[f"{name}, {kind}" for kind in ("forward", "both") for name in rasterizers],
        "tiles / cuda, both", "cpu / cuda, both",
    ]  # fmt: skip
    rows = []
    for case in GPU_CASES:
        cells = {(kind, n): times.get(f"{case}|{n}|{kind}") for kind in ("forward", "both") for n in rasterizers}
        ratios = [_ratio_text(cells["both", name], cells["both", "cuda"]) for name in ("tiles", "cpu")]
        rows.append([str(case), *[milliseconds(v) for v in cells.values()], *ratios])
    return table(head, rows)


def iteration_section(kernel_sets: list[str], thread_counts: list[int], rounds: int) -> str:
    """Return the table of training iterations. kernel_sets: their names."""
    work: dict[str, Callable[[], object]] = {}
    for case in ITERATION_CASES:
        for name in kernel_sets:
            if not is_too_slow(name, case):
                step = Iteration(case, name).step
                work |= {f"{case}|{name}|{count}": on_threads(count, step) for count in thread_counts}
    times = median_times(work, rounds)
    names = [name for name in kernel_sets if any(f"|{name}|" in key for key in times)]
    rows = [
        [str(case), *[milliseconds(times.get(f"{case}|{name}|{count}")) for name in names for count in thread_counts]]
        for case in ITERATION_CASES
    ]
    head = [f"{name}, {_thread_label(count)}" for name in names for count in thread_counts]
    return table(["A training iteration, ms", *head], rows)


STAGES = {
    "projection": ("project",),
    "tiles and depth order": ("list_sorted", "scatter_entries"),
    "raster, forward": ("raster",),
    "raster, backward": ("raster_backward",),
    "projection, backward, and Adam": ("project_backward", "adam_kernel"),
    "loss": ("loss_and_gradient",),
}
STAGE_CASES = (ITERATION_CASES[0], ITERATION_CASES[3])


def stage_section(thread_counts: list[int], rounds: int) -> str:
    """Return the table of the CPU kernels within iterations, and of the remainder: autograd, Python, memory."""
    rows = {name: [name] for name in (*STAGES, "between the kernels", "iteration", "the raster alone")}
    for case in STAGE_CASES:
        for count in thread_counts:
            iteration = Iteration(case, "cpu")
            with torch_threads(count):
                cells = _stage_times(iteration.step, 10 * rounds)
            cells["the raster alone"] = cells["raster, forward"] + cells["raster, backward"]
            for name, row in rows.items():
                row.append(milliseconds(cells[name]))
    head = ["ms", *[f"{case}, {_thread_label(count)}" for case in STAGE_CASES for count in thread_counts]]
    return table(head, list(rows.values()))


def _stage_times(step: Callable[[], object], repeats: int) -> dict[str, float]:
    """Return the median seconds of each stage over repeated steps; `parallel`, which starts each kernel, is timed."""
    step()  # loads the kernels
    seconds: dict[str, float] = {}
    parallel = importlib.import_module("core.gaussians.cpu.threads").parallel

    def timed(function: Callable[..., object], *args: object, **options: object) -> None:
        start = time.perf_counter()
        parallel(function, *args, **options)
        seconds[function.__name__] = seconds.get(function.__name__, 0.0) + time.perf_counter() - start

    kernel_modules = [module for name, module in sys.modules.items()
                      if name.startswith("core.gaussians.cpu.") and getattr(module, "parallel", None) is parallel]
    samples: dict[str, list[float]] = {name: [] for name in (*STAGES, "between the kernels", "iteration")}
    for module in kernel_modules:
        module.parallel = timed  # type: ignore[attr-defined]
    try:
        for _ in range(3 + repeats):  # the first three are left out
            seconds.clear()
            iteration_time = time_once(step)
            for name, functions in STAGES.items():
                samples[name].append(sum(seconds.get(function, 0.0) for function in functions))
            samples["between the kernels"].append(iteration_time - sum(seconds.values()))
            samples["iteration"].append(iteration_time)
    finally:
        for module in kernel_modules:
            module.parallel = parallel  # type: ignore[attr-defined]
    return {name: statistics.median(values[3:]) for name, values in samples.items()}


def flare_section(kernel_sets: list[str], rounds: int) -> str:
    """Return a table of 2,000 flare Gaussians alone: both blends, plain and rings, at full and mixed resolution."""
    rows, work = [], {}
    variants = list(product(("over", "add"), (False, True), ("full", "mixed")))
    for width, height in ((480, 270), (960, 540)):
        for name in kernel_sets:
            for blend, has_ring, resolution in variants:
                if _is_too_slow(name, width):
                    continue
                inputs = [values.requires_grad_() for values in workload.make_flares(2000, width, height)]
                rings = torch.tensor([[1.0, 0.3]]).repeat(2000, 1) if has_ring else None
                function = _splat_function(inputs, width, height, rings, blend, resolution, name)
                work[f"{width}|{name}|{blend}|{has_ring}|{resolution}"] = function
    times = median_times(work, rounds)
    for blend, has_ring, resolution in variants:
        row = [f"{blend}, {'ring r0 = 1, w = 0.3' if has_ring else 'plain'}, {resolution}"]
        for width in (480, 960):
            row += [milliseconds(times.get(f"{width}|{name}|{blend}|{has_ring}|{resolution}"))
                    for name in kernel_sets if not _is_too_slow(name, width)]
        rows.append(row)
    head = ["2,000 flares, forward + backward, ms"]
    for width, height in ((480, 270), (960, 540)):
        head += [f"{name}, {width}x{height}" for name in kernel_sets if not _is_too_slow(name, width)]
    return table(head, rows)


def _is_too_slow(kernel_set: str, width: int) -> bool:
    """Return whether a kernel set is left out of `flare_section` at a width."""
    return kernel_set == "tiles" and width > 480


def _splat_function(
    inputs: list[Tensor], width: int, height: int, rings: Tensor | None, blend: str, resolution: str, kernel_set: str
) -> Callable[[], object]:
    """Return a function that splats the flare Gaussians `inputs`, forward and backward."""
    picture_gradient = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(0))

    def run() -> None:
        for value in inputs:
            value.grad = None
        splats = splat(
            *inputs, width, height, rings=rings, blend=blend, resolution=resolution, kernels=kernel_set  # type: ignore[arg-type]
        )
        splats.colour.backward(picture_gradient)

    return run


def curve_section(rasterizers: dict[str, Rasterizer], rounds: int, device: str, picture: Path) -> str:
    """Return a table of forward + backward by the number of Gaussians, and draw it as a picture."""
    rows, times_by_set = [], {}
    fast_sets = [name for name in rasterizers if name not in ("torch", "tiles")]
    for name in fast_sets:
        work: dict[str, Callable[[], object]] = {
            str(size): Raster(Case(size, 480, 270), rasterizers[name], None, device).forward_backward for size in CURVE
        }
        times_by_set[name] = median_times(work, rounds)
    for size in CURVE:
        row = [f"{size // 1000}k"]
        for name in fast_sets:
            seconds = times_by_set[name][str(size)]
            row += [milliseconds(seconds), f"{seconds / size * 1e9:.0f}"]
        rows.append(row)
    plot_times(times_by_set, picture)
    head = ["Gaussians, 480x270"]
    for name in fast_sets:
        head += [f"{name}, ms", f"{name}, ns a Gaussian"]
    return table(head, rows) + f"\n\n![Forward + backward against the number of Gaussians]({picture.name})"


def peer_section(checkout: Path, rounds: int) -> str:
    """Return a table of OpenSplat's rasterizer, built from `checkout`, and ours; OpenSplat's gets colours, not SH."""
    module, rows = opensplat.build_module(checkout), []
    threads = torch.get_num_threads()
    for case in PEER_CASES:
        our_raster = Raster(case, our_rasterizer("cpu"), "cpu", "cpu")
        means, quats, scales, opacities, sh = (value.detach() for value in our_raster.inputs)
        view_colours = colours(means, sh, 3)
        camera = (our_raster.camera[0], our_raster.camera[1])
        opensplat_scene = opensplat.Rasterizer(
            module, means, quats, scales, opacities, view_colours, camera, case.width, case.height, our_raster.upstream
        )
        with torch.no_grad():
            difference = float((opensplat_scene.picture() - our_raster.picture()).abs().mean())
        work = {"peer": opensplat_scene.forward_backward, "1": on_threads(1, our_raster.forward_backward),
                "all": on_threads(threads, our_raster.forward_backward)}
        times = median_times(work, rounds)
        ratios = [_ratio_text(times["peer"], times[key]) for key in ("1", "all")]
        rows.append([str(case), *[milliseconds(times[key]) for key in work], *ratios, f"{difference:.1e}"])
    head = ["Forward + backward, ms", "OpenSplat, 1 thread", "cpu, 1 thread", f"cpu, {_thread_label(threads)}"]
    head += [f"OpenSplat / cpu, {_thread_label(count)}" for count in (1, threads)] + ["mean difference of the pictures"]
    return table(head, rows)


def probe(measurement: str, kernel_set: str) -> dict[str, float]:
    """Return the figures of one measurement, which runs in a process of its own.

    measurement: "start", seconds of the imports and of two iterations; "both", seconds of forward + backward; "memory",
    the resident memory before training and its peak, MB.
    """
    case = Case(50_000, 480, 270)
    if measurement == "start":
        imported = time.perf_counter() - START
        iteration = Iteration(Case(1000, 480, 270), kernel_set)
        times = []
        for _ in range(2):
            start = time.perf_counter()
            iteration.step()
            times.append(time.perf_counter() - start)
        return {"import": imported, "first": times[0], "second": times[1]}
    if measurement == "both":
        return median_times({"both": Raster(case, our_rasterizer(kernel_set), kernel_set, "cpu").forward_backward}, 5)
    memory_before = resident_memory()
    iteration = Iteration(case, kernel_set)
    for _ in range(5):
        iteration.step()
    return {"before": memory_before, "peak": peak_memory()}


def _thread_label(threads: int) -> str:
    return "1 thread" if threads == 1 else f"{threads} threads"


def _ratio_text(numerator: float | None, denominator: float | None) -> str:
    if numerator is None or denominator is None:
        return "–"
    ratio = numerator / denominator
    return f"{ratio:.2f}x" if ratio < 10 else f"{ratio:.0f}x"


def main() -> None:
    """Time the sections and write their tables."""
    parser = argparse.ArgumentParser(description="Times the kernel sets side by side.")
    parser.add_argument("--kernels", nargs="+", default=[n for n in ("cpu", "tiles") if kernels.is_available(n)])
    parser.add_argument("--rasterizer", action="append", default=[], metavar="NAME=MODULE:FUNCTION")
    parser.add_argument("--opensplat", type=Path, metavar="FOLDER", help="a checkout of OpenSplat, for --only peer")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, torch.get_num_threads()])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    parser.add_argument("--out", type=Path, default=DOCUMENT)
    parser.add_argument("--probe", nargs=2, metavar=("WHAT", "KERNELS"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.probe:
        sys.stdout.write(json.dumps(probe(*args.probe)) + "\n")
        return
    rasterizers = {name: our_rasterizer(name) for name in args.kernels}
    if args.device == "cuda" and importlib.util.find_spec("gsplat"):
        rasterizers["gsplat"] = gsplat_rasterizer
    for option in args.rasterizer:
        name, function_path = option.split("=")
        module, function = function_path.split(":")
        rasterizers[name] = getattr(importlib.import_module(module), function)
    rounds = 2 if args.quick else 5
    thread_counts = sorted(set(args.threads))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    sections: dict[str, Callable[[], str]] = {
        "raster": lambda: raster_section(rasterizers, thread_counts, rounds, args.device),
        "iteration": lambda: iteration_section(args.kernels, thread_counts, rounds),
        "stages": lambda: stage_section(thread_counts, rounds),
        "flares": lambda: flare_section(args.kernels, rounds),
        "curve": lambda: curve_section(rasterizers, rounds, args.device, args.out.parent / "raster-curve.png"),
        "process": lambda: process_section(args.kernels),
        "peer": lambda: peer_section(args.opensplat, rounds),
        "gpu": lambda: gpu_section(rounds),
    }
    unavailable = {} if args.opensplat else {"peer": "it needs --opensplat"}
    unavailable |= {} if args.device == "cuda" else {"gpu": "torch finds no NVIDIA GPU"}
    for section in args.only:
        if section in unavailable:
            print(f"The section {section} is left out: {unavailable[section]}.", file=sys.stderr)
            continue
        text = f"## {SECTIONS[section]}\n\n{sections[section]()}\n\n{report.conditions()}"
        report.write_section(args.out, section, text)
        print(text, end="\n\n", flush=True)


SECTIONS = {
    "raster": "Rasterization",
    "iteration": "Training",
    "stages": "By stage",
    "flares": "Flares",
    "curve": "Against the number of Gaussians",
    "process": "Memory, first calls, instruction sets",
    "peer": "Beside a C++ rasterizer",
    "gpu": "On a GPU",
}

if __name__ == "__main__":
    main()
