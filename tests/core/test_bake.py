# SPDX-License-Identifier: GPL-3.0-or-later
"""Layers, their files, edits, frame numbers, and a bake that can be gone on with."""
from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from core.bake import bake as baking
from core.bake.bake import MANIFEST, BakeSettings, bake, read_manifest
from core.bake.exr import read_description, read_layers, write_layers
from core.bake.layers import EMPTY_DEPTH, FrameLayers, layer_names, to_layers
from core.capture.camera import Camera
from core.colour import REC_709, colour_space
from core.conventions.frame_numbers import missing_numbers, number_views, plates_by_number, select_frames
from core.errors import Cancelled, FrameError, RunError, SettingsError
from core.fit.run import ViewLayers
from core.images.exr import exr_colour_space, read_exr, read_exr_header
from core.images.write import write_exr
from core.look import KeyedEdits, LookEdits
from core.system.files import write_json
from tests.core.recording_progress import StopAfter

HALF = 2.0 ** -11  # the relative rounding error of 16 bit floats


@dataclass
class FakeRendering:
    scene: np.ndarray
    flare_by_light: dict[str, np.ndarray]
    depth: np.ndarray


class FakeRenderer:
    """Two lights over noise; remembers what it was asked for."""

    fingerprint = "fake"
    lights = ("lamp", "key light")

    def __init__(self) -> None:
        self.elements = {"lamp": ("ghost",), "key light": ()}
        self.rendered: list[int] = []
        self.edits: list[LookEdits | None] = []

    def render(self, camera: Camera, edits: LookEdits | None = None) -> FakeRendering:
        """Note camera and edits in `rendered` and `edits`; return random layers, which depend on the focal length
        alone."""
        self.rendered.append(round(camera.fx))
        self.edits.append(edits)
        random = np.random.default_rng(round(camera.fx))
        size = camera.height, camera.width
        flares = {light: random.random((*size, 3), np.float32) ** 4 * 3 for light in self.lights}
        depth = random.random(size, np.float32)
        depth[0, 0] = 0
        return FakeRendering(random.random((*size, 3), np.float32), flares, depth)


def camera(mark: int) -> Camera:
    return Camera(12, 8, float(mark), float(mark), 6.0, 4.0, np.eye(4))


VIEWS = ("0003.png", "0004.png", "0010.png")
CAMERAS = {name: camera(index + 1) for index, name in enumerate(VIEWS)}
FRAMES = number_views(VIEWS)


def layers(mark: int = 1) -> FrameLayers:
    return to_layers(FakeRenderer().render(camera(mark)))


# ---- layers and files -----------------------------------------------------------------------------


@pytest.mark.parametrize("half", [True, False])
def test_scene_and_flares_sum_to_the_composite_in_the_file(tmp_path: Path, half: bool) -> None:
    write_layers(tmp_path / "a.exr", layers(), half=half)
    channels = read_exr(tmp_path / "a.exr")
    tolerance = 2 * HALF if half else 1e-6
    for name in "RGB":
        scene, flare = channels[f"scene.{name}"], channels[f"flare.{name}"]
        lights = channels[f"flare_lamp.{name}"] + channels[f"flare_key_light.{name}"]
        np.testing.assert_allclose(scene + flare, channels[name], rtol=tolerance)
        np.testing.assert_allclose(lights, flare, rtol=tolerance, atol=tolerance)


def test_channels_are_those_of_the_format(tmp_path: Path) -> None:
    write_layers(tmp_path / "a.exr", layers())
    channels = read_exr(tmp_path / "a.exr")
    rgba = ["R", "G", "B", "A"]
    expected = {*rgba, "scene.R", "scene.G", "scene.B", "depth.Z"} | {
        f"{layer}.{name}" for layer in ("flare", "flare_lamp", "flare_key_light") for name in rgba}
    assert set(channels) == expected
    assert channels["depth.Z"][0, 0] == np.float32(EMPTY_DEPTH)
    assert (channels["A"] == 1).all()
    brightest = np.max([channels[f"flare.{name}"] for name in "RGB"], axis=0)
    np.testing.assert_allclose(channels["flare.A"], np.clip(brightest, 0, 1), rtol=HALF)


