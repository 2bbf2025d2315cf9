# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare generator keeps to optics, and the sample capture to its own layers."""
from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.capture import Capture
from core.colour.srgb import srgb_from_linear
from core.errors import CaptureError, SettingsError
from core.images.read import read_picture
from core.optics.aperture import Aperture
from core.optics.flare import build_optics
from core.optics.ghosts import GhostSettings, draw_ghosts
from core.optics.lenses import LENS_FOLDER
from core.optics.prescription import read_prescription
from core.optics.starburst import Glow, Ring, Starburst, Streak, draw_ring, draw_streak, starburst_texture
from core.optics.trace import FIELDS, SENSOR_X, reflectance, trace_ray
from core.system.progress import Progress
from sample_scenes.capture_files import expose, write_layer
from sample_scenes.description import Pinhole, look_at
from sample_scenes.flares import LENS_SETUPS, LensSetup, render_flare
from sample_scenes.over_photos import add_flares, measure_sky_share
from sample_scenes.render import make_capture as make_sample_capture
from sample_scenes.scenes import SCENES
from tests.core.captures import make_capture

SAMPLE = Path(__file__).parents[2] / "sample_scenes" / "desk"
SMALL = Pinhole(120, 68, 118.0, 118.0, 60.0, 34.0)
LENSES = sorted(path.stem for path in LENS_FOLDER.glob("*.lens"))
ROUND = LensSetup("US3576360", stop_down=0.34, blades=8, curved=1.0, uneven=0.0,
                  ghosts=GhostSettings(count=8, gain=300.0, bands=3))
"""A lens with a round stop: nothing about it has a direction."""


