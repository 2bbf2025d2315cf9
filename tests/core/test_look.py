# SPDX-License-Identifier: GPL-3.0-or-later
"""The look in numpy compared with the flare in torch; elements, edits and shots."""
from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from core.bake import shot as shot_bakes
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.errors import FlareFileError, SettingsError
from core.flare import file as flare_file
from core.flare.compositing import splat_flare
from core.flare.file import FlareFile
from core.flare.model import OURS, PAPER, FlareModel
from core.look import (
    Edit,
    KeyedEdits,
    LookEdits,
    PlacedLight,
    PlaneGaussians,
    TrainedCamera,
    ViewOfLight,
    draw,
    read_look,
    store_elements,
)
from core.look import elements as grouping
from core.look.container import read_tensors, rewrite_metadata
from core.look.edits import apply_edits
from core.look.form import FORM_BOUNDS, FlareForm
from core.look.look import network_query
from core.look.shot import Shot, ShotFrame, read_folders_in_steps
from core.system.steps import finish
from tests.core.flared import cameras
from tests.core.test_flare import pose, some_flare

FORMS = {"paper": PAPER, "ours": OURS, "plane": replace(PAPER, line=False, plane_offset=False),
         "bare": replace(PAPER, light_correction=False, plane_offset=False, sh_degree=1),
         "small": replace(OURS, levels=6), "arcs": replace(OURS, arcs=True)}
SMALL = FORMS["small"]
CAMERA = TrainedCamera(64, 40, 70.0, 70.0, 33.0, 19.5)


def saved(path: Path, form: FlareForm = SMALL, lights: int = 2, blend: str = "add", count: int = 40) -> FlareModel:
    model = some_flare(form, count, lights)
    flare_file.save(path, FlareFile(model, blend, CAMERA, "CC0", "some notes"))  # type: ignore[arg-type]
    return model


