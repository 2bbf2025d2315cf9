# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's window driven from inside: mouse, keys, screenshots.

Where the module `ui_driver` is at hand (a virtual screen with real X events) it is used; anywhere else
Blender simulates the events itself (start it with --enable-event-simulate), and so it does where FIT_FLARE_SIMULATE is
set. Steps are a generator: `yield N`
lets Blender live N seconds. Positions are window pixels from the lower left corner.
"""
from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable

import bpy

try:
    import ui_driver as real
except ImportError:
    real = None
if os.environ.get("FIT_FLARE_SIMULATE"):
    real = None

SETTLE_S = 0.12
FAILED = ""
"""Where a picture of the window is kept when a step fails."""

_queue: list[dict] = []
_mouse = 0, 0


def window():
    return bpy.context.window_manager.windows[0]


def area(kind: str = "VIEW_3D"):
    """The largest area of that kind."""
    return max((one for one in window().screen.areas if one.type == kind), key=lambda one: one.width * one.height)


def region(kind: str, of=None):
    found = [one for one in (of or area()).regions if one.type == kind]
    assert found, f"the area has no region {kind}"
    return found[0]


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


def point(x: float, y: float) -> None:
    """Move the mouse there."""
    if real is not None:
        real._send(("mousemove", int(x), int(window().height - y)))
    else:
        _simulate("MOUSEMOVE", "NOTHING", x, y)


def click(x: float, y: float, ctrl: bool = False) -> None:
    """Click with the left button, with Ctrl held if `ctrl`."""
    if real is not None:
        down, up = ([("keydown", "ctrl")], [("keyup", "ctrl")]) if ctrl else ([], [])
        real._send(*down)
        real.click(x, window().height - y)
        real._send(*up)
        return
    _simulate("MOUSEMOVE", "NOTHING", x, y)
    _simulate("LEFTMOUSE", "PRESS", x, y, ctrl=ctrl)
    _simulate("LEFTMOUSE", "RELEASE", x, y, ctrl=ctrl)


def drag(x0: float, y0: float, x1: float, y1: float, button: str = "LEFTMOUSE") -> None:
    """Press a button at one point, move to another in six moves, and release."""
    if real is not None:
        top = window().height
        real.drag(x0, top - y0, x1, top - y1, button={"LEFTMOUSE": 1, "MIDDLEMOUSE": 2}[button])
        return
    _simulate("MOUSEMOVE", "NOTHING", x0, y0)
    _simulate(button, "PRESS", x0, y0)
    for step in range(1, 7):
        _simulate("MOUSEMOVE", "NOTHING", x0 + (x1 - x0) * step / 6, y0 + (y1 - y0) * step / 6)
    _simulate(button, "RELEASE", x1, y1)


X_NAMES = {"RET": "Return", "ESC": "Escape", "DEL": "Delete", "HOME": "Home", "END": "End", "PAGE_DOWN": "Next",
           "DOWN_ARROW": "Down", "NUMPAD_0": "KP_0"}


def press(key: str, *, ctrl: bool = False, shift: bool = False) -> None:
    """A key by Blender's name; it goes to what is under the mouse."""
    if real is not None:
        name = X_NAMES.get(key, key.lower() if len(key) == 1 else key)
        real.key("+".join(["ctrl"] * ctrl + ["shift"] * shift + [name]))
        return
    _simulate(key, "PRESS", ctrl=ctrl, shift=shift)
    _simulate(key, "RELEASE", ctrl=ctrl, shift=shift)


KEYS = {**dict(zip("0123456789", ("ZERO", "ONE", "TWO", "THREE", "FOUR", "FIVE", "SIX", "SEVEN", "EIGHT", "NINE"),
                   strict=True)), "/": "SLASH", ".": "PERIOD", "-": "MINUS", "_": "MINUS", " ": "SPACE"}


def write(text: str) -> None:
    """Type a text with the keyboard."""
    if real is not None:
        real.text(text)
        return
    for letter in text:
        key = KEYS.get(letter, letter.upper())
        _simulate(key, "PRESS", unicode=letter)
        _simulate(key, "RELEASE")


