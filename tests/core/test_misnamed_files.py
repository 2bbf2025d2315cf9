# SPDX-License-Identifier: GPL-3.0-or-later
"""Files whose name is of another format: read by their contents, written as what they are, or refused with the right
name."""
from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from core.capture.solve.source_frames import prepare_frames
from core.colour import colour_space
from core.colour.spaces import P3_D65
from core.errors import CaptureError, FrameError
from core.images.decoders import file_kind
from core.images.formats.exif import read_exif
from core.images.listing import unlisted_entries
from core.images.plates import clean_name, read_plate, write_plate
from core.images.read import has_float_pixels, has_half_pixels, read_picture
from core.images.write import write_exr
from core.system.progress import Progress
from tests.core.picture_files import p3_jpeg, profile, scene
from tests.core.videos import stripes, write_video


def write_files(folder: Path) -> dict[str, Path]:
    """Write the same picture as PNG, JPEG, TIFF, WebP and EXR; return the paths by kind."""
    light = scene(48, 32)
    codes = (np.clip(colour_space("srgb").from_linear(light), 0, 1) * 255 + 0.5).astype(np.uint8)
    cv2.imwrite(str(folder / "a.png"), codes[..., ::-1])
    p3_jpeg(folder / "a.jpg", light)
    cv2.imwrite(str(folder / "a.tif"), codes[..., ::-1].astype(np.uint16) * 257)
    Image.fromarray(codes).save(folder / "a.webp", lossless=True, icc_profile=profile(P3_D65))
    write_exr(folder / "a.exr", {name: light[..., k] for k, name in enumerate("RGB")})
    return {kind: folder / f"a.{suffix}" for kind, suffix in (
        ("png", "png"), ("jpeg", "jpg"), ("tiff", "tif"), ("webp", "webp"), ("exr", "exr"))}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".exr", ".dpx", ".heic", ".tga"])
@pytest.mark.parametrize("kind", ["png", "jpeg", "tiff", "webp", "exr"])
def test_a_clean_plate_is_of_the_format_of_its_plate_whatever_the_name(kind: str, suffix: str, tmp_path: Path) -> None:
    source = write_files(tmp_path)[kind]
    named = Path(shutil.copy(source, tmp_path / f"named{suffix}"))
    picture = read_picture(named)
    np.testing.assert_array_equal(picture.pixels, read_picture(source).pixels)
    plate = read_plate(named)
    target = tmp_path / "clean" / clean_name(named).name
    target.parent.mkdir()
    write_plate(target, plate, plate.codes // 2 if plate.codes.dtype.kind == "u" else plate.codes / np.float16(2))
    if suffix != ".heic":
        assert file_kind(target) == kind
        is_told = "whatever its name" in plate.warning and "whatever its name" not in read_plate(source).warning
        assert is_told == (suffix != source.suffix)
    elif kind != "exr":
        assert file_kind(target) == "png"
    clean = read_picture(target)
    before, after = (np.asarray(each.linear().mean((0, 1))) for each in (picture, clean))
    np.testing.assert_allclose(after / after.sum(), before / before.sum(), atol=0.03)  # no change of primaries
    assert after.sum() < before.sum()


def test_kinds_of_pixels_are_those_of_the_contents(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    exr = Path(shutil.copy(files["exr"], tmp_path / "e.png"))
    picture = Path(shutil.copy(files["png"], tmp_path / "p.exr"))
    assert has_float_pixels(exr) and has_half_pixels(exr)
    assert not has_float_pixels(picture) and not has_half_pixels(picture)


def test_a_jpeg_that_becomes_a_png_keeps_colours_and_orientation(tmp_path: Path) -> None:
    """As the clean frames of a capture."""
    light = scene(48, 32)
    codes = (np.clip(colour_space("display-p3").from_linear(light), 0, 1) * 255 + 0.5).astype(np.uint8)
    exif = Image.Exif()
    exif[0x112], exif[0x13b] = 6, "Ada"
    Image.fromarray(codes).save(tmp_path / "a.jpg", quality=98, exif=exif, icc_profile=profile(P3_D65))
    plate = read_plate(tmp_path / "a.jpg")
    changed = plate.codes.copy()
    changed[0] = 0
    write_plate(tmp_path / "a.png", plate, changed)
    clean, before = (read_picture(tmp_path / name).pixels for name in ("a.png", "a.jpg"))
    np.testing.assert_array_equal(clean[1:], before[1:])
    assert read_exif(tmp_path / "a.png")[0] == 6
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.getexif()[0x13b] == "Ada"


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("clip") / "a.mp4", "libx264", "yuv420p", [stripes(32)])


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.exr", "a.tga", "a"])
def test_a_video_with_the_name_of_a_picture_is_called_a_video(clip: Path, name: str, tmp_path: Path) -> None:
    path = Path(shutil.copy(clip, tmp_path / name))
    for read in (read_picture, read_plate):
        with pytest.raises(FrameError, match=f"{name} holds a video.*give it the suffix of its format"):
            read(path)
    with pytest.raises(CaptureError, match="neither a folder of frames nor a video: it holds a video; give it"):
        prepare_frames(path, tmp_path / "work", 0, 100, Progress())


def test_a_picture_without_a_suffix_is_named(tmp_path: Path) -> None:
    path = Path(shutil.copy(write_files(tmp_path)["webp"], tmp_path / "download"))
    with pytest.raises(FrameError, match=r"download holds WEBP data; give it the suffix \.webp"):
        read_picture(path)


def test_a_video_in_a_folder_of_pictures_has_a_reason(clip: Path, tmp_path: Path) -> None:
    shutil.copy(clip, tmp_path / "a.mp4")
    assert unlisted_entries(tmp_path) == [("a video, which is read by its own name", ["a.mp4"])]


def test_a_solve_of_a_folder_without_frames_names_what_it_could_read(clip: Path, tmp_path: Path) -> None:
    for name in ("left", "right", "notes"):
        (tmp_path / "shot" / name).mkdir(parents=True)
        (tmp_path / "shot" / name / "a.txt").write_text("")
    with pytest.raises(CaptureError, match="shot holds no frames; give a folder with PNG"):
        prepare_frames(tmp_path / "shot", tmp_path / "work", 0, 100, Progress())
    write_files(tmp_path / "shot" / "left")
    with pytest.raises(CaptureError, match="shot holds no frames; left in it does: name that"):
        prepare_frames(tmp_path / "shot", tmp_path / "work", 0, 100, Progress())
    shutil.copy(clip, tmp_path / "shot" / "a.mp4")
    with pytest.raises(CaptureError, match=r"shot holds no frames; .*left.* in it do: name one of them"):
        prepare_frames(tmp_path / "shot", tmp_path / "work", 0, 100, Progress())
