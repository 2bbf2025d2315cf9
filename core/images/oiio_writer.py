# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes clean plates of the formats that OpenCV and OpenEXR do not write: lossless, with the header of the plate.

OpenImageIO writes them but WebP, whose profile, Exif and XMP only Pillow writes, and those tags of a TIFF that it does
not know, such as a map's place. `plates.write_plate` calls it.
"""
from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..system.files import atomic_path
from ..system.reading import check_regular
from .decoders import file_kind, open_oiio
from .formats.exif import without_thumbnail
from .metadata import copy_metadata
from .unsupported import needs_openimageio

OIIO_FORMATS = {".dpx": "dpx", ".webp": "webp", ".bmp": "bmp", ".tga": "targa", ".tif": "tiff", ".tiff": "tiff"}
"""OpenImageIO's names of the formats that it writes here."""


def needs_oiio_writer(path: Path) -> bool:
    """Return whether OpenCV cannot write a plate as it is stored."""
    kind = file_kind(path)
    return kind in ("dpx", "cineon", "webp", "bmp", "tga") or (kind == "tiff" and needs_openimageio(path))


def write_by_oiio(path: Path, source: Path, codes: NDArray[Any], alpha: NDArray[Any] | None, suffix: str) -> None:
    """Write codes (height, width, 1 or 3) and straight alpha (height, width) with the header of `source`.

    suffix: chooses the format, a key of OIIO_FORMATS; the suffix of `path` has no effect. Raises FrameError.
    """
    if suffix == ".webp":
        _write_webp(path, source, codes, alpha)
        return
    import OpenImageIO as oiio  # noqa: N813 - as its own documents do

    pixels = codes if alpha is None else np.concatenate([codes, alpha[..., None]], -1)
    format_name = OIIO_FORMATS[suffix]
    image_input = open_oiio(source)
    try:
        spec = image_input.spec().copy()
    finally:
        image_input.close()
    names = ("R", "G", "B") if codes.shape[2] == 3 else ("Y",)
    spec.nchannels, spec.channelnames = pixels.shape[2], (*names, "A")[:pixels.shape[2]]
    spec.alpha_channel = pixels.shape[2] - 1 if alpha is not None else -1
    types = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float16": oiio.HALF}
    spec.set_format(types.get(codes.dtype.name, oiio.FLOAT))
    spec.channelformats = ()
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if format_name == "dpx" and file_kind(source) == "cineon":  # a Cineon's codes are film density in 10 bits
        spec.attribute("dpx:Transfer", "Printing density")
        spec.attribute("oiio:BitsPerSample", 10)
    if format_name == "tiff":
        spec.attribute("planarconfig", "contig")
        compression = spec.get_string_attribute("compression")
        if compression in ("jpeg", "webp", "lerc"):  # lossy
            spec.attribute("compression", "zip")
    with atomic_path(path) as temporary:
        output = oiio.ImageOutput.create(format_name)
        is_written = (output is not None and output.open(str(temporary), spec)
                      and output.write_image(np.ascontiguousarray(pixels)) and output.close())
        if not is_written:
            raise FrameError(f"{path} could not be encoded as {suffix[1:].upper()} "
                             f"({output.geterror() if output is not None else oiio.geterror()}).")
        if format_name == "tiff":
            temporary.write_bytes(copy_metadata(temporary.read_bytes(), source, has_alpha=alpha is not None))


def _write_webp(path: Path, source: Path, codes: NDArray[Any], alpha: NDArray[Any] | None) -> None:
    """Write a lossless WebP with the profile, Exif and XMP of `source`. Raises FrameError.

    codes: 8 bit, grey or R G B (height, width, 1 or 3). alpha: (height, width) or None.
    """
    from PIL import Image

    check_regular(source)
    try:
        with Image.open(source) as stored:
            metadata = {name: stored.info[name] for name in ("icc_profile", "exif", "xmp") if stored.info.get(name)}
        if "exif" in metadata:
            metadata["exif"] = without_thumbnail(metadata["exif"].removeprefix(b"Exif\0\0"))
        colours = np.repeat(codes, 3, -1) if codes.shape[2] == 1 else codes
        pixels = colours if alpha is None else np.concatenate([colours, alpha[..., None]], -1)
        encoded = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(encoded, "WEBP", lossless=True, exact=True, **metadata)
    except (OSError, ValueError) as problem:
        raise FrameError(f"{path} could not be encoded as WebP ({problem}).") from problem
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.getvalue())
