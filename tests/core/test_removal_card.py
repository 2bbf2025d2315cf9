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
from core.removal.model.image_formation import under_shoulder
from core.removal.model.network import MULTIPLE
from core.removal.model.recipe import Recipe
from core.removal.synthesis import flare
from core.removal.synthesis.prescription import built_in
from core.removal.training import pairs, random_cameras, run
from core.removal.training.backgrounds import Backgrounds
from core.removal.training.gpu import composition, cuda_graphs, jpeg, pools
from core.removal.training.gpu.batches import batches, drawn_on_card
from core.removal.training.trainer import Trainer

CPU = torch.device("cpu")
CANVAS, WIDTH, HEIGHT = 96, 96, 64
RECIPE = Recipe(iterations=4, stages=((1.0, 64, 96),), pixels=30_000, widths=(8,) * 5, canvas=CANVAS, warm=1)
NOTHING = replace(RECIPE, clean=0, against_light=0, shoulder=0, grey=0, faded=0)


def flat() -> Backgrounds:
    """Scenes of one grey."""
    return Backgrounds([np.full((64, 64, 3), 128, np.uint8)], [])


def made(seed: int, kind: str | None = None) -> pairs.Layers:
    one = flare.flare(seed, CANVAS, built_in(), kind)
    return pairs.Layers(one.rest, one.glare, one.light, one.lights, np.array([1, 0.5, 0.25], np.float32))


def together(some: list[pairs.Layers]) -> composition.Flares:
    count = len(some)
    lights, there = torch.zeros(count, composition.LIGHTS, 2), torch.zeros(count, composition.LIGHTS, dtype=torch.bool)
    for row, one in enumerate(some):
        for number, place in enumerate(one.lights):
            lights[row, number] = torch.tensor(place)
            there[row, number] = True
    planes = [np.concatenate([one.rest, one.glare, one.light], -1).transpose(2, 0, 1) for one in some]
    colours = torch.from_numpy(np.stack([one.colour for one in some]))
    return composition.Flares(torch.from_numpy(np.stack(planes)), lights, there, colours)


def test_flares_are_laid_over_frames_as_one_by_one() -> None:
    """But for the 32nds of a pixel to which OpenCV rounds."""
    some = [made(seed, kind) for seed, kind in enumerate((*flare.CLASSES, *flare.CLASSES))]
    matrices, shining, expected = [], [], []
    for seed, one in enumerate(some):
        random = np.random.default_rng(seed)
        matrices.append(random_cameras.laid(random, CANVAS, WIDTH, HEIGHT))
        shining.append(random_cameras.shining(random, 0.8))
        expected.append(pairs._placed(one, shining[-1], matrices[-1], WIDTH, HEIGHT))
    blurs, colours, gains, mosts = (np.array(part) for part in zip(*shining, strict=True))
    assert 1 < (blurs > 0).sum() < len(some) - 1
    how = composition.Laying(np.array(matrices), blurs, colours[..., None, None], gains[:, None, None, None],
                             mosts[:, None, None, None]).on(CPU)
    found = composition._placed(together(some), how, how.matrices, HEIGHT, WIDTH)
    for row, apart in enumerate(expected):
        for one, other in zip(found, apart, strict=True):
            there = one[row].permute(1, 2, 0).numpy()
            assert np.abs(there - other).mean() < 0.01 * max(float(other.mean()), 0.02), (row, flare.CLASSES[row % 8])


