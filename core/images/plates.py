# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes plates: picture files as delivered, without loss of depth, channels or colour tags.

A plate keeps its file's code values (8 or 16 bit, half or full floats), its alpha, an EXR's other channels and header,
and the colour profile and tags of other files. Pixels that removal or transfer does not touch are written back to the
last bit; an unchanged plate is copied.
"""
from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourSpace, colour_space, space_of_chromaticities
from ..colour.srgb import LUMINANCE, srgb_from_linear
from ..errors import FrameError, SettingsError, is_out_of_memory
from ..system.files import atomic_path
from ..system.reading import open_regular
from .borders import PictureArea, find_picture_area
from .declared import declared_space, jpeg_profile
from .decoders import Description, describe, file_kind, profile_space
from .exr import has_chroma, is_exr, main_part, missing_rgb_error, read_exr_parts, read_luminance_chroma
from .exr_views import check_parts, stereo_views
from .formats import jpeg, png, tiff
from .formats.exif import upright_block
from .formats.kinds import JPEG_SUFFIXES, SUFFIX_OF_KIND
from .formats.kinds import SUFFIXES as SUFFIX_KINDS
from .listing import SUFFIXES
from .metadata import copy_metadata, dropped_parts_warning, with_colour_chunks, with_description
from .oiio_writer import OIIO_FORMATS, needs_oiio_writer, write_by_oiio
from .picture import Encoding
from .read import read_stored_pixels, rgb_codes
from .size import picture_size
from .unsupported import unsupported_file_error
from .write import MAX_HALF, save_exr_parts, write_exr

_PLACEMENT = ("chromaticities", "dataWindow", "displayWindow", "pixelAspectRatio")
"""Attributes that give another EXR a plate's windows and colours."""
_UNWRITTEN = ("heif", "avif", "jxl", "jp2", "gif", "psd")
"""Formats whose clean plates are PNG."""
_JPEG_QUALITY = 97
"""OpenCV's quality of JPEG, up to 100."""
_JPEGS, _TIFFS = JPEG_SUFFIXES, (".tif", ".tiff")
_DEPTHS: dict[str, tuple[type, ...]] = {".png": (np.uint8, np.uint16), **dict.fromkeys(_JPEGS, (np.uint8,))}
"""Pixel types by suffix, for formats that cannot hold every plate; OpenCV would convert others to 8 bit silently."""


