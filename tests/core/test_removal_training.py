# SPDX-License-Identifier: GPL-3.0-or-later
"""Training and scoring of the removal network: it learns, it can be stopped, its scores are right."""
from __future__ import annotations

import errno
import json
import multiprocessing
import pickle
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from core.colour.srgb import Pixels
from core.errors import Cancelled, EngineError, FrameError, RunError, SettingsError
from core.images.contact_sheet import GAP, LABEL_HEIGHT
from core.images.write import write_png
from core.metrics.lpips import Lpips
from core.optics.prescription import built_in_lenses
from core.removal import evaluation
from core.removal.model import network, weights
from core.removal.model.network import Attention, RemovalNetwork
from core.removal.model.recipe import RETIRED, Recipe, as_dict, from_dict
from core.removal.training import backgrounds as removal_backgrounds
from core.removal.training import optimiser, run
from core.removal.training.backgrounds import Backgrounds
from core.removal.training.batches import Batch, Batches
from core.removal.training.flare_bank import UserFlares
from core.removal.training.optimiser import MuonAdamW
from core.removal.training.shared_arrays import SharedArrays
from core.removal.training.trainer import RemovalTrainer
from core.removal.training.workers import SINGLE_WORKER, SharedBuffers, Worker, worker_group
from core.system.folder_lock import folder_lock
from tests.core.recording_progress import StopAfter

torch.set_num_threads(1)  # small tensors, on which threads only wait for each other

WIDTHS = (8, 8, 8, 8, 8)
RECIPE = Recipe(iterations=4, size_stages=((0.5, 64, 64), (1.0, 64, 96)), pixels_per_iteration=8000, widths=WIDTHS,
                bank_size=2, canvas_size=64)


def backgrounds() -> Backgrounds:
    x, y = np.meshgrid(np.linspace(0, 150, 300), np.linspace(20, 100, 200))
    return Backgrounds([np.stack([x, y, 120 - y], -1).astype(np.uint8)], [])


def widths_of(path: Path) -> tuple[int, ...]:
    return tuple(see.out_channels for see in weights.load_network(path).input_convs)  # type: ignore[union-attr, misc]


def test_a_resumed_training_ends_as_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = run.train(RECIPE, tmp_path / "whole", backgrounds(), built_in_lenses(), processes=1)
    with pytest.raises(Cancelled):
        run.train(RECIPE, tmp_path / "parts", backgrounds(), built_in_lenses(), processes=1,
                  progress=StopAfter(2, "train"))
    with pytest.raises(RunError, match="--resume"):
        run.train(RECIPE, tmp_path / "parts", backgrounds(), built_in_lenses())
    with folder_lock(tmp_path / "parts"), pytest.raises(RunError, match="Another process"):
        run.train(RECIPE, tmp_path / "parts", backgrounds(), built_in_lenses(), resume=True)
    parts = run.train(RECIPE, tmp_path / "parts", backgrounds(), built_in_lenses(), resume=True, processes=2)
    a, b = weights.read_weights(whole)[0], weights.read_weights(parts)[0]
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == torch.float16
        torch.testing.assert_close(a[name], b[name], atol=1e-3, rtol=1e-2)
    assert widths_of(whole) == RECIPE.widths


def test_a_loaded_state_gives_the_same_next_step() -> None:
    """To the last bit, of moments too: those of weights that lie channels last are saved in rows."""
    compose_batches = Batches(RECIPE, backgrounds(), built_in_lenses())
    drawn = [compose_batches[number] for number in range(3)]
    whole = RemovalTrainer(RECIPE)
    for batch in drawn[:2]:
        whole.step(batch)
    gone_on = RemovalTrainer(RECIPE)
    gone_on.load_state({name: value.clone() for name, value in whole.state().items()}, 2)
    for one in (whole, gone_on):
        one.step(drawn[2])
    expected = whole.state()
    assert [name for name, value in gone_on.state().items() if not torch.equal(value, expected[name])] == []


