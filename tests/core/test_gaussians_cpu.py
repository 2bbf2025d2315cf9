# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU kernels: the same result on every machine and thread count, threads and memory."""
from __future__ import annotations

import math
import os
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("numba")

from core.gaussians import loss as definition
from core.gaussians import optimiser as plain_optimiser
from core.gaussians import rasterization, splat
from core.gaussians.cpu import AdamStep, adam_steps, binning, buffers, compilation, l1_ssim, layout, threads
from core.gaussians.cpu import scene as rendering
from core.gaussians.cpu.tiles import bin_gaussians

ROOT = Path(__file__).parents[2]
SIZE = (70, 45)

SCENE = """
    import math, sys
    import numpy as np, torch
    from core.gaussians import rasterization

    def scene(n=2500, seed=0, size=(70, 45)):
        g = torch.Generator().manual_seed(seed)
        u = lambda *shape: torch.rand(*shape, generator=g)
        z = 2 + 6 * u(n)
        means = torch.stack([(u(n) - 0.5) * 1.3 * z, (u(n) - 0.5) * z, z], 1)
        w, h = size
        return dict(
            means=means, quats=u(n, 4) - 0.5, scales=torch.exp(u(n, 3) * 2.5 - 4.5), opacities=u(n),
            sh=(u(n, 16, 3) - 0.5) * 0.7, world_to_camera=torch.eye(4),
            intrinsics=torch.tensor([[w * 0.8, 0, w / 2], [0, w * 0.8, h / 2], [0, 0, 1]]),
            width=w, height=h, kernels="cpu", depth=False,
        )
"""
_namespace: dict[str, object] = {}
exec(textwrap.dedent(SCENE), _namespace)
scene = _namespace["scene"]


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def gradients(count: int, **changes: object) -> list[Tensor]:
    """Render the scene on this many threads; return colour, alpha and the gradients of all inputs."""
    torch.set_num_threads(count)
    arguments = {**scene(), **changes}  # type: ignore[operator]
    inputs = {k: v.requires_grad_() for k, v in arguments.items() if isinstance(v, Tensor)}
    result = rasterization(**arguments)
    weights = torch.linspace(-1, 1, result.colour.numel()).reshape(result.colour.shape)
    ((result.colour * weights).sum() + result.alpha.square().sum()).backward()
    return [result.colour.detach(), result.alpha.detach(), *(v.grad for v in inputs.values() if v.grad is not None)]


def test_every_run_and_every_thread_count_gives_the_same_bits() -> None:
    first = gradients(1)
    assert len(first) == 2 + 7
    for count in (1, 2, 3):
        for a, b in zip(first, gradients(count), strict=True):
            assert torch.equal(a, b), count


@pytest.mark.parametrize("planes", [1, 3])
def test_equal_depths_are_drawn_in_input_order(planes: int) -> None:
    """Depths that many share: cuts between the threads' parts fall on them, and parts may be empty."""
    means = scene()["means"]  # type: ignore[operator]
    z = means[:, 2].quantile((torch.arange(planes) + 0.5) / planes)[torch.arange(len(means)) % planes]
    means = means * (z / means[:, 2])[:, None]
    means[:, 2] = z
    changes = {"means": means, "near": 0.1}
    exact = rasterization(**{**scene(), **changes, "kernels": "torch"}).colour  # type: ignore[operator]
    first = gradients(1, **changes)
    assert (first[0] - exact).abs().max() < 1e-4
    for count in (2, 5):
        for a, b in zip(first, gradients(count, **changes), strict=True):
            assert torch.equal(a, b), count


def test_gaussians_with_nan_are_not_drawn() -> None:
    """NaN in logarithms of scales or logits of opacities must not become a size or an opacity either."""
    arguments = scene()  # type: ignore[operator]
    kept = torch.arange(len(arguments["means"])) % 7 != 0
    names = ("means", "quats", "scales", "opacities", "sh")
    arguments |= {"scales": arguments["scales"].log(), "opacities": torch.logit(arguments["opacities"]), "raw": True}
    without = rasterization(**{**arguments, **{name: arguments[name][kept] for name in names}}).colour
    for name in ("scales", "opacities"):
        spoiled = arguments[name].clone()
        spoiled[~kept] = math.nan
        assert torch.equal(rasterization(**{**arguments, name: spoiled}).colour, without)


