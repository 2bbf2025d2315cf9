# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: everything that can be broken. Words: the zip, a capture, a .flare of it, a folder, a sham engine."""
from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import NAME, empty, install, leave, part, refusal

# Started in the background, a test run has SIGINT ignored, and so would the sham engine, which cannot undo that.
signal.signal(signal.SIGINT, signal.SIG_DFL)
package, capture, flare, out, sham = sys.argv[1:6]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
jobs, fits, engine, looks = (part(f"flare_addon.{name}") for name in ("jobs", "fits", "engine", "looks"))
preferences = part("flare_addon.preferences").own()
folder = Path(out)
said: dict[str, object] = {}
os.environ.pop("FIT_FLARE_ENGINE", None)


def polls(name: str) -> bool:
    return bool(getattr(ops, name).poll())


# ---- nothing there yet ------------------------------------------------------------------------------
scene = empty()
said["polls of an empty scene"] = {name: polls(name) for name in (
    "import_capture", "capture_from_camera", "add_light", "lights_from_selected", "find_lights", "fit", "resume",
    "bake", "set_up_baked", "remove_compositor", "open_flare", "add_flare", "remove_flare", "save_flare", "apply_flare",
    "pick_light", "test_engine", "remove_engine", "use_result", "show_preview", "cancel")}
said["import of nothing"] = refusal(lambda: ops.import_capture(directory=str(folder)))
(folder / "bad" / "images").mkdir(parents=True)
(folder / "bad" / "sparse" / "0").mkdir(parents=True)
(folder / "bad" / "sparse" / "0" / "cameras.bin").write_bytes(b"\x05")
said["import of a broken capture"] = refusal(lambda: ops.import_capture(directory=str(folder / "bad")))
said["objects after refusals"] = len(bpy.data.objects)
said["no engine"] = refusal(lambda: ops.fit())

# ---- engines that are none, or die ------------------------------------------------------------------
ops.import_capture(directory=capture)
preferences.engine = str(folder / "nowhere")
said["engine named, not there"] = [polls("fit"), polls("test_engine")]
preferences.engine = sham


def behave(how: str) -> None:
    """What the sham engine does next."""
    Path(sham).with_name("behaviour").write_text(how)


fit_words: dict[str, str] = {}
for how in ("dies", "refuses", "chatters", "ends"):
    behave(how)
    fit_words[how] = refusal(lambda: ops.fit())
    fit_words[f"{how}, state"] = fits.state_of(scene)
said["fits"] = fit_words
behave("finishes")
said["a fit that ends well"] = [refusal(lambda: ops.fit()), fits.state_of(scene), scene.fit_flare.flare != ""]
behave("answers")
said["test"] = [refusal(lambda: ops.test_engine()), engine.tested().result]

# ---- work that goes on while Blender is closed, found again and cancelled ---------------------------
behave("sleeps")
run = folder / "long"
with open(folder / "events", "wb") as events:
    process = subprocess.Popen([sham, str(engine.RUN), "fit"], stdout=events, start_new_session=True)
run.mkdir()
shutil.copy(folder / "events", run / jobs.EVENTS)
(run / jobs.RECORD).write_text(f'{{"kind": "fit", "pid": {process.pid}}}')
time.sleep(0.5)
shutil.copy(folder / "events", run / jobs.EVENTS)
found = jobs.find(run)
found.poll()
said["found again"] = [found.state, found.stage, found.done, found.total]
scene.fit_flare.run = str(run)
said["state of the found"] = fits.state_of(scene)
found.stop()
process.wait(20)
shutil.copy(folder / "events", run / jobs.EVENTS)
found.poll()
said["cancelled"] = [found.state, found.error]
(run / jobs.RECORD).write_text('{"kind": "fit", "pid": 1}')
jobs.forget(run)
again = jobs.find(run)
again.poll()
said["another program has the number"] = again.state
shutil.rmtree(run)
jobs.forget(run)
said["run folder deleted"] = [fits.state_of(scene), jobs.find(run) is None, polls("resume")]

# ---- a capture that moved ---------------------------------------------------------------------------
scene.fit_flare.run = ""
Path(capture).rename(Path(capture).with_name("away"))
said["capture moved"] = [polls("fit"), fits.capture_of(scene).is_dir()]
Path(capture).with_name("away").rename(capture)

