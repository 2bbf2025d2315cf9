# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour spaces against published matrices, against OpenColorIO, and there and back."""
from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from core.colour import REC_709, colour_space, space_of_chromaticities
from core.colour.icc import UnreadableProfile, _parse_curve
from core.colour.spaces import AP1, REC_2020, built_in_names, matrix_between
from core.errors import SettingsError

VALUES = np.array([[0.0, 0.01, 0.18], [1.0, 0.5, 2.5], [-0.02, 0.9, 100.0]], np.float32)


def test_matrices_are_the_published_ones() -> None:
    """AP1 to Rec. 709 by Bradford, as ACES prints it; Rec. 2020 to Rec. 709 of ITU-R BT.2087."""
    np.testing.assert_allclose(matrix_between(AP1, REC_709), [
        [1.7050509, -0.6217921, -0.0832589], [-0.1302564, 1.1408047, -0.0105483],
        [-0.0240034, -0.1289690, 1.1529723]], atol=2e-6)
    np.testing.assert_allclose(matrix_between(REC_2020, REC_709), [
        [1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], atol=1e-4)


@pytest.mark.parametrize("name", built_in_names())
def test_spaces_convert_there_and_back_without_loss(name: str) -> None:
    space = colour_space(name)
    np.testing.assert_allclose(space.from_linear(space.to_linear(VALUES)), VALUES, rtol=2e-5, atol=2e-5)
    assert space.is_linear == (name not in ("srgb", "rec709"))


def test_curves_have_their_known_points() -> None:
    assert colour_space("srgb").to_linear(np.float32([0.5]))[0] == pytest.approx(0.21404, abs=1e-5)
    assert colour_space("rec709").from_linear(np.float32([0.18]))[0] == pytest.approx(0.40901, abs=1e-4)


def test_white_stays_white() -> None:
    for name in built_in_names():
        np.testing.assert_allclose(colour_space(name).to_linear(np.ones((1, 3), np.float32)), 1, atol=1e-5)


def test_a_space_is_identified_by_its_chromaticities() -> None:
    rounded = tuple(round(value, 3) for value in AP1)
    assert space_of_chromaticities(rounded).name == "acescg"  # type: ignore[arg-type]
    assert space_of_chromaticities(REC_709).name == "linear"
    own = space_of_chromaticities((0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290))  # Adobe RGB (1998)
    np.testing.assert_allclose(own.to_linear(np.float32([[0, 1, 0]]))[0], [-0.3984, 1.0, -0.0429], atol=2e-3)
    with pytest.raises(SettingsError, match="span no colour space"):
        space_of_chromaticities((0.3, 0.3) * 4)  # type: ignore[arg-type]


def test_names_of_opencolorio_need_no_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OCIO", raising=False)
    assert [colour_space(name).name for name in ("lin_rec709", "lin_rec2020")] == ["linear", "rec2020"]


def test_an_unknown_space_is_refused_with_the_known_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OCIO", raising=False)
    with pytest.raises(SettingsError, match=r"srgb, rec709, linear, acescg.*--ocio"):
        colour_space("log of mine")


# ---- OpenColorIO ----------------------------------------------------------------------------------


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Write a small OpenColorIO configuration of linear spaces, a log space and a role; return its path."""
    library = pytest.importorskip("PyOpenColorIO", reason="the package opencolorio is not installed")
    made = library.Config()
    made.addColorSpace(library.ColorSpace(name="Linear Rec.709", encoding="scene-linear"))
    half = library.MatrixTransform([0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 1])
    made.addColorSpace(library.ColorSpace(name="half light", toReference=half))
    made.addColorSpace(library.ColorSpace(name="studio log", toReference=library.LogTransform(
        base=2, direction=library.TRANSFORM_DIR_INVERSE)))
    made.setRole("scene_linear", "Linear Rec.709")
    made.addDisplayView("screen", "plain", "Linear Rec.709")
    path = tmp_path / "config.ocio"
    path.write_text(made.serialize())
    return path


def test_spaces_of_a_configuration(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spaces of an OpenColorIO configuration convert to linear light and back; an unknown one is refused."""
    half = colour_space("half light", config)
    assert half.is_linear
    np.testing.assert_allclose(half.to_linear(VALUES), VALUES / 2, rtol=1e-5)
    log = colour_space("studio log", config)
    assert not log.is_linear
    np.testing.assert_allclose(log.to_linear(np.float32([[1, 2, 3]])), [[2, 4, 8]], rtol=1e-3)
    np.testing.assert_allclose(log.from_linear(np.float32([[2, 4, 8]])), [[1, 2, 3]], rtol=1e-3)
    monkeypatch.setenv("OCIO", str(config))
    np.testing.assert_allclose(colour_space("half light").to_linear(VALUES), VALUES / 2, rtol=1e-5)
    with pytest.raises(SettingsError, match="no colour space 'absent'"):
        colour_space("absent", config)


def test_built_in_spaces_equal_those_of_opencolorio() -> None:
    pytest.importorskip("PyOpenColorIO", reason="the package opencolorio is not installed")
    for ours, theirs in (("acescg", "ACEScg"), ("aces2065-1", "ACES2065-1"), ("rec2020", "Linear Rec.2020"),
                         ("p3-d65", "Linear P3-D65"), ("linear", "Linear Rec.709 (sRGB)")):
        other = colour_space(theirs, "ocio://default")
        np.testing.assert_allclose(colour_space(ours).to_linear(VALUES), other.to_linear(VALUES), rtol=1e-4, atol=1e-4)
        assert other.chromaticities == pytest.approx(colour_space(ours).chromaticities, abs=1e-5)


def test_an_invalid_configuration_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("PyOpenColorIO", reason="the package opencolorio is not installed")
    (tmp_path / "bad.ocio").write_text("no configuration")
    with pytest.raises(SettingsError, match=r"bad\.ocio cannot be read"):
        colour_space("ACEScg", tmp_path / "bad.ocio")


def test_blender_s_library_is_used_inside_blender() -> None:
    """In a Blender without the package, by the library and the configuration that ship with it."""
    root = Path(__file__).resolve().parents[2]
    older = root / ".venv-bpy45" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not older.is_file():
        pytest.skip(f"there is no {older} (`make setup` makes it)")
    code = ("import os, sys, pathlib, bpy, numpy\n"
            "assert 'PyOpenColorIO' not in sys.modules\n"
            "sys.path.insert(0, sys.argv[1])\n"
            "from core.colour import colour_space\n"
            "config = next(pathlib.Path(bpy.utils.system_resource('DATAFILES')).rglob('config.ocio'))\n"
            "print(colour_space('ACEScg', config).to_linear(numpy.float32([[0.1, 0.5, 1]])).tolist())\n"
            "sys.stdout.flush()\n"
            "os._exit(0)")
    ended = subprocess.run([older, "-c", code, root], capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stderr
    expected = colour_space("acescg").to_linear(np.float32([[0.1, 0.5, 1]]))
    np.testing.assert_allclose(json.loads(ended.stdout.splitlines()[-1]), expected, atol=2e-3)


@pytest.mark.parametrize("data", [b"curv" + bytes(4) + (2).to_bytes(4, "big") + b"\0\1\0", b"curv" + bytes(7)])
def test_a_curve_that_is_cut_short_is_damaged(data: bytes) -> None:
    with pytest.raises(UnreadableProfile, match="damaged"):
        _parse_curve(data)
