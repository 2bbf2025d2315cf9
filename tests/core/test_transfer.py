# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer of a flare: placement, queries, visibility, plates and layers."""
from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

from core.bake.bake import MANIFEST, BakeSettings, read_manifest
from core.bake.exr import read_layers
from core.capture import Camera, Capture, PointCloud
from core.colour import colour_space
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.errors import CaptureError, RunError, SettingsError
from core.flare import file as flare_file
from core.flare.file import FlareFile
from core.gaussians import SceneGaussians
from core.gaussians.ply import write_ply
from core.images.exr import read_data_window, read_exr
from core.images.plates import Plate
from core.images.window import DataWindow, move_to_window, union_window
from core.images.write import write_exr, write_png
from core.look import KeyedEdits, Look, PlacedLight, TrainedCamera, ViewOfLight, read_look
from core.look.shot import Shot, ShotFrame
from core.system.files import write_json
from core.transfer import query as queries
from core.transfer.plates import ColouredPlate
from core.transfer.sources import assign_sources, parse_assignments
from core.transfer.target import (
    Target,
    _most_similar_sources,
    capture_target,
    picture_target,
    resized,
    shot_target,
    undistorted_background,
)
from core.transfer.transfer import Transfer, TransferSettings
from tests.core.captures import make_capture
from tests.core.flared import cameras
from tests.core.test_look import saved

LIGHT = np.array([0.3, -0.6, 1.5])


