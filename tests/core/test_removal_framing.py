# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates of any shape before the network: transparent ones, panoramas and long ones."""
from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray

from core.images.panorama import wraps_around
from core.images.plates import Plate, read_plate
from core.images.write import write_exr
from core.removal.inference.framing import (
    MAX_ASPECT,
    fill_hidden,
    input_size,
    merge_margins,
    predict_in_parts,
    wrap_columns,
    wrap_margin,
)
from core.removal.inference.remover import Remover
from tests.core.removal_cases import picture

GPANO = ('<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
         '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}/></rdf:RDF></x:xmpmeta>')
FULL = 'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="128"'


# ---- alpha ----------------------------------------------------------------------------------------


def with_hidden(path: Path, hidden: int | None, dtype: type = np.uint8) -> Path:
    """Write a picture that is transparent outside an ellipse; return its path.

    hidden: code of the transparent pixels' colour, 0..255; None keeps the picture there.
    """
    top = np.iinfo(dtype).max
    codes = picture(96, 144, top, dtype)
    rows, columns = np.mgrid[:96, :144]
    inside = np.clip(1.5 - np.hypot((rows - 48) / 40, (columns - 72) / 60), 0, 0.5) * 2  # with a soft edge
    alpha = (inside * top).astype(dtype)
    if hidden is not None:
        codes[alpha == 0] = hidden * (top // 255)
    assert cv2.imwrite(str(path), np.concatenate([codes, alpha[..., None]], -1))
    return path


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint8)])
def test_hidden_colours_change_nothing(flare_everywhere: Path, tmp_path: Path, suffix: str, dtype: type) -> None:
    """Colours under full transparency stay as they are and do not change the result elsewhere."""
    remover = Remover(flare_everywhere, working_size=64)
    plates = [read_plate(with_hidden(tmp_path / f"{hidden}{suffix}", hidden, dtype)) for hidden in (None, 0, 255, 90)]
    results = [remover.remove(plate) for plate in plates]
    first_alpha = plates[0].alpha
    assert first_alpha is not None
    hidden = first_alpha == 0
    for plate, (codes, flare) in zip(plates, results, strict=True):
        np.testing.assert_array_equal(codes[~hidden], results[0][0][~hidden])
        np.testing.assert_array_equal(codes[hidden], plate.codes[hidden])
        np.testing.assert_array_equal(flare, results[0][1])
    assert (results[0][0][~hidden] < plates[0].codes[~hidden]).mean() > 0.3  # the test's network sees red flares
    assert not results[0][1][hidden].any()


def test_hidden_parts_continue_the_picture(tmp_path: Path) -> None:
    filled = fill_hidden(read_plate(with_hidden(tmp_path / "a.png", 255)))
    codes, hidden = filled.codes.astype(int), cv2.imread(str(tmp_path / "a.png"), -1)[..., 3] == 0
    seen = codes[~hidden]
    assert filled.alpha is None
    assert (codes[hidden] >= seen.min(0)).all()
    assert (codes[hidden] <= seen.max(0)).all()
    opaque = Plate(tmp_path / "a.png", picture(), "srgb", alpha=np.full((60, 90), 255, np.uint8))
    assert fill_hidden(opaque) is opaque


# ---- panoramas ------------------------------------------------------------------------------------


def write_png(path: Path, codes: NDArray[Any], chunk: tuple[bytes, bytes] | None = None) -> Path:
    """Write a PNG with a further chunk (name, body) after its header, if one is given; return the path."""
    done, data = cv2.imencode(".png", codes)
    assert done
    content = data.tobytes()
    if chunk is not None:
        name, body = chunk
        packed = len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
        content = content[:33] + packed + content[33:]
    path.write_bytes(content)
    return path


def xmp_chunk(properties: str, compressed: bool = False) -> tuple[bytes, bytes]:
    packet = GPANO.format(properties).encode()
    flags, packet = (b"\1\0", zlib.compress(packet)) if compressed else (b"\0\0", packet)
    return b"iTXt", b"XML:com.adobe.xmp\0" + flags + b"\0\0" + packet


@pytest.mark.parametrize(("properties", "compressed", "expected"), [
    (FULL, False, True),
    (FULL, True, True),
    (FULL + ' GPano:CroppedAreaImageWidthPixels="128"', False, True),
    (FULL + ' GPano:CroppedAreaImageWidthPixels="100"', False, False),  # a part of the circle
    ('GPano:ProjectionType="cylindrical"', False, True),
    ('GPano:ProjectionType="rectilinear"', False, False),
    ("", False, False),
])
def test_a_png_says_that_it_is_a_panorama(tmp_path: Path, properties: str, compressed: bool, expected: bool) -> None:
    path = write_png(tmp_path / "a.png", picture(), xmp_chunk(properties, compressed))
    assert wraps_around(path) is expected


def test_jpeg_tiff_and_exr_say_that_they_are_panoramas(tmp_path: Path) -> None:
    element = (b"<rdf:Description><GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
               b"</rdf:Description>")
    jpeg = cv2.imencode(".jpg", picture())[1].tobytes()
    body = b"http://ns.adobe.com/xap/1.0/\0" + element
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + jpeg[2:])
    assert wraps_around(tmp_path / "a.jpg")
    assert cv2.imwrite(str(tmp_path / "a.tif"), picture())
    assert not wraps_around(tmp_path / "a.tif")
    (tmp_path / "a.tif").write_bytes((tmp_path / "a.tif").read_bytes() + element)  # where a tag may point to
    assert wraps_around(tmp_path / "a.tif")
    for kind, expected in ((OpenEXR.ENVMAP_LATLONG, True), (OpenEXR.ENVMAP_CUBE, False), (None, False)):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        channels = {name: np.zeros((8, 16), np.float16) for name in "RGB"}
        with OpenEXR.File(header if kind is None else {**header, "envmap": kind}, channels) as file:
            file.write(str(tmp_path / "a.exr"))
        plate = read_plate(tmp_path / "a.exr")
        assert wraps_around(plate.path, plate.extras["header"]) is expected
    assert not wraps_around(tmp_path / "missing.jpg")


