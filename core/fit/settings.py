# SPDX-License-Identifier: GPL-3.0-or-later
"""Every setting of a fit, and its presets.

Defaults are the paper's (appendix "Flare representation"); the presets change length and rates so that a fit ends in
minutes on two CPU cores. `fit` of the commands takes a preset and overrides of it; `trainer` follows them, and `config`
keeps them in a run.
"""
from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Literal

import numpy as np

from ..choices import ITERATIONS, PARALLAX_ITERATIONS, PARALLAX_MODES, Blend, Device, Kernels, Mode, Model, Preset
from ..colour.srgb import srgb_from_linear
from ..errors import SettingsError
from ..flare.density import DensitySettings
from ..flare.model import OURS, PAPER
from ..flare.visibility import VisibilitySettings
from ..gaussians.densification import ClassicSettings, McmcSettings
from ..look.form import FORM_BOUNDS, FlareForm
from ..look.look import MAX_GAUSSIANS
from ..typed import MAX_INT_DIGITS, MAX_SEED, Bounds
from .coarse_to_fine import CoarseToFineSettings


@dataclass(frozen=True)
class FlareRates:
    """Adam's learning rates for the flare. `position` decays exponentially to `position_final`.

    final_ratio: factor that the other rates reach at the end, exponentially from the middle of the fit on.
    """

    network: float = 1e-4
    grids: float = 1e-4
    position: float = 1.6e-4
    position_final: float = 1.6e-6
    features: float = 2.5e-3
    opacity: float = 0.05
    scale: float = 0.1
    rotation: float = 1e-3
    offset: float = 1e-3
    ring: float = 5e-3
    arc: float = 5e-3
    latent: float = 5e-3
    brightness: float = 0.01
    final_ratio: float = 1.0


@dataclass(frozen=True)
class SceneRates:
    """Adam's learning rates for the scene, as in 3DGS (Kerbl et al. 2023); positions in units of the extent."""

    position: float = 1.6e-4
    position_final: float = 1.6e-6
    features: float = 2.5e-3
    features_rest: float = 2.5e-3 / 20
    opacity: float = 0.05
    scale: float = 5e-3
    rotation: float = 1e-3


@dataclass(frozen=True)
class FlareSettings:
    """The flare: its form, the number of Gaussians a light starts with, density control, rates, occlusion.

    opacity: that of the first Gaussians.

    detection: False puts every light at the centroid of the points plus uniform noise (ablation). occlusion: scale each
    flare by the visibility of its light behind the scene (`visibility`).

    scene_only_until: share of the iterations in which the scene is fitted alone, if it has clean frames. A flare that
    is fitted before the scene hides its light learns to vanish by itself, in neighbouring views too.

    snap_lights: move lights to where clean frames show their flares (`lights.snap`).

    correction_weight: of the squared delta_l in the loss. Where a light is hidden nothing else holds delta_l, and Adam
    makes a full step of the faintest gradient: delta_l would leave the frame, in neighbouring views too.
    """

    form: FlareForm = PAPER
    count: int = 200
    opacity: float = 0.05
    density: DensitySettings = field(default_factory=DensitySettings)
    rates: FlareRates = field(default_factory=FlareRates)
    detection: bool = True
    occlusion: bool = False
    scene_only_until: float = 0.0
    snap_lights: bool = False
    correction_weight: float = 0.0
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)

    @property
    def active_visibility(self) -> VisibilitySettings | None:
        """How the scene hides lights; None where it does not."""
        return self.visibility if self.occlusion else None


@dataclass(frozen=True)
class SceneSettings:
    """The scene: 3DGS from the capture's points, with one of two strategies of densification, or plates.

    kind: "plates" uses one plate per frame as the scene, and needs no cameras; the other settings are for "gaussians".
    sh_every: iterations between degrees of spherical harmonics. reorder_every: iterations between sorts along the
    Morton curve, which keeps neighbours together in memory. start: a 3DGS PLY in the capture's world to start from
    instead of the points. frozen: keep that scene unchanged and fit only the flare.
    far_layer: add a far layer where the frames show something beyond the parallax of the capture (`far_layer`).
    """

    kind: Literal["gaussians", "plates"] = "gaussians"
    start: str = ""
    frozen: bool = False
    strategy: Literal["classic", "mcmc"] = "classic"
    classic: ClassicSettings = field(default_factory=ClassicSettings)
    mcmc: McmcSettings = field(default_factory=McmcSettings)
    rates: SceneRates = field(default_factory=SceneRates)
    sh_every: int = 1000
    reorder_every: int = 500
    far_layer: bool = True


