# SPDX-License-Identifier: GPL-3.0-or-later
"""The element that is brightest at a point of the picture, against drawn pictures of the elements."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.capture import LightExtent
from core.choices import Blend
from core.colour.srgb import LUMINANCE
from core.look import Edit, Look, LookEdits, PlacedLight, draw, read_look
from core.look.picking import MIN_LIGHT, brightest_element, light_at
from tests.core.flared import LIGHT, cameras
from tests.core.test_look import saved
from tests.core.test_look_layers import gaussians

CAMERA = cameras(1)[0].scaled(96)
LIGHTS = (PlacedLight("a", "lamp 0", np.array(LIGHT)), PlacedLight("b", "lamp 0", 0.8 * np.array(LIGHT)))
SOURCES = {light.name: light.source for light in LIGHTS}
POINTS = [(x, y) for x in range(3, CAMERA.width, 9) for y in range(3, CAMERA.height, 9)]


@pytest.mark.parametrize("blend", ["add", "over"])
def test_the_light_at_a_point_is_that_of_the_drawn_picture(blend: Blend) -> None:
    flares, k = gaussians(), CAMERA.intrinsics
    picture = draw([flares], k, CAMERA.width, CAMERA.height, blend) @ LUMINANCE
    for x, y in POINTS:
        assert light_at(flares, k, (x + 0.5, y + 0.5), blend).sum() == pytest.approx(picture[y, x], rel=2e-3, abs=1e-4)


def drawn_elements(look: Look, lights: tuple[PlacedLight, ...], edits: LookEdits) -> dict[tuple[str, str], np.ndarray]:
    """Return the luminance (h, w) of each visible element drawn alone, by names of light and element."""
    pictures = {}
    for light in lights:
        names = look.element_names[light.source]
        for name in names:
            if edits.elements.get((light.name, name), Edit()).mute:
                continue
            alone = replace(edits, elements={**edits.elements, **{
                (light.name, other): replace(edits.elements.get((light.name, other), Edit()), mute=other != name)
                for other in names}})
            flares = look.evaluate_lights(CAMERA.world_to_camera, [light], alone)
            pictures[light.name, name] = draw(flares.values(), CAMERA.intrinsics, CAMERA.width, CAMERA.height,
                                              look.blend, look.pixel_grid) @ LUMINANCE
    return pictures


@pytest.mark.parametrize("is_extended", [False, True])
def test_the_brightest_element_is_that_of_the_brightest_picture(is_extended: bool, tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1, count=60)
    look = read_look(tmp_path / "a.flare")
    lights = tuple(replace(light, extent=LightExtent.sphere(0.2)) for light in LIGHTS) if is_extended else LIGHTS
    names = look.element_names["lamp 0"]
    assert len(names) > 1
    edits = LookEdits(Edit(), {"b": Edit(intensity=0.4)}, {
        ("a", names[0]): Edit(mute=True), ("b", names[1]): Edit(intensity=2.0, scale=1.5)})
    pictures = drawn_elements(look, lights, edits)
    flares = look.evaluate_lights(CAMERA.world_to_camera, lights, edits)
    picked = set()
    for x, y in POINTS:
        by_light = sorted(pictures, key=lambda key: pictures[key][y, x], reverse=True)
        first, second = (float(pictures[key][y, x]) for key in by_light[:2])
        found = brightest_element(look, SOURCES, flares, edits, CAMERA.intrinsics, (x + 0.5, y + 0.5))
        if first < 0.9 * MIN_LIGHT:
            assert found is None
        elif first > 1.01 * second and first > 1.1 * MIN_LIGHT:
            assert found == by_light[0]
            picked.add(found)
    assert len(picked) > 1 and ("a", names[0]) not in picked


def test_nothing_is_picked_without_a_flare(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    look = read_look(tmp_path / "a.flare")
    assert brightest_element(look, SOURCES, {}, LookEdits(), CAMERA.intrinsics, (5, 5)) is None
    flares = look.evaluate_lights(CAMERA.world_to_camera, LIGHTS)
    assert brightest_element(look, SOURCES, flares, LookEdits(), CAMERA.intrinsics, (1e6, 1e6)) is None