# ---- .flare files -----------------------------------------------------------------------------------
data = Path(flare).read_bytes()
(folder / "cut.flare").write_bytes(data[: len(data) // 2])
length = int.from_bytes(data[:8], "little")
newer = data[8:8 + length].replace(rb'\"version\": 1', rb'\"version\": 9')
(folder / "newer.flare").write_bytes(len(newer).to_bytes(8, "little") + newer + data[8 + length:])
for name in ("cut", "newer", "absent"):
    said[f"{name} flare"] = refusal(partial(ops.open_flare, filepath=str(folder / f"{name}.flare")))
said["edits survive a refusal"] = len(scene.fit_flare.lights)
shutil.copy(flare, folder / "mine.flare")
ops.open_flare(filepath=str(folder / "mine.flare"))
(folder / "mine.flare").unlink()
try:
    looks.look_of(scene)
except part("core.errors").FitFlareError as problem:
    said["flare deleted later"] = str(problem)
said["save of a deleted flare"] = refusal(lambda: ops.save_flare(name="x"))
said["bake of a deleted flare"] = refusal(lambda: ops.bake())

# ---- cameras and scenes -----------------------------------------------------------------------------
ops.open_flare(filepath=flare)
scene.camera.data.type = "ORTHO"
said["orthographic"] = refusal(lambda: ops.bake())
scene.camera.data.type = "PERSP"
bpy.data.objects.remove(scene.camera)
said["camera deleted"] = [polls("bake"), scene.camera is None]
target = scene.fit_flare.lights[0].target
bpy.data.objects.remove(target)
said["light deleted"] = scene.fit_flare.lights[0].target is None
second = bpy.data.scenes.new("Second")
bpy.context.window.scene = second
own_lights = part("flare_addon.lights").of_scene(second)
said["second scene is empty"] = [second.fit_flare.flare, polls("bake"), len(own_lights)]
ops.open_flare(filepath=flare)
second.fit_flare.master.intensity = 3
said["two scenes"] = [second.fit_flare.master.intensity, scene.fit_flare.master.intensity]

# ---- undo after each operator -----------------------------------------------------------------------
scene = empty()
bpy.ops.ed.undo_push(message="start")


def dump() -> list[object]:
    now = bpy.context.scene
    state = now.fit_flare
    return [sorted(item.name for item in bpy.data.objects), state.flare, [item.name for item in state.lights],
            state.master.intensity, now.render.resolution_x, state.capture]


undone: dict[str, bool] = {}
for name, call in (("import_capture", lambda: ops.import_capture(directory=capture)),
                   ("add_light", lambda: ops.add_light(name="key")),
                   ("open_flare", lambda: ops.open_flare(filepath=flare)),
                   ("add_flare", lambda: ops.add_flare()),
                   ("remove_flare", lambda: ops.remove_flare()),
                   ("shot_from_picture", lambda: ops.shot_from_picture(
                       filepath=str(sorted((Path(capture) / "images").iterdir())[0]))),
                   ("pick_light", lambda: ops.pick_light(x=0.5, y=0.5))):
    before = dump()
    assert call() == {"FINISHED"}, name
    bpy.ops.ed.undo_push(message=name)
    after = dump()
    bpy.ops.ed.undo()
    undone[name] = dump() == before and after != before
    bpy.ops.ed.redo()
    undone[name] = undone[name] and dump() == after
    bpy.context.view_layer.update()
said["undone"] = undone

# ---- the rest ---------------------------------------------------------------------------------------
said["online"] = [bpy.app.online_access, polls("set_up_engine")]
said["log of nothing"] = refusal(lambda: ops.show_log(folder=str(folder / "nowhere")))
said["folder of nothing"] = refusal(lambda: ops.open_folder(folder=str(folder / "nowhere")))
said["layers of nothing"] = refusal(lambda: ops.set_up_compositor(directory=str(folder)))
said["library name"] = refusal(lambda: ops.save_flare(name="///"))
bpy.ops.preferences.addon_disable(module=NAME)
said["after disabling"] = [hasattr(bpy.types.Scene, "fit_flare"), hasattr(bpy.types.WindowManager, "fit_flare_library")]
bpy.ops.preferences.addon_enable(module=NAME)
repository = next(index for index, repo in enumerate(bpy.context.preferences.extensions.repos)
                  if repo.module == "user_default")
bpy.ops.extensions.package_uninstall(repo_index=repository, pkg_id="fit_flare")
root = Path(bpy.utils.user_resource("EXTENSIONS"))
said["left behind"] = sorted(str(path.relative_to(root)) for path in root.rglob("*fit_flare*"))
said["modules left"] = NAME in bpy.context.preferences.addons
leave(said)
