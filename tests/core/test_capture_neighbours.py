# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures as COLMAP's front ends, nerfstudio, instant-ngp, BlenderNeRF, Metashape and RealityCapture write them.

Nothing of a capture is passed over without a sentence.
"""
from __future__ import annotations

import json
import re
import shutil
import unicodedata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from core.capture import Capture
from core.capture.layout import count_images
from core.capture.ply import read_points
from core.errors import CaptureError, FrameError
from core.images.formats.exif import undo_orientation
from core.images.write import write_exr
from core.removal.jobs.fitted import _clean_view
from core.transfer.target import capture_target
from tests.core.captures import SIZE, make_capture, make_transforms, orbit, picture
from tests.core.test_exif import exif_segment

MODEL = Path("sparse") / "0"


def names(capture: Capture) -> list[str]:
    return [view.name for view in capture.views]


def edit(folder: Path, **values: Any) -> None:
    meta = json.loads((folder / "transforms.json").read_text())
    meta.update(values)
    (folder / "transforms.json").write_text(json.dumps(meta))


def keep_images(model: Path, number: int) -> None:
    """Leave the first images of a text model only."""
    lines = (model / "images.txt").read_text().splitlines()
    (model / "images.txt").write_text("\n".join(lines[:1 + 2 * number]) + "\n")


# Where the camera solve is.

@pytest.mark.parametrize("place", ["sparse/1", "sparse/10", "colmap/sparse/0", "colmap/sparse/3", "colmap/0", "sparse",
                                   "colmap/sparse", "colmap", "Sparse/0", "COLMAP/SPARSE/0", "."])
def test_a_model_is_found_in_each_place(tmp_path: Path, place: str) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "sparse").rename(tmp_path / "sparse")
    model = folder / place
    model.mkdir(parents=True, exist_ok=True)
    for file in (tmp_path / MODEL).iterdir():
        file.rename(model / file.name)
    capture = Capture.open(folder)
    assert len(capture.views) == 4 and len(capture.points) == 20 and not capture.warnings
    assert capture.frame(capture.views[3]).size == SIZE


@pytest.mark.parametrize("places", [("sparse/0", "sparse/1"), ("colmap/sparse/0", "colmap/sparse/1"),
                                    ("sparse/2", "sparse/10"), ("sparse", "sparse/0")])
@pytest.mark.parametrize("form", ["text", "binary"])
def test_the_model_with_the_most_images_is_used(tmp_path: Path, places: tuple[str, str], form: str) -> None:
    import pycolmap

    folder = make_capture(tmp_path / "c")
    whole = (tmp_path / "whole")
    (folder / MODEL).rename(whole)
    (folder / "sparse").rmdir()
    for number, place in zip((2, 4), places, strict=True):
        shutil.copytree(whole, folder / place, dirs_exist_ok=True)
        keep_images(folder / place, number)
        if form == "binary":
            lines = (folder / place / "points3D.txt").read_text().splitlines()
            (folder / place / "points3D.txt").write_text("".join(
                " ".join(line.split()[:8 + 2 * number]) + "\n" for line in lines))
            reconstruction = pycolmap.Reconstruction()
            reconstruction.read_text(str(folder / place))
            for file in (folder / place).glob("*.txt"):
                file.unlink()
            reconstruction.write_binary(str(folder / place))
    capture = Capture.open(folder)
    assert len(capture.views) == 4
    [sentence] = capture.warnings
    assert f"{places[1]} with 4 frames is used" in sentence and f"{places[0]} 2)" in sentence


@pytest.mark.parametrize("elsewhere", ["D:/shots/one", "D:\\shots\\one", "/shots/one"])
def test_absolute_names_of_another_machine_resolve_by_their_suffix(elsewhere: str, tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "c")
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["file_path"] = f"{elsewhere}/{frame['file_path'].removeprefix('./')}"
    (folder / "transforms.json").write_text(json.dumps(data))
    assert [view.name for view in Capture.open(folder).views] == ["0000.png", "0001.png", "0002.png"]
    data["frames"][0]["file_path"] = "/etc/passwd"
    (folder / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(CaptureError, match="not inside the folder"):
        Capture.open(folder)


@pytest.mark.parametrize("start", ["images/", "shot/images/", "/data/shot/images/", "C:\\shot\\images\\", "../images/"])
@pytest.mark.parametrize("subfolder", ["", "left/"])
def test_names_of_a_model_that_start_above_its_frames_are_resolved(start: str, subfolder: str, tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "images" / subfolder).mkdir(exist_ok=True)
    for name in [f"000{number}.png" for number in range(4)] if subfolder else []:
        (folder / "images" / name).rename(folder / "images" / subfolder / name)
    text = re.sub(r" (\d{4}\.png)\n", lambda match: f" {start}{subfolder}{match[1]}\n",
                  (folder / MODEL / "images.txt").read_text())
    (folder / MODEL / "images.txt").write_text(text)
    capture = Capture.open(folder)
    assert [view.name for view in capture.views] == [f"{subfolder}000{number}.png" for number in range(4)]
    assert not capture.warnings and not capture.left_out


def test_points_without_colours_are_reported(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "c", ply_file_path="p.ply")
    ply(folder / "p.ply", ("intensity",), "float", [0.5])
    assert any("p.ply have no colours, so they start grey" in sentence for sentence in Capture.open(folder).warnings)


def test_a_model_in_another_place_is_named(tmp_path: Path) -> None:
    """COLMAP's automatic reconstruction writes dense/0/sparse."""
    folder = make_capture(tmp_path / "c")
    deeper = folder / "dense" / "0" / "sparse"
    deeper.parent.mkdir(parents=True)
    (folder / "sparse" / "0").rename(deeper)
    with pytest.raises(CaptureError, match=f"a model lies in {deeper}: name the folder that holds it"):
        Capture.open(folder)
    shutil.rmtree(folder / "dense")
    with pytest.raises(CaptureError, match="run solve first"):
        Capture.open(folder)


