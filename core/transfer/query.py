# SPDX-License-Identifier: GPL-3.0-or-later
"""What the flare's network is asked for when the flare stands elsewhere (docs/transfer.md).

Placement always follows the target. Appearance follows

source  one training view, for the whole shot: the one whose light stands most like the target's
target  the target's view as it is, outside what was trained too
blend   the target's view, kept inside what was trained; the default

A camera's position in another world means nothing to the network, which learned it in the source's. Where the
target's light stands where the source's does, the worlds are one and positions hold. Elsewhere, `target` takes
the camera's offset from the light over, and `blend` mixes what the training views show that have the light at a
like place in the frame and at a like distance; the mix changes smoothly along a path.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Follows
from ..errors import FlareFileError
from ..look import LightLook, LookEdits, PlaneGaussians, ViewOfLight
from ..look.look import describe

NEIGHBOURS = 4
PLACE = 0.1  # of the normalised plane: lights this far apart are as unlike
DISTANCE = 0.2  # as distances whose logarithms differ by this
SAME_WORLD = 0.02  # of the distance, within which two lights are one: as well as lights are found

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Seen:
    """Training views of one light: cameras (v, 3), world units; lights (v, 2), normalised; distances (v,)."""

    cameras: Floats
    lights: Floats
    distances: Floats

    @classmethod
    def of(cls, rows: ArrayLike, xyz: ArrayLike) -> Seen:
        """From rows (v, 5) of camera x, y, z and light x, y, and the light's position (3,)."""
        table = np.asarray(rows, np.float64).reshape(-1, 5)
        return cls(table[:, :3], table[:, 3:], np.linalg.norm(table[:, :3] - np.asarray(xyz), axis=1))

    def unlikeness(self, light: ArrayLike, distance: float) -> Floats:
        """(v,) how unlike a view each is, of a light (2,) at a distance; the frame's quadrants count as one."""
        place = np.linalg.norm(np.abs(self.lights) - np.abs(light), axis=1) / PLACE
        far = np.log(self.distances / max(distance, 1e-9)) / DISTANCE
        return np.asarray(np.hypot(place, far))


def seen_by(path: Path | str, lights: Sequence[LightLook],
            poses: Sequence[ArrayLike] | None = None) -> dict[str, Seen]:
    """What each light's network was trained on: as the .flare says, or from the training poses (4, 4) where it
    does not; lights of which neither tells are left out. Raises FlareFileError where the file makes no sense."""
    listed = describe(path).get("seen", {})
    found: dict[str, Seen] = {}
    for light in lights:
        rows: Any = listed.get(light.name) if isinstance(listed, Mapping) else None
        if not rows and poses is not None:
            views = [ViewOfLight.of(pose, light.xyz) for pose in poses]
            rows = [[*view.camera, *view.light] for view in views if view.depth > 0]
        if rows:
            try:
                found[light.name] = Seen.of(rows, light.xyz)
            except (TypeError, ValueError) as problem:
                raise FlareFileError(f"{path} is damaged: its training views make no sense ({problem}).") from problem
    return found


def evaluate(light: LightLook, view: ViewOfLight, xyz: ArrayLike, query: Follows, seen: Seen | None, *,
             share: float = 1.0, edits: LookEdits | None = None, name: str | None = None, scale: float = 1.0,
             fixed: ViewOfLight | None = None) -> PlaneGaussians | None:
    """The Gaussians of `light` placed in `view`, where the target's light stands at `xyz` (3,) in its own world.

    seen: of the source; without it, `blend` keeps to the trained box. scale: units of the target's world to one of
    the source's. fixed: what `source` asks for. The flare fades where the light leaves what was trained far behind.
    """
    if view.depth <= 0 or share <= 0:
        return None
    share *= fade(light, view)
    if share <= 0:
        return None
    asked = _asked(light, view, np.asarray(xyz, np.float64), query, seen, scale, fixed)
    parts = [light.evaluate(view, query=one, edits=edits, share=share, name=name) for _, one in asked]
    return _mixed([part for part in parts if part is not None], [weight for weight, _ in asked])


def fixed_view(light: LightLook, views: Sequence[ViewOfLight], distances: Sequence[float],
               seen: Seen | None) -> ViewOfLight | None:
    """The training view that is asked for throughout a shot with these views of the light (`source`).

    The one most like the shot's middle; None where the light is never in front.
    """
    front = [(view, far) for view, far in zip(views, distances, strict=True) if view.depth > 0]
    if not front:
        return None
    place = np.median([view.light for view, _ in front], axis=0)
    if seen is None:
        camera = (light.query_range.camera_low + light.query_range.camera_high) / 2
        return replace(front[0][0], camera=camera, light=light.query_range.clipped(camera, place)[1])
    best = int(seen.unlikeness(place, float(np.median([far for _, far in front]))).argmin())
    return replace(front[0][0], camera=seen.cameras[best].astype(np.float32),
                   light=seen.lights[best].astype(np.float32))


def fade(light: LightLook, view: ViewOfLight) -> float:
    """1 while the light is no further out than in training, 0 from twice as far: nothing is known there, and a
    light that goes behind the camera passes through it."""
    reach = float(light.query_range.light_high[2])
    t = min(max(2 - float(np.linalg.norm(view.light)) / max(reach, 1e-6), 0.0), 1.0)
    return t * t * (3 - 2 * t)


def _asked(light: LightLook, view: ViewOfLight, xyz: Floats, query: Follows, seen: Seen | None, scale: float,
           fixed: ViewOfLight | None) -> list[tuple[float, ViewOfLight]]:
    """Views to ask the network for, with weights that sum to 1."""
    away = (view.camera - xyz) / scale
    distance = float(np.linalg.norm(away))
    one_world = scale == 1 and np.linalg.norm(xyz - light.xyz) <= SAME_WORLD * distance
    camera = view.camera if one_world else (light.xyz + away).astype(np.float32)
    if query == "target":
        return [(1.0, replace(view, camera=camera))]
    if query == "source" and fixed is not None:
        return [(1.0, fixed)]
    inside, place = light.query_range.clipped(camera, view.light)
    if seen is None or one_world:
        return [(1.0, replace(view, camera=inside, light=place))]
    unlike = seen.unlikeness(place, distance)
    order = np.argsort(unlike)[:NEIGHBOURS + 1]
    # The farthest of them has no weight, so that none enters or leaves with a jump.
    edge = unlike[order[-1]] if len(order) > NEIGHBOURS else 2 * unlike[order[-1]] + 1e-6
    weights = np.maximum(1 - (unlike[order] / max(edge, 1e-9)) ** 2, 0) ** 2 + 1e-12
    weights /= weights.sum()
    return [(float(weight), replace(view, camera=seen.cameras[row].astype(np.float32), light=place))
            for weight, row in zip(weights, order, strict=True) if weight > 1e-6]


def _mixed(parts: Sequence[PlaneGaussians], weights: Sequence[float]) -> PlaneGaussians | None:
    """The same Gaussians under several queries, averaged."""
    if len(parts) < 2:
        return parts[0] if parts else None

    def mean(name: str) -> Any:
        return np.asarray(sum(weight * getattr(part, name) for part, weight in zip(parts, weights, strict=True)),
                          np.float32)

    rings, arcs = (None if getattr(parts[0], name) is None else mean(name) for name in ("rings", "arcs"))
    return PlaneGaussians(mean("means"), mean("covariances"), mean("opacities"), mean("colours"), rings, arcs)
