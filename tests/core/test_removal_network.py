# SPDX-License-Identifier: GPL-3.0-or-later
"""The removal network, its inputs and its weights."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from core.errors import RunError
from core.removal.model import weights
from core.removal.model.image_formation import flare_to_linear
from core.removal.model.network import INPUT_CHANNELS, LEVELS, RemovalNetwork, pyramid_inputs
from tests.core.removal_cases import TINY


def test_a_flare_in_display_values_is_converted_to_light() -> None:
    frame, added = np.float32([0.8, 0.8, 0.1]), np.float32([0.0, 0.3, 0.4])
    np.testing.assert_allclose(flare_to_linear(frame, added), [0.0, 0.64 - 0.25, 0.01], atol=1e-6)


def test_every_level_gets_the_minima_and_the_frame_rotated_about_its_centre() -> None:
    frame = torch.rand(1, 3, 64, 96)
    levels = pyramid_inputs(frame)
    assert [tuple(part.shape[2:]) for part in levels] == [(64 >> k, 96 >> k) for k in range(1, LEVELS + 1)]
    for level, part in enumerate(levels):
        assert part.shape[1] == INPUT_CHANNELS + (12 if level == 0 else 0)
        side = 2 << level
        here = part[:, -INPUT_CHANNELS:]
        torch.testing.assert_close(here[:, :3, 0, 1], frame[:, :, :side, side:2 * side].mean((2, 3)))
        torch.testing.assert_close(here[:, 4:7, 0, 1], frame[:, :, :side, side:2 * side].amin((2, 3)))
        torch.testing.assert_close(here[:, 8:16], torch.flip(here[:, :8], (2, 3)))
        assert here[0, -3].abs().max() < 1
        assert here[0, -3, 0, 0] == -here[0, -3, 0, -1]


@pytest.mark.parametrize("size", [(32, 32), (64, 128)])
def test_the_network_is_fully_convolutional(size: tuple[int, int]) -> None:
    output = RemovalNetwork(TINY.widths, TINY.blocks, TINY.attention)(torch.rand(2, 3, *size))
    assert output.flare.shape == output.flare_without_glow.shape == (2, 3, *size)


def test_the_prediction_depends_on_the_opposite_corner() -> None:
    """A light in one corner may have its ghost in the other."""
    torch.manual_seed(3)
    network = RemovalNetwork(TINY.widths, TINY.blocks, TINY.attention)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    frame = torch.full((1, 3, 96, 96), 0.2, requires_grad=True)
    network(frame).flare[0, :, -4:, :4].sum().backward()
    assert frame.grad is not None
    assert float(frame.grad[0, :, :4, :4].abs().sum()) > 0


def test_weights_keep_their_recipe_and_damaged_files_are_refused(tmp_path: Path, flare_everywhere: Path) -> None:
    assert [conv.out_channels for conv in weights.load_network(flare_everywhere).input_convs] == list(TINY.widths)
    with pytest.raises(RunError, match="missing"):
        weights.read_weights(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    with pytest.raises(RunError, match="damaged"):
        weights.read_weights(tmp_path / "bad.safetensors")
    weights.write_weights(tmp_path / "other.safetensors", {"a": torch.zeros(2)}, {})
    with pytest.raises(RunError, match="no weights of the removal network"):
        weights.load_network(tmp_path / "other.safetensors")
    tensors, about = weights.read_weights(flare_everywhere)
    tensors[next(iter(tensors))].view(-1)[0] = torch.nan
    weights.write_weights(tmp_path / "nan.safetensors", tensors, about)
    with pytest.raises(RunError, match="no finite numbers"):
        weights.load_network(tmp_path / "nan.safetensors")


def test_weights_are_read_under_the_tensor_names_of_format_0(tmp_path: Path, flare_everywhere: Path) -> None:
    tensors, metadata = weights.read_weights(flare_everywhere)
    retired = {present: name for name, present in weights.RETIRED_NAMES.items()}
    renamed = {".".join(retired.get(part, part) for part in name.split(".")): value for name, value in tensors.items()}
    assert "enter.1.0.first.weight" in renamed and "attention.0.asked.weight" in renamed
    weights.write_weights(tmp_path / "format_0.safetensors", renamed, metadata)
    assert weights.read_weights(tmp_path / "format_0.safetensors")[0].keys() == tensors.keys()
    frame = torch.rand(1, 3, 64, 96)
    assert torch.equal(weights.load_network(tmp_path / "format_0.safetensors")(frame).flare,
                       weights.load_network(flare_everywhere)(frame).flare)
