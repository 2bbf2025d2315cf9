# SPDX-License-Identifier: GPL-3.0-or-later
"""What was learned on one grid of pixels looks alike on others."""
from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from core.bake.shot import ShotRenderer
from core.capture import Camera, Capture
from core.colour.srgb_torch import decode, encode
from core.conventions.pixel_grid import DILATION, MAX_PIXELS, PIXEL_VARIANCE, PixelGrid, dilation
from core.conventions.run_files import FLARE, SCENE
from core.errors import FlareFileError
from core.fit import Run, fit
from core.fit.rendering import render_scene
from core.fit.trainer import Trainer
from core.flare import file as flare_file
from core.flare.compositing import splat_flare
from core.flare.placement import PlaneGaussians
from core.gaussians import SceneGaussians
from core.gaussians.ply import read_ply, write_ply
from core.look import PlacedLight, draw, read_look, to_pixels
from core.look import PlaneGaussians as LookGaussians
from core.look.container import read_tensors, rewrite_metadata
from core.look.shot import Shot, ShotFrame
from tests.core.flared import HEIGHT, LIGHT, WIDTH, cameras, flared_capture
from tests.core.test_fit import quick

CAMERA = cameras(3)[1]
GRID = PixelGrid(CAMERA.focal_length, CAMERA.focal_length)


def at(times: float) -> Camera:
    return CAMERA.scaled(round(times * WIDTH), round(times * HEIGHT))


def reduced(picture: Any, times: int) -> Any:
    """Means of blocks."""
    height, width = picture.shape[0] // times, picture.shape[1] // times
    return picture.reshape(height, times, width, times, -1).mean((1, 3))


def same_places(picture: Any, times: int) -> Any:
    """The pixels of a picture, an odd number of times as large, whose middles are those of the small one's."""
    return picture[times // 2::times, times // 2::times]


def fine_scene(count: int = 400) -> SceneGaussians:
    """Return a random scene about the origin with many Gaussians thinner than a pixel, none fully bright or dark."""
    generator = torch.Generator().manual_seed(0)
    scene = SceneGaussians.empty(count)
    with torch.no_grad():
        scene.means.copy_(torch.randn((count, 3), generator=generator))
        scene.log_scales.copy_(torch.full((count, 3), 0.03).log() + torch.randn((count, 3), generator=generator))
        scene.quaternions.copy_(torch.randn((count, 4), generator=generator))
        scene.opacity_logits.fill_(2.0)
        scene.sh[:, 0] = torch.rand((count, 3), generator=generator) * 2 - 1
    return scene


def streaks() -> PlaneGaussians:
    """Two lines of light thinner than a pixel, and a thin ring."""
    line = [0.0400, 0.0, 1e-6]
    return PlaneGaussians(
        torch.tensor([[0.0, 0.003], [0.05, -0.1011], [-0.1, 0.05]]),
        torch.tensor([line, [0.01, 0.005, 0.00251], [0.01, 0.0, 0.01]]), torch.tensor([0.5, 0.7, 0.4]),
        torch.tensor([[1.0, 0.5, 0.2], [0.2, 0.9, 1.0], [1.0, 1.0, 1.0]]),
        torch.tensor([[0.0, 1.0], [0.0, 1.0], [1.0, 0.02]]))


def flare_at(camera: Camera, pixel_grid: PixelGrid | None) -> torch.Tensor:
    return splat_flare(streaks(), torch.from_numpy(camera.intrinsics).float(), *camera.size, "add",
                       pixel_grid=pixel_grid,
                       kernels="torch").colour


# ---- grids ----------------------------------------------------------------------------------------


def test_the_pixel_ratio_follows_the_focal_length() -> None:
    zoom = PixelGrid(500.0, 800.0)
    assert [zoom.pixel_ratio(focal) for focal in (250, 499.9, 500, 600, 800, 800.1, 1600)] == [0.5, 1, 1, 1, 1, 1, 2]
    assert PixelGrid.from_focal_lengths([600.0, 500.0, 800.0]) == zoom
    assert dilation(zoom, 650) == dilation(None, 9.0) == DILATION
    assert dilation(zoom, 1600) == pytest.approx(4 * DILATION)
    assert dilation(zoom, 50) == PIXEL_VARIANCE, "less, and thin ones fall between the pixels' middles"


def test_coarse_pictures_are_supersampled_up_to_a_limit() -> None:
    grid = PixelGrid(1000.0, 1000.0)
    factors = [grid.supersampling_factor(focal, 100, 50) for focal in (2000, 1000, 990, 940, 500, 400, 100)]
    assert factors == [1, 1, 1, 2, 2, 3, 10]
    assert grid.supersampling_factor(1.0, 1920, 1080) ** 2 * 1920 * 1080 <= MAX_PIXELS
    assert grid.supersampling_factor(500.0, 8192, 4320) == 1


@pytest.mark.parametrize("lengths", [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0, math.inf), (math.nan, 1.0),
                                     (1.0, math.nan)])
