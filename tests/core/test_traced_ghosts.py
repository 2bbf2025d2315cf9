# SPDX-License-Identifier: GPL-3.0-or-later
"""Ghosts measured one by one, and the first Gaussians at them."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from core.fit import traced_flare
from core.fit.traced_ghosts import MeasuredGhost, measure_ghosts, start_at_ghosts
from core.fit.traced_settings import TracedFlareSettings
from core.flare.model import OURS, LightFlare
from core.optics.flare import build_optics
from core.optics.ghosts import draw_ghosts

SMALL = {"lens": "US1998704", "tracing.width": 64, "tracing.bands": 1, "ghosts.count": 6}


def test_a_measured_ghost_is_where_it_is_drawn() -> None:
    settings = TracedFlareSettings().override(SMALL)
    setup, camera = traced_flare.setup_with_ghost_gain(settings), traced_flare.traced_camera(settings)
    lights = np.array([[0.04, 0.02], [-0.03, 0.03], [0.05, -0.02]])
    ghosts = measure_ghosts(setup, camera, lights, settings.colour)
    assert 3 <= len(ghosts) <= 6
    assert [ghost.light for ghost in ghosts] == sorted((ghost.light for ghost in ghosts), reverse=True)
    brightest = ghosts[0]
    optics, pairs = build_optics(setup)
    y, x = np.mgrid[:108, :192] + 0.5
    focal = camera.fx / camera.width * 64  # three times the frame
    light = lights[0]
    distances = []
    for pair in pairs:
        picture = draw_ghosts(optics, [pair], replace(setup.ghosts, supersample=1), (light[0], light[1]),
                              (focal, focal), (96, 54), 192, 108).sum(-1)
        if picture.sum() > 0:
            share = picture / picture.sum()
            centre = np.array([(share * (x - 96)).sum(), (share * (y - 54)).sum()]) / focal
            distances.append(np.linalg.norm(centre - brightest.place * light) / brightest.radius)
    assert min(distances) < 0.5


def test_the_first_gaussians_of_a_ghost_are_its_disc() -> None:
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    settings = TracedFlareSettings().override(SMALL)
    camera = traced_flare.traced_camera(settings)
    form = replace(OURS, light_correction=False)
    places = torch.tensor([[0.1, 0.1], [-0.1, -0.1]])
    query_range = traced_flare.QueryRange.of(torch.tensor([[-1e6] * 3, [1e6] * 3]), places, 0.2)
    flare = LightFlare(form, query_range, 80, generator, 1e-6)
    ghost = MeasuredGhost(-0.8, 0.04, (0.2, 0.1, 0.05), 0.1)
    rows = torch.arange(80)
    start_at_ghosts(flare, rows, [ghost, MeasuredGhost(0.5, 0.1, (1e-6, 1e-6, 1e-6), 1e-7)], generator)
    light = torch.tensor([0.08, 0.02])
    with torch.no_grad():
        for layer in (flare.network.head,):
            layer.weight *= 0
            layer.bias *= 0
        drawn = traced_flare._draw_flare(flare, light, traced_flare._intrinsics(camera), camera).numpy()
    weight = drawn.sum(-1)
    y, x = np.mgrid[:camera.height, :camera.width] + 0.5
    centre = np.array([(weight * (x - camera.cx)).sum(), (weight * (y - camera.cy)).sum()]) / weight.sum() / camera.fx
    np.testing.assert_allclose(centre, [-0.064, -0.016], atol=0.005)
    column, row = (int(value) for value in camera.fx * np.array([-0.064, -0.016]) + (camera.cx, camera.cy))
    level = drawn[row - 1:row + 2, column - 1:column + 2].mean((0, 1))
    np.testing.assert_allclose(level / level.mean(), np.array(ghost.level) / np.mean(ghost.level), rtol=0.01)
    assert 0.5 < level.mean() / np.mean(ghost.level) < 2  # so few pixels widen the Gaussians
    inside = np.hypot(x - camera.cx + 0.064 * camera.fx, y - camera.cy + 0.016 * camera.fx) < 0.055 * camera.fx
    assert weight[inside].sum() > 0.85 * weight.sum()


def test_places_of_the_light_are_denser_at_the_centre_and_reach_beyond_the_frame() -> None:
    settings = TracedFlareSettings()
    places = traced_flare.spread_places(settings) / settings.reach
    assert len(places) == settings.tracing.positions
    assert np.abs(places[:, 0]).max() == pytest.approx(settings.tracing.field, rel=0.1)
    assert (np.abs(places[:, 0]) < 0.3).mean() > 0.3
    assert 0.05 < (np.abs(places[:, 0]) > 1).mean() < 0.3
