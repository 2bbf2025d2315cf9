# SPDX-License-Identifier: GPL-3.0-or-later
"""The rows of docs/threat_model.md that no other test covers; and each row names a test that exists."""
from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import pickle
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from core.bake.bake import MANIFEST, read_manifest
from core.bake.exr import HEADER_ATTRIBUTE, read_description, read_layers
from core.bake.layers import layer_names
from core.colour.spaces import REC_709
from core.errors import FitFlareError, FrameError
from core.fit import checkpoint
from core.flare.file import load as load_flare
from core.images.exr import read_data_window, read_exr_header
from core.images.exr_views import stereo_views
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.size import picture_size
from core.images.write import write_exr
from core.look import read_look
from core.metrics import lpips
from core.removal.jobs.manifest import Manifest
from core.removal.model import weights
from tests.core.picture_files import WRITERS, scene
from tests.faults.media import media

ROOT = Path(__file__).resolve().parents[2]


class Trap:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self._mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self._mark),)


def test_every_attempt_names_a_test_that_exists() -> None:
    text = (ROOT / "docs" / "threat_model.md").read_text(encoding="utf-8")
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)
    rows = [line for line in text.split("## Attempts")[1].split("## Limits")[0].splitlines() if line.startswith("| a ")
            or line.startswith("| an ") or line.startswith("| LPIPS") or line.startswith("| JSON")]
    assert len(named) == len(rows) > 15
    for file, name in named:
        assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8"), f"{file}::{name}"


def test_no_reader_unpickles(tmp_path: Path) -> None:
    mark, path = tmp_path / "mark", tmp_path / "a.flare"
    path.write_bytes(pickle.dumps(Trap(mark)))
    for reader in (read_look, load_flare, checkpoint.load, weights.load_network):
        with pytest.raises(FitFlareError):
            reader(path)
    assert not mark.exists()
    pickle.loads(path.read_bytes())
    assert mark.exists(), "the trap works"


def test_lpips_weights_with_code_are_refused(tmp_path: Path) -> None:
    import torch

    mark = tmp_path / "mark"
    torch.save({"a": Trap(mark)}, tmp_path / "lpips.pth")
    with pytest.raises(FitFlareError):
        lpips._read_weights(tmp_path / "lpips.pth")
    assert not mark.exists()


@pytest.mark.parametrize("size", [(2**31 - 1, 2**31 - 1), (1_000_000, 1_000_000), (0, 4)])
def test_a_picture_that_claims_a_huge_size_is_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((4, 4, 3), np.uint8))
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", *size)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    for reader in (read_picture, read_plate):
        with pytest.raises(FitFlareError):
            reader(path)


def _write_film_scan(path: Path) -> None:
    """Write a DPX or a Cineon."""
    write = WRITERS["log DPX"][2] if path.suffix == ".dpx" else next(
        (lambda path, _, other=other: other.write(path)) for other in media() if other.file == path.name)
    write(path, scene(48, 32))


@pytest.mark.parametrize(("file", "width_at"), [("a.dpx", [772]), ("a.cin", [200, 228, 256])])
def test_a_picture_that_claims_more_pixels_than_its_bytes_is_refused(file: str, width_at: list[int],
                                                                     tmp_path: Path) -> None:
    path = tmp_path / file
    _write_film_scan(path)
    data = bytearray(path.read_bytes())
    order = "<" if data[:4] == b"XPDS" else ">"
    for at in width_at:  # Cineon has a size for each channel
        data[at:at + 8] = struct.pack(f"{order}II", 20_000, 10_000)
    path.write_bytes(data)
    with pytest.raises(FrameError, match=r"claims 20000 x 10000 pixels in"):
        read_picture(path)


@pytest.mark.parametrize(("file", "at"), [("a.dpx", 32), ("a.cin", 16)])
@pytest.mark.parametrize("swapped", [False, True])
def test_a_picture_that_claims_user_data_beyond_its_end_is_refused(file: str, at: int, swapped: bool,
                                                                   tmp_path: Path) -> None:
    path = tmp_path / file
    _write_film_scan(path)
    data = bytearray(path.read_bytes())
    order: Any = "little" if (data[:4] == b"XPDS") != swapped else "big"
    if swapped:
        data[:36] = b"".join(data[k:k + 4][::-1] for k in range(0, 36, 4))
    data[at:at + 4] = (0xF0000000).to_bytes(4, order)
    path.write_bytes(data)
    for reader in (read_picture, picture_size):
        with pytest.raises(FrameError, match=r"of 4026531840 bytes"):
            reader(path)