@dataclass(frozen=True)
class SplitSettings:
    """Modes `split` and `estimated`: separation of scene and flare without exact clean frames, by parallax.

    A flare adds light, and it moves through the frame from view to view as no part of the scene does. So the scene is
    fitted alone first, in `scene_only_rounds` passes over the views (a third of the iterations at most), with a
    quantile loss: where a frame is brighter than the scene, the error counts `excess_weight` times as much. Longer, and
    the scene takes up the glow about the lights; shorter, and the flare takes walls.

    Then both are fitted to the frames. The quantile loss of the scene stays, with `scene_weight`, and by the middle of
    the fit counts only where the scene is brighter than a frame. The scene's light near a visible light costs
    `near_scene_penalty`, half of that at `light_radius` of the width: what both could make goes to the flare. The
    scene's colours have degree `sh_degree` for the share `low_sh_until` of the iterations, since they could follow a
    flare if they changed freely with direction. After that, the penalty is multiplied by `final_near_share`: scenes
    whose colours change freely become darker about a light, and the flare becomes a veil. sky: add far points at the
    start. opacity_floor: while the number of flare Gaussians changes, fainter ones are drawn with this opacity, so that
    a flare whose light the scene took can come back.

    When the flare starts, the scene is tested for convergence: flares only add light, while errors have both signs. If
    the squared excess of the frames over the scene is less than `converged_ratio` times their squared deficit, the
    flare's light far from the lights costs `far_flare_penalty`: what both could make goes to the flare near the lights
    only.

    If such a capture also has few training views, less than `few_views` and most from half of them down, its scene is
    fitted alone for longer, up to a third of the iterations.

    Mode `estimated`: after these passes, and until the middle of the fit, the scene is also fitted to the estimated
    clean frames, with a falling weight; the flare that these still hold is removed by parallax. Of the flare that they
    show, nothing is penalised just below `converged_ratio`, and all of it at `diverged_ratio` and below.
    """

    scene_only_rounds: int = 2
    excess_weight: float = 0.25
    scene_weight: float = 0.05
    near_scene_penalty: float = 0.05
    final_near_share: float = 0.5
    light_radius: float = 0.05
    sh_degree: int = 1
    low_sh_until: float = 0.7
    sky: bool = True
    opacity_floor: float = 0.004
    converged_ratio: float = 26.0
    diverged_ratio: float = 18.0
    far_flare_penalty: float = 0.1
    few_views: int = 30


@dataclass(frozen=True)
class BrightnessSettings:
    """The brightness of each light in each frame, an unknown of the fit for lights that move or change.

    roughness_weight: of the absolute change between neighbouring frames, in the loss. prior_weight: of the squared
    difference from the brightness in lights.json, where it has one. solve_every: share of the iterations after which
    the brightness is solved for all frames at once; in between it follows the gradient.
    """

    solve_every: float = 0.15
    roughness_weight: float = 1e-4
    prior_weight: float = 1e-3


@dataclass(frozen=True)
class PlateSettings:
    """A fit over plates.

    squares_until: share of the iterations, at the start, in which the loss has squares alone; with L1 the flare would
    vanish there, since most pixels have none. squares_weight: of the squares. l1_weight: of L1 and SSIM, which join
    them later. excess_weight: factor on squares where the frame is brighter than the composite, relative to the rest:
    estimated plates more often contain flare than lack light.

    aligned: improve estimated plates by aligned neighbours (`plate_estimates`) at the start. refine_at: share of the
    iterations from which this is repeated, whenever the brightness is solved, with the fitted flare subtracted; 1
    repeats nothing. A flare that is too large makes the plates too dark, and grows by them.
    """

    squares_until: float = 0.5
    squares_weight: float = 5.0
    l1_weight: float = 1.0
    excess_weight: float = 3.0
    aligned: bool = True
    refine_at: float = 1.0


