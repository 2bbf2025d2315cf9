# SPDX-License-Identifier: GPL-3.0-or-later
"""The config.toml of a run: every setting of its fit, written by `run` and read again by all who open the run."""
from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from ..errors import RunError, SettingsError
from ..system.files import write_text
from ..system.progress import Progress
from ..system.reading import MAX_TOML_BYTES, UTF8_SIG, parse_toml, read_text
from ..typed import parse_table
from .overrides import current_names
from .settings import FitSettings


def write_config(path: Path, settings: FitSettings) -> None:
    """Write every setting, resolved, as TOML."""
    lines: list[str] = []
    _write_table(lines, [], settings)
    write_text(path, "\n".join(lines).lstrip("\n") + "\n")


def _write_table(lines: list[str], keys: list[str], table: Any) -> None:
    """Append a dataclass to `lines` as a TOML table, its plain values before its nested tables.

    keys: parts of the table's dotted name; empty for the outermost table.
    """
    plain = [entry for entry in fields(table) if not is_dataclass(getattr(table, entry.name))]
    if keys:
        lines += ["", f"[{'.'.join(keys)}]"]
    for entry in plain:
        value = getattr(table, entry.name)
        if value is not None:  # TOML has no null; what is absent has its default, None
            lines.append(f"{entry.name} = {_to_toml(value)}")
    for entry in fields(table):
        if entry not in plain:
            _write_table(lines, [*keys, entry.name], getattr(table, entry.name))


def _to_toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # A JSON string is a TOML string, except that TOML also escapes U+007F and has no surrogate pairs.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def read_config(path: Path, progress: Progress | None = None) -> FitSettings:
    """Read the settings of a run; with `progress`, settings under old names are reported to the user in one line.

    Raises RunError if the file is missing, damaged, or has unknown names.
    """
    try:
        data = parse_toml(read_text(path, MAX_TOML_BYTES, UTF8_SIG))
        if "mode" not in data:  # a truncated file would otherwise pass for one with default settings
            raise ValueError("it has no mode")
        values, renamed = current_names(_flatten(data))
        values.pop("split.excess_unfound", None)  # a setting that no longer exists
        values.setdefault("split.few_views", 0)  # runs without it are resumed as they were begun
        settings: FitSettings = parse_table(FitSettings, _nest(values)).validated()
    except OSError as problem:
        raise RunError(f"{path} cannot be read ({problem.strerror}); name the folder of a run.") from problem
    except (ValueError, TypeError, SettingsError) as problem:
        raise RunError(f"{path} is not a fit's configuration ({problem}); start the fit anew.") from problem
    if renamed and progress is not None:
        names = ", ".join(f"{old} is now {new}" for old, new in renamed.items())
        progress.say(f"{path} has old names of settings, which still work in this version: {names}.")
    return settings


def _flatten(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested tables by dotted name; an empty table is kept as a value."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        flat |= _flatten(value, f"{prefix}{name}.") if isinstance(value, dict) and value else {prefix + name: value}
    return flat


def _nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested tables from values by dotted name. Raises ValueError if a name is both a value and a table."""
    tables: dict[str, Any] = {}
    for name, value in flat.items():
        *keys, last = name.split(".")
        table = tables
        for key in keys:
            table = table.setdefault(key, {})
            if not isinstance(table, dict):
                raise ValueError(f"{key} is both a value and a table")
        table[last] = value
    return tables
