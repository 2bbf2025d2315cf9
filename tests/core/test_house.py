# SPDX-License-Identifier: GPL-3.0-or-later
"""The rules of the house that keep Blender and the engine apart."""
from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OURS = "fit_flare."  # as tests and tools name the root package

# What Blender's own Python, which has numpy and nothing else of ours, must be able to import.
LIGHT = ("core.errors", "core.choices", "core.system.files", "core.system.progress", "core.conventions.splatting",
         "core.conventions.run_files", "core.images.read", "core.images.write", "core.capture", "core.bake.bake",
         "core.metrics.evaluation", "core.look")

# From the lowest; what is not named is the ground floor, below all.
ROOMS = ("core.system", "core.conventions", "core.colour", "core.images", "core.capture", "core.metrics",
         "core.gaussians", "core.look", "core.lights", "core.flare", "core.removal.model", "core.removal.synthesis",
         "core.removal.inference", "core.removal.training", "core.removal.jobs", "core.removal", "core.fit",
         "core.bake", "core.transfer", "flare_addon", "headless")

# Kernel sets that refuse to be imported on a machine without their device.
OPTIONAL = ("core.gaussians.cuda", "core.gaussians.warp_kernels")


def isolated(code: str) -> None:
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr


def room_of(module: str) -> int:
    """Place in ROOMS; -1 for the ground floor."""
    return next((place for place, room in enumerate(ROOMS) if f"{module}.".startswith(f"{room}.")), -1)


def imported(path: Path) -> Iterator[str]:
    """What a file imports, at its head or in a function; what is ours by its whole name from the root."""
    package = path.relative_to(ROOT).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.removeprefix(OURS) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = list(package[:len(package) - node.level + 1]) if node.level else []
            base += node.module.split(".") if node.module else []
            yield from (".".join([*base, alias.name]).removeprefix(OURS) for alias in node.names)


def importers(wanted: str, files: Iterable[Path]) -> list[str]:
    return [f"{path.relative_to(ROOT)} imports {module}" for path in files for module in imported(path)
            if f"{module}.".startswith(f"{wanted}.")]


def test_no_file_of_core_imports_blender_and_none_of_the_addon_torch() -> None:
    """Not in a function either."""
    core = sorted((ROOT / "core").rglob("*.py"))
    addon = [ROOT / "__init__.py", *sorted((ROOT / "flare_addon").rglob("*.py"))]
    assert not importers("bpy", core)
    assert not importers("torch", addon)
    assert importers("torch", core) and importers("bpy", addon), "they are found at all"


def test_rooms_depend_downwards_only() -> None:
    files = [path for part in ("core", "flare_addon", "headless") for path in sorted((ROOT / part).rglob("*.py"))]
    edges = [(path, module) for path in files for module in imported(path)]
    upwards = [f"{path.relative_to(ROOT)} imports {module}" for path, module in edges
               if room_of(module) > room_of(".".join(path.relative_to(ROOT).with_suffix("").parts))]
    assert not upwards
    assert len([module for _, module in edges if room_of(module) >= 0]) > 500, "they are found at all"


def test_core_imports_no_blender() -> None:
    assert "bpy" not in sys.modules
    isolated("import importlib, pathlib, sys\n"
             "for path in sorted(pathlib.Path('core').rglob('*.py')):\n"
             "    parts = path.with_suffix('').parts\n"
             "    name = '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)\n"
             "    try:\n"
             "        importlib.import_module(name)\n"
             "    except ImportError:\n"
             f"        if name not in {OPTIONAL!r}: raise\n"
             "assert 'bpy' not in sys.modules, 'core imports bpy'")


def test_the_light_part_of_core_needs_numpy_alone() -> None:
    heavy = ("torch", "cv2", "OpenEXR", "pycolmap", "numba", "safetensors", "tqdm", "bpy")
    isolated(f"import importlib, sys\n"
             f"sys.modules.update(dict.fromkeys({heavy!r}))\n"  # None in sys.modules: the import fails
             f"for name in {LIGHT!r}:\n"
             f"    importlib.import_module(name)")
