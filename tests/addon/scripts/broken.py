# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: broken input and failing engines.

Arguments: the zip, a capture, a .flare of it, a folder, a sham engine.
"""
from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
import types
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
preferences = part("flare_addon.user_settings").addon_preferences()
folder = Path(out)
said: dict[str, object] = {}
os.environ.pop("FIT_FLARE_ENGINE", None)


def polls(name: str) -> bool:
    return bool(getattr(ops, name).poll())


class Drawn:
    """Stands for a layout: keeps the labels, takes other calls as Blender would, and looks at what they name."""

    def __init__(self) -> None:
        self.labels: list[str] = []

    def label(self, text: str = "", **_named: object) -> None:
        self.labels.append(text)

    def prop(self, data: object, name: str, **_named: object) -> None:
        getattr(data, name)

    def operator(self, name: str, **_named: object) -> object:
        group, _, verb = name.partition(".")
        assert getattr(getattr(bpy.ops, group), verb).get_rna_type(), name
        return types.SimpleNamespace()

    def template_list(self, kind: str, _id: str, data: object, items: str, active: object, index: str,
                      **_named: object) -> None:
        assert hasattr(bpy.types, kind)
        assert hasattr(data, items)
        assert hasattr(active, index)

    def __getattr__(self, name: str) -> object:
        return lambda *_words, **_named: self


def shown(name: str) -> str:
    """Return the labels that a panel draws at the moment, as one text."""
    cls = getattr(part("flare_addon.panels"), f"FITFLARE_PT_{name}")
    layout = Drawn()
    own = {key: value for key, value in vars(cls).items() if callable(value)}
    panel = types.SimpleNamespace(layout=layout)
    for key, value in own.items():
        setattr(panel, key, partial(value, panel))
    panel.draw(bpy.context)
    return " ".join(layout.labels)


PANELS = ("capture", "lights", "fit", "look", "bake", "transfer", "library")

# ---- nothing there yet ------------------------------------------------------------------------------
scene = empty()
said["polls of an empty scene"] = {name: polls(name) for name in (
    "import_capture", "capture_from_camera", "add_light", "lights_from_selected", "find_lights", "fit", "resume",
    "bake", "set_up_baked", "remove_compositor", "open_flare", "add_flare", "remove_flare", "save_flare", "apply_flare",
    "pick_light", "test_engine", "remove_engine", "use_result", "show_preview", "cancel")}
part("flare_addon.library").BOX = Path("no such folder")  # as an extension without looks of its own
said["panels of an empty scene"] = [shown(name) for name in PANELS]
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
said["panel without an engine"] = shown("fit")
preferences.engine = sham
os.environ["FIT_FLARE_ENGINE"] = "gone"
said["engine of the variable, not there"] = [polls("fit"), engine.missing_reason().split(" Name")[0]]
preferences.engine, os.environ["FIT_FLARE_ENGINE"] = str(folder / "nowhere"), sham
said["engine of the variable"] = str(engine.find_engine()) == sham
preferences.engine = sham
del os.environ["FIT_FLARE_ENGINE"]


def behave(how: str) -> None:
    """What the sham engine does next."""
    Path(sham).with_name("behaviour").write_text(how)


fit_words: dict[str, str] = {}
for how in ("dies", "refuses", "chatters", "ends"):
    behave(how)
    fit_words[how] = refusal(lambda: ops.fit())
    fit_words[f"{how}, state"] = fits.fit_state(scene)
said["fits"] = fit_words
behave("vanishes")
long_ago = folder / "long ago"
long_ago.mkdir()
(long_ago / jobs.LOG).write_text("a warning of the last time\n")
with contextlib.suppress(part("core.errors").FitFlareError):
    jobs.start_job("fit", long_ago, [sham])
said["dies without a word"] = jobs.find_job(long_ago).error
jobs.stop_watching(long_ago)
said["dies without a word, found again"] = jobs.find_job(long_ago).error

# As one that is stopped while it loads its modules: with a status, and without a word to us.
(long_ago / jobs.STOP).touch()
jobs.stop_watching(long_ago)
found = jobs.find_job(long_ago)
said["stopped before it listened"] = [found.state, found.error]
(long_ago / jobs.STOP).unlink()
not_executable = folder / "python"
not_executable.touch(mode=0o644)
try:
    jobs.start_job("fit", folder / "cannot", [str(not_executable)])
except part("core.errors").EngineError as problem:
    said["cannot be executed"] = str(problem)
behave("finishes")
said["a fit that ends well"] = [refusal(lambda: ops.fit()), fits.fit_state(scene), scene.fit_flare.flare != ""]
make = {"name": "From a Lens", "f_number": 4.0, "squeeze": 1.8}
behave("refuses")
said["a flare from a lens, refused"] = [refusal(lambda: ops.make_flare(**make)), shown("library")]
behave("makes")
made = refusal(lambda: ops.make_flare(**make))
said["a flare from a lens"] = [made, Path(bpy.context.window_manager.fit_flare_library).stem,
                               Path(sham).with_name("arguments").read_text().split("make-flare")[1].split()]
bad = folder / "bad.lens"
bad.write_text("1 2 three")
said["a lens that is none"] = [refusal(partial(ops.make_flare, name=name, lens="FILE", filepath=path))
                               for name, path in (("From a File", str(bad)), ("From a File", str(folder / "gone.lens")),
                                                  ("From a File", ""), ("///", str(bad)))]
said["a name that is taken"] = refusal(lambda: ops.make_flare(**make))
said["lenses"] = [item[1] for item in part("flare_addon.operators.make_flare")._lens_items(None, None)]
for path in part("flare_addon.library").folder().iterdir():
    path.unlink()
behave("answers")
said["test"] = [refusal(lambda: ops.test_engine()), engine.last_test().result]

preferences.engine = str(folder / "nowhere")
said["test of another engine"] = engine.last_test() is None
preferences.engine = sham

# ---- Flare from Footage ------------------------------------------------------------------------------
behave("refuses")
clip = folder / "clip.mp4"
clip.touch()
before, scene.fit_flare.preset = scene.fit_flare.run, "high"
said["footage"] = [refusal(lambda path=path: ops.flare_from_footage(filepath=str(path)))
                   for path in (folder / "none.mp4", clip)]
said["footage that failed changes no run"] = scene.fit_flare.run == before
said["footage's command"] = [word.replace(str(folder.resolve()), "X").replace(str(folder), "X")
                             for word in jobs.find_job(folder / "clip_flare_1" / "run").args]
said["footage in the panel"] = "Flare from Footage needs only a clip" in said["panels of an empty scene"][0]
shutil.rmtree(folder / "clip_flare_1")

# ---- work that goes on while Blender is closed, found again and cancelled ---------------------------
behave("sleeps")
run = folder / "long"
with open(folder / "events", "wb") as events:
    process = subprocess.Popen([sham, str(engine.RUN_SCRIPT), "fit"], stdout=events, start_new_session=True)
run.mkdir()
shutil.copy(folder / "events", run / jobs.EVENTS)
(run / jobs.RECORD).write_text(f'{{"kind": "fit", "pid": {process.pid}, "started": {time.time()}}}')
time.sleep(0.5)
shutil.copy(folder / "events", run / jobs.EVENTS)
found = jobs.find_job(run)
found.poll()
said["found again"] = [found.state, found.stage, found.done, found.total]
scene.fit_flare.run = str(run)
said["state of the found"] = fits.fit_state(scene)
found.stop()
said["asked by a file too"] = (run / jobs.STOP).exists()
process.wait(20)
shutil.copy(folder / "events", run / jobs.EVENTS)
found.poll()
said["cancelled"] = [found.state, found.error]
(run / jobs.RECORD).write_text(f'{{"kind": "fit", "pid": {os.getpid()}, "started": {time.time() - 86400}}}')
jobs.stop_watching(run)
again = jobs.find_job(run)
again.poll()
said["another program has the number"] = again.state
shutil.rmtree(run)
jobs.stop_watching(run)
said["panel of a lost run"] = shown("fit")
said["run folder deleted"] = [fits.fit_state(scene), jobs.find_job(run) is None, polls("resume")]

# ---- paths -------------------------------------------------------------------------------------------
paths = part("flare_addon.paths")
said["written on Windows"] = str(paths.absolute("//captures\\desk")) == str(paths.absolute("//captures/desk"))
(folder / "drive").mkdir()
(folder / "Z").symlink_to(folder / "drive", target_is_directory=True)
said["a linked drive"] = paths.blend_relative(folder / "Z" / "x" / ".." / "run") == str(folder / "Z" / "run")

# ---- a capture that moved ---------------------------------------------------------------------------
scene.fit_flare.run = ""
Path(capture).rename(Path(capture).with_name("away"))
said["capture moved"] = [polls("fit"), fits.capture_folder(scene).is_dir()]
said["panels of a moved capture"] = [shown("capture"), shown("fit")]
said["operators of a moved capture"] = [refusal(ops.find_lights), refusal(ops.clean_frames), refusal(ops.fit)]
Path(capture).with_name("away").rename(capture)

# ---- places that cannot be looked at ----------------------------------------------------------------
state, asking = scene.fit_flare, ("fit", "find_lights", "clean_frames", "use_lights", "use_result", "resume",
                                  "show_preview", "bake")
kept, unseen = {name: getattr(state, name) for name in paths.PATH_PROPERTIES}, "x" * 300
said["a name too long for the disk"] = []
for name in paths.PATH_PROPERTIES:
    setattr(state, name, str(folder / unseen))
    said["a name too long for the disk"].append([name, *map(shown, PANELS), *map(polls, asking)])
    setattr(state, name, kept[name])
state.run = state.capture = str(folder / unseen)
for state.mode in ("split", "estimated"):
    said["a name too long for the disk"].append(["all", *map(shown, PANELS), *map(polls, asking)])
for name in paths.PATH_PROPERTIES:
    setattr(state, name, kept[name])

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

# ---- a full disk, and an engine that dies while it bakes ----------------------------------------------
ops.open_flare(filepath=flare)
scene.fit_flare.layers = str(folder / "layers")
baked: list[object] = []
for how in ("breaks", "fills", "bakes"):
    behave(how)
    baked.append([refusal(lambda: ops.bake()), shown("bake"), sorted(
        path.name for path in (folder / "layers").glob("*.exr"))])
said["bakes"] = baked
job = jobs._jobs[jobs._key(fits._cleaning_folder(Path(capture)))] = jobs.find_job(folder / "layers")
job.error = "It cannot be shown."
said["done, and not shown"] = [job.state, shown("fit"), shown("bake")]
job.error = ""
jobs.stop_watching(fits._cleaning_folder(Path(capture)))


def full(*_words: object, **_named: object) -> None:
    """A disk that takes nothing more."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