@dataclass(frozen=True)
class FitSettings:
    """All settings of a fit. width: largest working width in pixels; 0 keeps the frames' own size.

    ssim_share is 1 - lambda of the paper's loss. separate_until: share of the iterations, from the start, in which the
    flare is composited over the clean frames instead of the scene; 0 in the paper. holdout: a number N (every N-th view
    is held out; 0: none), a split file's name, or None (the capture's split.json, else every 8th). exposure: "measured"
    finds frames whose exposure differs from most, "fixed" takes all for equal. device: of scene, flare and frames in
    the iterations, see `core.gaussians.device`. coarse_to_fine: sizes of the pictures in modes with exact clean frames;
    the others, and a scene that starts from a PLY, use full size throughout.

    white: scene-linear light at which frames are clipped; None where the frames have not been checked for more than 1,
    which only float frames can hold, and in runs of versions that clipped all at 1.
    """

    mode: Mode = "default"
    blend: Blend = "over"
    iterations: int = 30000
    width: int = 0
    seed: int = 0
    ssim_share: float = 0.1
    separate_until: float = 0.0
    holdout: str | int | None = None
    white: float | None = None
    exposure: Literal["measured", "fixed"] = "measured"
    kernels: Kernels = "auto"
    device: Device = "auto"
    checkpoint_every_s: float = 60.0
    preview_every: int = 1000
    coarse_to_fine: CoarseToFineSettings = field(default_factory=CoarseToFineSettings)
    flare: FlareSettings = field(default_factory=FlareSettings)
    scene: SceneSettings = field(default_factory=SceneSettings)
    split: SplitSettings = field(default_factory=SplitSettings)
    brightness: BrightnessSettings = field(default_factory=BrightnessSettings)
    plates: PlateSettings = field(default_factory=PlateSettings)

    @property
    def uses_plates(self) -> bool:
        """Return whether the scene is one plate per frame."""
        return self.scene.kind == "plates"

    @property
    def supervised(self) -> bool:
        """Return whether clean frames that are taken for exact supervise the scene."""
        return self.mode in ("default", "2d")

    @property
    def uses_parallax(self) -> bool:
        """Return whether scene and flare are separated by parallax."""
        return self.mode in PARALLAX_MODES

    @property
    def needs_clean_frames(self) -> bool:
        """Return whether the fit needs clean frames, exact or estimated."""
        return self.supervised or self.mode == "estimated"

    @property
    def display_white(self) -> float:
        """`white` as a display value; 1 where it is not known."""
        return 1.0 if self.white is None else float(srgb_from_linear(np.array(self.white)))

    def validated(self) -> FitSettings:
        """Return these settings unchanged. Raises SettingsError if a number is outside its `BOUNDS`, or values
        contradict each other."""
        for name, bounds in BOUNDS.items():
            value = attrgetter(name)(self)
            if isinstance(value, int | float) and not bounds.contains(value):
                raise SettingsError(f"The settings cannot be used: {name} must lie {bounds}.")
        checks = (
            (_is_valid_holdout(self.holdout), "holdout must be a number of a few digits or the name of a split file"),
            (not self.scene.frozen or bool(self.scene.start), "a frozen scene needs a PLY to start from"),
            (self.mode != "2d" or not self.flare.form.line, "mode 2d needs a form without the line"),
            (self.flare.form.is_consistent, "a form with arcs needs rings, and ellipses instead of solid Gaussians"),
        )
        for is_met, requirement in checks:
            if not is_met:
                raise SettingsError(f"The settings cannot be used: {requirement}.")
        return self


def _is_valid_holdout(holdout: str | int | None) -> bool:
    """Return whether `holdout` is no text of too many digits: text of digits is taken for a number."""
    if not isinstance(holdout, str) or not holdout.strip().lstrip("+-").isdigit():
        return True
    return re.fullmatch(rf"[+-]?\d{{1,{MAX_INT_DIGITS}}}", holdout.strip()) is not None


# ---- bounds of the numbers ------------------------------------------------------------------------

