# SPDX-License-Identifier: GPL-3.0-or-later
"""Rules for imports: packages depend downwards only and without circles, and Blender and torch stay apart."""
from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXTENSION = "fit_flare."  # the root package, as tests and tools name it
SOURCES = ("core", "flare_addon", "headless")

# Modules that Blender's own Python, which has numpy and no other dependency of the engine, must be able to import.
NUMPY_ONLY = ("core.errors", "core.choices", "core.system.files", "core.system.progress",
              "core.conventions.splatting", "core.conventions.run_files", "core.images.read", "core.images.write",
              "core.capture", "core.bake.bake", "core.bake.shot_frames", "core.metrics.evaluation", "core.look",
              "core.optics.lenses")

# Layers from the lowest; modules of `core` that are not listed are below all of them.
LAYERS = ("core.system", "core.conventions", "core.optics", "core.colour", "core.images", "core.capture",
         "core.metrics",
          "core.gaussians", "core.look", "core.lights", "core.flare", "core.removal.model", "core.removal.synthesis",
          "core.removal.inference", "core.removal.training", "core.removal.jobs", "core.removal", "core.fit",
          "core.bake", "core.transfer", "flare_addon", "headless")

# Kernel sets that refuse to be imported on a machine without their device.
OPTIONAL = ("core.gaussians.cuda", "core.gaussians.warp_kernels", "core.gaussians.warp_scene")


def run_isolated(code: str) -> None:
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def source_files() -> list[Path]:
    return [path for part in SOURCES for path in sorted((ROOT / part).rglob("*.py"))]


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def layer_of(module: str) -> int:
    """Index in LAYERS; -1 for a module below all of them."""
    return next((index for index, layer in enumerate(LAYERS) if f"{module}.".startswith(f"{layer}.")), -1)


def imported(path: Path) -> Iterator[str]:
    """Yield the names that a file imports, at its head or in a function; our own by their full names from the root."""
    package = path.relative_to(ROOT).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.removeprefix(EXTENSION) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = list(package[:len(package) - node.level + 1]) if node.level else []
            base += node.module.split(".") if node.module else []
            yield from (".".join([*base, alias.name]).removeprefix(EXTENSION) for alias in node.names)


def importers(library: str, files: Iterable[Path]) -> list[str]:
    return [f"{path.relative_to(ROOT)} imports {module}" for path in files for module in imported(path)
            if f"{module}.".startswith(f"{library}.")]


def package_imports(files: Iterable[Path]) -> dict[str, set[str]]:
    """Return the packages that each package imports, without itself and without packages that it contains or is in."""
    files = list(files)
    packages = {module_of(path) for path in files if path.name == "__init__.py"}

    def package_of(name: str) -> str:
        while name and name not in packages:
            name = name.rpartition(".")[0]
        return name

    graph: dict[str, set[str]] = {}
    for path in files:
        package = package_of(module_of(path))
        targets = {package_of(name) for name in imported(path)} - {"", package}
        # A package and those inside it are one unit where they meet: a subpackage may use its parent's modules.
        graph.setdefault(package, set()).update(
            target for target in targets
            if not f"{target}.".startswith(f"{package}.") and not f"{package}.".startswith(f"{target}."))
    return graph


def find_circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Return a circle of a graph as the list of its nodes, the first repeated at the end; [] where there is none."""
    finished: set[str] = set()

    def search(node: str, path: list[str]) -> list[str]:
        """Search depth-first from `node`, reached by `path`; return a circle or []."""
        if node in path:
            return [*path[path.index(node):], node]
        if node in finished:
            return []
        for target in sorted(graph.get(node, ())):
            if circle := search(target, [*path, node]):
                return circle
        finished.add(node)
        return []

    return next((circle for node in sorted(graph) if (circle := search(node, []))), [])


def test_no_file_of_core_imports_blender_and_none_of_the_addon_torch() -> None:
    """Neither at the head of a file nor in a function."""
    core = sorted((ROOT / "core").rglob("*.py"))
    addon = [ROOT / "__init__.py", *sorted((ROOT / "flare_addon").rglob("*.py"))]
    assert not importers("bpy", core)
    assert not importers("torch", addon)
    assert importers("torch", core) and importers("bpy", addon), "the search finds imports at all"


def test_layers_depend_downwards_only() -> None:
    imports = [(path, module) for path in source_files() for module in imported(path)]
    upwards = [f"{path.relative_to(ROOT)} imports {module}" for path, module in imports
               if layer_of(module) > layer_of(module_of(path))]
    assert not upwards
    assert len([module for _, module in imports if layer_of(module) >= 0]) > 500, "the search finds imports at all"


def test_packages_have_no_import_circles() -> None:
    """Counts imports in functions as well, which would hide a circle from Python."""
    graph = package_imports(source_files())
    assert not find_circle(graph), " -> ".join(find_circle(graph))
    assert "core.colour" in graph["core.images"] and "core.images" in graph["core.capture"], "the graph has edges"


def test_an_import_circle_is_found() -> None:
    graph = {"a": {"b", "c"}, "b": {"d"}, "c": set(), "d": {"b"}}
    assert find_circle(graph) == ["b", "d", "b"]
    assert find_circle({**graph, "d": set()}) == []


def test_core_imports_no_blender() -> None:
    assert "bpy" not in sys.modules
    run_isolated("import importlib, pathlib, sys\n"
                 "for path in sorted(pathlib.Path('core').rglob('*.py')):\n"
                 "    parts = path.with_suffix('').parts\n"
                 "    name = '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)\n"
                 "    try:\n"
                 "        importlib.import_module(name)\n"
                 "    except ImportError:\n"
                 f"        if name not in {OPTIONAL!r}: raise\n"
                 "assert 'bpy' not in sys.modules, 'core imports bpy'")


def test_the_modules_that_blender_imports_need_numpy_alone() -> None:
    missing = ("torch", "cv2", "OpenEXR", "pycolmap", "numba", "safetensors", "tqdm", "bpy", "av", "OpenImageIO", "PIL",
               "PyOpenColorIO", "simplejpeg", "rawpy", "pillow_heif", "pillow_jxl")
    run_isolated(f"import importlib, sys\n"
                 f"sys.modules.update(dict.fromkeys({missing!r}))\n"  # None in sys.modules: the import fails
                 f"for name in {NUMPY_ONLY!r}:\n"
                 f"    importlib.import_module(name)")