def test_workers_share_the_frames_of_one_process(tmp_path: Path) -> None:
    alone = run.train(RECIPE, tmp_path / "alone", backgrounds(), built_in_lenses(), processes=1)
    by_three = run.train(RECIPE, tmp_path / "three", backgrounds(), built_in_lenses(), processes=3)
    logs = [json.loads((path.parent / run.LOG).read_text(encoding="utf-8")) for path in (alone, by_three)]
    assert logs[0]["untouched"] == pytest.approx(logs[1]["untouched"], rel=1e-4), "the pictures are the same"
    a, b = weights.read_weights(alone)[0], weights.read_weights(by_three)[0]
    for name in a:
        torch.testing.assert_close(a[name], b[name], atol=1e-3, rtol=1e-2)
    assert torch.get_num_threads() == 1
    assert not multiprocessing.active_children()

    whole = Batches(RECIPE, backgrounds(), built_in_lenses())[0]
    parts = [Batches(RECIPE, backgrounds(), built_in_lenses(), worker=Worker(rank, 3))[0] for rank in range(3)]
    assert len(whole.frame) == 2
    assert [len(part.frame) for part in parts] == [1, 1, 0]
    assert [part.share for part in parts] == [0.5, 0.5, 0]
    assert np.array_equal(whole.scene[1], parts[1].scene[0])


def adds_up(worker: Worker) -> None:
    """A learner that has numbers in several layouts, and makes every piece of work that is its own."""
    sums, pieces = numbers(worker)
    for _ in range(2):
        worker.all_reduce(sums)
        worker.all_gather(pieces)


def numbers(worker: Worker) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    plain = torch.arange(24.0).view(2, 3, 2, 2) + 100 * worker.rank
    pieces = [torch.full((2, 3), float(k if worker.is_responsible_for(k) else -1)) for k in range(5)]
    return [plain.contiguous(memory_format=torch.channels_last), torch.tensor([1.0 + worker.rank])], pieces


def test_workers_reduce_and_gather_tensors() -> None:
    with worker_group(3, adds_up) as worker:
        sums, pieces = numbers(worker)
        worker.all_reduce(sums)
        worker.all_gather(pieces)
        assert torch.equal(sums[0], 3 * torch.arange(24.0).view(2, 3, 2, 2) + 300)
        assert sums[1].tolist() == [6]
        assert [piece.unique().tolist() for piece in pieces] == [[0], [1], [2], [3], [4]]
        once = sums[0].clone()
        worker.all_reduce(sums)
        assert torch.equal(sums[0], 3 * once), "the others have the sum too"
        worker.all_gather(pieces)
    alone, pieces = numbers(SINGLE_WORKER)
    SINGLE_WORKER.all_reduce(alone)
    SINGLE_WORKER.all_gather(pieces)
    assert alone[1].tolist() == [1] and [float(piece[0, 0]) for piece in pieces] == [0, 1, 2, 3, 4]


def test_shared_buffers_are_never_truncated(tmp_path: Path) -> None:
    """Windows refuses that where another has it mapped."""
    (tmp_path / "2x3").write_bytes(b"\1" * 64)
    rows = SharedBuffers(str(tmp_path), multiprocessing.get_context("spawn").Barrier(1)).shared_rows(2, 3)
    assert (tmp_path / "2x3").stat().st_size == 64 and rows.shape == (2, 3)
    assert (rows != 0).all(), "what is there stays"


def ends(_learner: Worker) -> None:
    """A learner that ends at once."""


def test_an_ended_worker_raises_an_error(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="ended too early"), worker_group(2, ends) as worker:
        for _ in range(100):
            worker.all_reduce([torch.zeros(1000)])
    assert not multiprocessing.active_children()
    with worker_group(1, ends) as worker:
        assert worker == SINGLE_WORKER
    with pytest.raises(SettingsError, match="at least one process"):
        run.train(RECIPE, tmp_path, backgrounds(), built_in_lenses(), processes=0)


def test_shared_arrays_are_mapped_by_other_processes(tmp_path: Path) -> None:
    arrays = [np.arange(5, dtype=np.uint8), np.arange(7, dtype=np.float16)[:, None], np.zeros((0, 2), np.float32)]
    mapped = SharedArrays(tmp_path / "some", arrays)
    there = pickle.loads(pickle.dumps(mapped))
    for some in (mapped, there):
        assert len(some) == 3
        for one, other in zip(some, arrays, strict=True):
            assert one.dtype == other.dtype
            assert np.array_equal(one, other)
        assert np.array_equal(some[-2], arrays[1])
        assert len(some[1:]) == 2
    with pytest.raises(ValueError, match="read-only"):
        there[0][0] = 1
    assert len(pickle.dumps(there)) < 1000, "what has been mapped is not sent"


