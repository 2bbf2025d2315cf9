# SPDX-License-Identifier: GPL-3.0-or-later
"""The deformation network in numpy: its store of computed offsets, products of matrices without a BLAS, and redraws in
which lights take turns."""
from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import core.look.network as network_module
from core.look import Look, PlacedLight, PlaneGaussians, read_look
from core.look.network import GAUSSIANS_PER_BLOCK, Network, OffsetsBudget, _OffsetsCache, has_optimised_blas
from tests.core.flared import LIGHT, cameras
from tests.core.test_look import saved


def test_offsets_are_computed_once_until_the_store_is_full() -> None:
    """The entry that was not used for longest is dropped."""
    cache, computed = _OffsetsCache(3 * 40), []

    def offsets(number: int) -> float:
        def compute() -> np.ndarray:
            computed.append(number)
            return np.full(10, number, np.float32)

        return float(cache.get((0, bytes([number])), compute)[0])

    assert [offsets(number) for number in (1, 2, 3, 1, 4, 1, 2)] == [1, 2, 3, 1, 4, 1, 2]
    assert computed == [1, 2, 3, 4, 2]
    assert cache.get((1, bytes([1])), lambda: np.zeros(10, np.float32))[0] == 0, "of another network"


def test_an_entry_larger_than_the_store_is_returned_and_not_kept() -> None:
    cache = _OffsetsCache(8)
    assert cache.get((0, b""), lambda: np.ones(10, np.float32)).sum() == 10
    assert cache.get((0, b""), lambda: np.zeros(10, np.float32)).sum() == 0


LIGHTS = [PlacedLight(f"lamp {number}", "lamp 0", np.array(LIGHT) + np.array([0.1 * number, 0, 0]))
          for number in range(5)]


def redraw(look: Look, view: int, budget: OffsetsBudget | None) -> dict[str, PlaneGaussians]:
    """The flares of LIGHTS in a view, as one redraw evaluates them."""
    if budget is not None:
        budget.begin()
    return look.evaluate_lights(cameras(3)[view].world_to_camera, LIGHTS, budget=budget)


def budget_of(seconds: float, seconds_at_rest: float = 0.0, cost: float = 1.0) -> OffsetsBudget:
    """A budget for which the network takes `cost` seconds for each light."""
    ticks = itertools.count()
    return OffsetsBudget(seconds, seconds_at_rest, lambda: cost * next(ticks))


def exact_lights(look: Look, view: int, flares: dict[str, PlaneGaussians]) -> list[str]:
    return [name for name, expected in redraw(look, view, None).items()
            if np.array_equal(flares[name].colours, expected.colours)]


def test_lights_take_turns_until_all_are_exact(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), budget_of(1.0)
    assert len(exact_lights(look, 0, redraw(look, 0, budget))) == len(LIGHTS) and budget.is_complete
    counts = []
    for _ in LIGHTS:
        flares = redraw(look, 1, budget)
        exact = exact_lights(look, 1, flares)
        counts.append(len(exact))
        assert budget.is_complete == (len(exact) == len(LIGHTS))
        for name, expected in redraw(look, 1, None).items():  # near their exact places, whosever turn it is
            assert np.abs(flares[name].means - expected.means).max() < 0.05
    assert counts == [1, 2, 3, 4, 5]


def test_lights_are_completed_faster_at_rest(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), budget_of(1.0, 60.0)
    redraw(look, 0, budget)
    counts = [len(exact_lights(look, view, redraw(look, view, budget))) for view in (1, 2, 2, 2, 1)]
    assert counts == [1, 1, 2, 5, 1]


def test_a_moving_camera_lets_no_light_wait_for_ever(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), budget_of(1.0)
    redraw(look, 0, budget)
    turns = set()
    for number in range(2 * len(LIGHTS)):
        turns |= set(exact_lights(look, 1 + number % 2, redraw(look, 1 + number % 2, budget)))
    assert turns == {light.name for light in LIGHTS}


@pytest.mark.parametrize(("cost", "exact"), [
    (3.0, [1, 0, 0, 1, 0, 0, 1, 0, 0]), (2.5, [1, 0, 0, 1, 0, 1, 0, 0, 1]), (1.0, [1] * 9), (0.1, [1] * 9)])
def test_a_light_that_takes_longer_than_a_redraw_has_is_computed_in_some_redraws(tmp_path: Path, cost: float,
                                                                                 exact: list[int]) -> None:
    """In a moving view the mean time stays within the limit of one redraw."""
    saved(tmp_path / "a.flare", lights=1)
    look, budget, counts = read_look(tmp_path / "a.flare"), budget_of(1.0, 60.0, cost), []
    poses = [camera.world_to_camera.copy() for camera in cameras(len(exact) + 1)]

    def draw(pose: np.ndarray) -> bool:
        budget.begin()
        flare = look.evaluate_lights(pose, LIGHTS[:1], budget=budget)["lamp 0"]
        is_exact = np.array_equal(flare.colours, look.evaluate_lights(pose, LIGHTS[:1])["lamp 0"].colours)
        assert budget.is_complete == is_exact
        return is_exact

    assert draw(poses[0])
    counts = [int(draw(pose)) for pose in poses[1:]]
    assert counts == exact
    assert [draw(poses[-1]) for _ in range(2)][-1], "complete once the view rests"
    assert draw(poses[0]), "at once, after a rest"