lights, library, shots = (part(f"flare_addon.{name}") for name in ("lights", "library", "shots"))
write_shot, shots.Shot.write_in_steps = shots.Shot.write_in_steps, full
said["bake on a full disk"] = refusal(lambda: ops.bake())
shots.Shot.write_in_steps = write_shot
write_annotated, library.write_annotated = library.write_annotated, full
said["save on a full disk"] = refusal(lambda: ops.save_flare(name="full"))
said["library after"] = [path.name for path in library.user_files()]
library.write_annotated = write_annotated
write_json, jobs.write_json = jobs.write_json, full
scene.fit_flare.run = ""
behave("sleeps")
began = time.monotonic()
said["fit on a full disk"] = refusal(lambda: ops.fit())
said["its engine is not left alone"] = time.monotonic() - began < 5 and not jobs.running()
jobs.write_json, jobs.MIN_FREE_BYTES = write_json, 1 << 62  # every disk is full by that
behave("ends")
said["no room for the last words"] = refusal(lambda: ops.fit())
jobs.MIN_FREE_BYTES = 1 << 16
scene.fit_flare.run = ""

# ---- cameras and scenes -----------------------------------------------------------------------------
ops.open_flare(filepath=flare)
scene.camera.data.type = "ORTHO"
said["orthographic"] = refusal(lambda: ops.bake())
scene.camera.data.type = "PERSP"
bpy.data.objects.remove(scene.camera)
said["camera deleted"] = [polls("bake"), scene.camera is None]
said["panel without a camera"] = shown("look")
target = scene.fit_flare.lights[0].target
scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
scene.collection.objects.link(scene.camera)
for collection in target.users_collection:  # as X in the viewport does: the flare still knows the object
    collection.objects.unlink(target)
