# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare of one light: canonical Gaussians and the network that deforms them.

The paper's form and ours are one model with switches (`FlareForm`), so that every design choice can be removed and
measured. A `FlareModel` holds one such flare for each light of a capture; `core.fit` optimises it.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from ..gaussians.kernels import fused_kernels
from ..gaussians.spherical_harmonics import colours
from ..look.form import FlareForm
from ..look.plane import PLANE_DEPTH
from ..system.files import round_for_text
from . import placement
from .deformation import DeformationNetwork, QueryRange
from .frame_lights import FrameLights
from .placement import PlaneGaussians

MIN_TRAINING_VISIBILITY = 0.2
"""Visibility of a light below which a view gives no gradient to its flare."""

RING_INTERVAL = 4
"""One Gaussian in this many is a ring at first, where the form has rings."""
LINE_RANGE = -1.2, 1.4
"""Places on the line over which Gaussians are spread at first: from beyond the light's mirror image (-1) to beyond the
light (1)."""
INITIAL_CODE_SCALE = 0.1
"""Standard deviation of the latent codes at first."""
INITIAL_SIZES = 0.01, 0.06
"""Range of the Gaussians' standard deviations at first, in the normalised plane of a frame of FULL_SCALE_REACH."""
FULL_SCALE_REACH = 0.36
"""Half the width of a frame, normalised, of a lens of 50 mm on a sensor of 36 mm. The sizes and steps of a fit are in
these units; those of a longer lens are smaller by `plane_scale`."""
INITIAL_RING_RADII = 3.0, 8.5
"""r0 of rings at first, in standard deviations, from the smallest to the largest: up to half of the plane. A ring with
no Gaussian near it is not learned; and thin rings, unlike larger Gaussians, leave the frame free."""
INITIAL_RING_WIDTH = 0.5
"""w of rings at first, in standard deviations."""


PAPER = FlareForm()
OURS = replace(PAPER, solid=False, sh_degree=0, static_offset=True, rings=True, latent=4, levels=3, base=4)


class ViewOfLight(NamedTuple):
    """One light seen from one camera: the input of a flare.

    camera (3,) position in the world, rotation (3, 3) world to camera, light (2,) normalised coordinates, depth of the
    light along the axis, world units; not positive means behind the camera.
    """

    camera: Tensor
    rotation: Tensor
    light: Tensor
    depth: float

    def to(self, device: torch.device) -> ViewOfLight:
        """Return the view with its tensors on a device."""
        return ViewOfLight(self.camera.to(device), self.rotation.to(device), self.light.to(device), self.depth)

    @classmethod
    def of(cls, world_to_camera: Tensor, xyz: Tensor) -> ViewOfLight:
        """Make the view, in float32, from a pose world_to_camera (4, 4) and the light's position xyz (3,) in the world.
        """
        pose = world_to_camera.double()
        x, y, z = (pose[:3, :3] @ xyz.double() + pose[:3, 3]).tolist()
        camera = -pose[:3, :3].T @ pose[:3, 3]
        light = torch.tensor([x / z, y / z] if z > 0 else [math.inf, math.inf])
        return cls(camera.float(), pose[:3, :3].float(), light.float(), z)


def plane_scale(reach: float) -> float:
    """Return the scale of a flare's sizes and steps in the normalised plane, for frames of this half width: 1 for
    lenses up to 50 mm, less for longer ones, whose frame is a small part of the plane."""
    return min(reach / FULL_SCALE_REACH, 1.0)