def psnr(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return float(-10 * np.log10(np.mean((a.astype(float) - b) ** 2)))


def straight(name: str, x: float, slope: float) -> tuple[float, float]:
    """Trace a ray that no surface reflects; return its x on the sensor and the lens's focal length.

    x, slope: of the ray before the lens.
    """
    lens = read_prescription(LENS_FOLDER / f"{name}.lens")
    focal, back = lens.focal_length(), lens.back_focus()
    out = np.zeros(FIELDS)
    bare = np.zeros(len(lens.index))
    arrived = trace_ray(x, 0.0, slope, -1, -1, lens.curvature, lens.vertices, lens.indices(0.5876),
                        lens.semi_aperture, bare, lens.stop, float(lens.vertices[-1] + back), 0.5876, out)
    assert arrived
    return float(out[SENSOR_X]), focal


@pytest.mark.parametrize("name", LENSES)
def test_a_prescription_has_its_stated_focal_length(name: str) -> None:
    stated = float((LENS_FOLDER / f"{name}.lens").read_text().split(" mm,")[0].split()[-1])
    assert read_prescription(LENS_FOLDER / f"{name}.lens").focal_length() == pytest.approx(stated, rel=0.05)


@pytest.mark.parametrize("name", LENSES)
def test_a_prescription_focuses_at_its_last_thickness(name: str) -> None:
    """Sensitive to every digit: a radius or thickness copied wrong moves the focus."""
    lens = read_prescription(LENS_FOLDER / f"{name}.lens")
    assert lens.back_focus() == pytest.approx(lens.thickness[-1], rel=0.003)


@pytest.mark.parametrize("name", LENSES)
def test_a_real_ray_near_the_axis_ends_where_the_paraxial_one_does(name: str) -> None:
    at, _ = straight(name, 0.05, 0.0)
    assert abs(at) < 1e-4
    at, focal = straight(name, 0.0, 0.001)
    assert at / focal == pytest.approx(-0.001, rel=0.02)  # upside down, as the draw code takes it


@pytest.mark.parametrize("text, fault", [
    ("1 2 3 4 5\n1 2 3 4 5\n", "stop"), ("stop 1 1 0 5\n", "stop"), ("10 1 1.5\nstop 1 1 0 5\n", "surface"),
    ("10 1 glass 60 5\n", "surface")])
def test_a_broken_prescription_is_refused(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "x.lens").write_text(text)
    with pytest.raises(SettingsError, match=fault):
        read_prescription(tmp_path / "x.lens")


def test_reflectance_matches_fresnel_and_a_quarter_wave() -> None:
    assert reflectance(1.0, 1.0, 1.5, 0.55, 0.0) == pytest.approx(0.04)
    ideal = ((1.9 - 1.38**2) / (1.9 + 1.38**2)) ** 2
    assert reflectance(1.0, 1.0, 1.9, 0.55, 0.55) == pytest.approx(ideal, abs=1e-9)
    assert reflectance(0.2, 1.5, 1.0, 0.55, 0.0) == 1.0  # total
    brewster = math.cos(math.atan(1.5))
    rs = ((brewster - 1.5 * math.sqrt(1 - (1 - brewster**2) / 2.25)) /
          (brewster + 1.5 * math.sqrt(1 - (1 - brewster**2) / 2.25))) ** 2
    assert reflectance(brewster, 1.0, 1.5, 0.55, 0.0) == pytest.approx(rs / 2)


# The rasterizers let torch flush subnormal numbers, in this process too: hypothesis must not ask for any.
@given(*(st.floats(low, high, allow_subnormal=False)
         for low, high in ((0.01, 1), (1.0, 2.0), (1.0, 2.0), (0.4, 0.7), (0, 0.8))))
@example(cosine=0.21875, n0=1.0, n2=1.0, wavelength=0.5, coating=1.1754943508222875e-38)
def test_reflectance_is_between_0_and_1_and_reciprocal(
        cosine: float, n0: float, n2: float, wavelength: float, coating: float) -> None:
    there = reflectance(cosine, n0, n2, wavelength, coating)
    assert 0.0 <= there <= 1.0 + 1e-12
    sine = math.sqrt(1 - cosine**2) * n0 / n2
    if sine < 0.999 and there < 1.0:
        assert reflectance(math.sqrt(1 - sine**2), n2, n0, wavelength, coating) == pytest.approx(there, abs=1e-9)


@pytest.mark.parametrize("name", sorted(LENS_SETUPS))
def test_a_rendered_flare_is_reproducible_finite_and_non_negative(name: str) -> None:
    setup = replace(LENS_SETUPS[name], ghosts=replace(LENS_SETUPS[name].ghosts, bands=2, count=6))
    light = (-0.22, -0.13)
    flare = render_flare(setup, SMALL, light)
    assert flare.shape == (68, 120, 3) and flare.dtype == np.float32
    assert np.isfinite(flare).all() and flare.min() >= 0 and flare.max() > 1
    assert np.array_equal(flare, render_flare(setup, SMALL, light))


def test_flare_energy_scales_with_share_intensity_and_colour() -> None:
    full = render_flare(ROUND, SMALL, (0.1, 0.1))
    half = render_flare(ROUND, SMALL, (0.1, 0.1), visible_share=0.25, intensity=2.0, colour=(1.0, 0.5, 0.0))
    np.testing.assert_allclose(half, full * np.array([0.5, 0.25, 0.0], np.float32), rtol=1e-5)


def test_a_light_that_is_hidden_or_behind_has_no_flare() -> None:
    assert not render_flare(ROUND, SMALL, (0.1, 0.2, -3.0)).any()
    assert not render_flare(ROUND, SMALL, (0.1, 0.2, 0.0)).any()
    assert not render_flare(ROUND, SMALL, (0.1, 0.2), visible_share=0.0).any()
    assert not render_flare(ROUND, SMALL, (1.6, 0.0)).any()  # beside the hood
    assert render_flare(ROUND, SMALL, (0.62, 0.0)).any()  # out of the frame, not of the hood


def test_a_position_and_its_normalised_coordinates_give_one_flare() -> None:
    assert np.array_equal(render_flare(ROUND, SMALL, (0.4, -0.2, 4.0)), render_flare(ROUND, SMALL, (0.1, -0.05)))


def test_ghosts_lie_on_the_line_through_principal_point_and_light() -> None:
    optics, pairs = build_optics(ROUND)
    camera = Pinhole(160, 120, 118.0, 118.0, 71.3, 64.2)
    light = np.array([0.14, -0.09])
    across = np.array([-light[1], light[0]]) / np.linalg.norm(light)
    x, y = np.meshgrid(np.arange(160) + 0.5 - camera.cx, np.arange(120) + 0.5 - camera.cy)
    seen = 0
    for pair in pairs:
        ghost = draw_ghosts(optics, [pair], ROUND.ghosts, tuple(light), (camera.fx, camera.fy),
                            (camera.cx, camera.cy), camera.width, camera.height).sum(axis=2)
        border = np.concatenate([ghost[0], ghost[-1], ghost[:, 0], ghost[:, -1]]).max()
        if ghost.sum() == 0 or border > 0.02 * ghost.max():  # cut by the frame: its centroid tells nothing
            continue
        centroid = np.array([(ghost * x).sum(), (ghost * y).sum()]) / ghost.sum()
        assert abs(centroid @ across) < 0.6
        seen += 1
    assert seen >= 4


def test_the_flare_of_a_round_lens_rotates_with_the_light() -> None:
    camera = Pinhole(96, 96, 90.0, 90.0, 48.0, 48.0)
    across = render_flare(ROUND, camera, (0.2, 0.0))
    down = render_flare(ROUND, camera, (0.0, 0.2))
    difference = np.abs(np.rot90(across, -1) - down)
    assert difference.max() < 0.02 * across.max() and psnr(np.rot90(across, -1), down) > 45
    assert psnr(across, across[::-1]) > 45


def test_a_flare_moves_smoothly() -> None:
    setup = replace(LENS_SETUPS["fast"], ghosts=replace(LENS_SETUPS["fast"].ghosts, count=10, bands=3))
    camera = SCENES["desk"].camera.scaled(240, 135)
    flares = [np.minimum(render_flare(setup, camera, (0.2 + step * 1e-4, -0.1)), 2) for step in range(5)]
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise(flares)]
    assert max(steps) < 0.01 * np.linalg.norm(flares[0])
    assert max(steps) < 1.5 * min(steps)


