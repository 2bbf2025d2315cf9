# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a .flare from a lens prescription: traces its flare at many places of the light, and fits a flare model to it.

There is no scene: the pictures hold the flare alone, so the supervision is exact. The light's places are spread evenly
over the frame and beyond it. A lens looks the same from everywhere, so the model's camera range is so wide that the
position of the camera changes nothing. `headless/commands/make_flare.py` and `sample_scenes/make_library.py` call
`make_flare`.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..capture import Camera
from ..conventions.pixel_grid import PixelGrid
from ..errors import SettingsError
from ..flare import file as flare_file
from ..flare.compositing import splat_flare
from ..flare.deformation import QueryRange
from ..flare.density import clone_and_prune
from ..flare.file import FlareFile
from ..flare.model import FlareModel, LightFlare, ViewOfLight, plane_scale
from ..look import TrainedCamera, store_elements
from ..optics.flare import LensSetup, build_optics, render_flare
from ..optics.ghosts import draw_ghosts, limit_brightness
from ..optics.lenses import find_lens
from ..system.files import atomic_path
from ..system.processes import available_cores
from ..system.progress import Progress
from .optimisers import FlareOptimisers
from .settings import FitSettings, preset
from .traced_ghosts import measure_ghosts, start_at_ghosts
from .traced_settings import REFERENCE_REACH, TracedFlareSettings

Pictures = NDArray[np.float32]
Places = NDArray[np.float64]

LIGHT = "light"
"""Name of the light in the file."""
CAMERA_RANGE = 1e6
"""Half the side of the model's camera range, world units: all cameras fall on one point of its grid."""
PATH_LENGTH = 12
"""Number of places on the path along which the error is measured."""
PATH_ENDS = (-0.85, 0.7), (0.9, -0.5)
"""Ends of that path, relative to the frame's half width and height."""
PROBES = (0.15, 0.12), (-0.4, 0.3), (0.6, -0.5), (0.85, 0.8), (-0.1, -0.8), (-0.95, 0.0)
"""Places of the light at which the level of the ghosts is measured, relative to the frame's half width and height."""
PLACE_STEPS = 0.7548776662, 0.5698402910
"""Steps of the R2 sequence (Roberts 2018): 1 / g and 1 / g^2, g the plastic number."""
CENTRE_POWER = 1.5
"""Exponent of the distances from the centre of evenly spread places: 1 keeps them even, more makes the centre denser.
"""
SHARE_AT_LIGHT, SHARE_AT_GHOSTS = 0.35, 0.55
"""Shares of the initial Gaussians that lie around the light, as rays, and in the ghosts; the others are spread along
the line."""
RAY_LENGTHS = 0.004, 0.9
"""Smallest and largest distance of the rays from the light, relative to half the frame's width."""
RAY_DEVIATIONS, MIN_RAY_DISTANCES = (0.35, 0.12), (2, 4)
"""Standard deviations along and across a ray, relative to its distance from the light, and the smallest distances that
count, in smallest RAY_LENGTHS: a ray is a needle, but the shortest ones are about as wide as long."""
GAIN_STEPS = 6
"""Steps in which the ghosts' gain is found where some of them reach their limit."""
CORE_GAUSSIANS, CORE_SIZES, CORE_OPACITY = 24, (0.3, 4.0), 0.2
"""Number, range of standard deviations (pixels) and opacity of the initial Gaussians in the light itself."""
MAX_THREADS = 8
"""Largest number of pictures that are traced at a time."""
SQUARED_WEIGHT = 0.3
"""Weight of the relative error in linear light against that of the encoded light: highlights against faint ghosts."""
ENCODING_OFFSET = 1e-3
"""Added to light before the square root that encodes it for the loss: about a display's curve, with a bounded slope at
black."""


class TracedPictures(NamedTuple):
    """Traced flares: places (n, 2) of the light, normalised coordinates, and pictures (n, height, width, 3), linear."""

    places: Places
    pictures: Pictures


@dataclass(frozen=True)
class TracedResult:
    """The result of `make_flare`. error, max_error: mean and largest relative L2 error along the path, linear light.
    count: number of Gaussians."""

    path: Path
    error: float
    max_error: float
    count: int


