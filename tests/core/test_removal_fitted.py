# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of a capture without the flare that was fitted to them."""
from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.capture import Camera, Capture
from core.capture.discs import light_disc_mask
from core.colour import ColourSpace, colour_space
from core.colour.srgb import LUMINANCE, linear_from_srgb, srgb_from_linear
from core.errors import CaptureError, FrameError, SettingsError
from core.images.exr import read_exr
from core.images.plates import Plate, read_plate
from core.images.read import read_picture
from core.images.write import write_exr, write_png
from core.removal.jobs.fitted import _fit_flare_gains, remove_fitted_flare, subtract_fitted_flare
from core.removal.jobs.manifest import MANIFEST
from core.system.progress import Progress
from tests.core.flared import LIGHT, flare, flared_capture
from tests.core.recording_progress import RecordingProgress


@dataclass
class RenderedLayers:
    scene: np.ndarray
    flare_by_light: dict[str, np.ndarray]


class Exact:
    """A fit of the capture, or of a copy, that found the very scene and flare, by two lights."""

    def __init__(self, capture: Capture) -> None:
        self.capture, self.rendered = capture, 0

    def render(self, camera: Camera) -> RenderedLayers:
        self.rendered += 1
        whole = flare(camera)
        return RenderedLayers(scene_of(self.capture, camera), {"a": whole * 0.25, "b": whole * 0.75})


def scene_of(capture: Capture, camera: Camera) -> np.ndarray:
    """The exact one."""
    view = next(one for one in capture.views
                if np.allclose(one.camera.world_to_camera, camera.world_to_camera, atol=1e-9))
    scene = capture.truth_scene(view)
    assert scene is not None
    return scene.linear()


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return Capture.open(flared_capture(tmp_path / "capture", count=3))


def test_subtracting_the_exact_flare_leaves_the_exact_scene(capture: Capture, tmp_path: Path) -> None:
    out, fitted = tmp_path / "clean", Exact(capture)
    found = remove_fitted_flare(fitted, capture, capture.views, out, Progress(), flare_folder=tmp_path / "flare")
    assert found["made"] == 3
    for view in capture.views:
        filmed, clean = read_picture(capture.frame_path(view)).pixels, read_picture(out / view.name).pixels
        truth = read_picture(capture.folder / "removed" / view.name).pixels
        light = flare(view.camera)
        lit = (filmed.max(-1) < 0.95) & (light.max(-1) > 0.02)
        assert lit.sum() > 50 and np.abs(filmed - truth)[lit].mean() > 0.05
        # what 8 bit codes of a bright frame can say of a dark scene below it
        assert np.abs(linear_from_srgb(clean) - linear_from_srgb(truth))[lit].max() < 0.009
        np.testing.assert_array_equal(clean[light.max(-1) == 0], filmed[light.max(-1) == 0])
        written = read_exr(tmp_path / "flare" / Path(view.name).with_suffix(".exr"))
        np.testing.assert_allclose(np.stack([written[name] for name in "RGB"], -1), light, atol=1e-3)
    assert remove_fitted_flare(fitted, capture, capture.views, out, Progress())["kept"] == 3
    assert fitted.rendered == 3, "what is there is not made again"
    assert remove_fitted_flare(fitted, capture, capture.views[:1], out, Progress(), overwrite=True)["made"] == 1


class Glow:
    """A fit that found a glow, the same by each of two lights, on an even scene; of any camera."""

    def render(self, camera: Camera) -> RenderedLayers:
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height)[:, None] + 0.5 - camera.cy) / camera.fy
        glow = 0.15 * np.exp(-((x - 0.1) ** 2 + (y + 0.05) ** 2) / 0.02)
        layer = (glow[..., None] * np.array([1, 0.5, 0.25])).astype(np.float32)
        return RenderedLayers(np.full_like(layer, 0.2), {"a": layer, "b": layer})


