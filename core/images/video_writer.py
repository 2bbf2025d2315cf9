# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes a video anew with changed frames: its sound, tags, timecode, colour tags and timing stay.

`core/removal/jobs/clean_video.py` calls `rewrite_video`. A change is added to the codes of the decoded frame, in its
own matrix, range and curve, so what does not change keeps its codes up to the encoder; FFV1 then loses nothing.
"""
from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, SettingsError
from ..system.files import atomic_path
from .video import Video, VideoFrame, import_av
from .video_colour import FULL_RANGE, LIMITED_RANGE, RGB, UNSPECIFIED, usual_matrix
from .video_mastering import x265_options
from .video_planes import PlaneFormat, plane_arrays, plane_format, shrink_plane, to_planar

CONTAINERS = {".mov": "mov", ".mp4": "mp4", ".m4v": "mp4", ".mkv": "matroska"}
"""FFmpeg's names of the containers that are written, by suffix."""
MOV_SOUND = ("pcm_", "aac", "alac", "mp3", "ac3", "eac3")
"""Starts of the names of sound codecs that QuickTime files hold; others are encoded as PCM of 24 bits."""
LEAD_S = Fraction(1, 2)
"""Seconds of sound that are written ahead of the picture."""
_BRANDS = ("major_brand", "minor_version", "compatible_brands", "encoder")
_STREAM_FACTS = ("rotate", "encoder", "duration", "bps", "number_of", "_statistics", "vendor_id")
"""Starts of tags that describe the old stream rather than its content."""
Change = Callable[[VideoFrame], tuple[NDArray[np.float32], NDArray[np.float32]] | None]
"""Returns the pixels of a frame before and after, upright, as display values 0..1 or light; None where none change."""


@dataclass(frozen=True)
class Encoder:
    """An encoder of FFmpeg, with its options.

    name: FFmpeg's name. suffixes: suffixes of the containers that hold it. keeps: returns whether a planar format is
    encoded unchanged. Frames in another format are converted to `alpha` if they have alpha, to `deep` if they have more
    than 8 bits, else to `fallback`. limited: always write limited range. tag: the codec's tag in MP4 and MOV.
    """

    name: str
    options: dict[str, str]
    suffixes: tuple[str, ...]
    fallback: str
    alpha: str | None = None
    deep: str | None = None
    limited: bool = False
    tag: str | None = None
    keeps: Callable[[PlaneFormat], bool] = field(default=lambda planar: not planar.has_alpha)


CODECS: dict[str, Encoder] = {
    "prores": Encoder("prores_ks", {"profile": "hq", "vendor": "apl0"}, (".mov", ".mkv"), "yuv422p10le",
                      limited=True, keeps=lambda planar: planar.name == "yuv422p10le"),
    "prores4444": Encoder("prores_ks", {"profile": "4444", "vendor": "apl0", "alpha_bits": "16"}, (".mov", ".mkv"),
                          "yuv444p10le", alpha="yuva444p10le", limited=True,
                          keeps=lambda planar: planar.name in ("yuv444p10le", "yuva444p10le")),
    "h264": Encoder("libx264", {"crf": "10", "preset": "medium"}, (".mov", ".mp4", ".m4v", ".mkv"), "yuv444p",
                    deep="yuv444p10le"),
    "h265": Encoder("libx265", {"crf": "10", "preset": "medium", "x265-params": "log-level=none:bframes=0"},
                    (".mov", ".mp4", ".m4v", ".mkv"), "yuv444p", deep="yuv444p10le", tag="hvc1"),
    "ffv1": Encoder("ffv1", {"level": "3", "slicecrc": "1"}, (".mkv",), "gbrp16le", alpha="gbrap16le",
                    keeps=lambda planar: planar.bits > 0),
}
"""Encoders by the names of the command line. x265 with B-frames gives a clip of one frame a random decoding time, which
most containers refuse."""


def choose_codec(target: Path, video: Video, codec: str | None) -> str:
    """Return the codec for a file: `codec`, or if that is None one that suits the container and the video's depth and
    alpha.

    Raises SettingsError for a container that is not written, or that does not hold the codec.
    """
    suffix = target.suffix.lower()
    check_target(target, codec)
    if codec is not None:
        return codec
    if suffix == ".mkv":
        return "ffv1"
    if suffix == ".mov":
        return "prores4444" if video.has_alpha or video.colour.matrix == RGB else "prores"
    return "h265" if video.colour.bits > 8 or video.colour.is_light else "h264"


def check_target(target: Path, codec: str | None) -> None:
    """Raise SettingsError for a video that cannot be written."""
    suffix = target.suffix.lower()
    if suffix not in CONTAINERS:
        raise SettingsError(f"{target} is no video that this program writes; name it .mov, .mp4 or .mkv.")
    if codec is not None and suffix not in CODECS[codec].suffixes:
        raise SettingsError(f"{codec} is not written to {suffix}; use {' or '.join(CODECS[codec].suffixes)}.")