@pytest.fixture(scope="module")
def flare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A .flare of one light, whose small bright Gaussians leave most of a picture out of its reach."""
    path = tmp_path_factory.mktemp("flare") / "lamp.flare"
    model = saved(path, lights=1, count=12)
    with torch.no_grad():
        light = model.lights[0]
        light.gaussians["log_scales"] -= 1.2
        for layer in (light.network.head, light.network.correction[2]):
            layer.weight *= 0.02
            layer.bias *= 0.02
    poses = [torch.from_numpy(camera.world_to_camera) for camera in cameras(6)]
    flare_file.save(path, FlareFile(model, "add", TrainedCamera(64, 40, 70.0, 70.0, 33.0, 19.5),
                                    training_views=model.training_views(poses)))
    return path


@pytest.fixture(scope="module")
def look(flare: Path) -> Look:
    return read_look(flare)


def name(look: Look) -> str:
    return look.names[0]


def shot(flare: Path, look: Look, views: list[Camera], xyz: Any = None, shares: list[float] | None = None) -> Shot:
    xyz = look.lights[0].xyz if xyz is None else np.asarray(xyz)
    shares = shares or [1.0] * len(views)
    return Shot(flare, tuple(ShotFrame(number + 1, "Camera", camera, (PlacedLight("lamp", name(look), xyz, share),))
                             for number, (camera, share) in enumerate(zip(views, shares, strict=True))))


def light_of(transfer: Transfer, index: int = 0) -> np.ndarray[Any, Any]:
    one = transfer.target.frames[index]
    return sum(transfer.frame_renderer(one.frame).render(one.shot.camera).flare_by_light.values())  # type: ignore[return-value]


# ---- placement ------------------------------------------------------------------------------------


def test_a_transfer_follows_the_target_camera(flare: Path, look: Look) -> None:
    """Another camera with the same pose: every Gaussian has the same position on the normalised plane."""
    camera = cameras(3)[1]
    other = Camera(150, 60, 120.0, 110.0, 80.0, 25.0, camera.world_to_camera)
    transfer = Transfer(flare, shot_target(shot(flare, look, [camera, other]), look, {}))
    first, second = light_of(transfer, 0), light_of(transfer, 1)
    assert first.max() > 0.02

    def centre(picture: np.ndarray[Any, Any], seen: Camera) -> np.ndarray[Any, Any]:
        weight = picture.sum(-1)
        rows, columns = np.mgrid[:seen.height, :seen.width] + 0.5
        middle = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        return (middle - (seen.cx, seen.cy)) / (seen.fx, seen.fy)

    # Both frames hold the whole flare but for its faintest rims; a pixel is 0.014 of the plane.
    np.testing.assert_allclose(centre(first, camera), centre(second, other), atol=0.02)


def test_the_flare_of_a_picture_lies_at_its_light(look: Look, tmp_path: Path) -> None:
    write_png(tmp_path / "plate.0007.png", np.full((80, 120, 3), 0.2))
    there = picture_target([tmp_path / "plate.0007.png"], look, {"sun": (90.0, 20.0)}, {}, {name(look): 4.0},
                           focal=131.25, centre=(60.0, 40.0))
    one = there.frames[0]
    assert (one.frame.number, one.frame.file) == (7, "layers.0007.exr")
    pixels, depth = one.shot.camera.project(one.shot.lights[0].xyz)
    np.testing.assert_allclose(pixels[0], (90.0, 20.0), atol=1e-9)
    assert depth[0] > 0
    assert np.linalg.norm(one.shot.lights[0].xyz) == pytest.approx(4.0)
    twice = picture_target(2 * [tmp_path / "plate.0007.png"], look, {"sun": (90.0, 20.0)}, {}, {name(look): 4.0})
    assert len(twice.frames) == 1
    with pytest.raises(SettingsError, match="No light was found"):
        picture_target([tmp_path / "plate.0007.png"], look, {}, {}, {name(look): 4.0})


@pytest.mark.parametrize(("size", "expected"), [((96, 54), 70 * 96 / 64), ((54, 96), 70 * 96 / 64),
                                                ((128, 32), 140.0), ((60, 60), 70 * 60 / 64)])
def test_a_portrait_picture_has_the_turned_field_of_view(look: Look, tmp_path: Path, size: tuple[int, int],
                                                         expected: float) -> None:
    """The focal length of an upright picture follows from its long side."""
    write_png(tmp_path / "a.png", np.full((size[1], size[0], 3), 0.2))
    found = picture_target([tmp_path / "a.png"], look, {"sun": (20.0, 12.0)}, {}, {name(look): 4.0})
    assert look.camera.width == 64 and look.camera.fx == 70
    assert found.frames[0].shot.camera.fx == pytest.approx(expected)


def test_detected_lights_show_the_most_similar_source() -> None:
    """Each source once where there are enough; nearest pairs first."""
    def at(*places: tuple[float, float]) -> queries.TrainingViews:
        return queries.TrainingViews(np.zeros((len(places), 3)), np.array(places), np.ones(len(places)))

    seen = {"left": at((-0.3, 0), (-0.2, 0)), "right": at((0.2, 0.1))}
    assert _most_similar_sources({"a": (0.1, 0), "b": (-0.2, 0.1)}, seen) == {"a": "right", "b": "left"}
    assert _most_similar_sources({"a": (0.3, 0), "b": (0.2, 0)}, seen) == {"b": "right", "a": "left"}
    three = _most_similar_sources({"a": (0.3, 0), "b": (0.2, 0), "c": (0.25, 0)}, seen)
    assert three == {"b": "right", "c": "left", "a": "right"}
    assert _most_similar_sources({"a": (0.3, 0)}, {}) == {}


# ---- visibility -----------------------------------------------------------------------------------


def test_hidden_lights_and_lights_behind_the_camera_have_no_flare(flare: Path, look: Look) -> None:
    camera = cameras(3)[1]
    turned = replace(camera, world_to_camera=np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.world_to_camera)
    transfer = Transfer(flare, shot_target(shot(flare, look, [camera, camera, turned], shares=[1, 0, 1]), look, {}),
                        TransferSettings(smooth=0))
    assert light_of(transfer, 0).max() > 0
    assert not light_of(transfer, 1).any()
    assert not light_of(transfer, 2).any()


def slow(count: int) -> list[Camera]:
    """A path so slow that frames are neighbours."""
    return [replace(cameras(1)[0], world_to_camera=np.array(
        [[1, 0, 0, 0.01 * step], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1.0]])) for step in range(count)]


def test_visibility_ramps_to_zero_at_hidden_frames(flare: Path, look: Look) -> None:
    shares = [1.0] * 6 + [0.0] * 3 + [1.0] * 6
    there = shot_target(shot(flare, look, slow(15), shares=shares), look, {})
    transfer = Transfer(flare, there, TransferSettings(smooth=2))
    smooth = [transfer.visibility(index, "lamp") for index in range(15)]
    assert smooth[0] == smooth[-1] == 1
    assert smooth[6:9] == [0, 0, 0]
    assert max(abs(np.diff(smooth))) < 0.5
    assert all(value <= share for value, share in zip(smooth, shares, strict=True))


def test_visibility_is_not_smoothed_across_stills(flare: Path, look: Look) -> None:
    """Frames far apart, or with a number left out, are no path."""
    stills = shot_target(shot(flare, look, cameras(3), shares=[1, 0, 1]), look, {})
    far = Transfer(flare, stills, TransferSettings(smooth=2))
    assert [far.visibility(index, "lamp") for index in range(3)] == [1, 0, 1]
    whole = shot(flare, look, slow(3), shares=[1, 0, 1])
    gaps = replace(whole, frames=tuple(replace(one, frame=2 * one.frame) for one in whole.frames))
    gapped = Transfer(flare, shot_target(gaps, look, {}), TransferSettings(smooth=2))
    assert [gapped.visibility(index, "lamp") for index in range(3)] == [1, 0, 1]


def test_the_scene_of_the_fit_hides_lights_as_in_the_fit(flare: Path, tmp_path: Path) -> None:
    """If splats leave a third of an unoccluded light, a third counts as full visibility."""
    flare_file.save(tmp_path / "veiled.flare", replace(flare_file.load(flare), model=veiled(flare, 1 / 3)))
    look, camera = read_look(tmp_path / "veiled.flare"), cameras(3)[1]
    middle = camera.position + 0.5 * (look.lights[0].xyz - camera.position)
    haze = SceneGaussians(torch.tensor(middle[None], dtype=torch.float32), torch.full((1, 3), 1.0),
                          torch.tensor([[1.0, 0, 0, 0]]), torch.logit(torch.tensor([2 / 3])), torch.zeros(1, 16, 3))
    write_ply(tmp_path / "haze.ply", haze)
    settings = TransferSettings(smooth=0)

    def share(xyz: Any) -> float:
        there = shot_target(shot(flare, look, [camera], xyz=xyz), look, {}, scene=tmp_path / "haze.ply")
        return Transfer(tmp_path / "veiled.flare", there, settings).visibility(0, "lamp")

    assert share(look.lights[0].xyz) == pytest.approx(1, abs=0.03)
    assert share(look.lights[0].xyz + 1e-3) == pytest.approx(1 / 3, abs=0.03), "a world of its own"


def veiled(flare: Path, clear: float) -> Any:
    model = flare_file.load(flare).model
    model.clear.fill_(clear)
    return model


def test_the_scene_of_the_target_hides_its_lights(flare: Path, look: Look, tmp_path: Path) -> None:
    """A wall between camera and light, in one of two views."""
    camera = cameras(3)[1]
    away = replace(camera, world_to_camera=np.array([[1, 0, 0, -3.0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1.0]]))
    middle = camera.position + 0.5 * (look.lights[0].xyz - camera.position)
    wall = SceneGaussians(torch.tensor(middle[None], dtype=torch.float32), torch.full((1, 3), -1.5),
                          torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([9.0]), torch.zeros(1, 16, 3))
    write_ply(tmp_path / "wall.ply", wall)
    there = shot_target(shot(flare, look, [camera, away]), look, {}, scene=tmp_path / "wall.ply")
    transfer = Transfer(flare, there, TransferSettings(smooth=0))
    assert transfer.visibility(0, "lamp") == 0, "splats are never quite opaque, but hide all the same"
    assert transfer.visibility(1, "lamp") == 1
    shown = Transfer(flare, replace(there, scene_is_background=True), TransferSettings(smooth=0))
    rendering = shown.frame_renderer(there.frames[0].frame).render(camera)
    assert rendering.scene.max() > 0.1
    assert rendering.depth.max() > 1
    assert there.scene is not None
    with torch.no_grad():
        there.scene.sh[:, 0] = (3.0 - 0.5) / 0.28209479  # a display value
    for white, brightest in ((1.0, 1.0), (5.9, 12.5)):  # of a wall that is not quite opaque
        there.scene.display_white = white
        scene = shown.frame_renderer(there.frames[0].frame).render(camera).scene
        assert scene.max() == pytest.approx(brightest, rel=0.05)


def test_the_flare_fades_far_outside_the_trained_range(look: Look) -> None:
    light = look.lights[0]
    reach = float(light.query_range.light_high[2])

    def at(distance: float) -> float:
        place = np.array([distance, 0.0], np.float32)
        view = ViewOfLight(np.zeros(3, np.float32), np.eye(3, dtype=np.float32), place, 1.0)
        return queries.extrapolation_fade(light, view)

    assert at(0.9 * reach) == 1
    assert at(2.1 * reach) == 0
    assert np.all(np.diff([at(reach * step) for step in np.linspace(0.9, 2.1, 30)]) <= 0)


# ---- appearance -----------------------------------------------------------------------------------


def test_target_and_blend_equal_the_flare_in_its_own_world(flare: Path, look: Look) -> None:
    camera = cameras(6)[2]
    expected = look.evaluate(camera.world_to_camera)[name(look)]
    seen = queries.training_views(flare, look.lights)
    view = ViewOfLight.of(camera.world_to_camera, look.lights[0].xyz)
    for query in ("target", "blend"):
        found = queries.evaluate(look.lights[0], view, look.lights[0].xyz, query, seen[name(look)])  # type: ignore[arg-type]
        assert found is not None
        np.testing.assert_allclose(found.means, expected.means, atol=1e-6)
        np.testing.assert_allclose(found.colours, expected.colours, atol=1e-6)


def test_blend_averages_training_views_and_changes_smoothly(flare: Path, look: Look) -> None:
    light, seen = look.lights[0], queries.training_views(flare, look.lights)[name(look)]
    assert len(seen.cameras) == 6
    xyz = light.xyz + np.array([100.0, 0, 0])
    means = []
    for step in np.linspace(0, 1, 60):
        view = ViewOfLight(np.float32([100 + 1.2 * (2 * step - 1), 0, -4]), np.eye(3, dtype=np.float32),
                           np.float32([0.05 + 0.1 * step, -0.1]), 5.0)
        queried = queries._weighted_queries(light, view, xyz, "blend", seen, 1.0, None)
        assert sum(weight for weight, _ in queried) == pytest.approx(1)
        assert all(any(np.allclose(one.camera, known, atol=1e-4) for known in seen.cameras) for _, one in queried)
        found = queries.evaluate(light, view, xyz, "blend", seen)
        assert found is not None
        means.append(found.opacities)
    steps = np.abs(np.diff(means, axis=0)).max(1)
    assert steps.max() < 8 * np.median(steps) + 1e-4


@pytest.mark.parametrize("query", ["target", "blend"])
def test_a_slightly_displaced_light_is_in_the_same_world(query: Any, flare: Path,
                                                         look: Look) -> None:
    """Lights are found to a hundredth of their distance or so: the camera is where it is, and nothing is mixed."""
    light, seen, camera = look.lights[0], queries.training_views(flare, look.lights)[name(look)], cameras(6)[2]
    aside = np.array([0.0, np.linalg.norm(camera.position - light.xyz), 0.0])

    def queried_views(share: float) -> list[ViewOfLight]:
        xyz = light.xyz + share * aside
        view = ViewOfLight.of(camera.world_to_camera, xyz)
        return [one for _, one in queries._weighted_queries(light, view, xyz, query, seen, 1.0, None)]

    for share in (0.0, 0.01):
        assert len(queried_views(share)) == 1
        np.testing.assert_allclose(queried_views(share)[0].camera, camera.position, atol=1e-6)
    assert np.linalg.norm(queried_views(0.05)[0].camera - camera.position) > 0.1, "elsewhere it is another world"


def test_dissimilarity_grows_with_position_and_distance() -> None:
    """Half the plane aside is less alike than twice as far, and that less than a tenth of the plane aside."""
    def likest(aside: float, times: float) -> str:
        lights = np.array([[0.1 + aside, 0.0], [0.1, 0.0]])
        seen = queries.TrainingViews(np.zeros((2, 3)), lights, np.array([4.0, 4.0 * times]))
        return ("aside", "farther")[int(seen.dissimilarity((0.1, 0.0), 4.0).argmin())]

    assert likest(0.5, 2.0) == "farther"
    assert likest(0.1, 2.0) == "aside"


def test_source_queries_one_view_for_the_whole_shot(flare: Path, look: Look) -> None:
    views = cameras(5)
    transfer = Transfer(flare, shot_target(shot(flare, look, views), look, {}), TransferSettings(query="source"))
    fixed = transfer._fixed_views_by_light["lamp"]
    assert any(np.allclose(fixed.camera, known, atol=1e-4) for known in transfer.training_views[name(look)].cameras)
    queried = [queries._weighted_queries(look.lights[0], ViewOfLight.of(view.world_to_camera, look.lights[0].xyz),
                                         look.lights[0].xyz, "source", None, 1.0, fixed) for view in views]
    assert all(one == [(1.0, fixed)] for one in queried)


def test_sources_are_assigned_by_request_name_and_turn() -> None:
    assert assign_sources(["lamp", "sun", "moon"], ["lamp", "neon"]) == {"lamp": "lamp", "sun": "lamp", "moon": "neon"}
    assert assign_sources(["sun"], ["lamp", "neon"], parse_assignments(["sun=neon"])) == {"sun": "neon"}
    with pytest.raises(SettingsError, match="no light 'moon'"):
        assign_sources(["sun"], ["lamp"], {"moon": "lamp"})
    with pytest.raises(SettingsError, match="not of the form"):
        parse_assignments(["sun"])


# ---- plates ---------------------------------------------------------------------------------------


def plate_target(path: Path, look: Look) -> Target:
    return picture_target([path], look, {"sun": (20.0, 12.0)}, {}, {name(look): 4.0})


@pytest.mark.parametrize("half", [True, False])
def test_an_acescg_plate_is_unchanged_outside_the_flare(flare: Path, look: Look, tmp_path: Path,
                                                        half: bool) -> None:
    random = np.random.default_rng(3)
    values = (random.standard_normal((90, 160, 3)) * 3).astype(np.float16 if half else np.float32)  # below 0, above 1
    aces = colour_space("acescg")
    write_exr(tmp_path / "plate.0001.exr", {channel: values[..., index] for index, channel in enumerate("RGB")},
              half=half, header={"chromaticities": aces.chromaticities})
    transfer = Transfer(flare, plate_target(tmp_path / "plate.0001.exr", look))
    transfer.bake(tmp_path / "out", settings=BakeSettings(space="acescg"))
    made = read_exr(tmp_path / "out" / "layers.0001.exr")
    crop_to_display_window = read_exr(tmp_path / "out" / "frames" / "plate.0001.exr")
    light = np.stack([made[f"flare.{channel}"] for channel in "RGB"], -1)
    outside = ~(light != 0).any(-1)
    assert 0.2 < outside.mean() < 0.99
    for index, channel in enumerate("RGB"):
        stored = values[..., index].astype(np.float32)
        np.testing.assert_array_equal(made[f"scene.{channel}"], stored)
        np.testing.assert_array_equal(made[channel][outside], stored[outside])
        np.testing.assert_array_equal(crop_to_display_window[channel][outside], stored[outside])
        assert (made[channel] != stored)[~outside].mean() > 0.3
    for path in (tmp_path / "out" / "layers.0001.exr", tmp_path / "out" / "frames" / "plate.0001.exr"):
        with OpenEXR.File(str(path), header_only=True) as file:
            assert file.parts[0].header["chromaticities"] == pytest.approx(aces.chromaticities, abs=1e-6)
    # The flare is the same light, in the plate's primaries.
    plain = sum(transfer.frame_renderer(transfer.target.frames[0].frame).render(
        transfer.target.frames[0].shot.camera).flare_by_light.values())
    np.testing.assert_allclose(aces.to_linear(light), plain, atol=0.01 * plain.max())


def test_a_png_plate_keeps_its_codes_and_gains_light(flare: Path, look: Look, tmp_path: Path) -> None:
    codes = np.random.default_rng(0).integers(0, 65535, (60, 100, 3), np.uint16)
    cv2.imwrite(str(tmp_path / "plate.png"), codes[..., ::-1])
    transfer = Transfer(flare, plate_target(tmp_path / "plate.png", look))
    transfer.bake(tmp_path / "out")
    found = cv2.imread(str(tmp_path / "out" / "frames" / "plate.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    layers = read_layers(tmp_path / "out" / "layers.0001.exr")
    outside = ~(layers.flare != 0).any(-1)
    assert found.dtype == np.uint16
    assert 0.1 < outside.mean() < 0.99
    np.testing.assert_array_equal(found[outside], codes[outside])
    expected = srgb_from_linear(np.clip(layers.composite, 0, 1))
    np.testing.assert_allclose(found / 65535, expected, atol=2e-3)


def boxed(low: tuple[int, int], high: tuple[int, int]) -> tuple[Any, Any]:
    return np.array(low, np.int32), np.array(high, np.int32)


def plate_exr(path: Path, size: tuple[int, int], origin: tuple[int, int], frame: tuple[int, int],
              aspect: float = 1.0) -> Path:
    """A grey plate, `size` pixels of it stored from `origin` on."""
    (x, y), (width, height) = origin, size
    write_exr(path, dict.fromkeys("RGB", np.full((height, width), 0.1, np.float32)), half=False,
              header={"dataWindow": boxed(origin, (x + width - 1, y + height - 1)),
                      "displayWindow": boxed((0, 0), (frame[0] - 1, frame[1] - 1)), "pixelAspectRatio": aspect})
    return path


def lies_at(path: Path) -> tuple[tuple[int, int], ...]:
    """Size, origin and frame of an EXR's pixels; how wide one is the camera says, and the plate for itself."""
    window = read_data_window(path)
    return window.size, window.origin, window.frame


