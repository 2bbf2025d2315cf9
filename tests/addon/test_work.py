# SPDX-License-Identifier: GPL-3.0-or-later
"""An artist's work in Blender, compared with the core: import, lights, look, overlay, occlusion, transfer."""
from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from blenders import Blender

from core.bake.exr import read_layers
from core.bake.shot import bake_shot
from core.flare import file as flare_file
from core.flare.deformation import QueryRange
from core.flare.file import FlareFile
from core.flare.model import OURS, FlareModel, LightFlare
from core.look import LookEdits, TrainedCamera, draw, read_look
from core.look.shot import Shot
from tests.core.flared import HEIGHT, LIGHT, WIDTH, cameras, flared_capture

SCRIPTS = Path(__file__).parent / "scripts"


def a_flare(path: Path, *names: str) -> Path:
    """Write a .flare of the light of `flared_capture`, its Gaussians spread and coloured at random; return the path.

    names: its lights' names, all with the same flare; "lamp" alone by default.
    """
    generator = torch.Generator().manual_seed(4)
    place = cameras(5)
    seen = torch.tensor(np.array([camera.project_normalised(LIGHT)[0][0] for camera in place])).float()
    reach = QueryRange.of(torch.tensor(np.array([camera.position for camera in place])).float(), seen)
    light = LightFlare(replace(OURS, arcs=True), reach, 60, generator)
    with torch.no_grad():
        light.gaussians["opacity_logits"] += 2
        light.gaussians["sh"] += torch.rand(light.gaussians["sh"].shape, generator=generator)
        light.gaussians["log_scales"] += torch.randn(light.gaussians["log_scales"].shape, generator=generator)
        light.gaussians["arcs"] += 0.5 * torch.randn(60, 2, generator=generator)
    names = names or ("lamp",)
    model = FlareModel(list(names), torch.tensor(LIGHT[None]).repeat(len(names), 1), [light] * len(names))
    flare_file.save(path, FlareFile(model, "add", TrainedCamera(WIDTH, HEIGHT, 70.0, 70.0, 33.0, 19.5)))
    return path


