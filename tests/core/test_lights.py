# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights in pictures, in 3D, on disk."""
from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Camera, Capture
from core.colour.srgb import srgb_from_linear
from core.errors import Cancelled, CaptureError, EngineError, SettingsError
from core.images.picture import Picture
from core.lights import (
    Detection,
    ExposureDetector,
    TriangulationSettings,
    find_lights,
    make_detector,
    triangulate_lights,
    union_mask,
    write_findings,
)
from core.lights.candidates import MAX_LISTED_PAIRS
from core.lights.exposure import MAX_MORPHOLOGY_COST
from core.lights.file import check_replaceable, write_lights
from core.lights.find import Findings, _lights_from_one_view
from core.lights.found_light import FoundLight
from core.lights.ghosts import Blob, find_blobs, locate_by_ghosts
from core.lights.lifted import lift_to_gaussians
from core.lights.merging import remove_ghosts
from core.lights.triangulation import binomial_tail
from core.system.progress import Progress
from tests.core.captures import make_capture, orbit, picture

SIZE = (320, 240)
EXTENT = 2.5


def backdrop(seed: int = 0, size: tuple[int, int] = SIZE) -> NDArray[np.float64]:
    """A smooth picture in linear light, nowhere clipped."""
    return (picture(seed, size)[..., ::-1].astype(np.float64) / 255) ** 2.2 * 0.2


def with_disc(light: NDArray[np.float64], at: tuple[float, float], radius: float, radiance: float = 30.0,
              colour: tuple[float, float, float] = (1.0, 0.8, 0.6), glare: float = 1.0) -> NDArray[np.float64]:
    """A disc and its glare, added."""
    v, u = np.mgrid[:light.shape[0], :light.shape[1]] + 0.5
    away = np.hypot(u - at[0], v - at[1])
    shape = np.clip(radius - away + 0.5, 0, 1) * radiance + glare * radius ** 2 / (radius ** 2 + away ** 2)
    return light + shape[..., None] * np.array(colour)


def stored(light: NDArray[np.float64]) -> Picture:
    """As an 8 bit file holds it."""
    return Picture(np.round(np.clip(srgb_from_linear(light), 0, 1) * 255).astype(np.float32) / 255, "srgb")


