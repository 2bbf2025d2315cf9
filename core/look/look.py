# SPDX-License-Identifier: GPL-3.0-or-later
"""A .flare as a look: what it shows for a camera and lights, with an artist's edits."""
from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Blend
from ..conventions.pixel_grid import Sampling
from ..errors import FlareFileError
from ..typed import Bounds, table_of
from . import container, elements
from .edits import LookEdits, edited
from .elements import Element
from .network import Floats, Network, QueryRange, frequency_encoding
from .plane import (
    PlaneGaussians,
    arcs_of_ellipse,
    colours,
    covariance_of_ellipse,
    covariance_of_solid,
    opacity_gain,
)

VERSION = 1
KEY = "fit_flare"
"""Of the description in a .flare's metadata."""
MOST_GAUSSIANS = 1_000_000
"""Of a light; a file that claims more is damaged or hostile."""
FORM_BOUNDS = {"sh_degree": Bounds(0, 3), "latent": Bounds(0, 64), "levels": Bounds(1, 16), "base": Bounds(1, 256)}
"""What the numbers of a form may be, likewise."""

Query = Literal["target", "source", "trained"]


@dataclass(frozen=True)
class FlareForm:
    """What the model is made of; each field a choice that can be measured alone.

    line              Gaussians live on the line through principal point and light; else free (mode `2d`)
    light_correction  delta_l, a 2D correction of the light's position for each view (paper, eq. 4)
    plane_offset      delta_f, a deformed 2D offset of each Gaussian (paper, eq. 3)
    solid             3D Gaussians with SH colour at depth 0.21 (paper); else ellipses on the plane
    sh_degree         of the colour's view dependence, 0 to 3 (solid only)
    static_offset     a learned 2D offset of each Gaussian, the same in all views
    rings             the radial profile exp(-(r - r0)^2 / (2 w^2)) (ours; docs/interop.md)
    arcs              one side of it brighter, by exp(b·d): rings of which the lens's barrel hides a part (ellipses with
                      rings only)
    latent            width of a per-Gaussian code that the network sees
    levels, base      of the hash grids: how many, and the resolution of the coarsest. Fine cells hold a view
                      each, and learn nothing about the views between
    """

    line: bool = True
    light_correction: bool = True
    plane_offset: bool = True
    solid: bool = True
    sh_degree: int = 3
    static_offset: bool = False
    rings: bool = False
    latent: int = 0
    levels: int = 16
    base: int = 16
    arcs: bool = False

    @property
    def consistent(self) -> bool:
        """Whether its parts go together."""
        return not self.arcs or (self.rings and not self.solid)

    @property
    def makes_sense(self) -> bool:
        """Whether its numbers lie within `FORM_BOUNDS` too."""
        return self.consistent and all(bounds.hold(getattr(self, name)) for name, bounds in FORM_BOUNDS.items())