def test_depth_stays_32_bit_beside_half_colour(tmp_path: Path) -> None:
    frame = layers()
    write_layers(tmp_path / "a.exr", frame)
    channels = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(channels["depth.Z"][1:], frame.depth[1:])
    assert not np.array_equal(channels["scene.R"], frame.scene[..., 0])


def test_written_layers_are_read_with_their_lights_and_notes(tmp_path: Path) -> None:
    frame = layers()
    write_layers(tmp_path / "a.exr", frame, half=False, notes={"view": "0003.png"})
    again = read_layers(tmp_path / "a.exr")
    assert list(again.flares) == ["lamp", "key light"]
    np.testing.assert_array_equal(again.flares["key light"], frame.flares["key light"])
    np.testing.assert_array_equal(again.scene, frame.scene)
    assert read_description(tmp_path / "a.exr")["view"] == "0003.png"


def test_a_foreign_exr_is_refused_by_name(tmp_path: Path) -> None:
    write_exr(tmp_path / "other.exr", {"R": np.zeros((4, 4))})
    (tmp_path / "broken.exr").write_bytes(b"\x76\x2f\x31\x01 and then nothing")
    for name in ("other.exr", "broken.exr", "absent.exr"):
        with pytest.raises(FrameError, match=name):
            read_layers(tmp_path / name)


def test_layer_names_are_safe_and_unique() -> None:
    names = layer_names(["lamp", "Lamp", "desk.lamp/2", "Lampe é", "灯", "", "x" * 90])
    assert list(names.values())[:6] == [
        "flare_lamp", "flare_Lamp_2", "flare_desk_lamp_2", "flare_Lampe_e", "flare_light", "flare_light_2"]
    assert all("." not in name and len(name) <= 48 for name in names.values())
    taken = layer_names(["a", "a!", "a_2", "a?"])
    assert len({name.casefold() for name in taken.values()}) == 4


def test_a_flare_without_lights_is_black() -> None:
    frame = FrameLayers(np.ones((2, 3, 3), np.float32), {}, np.ones((2, 3), np.float32))
    assert not frame.flare.any()
    np.testing.assert_array_equal(frame.composite, frame.scene)


# ---- edits and frames -----------------------------------------------------------------------------


def gains(edits: list[str], lights: list[str]) -> dict[str, list[float]]:
    """The factors that edits put on lights; matrices without saturation are plain factors."""
    return {name: matrix.diagonal().tolist()
            for name, matrix in LookEdits.parse(edits, lights).colour_matrices(lights).items()}


def test_edits_multiply() -> None:
    """Intensity, tint and mute of edits are factors on each light's flare; * stands for all lights."""
    assert gains(["lamp.intensity=2", "lamp.tint=1,0.5,0"], ["lamp", "key"]) == {"lamp": [2, 1, 0]}
    assert gains(["*.intensity=0.5"], ["lamp", "key"]) == {"lamp": [0.5] * 3, "key": [0.5] * 3}
    assert gains(["a.b.intensity=3"], ["a.b"]) == {"a.b": [3, 3, 3]}
    assert gains(["lamp.mute=1"], ["lamp", "key"]) == {"lamp": [0, 0, 0]}
    red = gains(["lamp.tint=#ff8000"], ["lamp"])["lamp"]
    np.testing.assert_allclose(red, (1, 0.21586, 0), atol=1e-5)


@pytest.mark.parametrize("edit", ["lamp", "lamp.intensity", "lamp.intensity=", "lamp.intensity=much", "sun.intensity=1",
                                  "lamp.intensity=-1", "lamp.intensity=nan", "lamp.tint=1,2", "lamp.size=2",
                                  "lamp.tint=#12345", "=2", ".intensity=2"])
def test_an_invalid_edit_is_refused(edit: str) -> None:
    with pytest.raises(SettingsError, match="edit"):
        gains([edit], ["lamp"])


