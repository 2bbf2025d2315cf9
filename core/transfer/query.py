# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the views at which a flare's network is evaluated for a target; called by `transfer` (docs/transfer.md).

Placement always follows the target. Appearance follows

source  one training view for the whole shot: the most similar one to the target's views
target  the target's view, even outside the range of the training views
blend   the target's view, kept inside that range; the default

The network learned camera positions in the source's world. If the target's light is where the source's is, both worlds
are the same and positions are valid. Else `target` adopts the camera's offset from the light, and `blend` averages the
flares of the training views that have the light at a similar position in the frame and at a similar distance; their
weights change smoothly along a path.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Follows
from ..conventions.smoothstep import smoothstep
from ..errors import FlareFileError
from ..look import LightLook, LookEdits, PlaneGaussians, ViewOfLight
from ..look.look import read_description

NEIGHBOURS = 4
"""Number of training views that `blend` averages."""
POSITION_SCALE = 0.1
"""Difference of positions on the normalised plane that counts as a dissimilarity of 1."""
LOG_DISTANCE_SCALE = 0.2
"""Difference of the logarithms of distances that counts as a dissimilarity of 1."""
SAME_WORLD_TOLERANCE = 0.02
"""Distance of two lights, relative to the camera's, below which they are one: the accuracy of light detection."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrainingViews:
    """Training views of one light: cameras (v, 3), world units; lights (v, 2), normalised; distances (v,)."""

    cameras: Floats
    lights: Floats
    distances: Floats

    @classmethod
    def of(cls, rows: ArrayLike, xyz: ArrayLike) -> TrainingViews:
        """Read rows (v, 5) of camera x, y, z and light x, y; xyz (3,): the light's position."""
        table = np.asarray(rows, np.float64).reshape(-1, 5)
        return cls(table[:, :3], table[:, 3:], np.linalg.norm(table[:, :3] - np.asarray(xyz), axis=1))

    def dissimilarity(self, light: ArrayLike, distance: float) -> Floats:
        """Return (v,) dissimilarities to a view of a light (2,) at a distance; the frame's quadrants are equivalent."""
        in_position = np.linalg.norm(np.abs(self.lights) - np.abs(light), axis=1) / POSITION_SCALE
        in_distance = np.log(self.distances / max(distance, 1e-9)) / LOG_DISTANCE_SCALE
        return np.asarray(np.hypot(in_position, in_distance))


def training_views(path: Path | str, lights: Sequence[LightLook],
                   poses: Sequence[ArrayLike] | None = None) -> dict[str, TrainingViews]:
    """Return the training views of each light: as the .flare lists them, else computed from training poses (4, 4).

    Omits lights for which there is neither. Raises FlareFileError for an invalid file."""
    stored = read_description(path).get("seen", {})
    by_light: dict[str, TrainingViews] = {}
    for light in lights:
        rows: Any = stored.get(light.name) if isinstance(stored, Mapping) else None
        if not rows and poses is not None:
            views = [ViewOfLight.of(pose, light.xyz) for pose in poses]
            rows = [[*view.camera, *view.light] for view in views if view.depth > 0]
        if rows:
            try:
                by_light[light.name] = TrainingViews.of(rows, light.xyz)
            except (TypeError, ValueError) as problem:
                raise FlareFileError(f"{path} is damaged: its training views are not valid ({problem}).") from problem
    return by_light


def evaluate(light: LightLook, view: ViewOfLight, xyz: ArrayLike, query: Follows, training: TrainingViews | None, *,
             visibility: float = 1.0, edits: LookEdits | None = None, name: str | None = None, scale: float = 1.0,
             fixed: ViewOfLight | None = None) -> PlaneGaussians | None:
    """Return the plane Gaussians of `light` in `view`; xyz (3,): position of the target's light in its own world.

    training: views of the source; without them, `blend` clips to the range of the training views. scale: units of the
    target's world for one of the source's. fixed: view for the query `source`. The flare fades out for a light far
    outside the range of the training views.
    """
    if view.depth <= 0 or visibility <= 0:
        return None
    visibility *= extrapolation_fade(light, view)
    if visibility <= 0:
        return None
    weighted = _weighted_queries(light, view, np.asarray(xyz, np.float64), query, training, scale, fixed)
    parts = [light.evaluate(view, query=query_view, edits=edits, visibility=visibility, name=name)
             for _, query_view in weighted]
    return _average([part for part in parts if part is not None], [weight for weight, _ in weighted])