@pytest.mark.parametrize(("size", "origin"), [((120, 80), (-10, -10)), ((100, 30), (0, 20)), ((60, 40), (13, 5))])
def test_the_flare_lies_on_the_frame_for_any_data_window(flare: Path, look: Look, tmp_path: Path,
                                                         size: tuple[int, int], origin: tuple[int, int]) -> None:
    """Overscan, and frames of which a part was left out: to the camera of a picture, and of a shot."""
    whole = plate_exr(tmp_path / "whole.0001.exr", (100, 60), (0, 0), (100, 60))
    (tmp_path / "plates").mkdir()
    plate = plate_exr(tmp_path / "plates" / "plate.0001.exr", size, origin, (100, 60))
    expected = light_of(Transfer(flare, plate_target(whole, look)))
    camera = plate_target(whole, look).frames[0].shot.camera
    light = plate_target(whole, look).frames[0].shot.lights[0]
    one = Shot(flare, (ShotFrame(1, "Camera", camera, (light,)),))
    by_shot = shot_target(one, look, {}, plates=tmp_path / "plates")
    frame_window = DataWindow((100, 60), (0, 0), (100, 60))
    layers_window = union_window([DataWindow(size, origin, (100, 60))])
    for target in (plate_target(plate, look), by_shot):
        found = light_of(Transfer(flare, target))
        assert found.shape == (layers_window.size[1], layers_window.size[0], 3)
        np.testing.assert_allclose(move_to_window(found, layers_window, frame_window), expected, atol=1e-4)
    Transfer(flare, by_shot).bake(tmp_path / "out")
    flared = tmp_path / "out" / "frames" / "plate.0001.exr"
    with OpenEXR.File(str(flared), header_only=True) as file:
        assert file.parts[0].header["dataWindow"][0].tolist() == list(origin)
    np.testing.assert_allclose(read_exr(flared)["R"] - 0.1,
                               move_to_window(found[..., 0], layers_window, read_data_window(plate)), atol=1e-5)
    layers = by_shot.frames[0].frame.file
    assert lies_at(plate) == (size, origin, (100, 60))
    assert lies_at(tmp_path / "out" / layers) == (layers_window.size, layers_window.origin, (100, 60))
    np.testing.assert_allclose(read_exr(tmp_path / "out" / layers)["flare.R"], found[..., 0], atol=1e-5)
    Transfer(flare, resized(by_shot, 50, 30)).bake(tmp_path / "small")
    assert lies_at(tmp_path / "small" / layers) == ((50, 30), (0, 0), (50, 30))