@pytest.mark.parametrize("blades, spikes", [(6, 6), (7, 14), (8, 8)])
def test_starburst_has_the_spikes_of_its_blades(blades: int, spikes: int) -> None:
    texture = starburst_texture(Aperture(1.0, blades, curved=0.0), Starburst(gain=1.0, peak=1e9)).sum(axis=2)
    angle = np.arange(720) / 720 * 2 * np.pi
    middle, total = texture.shape[0] // 2, np.zeros(720)
    for radius in range(60, 160, 4):
        ring = texture[(middle + radius * np.sin(angle)).round().astype(int),
                       (middle + radius * np.cos(angle)).round().astype(int)]
        total += ring / ring.mean()
    harmonics = np.abs(np.fft.rfft(total))[1:20]
    assert harmonics.argmax() + 1 == spikes


def test_ring_is_wider_for_longer_wavelengths() -> None:
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 241, dtype=np.float32), np.zeros(1, np.float32))
    ring = draw_ring(Ring(radius=0.3, lean=0.0), (0.0, 0.0), x, y)[0]
    red, green, blue = (float((ring[:, c] * np.abs(x[0])).sum() / ring[:, c].sum()) for c in range(3))
    assert red > green > blue and green == pytest.approx(0.3, rel=0.06)
    assert ring[120].max() < 1e-3 * ring.max()  # the hole is a hole


