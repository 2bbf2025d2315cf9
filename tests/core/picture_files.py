# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes one synthetic scene as files of many formats, each with the colours that it declares."""
from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813 - as its own documents do
from numpy.typing import NDArray

from core.colour import colour_space
from core.colour.icc import _to_d50
from core.colour.spaces import P3_D65, Chromaticities, matrix_to_xyz
from core.images.formats import jpeg, png, tiff
from core.images.write import write_exr
from tests.core.videos import write_video


def scene(width: int = 96, height: int = 64, level: float = 0.7) -> NDArray[np.float32]:
    """Scene-linear Rec. 709 light (height, width, 3): smooth ramps of muted colours, up to `level`."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    light = np.stack([0.2 + 0.8 * x, 0.25 + 0.6 * y, 0.3 + 0.5 * (1 - x) * (1 - y)], -1)
    return (light * level).astype(np.float32)


def profile(chromaticities: Chromaticities, gamma: float | None = None) -> bytes:
    """Return an ICC profile (version 4) of these primaries with a power of `gamma` as its curve; None: sRGB's curve."""
    columns = _to_d50(matrix_to_xyz(chromaticities)).T
    curve = (struct.pack(">4sIHH5i", b"para", 0, 3, 0, *(round(n * 65536) for n in (
        2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))) if gamma is None
        else struct.pack(">4sIHHi", b"para", 0, 0, 0, round(gamma * 65536)))
    blocks = [(name, struct.pack(">4sI3i", b"XYZ ", 0, *(round(n * 65536) for n in column)))
              for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns, strict=True)]
    blocks += [(name, curve) for name in (b"rTRC", b"gTRC", b"bTRC")]
    at, table, body = 132 + 12 * len(blocks), b"", b""
    for name, block in blocks:
        table += struct.pack(">4sII", name, at + len(body), len(block))
        body += block
    head = struct.pack(">I4s4s4s4s4s12s4s", at + len(body), b"test", b"\4\0\0\0", b"mntr", b"RGB ", b"XYZ ", bytes(12),
                       b"acsp").ljust(128, b"\0")
    return head + struct.pack(">I", len(blocks)) + table + body


def png_16(path: Path, values: NDArray[Any], *chunks: tuple[bytes, bytes]) -> None:
    """Write values 0..1 as 16 bit PNG with chunks before its pixels."""
    data = cv2.imencode(".png", (np.clip(values, 0, 1) * 65535 + 0.5).astype(np.uint16)[..., ::-1])[1].tobytes()
    path.write_bytes(data[:33] + b"".join(png.make_chunk(*chunk) for chunk in chunks) + data[33:])


def by_oiio(path: Path, values: NDArray[Any], kind: Any, attributes: dict[str, Any] | None = None) -> None:
    """Write values with OpenImageIO, (height, width, channels)."""
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], kind)
    for name, value in (attributes or {}).items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.ascontiguousarray(values)) and output.close()


def luminance_and_chroma(path: Path, light: NDArray[np.float32]) -> None:
    """Write light (h, w, 3) as an uncompressed half-float EXR of Y, and RY and BY at half resolution."""
    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    height, width = light.shape[:2]
    luminance = light @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    red, blue = (((light[..., k] - luminance) / np.maximum(luminance, 1e-6)).astype("<f2") for k in (0, 2))
    channels = b"".join(name + b"\0" + struct.pack("<iIii", 1, 0, step, step)
                        for name, step in ((b"BY", 2), (b"RY", 2), (b"Y", 1)))
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = b"".join([b"\x76\x2f\x31\x01\x02\0\0\0", attribute(b"channels", b"chlist", channels + b"\0"),
                       attribute(b"compression", b"compression", b"\0"), attribute(b"dataWindow", b"box2i", window),
                       attribute(b"displayWindow", b"box2i", window), attribute(b"lineOrder", b"lineOrder", b"\0"),
                       attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
                       attribute(b"screenWindowCenter", b"v2f", bytes(8)),
                       attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)), b"\0"])
    lines = []
    for y in range(height):
        row = (b"" if y % 2 else blue[y, ::2].tobytes() + red[y, ::2].tobytes()) + luminance[y].astype("<f2").tobytes()
        lines.append(struct.pack("<ii", y, len(row)) + row)
    starts = np.cumsum([len(header) + 8 * height, *map(len, lines[:-1])])
    path.write_bytes(header + struct.pack(f"<{height}Q", *starts.tolist()) + b"".join(lines))