def rewrite_video(source: Path, target: Path, codec: str, change: Change, *,
                  on_frame: Callable[[], None] = lambda: None,
                  on_written: Callable[[Path], None] = lambda _: None) -> list[str]:
    """Write `source` to `target` with changed frames, and return sentences about what was left out.

    codec: a name of CODECS, as `choose_codec` returns it. on_frame: called after each frame, and may raise to stop.
    on_written: called with the whole file before it is renamed to `target`. Raises FrameError where the source cannot
    be decoded or the target not be encoded, OSError where the target cannot be written.
    """
    av = import_av()
    encoder = CODECS[codec]
    # `video` decodes the frames; `container` is the same file, read beside it for its sound, subtitles and tags.
    with Video(source) as video, atomic_path(target) as temporary, av.open(str(source), metadata_errors="replace") as \
            container:
        # Without this, FFmpeg drops tags of other names than its own, such as "com.apple.quicktime.make".
        options = {"movflags": "use_metadata_tags"} if any("." in name for name in container.metadata) else {}
        container_format = CONTAINERS[target.suffix.lower()]
        if container_format == "matroska":
            options = {}
        left_out = list[str]()
        try:
            with av.open(str(temporary), "w", format=container_format, container_options=options) as output:
                _copy_tags(container.metadata, output.metadata, _BRANDS)
                stream = _add_video_stream(output, video, container, encoder, left_out)
                other_streams = _OtherStreams(container, output, video, left_out)
                _copy_chapters(container, output)
                _encode(output, stream, encoder, video, change, other_streams, on_frame)
        except (av.error.FFmpegError, ValueError) as problem:
            if isinstance(problem, OSError) and problem.errno:
                raise OSError(problem.errno, os.strerror(problem.errno), str(target)) from problem
            raise FrameError(f"{target} cannot be written as {codec}: {problem}; choose another --codec or another "
                             "suffix.") from problem
        if video.has_alpha and encoder.alpha is None:
            left_out.append(f"{codec} has no alpha, so that of {source} is left out; use --codec prores4444 or ffv1.")
        if encoder.name == "ffv1" and video.aspect != 1:
            left_out.append(f"FFV1 in .mkv is written without the pixel aspect of {source}, {video.aspect:.4g}; set it "
                            "where it is used, or write another codec.")
        on_written(temporary)
        return left_out + video.problems


def _copy_tags(tags: Any, target: Any, skipped: tuple[str, ...]) -> None:
    """Copy tags, but those whose names start with one of `skipped`."""
    target.update({name: value for name, value in tags.items() if not name.lower().startswith(skipped)})


def _copy_chapters(source: Any, target: Any) -> None:
    if hasattr(source, "chapters") and (chapters := source.chapters()):
        target.set_chapters(chapters)


def _timecode(container: Any, stream: Any) -> str | None:
    """Return the timecode of the first frame: a tag of the stream, of the container, or of a stream of its own; None
    for none."""
    for tags in (stream.metadata, container.metadata, *(other.metadata for other in container.streams)):
        for name, value in tags.items():
            if name.lower() == "timecode":
                return str(value)
    return None


def _choose_pixel_format(encoder: Encoder, video: Video, first: VideoFrame) -> PlaneFormat:
    """Return the planar format to encode. first: the first frame of the video.

    It is the source's format if the encoder keeps it. Otherwise it is the source's format, without alpha if the encoder
    has none, provided that the encoder accepts it and is not limited to limited range; else the encoder's own format
    for alpha, for more than 8 bits, or for all other frames.
    """
    av = import_av()
    _, planar = to_planar(first.raw, video.colour.limited)
    accepted = {pixel_format.name for pixel_format in av.codec.Codec(encoder.name, "w").video_formats or ()}
    if encoder.keeps(planar) and planar.name in accepted and not (encoder.limited and not video.colour.limited):
        return planar
    # yuvj is FFmpeg's older name of yuv in full range.
    output_name, plain_name = encoder.fallback, planar.name.replace("yuvj", "yuv")
    if encoder.alpha is None:
        plain_name = plain_name.replace("yuva", "yuv")
    if plain_name in accepted and not encoder.limited:
        output_name = plain_name
    elif planar.has_alpha and encoder.alpha is not None:
        output_name = encoder.alpha
    elif encoder.deep is not None and planar.bits > 8:
        output_name = encoder.deep
    output_format = plane_format(output_name)
    assert output_format is not None
    return output_format


