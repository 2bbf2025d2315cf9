# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds a light from its ghosts if no frame shows where it is: out of frame, or a sun in a clipped sky.

A ghost lies on the line through the principal point p and the light's projection l, and to first order at a fixed ratio
mu of the way (paraxial optics: Lee and Eisemann 2013): g - p = mu (l - p). So a blob at g claims a light at p + (g - p)
/ mu, and where mu is right the claims of all views meet in one place. Values of mu are tried, and the claims
triangulated like detections.

Only ghosts on the far side of the principal point (mu < 0) are used: when the camera turns, they move in the opposite
direction to the scene. If the camera hardly moves, blobs of the scene may also agree on a light. Therefore the blobs
of each candidate are also triangulated as points of the scene. If one point explains most of them, they are no ghosts.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera, Floats
from ..images.picture import Picture
from ..system.progress import Progress
from .detection import Detection, Mask
from .found_light import FoundLight
from .surroundings import map_index
from .triangulation import TriangulationSettings, triangulate_lights

GHOST_RATIOS = -np.exp(np.linspace(np.log(0.12), np.log(2.5), 28))
"""Values of mu that the search tests."""
MIN_VIEWS, MIN_SHARE, MAX_NFA = 6, 0.35, 1e-6
"""Bounds of `TriangulationSettings`; blobs of one scene are not independent, so the NFA must be low."""
MIN_MOTION = 0.01
"""Motion of a ghost, in diagonals; what keeps its place in the frame is dirt."""
MAX_BLOBS = 20
"""Blobs of a picture, the strongest."""
WORKING_SIZE = 480
"""Largest side of the picture in which blobs are found, pixels."""
BLOB_RADII = np.exp(np.linspace(np.log(0.007), np.log(0.06), 6))
"""Radii of blobs that are tested, relative to the diagonal."""
SIGMA_RATIO = 1.6
"""Ratio of the two Gaussians: at 1.6 their difference is close to a Laplacian of Gaussian (Marr and Hildreth 1980)."""
MAX_LIGHT = 4.0
"""Linear light at which pixels are clipped: one far above white would outshine the blobs near it."""
MIN_SEPARATION = 0.7
"""Smallest distance of a blob from a stronger one, in radii of that one."""
MIN_STRENGTH = 0.004
"""Strength of a blob, see `Blob`, up to which it is noise."""
MAX_VISIBLE_SHARE = 0.2
"""Share of the views with a light well inside the frame from which it is not out of frame."""
MIN_SHARE_IN_AREA = 0.12
"""Lowest share of the views that must agree on a light in a clipped area: in the others its ghost may be hidden by the
clipped area, or lie out of the frame."""
MIN_VIEWS_IN_AREA = 4
"""Fewest views that agree on a light and have it inside their clipped area; in the others that agree, it may be out of
frame."""
MIN_CENTRE_DISTANCE = 0.06
"""Smallest distance of a light in a clipped area from the principal point, diagonals. At smaller distances all ghosts
lie on the light."""
MAX_SCENE_SHARE = 0.5
"""Share of the blobs of a light that one point of the scene may explain."""
BLOB_TOLERANCE = 0.01
"""Tolerance of a blob's place, diagonals."""


@dataclass(frozen=True, eq=False)
class Blob:
    """A bright spot at `xy` (2,) pixels, of `radius` pixels.

    strength: how much it exceeds its surroundings, in square roots of linear light.
    """

    xy: NDArray[np.float64]
    radius: float
    strength: float


