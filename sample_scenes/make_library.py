# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the library in the box: `python sample_scenes/make_library.py [NAME ...]`, and `--sheet FILE` for its sheet.

Each look is traced through a prescription that comes with the program and fitted (`core.fit.traced_flare`), one after
the other. It leaves NAME.flare, its thumbnail NAME.png, and its entry in looks.json; `--table` prints their errors.
A look that is there with the same settings is kept, so a second run resumes.
"""
from __future__ import annotations

import argparse
import hashlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.fit.traced_flare import default_notes, make_flare
from core.fit.traced_settings import TracedFlareSettings
from core.images.contact_sheet import add_label, side_by_side
from core.images.write import write_png
from core.look import read_look
from core.look.thumbnail import draw_thumbnail
from core.system.files import write_json
from core.system.progress import Progress
from sample_scenes.command import run_command

LIBRARY = Path(__file__).resolve().parents[1] / "flare_addon" / "library_looks"
INDEX = "looks.json"
LICENCE = "CC0-1.0"
THUMBNAIL_SIZE = 192
SHEET_SIZE, SHEET_COLUMNS = (320, 180), 4


@dataclass(frozen=True)
class LibraryLook:
    """A look of the library. text: one line for users. values: settings of `make-flare` by dotted name."""

    name: str
    text: str
    values: dict[str, Any]

    @property
    def settings(self) -> TracedFlareSettings:
        """The settings of the look."""
        return TracedFlareSettings().override({**SHORT_FIT, "ghosts.count": 14, **self.values})


def _streak(gain: float, turn: float, colour: tuple[float, float, float], *, length: float = 0.06, width: float = 0.004,
            power: float = 0.8, mirror: float = 0.0) -> dict[str, Any]:
    """Return the settings of one streak. turn: degrees from the x axis."""
    return {"gain": gain, "length": length, "power": power, "width": width, "turn": turn, "colour": colour,
            "mirror": mirror}


SHORT_FIT = {"tracing.positions": 48, "fit.iterations": 1200, "fit.gaussians": 800, "fit.max_gaussians": 1600}
"""Settings of the fits of looks whose light is mostly at the light itself."""
GHOST_FIT = {"tracing.positions": 96, "fit.iterations": 1500, "fit.gaussians": 1600, "fit.max_gaussians": 2000}
"""Settings of the fits of looks with strong ghosts."""
BARE = (0.0,)
"""Wavelength 0 stands for glass without a coating."""
WHITE, BLUE, AMBER = (1.0, 1.0, 1.0), (0.2, 0.45, 1.0), (1.0, 0.55, 0.2)

LOOKS = (
    LibraryLook("Clean Prime", "A modern prime, stopped down: a small starburst and few faint ghosts.",
                {"lens": "US3576360", "iris.f_number": 4.0, "iris.blades": 9, "ghosts.level": 0.006, "ghosts.count": 12,
                 "glow.gain": 0.1, "starburst.gain": 500.0}),
    LibraryLook("Anamorphic Blue", "A long blue streak and stretched ghosts, as in science fiction.",
                {"lens": "FR1233449", "squeeze": 1.8, "iris.f_number": 4.0, "iris.blades": 6, "iris.rotation": 0.0,
                 "ghosts.level": 0.008, "streaks": [_streak(1.6, 0, BLUE, length=0.05, power=0.7, mirror=0.1),
                                                    _streak(0.25, 0, BLUE, length=0.3, width=0.011, mirror=0.3)]}),
    LibraryLook("Old Uncoated Prime", "A lens of the 1930s without coatings: a warm veil over the whole frame.",
                {**GHOST_FIT, "lens": "US1998704", "glass.coating": BARE, "iris.blades": 12, "iris.roundness": 0.6,
                 "ghosts.level": 0.035, "glow.gain": 0.4, "glow.wide_gain": 0.07, "starburst.gain": 200.0,
                 "colour": (1.0, 0.86, 0.66)}),
    LibraryLook("Zoom with Large Ghosts", "Twenty-one surfaces: large soft ghosts on both sides of the light.",
                {**GHOST_FIT, "lens": "US3856386", "ghosts.level": 0.03, "ghosts.count": 30, "iris.blades": 6,
                 "glass.coating": (0.42, 0.66, 0.50, 0.58, 0.46, 0.70)}),
    LibraryLook("Star Filter", "A cross filter: four long thin rays.",
                {"lens": "GB850117", "ghosts.level": 0.004, "ghosts.count": 8, "starburst.gain": 60.0,
                 "streaks": [_streak(1.2, turn, WHITE, length=0.035, width=0.003, power=0.75) for turn in (45, 135)]}),
    LibraryLook("Vintage Ring", "A strong ring about the light, of a lens with turned grooves.",
                {"lens": "DE2205380", "ghosts.level": 0.01, "starburst.gain": 200.0,
                 "rings": [{"gain": 0.3, "radius": 0.25, "width": 0.05, "dispersion": 0.4}]}),
    LibraryLook("Telephone", "A small lens behind smeared plastic: a wide veil, a slanting streak, one violet ghost.",
                {**GHOST_FIT, "lens": "FR1066698", "focal_length": 5.0, "sensor": 6.4, "iris.blades": 24,
                 "iris.roundness": 1.0, "glass.coating": (0.54, 0.40, 0.55), "ghosts.level": 0.025, "glow.gain": 0.35,
                 "glow.wide_gain": 0.05, "starburst.gain": 150.0,
                 "streaks": [_streak(0.25, 70, WHITE, length=0.1, width=0.008)]}),
    LibraryLook("Dirty Window", "Dust and scratches: a grey veil, and rays in all directions.",
                {"lens": "GB850117", "iris.blades": 16, "iris.roundness": 0.9, "glass.dust": 500,
                 "glass.scratches": 60, "glass.seed": 7, "ghosts.level": 0.006, "ghosts.count": 8, "glow.gain": 0.45,
                 "glow.radius": 0.06, "glow.wide_gain": 0.15, "starburst.gain": 2500.0}),
    LibraryLook("Anamorphic Warm", "An amber streak and oval ghosts.",
                {"lens": "US4621909", "squeeze": 1.5, "iris.blades": 8, "iris.f_number": 4.0, "ghosts.level": 0.008,
                 "colour": (1.0, 0.8, 0.55),
                 "streaks": [_streak(1.2, 0, AMBER, length=0.05, power=0.75),
                             _streak(0.2, 0, AMBER, length=0.25, width=0.012)]}),
    LibraryLook("Wide Angle Sun", "The sun in a wide angle at f/16: a crisp star with fourteen long rays.",
                {"lens": "GB978797", "iris.f_number": 16.0, "iris.blades": 7, "iris.roundness": 0.0,
                 "ghosts.level": 0.012, "ghosts.count": 20, "starburst.gain": 4000.0, "starburst.peak": 14.0,
                 "colour": (1.0, 0.96, 0.88)}),
    LibraryLook("Night Street", "A sodium lamp with the lens wide open: a soft orange glow.",
                {"lens": "US4621909", "iris.f_number": 2.0, "ghosts.level": 0.012, "glow.gain": 0.6,
                 "glow.radius": 0.05, "glow.wide_gain": 0.06, "starburst.gain": 120.0, "colour": (1.0, 0.55, 0.2)}),
    LibraryLook("Torch", "A cold white LED straight into the lens: a hard star and a bluish ring.",
                {"lens": "US4333714", "iris.f_number": 8.0, "iris.blades": 5, "iris.roundness": 0.05,
                 "ghosts.level": 0.012, "starburst.gain": 1800.0, "colour": (0.85, 0.93, 1.0),
                 "rings": [{"gain": 0.08, "radius": 0.18, "width": 0.03, "dispersion": 0.6}]}),
    LibraryLook("Six-Point Star", "Six straight blades at f/11: six pointed rays.",
                {**GHOST_FIT, "lens": "US3576360", "iris.f_number": 11.0, "iris.blades": 6, "iris.roundness": 0.0,
                 "iris.rotation": 0.0, "iris.unevenness": 0.004, "ghosts.level": 0.006, "ghosts.count": 10,
                 "starburst.gain": 5000.0, "starburst.peak": 12.0}),
    LibraryLook("Rainbow Ring", "Two rings in the colours of the spectrum about the light.",
                {**GHOST_FIT, "lens": "US4099850", "ghosts.level": 0.006, "ghosts.count": 8, "starburst.gain": 150.0,
                 "rings": [{"gain": 0.16, "radius": 0.3, "width": 0.025},
                           {"gain": 0.1, "radius": 0.15, "width": 0.04}]}),
    LibraryLook("Cold Ghosts", "A cold light with large, faint, blue-grey ghosts.",
                {**GHOST_FIT, "lens": "GB978797", "glass.coating": (0.38, 0.72), "iris.blades": 5, "iris.f_number": 6.0,
                 "ghosts.level": 0.025, "starburst.gain": 400.0}),
    LibraryLook("Portrait Telephoto", "A long lens wide open: large soft discs.",
                {**GHOST_FIT, "lens": "US1998704", "focal_length": 135.0, "iris.f_number": 2.2, "iris.blades": 15,
                 "iris.roundness": 0.9, "ghosts.level": 0.025, "ghosts.rim": 0.1, "starburst.gain": 80.0,
                 "glow.gain": 0.3}),
)


def _digest(settings: TracedFlareSettings) -> str:
    return hashlib.sha256(repr(settings).encode()).hexdigest()[:16]


def read_index(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the entries of looks.json by name; {} where there is none."""
    path = folder / INDEX
    if not path.is_file():
        return {}
    return {str(entry["name"]): entry for entry in json.loads(path.read_text(encoding="utf-8"))["looks"]}


