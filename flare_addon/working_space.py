# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts between linear Rec. 709, the space of looks and edits, and Blender's scene-linear working space.

Under a studio's OpenColorIO configuration the working space is often ACEScg; from Blender 5.0 on a .blend may choose
it. A colour that an artist picks is in the working space.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RGB = tuple[float, float, float]

WHITE: RGB = (1.0, 1.0, 1.0)
_MAX_IDENTITY_DIFFERENCE = 1e-5
"""Largest difference of a matrix from the identity with which the working space counts as linear Rec. 709."""


def working_space() -> NDArray[np.float64]:
    """Return the matrix (3, 3) from linear Rec. 709 to Blender's working space."""
    from mathutils import Color

    return np.array([Color(axis).from_rec709_linear_to_scene_linear()[:] for axis in np.eye(3).tolist()]).T


def tint_from_picked(picked: RGB) -> RGB:
    """Return the factors of linear Rec. 709, 0 or more, of a tint that an artist picked in the working space.

    A neutral flare with this tint has the picked colour. Factors below 0, of colours outside Rec. 709, become 0.
    """
    return _convert(picked, is_inverse=True)


def picked_from_tint(tint: RGB) -> RGB:
    """Return the colour in the working space, components 0 or more, that `tint_from_picked` converts to a tint."""
    return _convert(tint, is_inverse=False)


def _convert(colour: RGB, *, is_inverse: bool) -> RGB:
    """Return a colour multiplied by the matrix of the working space, or by its inverse; white stays exactly white."""
    if colour == WHITE:  # most tints, and a drawing reads a thousand
        return WHITE
    matrix = working_space()
    if np.abs(matrix - np.eye(3)).max() <= _MAX_IDENTITY_DIFFERENCE:
        return colour
    matrix = np.linalg.inv(matrix) if is_inverse else matrix
    red, green, blue = np.maximum(matrix @ np.array(colour), 0).tolist()
    return red, green, blue
