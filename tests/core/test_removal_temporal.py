# SPDX-License-Identifier: GPL-3.0-or-later
"""The temporal filter and the neighbouring frames of a shot."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import FrameError
from core.images.plates import Plate
from core.removal.inference import optical_flow
from core.removal.inference.confidence import FlareFeatures
from core.removal.inference.neighbours import NEIGHBOUR_OFFSETS, ShotPredictor, shot_sort_key
from core.removal.inference.prediction import FlarePrediction, TtaPrediction, single_prediction
from core.removal.inference.remover import Remover
from core.removal.inference.temporal import (
    FramePrediction,
    Neighbour,
    filter_in_time,
    frame_features,
    shot_similarity,
)
from core.removal.jobs.batch import clean_plates, collect_plates, collect_with_neighbours
from core.removal.jobs.manifest import MANIFEST
from core.system.progress import Progress

Pixels = NDArray[np.float32]


def scene(seed: int) -> Pixels:
    """(48, 64, 3), smooth."""
    coarse = np.random.default_rng(seed).uniform(0.1, 0.9, (4, 5, 3))
    return np.asarray(cv2.resize(coarse, (64, 48), interpolation=cv2.INTER_LINEAR), np.float32)


def predicted(display: Pixels, flare: Pixels | float) -> FramePrediction:
    """A frame for which every augmentation predicts that flare."""
    return FramePrediction(frame_features(display),
                           single_prediction(np.broadcast_to(np.float32(flare), display.shape)))


def filter_in_shot(frame: FramePrediction, others: list[FramePrediction]) -> FlarePrediction:
    """The prediction for a frame, filtered with those of the others that are of its shot."""
    own = frame.features
    return filter_in_time(frame, [
        Neighbour(other, weight, optical_flow.compute_flow(own.grey, other.features.grey),
                  optical_flow.compute_flow(other.features.grey, own.grey))
        for other in others if (weight := shot_similarity(own, other.features)) > 0])


def filtered_flare(frame: FramePrediction, others: list[FramePrediction]) -> Pixels:
    return filter_in_shot(frame, others).flare


def wall(seed: int = 0) -> Pixels:
    """(96, 192, 3), with texture everywhere."""
    random = np.random.default_rng(seed)
    fine = random.uniform(0.1, 0.5, (24, 48, 3))
    return np.asarray(cv2.resize(fine, (192, 96), interpolation=cv2.INTER_CUBIC), np.float32).clip(0.05, 0.6)


def spot(x: float, y: float = 48) -> Pixels:
    """(96, 192, 3): a soft disc of light, a ghost."""
    at_y, at_x = np.mgrid[:96, :192]
    disc = 0.3 * np.exp(-((at_x - x)**2 + (at_y - y)**2) / (2 * 9**2))
    return np.repeat(disc[..., None], 3, -1).astype(np.float32)


def test_flicker_is_filtered_and_detail_stays() -> None:
    random = np.random.default_rng(0)
    detail = random.uniform(0, 0.02, (96, 192, 3)).astype(np.float32)
    levels = 0.1 + 0.02 * random.standard_normal(9)
    frames = [predicted(wall() + 0.2, level + detail) for level in levels]
    made = [filtered_flare(here, [other for other in frames if other is not here]) for here in frames]
    assert np.std([one.mean() for one in made]) < 0.2 * np.std(levels)
    np.testing.assert_allclose(made[3] - made[3].mean(), detail - detail.mean(), atol=2e-3)


def pan(share: float) -> tuple[list[FramePrediction], list[Pixels]]:
    """Frames of a wall, panned by two pixels a frame, with a ghost that moves the other way by seven, of which this
    share is predicted; and the ghosts."""
    wide = np.hstack([wall(), wall(1)])
    flares = [spot(40 + 7 * frame) for frame in range(13)]
    return [predicted(wide[:, 2 * frame:2 * frame + 192] + flare, share * flare)
            for frame, flare in enumerate(flares)], flares


@pytest.mark.parametrize("share", [0.4, 1.5])
def test_a_wrong_prediction_is_corrected_by_frames_with_the_flare_elsewhere(share: float) -> None:
    frames, flares = pan(share)
    made = filtered_flare(frames[6], [frames[6 + side * offset] for offset in (1, 2, 3, 4, 6) for side in (-1, 1)])
    before, after = (np.square(one - flares[6]).mean() for one in (frames[6].prediction.mean, made))
    assert after < 0.4 * before


def test_a_change_of_exposure_is_no_flare() -> None:
    """A flare is predicted correctly, under exposures that rise and fall."""
    frames, flares = pan(1)
    levels = 0.7 + 0.3 * np.cos(np.arange(13, dtype=np.float32))
    frames = [predicted(frame.features.display * level, flare * level)
              for frame, flare, level in zip(frames, flares, levels, strict=True)]
    made = [filtered_flare(frames[at], [frame for frame in frames if frame is not frames[at]]) for at in range(3, 10)]
    for here, flare, level in zip(made, flares[3:10], levels[3:10], strict=True):
        np.testing.assert_allclose(here, flare * level, atol=0.03)


def test_a_ghost_is_not_drawn_into_frames_that_have_it_elsewhere() -> None:
    frames, flares = pan(1)
    made = filtered_flare(frames[6], [frame for frame in frames if frame is not frames[6]])
    np.testing.assert_allclose(made, flares[6], atol=0.03)


def test_a_light_that_turns_on_is_no_flare() -> None:
    """One frame is lit; the predicted flare is nothing, or elsewhere."""
    lit = wall() + spot(60)
    for flare in (0 * lit, spot(160)):
        here, others = predicted(lit + flare, flare), [predicted(wall() + flare, flare) for _ in range(8)]
        made = filtered_flare(here, others)
        assert made[:, :90].max() < 1e-6


def test_frames_after_a_cut_or_of_another_size_have_no_effect() -> None:
    here = predicted(scene(1), 0.05)
    made = filtered_flare(here, [*(predicted(scene(seed), 0.4) for seed in (2, 3)), predicted(scene(1)[:32, :32], 0.4)])
    np.testing.assert_allclose(made, here.prediction.mean, atol=1e-6)


def test_unrelated_dark_photographs_have_no_effect() -> None:
    """Their skies and flat areas are alike; the prediction for one says nothing about the others."""
    def night(seed: int) -> Pixels:
        lit = np.random.default_rng(seed).random((12, 16, 3)) ** 4
        return np.asarray(cv2.resize(lit, (64, 48), interpolation=cv2.INTER_LINEAR), np.float32) * np.float32(0.15)

    others = [night(seed) for seed in range(1, 9)]
    for level in (0.05, 0.0):
        here = predicted(night(0), level)
        made = filtered_flare(here, [predicted(other, 0.05 - level) for other in others])
        np.testing.assert_allclose(made, np.minimum(here.prediction.mean, here.features.display), atol=1e-3)


def test_frames_of_a_pan_and_of_an_empty_sky_are_of_one_shot() -> None:
    wide = np.asarray(cv2.resize(np.random.default_rng(0).random((12, 40, 3)), (160, 48)), np.float32) * np.float32(0.1)
    grain = np.random.default_rng(1).normal(0.1, 0.002, (2, 48, 64, 3)).astype(np.float32)
    for here, after in ((wide[:, :64], wide[:, 1:65]), grain):
        assert shot_similarity(frame_features(here), frame_features(after)) > 0.5


def test_a_frame_without_neighbours_keeps_its_prediction() -> None:
    random = np.random.default_rng(0)
    flare = 0.1 * random.random((48, 64, 3)).astype(np.float32) * random.integers(0, 2, (48, 64, 1))
    frame = predicted(scene(4), flare)
    assert np.array_equal(filter_in_time(frame, []).flare, frame.prediction.mean)


def test_the_glow_fraction_is_that_of_the_frame_itself() -> None:
    frame = predicted(scene(4), 0.1)
    glow = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32)
    frame = frame._replace(prediction=frame.prediction._replace(glow_fraction=glow))
    still = optical_flow.compute_flow(frame.features.grey, frame.features.grey)
    for about in ([], [Neighbour(predicted(scene(4), 0.1), np.float32(1), still, still)]):
        assert np.array_equal(filter_in_time(frame, about).glow_fraction, glow)


@pytest.mark.parametrize("shape", [(32, 32), (32, 480), (480, 32)])
def test_the_smallest_frames_are_filtered(shape: tuple[int, int]) -> None:
    frame = np.random.default_rng(0).uniform(0.2, 0.8, (*shape, 3)).astype(np.float32)
    made = filtered_flare(predicted(frame, 0.1), [predicted(frame, 0.1) for _ in range(2)])
    np.testing.assert_allclose(made, 0.1, atol=0.01)


def test_the_confidence_is_averaged_over_the_shot() -> None:
    """By itself it counts as scene, the others are plain flares; frames of another shot do not count."""
    even = np.full((48, 64, 3), 0.1, np.float32)
    unlikely, plain = (FlareFeatures(regraded_ratio=0, light=-3, disagreement=disagreement, peak=1, fine_fraction=0.5)
                       for disagreement in (0, -2))
    prediction = single_prediction(even)
    doubtful, *confident = [FramePrediction(frame_features(scene(6)), prediction._replace(features=features))
                            for features in (unlikely, plain, plain)]
    elsewhere = FramePrediction(frame_features(scene(7)), confident[0].prediction)
    assert filter_in_shot(doubtful, []).confidence == 0 and filter_in_shot(doubtful, [elsewhere]).confidence == 0
    assert filter_in_shot(doubtful, confident).confidence == 1


def test_plates_of_a_shot_are_in_natural_order() -> None:
    names = ["a10.png", "a2.png", "b1.png", "a.png", "10a.png", "9b.png"]
    assert [path.name for path in sorted(map(Path, names), key=shot_sort_key)] == [
        "9b.png", "10a.png", "a2.png", "a10.png", "a.png", "b1.png"]


class WaveringRemover(Remover):
    """Predicts another flare for every plate, without a network, and counts its runs."""

    cache_key = "wavering"

    def __init__(self) -> None:
        self.working_size, self.glow, self.runs = 64, "keep at lights", 0

    def to_network_input(self, plate: Plate) -> Pixels:
        display = super().to_network_input(plate)
        display[0, 0] = 0.1 * (int(plate.path.stem[1:]) % 3)  # by which `predict_with_tta` knows the frame
        return display

    def predict_with_tta(self, display: Pixels) -> TtaPrediction:
        self.runs += 1
        return single_prediction(np.full_like(display, 0.1 + 0.2 * display[0, 0, 0]))


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """Twelve equal frames, numbered without leading zeros; the sixth is damaged."""
    folder = tmp_path / "shot"
    folder.mkdir()
    for number in range(1, 13):
        cv2.imwrite(str(folder / f"f{number}.png"), (scene(5) * 255).astype(np.uint8))
    (folder / "f6.png").write_bytes(b"no picture")
    return folder


def means(folder: Path) -> dict[str, float]:
    return {path.stem: float(cv2.imread(str(path)).mean()) for path in folder.glob("*.png")}


def test_a_shot_is_steady_and_each_frame_is_predicted_once(shot: Path, tmp_path: Path) -> None:
    remover = WaveringRemover()
    with pytest.raises(FrameError, match=r"1 of 12 plates.*f6\.png"):
        clean_plates([shot], tmp_path / "out", remover, Progress())
    assert remover.runs == 11
    with pytest.raises(FrameError, match=r"1 of 12"):
        clean_plates([shot], tmp_path / "stills", WaveringRemover(), Progress(), independent=True)
    steady, single = means(tmp_path / "out"), means(tmp_path / "stills")
    assert len(steady) == len(single) == 11
    assert np.std(list(steady.values())) < 0.35 * np.std(list(single.values()))


def test_a_clean_frame_does_not_depend_on_which_others_are_cleaned(shot: Path, tmp_path: Path) -> None:
    (shot / "f6.png").unlink()
    clean_plates([shot], tmp_path / "all", WaveringRemover(), Progress())
    for number in (1, 8):
        clean_plates([shot], tmp_path / "one", WaveringRemover(), Progress(), only={Path(f"f{number}.png")})
    clean_plates([shot / "f3.png"], tmp_path / "one", WaveringRemover(), Progress())
    for path in (tmp_path / "one").glob("*.png"):
        assert path.read_bytes() == (tmp_path / "all" / path.name).read_bytes()
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == ["f1.png", "f3.png", "f8.png",
                                                                          MANIFEST]


def test_mattes_and_results_beside_a_frame_are_no_neighbours(shot: Path) -> None:
    (shot / "matte.png").write_bytes((shot / "f1.png").read_bytes())
    (shot / "clean").mkdir()
    (shot / "clean" / "f1.png").write_bytes((shot / "f1.png").read_bytes())
    found = collect_with_neighbours([shot / "f1.png"], [shot / "clean", shot / "matte.png"])
    assert sorted(found) == sorted(shot.glob("f*.png"))


def test_neighbours_are_found_with_results_above_or_beside_them(shot: Path, tmp_path: Path) -> None:
    for out, flare in ((shot.parent, None), (tmp_path / "clean", shot)):
        frames = sorted(shot.glob("f*.png"))
        for _ in range(2):
            assert sorted(collect_with_neighbours([shot / "f1.png"], [out, flare])) == frames
            assert sorted(path for path, _ in collect_plates([shot], [out, flare])) == frames
            clean_plates([shot / "f1.png"], out, WaveringRemover(), Progress(), flare_folder=flare)


def test_neighbours_are_of_the_same_folder(shot: Path) -> None:
    remover = WaveringRemover()
    ShotPredictor(remover, [shot / "f1.png", shot / "f2.png", shot.parent / "f3.png"]).predict(shot / "f1.png")
    assert remover.runs == 2


def test_the_network_is_not_run_on_other_shots(shot: Path) -> None:
    for number in (2, 3):
        cv2.imwrite(str(shot / f"f{number}.png"), (scene(40 + number) * 255).astype(np.uint8))
    remover = WaveringRemover()
    ShotPredictor(remover, [shot / f"f{number}.png" for number in (1, 2, 3, 4)]).predict(shot / "f1.png")
    assert remover.runs == 2


def test_neighbours_are_sixteen_to_each_side_within_the_shot(tmp_path: Path) -> None:
    """The shot is followed from frame to frame: the first and the last frame of a pan have nothing in common."""
    wide = np.asarray(cv2.resize(np.random.default_rng(0).random((12, 60, 3)), (240, 48)), np.float32)
    for number in range(40):
        frame = wide[:, 4 * number:4 * number + 64] if number < 25 else scene(number)
        cv2.imwrite(str(tmp_path / f"f{number}.png"), (frame * 255).astype(np.uint8))
    paths = [tmp_path / f"f{number}.png" for number in range(40)]
    predicted_paths: list[Path] = []

    class Counting(WaveringRemover):
        def to_network_input(self, plate: Plate) -> Pixels:
            self.last = plate.path
            return Remover.to_network_input(self, plate)

        def predict_with_tta(self, display: Pixels) -> TtaPrediction:
            predicted_paths.append(self.last)
            return super().predict_with_tta(display)

    predictor = ShotPredictor(Counting(), paths)
    assert list(predictor.dependencies(paths[20])) == [*paths[4:20], *paths[21:37]]
    own = predictor.predict(paths[20])[1]
    assert len(predicted_paths) == 1 + len(NEIGHBOUR_OFFSETS) + sum(20 + offset < 25 for offset in NEIGHBOUR_OFFSETS)
    assert own.flare.shape == own.display.shape