def make_library(folder: Path, names: list[str], progress: Progress) -> None:
    """Fit the looks with these names, or all for an empty list, and write their files, thumbnails and index entries.

    A file made with the same settings is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for look in LOOKS:
        settings, file = look.settings, folder / f"{look.name}.flare"
        digest = _digest(settings)
        is_current = read_index(folder).get(look.name, {}).get("settings") == digest and file.is_file()
        if is_current or (names and look.name not in names):
            continue
        result = make_flare(settings, file, progress, notes=f"{look.text} {default_notes(settings)}", licence=LICENCE)
        write_png(file.with_suffix(".png"), draw_thumbnail(read_look(file), THUMBNAIL_SIZE, THUMBNAIL_SIZE))
        entries = read_index(folder)  # another process may have added its looks meanwhile
        entries[look.name] = {"name": look.name, "text": look.text, "lens": settings.lens, "licence": LICENCE,
                              "error": round(result.error, 3), "settings": digest}
        write_json(folder / INDEX, {"looks": [entries[other.name] for other in LOOKS if other.name in entries]})
        progress.say(f"{look.name}: {result.count} Gaussians, error {result.error:.3f}.")


def write_sheet(folder: Path, file: Path) -> None:
    """Write the thumbnails of all looks that the library folder holds as one JPEG."""
    import cv2

    looks = [look for look in LOOKS if (folder / f"{look.name}.flare").is_file()]
    cells = [add_label(look.name, draw_thumbnail(read_look(folder / f"{look.name}.flare"), *SHEET_SIZE))
             for look in looks]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % SHEET_COLUMNS)
    rows = [side_by_side(cells[start:start + SHEET_COLUMNS]) for start in range(0, len(cells), SHEET_COLUMNS)]
    sheet = (np.clip(np.concatenate(rows), 0, 1)[..., ::-1] * 255 + 0.5).astype(np.uint8)
    cv2.imwrite(str(file), sheet, [cv2.IMWRITE_JPEG_QUALITY, 88])


def main() -> int:
    """Make the library, its sheet or its table, as the arguments say; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="looks to make (default: all)")
    parser.add_argument("--out", type=Path, default=LIBRARY, metavar="FOLDER", help="default: the extension's library")
    parser.add_argument("--table", action="store_true", help="print the errors of the looks, and make none")
    parser.add_argument("--sheet", type=Path, metavar="FILE", help="write the sheet of the looks, and make none")
    args = parser.parse_args()
    if args.table:
        print("| look | lens | mean error |\n| --- | --- | ---: |")
        for name, entry in read_index(args.out).items():
            print(f"| {name} | {entry['lens']} | {entry['error']:.3f} |")
        return 0
    if args.sheet:
        write_sheet(args.out, args.sheet)
        return 0
    return run_command(lambda progress: make_library(args.out, args.names, progress))


if __name__ == "__main__":
    raise SystemExit(main())
