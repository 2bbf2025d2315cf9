# SPDX-License-Identifier: GPL-3.0-or-later
"""Time the kernel sets on the workload of `workload.py` and write docs/results/rasterizer.md.

    python benchmarks/raster.py                 all of it, some minutes on two cores
    python benchmarks/raster.py --quick         fewer rounds
    python benchmarks/raster.py --only raster curve
    python benchmarks/raster.py --engine mine=package.module:render
    python benchmarks/raster.py --only peer --opensplat FOLDER

An `--engine` is any other rasterizer for a column of its own: a function of (means, quats, scales, opacities,
sh, world_to_camera, intrinsics, width, height) that returns the colour (h, w, 3), differentiable. gsplat has its
column wherever it is installed and there is a GPU. OpenSplat is built from a checkout (`opensplat.py`).

Everything timed is the whole of what a user calls: projection, spherical harmonics of degree 3, sorting and
rasterization; an iteration adds L1 + SSIM, the backward pass and Adam.
"""
from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

START = time.perf_counter()
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.system.thread_environment import prepare_for_numpy_and_torch

prepare_for_numpy_and_torch()

import torch
from torch import Tensor

from benchmarks import opensplat, report, workload
from benchmarks.report import milliseconds, table
from benchmarks.resident import held, held_at_most
from benchmarks.timing import medians, on_threads, once, threads
from core.fit.optimisers import Optimisers
from core.fit.settings import FitSettings
from core.gaussians import Adam, SceneGaussians, kernels, l1_ssim, over, rasterization, splat
from core.gaussians.spherical_harmonics import colours

Engine = Callable[..., Tensor]
DOCUMENT = report.RESULTS / "rasterizer.md"


class Job(NamedTuple):
    """Gaussians, flare Gaussians, and the picture."""

    gaussians: int
    width: int
    height: int
    flares: int = 0
    resolution: Literal["full", "mixed"] = "full"

    def __str__(self) -> str:
        flares = f" + {self.flares} flares" if self.flares else ""
        flares += f" ({self.resolution})" if self.resolution != "full" else ""
        return f"{self.gaussians // 1000}k{flares}, {self.width}x{self.height}"


RASTER_JOBS = (
    Job(10_000, 480, 270), Job(50_000, 480, 270), Job(150_000, 480, 270), Job(50_000, 960, 540),
    Job(150_000, 960, 540), Job(50_000, 480, 270, 2000),
)  # fmt: skip
ITERATION_JOBS = (
    Job(50_000, 480, 270), Job(50_000, 480, 270, 2000), Job(50_000, 480, 270, 2000, "mixed"), Job(150_000, 960, 540),
)  # fmt: skip
PEER_JOBS = RASTER_JOBS[:5]
CURVE = (10_000, 20_000, 50_000, 100_000, 200_000, 350_000, 500_000)
SLOW = 150_000
"""From this many Gaussians or pixels on the torch path is left out of the tables: it takes too long."""


def our_engine(name: str) -> Engine:
    """One of our kernel sets as an engine."""

    def render(*arguments: object) -> Tensor:
        return rasterization(*arguments, kernels=name, depth=False).colour  # type: ignore[arg-type]

    return render


def gsplat_engine(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
) -> Tensor:  # fmt: skip
    """gsplat's CUDA rasterizer."""
    import gsplat

    colour, _, _ = gsplat.rasterization(
        means, quats, scales, opacities, sh, world_to_camera[None], intrinsics[None], width, height,
        near_plane=0.2, sh_degree=3,
    )  # fmt: skip
    return colour[0]