@pytest.mark.parametrize(("suffix", "kind"), [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint16)])
def test_hidden_colours_of_frames_are_never_seen(suffix: str, kind: type, tmp_path: Path) -> None:
    """BlenderNeRF's frames are transparent where nothing was rendered."""
    folder = make_capture(tmp_path / "c", views=2, suffix=suffix)
    top, seen = np.iinfo(kind).max, []
    for hidden in (0, top):
        for path in (folder / "images").iterdir():
            codes = np.full((48, 64, 4), top // 2, kind)
            codes[:, 40:, :3], codes[:, :20, 3], codes[:, 40:, 3] = hidden, top, 0
            cv2.imwrite(str(path), codes)
        capture = Capture.open(folder)
        seen.append(capture.frame(capture.views[0]).linear())
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not seen[0][:, 40:].any()
    np.testing.assert_allclose(seen[0][:, 20:40], seen[0][:, :20].mean() / 2, rtol=0.01)


def test_a_damaged_second_model_does_not_count(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "sparse/1").mkdir()
    (folder / "sparse/1/cameras.txt").write_text("1 PINHOLE 64 48 57 57 32 24\n")
    (folder / "sparse/1/images.bin").write_bytes(b"\xff" * 40)
    assert count_images(folder / "sparse/1") == 0
    assert len(Capture.open(folder).views) == 4


@pytest.mark.parametrize("change", ["CAMERAS.TXT", "Images", "Images.txt", "LIGHTS.JSON", "REMOVED", "Masks"])
def test_names_are_found_in_any_case(tmp_path: Path, change: str) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "lights.json").write_text('{"lights": [{"name": "lamp", "xyz": [0, 0, 0]}]}')
    for layer in ("removed", "masks"):
        shutil.copytree(folder / "images", folder / layer)
    for path in [folder / "images", folder / "lights.json", folder / "removed", folder / "masks",
                 *(folder / MODEL).iterdir()]:
        if path.name.casefold() == change.casefold():
            path.rename(path.with_name(change))
    capture = Capture.open(folder)
    assert len(capture.views) == 4 and len(capture.lights) == 1 and capture.has_clean_frames and capture.has_masks
    assert capture.frame(capture.views[0]).size == SIZE


