# SPDX-License-Identifier: GPL-3.0-or-later
"""Pairs that are composed all at once are those that are made one by one, and come out of what processes draw."""
from __future__ import annotations

import math
import multiprocessing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from core.errors import RunError
from core.optics.prescription import built_in_lenses
from core.removal.model.image_formation import add_under_shoulder
from core.removal.model.network import SIZE_MULTIPLE
from core.removal.model.recipe import Recipe
from core.removal.synthesis import flare
from core.removal.training import pairs, random_cameras, run
from core.removal.training.backgrounds import Backgrounds
from core.removal.training.gpu import composition, cuda_graphs, jpeg, pools
from core.removal.training.gpu.batches import compose_batches, open_gpu_batches
from core.removal.training.trainer import RemovalTrainer

CPU = torch.device("cpu")
CANVAS, WIDTH, HEIGHT = 96, 96, 64
RECIPE = Recipe(iterations=4, size_stages=((1.0, 64, 96),), pixels_per_iteration=30_000, widths=(8,) * 5,
                canvas_size=CANVAS, warmup_iterations=1)
NOTHING = replace(RECIPE, clean_share=0, against_light_share=0, shoulder_share=0, grey_share=0, lifted_black_share=0)


def flat() -> Backgrounds:
    """Scenes of one grey."""
    return Backgrounds([np.full((64, 64, 3), 128, np.uint8)], [])


def made(seed: int, kind: str | None = None) -> pairs.FlareLayers:
    one = flare.synthesise_flare(seed, CANVAS, built_in_lenses(), kind)
    return pairs.FlareLayers(one.rest, one.glow, one.light, one.lights, np.array([1, 0.5, 0.25], np.float32))


def together(some: list[pairs.FlareLayers]) -> composition.FlareBatch:
    """Return flares of single pictures as one batch of the GPU's composition."""
    count = len(some)
    lights = torch.zeros(count, composition.MAX_LIGHTS, 2)
    is_light = torch.zeros(count, composition.MAX_LIGHTS, dtype=torch.bool)
    for row, one in enumerate(some):
        for number, place in enumerate(one.lights):
            lights[row, number] = torch.tensor(place)
            is_light[row, number] = True
    planes = [np.concatenate([one.rest, one.glow, one.light], -1).transpose(2, 0, 1) for one in some]
    colours = torch.from_numpy(np.stack([one.colour for one in some]))
    return composition.FlareBatch(torch.from_numpy(np.stack(planes)), lights, is_light, colours)


def test_batched_warping_equals_that_of_single_pairs() -> None:
    """But for the 32nds of a pixel to which OpenCV rounds."""
    some = [made(seed, kind) for seed, kind in enumerate((*flare.FLARE_CLASSES, *flare.FLARE_CLASSES))]
    matrices, shining, expected = [], [], []
    for seed, one in enumerate(some):
        random = np.random.default_rng(seed)
        matrices.append(random_cameras.draw_placement(random, CANVAS, WIDTH, HEIGHT))
        shining.append(random_cameras.draw_appearance(random, 0.8))
        expected.append(pairs._flare_on_frame(one, shining[-1], matrices[-1], WIDTH, HEIGHT))
    blurs, colours, gains, mosts = (np.array(part) for part in zip(*shining, strict=True))
    assert 1 < (blurs > 0).sum() < len(some) - 1
    how = composition.FlarePlacements(np.array(matrices), blurs, colours[..., None, None], gains[:, None, None, None],
                                      mosts[:, None, None, None]).to(CPU)
    found = composition._flare_on_frame(together(some), how, how.matrices, HEIGHT, WIDTH)
    for row, apart in enumerate(expected):
        for one, other in zip(found, apart, strict=True):
            batched = one[row].permute(1, 2, 0).numpy()
            assert np.abs(batched - other).mean() < 0.01 * max(float(other.mean()), 0.02), flare.FLARE_CLASSES[row % 8]


