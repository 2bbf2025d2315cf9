# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights that are followed from frame to frame."""
from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Capture, read_lights
from core.colour.srgb import srgb_from_linear
from core.errors import CaptureError
from core.images.picture import Picture
from core.images.write import write_png
from core.lights.file import check_replaceable
from core.lights.find import track_moving_lights, write_tracks
from core.lights.found_light import FoundLight
from core.lights.sources import find_sources
from core.lights.tracks import TrackFindings, fit_brightness, track_lights
from tests.core.captures import make_capture

SIZE = (320, 180)
Lamp = tuple[float, float, float]
"""Place (x, y), pixels, and brightness 0..1."""


def lit(lamps: Sequence[Lamp], radius: float = 4.0, boxes: Sequence[tuple[int, int, int, int]] = ()
        ) -> NDArray[np.float64]:
    """Return linear light (h, w, 3) of lamps with their glow before a dim wall. boxes: (left, top, right, bottom),
    white."""
    light = np.full((SIZE[1], SIZE[0], 3), 0.06)
    light += 0.03 * np.sin(np.arange(SIZE[0]) / 9)[None, :, None] ** 2
    for left, top, right, bottom in boxes:
        light[top:bottom, left:right] = 1.3
    v, u = np.mgrid[:SIZE[1], :SIZE[0]] + 0.5
    for x, y, on in lamps:
        away = np.hypot(u - x, v - y)
        glow = np.clip(radius - away + 0.5, 0, 1) * 30 + 1.5 * radius ** 2 / (radius ** 2 + away ** 2)
        light += on * glow[..., None] * np.array([1.0, 0.9, 0.75])
    return light


def make_shot(folder: Path, number: int, frame: Callable[[int], NDArray[np.float64]]) -> Capture:
    """Write a shot without cameras of linear frames and open it."""
    (folder / "images").mkdir(parents=True)
    for index in range(number):
        write_png(folder / "images" / f"{index + 1:04d}.png", srgb_from_linear(np.clip(frame(index), 0, 1)))
    return Capture.open(folder, need_cameras=False)


def places(findings: TrackFindings, light: int = 0) -> NDArray[np.float64]:
    return np.array([key.xy for key in findings.lights[light].keys.values()])


