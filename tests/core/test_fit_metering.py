# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames that are exposed otherwise than most are found, and fitted, baked and scored as they were exposed."""
from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from core.capture import Camera, Capture
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.colour.srgb_torch import clip_straight_through, decode, encode, expose
from core.errors import Cancelled, RunError
from core.fit import Run, fit, metering
from core.fit.frames import Frames
from core.fit.sky import add_sky_points
from core.fit.trainer import Trainer
from core.images.write import write_png
from core.system.files import write_text
from tests.core.flared import cameras, flared_capture
from tests.core.recording_progress import RecordingProgress, StopAfter
from tests.core.test_fit import quick

Light = NDArray[np.float32]
SCALE, SIDE, COUNT = 3, 20, 12
"""The cameras' frames are 192x120 pixels; the wall has so many tiles a side, and there are so many frames."""


def wall(folder: Path, filmed: Callable[[int, Light], Light]) -> Capture:
    """Write and open a capture of a wall of tiles at the origin, with a point at each tile.

    filmed: returns a frame's light from its number and the light of the wall, each light (height, width, 3)
    scene-linear.
    """
    tiles = np.random.default_rng(3).uniform(0.05, 0.6, (SIDE, SIDE, 3)).astype(np.float32)
    across = (np.arange(SIDE) + 0.5) / SIDE * 4 - 2
    xyz = np.stack([*np.meshgrid(across, across, indexing="ij"), np.zeros((SIDE, SIDE))], -1).reshape(-1, 3)
    lines = []
    for number, camera in enumerate(seen.scaled(SCALE * seen.width) for seen in cameras(COUNT)):
        centres = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)
        rays = camera.rays(centres.reshape(-1, 2))
        met = camera.position - rays * (camera.position[2] / rays[:, 2:])
        tile = ((met[:, :2] + 2) / 4 * SIDE).astype(int).clip(0, SIDE - 1)
        light = tiles[tile[:, 0], tile[:, 1]].reshape(camera.height, camera.width, 3)
        write_png(folder / "images" / f"{number:04d}.png", srgb_from_linear(filmed(number, light)).clip(0, 1))
        lines.append(_image(number, camera, xyz))
    model = folder / "sparse" / "0"
    write_text(model / "cameras.txt", f"1 PINHOLE {camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} "
                                      f"{camera.cy}\n")
    write_text(model / "images.txt", "".join(lines))
    write_text(model / "points3D.txt", "".join(f"{i + 1} {x} {y} {z} 128 128 128 0.5\n"
                                               for i, (x, y, z) in enumerate(xyz)))
    return Capture.open(folder)


def _image(number: int, camera: Camera, xyz: NDArray[np.float64]) -> str:
    """Two lines of images.txt, with the points that are on the frame."""
    from core.capture.camera import quaternion_from_rotation

    pixels, depth = camera.project(xyz)
    found = " ".join(f"{pixels[i, 0]} {pixels[i, 1]} {i + 1}" for i in np.flatnonzero(camera.contains(pixels, depth)))
    pose = [*quaternion_from_rotation(camera.world_to_camera[:3, :3]), *camera.world_to_camera[:3, 3]]
    return f"{number + 1} {' '.join(map(str, pose))} 1 {number:04d}.png\n{found}\n"


def found(capture: Capture) -> dict[str, float]:
    return metering.measure_exposures(capture, Frames(capture))


def test_equal_exposures_stay_unmeasured(tmp_path: Path) -> None:
    assert not found(wall(tmp_path / "a", lambda _number, light: light))
    noise = np.random.default_rng(1).uniform(0.9, 1.1, (COUNT, 1, 1, 3)).astype(np.float32)
    grain = np.random.default_rng(2).uniform(0.8, 1.25, (SCALE * 40, SCALE * 64, 1)).astype(np.float32)
    assert not found(wall(tmp_path / "b", lambda number, light: light * np.roll(grain, 7 * number, 1)))
    assert not found(wall(tmp_path / "c", lambda number, light: light * noise[number])), "a drift of colour"


@pytest.mark.parametrize("veil", [0.0, 0.1])
def test_exposures_are_measured_under_a_veil(tmp_path: Path, veil: float) -> None:
    """A camera left to itself: the more flare, the less it is exposed."""
    stops = 0.6 * np.sin(np.arange(COUNT))
    capture = wall(tmp_path / "a", lambda number, light: (light + veil * (stops[number] < 0)) * 2 ** stops[number])
    exposures = np.log2(list(found(capture).values()))
    assert exposures == pytest.approx(stops - np.median(stops), abs=0.06)