def test_frame_numbers_come_from_names_or_else_from_the_order() -> None:
    def of(*views: str) -> list[tuple[str, int, str]]:
        return [(frame.view, frame.number, frame.file) for frame in number_views(views)]

    assert of("0003.png", "DSC_0000.JPG") == [
        ("DSC_0000.JPG", 0, "layers.0000.exr"), ("0003.png", 3, "layers.0003.exr")]
    assert of("b.png", "a.png") == [("a.png", 1, "layers.0001.exr"), ("b.png", 2, "layers.0002.exr")]
    assert [entry[1] for entry in of("a1.png", "b1.png")] == [1, 2]
    assert of("left/7.png", "right/7.png") == [
        ("left/7.png", 7, "left/layers.0007.exr"), ("right/7.png", 7, "right/layers.0007.exr")]
    assert [entry[:2] for entry in of("slate.png", "sh.1002.png", "sh.1001.png", "chart.png")] == [
        ("sh.1001.png", 1001), ("sh.1002.png", 1002), ("chart.png", 1003), ("slate.png", 1004)]


def test_long_numbers_are_whole_and_those_below_0_refused(tmp_path: Path) -> None:
    assert [frame.number for frame in number_views(["sh.999999.exr", "sh.1000000.exr"])] == [999999, 1000000]
    assert [frame.number for frame in number_views(["1700000002.png", "1700000001.png"])] == [1, 2], "times"
    assert plates_by_number([tmp_path / "sh.1000000.png"]) == {1000000: tmp_path / "sh.1000000.png"}
    assert [frame.number for frame in number_views(["take-0010.png"])] == [10]
    for read in (lambda: number_views(["sh.0001.png", "sh.-0001.png"]),
                 lambda: plates_by_number([Path("sh_-0001.png")])):
        with pytest.raises(SettingsError, match=r"-0001\.png has a frame number below 0"):
            read()


def test_frames_are_chosen_by_ranges() -> None:
    assert [frame.number for frame in select_frames(FRAMES, None)] == [3, 4, 10]
    assert [frame.number for frame in select_frames(FRAMES, "1-3, 10")] == [3, 10]
    assert [frame.number for frame in select_frames(FRAMES, "2-10:2")] == [4, 10]
    for text in ("", "a", "3-", "5-4", "20-30", "-3", "1-9:0", "1:2", "4-4000000000000000000000"):
        with pytest.raises(SettingsError):
            select_frames(FRAMES, text)


def test_missing_frame_numbers_are_reported() -> None:
    assert missing_numbers(FRAMES, None) == missing_numbers(FRAMES, "3-4,10") == ""
    assert missing_numbers(FRAMES, "1-12, 99") == "1-2,5-9,11-12,99"
    assert missing_numbers(FRAMES, "2-14:2") == "2,6-8:2,12-14:2"
    assert missing_numbers(FRAMES, "3-999999999") == "5-9,11-999999999"


# ---- bake -----------------------------------------------------------------------------------------


def test_bake_writes_every_frame_at_the_requested_size(tmp_path: Path) -> None:
    record = bake(FakeRenderer(), FRAMES, CAMERAS, tmp_path, BakeSettings(24, edits=("lamp.intensity=2",)))
    assert [entry["file"] for entry in record["frames"]] == [frame.file for frame in FRAMES]
    assert record == read_manifest(tmp_path)
    again = read_layers(tmp_path / FRAMES[0].file)
    assert again.scene.shape == (16, 24, 3)
    rendering = FakeRenderer().render(camera(1).scaled(24, 16))
    np.testing.assert_allclose(again.flares["lamp"], 2 * rendering.flare_by_light["lamp"], rtol=HALF, atol=1e-6)
    np.testing.assert_allclose(again.flares["key light"], rendering.flare_by_light["key light"], rtol=HALF, atol=1e-6)


def test_layers_keep_the_pixel_aspect(tmp_path: Path) -> None:
    """A compositor would show them half as wide as their plates; a solve's focal lengths that differ a little do not
    make a pixel oblong."""
    cameras = {name: replace(camera(60), fx=fx) for name, fx in zip(VIEWS, (30.0, 60.0, 60.3), strict=True)}
    bake(FakeRenderer(), FRAMES, cameras, tmp_path)
    aspects = [read_exr_header(tmp_path / frame.file)["pixelAspectRatio"] for frame in FRAMES]
    assert aspects == [2.0, 1.0, 1.0]
    bake(FakeRenderer(), FRAMES[:1], cameras, tmp_path / "square", BakeSettings(24, 8))
    assert read_exr_header(tmp_path / "square" / FRAMES[0].file)["pixelAspectRatio"] == 1.0, "as they are rendered"


