# SPDX-License-Identifier: GPL-3.0-or-later
"""A contact sheet of baked layers: frame | composite | scene | flare, one row per view, in display values."""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..images.contact_sheet import add_label, side_by_side
from ..images.picture import Picture
from ..images.write import write_png
from .layers import FrameLayers

TITLES = ("frame", "composite", "scene", "flare")


def contact_sheet(path: Path | str, rows: Iterable[tuple[str, Picture, FrameLayers]]) -> None:
    """Write the sheet as a PNG to `path`. rows: name, frame and layers of each view, all of one size."""
    strips = []
    for name, frame, layers in rows:
        linear = (layers.composite, layers.scene, layers.flare)
        pictures = [frame.display(), *(Picture(np.maximum(layer, 0), "linear").display() for layer in linear)]
        strips.append(side_by_side([add_label(f"{title}  {name}", picture)
                                    for title, picture in zip(TITLES, pictures, strict=True)]))
    if strips:
        write_png(path, np.concatenate(strips, axis=0))