class LightFlare(nn.Module):
    """Canonical Gaussians of one light and their deformation.

    `gaussians` holds one row for each Gaussian: positions (n, 1) along the line or (n, 2) on the plane, log_scales and
    rotations, (n, 3) and quaternions (n, 4) if the form is solid, else (n, 2) and directions (n, 2), opacity_logits (n,
    1), sh (n, k * 3), and where the form has them offsets (n, 2), rings (n, 2) as r0 and log w, arcs (n, 2) in
    deviations along the axes, latent (n, d).
    """

    def __init__(self, form: FlareForm, query_range: QueryRange, count: int, generator: torch.Generator,
                 opacity: float = 0.05, scale: float = 1.0) -> None:
        """Make random initial Gaussians and their deformation network.

        count, opacity: number and opacity (0..1) of the Gaussians. scale: `plane_scale` of the frames that the flare is
        fitted to.
        """
        super().__init__()
        self.form, self.query_range, self.scale = form, query_range, scale
        self.gaussians = nn.ParameterDict(
            {name: nn.Parameter(rows)
             for name, rows in _initial_gaussians(form, count, opacity, scale, generator).items()})
        deformed = [name for name in self.gaussians if name not in ("offsets", "latent")]
        heads = {name: self.gaussians[name].shape[1] for name in deformed}
        if form.line and form.plane_offset:
            heads["plane_offset"] = 2
        self.network = DeformationNetwork(heads, query_range, position_width=1 if form.line else 2,
                                          latent_width=form.latent, levels=form.levels, base=form.base)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.gaussians["positions"])

    @property
    def device(self) -> torch.device:
        """The device of the parameters."""
        return self.gaussians["positions"].device

    def forward(self, view: ViewOfLight, opacity_floor: float = 0.0) -> PlaneGaussians:
        """Return the flare's Gaussians in this view (paper, eq. 1 to 3), on the normalised plane.

        opacity_floor: opacity, 0..1, that fainter Gaussians are given (`_RaiseToFloor`). Raises ValueError for a light
        behind the camera: it has no flare (paper, "Flare Representation").
        """
        if view.depth <= 0:
            raise ValueError("a light behind the camera has no flare")
        features = self.network.view_features(view.camera, view.light)
        light = view.light
        if self.form.light_correction:
            light = light + self.scale * self.network.light_correction(features)
        placed = self._place_fused(features, light, opacity_floor)
        return self._place(features, light, view.rotation, opacity_floor) if placed is None else placed

    def _place_fused(self, features: Tensor, light: Tensor, opacity_floor: float) -> PlaneGaussians | None:
        """Return the result of `_place` by the fused CPU kernels; None if they are not available for the form."""
        form, rows, network = self.form, self.gaussians, self.network
        fused = fused_kernels(rows["positions"])
        if fused is None or form.solid or form.sh_degree or not form.static_offset:
            return None
        if tuple(zip(network.names, network.widths, strict=True)) != fused.PLACED_COLUMNS:
            return None
        deltas = network.offsets(rows["positions"], rows["latent"] if form.latent else None, features)
        placed = fused.place(deltas, light, self.scale, *(rows[name] for name in (
            "positions", "log_scales", "rotations", "opacity_logits", "sh", "rings", "offsets")))
        if placed is None:
            return None
        gaussians = PlaneGaussians(*placed)
        return gaussians._replace(opacities=_raise_to_floor(gaussians.opacities, opacity_floor))

    def _place(self, features: Tensor, light: Tensor, rotation: Tensor, opacity_floor: float) -> PlaneGaussians:
        """Return the Gaussians on the plane, by torch: the definition.

        features: of the view. light: (2,), its corrected place. rotation: (3, 3), world to camera.
        """
        form, rows = self.form, self.gaussians
        latent = rows["latent"] if form.latent else None
        deltas = self.network(rows["positions"], latent, features)  # delta_x of the paper, by the name of x

        def deformed(name: str) -> Tensor:
            """Return canonical rows plus the network's offsets for this view."""
            return rows[name] + deltas[name]

        means = placement.on_line(deformed("positions"), light) if form.line else deformed("positions")
        if "plane_offset" in deltas:
            means = means + self.scale * deltas["plane_offset"]
        if form.static_offset:
            means = means + rows["offsets"]
        scales, rotations = deformed("log_scales"), deformed("rotations")
        if form.solid:
            covariances = placement.project_covariances(means, scales, rotations)
        else:
            covariances = placement.covariance_of_ellipse(scales, rotations)
        opacities = _raise_to_floor(deformed("opacity_logits").sigmoid()[:, 0], opacity_floor)
        rings = arcs = None
        if form.rings:
            rings = _to_rings(deformed("rings"))
        if form.arcs and rings is not None:
            opacities = opacities * placement.opacity_gain(deformed("arcs"), rings)
            arcs = placement.arcs_of_ellipse(deformed("arcs"), scales, rotations)
        flare_colours = self._colours(deformed("sh"), means, rotation)
        return PlaneGaussians(means, covariances, opacities, flare_colours, rings, arcs)

    def state_without_scale(self) -> dict[str, Tensor]:
        """Return the state of an equal flare whose `scale` is 1.

        For this, the last layers of the network that yield lengths in the plane are multiplied by the scale.
        """
        state = {name: tensor.detach() for name, tensor in self.state_dict().items()}
        if self.scale == 1:
            return state
        names, widths = self.network.names, self.network.widths
        head_factors = torch.ones(sum(widths))
        if "plane_offset" in names:
            start = sum(widths[:names.index("plane_offset")])
            head_factors[start:start + 2] = self.scale
        # "correction.2" is the last layer of the network's Sequential `correction`.
        for layer, factor in (("head", head_factors), ("correction.2", torch.full((2,), self.scale))):
            for part, values in (("weight", factor[:, None]), ("bias", factor)):
                state[f"network.{layer}.{part}"] = state[f"network.{layer}.{part}"] * values
        return state

    def _colours(self, sh: Tensor, means: Tensor, rotation: Tensor) -> Tensor:
        """Return colours (n, 3) from spherical harmonics, in the direction of each mean in the world.

        sh: (n, k * 3), k coefficients of each channel. means: (n, 2) on the plane. rotation: (3, 3), world to camera.
        """
        rays = torch.cat([means, torch.ones_like(means[:, :1])], -1)
        return colours(rays @ rotation, sh.unflatten(-1, (-1, 3)), self.form.sh_degree)


