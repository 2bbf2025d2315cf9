# SPDX-License-Identifier: GPL-3.0-or-later
"""A .flare as a look: reads it, and evaluates its flares for a camera and lights, with an artist's edits.

`Look.evaluate_lights` is the one loop over lights: the overlay and shot bakes call it, and `Look.evaluate` does for the
lights where the file has them. `core.transfer` uses `Look.visible_lights` with queries of its own. Both evaluate a
placed light by `placed_light.evaluate_placed`, so that lights with an extent, fall-off and factors are alike in all.
"""
from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Blend
from ..conventions.pixel_grid import PixelGrid
from ..errors import FlareFileError, SettingsError
from ..system.reading import parse_json
from ..typed import parse_table
from . import container, elements
from .edits import LookEdits, apply_edits
from .elements import Element
from .form import FlareForm
from .network import Floats, Network, OffsetsBudget, QueryRange, frequency_encoding
from .placed_light import PlacedLight as PlacedLight
from .placed_light import ViewOfLight as ViewOfLight
from .placed_light import evaluate_placed
from .plane import (
    PlaneGaussians,
    arcs_of_ellipse,
    colours,
    covariance_of_ellipse,
    opacity_gain,
    project_covariances,
)

VERSION = 1
METADATA_KEY = "fit_flare"
"""Key of the description in a .flare's metadata."""
MAX_GAUSSIANS = 1_000_000
"""Most Gaussians of a light; a file that claims more is damaged or hostile."""

