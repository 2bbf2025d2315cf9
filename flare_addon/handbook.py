# SPDX-License-Identifier: GPL-3.0-or-later
"""The handbook: addresses of its pages for the buttons of panels and preferences, and for Blender's Online Manual.

The extension contains the handbook as HTML pages; a source tree has its Markdown. Nothing is loaded from the network.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

_ROOT = Path(__file__).resolve().parents[1]
PAGES, SOURCE = _ROOT / "handbook", _ROOT / "docs" / "handbook"

_TOPICS = (("bpy.ops.fit_flare.set_up_engine*", "install"), ("bpy.ops.fit_flare.*engine*", "install"),
           ("bpy.ops.fit_flare.download_weights*", "install"), ("bpy.ops.fit_flare.import_*", "first_fit"),
           ("bpy.ops.fit_flare.*capture*", "first_fit"), ("bpy.ops.fit_flare.*light*", "first_fit"),
           ("bpy.ops.fit_flare.fit*", "first_fit"), ("bpy.ops.fit_flare.resume*", "first_fit"),
           ("bpy.ops.fit_flare.clean_frames*", "first_fit"), ("bpy.ops.fit_flare.add_library_flare*", "first_flare"),
           ("bpy.ops.fit_flare.*library*", "transfer"), ("bpy.ops.fit_flare.save_flare*", "transfer"),
           ("bpy.ops.fit_flare.shot_from_picture*", "transfer"), ("bpy.ops.fit_flare.*", "editing"),
           ("bpy.types.fitflare_*", "editing"))
"""The page of each button and slider, the first match, as patterns of Blender's identifiers in lower case."""


def url(page: str = "") -> str:
    """Return the address of a page by its name without ending; of the contents for ""."""
    if (PAGES / "index.html").is_file():
        return (PAGES / f"{page or 'index'}.html").as_uri()
    return (SOURCE / f"{page or 'README'}.md").as_uri()


def draw_button(layout: Any, page: str = "", text: str = "") -> None:
    """Draw a button that opens a page in the web browser."""
    layout.operator("wm.url_open", text=text, icon="HELP", emboss=bool(text)).url = url(page)


def _manual_map() -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return the pages for the entry Online Manual in the context menus of our buttons and sliders."""
    ending = url().rpartition(".")[2]
    return f"{url().rpartition('/')[0]}/", tuple((pattern, f"{page}.{ending}") for pattern, page in _TOPICS)


def register() -> None:
    bpy.utils.register_manual_map(_manual_map)


def unregister() -> None:
    bpy.utils.unregister_manual_map(_manual_map)