def _add_video_stream(out: Any, video: Video, source: Any, encoder: Encoder, left_out: list[str]) -> Any:
    """Add a video stream to `out` with the tags, timing and shape of the stream of `video`, and return it.

    source: the container of the video, opened a second time. left_out: list of sentences about what is not written;
    this function adds to it.
    """
    first = next(iter(video), None)
    if first is None:
        raise FrameError(f"{video.path} has no frame that can be read; copy it again.")
    planar, raw = _choose_pixel_format(encoder, video, first), first.raw
    original = video.stream
    options = dict(encoder.options)
    mastering = x265_options(raw)
    if mastering and "x265-params" not in options:
        left_out.append(f"{encoder.name} writes neither the mastering display nor the light levels that {video.path} "
                        "names; use --codec h265 to keep them.")
    elif mastering:
        options["x265-params"] += mastering
    stream = out.add_stream(encoder.name, rate=video.rate, options=options)
    stream.width, stream.height = video.stored_size
    stream.pix_fmt = planar.name
    context = stream.codec_context
    context.time_base = original.time_base if first.time is not None else 1 / video.rate
    if encoder.tag is not None and out.format.name != "matroska":
        context.codec_tag = encoder.tag
    ratio = original.sample_aspect_ratio
    if ratio:
        context.sample_aspect_ratio = ratio
    _set_colour_tags(context, video, raw, planar)
    context.color_range = LIMITED_RANGE if _is_limited(planar, video, encoder) else FULL_RANGE
    if video.matrix is not None:
        stream.set_display_matrix(video.matrix)
    _copy_tags(original.metadata, stream.metadata, _STREAM_FACTS)
    if timecode := _timecode(source, original):
        stream.metadata["timecode"] = timecode
    return stream


def _set_colour_tags(context: Any, video: Video, raw: Any, planar: PlaneFormat) -> None:
    """Set matrix, transfer curve and primaries of a codec context to those of the video's first frame, `raw`.

    planar: the format that is encoded.
    """
    tags = {"colorspace": raw.colorspace, "color_trc": raw.color_trc, "color_primaries": raw.color_primaries}
    for name, value in tags.items():  # a tag that the frame lacks is taken from the container
        setattr(context, name, value if value not in (0, UNSPECIFIED) else getattr(video.stream.codec_context, name))
    if not planar.is_rgb and video.colour.matrix == RGB:
        context.colorspace = usual_matrix(*video.stored_size)  # converted from RGB


def _is_limited(planar: PlaneFormat, video: Video, encoder: Encoder) -> bool:
    """Return whether codes are written in limited range: never as RGB; as Y Cb Cr if the encoder demands it, the source
    has it, or the source is RGB. planar: the format that is encoded."""
    if planar.is_rgb:
        return False
    return encoder.limited or video.colour.limited or video.colour.matrix == RGB


class _OtherStreams:
    """Sound and subtitles of the source, copied packet by packet beside the frames; sound that does not fit into the
    new container is encoded anew.

    left_out: list of sentences about what is not written or is encoded anew; this class adds to it.
    """

    def __init__(self, source: Any, out: Any, video: Video, left_out: list[str]) -> None:
        """Add the streams to the container `out`. source: the container of the video, opened a second time."""
        self._out, self._targets, self._encoded = out, dict[int, Any](), dict[int, Any]()
        copied_streams = list[Any]()
        for stream in source.streams:
            if stream.index == video.stream.index or stream.type == "video":
                continue
            codec = stream.codec_context.name if stream.codec_context is not None else ""
            if stream.type == "audio" and codec:
                target = self._add_sound(stream, codec, video, left_out)
            elif stream.type == "subtitle" and codec in out.supported_codecs:
                target = out.add_stream_from_template(stream)
            else:
                if codec or "timecode" not in str(stream.metadata).lower():  # a timecode stream becomes a tag
                    left_out.append(f"Stream {stream.index} of {video.path} ({stream.type}) is left out.")
                continue
            _copy_tags(stream.metadata, target.metadata, _STREAM_FACTS)
            self._targets[stream.index] = target
            copied_streams.append(stream)
        self._packets: Iterator[Any] = iter(source.demux(copied_streams)) if copied_streams else iter(())
        self._waiting: Any = None

    def _add_sound(self, stream: Any, codec: str, video: Video, left_out: list[str]) -> Any:
        """Add a sound stream to the output and return it: copied, or encoded anew if the output cannot hold its
        codec."""
        is_mov = self._out.format.name == "mov"
        if codec.startswith(MOV_SOUND) if is_mov else codec in self._out.supported_codecs:
            return self._out.add_stream_from_template(stream)
        replacement_codec = "pcm_s24le" if is_mov else self._out.default_audio_codec
        target = self._out.add_stream(replacement_codec, rate=stream.codec_context.sample_rate)
        target.codec_context.layout = stream.codec_context.layout
        self._encoded[stream.index] = target
        left_out.append(f"The sound of {video.path} ({codec}) does not fit into the new file and is "
                        f"encoded as {replacement_codec}.")
        return target

    def write_until(self, time: Fraction | None) -> None:
        """Write the packets up to `time` seconds; all remaining ones for None."""
        av = import_av()
        while True:
            try:
                packet = self._waiting or next(self._packets, None)
            except (av.error.FFmpegError, OSError):
                packet = None
            self._waiting = None
            if packet is None:
                break
            if packet.dts is not None and time is not None and packet.dts * packet.time_base > time:
                self._waiting = packet
                return
            self._write(packet)
        if time is None:  # what the encoders still hold
            for target in self._encoded.values():
                self._out.mux(target.encode())
            self._encoded.clear()

    def _write(self, packet: Any) -> None:
        target = self._targets[packet.stream.index]
        if packet.stream.index in self._encoded:
            for frame in packet.decode():
                self._out.mux(target.encode(frame))
        elif packet.dts is not None:
            packet.stream = target
            self._out.mux(packet)