def test_shared_backgrounds_equal_those_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(3):
        write_png(tmp_path / f"{number}.png", np.random.default_rng(number).random((80, 96, 3)).astype(np.float32))
    (tmp_path / "cut_off.png").write_bytes(b"\x89PNG")
    held_in_memory = removal_backgrounds.read_backgrounds([tmp_path], augmented=True)
    with removal_backgrounds.open_shared_backgrounds([tmp_path], augmented=True) as found:
        assert found.unusable == [tmp_path / "cut_off.png"]
        sent = pickle.loads(pickle.dumps(found))
        assert sent.augmented
        for seed in range(4):
            drawn, expected = (some.draw(np.random.default_rng(seed), 96, 64, 2.0) for some in (sent, held_in_memory))
            assert np.array_equal(drawn, expected)

    def full(*_: object) -> SharedArrays:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(removal_backgrounds, "SharedArrays", full)
    with pytest.raises(RunError, match=r"No space left on device.*TMPDIR"), \
            removal_backgrounds.open_shared_backgrounds([tmp_path]):
        pass


def test_a_training_without_opencvs_extra_modules_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    write_png(tmp_path / "a.png", np.zeros((80, 96, 3), np.float32))
    monkeypatch.delattr(cv2, "ximgproc")
    with pytest.raises(EngineError, match="opencv-contrib-python-headless"):
        removal_backgrounds.read_backgrounds([tmp_path], augmented=True)
    assert removal_backgrounds.read_backgrounds([tmp_path]).photos


def test_a_handful_of_pairs_is_learned() -> None:
    recipe = Recipe(size_stages=((1.0, 64, 64),), pixels_per_iteration=16_384,
                    widths=(16, 16, 16, 16, 16), bank_size=2, canvas_size=64, clean_share=0)
    trainer = RemovalTrainer(recipe)
    batch = Batches(recipe, backgrounds(), built_in_lenses())[0]
    figures = {}
    for _ in range(120):
        loss, figures = trainer.loss(batch)
        loss.backward()
        trainer.optimiser.step(3e-3)
    assert figures["error"] < 0.2 * figures["untouched"]


def test_false_flares_weigh_more_late_in_a_training() -> None:
    recipe = replace(RECIPE, iterations=100, psnr_phase=1.0, clean_share=1.0)
    trainer = RemovalTrainer(recipe)
    batch = Batches(recipe, backgrounds(), built_in_lenses())[0]
    assert torch.equal(batch.frame, batch.scene)
    torch.nn.init.constant_(trainer.network.head.bias, 0.03)
    losses = {}
    for trainer.iteration in (0, 40, 80, 99):
        losses[trainer.iteration] = float(trainer.loss(batch)[0].detach())
    assert 0 < losses[0] < losses[40] - 1 < losses[80] - 2
    assert losses[80] == losses[99]


def test_the_patch_loss_penalises_false_flares_beside_a_flare() -> None:
    scene = torch.full((1, 3, 96, 192), 0.25)
    frame = scene.clone()
    frame[..., :96] += 0.5
    batch = Batch(frame, scene, scene, 1.0)
    losses = {}
    for local in (0.0, 0.5, 1.0):
        trainer = RemovalTrainer(replace(RECIPE, psnr_phase=1.0, patch_loss_share=local))
        torch.nn.init.constant_(trainer.network.head.bias, 0.1)
        losses[local] = float(trainer.loss(batch)[0].detach())
    # All of the picture is nearer to its scene; of its squares one half is, by less than what the other half loses.
    assert losses[0.0] < -0.3
    assert losses[1.0] > 0.5
    assert losses[0.5] == pytest.approx((losses[0.0] + losses[1.0]) / 2, rel=0.02)


def test_muon_steps_are_equally_long_in_every_direction() -> None:
    """Hidden matrices take steps of near-equal singular values, of 0.2 of the rate; other weights take AdamW's
    steps."""
    recipe = Recipe(widths=(16, 16, 16, 16, 16), weight_decay=0)
    trainer = RemovalTrainer(recipe)
    before = {name: value.detach().clone() for name, value in trainer.network.named_parameters()}
    for parameter in trainer.network.parameters():
        parameter.grad = torch.randn_like(parameter) * torch.rand(parameter.shape[-1]) ** 4
    trainer.optimiser.step(1e-2)
    steps = {name: value.detach() - before[name] for name, value in trainer.network.named_parameters()}
    hidden = steps["encoder.2.0.conv1.weight"].permute(0, 2, 3, 1).flatten(1)
    assert float(torch.linalg.matrix_norm(hidden, -2) / torch.linalg.matrix_norm(hidden, 2)) > 0.6
    assert float(hidden.square().mean().sqrt()) == pytest.approx(0.2e-2, rel=0.3)
    for name in ("input_convs.2.weight", "head.weight", "attention.0.pos_embed.weight", "encoder.2.0.conv1.bias"):
        assert float(steps[name].abs().median()) == pytest.approx(1e-2, rel=0.05)
    assert all(parameter.grad is None for parameter in trainer.network.parameters())


