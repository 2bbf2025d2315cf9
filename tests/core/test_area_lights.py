# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights with an extent: their samples, and the flare as a sum over them; factors and fall-off of lights."""
from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.bake.shot import ShotRenderer
from core.capture import LightExtent, read_lights, sample_curve, sample_surface
from core.capture.light_extent import CELLS, SAMPLES
from core.errors import CaptureError, SettingsError
from core.flare.model import PAPER
from core.flare.visibility import VisibilitySettings, visibility_behind
from core.look import Look, LookEdits, PlacedLight, PlaneGaussians, draw, read_look
from core.look.shot import Shot, ShotFrame
from core.transfer.target import shot_target
from core.transfer.transfer import Transfer, TransferSettings
from tests.core.flared import cameras
from tests.core.test_flare_visibility import wall
from tests.core.test_look import SMALL, saved

POSE = cameras(3)[1].world_to_camera
EYE = -POSE[:3, :3].T @ POSE[:3, 3]
RIGHT, DOWN, FORWARD = POSE[:3, :3]
PLACE = EYE + 4 * FORWARD + 0.6 * RIGHT - 0.4 * DOWN
RECTANGLE = LightExtent.rectangle([0.5 * RIGHT, 0.3 * DOWN])


def total(flare: PlaneGaussians | None) -> float:
    return 0.0 if flare is None else float(flare.energy.sum())


def one_light(tmp_path: Path, form: object = None) -> Look:
    saved(tmp_path / "a.flare", form or replace(PAPER, levels=6), 1)  # type: ignore[arg-type]
    return read_look(tmp_path / "a.flare")


def flare_of(look: Look, light: PlacedLight) -> PlaneGaussians | None:
    return look.evaluate_lights(POSE, [light]).get(light.name)


def placed(extent: LightExtent | None = None, shares: NDArray[np.float64] | None = None, **others: object
           ) -> PlacedLight:
    return PlacedLight("a", "lamp 0", PLACE, extent=extent, shares=None if shares is None else tuple(shares.tolist()),
                       **others)  # type: ignore[arg-type]


def is_before_gap(points: NDArray[np.float64], offset: float) -> NDArray[np.bool_]:
    """Whether a fence at half the distance, of bars 0.06 wide every 0.14, leaves points visible from the camera."""
    at_fence = ((points - EYE) @ RIGHT) / ((points - EYE) @ FORWARD) * 2
    return ((at_fence + offset) % 0.14) > 0.06


def test_the_light_behind_a_moving_fence_is_the_exact_sum(tmp_path: Path) -> None:
    look = one_light(tmp_path)
    # Where the light is changes its flare smoothly, so that a coarse grid will do; the fence needs a fine one.
    columns, rows, fine = np.linspace(-1, 1, 17), (np.arange(6) + 0.5) / 3 - 1, (np.arange(6000) + 0.5) / 3000 - 1
    light_of_column = [np.mean([total(flare_of(look, replace(placed(), xyz=PLACE + 0.5 * x * RIGHT + 0.3 * y * DOWN)))
                                for y in rows]) for x in columns]
    light_of_point = np.interp(fine, columns, light_of_column)
    dense = PLACE + 0.5 * fine[:, None] * RIGHT
    sampled = RECTANGLE.sampled(PLACE, POSE)
    ratios, exact = [], []
    for offset in np.linspace(0, 0.28, 40):
        expected = float((light_of_point * is_before_gap(dense, offset)).mean())
        shares = sampled.shares(is_before_gap(sampled.points, offset))
        ratios.append(total(flare_of(look, placed(RECTANGLE, shares))) / expected)
        exact.append(expected)
    assert np.ptp(exact) > 0.02 * np.mean(exact)  # the fence matters
    assert np.abs(np.array(ratios) - 1).max() < 0.03
    assert np.abs(np.diff(ratios)).max() < 0.03  # nothing flickers


@pytest.mark.parametrize("extent", [RECTANGLE, LightExtent.sphere(0.3),
                                    LightExtent.ellipse([0.4 * RIGHT, 0.1 * DOWN + 0.2 * FORWARD]),
                                    LightExtent.of_points(sample_curve([-0.5 * RIGHT, 0.2 * DOWN, 0.5 * RIGHT]))])
