# SPDX-License-Identifier: GPL-3.0-or-later
"""Every setting of a fit, its presets, and the config.toml that a run keeps.

Defaults are the paper's (appendix "Flare representation"); the presets change length and rates so that a
fit ends in minutes on two CPU cores.
"""
from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..choices import BY_PARALLAX, ITERATIONS, LONGER_BY_PARALLAX, Blend, Kernels, Mode, Model, Preset
from ..colour.srgb import srgb_from_linear
from ..errors import RunError, SettingsError
from ..flare.density import DensitySettings
from ..flare.model import OURS, PAPER
from ..flare.visibility import VisibilitySettings
from ..gaussians.densification import ClassicSettings, McmcSettings
from ..look.look import FORM_BOUNDS, MOST_GAUSSIANS, FlareForm
from ..system.files import WRITTEN_BY_HAND, write_text
from ..typed import MOST_SEED, WHOLE_DIGITS, Bounds, field_of, table_of


@dataclass(frozen=True)
class FlareRates:
    """Adam's learning rates for the flare; `position` decays exponentially to `position_final`.

    settled: the share of the others that is left at the end, to which they fall exponentially from the middle on.
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
    settled: float = 1.0


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
    """The flare: its form, the Gaussians that a light starts with, density control, rates, occlusion.

    `detection` False puts every light at the centroid of the points plus uniform noise (ablation).
    `occlusion` scales each flare by the share of its light that the scene leaves visible (`visibility`).
    `begin`: share of the iterations in which the scene is fitted alone first, where it has flare-free frames: a
    flare that is fitted before the scene hides its light learns to vanish by itself, and in the views beside, too.
    `snap`: lights that were given beside their flares are put where those are (`lights.snap`), where flare-free frames
    show them.
    `steady`: weight of the squared delta_l in the loss. Where a light is hidden nothing else holds delta_l, and Adam
    makes of the faintest gradient a full step: it wanders out of the frame and takes the views beside along.
    """

    form: FlareForm = PAPER
    count: int = 200
    opacity: float = 0.05
    density: DensitySettings = field(default_factory=DensitySettings)
    rates: FlareRates = field(default_factory=FlareRates)
    detection: bool = True
    occlusion: bool = False
    begin: float = 0.0
    snap: bool = False
    steady: float = 0.0
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)

    @property
    def occluded_by_scene(self) -> VisibilitySettings | None:
        """How the scene hides lights; None where it does not."""
        return self.visibility if self.occlusion else None


@dataclass(frozen=True)
class SceneSettings:
    """The scene: 3DGS from the capture's points, with one of two strategies of densification.

    `sh_every`: iterations between degrees of spherical harmonics. `reorder_every`: iterations between sorts
    along the Morton curve, which keeps neighbours together in memory. `start`: a 3DGS PLY in the capture's world
    to begin with, instead of the points; `frozen`: it stays as it is, and only the flare is fitted.
    """

    start: str = ""
    frozen: bool = False
    strategy: Literal["classic", "mcmc"] = "classic"
    classic: ClassicSettings = field(default_factory=ClassicSettings)
    mcmc: McmcSettings = field(default_factory=McmcSettings)
    rates: SceneRates = field(default_factory=SceneRates)
    sh_every: int = 1000
    reorder_every: int = 500


@dataclass(frozen=True)
class SplitSettings:
    """Modes `split` and `estimated`: how a scene is told from flare without exact flare-free frames.

    A flare adds light, and its place in the picture changes from view to view as no part of the scene's does. So the
    scene is fitted alone first, until every view was looked at `rounds` times (a third of the iterations at most), to
    what the frames agree on from below: where a frame is brighter than the scene, that counts for `excess` of what it
    counts where it is darker. Longer, and it takes up the glow about the lights; shorter, and the flare takes walls.
    From then on both are fitted to the frames, the scene besides from below with `weight`, in the end only where it is
    brighter than a frame; and its light costs `glow` near where a light is seen, half of that at `reach` of the width
    beside: what could be either's is the flare's. `sh_degree`: of the scene's colours for the share `plain` of the
    iterations, since they could follow a flare if they were free to change with the direction. `sky`: points far away
    to begin with.
    When the flare is due it is asked whether the scene has been found: flares only add, but errors go both ways. Where
    the square of what the frames have more than the scene is less than `found` times that of what they have less, the
    flare's light costs `haze` away from the lights: what could be either's is the flare's near them alone.
    Mode `estimated`: from the moment the flare is due to the middle of the fit the scene is drawn to the estimated
    flare-free frames as well, less and less: what they have left of the flare goes again by parallax. Of what they say
    that the flare adds nothing costs `haze` just below `found`, all at `lost` times and less.
    """

    rounds: int = 2
    excess: float = 0.25
    weight: float = 0.05
    glow: float = 0.05
    reach: float = 0.05
    sh_degree: int = 1
    plain: float = 0.7
    sky: bool = True
    found: float = 26.0
    lost: float = 18.0
    haze: float = 0.1


@dataclass(frozen=True)
class FitSettings:
    """A whole fit. `width`: the working width in pixels at most; 0 keeps the frames' own size.

    ssim_share is 1 - lambda of the paper's loss. `apart`: share of the iterations at the beginning in which the
    flare is put before the flare-free frames instead of the scene; 0 in the paper. `holdout`: a number N (every N-th
    view is held out; 0: none), a split file's name, or None (the capture's split.json, else every 8th).
    exposure: "found" looks for frames that are exposed otherwise than most, "fixed" takes all for alike.
    `white`: scene-linear light at which frames are clipped; None where a fit has yet to look whether its frames hold
    more than 1, which only float frames can, and in runs of versions that clipped all there.
    """

    mode: Mode = "default"
    blend: Blend = "over"
    iterations: int = 30000
    width: int = 0
    seed: int = 0
    ssim_share: float = 0.1
    apart: float = 0.0
    holdout: str | int | None = None
    white: float | None = None
    exposure: Literal["found", "fixed"] = "found"
    kernels: Kernels = "auto"
    checkpoint_every_s: float = 60.0
    preview_every: int = 1000
    flare: FlareSettings = field(default_factory=FlareSettings)
    scene: SceneSettings = field(default_factory=SceneSettings)
    split: SplitSettings = field(default_factory=SplitSettings)

    @property
    def supervised(self) -> bool:
        """Whether the scene is taught by flare-free frames that are taken for exact."""
        return self.mode in ("default", "2d")

    @property
    def by_parallax(self) -> bool:
        """Whether scene and flare are told apart by parallax."""
        return self.mode in BY_PARALLAX

    @property
    def looks_at_removed(self) -> bool:
        """Whether the fit needs flare-free frames, exact or estimated."""
        return self.supervised or self.mode == "estimated"

    @property
    def display_white(self) -> float:
        """`white` as a display value; 1 where it is not known."""
        return 1.0 if self.white is None else float(srgb_from_linear(np.array(self.white)))

    def checked(self) -> FitSettings:
        """Itself; raises SettingsError where a number lies outside of its `BOUNDS`, or values do not go together."""
        for name, bounds in BOUNDS.items():
            value = attrgetter(name)(self)
            if isinstance(value, int | float) and not bounds.hold(value):
                raise SettingsError(f"The settings cannot be used: {name} must lie {bounds}.")
        checks = (
            (_is_holdout(self.holdout), "holdout must be a number of a few digits or the name of a split file"),
            (not self.scene.frozen or bool(self.scene.start), "a frozen scene needs a PLY to start from"),
            (self.mode != "2d" or not self.flare.form.line, "mode 2d needs a form without the line"),
            (self.flare.form.consistent, "a form with arcs needs rings, and ellipses instead of solid Gaussians"),
        )
        for good, sentence in checks:
            if not good:
                raise SettingsError(f"The settings cannot be used: {sentence}.")
        return self


def _is_holdout(holdout: str | int | None) -> bool:
    """Whether text that reads as a number is one that can be counted to: `Capture.split` takes it for that."""
    if not isinstance(holdout, str) or not holdout.strip().lstrip("+-").isdigit():
        return True
    return re.fullmatch(rf"[+-]?\d{{1,{WHOLE_DIGITS}}}", holdout.strip()) is not None


# ---- what the numbers may be ----------------------------------------------------------------------

_COUNTED = 2**63 - 1  # TOML has no greater whole numbers
_LARGE = 1e30  # what float32 still computes with
_FROM_0, _FROM_1 = Bounds(0, _COUNTED), Bounds(1, _COUNTED)
_SHARE = Bounds(0, 1)
_BETWEEN = Bounds(0, 1, above=True, below=True)  # has a logit
_AMOUNT = Bounds(0, _LARGE)  # a weight, or a rate: at 0 what it is of stays as it is
_POSITIVE = Bounds(0, _LARGE, above=True)  # a rate that falls by a ratio, or is refused at 0 by its optimiser

BOUNDS: dict[str, Bounds] = {
    "iterations": Bounds(1, 10**9), "width": _FROM_0, "seed": Bounds(0, MOST_SEED), "ssim_share": _SHARE,
    "apart": _SHARE, "holdout": _FROM_0, "white": Bounds(1, 65504), "checkpoint_every_s": _AMOUNT,
    "preview_every": _FROM_1,

    "flare.count": Bounds(1, MOST_GAUSSIANS), "flare.opacity": _BETWEEN, "flare.begin": Bounds(0, 1, below=True),
    "flare.steady": _AMOUNT,
    **{f"flare.form.{name}": bounds for name, bounds in FORM_BOUNDS.items()},
    "flare.density.start": _FROM_0, "flare.density.stop": _FROM_0, "flare.density.every": _FROM_1,
    "flare.density.clone_above": _SHARE, "flare.density.clone_ratio": _SHARE, "flare.density.noise": _AMOUNT,
    "flare.density.prune_below": _SHARE, "flare.density.most": Bounds(0, MOST_GAUSSIANS),
    **dict.fromkeys((f"flare.rates.{name}" for name in (
        "network", "features", "opacity", "scale", "rotation", "offset", "ring", "arc", "latent")), _AMOUNT),
    **dict.fromkeys(("flare.rates.grids", "flare.rates.position", "flare.rates.position_final"), _POSITIVE),
    "flare.rates.settled": Bounds(0, 1, above=True),
    "flare.visibility.radius": Bounds(1e-6, 1), "flare.visibility.margin": _SHARE,
    "flare.visibility.pixels": Bounds(1, 1024),

    "scene.sh_every": _FROM_1, "scene.reorder_every": _FROM_1,
    "scene.classic.start": _FROM_0, "scene.classic.stop": _FROM_0, "scene.classic.every": _FROM_1,
    "scene.classic.gradient": _AMOUNT, "scene.classic.small": _AMOUNT, "scene.classic.large": _POSITIVE,
    "scene.classic.faint": Bounds(0, 1, below=True), "scene.classic.reset_every": _FROM_1,
    "scene.classic.reset_to": _BETWEEN, "scene.classic.cap": _FROM_1,
    "scene.mcmc.cap": _FROM_1, "scene.mcmc.start": _FROM_0, "scene.mcmc.stop": _FROM_0, "scene.mcmc.every": _FROM_1,
    "scene.mcmc.growth": Bounds(1, 100), "scene.mcmc.faint": Bounds(0, 1, below=True), "scene.mcmc.noise": _AMOUNT,
    "scene.mcmc.opacity_weight": _AMOUNT, "scene.mcmc.scale_weight": _AMOUNT,
    **dict.fromkeys((f"scene.rates.{name}" for name in (
        "features", "features_rest", "opacity", "scale", "rotation")), _AMOUNT),
    **dict.fromkeys(("scene.rates.position", "scene.rates.position_final"), _POSITIVE),

    "split.rounds": _FROM_0, "split.excess": _SHARE, "split.found": _AMOUNT, "split.lost": _AMOUNT,
    "split.haze": _AMOUNT, "split.weight": _AMOUNT, "split.glow": _AMOUNT, "split.reach": Bounds(1e-6, 1e6),
    "split.plain": _SHARE, "split.sh_degree": Bounds(0, 3),
}
"""What each number among the settings may be, by its dotted name; some may be None or text instead."""


APART = 0.7
"""Share of the iterations in which our form fits scene and flare apart."""
BEGIN = 0.08
"""Share of the iterations in which our form fits the scene alone."""
STEADY = 0.1
"""Far less than what the picture holds delta_l with where there is a flare, far more than what pulls it elsewhere."""
SETTLED = 0.05
"""Share of the flare's rates that is left at the end of a short schedule."""


