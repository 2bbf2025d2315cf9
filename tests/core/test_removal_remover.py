# SPDX-License-Identifier: GPL-3.0-or-later
"""The remover: prediction, upsampling and subtraction for single plates."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import SettingsError
from core.images.plates import Plate, read_plate
from core.images.write import write_exr
from core.removal.inference import guided_filter
from core.removal.inference import remover as remover_module
from core.removal.inference.guided_filter import GuidedFilterMaps, upsample_flare
from core.removal.inference.prediction import FlarePrediction, single_prediction
from core.removal.inference.remover import Remover
from tests.core.removal_cases import network_file, picture, with_no_glow


def clean_codes(remover: Remover, codes: NDArray[np.generic]) -> NDArray[np.generic]:
    return remover.remove(plate_of(codes))[0]


def plate_of(codes: NDArray[np.generic]) -> Plate:
    return Plate(Path("plate.png"), codes, "srgb")


def test_a_uniform_flare_is_subtracted_in_linear_light(flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remover = Remover(flare_everywhere, working_size=64)
    monkeypatch.setattr(remover, "linear_flare", lambda prediction, **_: np.full_like(prediction.display, 0.1))
    codes = np.full((300, 200, 3), 180, np.uint8)
    clean = np.asarray(clean_codes(remover, codes))
    expected = np.sqrt((180 / 255) ** 2 - 0.1) * 255
    assert np.abs(clean.astype(float) - expected).max() < 1


def test_a_flare_is_upsampled_along_the_edges_of_clipped_areas(
        flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The predicted flare has the edge of the clipped light; enlarged, that edge must be as sharp as the plate's."""
    remover = Remover(flare_everywhere, working_size=64)
    codes = np.full((512, 512, 3), 80, np.uint8)
    codes[:, 256:] = 255
    monkeypatch.setattr(remover, "linear_flare",
                        lambda prediction, **_: 0.1 * (prediction.display > 0.6).astype(np.float32))
    clean = np.asarray(clean_codes(remover, codes)).astype(int)
    assert np.abs(clean[200:300, 240:256] - 80).max() <= 5, "what is beside the flare keeps its level up to the edge"
    assert (codes[200:300, 258:270].astype(int) - clean[200:300, 258:270]).min() >= 8


def test_codes_without_flare_are_exactly_the_plates(flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remover = Remover(flare_everywhere, working_size=128)

    def corner(prediction: FlarePrediction, *, inside_matte: bool) -> NDArray[np.float32]:
        assert not inside_matte
        flare = np.zeros_like(prediction.display)
        flare[:20, :20] = 0.05
        return flare

    monkeypatch.setattr(remover, "linear_flare", corner)
    random = np.random.default_rng(0)
    for dtype in (np.uint8, np.uint16):
        codes = random.integers(0, np.iinfo(dtype).max, (400, 400, 3), dtype)
        clean = np.asarray(clean_codes(remover, codes))
        assert clean.dtype == codes.dtype
        assert np.array_equal(clean[120:], codes[120:])
        assert np.array_equal(clean[:, 120:], codes[:, 120:])
        assert (clean[:50, :50].astype(int) < codes[:50, :50]).mean() > 0.5


def test_a_plate_without_a_predicted_flare_is_unchanged(no_flare: Path) -> None:
    codes = picture()
    assert np.array_equal(clean_codes(Remover(no_flare, working_size=64), codes), codes)


def test_a_rotated_frame_has_the_same_prediction(flare_everywhere: Path) -> None:
    display = picture(64, 96, 1, np.float32)
    upright = Remover(flare_everywhere).predict(display).flare
    rotated = Remover(flare_everywhere).predict(np.ascontiguousarray(display[::-1, ::-1])).flare
    assert np.ptp(upright) > 1e-3
    np.testing.assert_allclose(rotated[::-1, ::-1], upright, atol=1e-5)


def test_the_glow_fraction_is_what_stays_with_glow_kept(flare_everywhere: Path) -> None:
    """The mean flare without its glow fraction is the flare of a remover that keeps all glow."""
    display = picture(64, 96, 1, np.float32)
    removed, kept = (Remover(flare_everywhere, glow=glow).predict(display) for glow in ("keep at lights", "keep"))
    assert 0.01 < removed.glow_fraction.mean() < 0.99 and kept.glow_fraction.max() == 0
    np.testing.assert_allclose(removed.flare * (1 - removed.glow_fraction), kept.flare, atol=1e-4)


@pytest.mark.parametrize(("frame", "lit", "alone", "counts"), [
    pytest.param((0.24, 0.1, 0.05), (0.24,), 0.1, 1.0, id="red"),
    pytest.param((0.24, 0.1, 0.05), (0.24,), 0.03, 0.0, id="next to nothing"),
    pytest.param((0.24, 0.23, 0.05), (0.24, 0.23), 0.1, 0.0, id="yellow"),
    pytest.param((0.7, 0.325, 0.1), (0.7,), 0.1, 0.5, id="at dusk"),
    pytest.param((0.7, 0.5, 0.4), (0.7,), 0.1, 0.0, id="by day")])
def test_the_per_channel_prediction_counts_for_one_colour_in_the_dark(
         flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch, frame: tuple[float, ...], lit: tuple[float, ...],
        alone: float, counts: float) -> None:
    """A prediction from one channel alone finds, for example, the glow of a red light."""
    def predict(_: Remover, view: NDArray[np.float32]) -> NDArray[np.float32]:
        is_grey = view[0, 0, 0] == view[0, 0, 1]
        lights = is_grey and np.isclose(view[0, 0, 0], lit, atol=1e-3).any()
        return with_no_glow(np.full_like(view, alone if lights else 0.02))

    monkeypatch.setattr(Remover, "_forward", predict)
    added = Remover(flare_everywhere).predict(np.full((160, 320, 3), frame, np.float32)).flare
    expected = 0.02 + (alone - 0.02) * counts * np.isclose(frame, lit[0])
    np.testing.assert_allclose(added[80, 160], expected, rtol=1e-3)


def test_strips_of_rows_join_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)
    found = GuidedFilterMaps(random.random((32, 64, 3), np.float32) * 0.1, random.random((32, 64, 3), np.float32) * 0.2)
    codes = picture(301, 500)
    whole, parts = np.zeros(codes.shape, np.float32), np.zeros(codes.shape, np.float32)
    for rows, light in upsample_flare(found, codes, "srgb", 255):
        whole[rows] = light
    monkeypatch.setattr(guided_filter, "STRIP_ROWS", 7)
    for rows, light in upsample_flare(found, codes, "srgb", 255):
        parts[rows] = light
    np.testing.assert_allclose(parts, whole, atol=2e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (700, 1), (33, 47), (64, 64), (31, 2000)])
