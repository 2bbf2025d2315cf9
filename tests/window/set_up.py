# SPDX-License-Identifier: GPL-3.0-or-later
"""The engine set up by one click in Blender's real window, tested, and removed again.

    python tests/window/run.py --out DIR --script tests/window/set_up.py …

Downloads torch and the rest, so it is started by hand. FIT_FLARE_PATH: more folders to find a Python in, for a Blender
whose own cannot make environments. A screenshot of each step, and set_up.json.
"""
from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
from measure import Gaps, module

ZIP, OUT = os.environ["FIT_FLARE_ZIP"], os.environ["FIT_FLARE_OUT"]
out = Path(OUT)
os.environ["PATH"] = os.pathsep.join([os.environ["PATH"], os.environ.get("FIT_FLARE_PATH", "")])
os.environ.pop("FIT_FLARE_ENGINE", None)


def shot(name: str) -> None:
    ui.screenshot(str(out / f"{name}.png"))


def steps():
    """Set the engine up from the preferences, test it and remove it; write figures to set_up.json."""
    bpy.context.preferences.view.show_splash = False
    bpy.ops.extensions.package_install_files(filepath=ZIP, repo="user_default", enable_on_install=True, overwrite=True)
    yield 1
    area = ui.area()
    yield from ui.show_editor(area, "PREFERENCES")
    yield from ui.go_to_section(area, "EXTENSIONS")
    place = ui.region("WINDOW", area)
    yield from ui.press_button("extensions.userpref_allow_online", place, across=0.75)
    assert bpy.app.online_access
    yield from ui.go_to_section(area, "ADDONS")
    yield from ui.fill(place.x + 0.2 * place.width, place.y + place.height - 19, "Fit Flare")
    yield from ui.press_button("preferences.addon_expand", place, across=24 / place.width)
    yield 0.5
    shot("10_no_engine")
    began = time.perf_counter()
    yield from ui.press_button("fit_flare.set_up_engine", place, across=0.5)
    engine = module("engine")
    making = engine.set_up_job()
    assert making is not None, "the set-up did not start"
    gaps, seen, shown = Gaps(), set(), False
    while making.running and time.perf_counter() - began < 1200:
        seen.add(making.done)
        if not shown and making.done >= 3:
            gaps.pause()
            shot("11_setting_up")
            shown = True
        yield 0.5
    assert making.state == "done", making.error
    facts: dict[str, object] = {"blender": bpy.app.version_string, "set_up_s": round(time.perf_counter() - began, 1),
                                "bar_positions": len(seen), **gaps.stop()}
    yield from ui.press_button("fit_flare.test_engine", place, across=0.15)
    while engine.last_test() is None or engine.last_test().running:
        yield 0.5
    assert engine.last_test().state == "done", engine.last_test().error
    facts["engine"] = engine.last_test().result
    yield 0.5
    shot("12_set_up")
    folder = engine.user_folder(engine.ENGINE_FOLDER)
    facts["megabytes"] = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) >> 20
    yield from ui.press_button("fit_flare.remove_engine", place, across=0.85)
    yield 0.5
    shot("13_remove")
    ui.press("RET")
    for _ in range(60):
        yield 0.5
        if not folder.exists():
            break
    assert not folder.exists(), "the engine is still there"
    yield 0.5
    shot("14_removed")
    (out / "set_up.json").write_text(json.dumps(facts, indent=2))
    print(json.dumps(facts, indent=2), flush=True)


ui.FAILED = str(out / "failed.png")
ui.run(steps)