class TestExposure:
    @pytest.mark.parametrize("at", [(100.5, 80.5), (100.3, 80.8), (211.9, 133.1)])
    @pytest.mark.parametrize("radius", [3.0, 7.3])
    def test_a_lamp_is_found_where_it_is(self, at: tuple[float, float], radius: float) -> None:
        (found,) = ExposureDetector().detect(stored(with_disc(backdrop(), at, radius)))
        assert np.linalg.norm(found.xy - at) < 0.25
        assert found.radius == pytest.approx(radius, rel=0.25)
        assert found.score > 0.8 and not found.is_cut

    def test_a_coloured_lamp_is_white_at_its_core_only(self) -> None:
        """Its glow clips in one channel, far out of the core."""
        scene = with_disc(backdrop(), (150, 100), 4, colour=(1.0, 0.45, 0.15), glare=4.0)
        (found,) = ExposureDetector().detect(stored(scene))
        assert found.radius > 6 and np.linalg.norm(found.xy - (150, 100)) < 0.3
        orange = with_disc(backdrop(), (150, 100), 8, radiance=2.0, colour=(1.0, 0.45, 0.15), glare=0.5)
        assert not ExposureDetector().detect(stored(orange)), "a bright orange thing clips, but is nowhere white"

    def test_the_colour_of_a_detection_is_that_of_its_glow(self) -> None:
        scene = with_disc(np.full((240, 320, 3), 0.1), (150, 100), 7)
        (found,) = ExposureDetector().detect(stored(scene))
        np.testing.assert_allclose(found.colour, (1.0, 0.8, 0.6), atol=0.05)

    def test_two_lamps_have_a_mask_each(self) -> None:
        scene = with_disc(with_disc(backdrop(), (60, 60), 6), (250, 150), 9, colour=(0.6, 0.8, 1))
        found = ExposureDetector().detect(stored(scene))
        assert len(found) == 2
        mask = union_mask(found, SIZE)
        assert mask[60, 60] and mask[150, 250] and not mask[100, 150] and 300 < mask.sum() < 700

    def test_spikes_and_a_bright_bracket_do_not_hide_a_lamp(self) -> None:
        scene = with_disc(backdrop(), (150, 100), 9)
        cv2.line(scene, (150, 100), (190, 140), (20.0, 20.0, 20.0), 3)
        cv2.line(scene, (150, 100), (150, 70), (20.0, 20.0, 20.0), 1)
        (found,) = ExposureDetector().detect(stored(scene))
        assert np.linalg.norm(found.xy - (150, 100)) < 2

    def test_a_starburst_is_one_detection(self) -> None:
        scene = with_disc(backdrop(), (150, 100), 9)
        for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
            base = np.array([-np.sin(angle), np.cos(angle)]) * 2.5
            tip = (np.array([np.cos(angle), np.sin(angle)]) * 17, base, -base)
            cv2.fillPoly(scene, [np.round([np.array([150, 100]) + point for point in tip]).astype(np.int32)],
                         (20.0, 20.0, 20.0))
        (found,) = ExposureDetector().detect(stored(scene))
        assert np.linalg.norm(found.xy - (150, 100)) < 1

    def test_a_lamp_at_the_edge_is_cut(self) -> None:
        (found,) = ExposureDetector(0.1).detect(stored(with_disc(backdrop(), (160, 2), 8)))
        assert found.is_cut

    @pytest.mark.parametrize("what", ["wall", "sky", "window", "red", "sparkle", "stripe", "nothing", "white"])
    def test_other_bright_regions_are_no_lamps(self, what: str) -> None:
        scene = backdrop()
        if what == "wall":
            scene[40:200, 30:200] = 1.2
        elif what == "sky":  # clipped in one place of a bright gradient
            v, u = np.mgrid[:240, :320]
            scene[:] = np.clip(1.02 - 0.0008 * np.hypot(u - 160, v - 120), 0, 1)[..., None]
        elif what == "window":
            for x in range(60, 260, 40):
                for y in range(30, 200, 40):
                    scene[y:y + 36, x:x + 36] = 1.5
            scene[100:104, 60:256] = 1.5  # and its panes run together
        elif what == "red":
            cv2.circle(scene, (150, 100), 9, (1.4, 0.05, 0.02), -1)
        elif what == "sparkle":
            scene[::24, ::24] = 3.0
        elif what == "stripe":
            scene[100:104, 20:300] = 2.0
        elif what == "white":
            scene[:] = 1.0
        assert not union_mask(ExposureDetector().detect(stored(scene)), SIZE).any()

    @pytest.mark.parametrize("what", ["half", "corner"])
    def test_a_large_white_region_is_not_opened_by_a_large_disc(self, what: str,
                                                                monkeypatch: pytest.MonkeyPatch) -> None:
        """Which would take minutes, with nobody asked whether to go on."""
        white = np.full((1080, 1920, 3), 0.2, np.float32)
        if what == "half":
            white[:540] = 1
        else:
            white[:160] = white[:, :160] = 1
        white[700:740, 900:940] = 1
        steps, morphology = [], cv2.morphologyEx
        monkeypatch.setattr(cv2, "morphologyEx", lambda mask, how, disc: steps.append(mask.size * disc.size) or
                            morphology(mask, how, disc))
        (found,) = ExposureDetector().detect(Picture(white, "srgb"))
        assert np.linalg.norm(found.xy - (920, 720)) < 0.01
        assert max(steps) < 2 * MAX_MORPHOLOGY_COST

    def test_a_large_lamp_is_opened_by_distances_as_by_a_disc(self, monkeypatch: pytest.MonkeyPatch) -> None:
        scene = with_disc(np.full((600, 800, 3), 0.02), (310, 280), 48, glare=0)
        cv2.fillPoly(scene, [np.array([(310, 270), (310, 290), (420, 330)])], (20.0, 20.0, 20.0))
        cv2.fillPoly(scene, [np.array([(300, 280), (320, 280), (290, 180)])], (20.0, 20.0, 20.0))
        (by_disc,) = ExposureDetector(0.1).detect(stored(scene))
        monkeypatch.setattr("core.lights.exposure.MAX_MORPHOLOGY_COST", 0)
        (by_distances,) = ExposureDetector(0.1).detect(stored(scene))
        assert np.linalg.norm(by_disc.xy - by_distances.xy) < 0.1 and np.linalg.norm(by_disc.xy - (310, 280)) < 1
        assert by_distances.score == pytest.approx(by_disc.score, abs=0.02)

    def test_lights_in_linear_pictures_are_detected(self) -> None:
        scene = with_disc(backdrop(), (150.2, 99.6), 8)
        (found,) = ExposureDetector().detect(Picture(scene.astype(np.float32), "linear"))
        assert np.linalg.norm(found.xy - (150.2, 99.6)) < 0.15


