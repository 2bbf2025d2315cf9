# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes of other tools: gsplat's export and reference, and compressed PLY."""
from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from core.capture import Camera
from core.errors import FlareFileError
from core.gaussians import SceneGaussians
from core.gaussians.ply import read_ply


def scene(n: int = 400, seed: int = 0) -> SceneGaussians:
    """Return a random cloud of Gaussians, with spherical harmonics, before the camera of `camera`."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    sh = torch.cat([normal(n, 1, 3), 0.15 * normal(n, 15, 3)], 1)
    return SceneGaussians(normal(n, 3), 0.4 * normal(n, 3) - 2.2, normal(n, 4), normal(n), sh)


def camera() -> Camera:
    pose = np.eye(4)
    pose[2, 3] = 5.0
    return Camera(96, 64, 90.0, 88.0, 47.0, 33.0, pose)


def packed(shares: torch.Tensor, *bits: int) -> torch.Tensor:
    """Shares 0..1 (n, k) as fields of these widths in one number each, the first the highest."""
    number = torch.zeros(len(shares), dtype=torch.int64)
    for column, width in enumerate(bits):
        number = (number << width) | (shares[:, column].double() * ((1 << width) - 1)).round().long()
    return number


def write_compressed(path: Path, scene: SceneGaussians) -> None:
    """Write a scene in PlayCanvas's compressed PLY, from that format's description.

    Each chunk of 256 Gaussians stores the ranges of its values; positions, scales and colours are packed as shares of
    these, rotations as the three smaller components, further harmonics as bytes.
    """
    parts = {name: part.detach() for name, part in scene.named_parameters()}
    colours = parts["sh"][:, 0] * 0.28209479177387814 + 0.5
    ranges, rows = [], []
    for start in range(0, len(scene), 256):
        here = slice(start, start + 256)
        row, shares = [], []
        for values in (parts["means"][here], parts["log_scales"][here], colours[here]):
            low, high = values.amin(0), values.amax(0)
            row += [low, high]
            shares.append((values - low) / (high - low))
        ranges.append(torch.cat(row))
        q = torch.nn.functional.normalize(parts["quaternions"][here])
        largest = q.abs().argmax(1)
        q = q * q.gather(1, largest[:, None]).sign()
        others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
        rotation = packed(q.gather(1, others) / 2**0.5 + 0.5, 10, 10, 10) | (largest << 30)
        rgba = torch.cat([shares[2], parts["opacity_logits"][here].sigmoid()[:, None]], 1)
        rows.append(torch.stack([packed(shares[0], 11, 10, 11), rotation, packed(shares[1], 11, 10, 11),
                                 packed(rgba, 8, 8, 8, 8)], 1))
    rest = parts["sh"][:, 1:].transpose(1, 2).reshape(len(scene), -1)
    names = [f"{end}_{what}{axis}" for what, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
             for end in ("min", "max") for axis in axes]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(ranges)}",
             *(f"property float {name}" for name in names), f"element vertex {len(scene)}",
             *(f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")),
             f"element sh {len(scene)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1])),
             "end_header", ""]
    body = (torch.stack(ranges).numpy().astype("<f4").tobytes() + torch.cat(rows).numpy().astype("<u4").tobytes()
            + ((rest / 8 + 0.5) * 256).clamp(0, 255).numpy().astype(np.uint8).tobytes())
    path.write_bytes("\n".join(lines).encode() + body)


def test_a_compressed_ply_is_read(tmp_path: Path) -> None:
    """Quantised, so alike and not the same: each within a step of its chunk's range."""
    first = scene()
    write_compressed(tmp_path / "a.compressed.ply", first)
    again = read_ply(tmp_path / "a.compressed.ply")
    assert len(again) == len(first)
    for name, step in (("means", 8 / 1023), ("log_scales", 3 / 1023), ("sh", 8 / 255)):
        assert (again.get_parameter(name) - first.get_parameter(name)).abs().max() < step, name
    unit = torch.nn.functional.normalize(first.quaternions)
    assert ((unit * again.quaternions).sum(1).abs() > 1 - 1e-5).all()
    assert (again.opacities - first.opacities).abs().max() < 1 / 255
    a, b = first.render(camera()).colour, again.render(camera()).colour
    assert (a - b).abs().mean() < 0.01


