# SPDX-License-Identifier: GPL-3.0-or-later
"""Layers that numpy draws and writes without an engine, against the definition, the engine and OpenEXR's reader."""
from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from core.bake.exr import read_description, read_layers
from core.bake.shot import ShotRenderer
from core.bake.shot_frames import LookRenderer, bake_shot_frames
from core.choices import Blend
from core.colour.srgb import linear_from_srgb
from core.errors import SettingsError
from core.fit.rendering import splat_look
from core.flare.compositing import linear_layers
from core.images.exr import read_exr, read_exr_header
from core.images.formats.exr_writer import write_scanlines
from core.look import PlacedLight, PlaneGaussians, draw, read_look
from core.look.pyramid import draw_added, draw_layers
from core.look.shot import Shot, ShotFrame
from tests.core.flared import LIGHT, cameras
from tests.core.test_look import saved


def a_look(path: Path, blend: Blend) -> Path:
    torch.manual_seed(0)
    saved(path, lights=1, blend=blend)
    return path


def gaussians(count: int = 300) -> PlaneGaussians:
    """Return random needles, discs and rings, from a third of a pixel to the whole picture, some of them arcs, some
    outside."""
    random = np.random.default_rng(3)
    long, turn = 10 ** random.uniform(-3, -0.2, count), random.uniform(0, np.pi, count)
    short = np.maximum(long * 10 ** random.uniform(-2, 0, count), 0.0006)
    c, s = np.cos(turn), np.sin(turn)
    covariances = np.stack([long**2 * c * c + short**2 * s * s, (long**2 - short**2) * c * s,
                            long**2 * s * s + short**2 * c * c], -1)
    rings = np.stack([random.choice([0, 1.5, 3], count), random.uniform(0.2, 1, count)], -1)
    arcs = 0.4 * short[:, None] * random.normal(size=(count, 2)) * (random.random((count, 1)) < 0.3)
    parts = (random.uniform(-0.7, 0.7, (count, 2)), covariances, random.uniform(0.1, 2, count),
             random.uniform(0, 1, (count, 3)), rings, arcs)
    return PlaneGaussians(*(np.asarray(part, np.float32) for part in parts))


@pytest.mark.parametrize(("width", "height"), [(251, 143), (96, 320)])
def test_a_pyramid_of_grids_draws_what_the_definition_draws(tmp_path: Path, width: int, height: int) -> None:
    look = read_look(a_look(tmp_path / "a.flare", "add"))
    k = np.array([[0.9 * width, 0, width / 2 + 3], [0, 0.9 * width, height / 2 - 2], [0, 0, 1.0]])
    drawn = draw_added(gaussians(), look, k, width, height)
    exact = draw([gaussians()], k, width, height, "add", look.pixel_grid)
    assert drawn.shape == exact.shape
    np.testing.assert_allclose(drawn, exact, rtol=6e-3, atol=6e-3)
    assert np.abs(drawn - exact).mean() < 1e-4 * exact.mean()
    assert exact.max() > 1


@pytest.mark.parametrize("blend", ["add", "over"])
def test_layers_without_an_engine_are_those_of_the_engine(tmp_path: Path, blend: Blend) -> None:
    look = read_look(a_look(tmp_path / "a.flare", blend))
    camera = replace(cameras(1)[0].scaled(96), exposure=1.5)
    seen = look.evaluate_lights(camera.world_to_camera, [
        PlacedLight("key", look.names[0], np.array(LIGHT)), PlacedLight("rim", look.names[0], np.array(LIGHT) * 0.9)])
    assert len(seen) == 2
    engine = linear_layers(torch.zeros(camera.height, camera.width, 3),
                           {name: splat_look(look, one, camera) for name, one in seen.items()}, blend)
    numpy = draw_layers(look, {name: one.with_exposure(1.5, blend) for name, one in seen.items()}, camera.intrinsics,
                        camera.width, camera.height)
    for name, layer in numpy.items():
        np.testing.assert_allclose(layer, engine.flares[name].numpy(), atol=1e-3)
        assert layer.max() > 0.01, "a flare is drawn"