def test_an_overscan_plate_of_another_frame_size_raises(flare: Path, look: Look, tmp_path: Path) -> None:
    plate_exr(tmp_path / "plate.0002.exr", (120, 80), (-10, -10), (100, 60))
    with pytest.raises(SettingsError, match="not the camera's 64 x 40"):
        shot_target(shot(flare, look, [replace(cameras(3)[1], width=64, height=40)] * 2), look, {},
                plates=plate_exr(tmp_path / "plate.0001.exr", (120, 80), (-10, -10), (100, 60)).parent)


def test_plates_may_differ_from_the_shot_in_size_and_not_in_aspect(flare: Path, look: Look,
                                                                   tmp_path: Path) -> None:
    one, plate = shot(flare, look, [cameras(3)[1]]), tmp_path / "plate.0001.png"
    write_png(plate, np.full((80, 128, 3), 0.2))
    assert shot_target(one, look, {}, plates=tmp_path).frames[0].plate == plate
    write_png(plate, np.full((60, 60, 3), 0.2))
    with pytest.raises(SettingsError, match="60 x 60 pixels and the shot 64 x 40, which is another shape"):
        shot_target(one, look, {}, plates=tmp_path)


def test_anamorphic_pixels_are_not_stretched_twice(look: Look, tmp_path: Path) -> None:
    """An anamorphic plate: squeezed as it is stored, round as it is shown."""
    squeezed = plate_target(plate_exr(tmp_path / "plate.exr", (100, 120), (0, 0), (100, 120), aspect=2.0), look)
    camera = squeezed.frames[0].shot.camera
    assert camera.fy == pytest.approx(2 * camera.fx)


