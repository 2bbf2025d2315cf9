# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the Blender extension: `python headless/package.py [DIR]` writes DIR/fit_flare-VERSION.zip.

Blender's own packer checks the manifest and packs the tree. It comes with the bpy package, and in Blender it is
`blender --command extension build`.
"""
from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def find_packer() -> list[str]:
    """Return the command that starts Blender's packer; [] where there is none."""
    spec = importlib.util.find_spec("bpy")
    for folder in (spec.submodule_search_locations if spec else None) or ():
        for script in Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"):
            return [sys.executable, str(script)]
    blender = shutil.which("blender")
    return [blender, "--command", "extension"] if blender else []


def main(argv: list[str]) -> int:
    """Build the extension into the folder argv[0], or build/; return the exit status."""
    command = find_packer()
    if not command:
        print("error: Blender's packer is needed: install the bpy package, or put blender on the PATH.",
              file=sys.stderr)
        return 1
    out = Path(argv[0]) if argv else ROOT / "build"
    out.mkdir(parents=True, exist_ok=True)
    return subprocess.run([*command, "build", "--source-dir", str(ROOT), "--output-dir", str(out)],
                          check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
