# SPDX-License-Identifier: GPL-3.0-or-later
"""Prints every text of the interface as Markdown, for a review of its wording: labels and tooltips of panels,
operators and properties, and the help of each command.

    python tests/window/interface_list.py > interface.md      (a Python with the bpy package)

The messages of errors and reports are not listed; they stand where they are raised.
"""
from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

ROOT = Path(__file__).resolve().parents[2]


def load_package() -> str:
    """Make this tree importable as a package and register the extension; return the name of the package."""
    spec = importlib.util.spec_from_file_location("run", ROOT / "headless" / "run.py")
    assert spec is not None and spec.loader is not None
    run = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run)
    name = str(run.register_package())
    importlib.import_module(name).register()
    return name


def classes_of(base: type) -> list[Any]:
    """Return the extension's registered classes of a type of Blender, sorted by name."""
    found = [cls for cls in base.__subclasses__() if cls.__name__.startswith("FITFLARE_")]
    return sorted(found, key=lambda cls: cls.__name__)


def properties_of(cls: Any) -> Iterator[str]:
    """Yield a table row for each visible property of a class, and for each item of a menu."""
    declared = {name for base in cls.__mro__ for name in getattr(base, "__annotations__", ())}
    is_operator = issubclass(cls, bpy.types.Operator)
    rna = bpy_operator(cls).get_rna_type() if is_operator else cls.bl_rna
    for prop in rna.properties:
        if prop.identifier in declared and not prop.is_hidden and (prop.description or prop.type == "ENUM"):
            yield f"| `{prop.identifier}` | {prop.name} | {prop.description} |"
            for item in prop.enum_items if prop.type == "ENUM" else ():
                yield f"| `{prop.identifier}={item.identifier}` | {item.name} | {item.description} |"


def bpy_operator(cls: Any) -> Any:
    """Return the operator of a class as Blender calls it."""
    return getattr(bpy.ops.fit_flare, cls.bl_idname.partition(".")[2])


def rows(title: str, classes: list[Any]) -> Iterator[str]:
    """Yield a section with a table of the properties of each class that has some."""
    yield f"\n## {title}\n"
    for cls in classes:
        table = list(properties_of(cls))
        if table:
            yield from (f"\n### {cls.__name__}\n", "| property | label | tooltip |", "| --- | --- | --- |", *table)


def panels_and_operators() -> Iterator[str]:
    """Yield lines of Markdown with the extension's panels, operators, their options, and properties."""
    yield "## Panels\n"
    yield from (f"- {cls.bl_label} (`{cls.__name__}`)" for cls in classes_of(bpy.types.Panel))
    yield from ("\n## Operators\n", "| operator | label | tooltip |", "| --- | --- | --- |")
    operators = classes_of(bpy.types.Operator)
    for cls in operators:
        yield f"| `{cls.bl_idname}` | {cls.bl_label} | {bpy_operator(cls).get_rna_type().description} |"
    yield from rows("Options of operators", operators)
    yield from rows("Properties", classes_of(bpy.types.PropertyGroup) + classes_of(bpy.types.AddonPreferences))


def commands(package: str) -> Iterator[str]:
    """Yield the help of run.py and of each command."""
    cli = importlib.import_module(f"{package}.headless.cli")
    parser = cli.build_parser()
    yield f"\n## Commands\n\n```\n{parser.format_help()}```"
    for action in parser._actions:
        for name, command in (action.choices or {}).items() if isinstance(action.choices, dict) else ():
            yield f"\n### {name}\n\n```\n{command.format_help()}```"


def main() -> None:
    """Print the list."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    package = load_package()
    print("# Texts of the interface\n")
    for line in (*panels_and_operators(), *commands(package)):
        print(line)


if __name__ == "__main__":
    main()