def test_an_anamorphic_lens_draws_its_ghosts_and_streak_along_x() -> None:
    bare = replace(ROUND, starburst=Starburst(gain=0.0), glow=Glow(0.0, wide_gain=0.0, floor=0.0))
    camera = Pinhole(400, 120, 80.0, 80.0, 200.0, 60.0)
    columns = np.arange(400) + 0.5 - 200
    spread = []
    for setup, light in ((bare, (0.1, 0.1)), (replace(bare, squeeze=2.0), (0.2, 0.1))):
        ghosts = render_flare(setup, camera, light).sum(axis=2)
        spread.append((ghosts * np.abs(columns)).sum() / ghosts.sum())
    assert spread[1] == pytest.approx(2 * spread[0], rel=0.03)
    x, y = np.meshgrid(np.linspace(-1, 1, 81, dtype=np.float32), np.linspace(-1, 1, 81, dtype=np.float32))
    streak = draw_streak(Streak(width=0.02), (0.0, 0.0), x, y)
    assert streak[40, 0].min() > 20 * streak[0, 40].max()


def test_every_scene_has_its_own_lens_setup() -> None:
    own = {name: scene for name, scene in SCENES.items() if name != "rims"}  # the garden again, under other rings
    assert len({scene.seed for scene in own.values()}) == len(own) >= 4
    # The studio is what the desk's flare is put on to, so it has the desk's lens.
    lenses = [LENS_SETUPS[scene.lens].lens for name, scene in own.items() if name != "studio"]
    assert len(set(lenses)) == len(lenses) and set(lenses) <= set(LENSES)
    assert len({scene.lens for scene in SCENES.values()}) == len(LENS_SETUPS) == len(SCENES) - 1
    for scene in SCENES.values():
        np.testing.assert_allclose(np.linalg.det(scene.poses[:, :3, :3]), 1.0)
        assert scene.views == len(scene.poses) == len(set(scene.stems))


def test_flares_are_added_to_photographs(tmp_path: Path) -> None:
    make_capture(tmp_path / "photos", 3)
    capture = Capture.open(tmp_path / "photos")
    add_flares(capture, tmp_path / "out", ROUND, np.array([0.3, -0.2, 1.0]), (1.0, 0.8, 0.6), 2.0, 48, Progress())
    made = Capture.open(tmp_path / "out")
    assert [light.xyz.tolist() for light in made.lights] == [[0.3, -0.2, 1.0]]
    for view, source in zip(made.views, capture.views, strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, source.camera.world_to_camera, atol=1e-9)
        assert view.camera.fx == pytest.approx(source.camera.fx * 0.75)
        removed, flare, scene = made.clean_frame(view), made.truth_flare(view), made.truth_scene(view)
        assert removed and flare and scene and flare.pixels.max() > 0.5
        np.testing.assert_allclose(scene.display(), removed.display(), atol=0.02)
        np.testing.assert_allclose(removed.display(), capture.frame(source, (48, 36)).display(), atol=0.51 / 255)
        both = srgb_from_linear(np.clip(removed.linear() + flare.pixels, 0, 1))
        np.testing.assert_allclose(made.frame(view).display(), both, atol=0.51 / 255)
        place = view.camera.project(np.array([[0.3, -0.2, 1.0]]))[0][0]
        assert made.frame(view).display()[int(place[1]), int(place[0])].min() > 0.8


