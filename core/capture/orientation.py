# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds out whether cameras were solved from photographs as stored or as shown, where their Exif data turn them.

Some programs solve the stored pixels, others apply the Exif orientation first, and neither says so. Where the
orientation exchanges width and height, the size of the camera decides. Else the points decide: their colours match the
picture that was solved. `Capture.open` calls it; most captures have no such photographs.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..colour.srgb import Pixels
from ..errors import FrameError
from ..images.formats.exif import SWAPS_SIDES, apply_orientation, read_exif
from ..images.picture import same_aspect
from ..images.read import read_picture
from ..images.size import picture_size
from .colmap import PointCloud, PosedFrame

SAMPLED_FRAMES = 6
"""Number of frames whose colours are compared."""
SAMPLED_POINTS = 4000
"""Approximate number of points whose colours are compared."""
MIN_POINTS = 30
"""Number of points on a frame from which their colours count."""
MAX_ERROR_RATIO = 0.9
"""Ratio of the colour errors of the two readings below which the smaller one decides."""


@dataclass(frozen=True)
class TurnedFrame:
    """A frame whose file has an Exif orientation (2 to 8), with the size of its stored pixels."""

    posed: PosedFrame
    path: Path
    orientation: int
    size: tuple[int, int]

    @property
    def upright_size(self) -> tuple[int, int]:
        """(width, height) as viewers show it."""
        return self.size[::-1] if self.orientation in SWAPS_SIDES else self.size


def exif_orientation(path: Path) -> int:
    """Return the Exif orientation of a picture; 1 where it cannot be read, which the check of its size reports."""
    try:
        return read_exif(path)[0]
    except OSError:
        return 1


def turned_frame(posed: PosedFrame, path: Path | None) -> TurnedFrame | None:
    """Return a frame whose file has an Exif orientation; None for others, and without a file."""
    orientation = 1 if path is None else exif_orientation(path)
    if path is None or orientation == 1:
        return None
    try:
        return TurnedFrame(posed, path, orientation, picture_size(path))
    except FrameError:  # the check of its size reports it
        return None


def upright_frames_of(frames: Iterable[PosedFrame], files: Mapping[str, Path],
                      points: PointCloud | None) -> tuple[dict[str, TurnedFrame], list[str]]:
    """Return the frames that were solved from the picture as its Exif orientation turns it, by the name of the pose,
    and sentences for the user.

    files: pictures by pose name. points: of the solve; None without one, where all turned frames count.
    """
    turned = [frame for posed in frames if (frame := turned_frame(posed, files.get(posed.name))) is not None]
    upright, warnings = ({frame.posed.name for frame in turned}, []) if points is None else find_upright(turned, points)
    return {frame.posed.name: frame for frame in turned if frame.posed.name in upright}, warnings


def find_upright(frames: Sequence[TurnedFrame], points: PointCloud) -> tuple[set[str], list[str]]:
    """Return the names of the frames that were solved as shown, and sentences for the user.

    Frames that nothing decides count as solved from their stored pixels.
    """
    upright: set[str] = set()
    undecided: dict[int, list[TurnedFrame]] = {}
    for frame in frames:
        lens = (frame.posed.lens.width, frame.posed.lens.height)
        fits_stored, fits_shown = same_aspect(frame.size, lens), same_aspect(frame.upright_size, lens)
        if fits_stored and fits_shown:
            undecided.setdefault(frame.orientation, []).append(frame)
        elif fits_shown:
            upright.add(frame.posed.name)
    warnings = [_describe_reading(sorted(upright), "as shown, by the sizes of their cameras")] if upright else []
    for orientation, group in sorted(undecided.items()):
        names = [frame.posed.name for frame in group]
        is_upright = _matches_upright(group, points)
        if is_upright is None:
            warnings.append(_describe_reading(
                names, f"as stored, though their Exif orientation is {orientation}: no coloured points show which. If "
                "the fit comes out turned, remove that tag"))
        elif is_upright:
            upright.update(names)
            warnings.append(_describe_reading(names, "as shown, by the colours of the points"))
    return upright, warnings


def _describe_reading(names: Sequence[str], reading: str) -> str:
    """Return a warning on how photographs of these names are read. reading: as stored or as shown, and why."""
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"Photographs with an Exif orientation ({names[0]}{more}) are read {reading}."


def _matches_upright(frames: Sequence[TurnedFrame], points: PointCloud) -> bool | None:
    """Compare the points' colours with the frames as stored and as shown, turned by their Exif orientation.

    Returns True if they match the frames as shown, False as stored, None where they do not decide.
    """
    error_stored = error_upright = 0.0
    compared = 0
    for frame in frames[::max(len(frames) // SAMPLED_FRAMES, 1)][:SAMPLED_FRAMES]:
        try:
            picture = read_picture(frame.path).display()
        except (FrameError, ImportError):  # a damaged frame is reported by whoever decodes it; Blender has no OpenCV
            continue
        errors = [_colour_error(pixels, frame.posed, points)
                  for pixels in (picture, apply_orientation(picture, frame.orientation))]
        if None not in errors:
            error_stored, error_upright = error_stored + (errors[0] or 0), error_upright + (errors[1] or 0)
            compared += 1
    if not compared or min(error_stored, error_upright) > MAX_ERROR_RATIO * max(error_stored, error_upright):
        return None
    return error_upright < error_stored


def _colour_error(picture: Pixels, posed: PosedFrame, points: PointCloud) -> float | None:
    """Return the median difference between the points' colours and the picture at their images; None for few points.

    picture: (height, width, 3), display values 0..1, of any size. Points that the frame observed are compared; without
    enough of them all points.
    """
    point_indices = posed.points if len(posed.points) >= MIN_POINTS else np.arange(len(points))
    point_indices = point_indices[::max(len(point_indices) // SAMPLED_POINTS, 1)]
    local = points.xyz[point_indices] @ posed.world_to_camera[:3, :3].T + posed.world_to_camera[:3, 3]
    is_in_front = local[:, 2] > 0
    height, width = picture.shape[:2]
    scale = np.array([width / posed.lens.width, height / posed.lens.height])
    pixels = posed.lens.distort(local[is_in_front, :2] / local[is_in_front, 2:]) * scale
    with np.errstate(invalid="ignore"):
        is_inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    if is_inside.sum() < MIN_POINTS:
        return None
    colours = points.rgb[point_indices][is_in_front][is_inside] / np.float32(255)
    x, y = pixels[is_inside].astype(int).T
    return float(np.median(np.abs(picture[y, x] - colours).mean(axis=1)))
