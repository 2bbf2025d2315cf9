# SPDX-License-Identifier: GPL-3.0-or-later
"""What is to be solved: the frames of a folder or a video, chosen, checked, and made small enough to match.

From a video, or where fewer frames are asked for than there are, the footage is cut into equal stretches
and the sharpest frame of each is taken: blur costs features, and even spacing keeps the overlap.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ...errors import CaptureError, FrameError
from ...images.exr import window_of
from ...images.formats.exif import read_exif, upright
from ...images.listing import pictures_in
from ...images.picture import Picture
from ...images.read import read_picture
from ...images.size import picture_size
from ...images.video import Video, displayed, is_video, told_short
from ...images.write import write_png
from ...system.files import read_json, write_json
from ...system.progress import Progress

RECORD = "stills.json"
COMBED, SOME = 1.1, 0.25
"""Times, in more than which part of the frames. Photographs have 0.6 to 0.8, moving fields 1.5 to 2.3."""
CLIPPED = 0.98  # of full scale: at or above it the sensor says nothing about the surface


@dataclass(frozen=True)
class Still:
    """A frame to solve: `name` of its small picture and mask, the file it comes from, its full size in
    pixels and its focal length as a multiple of the long side, where the file tells."""

    name: str
    file: str
    width: int
    height: int
    focal: float | None
    orientation: int


def choose(sharpness: Sequence[float], number: int) -> list[int]:
    """The index of the sharpest frame in each of `number` equal stretches; all where `number` is 0."""
    total = len(sharpness)
    if number <= 0 or number >= total:
        return list(range(total))
    edges = np.linspace(0, total, number + 1).round().astype(int)
    return [int(start + np.argmax(sharpness[start:end])) for start, end in pairwise(edges)]


def sharpness(grey: Pixels) -> float:
    """Variance of the Laplacian at about 480 pixels: high where edges are crisp."""
    import cv2

    scale = 480 / max(grey.shape)
    if scale < 1:
        grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.float32)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def is_combed(picture: Picture) -> bool:
    """Whether lines beside each other differ more than those two apart, as only those of two fields do."""
    grey = picture.display().mean(axis=2)
    return len(grey) > 2 and float(np.abs(np.diff(grey, axis=0)).mean()) > COMBED * float(
        np.abs(grey[2:] - grey[:-2]).mean())


def _say_if_interlaced(combed: Sequence[bool], progress: Progress) -> None:
    if combed and sum(combed) > len(combed) * SOME:
        progress.say("The footage is interlaced: every other line is of another moment, and cameras solved from it are "
                     "many times less exact; deinterlace it first.")


def gather(source: Path, work: Path, number: int, size: int, progress: Progress) -> tuple[list[Still], list[str]]:
    """Choose frames and write small pictures and masks of them below `work`.

    `number`: how many (0: all of a folder, 150 of a video); `size`: long side of the small pictures.
    Returns the stills, in order, and sentences about frames that had to be left out. What an earlier run
    wrote is taken as it is. Raises CaptureError where there is nothing to choose from, FrameError for a video that
    cannot be read.
    """
    before = gathered(work)
    if before is not None:
        return before
    if source.is_dir():
        stills, left_out = _from_folder(source, work, number, size, progress)
    elif source.is_file() and is_video(source):
        stills, left_out = _from_video(source, work, number or 150, size, progress)
    else:
        raise CaptureError(f"{source} is neither a folder of frames nor a video.")
    if len(stills) < 3:
        why = f"; {left_out[0]}" if left_out else ""
        raise CaptureError(f"{source} gives {len(stills)} frames of use, and a solve needs at least 3 that see "
                           f"the scene from different places{why}".rstrip(".") + ".")
    write_json(work / RECORD, {"stills": [asdict(still) for still in stills], "left_out": left_out})
    return stills, left_out


def gathered(work: Path) -> tuple[list[Still], list[str]] | None:
    """What `gather` has given before, None where it has not. Raises CaptureError where that is damaged."""
    if not (work / RECORD).is_file():
        return None
    data = read_json(work / RECORD, CaptureError)
    try:
        return [Still(**still) for still in data["stills"]], list(data["left_out"])
    except (KeyError, TypeError) as problem:
        raise CaptureError(f"{work / RECORD} is damaged.") from problem


def original(still: Still) -> Picture:
    """The frame at full size, upright."""
    return _upright(read_picture(Path(still.file)), still.orientation)


def _upright(picture: Picture, orientation: int) -> Picture:
    return Picture(upright(picture.pixels, orientation), picture.encoding)


def _from_folder(source: Path, work: Path, number: int, size: int,
                 progress: Progress) -> tuple[list[Still], list[str]]:
    files = pictures_in(source)
    if not files:
        raise CaptureError(f"{source} holds no frames (PNG, JPEG, TIFF or EXR).")
    left_out: list[str] = []
    if 0 < number < len(files):
        progress.stage("choose frames", len(files))
        scores = []
        for file in files:
            try:
                scores.append(sharpness(read_picture(file).display().mean(axis=2)))
            except FrameError:
                scores.append(-1.0)
            progress.advance()
        files = [files[i] for i in choose(scores, number)]
    progress.stage("read frames", len(files))
    stills, combed = list[Still](), list[bool]()
    for file in files:
        try:
            picture_size(file)
            orientation, focal = read_exif(file)
            picture = _upright(read_picture(file), orientation)
            aspect = window_of(file).aspect
        except FrameError as problem:
            left_out.append(str(problem))
            progress.say(f"Left out: {problem}")
        else:
            # Not its own name, which COLMAP would cut at a space, and which is another picture's without its suffix.
            still = Still(f"{len(stills):06d}.png", str(file.resolve()), *picture.size, focal, orientation)
            _write_small(picture, aspect, work, still.name, size)
            stills.append(still)
            combed.append(is_combed(picture))
        progress.advance()
    _say_if_interlaced(combed, progress)
    return stills, left_out


def _from_video(source: Path, work: Path, number: int, size: int,
                progress: Progress) -> tuple[list[Still], list[str]]:
    """Two passes: the sharpness of every frame, then the chosen ones."""
    import cv2

    with Video(source) as video:
        for sentence in video.says:
            progress.say(sentence)
        progress.stage("choose frames", video.length)
        scores = []
        for frame in video:
            scores.append(sharpness(np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.float32)))
            progress.advance()
    if not scores:
        raise CaptureError(f"{source} holds no frame that can be decoded; convert it to MP4 (H.264).")
    if len(scores) < video.length:
        progress.say(told_short(source, video.length, len(scores)))
    chosen = choose(scores, number)
    progress.stage("read frames", len(chosen))
    stills, combed = list[Still](), list[bool]()
    wanted = set(chosen)
    with Video(source) as video:
        for index, frame in enumerate(video):
            if index in wanted:
                picture = Picture(displayed(frame), "srgb")
                file = work / "full" / f"{index:06d}.png"
                write_png(file, picture.pixels)
                stills.append(Still(file.name, str(file.resolve()), *picture.size, None, 1))
                _write_small(picture, video.aspect, work, file.name, size)
                combed.append(is_combed(picture))
                progress.advance()
    _say_if_interlaced(combed, progress)
    return stills, []


def _write_small(picture: Picture, aspect: float, work: Path, name: str, size: int) -> None:
    """With square pixels: a solve knows one focal length, and `develop` stretches its camera to the frame's own."""
    wide = picture.size[0] * aspect
    scale = min(1.0, size / max(wide, picture.size[1]))
    width, height = (max(1, round(side * scale)) for side in (wide, picture.size[1]))
    small = picture.resized(width, height)
    write_png(work / "small" / name, _exposed(small))
    write_png(work / "masks" / f"{name}.png", usable(small).astype(np.float32))