def test_a_sun_over_photographs_is_far_and_shines_where_the_sky_is_bright(tmp_path: Path) -> None:
    make_capture(tmp_path / "photos", 3)
    capture = Capture.open(tmp_path / "photos")
    camera = capture.views[0].camera.scaled(48)
    direction = camera.rays(np.array([[20.0, 12.0]]))[0]
    add_flares(capture, tmp_path / "out", ROUND, 7 * direction, (1.0, 0.8, 0.6), 2.0, 48, Progress(), is_sun=True)
    made = Capture.open(tmp_path / "out")
    offset = made.lights[0].xyz - capture.centre
    assert np.linalg.norm(offset) == pytest.approx(1000 * capture.extent)
    np.testing.assert_allclose(offset / np.linalg.norm(offset), direction, atol=1e-9)
    shares = json.loads((tmp_path / "out" / "truth" / "visible_share.json").read_text())
    assert shares.keys() == {view.name for view in made.views}
    flare = made.truth_flare(made.views[0])
    assert flare is not None and shares[made.views[0].name]["light"] == 0 and not flare.pixels.any()  # before no sky

    sky = np.zeros((camera.height, camera.width, 3), np.float32)
    sky[:, :20] = 0.95  # the disc's left half
    assert measure_sky_share(sky, camera, made.lights[0].xyz) == pytest.approx(0.5, abs=0.25)
    sky[:] = (0.3, 0.5, 0.95)
    assert measure_sky_share(sky, camera, made.lights[0].xyz) == 1
    glint = np.zeros((180, 240, 3), np.float32)
    glint[59:61, 99:101] = 1  # at the sun's place, smaller than its disc
    assert measure_sky_share(glint, camera.scaled(240), made.lights[0].xyz) == 0
    out_of_frame = capture.centre + 1000 * camera.rays(np.array([[-20.0, 12.0]]))[0]
    assert measure_sky_share(np.zeros_like(sky), camera, out_of_frame) == 1


def test_look_at_centres_the_target() -> None:
    pose = look_at(np.array([1.0, -4.0, 2.0]), np.array([0.3, 0.5, 1.0]), 0.2)
    at = pose[:3, :3] @ (0.3, 0.5, 1.0) + pose[:3, 3]
    np.testing.assert_allclose(at[:2], 0, atol=1e-12)
    assert at[2] > 0 and np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_sensor_noise_has_the_stated_size_and_layers_survive_their_file(tmp_path: Path) -> None:
    grey = np.full((200, 200, 3), 0.25, np.float32)
    noisy = expose(grey, np.random.default_rng(1))
    slope = 1.055 / 2.4 * 0.25 ** (1 / 2.4 - 1)
    assert noisy.std() == pytest.approx(slope * math.hypot(0.0006, 0.0025 * 0.5), rel=0.03)
    assert expose(grey * 8, np.random.default_rng(1)).min() == pytest.approx(1.0, abs=1e-6)  # clips
    ramp = np.linspace(0, 6, 64 * 96 * 3, dtype=np.float32).reshape(64, 96, 3)
    write_layer(tmp_path / "a.exr", ramp, 45.0)
    np.testing.assert_allclose(read_picture(tmp_path / "a.exr").pixels, ramp, rtol=0.05, atol=0.02)


@pytest.fixture(scope="module")
def sample() -> Capture:
    return Capture.open(SAMPLE)


def test_the_sample_capture_is_complete_and_small(sample: Capture) -> None:
    assert len(sample.views) >= 60 and (sample.views[0].camera.width, sample.views[0].camera.height) == (480, 270)
    assert len(sample.points.xyz) >= 3000 and float(np.mean(sample.points.error)) < 0.6
    assert sample.has_clean_frames and sample.has_truth
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) <= 25_000_000


def test_the_sample_capture_has_the_cameras_and_lights_of_its_script(sample: Capture) -> None:
    scene = SCENES["desk"]
    for view, stem, pose in zip(sample.views, scene.stems, scene.poses, strict=True):
        assert Path(view.name).stem == stem
        np.testing.assert_allclose(view.camera.world_to_camera, pose, atol=1e-9)
        assert (view.camera.cx, view.camera.cy) == (scene.camera.cx, scene.camera.cy)
    for found, light in zip(sample.lights, scene.lights, strict=True):
        assert found.name == light.name
        np.testing.assert_allclose(found.xyz, light.xyz)


def test_sample_frames_are_their_layers_seen_by_a_sensor(sample: Capture) -> None:
    for view in sample.views[2::17]:
        frame, removed = sample.frame(view), sample.clean_frame(view)
        scene, flare = sample.truth_scene(view), sample.truth_flare(view)
        assert removed and scene and flare and flare.pixels.min() >= 0
        both = srgb_from_linear(np.clip(scene.pixels + flare.pixels, 0, 1))
        assert psnr(frame.display(), both) > 42
        assert psnr(removed.display(), scene.display()) > 42
        assert psnr(frame.display(), removed.display()) < 33


