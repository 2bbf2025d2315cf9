# SPDX-License-Identifier: GPL-3.0-or-later
"""Decodes the formats that OpenCV and OpenEXR do not read, or not exactly, by the libraries of each.

| library | reads |
| --- | --- |
| OpenImageIO | WebP, DPX, Cineon, PSD, BMP, Radiance HDR, Targa; BigTIFF, TIFF of 16 bit floats, planes |
| OpenCV | JPEG 2000, in up to 16 bits |
| Pillow | GIF, AVIF; HEIC with pillow-heif |
| PyAV | AVIF of 10 and 12 bits, and the code points of any |
| pillow-jxl-plugin | JPEG XL, which OpenImageIO's wheels for numpy 1.26 lack |
| rawpy | raw files of cameras, DNG |

`read.py` calls it. Each library is imported where it is used; where one is missing, FrameError says which.
"""
from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourSpace, colour_space
from ..colour.cicp import space_of_code_points
from ..colour.icc import DamagedProfile, UnreadableProfile, space_of_profile
from ..errors import EngineError, FrameError
from ..system.child import ChildDied, run_in_child
from ..system.progress import Progress
from ..system.reading import check_regular, open_regular, read_bytes
from .formats import tiff
from .formats.exif import SWAPS_SIDES, apply_orientation
from .formats.kinds import HEAD_BYTES, Kind, kind_of

if TYPE_CHECKING:
    from .video import VideoFrame

OIIO_KINDS = frozenset({"webp", "dpx", "cineon", "psd", "bmp", "hdr", "tga"})
"""Formats that OpenImageIO alone reads."""
MAX_PIXELS = 500_000_000
"""Largest picture that is opened; a header that claims more is damaged or hostile."""
MAX_BYTES = 2 << 30
"""Bound of a file that is read whole."""
_STATED_SIZES = {b"SDPX": (16, 32), b"\x80\x2a\x5f\xd7": (20, 16)}
"""Places of the sizes of the file and of its user data in the headers of DPX and Cineon, 4 bytes each, by the first
bytes of those with big-endian numbers."""
_DPX_ENCODING = 806, 808
"""Bytes of a DPX's header that say whether its pixels are packed as runs (SMPTE 268M, image element 1)."""
_MAX_RUN_LENGTH = 256
"""Bound of the compression of formats that store runs of equal pixels."""
_PACKAGES = {"OpenImageIO": ("OpenImageIO", "engine"), "pillow_heif": ("pillow-heif", "heif"),
             "PIL.Image": ("pillow", "heif"), "pillow_jxl": ("pillow-jxl-plugin", "jxl"), "rawpy": ("rawpy", "raw")}
"""Package and dependency group of each module."""
_DPX_TRANSFERS = {"linear": "linear", "printing density": "cineon", "logarithmic": "cineon", "kodaklog": "cineon",
                  "adx": "cineon"}
"""Names of colour spaces by OpenImageIO's names of the transfer of a DPX."""


class Description(NamedTuple):
    """Size, colour space (None where the file names none), Exif orientation, ICC profile, code points (primaries and
    transfer function), Exif block and XMP of a picture, by its header. The last two are read only from formats whose
    clean plates are PNGs."""

    width: int
    height: int
    space: ColourSpace | None = None
    orientation: int = 1
    profile: bytes = b""
    code_points: tuple[int, int] | None = None
    exif: bytes = b""
    xmp: bytes = b""


def file_kind(path: Path) -> Kind:
    """Return the format of a file. Raises OSError."""
    with open_regular(path) as stream:
        return kind_of(stream.read(HEAD_BYTES), path.suffix)


def describe(path: Path, kind: Kind) -> Description:
    """Read the header of a file of one of this module's formats. Width and height are those of the pixels that
    `decode_foreign` returns. Raises FrameError."""
    if kind in OIIO_KINDS or kind == "tiff":
        return _describe_by_oiio(path, kind)
    if kind == "raw":
        with _open_raw(path) as raw:
            sizes = raw.sizes
            is_turned = sizes.flip in (5, 6)  # LibRaw's numbers of the quarter turns, which `_decode_raw` applies
            width, height = (sizes.height, sizes.width) if is_turned else (sizes.width, sizes.height)
            return Description(width, height, colour_space("linear"))
    with _open_by_pillow(path, kind) as picture:
        width, height = picture.size
        profile = picture.info.get("icc_profile") or b""
        nclx = picture.info.get("nclx_profile")
        code_points = (int(nclx["color_primaries"]), int(nclx["transfer_characteristics"])) if nclx else None
        if kind == "avif":
            if _avif_orientation(picture) in SWAPS_SIDES:
                width, height = height, width
            if not profile and (frame := _read_av1_frame(path)) is not None:
                code_points = int(frame.raw.color_primaries), int(frame.raw.color_trc)  # Pillow gives none
        space = profile_space(path, profile) or (space_of_code_points(*code_points) if code_points else None)
        exif, xmp = (bytes(picture.info.get(name) or b"") for name in ("exif", "xmp"))
        # Orientation 1: `decode_foreign` turns these formats upright.
        return Description(width, height, space, 1, profile, code_points, exif.removeprefix(b"Exif\0\0"), xmp)