def test_edits_by_frame_reach_the_renderer_or_the_layers(tmp_path: Path) -> None:
    renderer = FakeRenderer()
    keyed = KeyedEdits((), {3: ("lamp.intensity=0",), 4: ("lamp.intensity=1",), 10: ("lamp/ghost.scale=2",)})
    bake(renderer, FRAMES, CAMERAS, tmp_path, BakeSettings(edits=("key light.saturation=0",), keyed=keyed))
    assert renderer.edits[:2] == [None, None]
    assert renderer.edits[2] is not None
    assert renderer.edits[2].elements["lamp", "ghost"].scale == 2
    first, second = (read_layers(tmp_path / frame.file) for frame in FRAMES[:2])
    assert not first.flares["lamp"].any()
    np.testing.assert_allclose(second.flares["lamp"], FakeRenderer().render(camera(2)).flare_by_light["lamp"],
                               rtol=HALF, atol=1e-6)
    np.testing.assert_allclose(np.ptp(second.flares["key light"], axis=-1), 0, atol=2e-3)
    with pytest.raises(RunError, match="other settings"):
        bake(renderer, FRAMES, CAMERAS, tmp_path, BakeSettings(edits=("key light.saturation=0",)))


def test_a_stopped_bake_resumes(tmp_path: Path) -> None:
    first, second = FakeRenderer(), FakeRenderer()
    with pytest.raises(Cancelled):
        bake(first, FRAMES, CAMERAS, tmp_path, progress=StopAfter(1))
    assert first.rendered == [1]
    assert len(read_manifest(tmp_path)["frames"]) == 1
    bake(second, FRAMES, CAMERAS, tmp_path)
    assert second.rendered == [2, 3]
    assert len(read_manifest(tmp_path)["frames"]) == 3
    assert not list(tmp_path.glob(".*"))


def test_a_deleted_frame_is_baked_again_and_others_stay_listed(tmp_path: Path) -> None:
    bake(FakeRenderer(), FRAMES, CAMERAS, tmp_path)
    (tmp_path / FRAMES[1].file).unlink()
    again = FakeRenderer()
    bake(again, FRAMES[1:2], CAMERAS, tmp_path)
    assert again.rendered == [2]
    assert [entry["frame"] for entry in read_manifest(tmp_path)["frames"]] == [3, 4, 10]


def test_a_truncated_frame_is_baked_again(tmp_path: Path) -> None:
    bake(FakeRenderer(), FRAMES, CAMERAS, tmp_path)
    whole = (tmp_path / FRAMES[1].file).read_bytes()
    (tmp_path / FRAMES[1].file).write_bytes(whole[:-100])
    again = FakeRenderer()
    bake(again, FRAMES, CAMERAS, tmp_path)
    assert again.rendered == [2]
    assert (tmp_path / FRAMES[1].file).read_bytes() == whole


def test_a_bake_with_other_settings_is_refused(tmp_path: Path) -> None:
    bake(FakeRenderer(), FRAMES, CAMERAS, tmp_path)
    changed = BakeSettings(edits=("lamp.intensity=2",))
    with pytest.raises(RunError, match="other settings"):
        bake(FakeRenderer(), FRAMES[:1], CAMERAS, tmp_path, changed)
    bake(FakeRenderer(), FRAMES[:1], CAMERAS, tmp_path, changed, overwrite=True)
    assert [path.name for path in sorted(tmp_path.iterdir())] == [MANIFEST, FRAMES[0].file]