_MAX_INT = 2**63 - 1  # TOML has no greater whole numbers
_MAX_FLOAT = 1e30  # its products still fit float32
_FROM_0, _FROM_1 = Bounds(0, _MAX_INT), Bounds(1, _MAX_INT)
_UNIT = Bounds(0, 1)
_OPEN_UNIT = Bounds(0, 1, exclusive_minimum=True, exclusive_maximum=True)  # has a logit
_NON_NEGATIVE = Bounds(0, _MAX_FLOAT)  # a weight or a rate; 0 switches its term or its parameter's steps off
_POSITIVE = Bounds(0, _MAX_FLOAT, exclusive_minimum=True)  # a rate that decays by a ratio, or that Adam refuses at 0

BOUNDS: dict[str, Bounds] = {
    "iterations": Bounds(1, 10**9), "width": _FROM_0, "seed": Bounds(0, MAX_SEED), "ssim_share": _UNIT,
    "separate_until": _UNIT, "holdout": _FROM_0, "white": Bounds(1, 65504), "checkpoint_every_s": _NON_NEGATIVE,
    "preview_every": _FROM_1,

    "coarse_to_fine.scene_width": _FROM_0, "coarse_to_fine.scene_until": _UNIT,
    "coarse_to_fine.flare_width": _FROM_0, "coarse_to_fine.flare_until": _UNIT,

    "flare.count": Bounds(1, MAX_GAUSSIANS), "flare.opacity": _OPEN_UNIT,
    "flare.scene_only_until": Bounds(0, 1, exclusive_maximum=True), "flare.correction_weight": _NON_NEGATIVE,
    **{f"flare.form.{name}": bounds for name, bounds in FORM_BOUNDS.items()},
    "flare.density.start": _FROM_0, "flare.density.stop": _FROM_0, "flare.density.every": _FROM_1,
    "flare.density.clone_above": _UNIT, "flare.density.clone_ratio": _UNIT, "flare.density.noise": _NON_NEGATIVE,
    "flare.density.prune_below": _UNIT, "flare.density.max_gaussians": Bounds(0, MAX_GAUSSIANS),
    **dict.fromkeys((f"flare.rates.{name}" for name in (
        "network", "features", "opacity", "scale", "rotation", "offset", "ring", "arc", "latent")), _NON_NEGATIVE),
    **dict.fromkeys((f"flare.rates.{name}" for name in ("brightness", "grids", "position", "position_final")),
                    _POSITIVE),
    "flare.rates.final_ratio": Bounds(0, 1, exclusive_minimum=True),
    "flare.visibility.radius": Bounds(1e-6, 1), "flare.visibility.margin": _UNIT,
    "flare.visibility.pixels": Bounds(1, 1024),

    "scene.sh_every": _FROM_1, "scene.reorder_every": _FROM_1,
    "scene.classic.start": _FROM_0, "scene.classic.stop": _FROM_0, "scene.classic.every": _FROM_1,
    "scene.classic.gradient": _NON_NEGATIVE, "scene.classic.small": _NON_NEGATIVE, "scene.classic.large": _POSITIVE,
    "scene.classic.faint": Bounds(0, 1, exclusive_maximum=True), "scene.classic.reset_every": _FROM_1,
    "scene.classic.reset_to": _OPEN_UNIT, "scene.classic.cap": _FROM_1,
    "scene.mcmc.cap": _FROM_1, "scene.mcmc.start": _FROM_0, "scene.mcmc.stop": _FROM_0, "scene.mcmc.every": _FROM_1,
    "scene.mcmc.growth": Bounds(1, 100),
    "scene.mcmc.faint": Bounds(0, 1, exclusive_maximum=True), "scene.mcmc.noise": _NON_NEGATIVE,
    "scene.mcmc.opacity_weight": _NON_NEGATIVE, "scene.mcmc.scale_weight": _NON_NEGATIVE,
    **dict.fromkeys((f"scene.rates.{name}" for name in (
        "features", "features_rest", "opacity", "scale", "rotation")), _NON_NEGATIVE),
    **dict.fromkeys(("scene.rates.position", "scene.rates.position_final"), _POSITIVE),

    "split.scene_only_rounds": _FROM_0, "split.few_views": _FROM_0, "split.excess_weight": _UNIT,
    "split.light_radius": Bounds(1e-6, 1e6),
    **dict.fromkeys((f"split.{name}" for name in (
        "converged_ratio", "diverged_ratio", "far_flare_penalty", "scene_weight", "near_scene_penalty")),
        _NON_NEGATIVE),
    "split.opacity_floor": Bounds(0, 1, exclusive_maximum=True),
    "split.low_sh_until": _UNIT, "split.final_near_share": _UNIT, "split.sh_degree": Bounds(0, 3),

    "brightness.roughness_weight": _NON_NEGATIVE, "brightness.prior_weight": _NON_NEGATIVE,
    "brightness.solve_every": Bounds(0, 1, exclusive_minimum=True), "plates.squares_until": _UNIT,
    "plates.squares_weight": _NON_NEGATIVE, "plates.l1_weight": _NON_NEGATIVE, "plates.excess_weight": _POSITIVE,
    "plates.refine_at": _UNIT,
}
"""Range of each numeric setting, by its dotted name; some may be None or text instead."""


