# SPDX-License-Identifier: GPL-3.0-or-later
"""Views of a stereo EXR, left and right eye, in one part ("Storing Multi-View Images in OpenEXR Files", ILM).

The attribute multiView lists the views; the first one's channels are at the root, the others' behind their name
("right.R"). Some programs write every view behind its name, and no attribute. Removal cleans all views (`split_views`),
transfer refuses them by name.
"""
from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .exr import read_exr_header
from .plates import Plate, write_plate, write_results
from .write import write_exr

_EYES = ("left", "right")


class View(NamedTuple):
    """A view and the names of its three colour channels; a grey view has one name three times."""

    name: str
    channels: tuple[str, str, str]


def read_header_and_names(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Read the header of an EXR's first part, and the names of its channels. Raises FrameError."""
    header = read_exr_header(path)
    return header, [channel.name for channel in header["channels"]]


def stereo_views(header: Mapping[str, Any], names: Collection[str]) -> list[View]:
    """Return the views of an EXR's part, the one at the root first; empty for a picture of one view."""
    listed = [str(name) for name in header.get("multiView", ())]
    prefixed = dict.fromkeys(name.rpartition(".")[0] for name in names if name.count(".") == 1)
    eyes = listed[1:] or [name for name in prefixed if name.lower() in _EYES]
    root = listed[0] if listed else next(name for name in (*_EYES, "root") if name not in [eye.lower() for eye in eyes])
    views = [View(root, colours)] if (colours := _colours(names, "")) else []
    if not views and listed:
        eyes = listed
    views += [View(eye, colours) for eye in eyes if (colours := _colours(names, f"{eye}."))]
    return views if len(views) > 1 else []


def _colours(names: Collection[str], prefix: str) -> tuple[str, str, str] | None:
    for each in ("RGB", "YYY"):
        channels = tuple(f"{prefix}{name}" for name in each)
        if all(name in names for name in channels):
            return channels[0], channels[1], channels[2]
    return None


def split_views(plate: Plate) -> list[tuple[str, Plate]]:
    """Return (name, plate) of each view of a plate; the plate itself, with the name "", where it has one."""
    channels = plate.extras.get("channels", {})
    views = stereo_views(plate.extras.get("header", {}), channels)
    if not views:
        return [("", plate)]
    return [(view.name, replace(plate, codes=np.stack([np.asarray(channels[name]) for name in view.channels], -1),
                                grey=len(set(view.channels)) == 1)) for view in views]


def join_views(plate: Plate, codes: Sequence[NDArray[Any]]) -> tuple[Plate, NDArray[Any]]:
    """Return the plate with the codes of all its views but the first, and those of the first, for `write_plate`.

    codes: of each view of `split_views`.
    """
    views = stereo_views(plate.extras.get("header", {}), plate.extras.get("channels", {}))
    if not views:
        return plate, codes[0]
    channels, is_changed = dict(plate.extras["channels"]), False
    for view, each in zip(views[1:], codes[1:], strict=True):
        for index, name in enumerate(view.channels):
            new = np.ascontiguousarray(each[..., index], channels[name].dtype)
            is_changed = is_changed or not np.array_equal(new, channels[name], equal_nan=True)
            channels[name] = new
    # Without its own codes, `write_plate` does not take the file for unchanged because the first view is.
    return replace(plate, extras={**plate.extras, "channels": channels},
                   codes=plate.codes[:0] if is_changed else plate.codes), codes[0]


def write_view_results(results: Sequence[Path], plate: Plate,
                       cleaned: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> None:
    """Write the clean plate with all its views, and the flares of all if `results` has a second path.

    cleaned: codes and flare of each view of `split_views`.
    """
    views = stereo_views(plate.extras.get("header", {}), plate.extras.get("channels", {}))
    if not views:
        write_results(results, plate, *cleaned[0])
        return
    write_plate(results[0], *join_views(plate, [codes for codes, _ in cleaned]))
    for result in results[1:]:
        channels = {f"{view.name}.{name}" if number else name: flare[..., k]
                    for number, (view, (_, flare)) in enumerate(zip(views, cleaned, strict=True))
                    for k, name in enumerate("RGB")}
        write_exr(result, channels, header={**plate.placement, "multiView": [view.name for view in views]})
