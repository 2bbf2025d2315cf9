# SPDX-License-Identifier: GPL-3.0-or-later
"""The sizes of a coarse-to-fine fit, and a fit that uses them."""
from __future__ import annotations

from pathlib import Path

import pytest
import torch

from core.capture import Capture
from core.fit import trainer as trainer_module
from core.fit.coarse_to_fine import MIN_SIDE, CoarseToFineSettings
from core.fit.frames import Frames
from core.fit.overrides import override_settings
from core.fit.run import Run
from core.fit.run_loop import fit
from core.fit.settings import FitSettings, preset
from core.fit.trainer import Trainer
from core.gaussians.ply import write_ply
from core.images.borders import PictureArea
from tests.core.flared import flared_capture

SETTINGS = CoarseToFineSettings(scene_width=240, scene_until=0.2, flare_width=120, flare_until=0.4)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture.open(flared_capture(tmp_path_factory.mktemp("capture")))


def short_fit(capture: Capture, iterations: int = 20, **changes: object) -> FitSettings:
    """A short fit whose scene is halved until half of it, and its flare quartered, then halved until 0.8."""
    width = capture.views[0].camera.width
    return override_settings(preset("draft", iterations=iterations), {
        "flare.count": 30, "flare.occlusion": False, "holdout": 4, "flare.scene_only_until": 0.1, "separate_until": 0.8,
        "coarse_to_fine.scene_width": width // 2, "coarse_to_fine.scene_until": 0.5,
        "coarse_to_fine.flare_width": width // 4, **changes})


@pytest.mark.parametrize(("width", "sizes"), [
    (480, {0.1: 2, 0.19: 2, 0.21: 1, 1.0: 1}),
    (960, {0.19: 4, 0.21: 2, 0.59: 2, 0.61: 1}),
    (1920, {0.19: 8, 0.59: 4, 0.79: 2, 0.81: 1}),
    (240, {0.0: 1}), (300, {0.0: 1}), (60, {0.0: 1}),
])
def test_the_larger_a_picture_the_later_the_scene_has_its_full_size(width: int, sizes: dict[float, int]) -> None:
    assert {progress: SETTINGS.scene_reduction((width, width), progress) for progress in sizes} == sizes


@pytest.mark.parametrize(("width", "first", "second"), [(480, 4, 2), (1920, 16, 8), (240, 2, 1), (120, 1, 1)])
def test_a_flare_by_itself_begins_small_and_doubles(width: int, first: int, second: int) -> None:
    assert [SETTINGS.flare_reduction((width, width), progress) for progress in (0.1, 0.4, 0.41, 0.8)] == [
        first, first, second, second]


def test_without_widths_pictures_keep_their_size() -> None:
    plain = CoarseToFineSettings()
    assert plain.scene_reduction((4096, 4096), 0.0) == plain.flare_reduction((4096, 4096), 0.0) == 1


def test_reduced_frames_show_the_same_camera_and_light_at_a_smaller_size(capture: Capture) -> None:
    frames, view = Frames(capture), capture.views[0]
    half = frames.reduced(2)
    whole, small = frames.targets(view), half.targets(view)
    assert small.camera.size == (whole.camera.width // 2, whole.camera.height // 2) == small.frame.shape[1::-1]
    assert small.camera.fx == pytest.approx(whole.camera.fx / 2)
    assert float(small.frame.mean()) == pytest.approx(float(whole.frame.mean()), abs=0.01)
    assert frames.targets(view).frame.shape == whole.frame.shape  # the cache keeps both sizes apart


def test_reduced_frames_leave_out_the_borders_too(capture: Capture) -> None:
    frames, view = Frames(capture), capture.views[0]
    width, height = frames.camera(view).size
    frames.picture_area = PictureArea(10, height - 8, 0, width)
    half = frames.reduced(2)
    # One line more on each side, which resizing mixes with the border.
    inside = PictureArea(6, (height - 8) // 2 - 1, 1, width // 2 - 1)
    assert half.picture_area == inside
    targets = half.targets(view)
    assert targets.camera.size == inside.size == targets.frame.shape[1::-1]


def test_a_fit_uses_the_sizes_of_its_schedule(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = short_fit(capture)
    trainer = Trainer(capture, settings)
    scene_widths, flare_widths = [], []
    render_scene, render_flare = trainer_module.render_scene, trainer_module.render_flare

    def note_scene(scene, camera, *args, **keywords):  # type: ignore[no-untyped-def]
        scene_widths.append(camera.width)
        return render_scene(scene, camera, *args, **keywords)

    def note_flare(flare, blend, camera, *args, **keywords):  # type: ignore[no-untyped-def]
        flare_widths.append(camera.width)
        return render_flare(flare, blend, camera, *args, **keywords)

    monkeypatch.setattr(trainer_module, "render_scene", note_scene)
    monkeypatch.setattr(trainer_module, "render_flare", note_flare)
    for _ in range(settings.iterations):
        trainer.step()
    width = capture.views[0].camera.width
    assert scene_widths == [width // 2] * 10 + [width] * 10
    # Iterations 1 and 2 fit the scene alone; from 17 on the flare is fitted together with the scene.
    assert flare_widths == [width // 4] * 6 + [width // 2] * 8 + [width] * 4


def test_a_fit_without_clean_frames_keeps_the_full_size(capture: Capture) -> None:
    trainer = Trainer(capture, short_fit(capture, mode="split"))
    trainer.step()
    (targets, _), (flare_targets, _) = trainer._load_targets_of_step(trainer.views[0])
    assert targets.camera.width == flare_targets.camera.width == capture.views[0].camera.width


def test_a_scene_that_starts_from_a_file_keeps_the_full_size(tmp_path: Path, capture: Capture) -> None:
    write_ply(tmp_path / "scene.ply", Trainer(capture, short_fit(capture)).scene)
    trainer = Trainer(capture, short_fit(capture, **{"scene.start": str(tmp_path / "scene.ply"),
                                                     "coarse_to_fine.flare_width": 0}))
    trainer.iteration = 1
    (targets, _), (flare_targets, _) = trainer._load_targets_of_step(trainer.views[0])
    assert targets.camera.width == flare_targets.camera.width == capture.views[0].camera.width


@pytest.mark.parametrize("size", [(4096, 256), (256, 4096), (1920, 40), (40, 1920), (1, 1)])
def test_no_side_of_a_reduced_picture_is_shorter_than_its_limit(size: tuple[int, int]) -> None:
    reduction = CoarseToFineSettings(scene_width=1, flare_width=1).flare_reduction(size, 0.0)
    assert reduction == 1 or min(size) // reduction >= MIN_SIDE


def test_a_resumed_coarse_fit_equals_the_uninterrupted_one(capture: Capture) -> None:
    settings, half = short_fit(capture), 9
    whole, first, second = (Trainer(capture, settings) for _ in range(3))
    for _ in range(settings.iterations):
        whole.step()
    for _ in range(half):
        first.step()
    second.load_state(first.state())
    for _ in range(settings.iterations - half):
        second.step()
    assert torch.equal(whole.scene.means, second.scene.means)


def test_the_standard_preset_is_coarse_to_fine_and_a_run_keeps_its_sizes(tmp_path: Path, capture: Capture) -> None:
    sizes = {name: preset(name).coarse_to_fine for name in ("draft", "standard", "high", "paper")}
    assert sizes.pop("standard") == CoarseToFineSettings(scene_width=240, flare_width=120)
    assert set(sizes.values()) == {CoarseToFineSettings()}
    fit(capture, short_fit(capture, 4), tmp_path / "run")
    assert Run.open(tmp_path / "run").settings.coarse_to_fine.scene_until == 0.5
