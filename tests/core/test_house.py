# SPDX-License-Identifier: GPL-3.0-or-later
"""The rules of the house that keep Blender and the engine apart."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# What Blender's own Python, which has numpy and nothing else of ours, must be able to import.
LIGHT = ("core.errors", "core.files", "core.progress", "core.pictures", "core.capture",
         "core.bake.bake", "core.metrics.evaluation", "core.look")


# Kernel sets that refuse to be imported on a machine without their device.
OPTIONAL = ("core.gaussians.cuda", "core.gaussians.warp_kernels")


def isolated(code: str) -> None:
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr


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
