# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene of a fit without a camera solve: one plate, the light without flare, for each frame.

`plate_trainer` fits the flare over the plates, and `run` reads them from the folder plates/ of a run. `rendering` shows
them where it would rasterize Gaussians.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from ..capture import Camera
from ..colour import ColourSpace
from ..errors import RunError
from ..gaussians import Rendering
from ..images.picture import Picture
from ..images.read import read_picture

ReadPlate = Callable[[str], Picture | None]


class PlateScene:
    """Plates by the name of the frame; `render_frame` returns the one of a camera's frame.

    cameras: of the whole frames. read: reads the plate of a frame, of any size; None where there is none.
    """

    def __init__(self, cameras: Mapping[str, Camera], read: ReadPlate, display_white: float = 1.0) -> None:
        self._cameras, self._read, self.display_white = cameras, read, display_white

    @classmethod
    def from_folder(cls, folder: Path, cameras: Mapping[str, Camera], display_white: float,
                    space: ColourSpace | None = None) -> PlateScene:
        """Open the plates of a folder: for each frame a picture of the same name with any suffix.

        space: colour space of the pictures; None for the space that each file declares.
        """
        files = {path.with_suffix("").relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*.*"))}

        def read(frame: str) -> Picture | None:
            path = files.get(Path(frame).with_suffix("").as_posix())
            return None if path is None else read_picture(path, space=space)

        return cls(cameras, read, display_white)

    def render_frame(self, camera: Camera) -> Rendering:
        """Return the plate of the camera's frame at the camera's size, display values; it has no depth.

        The camera may show a part of the frame, at any scale. Raises RunError for a camera without a plate, such as one
        of another shot.
        """
        full_camera = self._cameras.get(camera.frame)
        plate = None if full_camera is None else self._read(camera.frame)
        if full_camera is None or plate is None:
            raise RunError("The scene of this fit is one plate per frame, and there is none for "
                           f"{camera.frame or 'this camera'}; use the frames of the fitted shot.")
        scale_x, scale_y = camera.fx / full_camera.fx, camera.fy / full_camera.fy
        size = max(round(full_camera.width * scale_x), 1), max(round(full_camera.height * scale_y), 1)
        left, top = round(full_camera.cx * scale_x - camera.cx), round(full_camera.cy * scale_y - camera.cy)
        pixels = torch.from_numpy(plate.resized(*size).display(self.display_white))
        colour = _cropped(pixels, left, top, camera)
        empty = colour.new_zeros(colour.shape[:2])
        return Rendering(colour, empty, empty, empty, colour.new_zeros(0, 2), colour.new_zeros(0),
                         colour.new_zeros(0, 2))


def _cropped(pixels: Tensor, left: int, top: int, camera: Camera) -> Tensor:
    """Return the part of a picture that a camera shows; beyond its edges the edge repeats."""
    rows = (torch.arange(camera.height) + top).clamp(0, pixels.shape[0] - 1)
    columns = (torch.arange(camera.width) + left).clamp(0, pixels.shape[1] - 1)
    return pixels[rows][:, columns]