def test_no_plate_is_overwritten(flare: Path, look: Look, tmp_path: Path) -> None:
    plates = [tmp_path / side / "frames" / "plate.png" for side in ("left", "right")]
    for path in plates:
        write_png(path, np.full((40, 60, 3), 0.2))
    transfer = Transfer(flare, plate_target(plates[0], look))
    with pytest.raises(SettingsError, match="would be overwritten"):
        transfer.bake(tmp_path / "left")
    with pytest.raises(SettingsError, match="have one name"):
        picture_target(plates, look, {"sun": (20.0, 12.0)}, {}, {name(look): 4.0})
    transfer.bake(tmp_path / "out")
    flared = (tmp_path / "out" / "frames" / "plate.png").read_bytes()
    (tmp_path / "out" / "frames" / "plate.png").unlink()
    transfer.bake(tmp_path / "out")
    assert (tmp_path / "out" / "frames" / "plate.png").read_bytes() == flared


def test_a_plate_with_a_name_that_is_not_utf_8_is_written_and_kept(flare: Path, look: Look, tmp_path: Path) -> None:
    plate = tmp_path / os.fsdecode(b"pl\xe9_0001.png")
    try:
        write_png(plate, np.full((40, 60, 3), 0.2))
    except OSError:
        pytest.skip("this disk has no such names")
    transfer = Transfer(flare, plate_target(plate, look))
    record = transfer.bake(tmp_path / "out")
    flared = tmp_path / "out" / "frames" / plate.name
    assert record["frames"][0]["rest"] == [f"frames/{plate.name}"] and read_manifest(tmp_path / "out") == record
    made = flared.stat().st_mtime_ns
    assert transfer.bake(tmp_path / "out") == record and flared.stat().st_mtime_ns == made
    transfer.bake(tmp_path / "out", settings=BakeSettings(edits=("*.intensity=3",)), overwrite=True)
    assert flared.stat().st_mtime_ns != made