class _RaiseToFloor(torch.autograd.Function):
    """The larger of opacities (n,) and a floor, with the gradient of the result where that would increase an opacity
    below the floor, else 0.

    Adam changes a colour at a constant rate, and so the light of a Gaussian at a rate in proportion to its opacity. A
    flare whose first Gaussians fade therefore learns more slowly than the scene, which then takes its light for good.
    """

    @staticmethod
    def forward(ctx: Any, opacities: Tensor, floor: float) -> Tensor:
        ctx.save_for_backward(opacities >= floor)
        return opacities.clamp(min=floor)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (is_above,) = ctx.saved_tensors
        return torch.where(is_above | (gradient < 0), gradient, 0), None


def _raise_to_floor(opacities: Tensor, floor: float) -> Tensor:
    """Return opacities (n,) of at least `floor`, with the gradient of `_RaiseToFloor`; unchanged for a floor of 0."""
    return cast(Tensor, _RaiseToFloor.apply(opacities, floor)) if floor else opacities


def _to_rings(raw: Tensor) -> Tensor:
    """Return rings (n, 2) as r0 and w from raw rows of r0 and log w. log w is kept in -3..3, so that a ring is wide
    enough for the pixel grid of a picture."""
    return torch.stack([raw[:, 0], raw[:, 1].clamp(-3, 3).exp()], -1)


