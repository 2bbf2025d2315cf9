# SPDX-License-Identifier: GPL-3.0-or-later
"""What users choose from by name, for those who offer the choice where the engine itself cannot be imported."""
from __future__ import annotations

from typing import Literal

Preset = Literal["draft", "standard", "high", "paper"]
Mode = Literal["default", "estimated", "split", "unsup", "in-flare", "2d", "3dgs"]
Model = Literal["paper", "ours"]
Blend = Literal["over", "add"]
Kernels = Literal["auto", "torch", "tiles", "cpu", "cuda"]
Matching = Literal["auto", "exhaustive", "sequential", "similar"]
Follows = Literal["source", "target", "blend"]
"""What the appearance of a transferred flare follows: `core.transfer.query`."""

OUR_PRESETS: tuple[Preset, ...] = ("draft", "standard", "high")
"""Those of our form, the shortest first."""
ITERATIONS: dict[Preset, int] = {"draft": 1500, "standard": 3000, "high": 10000, "paper": 30000}
"""Length of a fit by its preset."""
BY_PARALLAX: tuple[Mode, ...] = ("estimated", "split")
"""Those in which scene and flare are told apart by how they move."""
LONGER_BY_PARALLAX = 1.2
"""Times that length, in those: they have to find out by themselves what exact flare-free frames would say."""