class Raster:
    """Forward, and forward with backward, of one job by one engine."""

    def __init__(self, job: Job, engine: Engine, kernel_set: str | None, device: str) -> None:
        self.job, self.engine, self.kernel_set = job, engine, kernel_set
        raw = workload.scene(job.gaussians)
        values = (raw.means, raw.quaternions, raw.log_scales.exp(), raw.opacity_logits.sigmoid(), raw.sh)
        self.inputs = [value.to(device).requires_grad_() for value in values]
        self.camera = [torch.eye(4, device=device), workload.intrinsics(job.width, job.height).to(device)]
        flares = workload.flares(job.flares, job.width, job.height)
        self.flares = [value.to(device).requires_grad_() for value in flares]
        self.upstream = torch.randn(job.height, job.width, 3, generator=torch.Generator().manual_seed(0)).to(device)

    def picture(self) -> Tensor:
        """The scene, behind the flares if there are any."""
        size = (self.job.width, self.job.height)
        colour = self.engine(*self.inputs, *self.camera, *size)
        if not self.job.flares:
            return colour
        laid = splat(*self.flares, *size, kernels=self.kernel_set)  # type: ignore[arg-type]
        return over(laid, colour)

    def forward(self) -> None:
        with torch.no_grad():
            self.picture()

    def both(self) -> None:
        for value in (*self.inputs, *self.flares):
            value.grad = None
        self.picture().backward(self.upstream)


class Iteration:
    """A whole step of training by one kernel set; at rates of nothing, so that the work stays that of the job: trained
    on noise for a few hundred steps the Gaussians would meet a third fewer tiles."""

    def __init__(self, job: Job, kernel_set: str) -> None:
        self.job, self.kernel_set = job, kernel_set
        self.scene = SceneGaussians(*workload.scene(job.gaussians))
        self.flares = [torch.nn.Parameter(v) for v in workload.flares(job.flares, job.width, job.height)]
        self.camera = (torch.eye(4), workload.intrinsics(job.width, job.height))
        self.target = torch.rand(job.height, job.width, 3, generator=torch.Generator().manual_seed(0))
        parameters = dict(self.scene.named_parameters())
        rates = Optimisers(self.scene, None, FitSettings(), extent=1.0, display_white=1.0).scene.rates
        if job.flares:
            parameters |= {f"flare{i}": p for i, p in enumerate(self.flares)}
            rates |= {f"flare{i}": 1e-6 for i in range(len(self.flares))}
        rates = {name: rate * 0 for name, rate in rates.items()}
        self.fused = "auto" if kernel_set == "cpu" else "torch"
        self.optimiser = Adam(parameters, rates, kernels=self.fused)  # type: ignore[arg-type]

    def step(self) -> None:
        s, size = self.scene, (self.job.width, self.job.height)
        picture = rasterization(
            s.means, s.quaternions, s.log_scales, s.opacity_logits, s.sh, *self.camera, *size,
            kernels=self.kernel_set, depth=False, raw=True,  # type: ignore[arg-type]
        ).colour  # fmt: skip
        if self.job.flares:
            laid = splat(
                *self.flares, *size, kernels=self.kernel_set, resolution=self.job.resolution,  # type: ignore[arg-type]
            )  # fmt: skip
            picture = over(laid, picture)
        self.optimiser.zero_grad()
        loss = l1_ssim(picture, self.target, 0.8, kernels=self.fused)  # type: ignore[arg-type]
        with self.optimiser.stepping():  # as the trainer does where the scene is rendered once
            loss.backward()
        self.optimiser.step()


def too_slow(name: str, job: Job) -> bool:
    """The torch paths are kept to sizes at which they finish."""
    size = max(job.gaussians, job.width * job.height)
    return (name == "torch" and size > 20_000) or (name == "tiles" and size >= SLOW)