def test_plates_of_any_shape_are_cleaned(flare_everywhere: Path, shape: tuple[int, int]) -> None:
    codes = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    assert np.asarray(clean_codes(Remover(flare_everywhere, working_size=96), codes)).shape == codes.shape


def test_keeping_glow_removes_no_more(flare_everywhere: Path) -> None:
    codes = picture()
    with_glow, without_glow = (
        np.asarray(clean_codes(Remover(flare_everywhere, working_size=96, glow=glow), codes)).astype(int)
        for glow in ("keep", "keep at lights"))
    assert (with_glow >= without_glow - 1).mean() > 0.98
    assert with_glow.mean() > without_glow.mean()


@pytest.mark.parametrize("size", [0, 63, 10_000])
def test_a_working_size_out_of_range_is_refused(flare_everywhere: Path, size: int) -> None:
    with pytest.raises(SettingsError, match="working size"):
        Remover(flare_everywhere, working_size=size)


def test_a_very_wide_plate_is_cleaned_over_its_width(flare_everywhere: Path) -> None:
    codes = picture(70, 40_000)
    less = clean_codes(Remover(flare_everywhere, working_size=64), codes) < codes
    assert less[:, :30_000].any() and less[:, 35_000:].any()


def test_a_grey_matte_removes_a_share(flare_everywhere: Path) -> None:
    codes = np.full((60, 90, 3), 180, np.uint8)
    plate = plate_of(codes)
    remover = Remover(flare_everywhere, working_size=64)
    whole, half = (remover.remove(plate, np.full((60, 90), share, np.float32))[1].astype(np.float32).mean()
                   for share in (1, 0.5))
    assert abs(half / whole - 0.5) < 0.03


def test_a_faint_flare_is_removed_inside_a_matte(tmp_path: Path) -> None:
    faint = Remover(network_file(tmp_path / "faint.safetensors", bias=0.9 * remover_module.MIN_FLARE), working_size=64)
    codes = np.full((60, 90, 3), 46_000, np.uint16)
    assert np.array_equal(clean_codes(faint, codes), codes)
    assert (faint.remove(plate_of(codes), np.ones((60, 90), np.float32))[0] < codes).mean() > 0.3


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_a_grey_plate_loses_the_luminance_of_a_flare(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                     flare_everywhere: Path) -> None:
    """A blue one too, and the flare that is written is what the plate has lost."""
    remover = Remover(flare_everywhere, working_size=64)
    blue = np.zeros((64, 96, 3), np.float32)
    blue[..., 2] = 0.2
    monkeypatch.setattr(remover, "predict_with_tta",
                        lambda display: single_prediction(blue[:display.shape[0], :display.shape[1]]))
    path = tmp_path / f"a{suffix}"
    if suffix == ".png":
        cv2.imwrite(str(path), np.full((64, 96), 180, np.uint8))
    else:
        write_exr(path, {"Y": np.full((64, 96), 0.5, np.float32)})
    plate = read_plate(path)
    assert plate.grey
    codes, flare = remover.remove(plate)
    assert (codes < plate.codes).all()
    assert np.ptp(codes, -1).max() == 0
    assert np.ptp(flare.astype(np.float32), -1).max() < 1e-3