def p3_jpeg(path: Path, light: NDArray[np.float32]) -> None:
    """Write a JPEG of Display P3, with its profile."""
    codes = (np.clip(colour_space("display-p3").from_linear(light), 0, 1) * 255 + 0.5).astype(np.uint8)
    data = cv2.imencode(".jpg", codes[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    segment = jpeg.make_segment(jpeg.APP2, b"ICC_PROFILE\0\1\1" + profile(P3_D65))
    path.write_bytes(data[:2] + segment + data[2:])


def heic(path: Path, light: NDArray[np.float32]) -> None:
    """Write a HEIC of sRGB."""
    import pillow_heif

    codes = (np.clip(colour_space("srgb").from_linear(light), 0, 1) * 255 + 0.5).astype(np.uint8)
    pillow_heif.from_bytes("RGB", (codes.shape[1], codes.shape[0]), codes.tobytes()).save(path, quality=100)


def avif(path: Path, light: NDArray[np.float32]) -> None:
    """Write an AVIF of 10 bits in PQ, with its code points."""
    signal = np.clip(colour_space("pq").from_linear(light), 0, 1)
    write_video(path, "libsvtav1", "yuv420p10le", [signal], matrix=9, tags=(9, 16, 9), full=True,
                options={"crf": "1", "preset": "8"})


def tiff_16(path: Path, values: NDArray[Any], tags: dict[int, tiff.Tag] | None = None) -> None:
    """Write values 0..1 as 16 bit TIFF with tags."""
    data = cv2.imencode(".tif", (np.clip(values, 0, 1) * 65535 + 0.5).astype(np.uint16)[..., ::-1])[1].tobytes()
    path.write_bytes(tiff.with_tags(data, tags or {}))


def _encoded(light: NDArray[np.float32], space: str) -> NDArray[np.float32]:
    return colour_space(space).from_linear(light)


WRITERS: dict[str, tuple[str, str, Callable[[Path, NDArray[np.float32]], None]]] = {
    "sRGB PNG": ("a.png", "", lambda path, light: png_16(path, _encoded(light, "srgb"))),
    "linear PNG": ("a.png", "", lambda path, light: png_16(path, light, (b"gAMA", (100_000).to_bytes(4, "big")))),
    "PQ PNG": ("a.png", "", lambda path, light: png_16(path, _encoded(light, "pq"), (b"cICP", bytes((9, 16, 0, 1))))),
    "HLG PNG": ("a.png", "", lambda path, light: png_16(path, _encoded(light, "hlg"), (b"cICP", bytes((9, 18, 0, 1))))),
    "Adobe RGB TIFF": ("a.tif", "", lambda path, light: tiff_16(path, _encoded(light, "adobergb"), {
        tiff.COLOUR_PROFILE: tiff.Tag(7, np.frombuffer(profile((0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.329),
                                                               563 / 256), np.uint8))})),
    "LogC4 TIFF": ("a.tif", "logc4", lambda path, light: tiff_16(path, _encoded(light, "logc4"))),
    "S-Log3 DPX": ("a.dpx", "slog3-cine", lambda path, light: by_oiio(path, _encoded(light, "slog3-cine"),
                                                                        oiio.UINT16)),
    "ACEScg EXR": ("a.exr", "", lambda path, light: write_exr(
        path, dict(zip("RGB", np.moveaxis(_encoded(light, "acescg"), 2, 0), strict=True)),
        header={"chromaticities": colour_space("acescg").chromaticities})),
    "Y/RY/BY EXR": ("a.exr", "", luminance_and_chroma),
    "log DPX": ("a.dpx", "", lambda path, light: by_oiio(path, _encoded(light, "cineon"), oiio.UINT16, {
        "oiio:BitsPerSample": 10, "dpx:Transfer": "Printing density"})),
    "video DPX": ("a.dpx", "", lambda path, light: by_oiio(path, _encoded(light, "rec709"), oiio.UINT16, {
        "oiio:BitsPerSample": 10, "dpx:Transfer": "ITU-R 709-4"})),
    "P3 JPEG": ("a.jpg", "", p3_jpeg),
    "HEIC": ("a.heic", "", heic),
    "PQ AVIF": ("a.avif", "", avif),
    "WebP": ("a.webp", "", lambda path, light: by_oiio(path, _encoded(light, "srgb"), oiio.UINT8,
                                                       {"compression": "lossless"})),
    "BMP": ("a.bmp", "", lambda path, light: by_oiio(path, _encoded(light, "srgb"), oiio.UINT8)),
    "Targa": ("a.tga", "", lambda path, light: by_oiio(path, _encoded(light, "srgb"), oiio.UINT8)),
    "Radiance HDR": ("a.hdr", "", lambda path, light: by_oiio(path, light, oiio.FLOAT)),
    "half TIFF": ("a.tif", "", lambda path, light: by_oiio(path, light, oiio.HALF)),
    "planar TIFF": ("a.tif", "", lambda path, light: by_oiio(path, _encoded(light, "srgb"), oiio.UINT16,
                                                             {"planarconfig": "separate"})),
    "10 bit TIFF": ("a.tif", "", lambda path, light: by_oiio(path, _encoded(light, "srgb"), oiio.UINT16,
                                                             {"oiio:BitsPerSample": 10})),
    "BigTIFF": ("a.tif", "", lambda path, light: by_oiio(path, _encoded(light, "srgb"), oiio.UINT16,
                                                         {"tiff:bigtiff": 1})),
    "JPEG 2000": ("a.jp2", "", lambda path, light: path.write_bytes(cv2.imencode(".jp2", (
        np.clip(_encoded(light, "srgb"), 0, 1) * 65535 + 0.5).astype(np.uint16)[..., ::-1])[1].tobytes())),
}
"""File name, space to name, and writer of each format."""