def test_the_picture_is_that_of_many_points(extent: LightExtent, tmp_path: Path) -> None:
    look = one_light(tmp_path, SMALL)
    camera = cameras(3)[1]

    def picture(lights: list[PlacedLight]) -> NDArray[np.float32]:
        flares = [flare for light in lights if (flare := flare_of(look, light)) is not None]
        return draw(flares, camera.intrinsics, camera.width, camera.height, look.blend)

    points = extent.sampled(PLACE, POSE).points[::4]
    exact = sum(picture([replace(placed(), xyz=point)]) for point in points) / np.float32(len(points))
    shown = picture([placed(extent)])
    assert np.linalg.norm(shown - exact) < 0.12 * np.linalg.norm(exact)
    assert shown.sum() == pytest.approx(float(np.sum(exact)), rel=0.03)
    middle = picture([placed()])
    assert np.linalg.norm(middle - exact) > 2 * np.linalg.norm(shown - exact)


def test_a_small_extent_is_a_point_and_grows_from_it_without_a_jump(tmp_path: Path) -> None:
    look = one_light(tmp_path, SMALL)
    point = flare_of(look, placed())
    assert point is not None
    tiny = flare_of(look, placed(LightExtent.sphere(1e-6)))
    assert tiny is not None and len(tiny) == len(point)
    np.testing.assert_allclose(tiny.means, point.means, atol=1e-5)
    before, after = (flare_of(look, placed(LightExtent.sphere(radius))) for radius in (0.00078, 0.00082))
    assert before is not None and after is not None and len(after) == CELLS * len(before)
    assert total(after) == pytest.approx(total(before), rel=1e-3)


def test_hidden_cells_have_no_flare_and_hidden_lights_none(tmp_path: Path) -> None:
    look = one_light(tmp_path)
    shares = np.zeros(CELLS)
    assert flare_of(look, placed(RECTANGLE, shares)) is None
    shares[3] = 0.5
    flare, whole = flare_of(look, placed(RECTANGLE, shares)), flare_of(look, placed(RECTANGLE))
    assert flare is not None and whole is not None
    assert len(flare) == len(whole) / CELLS
    assert total(flare) == pytest.approx(total(whole) / CELLS / 2, rel=0.1)


def test_an_extent_partly_behind_the_camera_has_the_flare_of_its_front(tmp_path: Path) -> None:
    look = one_light(tmp_path)
    long = LightExtent.rectangle([6 * FORWARD, 0.1 * DOWN])
    flare, whole = flare_of(look, placed(long)), flare_of(look, placed(RECTANGLE))
    assert flare is not None and whole is not None
    assert 0 < len(flare) < len(whole)
    assert np.isfinite(flare.covariances).all()
    assert flare_of(look, replace(placed(RECTANGLE), xyz=EYE - 4 * FORWARD)) is None


def test_a_one_sided_light_follows_the_cosine(tmp_path: Path) -> None:
    look = one_light(tmp_path)
    towards = (EYE - PLACE) / np.linalg.norm(EYE - PLACE)
    side = np.cross(DOWN, towards) / np.linalg.norm(np.cross(DOWN, towards))
    up = np.cross(towards, side)

    def light(degrees: float) -> float:
        turned = np.cos(np.radians(degrees)) * side + np.sin(np.radians(degrees)) * towards
        return total(flare_of(look, placed(LightExtent.ellipse([0.01 * turned, 0.01 * up], one_sided=True))))

    assert light(0) > 0
    assert light(60) == pytest.approx(light(0) / 2, rel=0.02)
    assert light(180) == 0