def _encode(out: Any, stream: Any, encoder: Encoder, video: Video, change: Change, other_streams: _OtherStreams,
            on_frame: Callable[[], None]) -> None:
    """Encode every frame with its change, and write the other streams up to LEAD_S ahead of it.

    stream: the video stream that `_add_video_stream` added. on_frame: called after each frame.
    """
    planar = plane_format(stream.pix_fmt)
    assert planar is not None
    context, time_base = stream.codec_context, stream.codec_context.time_base
    limited = _is_limited(planar, video, encoder)
    last_ticks: int | None = None
    for frame in video:
        before_and_after = change(frame)  # None where no pixel changes
        raw = apply_change(frame, *before_and_after) if before_and_after is not None else frame.raw
        if raw.format.name != planar.name or (not planar.is_rgb and frame.colour.limited != limited):
            raw = _reformat(raw, frame, planar, context, limited=limited)
        ticks = frame.number if frame.time is None else frame.time[0]  # without times, the time base is one frame
        if last_ticks is not None and ticks <= last_ticks:  # a damaged file may repeat a time
            ticks = last_ticks + 1
        # Type 0 of a picture lets the encoder choose its key frames.
        raw.pts, raw.time_base, raw.pict_type, last_ticks = ticks, time_base, 0, ticks
        raw.color_range, raw.colorspace = context.color_range, context.colorspace
        other_streams.write_until(ticks * time_base + LEAD_S)
        out.mux(stream.encode(raw))
        on_frame()
    out.mux(stream.encode())
    other_streams.write_until(None)


def _reformat(raw: Any, frame: VideoFrame, planar: PlaneFormat, context: Any, *, limited: bool) -> Any:
    """Convert PyAV's frame `raw` to the planar format that `context` encodes, by swscale with its exact flags.

    frame: the decoded frame that `raw` belongs to; its colour says what the codes mean. limited: write limited range.
    """
    from av.video.reformatter import Interpolation

    exact = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | \
        Interpolation.FULL_CHR_H_INP
    source = _SWSCALE_MATRICES.get(frame.colour.matrix, 5)  # 5 is BT.601; RGB has none
    target = _SWSCALE_MATRICES.get(int(context.colorspace), source)
    return raw.reformat(format=planar.name, interpolation=exact, src_colorspace=source, dst_colorspace=target,
                        src_color_range=LIMITED_RANGE if frame.colour.limited else FULL_RANGE,
                        dst_color_range=LIMITED_RANGE if limited and not planar.is_rgb else FULL_RANGE)


_SWSCALE_MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9}
"""swscale's numbers of matrix coefficients, by those of ITU-T H.273."""


def apply_change(frame: VideoFrame, before: NDArray[np.float32], after: NDArray[np.float32]) -> Any:
    """Return PyAV's frame, in a planar format, with the change from `before` to `after` added to its codes.

    before, after: upright pixels (height, width, 3), display values or light as `VideoFrame.picture` has them. Codes of
    unchanged pixels stay; a subsampled chroma code changes by the mean over its pixels.
    """
    colour = frame.colour
    difference = colour.from_pixels(after) - colour.from_pixels(before)
    difference[(after == before).all(-1)] = 0
    raw, planar = to_planar(frame.raw, colour.limited)
    raw.make_writable()
    arrays, max_code = plane_arrays(raw, planar), (1 << planar.bits) - 1
    codes = colour.to_plane_differences(frame.orientation.stored(difference))
    for index in range(1 if planar.is_grey else 3):
        plane = codes[..., index]
        if index and not planar.is_rgb and planar.sampling != (1, 1):
            plane = shrink_plane(np.ascontiguousarray(plane), planar)
        changed = np.clip(np.rint(arrays[index].astype(np.float32) + plane), 0, max_code)
        arrays[index][...] = changed.astype(planar.dtype)
    return raw