def test_muon_steps_equal_those_of_torch() -> None:
    """The difference is torch's rounding to bfloat16."""
    recipe = Recipe(widths=(16, 16, 24, 16, 16), weight_decay=0.1)
    trainer = RemovalTrainer(recipe)
    name = "up.1.weight"
    weight = dict(trainer.network.named_parameters())[name]
    theirs = torch.nn.Parameter(weight.detach().permute(0, 2, 3, 1).flatten(1).clone())
    muon = torch.optim.Muon([theirs], 1e-2, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    for _ in range(3):
        for parameter in trainer.network.parameters():
            parameter.grad = torch.randn_like(parameter)
        theirs.grad = weight.grad.permute(0, 2, 3, 1).flatten(1).clone()  # type: ignore[union-attr]
        trainer.optimiser.step(1e-2)
        muon.step()
    ours = weight.detach().permute(0, 2, 3, 1).flatten(1)
    assert float((ours - theirs.detach()).abs().max()) < 5e-4
    assert float(theirs.detach().abs().max()) > 1e-2


@pytest.mark.parametrize(("rows", "columns", "rank"), [(24, 216, 24), (40, 16, 16), (24, 216, 3)])
def test_merged_newton_schulz_steps_equal_single_ones(rows: int, columns: int, rank: int) -> None:
    torch.manual_seed(3)
    matrix = torch.randn(rows, rank) @ torch.randn(rank, columns)
    a, b, c = optimiser.NEWTON_SCHULZ_COEFFICIENTS
    expected = matrix.double() / matrix.double().norm()
    for _ in range(optimiser.NEWTON_SCHULZ_STEPS):
        square = expected @ expected.mT
        expected = a * expected + (b * square + c * square @ square) @ expected
    stack = torch.stack([torch.randn(rows, columns), matrix])
    found = optimiser.orthogonalise(stack)[1]
    assert found.dtype == torch.float32
    assert float((found - expected).norm() / expected.norm()) < 2e-3


def test_weights_that_are_not_channels_last_are_refused() -> None:
    with pytest.raises(ValueError, match="channels last"):
        MuonAdamW(RemovalNetwork((16,) * 5, (0, 0, 1, 0, 0), (0, 0)), 0.0)


def test_frame_sizes_follow_the_stages_of_the_recipe() -> None:
    recipe = Recipe(iterations=100, size_stages=((0.5, 64, 96), (1.0, 160, 256)), pixels_per_iteration=40_000,
                    bank_size=2, canvas_size=64)
    assert [recipe.size_range_at(at) for at in (0, 49, 50, 200)] == [(64, 96), (64, 96), (160, 256), (160, 256)]
    for at in range(100):
        count, width, height = recipe.draw_batch_shape(np.random.default_rng(at), at)
        least, most = recipe.size_range_at(at)
        assert least - 16 <= max(width, height) <= most + 16
        assert width % 32 == height % 32 == 0 and min(width, height) >= 64
        assert count == max(round(40_000 / (width * height)), 1)
    compose_batches = Batches(recipe, backgrounds(), built_in_lenses())
    early, late = compose_batches[3], compose_batches[70]
    assert early.frame.shape == early.scene.shape == early.scene_with_glow.shape
    assert len(early.frame) > len(late.frame) >= 1
    assert max(early.frame.shape[2:]) < max(late.frame.shape[2:])
    assert torch.equal(compose_batches[3].frame, early.frame)


def test_a_training_starts_from_weights(tmp_path: Path) -> None:
    first = run.train(RECIPE, tmp_path / "first", backgrounds(), built_in_lenses(), processes=1)
    second = run.train(RECIPE, tmp_path / "second", backgrounds(), built_in_lenses(), start=first, processes=1)
    assert weights.read_weights(second)[1]["iteration"] == "4"
    other = Recipe(**{**RECIPE.__dict__, "widths": (16, 8, 8, 8, 8)})
    third = run.train(other, tmp_path / "third", backgrounds(), built_in_lenses(), start=first, processes=1)
    assert widths_of(third) == RECIPE.widths, "the network is that of the weights"
    tensors, _ = weights.read_weights(first)
    weights.write_weights(tmp_path / "foreign.safetensors", tensors, {"recipe": "{}"})
    with pytest.raises(RunError, match="holds no weights"):
        run.train(RECIPE, tmp_path / "fourth", backgrounds(), built_in_lenses(), start=tmp_path / "foreign.safetensors")


def test_attention_equals_torch_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attention written out as matrices equals torch's fused function."""
    attention = Attention(16, 4, octaves=2)
    torch.nn.init.normal_(attention.proj.weight)
    x = torch.randn(2, 16, 6, 9)
    with torch.no_grad():
        written_out = attention(x)
        monkeypatch.setattr(network, "MAX_EXPLICIT_POSITIONS", 53)
        torch.testing.assert_close(attention(x), written_out, rtol=1e-4, atol=1e-5)
    assert (written_out - x).abs().max() > 0.1


def test_added_blocks_leave_the_prediction_unchanged(tmp_path: Path) -> None:
    small = replace(RECIPE, blocks=(0, 1, 1, 1, 1), attention=(0, 0))
    large = replace(RECIPE, blocks=(1, 0, 2, 1, 3), attention=(0, 1))
    first = run.train(small, tmp_path / "first", backgrounds(), built_in_lenses(), processes=1)
    grown = run.TrainingSetup(large, first, False, backgrounds(), built_in_lenses(), None).create_trainer(SINGLE_WORKER)
    assert [len(level) for level in grown.network.encoder] == [1, 1, 2, 1, 3]  # type: ignore[arg-type]
    frame = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        before, after = weights.load_network(first)(frame), grown.network(frame)
    assert before.flare.std() > 0
    torch.testing.assert_close(after.flare, before.flare, rtol=1e-3, atol=1e-6)  # a fused layout adds up otherwise
    grown_to = run.train(large, tmp_path / "second", backgrounds(), built_in_lenses(), start=first, processes=1)
    form = weights.read_architecture(grown_to, weights.read_weights(grown_to)[1])
    assert form == (small.widths, (1, 1, 2, 1, 3), (0, 1))
    longer = replace(large, iterations=5, blocks=(4, 4, 4, 4, 4), attention=(2, 2))
    run.train(longer, tmp_path / "second", backgrounds(), built_in_lenses(), resume=True, processes=1)
    assert weights.read_architecture(grown_to, weights.read_weights(grown_to)[1]) == form, "none grows on the way"
    of_before = {name: value for name, value in as_dict(small).items() if name != "attention"}
    assert weights.read_architecture(first, {"recipe": json.dumps(of_before)}).attention == (0, 0)


def test_the_log_has_metrics_and_validation_gains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "make_validation_pairs", partial(run.make_validation_pairs, count=8))
    run.train(RECIPE, tmp_path, backgrounds(), built_in_lenses(), validation=(backgrounds(), built_in_lenses()),
              processes=1)
    (line,) = [json.loads(text) for text in (tmp_path / run.LOG).read_text(encoding="utf-8").splitlines()]
    assert line["iteration"] == 4
    assert "gain_db" in line
    drawn = [Batches(RECIPE, backgrounds(), built_in_lenses())[at] for at in range(4)]
    untouched = [np.square(batch.frame - batch.scene).mean() for batch in drawn]
    assert line["untouched"] == pytest.approx(np.mean(untouched), abs=1e-5), "means since the last line"


