# SPDX-License-Identifier: GPL-3.0-or-later
"""Names of the files in a run's folder, for code that reads a run where torch cannot be imported."""
from __future__ import annotations

CONFIG = "config.toml"
CAPTURE = "capture.txt"
FLARE = "flare.flare"
SCENE = "scene.ply"
PLATES = "plates"
FRAME_LIGHTS = "lights.json"
CHECKPOINT = "checkpoint/state.safetensors"
METRICS = "metrics.jsonl"
PREVIEW = "preview.png"
SMALL_PREVIEW = "preview_small.png"
EVALUATION = "eval.json"
LOG = "log.txt"