def test_a_bake_with_other_lights_is_refused(tmp_path: Path) -> None:
    """A light's layer that a frame lacks is taken from the composite by Blender, and added twice."""
    bake(FakeRenderer(), FRAMES[:2], CAMERAS, tmp_path)
    alone = FakeRenderer()
    alone.lights = ("lamp",)  # type: ignore[assignment]
    with pytest.raises(RunError, match=r"layers of the lights lamp, key light, and these frames have lamp:"):
        bake(alone, FRAMES[2:], CAMERAS, tmp_path)
    bake(alone, FRAMES[2:], CAMERAS, tmp_path, overwrite=True)
    assert [path.name for path in sorted(tmp_path.iterdir())] == [MANIFEST, FRAMES[2].file]


def test_a_frame_whose_camera_changed_is_baked_again(tmp_path: Path) -> None:
    """A capture that was solved again has other cameras under the same names."""
    bake(FakeRenderer(), FRAMES, CAMERAS, tmp_path)
    again = FakeRenderer()
    turned = replace(CAMERAS[VIEWS[1]], world_to_camera=np.diag([-1.0, -1, 1, 1]))
    bake(again, FRAMES, {**CAMERAS, VIEWS[1]: turned}, tmp_path)
    assert again.rendered == [2]


def test_plates_have_the_numbers_of_their_names(tmp_path: Path) -> None:
    plates = [tmp_path / name for name in ("r_1001.png", "r_1002.png", "contact_sheet.png")]
    assert plates_by_number(plates) == {1001: plates[0], 1002: plates[1]}
    with pytest.raises(SettingsError, match=r"r_1002\.png and .*r_1002\.tif have one number"):
        plates_by_number([*plates, tmp_path / "r_1002.tif"])
    unnumbered = [tmp_path / "b.png", tmp_path / "a.png"]
    assert plates_by_number(unnumbered) == {1: unnumbered[1], 2: unnumbered[0]}


def test_a_damaged_manifest_is_one_line(tmp_path: Path) -> None:
    good = bake(FakeRenderer(), FRAMES[:1], CAMERAS, tmp_path)
    whole = (tmp_path / MANIFEST).read_text()
    number, file = f'"frame": {FRAMES[0].number}', f'"file": "{FRAMES[0].file}"'
    damaged = [whole.replace(old, new) for old, new in (
        (number, '"frame": "3"'), (number, '"frame": true'), (file, '"file": 5'), (file, f'{file}, "rest": "ab"'),
        (file, f'{file}, "rest": [5]'))]
    for text in ("", "[]", "{}", '{"version": 99}', *damaged):
        assert text != whole
        (tmp_path / MANIFEST).write_text(text)
        with pytest.raises(RunError, match=r"bake\.json"):
            bake(FakeRenderer(), FRAMES[:1], CAMERAS, tmp_path)
    assert good["frames"][0]["file"] == FRAMES[0].file


def test_a_manifest_cannot_name_files_outside_its_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    record = bake(FakeRenderer(), FRAMES[:1], CAMERAS, out)
    treasure = tmp_path / "treasure.exr"
    treasure.write_text("mine")
    record["frames"][0]["file"] = "../treasure.exr"
    write_json(out / MANIFEST, record)
    with pytest.raises(RunError):
        bake(another_fit(), FRAMES[:1], CAMERAS, out, overwrite=True)
    assert treasure.read_text() == "mine"


def test_extra_files_cannot_be_outside_the_folder(tmp_path: Path) -> None:
    out, treasure = tmp_path / "out", tmp_path / "treasure.png"
    record = bake(FakeRenderer(), FRAMES[:1], CAMERAS, out)
    treasure.write_text("mine")
    record["frames"][0]["rest"] = ["../treasure.png"]
    write_json(out / MANIFEST, record)
    with pytest.raises(RunError):
        bake(another_fit(), FRAMES[:1], CAMERAS, out, overwrite=True)
    assert treasure.read_text() == "mine"


@pytest.mark.parametrize("after", [1, 2])
def test_a_concurrent_bake_with_other_settings_is_refused(tmp_path: Path, after: int) -> None:
    """The one that comes second to a frame is refused, and writes over none of the other's."""
    class Meanwhile(FakeRenderer):
        def render(self, camera: Camera, edits: LookEdits | None = None) -> FakeRendering:
            if len(self.rendered) == after - 1:
                bake(another_fit(), FRAMES, CAMERAS, tmp_path, overwrite=True)
            return super().render(camera, edits)

    first = Meanwhile()
    with pytest.raises(RunError, match="Another bake, of another fit or with other settings"):
        bake(first, FRAMES, CAMERAS, tmp_path)
    assert len(first.rendered) == after
    assert len(read_manifest(tmp_path)["frames"]) == 3
    again = another_fit()
    bake(again, FRAMES, CAMERAS, tmp_path)
    assert again.rendered == [], "nothing of the other's was lost, the frame that was being written least of all"


