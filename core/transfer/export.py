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
from ..conventions.pixel_grid import DILATION, Sampling, dilation
from ..conventions.splatting import OPACITY_MAX
from ..gaussians.ply import write_ply
from ..gaussians.scene import COEFFICIENTS, SceneGaussians
from ..gaussians.spherical_harmonics import dc_from_colour
from ..look import Element, LightLook, Look, LookEdits, PlaneGaussians, ViewOfLight
from ..look.plane import PLANE_DEPTH, joined
from ..system.files import write_json

PRESET_VERSION = 1
_APART = 1e-5  # share of the depth between one Gaussian and the next, so that a sort by depth keeps their order
_FLAT = 1e-4  # thickness along the axis, share of the depth: next to nothing in any view near the camera's


def flare_scene(
    flares: Mapping[str, PlaneGaussians], camera: Camera, sampling: Sampling | None = None
) -> tuple[SceneGaussians, dict[str, NDArray[np.float32]]]:
    """One frame's flare as 3D Gaussians of the world, just before the camera (paper, "Flare Representation").

    They are flat, face the camera at depth 0.21, and project to what the look shows, with the low-pass that other
    programs add: that of the grid they were learned on (`sampling`) is larger in a finer picture, and the rest of it
    lies in them. Returned beside them, which 3DGS itself has no word for, (n,) each: ring_r0 and ring_w, 0 and 1 for a
    plain Gaussian; and of a flare with arcs arc_0 and arc_1, in deviations along the first and second axis.
    """
    whole = joined(list(flares.values())) or _nothing()
    n = len(whole)
    depth = PLANE_DEPTH * (1 + _APART * np.arange(n))
    local = np.concatenate([whole.means, np.ones((n, 1))], 1) * depth[:, None]
    to_world = camera.world_to_camera[:3, :3].T
    means = local @ to_world.T + camera.position
    rest = max(dilation(sampling, camera.focal_length) - DILATION, 0.0)
    xx, xy, yy = whole.covariances.T.astype(np.float64)
    xx, yy = xx + rest / camera.fx**2, yy + rest / camera.fy**2
    variances, axes = np.linalg.eigh(np.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2))
    deviations = np.sqrt(np.maximum(variances, 1e-14)) * depth[:, None]
    scales = np.concatenate([deviations, _FLAT * depth[:, None]], 1)
    turned = np.zeros((n, 3, 3))
    turned[:, :2, :2] = axes
    turned[:, 2, 2] = np.linalg.det(axes)  # a rotation, not a mirror image
    quaternions = np.array([quaternion_from_rotation(to_world @ one) for one in turned]).reshape(n, 4)
    # More opaque than 3DGS allows: the rest of the light goes into the colour.
    gain = np.maximum(whole.opacities / OPACITY_MAX, 1)
    opacities = np.clip(whole.opacities / gain, 1e-6, OPACITY_MAX)
    sh = torch.zeros(n, COEFFICIENTS, 3)
    sh[:, 0] = dc_from_colour(torch.from_numpy(np.asarray(whole.colours * gain[:, None], np.float32)))

    def tensor(values: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    scene = SceneGaussians(tensor(means), tensor(np.log(scales)), tensor(quaternions),
                           tensor(np.log(opacities / (1 - opacities))), sh)
    rings = np.tile(np.array([0.0, 1.0], np.float32), (n, 1)) if whole.rings is None else whole.rings
    more = {"ring_r0": rings[:, 0], "ring_w": rings[:, 1]}
    if whole.arcs is not None:
        own = np.einsum("nxa,nx->na", axes, whole.arcs) / np.sqrt(np.maximum(variances, 1e-14))
        more |= {"arc_0": own[:, 0], "arc_1": own[:, 1]}
    return scene, {name: np.asarray(values, np.float32) for name, values in more.items()}


def _nothing() -> PlaneGaussians:
    return PlaneGaussians(*(np.zeros(shape, np.float32) for shape in ((0, 2), (0, 3), (0,), (0, 3))))


def write_flare_ply(path: Path | str, flares: Mapping[str, PlaneGaussians], camera: Camera, blend: Blend,
                    sampling: Sampling | None = None) -> None:
    """One frame's flare as a 3DGS PLY; what `flare_scene` has besides, and what it means in the header."""
    scene, more = flare_scene(flares, camera, sampling)
    arcs = "" if "arc_0" not in more else ", times exp(arc_0 u + arc_1 v) and one at its peak, r^2 = u^2 + v^2"
    write_ply(path, scene, extra=more, comments=(
        "Fit Flare: the flare of one frame, as its camera sees it",
        "light adds, colours are scene-linear" if blend == "add" else "light covers, colours are display values",
        f"profile exp(-(r - ring_r0)^2 / (2 ring_w^2)){arcs}, r the Mahalanobis distance",
        f"lights {' '.join(' '.join(name.split()) for name in flares)}"))  # a line of the header is one comment


def preset(look: Look, view: Mapping[str, ViewOfLight], edits: LookEdits | None = None,
           camera: Camera | None = None) -> dict[str, Any]:
    """The look as a list of elements such as procedural flare tools have them, for one place of each light.

    view: where each light stands, by name. camera: whose picture it is; the trained one's where not given. An element:
    `offset` along the axis (0 at the light, 1 at the centre, 2 at the mirror image: 1 - mu), `aside` across it, `size`
    (standard deviations along its long and short axis, as shares of the picture's width), `rotation` of the long axis
    (degrees from the axis through the light, clockwise), `colour` (linear Rec. 709, brightest channel 1), `intensity`
    (linear light at its brightest), `shape` (glow, disc, ring or streak), and for a ring its `radius` and `thickness`
    in the same unit, and where one side is brighter `arc`: `towards` which (degrees, as `rotation`), and `share`, the
    other side's light.
    """
    lens, exposure = (look.camera, 1.0) if camera is None else (camera, camera.exposure)
    width = lens.width / lens.fx  # of the picture, on the normalised plane
    lights = []
    for light in look.lights:
        if light.name not in view or (edits is not None and not edits.shows(light.name, view)):
            continue
        seen = light.evaluate(view[light.name], edits=edits)
        if seen is None:
            continue
        seen = seen.exposed(exposure, look.blend)
        at = view[light.name].light.astype(np.float64)
        elements = [{"name": element.name, "kind": element.kind, "parts": [_part(seen, row, at, width) for row in rows]}
                    for element, rows in _shown(light, edits, len(seen))]
        lights.append({"name": light.name, "at": (at / width).tolist(), "elements": elements})
    return {"version": PRESET_VERSION, "made_by": "Fit Flare", "blend": look.blend, "unit": "picture width",
            "offset": "0 at the light, 1 at the principal point", "licence": look.licence, "notes": look.notes,
            "lights": lights}


def write_preset(path: Path | str, look: Look, view: Mapping[str, ViewOfLight], edits: LookEdits | None = None,
                 camera: Camera | None = None) -> None:
    """Write `preset` as JSON."""
    write_json(path, preset(look, view, edits, camera))


def _shown(light: LightLook, edits: LookEdits | None, count: int) -> Iterator[tuple[Element, list[int]]]:
    """The elements that edits leave, with their rows among the `count` Gaussians that are left."""
    hidden = edits.hidden(light.name, light.elements) if edits is not None else set()
    gone = [row for element in light.elements if element.name in hidden for row in element.members]
    left = np.setdiff1d(np.arange(count + len(gone)), gone)
    for element in light.elements:
        if element.name not in hidden:
            yield element, np.searchsorted(left, element.members).tolist()


def _part(seen: PlaneGaussians, row: int, light: NDArray[np.float64], width: float) -> dict[str, Any]:
    """One Gaussian of a preset."""
    reach = max(float(np.linalg.norm(light)), 1e-6)
    axis = light / reach
    mean = seen.means[row].astype(np.float64)
    xx, xy, yy = (float(value) for value in seen.covariances[row])
    variances, axes = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    short, long = np.sqrt(np.maximum(variances, 0)) / width
    x, y = axes[:, 1]
    turn = math.degrees(math.atan2(axis[0] * y - axis[1] * x, axis[0] * x + axis[1] * y))
    light_here = np.maximum(seen.colours[row].astype(np.float64), 0) * float(seen.opacities[row])
    peak = float(light_here.max())
    part: dict[str, Any] = {
        "offset": 1 - float(mean @ axis) / reach, "aside": float(axis[0] * mean[1] - axis[1] * mean[0]) / width,
        "size": [float(long), float(short)], "rotation": (turn + 90) % 180 - 90, "intensity": peak,
        "colour": (light_here / peak).tolist() if peak > 0 else [1.0, 1.0, 1.0],
        "shape": "streak" if long > 4 * short else "glow"}
    if seen.rings is not None:
        r0, w = (float(value) for value in seen.rings[row])
        if r0 > w:
            part |= {"shape": "ring" if r0 > 3 * w else "disc", "radius": [r0 * float(long), r0 * float(short)],
                     "thickness": [w * float(long), w * float(short)]}
        elif r0 != 0 or w != 1:  # its own profile, as a plain one of about its width
            part["size"] = [(max(r0, 0) + w) * float(long), (max(r0, 0) + w) * float(short)]
        if seen.arcs is not None and seen.arcs[row].any():
            x, y = (float(value) for value in seen.arcs[row])
            towards = math.degrees(math.atan2(axis[0] * y - axis[1] * x, axis[0] * x + axis[1] * y))
            part["arc"] = {"towards": towards, "share": math.exp(-2 * max(r0, 0) * float(seen.strengths[row]))}
    return part
