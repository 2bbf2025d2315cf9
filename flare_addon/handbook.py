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

_OPERATORS = {
    "install": ("set_up_engine", "test_engine", "remove_engine", "download_weights"),
    "first_flare": ("add_library_flare", "apply_flare", "open_flare"),
    "first_fit": ("import_capture", "flare_from_footage", "capture_from_camera", "find_lights", "add_light",
                  "lights_from_selected", "use_lights", "remove_light", "clean_frames", "fit", "resume", "use_result",
                  "cancel", "cancel_by_key", "show_preview", "show_log", "open_folder", "tracks_from_lights",
                  "lights_from_tracks"),
    "transfer": ("save_flare", "make_flare", "list_assets", "unlist_assets", "add_flare", "shot_from_picture",
                 "pick_light")}
"""The page of each operator, by the names in `bpy.ops.fit_flare`; `editing` has all others."""

_PROPERTIES = {
    "install": ("fitflare_ap_preferences.engine", "fitflare_ap_preferences.weights"),
    "first_flare": ("windowmanager.fit_flare_library",),
    "first_fit": (*(f"fitflare_pg_scene.{name}" for name in (
        "capture", "plate_space", "footage", "preset", "mode", "width", "limits_width", "matte", "keep_glow")),
        "fitflare_pg_object.light"),
    "transfer": ("fitflare_ap_preferences.library",)}
"""The page of each property, by type and name in lower case; `editing` has all others of the extension."""

_TOPICS = (*((f"bpy.ops.fit_flare.{name}", page) for page, names in _OPERATORS.items() for name in names),
           *((f"bpy.types.{name}", page) for page, names in _PROPERTIES.items() for name in names),
           ("bpy.ops.fit_flare.*", "editing"), ("bpy.types.fitflare_*", "editing"))
"""Pairs of a pattern of Blender's identifiers in lower case and its page; the first match counts."""


def url(page: str = "") -> str:
    """Return the address of a page by its name without ending; of the contents for ""."""
    if (PAGES / "index.html").is_file():
        return (PAGES / f"{page or 'index'}.html").as_uri()
    return (SOURCE / f"{page or 'README'}.md").as_uri()


def draw_button(layout: Any, page: str = "", text: str = "") -> None:
    """Draw a button that opens a page in the web browser."""
    layout.operator("wm.url_open", text=text, icon="HELP", emboss=bool(text)).url = url(page)


class LinkedPanel:
    """Mixin for a panel whose header has a button that opens a page of the handbook."""

    page = ""
    """The page of the handbook about the panel."""

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        draw_button(self.layout, self.page)  # type: ignore[attr-defined]


def _manual_map() -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return the pages for the entry Online Manual in the context menus of our buttons and sliders."""
    ending = url().rpartition(".")[2]
    return f"{url().rpartition('/')[0]}/", tuple((pattern, f"{page}.{ending}") for pattern, page in _TOPICS)


def register() -> None:
    bpy.utils.register_manual_map(_manual_map)


def unregister() -> None:
    bpy.utils.unregister_manual_map(_manual_map)