def test_the_log_of_a_killed_training_restarts_at_its_checkpoint(tmp_path: Path,
                                                                 monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines that were logged after the last checkpoint are logged again, once."""
    monkeypatch.setattr(run, "VALIDATE_EVERY", 1)
    with pytest.raises(Cancelled):
        run.train(RECIPE, tmp_path, backgrounds(), built_in_lenses(), processes=1, progress=StopAfter(2, "train"))
    log = tmp_path / run.LOG
    log.write_text(log.read_text(encoding="utf-8") + '{"iteration": 3, "loss": 7.0}\n{"iterat', encoding="utf-8")
    run.train(RECIPE, tmp_path, backgrounds(), built_in_lenses(), resume=True, processes=1)
    lines = [json.loads(text) for text in log.read_text(encoding="utf-8").splitlines()]
    assert [line["iteration"] for line in lines] == [1, 2, 3, 4] and lines[2]["loss"] != 7.0


def test_the_weights_of_the_best_validation_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gains = {1: 1.0, 2: 2.5, 3: 2.0, 4: 2.5, 5: 3.0, 6: 0.0}
    monkeypatch.setattr(run, "make_validation_pairs", lambda *_: {"streak": []})
    monkeypatch.setattr(run, "VALIDATE_EVERY", 1)
    monkeypatch.setattr(RemovalTrainer, "validate", lambda trainer, _: {"mean": gains[trainer.iteration]})
    train = partial(run.train, RECIPE, backgrounds=backgrounds(), lenses=built_in_lenses(), processes=1)
    tests = backgrounds(), built_in_lenses()

    def kept(folder: str) -> str:
        return weights.read_weights(tmp_path / folder / run.WEIGHTS)[1]["iteration"]

    train(tmp_path / "whole", validation=tests)
    assert kept("whole") == "2"
    with pytest.raises(Cancelled):
        train(tmp_path / "parts", validation=tests, progress=StopAfter(3, "train"))
    assert weights.read_weights(tmp_path / "parts" / run.CHECKPOINT)[1]["iteration"] == "3"
    train(tmp_path / "parts", validation=tests, resume=True)
    assert kept("parts") == "2", "what a part before had found is still the best"
    longer = replace(RECIPE, iterations=6)
    run.train(longer, tmp_path / "parts", backgrounds(), built_in_lenses(), validation=tests, resume=True, processes=1)
    assert kept("parts") == "5"
    train(tmp_path / "untested")
    assert kept("untested") == "4"
    write_png(tmp_path / "flares" / "one.png", np.full((48, 64, 3), 0.3))
    train(tmp_path / "own", validation=tests, user_flares=UserFlares(tmp_path / "flares", RECIPE.canvas_size))
    assert kept("own") == "4", "the checks have none of the user's flares"


def test_a_training_with_a_non_finite_loss_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = RemovalTrainer.step

    def broken(trainer: RemovalTrainer, batch: Batch) -> dict[str, float]:
        figures = step(trainer, batch)
        return figures if trainer.iteration < 3 else {**figures, "loss": float("nan")}

    monkeypatch.setattr(RemovalTrainer, "step", broken)
    with pytest.raises(RunError, match=r"iteration 3 is not finite.*learning_rate"):
        run.train(RECIPE, tmp_path, backgrounds(), built_in_lenses(), processes=1, save_every_s=0)
    state, about = weights.read_weights(tmp_path / run.CHECKPOINT)
    assert about["iteration"] == "2", "what was saved last is whole"
    assert all(torch.isfinite(value).all() for value in state.values())


def test_recipes_are_checked_and_survive_a_round_trip() -> None:
    recipe = Recipe(iterations=1000, warmup_iterations=10)
    assert recipe.learning_rate_at(0) == pytest.approx(recipe.learning_rate / 10)
    assert recipe.learning_rate_at(500) == pytest.approx(recipe.learning_rate / 2)
    assert recipe.learning_rate_at(1000) == 0
    assert from_dict(as_dict(recipe)) == recipe
    with pytest.raises(SettingsError, match="has no speed"):
        from_dict({"speed": 1})
    with pytest.raises(SettingsError, match="patch_loss_share lies between 0 and 1, not at 2"):
        Recipe(patch_loss_share=2)
    with pytest.raises(SettingsError, match="5 levels"):
        Recipe(widths=())
    with pytest.raises(SettingsError, match="5 levels"):
        Recipe(blocks=(1, 1))
    for attention in ((1,), (0, 4), (-1, 0)):
        with pytest.raises(SettingsError, match="attention for two levels"):
            Recipe(attention=attention)
    for stage in ((1.0, 32, 64), (1.0, 96, 64), (1.0, 96)):
        with pytest.raises(SettingsError, match="size_stages"):
            Recipe(size_stages=(stage,))  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="one iteration, pixel and flare"):
        Recipe(pixels_per_iteration=0)


def test_a_recipe_is_read_under_the_names_of_format_0() -> None:
    recipe = Recipe(warmup_iterations=10, patch_loss_share=0.5, size_stages=((1.0, 64, 96),))
    retired = {present: name for name, present in RETIRED.items()}
    data = {retired.get(name, name): value for name, value in as_dict(recipe).items()}
    assert {"warm", "local", "stages"} < data.keys()
    assert from_dict({**data, "repeats": 4}) == recipe
    assert from_dict({**as_dict(recipe), "warm": 20}).warmup_iterations == 20, "the last one counts"


# Scores.


def pair_folder(folder: Path, names: tuple[str, ...] = ("input_0.png", "gt_0.png")) -> Path:
    random = np.random.default_rng(0)
    for kind, level in (("input", 0.1), ("gt", 0.0)):
        for k in range(2):
            name = (names[0] if kind == "input" else names[1]).replace("0", str(k))
            write_png(folder / kind / name, np.clip(random.random((24, 30, 3)) * 0 + 0.5 + level, 0, 1))
    return folder


def test_scores_have_those_of_the_untouched_input_beside_them(tmp_path: Path) -> None:
    pair_folder(tmp_path / "real")
    pair_folder(tmp_path / "synthetic", ("a0.png", "a0.png"))
    cases = evaluation.read_cases(tmp_path)
    assert sorted({case.category for case in cases}) == ["real", "synthetic"]
    scores = evaluation.evaluate(cases, lambda frame: frame - np.float32(0.05))
    assert scores["mean"]["count"] == 4
    assert scores["mean"]["gain_db"] == pytest.approx(20 * np.log10(2), abs=0.4)
    assert scores["mean"]["made_worse"] == 0
    assert scores["mean"]["result"]["lpips"] is None
    worse = evaluation.evaluate(cases, lambda frame: frame + np.float32(0.05))
    assert worse["mean"]["made_worse"] == 1
    assert "real" in evaluation.format_table(worse)
    sheet = evaluation.draw_worst_sheet(cases, lambda frame: frame, worse, 40)
    assert sheet.shape == (4 * (LABEL_HEIGHT + 32), 4 * 40 + 3 * GAP, 3)


@pytest.mark.parametrize(("shape", "height"), [((1, 1200), 1), ((1200, 1), 80)])
def test_extreme_aspects_are_squeezed_on_the_sheet(shape: tuple[int, int], height: int,
                                                   tmp_path: Path) -> None:
    for kind, level in (("input", 200), ("gt", 100)):
        write_png(tmp_path / kind / "0.png", np.full((*shape, 3), level / 255))
    cases = evaluation.read_cases(tmp_path)
    scores = evaluation.evaluate(cases, lambda frame: frame)
    assert evaluation.draw_worst_sheet(cases, lambda frame: frame, scores, 40).shape[0] == LABEL_HEIGHT + height


def test_changing_a_clean_picture_counts_as_made_worse(tmp_path: Path) -> None:
    pair_folder(tmp_path)
    shutil.rmtree(tmp_path / "gt")
    shutil.copytree(tmp_path / "input", tmp_path / "gt")
    cases = evaluation.read_cases(tmp_path)
    kept = evaluation.evaluate(cases, lambda frame: frame)["mean"]
    assert (kept["gain_db"], kept["made_worse"]) == (0, 0)
    assert kept["result"]["psnr"] == kept["input"]["psnr"] == 100, "means are of the same pictures as gains"
    black = evaluation.evaluate(cases, np.zeros_like)
    assert black["mean"]["made_worse"] == 1 and black["mean"]["gain_db"] < -80
    assert evaluation.draw_worst_sheet(cases, np.zeros_like, black, 40).any()


def test_masked_psnr_counts_the_mask_alone(tmp_path: Path) -> None:
    pair_folder(tmp_path)
    mask = np.zeros((24, 30, 3))
    mask[:4] = 1
    for k in range(2):
        write_png(tmp_path / "mask" / f"mask_{k}.png", mask)

    def half(frame: Pixels) -> Pixels:
        result = frame.copy()
        result[:4] -= np.float32(0.1)
        return result

    result = evaluation.evaluate(evaluation.read_cases(tmp_path), half)["mean"]["result"]
    assert result["masked_psnr"] > 45 > result["psnr"]


def test_a_mask_of_another_shape_is_refused(tmp_path: Path) -> None:
    """Stretched over its picture it would count other pixels than it marks; a smaller one is only coarser."""
    for name, shape in (("input", (24, 30, 3)), ("gt", (24, 30, 3)), ("mask", (12, 15, 3))):
        write_png(tmp_path / name / "0.png", np.ones(shape))
    marked = evaluation.read_cases(tmp_path)[0].read()[2]
    assert marked is not None and marked.shape == (24, 30, 3)
    write_png(tmp_path / "mask" / "0.png", np.ones((30, 24, 3)))
    with pytest.raises(FrameError, match=r"0\.png is 24 x 30 pixels, another shape than .* of 30 x 24; make it for"):
        evaluation.read_cases(tmp_path)[0].read()


def test_a_flare_folder_beside_an_input_folder_is_no_input(tmp_path: Path) -> None:
    """`remove PAIRS/input --out PAIRS/clean --flare PAIRS/flare` leaves such a folder."""
    pair_folder(tmp_path)
    for folder in ("flare", "clean"):
        shutil.copytree(tmp_path / "gt", tmp_path / folder)
    assert {case.name for case in evaluation.read_cases(tmp_path)} == {"input_0", "input_1"}
    (tmp_path / "gt").rename(tmp_path / "GT")
    assert all(np.allclose(case.read()[1], 0.5, atol=0.01) for case in evaluation.read_cases(tmp_path))


def test_folders_without_complete_pairs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no pairs"):
        evaluation.read_cases(tmp_path)
    pair_folder(tmp_path)
    (tmp_path / "gt" / "gt_1.png").unlink()
    with pytest.raises(SettingsError, match="counterpart"):
        evaluation.read_cases(tmp_path)


def test_the_synthetic_test_set_is_a_function_of_its_seed() -> None:
    one, again, other = (evaluation.synthetic_cases(seed, 1, backgrounds(), built_in_lenses(), (96, 64))
                         for seed in (5, 5, 6))
    assert len(one) == 8
    for a, b, c in zip(one[:3], again[:3], other[:3], strict=True):
        (frame, scene, _), (frame2, _, _), (frame3, _, _) = a.read(), b.read(), c.read()
        assert frame.shape == scene.shape == (64, 96, 3)
        assert np.array_equal(frame, frame2)
        assert not np.array_equal(frame, frame3), "of another seed"
        np.testing.assert_allclose(frame * 255, np.round(frame * 255), rtol=0, atol=1e-4)


def test_lpips_uses_the_user_s_weights(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="lacks weights"):
        Lpips(tmp_path)
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
    torch.manual_seed(0)
    features = {f"features.{index}.weight": torch.randn(shape) / np.prod(shape[1:]) ** 0.5
                for index, shape in shapes.items()}
    features |= {f"features.{index}.bias": torch.zeros(shape[0]) for index, shape in shapes.items()}
    torch.save(features, tmp_path / "alexnet.pth")
    lines = {f"lin{k}.model.1.weight": torch.rand(1, shape[0], 1, 1) for k, shape in enumerate(shapes.values())}
    weights.write_weights(tmp_path / "alex.safetensors", lines, {})
    measure = Lpips(tmp_path)
    a = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
    assert measure(a, a) == 0
    near, far = (np.clip(a + amount, 0, 1).astype(np.float32) for amount in (0.02, 0.4))
    assert 0 < measure(a, near) < measure(a, far)


def test_final_weights_contain_a_share_of_the_initial_ones(tmp_path: Path) -> None:
    first = run.train(RECIPE, tmp_path / "first", backgrounds(), built_in_lenses(), processes=1)
    kept = {}
    for share in (0.0, 0.5, 1.0):
        folder, recipe = tmp_path / str(share), replace(RECIPE, initial_weights_mix=share, seed=2)
        with pytest.raises(Cancelled):
            run.train(recipe, folder, backgrounds(), built_in_lenses(), start=first, processes=1,
                      progress=StopAfter(2, "train"))
        run.train(recipe, folder, backgrounds(), built_in_lenses(), start=first, processes=1, resume=True)
        kept[share] = weights.read_weights(folder / run.WEIGHTS)[0]
    initial = weights.read_weights(first)[0]
    assert any(not torch.equal(kept[0.0][name], value) for name, value in initial.items())
    for name, value in initial.items():
        assert torch.equal(kept[1.0][name], value)
        torch.testing.assert_close(kept[0.5][name].float(), (value.float() + kept[0.0][name].float()) / 2, atol=1e-3,
                                   rtol=1e-3)


def test_added_layers_are_interpolated_by_the_same_share(tmp_path: Path) -> None:
    """With `initial_weights_mix` 1 a network that grew ends with the weights it began with, and predicts the same."""
    small = replace(RECIPE, blocks=(0, 1, 1, 2, 2), attention=(0, 0))
    large = replace(RECIPE, blocks=(0, 1, 2, 2, 2), attention=(1, 1), initial_weights_mix=1.0)
    first = run.train(small, tmp_path / "first", backgrounds(), built_in_lenses(), processes=1)
    grown = run.train(large, tmp_path / "grown", backgrounds(), built_in_lenses(), start=first, processes=1)
    name = "inner_attention.0.0.qkv.weight"
    assert weights.read_weights(grown)[0][name].any()
    frame = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        before, after = weights.load_network(first)(frame).flare, weights.load_network(grown)(frame).flare
    torch.testing.assert_close(after, before, rtol=1e-3, atol=1e-6)