def fixed_view(light: LightLook, views: Sequence[ViewOfLight], distances: Sequence[float],
               training: TrainingViews | None) -> ViewOfLight | None:
    """Return the training view for the query `source`, for a shot with these views of the light.

    It is the most similar one to the shot's median view; None if the light is never in front of the camera. distances:
    of the camera from the light, units of the source's world.
    """
    in_front = [(view, distance) for view, distance in zip(views, distances, strict=True) if view.depth > 0]
    if not in_front:
        return None
    position = np.median([view.light for view, _ in in_front], axis=0)
    if training is None:
        camera = (light.query_range.camera_low + light.query_range.camera_high) / 2
        return replace(in_front[0][0], camera=camera, light=light.query_range.clip(camera, position)[1])
    best = int(training.dissimilarity(position, float(np.median([distance for _, distance in in_front]))).argmin())
    return replace(in_front[0][0], camera=training.cameras[best].astype(np.float32),
                   light=training.lights[best].astype(np.float32))


def extrapolation_fade(light: LightLook, view: ViewOfLight) -> float:
    """Return 1 for a light no further from the principal point than in training, falling to 0 at twice that distance.

    The network has learned nothing farther out, and a light that goes behind the camera passes through there."""
    trained_distance = float(light.query_range.light_high[2])
    return float(smoothstep(float(np.linalg.norm(view.light)) / max(trained_distance, 1e-6), 2, 1))


def _weighted_queries(light: LightLook, view: ViewOfLight, xyz: Floats, query: Follows, training: TrainingViews | None,
                      scale: float, fixed: ViewOfLight | None) -> list[tuple[float, ViewOfLight]]:
    """Return (weight, view) of each view at which the network is evaluated; the weights sum to 1.

    For "blend" these are the NEIGHBOURS most similar training views, or the target's view where both worlds are the
    same or the training views are unknown. xyz (3,): the target's light. scale: units of its world for one of the
    source's. fixed: view for "source".
    """
    offset = (view.camera - xyz) / scale
    distance = float(np.linalg.norm(offset))
    is_same_world = scale == 1 and np.linalg.norm(xyz - light.xyz) <= SAME_WORLD_TOLERANCE * distance
    camera = view.camera if is_same_world else (light.xyz + offset).astype(np.float32)
    if query == "target":
        return [(1.0, replace(view, camera=camera))]
    if query == "source" and fixed is not None:
        return [(1.0, fixed)]
    clipped_camera, clipped_light = light.query_range.clip(camera, view.light)
    if training is None or is_same_world:
        return [(1.0, replace(view, camera=clipped_camera, light=clipped_light))]
    dissimilarity = training.dissimilarity(clipped_light, distance)
    nearest = np.argsort(dissimilarity)[:NEIGHBOURS + 1]
    # The most dissimilar one has no weight, so that weights change continuously when the neighbours change.
    cutoff = dissimilarity[nearest[-1]] if len(nearest) > NEIGHBOURS else 2 * dissimilarity[nearest[-1]] + 1e-6
    # The small term gives a single view, or several equal ones, a weight.
    weights = np.maximum(1 - (dissimilarity[nearest] / max(cutoff, 1e-9)) ** 2, 0) ** 2 + 1e-12
    weights /= weights.sum()
    return [(float(weight), replace(view, camera=training.cameras[row].astype(np.float32), light=clipped_light))
            for weight, row in zip(weights, nearest, strict=True) if weight > 1e-6]


def _average(parts: Sequence[PlaneGaussians], weights: Sequence[float]) -> PlaneGaussians | None:
    """Return the weighted average of the same Gaussians, evaluated for several queries."""
    if len(parts) < 2:
        return parts[0] if parts else None

    def mean(name: str) -> Any:
        return np.asarray(sum(weight * getattr(part, name) for part, weight in zip(parts, weights, strict=True)),
                          np.float32)

    rings, arcs = (None if getattr(parts[0], name) is None else mean(name) for name in ("rings", "arcs"))
    return PlaneGaussians(mean("means"), mean("covariances"), mean("opacities"), mean("colours"), rings, arcs)