icons = {}
row = types.SimpleNamespace(prop=lambda _item, name, icon="", **_how: icons.update({name: icon}))
part("flare_addon.operators.look").FITFLARE_UL_lights.draw_item(
    None, types.SimpleNamespace(scene=scene), types.SimpleNamespace(row=lambda **_how: row), None,
    scene.fit_flare.lights[0], 0, None, "")
said["icon of its flare"] = icons["name"]
said["light taken out of the scene"] = [scene.fit_flare.lights[0].target is not None, refusal(lambda: ops.bake())]
bpy.data.objects.remove(target)
said["light deleted"] = scene.fit_flare.lights[0].target is None
second = bpy.data.scenes.new("Second")
bpy.context.window.scene = second
own_lights = part("flare_addon.lights").scene_lights(second)
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
            state.master.intensity, now.render.resolution_x, state.capture, len(state.lights),
            sorted(item.name for item in now.objects if item.fit_flare.is_light),
            part("flare_addon.compositor.flare_node").find_node(now) is not None]


def slide() -> set[str]:
    """A slider dragged, which reset_look puts back."""
    bpy.context.scene.fit_flare.master.intensity = 2.0
    return {"FINISHED"}


def prepare(name: str) -> None:
    """Set up what an operator needs. It runs before the operator's undo step begins."""
    state = bpy.context.scene.fit_flare
    if name == "lights_from_selected":
        cube = bpy.data.objects.new("Bulb", None)
        bpy.context.scene.collection.objects.link(cube)
        bpy.context.view_layer.update()
        for item in bpy.context.selected_objects:
            item.select_set(False)
        cube.select_set(True)
    elif name == "apply_flare":
        assert ops.save_flare(name="Saved") == {"FINISHED"}
        state.flare = ""
        state.lights.clear()
    elif name == "set_up_baked":
        state.layers = str(folder / "real")