@pytest.fixture(scope="session")
def made(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    base = tmp_path_factory.mktemp("work")
    capture, flare = flared_capture(base / "capture", 5), a_flare(base / "lamp.flare")
    facts = blender.run(SCRIPTS / "work.py", package, capture, flare, base, user=base / "user")
    return facts, base


@pytest.fixture(scope="session")
def facts(made: tuple[Any, Path]) -> Any:
    return made[0]


def test_frames_are_cleaned_by_the_network_or_by_a_finished_fit(made: tuple[Any, Path]) -> None:
    """Block of work.py: "clean frames"."""
    facts, base = made
    images, removed = str(Path("capture") / "images"), str(Path("capture") / "removed")
    assert facts["cleaned by the network"] == ["remove", images, "--out", removed, "--all-glow"]
    assert facts["cleaned by the fit"] == ["remove", "--run", str(base / "a run"), "--out", removed]


def test_frames_are_cleaned_by_a_matte_and_otherwise_again(made: tuple[Any, Path]) -> None:
    """Block of work.py: "clean frames"."""
    facts, base = made
    images, removed = str(Path("capture") / "images"), str(Path("capture") / "removed")
    by_matte = ["remove", images, "--out", removed, "--matte", str(base / "roto")]
    assert facts["cleaned by a matte"] == [*by_matte, "--all-glow"]
    assert facts["cleaned, glow kept"] == [*by_matte, "--keep-glow"]
    first, made, stopped, stopped_otherwise = facts["cleaned again"]
    assert made and stopped_otherwise, "what the engine made is made again, and no two ways are mixed"
    assert not first and not stopped


def test_the_colour_space_of_the_frames_is_passed_to_the_commands(facts: Any) -> None:
    """A camera's by its name alone, one of Blender's with its configuration.

    Block of work.py: "clean frames".
    """
    assert facts["spaces offered"][0] == ["logc3", "logc4"] and facts["spaces offered"][1]
    by_camera, cleaned, by_blender, _, by_files, _ = facts["spaces passed"]
    assert by_camera[-2:] == cleaned[-2:] == ["--plate-space", "LogC4"]
    assert by_blender[-4:-1] == ["--plate-space", "AgX Log", "--ocio"] and Path(by_blender[-1]).is_file()
    assert by_files[-1] == "--keep"
    assert facts["space shown"] == "logc4"
    assert not facts["space kept"]


def test_a_moved_project_resumes_with_its_moved_capture(made: tuple[Any, Path]) -> None:
    """Block of work.py: "a project that was moved, its capture with it"."""
    facts, base = made
    resumed, cleaned, moved = facts["moved"]
    assert Path(resumed) == Path(moved).resolve()
    assert cleaned[:5] == ["remove", "--run", str(base / "a run"), "--capture", moved]
    assert "put it back" in facts["another's"]


def test_clean_frames_are_reloaded_after_they_are_made_again(facts: Any) -> None:
    """Block of work.py: "clean frames that are made again"."""
    assert facts["clean frames"] == [0, 1]


def test_own_clean_frames_count_as_exact_and_others_as_estimates(facts: Any) -> None:
    """Block of work.py: "what a fit goes by"."""
    assert facts["goes by"] == ["default", "estimated", "estimated", "estimated"]
    assert facts["says that a fit knows no matte"] == [False, True]


def test_a_bake_follows_the_cuts_of_the_timeline(facts: Any) -> None:
    """Block of work.py: "cuts by markers"."""
    names, *off = facts["cut"]
    assert names == ["Camera"] and [far < 1e-4 for far in off] == [False, False, True], off


def test_a_folder_without_layers_leaves_no_trace(facts: Any) -> None:
    """Block of work.py: "a folder that holds no layers"."""
    said, untouched, images = facts["no layers"]
    assert "no scene and flare layers" in said and untouched and not images, images


def test_a_blend_below_a_linked_folder_finds_its_files(facts: Any) -> None:
    """Block of work.py: "a .blend below a linked folder"."""
    assert facts["through a link"] == ["//", True]


def test_a_blend_saved_elsewhere_finds_its_files(facts: Any) -> None:
    """Block of work.py: "a .blend below a linked folder"."""
    assert facts["after a copy"], "the file that is open is where it was"
    assert facts["saved elsewhere"] == [["//..", True], True, True]


@pytest.mark.parametrize("kind", ["animated", "each"])
def test_cameras_see_points_where_the_footage_has_them(facts: Any, kind: str) -> None:
    """Off-centre principal point, turned and scaled root; by the matrices Blender renders with.

    Block of work.py: "import".
    """
    assert facts[f"pixels off, {kind}"] < 0.002


@pytest.mark.parametrize("kind", ["animated", "each"])
def test_cameras_are_exposed_as_a_fit_has_found_the_frames(facts: Any, kind: str) -> None:
    """Block of work.py: "import"."""
    assert facts[f"exposed, {kind}"] == [0.5, 1.5, 2.5, 3.5, 4.5]
    assert facts[f"as usual, {kind}"] == [1.0, 1.0]
    assert facts[f"own run, {kind}"] == 4.0
    assert facts[f"other run, {kind}"] == 1.0


def test_an_import_has_cameras_points_lights_and_frames(facts: Any) -> None:
    """Block of work.py: "import"."""
    assert facts["objects, animated"] == ["Camera", "Points", "capture Root", "lamp"]
    assert facts["objects, each"] == ["0000", "0001", "0002", "0003", "0004", "Points", "capture Root", "lamp"]
    assert facts["background, animated"] == ["SEQUENCE", "STRETCH", "0000.png"]
    assert facts["background, each"] == ["FILE", "STRETCH", "0000.png"]
    assert facts["sequence"] == [0, -1, 5]
    assert facts["frames"] == [0, 4, WIDTH, HEIGHT]
    assert facts["colours off"] <= 0.51
    np.testing.assert_allclose(facts["lights"]["lamp"], LIGHT, atol=1e-4)


def test_an_import_is_one_undo_step(facts: Any) -> None:
    """Block of work.py: "one undo step"."""
    count, after, capture, has_no_compositor = facts["undo"]
    assert has_no_compositor
    assert count > 3
    assert (after, capture) == (0, "")


def test_lights_of_the_scene_are_those_of_the_fit(facts: Any) -> None:
    """Block of work.py: "lights"."""
    assert facts["lights now"] == ["Bulb", "key", "lamp"]
    assert facts["bulb stays"]
    assert list(facts["lights.json"]) == ["key", "lamp"]
    np.testing.assert_allclose(facts["lights.json"]["key"], (0.5, -0.25, 1.0), atol=1e-5)
    np.testing.assert_allclose(facts["lights.json"]["lamp"], LIGHT, atol=1e-5)


def test_lights_move_to_a_fit_unless_the_artist_moved_them(facts: Any) -> None:
    """Block of work.py: "lights"."""
    assert facts["followed"] == {"key": False, "lamp": True}
    np.testing.assert_allclose(facts["followed back"], LIGHT + 1, atol=1e-4)  # lights.json has it elsewhere


def test_a_flare_finds_its_light(facts: Any) -> None:
    """Block of work.py: "look"."""
    assert facts["open"] == ["FINISHED"]
    assert facts["flares"] == [["lamp", "lamp", "lamp", True]]
    assert facts["native"]


def test_a_flare_over_frames_with_their_own_flare_is_reported(facts: Any) -> None:
    """Block of work.py: "look"."""
    as_filmed, without = facts["look says"]
    assert "The frames behind the camera contain their own flare" in as_filmed
    assert "their own flare" not in without


def test_sliders_can_be_animated_driven_and_reset(facts: Any) -> None:
    """Block of work.py: "look"."""
    assert facts["animated"] == pytest.approx(1.5)
    assert facts["driven"] == pytest.approx(2.0)
    assert "lamp.intensity=1.5" in facts["words"]
    assert any(word.startswith("lamp/") and word.endswith("rotation=30") for word in facts["words"])
    assert any(word.endswith("tint=1,0.5,0.25") for word in facts["words"])
    # What is animated stays so: there the slider follows its curve.
    assert facts["reset"] is True or all(word.startswith("lamp.intensity") for word in facts["reset"])


def test_the_overlay_draws_what_the_look_defines(facts: Any) -> None:
    """The GPU's quads and levels, drawn by numpy: what drawing small costs, whole and zoomed in.

    Block of work.py: "look".
    """
    assert facts["overlay off"] < 0.015
    assert facts["cropped off"] < 0.015
    assert facts["outside"]


def test_overlay_and_bake_follow_the_exposure_of_the_camera(made: tuple[Any, Path], tmp_path: Path) -> None:
    """Block of work.py: "look"."""
    facts, base = made
    off, brightest = facts["brighter"]
    assert off < 1e-6 < brightest
    shot = Shot.read(base / "exposed.json")
    assert shot.frames[0].camera.exposure == 2.0
    usual = replace(shot, frames=tuple(replace(one, camera=replace(one.camera, exposure=1.0)) for one in shot.frames))
    for name, one in (("exposed", shot), ("usual", usual)):
        bake_shot(one, tmp_path / name, half=False)
    exposed, plain = (read_layers(tmp_path / name / "layers.0002.exr").flare for name in ("exposed", "usual"))
    assert plain.max() > 0.05
    np.testing.assert_allclose(exposed, 2 * plain, rtol=1e-5)


def test_a_shot_has_the_captures_own_numbers(facts: Any) -> None:
    """Block of work.py: "a shot, and the same by hand"."""
    assert facts["pose off"] < 1e-5
    assert facts["place off"] < 1e-5
    assert facts["moved root off"] < 1e-5
    assert facts["shares"] == [pytest.approx(1.0)]


def test_a_wall_hides_a_light_softly(facts: Any) -> None:
    """Block of work.py: "occlusion: a wall slides before the light"."""
    shares = facts["fades"]
    assert shares[0] == pytest.approx(1)
    assert shares[-1] == pytest.approx(0)
    assert all(later <= before + 1e-6 for before, later in itertools.pairwise(shares))
    assert sum(0.02 < share < 0.98 for share in shares) >= 3


def test_a_light_behind_the_camera_gives_no_flare(facts: Any) -> None:
    """Block of work.py: "behind the camera"."""
    assert facts["behind"] == []


def test_settings_survive_a_reload_and_a_disabled_extension(facts: Any) -> None:
    """Block of work.py: "save, reload"."""
    assert facts["reloaded"] == ["lamp.flare", "lamp", [1.0, 0.5, 0.25], "capture Root"]
    assert facts["enabled again"] == [1.0, 0.5, 0.25]


def test_the_library_keeps_flares(facts: Any) -> None:
    """Block of work.py: "library and transfer"."""
    saved, again = facts["saved"]
    assert saved == ["FINISHED"]
    assert "already" in again
    assert facts["library"] == ["Desk lamp.flare"]
    assert facts["thumbnail"] > 200
    assert facts["library's place"] == [True, False], "uninstalling the extension deletes what is its own"
    assert facts["layers of a flare of the library"] == [False, True]
    assert facts["items"] == [["Desk lamp", "1 lights, 60 Gaussians. 35 mm"]]


def test_a_flare_is_applied_to_another_camera_and_light(facts: Any) -> None:
    """Block of work.py: "library and transfer"."""
    assert facts["applied"] == ["FINISHED"]
    assert facts["applied to"] == ["Spot"]
    assert facts["transferred"] == [False, 1, True]


def test_a_light_is_picked_in_a_single_picture(facts: Any) -> None:
    """Block of work.py: "a single picture, the light picked in it"."""
    assert facts["picture"] == [["FINISHED"], 96, 64]
    np.testing.assert_allclose(facts["picked"], [0.25, 0.3], atol=1e-4)


def test_an_upright_picture_uses_a_turned_camera(facts: Any) -> None:
    """As `transfer` takes it: across its long side lies what lay across the source's.

    Block of work.py: "a single picture, the light picked in it".
    """
    found, expected, wide = facts["upright"]
    assert wide
    assert found == pytest.approx(expected, rel=1e-5)


def test_blenders_own_camera_becomes_a_capture(facts: Any) -> None:
    """Block of work.py: "a capture of Blender's own camera"."""
    assert facts["exported"] == ["FINISHED"]
    assert facts["export off"] < 1e-5
    assert facts["export lens off"] < 1e-3
    assert facts["export points"] == 150
    assert facts["exported again"] == ["FINISHED"]
    for whose in ("of nerfstudio", "of COLMAP"):
        said, kept = facts[f"exported into one {whose}"]
        assert "choose another folder" in said and kept


def test_the_overlay_shows_what_is_baked(made: tuple[Any, Path], tmp_path: Path) -> None:
    """The shot that Blender wrote, through the engine, against what the overlay evaluates for that frame."""
    _, base = made
    shot = Shot.read(base / "shot.json")
    bake_shot(shot, tmp_path, half=False)
    frame = shot.frames[0]
    shown = read_look(shot.flare).evaluate_lights(frame.camera.world_to_camera, frame.lights,
                     LookEdits.parse(frame.edits, shot.lights, None), shot.query)
    picture = draw(shown.values(), frame.camera.intrinsics, *frame.camera.size)
    assert picture.max() > 0.05
    np.testing.assert_allclose(read_layers(tmp_path / "layers.0001.exr").flare, picture, atol=1e-4)
