# SPDX-License-Identifier: GPL-3.0-or-later
"""The method's own removal: a latent diffusion model of one step (after Difix3D+ and img2img-turbo), fine-tuned.

The frame's latents are taken for those of step 199 of the noise schedule and denoised once under a fixed
prompt. What is trained: LoRA of rank 16 on the UNet and on the VAE's encoder and decoder, and 1x1
convolutions that carry the encoder's features past the bottleneck to the decoder, so that detail survives,
with the decoder's last convolution. Everything else keeps the bits of the base model.

The base is a folder in the layout of diffusers (vae/, unet/, text_encoder/, tokenizer/, scheduler/), such as
SD-Turbo's, or its name in the local cache of Hugging Face; nothing is downloaded. diffusers, transformers
and peft are optional.
"""
from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor, nn

from ...colour.srgb import Pixels
from ...errors import EngineError, RunError, SettingsError
from ...system.folder_lock import held
from ...system.progress import Progress
from ..model import weights
from .remover import WORKING_SIZE, Remover, described
from .test_time_views import Views, told_once

PROMPT = "remove flares and keep the original image. High quality. Retain original colors"
STEP = 199
RANK = 16
RATE = 1e-4
ITERATIONS = 200_000
SAVE_EVERY = 500  # iterations
MULTIPLE = 8
KIND = "fit-flare diffusion removal"

_UNET_LAYERS = ["to_q", "to_k", "to_v", "to_out.0", "conv1", "conv2", "conv_shortcut", "conv_in", "conv_out",
                "proj_in", "proj_out", "ff.net.0.proj", "ff.net.2", "downsamplers.0.conv", "upsamplers.0.conv"]
_VAE_LAYERS = r".*(encoder|decoder)\..*(conv1|conv2|conv_shortcut|conv_in|to_q|to_k|to_v|to_out\.0|samplers\.0\.conv)$"


def need() -> None:
    """Raises EngineError, in one sentence, where the optional packages are absent."""
    lacking = [name for name in ("diffusers", "transformers", "peft") if importlib.util.find_spec(name) is None]
    if lacking:
        raise EngineError(f"The diffusion model needs {', '.join(lacking)}, which this Python has not; install the "
                          "group `diffusion` of pyproject.toml, or use the network that comes with the program.")


class DiffusionRemoval(nn.Module):
    """A base pipeline with what is trained on top of it; pictures are (n, 3, h, w), display values 0..1, sides
    multiples of MULTIPLE."""

    unet: Any
    vae: Any
    kept: Tensor
    prompt: Tensor

    def __init__(self, base: Path | str, rank: int = RANK) -> None:
        """Raises EngineError without the packages, RunError where the base cannot be read."""
        super().__init__()
        need()
        from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel
        from peft import LoraConfig
        from transformers import CLIPTextModel, CLIPTokenizer

        where = str(base)
        try:
            tokenizer = CLIPTokenizer.from_pretrained(where, subfolder="tokenizer", local_files_only=True)
            text = CLIPTextModel.from_pretrained(where, subfolder="text_encoder", local_files_only=True)
            self.unet = UNet2DConditionModel.from_pretrained(where, subfolder="unet", local_files_only=True)
            self.vae = AutoencoderKL.from_pretrained(where, subfolder="vae", local_files_only=True)
            schedule = DDPMScheduler.from_pretrained(where, subfolder="scheduler", local_files_only=True)
        except (OSError, ValueError) as problem:
            raise RunError(f"{base} is no base model in the layout of diffusers, in a folder or in this machine's "
                           f"cache ({str(problem).splitlines()[0]:.200}); get one and name its folder with "
                           "--base.") from problem
        self.rank = rank
        self.register_buffer("kept", schedule.alphas_cumprod[STEP].clone(), persistent=False)
        self.register_buffer("prompt", _embedded(tokenizer, text), persistent=False)
        self.requires_grad_(False)
        self.unet.add_adapter(LoraConfig(r=rank, lora_alpha=rank, init_lora_weights="gaussian",
                                         target_modules=_UNET_LAYERS))
        self.vae.add_adapter(LoraConfig(r=rank, lora_alpha=rank, init_lora_weights="gaussian",
                                        target_modules=_VAE_LAYERS))
        self.skips = self._new_skips()
        self.vae.decoder.conv_out.requires_grad_(True)

    def _new_skips(self) -> nn.ModuleList:
        """1x1 convolutions from what enters each of the encoder's blocks to what enters the decoder's, from the
        deepest; almost nothing at first."""
        encoder, decoder = self.vae.encoder, self.vae.decoder
        entering = [block.resnets[0].in_channels for block in encoder.down_blocks][::-1]
        wanted = [block.resnets[0].in_channels for block in decoder.up_blocks]
        layers = nn.ModuleList(nn.Conv2d(a, b, 1, bias=False) for a, b in zip(entering, wanted, strict=True))
        for layer in layers:
            nn.init.constant_(layer.get_parameter("weight"), 1e-5)
        return layers

    def forward(self, display: Tensor) -> Tensor:
        """The pictures without flare, not clipped."""
        latents, features = self._encode(display * 2 - 1)
        prompt = self.prompt.expand(len(display), -1, -1)
        step = torch.full((len(display),), STEP, dtype=torch.long, device=display.device)
        noise = self.unet(latents, step, encoder_hidden_states=prompt).sample
        clean = (latents - (1 - self.kept).sqrt() * noise) / self.kept.sqrt()
        return (self._decode(clean, features) + 1) / 2

    def _encode(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        encoder, features = self.vae.encoder, []
        x = encoder.conv_in(x)
        for block in encoder.down_blocks:
            features.append(x)
            x = block(x)
        x = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(encoder.mid_block(x))))
        if self.vae.quant_conv is not None:
            x = self.vae.quant_conv(x)
        return x.chunk(2, 1)[0] * self.vae.config.scaling_factor, features

    def _decode(self, latents: Tensor, features: list[Tensor]) -> Tensor:
        decoder, x = self.vae.decoder, latents / self.vae.config.scaling_factor
        if self.vae.post_quant_conv is not None:
            x = self.vae.post_quant_conv(x)
        x = decoder.mid_block(decoder.conv_in(x))
        for block, skip, feature in zip(decoder.up_blocks, self.skips, reversed(features), strict=True):
            x = block(x + skip(feature))
        return decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(x)))

    def trained(self) -> dict[str, Tensor]:
        """The tensors that training changes, by name."""
        return {name: value.detach() for name, value in self.named_parameters() if value.requires_grad}

    def save(self, path: Path | str, about: Mapping[str, str] | None = None) -> None:
        """Write what was trained, which is of use with the same base alone."""
        weights.write(path, {name: value.contiguous() for name, value in self.trained().items()},
                      {"kind": KIND, "rank": str(self.rank), **(about or {})})

    def load(self, path: Path | str) -> dict[str, str]:
        """Read it again. Raises RunError where it is none, or belongs to another base."""
        tensors, about = weights.read(path)
        own = self.trained()
        if about.get("kind") != KIND or tensors.keys() != own.keys() or any(
                tensors[name].shape != own[name].shape for name in own):
            raise RunError(f"{path} was not trained on this base model, or is no LoRA of train-removal --model "
                           "diffusion; use the base that it was trained on.")
        parameters = dict(self.named_parameters())
        with torch.no_grad():
            for name, value in tensors.items():
                parameters[name].copy_(value)
        return about