Query = Literal["target", "source", "trained"]


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
        """The matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixel_ratio(self, width: int, height: int) -> float:
        """Return how many pixels of a picture lie along one of this camera's, if both have the same field of view.

        Compares widths; for a portrait and a landscape picture the long sides, since the camera is turned then."""
        is_turned = (width < height) != (self.width < self.height)
        return max(width, height) / max(self.width, self.height) if is_turned else width / self.width


@dataclass(frozen=True, eq=False)
class _DeformedGaussians:
    """What the Gaussians of a light have from canonical parameters and offsets alone, wherever the light is.

    positions (n, 1) on the line, or (n, 2) on the plane. shift (n, 2): on the plane, or None. scales, rotations: of the
    ellipses or ellipsoids. covariances (n, 3): xx, xy, yy, None where they depend on the place. opacities (n,). sh (n,
    k, 3). colours (n, 3): None where they depend on the view. rings, arcs (n, 2): or None, as in `PlaneGaussians`.
    """

    positions: Floats
    shift: Floats | None
    scales: Floats
    rotations: Floats
    covariances: Floats | None
    opacities: Floats
    sh: Floats
    colours: Floats | None
    rings: Floats | None
    arcs: Floats | None


class LightLook:
    """The flare of one light; created by `read_look`."""

    def __init__(self, name: str, xyz: NDArray[np.float64], form: FlareForm, query_range: QueryRange,
                 rows: Mapping[str, Floats], tensors: Mapping[str, NDArray[Any]], blend: Blend,
                 stored_elements: list[Element], clear_visibility: float = 1.0) -> None:
        """Make the look of one light of a .flare.

        xyz: (3,), world units. rows: parameters of the canonical Gaussians, (n, width) each, by name. tensors: all
        tensors of this light in the file, those of the network among them. stored_elements: the elements in the file,
        or []. clear_visibility: visibility, 0..1, that the scene of the fit gives the light where nothing hides it.
        Raises ValueError and KeyError for tensors that do not fit."""
        self.name, self.xyz, self.form, self.query_range, self.blend = name, xyz, form, query_range, blend
        self.clear_visibility = clear_visibility
        self._canonical, self._stored_elements = rows, stored_elements
        encoded = frequency_encoding(rows["positions"])
        if form.latent:
            encoded = np.concatenate([encoded, rows["latent"]], -1)
        self._network = Network(tensors, _head_widths(form, rows), form.levels, form.base, query_range, encoded)
        self._network.check_shapes(has_correction=form.light_correction)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self._canonical["positions"])

    @cached_property
    def elements(self) -> list[Element]:
        """The elements in the file, or else those that `group_elements` makes of the canonical Gaussians."""
        if self._stored_elements:
            return self._stored_elements
        # Grouped as seen with a light off both axes, at 0.65 of its largest distance in training: there elements lie
        # apart.
        light = self.query_range.light_high[2] * np.array([0.55, 0.35], np.float32)
        camera = (self.query_range.camera_low + self.query_range.camera_high) / 2
        view = ViewOfLight(camera, np.eye(3, dtype=np.float32), np.asarray(light, np.float32), 1.0)
        gaussians, _ = self._evaluate_on_plane(view, None)
        return elements.group_elements(gaussians, self._canonical["positions"][:, 0] if self.form.line else None)

    def evaluate(self, view: ViewOfLight, *, query: ViewOfLight | None = None, edits: LookEdits | None = None,
                 visibility: float = 1.0, name: str | None = None, budget: OffsetsBudget | None = None
                 ) -> PlaneGaussians | None:
        """Return the plane Gaussians of this light's flare in `view`; None for a light behind the camera.

        query: camera and light at which the network is evaluated, by default the view's: appearance follows it,
        placement follows the view. visibility: 0..1, scales the opacities. name: of the light whose edits are applied,
        by default this light's. budget: bounds the time for the network, so that offsets may be those of an earlier
        view; None for exact ones.
        """
        if view.depth <= 0:
            return None
        gaussians, light = self._evaluate_on_plane(view, query, budget, name or self.name)
        if edits is not None:
            gaussians = apply_edits(gaussians, name or self.name, light, self.elements, edits, self.blend)
        if visibility != 1.0:
            gaussians = replace(gaussians, opacities=np.asarray(gaussians.opacities * visibility, np.float32))
        return gaussians

    def _evaluate_on_plane(self, view: ViewOfLight, query: ViewOfLight | None, budget: OffsetsBudget | None = None,
                           name: str = "") -> tuple[PlaneGaussians, Floats]:
        """Return Gaussians on the plane (paper, eq. 1 to 3), and the light's position (2,), corrected by delta_l.

        query: camera and light for the network; None for the view's. budget: bounds the time for the network. name: of
        the placed light, for the budget."""
        form, queried = self.form, query or view
        features = self._network.view_features(queried.camera, queried.light)
        offsets = self._network.offsets(features, budget, name)
        if offsets.deformed is None:
            offsets.deformed = self._deform(offsets.by_name)
        deformed: _DeformedGaussians = offsets.deformed
        light = view.light
        if form.light_correction:
            light = light + self._network.light_correction(features)
        means = deformed.positions * light if form.line else deformed.positions
        if deformed.shift is not None:
            means = means + deformed.shift
        covariances = deformed.covariances
        if covariances is None:
            covariances = project_covariances(means, deformed.scales, deformed.rotations)
        sh_colours = deformed.colours
        if sh_colours is None:
            # From camera to world: a row times the rotation is its transpose times the vector.
            rays = np.concatenate([means, np.ones_like(means[:, :1])], -1) @ view.rotation
            sh_colours = colours(rays, deformed.sh, form.sh_degree)
        return PlaneGaussians(means, covariances, deformed.opacities, sh_colours, deformed.rings, deformed.arcs), light

    def _deform(self, offsets: Mapping[str, Floats]) -> _DeformedGaussians:
        """Return the canonical Gaussians with the offsets (n, width) of a view."""
        form, rows = self.form, self._canonical
        shift = offsets.get("plane_offset")
        if form.static_offset:
            shift = rows["offsets"] if shift is None else shift + rows["offsets"]
        scales, rotations = rows["log_scales"] + offsets["log_scales"], rows["rotations"] + offsets["rotations"]
        with np.errstate(over="ignore"):  # an exponential that overflows gives opacity 0
            opacities = 1 / (1 + np.exp(-(rows["opacity_logits"] + offsets["opacity_logits"])[:, 0]))
        positions = rows["positions"] + offsets["positions"]
        sh = (rows["sh"] + offsets["sh"]).reshape(len(positions), (form.sh_degree + 1) ** 2, 3)
        rings = arcs = None
        if form.rings:
            ring_values = rows["rings"] + offsets["rings"]  # r0, and the logarithm of w, clamped as in core.flare
            rings = np.stack([ring_values[:, 0], np.exp(np.clip(ring_values[:, 1], -3, 3))], -1)
        if form.arcs and rings is not None:
            ellipse_arcs = rows["arcs"] + offsets["arcs"]
            opacities = opacities * opacity_gain(ellipse_arcs, rings)
            arcs = arcs_of_ellipse(ellipse_arcs, scales, rotations)
        covariances = None if form.solid else covariance_of_ellipse(scales, rotations)
        sh_colours = None if form.sh_degree else colours(np.zeros((len(sh), 3), np.float32), sh, 0)
        return _DeformedGaussians(positions, shift, scales, rotations, covariances, opacities, sh, sh_colours, rings,
                                  arcs)


class Look:
    """The lights of a .flare; created by `read_look`."""

    def __init__(self, path: Path, lights: tuple[LightLook, ...], blend: Blend, camera: TrainedCamera,
                 licence: str = "", notes: str = "", pixel_grid: PixelGrid | None = None,
                 edit_texts: Sequence[str] = ()) -> None:
        """Make a look; `read_look` reads one. edit_texts: the edits that the file stores, see `edits`."""
        self.path, self.lights, self.blend, self.camera = path, lights, blend, camera
        self._edit_texts = tuple(edit_texts)
        self.pixel_grid = pixel_grid
        self.licence, self.notes = licence, notes

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the lights, in the file's order."""
        return tuple(light.name for light in self.lights)

    @property
    def element_names(self) -> dict[str, list[str]]:
        """Names of the elements by light, an argument of `LookEdits.parse`."""
        return {light.name: [element.name for element in light.elements] for light in self.lights}

    @cached_property
    def edits(self) -> LookEdits:
        """The edits that the file stores, which an artist's sliders start from; neutral in a file of a fit.

        No method applies them by itself. Raises FlareFileError for edits of lights or elements that the look lacks.
        """
        if not self._edit_texts:
            return LookEdits()
        try:
            return LookEdits.parse(self._edit_texts, self.names, self.element_names)
        except SettingsError as problem:
            raise FlareFileError(f"{self.path} is damaged: {problem}") from problem

    @property
    def count(self) -> int:
        """Number of Gaussians of all lights."""
        return sum(light.count for light in self.lights)

    def evaluate(self, world_to_camera: ArrayLike, *, lights: Mapping[str, ArrayLike] | None = None,
                 edits: LookEdits | None = None, visibilities: Mapping[str, float] | None = None,
                 query: Query = "target") -> dict[str, PlaneGaussians]:
        """Return the plane Gaussians of each visible light in front of the camera, by name, in the file's order.

        world_to_camera: (4, 4), x right, y down, z forward. lights: positions (3,) by name, by default the file's;
        names that the file lacks are omitted. visibilities: 0..1, by name, by default 1. edits: by the names of lights.
        query: the view at which the network is evaluated, by default this one; `evaluate_lights` lists the others.
        """
        positions = {light.name: light.xyz for light in self.lights} if lights is None else lights
        names = sorted(positions, key=lambda name: self.names.index(name) if name in self.names else len(self.names))
        placed = [PlacedLight(name, name, np.asarray(positions[name], np.float64), (visibilities or {}).get(name, 1.0))
                  for name in names]
        return self.evaluate_lights(world_to_camera, placed, edits, query)

    def evaluate_lights(self, world_to_camera: ArrayLike, lights: Sequence[PlacedLight],
                        edits: LookEdits | None = None, query: Query = "target",
                        budget: OffsetsBudget | None = None) -> dict[str, PlaneGaussians]:
        """Return the plane Gaussians of each placed light of `visible_lights` with a visibility above 0, by its name.

        edits: by the names of the placed lights; lights that mute and solo turn off are omitted.
        query: the view at which the network is evaluated: "target" the view itself; "trained" camera and light, clipped
        to the range of the training views; "source" the middle of the range of cameras, and the clipped light.
        Placement always follows the view. budget: bounds the time for the network in an interactive redraw; lights
        with an extent are exact in any case. None for exact flares.
        """
        flares: dict[str, PlaneGaussians] = {}
        for light, source in self.visible_lights(lights, edits):
            def evaluate(view: ViewOfLight, visibility: float, source: LightLook = source, name: str = light.name,
                         is_point: bool = light.extent is None) -> PlaneGaussians | None:
                return source.evaluate(view, query=network_query(source, view, query), edits=edits,
                                       visibility=visibility, name=name, budget=budget if is_point else None)

            gaussians = evaluate_placed(light, world_to_camera, self.blend, evaluate, self.pixel_grid)
            if gaussians is not None:
                flares[light.name] = gaussians
        return flares

    def visible_lights(self, lights: Sequence[PlacedLight], edits: LookEdits | None = None
                       ) -> Iterator[tuple[PlacedLight, LightLook]]:
        """Yield each placed light with its source, the look's light whose flare it shows.

        Omits lights that mute and solo turn off, and lights whose source the look lacks."""
        sources = {light.name: light for light in self.lights}
        names = [light.name for light in lights]
        for light in lights:
            source = sources.get(light.source)
            if source is None or (edits is not None and not edits.is_visible(light.name, names)):
                continue
            yield light, source