@pytest.mark.parametrize("shape", ["rectangle", "ellipse"])
def test_a_mirrored_extent_emits_to_the_image_of_its_side(shape: str) -> None:
    extent = LightExtent.from_json({"shape": shape, "axes": [[0.5, 0, 0], [0, 0.3, 0]], "one_sided": True})
    eye = np.array([0.1, 0.2, 2.0])
    for mirror in (np.diag([-2.0, 2, 2]), np.diag([2.0, 2, -2]), -2 * np.eye(3)):
        for side in (1, -1):
            pose = np.eye(4)
            pose[:3, 3] = -mirror @ (side * eye)
            sampled = extent.transformed(mirror).sampled(np.zeros(3), pose)
            assert (sampled.emission > 0) == (side > 0)
            back = sampled.points @ np.linalg.inv(mirror).T
            assert np.abs(back[:, :2]).max(0) == pytest.approx([0.5, 0.3], abs=0.01) and not back[:, 2].any()


# ---- samples --------------------------------------------------------------------------------------


@pytest.mark.parametrize("aspect", [0.02, 0.5, 1, 3, 50])
def test_cells_have_equal_parts_and_samples_do_not_move(aspect: float) -> None:
    extent = LightExtent.rectangle([[aspect, 0, 0], [0, 1, 0]])
    sampled = extent.sampled([0, 0, 9], np.eye(4))
    assert sampled.count == CELLS == extent.cell_count
    np.testing.assert_array_equal(np.bincount(sampled.cells), SAMPLES // CELLS)
    np.testing.assert_allclose(sampled.weights, 1 / CELLS)
    moved = np.eye(4)
    moved[:3, 3] = 1, 2, 3
    np.testing.assert_array_equal(extent.sampled([0, 0, 9], moved).points, sampled.points)
    np.testing.assert_allclose(extent.sampled([1, 0, 9], np.eye(4)).points, sampled.points + np.array([1, 0, 0]))


def test_a_disc_has_even_samples_inside_its_edge() -> None:
    offsets = LightExtent.sphere(2.0).sampled([0, 0, 9], np.eye(4)).points - [0, 0, 9]
    radii = np.linalg.norm(offsets, axis=1)
    assert radii.max() < 2
    assert (radii < np.sqrt(2)).mean() == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(offsets[:, 2], 0, atol=1e-9)


def test_samples_of_a_surface_are_even_and_follow_it() -> None:
    vertices = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [0, 1, 0]], float)
    triangles = [[0, 1, 2], [0, 2, 3]]
    points = sample_surface(vertices, triangles)
    assert (points[:, 0] < 1.5).mean() == pytest.approx(0.5, abs=0.03)
    assert (points[:, 1] < 0.5).mean() == pytest.approx(0.5, abs=0.03)
    bent = vertices + np.array([[0, 0, 0], [0, 0, 5], [0, 0, 5], [0, 0, 0]])
    np.testing.assert_allclose(sample_surface(bent, triangles, reference=vertices)[:, :2], points[:, :2], atol=1e-9)
    extent = LightExtent.of_points(points)
    sampled = extent.sampled([0, 0, 0], np.eye(4))
    sizes = [np.ptp(sampled.points[sampled.cells == cell], axis=0).max() for cell in range(CELLS)]
    assert np.median(sizes) < 1.2  # cells are parts of the surface, not spread over it
    for degenerate in (np.zeros((4, 3)), np.full((4, 3), np.nan)):
        with pytest.raises(ValueError, match="no area"):
            sample_surface(degenerate, triangles)


# ---- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("extent", [RECTANGLE, LightExtent.sphere(0.25), LightExtent.of_points([[0, 0, 0], [1, 0, 0]]),
                                    LightExtent.ellipse([[1, 0, 0], [0, 2, 0]], one_sided=True)])
def test_a_shot_file_keeps_extent_shares_factor_and_distance(extent: LightExtent, tmp_path: Path) -> None:
    light = PlacedLight("a", "lamp 0", PLACE, 0.5, extent, tuple(np.linspace(0, 1, extent.cell_count).round(3)),
                        (2.0, 0.5, 0.0), 3.0)
    Shot(tmp_path / "a.flare", (ShotFrame(1, "Camera", cameras(3)[0], (light,)),)).write(tmp_path / "s.json")
    again = Shot.read(tmp_path / "s.json").frames[0].lights[0]
    assert again.extent is not None
    assert again.extent.to_json() == extent.to_json()
    assert (again.shares, again.factor, again.reference_distance) == (light.shares, light.factor, 3.0)
    assert again.cache_key() == light.cache_key() != replace(light, factor=(1.0, 1.0, 1.0)).cache_key()


