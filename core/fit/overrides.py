# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes single settings of a fit by their dotted names, and reads names and values of format 0.

`--set` of the commands and `config` use it.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from ..errors import SettingsError
from ..system.progress import Progress
from ..typed import parse_field
from .settings import FitSettings

RENAMED = {
    "apart": "separate_until", "flare.begin": "flare.scene_only_until", "flare.snap": "flare.snap_lights",
    "flare.steady": "flare.correction_weight", "flare.density.most": "flare.density.max_gaussians",
    "flare.rates.settled": "flare.rates.final_ratio", "split.rounds": "split.scene_only_rounds",
    "split.excess": "split.excess_weight", "split.weight": "split.scene_weight",
    "split.glow": "split.near_scene_penalty", "split.reach": "split.light_radius", "split.plain": "split.low_sh_until",
    "split.found": "split.converged_ratio", "split.lost": "split.diverged_ratio",
    "split.haze": "split.far_flare_penalty"}
"""The present name of each setting that was renamed, by its name in runs of format 0; both are read."""
RENAMED_VALUES = {("exposure", "found"): "measured"}
"""The present value of settings whose values were renamed, by (present name, value in runs of format 0)."""


def current_names(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return settings under their present dotted names and values, and the present name by each old name that was used.

    If a setting occurs under both its old and its present name, the later in `values` counts.
    """
    current, renamed = {}, {}
    for name, value in values.items():
        current_name = RENAMED.get(name, name)
        if current_name != name:
            renamed[name] = current_name
        has_old_value = isinstance(value, str) and (current_name, value) in RENAMED_VALUES
        current[current_name] = RENAMED_VALUES[current_name, value] if has_old_value else value
    return current, renamed


def override_settings(settings: FitSettings, values: Mapping[str, Any],
                      progress: Progress | None = None) -> FitSettings:
    """Return settings with some replaced by dotted name, such as {"flare.rates.network": 1e-3}.

    Old names work too; with `progress`, the user is told the present ones. Raises SettingsError for an unknown name or
    a value of the wrong kind.
    """
    values, renamed = current_names(values)
    for old, new in renamed.items():
        if progress is not None:
            progress.say(f"The setting {old} is now {new}; the old name still works in this version.")
    for name, value in values.items():
        settings = override_field(settings, name.split("."), value, name)
    return settings.validated()


def override_field(table: Any, keys: list[str], value: Any, name: str) -> Any:
    """Return a dataclass with the field at the path `keys` replaced. name: its dotted name, for error messages."""
    field_names = {entry.name for entry in fields(table)}
    if keys[0] not in field_names:
        raise SettingsError(f"There is no setting {name!r}; here there are {', '.join(sorted(field_names))}.")
    current = getattr(table, keys[0])
    if len(keys) > 1:
        if not is_dataclass(current):
            raise SettingsError(f"There is no setting {name!r}; {keys[0]} has no parts.")
        return replace(table, **{keys[0]: override_field(current, keys[1:], value, name)})
    try:
        return replace(table, **{keys[0]: parse_field(type(table), keys[0], value)})
    except (ValueError, TypeError) as problem:
        raise SettingsError(f"The setting {name!r} cannot be used so ({problem}).") from problem