def test_an_empty_flare_scores_as_the_readme_says(sample: Capture) -> None:
    scores = []
    for view in sample.views[::4]:
        scene, flare = sample.truth_scene(view), sample.truth_flare(view)
        assert scene and flare
        scores.append(psnr(srgb_from_linear(np.clip(scene.pixels + flare.pixels, 0, 1)), scene.display()))
    assert 23.5 < float(np.mean(scores)) < 26


def test_sample_lights_are_at_their_stated_positions(sample: Capture) -> None:
    """The bulbs as rendered agree with the cameras to a third of a pixel; the flares' cores sit on them."""
    shares = json.loads((SAMPLE / "truth" / "visible_share.json").read_text())
    checked = 0
    for view in sample.views[::5]:
        scene, flare = sample.truth_scene(view), sample.truth_flare(view)
        assert scene and flare
        places, _ = view.camera.project(np.array([light.xyz for light in sample.lights]))
        for light, (u, v) in zip(sample.lights, places, strict=True):
            if not (20 < u < 460 and 20 < v < 250) or shares[view.name][light.name] < 1:
                continue
            near = np.s_[int(v) - 14:int(v) + 15, int(u) - 14:int(u) + 15]
            bulb = np.clip(scene.pixels[near].max(axis=2) - 12, 0, 4)  # the bulb alone, as a flat disc
            rows, columns = np.mgrid[near] + 0.5
            centre = (bulb * columns).sum() / bulb.sum(), (bulb * rows).sum() / bulb.sum()
            assert math.dist(centre, (u, v)) < 0.35
            core = flare.pixels[near].sum(axis=2)
            core = np.clip(core - 0.5 * core.max(), 0, None)
            centre = (core * columns).sum() / core.sum(), (core * rows).sum() / core.sum()
            assert math.dist(centre, (u, v)) < 0.5
            checked += 1
    assert checked >= 8


def test_the_split_holds_out_hard_views(sample: Capture) -> None:
    shares = json.loads((SAMPLE / "truth" / "visible_share.json").read_text())
    train, test = sample.split(None)
    assert len(train) >= 48 and len(test) >= 8
    held = [share for view in test for share in shares[view.name].values()]
    assert any(share == 0 for share in held) and any(0.2 < share < 0.8 for share in held)
    for views in (train, test):
        outside = 0
        for view in views:
            places, depth = view.camera.project(np.array([light.xyz for light in sample.lights]))
            outside += bool(((places < 0) | (places > (480, 270))).any() and (depth > 0).all())
        assert outside >= 2


def test_a_folder_of_another_size_is_not_continued(tmp_path: Path) -> None:
    scene = SCENES["desk"]
    (tmp_path / "truth" / "scene").mkdir(parents=True)
    write_layer(tmp_path / "truth" / "scene" / f"{scene.stems[0]}.exr", np.zeros((270, 480, 3), np.float32), 45)
    with pytest.raises(CaptureError, match=r"480x270 pixels, not the 960x540 .* --out"):
        make_sample_capture(scene.resampled(960, 1), tmp_path, Progress())


def test_a_capture_can_be_rendered_wider_and_with_fewer_views() -> None:
    """Each view that is left is the same but for its pixels."""
    scene = SCENES["desk"]
    wide = scene.resampled(1920, 7)
    assert wide.camera == scene.camera.scaled(1920, 1080) and wide.samples < scene.samples
    assert wide.stems == scene.stems[::7]
    assert np.array_equal(wide.poses, scene.poses[::7])
    assert wide.resampled(None, 2).stems == scene.stems[::14]
    assert scene.resampled(None, 1) == scene
    assert scene.resampled(scene.camera.width // 4, 1).samples == scene.samples