def raster_section(engines: dict[str, Engine], counts: list[int], rounds: int, device: str) -> str:
    """Forward, and forward + backward: a table for each."""
    cases: dict[str, Callable[[], object]] = {}
    for job in RASTER_JOBS:
        for name, engine in engines.items():
            if too_slow(name, job) or (job.flares and name not in kernels.MODULES):
                continue
            raster = Raster(job, engine, name if name in kernels.MODULES else None, device)
            for count in counts:
                cases[f"{job}|{name}|{count}|forward"] = on_threads(count, raster.forward)
                cases[f"{job}|{name}|{count}|both"] = on_threads(count, raster.both)
    times = medians(cases, rounds)
    shown = [name for name in engines if any(f"|{name}|" in key for key in times)]
    parts = []
    for kind, title in (("forward", "Forward, ms"), ("both", "Forward + backward, ms")):
        head = [title, *[f"{name}, {_count(c)}" for name in shown for c in counts]]
        head += [f"cpu, {counts[0]} to {counts[-1]} threads", f"tiles / cpu, {_count(counts[-1])}"]
        rows = []
        for job in RASTER_JOBS:
            found = {(n, c): times.get(f"{job}|{n}|{c}|{kind}") for n in shown for c in counts}
            gain = _ratio(found.get(("cpu", counts[0])), found.get(("cpu", counts[-1])))
            against = _ratio(found.get(("tiles", counts[-1])), found.get(("cpu", counts[-1])))
            rows.append([str(job), *[milliseconds(v) for v in found.values()], gain, against])
        parts.append(table(head, rows))
    return "\n\n".join(parts)


GPU_JOBS = (*RASTER_JOBS, Job(1_000_000, 1920, 1080))


def gpu_section(rounds: int) -> str:
    """Forward, and forward + backward, on an NVIDIA GPU and beside it on all of the processor's threads."""
    engines = {"cuda": "cuda", "tiles": "cuda", "cpu": "cpu"}
    cases: dict[str, Callable[[], object]] = {}
    for job in GPU_JOBS:
        for name, device in engines.items():
            if not too_slow(name, job):
                raster = Raster(job, our_engine(name), name, device)
                cases |= {f"{job}|{name}|forward": raster.forward, f"{job}|{name}|both": raster.both}
    times = medians(cases, rounds)
    head = [
        f"ms; {torch.cuda.get_device_name()}, {_count(torch.get_num_threads())}",
        *[f"{name}, {kind}" for kind in ("forward", "both") for name in engines],
        "tiles / cuda, both", "cpu / cuda, both",
    ]  # fmt: skip
    rows = []
    for job in GPU_JOBS:
        found = {(kind, n): times.get(f"{job}|{n}|{kind}") for kind in ("forward", "both") for n in engines}
        ratios = [_ratio(found["both", name], found["both", "cuda"]) for name in ("tiles", "cpu")]
        rows.append([str(job), *[milliseconds(v) for v in found.values()], *ratios])
    return table(head, rows)


def iteration_section(sets: list[str], counts: list[int], rounds: int) -> str:
    """Whole iterations."""
    cases: dict[str, Callable[[], object]] = {}
    for job in ITERATION_JOBS:
        for name in sets:
            if not too_slow(name, job):
                step = Iteration(job, name).step
                cases |= {f"{job}|{name}|{count}": on_threads(count, step) for count in counts}
    times = medians(cases, rounds)
    shown = [name for name in sets if any(f"|{name}|" in key for key in times)]
    rows = [
        [str(job), *[milliseconds(times.get(f"{job}|{name}|{c}")) for name in shown for c in counts]]
        for job in ITERATION_JOBS
    ]
    return table(["A training iteration, ms", *[f"{name}, {_count(c)}" for name in shown for c in counts]], rows)


STAGES = {
    "projection": ("project",),
    "tiles and depth order": ("list_in_order", "scatter"),
    "raster, forward": ("raster",),
    "raster, backward": ("raster_backward",),
    "projection, backward, and Adam": ("project_backward", "_advance_all"),
    "loss": ("loss_and_gradient",),
}
STAGE_JOBS = (ITERATION_JOBS[0], ITERATION_JOBS[3])


