# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores against their definitions, and eval.json."""
from __future__ import annotations

import json
import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.errors import SettingsError
from core.images.picture import Picture
from core.metrics.evaluation import (
    clipped_mask,
    format_table,
    is_worse_than_empty,
    score_view,
    summarise,
    unscored_mask,
)
from core.metrics.flip import flip_map
from core.metrics.pictures import flip, psnr, relative_l2, ssim
from tests.core import flared


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    image = random.random((40, 50, 3))
    return image, np.clip(image + 0.1 * random.standard_normal(image.shape), 0, 1)


# ---- PSNR and the relative error ------------------------------------------------------------------


def test_psnr_of_a_constant_error() -> None:
    """An error of a tenth everywhere is 20 dB; equal pictures have infinite PSNR."""
    assert psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)) == pytest.approx(20)
    assert psnr(np.ones((4, 4)), np.ones((4, 4))) == math.inf


def test_psnr_scores_only_the_mask() -> None:
    image, target, keep = np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.ones((4, 4), bool)
    image[0, 0], keep[0, 0] = 1, False
    assert psnr(image, target) < 20
    assert psnr(image, target, keep) == math.inf
    assert math.isnan(psnr(image, target, np.zeros((4, 4), bool)))


def test_relative_error_of_an_empty_picture_is_one() -> None:
    target = np.random.default_rng(0).random((4, 4, 3))
    assert relative_l2(np.zeros_like(target), target) == pytest.approx(1)
    assert relative_l2(target * 1.1, target) == pytest.approx(0.1)
    assert math.isnan(relative_l2(target, np.zeros_like(target)))


def test_pictures_of_different_sizes_are_not_compared() -> None:
    for score in (psnr, ssim, relative_l2, flip):
        with pytest.raises(SettingsError):
            score(np.zeros((20, 20, 3)), np.zeros((20, 21, 3)))


# ---- SSIM -----------------------------------------------------------------------------------------


def by_definition(x: np.ndarray, y: np.ndarray) -> float:
    """Return the SSIM of one channel, window by window: Wang et al. 2004, eq. 13 to 16."""
    at = np.arange(11) - 5
    window = np.exp(-(at[:, None] ** 2 + at[None] ** 2) / (2 * 1.5 ** 2))
    window /= window.sum()
    values = []
    for i in range(x.shape[0] - 10):
        for j in range(x.shape[1] - 10):
            a, b = x[i:i + 11, j:j + 11], y[i:i + 11, j:j + 11]
            ma, mb = (window * a).sum(), (window * b).sum()
            va, vb = (window * (a - ma) ** 2).sum(), (window * (b - mb) ** 2).sum()
            cov = (window * (a - ma) * (b - mb)).sum()
            values.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(values))


