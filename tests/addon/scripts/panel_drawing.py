# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels drawn without a window: a layout that refuses what Blender's would refuse, and notes what it draws."""
from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import bpy
from start import NAME

_FUNCTIONS = bpy.types.UILayout.bl_rna.functions
_ICONS = frozenset(_FUNCTIONS["label"].parameters["icon"].enum_items.keys())


class Layout:
    """Stands in for Blender's UILayout. Raises where Blender has no such operator, property, icon, parameter or list.

    drawn: what was drawn, in order: pairs of the layout's function and its operator, menu, property, list or text.
    """

    def __init__(self, drawn: list[tuple[str, str]] | None = None) -> None:
        object.__setattr__(self, "drawn", [] if drawn is None else drawn)

    def __setattr__(self, name: str, value: Any) -> None:
        assert not bpy.types.UILayout.bl_rna.properties[name].is_readonly

    def __getattr__(self, name: str) -> Any:
        parameters = _FUNCTIONS[name].parameters

        def draw(*args: Any, **settings: Any) -> Any:
            unknown = set(settings) - set(parameters.keys())
            assert not unknown, f"{name} has no parameters {unknown}"
            assert settings.get("icon", "NONE") in _ICONS, settings["icon"]
            self.drawn.append((name, _subject(name, args, settings)))
            if name == "operator":
                return _operator_settings(args[0])
            return None if name == "menu" else Layout(self.drawn)

        return draw


def _subject(name: str, args: tuple[Any, ...], settings: dict[str, Any]) -> str:
    """Return what a call draws, and check that Blender has it."""
    if name == "operator":
        return str(args[0])
    if name == "menu":
        assert hasattr(bpy.types, args[0]), args[0]
        return str(args[0])
    if name in ("prop", "template_icon_view"):
        data, identifier = args[:2]
        assert identifier in data.bl_rna.properties, (data, identifier)
        return f"{data.bl_rna.identifier}.{identifier}"
    if name == "template_list":
        kind, _, data, items, active_data, active = args
        assert hasattr(bpy.types, kind) and items in data.bl_rna.properties and active in active_data.bl_rna.properties
        return str(kind)
    return str(settings.get("text", ""))


def _operator_settings(identifier: str) -> Any:
    """Return an object that takes the properties of an operator, and no others."""
    module, name = identifier.split(".")
    known = getattr(getattr(bpy.ops, module), name).get_rna_type().properties

    class Settings:
        def __setattr__(self, key: str, value: Any) -> None:
            assert key in known, (identifier, key)

    return Settings()


def subclasses(kind: type) -> list[Any]:
    """Return all classes of the extension of one of Blender's types, such as bpy.types.Panel."""
    result = [cls for cls in kind.__subclasses__() if cls.__module__.startswith(NAME)]
    return result + [further for cls in result for further in subclasses(cls)]


def draw_panel(cls: Any, **context: Any) -> list[tuple[str, str]] | None:
    """Draw a panel, its header and the preset of its header; return what was drawn, None where its poll says no.

    context: what differs from Blender's context; the same scene in a test and `bpy.context` otherwise.
    """
    place = SimpleNamespace(**{name: getattr(bpy.context, name) for name in ("scene", "window_manager", "preferences")},
                            space_data=None)
    place.__dict__.update(context)
    if not getattr(cls, "poll", lambda _context: True)(place):
        return None
    parts = {name: value for base in reversed(cls.__mro__) if base.__module__.startswith(NAME)
             for name, value in vars(base).items() if not name.startswith("__")}
    panel, layout = type(cls.__name__, (), parts)(), Layout()
    panel.layout = layout
    for name in ("draw_header", "draw_header_preset", "draw"):
        if hasattr(panel, name):
            getattr(panel, name)(place)
    return layout.drawn