@pytest.mark.parametrize(("first", "later", "exact"), [
    (200.0, 8.0, [1] * 9), (200.0, 60.0, [1, 0, 0, 1, 0, 0, 1, 0, 0])])
def test_one_slow_computation_does_not_delay_later_ones(tmp_path: Path, first: float, later: float,
                                                        exact: list[int]) -> None:
    """With 20 ms for a redraw and costs in ms. The first computation of a process takes longer."""
    saved(tmp_path / "a.flare", lights=1)
    look, ticks = read_look(tmp_path / "a.flare"), itertools.chain([0.0, first], itertools.count(first, later))
    budget = OffsetsBudget(20.0, 60.0, lambda: next(ticks))
    counts = []
    for camera in cameras(len(exact) + 1):
        budget.begin()
        look.evaluate_lights(camera.world_to_camera, LIGHTS[:1], budget=budget)
        counts.append(int(budget.is_complete))
    assert counts == [1, *exact]


def test_the_mean_time_of_lights_with_different_costs_stays_within_the_limit() -> None:
    """Four lights of 2 ms and one of 58 ms need 20 ms for a redraw on average, and each has its turns."""
    now, turns = 0.0, dict.fromkeys([(-1, "a"), (-1, "b"), (-1, "c"), (-1, "d"), (-2, "e")], 0)
    budget = OffsetsBudget(20.0, clock=lambda: now)
    for number in range(101):
        budget.begin()
        for light in turns:
            def compute(light: tuple[int, str] = light) -> np.ndarray:
                nonlocal now
                now += 58 if light[0] == -2 else 2
                turns[light] += 1
                return np.zeros(1, np.float32)

            budget.get(light, (light[0], f"{light[1]} {number}".encode()), compute)
        if number == 0:
            start = now
    assert 0.9 * 20 * 100 < now - start <= 1.05 * 20 * 100
    assert min(turns.values()) > 20


def test_a_redraw_with_time_for_all_lights_is_exact(tmp_path: Path) -> None:
    """With a budget of time that suffices for all lights, every light is exact in every view."""
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), budget_of(60.0)
    for view in (0, 1, 2):
        assert len(exact_lights(look, view, redraw(look, view, budget))) == len(LIGHTS) and budget.is_complete


def offsets(network: Network, size: int) -> np.ndarray:
    """The offsets of all Gaussians for one view, computed for `size` Gaussians at a time."""
    features = network.view_features(np.zeros(3, np.float32), np.array([0.1, 0.2], np.float32))
    columns = network._gaussian_features
    return np.concatenate([network._concatenated_offsets(columns[:, start:start + size], features)
                           for start in range(0, columns.shape[1], size)])


@pytest.mark.parametrize("uses_blas", [True, False])
def test_the_network_does_not_depend_on_the_blocks_of_its_gaussians(tmp_path: Path, uses_blas: bool,
                                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_module, "_uses_blas", uses_blas)
    saved(tmp_path / "a.flare", lights=1, count=2 * GAUSSIANS_PER_BLOCK + 7)
    network = read_look(tmp_path / "a.flare").lights[0]._network
    np.testing.assert_allclose(offsets(network, 10**6), offsets(network, 50), atol=1e-5)


def test_the_network_without_blas_gives_the_same_offsets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved(tmp_path / "a.flare", lights=1, count=700)
    network = read_look(tmp_path / "a.flare").lights[0]._network
    monkeypatch.setattr(network_module, "_uses_blas", True)
    expected = offsets(network, 700)
    monkeypatch.setattr(network_module, "_uses_blas", False)
    monkeypatch.setattr(np, "matmul", None)  # whatever BLAS it has
    computed = offsets(network, 700)
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(computed, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("config", "is_optimised"), [
    ({"CONFIG": {"Build Dependencies": {"blas": {"name": "scipy-openblas"}}}}, True),
    ({"CONFIG": {"Build Dependencies": {"blas": {"name": "accelerate"}}}}, True),
    ({"CONFIG": {"Build Dependencies": {"blas": {"name": "blas"}}}}, False),  # the reference BLAS
    ({"CONFIG": {"Build Dependencies": {"blas": {"name": "none"}}}}, False),
    ({"CONFIG": {}}, False),
    ({"blas_opt_info": {"libraries": ["openblas64_", "openblas64_"]}}, True),  # numpy below 1.26
    ({"blas_opt_info": {"extra_link_args": ["-Wl,-framework", "-Wl,Accelerate"]}}, True),
    ({"blas_opt_info": {"define_macros": [("NO_ATLAS_INFO", 1)], "libraries": ["blas"]}}, False),
    ({}, False)])
def test_an_optimised_blas_is_recognised(config: dict[str, Any], is_optimised: bool) -> None:
    assert has_optimised_blas(SimpleNamespace(**config)) is is_optimised