SEPARATE_UNTIL = 0.7
"""`separate_until` of our form."""
COARSE_TO_FINE = CoarseToFineSettings(scene_width=240, flare_width=120)
"""`coarse_to_fine` of `standard`."""
STANDARD_SCENE_RATES = {"features": 5e-3, "features_rest": 5e-3 / 20, "scale": 0.02}
"""Learning rates of the scene in `standard`: above the paper's, for a fit a fifteenth as long."""
SCENE_ONLY_UNTIL = 0.08
"""`flare.scene_only_until` of our form."""
CORRECTION_WEIGHT = 0.1
"""`flare.correction_weight` of our form: far below the gradients by which frames with a flare determine delta_l, far
above the noise of frames without one."""
PLATES_BASE = 2
"""Largest resolution of the coarsest grid in a fit over plates."""
FINAL_RATIO = 0.05
"""`flare.rates.final_ratio` of the short presets."""


def preset(name: Preset, *, model: Model | None = None, mode: Mode = "default",
           blend: Blend | None = None, iterations: int | None = None) -> FitSettings:
    """Return the settings of a preset, with every schedule scaled to the number of iterations.

    `paper` has the paper's form and figures, 30,000 iterations. `draft`, `standard` and `high` have our form, shorter
    schedules and higher rates. All are longer in the modes `estimated` and `split`, unless `iterations` is given.
    model, blend: another form and blend than the preset's: "paper" blends "over" in display space, "ours" adds in
    linear light and is hidden by the scene. Raises SettingsError for an unknown name or a number out of bounds.
    """
    if name not in ITERATIONS:
        raise SettingsError(f"There is no preset {name!r}; choose {', '.join(ITERATIONS)}.")
    length = iterations
    if length is None:
        length = (PARALLAX_ITERATIONS if mode in PARALLAX_MODES else ITERATIONS)[name]
    model = model or ("paper" if name == "paper" else "ours")
    form = replace(PAPER if model == "paper" else OURS, line=mode != "2d")
    if blend is None:
        blend = "over" if model == "paper" else "add"
    flare = FlareSettings(form=form)
    if model == "ours":
        flare = replace(flare, occlusion=True, scene_only_until=SCENE_ONLY_UNTIL, snap_lights=True,
                        correction_weight=CORRECTION_WEIGHT)
    # Validated before schedules are computed from the length.
    settings = FitSettings(mode=mode, blend=blend, iterations=length, flare=flare,
                           separate_until=SEPARATE_UNTIL if model == "ours" else 0.0).validated()
    if name == "paper":
        settings = _scale_schedule(settings, length / ITERATIONS["paper"])
    else:
        count, max_gaussians = {"draft": (300, 40_000), "standard": (500, 60_000), "high": (700, 200_000)}[name]
        settings = _shorten_schedule(settings, count, max_gaussians)
    if name == "standard" and mode not in PARALLAX_MODES:
        rates = replace(settings.scene.rates, **STANDARD_SCENE_RATES)
        settings = replace(settings, coarse_to_fine=COARSE_TO_FINE, scene=replace(settings.scene, rates=rates))
    if blend == "add":
        # Light that adds is fainter than what covers: a ghost is a hundredth of white, not a tenth of opaque.
        density = replace(settings.flare.density, clone_above=5e-4, prune_below=2e-4)
        settings = replace(settings, flare=replace(settings.flare, opacity=0.01, density=density))
    return settings.validated()