def find_blobs(picture: Picture, clean: Picture | None = None) -> list[Blob]:
    """Find bright spots, strongest first, by difference of Gaussians over scales.

    Spots have radii near BLOB_RADII and a strength above MIN_STRENGTH; at most MAX_BLOBS are returned. The search is in
    the square root of linear light; with `clean`, the clean frame, only in the light that the frame has beyond it.
    """
    import cv2

    light = picture.linear().max(axis=2)
    if clean is not None:
        light = np.maximum(light - clean.linear().max(axis=2), 0.0)
    width, height = picture.size
    scale = min(1.0, WORKING_SIZE / max(width, height))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    reduced = cv2.resize(np.minimum(light, MAX_LIGHT), size, interpolation=cv2.INTER_AREA)
    small = np.sqrt(np.asarray(reduced, np.float32))
    diagonal = float(np.hypot(*size))
    candidates: list[Blob] = []
    for radius in BLOB_RADII * diagonal:
        sigma = radius / SIGMA_RATIO
        inner = cv2.GaussianBlur(small, (0, 0), sigma)
        difference = np.asarray(inner - cv2.GaussianBlur(small, (0, 0), SIGMA_RATIO * sigma))
        window = 2 * max(1, round(radius)) + 1
        is_largest = difference == cv2.dilate(difference, np.ones((window, window), np.uint8))
        is_peak = is_largest & (difference > MIN_STRENGTH)
        for y, x in np.argwhere(is_peak):
            xy = np.array([(x + 0.5) / size[0] * width, (y + 0.5) / size[1] * height])
            candidates.append(Blob(xy, float(radius / scale), float(difference[y, x])))
    strongest: list[Blob] = []
    for blob in sorted(candidates, key=lambda blob: -blob.strength):
        if all(np.linalg.norm(blob.xy - other.xy) > MIN_SEPARATION * other.radius for other in strongest):
            strongest.append(blob)
        if len(strongest) == MAX_BLOBS:
            break
    return strongest


def locate_by_ghosts(views: Sequence[tuple[str, Camera]], blobs: Sequence[Sequence[Blob]], extent: float,
                     seed: int = 0, progress: Progress | None = None,
                     clipped_areas: Sequence[Mask] | None = None) -> list[FoundLight]:
    """Return at most one light, from the blobs of each view; none where too few views agree.

    The ratio of ghost to light is searched over GHOST_RATIOS, then refined. extent: size of the cameras' path, world
    units. clipped_areas: for each view a mask (height, width) of any size, true where the light may lie in the frame;
    None for a light that hardly any frame has inside. Raises Cancelled on a stop request.
    """
    progress = progress or Progress()
    search = _Search(views, blobs, extent, seed, clipped_areas)
    best: FoundLight | None = None
    best_ratio = 0.0
    for ratio in GHOST_RATIOS:
        progress.check()
        light = search.light_at_ratio(float(ratio))
        if light is not None and (best is None or _rank(light, float(ratio)) > _rank(best, best_ratio)):
            best, best_ratio = light, float(ratio)
    if best is None:
        return []
    for step in (0.06, 0.03, 0.015):  # refine the ratio in steps of 6, 3 and 1.5 %
        for ratio in (best_ratio * (1 - step), best_ratio * (1 + step)):
            progress.check()
            light = search.light_at_ratio(ratio)
            if light is not None and _rank(light, ratio) > _rank(best, best_ratio):
                best, best_ratio = light, ratio
    # The residual is given in pixels at the ghost; at the light it is 1 / |ratio| times as large.
    return [replace(best, residual=best.residual * abs(best_ratio), how=f"from a ghost at {best_ratio:.2f} of the way")]


def _rank(light: FoundLight, ratio: float) -> tuple[int, float]:
    """Return the sort key of a light at a ratio: its support, then the negative residual of the blobs, in pixels at the
    ghost."""
    return len(light.support), -light.residual * abs(ratio)


