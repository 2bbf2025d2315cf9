# SPDX-License-Identifier: GPL-3.0-or-later
"""Residual flare of a light in the views where geometry hides it, relative to those where it is visible."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from core.capture import Camera, View
from core.capture.renderer import ViewRenderer
from core.errors import CaptureError
from core.system.files import read_json

SHARES = "truth/visible_share.json"
"""File of a sample capture: visibility by frame and light, the share of its disc that no geometry hides, 0..1."""


def hidden_flare(renderer: ViewRenderer, folder: Path, cameras: Mapping[View, Camera]) -> dict[str, Any] | None:
    """Return how much flare remains of hidden lights: `residual`, the mean over lights, and `by_light`, their figures.

    A light's figures are mean energies (of its linear flare layer, over pixels and channels) in views where it is
    `hidden` (visibility 0), `visible` (1) and `partial` (between), the numbers of these views, and `residual`:
    hidden / visible. Lights without hidden or without visible views are left out. None if no light is left, or the
    capture has no visibilities.
    """
    if not (folder / SHARES).is_file():
        return None
    shares = read_json(folder / SHARES, CaptureError)
    energies: dict[str, dict[str, list[float]]] = {}
    for view, camera in cameras.items():
        for light, layer in renderer.render(camera).flare_by_light.items():
            share = float(shares[view.name][light])
            kind = "hidden" if share <= 0 else "visible" if share >= 1 else "partial"
            energies.setdefault(light, {}).setdefault(kind, []).append(float(np.mean(layer)))
    usable = {light: kinds for light, kinds in energies.items() if "hidden" in kinds and "visible" in kinds}
    if not usable:
        return None
    by_light = {light: _residual(kinds) for light, kinds in usable.items()}
    return {"residual": float(np.mean([entry["residual"] for entry in by_light.values()])), "by_light": by_light}


def _residual(kinds: Mapping[str, list[float]]) -> dict[str, Any]:
    """Return mean energy and number of views by kind, and the residual. kinds: energies by view, of one light."""
    means = {kind: float(np.mean(energies)) for kind, energies in kinds.items()}
    counts = {f"{kind}_views": len(energies) for kind, energies in kinds.items()}
    return {**means, **counts, "residual": means["hidden"] / max(means["visible"], 1e-12)}