@dataclass
class Plate:
    """A picture file with its code values.

    codes: (height, width, 3), the file's type, R G B; a grey file has three equal channels. encoding: "srgb" for
    integer codes, "linear" for floats. alpha: (height, width), codes as stored; None for a file without, and for an
    EXR, whose alpha is one of its channels. extras: empty but for an EXR, which has the "header" and all "channels" of
    its main part, and the "names" of the channels that hold the codes; with several parts also "parts" (header and
    channels of each) and "main" (the main part's index). declared: the space that the file declares, or that the user
    names; None for the default of its encoding.
    """

    path: Path
    codes: NDArray[Any]
    encoding: Encoding
    grey: bool = False
    alpha: NDArray[Any] | None = None
    extras: dict[str, Any] = field(default_factory=dict)
    declared: ColourSpace | None = None

    @property
    def max_code(self) -> float:
        """The code of the value 1: the greatest integer of the type, or 1 of floats."""
        return float(np.iinfo(self.codes.dtype).max) if self.codes.dtype.kind == "u" else 1.0

    @property
    def values(self) -> NDArray[np.float32]:
        """(height, width, 3) codes as 0..1, floats as they are, in the plate's colour space."""
        return self.codes.astype(np.float32) / np.float32(self.max_code)

    def to_plate_channels(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return linear light (height, width, 3) as the plate can show it: its luminance where the plate is grey."""
        return np.repeat(light @ LUMINANCE.astype(np.float32)[:, None], 3, -1) if self.grey else light

    @cached_property
    def picture_area(self) -> PictureArea:
        """The area inside its black borders."""
        if self.encoding == "srgb":
            return find_picture_area(self.codes, lambda line: line / self.max_code)
        return find_picture_area(self.codes, lambda line: srgb_from_linear(  # NaN counts as white
            np.clip(np.nan_to_num(line.astype(np.float32), nan=1.0), 0, 1)))

    @property
    def straight_alpha(self) -> NDArray[np.float32] | None:
        """(height, width), 0..1: alpha; None for a plate without, or whose codes are multiplied with it."""
        if self.alpha is None or tiff.is_premultiplied(self.path):
            return None
        return self.alpha.astype(np.float32) / np.float32(self.max_code)

    @property
    def space(self) -> ColourSpace:
        """The colour space of the codes: the declared one, else sRGB for integers; linear for floats, in an EXR's
        chromaticities where it has some.

        Raises FrameError where the chromaticities span no space.
        """
        if self.declared is not None:
            return self.declared
        if self.encoding == "srgb":
            return colour_space("srgb")
        chromaticities = self.placement.get("chromaticities")
        if chromaticities is None:
            return colour_space("linear")
        try:
            return space_of_chromaticities(tuple(chromaticities))
        except SettingsError as problem:
            raise FrameError(f"{self.path}: {problem}") from problem

    @property
    def is_rec709(self) -> bool:
        """Return whether the codes are sRGB display values, or scene-linear Rec. 709 light as floats."""
        return self.space.name == ("srgb" if self.encoding == "srgb" else "linear")

    @cached_property
    def in_rec709(self) -> Plate:
        """The plate as 16 bit sRGB codes, or as float scene-linear Rec. 709 light where its codes are floats or hold
        light above white; the plate itself if `is_rec709`."""
        if self.is_rec709:
            return self
        values = self.values if self.encoding == "srgb" else finite_light(self.codes)
        light = self.space.to_linear(values)
        alpha = None if self.alpha is None else self.alpha.astype(np.float32) / np.float32(self.max_code)
        if self.encoding == "linear" or self.space.has_headroom:
            return Plate(self.path, light, "linear", self.grey, alpha)
        codes, alpha_codes = (None if part is None else (np.clip(part, 0, 1) * 65535 + 0.5).astype(np.uint16)
                              for part in (srgb_from_linear(light), alpha))
        assert codes is not None
        return Plate(self.path, codes, "srgb", self.grey, alpha_codes)

    def without_light(self, light: NDArray[np.float32]) -> NDArray[Any]:
        """Return the codes minus light (height, width, 3), scene-linear Rec. 709; unchanged to the last bit where the
        light is 0 or the codes are not finite."""
        codes, changed = self.codes.copy(), (light != 0).any(-1)
        if codes.dtype.kind == "f":
            changed &= np.isfinite(codes).all(-1)
        values, removed = self.codes[changed].astype(np.float32) / np.float32(self.max_code), light[changed]
        if self.space.is_linear:  # convert the removed light to the plate's space, and subtract it there
            values = values - self.space.from_linear(removed)
        else:
            values = self.space.from_linear(self.space.to_linear(values) - removed)
        if codes.dtype.kind == "u":
            codes[changed] = (np.clip(values, 0, 1) * np.float32(self.max_code) + np.float32(0.5)).astype(codes.dtype)
        else:
            limit = np.float32(MAX_HALF) if codes.dtype == np.float16 else np.finfo(np.float32).max
            codes[changed] = np.clip(values, -limit, limit).astype(codes.dtype)
        return codes

    def light_in_plate_primaries(self, light: NDArray[Any]) -> NDArray[Any]:
        """Return scene-linear Rec. 709 light in the primaries of a linear plate, in which its flare is written;
        unchanged for other plates."""
        return self.space.from_linear(light) if self.space.is_linear and self.encoding == "linear" else light

    @cached_property
    def description(self) -> Description | None:
        """Header of the file, from which a clean plate in PNG gets its metadata; None where the file is itself a PNG,
        an EXR, or of an unknown format."""
        kind = file_kind(self.path)
        if kind == "jpeg":
            return _describe_jpeg(self.path)
        return None if kind in ("png", "exr", "") else describe(self.path, kind)

    @property
    def warning(self) -> str:
        """Sentences for the user, "" for none, read from the file: that its suffix does not fit its contents, and what
        is lost when the plate is written with changed codes."""
        return " ".join(filter(None, (self._kind_warning(), dropped_parts_warning(self.path))))

    def _kind_warning(self) -> str:
        """Return a sentence where the file's suffix does not fit its contents and the clean plate keeps the name, and
        with it the suffix; "" elsewhere."""
        kind = file_kind(self.path)
        if clean_name(self.path) != self.path or kind in ("", SUFFIX_KINDS.get(self.path.suffix.lower())):
            return ""
        written_kind = SUFFIX_KINDS.get(_format_suffix(self.path, self))
        result = ("so does the result of that name." if written_kind == kind else
                  f"the result of that name holds {str(written_kind).upper()} data.")
        return f"{self.path} holds {kind.upper()} data, whatever its name; {result}"

    @property
    def placement(self) -> dict[str, Any]:
        """Header attributes that give another EXR this one's windows and colours."""
        header = self.extras.get("header", {})
        return {name: header[name] for name in _PLACEMENT if name in header}


def _describe_jpeg(path: Path) -> Description:
    """Read the profile, the Exif block and the XMP of a JPEG. Raises FrameError."""
    with open_regular(path) as stream:
        profile, segments = jpeg_profile(stream), list(jpeg.segments(stream))
    exif, xmp = (next((content[len(signature):] for marker, content in segments
                       if marker == jpeg.APP1 and content.startswith(signature)), b"")
                 for signature in (jpeg.EXIF, jpeg.XMP))
    return Description(*picture_size(path), profile_space(path, profile), profile=profile, exif=exif, xmp=xmp)


def clean_name(path: Path) -> Path:
    """Return the name of a file's clean plate: the file's own, or one with the suffix of another format where this
    program does not write the file's own."""
    suffix = path.suffix.lower()
    if suffix == ".cin":
        return path.with_suffix(".dpx")
    kind = SUFFIX_KINDS.get(suffix)
    if kind in ("hdr", "raw"):
        return path.with_suffix(".exr")
    return path.with_suffix(".png") if kind in _UNWRITTEN else path


def is_plate_error(problem: Exception) -> bool:
    """Return whether the plate causes the error, so that others may work: it is damaged, unreadable, or too large for
    the memory.

    Any other exception is a defect.
    """
    return isinstance(problem, FrameError | OSError) or is_out_of_memory(problem)


def finite_light(codes: NDArray[Any]) -> NDArray[np.float32]:
    """Return float codes as finite linear light: NaN and negative infinity are black, infinity the greatest half."""
    return np.nan_to_num(codes.astype(np.float32), nan=0.0, posinf=MAX_HALF, neginf=0.0)


def read_plate(path: Path | str, space: ColourSpace | None = None) -> Plate:
    """Read a picture as stored; NaN and infinity are kept. space: the colour space of its codes; None for the one that
    the file declares.

    Raises FrameError where the file is missing, damaged, of another kind, or has no colour.
    """
    path = Path(path)
    if not path.exists():
        raise FrameError(f"{path} is missing{': it is a link that leads nowhere' if path.is_symlink() else ''}.")
    if path.suffix.lower() not in SUFFIXES:
        raise unsupported_file_error(path)
    picture_size(path)
    return _read_exr(path, space) if is_exr(path) else _read_codes(path, space)


def _read_codes(path: Path, space: ColourSpace | None) -> Plate:
    """Read a plate of any format but EXR. Raises FrameError."""
    with open_regular(path) as stream:
        pages = tiff.page_count(stream)
    if pages > 1:
        raise FrameError(f"{path} has {pages} pages; export the plate as a file of its own.")
    stored = read_stored_pixels(path)
    if stored.dtype not in (np.uint8, np.uint16, np.float16, np.float32):
        raise FrameError(f"{path} holds {stored.dtype} pixels; save it as 8 or 16 bit or as 32 bit float.")
    if _is_animated(path):
        raise FrameError(f"{path} is an animated PNG; export its frames as files of their own.")
    grey, codes = stored.ndim == 2 or _is_grey_with_alpha(path), rgb_codes(stored)
    alpha = _read_transparency(path, stored) if stored.ndim == 2 else None
    if stored.ndim == 3 and stored.shape[2] == 4:
        alpha = stored[..., 3].copy()
    encoding: Encoding = "linear" if stored.dtype.kind == "f" else "srgb"
    return Plate(path, codes, encoding, grey, alpha, declared=space or declared_space(path))


def _is_grey_with_alpha(path: Path) -> bool:
    """Return whether a PNG has colour type 4 (PNG specification, 11.2.1), which OpenCV reads as colour."""
    with open_regular(path) as stream:
        header = stream.read(26)
    return header[:4] == b"\x89PNG" and header[25:] == b"\x04"


def _is_animated(path: Path) -> bool:
    """Return whether a PNG has several frames (PNG specification, third edition, 11.3.6.1), of which OpenCV reads the
    first."""
    with open_regular(path) as stream:
        return any(int.from_bytes(content[:4], "big") > 1
                   for _, content in png.chunks(stream, (b"acTL",), before_pixels=True))


def _read_transparency(path: Path, stored: NDArray[Any]) -> NDArray[Any] | None:
    """Return alpha (height, width) of a grey PNG with one transparent code (PNG specification, 11.3.2.1), or None.

    OpenCV reads such files without their alpha.
    """
    with open_regular(path) as stream:
        depth = stream.read(25)[24:]  # bits of a code (PNG specification, 11.2.1)
        key = next((content for _, content in png.chunks(stream, (b"tRNS",), before_pixels=True)
                    if len(content) == 2), None)
    if key is None:
        return None
    max_code = np.iinfo(stored.dtype).max
    code = int.from_bytes(key, "big") * max_code // (2 ** depth[0] - 1)  # depths below 8 bits are spread over all codes
    return np.where(stored == code, 0, max_code).astype(stored.dtype)


def _read_exr(path: Path, space: ColourSpace | None) -> Plate:
    """Read an EXR plate, with the headers and channels of all its parts. Raises FrameError.

    The codes are the colours of the main part. If all channels of a stereo picture have a view's prefix, they are the
    colours of its first view.
    """
    parts = read_exr_parts(path)
    check_parts(path, parts)
    main_number = main_part([(number, channels) for number, (_, channels) in enumerate(parts)])
    header, channels = parts[main_number]
    if has_chroma(channels):  # written back as R, G, B, since chroma of half resolution cannot hold a clean edge
        if len(parts) > 1:
            raise FrameError(f"{path} has {len(parts)} parts, one of luminance and chroma; export the plate as a file "
                             "of its own.")
        colour = read_luminance_chroma(path).astype(np.asarray(channels["Y"]).dtype)
        channels = {**{name: pixels for name, pixels in channels.items() if name not in ("Y", "RY", "BY")},
                    **{name: colour[..., k] for k, name in enumerate("RGB")}}
    names = ["R", "G", "B"] if all(name in channels for name in "RGB") else ["Y"] if "Y" in channels else []
    if not names and (views := stereo_views(header, channels)):  # every view's channels are behind its name
        names = list(dict.fromkeys(views[0].channels))
    if not names:
        raise missing_rgb_error(path, channels)
    if any(channels[name].dtype not in (np.float16, np.float32) for name in names):
        raise FrameError(f"{path} has colour channels that are no floats; export it as half or float.")
    if len({channel.shape for channel in channels.values()}) > 1:
        raise FrameError(f"{path} has channels of several sizes (luminance and chroma, say); export it as R, G, B.")
    codes = np.stack([np.asarray(channels[name]) for name in (names if len(names) == 3 else names * 3)], -1)
    extras: dict[str, Any] = {"header": header, "channels": channels, "names": names}
    if len(parts) > 1:
        extras.update(parts=parts, main=main_number)
    return Plate(path, codes, "linear", len(names) == 1, None, extras, space)


def write_plate(path: Path | str, plate: Plate, codes: NDArray[Any], alpha: NDArray[Any] | None = None) -> None:
    """Write `codes` (height, width, 3) in the format and depth of `plate`, with its alpha, channels and tags, to
    `path`.

    path: has the plate's suffix, or that of `clean_name`. A plate that did not change is copied. alpha: codes as
    stored, to write in place of the plate's alpha; None for the plate's. Raises FrameError for what the format cannot
    hold.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    is_same_alpha = alpha is None or plate.alpha is None or np.array_equal(alpha, plate.alpha)
    if is_same_alpha and suffix == plate.path.suffix.lower() and np.array_equal(codes, plate.codes, equal_nan=True):
        with atomic_path(path) as temporary:
            shutil.copyfile(plate.path, temporary)
        return
    if "channels" in plate.extras:
        _write_exr(path, plate, codes)
        return
    if alpha is not None:
        plate = replace(plate, alpha=alpha)
    suffix = _format_suffix(path, plate)
    if suffix == ".exr":  # of a Radiance HDR or a raw file, which have no alpha
        light = plate.space.to_linear(codes.astype(np.float32) / np.float32(plate.max_code))
        write_exr(path, {name: light[..., k] for k, name in enumerate("RGB")})
        return
    if suffix not in (".png", *_JPEGS, *_TIFFS) and suffix not in OIIO_FORMATS:
        raise FrameError(f"{path} is of a format that this program does not write; choose PNG, TIFF or EXR.")
    if (needs_oiio_writer(plate.path) and suffix in OIIO_FORMATS) or suffix not in (".png", *_JPEGS, *_TIFFS):
        write_by_oiio(path, plate.path, codes[..., :1] if plate.grey else codes, plate.alpha, suffix)
        return
    if codes.dtype not in _DEPTHS.get(suffix, (codes.dtype,)) or (suffix in _JPEGS and plate.alpha is not None):
        raise FrameError(f"{plate.path} holds what no {suffix[1:].upper()} can hold ({codes.dtype} pixels"
                         f"{', alpha' if plate.alpha is not None else ''}): it has the suffix of another kind of file; "
                         "rename it to what it is.")
    encoded = _encode_by_opencv(path, plate, codes, suffix)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)


def _encode_by_opencv(path: Path, plate: Plate, codes: NDArray[Any], suffix: str) -> bytes:
    """Return the bytes of a PNG, JPEG or TIFF with these codes and the plate's alpha and metadata. suffix: chooses the
    format. path: named in the message of a FrameError."""
    import cv2

    stored: NDArray[Any] = codes[..., 0] if plate.grey and plate.alpha is None else codes[..., ::-1]
    if plate.alpha is not None:
        stored = np.concatenate([stored, plate.alpha[..., None]], -1)
    is_encoded, data = cv2.imencode(".jpg" if suffix in _JPEGS else suffix, np.ascontiguousarray(stored),
                                    _encoder_options(suffix, codes.dtype))
    if not is_encoded:
        raise FrameError(f"{path} could not be encoded as {suffix[1:].upper()}.")
    encoded = copy_metadata(data.tobytes(), plate.path, has_alpha=plate.alpha is not None)
    if suffix == ".png" and (description := plate.description) is not None:
        encoded = with_colour_chunks(encoded, description.profile, description.code_points)
        is_upright = file_kind(plate.path) != "jpeg"  # all other formats with a description are decoded upright
        exif = upright_block(description.exif) if is_upright else description.exif
        encoded = with_description(encoded, exif, description.xmp)
    return encoded


def _format_suffix(path: Path, plate: Plate) -> str:
    """Return the suffix of the format in which a plate is written to `path`: that of the plate's contents if `path`
    has the suffix of the plate, which may be wrong; else the suffix of `path`."""
    suffix, kind = path.suffix.lower(), file_kind(plate.path)
    if suffix != plate.path.suffix.lower() or kind in ("", SUFFIX_KINDS.get(suffix)):
        return suffix
    return clean_name(Path(f"plate{SUFFIX_OF_KIND[kind]}")).suffix


def _encoder_options(suffix: str, dtype: np.dtype[Any]) -> list[int]:
    """Return OpenCV's options for a format and a type of pixels: JPEG with chroma at full resolution, TIFF of floats
    without compression."""
    import cv2

    if suffix in _JPEGS:
        return [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
                cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    if suffix in _TIFFS and dtype.kind == "f":  # OpenCV would write LogLuv, with loss
        return [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE]
    return []


def write_flare(path: Path | str, plate: Plate, flare: NDArray[Any]) -> None:
    """Write the flare removed from a plate as an EXR with the plate's windows. flare: (height, width, 3), linear
    light in the plate's primaries."""
    write_exr(path, {name: flare[..., k] for k, name in enumerate("RGB")}, header=plate.placement)


def write_results(results: Sequence[Path], plate: Plate, codes: NDArray[Any], flare: NDArray[Any]) -> None:
    """Write the clean plate, and the flare if `results` has a second path."""
    write_plate(results[0], plate, codes)
    for result in results[1:]:
        write_flare(result, plate, flare)


def _write_exr(path: Path, plate: Plate, codes: NDArray[Any]) -> None:
    """Write codes with the headers, the other channels and the other parts of an EXR plate, as scanlines without loss.
    """
    channels = dict(plate.extras["channels"])
    for index, name in enumerate(plate.extras["names"]):
        channels[name] = np.ascontiguousarray(codes[..., index], channels[name].dtype)  # each in its own depth
    parts = list(plate.extras.get("parts", [None]))
    parts[plate.extras.get("main", 0)] = plate.extras["header"], channels
    save_exr_parts(path, [(_scanline_header(header), part_channels) for header, part_channels in parts],
                   source=plate.path)


def _scanline_header(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return a part's header for scanlines, with a lossless compression in place of a lossy one."""
    import OpenEXR

    header = {name: value for name, value in stored.items() if name not in ("channels", "chunkCount", "tiles")}
    header["type"] = OpenEXR.scanlineimage
    if header.get("lineOrder") == OpenEXR.RANDOM_Y:  # tiles in the order of rendering
        header["lineOrder"] = OpenEXR.INCREASING_Y
    if header.get("compression") in (OpenEXR.B44_COMPRESSION, OpenEXR.B44A_COMPRESSION, OpenEXR.DWAA_COMPRESSION,
                                     OpenEXR.DWAB_COMPRESSION):  # lossy
        header["compression"] = OpenEXR.ZIP_COMPRESSION
    return header