# images.txt.

@pytest.mark.parametrize("form", ["no lines of points", "empty lines", "no lines and spaces in names",
                                  "no lines and names without suffix", "a comment between"])
def test_an_images_txt_without_lines_of_points_is_read(tmp_path: Path, form: str) -> None:
    folder = make_capture(tmp_path / "c", views=7)
    lines = (folder / MODEL / "images.txt").read_text().splitlines()
    images = lines[1::2]
    if "spaces" in form:
        images = [line.replace(" 1 0", " 1 a 2 b 0") for line in images]
        for file in sorted((folder / "images").iterdir()):
            file.rename(file.with_name(f"a 2 b {file.name}"))
    if "suffix" in form:
        images = [line.removesuffix(".png") for line in images]
    joint = {"empty lines": "\n\n", "a comment between": "\n# points\n"}.get(form, "\n")
    (folder / MODEL / "images.txt").write_text("# Number of images: 7, mean observations per image: 0\n"
                                               + joint.join(images))
    capture = Capture.open(folder)
    assert len(capture.views) == 7
    assert not any(len(view.points) for view in capture.views)


def test_lines_of_points_are_no_images(tmp_path: Path) -> None:
    """Twelve whole numbers could be an image with the name "10 11 12"."""
    folder = make_capture(tmp_path / "c")
    text = (folder / MODEL / "images.txt").read_text().splitlines()
    text[2::2] = ["1 2 3 4 5 6 7 8 9 10 11 12"] * 4
    (folder / MODEL / "images.txt").write_text("\n".join(text))
    capture = Capture.open(folder)
    assert len(capture.views) == 4 and capture.views[0].points.tolist() == [2, 5, 8, 11]


# Frames and poses that have no counterpart.