def make_flare(settings: TracedFlareSettings, out: Path, progress: Progress, *, notes: str = "", licence: str = ""
               ) -> TracedResult:
    """Trace a lens's flare, fit a model to it, measure its error, and write it as a .flare at `out`.

    The error is measured on a path of the light that the fit did not see. notes, licence: text stored in the file;
    without notes, a note on the lens. Raises SettingsError, and Cancelled after a requested stop; then nothing is
    written.
    """
    settings = settings.validated()
    camera, setup = traced_camera(settings), setup_with_ghost_gain(settings)
    traced = trace(settings, setup, spread_places(settings), progress, "trace")
    model = fit_traced(settings, setup, traced, progress)
    path_pictures = trace(settings, setup, path_places(settings), progress, "measure")
    errors = relative_errors(model, camera, path_pictures)
    write_flare(out, model, camera, traced.places, notes or default_notes(settings), licence)
    return TracedResult(out, float(np.mean(errors)), float(max(errors)), model.count)


def default_notes(settings: TracedFlareSettings) -> str:
    """Return the note of a file: the lens and how it was used."""
    f_number = settings.iris.f_number or 2 * find_lens(settings.lens).widest_f_number()
    return (f"Traced through {Path(settings.lens).stem}, {settings.used_focal_length:.0f} mm, f/{f_number:.2g}, "
            f"{settings.iris.blades} blades, on a sensor {settings.sensor:g} mm wide.")


def traced_camera(settings: TracedFlareSettings) -> Camera:
    """Return the camera of the traced pictures, at the origin."""
    width, height = settings.tracing.width, settings.height
    focal = width / 2 / settings.reach
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def setup_with_ghost_gain(settings: TracedFlareSettings) -> LensSetup:
    """Return the tracer's setup with the gain at which the ghosts have the level `settings.ghosts.level`.

    Their level is measured on coarsely drawn ghosts with the light at PROBES. Raises SettingsError if no ghost of the
    lens reaches the frame.
    """
    setup = settings.lens_setup()
    if settings.ghosts.count == 0 or settings.ghosts.level == 0:
        return replace(setup, ghosts=replace(setup.ghosts, count=0))
    optics, pairs = build_optics(setup)
    camera = traced_camera(settings)
    bands = 3 if settings.ghosts.dispersion else 1
    drawing_settings = replace(setup.ghosts, bands=bands, supersample=1, limit=math.inf)
    # An anamorphic lens is traced as a spherical one that sees x divided by the squeeze.
    pictures = np.stack([draw_ghosts(optics, pairs, drawing_settings, (x / setup.squeeze, y),
                                     (camera.fx * setup.squeeze, camera.fy), (camera.cx, camera.cy), camera.width,
                                     camera.height) for x, y in _to_normalised(settings, PROBES)])
    level = _root_mean_square(pictures)
    if not level > 0:
        raise SettingsError(f"No ghost of the lens {settings.lens} reaches the frame; check that its file lists clear "
                            "diameters, or set ghosts.level=0.")
    gain = settings.ghosts.level / level
    for _ in range(GAIN_STEPS):  # the limit dims the brightest pixels, so the gain is raised until the level is right
        if gain * pictures.max() <= settings.ghosts.limit:
            break
        gain *= settings.ghosts.level / _root_mean_square(limit_brightness(gain * pictures, settings.ghosts.limit))
    return replace(setup, ghosts=replace(setup.ghosts, gain=gain))


def _root_mean_square(pictures: Pictures) -> float:
    """Return the root mean square of pictures (n, height, width, 3)."""
    return math.sqrt(float(np.mean([np.square(picture).mean() for picture in pictures])))


def _to_normalised(settings: TracedFlareSettings, fractions: Sequence[Sequence[float]] | Places) -> Places:
    """Convert places relative to the frame's half width and height to normalised coordinates."""
    half = settings.reach * np.array([1.0, settings.height / settings.tracing.width])
    return np.asarray(fractions, np.float64) * half


def spread_places(settings: TracedFlareSettings) -> Places:
    """Return places (n, 2) of the light, spread over the frame and beyond it, normalised coordinates.

    They follow the R2 sequence, and are denser towards the centre, where ghosts overlap and change fastest.
    """
    sequence = np.arange(1, settings.tracing.positions + 1)[:, None] * np.array(PLACE_STEPS)
    square = sequence % 1 * 2 - 1  # -1..1
    eccentricity = np.abs(square).max(1, keepdims=True)
    return _to_normalised(settings, square * eccentricity ** (CENTRE_POWER - 1) * settings.tracing.field)


def path_places(settings: TracedFlareSettings) -> Places:
    """Return the places of a path across the frame, normalised coordinates."""
    return _to_normalised(settings, np.linspace(*PATH_ENDS, PATH_LENGTH))