def test_one_of_two_concurrent_bakes_in_a_new_folder_is_refused(tmp_path: Path) -> None:
    """Neither has a frame yet when the other begins."""
    class Meanwhile(FakeRenderer):
        def render(self, camera: Camera, edits: LookEdits | None = None) -> FakeRendering:
            bake(another_fit(), FRAMES, CAMERAS, tmp_path)
            return super().render(camera, edits)

    with pytest.raises(RunError, match="Another bake, of another fit or with other settings"):
        bake(Meanwhile(), FRAMES, CAMERAS, tmp_path)
    assert {read_description(tmp_path / frame.file)["renderer"] for frame in FRAMES} == {"another"}


def test_an_empty_manifest_does_not_block_another_bake(tmp_path: Path) -> None:
    class Broken(FakeRenderer):
        fingerprint = "broken"

        def render(self, camera: Camera, edits: LookEdits | None = None) -> FakeRendering:
            raise RunError(f"no light in {camera} {edits}")

    with pytest.raises(RunError, match="no light"):
        bake(Broken(), FRAMES, CAMERAS, tmp_path)
    assert len(bake(FakeRenderer(), FRAMES, CAMERAS, tmp_path)["frames"]) == 3


def test_a_bake_survives_a_folder_cleared_by_another_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bake(FakeRenderer(), FRAMES, CAMERAS, tmp_path)
    usual = baking.file_lock

    @contextlib.contextmanager
    def cleared_meanwhile(lock: Path) -> Iterator[None]:
        (tmp_path / MANIFEST).unlink(missing_ok=True)
        monkeypatch.setattr(baking, "file_lock", usual)
        with usual(lock):
            yield

    monkeypatch.setattr(baking, "file_lock", cleared_meanwhile)
    assert len(bake(another_fit(), FRAMES, CAMERAS, tmp_path, overwrite=True)["frames"]) == 3


def another_fit() -> FakeRenderer:
    renderer = FakeRenderer()
    renderer.fingerprint = "another"
    return renderer


def test_layer_colours_keep_light_nonnegative_and_diagonal_factors_exact() -> None:
    """A covering flare may take light away: a factor leaves that, so that scene + flare stays the composite."""
    layer = np.full((2, 2, 3), (1.0, 0.0, -0.25), np.float32)
    rendering = ViewLayers(np.zeros_like(layer), {"lamp": layer}, layer[..., 0])
    vivid, hardly, double = (LookEdits.parse([f"lamp.{edit}"], ["lamp"]).colour_matrices(["lamp"])
                             for edit in ("saturation=2", "saturation=0.999", "intensity=2"))
    light = ViewLayers(np.zeros_like(layer), {"lamp": np.abs(layer)}, layer[..., 0])
    assert (to_layers(light, vivid).flares["lamp"] >= 0).all()
    np.testing.assert_allclose(to_layers(rendering, hardly).flares["lamp"], layer, atol=2e-3)
    np.testing.assert_array_equal(to_layers(rendering, double).flares["lamp"], 2 * layer)


def test_a_file_names_its_colour_space(tmp_path: Path) -> None:
    layers = FrameLayers(np.ones((2, 3, 3), np.float32), {}, np.ones((2, 3), np.float32))
    red_is_cyan = (0.2, 0.3, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
    spaces = {"rec709": REC_709, "untold": None, "acescg": colour_space("acescg").chromaticities, "own": red_is_cyan}
    for name, chromaticities in spaces.items():
        write_layers(tmp_path / f"{name}.exr", layers, chromaticities=chromaticities)
    assert [exr_colour_space(tmp_path / f"{name}.exr") for name in spaces] == ["linear", "linear", "acescg", ""]