def test_frames_without_a_pose_are_counted_and_named(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c", views=6)
    keep_images(folder / MODEL, 4)
    (folder / "images" / "second").mkdir()
    cv2.imwrite(str(folder / "images" / "second" / "0000.png"), picture(0))
    capture = Capture.open(folder)
    [sentence] = capture.warnings
    assert "4 of 7 frames in" in sentence and "0004.png, 0005.png, second/0000.png" in sentence
    assert capture.left_out == {"no pose": ("0004.png", "0005.png", "second/0000.png")}


@pytest.mark.parametrize("kind", ["colmap", "transforms", "subfolder"])
def test_poses_without_a_frame_are_counted_and_named(tmp_path: Path, kind: str) -> None:
    folder = make_transforms(tmp_path / "c", 9) if kind == "transforms" else make_capture(tmp_path / "c", 9)
    if kind == "subfolder":
        text = (folder / MODEL / "images.txt").read_text().replace("0001.png", "gone/0001.png")
        (folder / MODEL / "images.txt").write_text(text)
    (folder / "images" / "0001.png").unlink()
    capture = Capture.open(folder)
    assert len(capture.views) == 8
    [sentence] = capture.warnings
    assert "8 of 8 frames" in sentence and "1 poses have no frame" in sentence and "0001.png" in sentence
    [left_out] = capture.left_out.values()
    assert left_out[0].endswith("0001.png")
    if kind != "subfolder":
        assert [view.name for view in capture.split(None)[1]] == ["0000.png", "0008.png"], "as with all frames"
    assert len(Capture.open(folder, need_frames=False).views) == 9


# Names.

@pytest.mark.parametrize("suffix", [".exr", ".tif", ".jpg"])
def test_a_frame_with_another_suffix_is_used_and_reported(tmp_path: Path, suffix: str) -> None:
    folder = make_capture(tmp_path / "c")
    for path in sorted((folder / "images").iterdir()):
        if suffix == ".exr":
            write_exr(path.with_suffix(suffix), dict.fromkeys("RGB", np.full((48, 64), 0.5, np.float32)))
        else:
            cv2.imwrite(str(path.with_suffix(suffix)), cv2.imread(str(path)))
        path.unlink()
    capture = Capture.open(folder)
    [sentence] = capture.warnings
    assert "4 frames have other names" in sentence and f"0000{suffix} for 0000.png" in sentence
    assert capture.frame(capture.views[2]).size == SIZE


@pytest.mark.parametrize("form", ["backslash", "decomposed on disk", "decomposed in the model", "suffix", "dot"])
def test_a_name_has_one_form_for_frames_and_layers(tmp_path: Path, form: str) -> None:
    folder = make_capture(tmp_path / "c")
    composed = "cam \u00e9/0001.png"
    on_disk = {"decomposed on disk": unicodedata.normalize("NFD", composed),
               "suffix": composed.replace(".png", ".PNG")}.get(form, composed)
    in_model = {"backslash": composed.replace("/", "\\"), "dot": f"./{composed}",
                "decomposed in the model": unicodedata.normalize("NFD", composed)}.get(form, composed)
    shutil.copytree(folder / "images", folder / "removed")
    for layer in ("images", "removed"):
        (folder / layer / on_disk).parent.mkdir()
        (folder / layer / "0001.png").rename(folder / layer / on_disk)
    text = (folder / MODEL / "images.txt").read_text().replace(" 0001.png", f" {in_model}")
    (folder / MODEL / "images.txt").write_text(text)
    (folder / "split.json").write_text(json.dumps({"test": [composed]}))
    capture = Capture.open(folder)
    view = capture.view(composed)
    assert view.name == composed and capture.has_clean_frames and not capture.warnings
    assert capture.split(None)[1] == (view,)
    np.testing.assert_array_equal(capture.frame(view).pixels, capture.clean_frame(view).pixels)  # type: ignore[union-attr]


def test_views_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c", 12)
    text = (folder / MODEL / "images.txt").read_text()
    for i in range(12):
        (folder / "images" / f"{i:04d}.png").rename(folder / "images" / f"frame{i}.png")
        text = text.replace(f"{i:04d}.png", f"frame{i}.png")
    (folder / MODEL / "images.txt").write_text(text)
    assert names(Capture.open(folder)) == [f"frame{i}.png" for i in range(12)]


# nerfstudio, instant-ngp, BlenderNeRF.

APPLIED = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, -2], [0, -1, 0, 1]])
OLD = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])


def nerfstudio(folder: Path, applied: np.ndarray, scale: float, **declared: Any) -> np.ndarray:
    """Write a transforms.json as nerfstudio does, poses moved and scaled, beside the COLMAP model.

    applied: (3, 4) rotation and shift of nerfstudio's world. declared: further entries of the file. Returns the model's
    points in the file's world.
    """
    model = make_capture(folder.with_name("model"))
    make_transforms(folder, 4)
    (folder / "colmap" / "sparse").mkdir(parents=True)
    (model / MODEL).rename(folder / "colmap" / "sparse" / "0")
    frames = []
    for i, camera in enumerate(orbit(4)):
        pose = camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3] = applied[:, :3] @ pose[:3]
        pose[:3, 3] = scale * (pose[:3, 3] + applied[:, 3])
        frames.append({"file_path": f"images/{i:04d}.png", "transform_matrix": pose.tolist()})
    edit(folder, frames=frames, **declared)
    xyz = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    return scale * (xyz @ applied[:, :3].T + applied[:, 3])


@pytest.mark.parametrize("kind", ["declared", "no scale", "old default", "old default with scale", "undeclared motion",
                                  "undeclared scale"])
def test_points_of_the_colmap_model_follow_the_poses(tmp_path: Path, kind: str) -> None:
    applied = OLD if "old" in kind else APPLIED
    scale = 1.0 if kind in ("no scale", "old default") else 0.2
    declared: dict[str, Any] = {}
    if "old" not in kind and kind != "undeclared motion":
        declared["applied_transform"] = applied.tolist()
    if kind in ("declared", "old default with scale"):
        declared["applied_scale"] = scale
    expected = nerfstudio(tmp_path / "t", applied, scale, **declared)
    capture = Capture.open(tmp_path / "t")
    np.testing.assert_allclose(capture.points.xyz, expected, atol=1e-5)
    assert bool(capture.warnings) == kind.startswith("undeclared")
    assert all("as their cameras are" in sentence for sentence in capture.warnings)