@pytest.mark.parametrize("quality", [60, 75, 90])
def test_simulated_jpeg_matches_opencv(quality: int) -> None:
    random = np.random.default_rng(3)
    noise = cv2.GaussianBlur(random.random((64, 96, 3)).astype(np.float32), (0, 0), 1.5)
    picture = np.round(np.clip((noise - 0.5) * 4 + 0.5, 0, 1) * 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    expected = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(np.float32)
    codes = torch.from_numpy(picture[..., ::-1].astype(np.float32)).permute(2, 0, 1)[None]
    found = jpeg.simulate_jpeg(codes, torch.tensor([float(quality)]))[0].permute(1, 2, 0).numpy()[..., ::-1]
    lost, otherwise = (float(np.sqrt(np.square(one - picture).mean())) for one in (expected, found))
    assert otherwise == pytest.approx(lost, rel=0.05)
    assert np.sqrt(np.square(found - expected).mean()) < 0.4 * lost


def test_placements_put_lights_where_the_scene_is_bright() -> None:
    flares = together([made(seed, "scatter") for seed in range(6)])
    how = composition.draw_flare_placements(np.random.default_rng(1), 6, CANVAS, WIDTH, HEIGHT).to(CPU)
    scene = torch.zeros(6, 3, HEIGHT, WIDTH)
    scene[..., 16:32, 32:64] = 1
    faces_light = torch.tensor([1, 1, 1, 0, 0, 1]) > 0
    matrix, bright = composition._choose_placement(flares, how.matrices, scene, faces_light)
    for row in range(6):
        x, y = composition._canvas_to_frame(how.matrices[row][None], flares.lights[row, :1], flares.size)[0].unbind(-1)
        inside = ((x // 16).clamp(2, 3) == x // 16) & (y // 16 == 1)
        assert float(bright[row]) == float(inside.any() if faces_light[row] else inside[0])
        assert torch.equal(matrix[row], how.matrices[row, 0]) or faces_light[row]


def test_a_composed_frame_is_scene_light_rest_and_glow() -> None:
    count = 8
    random = np.random.default_rng(2)
    scene = torch.from_numpy(random.uniform(0.1, 0.4, (count, 3, HEIGHT, WIDTH)).astype(np.float32))
    gamma = torch.full((count,), 2.0)
    flares = together([made(seed, "glow") for seed in range(count)])
    how = composition.draw_flare_placements(random, count, CANVAS, WIDTH, HEIGHT).to(CPU)

    def compose(**changes: torch.Tensor) -> tuple[torch.Tensor, ...]:
        plain = composition.draw_frame_parameters(np.random.default_rng(5), count, NOTHING)
        as_it_is = {"exposure": 1, "mirrored": 0, "grain": 0, "contrast": 0, "saturation": 1, "lift": 0,
                    "jpeg_quality": 0}
        numbers = {name: np.full_like(getattr(plain, name), value, np.float32) for name, value in as_it_is.items()}
        filmed = replace(replace(plain, **numbers).to(CPU), **changes)
        return composition.compose(scene, gamma, filmed, [(flares, how)])

    rest, glow, light = composition._flare_on_frame(flares, how, how.matrices[:, 0], HEIGHT, WIDTH)
    frame, clear, gentle = compose()
    assert torch.allclose(clear, (scene + light).clamp(0, 1).sqrt(), atol=1e-6)
    assert torch.allclose(gentle, (scene + light + glow).clamp(0, 1).sqrt(), atol=1e-6)
    assert torch.allclose(frame, (scene + light + rest + glow).clamp(0, 1).sqrt(), atol=0.71 / 255)
    assert torch.equal((frame * 255).round() / 255, frame), "in 8 bits"
    none = torch.zeros(count, 1, 1, 1)
    frame, clear, gentle = compose(has_flare=none)
    assert torch.equal(frame, clear) and torch.equal(gentle, clear)
    frame, clear, _ = compose(has_flare=none, has_lights=none)
    assert torch.allclose(clear, scene.sqrt(), atol=1e-6)
    _, _, gentle = compose(shoulder=none + 0.5)
    expected = add_under_shoulder((scene + light).numpy(), glow.numpy(), 0.5)
    assert np.allclose(gentle.numpy(), np.sqrt(expected.clip(0, 1)), atol=1e-5)
    black, white = torch.full((count, 3, 1, 1), 0.1), torch.full((count, 3, 1, 1), 0.9)
    _, faded, _ = compose(black=black, white=white)
    assert torch.allclose(faded, 0.1 + 0.8 * compose()[1], atol=1e-6)
    channels = torch.zeros(count, 3, 3)
    channels[:, :, 1] = 1
    _, grey, _ = compose(channels=channels)
    assert torch.allclose(grey, compose()[1][:, 1:2].expand_as(grey), atol=1e-6)


def test_a_second_flare_is_added_to_the_first_frames_alone() -> None:
    scene, gamma = torch.full((3, 3, HEIGHT, WIDTH), 0.2), torch.full((3,), 2.0)
    flares = together([made(seed, "glow") for seed in range(3)])
    random = np.random.default_rng(2)
    filmed = composition.draw_frame_parameters(random, 3, NOTHING).to(CPU)
    how = composition.draw_flare_placements(random, 3, CANVAS, WIDTH, HEIGHT).to(CPU)
    second = composition.draw_flare_placements(random, 1, CANVAS, WIDTH, HEIGHT, is_second=True).to(CPU)
    shown = []
    for over in ([(flares, how)], [(flares, how), (composition.FlareBatch(*(part[:1] for part in flares)), second)]):
        torch.manual_seed(1)
        shown.append(composition.compose(scene, gamma, filmed, over)[2])
    assert (shown[1] - shown[0])[0].max() > 0.01
    assert torch.equal(shown[1][1:], shown[0][1:])


def test_drawn_parameters_have_the_recipe_s_shares() -> None:
    recipe = replace(RECIPE, clean_share=0.3, against_light_share=0.4, shoulder_share=0.2, grey_share=0.1,
                     lifted_black_share=0.25)
    filmed = composition.draw_frame_parameters(np.random.default_rng(0), 4000, recipe)
    shares = {"clean_share": filmed.has_flare == 0, "against_light_share": filmed.faces_light,
              "shoulder_share": filmed.shoulder > 0,
              "grey_share": filmed.channels[:, 0, 0] + filmed.channels[:, 1, 1] + filmed.channels[:, 2, 2] < 2,
              "lifted_black_share": filmed.white[:, 0] < 1}
    for name, found in shares.items():
        assert np.mean(found) == pytest.approx(getattr(recipe, name), abs=0.03), name
    assert filmed.channels.sum(-1) == pytest.approx(1)


def test_pools_are_filled_by_processes_and_trained_on() -> None:
    shapes = pools.frame_shapes(RECIPE, SIZE_MULTIPLE)
    assert sum(shape.share for shape in shapes) == pytest.approx(1)
    assert {(shape.width, shape.height) for shape in shapes} == {(96, 64), (64, 64), (64, 96)}
    filled = pools.Pools(shapes, CANVAS, CPU, scene_count=100, flare_count=6)
    trainer = RemovalTrainer(RECIPE)
    with pools.keep_pools_filled(filled, RECIPE, flat(), built_in_lenses(), None, 2):
        assert len(multiprocessing.active_children()) == 2
        drawn = compose_batches(filled, RECIPE, np.random.default_rng(1))
        for _ in range(8):
            batch = next(drawn)
            count, _, height, width = batch.frame.shape
            assert count == round(RECIPE.pixels_per_iteration / (width * height))
            for part in batch[:3]:
                assert part.shape == batch.frame.shape and part.dtype == torch.float32
                assert float(part.min()) >= 0 and float(part.max()) <= 1
        figures = trainer.step(batch)
        assert math.isfinite(figures["loss"]) and figures["untouched"] > 0
    assert not multiprocessing.active_children()
    assert filled.flares_stored >= 6 and min(filled.scenes_stored) >= pools.SCENES_PER_BLOCK
    scenes, gammas = filled.sample_scenes(np.random.default_rng(0), 0)
    assert torch.allclose(scenes.float(), ((128 / 255) ** gammas)[:, None, None, None].expand_as(scenes), atol=1e-3)
    assert 1.8 <= float(gammas.min()) <= float(gammas.max()) <= 2.2
    some = filled.sample_flares(np.random.default_rng(0), 5)
    assert some.layers.shape == (5, 9, CANVAS, CANVAS) and some.is_light.any() and (some.colour > 0).any()


def test_pool_sizes_fit_the_free_memory_of_a_gpu() -> None:
    shapes = pools.frame_shapes(replace(RECIPE, size_stages=((1.0, 256, 480),)), SIZE_MULTIPLE)
    assert {(shape.width, shape.height) for shape in shapes} == {(480, 320), (384, 256), (480, 256), (320, 480),
                                                                 (352, 352)}
    assert pools.pool_sizes(80 << 30, shapes, 384) == (pools.MAX_SCENES, pools.MAX_FLARES)
    for free in (6 << 30, 24 << 30):
        scenes, flares = pools.pool_sizes(free, shapes, 384)
        assert 0.38 * free < scenes * 6 * 480 * 320 * 0.83 + flares * 18 * 384**2 < 0.42 * free
        assert scenes > 3 * flares > 1000
    assert min(pools.pool_sizes(0, shapes, 384)) >= 1


def test_drawing_processes_that_end_raise_an_error() -> None:
    filled = pools.Pools(pools.frame_shapes(RECIPE, SIZE_MULTIPLE), CANVAS, CPU, scene_count=8, flare_count=2)
    with pytest.raises(RunError, match="draw pictures for the training ended"), \
            pools.keep_pools_filled(filled, RECIPE, Backgrounds([], []), built_in_lenses(), None, 2):
        pass
    assert not multiprocessing.active_children()


def test_a_graphed_function_is_called_directly_on_a_cpu() -> None:
    calls = []

    def work(one: torch.Tensor) -> list[torch.Tensor]:
        calls.append(one)
        return [one * 2]

    twice = cuda_graphs.GraphedFunction(work)
    assert torch.equal(twice(torch.ones(2))[0], torch.full((2,), 2.0))
    assert torch.equal(twice(torch.zeros(2))[0], torch.zeros(2))
    assert len(calls) == 2


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU")
def test_a_training_runs_on_a_gpu(tmp_path: Path) -> None:
    card = torch.device("cuda")
    twice = cuda_graphs.GraphedFunction(lambda one: [one * 2, one.sum()])
    for side in (3, 5, 3):
        given = torch.rand(side, side, device=card)
        doubled, whole = twice(given)
        assert torch.equal(doubled, given * 2) and torch.allclose(whole, given.sum())
    with open_gpu_batches(RECIPE, 0, flat(), built_in_lenses(), None, card, 2) as drawn:
        batch = next(drawn)
        trainer, plain = RemovalTrainer(RECIPE), RemovalTrainer(RECIPE)
        trainer.step(batch)
        loss, figures = plain.loss(batch)
        loss.backward()
        assert trainer.step(batch)["loss"] == pytest.approx(figures["loss"], rel=0.02), "of the step before"
    assert run.train(RECIPE, tmp_path, flat(), built_in_lenses(), processes=3).is_file()