class TestFollowing:
    def test_a_lamp_that_moves_is_followed_within_a_fraction_of_a_pixel(self, tmp_path: Path) -> None:
        path = [(40.3 + 18 * i, 90.7 + 30 * np.sin(i / 3), 1.0) for i in range(14)]
        findings = track_lights(make_shot(tmp_path, 14, lambda i: lit([path[i]])))
        assert len(findings.lights) == 1 and len(findings.lights[0].support) == 14
        np.testing.assert_allclose(places(findings), [at[:2] for at in path], atol=0.4)
        assert not findings.lights[0].doubtful

    def test_twins_keep_their_names_from_afar_to_near(self, tmp_path: Path) -> None:
        def pair(i: int) -> list[Lamp]:
            apart = 11 + 3.0 * i
            return [(150 - apart / 2, 90 + i, 1.0), (150 + apart / 2, 90 + i, 1.0)]

        findings = track_lights(make_shot(tmp_path, 12, lambda i: lit(pair(i), 3.0)))
        assert len(findings.lights) == 2
        tracks = sorted((places(findings, light) for light in range(2)), key=lambda track: track[0, 0])
        for side, track in enumerate(tracks):
            np.testing.assert_allclose(track, [pair(i)[side][:2] for i in range(12)], atol=1.0)

    def test_lamps_that_cross_keep_their_names(self, tmp_path: Path) -> None:
        def crossing(i: int) -> list[Lamp]:
            return [(40 + 16 * i, 70 + 2 * i, 1.0), (280 - 16 * i, 100 - i, 1.0)]

        findings = track_lights(make_shot(tmp_path, 15, lambda i: lit(crossing(i), 3.0)))
        tracks = sorted((places(findings, light) for light in range(2)), key=lambda track: track[0, 0])
        assert np.abs(tracks[0][-1] - crossing(14)[0][:2]).max() < 2
        assert np.abs(tracks[1][-1] - crossing(14)[1][:2]).max() < 2

    def test_a_hidden_lamp_is_the_same_afterwards_and_dark_meanwhile(self, tmp_path: Path) -> None:
        path = [(40 + 17 * i, 60 + 2 * i) for i in range(15)]
        shown = [not 6 <= i < 10 for i in range(15)]
        findings = track_lights(make_shot(tmp_path, 15, lambda i: lit([(*path[i], 1.0)] if shown[i] else [])))
        (light,) = findings.lights
        assert len(light.support) == 11
        np.testing.assert_allclose(places(findings), path, atol=2.0)
        on = [key.on for key in light.keys.values()]
        assert all(on[i] == 0 for i in range(6, 10)) and min(on[:6] + on[10:]) > 0.8

    def test_a_lamp_that_leaves_the_frame_goes_on_and_is_doubtful(self, tmp_path: Path) -> None:
        findings = track_lights(make_shot(tmp_path, 16, lambda i: lit([(150 + 20 * i, 90, 1.0)])))
        (light,) = findings.lights
        last = list(light.keys.values())[-1]
        assert last.xy is not None and last.xy[0] > SIZE[0] + 20 and last.on is None
        assert "0012.png" not in light.support and "0012.png" in light.doubtful

    def test_a_dimmed_lamp_has_its_brightness(self, tmp_path: Path) -> None:
        on = [1.0, 1.0, 0.8, 0.6, 0.45, 0.6, 0.8, 1.0, 1.0, 0.7, 0.5, 1.0]
        findings = track_lights(make_shot(tmp_path, 12, lambda i: lit([(100 + 5 * i, 90, on[i])])))
        np.testing.assert_allclose([key.on for key in findings.lights[0].keys.values()], on, atol=0.13)

    def test_a_white_box_that_moves_is_no_lamp(self, tmp_path: Path) -> None:
        findings = track_lights(make_shot(
            tmp_path, 10, lambda i: lit([(60 + 10 * i, 60, 1.0)], boxes=[(200 - 8 * i, 110, 224 - 8 * i, 140)])))
        assert len(findings.lights) == 1 and abs(places(findings)[0][1] - 60) < 1

    def test_a_ghost_is_no_lamp(self, tmp_path: Path) -> None:
        def frame(i: int) -> NDArray[np.float64]:
            x, y = 60 + 15 * i, 50 + 5 * i
            light = lit([(x, y, 1.0)], 6.0)
            return np.maximum(light, lit([(160 - 0.6 * (x - 160), 90 - 0.6 * (y - 90), 0.6)], 3.0))

        findings = track_lights(make_shot(tmp_path, 12, frame))
        assert len(findings.lights) == 1 and any("ghosts" in text for text in findings.messages)
        assert abs(places(findings)[0][0] - 60) < 1

    @pytest.mark.parametrize(("offset", "radius", "count"), [(0.0, 2.5, 1), (40.0, 2.5, 2), (0.0, 5.0, 2)])
    def test_a_reflection_on_the_ground_is_no_lamp(self, tmp_path: Path, offset: float, radius: float, count: int
                                                   ) -> None:
        """What is smaller and straight below a lamp is its reflection; a lamp as large, or beside it, is none."""
        def frame(i: int) -> NDArray[np.float64]:
            x = 60 + 12 * i
            return np.maximum(lit([(x, 45, 1.0)], 5.0), lit([(x + offset, 130 - i, 0.8)], radius))

        findings = track_lights(make_shot(tmp_path, 12, frame))
        assert len(findings.lights) == count and abs(places(findings)[0][1] - 45) < 1
        assert any("reflection on" in text for text in findings.messages) == (count == 1)

    def test_a_lamp_below_a_white_thing_or_a_smaller_lamp_is_no_reflection(self, tmp_path: Path) -> None:
        box, lamp = (138, 40, 168, 62), (150.0, 130.0, 1.0)
        for number, frame in enumerate((lit([lamp], 3.0, boxes=[box]),
                                        np.maximum(lit([(150.0, 40.0, 1.0)], 3.0), lit([lamp], 6.0)))):
            findings = track_lights(make_shot(tmp_path / str(number), 8, lambda _i, frame=frame: frame))
            assert lamp[1] in [round(float(places(findings, light)[0][1])) for light in range(len(findings.lights))]

    def test_a_lamp_that_left_the_frame_is_not_another_that_appears_elsewhere(self, tmp_path: Path) -> None:
        def lamps(i: int) -> list[Lamp]:
            leaving = [(200.0 + 5 * i + 5 * (i % 2), 120.0 + 6 * i, 1.0)] if i < 12 else []
            return leaving + ([(60.0 + i, 40.0 + i, 1.0)] if i >= 26 else [])

        findings = track_lights(make_shot(tmp_path, 36, lambda i: lit(lamps(i))))
        assert [light.support[0] for light in findings.lights] in (["0001.png", "0027.png"], ["0027.png", "0001.png"])

    def test_a_large_sun_in_a_bright_sky_is_a_light(self, tmp_path: Path) -> None:
        def frame(i: int) -> NDArray[np.float64]:
            v, u = np.mgrid[:SIZE[1], :SIZE[0]] + 0.5
            away = np.hypot(u - 150 - i, v - 60)
            return (0.1 + 8.0 * np.exp(-away / 8) + 0.5 * np.exp(-away / 40))[..., None] * np.array([1.0, 0.8, 0.55])

        (light,) = track_lights(make_shot(tmp_path, 8, frame)).lights
        assert len(light.support) == 8 and light.radius > 15

    def test_frames_without_a_lamp_say_so(self, tmp_path: Path) -> None:
        findings = track_lights(make_shot(tmp_path, 5, lambda _: lit([])))
        assert not findings.lights and any("No light was found" in text for text in findings.messages)

    def test_footage_that_stays_below_white_is_searched_as_well(self, tmp_path: Path) -> None:
        findings = track_lights(make_shot(
            tmp_path, 8, lambda i: np.clip(lit([(60 + 20 * i, 90, 1.0)]), 0, 1) * 0.8))
        assert len(findings.lights) == 1 and len(findings.lights[0].support) == 8


