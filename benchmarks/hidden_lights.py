# SPDX-License-Identifier: GPL-3.0-or-later
"""What is left of a light's flare in the views where geometry hides the light, against those where it is seen."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from core.capture import Camera, View
from core.errors import CaptureError
from core.metrics.evaluation import Renderer
from core.system.files import read_json

SHARES = "truth/visible_share.json"
"""Of a sample capture: for each frame and light the part of the light's disc that no geometry hides, 0..1."""


def hidden_flare(renderer: Renderer, folder: Path, cameras: Mapping[View, Camera]) -> dict[str, Any] | None:
    """Energies (means of the linear layer over pixels and channels) of the lights' flares: `hidden` where the share is
    0, `partial` in between, `visible` where it is 1, means over views and lights; `residual`, hidden / visible.

    `by_light`: the same by light, whose views differ in brightness less. None where the capture does not tell
    the shares, or no light is hidden in one of these views and seen in another.
    """
    if not (folder / SHARES).is_file():
        return None
    shares = read_json(folder / SHARES, CaptureError)
    found: dict[str, dict[str, list[float]]] = {}
    for view, camera in cameras.items():
        for light, layer in renderer.render(camera).flare_by_light.items():
            share = float(shares[view.name][light])
            kind = "hidden" if share <= 0 else "visible" if share >= 1 else "partial"
            found.setdefault(light, {}).setdefault(kind, []).append(float(np.mean(layer)))
    judged = {light: kinds for light, kinds in found.items() if "hidden" in kinds and "visible" in kinds}
    if not judged:
        return None
    by_light = {light: _residual(kinds) for light, kinds in judged.items()}
    return {"residual": float(np.mean([one["residual"] for one in by_light.values()])), "by_light": by_light}


def _residual(kinds: Mapping[str, list[float]]) -> dict[str, Any]:
    means = {kind: float(np.mean(energies)) for kind, energies in kinds.items()}
    counts = {f"{kind}_views": len(energies) for kind, energies in kinds.items()}
    return {**means, **counts, "residual": means["hidden"] / max(means["visible"], 1e-12)}