def test_overscan_and_cropped_frames_lose_the_flare_in_its_place(tmp_path: Path) -> None:
    capture = Capture.open(flared_capture(tmp_path / "capture", count=3, float_gain=1.0))
    corners = ((-8, -4, 71, 43), (10, 5, 49, 29), (0, 0, 63, 39))
    for view, (left, top, right, bottom) in zip(capture.views, corners, strict=True):
        layers = Glow().render(view.camera.cropped(left, top, right - left + 1, bottom - top + 1))
        light = layers.scene + sum(layers.flare_by_light.values())
        write_exr(capture.frame_path(view), {name: light[..., k] for k, name in enumerate("RGB")}, header={
            "dataWindow": (np.array([left, top], np.int32), np.array([right, bottom], np.int32)),
            "displayWindow": (np.array([0, 0], np.int32), np.array([63, 39], np.int32))})
    capture = Capture.open(capture.folder)
    remove_fitted_flare(Glow(), capture, capture.views, tmp_path / "clean", Progress())
    for view in capture.views:
        clean = read_exr(tmp_path / "clean" / view.name)
        assert max(float(np.abs(clean[name] - 0.2).max()) for name in "RGB") < 2e-3


def test_grey_frames_lose_the_luminance_of_the_flare(tmp_path: Path) -> None:
    capture = Capture.open(flared_capture(tmp_path / "capture", count=3))
    for view in capture.views:
        layers = Glow().render(view.camera)
        light = (layers.scene + sum(layers.flare_by_light.values())) @ LUMINANCE
        cv2.imwrite(str(capture.frame_path(view)), np.round(srgb_from_linear(light) * 255).astype(np.uint8))
    remove_fitted_flare(Glow(), capture, capture.views, tmp_path / "clean", Progress())
    for view in capture.views:
        codes = cv2.imread(str(tmp_path / "clean" / view.name), cv2.IMREAD_UNCHANGED)
        assert codes.ndim == 2
        assert np.abs(linear_from_srgb(codes.astype(np.float32) / 255) - 0.2).max() < 5e-3


def test_a_light_that_is_off_leaves_no_dark_flare(capture: Capture, tmp_path: Path) -> None:
    """No flare is subtracted for a light that is off, and half of it for a light of half the brightness."""
    for view, share in zip(capture.views, (0.0, 0.5, 1.0), strict=True):
        light = scene_of(capture, view.camera) + np.float32(share) * flare(view.camera)
        write_png(capture.frame_path(view), srgb_from_linear(light).clip(0, 1))
    dimmed = Capture.open(capture.folder)
    progress = RecordingProgress()
    remove_fitted_flare(Exact(capture), dimmed, dimmed.views, tmp_path / "clean", progress)
    assert [text for text in progress.texts if "1 of 3 frames show less than half of the flare that 'a'" in text]
    for view in dimmed.views:
        clean = read_picture(tmp_path / "clean" / view.name).linear()
        lit = (dimmed.frame(view).display().max(-1) < 0.95) & (flare(view.camera).max(-1) > 0.02)
        assert lit.sum() > 50
        assert np.abs(clean - scene_of(capture, view.camera))[lit].max() < 0.012