def _initial_gaussians(form: FlareForm, count: int, opacity: float, scale: float, generator: torch.Generator
                       ) -> dict[str, Tensor]:
    """Return the rows of `count` initial Gaussians, by name of the parameter.

    They are spread evenly over LINE_RANGE, or, if the form has no line, at random over a square with sides of `scale`
    about the principal point. Sizes are log-uniform over INITIAL_SIZES times `scale`, so most of the frame stays free.
    """
    if form.line:
        positions = torch.linspace(*LINE_RANGE, count)[:, None]
    else:
        positions = scale * (torch.rand(count, 2, generator=generator) - 0.5)
    fraction = torch.rand(count, 1, generator=generator)
    size = _log_interpolate(*INITIAL_SIZES, fraction) + math.log(scale)
    if form.solid:
        log_scales = (size + math.log(PLANE_DEPTH)).repeat(1, 3)
        rotations = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    else:
        log_scales, rotations = size.repeat(1, 2), torch.tensor([1.0, 0.0]).repeat(count, 1)
    rows = {
        "positions": positions,
        "log_scales": log_scales,
        "rotations": rotations,
        "opacity_logits": torch.full((count, 1), math.log(opacity / (1 - opacity))),
        "sh": torch.zeros(count, 3 * (form.sh_degree + 1) ** 2),
    }
    if form.static_offset:
        rows["offsets"] = torch.zeros(count, 2)
    if form.rings:
        # Optimisation rarely turns a disc into a ring, since the pictures in between are worse; so some begin as rings.
        # The others have r0 = 0 and log w = 0: plain Gaussians. One `fraction` gives both size and radius of a ring.
        rows["rings"] = torch.zeros(count, 2)
        rows["rings"][::RING_INTERVAL, 0] = _log_interpolate(*INITIAL_RING_RADII, fraction[::RING_INTERVAL, 0]).exp()
        rows["rings"][::RING_INTERVAL, 1] = math.log(INITIAL_RING_WIDTH)
    if form.arcs:
        rows["arcs"] = torch.zeros(count, 2)
    if form.latent:
        rows["latent"] = INITIAL_CODE_SCALE * torch.randn(count, form.latent, generator=generator)
    return rows


def _log_interpolate(low: float, high: float, fraction: Tensor) -> Tensor:
    """Return the logarithm of the value at a fraction (0..1) between low and high on a logarithmic scale."""
    return math.log(low) + (math.log(high) - math.log(low)) * fraction


