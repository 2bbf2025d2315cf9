# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare model: placement, encodings, compositing, density, and the .flare file."""
from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from core.capture import Camera
from core.colour.srgb_torch import decode, encode
from core.conventions.pixel_grid import PixelGrid
from core.errors import FlareFileError
from core.flare import file as flare_file
from core.flare import placement
from core.flare.compositing import composite, concatenate, linear_layers, splat_flare
from core.flare.deformation import QueryRange
from core.flare.density import DensitySettings, clone_and_prune
from core.flare.encoding import HashGrid, frequency_encoding
from core.flare.file import FlareFile
from core.flare.model import OURS, PAPER, FlareModel, LightFlare, ViewOfLight, _RaiseToFloor, plane_scale
from core.gaussians import Splats, rasterization
from core.gaussians.optimiser import Adam
from core.gaussians.rendering import arc_strengths
from core.look import TrainedCamera
from core.look.form import FlareForm
from core.look.plane import PLANE_DEPTH
from tests.core.flared import cameras

RANGE = QueryRange((-1.0, -1.0, -5.0), (1.0, 1.0, -3.0), (0.5, 0.5, 0.7))


def random_(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def some_flare(form: FlareForm = PAPER, count: int = 40, lights: int = 1, seed: int = 0) -> FlareModel:
    """Return an untrained flare whose weights are changed at random, so that every deformation does something."""
    generator = random_(seed)
    with torch.random.fork_rng():  # the networks draw their weights from torch's global generator
        torch.manual_seed(seed)
        flares = [LightFlare(form, RANGE, count, generator) for _ in range(lights)]
    model = FlareModel([f"lamp {i}" for i in range(lights)],
                       torch.tensor([[0.3 * i - 0.2, -0.4, 1.0] for i in range(lights)]), flares)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            strength = 0.01 if "table" in name else 0.05
            parameter += strength * torch.randn(parameter.shape, generator=generator)
    return model


def pose(number: int = 0) -> Tensor:
    return torch.from_numpy(cameras(3)[number].world_to_camera)


# ---- beginning ------------------------------------------------------------------------------------


def test_initial_rings_have_all_sizes_and_are_thin() -> None:
    """Ghosts may be half as wide as the frame, and a fit finds a ring only from an initial ring of nearly its size."""
    flare = LightFlare(OURS, RANGE, 400, random_(2)).gaussians
    scales, r0 = flare["log_scales"].detach()[:, 0].exp(), flare["rings"].detach()[:, 0]
    radii = (scales * r0)[r0 > 0].sort().values
    assert radii[0] < 0.04 and radii[-1] > 0.45
    assert (radii[1:] / radii[:-1]).max() < 1.3
    assert scales.max() <= 0.061


def test_a_flare_of_a_long_lens_starts_within_its_frame() -> None:
    flare = LightFlare(OURS, RANGE, 400, random_(2), scale=plane_scale(0.03))
    assert flare.gaussians["log_scales"].detach().exp().max() <= 0.06 * 0.03 / 0.36 + 1e-6
    assert plane_scale(0.36) == plane_scale(2.0) == 1.0


def test_a_saved_flare_of_a_long_lens_is_the_fitted_one(tmp_path: Path) -> None:
    model = some_flare(replace(OURS, light_correction=True))
    model.lights[0].scale = 0.1
    expected = model(pose())["lamp 0"].means
    flare_file.save(tmp_path / "a.flare", FlareFile(model, "add", CAMERA))
    read = flare_file.load(tmp_path / "a.flare").model
    assert read.lights[0].scale == 1
    torch.testing.assert_close(read(pose())["lamp 0"].means, expected)
    model.lights[0].scale = 1.0
    assert (model(pose())["lamp 0"].means - expected).abs().max() > 1e-3


def test_a_light_that_passes_the_cameras_plane_leaves_the_grid_to_the_frame() -> None:
    """A turn of the camera takes it to a hundred frames aside; one that never is in the frame still has a range."""
    eyes, aside = torch.zeros(3, 3), torch.tensor([[0.1, -0.2], [0.3, 0.1], [-90.0, 4.0]])
    assert max(QueryRange.of(eyes, aside, reach=0.4).light_high) < 0.7
    assert QueryRange.of(eyes[:2], aside[:2], reach=0.4) == QueryRange.of(eyes[:2], aside[:2])
    assert max(QueryRange.of(eyes, aside + 2, reach=0.4).light_high) > 2.8


# ---- placement ------------------------------------------------------------------------------------


def test_the_line_runs_from_principal_point_to_light() -> None:
    light = torch.tensor([0.3, -0.2])
    assert torch.equal(placement.on_line(torch.tensor([[0.0], [1.0], [-2.0]]), light),
                       torch.tensor([[0.0, 0.0], [0.3, -0.2], [-0.6, 0.4]]))


def test_solid_gaussians_project_as_the_rasterizer_projects_them() -> None:
    """The flare emitted as 3D Gaussians at depth 0.21 gives the picture that splatting on the plane gives."""
    generator, n = random_(1), 6
    intrinsics = torch.tensor([[60.0, 0, 20.5], [0, 66.0, 17.5], [0, 0, 1]])
    means = 0.15 * torch.randn(n, 2, generator=generator)
    log_scales = math.log(0.01) + 0.4 * torch.randn(n, 3, generator=generator)
    quaternions = torch.randn(n, 4, generator=generator)
    opacities = torch.rand(n, generator=generator) * 0.5 + 0.2
    colours = torch.rand(n, 3, generator=generator)
    flat = placement.PlaneGaussians(means, placement.project_covariances(means, log_scales, quaternions),
                                    opacities, colours)
    splats = splat_flare(flat, intrinsics, 40, 36, "over", kernels="torch")
    solid = torch.cat([means, torch.ones(n, 1)], 1) * PLANE_DEPTH
    sh = ((colours - 0.5) / 0.28209479177387814)[:, None]
    # All lie at one depth: nudged apart so that the order of the list is the order of depth.
    solid[:, 2] += torch.arange(n) * 1e-6
    picture = rasterization(solid, quaternions, log_scales.exp(), opacities, sh, torch.eye(4), intrinsics, 40, 36,
                            kernels="torch")
    assert torch.allclose(splats.colour, picture.colour, atol=2e-4)
    assert torch.allclose(1 - splats.transmittance, picture.alpha, atol=2e-4)


def test_an_ellipse_has_its_axes() -> None:
    scales = torch.tensor([[0.2, 0.1]]).log()
    for angle in (0.0, 0.7, 2.0):
        axis = torch.tensor([[3 * math.cos(angle), 3 * math.sin(angle)]])
        xx, xy, yy = placement.covariance_of_ellipse(scales, axis)[0]
        values, vectors = torch.linalg.eigh(torch.tensor([[xx, xy], [xy, yy]]))
        assert torch.allclose(values.sqrt(), torch.tensor([0.1, 0.2]), atol=1e-6)
        assert abs(float(vectors[:, 1] @ axis[0])) == pytest.approx(3.0, abs=1e-4)


def test_resolution_and_focal_length_move_the_flare_as_a_lens_would() -> None:
    gaussians = next(iter(some_flare(replace(OURS, arcs=True))(pose()).values()))
    small, large = (torch.tensor([[f, 0, f / 3], [0, f, f / 4], [0, 0, 1.0]]) for f in (100.0, 200.0))
    centres, covariances = placement.to_pixels(gaussians, small, PixelGrid(100.0, 100.0))
    twice, wide = placement.to_pixels(gaussians, large, PixelGrid(100.0, 100.0))
    assert torch.allclose(twice, 2 * centres, atol=1e-4)
    assert torch.allclose(wide, 4 * covariances, rtol=1e-5)
    slopes = [placement.arcs_to_pixels(gaussians.arcs, found, k) for found, k in ((covariances, small), (wide, large))]
    assert slopes[0].abs().max() > 0.01 and torch.allclose(2 * slopes[1], slopes[0], rtol=1e-4, atol=1e-5)


def test_an_arc_scales_and_turns_with_its_gaussian() -> None:
    """|a| is the strength at every size and angle, and the bright side turns with the axes."""
    a, k = torch.tensor([[0.9, -1.2]]), torch.eye(3)
    found = []
    for size, angle in ((1.0, 0.0), (5.0, 0.0), (1.0, 2.0)):
        log_scales = (size * torch.tensor([[0.3, 0.1]])).log()
        axis = torch.tensor([[math.cos(angle), math.sin(angle)]])
        covariance = placement.covariance_of_ellipse(log_scales, axis)
        way = placement.arcs_of_ellipse(a, log_scales, axis)
        strengths = arc_strengths(covariance, placement.arcs_to_pixels(way, covariance, k))
        assert strengths.item() == pytest.approx(1.5, rel=1e-4)
        found.append(way[0])
    assert torch.allclose(found[1], 5 * found[0])
    c, s = math.cos(2.0), math.sin(2.0)
    assert torch.allclose(found[2], torch.tensor([[c, -s], [s, c]]) @ found[0])


def test_the_low_pass_keeps_the_shift_of_an_arc() -> None:
    """What the low-pass blurs moves no less far: the plain Gaussian of the shifted mean is the same picture."""
    means, covariances = torch.tensor([[0.01, 0.02]]), torch.tensor([[2e-4, 5e-5, 1e-4]])
    way = torch.tensor([[0.015, -0.01]])
    k = torch.tensor([[60.0, 0, 16], [0, 66.0, 12], [0, 0, 1]])
    rest = covariances, torch.full((1,), 0.5), torch.ones(1, 3)
    arc = placement.PlaneGaussians(means, *rest, torch.tensor([[0.0, 1.0]]), way)
    pictures = [splat_flare(one, k, 32, 24, "add", kernels="torch").colour
                for one in (arc, placement.PlaneGaussians(means + way, *rest))]
    assert torch.allclose(*pictures, atol=1e-5)


def test_opacities_are_smooth_where_an_arc_begins() -> None:
    """The picture's sum has no kink at arc strength zero, as it would if the peak were kept at one."""
    covariance, rings = torch.tensor([[2e-3, 0.0, 2e-3]]), torch.tensor([[3.0, 0.4]])
    k = torch.tensor([[100.0, 0, 20], [0, 100.0, 20], [0, 0, 1]])

    def total(strength: float) -> float:
        a = torch.tensor([[strength, 0.0]])
        gain = placement.opacity_gain(a, rings)
        way = placement.arcs_of_ellipse(a, 0.5 * covariance[:, :1].log().repeat(1, 2), torch.tensor([[1.0, 0.0]]))
        one = placement.PlaneGaussians(torch.zeros(1, 2), covariance, 0.1 * gain, torch.ones(1, 3), rings, way)
        return float(splat_flare(one, k, 40, 40, "add", kernels="torch").colour.sum())

    none = total(0.0)
    assert total(1e-3) == pytest.approx(none, rel=1e-3)  # 3e-3 of it if the peak were kept
    assert float(placement.opacity_gain(torch.tensor([[2.0, 0.0]]), rings)) == pytest.approx(1, abs=0.01)


def test_sets_with_and_without_arcs_are_joined() -> None:
    model = some_flare(replace(OURS, arcs=True), lights=2)
    first, second = model(pose()).values()
    plain = second._replace(arcs=None)
    whole = concatenate({"a": first, "b": plain})
    assert whole is not None and torch.equal(whole.arcs[:40], first.arcs) and not whole.arcs[40:].any()
    assert concatenate({"b": plain}).arcs is None


# ---- lights ---------------------------------------------------------------------------------------


def test_a_light_behind_the_camera_has_no_flare() -> None:
    model = some_flare(lights=2)
    model.positions[1] = torch.tensor([0.0, 0.0, -9.0])
    assert list(model(pose())) == ["lamp 0"]
    with pytest.raises(ValueError, match="behind"):
        model.lights[1](ViewOfLight.of(pose(), model.positions[1]))


@pytest.mark.parametrize("form", [PAPER, OURS, replace(PAPER, line=False), replace(PAPER, light_correction=False),
                                  replace(PAPER, plane_offset=False), replace(OURS, latent=0, rings=False),
                                  replace(OURS, arcs=True)])
def test_every_form_gives_finite_gaussians_and_gradients(form: FlareForm) -> None:
    model = some_flare(form)
    gaussians = model(pose())["lamp 0"]
    assert gaussians.means.shape == (40, 2)
    assert gaussians.covariances.shape == (40, 3)
    assert gaussians.colours.shape == (40, 3) and (gaussians.colours >= 0).all()
    assert ((gaussians.opacities > 0) & (gaussians.opacities < 1)).all()
    assert (gaussians.rings is not None) == form.rings
    assert (gaussians.arcs is not None) == form.arcs
    sum((part**2).sum() for part in gaussians if part is not None).backward()
    for name, parameter in model.named_parameters():
        unused = "correction" in name and not (form.light_correction and form.line)
        gradient = parameter.grad
        assert (gradient is None) == unused, name
        if gradient is not None:
            assert gradient.coalesce().values().isfinite().all() if gradient.is_sparse else gradient.isfinite().all()


def test_off_screen_lights_are_handled_like_others() -> None:
    view = ViewOfLight.of(pose(), torch.tensor([30.0, 0.0, 0.0]))
    assert view.depth > 0 and view.light[0] > 2  # 63 degrees off the axis
    gaussians = some_flare().lights[0](view)
    assert all(part.isfinite().all() for part in gaussians if part is not None)


# ---- encodings ------------------------------------------------------------------------------------


def test_a_lookup_touches_eight_rows_a_level() -> None:
    grid = HashGrid(17, 1.8)
    with torch.no_grad():
        grid.table.weight.uniform_(-1, 1, generator=random_(0))
    grid(torch.tensor([0.3, 0.6, 0.9])).sum().backward()
    gradient = grid.table.weight.grad
    assert gradient is not None and gradient.is_sparse
    rows = gradient.coalesce().indices()[0]
    assert len(rows) <= 16 * 8
    assert len(gradient.coalesce().values()) == len(rows) >= 16 * 7


def test_the_grid_is_continuous_across_cells_and_clamped() -> None:
    grid = HashGrid(8, 1.6, levels=6)
    with torch.no_grad():
        grid.table.weight.uniform_(-1, 1, generator=random_(0))
    border = 5 / 16
    left, right = (grid(torch.tensor([border + step, 0.21, 0.4])) for step in (-1e-6, 1e-6))
    assert torch.allclose(left, right, atol=1e-3)
    assert torch.equal(grid(torch.tensor([1.5, -2.0, 0.5])), grid(torch.tensor([1.0, 0.0, 0.5])))


def test_the_coarsest_level_interpolates_its_corners() -> None:
    grid = HashGrid(17, 1.8, levels=1)
    with torch.no_grad():  # a table that holds x itself must give x back
        side = torch.arange(17, dtype=torch.float32) / 16
        grid.table.weight[:, 0] = side.repeat(17 * 17)
        grid.table.weight[:, 1] = side.repeat_interleave(17 * 17)
    out = grid(torch.tensor([0.337, 0.5, 0.912]))
    assert torch.allclose(out, torch.tensor([0.337, 0.912]), atol=1e-6)


def test_frequency_encoding_has_three_bands() -> None:
    out = frequency_encoding(torch.tensor([[0.25]]), 3)[0]
    angles = torch.tensor([0.25, 0.5, 1.0]) * math.pi
    assert torch.allclose(out, torch.cat([angles.sin(), angles.cos()]), atol=1e-6)


# ---- compositing ----------------------------------------------------------------------------------


def test_flare_over_scene_equals_one_joint_rasterisation() -> None:
    """C_flare + T_flare C_scene is what 3DGS gives for both sets together."""
    generator, n = random_(3), 5
    intrinsics = torch.tensor([[50.0, 0, 16], [0, 50.0, 12], [0, 0, 1]])

    def gaussians(depth: float, scale: float) -> tuple[Tensor, ...]:
        z = depth + 0.001 * torch.arange(n)
        xy = 0.2 * torch.randn(n, 2, generator=generator) * z[:, None]
        return (torch.cat([xy, z[:, None]], 1), torch.randn(n, 4, generator=generator), torch.full((n, 3), scale),
                0.2 + 0.3 * torch.rand(n, generator=generator), torch.randn(n, 1, 3, generator=generator))

    scene, flare = gaussians(3.0, 0.4), gaussians(0.21, 0.02)

    def picture(*parts: Tensor) -> Any:
        return rasterization(*parts, torch.eye(4), intrinsics, 32, 24, kernels="torch")

    together = picture(*(torch.cat(pair) for pair in zip(scene, flare, strict=True)))
    before = picture(*flare)
    apart = composite(picture(*scene).colour, Splats(before.colour, 1 - before.alpha), "over")
    assert torch.allclose(apart, together.colour, atol=1e-6)


def test_encode_and_decode_are_inverse() -> None:
    values = torch.linspace(0, 4, 500)
    assert torch.allclose(encode(decode(values)), values, atol=1e-5)


def test_added_light_is_clipped_with_a_straight_through_gradient() -> None:
    scene = torch.full((2, 2, 3), 0.9)
    light = torch.full((2, 2, 3), 0.6, requires_grad=True)
    picture = composite(scene, Splats(light, torch.ones(2, 2)), "add")
    assert (picture == 1).all()
    picture.sum().backward()
    assert light.grad is not None and (light.grad > 0).all()


@pytest.mark.parametrize("blend", ["over", "add"])
def test_layers_add_up_in_linear_light(blend: Any) -> None:
    model = some_flare(OURS if blend == "add" else PAPER, lights=3)
    camera = cameras(3)[1]
    intrinsics = torch.from_numpy(camera.intrinsics).float()
    with torch.no_grad():
        parts = model(torch.from_numpy(camera.world_to_camera))
        splats = {name: splat_flare(one, intrinsics, camera.width, camera.height, blend, kernels="torch")
                  for name, one in parts.items()}
        scene = torch.rand(camera.height, camera.width, 3, generator=random_(0))
        out = linear_layers(scene, splats, blend)
        whole = concatenate(parts)
        assert whole is not None
        direct = composite(scene, splat_flare(whole, intrinsics, camera.width, camera.height, blend, kernels="torch"),
                           blend)
    assert list(out.flares) == ["lamp 0", "lamp 1", "lamp 2"]
    assert torch.allclose(sum(out.flares.values()), out.flare, atol=1e-5)  # type: ignore[arg-type]
    assert torch.allclose(out.scene + out.flare, out.composite, atol=1e-6)
    assert torch.allclose(encode(out.composite.clamp_min(0)).clamp(0, 1), direct.clamp(0, 1), atol=1e-3)


# ---- density --------------------------------------------------------------------------------------


def test_cloning_and_pruning_follow_opacity() -> None:
    light = some_flare(count=1000).lights[0]
    with torch.no_grad():
        light.gaussians["opacity_logits"][:] = torch.logit(torch.tensor(0.3))
        light.gaussians["opacity_logits"][:100] = torch.logit(torch.tensor(0.001))  # to be pruned
        light.gaussians["opacity_logits"][100:200] = torch.logit(torch.tensor(0.004))  # kept, never cloned
    optimiser = Adam(dict(light.gaussians.items()), 1e-3)
    for parameter in light.gaussians.values():
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()
    before = light.gaussians["positions"].detach().clone()
    names = {name: name for name in light.gaussians}
    clone_and_prune(light, optimiser, names, DensitySettings(), random_(0))
    clones = light.count - 900
    assert 120 < clones < 200  # a fifth of 800, drawn
    assert torch.equal(light.gaussians["positions"][:900], before[100:])
    moved = light.gaussians["positions"][900:].detach()
    nearest = (moved - before[200:].T).abs().amin(1)
    assert 0 < float(nearest.max()) < 0.1
    assert (optimiser.moments["positions"].first[900:] == 0).all()
    assert (optimiser.moments["positions"].first[:900] != 0).all()
    clone_and_prune(light, optimiser, names, DensitySettings(max_gaussians=light.count + 3), random_(0))
    assert light.count == 900 + clones + 3


# ---- the file -------------------------------------------------------------------------------------

CAMERA = TrainedCamera(64, 40, 70.0, 70.0, 33.0, 19.5)


@pytest.mark.parametrize("form", [PAPER, OURS, replace(PAPER, line=False)])
def test_a_saved_flare_loads_bit_for_bit(tmp_path: Path, form: FlareForm) -> None:
    model = some_flare(replace(form, levels=5), lights=2)
    model.clear.copy_(torch.tensor([0.25, 1.0]))
    path = tmp_path / "look.flare"
    flare_file.save(path, FlareFile(model, "add", CAMERA, "CC0", "warm evening", [{"name": "ghost 1"}]))
    back = flare_file.load(path)
    assert (back.blend, back.camera, back.licence, back.notes) == ("add", CAMERA, "CC0", "warm evening")
    assert back.elements == [{"name": "ghost 1"}]
    assert back.model.names == model.names
    for (name, a), (other, b) in zip(model.state_dict().items(), back.model.state_dict().items(), strict=True):
        assert name == other and torch.equal(a, b), name
    for a, b in zip(model(pose())["lamp 1"], back.model(pose())["lamp 1"], strict=True):
        assert a is b is None or torch.equal(a, b)


def test_a_hidden_light_gives_no_gradient_to_its_flare() -> None:
    model = some_flare(PAPER, lights=1)
    for value, taught in ((0.1, False), (0.9, True)):
        share = torch.tensor(value, requires_grad=True)
        shown = model(pose(), {"lamp 0": share})["lamp 0"]
        torch.testing.assert_close(shown.opacities, model(pose())["lamp 0"].opacities * value)
        assert shown.means.requires_grad == taught
        shown.opacities.sum().backward()
        assert share.grad is not None and share.grad > 0
        assert (model.lights[0].gaussians["opacity_logits"].grad is not None) == taught


def _described(path: Path, **changes: Any) -> None:
    """Write the file again with its description changed."""
    from safetensors import safe_open

    with safe_open(str(path), "pt") as file:
        description = json.loads(file.metadata()["fit_flare"])
    description.update(changes)
    save_file(load_file(str(path)), str(path), {"fit_flare": json.dumps(description)})


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "look.flare"
    flare_file.save(path, FlareFile(some_flare(replace(PAPER, levels=2)), "over", CAMERA))
    return path


def test_damaged_flares_are_refused_by_name(saved: Path) -> None:
    whole = saved.read_bytes()
    contents = {"empty": b"", "half": whole[: len(whole) // 2], "pickle": b"\x80\x04\x95" + bytes(50),
                "header": (2**62).to_bytes(8, "little") + whole[8:]}
    for what, data in contents.items():
        saved.write_bytes(data)
        with pytest.raises(FlareFileError, match=r"look\.flare"):
            flare_file.load(saved)
        assert what
    saved.unlink()
    with pytest.raises(FlareFileError, match="missing"):
        flare_file.load(saved)


@pytest.mark.parametrize("changes", [
    {"version": 99}, {"version": "1"}, {"blend": "multiply"}, {"lights": [{}]}, {"lights": 3}, {"camera": {}},
    {"camera": {"width": 0, "height": 40, "fx": 64, "fy": 64, "cx": 32, "cy": 20}},
    {"camera": {"width": 64, "height": 40, "fx": 0, "fy": 64, "cx": 32, "cy": 20}},
    {"lights": [{"name": "a", "xyz": [0, 0, float("inf")], "form": {}, "range": {}, "count": 1}]},
    {"lights": [{"name": "a", "xyz": [0, 0, 1], "form": {}, "range": {}, "count": 10**12}]},
])
def test_a_description_that_does_not_fit_is_refused(saved: Path, changes: dict[str, Any]) -> None:
    _described(saved, **changes)
    with pytest.raises(FlareFileError, match=r"look\.flare"):
        flare_file.load(saved)


def test_other_safetensors_and_nan_are_refused(saved: Path) -> None:
    tensors = load_file(str(saved))
    name = next(key for key in tensors if key.endswith("opacity_logits"))
    from safetensors import safe_open

    with safe_open(str(saved), "pt") as file:
        metadata = dict(file.metadata())
    save_file(tensors, str(saved))
    with pytest.raises(FlareFileError, match="not a flare"):
        flare_file.load(saved)
    tensors[name][0] = float("nan")
    save_file(tensors, str(saved), metadata)
    with pytest.raises(FlareFileError, match="finite"):
        flare_file.load(saved)


def test_cameras_of_the_tests_look_at_the_light() -> None:
    assert all(isinstance(camera, Camera) for camera in cameras(2))
    assert all(ViewOfLight.of(pose(i), torch.tensor([0.3, -0.6, 1.5])).depth > 0 for i in range(3))


@pytest.mark.parametrize("taught", [True, False])
def test_light_is_added_with_the_gradients_of_its_definition(taught: bool) -> None:
    """Within 0..1 those of autograd; where the picture is clipped, those of the curves without the clip."""
    generator = torch.Generator().manual_seed(0)
    scene = (torch.rand(6, 8, 3, generator=generator, dtype=torch.float64) ** 3 * 1.2 - 0.1).requires_grad_(taught)
    light = (torch.rand(6, 8, 3, generator=generator, dtype=torch.float64) ** 6).requires_grad_()
    wanted = torch.randn(6, 8, 3, generator=generator, dtype=torch.float64)
    inputs = (scene, light) if taught else (light,)
    picture = composite(scene, Splats(light, torch.ones(6, 8)), "add")
    plain = encode(decode(scene.clamp(0, 1)) + light)
    assert (plain > 1).any() and (scene < 0).any() and (scene > 1).any()
    torch.testing.assert_close(picture, plain.clamp(0, 1))
    found = torch.autograd.grad(picture, inputs, wanted)
    inner = scene.detach().clamp(0, 1).requires_grad_()
    expected = torch.autograd.grad(encode(decode(inner) + light), (inner, light) if taught else (light,), wanted)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)


# ---- floor of the opacity -------------------------------------------------------------------------


def test_a_floor_changes_only_fainter_gaussians() -> None:
    model = some_flare(OURS)
    (view,) = model.views(pose())
    plain, raised = model.lights[0](view).opacities, model.lights[0](view, 0.05).opacities
    assert (plain < 0.05).any() and (plain > 0.05).any()
    assert torch.equal(raised, plain.clamp(min=0.05))


@pytest.mark.parametrize(("opacity", "gradient", "expected"), [
    (0.001, -1.0, -1.0), (0.001, 1.0, 0.0), (0.2, -1.0, -1.0), (0.2, 1.0, 1.0)])
def test_a_gradient_raises_what_is_below_the_floor_but_does_not_lower_it(opacity: float, gradient: float,
                                                                         expected: float) -> None:
    opacities = torch.full((3,), opacity, requires_grad=True)
    _RaiseToFloor.apply(opacities, 0.01).backward(torch.full((3,), gradient))
    assert opacities.grad is not None and opacities.grad.tolist() == [expected] * 3
