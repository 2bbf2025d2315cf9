# SPDX-License-Identifier: GPL-3.0-or-later
"""The sample captures by name."""
from __future__ import annotations

from ..description import SceneDescription
from . import desk, gallery, garden, hill, street, studio

SCENES: dict[str, SceneDescription] = {scene.name: scene for scene in (
    desk.DESK, street.STREET, gallery.GALLERY, garden.GARDEN, garden.RIMS, hill.HILL,
    studio.STUDIO)}
