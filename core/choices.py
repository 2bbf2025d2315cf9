# SPDX-License-Identifier: GPL-3.0-or-later
"""Options that users choose by name, for code that offers the choice where torch cannot be imported.

The settings, the commands and the add-on's menus take them from here.
"""
from __future__ import annotations

from typing import Literal

Preset = Literal["draft", "standard", "high", "paper"]
Mode = Literal["default", "estimated", "split", "unsup", "in-flare", "2d", "3dgs"]
Model = Literal["paper", "ours"]
Blend = Literal["over", "add"]
Kernels = Literal["auto", "torch", "tiles", "cpu", "cuda"]
Device = Literal["auto", "cpu", "cuda"]
Matching = Literal["auto", "exhaustive", "sequential", "similar"]
Follows = Literal["source", "target", "blend"]
"""Camera and lights that the appearance of a transferred flare follows, see `core.transfer.query`."""

OUR_PRESETS: tuple[Preset, ...] = ("draft", "standard", "high")
"""Presets of the model "ours", the shortest first."""
ITERATIONS: dict[Preset, int] = {"draft": 1500, "standard": 2400, "high": 10000, "paper": 30000}
"""Number of iterations of a fit by its preset."""
PARALLAX_MODES: tuple[Mode, ...] = ("estimated", "split")
"""Modes that separate scene and flare by parallax."""
PARALLAX_ITERATIONS: dict[Preset, int] = {"draft": 1800, "standard": 3600, "high": 12000, "paper": 36000}
"""The same in those modes, which lack the exact clean frames that tell scene from flare, and so take longer."""
