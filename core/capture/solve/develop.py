# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the capture of a solve: undistorted frames at full size, and their model."""
from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...images.exr import read_data_window
from ...images.read import has_float_pixels, has_half_pixels, read_stored_pixels
from ...images.write import write_exr, write_png
from ...system.files import atomic_path, retry_while_locked
from ...system.progress import Progress
from ..camera import Camera
from ..colmap import ObservedFrame, PointCloud, write_model
from ..lens import Lens, undistort_picture
from .mapping import Solved, SolvedFrame
from .source_frames import SourceFrame, read_full_size

MIN_DISTORTION_PX = 0.1
"""Distortion below which a lens counts as a pinhole, and the pixels stay untouched."""


def write_capture(sources: Sequence[SourceFrame], solved: Solved, out: Path, work: Path, size: int,
                  progress: Progress) -> None:
    """Write images/ and sparse/0 of the capture `out`; `size` is the long side of the frames, 0 as filmed.

    They are written below `work`, where an interrupted run finds its frames again, and moved when complete.
    """
    progress.stage("write frames", len(solved.frames))
    names = _file_names(sources)
    undistorted: dict[Lens, Camera] = {}
    lenses: dict[tuple[Lens, tuple[int, int]], Lens] = {}
    observed_frames = []
    for frame in solved.frames:
        source = sources[frame.index]
        scale = min(1.0, size / max(source.width, source.height)) if size else 1.0
        size_px = (round(source.width * scale), round(source.height * scale))
        if frame.lens not in undistorted:
            undistorted[frame.lens] = _undistorted_camera(frame.lens)
        camera = undistorted[frame.lens].scaled(*size_px)
        _write_frame(source, frame, camera, work / "images" / names[frame.index])
        # One object for all frames of a lens and size: the model then has one camera for them.
        lens = lenses.setdefault((frame.lens, size_px), Lens("PINHOLE", (camera.fx, camera.fy, camera.cx, camera.cy),
                                                             *size_px))
        pixels = frame.lens.undistort(frame.pixels) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        valid = np.isfinite(pixels).all(axis=1)
        observed_frames.append(ObservedFrame(names[frame.index], lens, frame.world_to_camera, pixels[valid],
                                             frame.points[valid]))
        progress.advance()
    # Errors are in pixels of the small pictures; the model has them in pixels of the frames.
    error_scale = sum(frame.lens.width for frame in observed_frames) / sum(frame.lens.width for frame in solved.frames)
    model = solved.model
    cloud = PointCloud(model.xyz.astype(np.float32), model.rgb, (model.error * error_scale).astype(np.float32))
    write_model(work / "sparse" / "0", observed_frames, cloud)
    for name in ("images", "sparse"):
        shutil.rmtree(out / name, ignore_errors=True)
        retry_while_locked((work / name).rename, out / name)


def _file_names(sources: Sequence[SourceFrame]) -> list[str]:
    """Return a name for each frame: that of its file, with the suffix of a lossless format that can hold its light.

    The names differ even without regard to case.
    """
    names: list[str] = []
    used: set[str] = set()
    for source in sources:
        file = Path(source.file)
        suffix = ".exr" if has_float_pixels(file, source.colour_space) else ".png"
        name = file.stem + suffix
        names.append(file.name + suffix if name.casefold() in used else name)
        used.add(names[-1].casefold())
    return names


def _undistorted_camera(lens: Lens) -> Camera:
    """Return the pinhole camera of the undistorted frame, at the lens's size."""
    fx, fy, cx, cy = (*lens.focal, *lens.centre) if lens.max_distortion_px < MIN_DISTORTION_PX else lens.pinhole
    return Camera(lens.width, lens.height, fx, fy, cx, cy, np.eye(4))


def _write_frame(source: SourceFrame, frame: SolvedFrame, camera: Camera, target: Path) -> None:
    """Write one frame as `camera` sees it, unless an earlier run has."""
    if target.is_file():
        return
    file = Path(source.file)
    is_distorted = frame.lens.max_distortion_px >= MIN_DISTORTION_PX
    # A frame that needs no change is copied, not encoded again.
    if (not is_distorted and camera.size == (source.width, source.height) and source.orientation == 1
            and not source.space
            and file.suffix.lower() == target.suffix):
        with atomic_path(target) as temporary:
            shutil.copyfile(file, temporary)
        return
    picture = read_full_size(source)
    if is_distorted:
        picture = undistort_picture(picture, frame.lens.undistortion_maps(camera.scaled(*picture.size)))
    picture = picture.resized(*camera.size)
    if target.suffix == ".exr":
        channels = dict(zip("RGB", np.moveaxis(picture.pixels, 2, 0), strict=True))
        write_exr(target, channels, half=has_half_pixels(file),
                  header={"pixelAspectRatio": read_data_window(file).aspect})
    else:
        write_png(target, picture.display(), 16 if read_stored_pixels(file).dtype == np.uint16 else 8)
