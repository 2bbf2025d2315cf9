# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the frames of a video by PyAV (FFmpeg): upright, in the colours that players show, or as scene-linear light.

    with Video(path) as video:
        for frame in video:
            picture = frame.picture()

Matrix, range, transfer and primaries are those that the stream names or, where it names none, its container. `solve`,
`remove` and the flare bank of a training read videos here; `video_colour.py` converts the colours, `video_writer.py`
writes videos. PyAV is imported where it is used, because Blender's own Python has none.
"""
from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour.cicp import HLG, PQ
from ..errors import EngineError, FrameError
from ..system.files import atomic_path
from ..system.reading import check_regular
from .formats.kinds import VIDEOS as VIDEOS
from .formats.kinds import is_video as is_video
from .picture import Encoding, Picture
from .video_colour import (
    BT_709,
    BT_2020,
    BY_PRIMARIES,
    FULL_RANGE,
    LIMITED_RANGE,
    LUMA_WEIGHTS,
    RGB,
    TRANSFERS,
    UNSPECIFIED,
    UNSUPPORTED_MATRICES,
    UNSUPPORTED_TRANSFERS,
    WIDE_PRIMARIES,
    YCGCO,
    VideoColour,
    usual_matrix,
)
from .video_planes import (
    Orientation,
    PlaneFormat,
    display_matrix,
    nearest_planar_name,
    orientation_from_matrix,
    plane_arrays,
    plane_format,
    stack_planes,
    to_planar,
)
from .write import write_exr

MAX_VIDEO_PIXELS = 100_000_000
"""Largest frame that is decoded; a header that claims more is damaged or hostile."""
MAX_NAMED_FRAMES = 8
"""Number of damaged frames that a sentence names."""

_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}
"""Decoders that keep alpha, by FFmpeg's names of the codecs."""


def import_av() -> ModuleType:
    """Import PyAV. Raises EngineError where it is not installed.

    By default PyAV prints none of FFmpeg's messages. `av.logging.set_level` must not be called: it installs a callback
    in Python, for which decoding threads wait while a file is closed.
    """
    try:
        import av
    except ImportError as problem:
        raise EngineError("Videos need PyAV: install the Python package av in the engine's environment.") from problem
    return av


@dataclass(frozen=True)
class VideoFrame:
    """One decoded frame; pixels are converted when they are read.

    number: index from 0, in the order of display. raw: PyAV's frame as stored, before it is turned upright.
    """

    number: int
    raw: Any
    colour: VideoColour
    orientation: Orientation

    @property
    def encoding(self) -> Encoding:
        """What the pixels are: display values, or light for PQ, HLG and linear videos."""
        return "linear" if self.colour.is_light else "srgb"

    @property
    def is_damaged(self) -> bool:
        """Return whether the decoder filled in parts of the frame."""
        return bool(self.raw.is_corrupt)

    @property
    def time(self) -> tuple[int, Fraction] | None:
        """When the frame is shown, as ticks and seconds to a tick; None where the file does not say."""
        return None if self.raw.pts is None else (int(self.raw.pts), Fraction(self.raw.time_base))

    @cached_property
    def _planes(self) -> tuple[list[NDArray[Any]], PlaneFormat]:
        frame, planar = to_planar(self.raw, self.colour.limited)
        return plane_arrays(frame, planar), planar

    @cached_property
    def _signal(self) -> NDArray[Any]:
        arrays, planar = self._planes
        return self.colour.to_signal(stack_planes(arrays, planar))

    def stored_codes(self) -> NDArray[Any]:
        """Return the R G B codes of the signal (height, width, 3), uint8 or uint16: neither its curve nor its primaries
        are converted, and the frame is not turned upright."""
        arrays, planar = self._planes
        return replace(self.colour, transfer="display", primaries=None).to_signal(stack_planes(arrays, planar))

    def pixels(self) -> NDArray[Any]:
        """Return R G B (height, width, 3), upright: uint8 or uint16 codes of display values, or float32 linear
        light."""
        return self.orientation.upright(self.colour.to_pixels(self._signal))

    def alpha(self) -> NDArray[Any] | None:
        """Return alpha (height, width): codes of the same type as `pixels`, or float32 0..1 if these are linear light;
        None where the video has no alpha."""
        arrays, planar = self._planes
        if not planar.has_alpha:
            return None
        alpha, max_code = arrays[-1].astype(np.float32), float((1 << planar.bits) - 1)
        if self.colour.is_light:
            return self.orientation.upright(alpha / np.float32(max_code))
        dtype = np.uint8 if planar.bits == 8 and not self.colour.is_wide else np.uint16
        codes = alpha * np.float32(np.iinfo(dtype).max / max_code) + np.float32(0.5)
        return self.orientation.upright(codes.astype(dtype))

    def straight_alpha(self) -> NDArray[np.float32] | None:
        """Return straight alpha (height, width), 0..1; None where the video has no alpha."""
        alpha = self.alpha()
        if alpha is None or alpha.dtype.kind == "f":
            return alpha
        return alpha.astype(np.float32) / np.float32(np.iinfo(alpha.dtype).max)

    def picture(self) -> Picture:
        """Return the frame as display values 0..1, or as linear light."""
        pixels = self.pixels()
        if pixels.dtype.kind == "u":
            pixels = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
        return Picture(pixels, self.encoding)

    def grey(self) -> NDArray[np.float32]:
        """Return luma, or the green of RGB, (height, width), upright, for measures of detail. All codes of the format,
        also those outside a limited range, are scaled to 0..255."""
        arrays, planar = self._planes
        luma = arrays[1 if planar.is_rgb else 0].astype(np.float32)
        return self.orientation.upright(luma * np.float32(255 / ((1 << planar.bits) - 1)))