def _simulate(kind: str, value: str, x: float | None = None, y: float | None = None, **more: object) -> None:
    """Queue an event for Blender's own simulation, where the mouse is if no place is given."""
    global _mouse
    if x is not None and y is not None:
        _mouse = int(x), int(y)
    _queue.append({"type": kind, "value": value, "x": _mouse[0], "y": _mouse[1], **more})


# ---- what is under the mouse ------------------------------------------------------------------------

NOTHING = "nothing was copied"


def copied(x: float, y: float, path: bool = False):
    """Press Ctrl-C over a button or field. Steps; their value is the copied text: an operator's call or a field's
    value.

    path: with Shift, which copies the path of the property that the field shows.
    """
    manager = bpy.context.window_manager
    manager.clipboard = NOTHING
    point(x, y)
    press("C", ctrl=True, shift=path)
    yield 0.05
    return manager.clipboard


def find(wanted: str | Callable[[str], bool], place, *, path: bool = False, across: float = 0.55,
         below: float | None = None, pages: int = 4):
    """Find a button or field by walking down a region with the mouse, page by page. Steps; their value is its place.

    wanted: the button's operator, the path of the field's property if `path`, or a test of the copied text. place: the
    region. across: where to walk, a share of its width. below: height to begin at on the present page. Raises
    LookupError.
    """
    def right(text: str) -> bool:
        if callable(wanted):
            return wanted(text)
        return text == wanted if path else text.startswith(f"bpy.ops.{wanted}(")

    step, x = 13 * bpy.context.preferences.system.ui_scale, place.x + place.width * across
    for page in range(pages):
        y = place.y + place.height - 8
        if page == 0 and below is not None:
            y = below
        else:
            point(x, y)
            press("PAGE_DOWN" if page else "HOME")
            yield 0.2
        while y > place.y + 4:
            text = yield from copied(x, y, path)
            if right(text):
                return x, y - 0.3 * step
            y -= step
    raise LookupError(f"{wanted} is nowhere under the mouse in the region {place.type}")


def press_button(wanted: str, place, **how: object):
    """Find an operator's button and click it; its place. Steps."""
    x, y = yield from find(wanted, place, **how)
    click(x, y)
    yield 0.3
    return x, y


def fill(x: float, y: float, text: str):
    """Click into the field there and type. Steps."""
    click(x, y)
    yield 0.3
    press("A", ctrl=True)
    write(text)
    press("RET")
    yield 0.3


def fill_above(x: float, y: float, text: str, new: str):
    """Find the field with the text `text` by walking upwards from a point in a dialog, and type `new` over it. Steps.

    Fields are found first, since outside a field a letter would be the key of a button.
    """
    for step in range(20):
        found = yield from copied(x, y + 8 * step)
        if found == text:
            yield from fill(x, y + 8 * step + 2, new)
            return
    raise LookupError(f"no field above has the text {text}")


def choose_item(x: float, y: float, chosen: Callable[[], bool]):
    """Choose from the menu that a click opens, one entry further down each time, until `chosen` is true. Steps."""
    for down in range(8):
        click(x, y)
        yield 0.4
        press("HOME")
        for _ in range(down):
            press("DOWN_ARROW")
        press("RET")
        yield 0.4
        if chosen():
            return
    raise LookupError("the menu has no such entry")


def show_editor(of, kind: str):
    """Turn an area into the preferences or the 3D view, by the button at the left end of its header. Steps.

    The preferences are the last entry of that button's menu, the 3D view is the first.
    """
    header = region("HEADER", of)
    click(header.x + 20 * bpy.context.preferences.system.ui_scale, header.y + header.height / 2)
    yield 0.5
    press({"PREFERENCES": "END", "VIEW_3D": "HOME"}[kind])
    press("RET")
    for _ in range(20):
        yield 0.3
        if of.type == kind:
            return
    raise LookupError(f"the editor is {of.type}, not {kind}")


