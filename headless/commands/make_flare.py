# SPDX-License-Identifier: GPL-3.0-or-later
"""make-flare: makes a .flare from a lens prescription, without footage."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import SettingsError
from ...core.system.files import check_no_overwrite
from ...core.system.progress import Progress
from ...core.system.reading import MAX_TOML_BYTES, UTF8_SIG, parse_toml, read_text
from ..command import Command, Step, parse_seed
from .fit import parse_setting

if TYPE_CHECKING:
    from ...core.fit.traced_settings import TracedFlareSettings

TARGET_ERROR = 0.15
"""Mean relative error above which the command says how to lower it."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("lens", metavar="LENS", nargs="?", default="",
                        help="a .lens file, or the name of a lens of the program; --list shows these")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the .flare to write")
    parser.add_argument("--list", action="store_true", dest="list_lenses",
                        help="list the lenses of the program, and write nothing")
    parser.add_argument("--settings", type=Path, metavar="FILE", help="a TOML file with settings, as --set names them")
    parser.add_argument("--focal", type=float, metavar="MM", help="scale the lens to this focal length")
    parser.add_argument("--sensor", type=float, metavar="MM", help="width of the sensor (default 36)")
    parser.add_argument("--squeeze", type=float, metavar="FACTOR",
                        help="squeeze of an anamorphic lens, such as 1.8 or 2")
    parser.add_argument("--f-number", type=float, metavar="N", help="opening of the iris (default: two stops below the "
                                                                    "widest)")
    parser.add_argument("--blades", type=int, metavar="N", help="blades of the iris (default 8)")
    parser.add_argument("--roundness", type=float, metavar="SHARE",
                        help="roundness of the blades: 0 straight, 1 a circle")
    parser.add_argument("--rotation", type=float, metavar="DEGREES", help="rotation of the iris")
    parser.add_argument("--coating", metavar="NM[,NM...]",
                        help="wavelengths in nanometres that the coatings are made for, in turn over the surfaces; 0 "
                             "for bare glass")
    parser.add_argument("--dust", type=int, metavar="N", help="specks of dust on the glass (default 30)")
    parser.add_argument("--scratches", type=int, metavar="N", help="scratches on the glass (default 0)")
    parser.add_argument("--colour", metavar="R,G,B", help="colour of the light, linear (default 1,1,1)")
    parser.add_argument("--ghosts", type=float, metavar="LEVEL",
                        help="root mean square of the ghosts over the frame, 1 is white (default 0.02)")
    parser.add_argument("--dispersion", choices=("on", "off"),
                        help="whether the glass splits the colours of ghosts (default on)")
    parser.add_argument("--starburst", type=float, metavar="GAIN", help="brightness of the starburst (default 700)")
    parser.add_argument("--glow", type=float, metavar="GAIN", help="brightness of the glow (default 0.2)")
    parser.add_argument("--ring", type=float, metavar="GAIN",
                        help="add a ring of this brightness around the light, such as 0.1")
    parser.add_argument("--streak", type=float, metavar="GAIN",
                        help="add a horizontal streak of this brightness, such as 1")
    parser.add_argument("--seed", type=parse_seed, metavar="N",
                        help="random seed of blades, dust and scratches (default 0)")
    parser.add_argument("--notes", default="", metavar="TEXT", help="notes to store in the file")
    parser.add_argument("--licence", default="", metavar="TEXT", help="licence to store in the file")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes",
                        help="any other setting by its name in docs/make_flare.md, such as fit.iterations=3000; "
                             "repeatable")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Trace a flare, fit a model to it and write the .flare; or, with --list, list the lenses. Raises SettingsError."""
    from ...core.optics.lenses import lens_names

    if args.list_lenses:
        progress.say(f"Lenses of the program: {', '.join(lens_names())}.")
        return {"lenses": lens_names()}
    if not args.lens or args.out is None:
        raise SettingsError("make-flare needs a lens and --out FILE; --list shows the lenses of the program.")
    if args.out.suffix != ".flare":
        raise SettingsError(f"--out {args.out} is not a .flare; give the file that suffix.")
    if Path(args.lens).is_file():
        check_no_overwrite([Path(args.lens)], [args.out])

    from ...core.fit.traced_flare import make_flare

    settings = read_settings(args)
    result = make_flare(settings, args.out, progress, notes=args.notes, licence=args.licence)
    progress.say(f"The flare is {args.out}: {result.count} Gaussians, error {result.error:.3f} (relative L2 in linear "
                 f"light, mean over a path that the fit did not see; largest {result.max_error:.3f}).")
    if result.error > TARGET_ERROR:
        progress.say(f"The error is above {TARGET_ERROR}; a longer fit lowers it: "
                     f"--set fit.iterations={2 * settings.fit.iterations}.")
    return {"flare": str(args.out), "error": result.error, "largest_error": result.max_error, "gaussians": result.count}


def read_settings(args: argparse.Namespace) -> TracedFlareSettings:
    """Return the settings from the file of --settings, then the options, then --set. Raises SettingsError."""
    from ...core.fit.traced_settings import TracedFlareSettings

    settings = TracedFlareSettings()
    values: dict[str, Any] = _read_toml(args.settings) if args.settings else {}
    options = {"lens": args.lens, "focal_length": args.focal, "sensor": args.sensor, "squeeze": args.squeeze,
               "iris.f_number": args.f_number, "iris.blades": args.blades, "iris.roundness": args.roundness,
               "iris.rotation": args.rotation, "glass.dust": args.dust, "glass.scratches": args.scratches,
               "glass.seed": args.seed, "ghosts.level": args.ghosts, "starburst.gain": args.starburst,
               "glow.gain": args.glow}
    values |= {name: value for name, value in options.items() if value is not None}
    if args.dispersion is not None:
        values["ghosts.dispersion"] = args.dispersion == "on"
    if args.coating is not None:
        # The option has nanometres, the setting micrometres.
        values["glass.coating"] = [number / 1000 for number in _parse_numbers("--coating", args.coating)]
    if args.colour is not None:
        values["colour"] = _parse_numbers("--colour", args.colour)
    if args.ring is not None:
        values["rings"] = [{"gain": args.ring}]
    if args.streak is not None:
        values["streaks"] = [{"gain": args.streak}]
    return settings.override({**values, **dict(map(parse_setting, args.changes))})


def _parse_numbers(option: str, text: str) -> list[float]:
    """Parse numbers with commas between them. Raises SettingsError."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise SettingsError(f"{option} {text} is not a list of numbers with commas between them.") from None


def _read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file as values by name, those in a table by "table.name". Raises SettingsError."""
    try:
        tables = parse_toml(read_text(path, MAX_TOML_BYTES, UTF8_SIG))
    except (OSError, ValueError) as problem:
        raise SettingsError(f"--settings {path} cannot be read ({problem}); it should be TOML.") from problem
    return {f"{table}.{name}" if isinstance(part, dict) else table: value
            for table, part in tables.items()
            for name, value in (part.items() if isinstance(part, dict) else (("", part),))}


COMMAND = Command(
    "make-flare", "Makes a flare from a lens prescription, without footage.",
    """Traces the flare of a lens for many positions of the light: ghosts, starburst, glow, rings, streaks. Then it fits
a flare model to the pictures and writes a .flare, which works like a fitted one. It prints the error on a path of the
light that the fit did not see. docs/make_flare.md describes the settings and the .lens format.

  run.py make-flare US3576360 --out prime.flare
  run.py make-flare my.lens --out blue.flare --squeeze 1.8 --streak 1.5 --blades 6""",
    arguments, (Step("make-flare", "engine", run),))