def _exposed(picture: Picture) -> Pixels:
    """Display values; linear light is brought to a middle grey first, since EXR frames have no set exposure."""
    if picture.encoding == "linear":
        middle = float(np.median(picture.pixels.mean(axis=2)))
        gain = np.float32(0.18 / middle) if middle > 1e-6 else np.float32(1.0)
        return Picture(picture.pixels * gain, "linear").display()
    return picture.display()


def usable(picture: Picture) -> NDArray[np.bool_]:
    """Where features may be taken (h, w): not in clipped pixels nor in the bloom just round them, whose rim moves
    with exposure and glare; and not along the lines from compact clipped spots through the middle of the frame,
    where the ghosts of a light have their centres, which move with the lens. Of linear light what clips where features
    are looked for."""
    import cv2

    clipped = (_exposed(picture).max(axis=2) >= CLIPPED).astype(np.uint8)
    # Lone pixels are sparkle on a texture, and good features.
    clipped = cv2.morphologyEx(clipped, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    diagonal = float(np.hypot(*picture.size))
    lines = _ghost_lines(np.asarray(clipped, np.uint8), max(3, round(0.015 * diagonal)))
    reach = max(2, round(0.008 * diagonal))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return (np.asarray(cv2.dilate(clipped, disc)) == 0) & ~lines


def _ghost_lines(clipped: NDArray[np.uint8], thickness: int) -> NDArray[np.bool_]:
    """Bands (h, w) of the thickness in pixels, for the four largest compact spots at most."""
    import cv2

    height, width = clipped.shape
    drawn = np.zeros((height, width), np.uint8)
    number, _, boxes, centres = cv2.connectedComponentsWithStats(clipped, connectivity=8)
    middle = np.array([width, height]) / 2
    spots = []
    for label in range(1, number):
        _, _, wide, high, area = map(int, boxes[label])
        # A disc fills 0.79 of its box; a spot with spikes less, a window frame or a text far less.
        if 9 <= area <= 0.01 * width * height and area >= 0.4 * wide * high and max(wide, high) <= 3 * min(wide, high):
            spots.append((area, label))
    for _, label in sorted(spots, reverse=True)[:4]:
        away = middle - centres[label]
        length = float(np.linalg.norm(away))
        if length > 2 * thickness:
            reach = float(np.hypot(width, height)) * away / length
            start, end = (middle - reach).astype(int), (middle + reach).astype(int)
            cv2.line(drawn, tuple(map(int, start)), tuple(map(int, end)), (1.0,), thickness)
    return drawn > 0