@pytest.mark.parametrize("name", ["chromaticities", "pixelAspectRatio", "multiView"])
def test_header_entries_of_an_exr_with_another_type_are_ignored(tmp_path: Path, name: str) -> None:
    path, header = tmp_path / "a.exr", {"chromaticities": REC_709, "pixelAspectRatio": 2.0,
                                        "multiView": ["left", "right"]}
    write_exr(path, {channel: np.ones((4, 4), np.float32) for channel in "RGB"}, header=header)
    kind = {"chromaticities": b"chromaticities", "pixelAspectRatio": b"float", "multiView": b"stringvector"}[name]
    start = name.encode() + b"\0"
    assert path.read_bytes().count(start + kind) == 1
    path.write_bytes(path.read_bytes().replace(start + kind, start + b"x" * len(kind)))
    assert type(read_exr_header(path).get(name)) in (type(None), float)  # the library sets a ratio of 1
    assert read_picture(path).pixels.min() == 1
    plate = read_plate(path)
    assert plate.space.name == "linear" and read_data_window(path).size == (4, 4)
    assert stereo_views(read_exr_header(path), ["R", "G", "B"]) == []


@pytest.mark.parametrize("text", ["[" * 5000, "null", '{"lights": 3}', "\x01"])
def test_strange_header_text_of_an_exr_is_ignored(tmp_path: Path, text: str) -> None:
    channels = {name: np.ones((4, 4), np.float32) for name in ("R", "G", "B")}
    write_exr(tmp_path / "a.exr", channels, header={HEADER_ATTRIBUTE: text})
    for reader in (read_description, read_layers):
        with contextlib.suppress(FitFlareError):  # a sentence is as good
            reader(tmp_path / "a.exr")


def test_a_manifest_deletes_nothing_outside_its_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in ("../victim", "/etc/passwd", "a/../../victim"):
        (out / MANIFEST).write_text(json.dumps({"version": 1, "made_from": {}, "layers": {}, "frames": [
            {"frame": 1, "file": name, "width": 4, "height": 4}]}))
        with pytest.raises(FitFlareError, match="not inside the folder"):
            read_manifest(out)


def test_a_removal_manifest_deletes_nothing_outside_its_folder(tmp_path: Path) -> None:
    out, victim, plate = tmp_path / "out", tmp_path / "victim.exr", tmp_path / "a.png"
    out.mkdir()
    for path in (victim, plate):
        path.write_bytes(b"work")
    (out / "remove.json").write_text(json.dumps({"plates": {"a.png": "1"}, "flares": {"a.png": "../victim.exr"},
                                                 "flares_made": {"a.png": "1"}, "sources": {}, "written": {}}))
    Manifest(out).begin_frame(Path("a.png"), plate, "2", [out / "a.png"], overwrite=True)
    assert victim.read_bytes() == b"work"


def test_a_light_name_is_no_path() -> None:
    for name in layer_names(["../../x", "a/b", "c:\\d", "e\0f"]).values():
        assert not set(name) & set("/\\:\0"), name


def test_farm_templates_start_no_shell() -> None:
    templates = sorted((ROOT / "headless" / "farm").glob("*.yaml"))
    assert templates
    for path in templates:
        commands = re.findall(r"command:\s*(.+)", path.read_text(encoding="utf-8"))
        assert commands
        assert all(re.fullmatch(r'"\{\{Param\.\w+\}\}"', command.strip()) for command in commands), path.name
        assert "embeddedFiles" not in path.read_text(encoding="utf-8"), path.name


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="there is no bpy package (`make setup`)")
def test_a_blend_is_opened_without_its_scripts(tmp_path: Path) -> None:
    blend, mark = tmp_path / "trap.blend", tmp_path / "mark"
    make = ("import bpy, sys\nbpy.ops.wm.read_factory_settings(use_empty=True)\ntext = bpy.data.texts.new('trap.py')\n"
            "text.write(f'import os; os.mkdir({sys.argv[2]!r})')\ntext.use_module = True\n"
            "scene = bpy.context.scene\nscene.camera = bpy.data.objects.new('c', bpy.data.cameras.new('c'))\n"
            "scene.collection.objects.link(scene.camera)\nbpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])\n")
    look = ("import bpy, sys\nbpy.context.preferences.filepaths.use_scripts_auto_execute = True\n"
            "sys.path.insert(0, sys.argv[2])\nfrom headless import run\nrun.register_package()\n"
            "import importlib\nmodule = importlib.import_module('fit_flare.flare_addon.capture.blend_shot')\n"
            "from pathlib import Path\nmodule.open_blend(Path(sys.argv[1]))\n")
    with_scripts = "import bpy, sys\nbpy.ops.wm.open_mainfile(filepath=sys.argv[1], use_scripts=True)\n"
    for code, argument, runs in ((make, mark, False), (look, ROOT, False), (with_scripts, mark, True)):
        done = subprocess.run([sys.executable, "-c", code, str(blend), str(argument)], capture_output=True, text=True,
                              check=False)
        assert done.returncode in (0, -11), done.stderr  # Blender as a module may crash at its end
        assert "Traceback" not in done.stderr, done.stderr
        assert blend.exists()
        assert mark.exists() == runs, "the last one shows that the trap works"