@pytest.mark.parametrize("scale", [0, -1, "x"])
def test_an_invalid_applied_scale_is_refused(tmp_path: Path, scale: object) -> None:
    nerfstudio(tmp_path / "t", APPLIED, 1.0, applied_transform=APPLIED.tolist(), applied_scale=scale)
    with pytest.raises(CaptureError, match="applied_scale"):
        Capture.open(tmp_path / "t")


@pytest.mark.parametrize(("values", "model", "params"), [
    ([-0.2, 0.05, 0.01, 0, 0.001, 0.002], "OPENCV", (-0.2, 0.05, 0.001, 0.002, 0.01)),
    ([-0.2, 0.05, 0.01, 0, 0.001, 0.002], "FULL_OPENCV", (-0.2, 0.05, 0.001, 0.002, 0.01)),
    ([-0.02, 0.005, 0.001, 0.002, 0, 0], "OPENCV_FISHEYE", (-0.02, 0.005, 0, 0, 0.001, 0.002)),
    ([-0.2, 0.05], "OPENCV", (-0.2, 0.05, 0, 0, 0)),
])
@pytest.mark.parametrize("where", ["file", "frame"])
def test_distortion_params_are_read(tmp_path: Path, values: list[float], model: str, params: tuple[float, ...],
                                    where: str) -> None:
    folder = make_transforms(tmp_path / "t", camera_model=model, **({"distortion_params": values} if where == "file"
                                                                    else {"k1": 0.9}))
    if where == "frame":
        meta = json.loads((folder / "transforms.json").read_text())
        for frame in meta["frames"]:
            frame["distortion_params"] = values
        (folder / "transforms.json").write_text(json.dumps(meta))
    lens = Capture.open(folder).views[0].lens
    assert lens is not None and lens.params[4:4 + len(params)] == params


@pytest.mark.parametrize("values", ["-0.2", [0.1] * 7, [float("nan")] * 6, ["a"] * 6])
def test_invalid_distortion_params_are_refused(tmp_path: Path, values: object) -> None:
    with pytest.raises(CaptureError, match="distortion_params"):
        Capture.open(make_transforms(tmp_path / "t", distortion_params=values))


@pytest.mark.parametrize("form", ["train and test", "test alone", "val alone", "train alone", "backslashes",
                                  "train, val"])
def test_lists_of_frames_split_the_views(tmp_path: Path, form: str) -> None:
    folder = make_transforms(tmp_path / "t", 6)
    path = "images\\000{}.png" if form == "backslashes" else "./images/000{}.png"
    train, test = ([path.format(i) for i in part] for part in ((0, 1, 2, 4), (3, 5)))
    lists = {"train and test": {"train_filenames": train, "test_filenames": test},
             "test alone": {"test_filenames": test}, "val alone": {"val_filenames": test},
             "train alone": {"train_filenames": train},
             "backslashes": {"train_filenames": train, "test_filenames": test},
             "train, val": {"train_filenames": train[:2], "val_filenames": test}}[form]
    edit(folder, **lists)
    capture = Capture.open(folder)
    training, held_out = capture.split(None)
    assert [view.name for view in held_out] == ["0003.png", "0005.png"]
    assert len(training) == (2 if form == "train, val" else 4)
    assert len(capture.split(3)[1]) == 2, "a number on the command line comes first"


def test_a_list_that_names_no_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"test_filenames names images/9\.png"):
        Capture.open(make_transforms(tmp_path / "t", test_filenames=["images/9.png"]))