def test_each_light_has_its_own_gain() -> None:
    random = np.random.default_rng(1)
    scene, *flares = (random.random((80, 120, 3)).astype(np.float32) * top for top in (0.2, 0.3, 0.3))
    wrong = np.where(random.random((80, 120, 1)) < 0.2, 0.2, 0).astype(np.float32)  # what the scene has not
    faint, missing = np.full_like(scene, 1e-4), np.zeros_like(scene)
    lights = {"on": flares[0], "dim": flares[1], "faint": faint, "hidden": missing}
    plate = Plate(Path("a.exr"), scene + flares[0] + 0.3 * flares[1] + wrong, "linear")
    found = _fit_flare_gains(plate, scene, lights)
    assert found["on"] == pytest.approx(1, abs=0.05)
    assert found["dim"] == pytest.approx(0.3, abs=0.05)
    assert found["faint"] == pytest.approx(1, abs=0.05), "what does not show is as it was fitted"
    assert found["hidden"] == 1
    assert _fit_flare_gains(plate, scene, {}) == {}
    for uneven in (0.9, 1.1):  # a frame that is exposed a little otherwise, or a scene that was fitted so
        other = _fit_flare_gains(Plate(Path("a.exr"), plate.codes * np.float32(uneven), "linear"), scene, lights)
        assert other["on"] == pytest.approx(1, abs=0.12)
        assert other["dim"] == pytest.approx(0.3, abs=0.12)
    assert _fit_flare_gains(Plate(Path("a.exr"), 3 * plate.codes, "linear"), scene, lights)["on"] == 1, "never more"


def test_a_plate_that_is_clipped_everywhere_stays_finite() -> None:
    white = Plate(Path("a.png"), np.full((8, 8, 3), 255, np.uint8), "srgb")
    scene, light = np.full((8, 8, 3), 0.5, np.float32), np.full((8, 8, 3), 0.25, np.float32)
    assert _fit_flare_gains(white, scene, {"lamp": light}) == {"lamp": 1.0}


def test_a_faint_flare_is_found_in_a_slightly_dark_frame() -> None:
    random = np.random.default_rng(2)
    scene = random.uniform(0.05, 0.6, (60, 90, 3)).astype(np.float32)
    ghosts = np.where(random.random((60, 90, 1)) < 0.1, 0.06, 0).astype(np.float32) * np.ones(3, np.float32)
    for stops in (-0.15, -0.05, 0.1):
        codes = (scene + ghosts) * np.float32(2**stops)
        assert _fit_flare_gains(Plate(Path("a.exr"), codes, "linear"), scene, {"lamp": ghosts})["lamp"] > 0.85


def test_the_fitted_scene_replaces_clipped_pixels() -> None:
    codes = np.full((2, 2, 3), 255, np.uint8)
    codes[0, 0] = 128
    plate = Plate(Path("a.png"), codes, "srgb")
    light, scene = np.full((2, 2, 3), 0.9, np.float32), np.full((2, 2, 3), 0.5, np.float32)
    light[1, 1] = 0
    clean = subtract_fitted_flare(plate, light, scene)
    assert clean[0, 0].max() == 0, "more flare than there is light"
    assert clean[0, 1, 0] == 188, "0.5 of white"
    assert clean[1, 1, 0] == 255


def test_a_light_disc_stays_as_filmed(capture: Capture, tmp_path: Path) -> None:
    view = capture.views[1]
    x, y = view.camera.project(LIGHT)[0][0]
    codes = cv2.imread(str(capture.frame_path(view)))
    codes[int(y), int(x)] = 255
    codes[2, 3] = 255
    cv2.imwrite(str(capture.frame_path(view)), codes)

    class Bright(Exact):
        def render(self, _camera: Camera) -> RenderedLayers:
            filmed = capture.frame(view).linear()
            return RenderedLayers(np.zeros_like(filmed), {"lamp": filmed})

    remove_fitted_flare(Bright(capture), capture, [view], tmp_path / "clean", Progress(),
                        flare_folder=tmp_path / "flare")
    clean = cv2.imread(str(tmp_path / "clean" / view.name))
    assert (clean[int(y), int(x)] == 255).all()
    assert (clean[2, 3] == 0).all(), "white far from every light is flare"
    written = read_exr(tmp_path / "flare" / Path(view.name).with_suffix(".exr"))
    assert written["G"][int(y), int(x)] == 0, "a flare that was not subtracted is not written"
    assert written["G"][2, 3] == pytest.approx(1, abs=1e-3)