def test_ssim_is_the_definition(pair: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = pair
    channels = [by_definition(image[..., index], target[..., index]) for index in range(3)]
    assert ssim(image, target) == pytest.approx(np.mean(channels), abs=1e-9)
    assert ssim(image, image) == pytest.approx(1)


def test_ssim_with_padding_is_the_definition_on_the_padded_picture(pair: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = (np.pad(picture, ((5, 5), (5, 5), (0, 0))) for picture in pair)
    assert ssim(*pair, borders="same") == pytest.approx(ssim(image, target), abs=1e-12)
    assert ssim(*pair, borders="same") != pytest.approx(ssim(*pair), abs=1e-6)


def test_ssim_with_padding_is_that_of_scipy(pair: tuple[np.ndarray, np.ndarray]) -> None:
    ndimage = pytest.importorskip("scipy.ndimage")
    x, y = (picture[..., 0] for picture in pair)

    def blurred(picture: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(picture, 1.5, mode="constant", radius=5)

    mx, my = blurred(x), blurred(y)
    vx, vy, cov = blurred(x * x) - mx ** 2, blurred(y * y) - my ** 2, blurred(x * y) - mx * my
    expected = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx ** 2 + my ** 2 + 1e-4) * (vx + vy + 9e-4))
    assert ssim(x, y, "same") == pytest.approx(expected.mean(), abs=1e-9)


def test_ssim_needs_a_window() -> None:
    with pytest.raises(SettingsError, match="11"):
        ssim(np.zeros((10, 30)), np.zeros((10, 30)))


@pytest.mark.parametrize("kind", ["noise", "smooth", "filmed", "opposite", "green and blue"])
@pytest.mark.parametrize("size", [(24, 90), (120, 160)])
def test_flip_agrees_with_its_reference(kind: str, size: tuple[int, int]) -> None:
    reference = pytest.importorskip("flip_evaluator")
    random = np.random.default_rng(0)
    noise = random.random((*size, 3), np.float32)
    target = cv2.resize(random.random((5, 7, 3), np.float32), size[::-1], interpolation=cv2.INTER_CUBIC).clip(0, 1)
    image = np.clip(target + 0.08 * random.standard_normal(target.shape), 0, 1).astype(np.float32)
    if kind == "noise":
        image, target = noise, noise[::-1]
    elif kind == "filmed":
        target = flared_frame(size)
        image = np.roll(target, 3, 1) * np.float32(0.9)
    elif kind == "opposite":
        image, target = np.zeros_like(noise), np.ones_like(noise)
    elif kind == "green and blue":
        image, target = np.broadcast_to(np.eye(3, dtype=np.float32)[1:, None, None], (2, *size, 3))
    image, target = np.ascontiguousarray(image), np.ascontiguousarray(target)
    expected = np.squeeze(reference.evaluate(target, image, "LDR", applyMagma=False)[0])
    np.testing.assert_allclose(flip_map(image, target), expected, atol=1e-4)
    # Not the reference's own mean: it adds up in single precision.
    assert flip(image, target) == pytest.approx(expected.mean(dtype=np.float64), abs=1e-5)


def flared_frame(size: tuple[int, int]) -> np.ndarray:
    """A frame of the tests' capture: dots, and a flare."""
    camera = flared.cameras(3)[1]
    dots = cv2.resize(np.random.default_rng(1).random((20, 30, 3), np.float32), size[::-1],
                      interpolation=cv2.INTER_NEAREST)
    return np.clip(srgb_from_linear(0.3 * dots + cv2.resize(flared.flare(camera), size[::-1])), 0, 1)


def test_flip_of_equal_pictures_is_zero(pair: tuple[np.ndarray, np.ndarray]) -> None:
    assert flip(pair[0], pair[0]) == 0
    assert 0.02 < flip(*pair) < 1
    with pytest.raises(SettingsError):
        flip(pair[0], pair[1][:-1])


# ---- evaluation -----------------------------------------------------------------------------------


def layers() -> tuple[np.ndarray, np.ndarray]:
    """A linear scene and a linear flare."""
    random = np.random.default_rng(1)
    return (0.3 * random.random((16, 20, 3))).astype(np.float32), (0.2 * random.random((16, 20, 3))).astype(np.float32)


def test_an_exact_fit_scores_as_exact() -> None:
    scene, flare = layers()
    frame = Picture(srgb_from_linear(scene + flare), "srgb")
    scores = score_view(scene + flare, scene, frame, Picture(srgb_from_linear(scene), "srgb"), Picture(flare, "linear"))
    for layer in ("composite", "scene", "flare"):
        assert scores[layer]["ssim"] == pytest.approx(1)
        assert scores[layer]["psnr"] > 100
        assert scores[layer]["lpips"] is None
    assert scores["flare_linear"]["relative_l2"] == pytest.approx(0, abs=1e-6)
    assert 5 < scores["flare_linear"]["empty_psnr"] < 25


def test_lpips_scores_the_displayed_layers() -> None:
    scene, flare = layers()
    frame, clean = (Picture(srgb_from_linear(light), "srgb") for light in (scene + flare, scene))
    scores = score_view(scene + flare, scene * np.float32(0.5), frame, clean,
                        lpips=lambda image, target: float(np.abs(image - target).mean()))
    assert scores["composite"]["lpips"] == pytest.approx(0, abs=1e-6)
    expected = np.abs(srgb_from_linear(scene * np.float32(0.5)) - clean.display()).mean()
    assert scores["scene"]["lpips"] == pytest.approx(expected, abs=1e-6)
    assert scores["flare"]["lpips"] is not None and scores["flare"]["lpips"] > 0


def test_the_flare_is_scored_in_display_space() -> None:
    scene, flare = layers()
    frame = Picture(srgb_from_linear(scene + flare), "srgb")
    reference = Picture(srgb_from_linear(scene), "srgb")
    scores = score_view(scene + 0.5 * flare, scene, frame, reference)
    shown = srgb_from_linear(scene + 0.5 * flare) - srgb_from_linear(scene)
    assert scores["flare"]["psnr"] == pytest.approx(psnr(shown, frame.pixels - reference.pixels), abs=1e-3)
    assert scores["flare"]["empty_psnr"] == pytest.approx(psnr(0 * shown, frame.pixels - reference.pixels), abs=1e-3)
    assert "flare_linear" not in scores


def test_clipped_pixels_do_not_count_against_the_linear_flare() -> None:
    scene, flare = layers()
    truth = flare.copy()
    truth[3, 4] = 50
    frame = Picture(np.clip(srgb_from_linear(scene + truth), 0, 1), "srgb")
    assert clipped_mask(frame).sum() == 1
    assert clipped_mask(frame, (frame.size[0] // 2, frame.size[1] // 2)).sum() == 1
    assert not clipped_mask(Picture(scene + truth, "linear")).any()
    scores = score_view(scene + flare, scene, frame, Picture(srgb_from_linear(scene), "srgb"), Picture(truth, "linear"))
    assert scores["flare_linear"]["relative_l2"] == pytest.approx(0, abs=1e-6)


def test_what_a_mask_leaves_out_of_the_fit_is_not_scored(pair: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = (part.astype(np.float32) for part in pair)
    counted = np.ones(image.shape[:2], bool)
    counted[10:30, 10:30] = False
    passer_by = target.copy()
    passer_by[~counted] = 1 - passer_by[~counted]
    light = linear_from_srgb(image)
    scores = [score_view(light, light, Picture(frame, "srgb"), Picture(frame, "srgb"), scored_mask=mask)
              for frame, mask in ((target, counted), (passer_by, counted), (passer_by, None))]
    for layer in ("composite", "scene"):
        alone, passed, unmasked = ({name: scores[index][layer][name] or 0.0 for name in ("psnr", "ssim")}
                                   for index in range(3))
        assert alone["psnr"] == pytest.approx(passed["psnr"], rel=1e-6)
        assert alone["ssim"] == pytest.approx(passed["ssim"], abs=0.02)  # windows reach over the edge of the mask
        assert unmasked["psnr"] < passed["psnr"] - 3
        assert unmasked["ssim"] < passed["ssim"] - 0.05
    none = np.zeros_like(counted)
    assert math.isnan(score_view(light, light, Picture(target, "srgb"), None, scored_mask=none)["composite"]["psnr"])


def test_the_table_says_how_much_masks_leave_out() -> None:
    scores = {**summarise("none", [], (50, 40)), "masked": {"a": 0.5, "b": 0.25}}
    assert "Masks leave 38% of the pixels of 2 views out" in format_table(scores)


def test_exact_layers_reveal_clipping_hidden_by_noise() -> None:
    scene, flare = layers()
    truth = flare.copy()
    truth[3, 4] = 50
    frame = np.clip(srgb_from_linear(scene + truth), 0, 1)
    frame[3, 4] = 0.97  # clipped by the camera, less than white after JPEG

    class Known:
        def frame(self, *_: object) -> Picture:
            return Picture(frame, "srgb")

        def truth_scene(self, *_: object) -> Picture | None:
            return Picture(scene, "linear")

        def truth_flare(self, *_: object) -> Picture | None:
            return Picture(truth, "linear")

    class Unknown(Known):
        def truth_flare(self, *_: object) -> Picture | None:
            return None

    assert not unscored_mask(Unknown(), None).any()
    assert np.argwhere(unscored_mask(Known(), None)).tolist() == [[3, 4]]
    assert unscored_mask(Known(), None, (frame.shape[1] // 2, frame.shape[0] // 2)).sum() == 1


def test_the_summary_is_the_mean_and_json() -> None:
    """The summary has the means over the views, can be written as JSON, and names the worst view in its table."""
    scene, flare = layers()
    frame = Picture(srgb_from_linear(scene + flare), "srgb")
    reference = Picture(srgb_from_linear(scene), "srgb")
    truth = Picture(flare, "linear")
    views = [(f"{gain}.png", score_view(scene + np.float32(gain) * flare, scene, frame, reference, truth))
             for gain in (0.5, 0.75, 1.0)]
    scores = summarise("truth", views, (20, 16))
    text = json.dumps(scores, allow_nan=False)
    again = json.loads(text)
    assert again["reference"] == "truth"
    assert again["flare_linear"]["relative_l2"] == pytest.approx((0.5 + 0.25 + 0) / 3, abs=1e-5)
    assert [view["name"] for view in again["views"]] == ["0.5.png", "0.75.png", "1.0.png"]
    assert set(again["composite"]) == {"psnr", "ssim", "lpips", "flip"}
    shown = format_table(again)
    assert "against the exact layers" in shown
    assert "in 0.5.png" in shown


def test_infinite_scores_become_null() -> None:
    scores = {"composite": {"psnr": math.inf, "ssim": 1.0}, "scene": {"psnr": 20.0, "ssim": 0.5}}
    made = summarise("removed", [("a", {**scores, "flare": scores["scene"]})], (4, 4))
    assert made["composite"] == {"psnr": None, "ssim": 1.0}
    assert "removed/" in format_table(made)


def test_flare_scores_average_the_views_with_a_flare() -> None:
    """Where there is none an empty flare is exact and has no mean: the fit's own score would stand alone there."""
    scene, flare = layers()
    flare[8:] = 0
    reference, shown = (Picture(srgb_from_linear(light), "srgb") for light in (scene, scene + flare))
    astray = scene + flare[::-1]
    black = Picture(0 * flare, "linear")
    views = [("lit.png", score_view(astray, scene, shown, reference, Picture(flare, "linear"))),
             ("dark.png", score_view(scene + np.float32(1e-4), scene, reference, reference, black))]
    alone, both = summarise("truth", views[:1], (20, 16)), summarise("truth", views, (20, 16))
    for layer in ("flare", "flare_linear"):
        of_one_set = [key for key in ("psnr", "empty_psnr", "relative_l2") if key in alone[layer]]
        assert {key: both[layer][key] for key in of_one_set} == {key: alone[layer][key] for key in of_one_set}
        note = f"1 of 2 views show no flare to be scored against: PSNR, empty and rel. L2 of {layer} "
        assert note in format_table(both)
    assert both["flare"]["ssim"] == pytest.approx(np.mean([scores["flare"]["ssim"] for _, scores in views]))
    assert is_worse_than_empty(both)
    assert "show no flare" not in format_table(alone)


def test_a_pixel_that_is_clipped_in_one_channel_is_clipped() -> None:
    pixels = np.full((4, 4, 3), 0.5, np.float32)
    pixels[1, 2, 0] = 1.0
    assert clipped_mask(Picture(pixels, "srgb")).sum() == 1
    flare = np.full((4, 4, 3), 0.1, np.float32)
    flare[2, 3, 0] = 5.0
    capture = SimpleNamespace(frame=lambda _: Picture(np.full_like(flare, 0.5), "srgb"),
                              truth_scene=lambda _: Picture(np.full_like(flare, 0.1), "linear"),
                              truth_flare=lambda _: Picture(flare, "linear"))
    assert unscored_mask(capture, SimpleNamespace()).sum() == 1  # type: ignore[arg-type]
