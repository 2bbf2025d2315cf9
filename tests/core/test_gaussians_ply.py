# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes as PLY files: exact round trips, foreign files, and errors."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from core.errors import FlareFileError
from core.gaussians import SceneGaussians
from core.gaussians.ply import read_ply, write_ply
from core.gaussians.rendering import NEAR


def scene(n: int = 7) -> SceneGaussians:
    generator = torch.Generator().manual_seed(0)
    shapes = (((n, 3), 1e3), ((n, 3), 1.0), ((n, 4), 1e-3), ((n,), 1e6), ((n, 16, 3), 1.0))
    values = [torch.randn(shape, generator=generator) * size for shape, size in shapes]
    return SceneGaussians(*values)


def header(text: str, n: int, rest: int = 45, form: str = "binary_little_endian") -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)] + ["opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    return ["ply", f"format {form} 1.0", *([text] if text else []), f"element vertex {n}",
            *(f"property float {name}" for name in names), "end_header"]  # fmt: skip


@pytest.mark.parametrize("n", [0, 1, 7])
def test_a_scene_is_restored_exactly(tmp_path: Path, n: int) -> None:
    first = scene(n)
    write_ply(tmp_path / "a.ply", first)
    again = read_ply(tmp_path / "a.ply")
    for name, parameter in first.named_parameters():
        assert torch.equal(parameter, again.get_parameter(name)), name
    write_ply(tmp_path / "b.ply", again)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize(("kept", "number", "said", "read"), [
    *(("near", 0.0125, said, read) for said, read in (
        ("comment near 0.03", 0.03), ("comment near 5", NEAR), ("comment near nan", NEAR), ("comment near far", NEAR))),
    *(("display_white", 5.9063, said, read) for said, read in (
        ("comment white 3.5", 3.5), ("comment white 0.5", 1.0), ("comment white 1e9", 1.0),
        ("comment white nan", 1.0))),
])
def test_near_white_and_pixel_grid_are_restored(kept: str, number: float, said: str, read: float,
                                                tmp_path: Path) -> None:
    """A scene's value is written as a comment where it is not the default, and invalid comments are ignored."""
    first = scene()
    setattr(first, kept, number)
    write_ply(tmp_path / "a.ply", first)
    assert getattr(read_ply(tmp_path / "a.ply"), kept) == number
    write_ply(tmp_path / "b.ply", scene())
    plain = (tmp_path / "b.ply").read_bytes()
    assert said.split()[1].encode() not in plain[:3000], "other programs read what they know"
    (tmp_path / "b.ply").write_bytes(plain.replace(b"element vertex", f"{said}\nelement vertex".encode(), 1))
    assert getattr(read_ply(tmp_path / "b.ply"), kept) == read


