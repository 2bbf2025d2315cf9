# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric"), AlexNet, v0.1.

The weights are not part of this program: a folder holds those of AlexNet's features, as torchvision names
them (features.0.weight, ...), and the five linear layers of the metric (lin0.model.1.weight, ...), in
.safetensors or .pth files of any name.
"""
from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor

from ..colour.srgb import Pixels
from ..errors import SettingsError
from ..system.reading import check_regular

_LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))
"""Index in AlexNet's features, stride, padding, whether a 3x3 maximum of stride 2 comes first."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and standard deviation of red, green and blue, -1 to 1, by which the network's input is normalised."""


class Lpips:
    """LPIPS distance of two pictures of display values 0..1; 0 is equal."""

    def __init__(self, folder: Path | str) -> None:
        """Read the weights from a folder. Raises SettingsError if some are missing, or a file holds more than
        weights."""
        self._weights: dict[str, Tensor] = {}
        for path in sorted(Path(folder).glob("*")):
            self._weights.update(_read_weights(path))
        required = [f"features.{layer[0]}.{kind}" for layer in _LAYERS for kind in ("weight", "bias")]
        required += [f"lin{k}.model.1.weight" for k in range(5)]
        missing = [name for name in required if name not in self._weights]
        if missing:
            raise SettingsError(f"{folder} lacks weights of LPIPS, first {missing[0]}; put AlexNet's features and the "
                                "metric's five layers there.")

    @torch.inference_mode()
    def __call__(self, image: Pixels, target: Pixels) -> float:
        """Return the distance of two pictures (height, width, 3), at least 32 pixels a side."""
        stacked = (torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32))[None]
                   for picture in (image, target))
        return float(self.distance(*stacked))

    def distance(self, image: Tensor, target: Tensor) -> Tensor:
        """Return the mean distance of pictures (n, 3, h, w), with gradients."""
        total = torch.zeros((), device=image.device)
        features = zip(self._features(image), self._features(target), strict=True)
        for level, (image_features, target_features) in enumerate(features):
            weight = self._weights[f"lin{level}.model.1.weight"].reshape(1, -1, 1, 1).to(image_features)
            total = total + (((image_features - target_features) ** 2) * weight).sum(1).mean()
        return total

    def _features(self, x: Tensor) -> list[Tensor]:
        """Return the activations of the compared layers for x (n, 3, h, w), 0..1, normalised over channels."""
        shift, scale = (torch.tensor(values, device=x.device).reshape(1, 3, 1, 1) for values in (_SHIFT, _SCALE))
        x = (x * 2 - 1 - shift) / scale
        features = []
        for index, stride, padding, is_pooled in _LAYERS:
            if is_pooled:
                x = F.max_pool2d(x, 3, 2)
            kernel, bias = (self._weights[f"features.{index}.{kind}"].to(x) for kind in ("weight", "bias"))
            x = F.relu(F.conv2d(x, kernel, bias, stride, padding))
            features.append(x / (x.square().sum(1, keepdim=True) + 1e-20).sqrt())
        return features


def _read_weights(path: Path) -> dict[str, Tensor]:
    """Read a file of weights; {} for a file of another kind. Raises SettingsError for pickled code."""
    check_regular(path)
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(str(path))
    if path.suffix in (".pth", ".pt"):
        try:
            stored = torch.load(path, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError) as problem:
            raise SettingsError(f"{path} is no file of plain weights; remove it from the folder.") from problem
        return {str(name): value for name, value in stored.items() if isinstance(value, Tensor)}
    return {}
