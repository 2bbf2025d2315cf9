# SPDX-License-Identifier: GPL-3.0-or-later
"""The store of computed offsets in core.look.network, and drawings in which lights take turns."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from core.look import Look, PlacedLight, PlaneGaussians, read_look
from core.look.network import ROWS_PER_BLOCK, OffsetsBudget, _OffsetsCache
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


def drawn(look: Look, view: int, budget: OffsetsBudget | None) -> dict[str, PlaneGaussians]:
    """The flares of LIGHTS in a view, as one drawing evaluates them."""
    if budget is not None:
        budget.begin()
    return look.evaluate_lights(cameras(3)[view].world_to_camera, LIGHTS, budget=budget)


def exact_lights(look: Look, view: int, flares: dict[str, PlaneGaussians]) -> list[str]:
    return [name for name, expected in drawn(look, view, None).items()
            if np.array_equal(flares[name].colours, expected.colours)]


def test_lights_take_turns_until_all_are_exact(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), OffsetsBudget(1e-9)
    assert len(exact_lights(look, 0, drawn(look, 0, budget))) == len(LIGHTS) and budget.is_complete
    counts = []
    for _ in LIGHTS:
        flares = drawn(look, 1, budget)
        exact = exact_lights(look, 1, flares)
        counts.append(len(exact))
        assert budget.is_complete == (len(exact) == len(LIGHTS))
        for name, expected in drawn(look, 1, None).items():  # near their exact places, whosever turn it is
            assert np.abs(flares[name].means - expected.means).max() < 0.05
    assert counts == [1, 2, 3, 4, 5]


def test_lights_are_completed_faster_at_rest(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), OffsetsBudget(1e-9, 60.0)
    drawn(look, 0, budget)
    counts = [len(exact_lights(look, view, drawn(look, view, budget))) for view in (1, 2, 2, 2, 1)]
    assert counts == [1, 1, 2, 5, 1]


def test_a_moving_camera_lets_no_light_wait_for_ever(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), OffsetsBudget(1e-9)
    drawn(look, 0, budget)
    turns = set()
    for number in range(2 * len(LIGHTS)):
        turns |= set(exact_lights(look, 1 + number % 2, drawn(look, 1 + number % 2, budget)))
    assert turns == {light.name for light in LIGHTS}


def test_time_for_all_lights_is_an_exact_drawing(tmp_path: Path) -> None:
    """With a budget of time that suffices for all lights, every light is exact in every view."""
    saved(tmp_path / "a.flare", lights=1)
    look, budget = read_look(tmp_path / "a.flare"), OffsetsBudget(60.0)
    for view in (0, 1, 2):
        assert len(exact_lights(look, view, drawn(look, view, budget))) == len(LIGHTS) and budget.is_complete


def test_the_network_does_not_depend_on_the_blocks_of_its_rows(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1, count=2 * ROWS_PER_BLOCK + 7)
    network = read_look(tmp_path / "a.flare").lights[0]._network
    features = network.view_features(np.zeros(3, np.float32), np.array([0.1, 0.2], np.float32))
    rows = network._gaussian_features
    whole = network._concatenated_offsets(rows, features)
    parts = [network._concatenated_offsets(rows[start:start + 50], features) for start in range(0, len(rows), 50)]
    np.testing.assert_allclose(whole, np.concatenate(parts), atol=1e-5)