@pytest.mark.parametrize(("extent", "part"), [
    ({"shape": "cube"}, "needs a shape"), ({"shape": "sphere", "radius": -1}, "negative"),
    ({"shape": "rectangle", "axes": [[1, 0, 0]]}, "two axes"), ({"shape": "points", "points": []}, "1 to 4096 points"),
    ({"shape": "sphere", "radius": float("nan")}, "not finite"), ({"shape": "ellipse", "axes": "wide"}, "float"),
    ([], "needs a shape")])
def test_an_invalid_extent_is_named(extent: object, part: str, tmp_path: Path) -> None:
    file = tmp_path / "lights.json"
    file.write_text(json.dumps({"lights": [{"name": "lamp", "xyz": [0, 0, 0], "extent": extent}]}))
    with pytest.raises(CaptureError, match=f"'lamp': .*{part}"):
        read_lights(file)


@pytest.mark.parametrize("change", [{"shares": [0.5]}, {"factor": [1, 2]}, {"factor": [-1, 0, 0]},
                                    {"reference_distance": -1}, {"extent": {"shape": "sphere", "radius": "big"}}])
def test_an_invalid_light_of_a_shot_is_refused(change: dict[str, object], tmp_path: Path) -> None:
    Shot(tmp_path / "a.flare", (ShotFrame(1, "Camera", cameras(3)[0], (placed(LightExtent.sphere(1.0)),)),)
         ).write(tmp_path / "s.json")
    data = json.loads((tmp_path / "s.json").read_text())
    data["frames"][0]["lights"][0].update(change)
    (tmp_path / "s.json").write_text(json.dumps(data))
    with pytest.raises(SettingsError, match="is not a shot"):
        Shot.read(tmp_path / "s.json")


def test_lights_without_an_extent_have_the_text_of_earlier_layers() -> None:
    frame = ShotFrame(1, "Camera", cameras(3)[0], (PlacedLight("a", "b", np.array([1.0, 2.0, 3.0])),))
    text = repr((1, "Camera", (), *frame.camera.numbers, [("a", "b", [1.0, 2.0, 3.0], 1.0)]))
    assert frame.cache_key() == text


# ---- factors --------------------------------------------------------------------------------------


@pytest.mark.parametrize("extent", [None, RECTANGLE])
def test_a_factor_multiplies_the_linear_light(extent: LightExtent | None, tmp_path: Path) -> None:
    look = one_light(tmp_path)
    plain, dimmed = (flare_of(look, placed(extent, factor=factor)) for factor in ((1.0, 1.0, 1.0), (0.5, 0.0, 2.0)))
    assert plain is not None and dimmed is not None
    np.testing.assert_allclose(dimmed.colours, plain.colours * np.float32([0.5, 0, 2]), rtol=1e-5)
    assert flare_of(look, placed(extent, factor=(0.0, 0.0, 0.0))) is None


@pytest.mark.parametrize("extent", [None, LightExtent.sphere(0.1)])
def test_fall_off_is_the_inverse_square(extent: LightExtent | None, tmp_path: Path) -> None:
    look = one_light(tmp_path)
    distance = float(np.linalg.norm(PLACE - EYE))
    plain, same, twice = (flare_of(look, placed(extent, reference_distance=reference))
                          for reference in (0.0, distance, 2 * distance))
    assert total(same) == pytest.approx(total(plain), rel=0.01)
    assert total(twice) == pytest.approx(4 * total(plain), rel=0.01)


def test_edits_apply_to_every_cell(tmp_path: Path) -> None:
    look = one_light(tmp_path)
    edits = LookEdits.parse(["a.intensity=3"], ["a"])
    bright = look.evaluate_lights(POSE, [placed(RECTANGLE)], edits)["a"]
    assert total(bright) == pytest.approx(3 * total(flare_of(look, placed(RECTANGLE))), rel=1e-4)