def stage_section(counts: list[int], rounds: int) -> str:
    """The CPU kernels within whole iterations, and what is left: autograd, Python, memory."""
    rows = {name: [name] for name in (*STAGES, "between the kernels", "iteration", "the raster alone")}
    for job in STAGE_JOBS:
        for count in counts:
            iteration = Iteration(job, "cpu")
            with threads(count):
                found = _stage_times(iteration.step, 10 * rounds)
            found["the raster alone"] = found["raster, forward"] + found["raster, backward"]
            for name, row in rows.items():
                row.append(milliseconds(found[name]))
    head = ["ms", *[f"{job}, {_count(count)}" for job in STAGE_JOBS for count in counts]]
    return table(head, list(rows.values()))


def _stage_times(step: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median seconds of each stage over repetitions of a step."""
    step()  # loads the kernels
    spent: dict[str, float] = {}
    parallel = importlib.import_module("core.gaussians.cpu.threads").parallel

    def timed(function: Callable[..., object], *arguments: object, **options: object) -> None:
        start = time.perf_counter()
        parallel(function, *arguments, **options)
        spent[function.__name__] = spent.get(function.__name__, 0.0) + time.perf_counter() - start

    users = [module for name, module in sys.modules.items()
             if name.startswith("core.gaussians.cpu.") and getattr(module, "parallel", None) is parallel]
    samples: dict[str, list[float]] = {name: [] for name in (*STAGES, "between the kernels", "iteration")}
    for module in users:
        module.parallel = timed  # type: ignore[attr-defined]
    try:
        for _ in range(3 + repeats):
            spent.clear()
            whole = once(step)
            for name, functions in STAGES.items():
                samples[name].append(sum(spent.get(function, 0.0) for function in functions))
            samples["between the kernels"].append(whole - sum(spent.values()))
            samples["iteration"].append(whole)
    finally:
        for module in users:
            module.parallel = parallel  # type: ignore[attr-defined]
    return {name: statistics.median(values[3:]) for name, values in samples.items()}


def flare_section(sets: list[str], rounds: int) -> str:
    """2,000 flare Gaussians alone: both blends, plain and rings, at full and mixed resolution."""
    rows, cases = [], {}
    variants = [(b, r, m) for b in ("over", "add") for r in (False, True) for m in ("full", "mixed")]
    for width, height in ((480, 270), (960, 540)):
        for name in sets:
            for blend, ring, resolution in variants:
                if name == "tiles" and width > 480:
                    continue
                inputs = [v.requires_grad_() for v in workload.flares(2000, width, height)]
                rings = torch.tensor([[1.0, 0.3]]).repeat(2000, 1) if ring else None
                cases[f"{width}|{name}|{blend}|{ring}|{resolution}"] = _laid(
                    inputs, width, height, rings, blend, resolution, name
                )
    times = medians(cases, rounds)
    for blend, ring, resolution in variants:
        row = [f"{blend}, {'ring r0 = 1, w = 0.3' if ring else 'plain'}, {resolution}"]
        for width in (480, 960):
            row += [
                milliseconds(times.get(f"{width}|{name}|{blend}|{ring}|{resolution}"))
                for name in sets
                if not (name == "tiles" and width > 480)
            ]
        rows.append(row)
    head = ["2,000 flares, forward + backward, ms"]
    for size in ("480x270", "960x540"):
        head += [f"{name}, {size}" for name in sets if not (name == "tiles" and size != "480x270")]
    return table(head, rows)


def _laid(
    inputs: list[Tensor], width: int, height: int, rings: Tensor | None, blend: str, resolution: str, name: str
) -> Callable[[], object]:
    upstream = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(0))

    def run() -> None:
        for value in inputs:
            value.grad = None
        laid = splat(
            *inputs, width, height, rings=rings, blend=blend, resolution=resolution, kernels=name  # type: ignore[arg-type]
        )
        laid.colour.backward(upstream)

    return run


def curve_section(engines: dict[str, Engine], rounds: int, device: str, picture: Path) -> str:
    """Forward + backward against the count, as a table and as a picture."""
    rows, lines = [], {}
    fast = [name for name in engines if name not in ("torch", "tiles")]
    for name in fast:
        cases: dict[str, Callable[[], object]] = {
            str(n): Raster(Job(n, 480, 270), engines[name], None, device).both for n in CURVE
        }
        lines[name] = medians(cases, rounds)
    for n in CURVE:
        row = [f"{n // 1000}k"]
        for name in fast:
            seconds = lines[name][str(n)]
            row += [milliseconds(seconds), f"{seconds / n * 1e9:.0f}"]
        rows.append(row)
    _plot(lines, picture)
    head = ["Gaussians, 480x270"]
    for name in fast:
        head += [f"{name}, ms", f"{name}, ns a Gaussian"]
    return table(head, rows) + f"\n\n![Forward + backward against the number of Gaussians]({picture.name})"


def _plot(lines: dict[str, dict[str, float]], picture: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.6), layout="constrained")
    for name, times in lines.items():
        counts = [int(n) / 1000 for n in times]
        axes.plot(counts, [t * 1e3 for t in times.values()], "o-", label=name)
    axes.set(xlabel="Gaussians, thousands", ylabel="forward + backward, ms", xlim=(0, None), ylim=(0, None))
    axes.set_title(f"480x270, {torch.get_num_threads()} threads", fontsize=10)
    axes.grid(alpha=0.3)
    if len(lines) > 1:
        axes.legend()
    figure.savefig(picture, dpi=150)
    pyplot.close(figure)


def peer_section(checkout: Path, rounds: int) -> str:
    """OpenSplat's rasterizer beside ours."""
    module, rows = opensplat.build(checkout), []
    threads = torch.get_num_threads()
    for job in PEER_JOBS:
        ours = Raster(job, our_engine("cpu"), "cpu", "cpu")
        means, quats, scales, opacities, sh = (value.detach() for value in ours.inputs)
        seen_colours = colours(means, sh, 3)
        camera = (ours.camera[0], ours.camera[1])
        theirs = opensplat.Rasterizer(
            module, means, quats, scales, opacities, seen_colours, camera, job.width, job.height, ours.upstream
        )
        with torch.no_grad():
            apart = float((theirs.picture() - ours.picture()).abs().mean())
        cases = {"peer": theirs.both, "1": on_threads(1, ours.both), "all": on_threads(threads, ours.both)}
        times = medians(cases, rounds)
        ratios = [_ratio(times["peer"], times[key]) for key in ("1", "all")]
        rows.append([str(job), *[milliseconds(times[key]) for key in cases], *ratios, f"{apart:.1e}"])
    head = ["Forward + backward, ms", "OpenSplat, 1 thread", "cpu, 1 thread", f"cpu, {_count(threads)}"]
    head += [f"OpenSplat / cpu, {_count(count)}" for count in (1, threads)] + ["pictures apart, mean"]
    return table(head, rows)


def process_section(sets: list[str]) -> str:
    """Memory and the first call, each in a process of its own; other instruction sets."""
    rows = []
    for name in sets:
        if name == "torch":
            continue
        found = _probe("memory", name)
        rows.append([name, f"{found['before']:.0f}", f"{found['peak']:.0f}"])
    text = table(["Resident memory, training 50k at 480x270, MB", "after import", "peak"], rows)
    if "cpu" not in sets:
        return text
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (_probe("start", "cpu", FIT_FLARE_CACHE=cache) for _ in range(2))
    rows = [
        [what, f"{found['import']:.1f}", f"{found['first']:.1f}", f"{found['second'] * 1e3:.0f} ms"]
        for what, found in (("empty cache: compiles", cold), ("from the cache", warm))
    ]
    text += "\n\n" + table(
        ["Start of a process", "imports (torch, numba), s", "first iteration, s", "second iteration"], rows
    )
    rows = []
    for what, variables in INSTRUCTIONS.items():
        with tempfile.TemporaryDirectory() as cache:
            _probe("start", "cpu", FIT_FLARE_CACHE=cache, **variables)
            rows.append([what, milliseconds(_probe("both", "cpu", FIT_FLARE_CACHE=cache, **variables)["both"])])
    return text + "\n\n" + table(["50k, 480x270, forward + backward, ms, all threads", "cpu"], rows)


INSTRUCTIONS = {
    "native": {},
    "AVX2": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+popcnt,+f16c,+lzcnt"},
    "SSE4.2": {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": "+sse4.2,+popcnt"},
}


def _probe(what: str, name: str, **variables: str) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, __file__, "--probe", what, name],
        env={**os.environ, **variables}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def probe(what: str, name: str) -> dict[str, float]:
    """What a process of its own is asked to measure."""
    job = Job(50_000, 480, 270)
    if what == "start":
        imported = time.perf_counter() - START
        iteration = Iteration(Job(1000, 480, 270), name)
        times = []
        for _ in range(2):
            start = time.perf_counter()
            iteration.step()
            times.append(time.perf_counter() - start)
        return {"import": imported, "first": times[0], "second": times[1]}
    if what == "both":
        return medians({"both": Raster(job, our_engine(name), name, "cpu").both}, 5)
    before = held()
    iteration = Iteration(job, name)
    for _ in range(5):
        iteration.step()
    return {"before": before, "peak": held_at_most()}


def _count(threads: int) -> str:
    return "1 thread" if threads == 1 else f"{threads} threads"


def _ratio(a: float | None, b: float | None) -> str:
    return "–" if a is None or b is None else f"{a / b:.2f}x" if a / b < 10 else f"{a / b:.0f}x"


def main() -> None:
    """See the module's head."""
    parser = argparse.ArgumentParser(description="Times the kernel sets side by side.")
    parser.add_argument("--kernels", nargs="+", default=[n for n in ("cpu", "tiles") if kernels.available(n)])
    parser.add_argument("--engine", action="append", default=[], metavar="NAME=MODULE:FUNCTION")
    parser.add_argument("--opensplat", type=Path, metavar="FOLDER", help="a checkout of OpenSplat, for --only peer")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, torch.get_num_threads()])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    parser.add_argument("--out", type=Path, default=DOCUMENT)
    parser.add_argument("--probe", nargs=2, metavar=("WHAT", "KERNELS"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.probe:
        sys.stdout.write(json.dumps(probe(*arguments.probe)) + "\n")
        return
    engines = {name: our_engine(name) for name in arguments.kernels}
    if arguments.device == "cuda" and importlib.util.find_spec("gsplat"):
        engines["gsplat"] = gsplat_engine
    for entry in arguments.engine:
        name, place = entry.split("=")
        module, function = place.split(":")
        engines[name] = getattr(importlib.import_module(module), function)
    rounds = 2 if arguments.quick else 5
    counts = sorted(set(arguments.threads))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    write: dict[str, Callable[[], str]] = {
        "raster": lambda: raster_section(engines, counts, rounds, arguments.device),
        "iteration": lambda: iteration_section(arguments.kernels, counts, rounds),
        "stages": lambda: stage_section(counts, rounds),
        "flares": lambda: flare_section(arguments.kernels, rounds),
        "curve": lambda: curve_section(engines, rounds, arguments.device, arguments.out.parent / "raster-curve.png"),
        "process": lambda: process_section(arguments.kernels),
        "peer": lambda: peer_section(arguments.opensplat, rounds),
        "gpu": lambda: gpu_section(rounds),
    }
    lacking = {"peer"} if arguments.opensplat is None else set()
    lacking |= {"gpu"} if arguments.device == "cpu" else set()
    for section in arguments.only:
        if section in lacking:
            continue
        conditions = report.conditions()
        text = f"## {SECTIONS[section]}\n\n{write[section]()}\n\n{conditions}"
        report.write_section(arguments.out, section, text)
        sys.stdout.write(text + "\n\n")
        sys.stdout.flush()


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