def network_query(light: LightLook, view: ViewOfLight, query: Query) -> ViewOfLight | None:
    """Return the view at which the network is evaluated; None for `view` itself.

    query: "target" for `view` itself; "trained" for its camera and light, clipped to the range of the training views;
    "source" for the middle of the range of cameras, and the clipped light.
    """
    if query == "target":
        return None
    query_range = light.query_range
    if query == "trained":
        camera, position = query_range.clip(view.camera, view.light)
    else:
        camera = (query_range.camera_low + query_range.camera_high) / 2
        _, position = query_range.clip(camera, view.light)
    return replace(view, camera=camera, light=position)


# ---- the file -------------------------------------------------------------------------------------


def read_description(path: Path | str) -> dict[str, Any]:
    """Read the description of a .flare (lights, blend, camera, licence, notes), without its tensors.

    Raises FlareFileError for a file that is missing, damaged, of a newer version, or not a flare.
    """
    return _parse_description_unchecked(Path(path), container.read_tensors(path)[1])


def store_elements(path: Path | str) -> None:
    """Write the elements of each light into a .flare without elements, so that later versions group them alike."""
    look = read_look(path)
    _, metadata = container.read_tensors(path)
    entries = [element.to_json(light.name) for light in look.lights for element in light.elements]
    description = {**_parse_description_unchecked(Path(path), metadata), "elements": entries}
    container.rewrite_metadata(path, path, {**metadata, METADATA_KEY: json.dumps(description)})