def adapt_to_plates(settings: FitSettings) -> FitSettings:
    """Return settings changed for a scene of plates: nothing in it hides lights, and no scene is fitted before the
    flare.

    A shot shows its lights at fewer places than a capture, so the grids are coarser.
    """
    length, density = settings.iterations, settings.flare.density
    density = replace(density, start=max(round(length * 0.1), density.every))
    form = replace(settings.flare.form, base=min(settings.flare.form.base, PLATES_BASE))
    flare = replace(settings.flare, form=form, occlusion=False, snap_lights=False, scene_only_until=0.0,
                    density=density)
    return replace(settings, scene=replace(settings.scene, kind="plates"), flare=flare)


def adapt_to_trained_scene(settings: FitSettings) -> FitSettings:
    """Return settings whose learning rates keep the detail of a scene that was trained before."""
    rates = replace(settings.scene.rates, **{name: getattr(SceneRates(), name) for name in STANDARD_SCENE_RATES})
    return replace(settings, scene=replace(settings.scene, rates=rates))


def _scale_schedule(settings: FitSettings, factor: float) -> FitSettings:
    """Scale every schedule by a factor, so that events keep their share of a fit that is longer by that factor."""
    def scaled(iteration: int) -> int:
        return max(round(iteration * factor), 1)

    density, scene = settings.flare.density, settings.scene
    density = replace(density, start=scaled(density.start), stop=scaled(density.stop), every=scaled(density.every))
    classic, mcmc = scene.classic, scene.mcmc
    classic = replace(classic, start=scaled(classic.start), stop=scaled(classic.stop), every=scaled(classic.every),
                      reset_every=scaled(classic.reset_every))
    mcmc = replace(mcmc, start=scaled(mcmc.start), stop=scaled(mcmc.stop), every=scaled(mcmc.every))
    return replace(settings, flare=replace(settings.flare, density=density),
                   scene=replace(scene, classic=classic, mcmc=mcmc, sh_every=scaled(scene.sh_every)))


def _shorten_schedule(settings: FitSettings, count: int, max_gaussians: int) -> FitSettings:
    """Return the settings with the schedule and learning rates of a short fit.

    Density control and harmonics begin, end and repeat at fixed shares of `iterations`; rates are above the paper's. A
    light starts with `count` Gaussians. If the scene, with at most `max_gaussians`, is first fitted alone, the flare's
    density changes later."""
    length = settings.iterations
    every = max(round(length / 40), 20)
    scene_only_until = settings.flare.scene_only_until
    density = replace(settings.flare.density, start=max(round(length * (scene_only_until + 0.1)), every),
                      stop=round(length * (scene_only_until * 0.6 + 0.6)), every=every, clone_ratio=0.1)
    rates = replace(settings.flare.rates, network=1e-3, grids=5e-3, position=1.6e-3, position_final=1.6e-5,
                    features=1e-2, scale=0.02, rotation=5e-3, ring=2e-2, arc=2e-2, final_ratio=FINAL_RATIO)
    classic = replace(settings.scene.classic, start=round(length * 0.05), stop=round(length * 0.6),
                      every=max(round(length / 50), 20), reset_every=10 * length, cap=max_gaussians)  # never resets
    mcmc = replace(settings.scene.mcmc, start=classic.start, stop=round(length * 0.8), every=classic.every,
                   cap=max_gaussians)
    scene = replace(settings.scene, classic=classic, mcmc=mcmc, sh_every=max(round(length / 6), 1),
                    rates=replace(settings.scene.rates, position=3.2e-4, position_final=3.2e-6))
    flare = replace(settings.flare, count=count, density=density, rates=rates)
    return replace(settings, preview_every=max(length // 8, 1), scene=scene, flare=flare)