@pytest.mark.parametrize("overwrite", [False, True])
def test_layers_in_the_plates_folder_raise(flare: Path, look: Look, tmp_path: Path, overwrite: bool) -> None:
    """The layers would replace the plates, or be taken for plates the next time."""
    for kind in ("exr", "png"):
        plate = tmp_path / kind / ("layers.0001.exr" if kind == "exr" else "shot.0001.png")
        plate.parent.mkdir()
        if kind == "exr":
            write_exr(plate, dict.fromkeys("RGB", np.full((40, 60), 0.2)))
            write_json(plate.parent / MANIFEST, {"version": 1, "made_from": {}, "layers": {}, "frames": [
                {"file": plate.name, "frame": 1, "width": 60, "height": 40}]})
        else:
            write_png(plate, np.full((40, 60, 3), 0.2))
        before = {path.name: path.read_bytes() for path in plate.parent.iterdir()}
        with pytest.raises(SettingsError, match=r"would be overwritten|among the plates"):
            Transfer(flare, plate_target(plate, look)).bake(plate.parent, overwrite=overwrite)
        assert {path.name: path.read_bytes() for path in plate.parent.iterdir()} == before


def test_an_overwriting_transfer_leaves_no_earlier_frames(flare: Path, look: Look, tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "capture", views=3)
    (folder / "lights.json").write_text('{"lights": [{"name": "sun", "xyz": [0.2, -0.3, 0.5]}]}')
    target = capture_target(Capture.open(folder), look, {})
    Transfer(flare, target).bake(tmp_path / "out")
    assert len(list((tmp_path / "out" / "frames").iterdir())) == 3
    (tmp_path / "out" / "frames" / "notes.txt").touch()
    Transfer(flare, target).bake(tmp_path / "out", [target.frames[1].frame], BakeSettings(edits=("*.intensity=3",)),
                                 overwrite=True)
    plate = target.frames[1].plate
    assert plate is not None
    assert {path.name for path in (tmp_path / "out" / "frames").iterdir()} == {plate.name, "notes.txt"}


def test_layers_in_a_nonlinear_space_raise(flare: Path, look: Look, tmp_path: Path) -> None:
    write_png(tmp_path / "plate.png", np.full((40, 60, 3), 0.2))
    with pytest.raises(SettingsError, match="srgb is not linear"):
        Transfer(flare, plate_target(tmp_path / "plate.png", look)).bake(
            tmp_path / "out", settings=BakeSettings(space="srgb"))