class Video:
    """The frames of a video, `VideoFrame`s in the order of display. Raises FrameError where none can be decoded."""

    length: int
    """Number of frames by the file's header, which may be too large; 0 where unknown."""
    aspect: float
    """Pixel aspect ratio (width / height) of upright frames; 1 where unknown."""

    def __init__(self, path: Path) -> None:
        """Open the file and decode its first frame. Raises EngineError where PyAV is missing."""
        check_regular(path)
        self.path = Path(path)
        self._start = 0
        self._container: Any = None
        self._first_pass: Iterator[Any] | None = None
        """All frames, for the first iteration: opening and decoding anew takes as long as several frames."""
        self.problems: list[str] = []
        """Sentences about missing and damaged frames of the last iteration."""
        try:
            self._open()
            decoded = self._decode_frames()
            first = next(decoded, None)
        except FrameError:
            self.close()
            raise
        if first is None:
            self.close()
            raise self._unreadable_error()
        self._first_pass = itertools.chain((first,), decoded)
        self.colour = _read_colour(self.path, first, self.stream)
        """What the codes of the first frame mean."""
        self.matrix = display_matrix(first)
        self.orientation = orientation_from_matrix(self.matrix)
        self.stored_size = int(first.width), int(first.height)
        """(width, height) of frames before they are turned upright."""
        self.length = self._declared_length()
        ratio = Fraction(self.stream.sample_aspect_ratio or 0)
        aspect = float(ratio) if ratio > 0 else 1.0
        self.aspect = 1 / aspect if self.orientation.transposed else aspect
        self.has_alpha = _has_alpha(first)
        self.rate = Fraction(self.stream.average_rate or self.stream.guessed_rate or 25)
        """Frames per second, on average."""
        self.estimated_length = self.length or self._length_by_duration()
        """About how many frames there are, for progress; 0 where even the duration is unknown."""

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._first_pass = None
        if self._container is not None:
            self._container.close()
            self._container = None

    def __iter__(self) -> Iterator[VideoFrame]:
        """Yield the frames, from the one that `seek` chose or the first. `problems` is complete after the last
        frame."""
        number, start = self._start, self._start
        self._start, self.problems = 0, []
        damaged, colours, changes_size = list[int](), dict[tuple[int, ...], VideoColour](), False
        for raw in self._frames_from(start):
            if (raw.width, raw.height) != self.stored_size:
                self.problems.append(f"{self.path} changes its size to {raw.width} x {raw.height} at frame {number + 1}"
                                     "; the frames from there on are left out, split the video there.")
                changes_size = True
                break
            tags = (raw.colorspace, raw.color_range, raw.color_trc, raw.color_primaries)
            if tags not in colours:
                colours[tags] = _read_colour(self.path, raw, self.stream)
            frame = VideoFrame(number, raw, colours[tags], self.orientation)
            if frame.is_damaged:
                damaged.append(number + 1)
            yield frame
            number += 1
        if damaged:
            names = ", ".join(map(str, damaged[:MAX_NAMED_FRAMES])) + (", …" if damaged[MAX_NAMED_FRAMES:] else "")
            self.problems.append(f"{len(damaged)} of {number - start} frames of {self.path} are damaged ({names}); "
                                 "copy it again.")
        if number < self.length and start == 0 and not changes_size:
            self.problems.append(f"The header of {self.path} declares {self.length} frames, and {number} could be read"
                                 "; if it is cut off, copy it again.")

    def check_named_space(self, name: str) -> None:
        """Raise FrameError where the video's tags name light or wide primaries: its frames are then converted by these
        tags, so that the colour space `name` of the user cannot apply."""
        if self.colour.is_light or self.colour.is_wide:
            named = self.colour.transfer if self.colour.is_light else "wide primaries"
            raise FrameError(f"{self.path} names its own colours ({named}), and --plate-space {name} others; leave the "
                             "option out, or correct the tags of the video.")

    def seek(self, number: int) -> None:
        """Let the next iteration begin at frame `number`, counted from 0."""
        self._start = max(number, 0)

    def _open(self) -> None:
        """Open the file anew, at its start."""
        av = import_av()
        self.close()
        try:
            self._container = av.open(str(self.path), metadata_errors="replace")
            streams = [stream for stream in self._container.streams.video
                       if not stream.disposition & av.stream.Disposition.attached_pic]  # cover art of music
            if not streams:
                raise FrameError(f"{self.path} holds no video; give the file with the picture.")
            best = self._container.streams.best("video")
            self.stream: Any = best if best in streams else streams[0]
            if self.stream.codec_context is None:  # FFmpeg has no decoder for the codec
                raise self._unreadable_error()
            self._decoder = self._create_alpha_decoder() or self.stream.codec_context
            self._decoder.options = {"max_pixels": str(MAX_VIDEO_PIXELS)}
            self._decoder.thread_type = "AUTO"
        except (av.error.FFmpegError, OSError, ValueError, MemoryError) as problem:
            raise self._unreadable_error() from problem

    def _create_alpha_decoder(self) -> Any:
        """Return libvpx's decoder for VP8 and VP9 with alpha, which FFmpeg's own decoders leave out; None for others,
        and where FFmpeg is built without it."""
        name = _ALPHA_DECODERS.get(self.stream.codec_context.name)
        if name is None or self.stream.metadata.get("alpha_mode") != "1":
            return None
        try:
            decoder = import_av().CodecContext.create(name, "r")
        except ValueError:
            return None
        if self.stream.codec_context.extradata:
            decoder.extradata = self.stream.codec_context.extradata
        return decoder

    def _unreadable_error(self) -> FrameError:
        if not self.path.exists():
            return FrameError(f"{self.path} is missing.")
        return FrameError(f"{self.path} cannot be decoded: it is cut off, or not a video that this program knows; copy "
                          "it again, or convert it to MP4 (H.264).")

    def _decode_frames(self) -> Iterator[Any]:
        """Yield PyAV's frames from the present position on; frames that cannot be decoded are left out."""
        av = import_av()
        errors = (av.error.FFmpegError, OSError, ValueError, RuntimeError, MemoryError)
        packets = self._container.demux(self.stream)
        while True:
            try:
                packet = next(packets)
            except (StopIteration, EOFError):
                return
            except errors:  # the container is damaged here; None makes the decoder give the frames that it still holds
                packet = None
            try:
                frames = self._decoder.decode(packet)
            except errors:
                frames = []
            for frame in frames:
                if frame.width and frame.height:
                    yield frame
            if packet is None:
                return

    def _frames_from(self, number: int) -> Iterator[Any]:
        """Yield PyAV's frames from frame `number` on: after a seek if the frame's time is known and decoding from the
        key frame before it reaches that time, else by decoding all frames from the start."""
        first_pass, self._first_pass = self._first_pass, None
        if number == 0 and first_pass is not None:
            yield from first_pass
            return
        self._open()
        if number == 0:
            yield from self._decode_frames()
            return
        times = self._packet_times()
        if times is not None and number >= len(times):
            return
        if times is not None and self._seek_key_frame(times[number]):
            frames = self._decode_frames()
            first = next((frame for frame in frames if frame.pts is None or frame.pts >= times[number]), None)
            if first is not None and first.pts == times[number]:
                yield first
                yield from frames
                return
        self._open()
        for index, frame in enumerate(self._decode_frames()):
            if index >= number:
                yield frame

    def _seek_key_frame(self, ticks: int) -> bool:
        """Reopen the file at the key frame before a time, in ticks; False where the file cannot be searched."""
        av = import_av()
        self._open()
        try:
            self._container.seek(ticks, stream=self.stream, backward=True)
        except (av.error.FFmpegError, OSError, ValueError):
            return False
        return True

    def _packet_times(self) -> list[int] | None:
        """Return the time of every frame, in ticks, in the order of display, from the packets alone; None where a time
        is unknown. Reads on to the file's end."""
        av = import_av()
        times = list[int]()
        try:
            for packet in self._container.demux(self.stream):
                if packet.size == 0 or packet.is_discard:
                    continue
                if packet.pts is None:
                    return None
                times.append(packet.pts)
        except (av.error.FFmpegError, OSError, ValueError):
            return None
        return sorted(times)

    def _declared_length(self) -> int:
        """Return the number of frames that the header declares, without frames that an edit list hides; 0 if
        unknown."""
        stream = self.stream
        if not stream.frames:
            return 0
        if "mov" not in self._container.format.name:
            return int(stream.frames)
        entries = stream.index_entries
        return sum(not entry.is_discard for entry in entries) if len(entries) else int(stream.frames)

    def _length_by_duration(self) -> int:
        """Return the approximate number of frames by the duration; 0 where it is unknown."""
        seconds = Fraction(self._container.duration or 0, 1_000_000)
        return max(int(seconds * self.rate), 0)