def rank_of(path: Path | str) -> int:
    """Of the LoRA in a file that `DiffusionRemoval.save` wrote."""
    return int(weights.read(path)[1].get("rank", RANK))


@torch.no_grad()
def _embedded(tokenizer: Any, text: Any) -> Tensor:
    words = tokenizer(PROMPT, padding="max_length", max_length=tokenizer.model_max_length, truncation=True,
                      return_tensors="pt")
    embedded: Tensor = text(words.input_ids)[0]
    return embedded


class DiffusionTrainer:
    """L2 + LPIPS, batch 1, AdamW at 1e-4, on the pairs that the network in the box is trained on."""

    def __init__(self, model: DiffusionRemoval, *, rate: float = RATE,
                 perceptual: Callable[[Tensor, Tensor], Tensor] | None = None) -> None:
        self.model, self._perceptual = model, perceptual
        self.optimiser = torch.optim.AdamW([value for value in model.parameters() if value.requires_grad], rate)

    def step(self, frame: Pixels, scene: Pixels) -> dict[str, float]:
        """One iteration on a picture and its counterpart, display values (height, width, 3)."""
        device = next(self.model.parameters()).device
        given, goal = (torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))[None].to(device)
                       for picture in (frame, scene))
        told = self.model(given)
        squared = F.mse_loss(told, goal)
        loss = squared if self._perceptual is None else squared + self._perceptual(told, goal)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        return {"loss": float(loss.detach()), "l2": float(squared.detach())}


class DiffusionRemover(Remover):
    """Takes flares from plates by the diffusion model: what its answer lacks of the frame is the flare."""

    sure = 0.0

    def __init__(self, base: Path | str, lora: Path | str, *, working_size: int = WORKING_SIZE) -> None:
        """lora: the file that `DiffusionRemoval.save` wrote. Raises EngineError, RunError."""
        self.working_size, self.glow = working_size, "taken"
        self.model = DiffusionRemoval(base, rank_of(lora))
        self.model.load(lora)
        self.model.eval()
        self.described = described("diffusion", lora, str(base), working_size)

    @torch.inference_mode()
    def views(self, display: Pixels) -> Views:
        """Of display values whose sides are multiples of MULTIPLE, which the model is shown once."""
        frame = torch.from_numpy(np.ascontiguousarray(display.transpose(2, 0, 1)))[None]
        added = (frame - self.model(frame).clamp(0, 1)).clamp(min=0)
        return told_once(np.ascontiguousarray(added[0].permute(1, 2, 0).numpy()))


def train_diffusion(model: DiffusionRemoval, folder: Path | str, draw: Callable[[int], tuple[Pixels, Pixels]],
                    iterations: int, progress: Progress, *, resume: bool = False,
                    perceptual: Callable[[Tensor, Tensor], Tensor] | None = None) -> Path:
    """Train and write lora.safetensors, again and again; `draw` gives the pair of an iteration.

    Resuming starts the optimiser's moments anew. Raises RunError, SettingsError, Cancelled.
    """
    if iterations < 1:
        raise SettingsError("A training needs at least one iteration.")
    folder = Path(folder)
    with held(folder):
        path, first = folder / "lora.safetensors", 0
        if path.exists():
            if not resume:
                raise RunError(f"{folder} holds a training already; go on with --resume, or choose another folder.")
            first = int(json.loads(model.load(path).get("iteration", "0")))
        trainer = DiffusionTrainer(model, perceptual=perceptual)
        progress.stage("train", iterations, min(first, iterations))
        done = first
        try:
            for number in range(first, iterations):
                figures = trainer.step(*draw(number))
                done = number + 1
                if done % SAVE_EVERY == 0:
                    model.save(path, {"iteration": str(done)})
                progress.advance(1, **figures)
        finally:
            if done > first:
                model.save(path, {"iteration": str(done)})
    return path