def spot(xy: NDArray[np.float64], radius: float = 3.0, score: float = 1.0) -> Detection:
    return Detection(np.asarray(xy, np.float64), radius, score, np.array([1.0, 0.9, 0.7]), np.ones((3, 3), bool),
                     (int(xy[0]), int(xy[1])), False)


def scene(lights: list[tuple[float, float, float]], cameras: list[Camera], noise: float = 0.4, clutter: int = 2,
          hidden: float = 0.0, seed: int = 0) -> list[list[Detection]]:
    """Return the detections of lights in every view that has them in frame.

    noise: standard deviation of their places, pixels. clutter: false detections in each view. hidden: probability that
    a light is missed.
    """
    rng = np.random.default_rng(seed)
    all_views = []
    for camera in cameras:
        pixels, depth = camera.project(lights)
        some = [spot(pixel + rng.normal(0, noise, 2)) for pixel, seen in
                zip(pixels, camera.contains(pixels, depth), strict=True) if seen and rng.uniform() >= hidden]
        some += [spot(rng.uniform((0, 0), SIZE), score=0.5) for _ in range(clutter)]
        all_views.append(some)
    return all_views


def named(cameras: list[Camera]) -> list[tuple[str, Camera]]:
    return [(f"{i:04d}.png", camera) for i, camera in enumerate(cameras)]


