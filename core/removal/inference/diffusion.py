# SPDX-License-Identifier: GPL-3.0-or-later
"""Removal by a fine-tuned one-step latent diffusion model (after Difix3D+ and img2img-turbo), the removal model of the
method that `core.fit` implements.

The latents of the frame are treated as those of step 199 of the noise schedule, and denoised once under a fixed prompt.
Training changes LoRAs of rank 16 on the UNet and on the VAE's encoder and decoder, 1x1 skip convolutions from the
encoder past the bottleneck to the decoder, which preserve detail, and the decoder's last convolution. All other weights
stay those of the base model.

The base is a folder in the layout of diffusers (vae/, unet/, text_encoder/, tokenizer/, scheduler/), such as
SD-Turbo's, or its name in the local cache of Hugging Face; nothing is downloaded. diffusers, transformers and peft are
optional. `remove --model diffusion` and `train-removal --model diffusion` call this module.
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
from ...system.folder_lock import folder_lock
from ...system.progress import Progress
from ..model import weights
from .prediction import TtaPrediction, single_prediction
from .remover import WORKING_SIZE, Remover, compute_cache_key

PROMPT = "remove flares and keep the original image. High quality. Retain original colors"
NOISE_STEP = 199
"""Step of the noise schedule that a frame's latents are treated as."""
RANK = 16
"""Rank of the LoRAs."""
LEARNING_RATE = 1e-4
ITERATIONS = 200_000
SAVE_EVERY = 500  # iterations
SIZE_MULTIPLE = 8
"""Height and width of the model's input are multiples of this, pixels."""
KIND = "fit-flare diffusion removal"
"""Kind of the file, in its header."""

_UNET_LAYERS = ["to_q", "to_k", "to_v", "to_out.0", "conv1", "conv2", "conv_shortcut", "conv_in", "conv_out",
                "proj_in", "proj_out", "ff.net.0.proj", "ff.net.2", "downsamplers.0.conv", "upsamplers.0.conv"]
_VAE_LAYERS = r".*(encoder|decoder)\..*(conv1|conv2|conv_shortcut|conv_in|to_q|to_k|to_v|to_out\.0|samplers\.0\.conv)$"
"""Layers with LoRAs: ends of names in the UNet; a pattern for whole names in the VAE."""


def check_packages() -> None:
    """Raise EngineError where the optional packages are missing."""
    missing = [name for name in ("diffusers", "transformers", "peft") if importlib.util.find_spec(name) is None]
    if missing:
        raise EngineError(f"The diffusion model needs {', '.join(missing)}, which this Python lacks; install the "
                          "group `diffusion` of pyproject.toml, or use the network that comes with the program.")