def test_a_flare_that_covers_a_brighter_one_has_a_negative_layer_in_every_bake(tmp_path: Path) -> None:
    flare = a_look(tmp_path / "a.flare", "over")
    look = read_look(flare)
    camera = cameras(1)[0].scaled(96)
    lights = (PlacedLight("red", look.names[0], np.array(LIGHT), factor=(1.0, 0.0, 0.0)),
              PlacedLight("white", look.names[0], np.array(LIGHT)))
    frame = ShotFrame(1, "Camera", camera, lights)
    engine, numpy = (kind(Shot(flare, (frame,))).render(frame, camera) for kind in (ShotRenderer, LookRenderer))
    seen = look.evaluate_lights(camera.world_to_camera, lights)
    exact = linear_from_srgb(draw(seen.values(), camera.intrinsics, camera.width, camera.height, "over",
                                  look.pixel_grid))
    for layers in (engine, numpy):
        assert layers.flare_by_light["red"][..., 1].min() < -0.005
        np.testing.assert_allclose(sum(layers.flare_by_light.values()), exact, atol=1e-3)


def test_a_shot_bakes_without_torch_and_opencv_and_openexr(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flare = a_look(tmp_path / "a.flare", "add")
    name = read_look(flare).names[0]
    frames = tuple(ShotFrame(number, "Camera", camera.scaled(64), (PlacedLight("lamp", name, np.array(LIGHT)),),
                             ("lamp.intensity=0.5", "lamp.scale=1.2"))
                   for number, camera in enumerate(cameras(2), 1))
    shot = Shot(flare, frames)
    exact = {frame.frame: read_layers(tmp_path / "engine" / f"layers.{frame.frame:04d}.exr") for frame in frames
             if bake_shot_frames(ShotRenderer(shot), tmp_path / "engine")}
    for module in ("OpenEXR", "cv2"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    bake_shot_frames(LookRenderer(shot), tmp_path / "numpy")
    kept = (tmp_path / "numpy" / "layers.0001.exr").stat().st_mtime_ns
    bake_shot_frames(LookRenderer(shot), tmp_path / "numpy")  # resumes
    assert (tmp_path / "numpy" / "layers.0001.exr").stat().st_mtime_ns == kept
    monkeypatch.undo()
    for number, layers in exact.items():
        path = tmp_path / "numpy" / f"layers.{number:04d}.exr"
        drawn = read_layers(path)
        np.testing.assert_allclose(drawn.flares["lamp"], layers.flares["lamp"], atol=3e-3)
        assert not drawn.scene.any() and layers.flares["lamp"].max() > 0.02
        assert read_description(path) == read_description(tmp_path / "engine" / path.name)
        assert (read_exr_header(path)["chromaticities"]
                == read_exr_header(tmp_path / "engine" / path.name)["chromaticities"])
    with pytest.raises(SettingsError, match="engine only"):
        LookRenderer(replace(shot, run=tmp_path))


@pytest.mark.parametrize(("width", "height"), [(1, 1), (33, 17), (40, 64)])
def test_an_exr_that_numpy_writes_is_read_exactly(tmp_path: Path, width: int, height: int) -> None:
    random = np.random.default_rng(0)
    channels: dict[str, Any] = {
        "R": random.normal(size=(height, width)).astype(np.float16), "depth.Z": np.full((height, width), 1e10, "f4"),
        "a_layer_whose_name_is_longer_than_31_letters.G": np.zeros((height, width), np.float16),
        "noise.B": random.integers(0, 2**15 - 1024, (height, width)).astype(np.uint16).view(np.float16)}
    write_scanlines(tmp_path / "a.exr", channels, {
        "software": "Straße", "pixelAspectRatio": 2.0, "chromaticities": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3, 0.3),
        "dataWindow": ((-2, -1), (width - 3, height - 2)), "displayWindow": ((0, 0), (99, 49))})
    found, header = read_exr(tmp_path / "a.exr"), read_exr_header(tmp_path / "a.exr")
    assert set(found) == set(channels)
    for name, pixels in channels.items():
        np.testing.assert_array_equal(found[name], pixels.astype(np.float32))
    assert header["software"] == "Straße" and header["pixelAspectRatio"] == 2
    assert np.asarray(header["dataWindow"]).tolist() == [[-2, -1], [width - 3, height - 2]]
    assert np.allclose(header["chromaticities"], (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3, 0.3))