def write_annotated(source: Path | str, target: Path | str, *, notes: str, licence: str,
                    edits: LookEdits | None = None) -> None:
    """Write a copy of a .flare with other notes, licence and edits (`Look.edits`).

    Raises FlareFileError if `source` is not a flare."""
    _, metadata = container.read_tensors(source)
    description = {**_parse_description_unchecked(Path(source), metadata), "notes": notes, "licence": licence}
    if edits is not None:
        description["edits"] = edits.texts()
    container.rewrite_metadata(source, target, {**metadata, METADATA_KEY: json.dumps(description)})


def _parse_description_unchecked(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Parse the description in a .flare's metadata; check its version alone. Raises FlareFileError."""
    if METADATA_KEY not in metadata:
        raise FlareFileError(f"{path} is a safetensors file, but not a flare; choose another.")
    try:
        description = parse_json(metadata[METADATA_KEY])
    except ValueError as problem:
        raise FlareFileError(f"{path} is damaged or not a flare ({problem}); save it again.") from problem
    version = description.get("version") if isinstance(description, dict) else None
    if not isinstance(version, int) or version > VERSION:
        raise FlareFileError(f"{path} was written by a newer Fit Flare (format {version}); update to open it.")
    return description


def parse_description(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Parse and validate the description in a .flare's metadata, for all readers, so that they accept the same files.

    Raises FlareFileError if it is missing, of a newer version, or invalid. Does not compare it with the tensors."""
    description = _parse_description_unchecked(path, metadata)
    try:
        names = [_check_light(path, entry, description.get("elements", [])) for entry in description["lights"]]
        if len(set(names)) < len(names):
            raise ValueError("two lights have one name")
        if description["blend"] not in ("over", "add"):
            raise ValueError(f"blend {description['blend']!r}")
        camera = parse_table(TrainedCamera, description["camera"])
        if min(camera.width, camera.height, camera.fx, camera.fy) <= 0:
            raise ValueError("its camera is not valid")
        PixelGrid.read(description.get("sampling"))
        if not all(isinstance(text, str) for text in description.get("edits", [])):
            raise ValueError("edits are a list of texts")
        for rows in description.get("seen", {}).values():
            if any(len([float(value) for value in row]) != 5 for row in rows):  # camera x, y, z, light x, y
                raise ValueError("a training view is not valid")
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as problem:
        raise FlareFileError(f"{path} is damaged: its description is not valid ({problem}); save it again."
                             ) from problem
    return description


def _check_light(path: Path, entry: Mapping[str, Any], element_entries: Any) -> str:
    """Validate the description of a light, and return its name.

    entry: the light's description. element_entries: the elements of all lights. Raises FlareFileError for a form of a
    newer version; for invalid values ValueError, KeyError or TypeError, which the caller turns into FlareFileError.
    """
    unknown = set(entry["form"]) - {field.name for field in fields(FlareForm)}
    if unknown:
        raise FlareFileError(f"{path} was written by a newer Fit Flare (its form has {', '.join(sorted(unknown))}); "
                             "update to open it.")
    name, count, xyz = str(entry["name"]), int(entry["count"]), [float(value) for value in entry["xyz"]]
    if not 0 <= count <= MAX_GAUSSIANS or len(xyz) != 3 or not all(map(math.isfinite, xyz)):
        raise ValueError("a light's description is not valid")
    if not FlareForm(**entry["form"]).is_valid:
        raise ValueError("a light's form is not valid")
    if not 0 <= float(entry.get("clear", 1.0)) <= 1:
        raise ValueError("a light's clear share is not valid")
    QueryRange.read(entry["range"])
    elements.read_elements(element_entries, name, count)
    return name


def read_look(path: Path | str) -> Look:
    """Read a .flare. Raises FlareFileError for a file that is missing, damaged, of a newer version, or not a flare."""
    path = Path(path)
    tensors, metadata = container.read_tensors(path)
    description = parse_description(path, metadata)
    for name, tensor in tensors.items():
        if tensor.dtype.kind == "f" and not np.isfinite(tensor).all():
            raise FlareFileError(f"{path} is damaged: {name} holds values that are not finite; save it again.")
    blend = description["blend"]
    try:
        lights = tuple(_read_light(number, entry, tensors, blend, description.get("elements", []))
                       for number, entry in enumerate(description["lights"]))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as problem:
        raise FlareFileError(f"{path} is damaged: its tensors do not fit its description ({problem}).") from problem
    return Look(path, lights, blend, parse_table(TrainedCamera, description["camera"]),
                str(description.get("licence", "")), str(description.get("notes", "")),
                PixelGrid.read(description.get("sampling")), description.get("edits", []))


def _read_light(number: int, entry: Mapping[str, Any], tensors: Mapping[str, NDArray[Any]], blend: Blend,
                element_entries: Any) -> LightLook:
    """Make the look of light `number` of a file from its tensors.

    entry: the light's description. element_entries: the elements of all lights. Raises ValueError and KeyError."""
    form, name, count = FlareForm(**entry["form"]), str(entry["name"]), int(entry["count"])
    xyz = np.array([float(value) for value in entry["xyz"]], np.float64)
    light_tensors = {key[len(f"{number}."):]: value for key, value in tensors.items() if key.startswith(f"{number}.")}
    rows = {key[len("gaussians."):]: np.asarray(value, np.float32) for key, value in light_tensors.items()
            if key.startswith("gaussians.")}
    for key, width in _row_widths(form).items():
        if rows[key].shape != (count, width):
            raise ValueError(f"{key} has the shape {rows[key].shape}")
    return LightLook(name, xyz, form, QueryRange.read(entry["range"]), rows, light_tensors, blend,
                     elements.read_elements(element_entries, name, count), float(entry.get("clear", 1.0)))


def _row_widths(form: FlareForm) -> dict[str, int]:
    """Return the number of columns of each parameter of the canonical Gaussians, by its name in the .flare."""
    widths = {"positions": 1 if form.line else 2, "log_scales": 3 if form.solid else 2,
              "rotations": 4 if form.solid else 2, "opacity_logits": 1, "sh": 3 * (form.sh_degree + 1) ** 2}
    extra = {"offsets": (form.static_offset, 2), "rings": (form.rings, 2), "arcs": (form.arcs, 2),
             "latent": (form.latent, form.latent)}
    return {**widths, **{name: width for name, (is_present, width) in extra.items() if is_present}}


def _head_widths(form: FlareForm, rows: Mapping[str, Floats]) -> dict[str, int]:
    """Return the widths of the offsets by name, in the order of the network's head (core.flare.model.LightFlare)."""
    names = sorted(name for name in _row_widths(form) if name not in ("offsets", "latent"))  # as torch sorts parameters
    heads = {name: rows[name].shape[1] for name in names}
    if form.line and form.plane_offset:
        heads["plane_offset"] = 2  # without the line, positions have two coordinates already
    return heads