@dataclass(frozen=True)
class TrainedCamera:
    """Intrinsics of the footage, pixels; the plane's coordinates are (pixel - centre) / focal length."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """(3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixels_across(self, width: int, height: int) -> float:
        """How many times as many pixels a picture of that size has across this camera's field of view: by the width;
        where one of the two is upright and the other is not by the long sides, since that is how a camera is turned."""
        turned = (width < height) != (self.width < self.height)
        return max(width, height) / max(self.width, self.height) if turned else width / self.width


@dataclass(frozen=True, eq=False)
class ViewOfLight:
    """One light seen from one camera. camera (3,) in the world, rotation (3, 3) world to camera, light (2,)
    normalised coordinates, depth along the axis in world units: not positive means behind the camera."""

    camera: Floats
    rotation: Floats
    light: Floats
    depth: float

    @classmethod
    def of(cls, world_to_camera: ArrayLike, xyz: ArrayLike) -> ViewOfLight:
        """From a pose (4, 4) and the light's position (3,)."""
        pose = np.asarray(world_to_camera, np.float64)
        x, y, z = (pose[:3, :3] @ np.asarray(xyz, np.float64) + pose[:3, 3]).tolist()
        camera = -pose[:3, :3].T @ pose[:3, 3]
        light = [x / z, y / z] if z > 0 else [math.inf, math.inf]
        return cls(camera.astype(np.float32), pose[:3, :3].astype(np.float32), np.array(light, np.float32), z)


class LightLook:
    """The flare of one light; made by `read`."""

    def __init__(self, name: str, xyz: NDArray[np.float64], form: FlareForm, query_range: QueryRange,
                 rows: Mapping[str, Floats], tensors: Mapping[str, NDArray[Any]], blend: Blend,
                 listed: list[Element], clear: float = 1.0) -> None:
        """rows: canonical Gaussians by name; tensors: the network's; listed: elements the file has, [] for none.
        clear: what the scene it was learned in leaves of the light where nothing hides it, 0..1
        (`core.flare.model.FlareModel`)."""
        self.name, self.xyz, self.form, self.query_range, self.blend = name, xyz, form, query_range, blend
        self.clear = clear
        self._rows, self._listed = rows, listed
        encoded = frequency_encoding(rows["positions"])
        if form.latent:
            encoded = np.concatenate([encoded, rows["latent"]], -1)
        self._network = Network(tensors, _heads(form, rows), form.levels, form.base, query_range, encoded)
        self._network.check(corrects=form.light_correction)

    @property
    def count(self) -> int:
        """Gaussians."""
        return len(self._rows["positions"])

    @cached_property
    def elements(self) -> list[Element]:
        """Its elements: the file's own, or else found from the canonical Gaussians."""
        if self._listed:
            return self._listed
        along = self.query_range.light_high[2] * np.array([0.55, 0.35], np.float32)
        middle = (self.query_range.camera_low + self.query_range.camera_high) / 2
        seen, _ = self._gaussians(ViewOfLight(middle, np.eye(3, dtype=np.float32), np.asarray(along, np.float32), 1.0),
                                  None)
        return elements.group(seen, self._rows["positions"][:, 0] if self.form.line else None)

    def evaluate(self, view: ViewOfLight, *, query: ViewOfLight | None = None, edits: LookEdits | None = None,
                 share: float = 1.0, name: str | None = None) -> PlaneGaussians | None:
        """The Gaussians this light shows in `view`; None for a light behind the camera, which has no flare.

        query: the camera and light the network is asked for, if not the view's own: appearance follows it,
        placement follows the view. share: how much of the light is visible, 0..1; scales the opacities. name:
        whose edits are applied, if not this light's.
        """
        if view.depth <= 0:
            return None
        gaussians, light = self._gaussians(view, query)
        if edits is not None:
            gaussians = edited(gaussians, name or self.name, light, self.elements, edits, self.blend)
        if share != 1.0:
            gaussians = replace(gaussians, opacities=np.asarray(gaussians.opacities * share, np.float32))
        return gaussians

    def _gaussians(self, view: ViewOfLight, query: ViewOfLight | None) -> tuple[PlaneGaussians, Floats]:
        """Gaussians on the plane (paper, eq. 1 to 3), and the light with delta_l."""
        form, rows, asked = self.form, self._rows, query or view
        features = self._network.view_features(asked.camera, asked.light)
        change = self._network.offsets(features)
        light = view.light
        if form.light_correction:
            light = light + self._network.light_correction(features)
        positions = rows["positions"] + change["positions"]
        means = positions * light if form.line else positions
        if "plane_offset" in change:
            means = means + change["plane_offset"]
        if form.static_offset:
            means = means + rows["offsets"]
        scales, rotations = rows["log_scales"] + change["log_scales"], rows["rotations"] + change["rotations"]
        covariances = (covariance_of_solid(means, scales, rotations) if form.solid
                       else covariance_of_ellipse(scales, rotations))
        with np.errstate(over="ignore"):
            opacities = 1 / (1 + np.exp(-(rows["opacity_logits"] + change["opacity_logits"])[:, 0]))
        rays = np.concatenate([means, np.ones_like(means[:, :1])], -1) @ view.rotation
        sh = (rows["sh"] + change["sh"]).reshape(len(means), (self.form.sh_degree + 1) ** 2, 3)
        rings = arcs = None
        if form.rings:
            raw = rows["rings"] + change["rings"]
            rings = np.stack([raw[:, 0], np.exp(np.clip(raw[:, 1], -3, 3))], -1)
        if form.arcs and rings is not None:
            own = rows["arcs"] + change["arcs"]
            opacities = opacities * opacity_gain(own, rings)
            arcs = arcs_of_ellipse(own, scales, rotations)
        return PlaneGaussians(means, covariances, opacities, colours(rays, sh, form.sh_degree), rings, arcs), light


class Look:
    """All lights of a .flare; made by `read`."""

    def __init__(self, path: Path, lights: tuple[LightLook, ...], blend: Blend, camera: TrainedCamera,
                 licence: str = "", notes: str = "", sampling: Sampling | None = None) -> None:
        self.path, self.lights, self.blend, self.camera = path, lights, blend, camera
        self.sampling = sampling
        self.licence, self.notes = licence, notes

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the lights, in their order."""
        return tuple(light.name for light in self.lights)

    @property
    def element_names(self) -> dict[str, list[str]]:
        """Names of the elements by light, as `LookEdits.parse` takes them."""
        return {light.name: [element.name for element in light.elements] for light in self.lights}

    @property
    def count(self) -> int:
        """Gaussians of all lights."""
        return sum(light.count for light in self.lights)

    def evaluate(self, world_to_camera: ArrayLike, *, lights: Mapping[str, ArrayLike] | None = None,
                 edits: LookEdits | None = None, shares: Mapping[str, float] | None = None,
                 query: Query = "target") -> dict[str, PlaneGaussians]:
        """The Gaussians of each light in front of the camera, by the light's name, in the file's order.

        world_to_camera: (4, 4), x right, y down, z forward. lights: positions (3,) by name where they differ
        from the file's; with it, lights it does not name are left out. edits: mute and solo leave lights out.
        shares: how much of a light is visible, 0..1, by name (1 where not named).
        query: what appearance follows: "target" the view as it is; "trained" the view, kept inside what training
        saw; "source" the middle of what training saw. Placement follows the view always.
        """
        placed = {light.name: light.xyz for light in self.lights} if lights is None else dict(lights)
        shown: dict[str, PlaneGaussians] = {}
        for light in self.lights:
            if light.name not in placed or (edits is not None and not edits.shows(light.name, placed)):
                continue
            view = ViewOfLight.of(world_to_camera, placed[light.name])
            if view.depth <= 0:
                continue
            found = light.evaluate(view, query=asked(light, view, query), edits=edits,
                                   share=(shares or {}).get(light.name, 1.0))
            if found is not None:
                shown[light.name] = found
        return shown


def asked(light: LightLook, view: ViewOfLight, query: Query) -> ViewOfLight | None:
    """What the network is asked for, by name; see `Look.evaluate`. None: the view itself."""
    if query == "target":
        return None
    reach = light.query_range
    if query == "trained":
        camera, place = reach.clipped(view.camera, view.light)
    else:
        camera = (reach.camera_low + reach.camera_high) / 2
        _, place = reach.clipped(camera, view.light)
    return replace(view, camera=camera, light=place)


# ---- the file -------------------------------------------------------------------------------------


def describe(path: Path | str) -> dict[str, Any]:
    """The description of a .flare (lights, blend, camera, licence, notes), without its tensors' meaning.

    Raises FlareFileError where the file is missing, damaged, newer, or not a flare.
    """
    return _described(Path(path), container.read_tensors(path)[1])


def list_elements(path: Path | str) -> None:
    """Write the elements of each light into a .flare that lists none, so that they stay what they are."""
    look = read(path)
    _, metadata = container.read_tensors(path)
    listed = [element.entry(light.name) for light in look.lights for element in light.elements]
    description = {**_described(Path(path), metadata), "elements": listed}
    container.rewritten(path, path, {**metadata, KEY: json.dumps(description)})


def annotated(source: Path | str, target: Path | str, *, notes: str, licence: str) -> None:
    """A copy of a .flare with other notes and licence. Raises FlareFileError where `source` is not a flare."""
    _, metadata = container.read_tensors(source)
    description = {**_described(Path(source), metadata), "notes": notes, "licence": licence}
    container.rewritten(source, target, {**metadata, KEY: json.dumps(description)})


def _described(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    if KEY not in metadata:
        raise FlareFileError(f"{path} is a safetensors file, but not a flare; choose another.")
    try:
        description = json.loads(metadata[KEY])
    except (ValueError, RecursionError) as problem:
        raise FlareFileError(f"{path} is damaged or not a flare ({problem}); save it again.") from problem
    version = description.get("version") if isinstance(description, dict) else None
    if not isinstance(version, int) or version > VERSION:
        raise FlareFileError(f"{path} was written by a newer Fit Flare (format {version}); update to open it.")
    return description


def checked(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """The description in a .flare's metadata, for every reader: what one refuses all do. Raises FlareFileError where
    it is not there, newer, or makes no sense; whether the tensors fit it is the reader's to say."""
    description = _described(path, metadata)
    try:
        names = [_check_light(path, entry, description.get("elements", [])) for entry in description["lights"]]
        if len(set(names)) < len(names):
            raise ValueError("two lights have one name")
        if description["blend"] not in ("over", "add"):
            raise ValueError(f"blend {description['blend']!r}")
        camera = table_of(TrainedCamera, description["camera"])
        if min(camera.width, camera.height, camera.fx, camera.fy) <= 0:
            raise ValueError("its camera makes no sense")
        Sampling.read(description.get("sampling"))
        for rows in description.get("seen", {}).values():
            if any(len([float(value) for value in row]) != 5 for row in rows):
                raise ValueError("a training view makes no sense")
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as problem:
        raise FlareFileError(f"{path} is damaged: its description makes no sense ({problem}); save it again."
                             ) from problem
    return description


def _check_light(path: Path, entry: Mapping[str, Any], listed: Any) -> str:
    """Its name."""
    strange = set(entry["form"]) - {one.name for one in fields(FlareForm)}
    if strange:
        raise FlareFileError(f"{path} was written by a newer Fit Flare (its form has {', '.join(sorted(strange))}); "
                             "update to open it.")
    name, count, xyz = str(entry["name"]), int(entry["count"]), [float(value) for value in entry["xyz"]]
    if not 0 <= count <= MOST_GAUSSIANS or len(xyz) != 3 or not all(map(math.isfinite, xyz)):
        raise ValueError("a light's description makes no sense")
    if not FlareForm(**entry["form"]).makes_sense:
        raise ValueError("a light's form makes no sense")
    if not 0 <= float(entry.get("clear", 1.0)) <= 1:
        raise ValueError("a light's clear share makes no sense")
    QueryRange.read(entry["range"])
    elements.read(listed, name, count)
    return name


def read(path: Path | str) -> Look:
    """Read a .flare. Raises FlareFileError where it is missing, damaged, newer, or not a flare."""
    path = Path(path)
    tensors, metadata = container.read_tensors(path)
    description = checked(path, metadata)
    for name, tensor in tensors.items():
        if tensor.dtype.kind == "f" and not np.isfinite(tensor).all():
            raise FlareFileError(f"{path} is damaged: {name} holds values that are not finite; save it again.")
    blend = description["blend"]
    try:
        lights = tuple(_light(number, entry, tensors, blend, description.get("elements", []))
                       for number, entry in enumerate(description["lights"]))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as problem:
        raise FlareFileError(f"{path} is damaged: its tensors do not fit its description ({problem}).") from problem
    return Look(path, lights, blend, table_of(TrainedCamera, description["camera"]),
                str(description.get("licence", "")), str(description.get("notes", "")),
                Sampling.read(description.get("sampling")))


def _light(number: int, entry: Mapping[str, Any], tensors: Mapping[str, NDArray[Any]], blend: Blend,
           listed: Any) -> LightLook:
    form, name, count = FlareForm(**entry["form"]), str(entry["name"]), int(entry["count"])
    xyz = np.array([float(value) for value in entry["xyz"]], np.float64)
    own = {key[len(f"{number}."):]: value for key, value in tensors.items() if key.startswith(f"{number}.")}
    rows = {key[len("gaussians."):]: np.asarray(value, np.float32) for key, value in own.items()
            if key.startswith("gaussians.")}
    for key, width in _widths(form).items():
        if rows[key].shape != (count, width):
            raise ValueError(f"{key} has the shape {rows[key].shape}")
    return LightLook(name, xyz, form, QueryRange.read(entry["range"]), rows, own, blend,
                     elements.read(listed, name, count), float(entry.get("clear", 1.0)))


def _widths(form: FlareForm) -> dict[str, int]:
    """Columns of the canonical Gaussians by name (core.flare.model.LightFlare)."""
    widths = {"positions": 1 if form.line else 2, "log_scales": 3 if form.solid else 2,
              "rotations": 4 if form.solid else 2, "opacity_logits": 1, "sh": 3 * (form.sh_degree + 1) ** 2}
    extra = {"offsets": (form.static_offset, 2), "rings": (form.rings, 2), "arcs": (form.arcs, 2),
             "latent": (form.latent, form.latent)}
    return {**widths, **{name: width for name, (there, width) in extra.items() if there}}


def _heads(form: FlareForm, rows: Mapping[str, Floats]) -> dict[str, int]:
    """Offsets by name, in the order of the network's one head matrix (core.flare.model.LightFlare)."""
    known = sorted(name for name in _widths(form) if name not in ("offsets", "latent"))  # as torch sorts parameters
    heads = {name: rows[name].shape[1] for name in known}
    if form.line and form.plane_offset:
        heads["plane_offset"] = 2
    return heads