def test_splats_with_a_nan_centre_are_not_drawn() -> None:
    g = torch.Generator().manual_seed(2)
    centres, covariances = torch.rand(60, 2, generator=g) * 70, torch.tensor([90.0, 20, 60]).repeat(60, 1)
    opacities, colours = torch.rand(60, generator=g), torch.rand(60, 3, generator=g)
    lost = torch.arange(60) % 3
    without = splat(centres[lost == 2], covariances[lost == 2], opacities[lost == 2], colours[lost == 2], *SIZE,
                    kernels="cpu").colour
    centres[lost == 0, 0] = math.nan
    centres[lost == 1] = math.nan
    for kernels in ("cpu", "tiles"):
        found = splat(centres, covariances, opacities, colours, *SIZE, kernels=kernels).colour
        torch.testing.assert_close(found, without, atol=1e-6 if kernels == "cpu" else 1e-4, rtol=0)


def test_splats_give_the_same_bits_on_all_thread_counts() -> None:
    def draw(count: int) -> list[Tensor]:
        """Splat random rings on this many threads; return the picture and the gradients of all inputs."""
        torch.set_num_threads(count)
        g = torch.Generator().manual_seed(2)
        inputs = [
            torch.rand(60, 2, generator=g) * 70, torch.tensor([90.0, 20, 60]).repeat(60, 1),
            torch.rand(60, generator=g), torch.rand(60, 3, generator=g), torch.rand(60, 2, generator=g) + 0.1,
        ]  # fmt: skip
        for tensor in inputs:
            tensor.requires_grad_()
        found = splat(*inputs[:4], *SIZE, rings=inputs[4], blend="add", kernels="cpu")
        found.colour.square().sum().backward()
        return [found.colour.detach(), *(t.grad for t in inputs if t.grad is not None)]

    for a, b in zip(draw(1), draw(2), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("opacity", [0.02, 0.99])
def test_wide_and_narrow_gaussians_lose_no_tile(opacity: float) -> None:
    """Some meet one column of tiles, some all; leaning, so that columns differ."""
    size, count = (210, 130), 40
    g = torch.Generator().manual_seed(5)
    length = torch.linspace(0.01, 1.5, count)
    arguments = {
        "means": torch.cat([torch.rand(count, 2, generator=g) * 2 - 1, torch.linspace(2, 3, count)[:, None]], 1),
        "quats": torch.randn(count, 4, generator=g), "scales": length[:, None] * torch.tensor([1.0, 0.2, 0.05]),
        "opacities": torch.full((count,), opacity), "sh": torch.randn(count, 1, 3, generator=g),
        "world_to_camera": torch.eye(4), "width": size[0], "height": size[1], "depth": False,
        "intrinsics": torch.tensor([[150.0, 0, 105], [0, 150, 65], [0, 0, 1]]),
    }  # fmt: skip
    exact = rasterization(**arguments, kernels="torch").colour  # type: ignore[arg-type]
    found = rasterization(**arguments, kernels="cpu").colour  # type: ignore[arg-type]
    unsure = (found - exact).abs() > 1e-4  # at the rim of a Gaussian, where alpha is 1/255, rounding decides
    assert unsure.float().mean() < 2e-3
    assert (found - exact).abs().max() < 6e-3 * float(arguments["sh"].abs().max())  # type: ignore[union-attr]


@pytest.mark.parametrize("count", [1, 2, 4])
def test_parts_are_balanced_and_cover_all_gaussians(count: int) -> None:
    rng = np.random.default_rng(0)
    keys = rng.uniform(2, 10, 20_000).astype(np.float32).view(np.uint32)
    keys[::5] = binning.CULLED_KEY
    bounds = np.where(keys < binning.CULLED_KEY, rng.integers(1, 6, len(keys)), 0).astype(np.int32)
    chunk_bounds = np.add.reduceat(bounds, np.arange(0, len(keys), 1024)).astype(np.int64)
    for some in (keys, np.full_like(keys, binning.CULLED_KEY), np.full_like(keys, 7)):
        starts, cuts = np.empty(len(chunk_bounds), np.int64), np.empty(count + 1, np.int64)
        work = np.empty(binning.HISTOGRAM_BINS, np.int64)
        capacity = binning.plan_parts(some, bounds, chunk_bounds, 3, work, starts, cuts)
        assert capacity == bounds.sum() and (starts == np.cumsum(chunk_bounds) - chunk_bounds).all()
        assert cuts[0] == 0 and cuts[-1] == binning.CULLED_KEY and (np.diff(cuts) >= 0).all()
        if some is keys:
            shares = [bounds[(keys >= a) & (keys < b)].sum() for a, b in pairwise(cuts)]
            assert max(shares) < 1.2 * min(shares)


def test_two_renderings_keep_their_states_until_backward() -> None:
    alone = gradients(2)
    torch.set_num_threads(2)
    pairs = []
    for seed in (0, 1):
        arguments = scene(seed=seed)  # type: ignore[operator]
        arguments["means"].requires_grad_()
        pairs.append((arguments["means"], rasterization(**arguments)))
    for means, result in pairs:
        weights = torch.linspace(-1, 1, result.colour.numel()).reshape(result.colour.shape)
        ((result.colour * weights).sum() + result.alpha.square().sum()).backward()
        assert means.grad.isfinite().all()
    assert torch.equal(pairs[0][0].grad, alone[2])


def test_without_gradients_the_picture_is_the_same() -> None:
    with torch.no_grad():
        result = rasterization(**scene())  # type: ignore[operator]
    assert torch.equal(result.colour, gradients(1)[0])


def test_a_scene_without_visible_gaussians_renders_the_background() -> None:
    arguments = scene(n=20)  # type: ignore[operator]
    arguments["means"] = arguments["means"] * torch.tensor([1.0, 1.0, -1.0])
    arguments["means"].requires_grad_()
    background = torch.tensor([0.1, 0.2, 0.3])
    result = rasterization(**arguments, background=background)
    result.colour.sum().backward()
    assert torch.equal(result.colour, background.expand(45, 70, 3))
    assert not result.alpha.any() and not arguments["means"].grad.any()


RENDER = SCENE + """
    with torch.no_grad():
        picture = rasterization(**scene(n=400, size=(40, 36))).colour.numpy()
    np.save(sys.argv[1], picture)
"""


@pytest.mark.skipif(sys.platform == "darwin" or os.uname().machine != "x86_64", reason="instruction sets of x86-64")
def test_all_instruction_sets_give_the_same_picture(tmp_path: Path) -> None:
    pictures = []
    import llvmlite.binding as llvm

    has_more_than_avx2 = llvm.get_host_cpu_features().get("avx512f", False)
    # This machine's own; AVX2, if that is another; SSE 4.2. Each is compiled anew.
    for name in ("", "haswell", "nehalem") if has_more_than_avx2 else ("", "nehalem"):
        where = tmp_path / f"{name}.npy"
        environment = {**os.environ, **({"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""} if name else {})}
        subprocess.run(
            [sys.executable, "-c", textwrap.dedent(RENDER), str(where)], cwd=ROOT, env=environment, check=True
        )
        pictures.append(np.load(where))
    assert pictures[0].std() > 0.05
    for picture in pictures[1:]:
        assert np.abs(picture - pictures[0]).max() < 1e-5


@pytest.mark.parametrize("kernel", ["raster_forward", "raster_backward"])
def test_arm_code_has_vectors_and_no_library_calls(kernel: str) -> None:
    import importlib
    import re

    import llvmlite.binding as llvm
    import numba

    gradients(1)  # so that its signature is known
    module = importlib.import_module(f"core.gaussians.cpu.{kernel}")
    kept = module.raster if kernel == "raster_forward" else module.raster_backward
    options = {**compilation.OPTIONS, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    function = numba.njit(**options)(kept.py_func)  # not from the cache, which has no code to show
    function.compile(kept.signatures[0])
    library = next(iter(function.overloads.values())).library
    code = library.get_llvm_str()
    assert "llvm.x86" not in code
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    parsed = llvm.parse_assembly(re.sub(r"target (triple|datalayout) = .*", "", code))
    machine = llvm.Target.from_triple("aarch64-unknown-linux-gnu").create_target_machine(opt=2)
    parsed.triple, parsed.data_layout = machine.triple, str(machine.target_data)
    assembly = machine.emit_assembly(parsed)
    assert len(re.findall(r"\bfmla\b.*\.4s", assembly)) > 20
    called = set(re.findall(r"\bbl\s+(\S+)", assembly))
    assert called <= {"memset", "memcpy", "numba_attempt_nocopy_reshape"}, called


def test_an_error_in_any_thread_reaches_the_caller() -> None:
    calls = []

    def fail(_: np.ndarray, number: int) -> None:
        calls.append(number)
        raise ValueError(str(number))

    torch.set_num_threads(3)
    with pytest.raises(ValueError, match="7"):
        threads.parallel(fail, 7)
    assert calls == [7, 7, 7]
    gradients(2)  # the threads are still there


def test_calls_reach_sleeping_and_spinning_threads() -> None:
    """Every call runs on as many threads as it asks for, also if several callers ask at once for changing numbers."""
    def call(times: int, pause: float) -> None:
        for number in range(times):
            seen: list[int] = []
            threads.parallel(lambda _, seen=seen: seen.append(threading.get_ident()), limit=1 + number % 3)
            assert len(set(seen)) == len(seen) == 1 + number % 3
            time.sleep(pause)

    torch.set_num_threads(3)
    with ThreadPoolExecutor() as pool:
        for done in [pool.submit(call, *arguments) for arguments in ((300, 0.0), (100, 0.0), (20, 0.01))]:
            done.result(60)


def test_memory_is_reused_only_after_its_last_reference() -> None:
    size = buffers.MIN_POOLED_BYTES  # numbers of 4 bytes: a block of its own
    first = buffers.empty(size)
    place = first.ctypes.data
    assert place % buffers.CACHE_LINE == 0
    view = torch.from_numpy(first)[3:].view(-1, 1)
    del first
    other = buffers.empty(size)
    assert other.ctypes.data != place
    del view
    assert buffers.empty(size - 1).ctypes.data == place


def test_the_memory_pool_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(buffers, "MAX_FREE_BYTES", 8 * buffers.MIN_POOLED_BYTES)
    for _ in range(3):
        held = [buffers.empty(buffers.MIN_POOLED_BYTES * step // 4) for step in (1, 2, 3, 4)]
        del held
    free = sum(size * len(blocks) for size, blocks in buffers._free_blocks.items())
    assert free == buffers._free_bytes <= 8 * buffers.MIN_POOLED_BYTES


@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.int64])
def test_small_arrays_are_aligned(dtype: type) -> None:
    for count in (1, 100, 5000):
        array = buffers.empty(count, dtype)
        assert array.size == count and array.dtype == dtype and array.ctypes.data % buffers.CACHE_LINE == 0


@pytest.mark.parametrize("size", [(5, 6), (37, 53), (64, 48), (11, 2)])
def test_the_fused_loss_and_its_gradient_equal_the_definition(size: tuple[int, int]) -> None:
    g = torch.Generator().manual_seed(0)
    image = torch.rand(*size, 3, generator=g).requires_grad_()
    target = (image.detach() + 0.2 * torch.randn(*size, 3, generator=g)).clamp(0, 1)
    exact = image.detach().double().requires_grad_()
    expected = definition.l1_ssim(exact, target.double(), 0.8, kernels="torch")
    (3 * expected).backward()
    for _ in range(2):  # the second time what is known of the target is used again
        image.grad = None
        found = l1_ssim(image, target, 0.8)
        (3 * found).backward()
        assert abs(found.item() - expected.item()) < 1e-6
        assert torch.linalg.vector_norm(image.grad - exact.grad) < 1e-5 * torch.linalg.vector_norm(exact.grad)


def test_the_loss_sees_a_target_that_was_changed_in_place() -> None:
    image, target = torch.rand(20, 30, 3), torch.rand(20, 30, 3)
    before = l1_ssim(image, target, 0.5)
    target.copy_(image)
    assert l1_ssim(image, target, 0.5).item() == pytest.approx(0, abs=1e-6) != before.item()


@pytest.mark.parametrize(
    ("shape", "rate"),
    [((1001, 3), 0.01), ((1001, 16, 3), torch.linspace(0.1, 1, 48).reshape(16, 3)), ((7,), 0.1),
     ((50, 3), torch.tensor([1.0, 2, 3]))],
)  # fmt: skip
def test_fused_adam_steps_equal_the_definition(shape: tuple[int, ...], rate: float | Tensor) -> None:
    g = torch.Generator().manual_seed(0)
    values = torch.rand(shape, generator=g)
    moments = [torch.zeros(shape) for _ in range(2)]
    exact, exact_moments = values.double(), [m.double() for m in moments]
    exact_rate = rate.double() if isinstance(rate, Tensor) else rate
    other, other_moments = torch.zeros(40_000), [torch.zeros(40_000) for _ in range(2)]  # in the same call
    for step in range(1, 5):
        gradient = torch.randn(shape, generator=g)
        constants = {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-15}
        others = AdamStep(other, torch.ones(40_000), *other_moments, 1, 0.5)
        adam_steps([AdamStep(values, gradient, *moments, step, rate), others], **constants)
        plain_optimiser.adam_step(exact, gradient.double(), *exact_moments, step, exact_rate, **constants)
        for moment in other_moments:
            moment.zero_()
    assert torch.allclose(other, torch.tensor(-2.0))
    assert (values - exact).abs().max() < 3e-6
    assert (moments[0] - exact_moments[0]).abs().max() < 1e-6


def test_ellipses_far_larger_than_the_picture_are_listed_within_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The edges of such ellipses are exact to a pixel at best; a row listed wrongly would lie below the picture's
    tiles."""
    width, height, count = 240, 135, 20_000
    random = np.random.default_rng(0)
    records, met = np.empty(0), np.empty(0, int)

    def listed(*given: Any) -> Any:
        """Call `bin_gaussians` as the kernels do; check rows and bounds, and keep the inputs for the test."""
        nonlocal records, met
        records, tiles, rows, bounds, grid = (given[0].reshape(-1, layout.RECORD).astype(float), given[2], given[3],
                                              given[4].copy(), given[-1])
        packed = rows.astype(np.int64)
        ends = (packed >> binning.FIRST_BITS) & binning.END_MASK, packed >> (binning.COLUMN_BITS + binning.FIRST_BITS)
        two = np.maximum(*ends) > layout.TILE_HEIGHT
        few = tiles >= 0
        assert (packed[few] >= 0).all()
        assert (tiles[few & two] + grid.tiles_x < grid.num_tiles).all()
        bins = bin_gaussians(*given)
        met = np.flatnonzero(few)
        assert (bins.slot_counts <= bounds)[given[1] < binning.CULLED_KEY].all()
        return bins

    monkeypatch.setattr(rendering, "bin_gaussians", listed)
    intrinsics = torch.tensor([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]])
    scales = np.exp(random.uniform(np.log(0.01), np.log(1e4), (count, 3)))
    quats, opacities = random.normal(size=(count, 4)), random.uniform(0.05, 1, count)
    means = np.concatenate([random.normal(size=(count, 2)) * scales.max(1)[:, None], np.ones((count, 1))], 1)
    first_row, reach = random.choice([64.0, 128.0], count), random.uniform(1, 30, count)
    first_row += random.uniform(-0.3, 3, count)
    for _ in range(3):  # moved until they just reach into the picture, from the side and from below
        tensors = [torch.tensor(part, dtype=torch.float32) for part in (means, quats, scales, opacities)]
        rasterization(*tensors, torch.zeros(count, 1, 3), torch.eye(4), intrinsics, width, height, depth=False,
                      kernels="cpu")
        x, y, half_x, half_y = records[:, [layout.X, layout.Y, layout.HALF_X, layout.HALF_Y]].T
        seen = np.isfinite(half_x + half_y)
        means[seen, 0] += (reach - x - half_x)[seen] / 100
        means[seen, 1] += (first_row - y + half_y)[seen] / 100
    assert len(met) > 1000
