# SPDX-License-Identifier: GPL-3.0-or-later
"""The visible share of a light: hidden, free, half hidden, and differentiable."""
from __future__ import annotations

import pytest
import torch

from core.flare.model import FlareModel
from core.flare.visibility import (
    VisibilitySettings,
    clear_visibilities,
    light_visibilities,
    light_visibility,
    relative_to_clear,
)
from core.gaussians.scene import SceneGaussians
from tests.core.test_flare import some_flare
from tests.core.test_look import SMALL

LIGHT = torch.tensor([0.0, 0.0, 4.0])
CAMERA = torch.zeros(3)


def wall(x: float = 0.0, z: float = 2.0, half_width: float = 0.5, opacity: float = 0.98) -> SceneGaussians:
    """A thin wall of overlapping Gaussians: x from `x - half_width` to `x + half_width`, all y."""
    xs = torch.arange(x - half_width, x + half_width + 1e-6, 0.01)
    ys = torch.arange(-0.3, 0.3, 0.01)
    means = torch.cartesian_prod(xs, ys, torch.tensor([z]))
    n = len(means)
    return SceneGaussians(means, torch.full((n, 3), 0.008).log(), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
                          torch.full((n,), opacity).logit(), torch.zeros(n, 16, 3))


def share(scene: SceneGaussians, light: torch.Tensor = LIGHT) -> float:
    with torch.no_grad():
        return float(light_visibility(scene, CAMERA, light, VisibilitySettings(radius=0.02), kernels="torch"))


def test_an_unobstructed_light_has_visibility_1_and_a_hidden_one_0() -> None:
    assert share(SceneGaussians.empty()) == 1
    assert share(wall()) < 0.01
    assert share(wall(x=1.5)) > 0.99


def test_what_lies_behind_or_at_the_light_does_not_hide_it() -> None:
    assert share(wall(z=5.0)) == 1
    assert share(wall(z=3.9)) == 1  # the lamp itself, within the margin
    assert share(wall(z=-2.0)) == 1


@pytest.mark.parametrize("distance", [100.0, 1000.0, 10_000.0])
def test_what_is_near_hides_lights_however_far_they_are(distance: float) -> None:
    """All that the picture shows; what it culls hides nothing."""
    light = torch.tensor([0.0, 0.0, distance])
    assert share(wall(z=0.5), light) < 0.01
    near = wall(z=0.1)
    assert share(near, light) > 0.99
    near.near = 0.05  # a world of small units
    assert share(near, light) < 0.01


def test_a_light_that_is_near_is_hidden_by_what_is_nearer_still() -> None:
    """Though a picture would cull it: a world of small units."""
    assert wall().near > 0.1
    assert share(wall(z=0.1), torch.tensor([0.0, 0.0, 0.15])) < 0.01


def test_an_edge_through_the_light_hides_half_of_it() -> None:
    reach = 0.022  # Gaussians of 0.008 and the rasterizer's low-pass go on so far past the last centre
    assert share(wall(x=0.5 + reach)) == pytest.approx(0.5, abs=0.08)
    shares = [share(wall(x=0.5 + reach + shift)) for shift in (-0.06, -0.03, 0.0, 0.03, 0.06)]
    assert shares == sorted(shares)
    assert shares[0] < 0.1 and shares[-1] > 0.9


def test_the_light_need_not_be_in_any_frame() -> None:
    """The small camera turns to the light: all directions are alike."""
    for axis in torch.eye(3):
        assert share(SceneGaussians.empty(), 4 * axis) == 1
        hidden = wall()
        turn = torch.linalg.qr(torch.stack([axis, *torch.randn(2, 3, generator=torch.Generator().manual_seed(0))]).T)[0]
        forward = turn[:, 0] * torch.sign(turn[:, 0] @ axis)
        rotation = torch.stack([turn[:, 1], torch.linalg.cross(forward, turn[:, 1]), forward])
        hidden.means.data = hidden.means.data @ rotation
        assert share(hidden, 4 * forward) < 0.01


def test_visibility_is_differentiable_by_the_occluder() -> None:
    scene = wall(opacity=0.3)
    light_visibility(scene, CAMERA, LIGHT, kernels="torch").backward()
    gradient = scene.opacity_logits.grad
    assert gradient is not None and float(gradient.min()) < 0 and float(gradient.max()) <= 1e-7


def test_what_always_stands_before_a_light_does_not_hide_it() -> None:
    """A haze before the light in all views is no occluder; a wall in one of them is."""
    haze = wall(half_width=3.0, opacity=0.06)
    model = FlareModel(["sun"], LIGHT[None], [some_flare(SMALL, 4).lights[0]])
    poses = []
    for x in torch.linspace(-0.5, 0.5, 12).tolist():
        pose = torch.eye(4)
        pose[0, 3] = -x
        poses.append(pose)
    settings = VisibilitySettings(radius=0.02)
    with torch.no_grad():
        raw = [float(light_visibility(haze, -pose[:3, 3], LIGHT, settings, kernels="torch")) for pose in poses]
        assert max(raw) < 0.7
        model.clear.copy_(clear_visibilities(haze, model, poses, settings, kernels="torch"))
        for pose in poses:
            assert float(light_visibilities(haze, model, pose, settings, "torch")["sun"]) == pytest.approx(1, abs=0.1)
        assert float(light_visibilities(wall(), model, torch.eye(4), settings, "torch")["sun"]) < 0.02
        walled = wall(half_width=3.0)
        model.clear.copy_(clear_visibilities(walled, model, poses, settings, kernels="torch"))
        assert float(model.clear) == 0
        assert float(light_visibilities(walled, model, torch.eye(4), settings, "torch")["sun"]) == 1


def test_clear_visibility_is_that_of_the_views_that_see_the_light() -> None:
    model = FlareModel(["sun"], LIGHT[None], [some_flare(SMALL, 4).lights[0]])
    poses = []
    for x in (*torch.linspace(-0.4, 0.4, 8).tolist(), 2.0, 3.0):
        pose = torch.eye(4)
        pose[0, 3] = -x
        poses.append(pose)
    assert float(clear_visibilities(wall(), model, poses, VisibilitySettings(radius=0.02), "torch")) > 0.99


def test_visibilities_are_relative_to_the_clear_one() -> None:
    half = torch.tensor(0.5)
    assert float(relative_to_clear(half, 1.0)) == 0.5
    assert float(relative_to_clear(half, 0.66)) == pytest.approx(0.5 / 0.66)
    assert float(relative_to_clear(half, 0.4)) == 1, "clearer than clear is clear"
    assert float(relative_to_clear(half, 0.0)) == 1, "a scene that hides a light from everywhere says nothing about it"