def circle(height: int, start: int = 0) -> np.ndarray[Any, Any]:
    """Codes (height, 2 height, 3) of a panorama without tags, from its column `start` on."""
    coarse = np.random.default_rng(0).uniform(0, 255, (6, 12, 3)).astype(np.float32)
    wide = cv2.resize(np.concatenate([coarse, coarse], 1), (4 * height, height), interpolation=cv2.INTER_CUBIC)
    return wide[:, height + start:3 * height + start].clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("change", ["", "part", "3:2", "flat", "mirrored"])
@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_a_picture_whose_sides_meet_is_a_panorama(tmp_path: Path, change: str, suffix: str) -> None:
    codes = circle(96, 40)
    if change == "part":
        codes = cv2.resize(codes[:48, :96], (192, 96))
    elif change == "3:2":
        codes = np.ascontiguousarray(codes[:, :144])
    elif change == "flat":
        codes[:] = 120
    elif change == "mirrored":
        codes[:, 96:] = codes[:, 96:][:, ::-1]
    path = tmp_path / f"a{suffix}"
    if suffix == ".png":
        cv2.imwrite(str(path), codes)
    else:
        write_exr(path, {name: (codes[..., k] / np.float32(255)) ** 2.2 for k, name in enumerate("RGB")})
    assert (wrap_margin(read_plate(path)) > 0) == (change == "")


def test_a_panorama_has_no_seam(flare_everywhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a network that predicts more flare towards the right, the flare of a panorama still joins at its sides."""
    remover = Remover(flare_everywhere, working_size=128)
    monkeypatch.setattr(remover, "linear_flare", lambda prediction, **_: np.broadcast_to(
        np.linspace(0.01, 0.1, prediction.display.shape[1], dtype=np.float32)[None, :, None], prediction.display.shape))
    codes = np.full((64, 128, 3), 200, np.uint8)
    steps = {}
    for name, chunk in (("flat", None), ("panorama", xmp_chunk(FULL))):
        flare = remover.remove(read_plate(write_png(tmp_path / f"{name}.png", codes, chunk)))[1].astype(np.float32)
        steps[name] = np.abs(flare[:, 0] - flare[:, -1]).mean() / np.abs(np.diff(flare, axis=1)).mean()
    assert steps["panorama"] < 3 < steps["flat"]


def test_the_margins_of_a_panorama_merge_to_the_whole() -> None:
    light = np.random.default_rng(0).random((4, 40, 3)).astype(np.float32)
    np.testing.assert_allclose(merge_margins(wrap_columns(light, 10), 10), light, atol=1e-6)
    assert wrap_columns(light, 0) is light
    ramp = np.broadcast_to(np.arange(60, dtype=np.float32)[None, :, None], (1, 60, 3))
    merged = merge_margins(ramp, 10)[0, :, 0]  # the predictions of an edge differ by 40
    assert abs(merged[0] - merged[-1]) < 6
    np.testing.assert_array_equal(merged[10:30], ramp[0, 20:40, 0])


# ---- long pictures --------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(480, 270), (270, 480), (478, 200), (320, 320), (4096, 1716)])
def test_usual_pictures_have_the_working_size(size: tuple[int, int]) -> None:
    assert max(input_size(*size, 480)) == 480
    assert max(input_size(*size, 64)) == 64


@pytest.mark.parametrize(("size", "expected"), [((3072, 512), (1440, 256)), ((512, 3072), (256, 1440)),
                                                ((20000, 10), (15360, 64))])
def test_long_pictures_keep_their_short_side(size: tuple[int, int], expected: tuple[int, int]) -> None:
    columns, rows = input_size(*size, 480)
    assert columns % 32 == rows % 32 == 0
    assert (abs(columns - expected[0]) <= 32, abs(rows - expected[1]) <= 32) == (True, True)


@pytest.mark.parametrize("shape", [(64, 64 * 6), (64 * 6, 64), (32, 32 * 50), (64, 224)])
def test_parts_of_a_long_picture_overlap(shape: tuple[int, int]) -> None:
    display = np.random.default_rng(0).random((*shape, 3)).astype(np.float32)
    sizes = []

    def predict(part: NDArray[np.float32]) -> NDArray[np.float32]:
        sizes.append(part.shape[:2])
        return np.concatenate([part, 1 - part], -1)

    merged = predict_in_parts(display, predict)
    np.testing.assert_allclose(merged, np.concatenate([display, 1 - display], -1), atol=1e-5)
    assert all(max(size) == 2 * min(size) for size in sizes)
    assert len(sizes) >= max(shape) / min(shape) - 1
    whole = np.zeros((32, int(32 * MAX_ASPECT), 3), np.float32)
    assert predict_in_parts(whole, lambda part: part) is whole


def test_a_long_picture_is_cleaned_as_its_parts(flare_everywhere: Path) -> None:
    remover = Remover(flare_everywhere, working_size=64)
    codes = np.tile(picture(64, 64), (1, 6, 1))
    clean = remover.remove(Plate(Path("a.png"), codes, "srgb"))[0]
    assert (clean.astype(int) < codes).mean() > 0.3  # the test's network sees red flares
