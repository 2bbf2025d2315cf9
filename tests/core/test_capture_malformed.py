# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures that cannot be used: one clear sentence that names the file, and nothing written."""
from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.capture import Capture
from core.errors import CaptureError, FitFlareError, FrameError
from tests.core.captures import make_capture, make_transforms, picture

Damage = Callable[[Path], object]
SPARSE = Path("sparse") / "0"


def put(name: str, content: str | bytes) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return damage


def swap(name: str, old: str, new: str) -> Damage:
    def damage(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))
    return damage


def drop(name: str) -> Damage:
    def damage(folder: Path) -> None:
        (folder / name).unlink()
    return damage


def binary(folder: Path) -> Path:
    """Rewrite the capture's text model as a binary one; return the model's folder."""
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(folder / SPARSE))
    for file in (folder / SPARSE).iterdir():
        file.unlink()
    reconstruction.write_binary(str(folder / SPARSE))
    return folder / SPARSE


def cut(name: str, keep: float) -> Damage:
    def damage(folder: Path) -> None:
        path = binary(folder) / name
        data = path.read_bytes()
        path.write_bytes(data[:int(keep * len(data))])
    return damage


def patch(name: str, at: int, data: bytes) -> Damage:
    def damage(folder: Path) -> None:
        path = binary(folder) / name
        old = path.read_bytes()
        path.write_bytes(old[:at] + data + old[at + len(data):])
    return damage


def folder_instead(name: str) -> Damage:
    def damage(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).mkdir(parents=True)
    return damage


def frame_of_size(width: int, height: int, name: str = "images/0001.png") -> Damage:
    def damage(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), picture(0, (width, height)))
    return damage


def link_out(name: str) -> Damage:
    def damage(folder: Path) -> None:
        outside = folder.parent / "outside.png"
        cv2.imwrite(str(outside), picture(0))
        (folder / name).unlink()
        (folder / name).symlink_to(outside)
    return damage


def half_removed(folder: Path) -> None:
    frame_of_size(64, 48, "removed/0000.png")(folder)


def no_model(folder: Path) -> None:
    for file in (folder / SPARSE).iterdir():
        file.unlink()


HUGE = struct.pack("<Q", 2**62)
def lights(values: str) -> Damage:
    """A lights.json with one light of these values."""
    return put("lights.json", f'{{"lights": [{{"name": "a", {values}}}]}}')


IMAGES, CAMERAS, POINTS = (f"sparse/0/{name}.txt" for name in ("images", "cameras", "points3D"))
TWO_LIGHTS = '{"lights": [{"name": "a", "xyz": [0, 0, 0]}, {"name": "a", "xyz": [1, 0, 0]}]}'