def preset(name: Preset, *, model: Model | None = None, mode: Mode = "default",
           blend: Blend | None = None, iterations: int | None = None) -> FitSettings:
    """Settings by name, with every schedule stretched to the number of iterations.

    paper     the paper's form and figures, 30,000 iterations
    draft, standard, high: our form, shorter schedules with higher rates (README has times and figures)

    All are a fifth longer in the modes `estimated` and `split`, unless `iterations` says how long. `model` and `blend`
    choose another form: the paper's covers in display space, ours adds in linear light and is hidden by the scene.
    """
    if name not in ITERATIONS:
        raise SettingsError(f"There is no preset {name!r}; choose {', '.join(ITERATIONS)}.")
    length = iterations
    if length is None:
        length = round(ITERATIONS[name] * (LONGER_BY_PARALLAX if mode in BY_PARALLAX else 1))
    model = model or ("paper" if name == "paper" else "ours")
    form = replace(PAPER if model == "paper" else OURS, line=mode != "2d")
    if blend is None:
        blend = "over" if model == "paper" else "add"
    flare = FlareSettings(form=form)
    if model == "ours":
        flare = replace(flare, occlusion=True, begin=BEGIN, snap=True, steady=STEADY)
    settings = FitSettings(mode=mode, blend=blend, iterations=length, flare=flare,
                           apart=APART if model == "ours" else 0.0).checked()  # schedules are computed from its length
    if name == "paper":
        settings = _stretched(settings, length / ITERATIONS["paper"])
    else:
        count, most = {"draft": (300, 40_000), "standard": (500, 60_000), "high": (700, 200_000)}[name]
        settings = _shortened(settings, count, most)
    if blend == "add":
        # Light that adds is fainter than what covers: a ghost is a hundredth of white, not a tenth of opaque.
        density = replace(settings.flare.density, clone_above=5e-4, prune_below=2e-4)
        settings = replace(settings, flare=replace(settings.flare, opacity=0.01, density=density))
    return settings.checked()


