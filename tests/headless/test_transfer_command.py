# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands transfer, export and bake for a .flare: to a picture, a capture and a .blend."""
from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from core.bake.exr import read_description, read_layers
from core.capture import Capture
from core.fit import fit, preset
from core.fit.overrides import override_settings
from core.flare.file import FlareFile
from core.flare.file import save as save_flare
from core.gaussians.ply import read_ply
from core.images.formats import jpeg
from core.images.read import read_picture
from core.images.write import write_png
from core.look import TrainedCamera, read_look
from core.look.shot import Shot
from tests.core.captures import make_transforms
from tests.core.test_flare import some_flare

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def made(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, hardly fitted: its flare is there, whatever it looks like."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    settings = override_settings(preset("draft", iterations=3), {"flare.count": 40, "holdout": 0})
    folder = fit(Capture.open(capture), settings, tmp_path_factory.mktemp("run") / "run").folder
    torch.set_num_threads(before)
    return folder


Run = Callable[..., list[dict[str, Any]]]


def test_transfer_to_a_picture(run: Run, made: Path, tmp_path: Path) -> None:
    """A transfer to a picture writes layers and a frame; without a light in the picture it needs one named."""
    write_png(tmp_path / "plate.png", np.full((54, 96, 3), 0.3))
    run("transfer", made, "--to", tmp_path / "plate.png", "--light", "sun=60,10", "--out", tmp_path / "out", "--set",
        "sun.intensity=3")
    layers = read_layers(tmp_path / "out" / "layers.0001.exr")
    assert list(layers.flares) == ["sun"]
    assert layers.flare.max() > 0
    assert read_picture(tmp_path / "out" / "frames" / "plate.png").size == (96, 54)
    problem = run("transfer", made, "--to", tmp_path / "plate.png", "--out", tmp_path / "none", status=2)[-1]
    assert "No light was found in" in problem["text"]


def test_a_transfer_reports_what_a_plate_cannot_keep(run: Run, made: Path, tmp_path: Path) -> None:
    """A gain map behind a JPEG, and a name of another format."""
    data = cv2.imencode(".jpg", np.full((54, 96, 3), 90, np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(data[:2] + jpeg.make_segment(jpeg.APP2, b"MPF\0MM\0*\0\0\0\x08") + data[2:] + data)
    (tmp_path / "b.jpg").write_bytes(cv2.imencode(".png", np.full((54, 96, 3), 90, np.uint8))[1].tobytes())
    for name, sentence in (("a.jpg", "holds more than one picture"), ("b.jpg", "holds PNG data, whatever its name")):
        events = run("transfer", made, "--to", tmp_path / name, "--light", "sun=60,10", "--out", tmp_path / name[0])
        assert sum(sentence in event.get("text", "") for event in events) == 1


def test_options_that_do_not_apply_to_the_target_are_refused(run: Run, made: Path, capture: Path,
                                                             tmp_path: Path) -> None:
    write_png(tmp_path / "plate.png", np.full((54, 96, 3), 0.3))
    for target, *words in ((tmp_path / "plate.png", "--light", "9,9", "--scene", "x.ply"),
                           (tmp_path / "plate.png", "--light", "9,9", "--plates", tmp_path),
                           (capture, "--light", "9,9"), (capture, "--plates", tmp_path), (made, "--focal", "90")):
        problem = run("transfer", made, "--to", target, *words, "--out", tmp_path / "none", status=2)[-1]["text"]
        assert "as the target; leave it out." in problem
    for words, sentence in ((("--light", "a=1,2", "--light", "a=3,4"), "names 'a' twice"),
                            (("--light", "a=1,2", "--use", "b=lamp"), "have no light 'b'")):
        problem = run("transfer", made, "--to", tmp_path / "plate.png", *words, "--out", tmp_path / "x",
                      status=2)[-1]["text"]
        assert sentence in problem
    assert not (tmp_path / "none").exists()


def test_transfer_to_plates_skips_one_without_a_light(run: Run, made: Path, tmp_path: Path) -> None:
    lit = np.full((54, 96, 3), 0.1)
    lit[20:25, 40:45] = 1
    write_png(tmp_path / "plates" / "f.0001.png", lit)
    write_png(tmp_path / "plates" / "f.0002.png", np.full((54, 96, 3), 0.1))
    events = run("transfer", made, "--to", tmp_path / "plates", "--out", tmp_path / "out")
    assert any("1 of 2 pictures show no light, and get no flare: f.0002.png" in event.get("text", "")
               for event in events)
    assert not read_layers(tmp_path / "out" / "layers.0002.exr").flare.any()
    assert read_layers(tmp_path / "out" / "layers.0001.exr").flare.any()


def test_plates_that_are_not_written_are_reported(run: Run, made: Path, tmp_path: Path) -> None:
    write_png(tmp_path / "plate.png", np.full((54, 96, 3), 0.3))
    events = run("transfer", made, "--to", tmp_path / "plate.png", "--light", "60,10", "--size", "48", "--out",
                 tmp_path / "out")
    assert any("For 1 of 1 plates only the layers are written" in event.get("text", "") for event in events)
    assert not (tmp_path / "out" / "frames").exists()


def test_a_bare_flare_is_baked_as_its_run_is(run: Run, made: Path, capture: Path, tmp_path: Path) -> None:
    """With the capture's cameras: the same light, less what the run's scene hides, over black."""
    run("bake", made / "flare.flare", "--capture", capture, "--out", tmp_path / "flare", "--frames", "3-4", "--space",
        "acescg", "--float")
    layers = read_layers(tmp_path / "flare" / "layers.0003.exr")
    assert not layers.scene.any()
    assert layers.flare.max() > 0
    assert read_description(tmp_path / "flare" / "layers.0003.exr")["space"][:2] == ["acescg", None]
    sentence = run("bake", made / "flare.flare", "--out", tmp_path / "none", status=2)[-1]["text"]
    assert "--capture" in sentence
    assert "--blend" in sentence


def test_splats_and_preset_have_every_gaussian_of_the_flare(run: Run, made: Path, tmp_path: Path) -> None:
    run("export", made, "--as", "ply", "--out", tmp_path / "ply", "--frames", "2")
    assert len(read_ply(tmp_path / "ply" / "flare.0002.ply")) == read_look(made / "flare.flare").count
    run("export", made, "--as", "preset", "--out", tmp_path / "lamp.json", "--frames", "2")
    preset_made = json.loads((tmp_path / "lamp.json").read_text())
    parts = [part for element in preset_made["lights"][0]["elements"] for part in element["parts"]]
    assert len(parts) == read_look(made / "flare.flare").count
    assert {"offset", "size", "colour", "shape"} <= set(parts[0])


def test_a_preset_needs_a_light_in_front_of_the_camera(run: Run, tmp_path: Path) -> None:
    """Frame 0 has one of two lights before it and the other behind, frame 1 is past both."""
    folder = make_transforms(tmp_path / "capture", views=2)
    poses = json.loads((folder / "transforms.json").read_text())
    poses["frames"][1]["transform_matrix"][2][3] = 100
    (folder / "transforms.json").write_text(json.dumps(poses))
    flare = some_flare(lights=2)
    flare.positions[1] = torch.tensor([0.0, 0.0, -8.0])
    save_flare(tmp_path / "a.flare", FlareFile(flare, "add", TrainedCamera(64, 40, 70.0, 70.0, 33.0, 19.5)))
    args = ["export", tmp_path / "a.flare", "--capture", folder, "--as", "preset", "--out", tmp_path / "a.json"]
    messages = [event["text"] for event in run(*args) if event["type"] == "say"]
    assert messages[-1] == "Lights behind the camera in frame 0 are left out: lamp 1."
    made = (tmp_path / "a.json").read_text()
    assert [light["name"] for light in json.loads(made)["lights"]] == ["lamp 0"]
    assert "No light is in front of the camera in frame 1" in run(*args, "--frames", "1", status=1)[-1]["text"]
    assert (tmp_path / "a.json").read_text() == made


BLEND = """
import sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.frame_start, scene.frame_end = 1, 9
scene.render.resolution_x, scene.render.resolution_y = 96, 54
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
scene.collection.objects.link(camera)
scene.camera = camera
camera.location, camera.rotation_euler = (0, -5, 1), (1.5707963, 0, 0)
data = bpy.data.lights.new("sun", "POINT")
data.shadow_soft_size = 0.05
light = bpy.data.objects.new("sun", data)
light.location = (0.5, 0, 1.6)
scene.collection.objects.link(light)
bpy.ops.mesh.primitive_cube_add(size=0.5, location=(0.3, -2, 1.3))
wall = bpy.context.object
for frame, x in ((1, 3.25), (5, 0.25), (9, -2.75)):
    wall.location.x = x
    wall.keyframe_insert("location", frame=frame)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
sys.stdout.flush()
import os
os._exit(0)
"""


@pytest.fixture(scope="module")
def blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera, a lamp, and a block that passes between them in frame 5."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("there is no bpy (`make setup` brings it)")
    path = tmp_path_factory.mktemp("blend") / "shot.blend"
    subprocess.run([sys.executable, "-c", BLEND, str(path)], check=True, capture_output=True, timeout=120)
    return path


def test_transfer_to_a_blend_whose_objects_hide_the_light(run: Run, made: Path, blend: Path, tmp_path: Path) -> None:
    """A transfer to a .blend follows its camera and lamp, and fades the flare while an object hides the lamp."""
    out = tmp_path / "out"
    run("transfer", made, "--to", blend, "--out", out, "--frames", "1-9", "--jobs", "2", "--float")
    shot = Shot.read(out / "shot.1-9.json")
    assert [one.frame for one in shot.frames] == list(range(1, 10))
    shares = [one.lights[0].visibility for one in shot.frames]
    assert shares[4] == 0
    assert shares[0] == shares[8] == 1
    camera = shot.frames[0].camera
    pixels, depth = camera.project(shot.frames[0].lights[0].xyz)
    np.testing.assert_allclose(pixels[0], (48 + 96 * 50 / 36 * 0.1, 27 - 96 * 50 / 36 * 0.12), atol=1e-3)
    assert depth[0] == pytest.approx(5)
    most = [float(read_layers(out / f"layers.{frame:04d}.exr").flare.max()) for frame in range(1, 10)]
    assert most[0] > 0
    assert most[4] == 0
    assert max(abs(np.diff(most))) < 0.9 * max(most)
    # A chunk alone, as a farm makes it, is the same: its neighbours are looked at too.
    run("transfer", made, "--to", blend, "--out", tmp_path / "part", "--frames", "4-4", "--float")
    assert (tmp_path / "part" / "layers.0004.exr").read_bytes() == (out / "layers.0004.exr").read_bytes()


def test_a_range_of_frames_that_is_no_file_name_gets_one(run: Run, made: Path, blend: Path, tmp_path: Path) -> None:
    """Steps have a colon, and a long list is longer than a name may be."""
    names = set()
    for number, frames in enumerate(("1-9:8", ",".join(map(str, [1, 9] * 60)))):
        run("transfer", made, "--to", blend, "--out", tmp_path / f"{number}", "--frames", frames)
        assert (tmp_path / f"{number}" / "layers.0009.exr").is_file()
        names.add(next((tmp_path / f"{number}").glob("shot.*.json")).name)
    assert len(names) == 2
    assert all(len(name) < 30 and ":" not in name for name in names)


def test_a_bare_flare_is_baked_for_a_blend(run: Run, made: Path, blend: Path, tmp_path: Path) -> None:
    run("bake", made / "flare.flare", "--blend", blend, "--out", tmp_path / "out", "--frames", "1", "--lights", "sun")
    layers = read_layers(tmp_path / "out" / "layers.0001.exr")
    assert list(layers.flares) == ["sun"]
    assert layers.flare.max() > 0
    problem = run("bake", made / "flare.flare", "--blend", blend, "--out", tmp_path / "none", "--lights", "moon",
                  status=1)[-1]
    assert "no object 'moon'" in problem["text"]


def test_arguments_are_checked_before_a_blend_is_read(run: Run, made: Path, blend: Path, tmp_path: Path) -> None:
    """Which may take minutes to look through; nothing is left behind either."""
    for more, said in ((["--radius", "nan"], "--radius"), (["--light", "3,4"], "--light"), (["--jobs", "0"], "--jobs"),
                       (["--size", "0"], "--size"), (["--smooth", "-1"], "--smooth")):
        assert said in run("transfer", made, "--to", blend, "--out", tmp_path / "o", *more, status=2)[-1]["text"]
    bad = tmp_path / "bad.blend"
    bad.write_bytes(b"no blend")
    text = run("transfer", made, "--to", bad, "--out", tmp_path / "o", status=1)[-1]["text"]
    assert "\n" not in text and "bad.blend cannot be opened by Blender" in text
    text = run("solve", blend, "--plates", tmp_path, "--out", tmp_path / "o", "--frames", "3", status=2)[-1]["text"]
    assert text.startswith("--frames is only for frames or a video")
    assert not (tmp_path / "o").exists()


def test_a_missing_target_lists_the_kinds_of_target(run: Run, made: Path, tmp_path: Path) -> None:
    for name in ("none", "none.png"):
        text = run("transfer", made, "--to", tmp_path / name, "--out", tmp_path / "o", status=1)[-1]["text"]
        assert text.endswith("is missing; name a target for the flare: pictures, a capture, a run, a .blend, a PLY "
                             "or a shot.")


def test_a_target_of_an_unsupported_kind_is_reported(run: Run, made: Path, tmp_path: Path) -> None:
    for name, sentence in (("a.mov", "a.mov is a video; take its frames out first"),
                           ("a.txt", "a.txt is not a picture")):
        (tmp_path / name).touch()
        text = run("transfer", made, "--to", tmp_path / name, "--light", "9,9", "--out", tmp_path / "o", status=1)[-1]
        assert sentence in text["text"]


def test_the_animated_camera_of_a_blend_is_a_capture(run: Run, blend: Path, tmp_path: Path) -> None:
    for frame in range(1, 5):
        write_png(tmp_path / "renders" / f"render.{frame:04d}.png", np.full((54, 96, 3), 0.1 * frame))
    run("solve", blend, "--plates", tmp_path / "renders", "--out", tmp_path / "capture")
    found = Capture.open(tmp_path / "capture")
    assert len(found.views) == 4
    assert [light.name for light in found.lights] == ["sun"]
    assert len(found.points) > 4
    pixels, _ = found.views[0].camera.project(found.lights[0].xyz)
    np.testing.assert_allclose(pixels[0], (48 + 96 * 50 / 36 * 0.1, 27 - 96 * 50 / 36 * 0.12), atol=1e-3)
    assert found.frame(found.views[2]).display()[0, 0, 0] == pytest.approx(0.3, abs=0.01)


def test_edits_that_a_flare_stores_are_applied_and_named(run: Run, tmp_path: Path) -> None:
    from core.look import LookEdits
    from core.look.look import write_annotated

    save_flare(tmp_path / "plain.flare", FlareFile(some_flare(count=20, lights=1), "add",
                                                   TrainedCamera(64, 40, 70.0, 70.0, 33.0, 19.5)))
    look = read_look(tmp_path / "plain.flare")
    write_annotated(tmp_path / "plain.flare", tmp_path / "edited.flare", notes="", licence="",
                    edits=LookEdits.parse([f"{look.names[0]}.intensity=0.25"], look.names))
    write_png(tmp_path / "plate.png", np.zeros((40, 64, 3), np.float32))
    light, said = {}, {}
    for name in ("plain", "edited"):
        events = run("transfer", tmp_path / f"{name}.flare", "--to", tmp_path / "plate.png", "--light", "20,12",
                     "--query", "source", "--out", tmp_path / name)
        light[name] = read_layers(next((tmp_path / name).glob("layers.*.exr"))).flare.sum()
        said[name] = [event["text"] for event in events if "stores are applied" in event.get("text", "")]
    assert light["edited"] == pytest.approx(0.25 * light["plain"], rel=2e-3) and light["plain"] > 0
    assert said["plain"] == [] and "intensity=0.25" in said["edited"][0]
