# SPDX-License-Identifier: GPL-3.0-or-later
"""Mattes restrict a removal to marked places."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from core.errors import FrameError, SettingsError
from core.images.exr import read_exr
from core.images.formats import tiff
from core.images.formats.exif import apply_orientation
from core.images.window import DataWindow
from core.images.write import write_exr
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
from core.removal.jobs.manifest import MANIFEST
from core.removal.jobs.mattes import Mattes
from core.system.progress import Progress
from tests.core.removal_cases import picture, write_codes
from tests.core.test_exif import exif_segment


def half_matte(path: Path, width: int, height: int, dtype: type = np.uint8) -> Path:
    """White on the left half, black on the right."""
    values = np.zeros((height, width), dtype)
    values[:, :width // 2] = np.iinfo(dtype).max
    path.parent.mkdir(exist_ok=True)
    return write_codes(path, values)


def full_window(width: int, height: int) -> DataWindow:
    return DataWindow((width, height), (0, 0), (width, height))


@pytest.mark.parametrize(("scale", "dtype"), [(1, np.uint8), (1, np.uint16), (2, np.uint8)])
def test_flares_are_removed_only_where_the_matte_is_white(tmp_path: Path, flare_everywhere: Path, scale: int,
                                                          dtype: type) -> None:
    source = write_codes(tmp_path / "plate.png", picture())
    matte = half_matte(tmp_path / "matte.png", 90 // scale, 60 // scale, dtype)
    clean_plates([source], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress(),
                 mattes=Mattes(matte), flare_folder=tmp_path / "flare")
    clean, flare = cv2.imread(str(tmp_path / "out" / "plate.png")), read_exr(tmp_path / "flare" / "plate.exr")
    difference = np.abs(clean.astype(int) - cv2.imread(str(source))).max(-1)
    assert (difference[:, :44] > 0).mean() > 0.9, "black has nothing to take"
    assert not difference[:, 46:].any()
    assert not flare["R"][:, 46:].any()
    assert (flare["R"][:, :44] > 0).mean() > 0.9


@pytest.mark.parametrize("painted", ["as shown", "on the pixels", "as the plate"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_matte_has_the_orientation_of_its_plate(tmp_path: Path, orientation: int, painted: str) -> None:
    """A telephone held upright stores its photographs on their sides."""
    stored = np.zeros((60, 90), np.uint8)
    stored[:10, :20] = 255
    if painted == "on the pixels" and orientation == 3:
        pytest.skip("it cannot be distinguished from one painted as shown")
    values = apply_orientation(stored, orientation) if painted == "as shown" else stored
    raw = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    segment = exif_segment("MM", orientation, 27) if painted == "as the plate" else b""
    (tmp_path / "matte.jpg").write_bytes(raw[:2] + segment + raw[2:])
    found = Mattes(tmp_path / "matte.jpg").read(Path("a.jpg"), full_window(90, 60), orientation)
    np.testing.assert_allclose(found, stored / 255, atol=0.03)


def test_a_matte_follows_the_windows_of_its_file_and_of_the_plate(tmp_path: Path) -> None:
    """A matte may be cropped to what is painted, cover the frame, or have half its size; the plate may have
    overscan."""
    painted = np.zeros((60, 90), np.float32)
    painted[20:30, 50:70] = 1
    cropped = {"dataWindow": ((50, 20), (69, 29)), "displayWindow": ((0, 0), (89, 59))}
    header = {name: tuple(np.array(corner, np.int32) for corner in corners) for name, corners in cropped.items()}
    write_exr(tmp_path / "cropped.exr", {"Y": painted[20:30, 50:70]}, header=header)
    write_exr(tmp_path / "whole.exr", {"Y": painted})
    write_exr(tmp_path / "half.exr", {"Y": painted[::2, ::2]})
    overscan = DataWindow((110, 72), (-10, -6), (90, 60))
    for name, off in (("cropped.exr", 0), ("whole.exr", 0), ("half.exr", 1)):
        for window in (full_window(90, 60), overscan):
            found = Mattes(tmp_path / name).read(Path("a.exr"), window)
            assert found.shape == window.size[::-1]
            high, wide = np.nonzero(found > 0.5)
            corners = np.array([wide.min(), wide.max(), high.min(), high.max()]) + np.repeat(window.origin, 2)
            assert np.abs(corners - (50, 69, 20, 29)).max() <= off
    write_exr(tmp_path / "pixels.exr", {"Y": np.pad(painted, ((6, 6), (10, 10)))})
    found = Mattes(tmp_path / "pixels.exr").read(Path("a.exr"), overscan)
    np.testing.assert_array_equal(found[6:-6, 10:-10], painted)


def test_a_premultiplied_matte_is_not_multiplied_again(tmp_path: Path) -> None:
    painted = np.full((60, 90, 4), 128, np.uint8)
    encoded = cv2.imencode(".tif", painted)[1].tobytes()
    for kind, expected in ((tiff.ASSOCIATED, 128 / 255), (tiff.UNASSOCIATED, (128 / 255) ** 2)):
        (tmp_path / "matte.tif").write_bytes(tiff.with_tags(encoded, {tiff.EXTRA_SAMPLES: tiff.short(kind)}))
        found = Mattes(tmp_path / "matte.tif").read(Path("a.png"), full_window(90, 60))
        np.testing.assert_allclose(found, expected, atol=1e-3)


def test_a_matte_painted_on_transparency_is_its_alpha(tmp_path: Path) -> None:
    painted = np.full((60, 90, 4), 255, np.uint8)
    painted[:, :45, 3] = 0
    cv2.imwrite(str(tmp_path / "matte.png"), painted)
    found = Mattes(tmp_path / "matte.png").read(Path("a.png"), full_window(90, 60))
    assert not found[:, :45].any()
    assert found[:, 45:].min() == 1


def test_each_plate_has_its_own_matte(tmp_path: Path, flare_everywhere: Path) -> None:
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / "in").mkdir(exist_ok=True)
        write_codes(tmp_path / "in" / name, picture())
    half_matte(tmp_path / "mattes" / "a.png", 90, 60)
    write_exr(tmp_path / "mattes" / "b.exr", {"Y": np.full((60, 90), np.nan)})
    remover, mattes = Remover(flare_everywhere, working_size=64), Mattes(tmp_path / "mattes")
    with pytest.raises(FrameError, match=r"1 of 3 plates .*c\.png has no matte"):
        clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png", MANIFEST]
    assert np.array_equal(cv2.imread(str(tmp_path / "out" / "b.png")), cv2.imread(str(tmp_path / "in" / "b.png")))
    half_matte(tmp_path / "mattes" / "c.png", 90, 60)
    mattes = Mattes(tmp_path / "mattes")
    for made, kept in ((1, 2), (0, 3)):
        found = clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes)
        assert (found["made"], found["kept"]) == (made, kept)
    half_matte(tmp_path / "mattes" / "a.png", 45, 30)
    found = clean_plates([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes)
    assert (found["made"], found["kept"]) == (1, 2), "a matte that was painted again"


def test_mattes_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="missing"):
        Mattes(tmp_path / "none.png")
    matte = Mattes(half_matte(tmp_path / "mattes" / "a.png", 60, 60))
    with pytest.raises(FrameError, match="another shape"):
        matte.read(Path("a.png"), full_window(90, 60))
    half_matte(tmp_path / "mattes" / "a.tif", 60, 60)
    with pytest.raises(SettingsError, match="keep one"):
        Mattes(tmp_path / "mattes")


@pytest.mark.parametrize(("colour", "alpha", "marked"), [
    ("black", "left", "left"), ("white", "left", "left"), ("left", "left", "left"), ("left", "full", "left"),
    ("black", "full", "none"), ("black", "none", "none")])
def test_the_alpha_of_an_exr_matte_counts(colour: str, alpha: str, marked: str, tmp_path: Path) -> None:
    """Rotoscoping tools write the shape into alpha alone, into all channels, or into alpha beside white."""
    left = np.zeros((48, 64), np.float32)
    left[:, :32] = 1
    shapes = {"left": left, "black": 0 * left, "none": 0 * left, "white": 0 * left + 1, "full": 0 * left + 1}
    write_exr(tmp_path / "roto.exr", {**dict.fromkeys("RGB", shapes[colour]), "A": shapes[alpha]})
    found = Mattes(tmp_path / "roto.exr").read(Path("plate.png"), full_window(64, 48))
    np.testing.assert_array_equal(found, shapes[marked])
