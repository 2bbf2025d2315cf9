# SPDX-License-Identifier: GPL-3.0-or-later
"""The confidence in a predicted flare, and test-time augmentation."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.removal.inference import confidence
from core.removal.inference.prediction import single_prediction
from core.removal.inference.remover import Remover
from core.removal.inference.test_time_augmentation import shot_confidence
from core.removal.jobs.batch import clean_plates
from core.removal.jobs.mattes import Mattes
from core.removal.model.image_formation import flare_to_linear
from tests.core.recording_progress import RecordingProgress
from tests.core.removal_cases import with_no_glow, write_codes


def graded_dusk(veil: float = 0.0, black: float = 0.0) -> NDArray[np.float32]:
    """(160, 240, 3): a scene with darks of its own, under a veil of light that grows to its right or not, graded so
    that its black is grey."""
    coarse = np.random.default_rng(5).random((80, 120, 1)) ** 2 * (0.9, 0.8, 0.7)
    fine = np.asarray(cv2.resize(coarse, (240, 160), interpolation=cv2.INTER_LINEAR))
    light = fine**2 + veil * np.linspace(0, 2, 240)[None, :, None]
    return np.asarray(black + (1 - black) * np.sqrt(np.clip(light, 0, 1)), np.float32)


def predict_lifted_darks(_: Remover, view: NDArray[np.float32]) -> NDArray[np.float32]:
    """Column by column what the darkest places have, as if it were a veil; of the smaller view half as much."""
    of_all = 1 if view.shape[1] in (256, 480) else 0.5  # and 192, 384
    darks = of_all * (cv2.erode(view.min(0, keepdims=True), np.ones((1, 41))) - 0.01)
    return with_no_glow(np.broadcast_to(np.maximum(darks, 0), view.shape).astype(np.float32))


@pytest.mark.parametrize(("in_two", "expected"), [(0.0, 1), (0.15, 1), (0.9, 0)])
def test_disagreement_of_the_augmentations_lowers_the_confidence(
        flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch, in_two: float, expected: float) -> None:
    """Four augmentations agree on a flare in the left half of the frame; only two predict one in the right half.

    Two further predictions are of the frame with its black point stretched.
    """
    share = 1 / (1 + 0.8**2)  # of its two views, by their pixels
    shown: list[tuple[int, ...]] = []

    def predict(_: Remover, view: NDArray[np.float32]) -> NDArray[np.float32]:
        upright, middle = len(shown) % 2 == 0, view.shape[1] // 2
        added = np.zeros_like(view)
        added[:, :middle] = 0.1
        if len(shown) < 2:
            added[:, middle:] = in_two
        shown.append(view.shape)
        return with_no_glow(added if upright else added[::-1, ::-1])

    monkeypatch.setattr(Remover, "_forward", predict)
    made = Remover(flare_everywhere).predict(np.full((160, 320, 3), (0.5, 0.6, 0.7), np.float32))  # no dark frame
    assert shown == [(160, 320, 3)] * 2 + [(128, 256, 3)] * 2 + [(160, 320, 3)] * 2
    assert made.flare.shape == (160, 320, 3) and made.confidence == expected
    np.testing.assert_allclose(made.flare[:, :158], 0.1, rtol=1e-4)
    np.testing.assert_allclose(made.flare[:, 162:], in_two * share, rtol=0.02, atol=1e-6)


def test_features_of_a_spot_on_a_broad_light() -> None:
    """The peak is that of the spot, the fine fraction its share."""
    flare = np.full((160, 240, 3), 0.1, np.float32)
    flare[70:78, 100:108] += 0.4
    mean, spot = flare.mean(), 0.4 * 64 / (160 * 240)
    *logarithms, fine_fraction = confidence.extract_features(np.full_like(flare, 0.5), flare, 0.2 * flare, 0.5 * flare)
    np.testing.assert_allclose(np.exp(logarithms), [
        0.5 + confidence.REGRADED_FLOOR, flare_to_linear(np.full_like(flare, 0.5), flare).mean() + 0.002,
        0.2 + confidence.DISAGREEMENT_FLOOR, 0.5 / mean],
        rtol=1e-3)
    np.testing.assert_allclose(fine_fraction, spot / mean, rtol=1e-3)


def test_a_lifted_black_is_no_flare(flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Remover, "_forward", predict_lifted_darks)
    remover = Remover(flare_everywhere)
    grade, veil = remover.predict(graded_dusk(black=0.04)), remover.predict(graded_dusk(veil=0.1))
    assert grade.flare.mean() > 0.02 and remover.linear_flare(grade).max() == 0
    assert remover.linear_flare(grade, inside_matte=True).max() > 0.01  # an artist has seen a flare there
    assert veil.confidence == 1 and remover.linear_flare(veil).mean() > 0.05


def test_the_log_says_that_a_flare_may_be_a_grade(flare_everywhere: Path, tmp_path: Path,
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Remover, "_forward", predict_lifted_darks)
    frames = {"grade": graded_dusk(black=0.03), "veil": graded_dusk(veil=0.1), "white": np.ones((160, 240, 3))}
    for name, display in frames.items():
        write_codes(tmp_path / name / f"{name}.png", (display * 255 + 0.5).astype(np.uint8))
    plates = [tmp_path / name / f"{name}.png" for name in ("grade", "veil")]
    heard = RecordingProgress()
    clean_plates(plates, tmp_path / "clean", Remover(flare_everywhere), heard)
    assert [said for said in heard.texts if said.startswith("In 1 of them") and "all-white matte" in said
            and "grade.png (0.00)" in said]
    codes = [cv2.imread(str(path)) for path in (plates[0], tmp_path / "clean" / "grade.png")]
    np.testing.assert_array_equal(*codes)

    heard = RecordingProgress()  # as the message says
    matte = Mattes(tmp_path / "white" / "white.png")
    clean_plates(plates[:1], tmp_path / "clean", Remover(flare_everywhere), heard, mattes=matte)
    assert not [said for said in heard.texts if "its grade" in said]
    assert cv2.imread(str(tmp_path / "clean" / "grade.png")).mean() < codes[0].mean() - 1


def test_the_confidence_is_that_of_the_shot(flare_everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A doubtful prediction is trusted in a shot whose other frames have a flare; weights count."""
    monkeypatch.setattr(Remover, "_forward", predict_lifted_darks)
    remover = Remover(flare_everywhere)
    grade, veil = remover.predict_with_tta(graded_dusk(black=0.04)), remover.predict_with_tta(graded_dusk(veil=0.1))
    faint = single_prediction(np.full_like(grade.mean, 0.001))
    assert shot_confidence([(grade, 1)]) == 0 and shot_confidence([(faint, 1)]) == 1
    assert shot_confidence([(grade, 1), (veil, 1), (veil, 1)]) == 1
    assert shot_confidence([(grade, 1), (faint, 1)]) == 0  # the other has no features


@pytest.mark.parametrize("display", [np.zeros((96, 96, 3), np.float32), np.ones((96, 96, 3), np.float32),
                                     np.full((96, 96, 3), 0.3, np.float32)])
def test_a_uniform_frame_has_finite_features(display: NDArray[np.float32]) -> None:
    back = confidence.stretch_black_point(display)
    assert back.dtype == np.float32 and np.isfinite(back).all()
    assert np.isfinite(confidence.extract_features(display, display * 0.1, 0 * display, back).log_odds)
    assert np.isfinite(confidence.extract_features(display, 0 * display, 0 * display, 0 * back).log_odds)