def test_a_veil_alone_does_not_change_the_exposure(tmp_path: Path) -> None:
    assert not found(wall(tmp_path / "a", lambda number, light: light + np.float32(0.15 * (number % 2))))


def test_points_in_a_glow_are_outliers_of_the_exposure(tmp_path: Path) -> None:
    def glowing(number: int, light: Light) -> Light:
        lit = light.copy()
        lit[:, : lit.shape[1] // 4] += 0.3 * (number % 3)
        return lit * 2 ** (0.5 * (-1) ** number)

    exposures = np.log2(list(found(wall(tmp_path / "a", glowing)).values()))
    assert exposures[::2].mean() - exposures[1::2].mean() == pytest.approx(1.0, abs=0.1)
    assert max(exposures[::2].std(), exposures[1::2].std()) < 0.1


def test_frames_without_points_take_the_nearest_exposure(tmp_path: Path) -> None:
    """They take the exposure of one neighbour, not a mean: a light may be switched on from one frame to the next."""
    def filmed(number: int, light: Light) -> Light:
        return light * (0.0 if number in (4, 5, 6, 7) else 2.0 if number < 6 else 1.0)

    exposures = found(wall(tmp_path / "a", filmed))
    for dark, next_to in ((4, 3), (5, 3), (6, 8), (7, 8)):
        assert exposures[f"{dark:04d}.png"] == exposures[f"{next_to:04d}.png"]
    assert exposures["0003.png"] / exposures["0008.png"] == pytest.approx(2, rel=0.05)


@pytest.mark.parametrize("why", ["few points are lit", "something else lies over it"])
def test_a_frame_with_an_uncertain_exposure_takes_the_nearest(tmp_path: Path, why: str) -> None:
    def filmed(number: int, light: Light) -> Light:
        """Film frames 0 to 5 at twice the light of the later ones; frame 4 gives no reliable exposure, for the reason
        `why`."""
        if number != 4:
            return light * (2.0 if number < 6 else 1.0)
        if why == "few points are lit":
            lit = np.zeros_like(light)
            lit[40:70, 60:90] = 1
            return light * lit
        other = np.random.default_rng(5).uniform(0, 0.3, (*light.shape[:2], 1)).astype(np.float32)
        return 0.1 * light + other

    exposures = found(wall(tmp_path / "a", filmed))
    assert exposures["0004.png"] == exposures["0003.png"]


def test_one_frame_of_another_exposure_leaves_the_exposure_fixed(tmp_path: Path) -> None:
    """A single brighter frame is a flash or lightning."""
    assert not found(wall(tmp_path / "a", lambda number, light: light * (1.5 if number == 5 else 1.0)))


def test_unmeasured_exposures_come_from_the_same_folder() -> None:
    assert metering._fill_unmeasured(np.array([1.0, np.nan, np.nan, 3.0]), [Path(name) for name in ("a", "a", "b", "b")]
                            ).tolist() == [1.0, 1.0, 3.0, 3.0]


def test_measured_exposures_can_be_read_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A run with measured exposures opens again, even if these are far from any real exposure."""
    capture = wall(tmp_path / "a", lambda number, light: light * 2.0 ** (number % 2))
    monkeypatch.setattr(metering.PointObservations, "estimate_stops", lambda _: np.linspace(-30, 30, COUNT))
    run = Run.create(tmp_path / "run", quick(10), capture.folder, found(capture))
    assert len(Run.open(run.folder).exposures) == COUNT


def test_exposures_are_not_measured_without_points_of_views(tmp_path: Path) -> None:
    capture = wall(tmp_path / "a", lambda number, light: light * 2.0 ** (number % 2))
    assert found(capture)
    model = capture.folder / "sparse" / "0" / "images.txt"
    poses = model.read_text(encoding="utf-8").splitlines()[::2]
    write_text(model, "".join(f"{pose}\n\n" for pose in poses))
    assert not found(Capture.open(capture.folder))
    (capture.folder / "sparse" / "0" / "points3D.txt").unlink()
    assert not found(Capture.open(capture.folder))


def test_black_frames_have_no_measured_exposure(tmp_path: Path) -> None:
    assert not found(wall(tmp_path / "a", lambda _number, light: 0 * light))


# ---- fits -----------------------------------------------------------------------------------------

STOPS = 0.7


@pytest.fixture(scope="module")
def drifting(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, dict[str, float]]:
    """A capture with a flare whose exposure alternates, two frames up and two down, by STOPS; and the exposures by
    frame."""
    folder = tmp_path_factory.mktemp("drifting") / "capture"
    capture, exposures = Capture.open(flared_capture(folder)), {}
    shutil.rmtree(folder / "truth")
    for number, view in enumerate(capture.views):
        exposures[view.name] = 2 ** (STOPS * (-1) ** (number // 2))
        for kind in ("images", "removed"):
            path = folder / kind / view.name
            light = linear_from_srgb(cv2.imread(str(path)) / np.float32(255)) * exposures[view.name]
            cv2.imwrite(str(path), (srgb_from_linear(light).clip(0, 1) * 255 + 0.5).astype(np.uint8))
    return Capture.open(folder), exposures


def flare_error(capture: Capture, run: Run) -> float:
    """Return the mean square difference, display values, of the frames from the clean frames plus the fitted flare."""
    errors = []
    for view in run.open_capture().views:
        layers = run.render(view.camera)
        clean = capture.clean_frame(view)
        assert clean is not None
        composite = np.clip(srgb_from_linear(sum(layers.flare_by_light.values(), clean.linear())), 0, 1)
        filmed = capture.frame(view).display()
        errors.append(float(np.square(composite - filmed).mean()))
    return float(np.mean(errors))


@pytest.mark.parametrize("mode", ["default", "split"])
def test_a_fit_uses_measured_exposures(drifting: tuple[Capture, dict[str, float]], tmp_path: Path, mode: str,
                                       monkeypatch: pytest.MonkeyPatch) -> None:
    capture, exposures = drifting
    monkeypatch.setattr(metering, "measure_exposures", lambda *_: exposures)
    fixed = fit(capture, quick(400, mode=mode, exposure="fixed"), tmp_path / "fixed")
    assert not (fixed.folder / "exposures.json").exists()
    heard = RecordingProgress()
    as_found = fit(capture, quick(400, mode=mode), tmp_path / "found", heard)
    assert any("exposure changes, by about 1.4 stops" in text for text in heard.texts)
    assert as_found.exposures == exposures
    assert flare_error(capture, as_found) < 0.3 * flare_error(capture, fixed)


@pytest.mark.parametrize("blend", ["add", "over"])
def test_a_view_is_rendered_at_its_exposure(drifting: tuple[Capture, dict[str, float]], tmp_path: Path, blend: str,
                                            monkeypatch: pytest.MonkeyPatch) -> None:
    capture, exposures = drifting
    monkeypatch.setattr(metering, "measure_exposures", lambda *_: exposures)
    run = Run.open(fit(capture, quick(20, blend=blend), tmp_path / "run").folder)
    view = next(view for view in run.open_capture(need_frames=False).views if exposures[view.name] < 1)
    own, usual = run.render(view.camera), run.render(replace(view.camera, exposure=1.0))
    inside = usual.scene.max(-1) < 0.99  # what is clipped in the one is not in the other
    assert own.scene[inside] == pytest.approx(exposures[view.name] * usual.scene[inside], abs=1e-4)
    flare, of_usual = (sum(one.flare_by_light.values()) for one in (own, usual))
    assert np.abs(of_usual).max() > 1e-3
    if blend == "add":
        assert flare == pytest.approx(exposures[view.name] * of_usual, rel=1e-4, abs=1e-5)
    else:
        assert 0.3 < np.abs(flare).sum() / np.abs(of_usual).sum() < 0.9


def test_a_resumed_fit_keeps_its_exposures(drifting: tuple[Capture, dict[str, float]], tmp_path: Path,
                                           monkeypatch: pytest.MonkeyPatch) -> None:
    capture, exposures = drifting
    monkeypatch.setattr(metering, "measure_exposures", lambda *_: exposures)
    whole = fit(capture, quick(30), tmp_path / "whole")
    with pytest.raises(Cancelled):
        fit(capture, quick(30), tmp_path / "run", StopAfter(12, "fit"))
    monkeypatch.setattr(metering, "measure_exposures", lambda *_: pytest.fail("they are known"))
    assert fit(capture, quick(30), tmp_path / "run", resume=True).fingerprint == whole.fingerprint


def test_a_fit_stops_while_exposures_are_measured(drifting: tuple[Capture, dict[str, float]],
                                                  tmp_path: Path) -> None:
    with pytest.raises(Cancelled, match="look at exposures"):
        fit(drifting[0], quick(10), tmp_path / "run", StopAfter(3, "look at exposures"))
    assert not (tmp_path / "run").exists()


def test_a_resumed_fit_without_exposures_gets_none(drifting: tuple[Capture, dict[str, float]], tmp_path: Path,
                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit that began without measured exposures, as in earlier versions, goes on without."""
    capture, exposures = drifting
    monkeypatch.setattr(metering, "measure_exposures", lambda *_: {})
    with pytest.raises(Cancelled):
        fit(capture, quick(30), tmp_path / "run", StopAfter(12, "fit"))
    monkeypatch.setattr(metering, "measure_exposures", lambda *_: exposures)
    assert fit(capture, quick(30), tmp_path / "run", resume=True).exposures == {}


@pytest.mark.parametrize("content", ['{"0000.png": 0}', '{"0000.png": "1"}', '{"0000.png": 1e9}', '{"0000.png": NaN}',
                                     "[1]", "{"])
def test_damaged_exposures_are_refused(drifting: tuple[Capture, dict[str, float]], tmp_path: Path,
                                       content: str) -> None:
    run = Run.create(tmp_path / "run", quick(10), drifting[0].folder, {"0000.png": 1.5})
    assert Run.open(run.folder).exposures == {"0000.png": 1.5}
    (run.folder / "exposures.json").write_text(content, encoding="utf-8")
    with pytest.raises(RunError, match=r"exposures\.json"):
        _ = Run.open(run.folder).exposures


def test_exposures_of_a_killed_start_are_removed(drifting: tuple[Capture, dict[str, float]], tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "exposures.json").write_text(json.dumps({"0000.png": 1.5}), encoding="utf-8")
    assert Run.create(tmp_path / "run", quick(10), drifting[0].folder).exposures == {}


def test_a_trainer_renders_each_view_at_its_exposure(drifting: tuple[Capture, dict[str, float]]) -> None:
    capture, exposures = drifting
    trainer = Trainer(capture, quick(5), exposures)
    assert {view.name: view.camera.exposure for view in trainer.views}.items() <= exposures.items()
    targets = trainer.frames.targets(trainer.views[0])
    assert targets.camera.exposure == exposures[trainer.views[0].name]
    assert capture.views[0].camera.exposure == 1


def test_with_unequal_exposures_a_scene_is_clipped_like_its_frames(drifting: tuple[Capture, dict[str, float]]
                                                                     ) -> None:
    """What one frame shows below white may be above it in another."""
    capture, exposures = drifting
    bright = torch.full((2, 2, 3), 1.5)
    assert float(Trainer(capture, quick(5), exposures)._clip_as_filmed(bright).max()) == 1
    assert Trainer(capture, quick(5), {})._clip_as_filmed(bright) is bright


def test_sky_points_have_colours_at_the_median_exposure(drifting: tuple[Capture, dict[str, float]],
                                                        tmp_path: Path) -> None:
    capture, exposures = drifting
    steady = Capture.open(flared_capture(tmp_path / "steady"))

    def sky(one: Capture) -> NDArray[np.float64]:
        points = add_sky_points(one, one.views, Frames(one))
        return linear_from_srgb(points.rgb[len(one.points):] / np.float32(255)).mean(0)

    off, off_without = (np.abs(sky(one) / sky(steady) - 1).mean() for one in (
        capture.with_exposures(exposures), capture))
    assert off < 0.5 * off_without


# ---- the arithmetic -------------------------------------------------------------------------------


def test_exposure_is_applied_in_linear_light() -> None:
    display = torch.linspace(0, 1.2, 25)
    assert expose(display, 1.0) is display
    for times in (0.4, 2.5):
        assert torch.allclose(expose(display, times), encode(times * decode(display)), atol=1e-6)


def test_expose_has_correct_gradients() -> None:
    display = torch.tensor([0.01, 0.03, 0.2, 0.7, 1.1], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda one: expose(one, 1.7), display)


def test_a_clipped_value_has_a_straight_through_gradient() -> None:
    display = torch.tensor([0.5, 1.4], requires_grad=True)
    shown = clip_straight_through(display, 1.0)
    shown.sum().backward()
    assert shown.tolist() == [0.5, 1.0]
    assert display.grad is not None
    assert display.grad.tolist() == [1.0, 1.0]


def test_a_camera_of_exposure_1_has_unchanged_numbers() -> None:
    """A camera's numbers identify its bake, so bakes of versions without exposures stay valid."""
    camera = cameras(1)[0]
    numbers: Any = camera.numbers
    assert len(numbers) == 3
    assert replace(camera, exposure=2.0).numbers[:3] == numbers
    assert replace(camera, exposure=2.0).numbers != numbers
    assert replace(camera, exposure=2.0).scaled(32).exposure == 2.0