def test_a_light_above_white_keeps_its_brightness_and_loses_its_flare(tmp_path: Path) -> None:
    capture = Capture.open(flared_capture(tmp_path / "bright", count=3, float_gain=8.0))

    class Fitted:
        def __init__(self, lamp: float) -> None:
            self.lamp = lamp

        def render(self, camera: Camera) -> RenderedLayers:
            view = next(one for one in capture.views if one.camera is camera)
            discs = light_disc_mask(capture.frame(view).display(), camera, LIGHT[None])
            lamp = np.float32(self.lamp) * discs[..., None]
            return RenderedLayers(scene_of(capture, camera), {"lamp": flare(camera) * 8 + lamp})

    for lamp, tolerance in ((0.0, 0.02), (100.0, 0.02)):  # the very flare, and one that would take the lamp away
        for shown in (True, False):
            out = tmp_path / f"{lamp}{shown}"
            remove_fitted_flare(Fitted(lamp), capture, capture.views, out, Progress(), above_white=shown)
            for view in capture.views:
                scene, frame = capture.truth_scene(view), capture.frame(view)
                assert scene is not None
                discs = light_disc_mask(frame.display(), view.camera, LIGHT[None])
                assert discs.any()
                found = read_picture(out / view.name).pixels[discs]
                expected = (scene if shown else frame).pixels[discs]
                np.testing.assert_allclose(found, expected, atol=tolerance)


def test_float_plates_keep_values_above_white_below_black_and_non_finite() -> None:
    codes = np.array([[[8.0, np.nan, 0.5]], [[-0.25, np.inf, 0.125]]], np.float32)
    plate = Plate(Path("a.exr"), codes, "linear")
    clean = subtract_fitted_flare(plate, np.full((2, 1, 3), 0.25, np.float32), np.zeros((2, 1, 3), np.float32))
    assert clean[0, 0, 0] == 7.75 and np.isnan(clean[0, 0, 1]) and clean[0, 0, 2] == 0.25
    assert clean[1, 0, 0] == -0.25 and np.isinf(clean[1, 0, 1]) and clean[1, 0, 2] == 0


def test_impossible_jobs_are_refused_before_anything_is_written(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="another folder"):
        remove_fitted_flare(Exact(capture), capture, capture.views, capture.folder / "images", Progress())
    bent = tmp_path / "bent"
    shutil.copytree(capture.folder, bent)
    cameras = bent / "sparse" / "0" / "cameras.txt"
    lines = cameras.read_text(encoding="utf-8").splitlines()
    lines = [line.replace("PINHOLE", "OPENCV") + " 0.1 0 0 0" if line and line[0] != "#" else line for line in lines]
    cameras.write_text("\n".join(lines) + "\n", encoding="utf-8")
    distorted = Capture.open(bent)
    with pytest.raises(CaptureError, match="distorted"):
        remove_fitted_flare(Exact(capture), distorted, distorted.views, tmp_path / "clean", Progress())
    assert not (tmp_path / "clean").exists()


def _as_exr(capture: Capture, folder: Path, space: ColourSpace) -> Capture:
    """Copy a capture with its frames as EXR of a colour space, without clean frames; return the copy."""
    shutil.copytree(capture.folder, folder)
    for path in sorted((folder / "images").iterdir()):
        light = space.from_linear(linear_from_srgb(read_picture(path).pixels))
        write_exr(path.with_suffix(".exr"), {name: light[..., k] for k, name in enumerate("RGB")}, half=False,
                  header={"chromaticities": space.chromaticities} if space.chromaticities else {})
        path.unlink()
    images = folder / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text(encoding="utf-8").replace(".png", ".exr"), encoding="utf-8")
    shutil.rmtree(folder / "removed")
    return Capture.open(folder)