COLMAP_CASES: dict[str, tuple[Damage, type[FitFlareError], str]] = {
    "no model": (no_model, CaptureError, "camera solve"),
    "no images file": (drop(IMAGES), CaptureError, "images.bin or images.txt"),
    "no images": (put(IMAGES, "# nothing\n"), CaptureError, "images.txt"),
    "no cameras": (put(CAMERAS, "# nothing\n"), CaptureError, "cameras.txt"),
    "unknown camera model": (swap(CAMERAS, "PINHOLE", "PERISCOPE"), CaptureError, "cameras.txt"),
    "too few parameters": (swap(CAMERAS, "PINHOLE", "OPENCV"), CaptureError, "cameras.txt"),
    "camera not numbers": (swap(CAMERAS, "64 48", "64 tall"), CaptureError, "cameras.txt"),
    "camera line cut": (put(CAMERAS, "1\n"), CaptureError, "cameras.txt"),
    "camera twice": (swap(CAMERAS, "# cameras", "1 PINHOLE 64 48 50 50 32 24"), CaptureError, "cameras.txt"),
    "camera of no size": (swap(CAMERAS, "64 48", "0 48"), CaptureError, "cameras.txt"),
    "camera of absurd size": (swap(CAMERAS, "64 48", "640000000 480000000"), CaptureError, "cameras.txt"),
    "focal length not finite": (swap(CAMERAS, "57.6", "nan"), CaptureError, "cameras.txt"),
    "focal length negative": (swap(CAMERAS, "57.6", "-57.6"), CaptureError, "cameras.txt"),
    "lens that folds all": (put(CAMERAS, "1 SIMPLE_RADIAL 64 48 57 32 24 -900\n"), CaptureError, "simpler model"),
    "camera absent": (swap(IMAGES, " 1 0002.png", " 9 0002.png"), CaptureError, "images.txt"),
    "pose not finite": (swap(IMAGES, "3 ", "3 nan "), CaptureError, "images.txt"),
    "pose infinite": (put(IMAGES, "1 1 0 0 0 inf 0 0 1 0000.png\n\n"), CaptureError, "images.txt"),
    "no rotation": (put(IMAGES, "1 0 0 0 0 0 0 0 1 0000.png\n\n"), CaptureError, "images.txt"),
    "quaternion too long": (put(IMAGES, "1 2 0 0 0 0 0 0 1 0000.png\n\n"), CaptureError, "images.txt"),
    "image line cut": (put(IMAGES, "1 1 0 0 0 0 0\n\n"), CaptureError, "images.txt"),
    "images truncated": (put(IMAGES, "# Number of images: 2, mean observations: 0\n1 1 0 0 0 0 0 0 1 0000.png"),
                         CaptureError, "images.txt"),
    "image cut short": (put(IMAGES, "1 1 0 0 0 0 0 0 1 0000.png\n2 1 0 0 0\n"), CaptureError, "images.txt"),
    "images not text": (put(IMAGES, b"\xff\xfe\x00garbage"), CaptureError, "images.txt"),
    "frame twice": (swap(IMAGES, "0002.png", "0001.png"), CaptureError, "0001.png"),
    "frame above the folder": (swap(IMAGES, "0002.png", "../../secret.png"), CaptureError, "secret.png"),
    "frame elsewhere": (swap(IMAGES, "0002.png", "/etc/passwd.png"), CaptureError, "passwd"),
    "frame by Windows path": (swap(IMAGES, "0002.png", "C:\\x.png"), CaptureError, "x.png"),
    "frame of a long name": (swap(IMAGES, "0002.png", "x" * 5000 + ".png"), CaptureError, "xxx"),
    "frame is a link out": (link_out("images/0002.png"), CaptureError, "0002.png"),
    "every frame missing": (lambda folder: [path.unlink() for path in (folder / "images").iterdir()], FrameError,
                            "0000.png"),
    "frame is a broken link": (lambda folder: (drop("images/0002.png")(folder),
                                               (folder / "images/0002.png").symlink_to("gone.png")),
                               FrameError, "0002.png"),
    "frame empty": (put("images/0002.png", b""), FrameError, "0002.png"),
    "frame is text": (put("images/0002.png", "not a picture"), FrameError, "0002.png"),
    "frame is a folder": (folder_instead("images/0002.png"), FrameError, "0002.png"),
    "frame claims a huge size": (put("images/0002.png", b"\x89PNG\r\n\x1a\n" + bytes(8) + b"\x7f" * 8),
                                 FrameError, "0002.png"),
    "frame of another shape": (frame_of_size(64, 64), FrameError, "0001.png"),
    "frame turned": (frame_of_size(48, 64), FrameError, "0001.png"),
    "frame one line short": (frame_of_size(64, 46), FrameError, "0001.png"),
    "frame of another kind": (lambda folder: (swap(IMAGES, "0002.png", "0002.xyz")(folder),
                                              (folder / "images/0002.png").rename(folder / "images/0002.xyz")),
                              FrameError, "0002.xyz"),
    "pose too far": (put(IMAGES, "1 1 0 0 0 1e200 0 0 1 0000.png\n\n"), CaptureError, "images.txt"),
    "points not finite": (swap(POINTS, "1 ", "1 nan "), CaptureError, "points3D.txt"),
    "point line cut": (put(POINTS, "1 0 0 0\n"), CaptureError, "points3D.txt"),
    "point colour": (put(POINTS, "1 0 0 0 400 0 0 1\n"), CaptureError, "points3D.txt"),
    "binary cameras cut": (cut("cameras.bin", 0.7), CaptureError, "cameras.bin"),
    "binary cameras empty": (cut("cameras.bin", 0.0), CaptureError, "cameras.bin"),
    "binary images cut": (cut("images.bin", 0.5), CaptureError, "images.bin"),
    "binary points cut": (cut("points3D.bin", 0.5), CaptureError, "points3D.bin"),
    "binary points cut late": (cut("points3D.bin", 0.999), CaptureError, "points3D.bin"),
    "absurd count of cameras": (patch("cameras.bin", 0, HUGE), CaptureError, "cameras.bin"),
    "absurd count of images": (patch("images.bin", 0, HUGE), CaptureError, "images.bin"),
    "absurd count of points": (patch("points3D.bin", 0, HUGE), CaptureError, "points3D.bin"),
    "absurd track": (patch("points3D.bin", 8 + 43, HUGE), CaptureError, "points3D.bin"),
    "binary camera model": (patch("cameras.bin", 12, b"\x63"), CaptureError, "cameras.bin"),
    "no images in binary": (patch("images.bin", 0, bytes(8)), CaptureError, "images.bin"),
    "lights not JSON": (put("lights.json", "{"), CaptureError, "lights.json"),
    "lights a list": (put("lights.json", "[]"), CaptureError, "lights.json"),
    "light without name": (put("lights.json", '{"lights": [{"xyz": [0, 0, 0]}]}'), CaptureError, "lights.json"),
    "light without place": (put("lights.json", '{"lights": [{"name": "a"}]}'), CaptureError, "lights.json"),
    "light in two dimensions": (put("lights.json", '{"lights": [{"name": "a", "xyz": [0, 0]}]}'), CaptureError,
                                "lights.json"),
    "light not finite": (put("lights.json", '{"lights": [{"name": "a", "xyz": [0, 0, NaN]}]}'), CaptureError,
                         "lights.json"),
    "light of words": (put("lights.json", '{"lights": [{"name": "a", "xyz": ["0", "0", "0"]}]}'), CaptureError,
                       "lights.json"),
    "light with a place and a path": (lights('"xyz": [0, 0, 1], "frames": {"0.png": {"xyz": [0, 0, 1]}}'), CaptureError,
                                      "one place and a path"),
    "light in the world and on the picture": (
        lights('"frames": {"0.png": {"xyz": [0, 0, 1]}, "1.png": {"xy": [1, 2]}}'), CaptureError, "one kind"),
    "light path without frames": (lights('"frames": {}'), CaptureError, "frames should read"),
    "light path without places": (lights('"frames": {"0.png": {"on": 1}}'), CaptureError, "no frame has a place"),
    "light frame that says nothing": (lights('"xyz": [0, 0, 1], "frames": {"0.png": {"confidence": 1}}'), CaptureError,
                                      "0.png"),
    "light brighter than 1": (lights('"xyz": [0, 0, 1], "frames": {"0.png": {"on": 1.5}}'), CaptureError, "within 0"),
    "light path of three numbers": (lights('"frames": {"0.png": {"xy": [1, 2, 3]}}'), CaptureError, "two finite"),
    "light path of other frames": (lights('"frames": {"elsewhere.png": {"xy": [1, 2]}}'), CaptureError,
                                   "none of its frames"),
    "light twice": (put("lights.json", TWO_LIGHTS), CaptureError, "lights.json"),
    "lights is a folder": (folder_instead("lights.json"), CaptureError, "lights.json"),
    "split of an unknown frame": (put("split.json", '{"test": ["0007.png"]}'), CaptureError, "split.json"),
    "split not JSON": (put("split.json", "test: 1"), CaptureError, "split.json"),
    "split without test": (put("split.json", '{"val": []}'), CaptureError, "split.json"),
    "split of numbers": (put("split.json", '{"test": [1, 2]}'), CaptureError, "split.json"),
    "split that leaves nothing": (put("split.json", json.dumps({"test": [f"000{i}.png" for i in range(4)]})),
                                  CaptureError, "split.json"),
    "removed by half": (half_removed, CaptureError, "removed"),
    "truth of another shape": (frame_of_size(50, 50, "truth/scene/0001.png"), FrameError, "0001.png"),
    "truth damaged": (put("truth/flare/0001.exr", b"\x76\x2f\x31\x01"), FrameError, "0001.exr"),
}