# ---- captures, chunks -----------------------------------------------------------------------------


def test_a_capture_is_rendered_in_chunks(flare: Path, look: Look, tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "capture", views=4)
    (folder / "lights.json").write_text('{"lights": [{"name": "sun", "xyz": [0.2, -0.3, 0.5]}]}')
    target = capture_target(Capture.open(folder), look, {})
    assert [one.plate is not None for one in target.frames] == [True] * 4
    Transfer(flare, target).bake(tmp_path / "whole")
    for part in (slice(2, 4), slice(0, 2)):
        again = Transfer(flare, capture_target(Capture.open(folder), look, {}))
        again.bake(tmp_path / "parts", [one.frame for one in target.frames[part]])
    written = {path.relative_to(tmp_path / "whole").as_posix() for path in (tmp_path / "whole").rglob("*.*")}
    assert written == {"bake.json", *(f"layers.{k:04d}.exr" for k in range(4)),
                       *(f"frames/{k:04d}.png" for k in range(4))}
    for name in sorted(written):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    with pytest.raises(RunError, match="other settings"):
        Transfer(flare, target, TransferSettings(query="source")).bake(tmp_path / "whole")


def test_a_scene_of_another_world_is_refused(look: Look, tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "capture", views=3))
    (tmp_path / "lights.json").write_text('{"lights": [{"name": "sun", "xyz": [0.2, -0.3, 0.5]}]}')
    for offset in (0, 1e5):
        points = PointCloud(capture.points.xyz + np.float32(offset), capture.points.rgb, capture.points.error)
        write_ply(tmp_path / f"{offset:.0f}.ply", SceneGaussians.from_points(points))
    capture_target(capture, look, {}, lights=tmp_path / "lights.json", scene=tmp_path / "0.ply")
    with pytest.raises(CaptureError, match=r"100000\.ply is of another world .* 3 of 3 views have none"):
        capture_target(capture, look, {}, lights=tmp_path / "lights.json", scene=tmp_path / "100000.ply",
                       scene_is_background=True)


@pytest.mark.parametrize(("model", "params"), [("PINHOLE", None), ("OPENCV", (57.6, 57.6, 32, 24, 0.02, 0, 0, 0))])
def test_the_plate_space_setting_overrides_the_file(model: str, params: Any, flare: Path, look: Look,
                                                    tmp_path: Path) -> None:
    """With a lens that distorts as well, whose frames are straightened first."""
    folder = make_capture(tmp_path / "capture", views=3, model=model, params=params)
    (folder / "lights.json").write_text('{"lights": [{"name": "sun", "xyz": [0.2, -0.3, 0.5]}]}')
    scenes = []
    for space in ("srgb", "linear"):
        target = capture_target(Capture.open(folder), look, {})
        transfer = Transfer(flare, target, TransferSettings(plate_space=space))
        scenes.append(transfer.frame_renderer(target.frames[1].frame).render(target.frames[1].shot.camera).scene)
    np.testing.assert_allclose(scenes[0], linear_from_srgb(scenes[1]), atol=0.01)
    assert np.abs(scenes[0] - scenes[1]).mean() > 0.1


@pytest.mark.parametrize("space", ["auto", "acescg", "linear"])
def test_a_distorted_exr_is_converted_once(space: str, look: Look, tmp_path: Path) -> None:
    """An undistorted plate of one colour keeps the light of its file: its colour space is not applied twice."""
    folder = make_capture(tmp_path / "capture", views=3, model="OPENCV", params=(57.6, 57.6, 32, 24, 0.02, 0, 0, 0))
    (folder / "lights.json").write_text('{"lights": [{"name": "sun", "xyz": [0.2, -0.3, 0.5]}]}')
    poses = folder / "sparse" / "0" / "images.txt"
    poses.write_text(poses.read_text().replace(".png", ".exr"))
    for path in (folder / "images").iterdir():
        write_exr(path.with_suffix(".exr"), {channel: np.full((48, 64), value) for channel, value in
                                             zip("RGB", (0.5, 0.1, 0.02), strict=True)},
                  half=False, header={"chromaticities": colour_space("acescg").chromaticities})
    one = capture_target(Capture.open(folder), look, {}).frames[1]
    assert one.plate is not None
    straight = undistorted_background(one, one.shot.camera.size, None if space == "auto" else colour_space(space))
    assert straight is not None
    expected = ColouredPlate.read(one.plate, None if space == "auto" else colour_space(space)).linear[0, 0]
    np.testing.assert_allclose(straight, np.broadcast_to(expected, straight.shape), atol=1e-5)


def test_edits_apply_to_the_lights_of_the_target(flare: Path, look: Look, tmp_path: Path) -> None:
    target = shot_target(shot(flare, look, [cameras(3)[1]]), look, {})
    Transfer(flare, target).bake(tmp_path / "one", settings=BakeSettings(half=False))
    Transfer(flare, target).bake(tmp_path / "two", settings=BakeSettings(half=False, edits=("lamp.intensity=2",)))
    Transfer(flare, target).bake(tmp_path / "big", settings=BakeSettings(half=False, edits=("lamp.scale=2",)))
    one, two, big = (read_layers(tmp_path / folder / "layers.0001.exr").flare for folder in ("one", "two", "big"))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-5)
    assert (big > 0).sum() > 1.2 * (one > 0).sum()
    with pytest.raises(SettingsError, match="moon"):
        Transfer(flare, target).bake(tmp_path / "bad", settings=BakeSettings(edits=("moon.intensity=2",)))