class DiffusionRemoval(nn.Module):
    """The base model with its LoRAs and skip convolutions; frames are (n, 3, h, w), display values 0..1, h and w
    multiples of SIZE_MULTIPLE."""

    unet: Any
    vae: Any
    alpha_cumprod: Tensor
    prompt: Tensor

    def __init__(self, base: Path | str, rank: int = RANK) -> None:
        """Load the base model, frozen, and add the LoRAs and skip convolutions to train.

        base: folder of the base model, or its name in the local cache. rank: rank of the LoRAs. Raises EngineError
        where packages are missing, RunError where the base cannot be read.
        """
        super().__init__()
        check_packages()
        from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel
        from peft import LoraConfig
        from transformers import CLIPTextModel, CLIPTokenizer

        source = str(base)
        try:
            tokenizer = CLIPTokenizer.from_pretrained(source, subfolder="tokenizer", local_files_only=True)
            text_encoder = CLIPTextModel.from_pretrained(source, subfolder="text_encoder", local_files_only=True)
            self.unet = UNet2DConditionModel.from_pretrained(source, subfolder="unet", local_files_only=True)
            self.vae = AutoencoderKL.from_pretrained(source, subfolder="vae", local_files_only=True)
            schedule = DDPMScheduler.from_pretrained(source, subfolder="scheduler", local_files_only=True)
        except (OSError, ValueError) as problem:
            raise RunError(f"{base} is no base model in the layout of diffusers, in a folder or in this machine's "
                           f"cache ({str(problem).splitlines()[0]:.200}); get one and name its folder with "
                           "--base.") from problem
        self.rank = rank
        self.register_buffer("alpha_cumprod", schedule.alphas_cumprod[NOISE_STEP].clone(), persistent=False)
        self.register_buffer("prompt", _embed_prompt(tokenizer, text_encoder), persistent=False)
        self.requires_grad_(False)
        self.unet.add_adapter(LoraConfig(r=rank, lora_alpha=rank, init_lora_weights="gaussian",
                                         target_modules=_UNET_LAYERS))
        self.vae.add_adapter(LoraConfig(r=rank, lora_alpha=rank, init_lora_weights="gaussian",
                                        target_modules=_VAE_LAYERS))
        self.skips = self._create_skips()
        self.vae.decoder.conv_out.requires_grad_(True)

    def _create_skips(self) -> nn.ModuleList:
        """Return 1x1 convolutions from the input of each encoder block to the input of the matching decoder block,
        deepest first, with weights of almost zero."""
        encoder, decoder = self.vae.encoder, self.vae.decoder
        in_channels = [block.resnets[0].in_channels for block in encoder.down_blocks][::-1]
        out_channels = [block.resnets[0].in_channels for block in decoder.up_blocks]
        layers = nn.ModuleList(nn.Conv2d(encoder_width, decoder_width, 1, bias=False) for encoder_width, decoder_width
                               in zip(in_channels, out_channels, strict=True))
        for layer in layers:
            nn.init.constant_(layer.get_parameter("weight"), 1e-5)
        return layers

    def forward(self, display: Tensor) -> Tensor:
        """Return frames (n, 3, h, w) of display values without their flare, not clipped: one denoising step on the
        latents."""
        latents, features = self._encode(display * 2 - 1)
        prompt = self.prompt.expand(len(display), -1, -1)
        step = torch.full((len(display),), NOISE_STEP, dtype=torch.long, device=display.device)
        noise = self.unet(latents, step, encoder_hidden_states=prompt).sample
        # Latents are sqrt(alpha) * clean + sqrt(1 - alpha) * noise (Ho et al. 2020), solved for the clean ones.
        clean = (latents - (1 - self.alpha_cumprod).sqrt() * noise) / self.alpha_cumprod.sqrt()
        return (self._decode(clean, features) + 1) / 2

    def _encode(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return the latents of x (n, 3, h, w), -1..1, and the features for the skip convolutions."""
        encoder, features = self.vae.encoder, []
        x = encoder.conv_in(x)
        for block in encoder.down_blocks:
            features.append(x)
            x = block(x)
        x = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(encoder.mid_block(x))))
        if self.vae.quant_conv is not None:
            x = self.vae.quant_conv(x)
        # The first half of the channels is the mean of the latents, the second their log variance.
        return x.chunk(2, 1)[0] * self.vae.config.scaling_factor, features

    def _decode(self, latents: Tensor, features: list[Tensor]) -> Tensor:
        """Return the frames (n, 3, h, w), -1..1, of latents and encoder features, as `_encode` returns them."""
        decoder, x = self.vae.decoder, latents / self.vae.config.scaling_factor
        if self.vae.post_quant_conv is not None:
            x = self.vae.post_quant_conv(x)
        x = decoder.mid_block(decoder.conv_in(x))
        for block, skip, feature in zip(decoder.up_blocks, self.skips, reversed(features), strict=True):
            x = block(x + skip(feature))
        return decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(x)))

    def trained_tensors(self) -> dict[str, Tensor]:
        """Return the tensors that training changes, by name."""
        return {name: value.detach() for name, value in self.named_parameters() if value.requires_grad}

    def save(self, path: Path | str, metadata: Mapping[str, str] | None = None) -> None:
        """Write the trained tensors, for use with the same base model."""
        weights.write_weights(path, {name: value.contiguous() for name, value in self.trained_tensors().items()},
                              {"kind": KIND, "rank": str(self.rank), **(metadata or {})})

    def load(self, path: Path | str) -> dict[str, str]:
        """Load the trained tensors from a file that `save` wrote, and return the metadata of its header. Raises
        RunError where it is another kind of file, or belongs to another base model."""
        tensors, metadata = weights.read_weights(path)
        trained = self.trained_tensors()
        if metadata.get("kind") != KIND or tensors.keys() != trained.keys() or any(
                tensors[name].shape != trained[name].shape for name in trained):
            raise RunError(f"{path} was not trained on this base model, or is no LoRA of train-removal --model "
                           "diffusion; use the base that it was trained on.")
        parameters = dict(self.named_parameters())
        with torch.no_grad():
            for name, value in tensors.items():
                parameters[name].copy_(value)
        return metadata


def read_rank(path: Path | str) -> int:
    """Return the rank of the LoRAs in a file that `DiffusionRemoval.save` wrote."""
    return int(weights.read_weights(path)[1].get("rank", RANK))


@torch.no_grad()
def _embed_prompt(tokenizer: Any, text_encoder: Any) -> Tensor:
    tokens = tokenizer(PROMPT, padding="max_length", max_length=tokenizer.model_max_length, truncation=True,
                       return_tensors="pt")
    embedded: Tensor = text_encoder(tokens.input_ids)[0]
    return embedded


class DiffusionTrainer:
    """Trains the model by L2 + LPIPS with batches of 1 and AdamW, on the same pairs as the removal network.

    perceptual: returns the LPIPS of two batches of pictures; None for L2 alone.
    """

    def __init__(self, model: DiffusionRemoval, *, learning_rate: float = LEARNING_RATE,
                 perceptual: Callable[[Tensor, Tensor], Tensor] | None = None) -> None:
        self.model, self._perceptual = model, perceptual
        self.optimiser = torch.optim.AdamW([value for value in model.parameters() if value.requires_grad],
                                           learning_rate)

    def step(self, frame: Pixels, scene: Pixels) -> dict[str, float]:
        """Run one iteration and return its losses. frame, scene: with and without flare, display values (h, w, 3)."""
        device = next(self.model.parameters()).device
        source, target = (torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)))[None].to(device)
                          for picture in (frame, scene))
        prediction = self.model(source)
        l2_loss = F.mse_loss(prediction, target)
        loss = l2_loss if self._perceptual is None else l2_loss + self._perceptual(prediction, target)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        return {"loss": float(loss.detach()), "l2": float(l2_loss.detach())}


class DiffusionRemover(Remover):
    """Removes flares from plates with the diffusion model: the frame minus the model's output is the flare."""

    min_mean_flare = 0.0

    def __init__(self, base: Path | str, lora: Path | str, *, working_size: int = WORKING_SIZE) -> None:
        """Load the base model and its trained tensors.

        base: folder of the base model, or its name in the local cache. lora: the file that `DiffusionRemoval.save`
        wrote. working_size: long side of the model's input, pixels. Raises EngineError, RunError.
        """
        # Remover.__init__ would load the network. The model does not separate the glow, so all of it is removed.
        self.working_size, self.glow = working_size, "remove"
        self.model = DiffusionRemoval(base, read_rank(lora))
        self.model.load(lora)
        self.model.eval()
        self._model_key = compute_cache_key("diffusion", lora, str(base), working_size)

    @property
    def _module(self) -> nn.Module:
        return self.model

    @torch.inference_mode()
    def predict_with_tta(self, display: Pixels) -> TtaPrediction:
        """Predict the flare of display values (h, w, 3), h and w multiples of SIZE_MULTIPLE, in one pass without
        augmentation."""
        frame = torch.from_numpy(np.ascontiguousarray(display.transpose(2, 0, 1)))[None].to(self.device)
        flare = (frame - self.model(frame).clamp(0, 1)).clamp(min=0)
        return single_prediction(np.ascontiguousarray(flare[0].permute(1, 2, 0).cpu().numpy()))


def train_diffusion(model: DiffusionRemoval, folder: Path | str, draw_pair: Callable[[int], tuple[Pixels, Pixels]],
                    iterations: int, progress: Progress, *, resume: bool = False,
                    perceptual: Callable[[Tensor, Tensor], Tensor] | None = None) -> Path:
    """Train the model and return the path of its weights, lora.safetensors in `folder`, which are saved every
    SAVE_EVERY iterations and when the training ends or is stopped.

    draw_pair: returns the frame and the scene of an iteration. perceptual: returns the LPIPS of two batches of
    pictures; None for L2 alone. resume: continue the training in the folder; the moments of the optimiser start at
    zero. Raises RunError, SettingsError, Cancelled.
    """
    if iterations < 1:
        raise SettingsError("A training needs at least one iteration.")
    folder = Path(folder)
    with folder_lock(folder):
        path, start_iteration = folder / "lora.safetensors", 0
        if path.exists():
            if not resume:
                raise RunError(f"{folder} holds a training already; go on with --resume, or choose another folder.")
            start_iteration = int(json.loads(model.load(path).get("iteration", "0")))
        trainer = DiffusionTrainer(model, perceptual=perceptual)
        progress.stage("train", iterations, min(start_iteration, iterations))
        completed = start_iteration
        try:
            for index in range(start_iteration, iterations):
                metrics = trainer.step(*draw_pair(index))
                completed = index + 1
                if completed % SAVE_EVERY == 0:
                    model.save(path, {"iteration": str(completed)})
                progress.advance(1, **metrics)
        finally:
            if completed > start_iteration:
                model.save(path, {"iteration": str(completed)})
    return path