class FlareModel(nn.Module):
    """The flares of a capture: one `LightFlare` for each light, by name, in the capture's order.

    clear: (lights,) the visibility of each light behind the fitted scene where nothing hides it, 0..1. It is less than
    1, since Gaussians that show the lamp itself, or a sky nearer than the sun, stand before it. 0: unknown, and
    visibilities are 1. frame_lights: places and brightness by frame, where lights move or change; a .flare has none.

    `move_to` puts the parameters on a device. The lights' places and `clear` stay on the CPU, where cameras are
    computed with them.
    """

    positions: Tensor
    clear: Tensor

    def __init__(self, names: Sequence[str], positions: Tensor, flares: Sequence[LightFlare],
                 frame_lights: FrameLights | None = None) -> None:
        super().__init__()
        self.names = tuple(names)
        self.register_buffer("positions", positions.double())  # (lights, 3), world units
        self.register_buffer("clear", torch.ones(len(positions)))
        self.flares = nn.ModuleList(flares)
        self.frame_lights = frame_lights

    def move_to(self, device: torch.device) -> None:
        """Move the parameters to a device."""
        self.flares.to(device)
        if self.frame_lights is not None:
            self.frame_lights.brightness.to(device)

    @property
    def lights(self) -> list[LightFlare]:
        """The flares, in the lights' order."""
        return [cast(LightFlare, flare) for flare in self.flares]

    @property
    def device(self) -> torch.device:
        """The device of the flares; the CPU without any."""
        return self.lights[0].device if self.lights else torch.device("cpu")

    @property
    def count(self) -> int:
        """Number of Gaussians in all flares."""
        return sum(flare.count for flare in self.lights)

    def positions_in(self, frame: str) -> Tensor:
        """Return the places (lights, 3) of the lights in a frame, world units."""
        places = None if self.frame_lights is None else self.frame_lights.positions_in(frame)
        return self.positions if places is None else places

    def views(self, world_to_camera: Tensor, frame: str = "") -> list[ViewOfLight]:
        """Return every light seen from one pose (4, 4), at its place in `frame`, on the device of its flare."""
        return [ViewOfLight.of(world_to_camera, xyz).to(flare.device)
                for flare, xyz in zip(self.lights, self.positions_in(frame), strict=True)]

    def training_views(self, poses: Sequence[Tensor], frames: Sequence[str] = ()) -> dict[str, list[list[float]]]:
        """Return, by the light's name, a list [camera x, y, z, light x, y] for each pose (4, 4) that has it in front.

        Cameras are in world units, lights in normalised coordinates. frames: name of each pose's frame, needed if
        lights move.
        """
        views_by_light: dict[str, list[list[float]]] = {name: [] for name in self.names}
        for pose, frame in zip(poses, frames or [""] * len(poses), strict=True):
            for name, view in zip(self.names, self.views(pose, frame), strict=True):
                if view.depth > 0:
                    views_by_light[name].append([round_for_text(value)
                                                 for value in (*view.camera.tolist(), *view.light.tolist())])
        return views_by_light

    def light_corrections(self, world_to_camera: Tensor, frame: str = "") -> Tensor:
        """Return delta_l (n, 2), the corrections of the places of the n lights in front of a pose (4, 4), in normalised
        coordinates divided by `scale`.

        Gradients stop at the view's features, which the whole flare shares. Else Adam would move rows of the grids that
        only views with a hidden light touch, by full steps.
        """
        views = self.views(world_to_camera, frame)
        lights = [(flare.network, view) for flare, view in zip(self.lights, views, strict=True) if view.depth > 0]
        with torch.no_grad():
            features = [network.view_features(view.camera, view.light) for network, view in lights]
        corrections = [network.light_correction(of_view)
                       for (network, _), of_view in zip(lights, features, strict=True)]
        return torch.stack(corrections) if corrections else torch.zeros(0, 2)

    def forward(self, world_to_camera: Tensor, visibilities: Mapping[str, Tensor] | None = None,
                frame: str = "", opacity_floor: float = 0.0) -> dict[str, PlaneGaussians]:
        """Return the Gaussians of every light in front of the camera, by the light's name.

        Opacities are multiplied by the visibility of the light, 0..1, and by its brightness in `frame`. If this product
        is below MIN_TRAINING_VISIBILITY, the light's Gaussians get no gradient: there is next to nothing to learn, and
        Adam would learn the error of the visibility at full rate. world_to_camera: (4, 4). visibilities: by the light's
        name; None if all are 1. opacity_floor: as for `LightFlare.forward`.
        """
        lights = zip(self.names, self.lights, self.views(world_to_camera, frame), strict=True)
        flares = {name: flare(view, opacity_floor) for name, flare, view in lights if view.depth > 0}
        shares = self.shares(visibilities, frame)
        if shares is None:
            return flares
        flares = {name: gaussians if shares[name] >= MIN_TRAINING_VISIBILITY else _detached(gaussians)
                  for name, gaussians in flares.items()}
        return {name: gaussians._replace(opacities=gaussians.opacities * shares[name])
                for name, gaussians in flares.items()}

    def shares(self, visibilities: Mapping[str, Tensor] | None, frame: str) -> Mapping[str, Tensor] | None:
        """Return visibility times brightness of each light, by name; None if neither is known, which means 1 for
        all."""
        brightness = None if self.frame_lights is None else self.frame_lights.brightness_in(frame)
        if brightness is None:
            return visibilities
        shares = dict(zip(self.names, brightness, strict=True))
        return shares if visibilities is None else {name: share * visibilities[name] for name, share in shares.items()}


def _detached(gaussians: PlaneGaussians) -> PlaneGaussians:
    """Return the Gaussians without gradients."""
    return PlaneGaussians(*(None if part is None else part.detach() for part in gaussians))  # type: ignore[arg-type]