def test_the_layout_equals_that_of_3dgs(tmp_path: Path) -> None:
    """Column by column, from the bytes."""
    s = scene(3)
    write_ply(tmp_path / "a.ply", s)
    data = (tmp_path / "a.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    assert head.decode().splitlines() == header("", 3)[:-1]
    table = np.frombuffer(body, "<f4").reshape(3, 62)
    assert np.array_equal(table[:, :3], s.means.detach().numpy())
    assert not table[:, 3:6].any()
    assert np.array_equal(table[:, 6:9], s.sh[:, 0].detach().numpy())
    for channel in range(3):
        columns = table[:, 9 + 15 * channel : 24 + 15 * channel]
        assert np.array_equal(columns, s.sh[:, 1:, channel].detach().numpy())
    assert np.array_equal(table[:, 54], s.opacity_logits.detach().numpy())
    assert np.array_equal(table[:, 55:58], s.log_scales.detach().numpy())
    assert np.array_equal(table[:, 58:], s.quaternions.detach().numpy())


@pytest.mark.parametrize("rest", [0, 9, 24])
@pytest.mark.parametrize("order", ["<", ">"])
def test_lower_degrees_and_big_endian_files_are_read(tmp_path: Path, rest: int, order: str) -> None:
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    table = np.arange(2 * (17 + rest), dtype=np.float32).reshape(2, -1)
    lines = header("comment from elsewhere", 2, rest, form)
    (tmp_path / "a.ply").write_bytes("\n".join(lines).encode() + b"\n" + table.astype(order + "f4").tobytes())
    s = read_ply(tmp_path / "a.ply")
    per = rest // 3
    for channel in range(3):
        columns = table[:, 9 + per * channel : 9 + per * (channel + 1)]
        assert np.array_equal(s.sh[:, 1 : 1 + per, channel].detach().numpy(), columns)
    assert not s.sh[:, 1 + per :].any()
    assert np.array_equal(s.quaternions.detach().numpy(), table[:, -4:])


def test_unknown_properties_and_elements_are_ignored(tmp_path: Path) -> None:
    s = scene(4)
    write_ply(tmp_path / "a.ply", s)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    rows = [body[i * 248 : (i + 1) * 248] for i in range(4)]
    head = head.replace(b"property float x\n", b"property uchar seen\nproperty float x\n")
    head += b"property double when\nelement camera 1\nproperty list uchar int ids\nend_header\n"
    data = head + b"".join(b"\7" + row + np.float64(3).tobytes() for row in rows) + b"\1\0\0\0\0"
    (tmp_path / "b.ply").write_bytes(data)
    again = read_ply(tmp_path / "b.ply")
    for name, parameter in s.named_parameters():
        assert torch.equal(parameter, again.get_parameter(name)), name


def broken() -> list[tuple[str, bytes, str]]:
    """Return broken PLY files: name, content, and words of the message that refuses the file."""
    body = np.zeros((2, 62), "<f4")
    good = "\n".join(header("", 2)) + "\n"

    def instead(old: str, new: str) -> bytes:
        assert old in good
        return good.replace(old, new, 1).encode() + body.tobytes()

    nan = body.copy()
    nan[1, 57] = np.nan
    return [
        ("empty", b"", "not a PLY"),
        ("other", b"\x89PNG\r\n" + b"\0" * 100, "not a PLY"),
        ("no end", b"ply\nformat binary_little_endian 1.0\n" + b"comment \n" * 20_000, "not a PLY"),
        ("cut short", good.encode() + body.tobytes()[:-1], "cut short"),
        ("no body", good.encode(), "cut short"),
        ("huge count", instead("vertex 2", "vertex 99999999999999999999"), "cut short"),
        ("count of 5000 digits", instead("vertex 2", f"vertex {'9' * 5000}"), "cut short"),
        ("negative count", instead("vertex 2", "vertex -2"), "vertices"),
        ("odd count", instead("vertex 2", "vertex ²"), "vertices"),
        ("ascii", instead("binary_little_endian", "ascii"), "ascii"),
        ("no format", instead("format binary_little_endian 1.0\n", ""), "not a PLY file of Gaussians"),
        ("missing", instead("property float opacity\n", ""), "opacity is missing"),
        ("missing rest", instead("property float f_rest_44\n", ""), "44 f_rest"),
        ("twice", instead("property float ny", "property float nx"), "not a PLY file of Gaussians"),
        ("list", instead("property float nx", "property list uchar int nx"), "plain number"),
        ("type", instead("property float nx", "property quad nx"), "plain number"),
        ("list first", instead("element vertex 2", "element face 2\nproperty int a\nelement vertex 2"), "begin"),
        ("not finite", good.encode() + nan.tobytes(), "not finite"),
    ]


@pytest.mark.parametrize(("what", "data", "message"), broken(), ids=[what for what, _, _ in broken()])
def test_broken_files_raise(tmp_path: Path, what: str, data: bytes, message: str) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(data)
    with pytest.raises(FlareFileError, match=message) as error:
        read_ply(path)
    sentence = str(error.value)
    assert "scene.ply" in sentence and sentence.endswith(".") and "\n" not in sentence, what


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FlareFileError, match=r"none\.ply cannot be read"):
        read_ply(tmp_path / "none.ply")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, scene(2))
    before = path.read_bytes()
    bad = scene(2)
    bad.sh.data = bad.sh.data[:1]
    with pytest.raises(ValueError):
        write_ply(path, bad)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