def trace(settings: TracedFlareSettings, setup: LensSetup, places: Places, progress: Progress, stage: str
          ) -> TracedPictures:
    """Trace the flare at each place (n, 2) of the light, normalised coordinates, on several threads.

    stage: name of this step for the progress. Raises Cancelled after a requested stop.
    """
    camera = traced_camera(settings)
    progress.stage(stage, len(places))
    pictures = np.zeros((len(places), camera.height, camera.width, 3), np.float32)
    with ThreadPoolExecutor(min(available_cores(), MAX_THREADS)) as pool:
        jobs = [pool.submit(render_flare, setup, camera, place, colour=settings.colour) for place in places]
        try:
            for number, job in enumerate(jobs):
                pictures[number] = job.result()
                progress.advance()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return TracedPictures(places, pictures)


def _fit_settings(settings: TracedFlareSettings) -> FitSettings:
    """Return the fit's settings: the preset "draft" with the blend "add", for a light whose position is known."""
    fit = settings.fit
    base = preset("draft", blend="add", iterations=fit.iterations)
    density = replace(base.flare.density, start=max(fit.iterations // 10, 10), stop=int(fit.iterations * 0.7),
                      max_gaussians=fit.max_gaussians)
    # The light's position is known, and its core is a few pixels wide. A correction, or large steps of the positions,
    # would move the core off its pixels, and the loss would darken it there instead of moving it back.
    form = replace(base.flare.form, light_correction=False)
    rates = replace(base.flare.rates, position=base.flare.rates.position / 4, network=base.flare.rates.network / 2)
    return replace(base, flare=replace(base.flare, form=form, rates=rates, count=fit.gaussians, density=density,
                                       opacity=0.02))


def fit_traced(settings: TracedFlareSettings, setup: LensSetup, traced: TracedPictures, progress: Progress
               ) -> FlareModel:
    """Fit a flare model to traced pictures with Adam; the same settings and pictures give the same model.

    The loss of a picture is the L1 error of encoded light plus the relative L2 error of linear light. setup: the traced
    lens.
    """
    fit = _fit_settings(settings)
    generator = torch.Generator().manual_seed(settings.fit.seed)
    with torch.random.fork_rng():  # torch's own generator draws the network's weights
        torch.manual_seed(settings.fit.seed)
        model = _initial_model(settings, setup, fit, traced, generator)
    flare, camera = model.lights[0], traced_camera(settings)
    optimisers = FlareOptimisers(model, fit.flare.rates)
    optimiser_names = {name: next(key for key in optimisers.dense.parameters if key.endswith(f"gaussians.{name}"))
                       for name in flare.gaussians}
    pictures = torch.from_numpy(traced.pictures)
    lights, intrinsics = torch.tensor(traced.places, dtype=torch.float32), _intrinsics(camera)
    encoded, energies = _encode_light(pictures), pictures.square().sum((1, 2, 3)).clamp_min(1e-6)
    remaining: list[int] = []
    random = np.random.default_rng(settings.fit.seed)
    progress.stage("fit", fit.iterations)
    for iteration in range(1, fit.iterations + 1):
        remaining = remaining or random.permutation(len(pictures)).tolist()
        index = remaining.pop()
        optimisers.set_rates(iteration / fit.iterations)
        drawn = _draw_flare(flare, lights[index], intrinsics, camera)
        # 1e-4 bounds the slope of the root where the error vanishes.
        relative_squared_error = (drawn - pictures[index]).square().sum() / energies[index]
        relative_error = (relative_squared_error + 1e-4).sqrt()
        loss = (_encode_light(drawn) - encoded[index]).abs().mean() + SQUARED_WEIGHT * relative_error
        loss.backward()
        optimisers.step()
        if fit.flare.density.is_due(iteration):
            clone_and_prune(flare, optimisers.dense, optimiser_names, fit.flare.density, generator)
        progress.advance(1, loss=float(loss.detach()), gaussians=flare.count)
    return model


def _initial_model(settings: TracedFlareSettings, setup: LensSetup, fit: FitSettings, traced: TracedPictures,
                   generator: torch.Generator) -> FlareModel:
    """Return the model before the fit: Gaussians at the light, at the lens's ghosts, and spread along the line.

    setup: the traced lens. fit: settings of the model. traced: gives the range of the light's places.
    """
    cameras = torch.tensor([[-CAMERA_RANGE] * 3, [CAMERA_RANGE] * 3])
    corner_radius = math.hypot(settings.reach, settings.reach * settings.height / settings.tracing.width)
    query_range = QueryRange.of(cameras, torch.tensor(traced.places, dtype=torch.float32), corner_radius)
    flare = LightFlare(fit.flare.form, query_range, fit.flare.count, generator, fit.flare.opacity,
                       plane_scale(settings.reach))
    shuffled_rows = torch.randperm(flare.count, generator=generator)
    at_light, at_ghosts = (round(flare.count * share) for share in (SHARE_AT_LIGHT, SHARE_AT_GHOSTS))
    pixel = 2 * settings.reach / settings.tracing.width
    _start_at_light(flare, shuffled_rows[:at_light], settings.reach, pixel, generator)
    if setup.ghosts.count:
        ghosts = measure_ghosts(setup, traced_camera(settings), _to_normalised(settings, PROBES), settings.colour)
        start_at_ghosts(flare, shuffled_rows[at_light:at_light + at_ghosts], ghosts, generator)
    return FlareModel([LIGHT], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), [flare])