def test_in_a_solved_capture_only_lights_that_move_get_a_path(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "room", 12, size=SIZE))
    standing = np.array([0.3, -0.4, 0.5])
    for index, view in enumerate(capture.views):
        at = view.camera.project(standing)[0][0]
        light = lit([(float(at[0]), float(at[1]), 1.0), (40.0 + 20 * index, 130.0 - 4 * index, 1.0)])
        write_png(capture.frame_path(view), srgb_from_linear(np.clip(light, 0, 1)))
    capture = capture.reopen()
    found = FoundLight(standing, False, (), 12, 0.0, 0.0, np.ones(3), 4.0)
    findings = track_moving_lights(capture, [found])
    (light,) = findings.lights
    np.testing.assert_allclose(places(findings)[[0, -1]], [(40, 130), (260, 86)], atol=1)
    assert "1 that were followed stand" in findings.messages[0]


def test_light_above_white_places_a_source_by_its_flux() -> None:
    light = lit([(100.25, 80.5, 1.0)], 3.0)
    light[76:85, 103:108] += 1.2
    placed = [find_sources(Picture(np.clip(light, 0, white).astype(np.float32), "linear"))[0].xy for white in (100, 1)]
    errors = [float(np.abs(xy - (100.25, 80.5)).max()) for xy in placed]
    assert errors[0] < 0.1 < errors[1]


def test_brightness_needs_a_ring_that_is_not_clipped() -> None:
    glow = 0.8 * np.exp(-np.arange(15) / 3)
    profiles = np.stack([np.full(15, np.nan), 0.1 + glow, 0.1 + 0.5 * glow])
    on = fit_brightness(profiles, np.array([True, True, True]))
    assert np.isnan(on[0]) and on[1] == pytest.approx(1, abs=0.08) and on[2] == pytest.approx(0.5, abs=0.08)


class TestFile:
    @pytest.fixture
    def shot(self, tmp_path: Path) -> Capture:
        return make_shot(tmp_path, 8, lambda i: lit([(60 + 15 * i, 90, 1.0)]))

    def entries(self, capture: Capture) -> list[dict[str, Any]]:
        return list(json.loads((capture.folder / "lights.json").read_text())["lights"])

    def test_paths_are_written_drawn_and_read(self, shot: Capture) -> None:
        report = write_tracks(shot, track_lights(shot))
        (light,) = read_lights(shot.folder / "lights.json")
        assert light.is_on_picture and light.keys["0003.png"].xy == pytest.approx([90, 90], abs=0.4)
        state = shot.reopen().light_state(light, shot.views[2])
        assert state.xy == pytest.approx([90, 90], abs=0.4) and state.on == pytest.approx(1, abs=0.1)
        sheet = cv2.imread(str(shot.folder / report["sheets"][0]))
        assert sheet is not None and sheet.max() > 200
        check_replaceable(shot.folder / "lights.json")

    def test_a_corrected_path_is_not_replaced(self, shot: Capture) -> None:
        write_tracks(shot, track_lights(shot))
        path = shot.folder / "lights.json"
        data = json.loads(path.read_text())
        data["lights"][0]["frames"]["0002.png"]["xy"][0] += 5
        path.write_text(json.dumps(data))
        with pytest.raises(CaptureError, match="light1"):
            check_replaceable(path)
        write_tracks(shot, track_lights(shot), keep=True)
        assert self.entries(shot) == data["lights"]

    def test_a_deleted_path_is_not_added_again(self, shot: Capture) -> None:
        write_tracks(shot, track_lights(shot))
        path = shot.folder / "lights.json"
        data = json.loads(path.read_text())
        path.write_text(json.dumps({**data, "lights": [{"name": "lamp", "xy": [5, 5]}]}))
        write_tracks(shot, track_lights(shot), keep=True)
        assert [entry["name"] for entry in self.entries(shot)] == ["lamp"]
