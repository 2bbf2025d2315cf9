# SPDX-License-Identifier: GPL-3.0-or-later
"""A look as other tools take it: one frame's Gaussians as a 3DGS PLY, or a flat preset of elements as JSON."""
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..capture.camera import Camera, quaternion_from_rotation
from ..choices import Blend
from ..conventions.pixel_grid import DILATION, PixelGrid, dilation
from ..conventions.splatting import OPACITY_MAX
from ..gaussians.ply import write_ply
from ..gaussians.scene import COEFFICIENTS, SceneGaussians
from ..gaussians.spherical_harmonics import dc_from_colour
from ..look import Element, LightLook, Look, LookEdits, PlaneGaussians, ViewOfLight
from ..look.plane import PLANE_DEPTH, concatenate
from ..system.files import write_json

PRESET_VERSION = 1
_DEPTH_STEP = 1e-5  # relative depth step between consecutive Gaussians, so that a sort by depth preserves their order
_THICKNESS = 1e-4  # standard deviation along the axis, relative to the depth: invisible in views near the camera's


def flare_scene(
    flares: Mapping[str, PlaneGaussians], camera: Camera, pixel_grid: PixelGrid | None = None
) -> tuple[SceneGaussians, dict[str, NDArray[np.float32]]]:
    """Convert one frame's flare to 3D Gaussians in the world, just before the camera (paper, "Flare Representation").

    They are flat, face the camera at depth 0.21, and project to the look's plane Gaussians. Other programs add a
    low-pass filter when they draw; where that of the fit's `pixel_grid` is larger, as in a finer picture, the
    difference is added to the covariances. Also returns properties beyond 3DGS, (n,) each: ring_r0 and ring_w, 0 and 1
    for a plain Gaussian; with arcs also arc_0 and arc_1, in standard deviations along the first and second axis.
    """
    gaussians = concatenate(list(flares.values())) or _no_gaussians()
    count = len(gaussians)
    depth = PLANE_DEPTH * (1 + _DEPTH_STEP * np.arange(count))
    camera_points = np.concatenate([gaussians.means, np.ones((count, 1))], 1) * depth[:, None]
    to_world = camera.world_to_camera[:3, :3].T
    means = camera_points @ to_world.T + camera.position
    extra_variance = max(dilation(pixel_grid, camera.focal_length) - DILATION, 0.0)
    xx, xy, yy = gaussians.covariances.T.astype(np.float64)
    xx, yy = xx + extra_variance / camera.fx**2, yy + extra_variance / camera.fy**2
    variances, axes = np.linalg.eigh(np.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2))
    deviations = np.sqrt(np.maximum(variances, 1e-14)) * depth[:, None]
    scales = np.concatenate([deviations, _THICKNESS * depth[:, None]], 1)
    rotations = np.zeros((count, 3, 3))
    rotations[:, :2, :2] = axes
    rotations[:, 2, 2] = np.linalg.det(axes)  # a rotation, not a mirror image
    quaternions = np.array([quaternion_from_rotation(to_world @ rotation) for rotation in rotations]).reshape(count, 4)
    # An opacity above the maximum of 3DGS is multiplied into the colour.
    gain = np.maximum(gaussians.opacities / OPACITY_MAX, 1)
    opacities = np.clip(gaussians.opacities / gain, 1e-6, OPACITY_MAX)
    sh = torch.zeros(count, COEFFICIENTS, 3)
    sh[:, 0] = dc_from_colour(torch.from_numpy(np.asarray(gaussians.colours * gain[:, None], np.float32)))

    def to_tensor(values: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    scene = SceneGaussians(to_tensor(means), to_tensor(np.log(scales)), to_tensor(quaternions),
                           to_tensor(np.log(opacities / (1 - opacities))), sh)
    rings = np.tile(np.array([0.0, 1.0], np.float32), (count, 1)) if gaussians.rings is None else gaussians.rings
    extra_properties = {"ring_r0": rings[:, 0], "ring_w": rings[:, 1]}
    if gaussians.arcs is not None:
        scaled_arcs = np.einsum("nxa,nx->na", axes, gaussians.arcs) / np.sqrt(np.maximum(variances, 1e-14))
        extra_properties |= {"arc_0": scaled_arcs[:, 0], "arc_1": scaled_arcs[:, 1]}
    return scene, {name: np.asarray(values, np.float32) for name, values in extra_properties.items()}


def _no_gaussians() -> PlaneGaussians:
    """Return a flare of no Gaussians."""
    return PlaneGaussians(*(np.zeros(shape, np.float32) for shape in ((0, 2), (0, 3), (0,), (0, 3))))


def write_flare_ply(path: Path | str, flares: Mapping[str, PlaneGaussians], camera: Camera, blend: Blend,
                    pixel_grid: PixelGrid | None = None) -> None:
    """Write one frame's flare as a 3DGS PLY, with the further properties of `flare_scene`, explained in the header."""
    scene, extra = flare_scene(flares, camera, pixel_grid)
    arcs = "" if "arc_0" not in extra else ", times exp(arc_0 u + arc_1 v) and one at its peak, r^2 = u^2 + v^2"
    write_ply(path, scene, extra=extra, comments=(
        "Fit Flare: the flare of one frame, as its camera sees it",
        "light adds, colours are scene-linear" if blend == "add" else "light covers, colours are display values",
        f"profile exp(-(r - ring_r0)^2 / (2 ring_w^2)){arcs}, r the Mahalanobis distance",
        f"lights {' '.join(' '.join(name.split()) for name in flares)}"))  # a line of the header is one comment


def make_preset(look: Look, views: Mapping[str, ViewOfLight], edits: LookEdits | None = None,
                camera: Camera | None = None) -> dict[str, Any]:
    """Return the look as a preset of elements for procedural flare tools, for one view of each light.

    views: by the light's name. camera: the picture's, by default the training camera. A part of an element has:

    offset      along the axis: 0 at the light, 1 at the principal point, 2 at the mirror image (1 - mu)
    aside       across the axis, picture widths
    size        standard deviations along the long and short axis, picture widths
    rotation    of the long axis, degrees clockwise from the axis through the light
    colour      linear Rec. 709, brightest channel 1
    intensity   linear light at the peak
    shape       glow, disc, ring or streak; a ring also has `radius` and `thickness`, picture widths
    arc         of a ring with a brighter side: `towards` which, degrees as `rotation`, and `share`, the light of the
                opposite side relative to it
    """
    picture_camera, exposure = (look.camera, 1.0) if camera is None else (camera, camera.exposure)
    width = picture_camera.width / picture_camera.fx  # of the picture, on the normalised plane
    lights = []
    for light in look.lights:
        if light.name not in views or (edits is not None and not edits.is_visible(light.name, views)):
            continue
        gaussians = light.evaluate(views[light.name], edits=edits)
        if gaussians is None:
            continue
        gaussians = gaussians.with_exposure(exposure, look.blend)
        light_position = views[light.name].light.astype(np.float64)
        elements = [{"name": element.name, "kind": element.kind,
                     "parts": [_element_part(gaussians, row, light_position, width) for row in rows]}
                    for element, rows in _visible_elements(light, edits, len(gaussians))]
        lights.append({"name": light.name, "at": (light_position / width).tolist(), "elements": elements})
    return {"version": PRESET_VERSION, "made_by": "Fit Flare", "blend": look.blend, "unit": "picture width",
            "offset": "0 at the light, 1 at the principal point", "licence": look.licence, "notes": look.notes,
            "lights": lights}


def write_preset(path: Path | str, look: Look, views: Mapping[str, ViewOfLight], edits: LookEdits | None = None,
                 camera: Camera | None = None) -> None:
    """Write `make_preset` as JSON."""
    write_json(path, make_preset(look, views, edits, camera))


def _visible_elements(light: LightLook, edits: LookEdits | None, count: int) -> Iterator[tuple[Element, list[int]]]:
    """Yield the elements that edits do not hide, with their rows among the `count` visible Gaussians."""
    hidden = edits.hidden_elements(light.name, light.elements) if edits is not None else set()
    hidden_rows = [row for element in light.elements if element.name in hidden for row in element.members]
    remaining = np.setdiff1d(np.arange(count + len(hidden_rows)), hidden_rows)
    for element in light.elements:
        if element.name not in hidden:
            yield element, np.searchsorted(remaining, element.members).tolist()


def _element_part(gaussians: PlaneGaussians, row: int, light: NDArray[np.float64], width: float) -> dict[str, Any]:
    """Return one Gaussian as a part of a preset's element, as `make_preset` describes it.

    row: index of the Gaussian. light (2,): position of the light; width: that of the picture; both on the normalised
    plane."""
    distance = max(float(np.linalg.norm(light)), 1e-6)
    axis = light / distance
    mean = gaussians.means[row].astype(np.float64)
    xx, xy, yy = (float(value) for value in gaussians.covariances[row])
    variances, axes = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    minor, major = np.sqrt(np.maximum(variances, 0)) / width
    x, y = axes[:, 1]
    rotation = math.degrees(math.atan2(axis[0] * y - axis[1] * x, axis[0] * x + axis[1] * y))
    colour = np.maximum(gaussians.colours[row].astype(np.float64), 0) * float(gaussians.opacities[row])
    peak = float(colour.max())
    part: dict[str, Any] = {
        "offset": 1 - float(mean @ axis) / distance, "aside": float(axis[0] * mean[1] - axis[1] * mean[0]) / width,
        "size": [float(major), float(minor)], "rotation": (rotation + 90) % 180 - 90, "intensity": peak,
        "colour": (colour / peak).tolist() if peak > 0 else [1.0, 1.0, 1.0],
        "shape": "streak" if major > 4 * minor else "glow"}
    if gaussians.rings is not None:
        r0, w = (float(value) for value in gaussians.rings[row])
        # A ring whose line is thinner than a third of its radius has a dark middle; a thicker one looks like a disc.
        if r0 > w:
            part |= {"shape": "ring" if r0 > 3 * w else "disc", "radius": [r0 * float(major), r0 * float(minor)],
                     "thickness": [w * float(major), w * float(minor)]}
        elif r0 != 0 or w != 1:  # approximated by a plain profile of about the same width
            part["size"] = [(max(r0, 0) + w) * float(major), (max(r0, 0) + w) * float(minor)]
        if gaussians.arcs is not None and gaussians.arcs[row].any():
            x, y = (float(value) for value in gaussians.arcs[row])
            towards = math.degrees(math.atan2(axis[0] * y - axis[1] * x, axis[0] * x + axis[1] * y))
            part["arc"] = {"towards": towards, "share": math.exp(-2 * max(r0, 0) * float(gaussians.arc_strengths[row]))}
    return part