undone: dict[str, bool] = {}
for name, call in (("import_capture", lambda: ops.import_capture(directory=capture)),
                   ("add_light", lambda: ops.add_light(name="key")),
                   ("open_flare", lambda: ops.open_flare(filepath=flare)),
                   ("add_flare", lambda: ops.add_flare()),
                   ("remove_flare", lambda: ops.remove_flare()),
                   ("shot_from_picture", lambda: ops.shot_from_picture(
                       filepath=str(sorted((Path(capture) / "images").iterdir())[0]))),
                   ("pick_light", lambda: ops.pick_light(x=0.5, y=0.5)),
                   ("lights_from_selected", lambda: ops.lights_from_selected()),
                   ("remove_light", lambda: ops.remove_light(object="lamp")),
                   ("slider", slide), ("reset_look", lambda: ops.reset_look()),
                   ("apply_flare", lambda: ops.apply_flare(filepath=flare)),
                   ("set_up_baked", lambda: ops.set_up_baked()),
                   ("remove_compositor", lambda: ops.remove_compositor())):
    prepare(name)
    bpy.ops.ed.undo_push(message="before")
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
logs = folder / "logs"
logs.mkdir()
(logs / "log.txt").symlink_to("/proc/self/mem")  # a file that may be looked at and not read, by root neither
(logs / "events.jsonl").write_bytes(b"first" + b"." * 300_000 + b"last")
said["shows logs"] = [*ops.show_log(folder=str(logs)), bpy.data.texts["Fit Flare Log"].as_string()]
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