@pytest.mark.parametrize("part", ["transforms_test.json", "transforms_val.json", "Transforms_Test.json"])
def test_files_of_parts_are_read_together(tmp_path: Path, part: str) -> None:
    """As BlenderNeRF and NeRF's synthetic scenes write them."""
    folder = make_transforms(tmp_path / "t", 6)
    meta = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    for name, frames in (("transforms_train.json", meta["frames"][:4]), (part, meta["frames"][4:])):
        (folder / name).write_text(json.dumps({**meta, "frames": frames}))
    capture = Capture.open(folder)
    assert len(capture.views) == 6
    assert [view.name for view in capture.split(None)[1]] == ["0004.png", "0005.png"]


# Masks.

@pytest.mark.parametrize("form", ["mask_path", "masks/0001.png", "masks/0001.png.png", "masks/0001.jpg",
                                  "Mask of 0 and 1"])
def test_masks_are_read(tmp_path: Path, form: str) -> None:
    folder = make_transforms(tmp_path / "t")
    mask = np.full((48, 64), 255 if "0 and 1" not in form else 1, np.uint8)
    mask[:, :20] = 0
    name = form if form.startswith("masks") else "masks/0001.png" if form.startswith("Mask") else "blocked/m.png"
    (folder / name).parent.mkdir()
    cv2.imwrite(str(folder / name), mask)
    if form == "mask_path":
        meta = json.loads((folder / "transforms.json").read_text())
        meta["frames"][1]["mask_path"] = ".\\blocked\\m.png"
        (folder / "transforms.json").write_text(json.dumps(meta))
    capture = Capture.open(folder)
    assert capture.has_masks and capture.mask(capture.views[0]) is None
    kept = capture.mask(capture.views[1])
    assert kept is not None and kept[:, 22:].all() and not kept[:, :18].any()
    half = capture.mask(capture.views[1], (32, 24))
    assert half is not None and half.shape == (24, 32) and half[:, 11:].all() and not half[:, :10].any()