def _stretched(settings: FitSettings, times: float) -> FitSettings:
    """The same events at the same shares of a fit that is so many times as long."""
    def at(iteration: int) -> int:
        return max(round(iteration * times), 1)

    density, scene = settings.flare.density, settings.scene
    density = replace(density, start=at(density.start), stop=at(density.stop), every=at(density.every))
    classic, mcmc = scene.classic, scene.mcmc
    classic = replace(classic, start=at(classic.start), stop=at(classic.stop), every=at(classic.every),
                      reset_every=at(classic.reset_every))
    mcmc = replace(mcmc, start=at(mcmc.start), stop=at(mcmc.stop), every=at(mcmc.every))
    return replace(settings, flare=replace(settings.flare, density=density),
                   scene=replace(scene, classic=classic, mcmc=mcmc, sh_every=at(scene.sh_every)))


def _shortened(settings: FitSettings, count: int, most: int) -> FitSettings:
    """A schedule for a short fit: the same events at the same shares of the whole, and higher rates.

    A light starts with `count` Gaussians; the scene has at most `most`.
    """
    length = settings.iterations
    every = max(round(length / 40), 20)
    begin = settings.flare.begin
    density = replace(settings.flare.density, start=max(round(length * (begin + 0.1)), every),
                      stop=round(length * (begin * 0.6 + 0.6)), every=every, clone_ratio=0.1)
    rates = replace(settings.flare.rates, network=1e-3, grids=5e-3, position=1.6e-3, position_final=1.6e-5,
                    features=1e-2, scale=0.02, rotation=5e-3, ring=2e-2, arc=2e-2, settled=SETTLED)
    classic = replace(settings.scene.classic, start=round(length * 0.05), stop=round(length * 0.6),
                      every=max(round(length / 50), 20), reset_every=10 * length, cap=most)
    mcmc = replace(settings.scene.mcmc, start=classic.start, stop=round(length * 0.8), every=classic.every, cap=most)
    scene = replace(settings.scene, classic=classic, mcmc=mcmc, sh_every=max(round(length / 6), 1),
                    rates=replace(settings.scene.rates, position=3.2e-4, position_final=3.2e-6))
    flare = replace(settings.flare, count=count, density=density, rates=rates)
    return replace(settings, preview_every=max(length // 8, 1), scene=scene, flare=flare)


# ---- config.toml ----------------------------------------------------------------------------------


def write_config(path: Path, settings: FitSettings) -> None:
    """Every setting, resolved, as TOML."""
    lines: list[str] = []
    _write_table(lines, [], settings)
    write_text(path, "\n".join(lines).lstrip("\n") + "\n")


def _write_table(lines: list[str], keys: list[str], table: Any) -> None:
    plain = [entry for entry in fields(table) if not is_dataclass(getattr(table, entry.name))]
    if keys:
        lines += ["", f"[{'.'.join(keys)}]"]
    for entry in plain:
        value = getattr(table, entry.name)
        if value is not None:  # TOML has no null; what is absent has its default, None
            lines.append(f"{entry.name} = {_toml(value)}")
    for entry in fields(table):
        if entry not in plain:
            _write_table(lines, [*keys, entry.name], getattr(table, entry.name))


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's text is TOML's, but that TOML wants one more control character escaped, and no pairs of surrogates.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def read_config(path: Path) -> FitSettings:
    """The settings of a run. Raises RunError where the file is missing, damaged, or holds unknown names."""
    try:
        data = tomllib.loads(path.read_text(encoding=WRITTEN_BY_HAND))
        if "mode" not in data:  # what is cut off would pass for settings that are left as they come
            raise ValueError("it has no mode")
        if isinstance(data.get("split"), dict):
            data["split"].pop("excess_unfound", None)  # of versions whose scenes went on alone when not found
        return table_of(FitSettings, data).checked()
    except OSError as problem:
        raise RunError(f"{path} cannot be read ({problem.strerror}); is this the folder of a run?") from problem
    except (ValueError, TypeError, SettingsError) as problem:
        raise RunError(f"{path} is not a fit's configuration ({problem}); start the fit anew.") from problem


def changed(settings: FitSettings, values: Mapping[str, Any]) -> FitSettings:
    """Settings with some replaced by dotted name, e.g. {"flare.rates.network": 1e-3}.

    Raises SettingsError for a name or a kind of value that does not exist.
    """
    for name, value in values.items():
        settings = _changed(settings, name.split("."), value, name)
    return settings.checked()


def _changed(table: Any, keys: list[str], value: Any, name: str) -> Any:
    known = {entry.name for entry in fields(table)}
    if keys[0] not in known:
        raise SettingsError(f"There is no setting {name!r}; here there are {', '.join(sorted(known))}.")
    now = getattr(table, keys[0])
    if len(keys) > 1:
        if not is_dataclass(now):
            raise SettingsError(f"There is no setting {name!r}; {keys[0]} has no parts.")
        return replace(table, **{keys[0]: _changed(now, keys[1:], value, name)})
    try:
        return replace(table, **{keys[0]: field_of(type(table), keys[0], value)})
    except (ValueError, TypeError) as problem:
        raise SettingsError(f"The setting {name!r} cannot be used so ({problem}).") from problem
