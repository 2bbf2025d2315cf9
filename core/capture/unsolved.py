# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes cameras for frames without a camera solve: a shot from a tripod, a pan, or footage that cannot be solved.

All frames share one camera at the origin, with the principal point in the middle and a focal length that a caller
gives, that camera.json records, that the Exif data of a frame have, or that lenses usually have. `Capture.open` calls
it.

    camera.json    {"focal_px": 408.0, "width": 480}    focal length in pixels of frames of that width
"""
from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import CaptureError, FrameError
from ..images.formats.exif import SWAPS_SIDES, read_exif
from ..images.listing import pictures_below, pictures_in
from ..images.size import picture_size
from ..system.file_names import find_entry
from ..system.files import read_json
from .camera_solve import CameraSolve
from .colmap import PointCloud, PosedFrame
from .lens import Lens
from .lights import is_finite

CAMERA = "camera.json"
"""Name of the file in a capture's folder that records the focal length."""
USUAL_FOCAL = 0.85
"""Focal length as a multiple of the frame's longer side where nothing says it: a field of view of 61 degrees."""
MIN_FOCAL, MAX_FOCAL = 0.1, 100.0
"""Focal lengths that a lens can have, as multiples of the longer side."""


def cameras_without_solve(folder: Path, focal: float | None = None) -> tuple[CameraSolve, str]:
    """Return the frames of a folder with one camera, and the source of the focal length, a noun phrase.

    The frames are those in images/ or, without it, those in the folder itself. focal: pixels of the first frame; None
    for camera.json, Exif data, or the usual one. Raises CaptureError without frames and for an impossible focal length,
    FrameError for a frame that is no picture.
    """
    images = find_entry(folder, "images")
    root = images if images is not None and images.is_dir() else folder
    paths = pictures_below(root) if root != folder else pictures_in(folder)
    if not paths:
        raise CaptureError(f"{folder} has no frames: neither images/ nor pictures; name a folder with frames.")
    sizes = [_upright_size(path) for path in paths]
    multiple, source = _focal_multiple(folder, paths[0], sizes[0], focal)
    frames = []
    for path, (width, height) in zip(paths, sizes, strict=True):
        focal_px = multiple * max(width, height)
        lens = Lens("SIMPLE_PINHOLE", (focal_px, width / 2, height / 2), width, height)
        frames.append(PosedFrame(path.relative_to(root).as_posix(), lens, np.eye(4)))
    return CameraSolve(frames, PointCloud.empty(), root), source


def _focal_multiple(folder: Path, first: Path, size: tuple[int, int], focal: float | None) -> tuple[float, str]:
    """Return the focal length as a multiple of the longer side, and its source.

    Taken from `focal` (pixels) if given, else from camera.json, else from Exif data, else USUAL_FOCAL. first: file
    of the first frame. size: its (width, height).
    """
    record_path = find_entry(folder, CAMERA)
    if focal is not None:
        multiple, source = focal / max(size), "as given"
    elif record_path is not None and record_path.is_file():
        data = read_json(record_path, CaptureError)
        focal_px, width = (data.get(key) if isinstance(data, dict) else None for key in ("focal_px", "width"))
        if focal_px is None or width is None or not (is_finite(focal_px) and is_finite(width) and width > 0):
            raise CaptureError(f'{record_path} should read {{"focal_px": 400.0, "width": 480}}; correct or remove it.')
        multiple, source = focal_px / width * size[0] / max(size), f"from {CAMERA}"
    else:
        exif_focal = _exif_focal(first)
        multiple = USUAL_FOCAL if exif_focal is None else exif_focal
        source = "a usual one" if exif_focal is None else f"from the Exif data of {first.name}"
    if not MIN_FOCAL <= multiple <= MAX_FOCAL:
        raise CaptureError(f"A focal length of {multiple * max(size):.4g} pixels ({source}) is none that a lens has "
                           f"for frames of {size[0]} x {size[1]}; give it in pixels.")
    return multiple, source


def _exif_focal(path: Path) -> float | None:
    try:
        return read_exif(path)[1]
    except OSError:
        return None


def _upright_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a frame as viewers show it."""
    width, height = picture_size(path)
    try:
        orientation = read_exif(path)[0]
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    return (height, width) if orientation in SWAPS_SIDES else (width, height)