class TestTriangulation:
    def test_lights_are_triangulated_without_false_ones(self) -> None:
        lights = [(0.4, -0.5, 0.3), (-0.9, -0.2, 1.5), (0.1, 0.3, -1.0)]
        cameras = orbit(30, size=SIZE)
        found = triangulate_lights(named(cameras), scene(lights, cameras, hidden=0.3), EXTENT)
        assert len(found) == 3
        for light in lights:
            nearest = min(found, key=lambda one: float(np.linalg.norm(one.xyz - light)))
            error = float(np.linalg.norm(nearest.xyz - light))
            assert error < 0.02 and not nearest.far
            assert error < 4 * nearest.uncertainty < 0.1
            assert nearest.residual < 1 and len(nearest.support) > 12

    def test_clutter_alone_is_no_light(self) -> None:
        cameras = orbit(24, size=SIZE)
        assert not triangulate_lights(named(cameras), scene([], cameras, clutter=3), EXTENT)

    def test_dirt_on_the_lens_is_no_light(self) -> None:
        cameras = orbit(30, size=SIZE, arc=2.2)
        detections = [[spot(np.array([60.0, 50.0]))] for _ in cameras]
        assert not [light for light in triangulate_lights(named(cameras), detections, EXTENT) if len(light.support) > 8]

    def test_the_sun_keeps_its_direction(self) -> None:
        direction = np.array([0.15, -0.25, 1.0])
        direction /= np.linalg.norm(direction)
        cameras = orbit(30, size=SIZE, arc=0.7)
        (found,) = triangulate_lights(named(cameras), scene([tuple(1e7 * direction)], cameras, clutter=1), EXTENT)
        assert found.far and np.linalg.norm(found.xyz) > 100 * EXTENT
        away = found.xyz - np.mean([camera.position for camera in cameras], axis=0)
        angle = np.degrees(np.arccos(away @ direction / np.linalg.norm(away)))
        assert angle < 0.2 and angle < 4 * found.uncertainty + 0.02

    def test_few_views_mean_more_uncertainty(self) -> None:
        light = [(0.2, -0.3, 0.1)]
        cameras = orbit(40, size=SIZE)
        some = {}
        for number in (3, 40):
            (one,) = triangulate_lights(named(cameras[:number]), scene(light, cameras[:number], clutter=0), EXTENT)
            some[number] = one
            assert np.linalg.norm(one.xyz - light[0]) < 4 * one.uncertainty
        assert some[3].uncertainty > 5 * some[40].uncertainty

    def test_a_light_in_too_few_views_is_rejected(self) -> None:
        cameras = orbit(20, size=SIZE)
        detections = scene([(0.2, -0.3, 0.1)], cameras, clutter=0)
        detections[2:] = [[] for _ in detections[2:]]
        assert not triangulate_lights(named(cameras), detections, EXTENT)
        settings = TriangulationSettings(min_views=2, max_nfa=1, min_share=0)
        (light,) = triangulate_lights(named(cameras), detections, EXTENT, settings)
        assert light.support == ("0000.png", "0001.png")

    def test_two_detections_of_one_lamp_are_merged(self) -> None:
        """A lamp and its glow, a little apart, in the same views."""
        cameras = orbit(20, size=SIZE)
        detections = [[spot(camera.project([(0.2, -0.3, 0.1)])[0][0], 8.0),
                       spot(camera.project([(0.24, -0.3, 0.1)])[0][0], 8.0)] for camera in cameras]
        assert len(triangulate_lights(named(cameras), detections, EXTENT)) == 1

    @pytest.mark.parametrize("share", [0.75, -0.5, 1.0])
    def test_a_ghost_of_a_light_is_no_light(self, share: float) -> None:
        """Spots that follow a light at a fixed share of the way to it; a second light beside it (share 1) stays."""
        views = named(turning(20))
        light, beside = np.array((0.4, -0.5, 0.3)), np.array((0.9, -0.2, -0.4))
        follows = []
        for name, camera in views:
            centre = np.array([camera.cx, camera.cy])
            pixel = camera.project([light if share != 1 else beside])[0][0]
            follows.append((name, spot(centre + share * (pixel - centre))))
        real = FoundLight(light, False, tuple(name for name, _ in views), 20, 0.5, 0.01, np.ones(3), 3.0)
        other = FoundLight(beside, False, tuple(name for name, _ in views[:15]), 20, 2.0, 0.01, np.ones(3), 3.0,
                           detections=tuple(follows[:15]))
        assert remove_ghosts([other, real], views) == ([real, other] if share == 1 else [real])

    def test_the_same_seed_gives_the_same_lights(self) -> None:
        cameras = orbit(20, size=SIZE)
        detections = scene([(0.4, -0.5, 0.3)], cameras, clutter=6)
        first, second = (triangulate_lights(named(cameras), detections, EXTENT) for _ in range(2))
        assert [light.xyz.tolist() for light in first] == [light.xyz.tolist() for light in second]


    def test_a_light_in_every_fourth_of_many_views(self) -> None:
        """A light that only every fourth of 1100 views shows is found, with all of these as its support."""
        cameras = orbit(1100, size=SIZE)
        detections = [some if i % 4 == 0 else [] for i, some in
                      enumerate(scene([(0.4, -0.5, 0.3)], cameras, clutter=0))]
        (found,) = triangulate_lights(named(cameras), detections, EXTENT)
        assert np.linalg.norm(found.xyz - (0.4, -0.5, 0.3)) < 0.02 and len(found.support) == 275

    def test_spots_without_a_score_propose_nothing(self) -> None:
        """Spots of score 0, which a threshold of 0 lets through, are no lights and do not keep a lamp from being
        found."""
        cameras = orbit(16, size=SIZE)
        nothing = [[spot((9.0 + 3 * number, 7.0), score=0.0) for number in range(24)] for _ in cameras]
        assert not triangulate_lights(named(cameras), nothing, EXTENT)
        lamp = scene([(0.4, -0.5, 0.3)], cameras, clutter=0)
        lit = [[*some, *none] for some, none in zip(lamp, nothing, strict=True)]
        (found,) = triangulate_lights(named(cameras), lit, EXTENT)
        assert np.linalg.norm(found.xyz - (0.4, -0.5, 0.3)) < 0.05

    def test_pairs_of_very_many_detections_are_drawn(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Without a list of all, and the same ones by the same seed."""
        listed, triangle = [], np.triu_indices
        monkeypatch.setattr(np, "triu_indices", lambda n, k: listed.append(math.comb(n, 2)) or triangle(n, k))
        cameras = orbit(8, size=SIZE)
        detections = scene([(0.4, -0.5, 0.3)], cameras, clutter=220)
        assert math.comb(sum(map(len, detections)), 2) > MAX_LISTED_PAIRS
        settings = TriangulationSettings(max_lights=1, max_candidates=600, min_views=5, max_nfa=np.inf)
        first, second = (triangulate_lights(named(cameras), detections, EXTENT, settings) for _ in range(2))
        assert [light.xyz.tolist() for light in first] == [light.xyz.tolist() for light in second] and first
        assert len(first[0].support) >= 5
        assert max(listed, default=0) <= MAX_LISTED_PAIRS


def test_the_binomial_tail_is_exact() -> None:
    for share in (1e-6, 0.01, 0.3, 0.5):
        for least in (0, 1, 15, 60):
            direct = sum(math.comb(60, k) * share ** k * (1 - share) ** (60 - k) for k in range(least, 61))
            assert binomial_tail(least, 60, share) == pytest.approx(direct, rel=1e-9)
    many = [binomial_tail(least, 1500, 0.3) for least in (0, 1, 400, 450, 600, 1500, 1501)]
    assert many == sorted(many, reverse=True) and many[0] == 1 and 0.5 < many[3] < 0.52 and many[-1] == 0
    edges = [binomial_tail(least, 60, share) for least, share in ((0, 0), (1, 0), (60, 1), (61, 1))]
    assert edges == [1, 0, 1, 0]


def turning(number: int, max_turn: float = 0.12) -> list[Camera]:
    """Cameras that travel and turn, the light of `TestGhosts` above all their frames. max_turn: radians."""
    turns = np.random.default_rng(4).uniform(-max_turn, max_turn, (number, 2))
    return [Camera(*SIZE, 300, 300, 160, 120, tilt(x, y) @ camera.world_to_camera)
            for camera, (x, y) in zip(orbit(number, size=SIZE), turns, strict=True)]


def tilt(x: float, y: float) -> NDArray[np.float64]:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([x, y, 0.0]))[0]
    return turn


class TestGhosts:
    light = np.array([0.5, -2.6, 1.0])

    def frames(self, cameras: list[Camera], share: float) -> list[Picture]:
        """Return pictures of bright static points and of a ghost of the light; share: the ghost's place on the line
        from the centre to the light, 0 for no ghost."""
        static = np.random.default_rng(0).uniform((-1, -0.8, -0.5), (1, 0.8, 1), (6, 3))
        made = []
        for camera in cameras:
            light = np.full((SIZE[1], SIZE[0], 3), 0.1)
            v, u = np.mgrid[:SIZE[1], :SIZE[0]] + 0.5
            spots = [(pixel, 4.0, 0.25) for pixel in camera.project(static)[0]]
            pixel = camera.project(self.light[None])[0][0]
            centre = np.array([camera.cx, camera.cy])
            if share:
                spots.append((centre + share * (pixel - centre), 7.0, 0.12))
            for at, radius, strength in spots:
                light += strength * (np.hypot(u - at[0], v - at[1]) < radius)[..., None] * np.array([0.5, 0.8, 1.0])
            made.append(stored(light))
        return made

    def test_a_light_out_of_frame_is_found_by_its_ghost(self) -> None:
        cameras = turning(16)
        for camera in cameras:
            assert not camera.contains(*camera.project(self.light[None]))[0]
        blobs = [find_blobs(frame) for frame in self.frames(cameras, -0.35)]
        (found,) = locate_by_ghosts(named(cameras), blobs, EXTENT)
        middle = np.mean([camera.position for camera in cameras], axis=0)
        a, b = found.xyz - middle, self.light - middle
        assert np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))) < 2
        assert len(found.support) >= 12 and "ghost" in found.how

    def test_the_search_can_be_stopped(self) -> None:
        progress = Progress()
        progress.request_stop()
        with pytest.raises(Cancelled):
            locate_by_ghosts(named(turning(8)), [[] for _ in range(8)], EXTENT, progress=progress)

    def test_no_light_is_found_without_ghosts(self) -> None:
        cameras = turning(16)
        blobs = [find_blobs(frame) for frame in self.frames(cameras, 0.0)]
        assert not locate_by_ghosts(named(cameras), blobs, EXTENT)


class TestSunInClippedSky:
    """A sun far away whose sky is clipped over many times its disc."""

    sun = np.array([30.0, -110.0, 420.0])
    sky_radius = 60.0

    def find(self, share: float) -> Findings:
        """Search the frames of turning cameras before a clipped sky; share: the ghost's place on the line from the
        centre to the sun, 0 for no ghost."""
        cameras, frames = turning(14, 0.2), {}
        static = np.random.default_rng(0).uniform((-1, -0.8, -0.5), (1, 0.8, 1), (6, 3))
        for name, camera in named(cameras):
            light = np.full((SIZE[1], SIZE[0], 3), 0.1)
            v, u = np.mgrid[:SIZE[1], :SIZE[0]] + 0.5
            sun, centre = camera.project(self.sun[None])[0][0], np.array([camera.cx, camera.cy])
            distance = np.hypot(u - sun[0] - 6, v - sun[1])  # the sun is not in the middle of the clipped sky
            light += np.clip(1 + (self.sky_radius - distance) / 120, 0, 1.2)[..., None]
            for pixel in camera.project(static)[0]:
                light[np.hypot(u - pixel[0], v - pixel[1]) < 4] = 0.4
            if share:
                ghost = centre + share * (sun - centre)
                light += 0.12 * (np.hypot(u - ghost[0], v - ghost[1]) < 7)[..., None] * np.array([0.5, 0.8, 1.0])
            frames[name] = stored(light)
        views = [SimpleNamespace(name=name, camera=camera) for name, camera in named(cameras)]
        return find_lights(SimpleNamespace(views=views, frame=lambda view: frames[view.name], extent=EXTENT,
                                           clean_frame=lambda _: None), ExposureDetector(0.3))

    def test_a_ghost_gives_the_direction_of_the_sun(self) -> None:
        findings = self.find(-0.5)
        (found,) = findings.lights
        middle = np.mean([camera.position for camera in turning(14, 0.2)], axis=0)
        a, b = found.xyz - middle, self.sun - middle
        assert np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))) < 0.7
        assert any("clipped area" in message for message in findings.messages)

    def test_a_clipped_sky_without_ghosts_is_no_light(self) -> None:
        assert not self.find(0.0).lights

    def test_objects_of_the_scene_are_no_ghosts(self) -> None:
        """From cameras that look forward and hardly move, objects opposite to a window agree on a light in it."""
        cameras = [Camera(*SIZE, 300, 300, 160, 120, shifted(x, y)) for x in np.linspace(-0.2, 0.2, 6)
                   for y in (-0.05, 0.05)]
        objects = np.random.default_rng(1).uniform((-4, 0.5, 8), (4, 3, 12), (10, 3))
        blobs = [[Blob(pixel, 5.0, 0.1) for pixel in camera.project(objects)[0] if camera.contains([pixel])[0]]
                 for camera in cameras]
        window = np.zeros((60, 80), bool)
        window[2:25] = True
        assert not locate_by_ghosts(named(cameras), blobs, 1.0, clipped_areas=[window] * len(cameras))


def shifted(x: float, y: float) -> NDArray[np.float64]:
    """World-to-camera matrix of a camera at (x, y, 0) that looks along z."""
    matrix = np.eye(4)
    matrix[:2, 3] = -x, -y
    return matrix


def test_lights_are_lifted_on_to_a_scene() -> None:
    """Gaussians of a lamp, a wall behind it and haze of no opacity: the lamp's centroid comes out."""
    rng = np.random.default_rng(0)
    lamp = np.array([0.3, -0.4, 0.2])
    means = np.concatenate([lamp + rng.normal(0, 0.02, (60, 3)),
                            np.stack([*rng.uniform(-2, 2, (2, 3000)), np.full(3000, 1.5)], axis=1),
                            rng.uniform(-1, 1, (500, 3))])
    opacities = np.concatenate([np.full(3060, 0.9), np.full(500, 0.05)])
    cameras = orbit(15, size=SIZE)
    detections = []
    for camera in cameras:
        pixel = camera.project(lamp[None])[0][0]
        corner = (int(pixel[0]) - 5, int(pixel[1]) - 5)
        detections.append([Detection(pixel, 5.0, 1.0, np.ones(3), np.ones((11, 11), bool), corner, False)])
    (light,) = lift_to_gaussians(named(cameras), detections, means, opacities, EXTENT)
    assert np.linalg.norm(light.xyz - lamp) < 0.01
    assert len(light.support) == 15 and light.residual < 1
    assert not lift_to_gaussians(named(cameras), [[] for _ in cameras], means, opacities, EXTENT)


class TestFile:
    def found(self, *places: tuple[float, float, float]) -> list:
        cameras = orbit(12, size=SIZE)
        return triangulate_lights(named(cameras), scene(list(places), cameras, noise=0.1, clutter=0), EXTENT)

    def test_written_lights_are_read_back(self, tmp_path: Path) -> None:
        folder = make_capture(tmp_path / "c")
        write_lights(folder / "lights.json", self.found((0.4, -0.5, 0.3)), named(orbit(12, size=SIZE)))
        (light,) = Capture.open(folder).lights
        assert light.name == "light1" and np.linalg.norm(light.xyz - (0.4, -0.5, 0.3)) < 0.02
        entry = json.loads((folder / "lights.json").read_text())["lights"][0]
        assert entry["support"] == 12 and entry["residual_px"] < 1 and entry["colour"][0] == 1

    def test_editing_by_hand_survives(self, tmp_path: Path) -> None:
        path, views = tmp_path / "lights.json", named(orbit(12, size=SIZE))
        a, b, c = (0.4, -0.5, 0.3), (-0.6, -0.2, 0.5), (0.0, 0.5, 0.0)
        write_lights(path, self.found(a, b, c), views)
        data = json.loads(path.read_text())
        assert len(data["lights"]) == 3

        def entry(place: tuple[float, float, float]) -> dict:
            return min(data["lights"], key=lambda one: np.linalg.norm(np.subtract(one["xyz"], place)))

        entry(a)["name"] = "lamp"  # renamed
        entry(b)["xyz"] = [-0.6, -0.22, 0.5]  # moved a little
        data["lights"].remove(entry(c))  # taken out
        data["lights"].append({"name": "moon", "xyz": [0, -900, 100], "note": "mine"})  # added
        path.write_text(json.dumps(data))
        before = json.loads(path.read_text())["lights"]
        write_lights(path, self.found(a, b, c), views, keep=True)
        assert json.loads(path.read_text())["lights"] == before
        new = (0.7, 0.3, -0.4)
        write_lights(path, self.found(a, b, c, new), views, keep=True)
        after = json.loads(path.read_text())["lights"]
        assert after[:-1] == before and np.linalg.norm(np.subtract(after[-1]["xyz"], new)) < 0.02
        write_lights(path, self.found(a), views)  # and without keep the file is made afresh
        assert len(json.loads(path.read_text())["lights"]) == 1

    def test_an_invalid_file_cannot_be_kept(self, tmp_path: Path) -> None:
        """Keeping an invalid lights.json is refused, and the file stays as it is."""
        path = tmp_path / "lights.json"
        path.write_text("{")
        with pytest.raises(CaptureError, match=r"lights\.json"):
            write_lights(path, [], [], keep=True)
        assert path.read_text() == "{"

    @pytest.mark.parametrize(("old", "new"), [
        ('"found": [', '"found": null, "before": ['), ('"found": [', '"found": [["a", 1, 2], '),
        ('"found": [', '"found": [[NaN, 1, 2], '), ('"found": [', '"found": [[1, 2], '),
        ('"uncertainty": ', '"uncertainty": NaN, "before": ')])
    def test_lights_edited_by_hand_are_not_replaced(self, tmp_path: Path, old: str, new: str) -> None:
        path, views = tmp_path / "lights.json", named(orbit(12, size=SIZE))
        found = self.found((0.4, -0.5, 0.3))
        write_lights(path, found, views)
        damaged = path.read_text().replace(old, new)
        path.write_text(damaged)
        with pytest.raises(CaptureError, match=r"lights\.json.*(list of places|is not finite)"):
            write_lights(path, found, views, keep=True)
        assert path.read_text() == damaged
        if "found" in new:
            with pytest.raises(CaptureError, match="list of places"):
                check_replaceable(path)


def lit_capture(folder: Path, views: int, places: list[tuple[float, float, float]]) -> Path:
    """Write a capture whose frames show lamps at these places in the world; return its folder."""
    make_capture(folder, views=views, size=SIZE)
    for i, camera in enumerate(orbit(views, size=SIZE)):
        light = backdrop(i)
        for place in places:
            light = with_disc(light, tuple(camera.project([place])[0][0]), 6)
        display = stored(light).pixels[..., ::-1]
        cv2.imwrite(str(folder / "images" / f"{i:04d}.png"), (display * 255 + 0.5).astype(np.uint8))
    return folder


class TestFind:
    def test_lights_of_frames_are_found_and_written(self, tmp_path: Path) -> None:
        places = [(0.4, -0.5, 0.3), (-0.6, 0.2, 0.5)]
        capture = Capture.open(lit_capture(tmp_path / "c", 9, places))
        findings = find_lights(capture, ExposureDetector(0.3))
        write_findings(capture, findings)
        lights = Capture.open(tmp_path / "c").lights
        assert len(lights) == 2
        for place in places:
            assert min(np.linalg.norm(light.xyz - place) for light in lights) < 0.02
        assert cv2.imread(str(tmp_path / "c/lights/sheet1.png")).shape[1] == 4 * 360
        report = json.loads((tmp_path / "c/lights/report.json").read_text())
        assert len(report["views"]) == 9 and all(len(view["detections"]) == 2 for view in report["views"])

    def test_views_without_a_light_give_a_message(self, tmp_path: Path) -> None:
        capture = Capture.open(lit_capture(tmp_path / "c", 6, []))
        findings = find_lights(capture, ExposureDetector(0.3))
        assert not findings.lights and "No light was found" in findings.messages[-1]
        write_findings(capture, findings)
        assert Capture.open(tmp_path / "c").lights == ()

    def test_a_single_view_gives_a_guessed_distance(self, tmp_path: Path) -> None:
        capture = Capture.open(lit_capture(tmp_path / "c", 1, [(0.4, -0.5, 0.3)]))
        findings = find_lights(capture, ExposureDetector(0.3))
        (light,) = findings.lights
        ray = light.xyz - capture.views[0].camera.position
        true = np.array((0.4, -0.5, 0.3)) - capture.views[0].camera.position
        assert ray @ true / np.linalg.norm(ray) / np.linalg.norm(true) > 0.9999
        assert "guess" in findings.messages[-1] and "guessed" in light.how

    def test_a_light_that_two_of_many_views_show_is_doubtful(self, tmp_path: Path) -> None:
        folder = lit_capture(tmp_path / "c", 8, [(0.4, -0.5, 0.3)])
        for i in range(2, 8):
            cv2.imwrite(str(folder / "images" / f"{i:04d}.png"), picture(i, SIZE) // 2)
        findings = find_lights(Capture.open(folder), ExposureDetector(0.3))
        assert not findings.lights and len(findings.doubtful) == 1
        assert not any("No light was found" in sentence for sentence in findings.messages)
        assert np.linalg.norm(findings.doubtful[0].xyz - (0.4, -0.5, 0.3)) < 4 * findings.doubtful[0].uncertainty

    def test_invalid_settings_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(SettingsError, match="0 and 1"):
            make_detector("exposure", 2.0)
        with pytest.raises(SettingsError, match="magic"):
            make_detector("magic")
        with pytest.raises(SettingsError, match="at least 1"):
            find_lights(Capture.open(make_capture(tmp_path / "c")), ExposureDetector(),
                        settings=TriangulationSettings(min_views=0))


def test_the_grounded_detector_names_missing_libraries_and_weights(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match="exposure method"):
        make_detector("grounded", boxes=tmp_path / "none", masks=tmp_path / "none")


def test_a_deleted_light_stays_deleted_after_a_search_that_missed_it(tmp_path: Path) -> None:
    path, views, found = tmp_path / "lights.json", named(orbit(12, size=SIZE)), TestFile().found
    kept, out = (0.4, -0.5, 0.3), (0.0, 0.5, 0.0)
    write_lights(path, found(kept, out), views)
    data = json.loads(path.read_text())
    data["lights"] = [one for one in data["lights"] if np.linalg.norm(np.subtract(one["xyz"], out)) > 0.1]
    path.write_text(json.dumps(data))
    for places in ((kept,), (kept, out)):
        write_lights(path, found(*places), views, keep=True)
    assert len(json.loads(path.read_text())["lights"]) == 1


def test_a_light_of_one_view_has_the_depth_of_the_points() -> None:
    camera, place = Camera(64, 48, 30.0, 30.0, 32.0, 24.0, np.eye(4)), np.array([2.0, 0.0, 2.4])
    capture = SimpleNamespace(views=[SimpleNamespace(name="a", camera=camera)], extent=1.0,
                              points=SimpleNamespace(xyz=place[None]))
    one = SimpleNamespace(xy=camera.project([place])[0][0], colour=np.ones(3), radius=2.0)
    np.testing.assert_allclose(_lights_from_one_view(capture, [one])[0].xyz, place, atol=1e-6)  # type: ignore[arg-type, list-item]
