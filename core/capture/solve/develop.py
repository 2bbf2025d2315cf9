# SPDX-License-Identifier: GPL-3.0-or-later
"""The capture on disk: undistorted frames at full size, and the model that belongs to them."""
from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...images.exr import window_of
from ...images.read import holds_floats, holds_halves, stored_pixels
from ...images.write import write_exr, write_png
from ...system.files import atomic_path, patiently
from ...system.progress import Progress
from ..camera import Camera
from ..colmap import Observed, PointCloud, write_model
from ..lens import Lens, straightened
from .mapping import Solved, SolvedFrame
from .stills import Still, original

STRAIGHT = 0.1  # pixels; a lens that bends less than this is left as it is, and the pixels untouched


def write(stills: Sequence[Still], solved: Solved, out: Path, work: Path, size: int, progress: Progress) -> None:
    """Write images/ and sparse/0 of the capture `out`; `size` is the long side of the frames, 0 as filmed.

    They are made below `work`, where a stopped run finds its frames again, and moved when all are there.
    """
    progress.stage("write frames", len(solved.frames))
    names = _names(stills)
    straight: dict[Lens, Camera] = {}
    lenses: dict[tuple[Lens, tuple[int, int]], Lens] = {}
    written = []
    for frame in solved.frames:
        still = stills[frame.still]
        scale = min(1.0, size / max(still.width, still.height)) if size else 1.0
        target = (round(still.width * scale), round(still.height * scale))
        if frame.lens not in straight:
            straight[frame.lens] = _straight(frame.lens)
        camera = straight[frame.lens].scaled(*target)
        _develop(still, frame, camera, work / "images" / names[frame.still])
        lens = lenses.setdefault((frame.lens, target), Lens("PINHOLE", (camera.fx, camera.fy, camera.cx, camera.cy),
                                                            *target))
        pixels = frame.lens.undistort(frame.pixels) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        good = np.isfinite(pixels).all(axis=1)
        written.append(Observed(names[frame.still], lens, frame.world_to_camera, pixels[good], frame.points[good]))
        progress.advance()
    larger = sum(frame.lens.width for frame in written) / sum(frame.lens.width for frame in solved.frames)
    model = solved.model
    cloud = PointCloud(model.xyz.astype(np.float32), model.rgb, (model.error * larger).astype(np.float32))
    write_model(work / "sparse" / "0", written, cloud)
    for name in ("images", "sparse"):
        shutil.rmtree(out / name, ignore_errors=True)
        patiently((work / name).rename, out / name)


def _names(stills: Sequence[Still]) -> list[str]:
    """A name for each frame: its file's, with the suffix of a lossless format that holds the file's light. No two are
    one, on any file system."""
    names: list[str] = []
    taken: set[str] = set()
    for still in stills:
        file = Path(still.file)
        suffix = ".exr" if holds_floats(file) else ".png"
        name = file.stem + suffix
        names.append(file.name + suffix if name.casefold() in taken else name)
        taken.add(names[-1].casefold())
    return names


def _straight(lens: Lens) -> Camera:
    """The pinhole camera of the undistorted frame, at the lens's size."""
    fx, fy, cx, cy = (*lens.focal, *lens.centre) if lens.bend < STRAIGHT else lens.pinhole
    return Camera(lens.width, lens.height, fx, fy, cx, cy, np.eye(4))


def _develop(still: Still, frame: SolvedFrame, camera: Camera, target: Path) -> None:
    """Write one frame as `camera` sees it, unless an earlier run has."""
    if target.is_file():
        return
    source = Path(still.file)
    bends = frame.lens.bend >= STRAIGHT
    if (not bends and camera.size == (still.width, still.height) and still.orientation == 1
            and source.suffix.lower() == target.suffix):
        with atomic_path(target) as temporary:
            shutil.copyfile(source, temporary)
        return
    picture = original(still)
    if bends:
        picture = straightened(picture, frame.lens.maps(camera.scaled(*picture.size)))
    picture = picture.resized(*camera.size)
    if target.suffix == ".exr":
        write_exr(target, dict(zip("RGB", np.moveaxis(picture.pixels, 2, 0), strict=True)), half=holds_halves(source),
                  header={"pixelAspectRatio": window_of(source).aspect})
    else:
        write_png(target, picture.display(), 16 if stored_pixels(source).dtype == np.uint16 else 8)