@pytest.mark.parametrize("kept", [2000, 300])
def test_a_damaged_compressed_ply_raises(tmp_path: Path, kept: int) -> None:
    write_compressed(tmp_path / "a.ply", scene(40))
    (tmp_path / "cut.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:kept])
    with pytest.raises(FlareFileError, match=r"cut\.ply is"):
        read_ply(tmp_path / "cut.ply")


@pytest.mark.parametrize("head", ["element vertex 1\nproperty uint packed_position\n",
                                  "property uint packed_position\n",
                                  f"element chunk {'9' * 20}\nproperty float min_x\n"
                                  "element vertex 1\nproperty uint packed_position\n"])
def test_a_compressed_ply_with_an_invalid_header_raises(tmp_path: Path, head: str) -> None:
    text = f"ply\nformat binary_little_endian 1.0\n{head}end_header\n"
    (tmp_path / "odd.ply").write_bytes(text.encode() + bytes(99))
    with pytest.raises(FlareFileError, match=r"odd\.ply is a damaged compressed PLY"):
        read_ply(tmp_path / "odd.ply")


def gsplat_parts() -> tuple[Any, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it tells that there is no CUDA here
        pytest.importorskip("gsplat", reason="the package gsplat is not installed")
        import gsplat.cuda._torch_impl as reference
        import gsplat.exporter as exporter
    return exporter, reference


def test_an_export_of_gsplat_loads_exactly_and_renders_as_its_reference(tmp_path: Path) -> None:
    """Projection and spherical harmonics by gsplat's torch reference; its compositing written out, since
    that part of the reference wants CUDA: alpha at most 0.999, left out below 1/255, front to back."""
    exporter, reference = gsplat_parts()
    first = scene()
    parts = {name: part.detach() for name, part in first.named_parameters()}
    exporter.export_splats(parts["means"], parts["log_scales"], parts["quaternions"], parts["opacity_logits"],
                           parts["sh"][:, :1], parts["sh"][:, 1:], save_to=str(tmp_path / "gsplat.ply"))
    again = read_ply(tmp_path / "gsplat.ply")
    for name, part in parts.items():
        assert torch.equal(part, again.get_parameter(name).detach()), name
    exporter.export_splats(*(part.clone() for part in (
        parts["means"], parts["log_scales"], parts["quaternions"], parts["opacity_logits"], parts["sh"][:, :1],
        parts["sh"][:, 1:])), format="ply_compressed", save_to=str(tmp_path / "small.ply"))
    small = read_ply(tmp_path / "small.ply").render(camera()).colour  # it leaves out what is fainter than 1/255
    assert (small - again.render(camera()).colour).abs().mean() < 0.01

    here = camera()
    pose = torch.from_numpy(here.world_to_camera).float()
    with torch.no_grad():
        covariances, _ = reference._quat_scale_to_covar_preci(parts["quaternions"], first.scales, True, False)
        radii, centres, depths, conics, _ = reference._fully_fused_projection(
            parts["means"], covariances, pose[None], torch.from_numpy(here.intrinsics).float()[None], here.width,
            here.height, eps2d=0.3)
        rays = parts["means"] - torch.from_numpy(here.position).float()
        colours = (reference._spherical_harmonics(3, rays, parts["sh"]) + 0.5).clamp_min(0)
        rows, columns = torch.meshgrid(torch.arange(here.height) + 0.5, torch.arange(here.width) + 0.5, indexing="ij")
        order = depths[0].argsort()
        order = order[radii[0, order].all(-1)]
        x, y = (grid - centres[0, order, axis, None, None] for axis, grid in enumerate((columns, rows)))
        a, b, c = conics[0, order].T[..., None, None]
        alpha = first.opacities[order, None, None] * torch.exp(-0.5 * (a * x * x + c * y * y) - b * x * y)
        alpha = torch.where(alpha < 1 / 255, 0, alpha.clamp_max(0.999))
        before = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha).cumprod(0)[:-1]])
        picture = torch.einsum("nhw,nc->hwc", alpha * before, colours[order])
        ours = again.render(here).colour
    # Entries at alpha = 1/255 flip between implementations; each is worth less than 1/255 of its colour.
    assert (ours - picture).abs().max() < 0.02
    assert (ours - picture).abs().mean() < 2e-4
