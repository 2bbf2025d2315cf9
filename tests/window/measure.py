# SPDX-License-Identifier: GPL-3.0-or-later
"""What a mouse has to wait for: the longest time between two calls of a timer, and how much of it is our own code."""
from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Iterator

import bpy

NAME = "bl_ext.user_default.fit_flare"


def module(name: str):
    """A module of the installed extension."""
    return importlib.import_module(f"{NAME}.flare_addon.{name}")


class Gaps:
    """The longest time between two calls of a 10 ms timer, while Blender draws, handles events and runs our code; and
    the longest that the window's thread itself worked in between, which other programs do not make longer (nor does
    drawing in software, which has threads of its own)."""

    def __init__(self) -> None:
        self.gaps: list[tuple[float, float]] = []
        self.last = time.perf_counter(), time.thread_time()
        self.on, self.paused = True, False
        bpy.app.timers.register(self.tick, persistent=True)

    def tick(self):
        now = time.perf_counter(), time.thread_time()
        if not self.paused:
            self.gaps.append((now[0] - self.last[0], now[1] - self.last[1]))
        self.last, self.paused = now, False
        return 0.01 if self.on else None

    def pause(self) -> None:
        """Leave out what comes now, a screenshot that this script itself takes."""
        self.paused = True

    def stop(self) -> dict[str, float]:
        """Stop the timer; return the number of gaps, the longest, the 99th percentile and how many are over 100 ms.

        The same for the work of the thread in each gap. The first two gaps are left out.
        """
        self.on = False
        figures: dict[str, float] = {"gaps": len(self.gaps)}
        for name, times in zip(("gap", "work"), zip(*(self.gaps[2:] or [(0.0, 0.0)]), strict=True), strict=True):
            ordered = sorted(times)
            figures |= {f"longest_{name}_ms": milliseconds(ordered[-1]),
                        f"{name}_99_percent_ms": milliseconds(ordered[len(ordered) * 99 // 100]),
                        f"{name}s_over_100_ms": sum(one > 0.1 for one in ordered)}
        return figures


def milliseconds(seconds: float) -> float:
    return round(1e3 * seconds, 1)


Times = list[tuple[float, float]]
"""Of each call the seconds that went by, and those that this thread worked: a busy machine makes the first longer."""


@contextlib.contextmanager
def noted(record: Times) -> Iterator[None]:
    """Measure a block."""
    began, worked = time.perf_counter(), time.thread_time()
    try:
        yield
    finally:
        record.append((time.perf_counter() - began, time.thread_time() - worked))


def timed(target, name: str, record: Times) -> None:
    """Measure each call of a function of the add-on."""
    inner = getattr(target, name)

    def call(*words, **named):
        with noted(record):
            return inner(*words, **named)
    setattr(target, name, call)


def timed_draw(panel, record: Times) -> None:
    """The same of a panel's drawing, with the signature that Blender asks for."""
    inner = panel.draw

    def draw(self, context):
        with noted(record):
            inner(self, context)
    panel.draw = draw


class Ours:
    """Times of all that the extension does in the window's thread while the engine works."""

    def __init__(self) -> None:
        """Wrap the extension's timers, panels and drawing so that each call is timed; drawing is registered anew."""
        self.times: dict[str, Times] = {}
        timed(module("jobs"), "_poll_jobs", self._of("look at the engine"))
        for panel in module("panels")._CLASSES:
            timed_draw(panel, self._of(f"panel {panel.bl_label}"))
        timed(module("looks"), "show_look", self._of("take the flare in"))
        timed(module("looks"), "read_look", self._of("read a .flare"))
        for name in ("overlay", "points"):
            drawn = module(name)
            drawn.unregister()
            timed(drawn, "_draw", self._of(f"draw {name}"))
            drawn.register()

    def _of(self, name: str) -> Times:
        return self.times.setdefault(name, [])

    def forget(self) -> None:
        """Begin anew."""
        for times in self.times.values():
            times.clear()

    def longest(self) -> dict[str, dict[str, float]]:
        """Milliseconds of the longest call, by what it was: by the clock, and at work."""
        return {kind: {name: milliseconds(max(one[index] for one in times)) for name, times in self.times.items()
                       if times} for index, kind in enumerate(("ours_ms", "ours_at_work_ms"))}