def test_the_edits_of_a_shot_combine_with_others(flare: Path, look: Look, tmp_path: Path) -> None:
    plain = shot(flare, look, [cameras(3)[1]])
    muted = replace(plain, frames=tuple(replace(one, edits=("lamp.mute=1",)) for one in plain.frames))
    for number, words in enumerate((("lamp.saturation=0.9",), ("lamp.scale=1.1",))):
        Transfer(flare, shot_target(muted, look, {})).bake(tmp_path / str(number), settings=BakeSettings(edits=words))
        assert not read_layers(tmp_path / str(number) / "layers.0001.exr").flare.any()


def test_the_layers_of_a_shot_stay_in_the_output_folder(flare: Path, look: Look, tmp_path: Path) -> None:
    one = shot(flare, look, [cameras(3)[1]]).frames[0]
    two = Shot(flare, tuple(replace(one, name=camera) for camera in ("../escaped", "other")))
    record = Transfer(flare, shot_target(two, look, {})).bake(tmp_path / "out")
    assert sorted(entry["file"] for entry in record["frames"]) == ["escaped/layers.0001.exr", "other/layers.0001.exr"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_edits_by_frame_may_be_toml(tmp_path: Path) -> None:
    (tmp_path / "edits.toml").write_text('set = ["lamp.tint=1,0.5,1"]\n[frames]\n1 = ["lamp.intensity=0"]\n'
                                         '3 = ["lamp.intensity=1"]\n')
    keyed = KeyedEdits.read(tmp_path / "edits.toml")
    assert keyed.edits_at(2, ["lamp"]).light_edit("lamp").intensity == pytest.approx(0.5)
    assert keyed.edits_at(2, ["lamp"]).light_edit("lamp").tint == (1, 0.5, 1)
    (tmp_path / "bad.toml").write_text("set = [")
    with pytest.raises(SettingsError, match=r"bad\.toml is not valid TOML"):
        KeyedEdits.read(tmp_path / "bad.toml")


def from_ten_times_as_far(camera: Camera, centre: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a camera that sees a light at `xyz` in a tenfold world as `camera` sees one at `centre`."""
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = -pose[:3, :3] @ (xyz + 10 * (camera.position - centre))
    return pose


@pytest.mark.parametrize("times", [1, 10])
def test_a_scaled_world_is_queried_at_the_source_s_distance(times: int, flare: Path,
                                                            look: Look) -> None:
    light, camera = look.lights[0], cameras(3)[1]
    xyz = times * light.xyz
    pose, seen = from_ten_times_as_far(camera, light.xyz, xyz), queries.training_views(flare, look.lights)[light.name]
    target, blend = (queries._weighted_queries(light, ViewOfLight.of(pose, xyz), xyz, query, seen, 10.0, None)
                     for query in ("target", "blend"))
    np.testing.assert_allclose(target[0][1].camera, camera.position, atol=1e-4)
    assert len(blend) > 1
    assert min(np.linalg.norm(one.camera - camera.position) for _, one in blend) < 0.5, "a view of the training"


def test_the_fixed_view_is_chosen_by_scaled_distances(flare: Path, look: Look,
                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    xyz, distances_seen = look.lights[0].xyz, list[float]()
    fixed_view = queries.fixed_view
    monkeypatch.setattr(queries, "fixed_view", lambda light, views, distances, training: (
        distances_seen.extend(distances), fixed_view(light, views, distances, training))[1])
    views = [replace(camera, world_to_camera=from_ten_times_as_far(camera, xyz, xyz)) for camera in cameras(5)[:2]]
    Transfer(flare, shot_target(shot(flare, look, views), look, {}), TransferSettings(query="source", scale=10))
    expected = [np.linalg.norm(camera.position - xyz) for camera in cameras(5)[:2]]
    np.testing.assert_allclose(distances_seen, expected, rtol=1e-6)


def test_a_frame_is_rendered_again_when_a_smoothing_neighbour_changes(flare: Path, look: Look) -> None:
    def prints(*shares: float) -> list[str]:
        target = shot_target(shot(flare, look, cameras(5), shares=list(shares)), look, {})
        transfer = Transfer(flare, target, TransferSettings(smooth=1))
        return [transfer.frame_fingerprint(number) for number in range(5)]

    same = [a == b for a, b in zip(prints(1, 1, 1, 1, 1), prints(1, 1, 1, 1, 0), strict=True)]
    assert same == [True, True, False, False, False], "the share is smoothed, then its step: two frames to each side"


def test_a_half_float_plate_is_clamped_below_infinity() -> None:
    plate = ColouredPlate(Plate(Path("a.exr"), np.full((2, 2, 3), 60000, np.float16), "linear"), colour_space("linear"))
    stored, _ = plate.codes_with_light(np.full((2, 2, 3), 30000, np.float32))
    assert stored.dtype == np.float16
    assert (stored == 65504).all()
