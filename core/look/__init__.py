# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads a .flare with numpy alone, without torch, and evaluates, edits and draws it for any camera and lights.

    look = read_look("lamp.flare")
    flares = look.evaluate(world_to_camera, edits=LookEdits.parse(["lamp.intensity=2"], look.names))
    picture = draw(flares.values(), intrinsics, 960, 540, look.blend, look.pixel_grid)

    form.py        the switches and sizes of a flare model
    container.py   the safetensors file
    network.py     hash grids and the deformation network
    plane.py       Gaussians on the normalised plane, placement and colour
    elements.py    the Gaussians of a light grouped into named ghosts, streaks, rings and glare
    edits.py       an artist's edits, for the overlay, bake and transfer
    keyed.py       edits by frame
    look.py        the lights of a .flare: reading and evaluation
    shot.py        cameras and placed lights by frame, as a JSON file that `bake` renders
    drawing.py     rasterization of Gaussians: the definition
    pyramid.py     the same picture drawn faster, for bakes without an engine
"""
from __future__ import annotations

from .drawing import draw
from .edits import Edit, LookEdits
from .elements import Element
from .keyed import KeyedEdits
from .look import LightLook, Look, PlacedLight, TrainedCamera, ViewOfLight, read_look, store_elements
from .plane import PlaneGaussians, to_pixels

__all__ = ["Edit", "Element", "KeyedEdits", "LightLook", "Look", "LookEdits", "PlacedLight", "PlaneGaussians",
           "TrainedCamera", "ViewOfLight", "draw", "read_look", "store_elements", "to_pixels"]