def write_frame(stem: Path, frame: VideoFrame) -> Path:
    """Write a frame without loss as STEM.png of 8 or 16 bits, or light as STEM.exr of half floats; return its path.

    Alpha is kept: beside straight colours in PNG, and with colours multiplied by it in EXR, as the formats define.
    """
    import cv2

    if frame.colour.is_light:
        light, alpha, target = frame.pixels(), frame.straight_alpha(), stem.with_name(stem.name + ".exr")
        if alpha is not None:
            light = light * alpha[..., None]
        channels = {name: light[..., index] for index, name in enumerate("RGB")}
        write_exr(target, channels if alpha is None else {**channels, "A": alpha})
        return target
    target, alpha = stem.with_name(stem.name + ".png"), frame.alpha()
    planes = [*cv2.split(frame.pixels())[::-1], *([] if alpha is None else [alpha])]
    is_encoded, data = cv2.imencode(".png", cv2.merge(planes), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not is_encoded:
        raise FrameError(f"{target} could not be encoded as PNG.")
    with atomic_path(target) as temporary:
        temporary.write_bytes(data.tobytes())
    return target


def _read_colour(path: Path, raw: Any, stream: Any) -> VideoColour:
    """Return what a frame's codes mean by its tags, which are code points of ITU-T H.273.

    Missing tags are filled in as players do. Range: limited for Y Cb Cr, full for grey and RGB. Matrix: BT.2020 if the
    primaries are, else by the size. Primaries: BT.2020 if the matrix is or the transfer is PQ or HLG. Raises FrameError
    for colours that cannot be converted.
    """
    context = stream.codec_context

    def tag(frame_tag: int, container_tag: int) -> int:  # the frame's tag, or the container's if the frame has none
        return int(container_tag if frame_tag in (UNSPECIFIED, 0) and container_tag else frame_tag)

    matrix, transfer, primaries = (tag(*pair) for pair in (
        (raw.colorspace, context.colorspace), (raw.color_trc, context.color_trc),
        (raw.color_primaries, context.color_primaries)))
    colour_range = int(raw.color_range or context.color_range)
    planar = plane_format(raw.format.name) or plane_format(nearest_planar_name(raw))
    assert planar is not None
    if planar.is_rgb:
        matrix, limited = RGB, False
    elif planar.is_grey:
        matrix, limited = BT_709, colour_range == LIMITED_RANGE  # any matrix: only the luma is decoded
    else:
        matrix = _matrix_of_components(path, raw, matrix, primaries)
        limited = colour_range != FULL_RANGE and not planar.is_full_range and not raw.format.name.startswith("yuvj")
    if transfer in UNSUPPORTED_TRANSFERS:
        raise FrameError(f"{path} has a {UNSUPPORTED_TRANSFERS[transfer]} transfer curve, which this program does not "
                         "read; convert the video to BT.709.")
    if primaries in (UNSPECIFIED, 0) and (matrix == BT_2020 or transfer in (PQ, HLG)):
        primaries = BT_2020
    return VideoColour(matrix, limited, planar.bits, TRANSFERS.get(transfer, "display"), WIDE_PRIMARIES.get(primaries))


def _matrix_of_components(path: Path, raw: Any, matrix: int, primaries: int) -> int:
    """Return the code point of the matrix by which a frame of luma and chroma is decoded.

    raw: the frame. matrix, primaries: code points of its tags. Raises FrameError for a matrix that is not supported.
    """
    if matrix == BY_PRIMARIES:
        matrix = primaries if primaries in (BT_709, BT_2020) else UNSPECIFIED
    if matrix in UNSUPPORTED_MATRICES:
        raise FrameError(f"{path} has the colour matrix {UNSUPPORTED_MATRICES[matrix]}, which this program does not "
                         "read; convert the video to BT.709, BT.2020 or RGB.")
    if matrix not in LUMA_WEIGHTS and matrix != YCGCO:
        matrix = BT_2020 if primaries == BT_2020 else usual_matrix(raw.width, raw.height)
    return matrix


def _has_alpha(raw: Any) -> bool:
    planar = plane_format(raw.format.name) or plane_format(nearest_planar_name(raw))
    return planar is not None and planar.has_alpha
