# SPDX-License-Identifier: GPL-3.0-or-later
"""Splits a plate into its views, left and right eye of a stereo EXR, and joins their clean plates.

Removal cleans all views so. `exr_views.py` identifies them.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .exr_views import StereoView, views_of_parts
from .plates import Plate, write_plate, write_results
from .write import write_exr


def _parts_of_plate(plate: Plate) -> list[tuple[Mapping[str, Any], Mapping[str, NDArray[Any]]]]:
    """Return header and channels of each part of a plate."""
    return list(plate.extras.get("parts") or [(plate.extras.get("header", {}), plate.extras.get("channels", {}))])


def _views_of_plate(plate: Plate) -> list[StereoView]:
    """Return the views of a plate, that of its codes first; empty for a picture of one view."""
    return views_of_parts(_parts_of_plate(plate))


def split_views(plate: Plate) -> list[tuple[str, Plate]]:
    """Return (name, plate) of each view of a plate; the plate itself, with the name "", where it has only one."""
    parts, views = _parts_of_plate(plate), _views_of_plate(plate)
    if not views:
        return [("", plate)]
    return [(view.name, _view_plate(plate, view, *parts[view.part])) for view in views]


def _view_plate(plate: Plate, view: StereoView, header: Mapping[str, Any],
                channels: Mapping[str, NDArray[Any]]) -> Plate:
    """Return the plate of one view. header, channels: of the part that holds it."""
    return replace(plate, codes=np.stack([np.asarray(channels[name]) for name in view.channels], -1),
                   grey=len(set(view.channels)) == 1, extras={"header": header, "channels": channels})


def join_views(plate: Plate, codes: Sequence[NDArray[Any]]) -> tuple[Plate, NDArray[Any]]:
    """Return the arguments for `write_plate`: the plate, whose channels hold the new codes of all views but the first,
    and the codes of the first view.

    codes: codes of each view, in the order of `split_views`.
    """
    views = _views_of_plate(plate)
    if not views:
        return plate, codes[0]
    parts, is_changed = [(header, dict(channels)) for header, channels in _parts_of_plate(plate)], False
    for view, view_codes in zip(views[1:], codes[1:], strict=True):
        channels = parts[view.part][1]
        for index, name in enumerate(view.channels):
            new_channel = np.ascontiguousarray(view_codes[..., index], channels[name].dtype)
            is_changed = is_changed or not np.array_equal(new_channel, channels[name], equal_nan=True)
            channels[name] = new_channel
    extras = {**plate.extras, "channels": parts[views[0].part][1]}
    if "parts" in extras:
        extras["parts"] = parts
    # `write_plate` copies a plate whose codes are unchanged. Empty codes prevent that if only another view has changed.
    return replace(plate, extras=extras, codes=plate.codes[:0] if is_changed else plate.codes), codes[0]


def write_view_results(results: Sequence[Path], plate: Plate,
                       cleaned: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> None:
    """Write the clean plate with all its views, and the flares of all if `results` has a second path.

    cleaned: (codes, flare) of each view, in the order of `split_views`. The channels of the first view's flare have no
    prefix ("R"), those of the others have the view's name ("right.R").
    """
    views = _views_of_plate(plate)
    if not views:
        write_results(results, plate, *cleaned[0])
        return
    write_plate(results[0], *join_views(plate, [codes for codes, _ in cleaned]))
    for result in results[1:]:
        channels = {f"{view.name}.{name}" if number else name: flare[..., k]
                    for number, (view, (_, flare)) in enumerate(zip(views, cleaned, strict=True))
                    for k, name in enumerate("RGB")}
        write_exr(result, channels, header={**plate.placement, "multiView": [view.name for view in views]})
