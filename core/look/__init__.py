# SPDX-License-Identifier: GPL-3.0-or-later
"""A .flare looked at without the engine: read, evaluated for a camera and lights, edited, drawn. numpy alone.

    look = read("lamp.flare")
    seen = look.evaluate(world_to_camera, edits=LookEdits.parse(["lamp.intensity=2"], look.names))
    picture = draw(seen.values(), intrinsics, 960, 540, look.blend, look.sampling)

    container.py   the safetensors file
    network.py     hash grids and the deformation network
    plane.py       Gaussians on the normalised plane, placement and colour
    elements.py    the Gaussians of a light as named ghosts, streaks, rings, glare
    edits.py       what an artist changes: the one definition, which bake and transfer use too
    keyed.py       edits that differ from frame to frame
    look.py        all of it together
    shot.py        cameras and placed lights frame by frame, written down for the engine to render
    drawing.py     Gaussians to pixels, for thumbnails and checks
"""
from __future__ import annotations

from .drawing import draw
from .edits import Edit, LookEdits
from .elements import Element
from .keyed import KeyedEdits
from .look import LightLook, Look, TrainedCamera, ViewOfLight, list_elements, read
from .plane import PlaneGaussians, pixels

__all__ = ["Edit", "Element", "KeyedEdits", "LightLook", "Look", "LookEdits", "PlaneGaussians", "TrainedCamera",
           "ViewOfLight", "draw", "list_elements", "pixels", "read"]
