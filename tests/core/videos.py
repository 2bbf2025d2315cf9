# SPDX-License-Identifier: GPL-3.0-or-later
"""Small videos for tests, written plane by plane, so that the truth of their colours does not come from FFmpeg."""
from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

PATCHES = np.array([(200, 60, 40), (40, 180, 60), (50, 70, 210), (128, 128, 128), (230, 200, 40), (240, 240, 240)])
"""Red, green, blue codes of 8 bits."""
STRIPE = 32
LUMA = {1: (0.2126, 0.0722), 4: (0.30, 0.11), 6: (0.299, 0.114), 7: (0.212, 0.087), 9: (0.2627, 0.0593)}
X265 = {"x265-params": "log-level=none:lossless=1:bframes=0", "preset": "ultrafast"}
"""Without B-frames, with which x265 gives the packet of a clip of one frame a random decoding time."""


def stripes(height: int, width: int = 6 * STRIPE, colours: NDArray[Any] = PATCHES / 255) -> NDArray[np.float64]:
    """(height, width, 3): upright stripes of colours 0..1."""
    columns = np.minimum(np.arange(width) * len(colours) // width, len(colours) - 1)
    return np.repeat(colours[columns][None], height, 0)


def frame_of(signal: NDArray[Any], pixels: str, matrix: int = 1, full: bool = False,
             alpha: NDArray[Any] | None = None) -> av.VideoFrame:
    """Return a video frame of a planar pixel format, with the codes of a signal R G B, 0..1, by ITU-T H.273.

    matrix: H.273's number of the conversion to luma and chroma. full: full range of codes.
    """
    height, width = signal.shape[:2]
    frame = av.VideoFrame(width, height, pixels)
    bits = frame.format.components[0].bits
    step, top = 1 << (bits - 8), (1 << bits) - 1
    if pixels.startswith("gbr"):
        planes = [signal[..., k] * top for k in (1, 2, 0)]
    elif pixels.startswith("gray"):
        planes = [signal[..., 0] * top if full else step * (16 + 219 * signal[..., 0])]
    else:
        red, blue = LUMA[matrix]
        luma = signal @ [red, 1 - red - blue, blue]
        differences = [(signal[..., k] - luma) / (2 - 2 * share) for k, share in ((2, blue), (0, red))]
        planes = ([luma * top, *(part * top + (1 << (bits - 1)) for part in differences)] if full else
                  [step * (16 + 219 * luma), *(step * (128 + 224 * part) for part in differences)])
    if alpha is not None:
        planes.append(alpha * top)
    for index, (plane, values) in enumerate(zip(frame.planes, planes, strict=True)):
        if index in (1, 2):  # every sample of these stripes has neighbours of its colour
            values = values[::height // plane.height, ::width // plane.width]
        codes = np.round(np.clip(values, 0, top)).astype(np.uint8 if bits == 8 else np.uint16)
        rows = np.frombuffer(plane, codes.dtype).reshape(plane.height, -1)
        rows[:, :plane.width] = codes
    return frame


def write_video(path: Path, codec: str, pixels: str, frames: Sequence[NDArray[Any]], *, matrix: int = 1,
                tags: tuple[int, int, int] | None = None, full: bool = False, options: dict[str, str] | None = None,
                aspect: Fraction | None = None, rotation: int | None = None, alpha: NDArray[Any] | None = None,
                sound: str = "", metadata: dict[str, str] | None = None, rate: int = 25) -> Path:
    """Write signals R G B of 0..1 as a video; return its path.

    matrix: H.273's number of the conversion by which codes are made. tags: H.273's numbers of matrix, transfer and
    primaries that the file names; None for none. full: full range of codes. sound: codec of a sound track of one
    second, "" for none. rotation: degrees, in the display matrix.
    """
    with av.open(str(path), "w") as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        context = stream.codec_context
        if full:
            context.color_range = 2
        if tags is not None:
            context.color_range = 2 if full else 1
            context.colorspace, context.color_trc, context.color_primaries = tags
        if aspect is not None:
            context.sample_aspect_ratio = aspect
        if rotation is not None:
            stream.set_display_rotation(rotation)
        tone = container.add_stream(sound, rate=48000) if sound else None
        for number, signal in enumerate(frames):
            frame = frame_of(signal, pixels, matrix, full, alpha)
            frame.pts, frame.time_base = number, Fraction(1, rate)
            if tags is not None or full:
                frame.color_range = 2 if full else 1
            if tags is not None:
                frame.colorspace, frame.color_trc, frame.color_primaries = tags
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        if tone is not None:
            samples = (np.sin(np.arange(48000) / 20) * 8000).astype(np.int16)[None]
            for start in range(0, 48000, 1000):
                block = av.AudioFrame.from_ndarray(samples[:, start:start + 1000], "s16", "mono")
                block.sample_rate, block.pts, block.time_base = 48000, start, Fraction(1, 48000)
                container.mux(tone.encode(block))
            container.mux(tone.encode())
    return path


def middles(pixels: NDArray[Any], count: int = len(PATCHES)) -> NDArray[Any]:
    """(count, 3): the pixels in the middle of each stripe."""
    height, width = pixels.shape[:2]
    return pixels[height // 2, ((np.arange(count) + 0.5) * width / count).astype(int)]