def go_to_section(of, section: str):
    """Go to a section of the preferences, by clicking down the list at their left. Steps."""
    settings = bpy.context.preferences
    tabs = min((one for one in of.regions if one.type in ("UI", "NAVIGATION_BAR")), key=lambda one: one.x)
    y = tabs.y + tabs.height - 20
    while settings.active_section != section and y > tabs.y:
        click(tabs.x + tabs.width * 0.5, y)
        yield 0.2
        y -= 12
    assert settings.active_section == section


def choose_file(folder: str, file: str = ""):
    """Type folder and file into the file browser that has opened in this window, and confirm. Steps."""
    for _ in range(20):
        if any(one.type == "FILE_BROWSER" for one in window().screen.areas):
            break
        yield 0.3
    browser = area("FILE_BROWSER")
    yield 0.5
    x, y = yield from _field(region("UI", browser), os.sep)
    yield from fill(x, y, folder)
    files = region("WINDOW", browser)
    click(files.x + 0.5 * files.width, files.y + 12)  # a field of folders goes on being typed into until then
    yield 0.4
    if file:
        place = region("EXECUTE", browser)
        yield from fill(place.x + 0.3 * place.width, place.y + place.height / 2, file)
    yield 0.5
    place = region("EXECUTE", browser)
    yield from press_along("file.execute", place, place.y + place.height / 2)


def _field(place, ending: str):
    """The field in a low region whose text ends so. Steps."""
    for share in (0.3, 0.4, 0.5, 0.6, 0.2):
        x, y = place.x + place.width * share, place.y + place.height / 2
        text = yield from copied(x, y)
        if text.endswith(ending):
            return x, y
    raise LookupError(f"no field in the region {place.type} ends with {ending}")


def press_along(call: str, place, y: float):
    """Find the button of an operator by walking along a row from its right end, and click it. Steps."""
    x = place.x + place.width - 6
    while x > place.x:
        text = yield from copied(x, y)
        if text.startswith(f"bpy.ops.{call}"):
            click(x - 3, y)
            yield 0.5
            return
        x -= 6
    raise LookupError(f"{call} is nowhere along the region {place.type}")


def press_in_top_bar(menu: str):
    """Find a menu of the window's top bar by walking along it from the left, and click it. Steps."""
    scale = bpy.context.preferences.system.ui_scale
    x, y = 30 * scale, window().height - 13 * scale
    while x < 0.4 * window().width:
        text = yield from copied(x, y)
        if menu in text:
            click(x, y)
            yield 0.5
            return
        x += 16 * scale
    raise LookupError(f"{menu} is nowhere along the top bar")


def open_tab(name: str):
    """Show the sidebar of the 3D viewport with N, and open a tab by clicking down the tabs. Steps."""
    view = region("WINDOW")
    if not area().spaces.active.show_region_ui:
        point(view.x + view.width * 0.4, view.y + view.height * 0.4)
        press("N")
        yield 0.5
    side, scale = region("UI"), bpy.context.preferences.system.ui_scale
    y = side.y + side.height - 30 * scale
    while side.active_panel_category != name and y > side.y:
        click(side.x + side.width - 12 * scale, y)
        yield 0.3
        y -= 25 * scale
    assert side.active_panel_category == name, f"the sidebar has no tab {name}"


def quit_(status: int = 0) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # nobody is there to be asked whether to save


def run(steps) -> None:
    """Walk through the steps of the generator function by a timer; an exception ends Blender with status 1, the end
    with 0."""
    walk = steps()
    sent = False

    def step():
        """Send the next simulated event, or go on with the next step once the events are handled; return the seconds to
        wait."""
        nonlocal sent
        try:
            if real is not None and bpy.app.timers.is_registered(real._pump):
                sent = True
                return 0.05
            if sent:  # let Blender handle what was sent
                sent = False
                return SETTLE_S
            if _queue:
                window().event_simulate(**_queue.pop(0))
                return 0.03
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
