# SPDX-License-Identifier: GPL-3.0-or-later
"""The capture on disk: undistorted frames at full size, and the model that belongs to them."""
from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...files import atomic_path, patiently
from ...pictures import holds_floats, holds_halves, stored_pixels, window_of, write_exr, write_png
from ...progress import Progress
from ..camera import Camera
from ..colmap import Observed, PointCloud, write_model
from ..lens import Lens, straightened
from .mapping import Solved, SolvedFrame
from .shots import Shot, original

STRAIGHT = 0.1  # pixels; a lens that bends less than this is left as it is, and the pixels untouched


def write(shots: Sequence[Shot], solved: Solved, out: Path, work: Path, size: int, progress: Progress) -> None:
    """Write images/ and sparse/0 of the capture `out`; `size` is the long side of the frames, 0 as filmed.

    They are made below `work`, where a stopped run finds its frames again, and moved when all are there.
    """
    progress.stage("write frames", len(solved.frames))
    names = _names(shots)
    straight: dict[Lens, Camera] = {}
    lenses: dict[tuple[Lens, tuple[int, int]], Lens] = {}
    written = []
    for frame in solved.frames:
        shot = shots[frame.shot]
        scale = min(1.0, size / max(shot.width, shot.height)) if size else 1.0
        target = (round(shot.width * scale), round(shot.height * scale))
        if frame.lens not in straight:
            straight[frame.lens] = _straight(frame.lens)
        camera = straight[frame.lens].scaled(*target)
        _develop(shot, frame, camera, work / "images" / names[frame.shot])
        lens = lenses.setdefault((frame.lens, target), Lens("PINHOLE", (camera.fx, camera.fy, camera.cx, camera.cy),
                                                            *target))
        pixels = frame.lens.undistort(frame.pixels) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        good = np.isfinite(pixels).all(axis=1)
        written.append(Observed(names[frame.shot], lens, frame.world_to_camera, pixels[good], frame.points[good]))
        progress.advance()
    larger = sum(frame.lens.width for frame in written) / sum(frame.lens.width for frame in solved.frames)
    model = solved.model
    cloud = PointCloud(model.xyz.astype(np.float32), model.rgb, (model.error * larger).astype(np.float32))
    write_model(work / "sparse" / "0", written, cloud)
    for name in ("images", "sparse"):
        shutil.rmtree(out / name, ignore_errors=True)
        patiently((work / name).rename, out / name)


def _names(shots: Sequence[Shot]) -> list[str]:
    """A name for each frame: its file's, with the suffix of a lossless format that holds the file's light. No two are
    one, on any file system."""
    names: list[str] = []
    taken: set[str] = set()
    for shot in shots:
        file = Path(shot.file)
        suffix = ".exr" if holds_floats(file) else ".png"
        name = file.stem + suffix
        names.append(file.name + suffix if name.casefold() in taken else name)
        taken.add(names[-1].casefold())
    return names


def _straight(lens: Lens) -> Camera:
    """The pinhole camera of the undistorted frame, at the lens's size."""
    fx, fy, cx, cy = (*lens.focal, *lens.centre) if lens.bend < STRAIGHT else lens.pinhole
    return Camera(lens.width, lens.height, fx, fy, cx, cy, np.eye(4))


def _develop(shot: Shot, frame: SolvedFrame, camera: Camera, target: Path) -> None:
    """Write one frame as `camera` sees it, unless an earlier run has."""
    if target.is_file():
        return
    source = Path(shot.file)
    bends = frame.lens.bend >= STRAIGHT
    if (not bends and camera.size == (shot.width, shot.height) and shot.orientation == 1
            and source.suffix.lower() == target.suffix):
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)
        return
    picture = original(shot)
    if bends:
        picture = straightened(picture, frame.lens.maps(camera.scaled(*picture.size)))
    picture = picture.resized(*camera.size)
    if target.suffix == ".exr":
        write_exr(target, dict(zip("RGB", np.moveaxis(picture.pixels, 2, 0), strict=True)), half=holds_halves(source),
                  header={"pixelAspectRatio": window_of(source).aspect})
    else:
        write_png(target, picture.display(), 16 if stored_pixels(source).dtype == np.uint16 else 8)