def edit(change: Callable[[dict[str, object]], object]) -> Damage:
    def damage(folder: Path) -> None:
        meta = json.loads((folder / "transforms.json").read_text())
        change(meta)
        (folder / "transforms.json").write_text(json.dumps(meta))
    return damage


def in_frame(**values: object) -> Damage:
    return edit(lambda meta: meta["frames"][1].update(values))  # type: ignore[index]


def matrix(scale: float = 1.0, flip: float = 1.0) -> list[list[float]]:
    return (np.diag([scale, scale, scale * flip, 1.0])).tolist()


PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n"
TRANSFORMS_CASES: dict[str, tuple[Damage, type[FitFlareError], str]] = {
    "not JSON": (put("transforms.json", "{"), CaptureError, "transforms.json"),
    "a list": (put("transforms.json", "[1]"), CaptureError, "transforms.json"),
    "deep JSON": (put("transforms.json", "[" * 200000), CaptureError, "transforms.json"),
    "no frames": (edit(lambda meta: meta.update(frames=[])), CaptureError, "transforms.json"),
    "frames not a list": (edit(lambda meta: meta.update(frames=3)), CaptureError, "transforms.json"),
    "frame without path": (in_frame(file_path=None), CaptureError, "transforms.json"),
    "frame above the folder": (in_frame(file_path="../x.png"), CaptureError, "x.png"),
    "frame of half a letter": (in_frame(file_path="images/\ud800.png"), CaptureError, "ud800"),
    "frame is the folder": (in_frame(file_path="./"), CaptureError, "'.'"),
    "frame twice": (in_frame(file_path="images/0000.png"), CaptureError, "0000.png"),
    "pose of words": (in_frame(transform_matrix=[["a"] * 4] * 4), CaptureError, "0001.png"),
    "pose too small": (in_frame(transform_matrix=[[1, 0], [0, 1]]), CaptureError, "0001.png"),
    "pose ragged": (in_frame(transform_matrix=[[1, 0], [0]]), CaptureError, "0001.png"),
    "pose not finite": (in_frame(transform_matrix=[[float("nan")] * 4] * 4), CaptureError, "0001.png"),
    "pose too far": (in_frame(transform_matrix=[[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
                     CaptureError, "0001.png"),
    "pose scaled": (in_frame(transform_matrix=matrix(2.0)), CaptureError, "0001.png"),
    "pose mirrored": (in_frame(transform_matrix=matrix(1.0, -1.0)), CaptureError, "0001.png"),
    "pose missing": (in_frame(transform_matrix=None), CaptureError, "0001.png"),
    "focal length of words": (edit(lambda meta: meta.update(fl_x="long")), CaptureError, "fl_x"),
    "focal length absent": (edit(lambda meta: meta.pop("fl_x")), CaptureError, "camera_angle_x"),
    "focal length zero": (edit(lambda meta: meta.update(fl_x=0)), CaptureError, "focal"),
    "focal length absurd": (edit(lambda meta: meta.update(fl_x=10**400)), CaptureError, "fl_x"),
    "field of view absurd": (edit(lambda meta: (meta.pop("fl_x"), meta.update(camera_angle_x=7))), CaptureError,
                             "field of view"),
    "camera model unknown": (edit(lambda meta: meta.update(camera_model="ORTHOPHOTO")), CaptureError, "ORTHOPHOTO"),
    "k4 of a perspective camera": (edit(lambda meta: meta.update(k4=0.1)), CaptureError, "k4"),
    "points missing": (edit(lambda meta: meta.update(ply_file_path="points.ply")), CaptureError, "points.ply"),
    "points elsewhere": (edit(lambda meta: meta.update(ply_file_path="/points.ply")), CaptureError, "points.ply"),
}
for name, ply in {
    "points not PLY": b"solid", "points without end": PLY, "points without z": PLY + b"end_header\n",
    "points of absurd count": PLY.replace(b"9", b"9" * 17) + b"property float y\nproperty float z\nend_header\nxyz",
    "points of no count": PLY.replace(b"9", b"-9") + b"property float y\nproperty float z\nend_header\n" + bytes(108),
    "points past 64 bits": PLY.replace(b"9", b"9" * 20) + b"property float y\nproperty float z\nend_header\nxyz",
    "points of 5000 digits": PLY.replace(b"9", b"9" * 5000) + b"property float y\nproperty float z\nend_header\nxyz",
    "words past 64 bits": PLY.replace(b"binary_little_endian", b"ascii").replace(b"9", b"9" * 20)
                          + b"property float y\nproperty float z\nend_header\n1 2 3\n",
    "points cut": PLY + b"property float y\nproperty float z\nend_header\n" + bytes(50),
    "points with lists": PLY + b"property list uchar int y\nproperty float z\nend_header\n" + bytes(50),
    "points not finite": PLY + b"property float y\nproperty float z\nend_header\n" + b"\xff" * 108,
    "points of words": PLY.replace(b"binary_little_endian", b"ascii") + b"property float y\nproperty float z\n"
                       b"end_header\n" + b"a b c\n" * 9,
}.items():
    def damage(folder: Path, ply: bytes = ply) -> None:
        edit(lambda meta: meta.update(ply_file_path="points.ply"))(folder)
        put("points.ply", ply)(folder)
    TRANSFORMS_CASES[name] = (damage, CaptureError, "points.ply")


def check(folder: Path, error: type[FitFlareError], says: str) -> None:
    """Assert that the capture is refused by an error in one sentence that contains `says`, and that no file changed."""
    def state() -> dict[Path, int]:
        return {path: path.lstat().st_mtime_ns for path in sorted(folder.parent.rglob("*"))}

    before = state()
    with pytest.raises(FitFlareError) as caught:
        Capture.open(folder)
    message = str(caught.value)
    assert type(caught.value) is error
    assert says in message
    assert message.endswith(".") and "\n" not in message and len(message) < 400
    assert state() == before


@pytest.mark.parametrize("case", COLMAP_CASES)
def test_malformed_colmap_capture(tmp_path: Path, case: str) -> None:
    """A damaged COLMAP capture is refused with the message of its case."""
    damage, error, says = COLMAP_CASES[case]
    folder = make_capture(tmp_path / "c")
    damage(folder)
    check(folder, error, says)


@pytest.mark.parametrize("case", TRANSFORMS_CASES)
def test_malformed_transforms_capture(tmp_path: Path, case: str) -> None:
    """A capture with a damaged transforms.json is refused with the message of its case."""
    damage, error, says = TRANSFORMS_CASES[case]
    folder = make_transforms(tmp_path / "t")
    damage(folder)
    check(folder, error, says)


@pytest.mark.parametrize("kind", ["absent", "file", "empty"])
def test_a_folder_without_a_capture_is_refused(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "c"
    if kind == "file":
        folder.write_text("")
    elif kind == "empty":
        folder.mkdir()
    check(folder, CaptureError, "c")


def test_a_truncated_frame_is_reported_when_it_is_decoded(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    path = folder / "images" / "0001.png"
    path.write_bytes(path.read_bytes()[:200])
    capture = Capture.open(folder)
    capture.frame(capture.views[0])
    with pytest.raises(FrameError, match=r"0001\.png"):
        capture.frame(capture.views[1])


@pytest.mark.parametrize("holdout", ["-3", -1, 1, "1", "no such file.json", "split.json/"])
def test_an_invalid_holdout_is_refused(tmp_path: Path, holdout: str | int) -> None:
    capture = Capture.open(make_capture(tmp_path / "c"))
    with pytest.raises(CaptureError):
        capture.split(holdout)


@pytest.mark.parametrize("form", ["binary", "text", "transforms"])
def test_random_damage_raises_our_errors(tmp_path: Path, form: str) -> None:
    """Any bytes may change: the capture opens, or one of our errors says why it does not."""
    folder = make_transforms(tmp_path / "c") if form == "transforms" else make_capture(tmp_path / "c")
    if form == "binary":
        binary(folder)
    files = [folder / "transforms.json"] if form == "transforms" else sorted((folder / SPARSE).glob("*.*"))
    files = [file for file in files if file.stem in ("transforms", "cameras", "images", "points3D")]
    rng = np.random.default_rng(0)
    outcomes = {"opened": 0, "refused": 0}
    for trial in range(240):
        file = files[trial % len(files)]
        whole = file.read_bytes()
        data = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(data)))
            data[at:at + int(rng.integers(1, 9))] = rng.integers(0, 256, rng.integers(0, 9), np.uint8).tobytes()
        file.write_bytes(data)
        try:
            Capture.open(folder)
            outcomes["opened"] += 1
        except FitFlareError as problem:
            assert str(problem).endswith(".")
            outcomes["refused"] += 1
        file.write_bytes(whole)
    assert outcomes["refused"] > 20