# ---- behind splats, and in a transfer -------------------------------------------------------------


def test_splats_hide_the_cells_behind_them() -> None:
    light = PlacedLight("a", "b", np.array([0.0, 0.0, 4.0]),
                        extent=LightExtent.rectangle([[0.3, 0, 0], [0, 0.2, 0]]))
    settings = VisibilitySettings()
    visibility, shares = visibility_behind(wall(x=0.5), np.eye(4), light, settings)  # hides the half with x > 0
    assert visibility == 1 and shares is not None
    centres = light.extent.sampled(light.xyz, np.eye(4)).centres  # type: ignore[union-attr]
    hidden = np.array(shares)[centres[:, 0] > 0.1], np.array(shares)[centres[:, 0] < -0.1]
    assert hidden[0].max() < 0.05 and hidden[1].min() > 0.95
    assert np.mean(shares) == pytest.approx(0.5, abs=0.03)
    half = replace(light, shares=(0.0,) * 8 + (1.0,) * 8)
    assert visibility_behind(wall(x=0.5), np.eye(4), half, settings)[1][:8] == (0.0,) * 8  # type: ignore[index]
    point = visibility_behind(wall(), np.eye(4), replace(light, extent=None), settings)
    assert point[0] < 0.01 and point[1] is None


def test_a_transfer_and_a_bake_show_the_same_extended_light(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", SMALL, 1)
    camera = cameras(3)[1]
    shares = tuple(np.linspace(0, 1, CELLS).round(3).tolist())
    light = placed(RECTANGLE, factor=(1.0, 0.5, 0.2), reference_distance=3.0)
    shot = Shot(tmp_path / "a.flare", (ShotFrame(1, "Camera", camera, (replace(light, shares=shares),)),), "target")
    baked = ShotRenderer(shot).render(shot.frames[0], camera).flare_by_light["a"]
    look = read_look(tmp_path / "a.flare")
    transfer = Transfer(tmp_path / "a.flare", shot_target(shot, look, {}), TransferSettings("target"))
    frame = transfer.target.frames[0]
    moved = transfer.frame_renderer(frame.frame).render(camera).flare_by_light["a"]
    overlay = draw([look.evaluate_lights(POSE, shot.frames[0].lights)["a"]], camera.intrinsics, camera.width,
                   camera.height)
    assert baked.max() > 0.02
    np.testing.assert_allclose(baked, overlay, atol=2e-4 * float(baked.max()))
    assert np.linalg.norm(moved - baked) < 0.1 * np.linalg.norm(baked)  # another world: the query's camera differs


def test_fall_off_of_a_transfer_starts_at_the_distance_of_the_first_frame(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", SMALL, 1)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    away = replace(camera, world_to_camera=camera.world_to_camera + np.outer([0, 0, 4, 0], [0, 0, 0, 1]))
    frames = tuple(ShotFrame(number, "Camera", each, (placed(),)) for number, each in ((1, camera), (2, away)))
    target = shot_target(Shot(tmp_path / "a.flare", frames), look, {})

    def light(fall_off: float | None) -> list[float]:
        transfer = Transfer(tmp_path / "a.flare", target, TransferSettings(fall_off=fall_off))
        return [float(transfer.frame_renderer(each.frame).render(each.shot.camera).flare_by_light["a"].sum())
                for each in target.frames]

    first, second = (float(np.linalg.norm(each.camera.position - PLACE)) for each in frames)
    plain, dimmed, named = light(None), light(0.0), light(2 * first)
    assert dimmed[0] == pytest.approx(plain[0], rel=1e-3)
    assert dimmed[1] == pytest.approx(plain[1] * (first / second) ** 2, rel=1e-3)
    assert named[0] == pytest.approx(4 * plain[0], rel=1e-3)
    texts = {Transfer(tmp_path / "a.flare", target, TransferSettings(fall_off=value)).frame_fingerprint(1)
             for value in (None, 0.0, 2 * first)}
    assert len(texts) == 3  # layers of other settings are not mistaken for these
