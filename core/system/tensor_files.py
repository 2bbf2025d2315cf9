# SPDX-License-Identifier: GPL-3.0-or-later
"""Tensors on disk: safetensors with text metadata, written atomically. Checkpoints, flares and weights use it."""
from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from .files import atomic_path
from .reading import check_regular


def write_tensors(path: Path | str, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write tensors and their metadata: the same bytes for the same arguments."""
    from safetensors.torch import save

    with atomic_path(path) as temporary:
        # Encode in memory: safetensors' own writer makes a temporary file, which would stay after a kill.
        data = save({name: value.cpu().contiguous() for name, value in tensors.items()}, dict(metadata))
        temporary.write_bytes(_with_sorted_metadata(data))


def _with_sorted_metadata(data: bytes) -> bytes:
    """Return a safetensors file with its metadata in the order of their names: the library's order is random."""
    body = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:body])
    if metadata := header.pop("__metadata__", None):
        header = {"__metadata__": dict(sorted(metadata.items())), **header}
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 8)  # the tensors stay aligned
    return len(text).to_bytes(8, "little") + text + data[body:]


def read_tensors(path: Path | str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read (tensors, metadata). Raises OSError, and ValueError where the file is damaged.

    Returns copies: safetensors gives views of the mapped file, which Windows does not let anyone replace while a view
    exists.
    """
    from safetensors import SafetensorError, safe_open

    check_regular(path)
    try:
        with safe_open(str(path), "pt") as file:
            return ({name: file.get_tensor(name).clone() for name in file.keys()},  # noqa: SIM118 - not a mapping
                    dict(file.metadata() or {}))
    except (SafetensorError, UnicodeError) as problem:  # UnicodeError: a path that is not UTF-8
        raise ValueError(str(problem)) from problem