def decode_foreign(path: Path, kind: Kind) -> NDArray[Any]:
    """Decode a file of one of this module's formats to (height, width), or B G R with alpha last, as stored.

    HEIC, AVIF and raw files come out upright. Raises FrameError.
    """
    if kind in OIIO_KINDS or kind == "tiff":
        return _decode_by_oiio(path, kind)
    if kind == "raw":
        return _decode_raw(path)
    if kind == "jp2":
        return _decode_in_child(_decode_jp2, path)
    if kind == "heif":
        return _decode_heif(path)
    with _open_by_pillow(path, kind) as picture:
        if getattr(picture, "n_frames", 1) > 1:
            raise FrameError(f"{path} has {picture.n_frames} frames; export them as files of their own.")
        orientation = _avif_orientation(picture) if kind == "avif" else 1
        frame = _read_av1_frame(path) if kind == "avif" and picture.mode == "RGB" else None  # without alpha
        if frame is not None and frame.colour.bits > 8 and (frame.raw.width, frame.raw.height) == picture.size:
            return _to_bgr(apply_orientation(frame.stored_codes(), orientation))  # Pillow would round to 8 bits
        is_transparent = picture.has_transparency_data
        mode = "RGBA" if is_transparent else picture.mode if picture.mode in ("L", "RGB") else "RGB"
        try:
            pixels = np.asarray(picture.convert(mode))
        except Exception as problem:  # the plug-ins raise what their libraries do
            raise _damaged_error(path, "" if kind == "jxl" else problem) from problem
    return _to_bgr(apply_orientation(pixels, orientation))


def _read_av1_frame(path: Path) -> VideoFrame | None:
    """Decode the picture of an AVIF with PyAV, which gives its code points and all of its bits, where Pillow gives 8;
    None where PyAV cannot read it."""
    from .video import Video

    try:
        with Video(path) as video:
            return next(iter(video), None)
    except (FrameError, EngineError):
        return None


def _avif_orientation(picture: Any) -> int:
    """Return the Exif orientation that stands for an AVIF's rotation and mirroring, which Pillow reports in this form
    and does not apply."""
    try:
        orientation = int(picture.getexif().get(tiff.ORIENTATION, 1))
    except Exception:  # a damaged block
        return 1
    return orientation if 1 <= orientation <= 8 else 1


def profile_space(path: Path, profile: bytes) -> ColourSpace | None:
    """Return the space of a file's ICC profile; None for an empty or damaged one. Raises FrameError for an intact one
    that cannot be honoured."""
    if not profile:
        return None
    try:
        return space_of_profile(profile)
    except DamagedProfile:
        return None  # viewers ignore it too
    except UnreadableProfile as problem:
        raise FrameError(f"{path} has a colour profile that {problem}; convert it to sRGB, or name its space with "
                         "--plate-space.") from problem