@pytest.mark.parametrize("name", FORMS)
def test_the_look_evaluates_as_the_torch_model(name: str, tmp_path: Path) -> None:
    model = saved(tmp_path / "a.flare", FORMS[name])
    look = read_look(tmp_path / "a.flare")
    assert look.names == model.names
    for number in range(3):
        with torch.no_grad():
            expected = model(pose(number))
        shown = look.evaluate(cameras(3)[number].world_to_camera)
        assert list(shown) == list(expected)
        for light, gaussians in expected.items():
            for field in ("means", "covariances", "opacities", "colours", "rings", "arcs"):
                theirs = getattr(gaussians, field)
                if theirs is not None:
                    np.testing.assert_allclose(getattr(shown[light], field), theirs.numpy(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("blend", ["add", "over"])
@pytest.mark.parametrize("form", ["small", "arcs"])
def test_draw_equals_the_rasterizer(form: str, blend: str, tmp_path: Path) -> None:
    model = saved(tmp_path / "a.flare", FORMS[form], 1, blend)
    if form == "arcs":
        with torch.no_grad():
            model.lights[0].gaussians["arcs"] += torch.randn(40, 2, generator=torch.Generator().manual_seed(5))
        flare_file.save(tmp_path / "a.flare", FlareFile(model, blend, CAMERA))  # type: ignore[arg-type]
    camera = cameras(3)[1]
    with torch.no_grad():
        expected = splat_flare(next(iter(model(pose(1)).values())), torch.from_numpy(camera.intrinsics).float(), 64, 40,
                               blend, kernels="torch").colour.numpy()  # type: ignore[arg-type]
    look = read_look(tmp_path / "a.flare")
    picture = draw(look.evaluate(camera.world_to_camera).values(), camera.intrinsics, 64, 40, look.blend)
    assert expected.max() > 0.05
    np.testing.assert_allclose(picture, expected, atol=2e-5)


def test_a_light_behind_the_camera_has_no_flare(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare")
    behind = np.diag([1.0, -1.0, -1.0, 1.0])
    assert read_look(tmp_path / "a.flare").evaluate(behind) == {}


def test_lights_can_be_placed_omitted_and_hidden(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare")
    look, view = read_look(tmp_path / "a.flare"), cameras(3)[0].world_to_camera
    moved = look.evaluate(view, lights={"lamp 1": look.lights[0].xyz})
    assert list(moved) == ["lamp 1"]
    half = look.evaluate(view, visibilities={"lamp 0": 0.25})
    np.testing.assert_allclose(half["lamp 0"].opacities, 0.25 * look.evaluate(view)["lamp 0"].opacities, rtol=1e-6)


def test_a_query_can_be_clipped_to_the_trained_range(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", replace(PAPER, levels=6), 1)
    look = read_look(tmp_path / "a.flare")
    inside, far = cameras(3)[1].world_to_camera, cameras(3)[1].world_to_camera.copy()
    far[0, 3] += 3
    for view, same in ((inside, True), (far, False)):
        free, kept = (look.evaluate(view, query=query)["lamp 0"] for query in ("target", "trained"))
        assert np.allclose(free.colours, kept.colours) == same
    low, high = look.lights[0].query_range.camera_low, look.lights[0].query_range.camera_high
    camera, light = look.lights[0].query_range.clip(np.array([9, 0, -4], np.float32), np.array([3, 4], np.float32))
    assert (camera >= low).all()
    assert (camera <= high).all()
    np.testing.assert_allclose(light[1] / light[0], 4 / 3, rtol=1e-5)
    assert np.linalg.norm(light) <= 0.7 + 1e-5


# ---- files ----------------------------------------------------------------------------------------


def test_notes_and_licence_are_read(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare")
    look = read_look(tmp_path / "a.flare")
    assert (look.licence, look.notes, look.camera.width, look.count) == ("CC0", "some notes", 64, 80)


def test_bad_files_raise_in_one_line(tmp_path: Path) -> None:
    good = tmp_path / "good.flare"
    saved(good, replace(OURS, levels=2))
    data = good.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8:8 + length])

    def with_description(**changes: object) -> bytes:
        description = {**json.loads(header["__metadata__"]["fit_flare"]), **changes}
        text = json.dumps({**header, "__metadata__": {"fit_flare": json.dumps(description)}}).encode()
        return len(text).to_bytes(8, "little") + text + data[8 + length:]

    first = json.loads(header["__metadata__"]["fit_flare"])["lights"][0]
    bad = {
        "empty": b"", "short": data[:20], "cut": data[:-10], "noise": bytes(range(256)) * 8,
        "huge": (1 << 60).to_bytes(8, "little") + data[8:], "list": (2).to_bytes(8, "little") + b"[]",
        "newer": with_description(version=99), "form": with_description(lights=[{**first, "form": {"spiral": True}}]),
        "count": with_description(lights=[{**first, "count": 7}]), "blend": with_description(blend="paint"),
        "xyz": with_description(lights=[{**first, "xyz": [1, 2]}]), "twice": with_description(lights=[first, first]),
        "members": with_description(elements=[{"light": first["name"], "name": "a", "members": [4000]}]),
    }
    for name, content in bad.items():
        (tmp_path / f"{name}.flare").write_bytes(content)
        with pytest.raises(FlareFileError, match=name):
            read_look(tmp_path / f"{name}.flare")
    for name in ("newer", "form"):
        with pytest.raises(FlareFileError, match="newer Fit Flare"):
            read_look(tmp_path / f"{name}.flare")
    with pytest.raises(FlareFileError, match="missing"):
        read_look(tmp_path / "absent.flare")


@pytest.mark.parametrize("padding", range(4))
def test_tensors_are_aligned_after_a_header_of_any_length(tmp_path: Path, padding: int) -> None:
    """numpy multiplies arrays that are not aligned several times slower."""
    header = json.dumps({"a": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]}}).encode() + b" " * padding
    values = np.arange(6, dtype="<f4").reshape(2, 3)
    (tmp_path / "a.flare").write_bytes(len(header).to_bytes(8, "little") + header + values.tobytes())
    array = read_tensors(tmp_path / "a.flare")[0]["a"]
    assert array.flags.aligned and np.array_equal(array, values)


def test_the_container_equals_safetensors(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    arrays = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.array([], np.int32), "c": np.array([True])}
    save_file(arrays, str(tmp_path / "a"), {"key": "value"})
    tensors, metadata = read_tensors(tmp_path / "a")
    assert metadata == {"key": "value"}
    for name, array in arrays.items():
        np.testing.assert_array_equal(tensors[name], array)


# ---- elements -------------------------------------------------------------------------------------


def plane(places: list[float], *, size: float = 0.02, long: float = 1.0, ring: float = 0.0) -> PlaneGaussians:
    """Gaussians on the line towards (0.3, 0)."""
    n = len(places)
    means = np.stack([0.3 * np.array(places), np.zeros(n)], -1).astype(np.float32)
    covariances = np.tile(np.array([(size * long) ** 2, 0, size**2], np.float32), (n, 1))
    rings = np.tile(np.array([ring, 1], np.float32), (n, 1))
    return PlaneGaussians(means, covariances, np.full(n, 0.5, np.float32), np.ones((n, 3), np.float32), rings)


def test_gaussians_are_grouped_by_kind_and_position() -> None:
    from core.look.plane import concatenate

    mu = [1.0, 1.02, 0.98, 0.4, 0.42, -0.5, 1.0, 0.4]
    gaussians = concatenate([plane(mu[:6]), plane(mu[6:7], long=9), plane(mu[7:], ring=3)])
    assert gaussians is not None
    found = {element.name: element for element in grouping.group_elements(gaussians, np.array(mu, np.float32))}
    assert {name: sorted(element.members.tolist()) for name, element in found.items()} == {
        "glare": [0, 1, 2], "ghost": [3, 4], "ghost 2": [5], "streak": [6], "ring": [7]}
    assert abs(found["ghost 2"].mu + 0.5) < 1e-5
    assert sum(element.energy for element in found.values()) == pytest.approx(1, abs=1e-5)


def test_close_ghosts_are_split_at_the_valley_between_them() -> None:
    """Within less than a kernel's reach of one another."""
    mu = np.array([0, 0.005, 0.01, 0.1, 0.105, 0.11], np.float32)
    found = grouping.group_elements(plane(mu.tolist()), mu)
    assert sorted(element.members.tolist() for element in found) == [[0, 1, 2], [3, 4, 5]]


def test_every_gaussian_belongs_to_one_element() -> None:
    random = np.random.default_rng(2)
    for count in (0, 1, 2, 400):
        gaussians = plane(random.uniform(-2, 2, count).tolist())
        for mu in (gaussians.means[:, 0] / np.float32(0.3), None):
            found = grouping.group_elements(gaussians, mu)
            assert len(found) <= grouping.MAX_ELEMENTS
            assert len({element.name for element in found}) == len(found)
            members = np.concatenate([np.zeros(0, np.int64), *(element.members for element in found)])
            assert sorted(members.tolist()) == list(range(count))


def test_elements_have_their_extent_and_colour() -> None:
    gaussians = replace(plane([1.0, 0.4, 0.44], size=0.02), colours=np.array([[2, 1, 0]] * 3, np.float32))
    source, pair = grouping.group_elements(gaussians, gaussians.means[:, 0] / np.float32(0.3))
    if source.mu < pair.mu:
        source, pair = pair, source
    assert source.extent == pytest.approx(0.02 * np.sqrt(2), rel=1e-4)
    assert pair.extent == pytest.approx(np.sqrt(2 * 0.02**2 + (0.3 * 0.02) ** 2), rel=1e-4)
    assert source.colour == (1.0, 0.5, 0.0)
    hole = grouping.group_elements(plane([1.0], size=0.02, ring=5), np.ones(1, np.float32))[0]
    assert hole.extent == pytest.approx(0.02 * 5, rel=0.1)


def test_stored_elements_are_not_regrouped(tmp_path: Path) -> None:
    path = tmp_path / "a.flare"
    flare_file.save(path, FlareFile(some_flare(SMALL, 40, 2), "add", CAMERA))
    found = read_look(path)
    store_elements(path)
    again = read_look(path)
    assert len(flare_file.load(path).elements) == sum(len(light.elements) for light in found.lights)
    for before, after_ in zip(found.lights, again.lights, strict=True):
        assert [element.name for element in before.elements] == [element.name for element in after_.elements]
        for one, other in zip(before.elements, after_.elements, strict=True):
            np.testing.assert_array_equal(one.members, other.members)
            assert other.kind == one.kind
            assert other.mu == pytest.approx(one.mu, abs=1e-4)
            assert other.extent == pytest.approx(one.extent, abs=1e-4)
            assert other.colour == pytest.approx(one.colour, abs=1e-3)


def test_elements_in_the_file_take_precedence(tmp_path: Path) -> None:
    model = some_flare(SMALL, 6, 1)
    listed = [{"light": "lamp 0", "name": "iris", "kind": "ring", "members": [0, 2], "mu": 0.5, "energy": 0.7}]
    flare_file.save(tmp_path / "a.flare", FlareFile(model, "add", CAMERA, elements=listed))
    elements = read_look(tmp_path / "a.flare").lights[0].elements
    assert [(element.name, element.members.tolist()) for element in elements] == [
        ("iris", [0, 2]), ("rest", [1, 3, 4, 5])]


# ---- edits ----------------------------------------------------------------------------------------

LIGHT = np.array([0.3, 0.0])


def ghosts() -> tuple[PlaneGaussians, list[grouping.Element]]:
    gaussians = plane([1.0, 0.4, 0.44])
    return gaussians, grouping.group_elements(gaussians, gaussians.means[:, 0] / np.float32(0.3))


def after(*texts: str, blend: str = "add") -> PlaneGaussians:
    gaussians, elements = ghosts()
    names = {"lamp": [element.name for element in elements]}
    return apply_edits(gaussians, "lamp", LIGHT, elements, LookEdits.parse(texts, ["lamp"], names), blend)


def test_neutral_edits_change_nothing() -> None:
    gaussians, elements = ghosts()
    assert apply_edits(gaussians, "lamp", LIGHT, elements, LookEdits(), "add") is gaussians


def test_scale_grows_each_element_about_its_own_centre() -> None:
    before, _ = ghosts()
    scaled = after("lamp.scale=2")
    np.testing.assert_allclose(scaled.covariances, 4 * before.covariances, rtol=1e-6)
    np.testing.assert_allclose(scaled.means[0], before.means[0], atol=1e-7)
    np.testing.assert_allclose(scaled.means[2] - scaled.means[1], 2 * (before.means[2] - before.means[1]), atol=1e-6)
    np.testing.assert_allclose(scaled.means[1:].mean(0), before.means[1:].mean(0), atol=1e-6)


def test_spread_moves_ghosts_and_not_the_light() -> None:
    before, _ = ghosts()
    spread = after("lamp.spread=0.5")
    np.testing.assert_allclose(spread.means[0], before.means[0], atol=1e-6)
    np.testing.assert_allclose(LIGHT - spread.means[1:].mean(0), 0.5 * (LIGHT - before.means[1:].mean(0)), atol=1e-6)
    np.testing.assert_allclose(spread.covariances, before.covariances, rtol=1e-6)


def test_rotation_turns_an_element_about_its_centre() -> None:
    before, _ = ghosts()
    turned = after("lamp/ghost.rotation=90")
    np.testing.assert_array_equal(turned.means[0], before.means[0])
    apart = turned.means[2] - turned.means[1]
    np.testing.assert_allclose(apart, [0, 0.012], atol=1e-6)  # x towards y: clockwise, since y runs down


def test_arcs_are_scaled_and_turned_with_their_gaussians() -> None:
    """The edited look drawn is the look drawn and turned: a quarter, about the middle of a square picture."""
    one = plane([0.0], ring=3.0)
    one = replace(one, arcs=np.array([[0.02, 0.01]], np.float32))
    elements = grouping.group_elements(one, np.zeros(1, np.float32))
    intrinsics = np.array([[100.0, 0, 20], [0, 100, 20], [0, 0, 1]])
    turned = apply_edits(one, "lamp", LIGHT, elements, LookEdits(Edit(rotation=90)), "add")
    expected = np.rot90(draw([one], intrinsics, 40, 40), -1)
    assert np.abs(expected - draw([one], intrinsics, 40, 40)).max() > 0.1
    np.testing.assert_allclose(draw([turned], intrinsics, 40, 40), expected, atol=1e-5)
    large = apply_edits(one, "lamp", LIGHT, elements, LookEdits(Edit(scale=2)), "add")
    np.testing.assert_allclose(large.arc_strengths, one.arc_strengths, rtol=1e-5)
    assert one.arc_strengths[0] == pytest.approx(5**0.5 / 2, rel=1e-5)
    # What a ring loses to an arc it loses in its energy, too; a plain Gaussian is only shifted.
    assert one.energy[0] < 0.5 * replace(one, arcs=None).energy[0]
    assert plane([0.0]).energy[0] == pytest.approx(replace(plane([0.0]), arcs=one.arcs).energy[0], rel=1e-5)


def test_arcs_need_rings(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", FORMS["arcs"], 1)
    _, metadata = read_tensors(tmp_path / "a.flare")
    description = json.loads(metadata["fit_flare"])
    description["lights"][0]["form"]["rings"] = False
    rewrite_metadata(tmp_path / "a.flare", tmp_path / "b.flare", {"fit_flare": json.dumps(description)})
    for reader in (read_look, flare_file.load):
        with pytest.raises(FlareFileError, match="is damaged"):
            reader(tmp_path / "b.flare")


@pytest.mark.parametrize("name", FORM_BOUNDS)
def test_a_form_out_of_bounds_raises_in_all_readers(name: str, tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", SMALL, 1)
    _, metadata = read_tensors(tmp_path / "a.flare")
    description = json.loads(metadata["fit_flare"])
    for value in (FORM_BOUNDS[name].minimum - 1, FORM_BOUNDS[name].maximum + 1):
        description["lights"][0]["form"][name] = value
        rewrite_metadata(tmp_path / "a.flare", tmp_path / "b.flare", {"fit_flare": json.dumps(description)})
        for reader in (read_look, flare_file.load):
            with pytest.raises(FlareFileError, match="form is not valid"):
                reader(tmp_path / "b.flare")


@pytest.mark.parametrize("changed", [{"latent": 0}, {"latent": 3}, {"levels": 5}])
def test_a_network_that_does_not_fit_its_form_raises_on_reading(changed: dict[str, int],
                                                                tmp_path: Path) -> None:
    """Not when it is first asked for a view: by then it stands in a library or a scene."""
    saved(tmp_path / "a.flare", OURS, 1)
    _, metadata = read_tensors(tmp_path / "a.flare")
    description = json.loads(metadata["fit_flare"])
    description["lights"][0]["form"].update(changed)
    rewrite_metadata(tmp_path / "a.flare", tmp_path / "b.flare", {"fit_flare": json.dumps(description)})
    for reader in (read_look, flare_file.load):
        with pytest.raises(FlareFileError, match="is damaged"):
            reader(tmp_path / "b.flare")


@pytest.mark.parametrize(("what", "said"), [
    ("two lights of one name", "two lights have one name"), ("clear 1.5", "clear share is not valid"),
    ("clear -0.1", "clear share is not valid"), ("clear NaN", "clear share is not valid"),
    ("a newer form", "newer Fit Flare .its form has spiral.; update"), ("elements 3", "is damaged"),
    ("elements without their Gaussians", "names Gaussians that are not there"), ("seen 3", "is damaged"),
    ("seen from nowhere", "training view is not valid"), ("a wide camera", "'wide'"),
    ("endless count", "is damaged")])
def test_both_readers_raise_the_same_errors(what: str, said: str, tmp_path: Path) -> None:
    saved(tmp_path / "a.flare")
    _, metadata = read_tensors(tmp_path / "a.flare")
    description = json.loads(metadata["fit_flare"])
    first, second = description["lights"]
    match what.split():
        case ["two", *_]:
            second["name"] = first["name"]
        case ["clear", value]:
            second["clear"] = float(value)
        case ["a", "newer", _]:
            second["form"]["spiral"] = True
        case ["elements" | "seen" as key, "3"]:
            description[key] = 3
        case ["elements", *_]:
            description["elements"] = [{"light": second["name"], "name": "ghost", "members": [4000]}]
        case ["seen", *_]:
            description["seen"] = {second["name"]: [[0.0, 0.0, 4.0, 0.1, 0.1], [0.1, 0.1]]}
        case ["a", "wide", _]:
            description["camera"]["fx"] = "wide"
        case _:
            second["count"] = math.inf
    rewrite_metadata(tmp_path / "a.flare", tmp_path / "b.flare", {"fit_flare": json.dumps(description)})
    for reader in (read_look, flare_file.load):
        reader(tmp_path / "a.flare")
        with pytest.raises(FlareFileError, match=rf"b\.flare.*{said}"):
            reader(tmp_path / "b.flare")


def test_only_streaks_are_lengthened() -> None:
    gaussians = plane([1.0], long=8.0)
    elements = grouping.group_elements(gaussians, np.ones(1, np.float32))
    assert elements[0].kind == "streak"
    longer = apply_edits(gaussians, "lamp", LIGHT, elements, LookEdits(Edit(streak=3.0)), "add")
    np.testing.assert_allclose(longer.covariances[0] / [gaussians.covariances[0, 0], 1, gaussians.covariances[0, 2]],
                               [9, 0, 1], atol=1e-4)
    np.testing.assert_array_equal(after("*.streak=3").covariances, ghosts()[0].covariances)


def test_mute_and_solo_turn_elements_and_lights_off() -> None:
    assert len(after("lamp/ghost.mute=1")) == 1
    assert len(after("lamp/ghost.solo=1")) == 2
    assert len(after("lamp/ghost.solo=1", "lamp/ghost.mute=1")) == 0
    edits = LookEdits.parse(["a.solo=1", "c.mute=1"], ["a", "b", "c"])
    assert [edits.is_visible(name, ["a", "b", "c"]) for name in "abc"] == [True, False, False]
    assert not LookEdits.parse(["*.mute=1"], ["a"]).is_visible("a", ["a"])


def test_colour_edits_of_gaussians_equal_those_of_the_layer() -> None:
    """For the blend "add", editing and drawing commute, also for a saturation above 1."""
    intrinsics = np.array([[50.0, 0, 10], [0, 50, 10], [0, 0, 1]])
    gaussians, elements = ghosts()
    gaussians = replace(gaussians, colours=np.array([[1, 0.2, 0], [0.1, 0.9, 0.3], [0, 0, 1]], np.float32))
    edits = LookEdits.parse(["lamp.intensity=2", "lamp.tint=1,0.5,0.25", "*.saturation=1.6"], ["lamp"])
    gaussians_first = draw([apply_edits(gaussians, "lamp", LIGHT, elements, edits, "add")], intrinsics, 40, 20)
    layer_first = draw([gaussians], intrinsics, 40, 20) @ edits.colour_matrices(["lamp"])["lamp"].T
    np.testing.assert_allclose(gaussians_first, layer_first, atol=1e-5)


def test_intensity_fades_and_brightens_an_over_flare() -> None:
    before, _ = ghosts()
    np.testing.assert_allclose(after("lamp.intensity=0.5", blend="over").opacities, 0.5 * before.opacities)
    np.testing.assert_allclose(after("lamp.tint=0.5,1,1", blend="over").colours[:, 0], 0.735357, atol=1e-5)


def test_edits_are_restored_from_their_texts() -> None:
    names = {"lamp": ["ghost", "streak 2"], "key/1": []}
    texts = ["*.intensity=0.5", "lamp.tint=1,0.8,0.6", "lamp/streak 2.streak=2.5", "key/1.solo=1", "key/1.rotation=-30"]
    edits = LookEdits.parse(texts, ["lamp", "key/1"], names)
    assert LookEdits.parse(edits.texts(), ["lamp", "key/1"], names) == edits
    assert set(edits.texts()) == set(texts)
    assert LookEdits().texts() == []
    assert edits.elements["lamp", "streak 2"].streak == 2.5
    both = LookEdits.parse(["*/ghost.scale=2", "lamp/*.scale=3"], ["lamp"], names)
    assert both.elements == {("lamp", "ghost"): Edit(scale=6.0), ("lamp", "streak 2"): Edit(scale=3.0)}


@pytest.mark.parametrize("name", ["key=1", " lamp", "a.b", " a.scale=2 /b = "])
def test_edits_are_restored_from_their_texts_for_any_light_name(name: str) -> None:
    edits = LookEdits(lights={name: Edit(intensity=2.5), "lamp": Edit(mute=True)},
                      elements={(name, "ghost 2"): Edit(tint=(1.0, 0.5, 0.25), rotation=-30.0)})
    assert LookEdits.parse(edits.texts(), ["lamp", name], {name: ["ghost 2"]}) == edits


@pytest.mark.parametrize("edit", ["lamp/iris.scale=2", "lamp.scale=-1", "lamp.mute=2", "lamp.rotation=a", "lamp.solo=",
                                  "sun/ghost.scale=1", "lamp.sizes=1", "lamp.scale=1e9", "lamp.rotation=inf"])
def test_invalid_edits_raise(edit: str) -> None:
    with pytest.raises(SettingsError, match="edit"):
        LookEdits.parse([edit], ["lamp"], {"lamp": ["ghost"]})


def test_keyed_edits_are_interpolated_between_keyframes(tmp_path: Path) -> None:
    keyed = KeyedEdits(("lamp.scale=2",), {10: ("lamp.intensity=0",), 20: ("lamp.intensity=1", "lamp.mute=1")})
    keyed.write(tmp_path / "edits.json")
    again = KeyedEdits.read(tmp_path / "edits.json")
    assert again == keyed
    strength = [again.edits_at(frame, ["lamp"]).light_edit("lamp").intensity for frame in (1, 10, 15, 20, 99)]
    np.testing.assert_allclose(strength, [0, 0, 0.5, 1, 1])
    assert [again.edits_at(frame, ["lamp"]).light_edit("lamp").mute for frame in (10, 19, 20)] == [False, False, True]
    assert again.edits_at(15, ["lamp"]).light_edit("lamp").scale == 2
    for text in ("[]", '{"set": "a"}', '{"frames": {"x": []}}', "{", '{"frames": {"6": [], "06": []}}',
                 '{"frames": {"6": [], "6": []}}', '{"frames": {"1_0": []}}', '{"frames": {"9999999999": []}}'):
        (tmp_path / "edits.json").write_text(text)
        with pytest.raises(SettingsError, match=r"edits\.json"):
            KeyedEdits.read(tmp_path / "edits.json")


def test_a_rotated_light_flare_is_finite_everywhere(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", SMALL, 1)
    look = read_look(tmp_path / "a.flare")
    edits = LookEdits(Edit(scale=0.0, spread=0.0, rotation=720.0, streak=0.0, intensity=0.0))
    for gaussians in look.evaluate(cameras(3)[0].world_to_camera, edits=edits).values():
        assert np.isfinite(gaussians.means).all()
        assert math.isfinite(float(draw([gaussians], CAMERA_K, 64, 40).sum()))


CAMERA_K = np.array([[70.0, 0, 33], [0, 70, 19.5], [0, 0, 1]])


def test_the_rasterizer_draws_edits_as_the_look(tmp_path: Path) -> None:
    """A bake with edits of shape and element renders what the overlay evaluates."""
    from core.fit.rendering import render
    from core.gaussians.scene import SceneGaussians

    model = saved(tmp_path / "a.flare")
    look, camera = read_look(tmp_path / "a.flare"), cameras(3)[1]
    part = look.lights[1].elements[0].name
    edits = LookEdits.parse(["*.scale=1.4", "lamp 0.spread=0.7", f"lamp 1/{part}.intensity=3", "lamp 1.rotation=40"],
                            look.names, look.element_names)
    empty = SceneGaussians(*(torch.zeros(0, *width) for width in ((3,), (3,), (4,), (), (16, 3))))
    baked = render(empty, model, "add", camera, "torch", look=look, edits=edits)
    for name, gaussians in look.evaluate(camera.world_to_camera, edits=edits).items():
        picture = draw([gaussians], camera.intrinsics, *camera.size)
        np.testing.assert_allclose(picture, baked.layers.flares[name].numpy(), atol=5e-5)


# ---- shots ----------------------------------------------------------------------------------------


def a_shot(tmp_path: Path, *texts: str) -> Shot:
    """One camera, three frames, the look of lamp 0 twice: as it was, and elsewhere and half hidden."""
    saved(tmp_path / "a.flare")
    lights = (PlacedLight("lamp 0", "lamp 0", np.array([-0.2, -0.4, 1.0])),
              PlacedLight("second", "lamp 0", np.array([0.5, 0.2, 1.5]), 0.5))
    return Shot(tmp_path / "a.flare", tuple(
        ShotFrame(number + 1, "Camera", camera, lights, texts) for number, camera in enumerate(cameras(3))))


def test_a_shot_is_restored_from_its_file(tmp_path: Path) -> None:
    shot = a_shot(tmp_path, "second.tint=1,0.5,0.5")
    shot.write(tmp_path / "shot.json")
    again = Shot.read(tmp_path / "shot.json")
    assert again.lights == ("lamp 0", "second")
    assert again.frames[2].edits == ("second.tint=1,0.5,0.5",)
    np.testing.assert_array_equal(again.frames[1].camera.world_to_camera, shot.frames[1].camera.world_to_camera)
    assert again.resized(128, None).frames[0].camera.size == (128, 80)
    text = (tmp_path / "shot.json").read_text()
    for old, new in (('"version": 1', '"version": 2'), ('"share": 1.0', '"share": "x"'), ('"frames"', '"frame"'),
                     ('"width": 64', '"width": -1'), ('"query": "target"', '"query": "moon"'),
                     ('"name": "second"', '"name": "lamp 0"'),
                     ('"frame": 1', '"frame": 1e400'), ('"frame": 1', '"frame": 1.5'), ('"frame": 1', '"frame": -5'),
                     ('"frame": 1', '"frame": 1e30'), ('"width": 64', '"width": 1e400'),
                     ('"share": 1.0', '"share": 1' + 400 * "0"), ('"exposure": 1.0', '"exposure": 0'),
                     ('"frame": 1', '"frame": true'), ('"frame": 1', '"frame": "1"'), ('"frame": 1', '"frame": 2'),
                     ('"width": 64', '"width": "64"'), ('"width": 64', '"width": 64.5'), ('0.0,', '"0.0",'),
                     ('"share": 1.0', '"share": true'), ('"share": 1.0', '"share": 1.5'),
                     ('"share": 1.0', '"share": -0.5'), ('"frames": [', '"frames": [], "before": [')):
        assert old in text
        (tmp_path / "bad.json").write_text(text.replace(old, new))
        with pytest.raises(SettingsError, match=r"bad\.json"):
            Shot.read(tmp_path / "bad.json")


def test_a_shot_is_written_and_read_in_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.look.shot.FRAMES_PER_STEP", 1)
    shot, file = a_shot(tmp_path), tmp_path / "shot.json"
    file.write_text("earlier")
    writing = shot.write_in_steps(file)
    next(writing)
    assert len(list(tmp_path.glob(".*partial*"))) == 1
    writing.close()
    assert file.read_text() == "earlier" and not list(tmp_path.glob(".*partial*"))
    assert sum(1 for _ in shot.write_in_steps(file)) == 3
    keys = [frame.cache_key() for frame in shot.frames]
    assert sum(1 for _ in Shot.read_in_steps(file)) == 6, "each frame is parsed in a step, and checked in another"
    assert [frame.cache_key() for frame in Shot.read(file).frames] == keys
    lines = file.read_text().splitlines()
    assert [json.loads(line.rstrip(","))["frame"] for line in lines[1:-1]] == [1, 2, 3]
    assert finish(read_folders_in_steps(file)) == ({"Camera": ""}, False)
    file.write_text(json.dumps(json.loads(file.read_text()), indent=1))  # as another program writes it
    assert [frame.cache_key() for frame in Shot.read(file).frames] == keys
    assert finish(read_folders_in_steps(file)) == ({"Camera": ""}, False)
    for damaged in (lines[:-1], [*lines[:2], lines[2].rstrip(","), *lines[3:]], [*lines[:-1], *lines[1:]]):
        file.write_text("\n".join(damaged))
        with pytest.raises(SettingsError, match=r"shot\.json is not valid JSON"):
            Shot.read(file)
        with pytest.raises(SettingsError, match=r"shot\.json"):
            finish(read_folders_in_steps(file))


def test_a_shot_bake_equals_the_overlay(tmp_path: Path) -> None:
    from core.bake.exr import read_layers
    from core.bake.shot import bake_shot

    shot = a_shot(tmp_path, "second.intensity=2", "*.scale=1.2")
    record = bake_shot(shot, tmp_path / "layers", half=False)
    assert [entry["file"] for entry in record["frames"]] == [f"layers.000{number}.exr" for number in (1, 2, 3)]
    look, frame = read_look(shot.flare), shot.frames[2]
    edits = LookEdits.parse(frame.edits, shot.lights)
    shown = look.evaluate_lights(frame.camera.world_to_camera, frame.lights, edits)
    layers = read_layers(tmp_path / "layers" / "layers.0003.exr")
    for name, gaussians in shown.items():
        picture = draw([gaussians], frame.camera.intrinsics, *frame.camera.size)
        np.testing.assert_allclose(layers.flares[name], picture, atol=5e-5)
    assert not layers.scene.any()
    np.testing.assert_allclose(shown["second"].opacities.max(), 0.5 * look.evaluate(
        frame.camera.world_to_camera, lights={"lamp 0": frame.lights[1].xyz})["lamp 0"].opacities.max(), rtol=1e-5)


def test_every_camera_has_its_own_folder(tmp_path: Path) -> None:
    frame = a_shot(tmp_path).frames[0]
    names = ("Cam.left", "Cam left", "cam_LEFT", "Левая", "カメラ", "../escaped", "..")
    folders = Shot(tmp_path, tuple(replace(frame, name=name) for name in names)).folders
    assert list(folders.values()) == ["Cam_left", "Cam_left_2", "cam_LEFT_3", "Левая", "カメラ", "escaped", "camera"]
    assert Shot(tmp_path, (frame, frame)).folders == {frame.name: ""}


def test_earlier_frames_stay_when_others_are_baked(tmp_path: Path) -> None:
    from core.bake.shot import bake_shot

    def times() -> list[int]:
        return [(out / f"layers.000{number}.exr").stat().st_mtime_ns for number in (1, 2, 3)]

    out, shot = tmp_path / "layers", a_shot(tmp_path)
    bake_shot(shot, out, overwrite=True)
    first = times()
    record = bake_shot(replace(shot, frames=shot.frames[1:2]), out, overwrite=True)
    assert times() == first and len(record["frames"]) == 3
    changed = replace(shot.frames[1], edits=("second.intensity=2",))
    bake_shot(replace(shot, frames=(changed,)), out, overwrite=True)
    assert [now == then for now, then in zip(times(), first, strict=True)] == [True, False, True]
    bake_shot(replace(shot, frames=shot.frames[:1], live=True), out, overwrite=True)
    assert [path.name for path in out.glob("*.exr")] == ["layers.0001.exr"], "colours half applied are no sequence"


def test_annotated_flares_are_read_by_both_readers(tmp_path: Path) -> None:
    from core.look.look import write_annotated

    saved(tmp_path / "a.flare")
    write_annotated(tmp_path / "a.flare", tmp_path / "b.flare", notes="Zeiss, wide open: ö", licence="CC BY 4.0")
    look, engine = read_look(tmp_path / "b.flare"), flare_file.load(tmp_path / "b.flare")
    assert (look.notes, look.licence) == (engine.notes, engine.licence) == ("Zeiss, wide open: ö", "CC BY 4.0")
    view = cameras(3)[0].world_to_camera
    before, after_ = (read_look(tmp_path / name).evaluate(view) for name in ("a.flare", "b.flare"))
    np.testing.assert_array_equal(before["lamp 1"].means, after_["lamp 1"].means)


def test_a_shot_with_an_invalid_edit_leaves_earlier_layers(tmp_path: Path) -> None:
    from core.bake.shot import bake_shot

    bake_shot(a_shot(tmp_path), tmp_path / "layers", frame_numbers={1, 2})
    before = {path.name: path.read_bytes() for path in (tmp_path / "layers").iterdir()}
    shot = a_shot(tmp_path, "second.intensity=2")
    *good, last = shot.frames
    bad = replace(shot, frames=(*good, replace(last, edits=("lamp 0.glow=2",))))
    with pytest.raises(SettingsError, match="glow"):
        bake_shot(bad, tmp_path / "layers", overwrite=True, half=False)
    assert {path.name: path.read_bytes() for path in (tmp_path / "layers").iterdir()} == before


@pytest.mark.parametrize("blend", ["add", "over"])
def test_the_layers_of_a_shot_scale_with_intensity(blend: str, tmp_path: Path) -> None:
    """Intensity is an exact factor for any blend, as in the layers of a run."""
    from core.bake.exr import read_layers
    from core.bake.shot import bake_shot

    saved(tmp_path / "a.flare", lights=1, blend=blend)
    light = read_look(tmp_path / "a.flare").lights[0]
    layers = {}
    for words in ((), ("lamp.intensity=0.25",), ("lamp.tint=0,1,0.5",)):
        one = ShotFrame(1, "Camera", cameras(3)[1], (PlacedLight("lamp", light.name, light.xyz, 1.0),), words)
        bake_shot(Shot(tmp_path / "a.flare", (one,)), tmp_path / f"{words}", half=False)
        layers[words] = read_layers(tmp_path / f"{words}" / "layers.0001.exr").flares["lamp"]
    plain, darker, tinted = layers.values()
    assert plain.max() > 0.01
    np.testing.assert_allclose(darker, 0.25 * plain, atol=1e-6)
    np.testing.assert_allclose(tinted, plain * (0, 1, 0.5), atol=1e-6)


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of Rec. 709


def test_saturation_is_applied_before_the_tint() -> None:
    texts = ["lamp.tint=1,0.5,0.25", "lamp.saturation=0", "lamp.intensity=2"]
    matrix = LookEdits.parse(texts, ["lamp"]).colour_matrices(["lamp"])["lamp"]
    np.testing.assert_allclose(matrix @ (0.2, 0.6, 1.0), 2 * (LUMINANCE @ (0.2, 0.6, 1.0)) * np.array([1, 0.5, 0.25]),
                               rtol=1e-6)


def test_over_flares_are_desaturated_in_linear_light() -> None:
    gaussians, elements = ghosts()
    gaussians = replace(gaussians, colours=np.array([[1, 0.2, 0], [0.1, 0.9, 0.3], [0, 0, 1]], np.float32))
    grey = srgb_from_linear(linear_from_srgb(gaussians.colours) @ LUMINANCE)
    shown = apply_edits(gaussians, "lamp", LIGHT, elements, LookEdits.parse(["lamp.saturation=0"], ["lamp"]), "over")
    np.testing.assert_allclose(shown.colours, np.repeat(grey[:, None], 3, 1), atol=1e-5)


def test_a_shot_bake_uses_its_query_and_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = a_shot(tmp_path)
    prints = {shot_bakes.ShotRenderer(one).fingerprint,
              shot_bakes.ShotRenderer(replace(one, query="trained")).fingerprint}
    for mark in "ab":
        run = SimpleNamespace(fingerprint=mark, flare=None)
        monkeypatch.setattr(shot_bakes.Run, "open", lambda _folder, run=run, **_options: run)
        prints.add(shot_bakes.ShotRenderer(replace(one, run=tmp_path)).fingerprint)
    assert len(prints) == 4


def test_the_source_query_lies_within_the_trained_range(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    light = read_look(tmp_path / "a.flare").lights[0]
    far = ViewOfLight(np.zeros(3, np.float32), np.eye(3, dtype=np.float32), np.array([3, 4], np.float32), 1.0)
    found, reach = network_query(light, far, "source").light, light.query_range.light_high
    assert np.linalg.norm(found) <= reach[2] + 1e-5
    assert (np.abs(found) <= reach[:2] + 1e-5).all()


def test_a_flare_stores_edits_of_its_lights(tmp_path: Path) -> None:
    from core.look.look import write_annotated

    saved(tmp_path / "a.flare")
    plain = read_look(tmp_path / "a.flare")
    first, second = plain.names
    part = plain.lights[0].elements[0].name
    edits = LookEdits.parse(["*.intensity=2", f"{first}.rotation=30", f"{second}.mute=1", f"{first}/{part}.scale=1.5"],
                            plain.names, plain.element_names)
    write_annotated(tmp_path / "a.flare", tmp_path / "b.flare", notes="", licence="", edits=edits)
    look = read_look(tmp_path / "b.flare")
    assert plain.edits.is_neutral
    assert sorted(look.edits.texts()) == sorted(edits.texts())
    placed = look.edits.for_placed_lights({"key": first, "rim": first, "moon": second})
    assert placed.lights["key"] == placed.lights["rim"] == edits.lights[first]
    assert placed.lights["moon"].mute and placed.elements["rim", part].scale == 1.5 and placed.master == edits.master
    tensors, metadata = read_tensors(tmp_path / "b.flare")
    for wrong in ('["nobody.intensity=2"]', "[1]", '"text"'):
        stored = json.loads(metadata["fit_flare"]) | {"edits": json.loads(wrong)}
        rewrite_metadata(tmp_path / "b.flare", tmp_path / "c.flare", {"fit_flare": json.dumps(stored)})
        with pytest.raises(FlareFileError, match="damaged"):
            _ = read_look(tmp_path / "c.flare").edits
    assert len(tensors) > 2
