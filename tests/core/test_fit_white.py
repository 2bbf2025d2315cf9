# SPDX-License-Identifier: GPL-3.0-or-later
"""Float frames are fitted with the light that they hold above white; others as they are, clipped there."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from core.bake.shot import ShotRenderer
from core.capture import Capture, View
from core.colour.srgb import srgb_from_linear
from core.colour.srgb_torch import decode, encode
from core.conventions.run_files import FLARE
from core.errors import SettingsError
from core.fit import FitSettings, Run, fit, preset
from core.fit.frames import Frames, Targets
from core.fit.metering import MAX_WHITE, resolve_white
from core.fit.overrides import override_settings
from core.fit.sky import add_sky_points
from core.fit.trainer import Trainer
from core.flare.compositing import composite, linear_layers
from core.gaussians import Splats
from core.images.picture import Picture
from core.images.read import has_float_pixels
from core.images.write import write_png
from core.look.shot import Shot, ShotFrame
from tests.core.flared import flared_capture, write_light
from tests.core.recording_progress import RecordingProgress

GAIN = 8.0  # the brightest of the flare is 3.6 then
SHOWN = float(srgb_from_linear(np.array(MAX_WHITE)))


@pytest.fixture(scope="module")
def bright(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture.open(flared_capture(tmp_path_factory.mktemp("bright"), float_gain=GAIN))


def quick(iterations: int = 400) -> FitSettings:
    return override_settings(preset("draft", iterations=iterations), {
        "flare.count": 60, "flare.occlusion": False, "holdout": 4, "flare.density.every": 50, "seed": 1})


@pytest.mark.parametrize(("lit", "mode", "white", "said"), [
    (3, "default", MAX_WHITE, "up to 64"), (None, "default", 1.0, ""),
    (3, "split", MAX_WHITE, "up to 64"), (3, "3dgs", MAX_WHITE, "up to 64"),
])
def test_white_is_raised_for_float_frames_above_1(lit: int | None, mode: str, white: float, said: str,
                                                  tmp_path: Path) -> None:
    """lit: the one view that holds light above white, late and for a moment."""
    capture = Capture.open(flared_capture(tmp_path / "c", 6, float_gain=0.3))
    if lit is not None:
        write_light(capture.frame_path(capture.views[lit]), np.full((40, 64, 3), 1.5, np.float32))
    found, says = resolve_white(replace(quick(), mode=mode), Capture.open(capture.folder))
    assert found.white == white
    assert said in "".join(says) and bool(said) == bool(says)


@pytest.mark.parametrize(("folder", "mode", "white"), [
    ("removed", "default", 1.0), ("removed", "split", MAX_WHITE), ("images", "default", 1.0), ("images", "split", 1.0),
])
@pytest.mark.parametrize("number", [0, 3])
def test_one_clipped_file_keeps_white_at_1(folder: str, mode: str, white: float, number: int,
                                           tmp_path: Path) -> None:
    where = flared_capture(tmp_path / "c", 6, float_gain=GAIN)
    path = where / folder / f"{number:04d}.exr"
    write_png(path.with_suffix(".png"), np.full((40, 64, 3), 0.5))
    path.unlink()
    if folder == "images":
        images = where / "sparse" / "0" / "images.txt"
        images.write_text(images.read_text(encoding="utf-8").replace(path.name, path.with_suffix(".png").name),
                          encoding="utf-8")
    settings = replace(quick(), mode=mode, holdout=0)
    found, says = resolve_white(settings, Capture.open(where))
    assert found.white == white
    assert (f"{number:04d}.png cannot" in "".join(says)) == (white == 1)


def test_integer_frames_keep_white_at_1(tmp_path: Path) -> None:
    capture = Capture.open(flared_capture(tmp_path / "c", 5))
    assert resolve_white(quick(), capture) == (replace(quick(), white=1.0), ())


@pytest.mark.parametrize(("name", "kind", "floats"), [
    ("a.exr", np.float32, True), ("a.tif", np.float32, True), ("a.tif", np.uint16, False), ("a.png", np.uint8, False)])
def test_float_files_are_recognised(name: str, kind: type, floats: bool, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "a.exr":
        write_light(path, np.ones((4, 5, 3), np.float32))
    else:
        assert cv2.imwrite(str(path), np.ones((4, 5, 3), kind))
    assert has_float_pixels(path) == floats


def test_frames_keep_light_above_white(bright: Capture) -> None:
    view = bright.views[3]
    light = bright.frame(view).pixels
    assert light.max() > 3
    shown = Frames(bright, display_white=SHOWN).frame(view).numpy()
    np.testing.assert_allclose(shown, srgb_from_linear(light), atol=1e-4)
    np.testing.assert_allclose(Frames(bright).frame(view).numpy(), srgb_from_linear(light).clip(0, 1), atol=1e-5)
    picture = Picture(np.full((1, 1, 3), 1e4, np.float32), "linear")
    assert picture.display(5.0).max() == 5.0


def test_added_light_is_clipped_at_white() -> None:
    scene = torch.full((1, 1, 3), 0.5, requires_grad=True)
    light = torch.full((1, 1, 3), 2.0, requires_grad=True)
    flare = Splats(light, torch.ones(1, 1))
    expected = encode(decode(torch.tensor(0.5)) + 2)
    assert composite(scene, flare, "add").detach().max() == 1
    picture = composite(scene, flare, "add", 6.0)
    torch.testing.assert_close(picture, expected.expand(1, 1, 3))
    picture.sum().backward()
    numeric = (encode(decode(torch.tensor(0.5)) + 2.001) - encode(decode(torch.tensor(0.5)) + 1.999)) / 0.002
    torch.testing.assert_close(light.grad, numeric.expand(1, 1, 3), rtol=1e-3, atol=0)


def test_layers_keep_a_scene_above_white() -> None:
    scene = encode(torch.tensor([0.5, 3.0, 100.0])).expand(1, 1, 3)
    white = float(encode(torch.tensor(MAX_WHITE)))
    for blend in ("add", "over"):
        parts = linear_layers(scene, {}, blend, white)
        torch.testing.assert_close(parts.scene[0, 0], torch.tensor([0.5, 3.0, MAX_WHITE]))
        assert float(linear_layers(scene, {}, blend).scene.max()) == pytest.approx(1)


def light_s_pixel(targets: Targets, capture: Capture) -> tuple[int, int]:
    (x, y), = targets.camera.project(capture.lights[0].xyz)[0].astype(int)
    return int(y), int(x)


def test_a_light_disc_above_white_is_kept_where_frames_differ(bright: Capture) -> None:
    trainer = Trainer(bright, replace(quick(), white=MAX_WHITE))
    targets = trainer.frames.targets(trainer.views[0])
    assert targets.clean is not None
    at = light_s_pixel(targets, bright)
    picture = torch.full_like(targets.frame, 0.5)
    above_white = targets._replace(clean=targets.clean.clone(), frame=targets.frame.clone())
    assert above_white.clean is not None
    above_white.clean[at], above_white.frame[at] = 2.0, 2.4
    sources = trainer._light_disc_mask(above_white)
    assert sources is not None and not sources.any(), "the flare is what the frame has more"
    assert torch.equal(trainer._composite_target(above_white, picture, sources), above_white.frame)
    above_white.frame[at] = 2.0
    sources = trainer._light_disc_mask(above_white)
    assert sources is not None and sources[at] and sources.sum() == 1
    background = trainer._flare_background(above_white, torch.ones_like(picture))
    assert not composite(background, None, "add", MAX_WHITE, sources)[at].any()
    for drawn, wanted in ((0.5, 1.0), (3.0, 3.0)):  # at least white, and as bright as what is round it makes it
        target = trainer._composite_target(above_white, torch.full_like(picture, drawn), sources)
        assert (target[at] == wanted).all()
        target[at] = above_white.frame[at]
        assert torch.equal(target, above_white.frame)


def test_the_flare_background_above_white_is_the_clean_frame_to_the_end(bright: Capture) -> None:
    trainer = Trainer(bright, replace(quick(), white=MAX_WHITE))
    targets = trainer.frames.targets(trainer.views[0])
    assert targets.clean is not None
    scene, hot = torch.full_like(targets.frame, 0.25), targets.clean > 1
    assert hot.any() and not hot.all()
    trainer.iteration = trainer.settings.iterations
    behind = trainer._flare_background(targets, scene)
    assert torch.equal(behind[hot], targets.clean[hot])
    assert (behind[~hot] == 0.25).all()


def test_scenes_above_white_have_a_higher_colour_rate(bright: Capture) -> None:
    rates = [trainer.optimisers.scene.rates["sh"] for trainer in
             (Trainer(bright, replace(quick(), white=white)) for white in (None, 1.0, MAX_WHITE))]
    assert all(isinstance(rate, torch.Tensor) for rate in rates)
    plain, clipped, far = (torch.as_tensor(rate) for rate in rates)
    assert torch.equal(plain, clipped) and (far[0] > 2 * plain[0]).all() and torch.equal(far[1:], plain[1:])


def truth(capture: Capture, view: View) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    scene, flare = capture.truth_scene(view), capture.truth_flare(view)
    assert scene is not None and flare is not None
    return scene.linear(), flare.linear()


def test_a_flare_above_white_is_fitted_as_bright_as_it_is(bright: Capture, tmp_path: Path) -> None:
    heard = RecordingProgress()
    run = fit(bright, quick(), tmp_path / "run", heard)
    assert any("up to 64" in text for text in heard.texts)
    assert Run.open(run.folder).settings.white == MAX_WHITE
    clipped = fit(bright, replace(quick(), white=1.0), tmp_path / "clipped")
    _, views = bright.split(4)
    ratios, errors = [], {"run": [], "clipped": []}
    for view in views:
        scene, flare = truth(bright, view)
        hot = flare.max(-1) > 1
        for one, name in ((run, "run"), (clipped, "clipped")):
            layer = sum(one.render(view.camera).flare_by_light.values())
            errors[name].append(np.square(layer - flare)[hot].mean())
            if one is run:
                ratios.append(layer[hot].sum() / flare[hot].sum())
    assert 0.85 < np.mean(ratios) < 1.15
    assert np.mean(errors["run"]) < 0.6 * np.mean(errors["clipped"])
    view = max(views, key=lambda one: float(truth(bright, one)[0].max()))
    scene = truth(bright, view)[0]
    found = run.render(view.camera).scene
    assert scene.max() > 2 and found.max() > 0.7 * scene.max()
    assert clipped.render(view.camera).scene.max() == pytest.approx(1)
    shot = ShotRenderer(Shot(run.folder / FLARE, (ShotFrame(1, "a", view.camera, ()),), run=run.folder))
    np.testing.assert_allclose(shot.render(shot.shot.frames[0], view.camera).scene, found, atol=1e-4)


def test_a_run_without_white_is_clipped_at_1(bright: Capture, tmp_path: Path) -> None:
    run = fit(bright, replace(quick(12), white=1.0), tmp_path / "run")
    config = run.folder / "config.toml"
    text = config.read_text(encoding="utf-8")
    assert "white = 1.0" in text
    config.write_text(text.replace("white = 1.0\n", ""), encoding="utf-8")
    again = Run.open(run.folder)
    assert again.settings.white is None and again.settings.display_white == 1
    camera = bright.views[0].camera
    np.testing.assert_array_equal(again.render(camera).scene, run.render(camera).scene)


def test_sky_points_are_clipped_at_white(bright: Capture) -> None:
    skies = (add_sky_points(bright, bright.views, Frames(bright, display_white=white)) for white in (SHOWN, 1.0))
    found, plain = (sky.rgb[len(bright.points):].astype(int) for sky in skies)
    assert (found >= plain).all(), "it is drawn up, and no colour begins anew from black"
    assert found.max() == 255


@pytest.mark.parametrize("white", [0.5, 0.0, -1.0, 1e6])
def test_an_invalid_white_is_refused(white: float) -> None:
    with pytest.raises(SettingsError, match="white must lie"):
        replace(quick(), white=white).validated()


def test_clean_frames_clipped_at_white_give_a_warning(tmp_path: Path) -> None:
    folder = flared_capture(tmp_path / "c", 5, float_gain=GAIN)
    for path in sorted((folder / "removed").glob("*.exr")):
        write_png(path.with_suffix(".png"), np.full((40, 64, 3), 0.5))
        path.unlink()
    heard = RecordingProgress()
    fit(Capture.open(folder), quick(2), tmp_path / "run", heard)
    assert any("EXR files for all" in text for text in heard.texts)
