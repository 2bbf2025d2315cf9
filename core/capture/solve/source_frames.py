# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the frames of a folder or a video to solve, checks them, and writes small pictures and masks of them.

From a video, or where fewer frames are wanted than exist, the footage is cut into equal stretches and the sharpest
frame of each is taken: blur costs features, and even spacing keeps the overlap.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...colour import ColourSpace, colour_space
from ...colour.srgb import Pixels
from ...errors import CaptureError, FrameError
from ...images.exr import read_data_window
from ...images.formats.exif import apply_orientation, read_exif
from ...images.listing import pictures_in, unlisted_entries
from ...images.picture import Picture
from ...images.read import read_picture
from ...images.size import picture_size
from ...images.unsupported import misnamed_reason
from ...images.video import Video, is_video, write_frame
from ...images.write import write_png
from ...system.files import read_json, write_json
from ...system.progress import Progress
from ...system.tally import list_first
from ...typed import parse_table, parse_value

RECORD_FILE = "stills.json"
"""File of the chosen frames, below the work folder."""
COMB_RATIO, MIN_COMBED_SHARE = 1.1, 0.25
"""A frame is interlaced above this ratio of line differences, and footage above this share of such frames.

Photographs have ratios of 0.6 to 0.8, moving fields 1.5 to 2.3.
"""
DEFAULT_VIDEO_FRAMES = 150
"""Number of frames that are chosen from a video by default."""
SHARPNESS_SIDE = 480
"""Long side at which sharpness is measured, pixels."""
GHOST_LINE_WIDTH, BLOOM_RADIUS = 0.015, 0.008
"""Width of the lines of ghosts and reach of bloom beyond clipped pixels, relative to the frame's diagonal."""
MAX_GHOST_LINES = 4
CLIP_LEVEL = 0.98
"""Display value at or above which the sensor says nothing about the surface."""


@dataclass(frozen=True)
class SourceFrame:
    """A frame to solve: `name` of its small picture and mask, its file, its full size in pixels, focal length and
    orientation.

    focal: multiple of the long side, where the file has it. orientation: Exif's. space, config: colour space of the
    pixels, where the user names one, and the OpenColorIO configuration that defines it.
    """

    name: str
    file: str
    width: int
    height: int
    focal: float | None
    orientation: int
    space: str = ""
    config: str | None = None

    @property
    def colour_space(self) -> ColourSpace | None:
        """The space that the user names; None for what the file declares."""
        return colour_space(self.space, self.config) if self.space else None


def choose_sharpest(sharpness: Sequence[float], number: int) -> list[int]:
    """Return the index of the sharpest frame in each of `number` equal stretches; all where `number` is 0."""
    total = len(sharpness)
    if number <= 0 or number >= total:
        return list(range(total))
    edges = np.linspace(0, total, number + 1).round().astype(int)
    return [int(start + np.argmax(sharpness[start:end])) for start, end in pairwise(edges)]


def sharpness(grey: Pixels) -> float:
    """Return the variance of the Laplacian of a grey picture (height, width): high where edges are sharp."""
    import cv2

    scale = SHARPNESS_SIDE / max(grey.shape)
    if scale < 1:
        grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.float32)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def is_interlaced(picture: Picture) -> bool:
    """Return whether adjacent lines differ more than lines two apart, which only happens between two fields."""
    grey = picture.display().mean(axis=2)
    return len(grey) > 2 and float(np.abs(np.diff(grey, axis=0)).mean()) > COMB_RATIO * float(
        np.abs(grey[2:] - grey[:-2]).mean())


def _warn_if_interlaced(interlaced: Sequence[bool], progress: Progress) -> None:
    if interlaced and sum(interlaced) > len(interlaced) * MIN_COMBED_SHARE:
        progress.say("The footage is interlaced, which makes cameras many times less accurate; deinterlace it first.")


