# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's window driven from inside: mouse, keys, screenshots.

Where the module `ui_driver` is at hand (a virtual screen with real X events) it is used; anywhere else
Blender simulates the events itself (start it with --enable-event-simulate). Steps are a generator: `yield N`
lets Blender live N seconds. Positions are window pixels from the lower left corner.
"""
from __future__ import annotations

import os
import sys
import traceback

import bpy

try:
    import ui_driver as real
except ImportError:
    real = None

FAILED = ""
"""Where a picture of the window is kept when a step fails."""

_queue: list[tuple] = []


def window():
    return bpy.context.window_manager.windows[0]


def area(kind: str = "VIEW_3D"):
    """The largest area of that kind."""
    return max((one for one in window().screen.areas if one.type == kind), key=lambda one: one.width * one.height)


def region(kind: str, of=None):
    return next(one for one in (of or area()).regions if one.type == kind)


def override(kind: str = "VIEW_3D", inner: str = "WINDOW"):
    """Context for operators that are called from a step."""
    chosen = area(kind)
    return bpy.context.temp_override(window=window(), screen=window().screen, area=chosen, region=region(inner, chosen))


def redraw() -> None:
    for one in window().screen.areas:
        one.tag_redraw()
    with bpy.context.temp_override(window=window()):
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)


def screenshot(path: str) -> None:
    if real is not None:
        real.screenshot(path)
        return
    redraw()
    with bpy.context.temp_override(window=window()):
        bpy.ops.screen.screenshot(filepath=path)


def move(x: float, y: float) -> None:
    if real is not None:
        real.move(x, window().height - y)
    else:
        _queue.append(("MOUSEMOVE", "NOTHING", x, y))


def click(x: float, y: float) -> None:
    if real is not None:
        real.click(x, window().height - y)
    else:
        _queue.extend([("MOUSEMOVE", "NOTHING", x, y), ("LEFTMOUSE", "PRESS", x, y), ("LEFTMOUSE", "RELEASE", x, y)])


def drag(x0: float, y0: float, x1: float, y1: float, button: str = "LEFTMOUSE") -> None:
    if real is not None:
        top = window().height
        real.drag(x0, top - y0, x1, top - y1, button={"LEFTMOUSE": 1, "MIDDLEMOUSE": 2}[button])
        return
    _queue.extend([("MOUSEMOVE", "NOTHING", x0, y0), (button, "PRESS", x0, y0)])
    _queue.extend(("MOUSEMOVE", "NOTHING", x0 + (x1 - x0) * step / 6, y0 + (y1 - y0) * step / 6)
                  for step in range(1, 7))
    _queue.append((button, "RELEASE", x1, y1))


def only(*panels) -> None:
    """Show these panels of the tab alone, so that the first one's rows are where `row` says."""
    for cls in [cls for cls in bpy.types.Panel.__subclasses__() if getattr(cls, "bl_category", "") == "Fit Flare"
                and getattr(cls, "is_registered", False)]:
        bpy.utils.unregister_class(cls)
    for cls in panels:
        bpy.utils.register_class(cls)
    redraw()


def row(below_header: float) -> tuple[float, float]:
    """The middle of a row of the first panel: its distance below the panel's header, in pixels at scale 1."""
    place, scale = region("UI"), bpy.context.preferences.system.ui_scale
    return place.x + place.width * 0.6, place.y + place.height - (15.4 + below_header) * scale


def quit_(status: int = 0) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # nobody is there to be asked whether to save


def run(steps) -> None:
    """Walk through the generator function `steps`; an exception ends Blender with status 1."""
    walk = steps()
    sent = False

    def step():
        nonlocal sent
        try:
            if real is not None and bpy.app.timers.is_registered(real._pump):
                sent = True
                return 0.05
            if sent:  # let Blender handle what was sent
                sent = False
                return 0.3
            if _queue:
                kind, value, x, y = _queue.pop(0)
                window().event_simulate(type=kind, value=value, x=int(x), y=int(y))
                return 0.06
            return next(walk) or 0.01
        except StopIteration:
            quit_(0)
        except BaseException:
            traceback.print_exc()
            if FAILED:
                screenshot(FAILED)
            quit_(1)
        return None

    bpy.app.timers.register(step, first_interval=1.0, persistent=True)