def test_invalid_focal_lengths_are_refused(lengths: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="focal lengths"):
        PixelGrid(*lengths)


# ---- flares ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("times", [3, 5])
def test_a_flare_on_a_finer_grid_equals_the_fit(times: int) -> None:
    own = flare_at(CAMERA, GRID)
    assert torch.equal(own, flare_at(CAMERA, None)), "as it was learned"
    kept, lost = (flare_at(at(times), pixel_grid) for pixel_grid in (GRID, None))
    assert torch.allclose(same_places(kept, times), own, atol=1e-3)
    assert float(kept.mean()) == pytest.approx(float(own.mean()), rel=0.01)
    assert float(lost.mean()) < 0.8 * float(own.mean()), "what thin ones lost before"


def test_a_flare_on_a_coarser_grid_keeps_its_light() -> None:
    own = float(flare_at(CAMERA, GRID).mean())
    assert float(flare_at(at(0.5), GRID).mean()) == pytest.approx(own, rel=0.1)
    assert float(flare_at(at(0.5), None).mean()) > 1.5 * own


@pytest.mark.parametrize("times", [0.25, 0.5, 1, 2])
def test_numpy_and_torch_filter_alike(times: float) -> None:
    camera, some = at(times), streaks()
    twin = LookGaussians(*(None if part is None else part.numpy() for part in some))  # type: ignore[arg-type]
    theirs = flare_at(camera, GRID).numpy()
    assert np.abs(draw([twin], camera.intrinsics, *camera.size, "add", GRID) - theirs).max() < 1e-3 * theirs.max()
    assert to_pixels(twin, camera.intrinsics, GRID)[1][0, 2] == pytest.approx(
        1e-6 * camera.fy**2 + max(0.3 * times**2, 1 / 12), rel=1e-4)


# ---- scenes ---------------------------------------------------------------------------------------


def test_a_scene_on_a_finer_grid_equals_the_fit() -> None:
    scene = fine_scene()
    with torch.no_grad():
        own, broken = (render_scene(scene, camera).colour for camera in (CAMERA, at(3)))
        scene.pixel_grid = GRID
        assert torch.equal(render_scene(scene, CAMERA).colour, own), "as it was learned"
        kept = render_scene(scene, at(3)).colour
    assert torch.allclose(same_places(kept, 3), own, atol=1e-3)
    assert float((same_places(broken, 3) - own).abs().max()) > 0.2, "what thin ones lost before"


def test_a_scene_on_a_coarser_grid_is_the_fit_averaged_in_light() -> None:
    scene = fine_scene()
    scene.pixel_grid = GRID
    with torch.no_grad():
        own, small = render_scene(scene, CAMERA), render_scene(scene, at(0.5))
    expected = encode(reduced(decode(own.colour), 2))
    assert torch.allclose(small.colour, expected, atol=1e-5)
    assert torch.allclose(small.alpha, reduced(own.alpha, 2)[..., 0], atol=1e-5)
    assert small.depth.shape == small.median_depth.shape == small.alpha.shape
    seen = small.alpha > 0.01
    assert (small.depth[seen] > 1).all() and (small.depth[small.alpha == 0] == 0).all(), "in world units, not thinned"
    assert torch.allclose(small.centres * 2, own.centres, atol=1e-3)
    assert render_scene(scene, at(0.5), depth=False).depth.numel() == 0


