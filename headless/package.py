# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the Blender extension, or a repository of it that people add to Blender by its address.

    package.py [DIR]                 write DIR/fit_flare-VERSION.zip (by default build/)
    package.py --repository DIR      write it into a static repository: index.json, index.html, and the weights

Blender's own packer checks the manifest, packs the tree and lists the repository. It comes with the bpy package, and in
Blender it is `blender --command extension`. The weights of the removal network are too large for the extension; the
add-on downloads them from the repository that it was installed from.
"""
from __future__ import annotations

import argparse
import hashlib
import importlib.util
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MODEL_CARD = ROOT / "core" / "removal" / "box" / "README.md"


def find_packer() -> list[str]:
    """Return the command that starts Blender's packer; [] where there is none."""
    spec = importlib.util.find_spec("bpy")
    for folder in (spec.submodule_search_locations if spec else None) or ():
        for script in Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"):
            return [sys.executable, str(script)]
    blender = shutil.which("blender")
    return [blender, "--command", "extension"] if blender else []


def build(packer: list[str], out: Path) -> int:
    """Build the extension into a folder, check it, and print its size; return the exit status.

    packer: the command that starts Blender's packer.
    """
    out.mkdir(parents=True, exist_ok=True)
    status = subprocess.run([*packer, "build", "--source-dir", str(ROOT), "--output-dir", str(out)],
                            check=False).returncode
    for package in out.glob("fit_flare-*.zip") if status == 0 else ():
        add_handbook(package)
        status = status or subprocess.run([*packer, "validate", str(package)], check=False).returncode
        print(f"{package}: {package.stat().st_size / 1e6:.1f} MB")
    return status


def add_handbook(package: Path) -> None:
    """Add the handbook to the extension, as HTML pages."""
    sys.path.insert(0, str(ROOT))
    from headless.handbook import render_pages

    with zipfile.ZipFile(package, "a", zipfile.ZIP_DEFLATED) as archive:
        for name, content in render_pages(ROOT / "docs" / "handbook").items():
            archive.writestr(f"handbook/{name}", content)


def copy_weights(folder: Path) -> str:
    """Copy the weights and their model card to a repository; return why that failed, "" after a success."""
    sys.path.insert(0, str(ROOT))
    from core.removal.model.weights_file import DIGEST_FILE, IN_THE_BOX, published_digest, published_name

    if not IN_THE_BOX.is_file():
        return f"{IN_THE_BOX} is missing"
    if hashlib.sha256(IN_THE_BOX.read_bytes()).hexdigest() != published_digest():
        return f"{DIGEST_FILE} is not the SHA-256 of {IN_THE_BOX.name}; write it anew"
    shutil.copyfile(IN_THE_BOX, folder / published_name())
    shutil.copyfile(MODEL_CARD, (folder / published_name()).with_suffix(".md"))
    return ""


def publish(packer: list[str], folder: Path) -> int:
    """Write a static repository of the extension into a folder, and print its address; return the exit status."""
    status = build(packer, folder)
    if status == 0 and (problem := copy_weights(folder)):
        print(f"error: {problem}.", file=sys.stderr)
        status = 1
    status = status or subprocess.run([*packer, "server-generate", "--repo-dir", str(folder), "--html"],
                                      check=False).returncode
    if status == 0:
        print(f"In Blender: Preferences > Get Extensions > Repositories > Add Remote Repository, with the address of "
              f"index.json; on this machine it is {(folder / 'index.json').resolve().as_uri()}")
    return status


def main(argv: list[str]) -> int:
    """Build the extension, or a repository of it; return the exit status."""
    parser = argparse.ArgumentParser(description="Builds the Blender extension, or a static repository of it.")
    parser.add_argument("out", nargs="?", type=Path, default=ROOT / "build", metavar="DIR",
                        help="folder for the extension (default: build/)")
    parser.add_argument("--repository", type=Path, metavar="DIR",
                        help="folder of a static repository: extension, index.json, index.html, weights")
    args = parser.parse_args(argv)
    packer = find_packer()
    if not packer:
        print("error: Blender's packer is needed: install the bpy package, or put blender on the PATH.",
              file=sys.stderr)
        return 1
    return publish(packer, args.repository) if args.repository else build(packer, args.out)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
