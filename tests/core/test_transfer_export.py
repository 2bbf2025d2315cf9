# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of a flare as a PLY and as a preset."""
from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from core.conventions.exposures import colour_scale
from core.conventions.pixel_grid import PixelGrid
from core.flare.model import OURS, PAPER
from core.gaussians import rasterization
from core.gaussians.ply import read_ply
from core.gaussians.projection import rotation_matrices
from core.gaussians.rendering import ALPHA_MIN
from core.look import LookEdits, PlaneGaussians, ViewOfLight, draw, read_look
from core.transfer.export import _element_part, flare_scene, make_preset, write_flare_ply, write_preset
from tests.core.flared import cameras
from tests.core.test_look import saved


@pytest.mark.parametrize("pixel_grid", [None, PixelGrid(70.0, 70.0), PixelGrid(25.0, 35.0)])
@pytest.mark.parametrize("blend", ["over", "add"])
def test_the_ply_of_a_frame_renders_as_the_flare(blend: str, pixel_grid: PixelGrid | None, tmp_path: Path) -> None:
    """Without rings, which 3DGS has no word for; "over", which is what a 3DGS renderer does."""
    form = replace(PAPER if blend == "over" else OURS, rings=False)
    saved(tmp_path / "a.flare", form, 2, blend)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[0]
    seen = look.evaluate(camera.world_to_camera)
    write_flare_ply(tmp_path / "flare.ply", seen, camera, blend, pixel_grid)
    scene = read_ply(tmp_path / "flare.ply")
    assert len(scene) == look.count
    with torch.no_grad():
        shown = rasterization(
            scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh,
            torch.from_numpy(camera.world_to_camera).float(), torch.from_numpy(camera.intrinsics).float(),
            camera.width, camera.height, kernels="torch").colour.numpy()
    expected = draw(seen.values(), camera.intrinsics, camera.width, camera.height, "over", pixel_grid)
    assert expected.max() > 0.05
    apart = np.abs(shown - expected)
    assert (apart < 2e-3).mean() > 0.999
    assert apart.max() < ALPHA_MIN, "one that is just too faint here and not there, at most"