@pytest.mark.parametrize("space", ["linear", "acescg"])
def test_an_exr_frame_keeps_its_format_and_colour_space(capture: Capture, tmp_path: Path, space: str) -> None:
    view = capture.views[0]
    linear = _as_exr(capture, tmp_path / "exr", colour_space(space))
    remove_fitted_flare(Exact(capture), linear, linear.views[:1], tmp_path / "clean", Progress(),
                        flare_folder=tmp_path / "flare")
    name = linear.views[0].name
    clean = read_plate(tmp_path / "clean" / name)
    assert clean.encoding == "linear" and clean.codes.dtype == np.float32 and clean.space.name == space
    truth = linear_from_srgb(read_picture(capture.folder / "removed" / view.name).pixels)
    below = read_picture(capture.frame_path(view)).pixels.max(-1) < 0.99
    assert np.abs(read_picture(tmp_path / "clean" / name).pixels - truth)[below].max() < 0.01
    taken = read_picture(tmp_path / "flare" / name).pixels
    np.testing.assert_allclose(taken, flare(view.camera), atol=2e-3)


def test_clean_frames_of_another_fit_or_capture_are_made_again(capture: Capture, tmp_path: Path) -> None:
    """By what they come from, whatever the times of files: of another fit, frame, camera or light, or by a network."""
    def made(one: Capture, fit: str = "first", **options: bool) -> int:
        found = remove_fitted_flare(Exact(capture), one, one.views, tmp_path / "clean", Progress(), fit_digest=fit,
                                    **options)
        return int(found["made"])

    assert [made(capture), made(capture), made(capture, "second"), made(capture)] == [3, 0, 3, 3]
    shutil.copytree(capture.folder, tmp_path / "again")
    other = Capture.open(tmp_path / "again")
    assert made(other) == 0, "the same capture elsewhere"
    frame = other.frame_path(other.views[1])
    shutil.copyfile(other.frame_path(other.views[0]), frame)
    os.utime(frame, (1, 1))
    assert made(other) == 1
    lights = tmp_path / "again" / "lights.json"
    lights.write_text(lights.read_text(encoding="utf-8").replace("0.3", "0.31"), encoding="utf-8")
    assert made(Capture.open(tmp_path / "again")) == 3
    (tmp_path / "clean" / MANIFEST).unlink()
    with pytest.raises(FrameError, match="may be someone's work"):
        made(capture)
    assert made(capture, overwrite=True) == 3


def test_borders_are_unchanged(capture: Capture, tmp_path: Path) -> None:
    """Borders, also at the black of video levels, are no part of the fitted picture."""
    shutil.copytree(capture.folder, tmp_path / "boxed")
    for path in (tmp_path / "boxed" / "images").iterdir():
        codes = cv2.imread(str(path))
        codes[:7] = codes[-7:] = 16
        cv2.imwrite(str(path), codes)
    boxed = Capture.open(tmp_path / "boxed")
    remove_fitted_flare(Exact(capture), boxed, boxed.views[:1], tmp_path / "clean", Progress(),
                        flare_folder=tmp_path / "flare")
    name = boxed.views[0].name
    before, after = (cv2.imread(str(folder / name)) for folder in (boxed.folder / "images", tmp_path / "clean"))
    taken = read_picture(tmp_path / "flare" / Path(name).with_suffix(".exr")).pixels
    for rows in (slice(0, 7), slice(-7, None)):
        assert np.array_equal(after[rows], before[rows]) and not taken[rows].any()
    assert (after[7:-7] != before[7:-7]).mean() > 0.1


def test_flares_requested_later_are_written(capture: Capture, tmp_path: Path) -> None:
    for flares, made in ((None, 3), (tmp_path / "flare", 3), (tmp_path / "flare", 0)):
        found = remove_fitted_flare(Exact(capture), capture, capture.views, tmp_path / "clean", Progress(),
                                    flare_folder=flares)
        assert found["made"] == made
    with pytest.raises(SettingsError, match="overwritten"):
        linear = _as_exr(capture, tmp_path / "exr", colour_space("linear"))
        remove_fitted_flare(Exact(capture), linear, linear.views, tmp_path / "other", Progress(),
                            flare_folder=linear.folder / "images")
