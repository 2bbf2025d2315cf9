# SPDX-License-Identifier: GPL-3.0-or-later
"""Tensors on disk: whole, with their text, and nothing of the file is held."""
from __future__ import annotations

from pathlib import Path

import pytest
import torch

from core.system import tensor_files

MAPS = Path("/proc/self/maps")


def test_written_tensors_are_read_back(tmp_path: Path) -> None:
    table = torch.arange(12.0).reshape(3, 4)
    tensor_files.write_tensors(tmp_path / "a.safetensors", {"table": table.T, "one": torch.ones(2, dtype=torch.half)},
                               {"who": "me"})
    read, about = tensor_files.read_tensors(tmp_path / "a.safetensors")
    assert about == {"who": "me"}
    assert torch.equal(read["table"], table.T)
    assert read["one"].dtype == torch.half
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


def test_the_same_tensors_give_the_same_bytes(tmp_path: Path) -> None:
    """The library writes the metadata in another order each time."""
    metadata = dict.fromkeys("hgfedcba", "é\n")
    for number in range(8):
        tensor_files.write_tensors(tmp_path / f"{number}", {"b": torch.ones(3), "a": torch.zeros(2)}, metadata)
    assert len({(tmp_path / f"{number}").read_bytes() for number in range(8)}) == 1
    assert tensor_files.read_tensors(tmp_path / "0")[1] == metadata


@pytest.mark.skipif(not MAPS.exists(), reason="needs a system that tells what is mapped")
def test_reading_leaves_no_mapping_of_the_file(tmp_path: Path) -> None:
    tensor_files.write_tensors(tmp_path / "held.safetensors", {"table": torch.zeros(1000, 1000)}, {})
    read, _ = tensor_files.read_tensors(tmp_path / "held.safetensors")
    part = read["table"][10:20]
    assert "held.safetensors" not in MAPS.read_text(encoding="utf-8")
    assert part.sum() == 0


def test_a_damaged_file_raises_value_error(tmp_path: Path) -> None:
    (tmp_path / "cut.safetensors").write_bytes(b"\0\1")
    with pytest.raises(ValueError, match=r"\w"):
        tensor_files.read_tensors(tmp_path / "cut.safetensors")
    with pytest.raises(OSError, match="No such file"):
        tensor_files.read_tensors(tmp_path / "absent.safetensors")