def _start_at_light(flare: LightFlare, rows: Tensor, reach: float, pixel: float, generator: torch.Generator) -> None:
    """Move the Gaussians `rows` (their indices) to the light, as rays at log-uniform distances, and scale all Gaussians
    to the frame.

    Starburst and glow have most of a flare's light and lie about the light, where few of the Gaussians along the line
    would be. The first CORE_GAUSSIANS rows form the light itself. reach: half the frame's width; pixel: width of a
    pixel of the traced pictures; both in normalised coordinates.
    """
    table = flare.gaussians
    with torch.no_grad():
        table["log_scales"] += math.log(reach / REFERENCE_REACH / flare.scale)
        low, high = (math.log(bound) for bound in RAY_LENGTHS)
        distance = torch.exp(low + (high - low) * torch.rand(len(rows), generator=generator)) * reach
        angle = 2 * math.pi * torch.rand(len(rows), generator=generator)
        direction = torch.stack([angle.cos(), angle.sin()], -1)
        table["positions"][rows] = 1.0
        table["offsets"][rows] = direction * distance[:, None]
        table["rotations"][rows] = direction
        deviations = [deviation * distance.clamp_min(RAY_LENGTHS[0] * reach * min_distance)
                      for deviation, min_distance in zip(RAY_DEVIATIONS, MIN_RAY_DISTANCES, strict=True)]
        table["log_scales"][rows] = torch.log(torch.stack(deviations, -1))
        table["rings"][rows] = 0.0
        # The light itself is a few pixels of many times white, which one Gaussian's colour would not reach.
        core = rows[:CORE_GAUSSIANS]
        low, high = (math.log(bound * pixel) for bound in CORE_SIZES)
        table["offsets"][core] = 0.0
        table["log_scales"][core] = low + (high - low) * torch.rand(len(core), 1, generator=generator)
        table["opacity_logits"][core] = math.log(CORE_OPACITY / (1 - CORE_OPACITY))


def _encode_light(light: Tensor) -> Tensor:
    """Return linear light encoded for the loss, sqrt(light + ENCODING_OFFSET): about a display's curve."""
    encoded: Tensor = (light.clamp_min(0) + ENCODING_OFFSET).sqrt()
    return encoded


def _intrinsics(camera: Camera) -> Tensor:
    return torch.tensor(camera.intrinsics, dtype=torch.float32)


def _draw_flare(flare: LightFlare, light: Tensor, intrinsics: Tensor, camera: Camera) -> Tensor:
    """Return the flare (height, width, 3) of a light at normalised coordinates (2,), linear."""
    view = ViewOfLight(torch.zeros(3), torch.eye(3), light, 1.0)
    return splat_flare(flare(view), intrinsics, camera.width, camera.height, "add").colour


@torch.no_grad()
def draw_fitted(model: FlareModel, camera: Camera, places: Places) -> Pictures:
    """Return the fitted flares (n, height, width, 3) of lights at places (n, 2), linear."""
    lights, intrinsics = torch.tensor(places, dtype=torch.float32), _intrinsics(camera)
    return np.stack([_draw_flare(model.lights[0], light, intrinsics, camera).numpy() for light in lights])


def relative_errors(model: FlareModel, camera: Camera, traced: TracedPictures) -> list[float]:
    """Return the L2 norm of fitted minus traced over that of traced, by picture, linear light."""
    fitted = draw_fitted(model, camera, traced.places)
    return [float(np.linalg.norm(picture - truth) / max(float(np.linalg.norm(truth)), 1e-9))
            for picture, truth in zip(fitted, traced.pictures, strict=True)]


def write_flare(out: Path, model: FlareModel, camera: Camera, places: Places, notes: str, licence: str) -> None:
    """Write a .flare atomically, with named elements, the places as training views, and the pixel grid."""
    lens = TrainedCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    views = {LIGHT: [[0.0, 0.0, 0.0, round(float(x), 5), round(float(y), 5)] for x, y in places]}
    grid = PixelGrid.from_focal_lengths([camera.fx])
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(out) as temporary:
        flare_file.save(temporary, FlareFile(model, "add", lens, licence, notes, training_views=views, pixel_grid=grid))
        store_elements(temporary)
