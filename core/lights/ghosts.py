# SPDX-License-Identifier: GPL-3.0-or-later
"""The direction of a light that is never in frame, from its ghosts.

A ghost lies on the line through the principal point and the light's projection, and to first order at a
fixed share mu of the way (paraxial optics: Lee and Eisemann 2013): g - p = mu (l - p). So a blob at g claims
a light at p + (g - p) / mu, and where mu is right the claims of all views meet in one place. We try values of
mu and gather the claims as if they were detections.

Only ghosts on the far side of the principal point (mu < 0) are used: a blob that belongs to the scene and not
to the lens would then have to come from a light behind the camera, so that the scene cannot pose as a ghost.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera
from ..images.picture import Picture
from ..system.progress import Progress
from .detection import Detection
from .gather import FoundLight, GatherSettings, gather

SHARES = -np.exp(np.linspace(np.log(0.12), np.log(2.5), 28))
MIN_VIEWS, MIN_SHARE, ACCIDENTS = 6, 0.35, 1e-6  # see GatherSettings; blobs of one scene are no independent accidents
MOVES = 0.01  # of the diagonal; what keeps its place in the frame is dirt, not a ghost
BLOBS = 20  # a picture; the strongest


@dataclass(frozen=True, eq=False)
class Blob:
    """A bright spot at `xy` (2,) pixels, of `radius` pixels, `strength` over its surroundings in linear light."""

    xy: NDArray[np.float64]
    radius: float
    strength: float


def find_blobs(picture: Picture, clean: Picture | None = None) -> list[Blob]:
    """Spots of 0.7 to 6 % of the diagonal that stand out, strongest first; with the frame without flare, of their
    difference alone. By difference of Gaussians over scales, of the square root of linear light."""
    import cv2

    light = picture.linear().max(axis=2)
    if clean is not None:
        light = np.maximum(light - clean.linear().max(axis=2), 0.0)
    width, height = picture.size
    scale = min(1.0, 480 / max(width, height))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    small = np.sqrt(np.asarray(cv2.resize(np.minimum(light, 4.0), size, interpolation=cv2.INTER_AREA), np.float32))
    diagonal = float(np.hypot(*size))
    found: list[Blob] = []
    for radius in np.exp(np.linspace(np.log(0.007), np.log(0.06), 6)) * diagonal:
        sigma = radius / 1.6
        inner = cv2.GaussianBlur(small, (0, 0), sigma)
        stands_out = np.asarray(inner - cv2.GaussianBlur(small, (0, 0), 1.6 * sigma))
        window = 2 * max(1, round(radius)) + 1
        peak = (stands_out == cv2.dilate(stands_out, np.ones((window, window), np.uint8))) & (stands_out > 0.004)
        for y, x in np.argwhere(peak):
            at = np.array([(x + 0.5) / size[0] * width, (y + 0.5) / size[1] * height])
            found.append(Blob(at, float(radius / scale), float(stands_out[y, x])))
    kept: list[Blob] = []
    for blob in sorted(found, key=lambda blob: -blob.strength):
        if all(np.linalg.norm(blob.xy - other.xy) > 0.7 * other.radius for other in kept):
            kept.append(blob)
        if len(kept) == BLOBS:
            break
    return kept


def gather_ghosts(views: Sequence[tuple[str, Camera]], blobs: Sequence[Sequence[Blob]], extent: float,
                  seed: int = 0, progress: Progress | None = None) -> list[FoundLight]:
    """At most one light that is out of frame, from the blobs of each view; none where too few views agree.

    Raises Cancelled when asked to stop.
    """
    progress = progress or Progress()
    best: FoundLight | None = None
    best_share = 0.0
    for share in SHARES:
        progress.check()
        light = _with_share(views, blobs, extent, float(share), seed)
        if light is not None and (best is None or _rank(light, float(share)) > _rank(best, best_share)):
            best, best_share = light, float(share)
    if best is None:
        return []
    for step in (0.06, 0.03, 0.015):  # the share itself, finer
        for share in (best_share * (1 - step), best_share * (1 + step)):
            progress.check()
            light = _with_share(views, blobs, extent, share, seed)
            if light is not None and _rank(light, share) > _rank(best, best_share):
                best, best_share = light, share
    return [replace(best, residual=best.residual * abs(best_share), how=f"from a ghost at {best_share:.2f} of the way")]


def _rank(light: FoundLight, share: float) -> tuple[int, float]:
    """Support first, then how well the blobs meet their predicted places, in pixels of the ghost."""
    return len(light.support), -light.residual * abs(share)


def _with_share(views: Sequence[tuple[str, Camera]], blobs: Sequence[Sequence[Blob]], extent: float, share: float,
                seed: int) -> FoundLight | None:
    """The light out of frame that most views' blobs claim, if they are ghosts at `share` of the way."""
    claims = []
    for (_, camera), some in zip(views, blobs, strict=True):
        centre = np.array([camera.cx, camera.cy])
        # The radius carries the tolerance: an error at the ghost is 1 / share times as large at the light.
        diagonal = float(np.hypot(*camera.size))
        claims.append([Detection(centre + (blob.xy - centre) / share, 0.02 * diagonal / abs(share), 1.0,
                                 np.ones(3), np.ones((1, 1), bool), (0, 0), False) for blob in some
                       if not camera.contains([centre + (blob.xy - centre) / share])[0]])
    settings = GatherSettings(tolerance=0.0, min_views=MIN_VIEWS, accidents=ACCIDENTS / len(SHARES),
                              min_share=MIN_SHARE, anywhere=True, most=2, tries=1000, seed=seed)
    diagonal = float(np.hypot(*views[0][1].size))
    for light in gather(views, claims, extent, settings):
        moved = np.ptp([one.xy * share for _, one in light.detections], axis=0).max()
        if sum(_well_inside(camera, light.xyz) for _, camera in views) < 0.2 * len(views) and moved > MOVES * diagonal:
            return light
    return None


def _well_inside(camera: Camera, xyz: NDArray[np.float64]) -> bool:
    """Whether a light is so far inside the frame that it would be seen itself."""
    pixels, depth = camera.project(xyz[None])
    margin = 0.05 * float(np.hypot(*camera.size))
    return bool(depth[0] > 0 and (pixels[0] > margin).all() and (pixels[0] < np.array(camera.size) - margin).all())
