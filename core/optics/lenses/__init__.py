# SPDX-License-Identifier: GPL-3.0-or-later
"""The lens prescriptions that come with the program: files beside this module, and those of `prescription`."""
from __future__ import annotations

from pathlib import Path

from ...errors import SettingsError
from ..prescription import Prescription, built_in_lenses, read_prescription

LENS_FOLDER = Path(__file__).parent


def lens_names() -> list[str]:
    """Return the names of the lenses that come with the program: their patents, without spaces."""
    return sorted([path.stem for path in LENS_FOLDER.glob("*.lens")]
                  + [lens.name.replace(" ", "") for lens in built_in_lenses()])


def find_lens(name: str) -> Prescription:
    """Return a lens by its name in `lens_names`, or read the file of that name. Raises SettingsError."""
    compact = name.replace(" ", "")
    if compact in lens_names():
        built_in = {lens.name.replace(" ", ""): lens for lens in built_in_lenses()}
        return built_in[compact] if compact in built_in else read_prescription(LENS_FOLDER / f"{compact}.lens")
    if not Path(name).is_file():
        raise SettingsError(f"There is no lens {name!r}; give a .lens file, or one of {', '.join(lens_names())}.")
    return read_prescription(name)