def _to_bgr(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return R G B (A) as B G R (A), grey as (height, width), grey with alpha as three equal channels and alpha."""
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        return np.ascontiguousarray(pixels[..., 0])
    if pixels.ndim == 2:
        return np.ascontiguousarray(pixels)
    order = {2: [0, 0, 0, 1], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[pixels.shape[2]]
    return np.ascontiguousarray(pixels[..., order])


def _import_library(name: str, path: Path) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as problem:
        package, group = _PACKAGES[name]
        raise FrameError(f"{path} needs the Python package {package}, which is not installed: `pip install --group "
                         f"{group} -c constraints.txt`, or save the picture as PNG, TIFF or EXR.") from problem


def _damaged_error(path: Path, problem: object) -> FrameError:
    reason = " ".join(str(problem).split())[:160]
    return FrameError(f"{path} is damaged or truncated{f' ({reason})' if reason else ''}; export it again.")


def open_oiio(path: Path) -> Any:
    """Open a file with OpenImageIO, for its alpha and colours as stored. Raises FrameError; the caller closes it."""
    oiio = _import_library("OpenImageIO", path)
    check_regular(path)
    _check_stated_size(path)
    oiio.attribute("limits:imagesize_MB", 8192)  # enough for MAX_PIXELS with four floats each
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    image_input = oiio.ImageInput.open(str(path), settings)
    if image_input is None:
        raise _damaged_error(path, oiio.geterror())
    return image_input


def _describe_by_oiio(path: Path, kind: Kind) -> Description:
    """Read the header of a file with OpenImageIO. Raises FrameError."""
    image_input = open_oiio(path)
    try:
        spec = image_input.spec()
        profile = spec.getattribute("ICCProfile")
        profile_bytes = bytes(np.asarray(profile, np.uint8)) if profile is not None else b""
        space = profile_space(path, profile_bytes) or _oiio_space(spec, kind)
        orientation = spec.get_int_attribute("Orientation", 1) if kind in ("webp", "tiff", "psd") else 1
        return Description(spec.width, spec.height, space, orientation if 1 <= orientation <= 8 else 1, profile_bytes)
    finally:
        image_input.close()


def _oiio_space(spec: Any, kind: Kind) -> ColourSpace | None:
    """Return the space that a header without a profile names; None for the default of its pixel type."""
    if kind == "cineon":
        return colour_space("cineon")
    if kind == "hdr":
        return colour_space("linear")
    if kind == "dpx":
        transfer = str(spec.get_string_attribute("dpx:Transfer")).strip().lower()
        if transfer in _DPX_TRANSFERS:
            return colour_space(_DPX_TRANSFERS[transfer])
        if "709" in transfer or "274m" in transfer:
            return colour_space("rec709")
    return None


def _check_stated_size(path: Path) -> None:
    """Raise FrameError for a DPX or Cineon that is smaller than its header says.

    OpenImageIO fills what is missing with black, and takes as many gigabytes as the header states for user data.
    """
    with open_regular(path) as stream:
        head = stream.read(36)
        size = stream.seek(0, 2)
    offsets = _STATED_SIZES.get(head[:4]) or _STATED_SIZES.get(head[3::-1])
    if offsets is None:
        return
    order: Literal["big", "little"] = "big" if head[:4] in _STATED_SIZES else "little"
    stated_size, user_data = (int.from_bytes(head[offset:offset + 4], order) for offset in offsets)
    if size < stated_size < 0xFFFFFFFF or size < user_data < 0xFFFFFFFF:  # a field with all bits set states nothing
        raise _damaged_error(path, f"it has {size} of {max(stated_size, user_data)} bytes")


def _check_claimed_pixels(path: Path, kind: Kind, spec: Any) -> None:
    """Raise FrameError for a file that cannot hold the pixels that its header claims: their memory may be gigabytes.

    Only formats without compression or with run-length encoding have a bound; others pass.
    """
    size = path.stat().st_size
    bits = spec.get_int_attribute("oiio:BitsPerSample", 0) or 8 * spec.format.size()
    claimed_bytes = spec.width * spec.height * spec.nchannels * bits // 8
    if kind in ("dpx", "cineon"):
        with open_regular(path) as stream:
            is_packed = kind == "dpx" and stream.read(_DPX_ENCODING[1])[_DPX_ENCODING[0]:] not in (b"", b"\0\0")
        max_bytes = _MAX_RUN_LENGTH * size if is_packed else size
    else:
        max_bytes = _MAX_RUN_LENGTH * size if kind in ("tga", "bmp", "hdr") else claimed_bytes
    if claimed_bytes > max_bytes:
        raise _damaged_error(path, f"it claims {spec.width} x {spec.height} pixels in {size} bytes")


def _decode_by_oiio(path: Path, kind: Kind) -> NDArray[Any]:
    """Decode a file with OpenImageIO to (height, width), or B G R with alpha last. Of more than four channels, the
    colours are kept, and alpha where it is the fourth. Raises FrameError."""
    image_input = open_oiio(path)
    try:
        spec = image_input.spec()
        channels = spec.nchannels
        if kind == "psd" and spec.get_string_attribute("psd:ColorMode") in ("CMYK", "Lab", "Multichannel"):
            raise FrameError(f"{path} is in {spec.get_string_attribute('psd:ColorMode')} colours; convert it to RGB.")
        if kind == "tiff" and spec.get_int_attribute("tiff:PhotometricInterpretation", 2) not in (0, 1, 2, 3, 6):
            # Readable are grey with white as 0 or as the maximum, R G B, palettes, and Y Cb Cr.
            raise FrameError(f"{path} is in colours for print or measurement (CMYK or Lab); convert it to RGB.")
        if channels > 4:
            channels = 4 if spec.alpha_channel == 3 else 3
        if spec.width * spec.height > MAX_PIXELS:
            raise FrameError(f"{path} claims {spec.width} x {spec.height} pixels, more than this program opens.")
        _check_claimed_pixels(path, kind, spec)
        pixel_type = {"uint8": "uint8", "uint16": "uint16", "half": "half"}.get(str(spec.format), "float")
        pixels = image_input.read_image(0, 0, 0, channels, pixel_type)
        problem = image_input.geterror()
        if "not configured" in problem:
            number = spec.get_int_attribute("tiff:Compression")
            name = tiff.UNSUPPORTED_COMPRESSIONS.get(number, f"the method {number}")
            raise FrameError(f"{path} is compressed with {name}, which the TIFF library here is built without; save "
                             "it with LZW or ZIP compression.")
        if pixels is None or problem:
            raise _damaged_error(path, problem)
        pixels = np.asarray(pixels).reshape(spec.height, spec.width, channels)
        if kind == "tiff" and pixels.dtype == np.uint16 and spec.get_int_attribute("tiff:PhotometricInterpretation",
                                                                                   1) == 0:
            pixels = 65535 - pixels  # 0 is white, which OpenImageIO converts in 8 bits only
        return _to_bgr(pixels)
    finally:
        image_input.close()


def _decode_in_child(decode: Callable[..., NDArray[Any]], path: Path) -> NDArray[Any]:
    """Decode in a child process, since a damaged file can crash the library. Raises FrameError."""
    try:
        return np.asarray(run_in_child(decode, path, progress=Progress()))
    except ChildDied as problem:
        raise _damaged_error(path, problem) from problem


def _decode_jp2(path: Path, _progress: Progress | None = None) -> NDArray[Any]:
    """Decode a file with OpenCV to (height, width), or B G R with alpha last; _progress: given by `run_in_child`,
    unused. Raises FrameError."""
    import cv2

    data = np.frombuffer(read_bytes(path, MAX_BYTES), np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error as problem:
        raise _damaged_error(path, problem.err) from problem
    if pixels is None:
        raise _damaged_error(path, "")
    return np.asarray(pixels)


def _open_by_pillow(path: Path, kind: Kind) -> Any:
    """Open HEIC, AVIF, JPEG XL, JPEG 2000 or GIF with Pillow and its plug-ins. Raises FrameError."""
    image = _import_library("PIL.Image", path)
    if kind == "jxl":
        _import_library("pillow_jxl", path)
    if kind == "heif":
        _import_library("pillow_heif", path).register_heif_opener()
    check_regular(path)
    image.MAX_IMAGE_PIXELS = MAX_PIXELS  # type: ignore[attr-defined]  # Pillow refuses photographs of 200 megapixels
    try:
        return image.open(path)
    except Exception as problem:  # plug-ins raise any exception; JPEG XL's gives no reason
        is_vague = kind == "jxl" or isinstance(problem, image.UnidentifiedImageError)
        raise _damaged_error(path, "" if is_vague else problem) from problem


def _decode_heif(path: Path) -> NDArray[Any]:
    """Decode HEIC upright, with the bits of the file spread over 16 where it has more than 8."""
    library = _import_library("pillow_heif", path)
    check_regular(path)
    try:
        picture = library.open_heif(path, convert_hdr_to_8bit=False)
        pixels = np.asarray(picture)
    except Exception as problem:
        raise _damaged_error(path, problem) from problem
    return _to_bgr(pixels)


def _open_raw(path: Path) -> Any:
    library = _import_library("rawpy", path)
    check_regular(path)
    try:
        return library.imread(str(path))
    except Exception as problem:
        raise _damaged_error(path, problem) from problem


def _decode_raw(path: Path) -> NDArray[Any]:
    """Develop a raw file upright to 16 bit scene-linear Rec. 709, B G R, with the camera's white balance and without
    automatic brightening; highlights are clipped at white."""
    library = _import_library("rawpy", path)
    with _open_raw(path) as raw:
        try:
            pixels = raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True,
                                     output_color=library.ColorSpace.sRGB)
        except Exception as problem:
            raise _damaged_error(path, problem) from problem
    return _to_bgr(pixels)