@pytest.mark.parametrize("quality", [60, 75, 90])
def test_jpeg_is_opencv_s(quality: int) -> None:
    random = np.random.default_rng(3)
    noise = cv2.GaussianBlur(random.random((64, 96, 3)).astype(np.float32), (0, 0), 1.5)
    picture = np.round(np.clip((noise - 0.5) * 4 + 0.5, 0, 1) * 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    expected = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(np.float32)
    codes = torch.from_numpy(picture[..., ::-1].astype(np.float32)).permute(2, 0, 1)[None]
    found = jpeg.stored(codes, torch.tensor([float(quality)]))[0].permute(1, 2, 0).numpy()[..., ::-1]
    lost, otherwise = (float(np.sqrt(np.square(one - picture).mean())) for one in (expected, found))
    assert otherwise == pytest.approx(lost, rel=0.05)
    assert np.sqrt(np.square(found - expected).mean()) < 0.4 * lost


def test_lights_are_laid_where_the_scene_is_bright() -> None:
    flares = together([made(seed, "scatter") for seed in range(6)])
    how = composition.laying(np.random.default_rng(1), 6, CANVAS, WIDTH, HEIGHT).on(CPU)
    scene = torch.zeros(6, 3, HEIGHT, WIDTH)
    scene[..., 16:32, 32:64] = 1
    against = torch.tensor([1, 1, 1, 0, 0, 1]) > 0
    matrix, bright = composition._chosen(flares, how.matrices, scene, against)
    for row in range(6):
        x, y = composition._on_frame(how.matrices[row][None], flares.lights[row, :1], flares.size)[0].unbind(-1)
        inside = ((x // 16).clamp(2, 3) == x // 16) & (y // 16 == 1)
        assert float(bright[row]) == float(inside.any() if against[row] else inside[0])
        assert torch.equal(matrix[row], how.matrices[row, 0]) or against[row]


def test_what_a_frame_is_composed_of() -> None:
    count = 8
    random = np.random.default_rng(2)
    scene = torch.from_numpy(random.uniform(0.1, 0.4, (count, 3, HEIGHT, WIDTH)).astype(np.float32))
    gamma = torch.full((count,), 2.0)
    flares = together([made(seed, "glare") for seed in range(count)])
    how = composition.laying(random, count, CANVAS, WIDTH, HEIGHT).on(CPU)

    def compose(**changes: torch.Tensor) -> tuple[torch.Tensor, ...]:
        plain = composition.filming(np.random.default_rng(5), count, NOTHING)
        as_it_is = {"exposure": 1, "mirrored": 0, "grain": 0, "contrast": 0, "saturation": 1, "lift": 0, "quality": 0}
        numbers = {name: np.full_like(getattr(plain, name), value, np.float32) for name, value in as_it_is.items()}
        filmed = replace(replace(plain, **numbers).on(CPU), **changes)
        return composition.composed(scene, gamma, filmed, [(flares, how)])

    rest, glare, light = composition._placed(flares, how, how.matrices[:, 0], HEIGHT, WIDTH)
    frame, clear, gentle = compose()
    assert torch.allclose(clear, (scene + light).clamp(0, 1).sqrt(), atol=1e-6)
    assert torch.allclose(gentle, (scene + light + glare).clamp(0, 1).sqrt(), atol=1e-6)
    assert torch.allclose(frame, (scene + light + rest + glare).clamp(0, 1).sqrt(), atol=0.71 / 255)
    assert torch.equal((frame * 255).round() / 255, frame), "in 8 bits"
    none = torch.zeros(count, 1, 1, 1)
    frame, clear, gentle = compose(flared=none)
    assert torch.equal(frame, clear) and torch.equal(gentle, clear)
    frame, clear, _ = compose(flared=none, lit=none)
    assert torch.allclose(clear, scene.sqrt(), atol=1e-6)
    _, _, gentle = compose(bend=none + 0.5)
    expected = under_shoulder((scene + light).numpy(), glare.numpy(), 0.5)
    assert np.allclose(gentle.numpy(), np.sqrt(expected.clip(0, 1)), atol=1e-5)
    black, white = torch.full((count, 3, 1, 1), 0.1), torch.full((count, 3, 1, 1), 0.9)
    _, faded, _ = compose(black=black, white=white)
    assert torch.allclose(faded, 0.1 + 0.8 * compose()[1], atol=1e-6)
    channels = torch.zeros(count, 3, 3)
    channels[:, :, 1] = 1
    _, grey, _ = compose(channels=channels)
    assert torch.allclose(grey, compose()[1][:, 1:2].expand_as(grey), atol=1e-6)


def test_a_second_flare_lies_over_some() -> None:
    scene, gamma = torch.full((3, 3, HEIGHT, WIDTH), 0.2), torch.full((3,), 2.0)
    flares = together([made(seed, "glare") for seed in range(3)])
    random = np.random.default_rng(2)
    filmed = composition.filming(random, 3, NOTHING).on(CPU)
    how = composition.laying(random, 3, CANVAS, WIDTH, HEIGHT).on(CPU)
    second = composition.laying(random, 1, CANVAS, WIDTH, HEIGHT, second=True).on(CPU)
    shown = []
    for over in ([(flares, how)], [(flares, how), (composition.Flares(*(part[:1] for part in flares)), second)]):
        torch.manual_seed(1)
        shown.append(composition.composed(scene, gamma, filmed, over)[2])
    assert (shown[1] - shown[0])[0].max() > 0.01
    assert torch.equal(shown[1][1:], shown[0][1:])


def test_what_is_drawn_has_the_recipe_s_shares() -> None:
    recipe = replace(RECIPE, clean=0.3, against_light=0.4, shoulder=0.2, grey=0.1, faded=0.25)
    filmed = composition.filming(np.random.default_rng(0), 4000, recipe)
    shares = {"clean": filmed.flared == 0, "against_light": filmed.against, "shoulder": filmed.bend > 0,
              "grey": filmed.channels[:, 0, 0] + filmed.channels[:, 1, 1] + filmed.channels[:, 2, 2] < 2,
              "faded": filmed.white[:, 0] < 1}
    for name, found in shares.items():
        assert np.mean(found) == pytest.approx(getattr(recipe, name), abs=0.03), name
    assert filmed.channels.sum(-1) == pytest.approx(1)


def test_processes_draw_what_a_training_learns_from() -> None:
    shapes = pools.shapes_of(RECIPE, MULTIPLE)
    assert sum(shape.share for shape in shapes) == pytest.approx(1)
    assert {(shape.width, shape.height) for shape in shapes} == {(96, 64), (64, 64), (64, 96)}
    room = pools.Pools(shapes, CANVAS, CPU, scenes=100, flares=6)
    trainer = Trainer(RECIPE)
    with pools.filled(room, RECIPE, flat(), built_in(), None, 2):
        assert len(multiprocessing.active_children()) == 2
        drawn = batches(room, RECIPE, np.random.default_rng(1))
        for _ in range(8):
            batch = next(drawn)
            count, _, height, width = batch.frame.shape
            assert count == round(RECIPE.pixels / (width * height))
            for part in batch[:3]:
                assert part.shape == batch.frame.shape and part.dtype == torch.float32
                assert float(part.min()) >= 0 and float(part.max()) <= 1
        figures = trainer.step(batch)
        assert math.isfinite(figures["loss"]) and figures["untouched"] > 0
    assert not multiprocessing.active_children()
    assert room.flares_made >= 6 and min(room.scenes_made) >= pools.BLOCK
    scenes, gammas = room.scenes(np.random.default_rng(0), 0)
    assert torch.allclose(scenes.float(), ((128 / 255) ** gammas)[:, None, None, None].expand_as(scenes), atol=1e-3)
    assert 1.8 <= float(gammas.min()) <= float(gammas.max()) <= 2.2
    some = room.flares(np.random.default_rng(0), 5)
    assert some.layers.shape == (5, 9, CANVAS, CANVAS) and some.there.any() and (some.colour > 0).any()


def test_pools_are_as_large_as_a_card_has_room_for() -> None:
    shapes = pools.shapes_of(replace(RECIPE, stages=((1.0, 256, 480),)), MULTIPLE)
    assert {(shape.width, shape.height) for shape in shapes} == {(480, 320), (384, 256), (480, 256), (320, 480),
                                                                 (352, 352)}
    assert pools.room(80 << 30, shapes, 384) == (pools.SCENES, pools.FLARES)
    for free in (6 << 30, 24 << 30):
        scenes, flares = pools.room(free, shapes, 384)
        assert 0.38 * free < scenes * 6 * 480 * 320 * 0.83 + flares * 18 * 384**2 < 0.42 * free
        assert scenes > 3 * flares > 1000
    assert min(pools.room(0, shapes, 384)) >= 1


def test_processes_that_end_are_told() -> None:
    room = pools.Pools(pools.shapes_of(RECIPE, MULTIPLE), CANVAS, CPU, scenes=8, flares=2)
    with pytest.raises(RunError, match="draw pictures for the training ended"), \
            pools.filled(room, RECIPE, Backgrounds([], []), built_in(), None, 2):
        pass
    assert not multiprocessing.active_children()


def test_on_a_processor_nothing_is_recorded() -> None:
    calls = []

    def work(one: torch.Tensor) -> list[torch.Tensor]:
        calls.append(one)
        return [one * 2]

    twice = cuda_graphs.Recorded(work)
    assert torch.equal(twice(torch.ones(2))[0], torch.full((2,), 2.0))
    assert torch.equal(twice(torch.zeros(2))[0], torch.zeros(2))
    assert len(calls) == 2


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU")
def test_a_training_on_a_card(tmp_path: Path) -> None:
    card = torch.device("cuda")
    twice = cuda_graphs.Recorded(lambda one: [one * 2, one.sum()])
    for side in (3, 5, 3):
        given = torch.rand(side, side, device=card)
        doubled, whole = twice(given)
        assert torch.equal(doubled, given * 2) and torch.allclose(whole, given.sum())
    with drawn_on_card(RECIPE, 0, flat(), built_in(), None, card, 2) as drawn:
        batch = next(drawn)
        trainer, plain = Trainer(RECIPE), Trainer(RECIPE)
        trainer.step(batch)
        loss, figures = plain.loss(batch)
        loss.backward()
        assert trainer.step(batch)["loss"] == pytest.approx(figures["loss"], rel=0.02), "of the step before"
    assert run.train(RECIPE, tmp_path, flat(), built_in(), processes=3).is_file()