def prepare_frames(source: Path, work: Path, number: int, size: int,
                   progress: Progress, space: tuple[str, str | None] = ("", None)
                   ) -> tuple[list[SourceFrame], list[str]]:
    """Choose frames and write small pictures and masks of them below `work`.

    `number`: how many (0: all of a folder, 150 of a video); `size`: long side of the small pictures; `space`: name of
    the colour space of the frames, "" for what they declare, and its OpenColorIO configuration. Returns the frames, in
    order, and sentences about those left out. The record of an earlier run is used as it stands. Raises
    CaptureError where there are too few frames, FrameError for a video that cannot be read.
    """
    earlier = read_record(work)
    if earlier is not None:
        return earlier
    if source.is_dir():
        frames, left_out = _prepare_folder(source, work, number, size, progress, space)
    elif source.is_file() and is_video(source):
        frames, left_out = _prepare_video(source, work, number or DEFAULT_VIDEO_FRAMES, size, progress, space)
    else:
        reason = misnamed_reason(source) if source.is_file() else ""
        raise CaptureError(f"{source} is neither a folder of frames nor a video{f': it {reason}' if reason else ''}.")
    if len(frames) < 3:
        first_problem = f"; {left_out[0]}" if left_out else ""
        raise CaptureError(f"{source} gives {len(frames)} usable frames, and a solve needs at least 3 that see "
                           f"the scene from different places{first_problem}".rstrip(".") + ".")
    write_json(work / RECORD_FILE, {"stills": [asdict(frame) for frame in frames], "left_out": left_out})
    return frames, left_out


def read_record(work: Path) -> tuple[list[SourceFrame], list[str]] | None:
    """Read the result of an earlier `prepare_frames`, or None. Raises CaptureError where it is damaged."""
    if not (work / RECORD_FILE).is_file():
        return None
    data = read_json(work / RECORD_FILE, CaptureError)
    try:
        return ([parse_table(SourceFrame, frame) for frame in data["stills"]],
                [parse_value(str, message) for message in data["left_out"]])
    except (KeyError, TypeError, ValueError) as problem:
        raise CaptureError(f"{work / RECORD_FILE} is damaged.") from problem


def read_full_size(frame: SourceFrame) -> Picture:
    """Read the frame at full size, upright."""
    return _to_upright(read_picture(Path(frame.file), space=frame.colour_space, over_black=True), frame.orientation)


def _to_upright(picture: Picture, orientation: int) -> Picture:
    return Picture(apply_orientation(picture.pixels, orientation), picture.encoding)


def _prepare_folder(source: Path, work: Path, number: int, size: int,
                    progress: Progress, space: tuple[str, str | None]) -> tuple[list[SourceFrame], list[str]]:
    """Prepare the frames of a folder, as `prepare_frames` describes; return them, and why others were left out."""
    named_space = colour_space(*space) if space[0] else None
    files = pictures_in(source)
    if not files:
        names = [name for reason, names in unlisted_entries(source) if reason.startswith(("a subfolder", "a video"))
                 for name in names]
        raise CaptureError(f"{source} holds no frames; " + (
            f"{list_first(names)} in it does: name that." if len(names) == 1 else
            f"{list_first(names)} in it do: name one of them." if names else
            "give a folder with PNG, JPEG, TIFF or EXR files, or a video."))
    left_out: list[str] = []
    if 0 < number < len(files):
        progress.stage("choose frames", len(files))
        scores = []
        for file in files:
            try:
                scores.append(sharpness(read_picture(file, space=named_space, over_black=True).display().mean(axis=2)))
            except FrameError:
                scores.append(-1.0)  # chosen only where its stretch has no other; it is then left out
            progress.advance()
        files = [files[i] for i in choose_sharpest(scores, number)]
    progress.stage("read frames", len(files))
    frames, interlaced = list[SourceFrame](), list[bool]()
    for file in files:
        try:
            picture_size(file)
            orientation, focal = read_exif(file)
            picture = _to_upright(read_picture(file, space=named_space, over_black=True), orientation)
            aspect = read_data_window(file).aspect
        except FrameError as problem:
            left_out.append(str(problem))
            progress.say(f"Left out: {problem}")
        else:
            # A number: COLMAP would cut a name at a space, and names may differ only by their suffix.
            frame = SourceFrame(f"{len(frames):06d}.png", str(file.resolve()), *picture.size, focal, orientation,
                                *space)
            _write_small(picture, aspect, work, frame.name, size)
            frames.append(frame)
            interlaced.append(is_interlaced(picture))
        progress.advance()
    _warn_if_interlaced(interlaced, progress)
    return frames, left_out