def test_masks_are_undistorted_with_their_frames(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c", model="SIMPLE_RADIAL", params=(57.6, 32, 24, -0.3))
    shutil.copytree(folder / "images", folder / "masks")
    for path in (folder / "masks").iterdir():
        cv2.imwrite(str(path), np.where(picture(3) > 127, 255, 0).max(axis=2).astype(np.uint8))
        cv2.imwrite(str(folder / "images" / path.name), cv2.cvtColor(cv2.imread(str(path), 0), cv2.COLOR_GRAY2BGR))
    capture = Capture.open(folder)
    frame, kept = capture.frame(capture.views[0]).pixels.min(axis=2), capture.mask(capture.views[0])
    assert kept is not None and np.abs(frame - kept).mean() < 0.1 and 0.1 < kept.mean() < 0.9


@pytest.mark.parametrize("form", ["white with alpha", "black on transparent", "grey with alpha", "opaque",
                                  "premultiplied"])
def test_masks_with_alpha_are_read_as_they_look(form: str, tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "t")
    (folder / "masks").mkdir()
    counts = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    counts[:12] = 0
    white = np.full_like(counts, 255)
    codes = {"white with alpha": (white, counts), "black on transparent": (0 * white, 255 - counts),
             "grey with alpha": (counts, white), "opaque": (counts, white), "premultiplied": (counts, counts)}[form]
    planes = codes if form == "grey with alpha" else (codes[0], codes[0], *codes)
    Image.fromarray(np.stack(planes, -1)).save(folder / "masks" / "0000.png")
    capture = Capture.open(folder)
    mask = capture.mask(capture.views[0])
    assert mask is not None and mask[16:].all() and not mask[:10].any()


def test_a_missing_mask_is_refused(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "t")
    meta = json.loads((folder / "transforms.json").read_text())
    meta["frames"][1]["mask_path"] = "masks/none.png"
    (folder / "transforms.json").write_text(json.dumps(meta))
    with pytest.raises(CaptureError, match=r"none\.png is missing"):
        Capture.open(folder)


# Points.

def ply(path: Path, names: tuple[str, ...], kind: str, values: list[float]) -> Path:
    """Write a binary PLY of two points with these properties of one kind besides x, y, z; the first has these
    values."""
    types = {"uchar": "u1", "ushort": "<u2", "uint": "<u4", "int": "<i4", "float": "<f4", "double": "<f8"}
    properties = [f"property float {axis}" for axis in "xyz"] + [f"property {kind} {name}" for name in names]
    row = np.zeros(2, [*((axis, "<f4") for axis in "xyz"), *((name, types[kind]) for name in names)])
    for name, value in zip(names, values, strict=True):
        row[name][0] = value
    path.write_bytes("\n".join(["ply", "format binary_little_endian 1.0", "element vertex 2", *properties,
                                "end_header", ""]).encode() + row.tobytes())
    return path


RGB, DIFFUSE = ("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")


@pytest.mark.parametrize(("names", "kind", "factor"), [
    (RGB, "uchar", 1), (RGB, "ushort", 257), (RGB, "ushort", 1), (RGB, "uint", 257 * 65537), (RGB, "int", 1),
    (RGB, "float", 1 / 255), (RGB, "double", 1 / 255), (RGB, "float", 1), (DIFFUSE, "uchar", 1),
    (DIFFUSE, "ushort", 257), (DIFFUSE, "float", 1 / 255), (("r", "g", "b"), "uchar", 1),
    (("r", "g", "b"), "double", 1 / 255), (("Red", "Green", "Blue"), "uchar", 1),
    (("scalar_Red", "scalar_Green", "scalar_Blue"), "float", 1),
])
def test_colours_of_every_type_are_read(tmp_path: Path, names: tuple[str, ...], kind: str, factor: float) -> None:
    path = ply(tmp_path / "p.ply", names, kind, [200 * factor, 100 * factor, 7 * factor])
    assert read_points(path).rgb.tolist() == [[200, 100, 7], [0, 0, 0]]


def test_harmonics_of_gaussians_are_colours(tmp_path: Path) -> None:
    path = ply(tmp_path / "p.ply", ("f_dc_0", "f_dc_1", "f_dc_2"), "float", [0.0, 1.0, -9.0])
    assert read_points(path).rgb.tolist() == [[128, 199, 0], [128, 128, 128]]


# Checks of the geometry.

@pytest.mark.parametrize("change", ["behind", "far off", "axes"])
def test_points_outside_all_views_are_reported(tmp_path: Path, change: str) -> None:
    folder = make_capture(tmp_path / "c", points=200)
    lines = []
    for line in (folder / MODEL / "points3D.txt").read_text().splitlines():
        words = line.split()
        x, y, z = map(float, words[1:4])
        moved = {"behind": (x, y, z - 20), "far off": (x + 100, y, z), "axes": (z, x + 9, -y - 9)}[change]
        lines.append(" ".join([words[0], *map(str, moved), *words[4:]]))
    assert not Capture.open(folder).warnings
    (folder / MODEL / "points3D.txt").write_text("\n".join(lines))
    [sentence] = Capture.open(folder).warnings
    assert "do not fit each other" in sentence


@pytest.mark.parametrize(("focal", "is_bad"), [(0.035, True), (35.0, False), (9e5, True), (2.0, True), (640.0, False)])
def test_an_implausible_focal_length_is_reported(tmp_path: Path, focal: float, is_bad: bool) -> None:
    folder = make_transforms(tmp_path / "t", fl_x=focal, fl_y=focal)
    edit(folder, fl_x=focal, fl_y=focal)
    assert any("focal length of 3 of 3 frames cannot be" in text for text in Capture.open(folder).warnings) == is_bad


# Exif orientation.

def turned_capture(folder: Path, orientation: int, *, coloured: bool = True) -> Path:
    """Write a capture whose JPEG files hold turned pictures with an Exif orientation, solved from the pictures as
    shown.

    coloured: give the points the colours of the frames.
    """
    make_capture(folder, points=300)
    shown = [picture(i) for i in range(4)]
    cloud = np.random.default_rng(1).uniform(-0.6, 0.6, (300, 3))
    if coloured:  # the picture on a plane that the cameras look at
        seen = orbit(4)[1].project(cloud)[0].astype(int)
        flat = picture(0)
        colours = flat[seen[:, 1].clip(0, 47), seen[:, 0].clip(0, 63), ::-1]
        lines = [f"{i + 1} {x} {y} {z} {' '.join(map(str, colour))} 0.5"
                 for i, ((x, y, z), colour) in enumerate(zip(cloud, colours, strict=True))]
        (folder / MODEL / "points3D.txt").write_text("\n".join(lines) + "\n")
        for i, camera in enumerate(orbit(4)):
            frame = np.zeros((48, 64, 3), np.uint8)
            for (x, y), colour in zip(camera.project(cloud)[0].astype(int), colours, strict=True):
                cv2.circle(frame, (int(x), int(y)), 3, tuple(map(int, colour[::-1])), -1)
            shown[i] = frame
    text = (folder / MODEL / "images.txt").read_text()
    for i, pixels in enumerate(shown):
        raw = cv2.imencode(".jpg", undo_orientation(pixels, orientation), [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        (folder / "images" / f"{i:04d}.png").unlink()
        (folder / "images" / f"{i:04d}.jpg").write_bytes(raw[:2] + exif_segment("II", orientation, 27) + raw[2:])
    (folder / MODEL / "images.txt").write_text(text.replace(".png", ".jpg"))
    return folder


@pytest.mark.parametrize("orientation", [2, 3, 4, 6, 8, 5])
def test_photographs_that_were_solved_as_shown_are_turned(tmp_path: Path, orientation: int) -> None:
    folder = turned_capture(tmp_path / "c", orientation)
    capture = Capture.open(folder)
    [sentence] = capture.warnings
    assert "as shown, by the " + ("sizes" if orientation > 4 else "colours") in sentence
    view = capture.views[2]
    path = folder / "images" / "0002.jpg"
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)[..., ::-1] / 255
    turned = {2: stored[:, ::-1], 3: stored[::-1, ::-1], 4: stored[::-1]}.get(orientation)
    assert view.upright and capture.frame(view).size == SIZE
    if turned is not None:
        np.testing.assert_allclose(capture.frame(view).pixels, turned, atol=1e-6)


def test_photographs_that_were_solved_as_stored_stay(tmp_path: Path) -> None:
    folder = turned_capture(tmp_path / "c", 3)
    for path in (folder / "images").iterdir():  # turn the pixels, keep the tag
        pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)[::-1, ::-1]
        raw = cv2.imencode(".jpg", pixels)[1].tobytes()
        path.write_bytes(raw[:2] + exif_segment("II", 3, 27) + raw[2:])
    capture = Capture.open(folder)
    assert not any(view.upright for view in capture.views) and not capture.warnings


def test_an_undecidable_orientation_is_reported(tmp_path: Path) -> None:
    folder = turned_capture(tmp_path / "c", 3)
    (folder / MODEL / "points3D.txt").unlink()
    capture = Capture.open(folder)
    [sentence] = capture.warnings
    assert "as stored, though their Exif orientation is 3" in sentence and not capture.views[0].upright


def test_layers_of_a_fit_are_not_subtracted_from_turned_pixels(tmp_path: Path) -> None:
    capture = Capture.open(turned_capture(tmp_path / "c", 3))
    with pytest.raises(FrameError, match=r"0002\.jpg was solved as viewers show it"):
        _clean_view(None, capture, capture.views[2], False)  # type: ignore[arg-type]


def test_a_flare_is_transferred_to_photographs_as_they_were_solved(tmp_path: Path) -> None:
    capture = Capture.open(turned_capture(tmp_path / "c", 3))
    (tmp_path / "lights.json").write_text('{"lights": [{"name": "lamp", "xyz": [0, 0, 1]}]}')
    look = SimpleNamespace(names=("lamp",))
    target = capture_target(capture, look, {}, lights=tmp_path / "lights.json")  # type: ignore[arg-type]
    undistorted = target.frames[2].undistorted
    assert undistorted is not None
    np.testing.assert_array_equal(undistorted(None).pixels, capture.frame(capture.views[2]).pixels)