# ---- files ----------------------------------------------------------------------------------------


def test_the_pixel_grid_of_a_scene_is_stored_in_its_ply(tmp_path: Path) -> None:
    scene = fine_scene(3)
    scene.pixel_grid = PixelGrid(512.25, 1024.5)
    write_ply(tmp_path / "a.ply", scene)
    assert read_ply(tmp_path / "a.ply").pixel_grid == scene.pixel_grid
    said = (tmp_path / "a.ply").read_bytes()
    for lengths in (b"0 1", b"nan nan", b"5 inf", b"9 5", b"far near", b"5", b""):
        (tmp_path / "b.ply").write_bytes(said.replace(b"512.25 1024.5", lengths))
        assert read_ply(tmp_path / "b.ply").pixel_grid is None, lengths


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Of the flared capture, at half the size of its frames."""
    folder = tmp_path_factory.mktemp("sampling")
    capture = Capture.open(flared_capture(folder / "capture", count=6, dots=80))
    return fit(capture, quick(20, **{"width": WIDTH // 2}), folder / "run")


def test_a_fit_stores_its_pixel_grid(run: Run) -> None:
    half = CAMERA.focal_length / 2
    assert run.scene.pixel_grid == run.look.pixel_grid == run.flare.pixel_grid == PixelGrid(half, half)  # type: ignore[union-attr]
    own, large = (run.render(at(times)) for times in (0.5, 1))
    for small, big in ((own.scene, large.scene), *zip(own.flare_by_light.values(), large.flare_by_light.values(),
                                                      strict=True)):
        assert float(big.mean()) == pytest.approx(float(small.mean()), rel=0.01)


def test_a_shot_and_its_run_render_alike(run: Run) -> None:
    camera = at(2)
    light = PlacedLight("lamp", run.lights[0], np.array(LIGHT), 1.0)
    one = ShotFrame("shot", 1, camera, (light,))
    shown = ShotRenderer(Shot(run.folder / FLARE, (one,), run=run.folder)).render(one, camera)
    layers = run.render(camera)
    assert np.allclose(shown.scene, layers.scene, atol=1e-5)


def test_a_fit_that_continues_a_scene_has_a_new_grid(run: Run) -> None:
    capture = Capture.open(run.capture_folder)
    begun = {"scene.start": str(run.folder / SCENE), "width": 0}
    assert Trainer(capture, quick(20, **begun)).scene.pixel_grid is None
    frozen = Trainer(capture, quick(20, **begun, **{"scene.frozen": True}))
    assert frozen.scene.pixel_grid == run.scene.pixel_grid, "it stays as it is"


def test_a_flare_with_a_damaged_grid_is_refused(run: Run, tmp_path: Path) -> None:
    _, metadata = read_tensors(run.folder / FLARE)
    description = json.loads(metadata["fit_flare"])
    for entry in ({"least": 0, "most": 1}, {"least": 5}, [1, 2], "far", {"least": "a", "most": "b"}, 7):
        rewrite_metadata(run.folder / FLARE, tmp_path / "a.flare",
                  {**metadata, "fit_flare": json.dumps({**description, "sampling": entry})})
        for reader in (read_look, flare_file.load):
            with pytest.raises(FlareFileError, match=r"a\.flare is damaged"):
                reader(tmp_path / "a.flare")
    del description["sampling"]  # as fits wrote it before
    rewrite_metadata(run.folder / FLARE, tmp_path / "a.flare", {**metadata, "fit_flare": json.dumps(description)})
    assert read_look(tmp_path / "a.flare").pixel_grid is None
    assert flare_file.load(tmp_path / "a.flare").pixel_grid is None
    assert replace(GRID, min_focal_length=1.0).pixel_ratio(2.0) == 1