@dataclass(frozen=True, eq=False)
class _Search:
    """The blobs of all views, and where a light may lie; see `locate_by_ghosts`."""

    views: Sequence[tuple[str, Camera]]
    blobs: Sequence[Sequence[Blob]]
    extent: float
    seed: int
    clipped_areas: Sequence[Mask] | None

    def light_at_ratio(self, ratio: float) -> FoundLight | None:
        """Return the best supported light that the blobs claim if they are ghosts at this ratio; None where too few
        views agree.

        Each blob claims a light at centre + (blob - centre) / ratio in its view; the claims are triangulated.
        """
        claims = []
        for index, ((_, camera), in_view) in enumerate(zip(self.views, self.blobs, strict=True)):
            centre = np.array([camera.cx, camera.cy])
            # Triangulation tolerates half a detection's radius: 1 % of the diagonal at the ghost, 1 / |ratio| times as
            # much at the light.
            radius = 2 * BLOB_TOLERANCE * float(np.hypot(*camera.size)) / abs(ratio)
            places = [centre + (blob.xy - centre) / ratio for blob in in_view]
            claims.append([_claim(place, radius) for place in places if self._may_lie_at(place, index)])
        min_share = MIN_SHARE if self.clipped_areas is None else MIN_SHARE_IN_AREA
        settings = TriangulationSettings(tolerance=0.0, min_views=MIN_VIEWS, max_nfa=MAX_NFA / len(GHOST_RATIOS),
                                         min_share=min_share, allow_out_of_frame=True, max_lights=2,
                                         max_candidates=1000, seed=self.seed)
        return next((light for light in triangulate_lights(self.views, claims, self.extent, settings)
                     if self._is_light_of_ghosts(light, ratio)), None)

    def _may_lie_at(self, place: Floats, view: int) -> bool:
        """Return whether a light may lie at a place (2,), pixels, of the view of this index."""
        camera = self.views[view][1]
        if not camera.contains([place])[0]:
            return True
        return self.clipped_areas is not None and self._is_clipped(place, view)

    def _is_clipped(self, place: Floats, view: int) -> bool:
        """Return whether a place (2,), pixels, in the frame of a view lies in its clipped area, and not at the
        centre."""
        assert self.clipped_areas is not None
        camera = self.views[view][1]
        if np.linalg.norm(place - (camera.cx, camera.cy)) < MIN_CENTRE_DISTANCE * np.hypot(*camera.size):
            return False
        area = self.clipped_areas[view]
        return bool(area[map_index(area, place, camera)])

    def _is_light_of_ghosts(self, light: FoundLight, ratio: float) -> bool:
        """Return whether the blobs that claim a light at a ratio are neither dirt on the lens nor objects of the scene,
        and the light is out of frame where it has to be."""
        cameras, places = dict(self.views), {name: detection.xy for name, detection in light.detections}
        centres = {name: np.array([cameras[name].cx, cameras[name].cy]) for name in places}
        ghosts = {name: centres[name] + (place - centres[name]) * ratio for name, place in places.items()}
        first_diagonal = float(np.hypot(*self.views[0][1].size))
        if np.ptp(list(ghosts.values()), axis=0).max() <= MIN_MOTION * first_diagonal:  # dirt stays in place
            return False
        if self.clipped_areas is None:
            visible = sum(_is_well_inside(camera, light.xyz) for _, camera in self.views)
            if visible >= MAX_VISIBLE_SHARE * len(self.views):
                return False
        else:
            # A place in the frame lies in the clipped area (`_may_lie_at`).
            in_area = sum(cameras[name].contains([place])[0] for name, place in places.items())
            if in_area < MIN_VIEWS_IN_AREA:
                return False
        return self._scene_support(ghosts) < MAX_SCENE_SHARE * len(ghosts)

    def _scene_support(self, pixels: Mapping[str, Floats]) -> int:
        """Return how many of the places one point of the scene explains, for the point that explains most.

        pixels: a place (2,) in each view, by the view's name.
        """
        views = [(name, camera) for name, camera in self.views if name in pixels]
        detections = [[_claim(pixels[name], 2 * BLOB_TOLERANCE * float(np.hypot(*camera.size)))]
                      for name, camera in views]
        settings = TriangulationSettings(tolerance=0.0, min_views=2, max_nfa=np.inf, min_share=0.0,
                                         allow_out_of_frame=True, max_lights=1, seed=self.seed)
        points = triangulate_lights(views, detections, self.extent, settings)
        return max((len(point.support) for point in points), default=0)


def _claim(place: NDArray[np.float64], radius: float) -> Detection:
    """Return a claimed place (2,) of a light as a detection, of which triangulation uses place and radius (pixels)
    alone."""
    return Detection(place, radius, score=1.0, colour=np.ones(3), mask=np.ones((1, 1), bool), corner=(0, 0),
                     is_cut=False)


def _is_well_inside(camera: Camera, xyz: NDArray[np.float64]) -> bool:
    """Return whether a light is more than 5 % of the diagonal inside the frame, where it would itself be visible."""
    pixels, depth = camera.project(xyz[None])
    margin = 0.05 * float(np.hypot(*camera.size))
    return bool(depth[0] > 0 and (pixels[0] > margin).all() and (pixels[0] < np.array(camera.size) - margin).all())