def _prepare_video(source: Path, work: Path, number: int, size: int,
                   progress: Progress, space: tuple[str, str | None]) -> tuple[list[SourceFrame], list[str]]:
    """Prepare the frames of a video, as `prepare_frames` describes; the list of frames left out is empty.

    The video is read twice: for the sharpness of every frame, then for the chosen ones.
    """
    named_space = colour_space(*space) if space[0] else None
    with Video(source) as video:
        if named_space is not None:
            video.check_named_space(named_space.name)
        progress.stage("choose frames", video.estimated_length)
        scores = []
        for frame in video:
            scores.append(sharpness(frame.grey()))
            progress.advance()
        for problem in video.problems:
            progress.say(problem)
    if not scores:
        raise CaptureError(f"{source} holds no frame that can be decoded; convert it to MP4 (H.264).")
    chosen = set(choose_sharpest(scores, number))
    progress.stage("read frames", len(chosen))
    frames, interlaced = list[SourceFrame](), list[bool]()
    with Video(source) as video:
        for frame in video:
            if frame.number in chosen:
                file = write_frame(work / "full" / f"{frame.number:06d}", frame)
                picture = frame.picture() if named_space is None else read_picture(file, space=named_space)
                frames.append(SourceFrame(f"{file.stem}.png", str(file.resolve()), *picture.size, None, 1, *space))
                _write_small(picture, video.aspect, work, frames[-1].name, size)
                interlaced.append(is_interlaced(picture))
                progress.advance()
    _warn_if_interlaced(interlaced, progress)
    return frames, []


def _write_small(picture: Picture, aspect: float, work: Path, name: str, size: int) -> None:
    """Write the small picture and its mask, with square pixels.

    aspect: pixel aspect ratio of the picture. size: long side of the small one, which is never enlarged. A solve has
    one focal length; `develop` stretches its camera to the frame's pixels.
    """
    square_width = picture.size[0] * aspect
    scale = min(1.0, size / max(square_width, picture.size[1]))
    width, height = (max(1, round(side * scale)) for side in (square_width, picture.size[1]))
    small = picture.resized(width, height)
    write_png(work / "small" / name, _to_display(small))
    write_png(work / "masks" / f"{name}.png", feature_mask(small).astype(np.float32))


def _to_display(picture: Picture) -> Pixels:
    """Convert to display values; EXR frames, which have no set exposure, are scaled to a middle grey first."""
    if picture.encoding == "linear":
        median = float(np.median(picture.pixels.mean(axis=2)))
        gain = np.float32(0.18 / median) if median > 1e-6 else np.float32(1.0)
        return Picture(picture.pixels * gain, "linear").display()
    return picture.display()


def feature_mask(picture: Picture) -> NDArray[np.bool_]:
    """Return (h, w), True where features may be extracted: not on clipped pixels, their bloom, or the lines of ghosts.

    The rim of a bloom moves with exposure and flare. The ghosts of a light lie on the line from its clipped spot
    through the centre of the frame, and move with the lens. In linear light, a pixel counts as clipped that
    is clipped in the small picture.
    """
    import cv2

    clipped = (_to_display(picture).max(axis=2) >= CLIP_LEVEL).astype(np.uint8)
    # Lone pixels are sparkle on a texture, and good features.
    clipped = cv2.morphologyEx(clipped, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    diagonal = float(np.hypot(*picture.size))
    lines = _ghost_lines(np.asarray(clipped, np.uint8), max(3, round(GHOST_LINE_WIDTH * diagonal)))
    bloom_radius = max(2, round(BLOOM_RADIUS * diagonal))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * bloom_radius + 1, 2 * bloom_radius + 1))
    return (np.asarray(cv2.dilate(clipped, disc)) == 0) & ~lines


def _ghost_lines(clipped: NDArray[np.uint8], thickness: int) -> NDArray[np.bool_]:
    """Return the mask (h, w) of lines through the frame's centre and the largest compact spots of a mask (h, w).

    The ghosts of a light lie on the line through it and the centre. clipped: the mask, 1 where a pixel is clipped.
    thickness: width of the lines, pixels.
    """
    import cv2

    height, width = clipped.shape
    lines = np.zeros((height, width), np.uint8)
    number, _, boxes, centres = cv2.connectedComponentsWithStats(clipped, connectivity=8)
    centre = np.array([width, height]) / 2
    spots = []
    for label in range(1, number):
        _, _, box_width, box_height, area = map(int, boxes[label])
        # A disc fills 0.79 of its box; a spot with spikes less, a window frame or a text far less.
        is_filled = area >= 0.4 * box_width * box_height
        is_round = max(box_width, box_height) <= 3 * min(box_width, box_height)
        if 9 <= area <= 0.01 * width * height and is_filled and is_round:
            spots.append((area, label))
    for _, label in sorted(spots, reverse=True)[:MAX_GHOST_LINES]:
        direction = centre - centres[label]
        length = float(np.linalg.norm(direction))
        if length > 2 * thickness:
            half = float(np.hypot(width, height)) * direction / length
            start, end = (centre - half).astype(int), (centre + half).astype(int)
            cv2.line(lines, tuple(map(int, start)), tuple(map(int, end)), (1.0,), thickness)
    return lines > 0
