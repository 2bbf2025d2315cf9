# SPDX-License-Identifier: GPL-3.0-or-later
"""Identifies the views of a stereo EXR, left and right eye, in one part ("Storing Multi-View Images in OpenEXR Files",
ILM), or in a part each, as Nuke writes them.

The attribute multiView lists the views of a part; the first one's channels are at the root, the others' behind their
name ("right.R"). Some programs write every view behind its name, and no attribute. A part of one view has the attribute
view. `plates.py` refuses what it cannot keep apart, `views.py` cleans all views, transfer refuses them by name.
"""
from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import FrameError
from .exr import main_part, read_exr_headers

_EYES = ("left", "right")
"""Names by which a view is recognised where no attribute lists the views."""
_WINDOWS = ("dataWindow", "displayWindow")


class StereoView(NamedTuple):
    """A view, the names of its three colour channels, and the number of the part that holds them; a grey view has one
    name three times."""

    name: str
    channels: tuple[str, str, str]
    part: int = 0


_Parts = Sequence[tuple[Mapping[str, Any], Collection[str]]]
"""Header and channel names of each part of an EXR."""


def views_of_file(path: Path) -> list[StereoView]:
    """Return the views of an EXR file, that of its main part first; empty for a picture of one view. Raises FrameError.
    """
    return views_of_parts([(header, [channel.name for channel in header["channels"]])
                           for header in read_exr_headers(path)])


def views_of_parts(parts: _Parts) -> list[StereoView]:
    """Return the views of an EXR's parts, the main part's first; empty for a picture of one view.

    If the main part holds several views, these are returned; else one for each part that names its view.
    """
    main = main_part([(number, names) for number, (_, names) in enumerate(parts)])
    if main_views := stereo_views(*parts[main]):
        return [view._replace(part=main) for view in main_views]
    views: dict[str, StereoView] = {}
    for number in (main, *(number for number in range(len(parts)) if number != main)):
        header, names = parts[number]
        if (view := _view_of_part(header)) and (colours := _colour_channels(names, "")):
            views.setdefault(view, StereoView(view, colours, number))
    return list(views.values()) if len(views) > 1 else []


def _view_of_part(header: Mapping[str, Any]) -> str:
    """Return the name of the view that a part holds, from its attribute, else from its name, such as "rgba.left"; ""
    for none."""
    if isinstance(view := header.get("view"), str) and view:
        return view
    last = str(header.get("name", "")).rpartition(".")[2]
    return last if last.lower() in _EYES else ""


def stereo_views(header: Mapping[str, Any], names: Collection[str]) -> list[StereoView]:
    """Return the views in one part of an EXR, the one at the root first; empty for a picture of one view.

    names: names of the channels. Without the attribute multiView, views are the channel prefixes "left" and "right".
    The channels without a prefix are then named after the missing eye; "root" if both eyes have a prefix.
    """
    listed_views = [str(name) for name in header.get("multiView", ())]
    prefixes = dict.fromkeys(name.rpartition(".")[0] for name in names if name.count(".") == 1)
    eye_prefixes = [prefix for prefix in prefixes if prefix.lower() in _EYES]
    if listed_views:
        # Where the list ends with the first view, the others go by their prefixes.
        root_view, prefixed_views = listed_views[0], listed_views[1:] or eye_prefixes
    else:
        prefixed_eyes = [prefix.lower() for prefix in eye_prefixes]
        root_view = next(name for name in (*_EYES, "root") if name not in prefixed_eyes)
        prefixed_views = eye_prefixes
    views = [StereoView(root_view, colours)] if (colours := _colour_channels(names, "")) else []
    if not views and listed_views:
        prefixed_views = listed_views  # the first one is behind its name too
    views += [StereoView(view, colours) for view in prefixed_views if (colours := _colour_channels(names, f"{view}."))]
    return views if len(views) > 1 else []


def _colour_channels(names: Collection[str], prefix: str) -> tuple[str, str, str] | None:
    """Return the names of R, G, B, or three times that of Y, behind a prefix; None where neither is among `names`."""
    for channel_names in ("RGB", "YYY"):
        channels = tuple(f"{prefix}{name}" for name in channel_names)
        if all(name in names for name in channels):
            return channels[0], channels[1], channels[2]
    return None


def check_parts(path: Path, parts: _Parts) -> None:
    """Raise FrameError for an EXR with several pictures of which only one would be changed: parts that are no views of
    the picture, or views with different windows."""
    pictures = [number for number, (_, names) in enumerate(parts) if _colour_channels(names, "")]
    views = views_of_parts(parts)
    if len(pictures) > 1 and sorted(view.part for view in views) != pictures:
        raise FrameError(f"{path} has {len(parts)} parts, {len(pictures)} of them with a picture, and does not say "
                         "that these are views; export the plate as a file of its own.")
    windows = {tuple(np.ravel([parts[view.part][0].get(name, ()) for name in _WINDOWS]).tolist()) for view in views}
    if len(windows) > 1:
        raise FrameError(f"{path} has views of different data windows; export each as a file of its own.")
