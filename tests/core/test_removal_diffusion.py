# SPDX-License-Identifier: GPL-3.0-or-later
"""The diffusion model: real classes at a small size with random weights, in the folder format of diffusers."""
from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from core.errors import EngineError, RunError
from core.removal.inference import diffusion
from core.system.progress import Progress

HERE = all(importlib.util.find_spec(name) for name in ("diffusers", "transformers", "peft"))
needs = pytest.mark.skipif(not HERE, reason="diffusers, transformers or peft is not installed")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small random pipeline of SD-Turbo's classes, as diffusers writes it."""
    from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    torch.manual_seed(0)
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("base")
    UNet2DConditionModel(sample_size=8, in_channels=4, out_channels=4, layers_per_block=1, block_out_channels=(8, 16),
                         norm_num_groups=4, down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
                         up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"), cross_attention_dim=16,
                         attention_head_dim=4).save_pretrained(folder / "unet")
    AutoencoderKL(in_channels=3, out_channels=3, latent_channels=4, norm_num_groups=4, layers_per_block=1,
                  block_out_channels=(8, 8, 16, 16), down_block_types=("DownEncoderBlock2D",) * 4,
                  up_block_types=("UpDecoderBlock2D",) * 4).save_pretrained(folder / "vae")
    DDPMScheduler(beta_start=0.00085, beta_end=0.012,
                  beta_schedule="scaled_linear").save_pretrained(folder / "scheduler")
    letters = [chr(c) for c in range(97, 123)]
    symbols = ["<|startoftext|>", "<|endoftext|>", *letters, *(letter + "</w>" for letter in letters)]
    vocabulary = {token: k for k, token in enumerate(symbols)}
    CLIPTextModel(CLIPTextConfig(vocab_size=len(vocabulary), hidden_size=16, intermediate_size=16, num_hidden_layers=1,
                                 num_attention_heads=2, max_position_embeddings=77, bos_token_id=0, eos_token_id=1,
                                 pad_token_id=1)).save_pretrained(folder / "text_encoder")
    (folder / "tokenizer").mkdir()
    (folder / "tokenizer" / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "tokenizer" / "merges.txt").write_text("#version: 0.2\n")
    (folder / "tokenizer" / "tokenizer_config.json").write_text(json.dumps(
        {"model_max_length": 77, "tokenizer_class": "CLIPTokenizer", "unk_token": "<|endoftext|>",
         "bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "pad_token": "<|endoftext|>"}))
    return folder


def pairs() -> list[tuple[np.ndarray, np.ndarray]]:
    x, y = np.meshgrid(np.linspace(0, 1, 32), np.linspace(0, 1, 32))
    found = []
    for shift in (0.2, 0.7):
        scene = np.stack([0.3 + 0.2 * x, 0.4 - 0.2 * y, 0.3 + 0 * x], -1).astype(np.float32)
        glow = 0.4 * np.exp(-((x - shift) ** 2 + (y - 0.5) ** 2) * 20)[..., None].astype(np.float32)
        found.append((np.clip(scene + glow, 0, 1).astype(np.float32), scene))
    return found


@needs
def test_training_changes_the_loras_and_no_weight_of_the_base(base: Path) -> None:
    model = diffusion.DiffusionRemoval(base)
    frozen = {name: value.clone() for name, value in model.named_parameters() if not value.requires_grad}
    names = model.trained_tensors().keys()
    assert any("unet" in name and "lora_A" in name for name in names)
    assert any("vae.encoder" in name and "lora" in name for name in names)
    assert any("vae.decoder" in name and "lora" in name for name in names)
    assert sum(name.startswith("skips") for name in names) == 4
    assert all("lora" in name or name.startswith("skips") or "decoder.conv_out" in name for name in names)
    trainer = diffusion.DiffusionTrainer(model)
    before = {name: value.clone() for name, value in model.trained_tensors().items()}
    for frame, scene in pairs():
        trainer.step(frame, scene)
    assert all(torch.equal(value, frozen[name]) for name, value in model.named_parameters() if name in frozen)
    changed = [name for name, value in model.trained_tensors().items() if not torch.equal(value, before[name])]
    assert len(changed) > len(before) / 2


@needs
def test_a_handful_of_pairs_is_learned(base: Path) -> None:
    torch.manual_seed(0)
    trainer = diffusion.DiffusionTrainer(diffusion.DiffusionRemoval(base), learning_rate=5e-3)
    few = pairs()
    losses = [float(np.mean([trainer.step(*pair)["loss"] for pair in few])) for _ in range(150)]
    assert min(losses[-10:]) < 0.1 * losses[0]


@needs
def test_lora_files_load_back(base: Path, tmp_path: Path) -> None:
    drawn: list[int] = []

    def draw(number: int) -> tuple[np.ndarray, np.ndarray]:
        drawn.append(number)
        return pairs()[number % 2]

    model = diffusion.DiffusionRemoval(base)
    path = diffusion.train_diffusion(model, tmp_path, draw, 3, Progress())
    frame = torch.rand(1, 3, 32, 40)
    again = diffusion.DiffusionRemoval(base, diffusion.read_rank(path))
    assert not torch.equal(again.eval()(frame), model.eval()(frame))
    again.load(path)
    assert torch.equal(again(frame), model(frame))
    with pytest.raises(RunError, match="--resume"):
        diffusion.train_diffusion(model, tmp_path, draw, 5, Progress())
    diffusion.train_diffusion(again, tmp_path, draw, 5, Progress(), resume=True)
    assert drawn == [0, 1, 2, 3, 4]
    added = diffusion.DiffusionRemover(base, path).predict(pairs()[0][0]).flare
    assert added.shape == (32, 32, 3)
    assert added.min() >= 0
    with pytest.raises(RunError, match="not trained on this base"):
        diffusion.DiffusionRemoval(base, rank=4).load(path)


@needs
def test_an_invalid_base_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no base model"):
        diffusion.DiffusionRemoval(tmp_path)


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(EngineError, match="needs diffusers, transformers, peft"):
        diffusion.check_packages()