def test_rings_are_extra_properties_of_the_ply(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", OURS, 1)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    seen = look.evaluate(camera.world_to_camera)
    write_flare_ply(tmp_path / "flare.ply", seen, camera, look.blend)
    head, body = (tmp_path / "flare.ply").read_bytes().split(b"end_header\n")
    assert b"property float ring_r0\nproperty float ring_w\n" in head
    assert b"comment light adds" in head
    table = np.frombuffer(body, "<f4").reshape(look.count, 64)
    np.testing.assert_array_equal(table[:, 62:], next(iter(seen.values())).rings)


def test_arcs_are_extra_properties_of_the_ply(tmp_path: Path) -> None:
    """In the Gaussians' own axes: exp(arc_0 u + arc_1 v) of the PLY's u and v is exp(b·d) of the plane's d."""
    saved(tmp_path / "a.flare", replace(OURS, arcs=True), 1)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    seen = next(iter(look.evaluate(camera.world_to_camera).values()))
    scene, more = flare_scene({"lamp": seen}, camera)
    assert list(more) == ["ring_r0", "ring_w", "arc_0", "arc_1"]
    np.testing.assert_allclose(np.hypot(more["arc_0"], more["arc_1"]), seen.arc_strengths, rtol=1e-3)
    axes = rotation_matrices(scene.quaternions).detach().numpy()[:, :, :2]  # in the world
    depth = (scene.means.detach().numpy() - camera.position) @ camera.world_to_camera[2, :3]
    own = np.stack([more["arc_0"], more["arc_1"]], -1) * scene.scales.detach().numpy()[:, :2]
    on_plane = (np.einsum("nxa,na->nx", axes, own) @ camera.world_to_camera[:2, :3].T) / depth[:, None]
    np.testing.assert_allclose(on_plane, seen.arcs, atol=1e-4 * np.abs(seen.arcs).max())


def test_an_invisible_flare_is_an_empty_ply(tmp_path: Path) -> None:
    write_flare_ply(tmp_path / "flare.ply", {}, cameras(1)[0], "add")
    assert len(read_ply(tmp_path / "flare.ply")) == 0


def test_a_light_name_with_line_breaks_stays_in_one_comment(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", OURS, 1)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    seen = next(iter(look.evaluate(camera.world_to_camera).values()))
    write_flare_ply(tmp_path / "flare.ply", {"left\nelement lamp\r": seen, "right": seen}, camera, look.blend)
    assert len(read_ply(tmp_path / "flare.ply")) == 2 * look.count
    assert b"\ncomment lights left element lamp right\n" in (tmp_path / "flare.ply").read_bytes()


def test_a_preset_has_position_and_intensity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One Gaussian of each kind at a known place."""
    saved(tmp_path / "a.flare", OURS, 1, count=4)
    look = read_look(tmp_path / "a.flare")
    light = np.array([0.3, 0.4], np.float32)
    along = np.array([0.6, 0.8])
    means = np.stack([light, 0 * light, -light, light / 2]).astype(np.float32)
    sides = np.array([[0.04, 0.04], [0.02, 0.02], [0.02, 0.02], [0.2, 0.01]])
    turn = np.stack([along, [-along[1], along[0]]], 1)
    covariances = [turn @ np.diag(side**2) @ turn.T for side in sides]
    seen = PlaneGaussians(means, np.array([[c[0, 0], c[0, 1], c[1, 1]] for c in covariances], np.float32),
                          np.full(4, 0.5, np.float32), np.tile(np.array([2, 1, 0.5], np.float32), (4, 1)),
                          np.array([[0, 1], [0, 1], [4, 0.5], [0, 1]], np.float32),
                          np.stack([0 * light, 0 * light, 0.01 * np.array([-0.8, 0.6]), 0 * light]).astype(np.float32))
    monkeypatch.setattr(type(look.lights[0]), "evaluate", lambda *_arguments, **_options: seen)
    view = {look.names[0]: ViewOfLight(np.zeros(3, np.float32), np.eye(3, dtype=np.float32), light, 1.0)}
    write_preset(tmp_path / "a.json", look, view)
    made = json.loads((tmp_path / "a.json").read_text())
    assert made == make_preset(look, view)
    rows = [row for element in look.lights[0].elements for row in element.members]
    listed = [part for element in made["lights"][0]["elements"] for part in element["parts"]]
    parts = [part for _, part in sorted(zip(rows, listed, strict=True), key=lambda pair: pair[0])]
    width = look.camera.width / look.camera.fx
    np.testing.assert_allclose([part["offset"] for part in parts], [0, 1, 2, 0.5], atol=1e-6)
    np.testing.assert_allclose([part["aside"] for part in parts], 0, atol=1e-6)
    assert [part["shape"] for part in parts] == ["glow", "glow", "ring", "streak"]
    np.testing.assert_allclose(parts[3]["size"], np.array([0.2, 0.01]) / width, rtol=1e-3)
    assert abs(parts[3]["rotation"]) < 0.1
    np.testing.assert_allclose(parts[2]["radius"], np.array([0.08, 0.08]) / width, rtol=1e-3)
    assert [("arc" in part) for part in parts] == [False, False, True, False]
    assert parts[2]["arc"] == pytest.approx({"towards": 90, "share": np.exp(-2 * 4 * 0.5)}, rel=1e-3)
    np.testing.assert_allclose(parts[0]["colour"], [1, 0.5, 0.25])
    assert parts[0]["intensity"] == pytest.approx(1.0)


@pytest.mark.parametrize("blend", ["over", "add"])
def test_a_preset_has_the_visible_lights_at_the_frame_s_exposure(blend: str, tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", OURS, 2, blend)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    view = {light.name: ViewOfLight.of(camera.world_to_camera, light.xyz) for light in look.lights}
    edits = LookEdits.parse(["lamp 0.mute=1"], look.names)
    usual, exposed = (make_preset(look, view, edits, replace(camera, exposure=times)) for times in (1.0, 0.5))
    assert [light["name"] for light in usual["lights"]] == [light["name"] for light in exposed["lights"]] == ["lamp 1"]
    before, after = ([part["intensity"] for element in one["lights"][0]["elements"] for part in element["parts"]]
                     for one in (usual, exposed))
    assert max(before) > 0
    np.testing.assert_allclose(after, np.multiply(before, colour_scale(0.5, blend)), rtol=1e-5)


@pytest.mark.parametrize("word", ["mute", "solo"])
def test_a_preset_omits_exactly_the_hidden_elements(word: str, tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", OURS, 1)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    light = look.lights[0]
    view = {light.name: ViewOfLight.of(camera.world_to_camera, light.xyz)}
    everything = {one["name"]: one for one in make_preset(look, view)["lights"][0]["elements"]}
    assert len(everything) == len(light.elements) > 2
    for element in light.elements:
        edits = LookEdits.parse([f"{light.name}/{element.name}.{word}=1"], look.names,
                                {light.name: [one.name for one in light.elements]})
        left = set(everything) - {element.name} if word == "mute" else {element.name}
        found = make_preset(look, view, edits)["lights"][0]["elements"]
        assert found == [everything[name] for name in everything if name in left]


def test_a_preset_is_in_picture_widths(tmp_path: Path) -> None:
    """Lengths are relative to the target's picture, not to the footage that the flare was trained on."""
    saved(tmp_path / "a.flare", OURS, 1)
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    view = {light.name: ViewOfLight.of(camera.world_to_camera, light.xyz) for light in look.lights}
    wide, tele = (make_preset(look, view, camera=replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom))["lights"][0]
                  for zoom in (1, 2))
    pixel = camera.project(look.lights[0].xyz[None])[0][0]
    np.testing.assert_allclose(wide["at"], (pixel - [camera.cx, camera.cy]) / camera.width, rtol=1e-4)
    np.testing.assert_allclose(tele["at"], 2 * np.array(wide["at"]), rtol=1e-6)
    (part, *_), (closer, *_) = (one["elements"][0]["parts"] for one in (wide, tele))
    np.testing.assert_allclose(closer["size"], 2 * np.array(part["size"]), rtol=1e-6)
    assert closer["offset"] == part["offset"]


def test_a_preset_has_side_and_rotation_of_a_part() -> None:
    """Clockwise of the axis through the light, as the picture is seen."""
    along, aside = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    long = np.cos(np.radians(30)) * along + np.sin(np.radians(30)) * aside
    turn = np.stack([long, [-long[1], long[0]]], 1)
    spread = turn @ np.diag([0.2**2, 0.01**2]) @ turn.T
    mean = (0.25 * along + 0.1 * aside)[None].astype(np.float32)
    one = PlaneGaussians(mean, np.array([[spread[0, 0], spread[0, 1], spread[1, 1]]], np.float32),
                         np.ones(1, np.float32), np.ones((1, 3), np.float32))
    part = _element_part(one, 0, 0.5 * along, 1.0)
    assert part["rotation"] == pytest.approx(30, abs=0.01)
    assert (part["offset"], part["aside"]) == pytest.approx((0.5, 0.1), abs=1e-6)
