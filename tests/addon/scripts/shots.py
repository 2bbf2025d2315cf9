# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: layers of one shot after the other into one folder, and a second capture in a scene. Arguments: the
zip, a capture, a .flare of it, a folder."""
from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import artists_tree, empty, install, leave, part, refusal

package, capture, flare, out = sys.argv[1], *map(Path, sys.argv[2:5])
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
shots, looks = (part(f"flare_addon.{name}") for name in ("shots", "looks"))
write_json = part("core.system.files").write_json
facts: dict[str, object] = {}


def recorded(shot: object, numbers: range) -> None:
    """Write bake.json for these frames of a shot, as the engine does after it has baked them."""
    made = part("core.bake.bake")
    names = part("core.bake.layers").layer_names(shot.lights)
    write_json(folder / "bake.json", {
        "version": 1, "made_from": {"renderer": shot.fingerprint(), "half": True, "edits": [], "size": [None, None]},
        "layers": names, "frames": [{"file": f"layers.{number:04d}.exr", "frame": number, "view": "", "width": 8,
                                     "height": 8} for number in numbers]})
    assert made.read_manifest(folder)["frames"]


# ---- one capture after the other --------------------------------------------------------------------
fits, lights = part("flare_addon.fits"), part("flare_addon.lights")
second = out / "second"
shutil.copytree(capture, second)
(second / "lights.json").unlink()
run = out / "run"
run.mkdir()
(run / fits.FLARE).write_bytes(b"")
(run / "capture.txt").write_text(f"{capture}\n")
scene = empty()
state = scene.fit_flare
ops.import_capture(directory=str(capture))
first, state.run = state.root, str(run)
first.fit_flare.is_root = False  # as the version before left it
state.footage = "removed"
ops.import_capture(directory=str(capture))
facts["imported again"] = [state.run == str(run), state.footage, len(lights.scene_lights(scene)),
                           lights.write_to_capture(scene, capture)]
shutil.rmtree(second / "removed", ignore_errors=True)
(second / "removed").mkdir()
for path in (second / "images").iterdir():
    shutil.copy(path, second / "removed" / f"{path.stem}.TIFF")
ops.import_capture(directory=str(second))
state.footage = "removed"
facts["shown of clean frames"] = {Path(bpy.path.abspath(back.image.filepath)).suffix
                                  for item in state.root.children if item.type == "CAMERA"
                                  for back in item.data.background_images} == {".TIFF"}
state.footage = "images"
facts["another imported"] = [state.run, fits.fit_state(scene), len(lights.scene_lights(scene))]
state.run = str(run)
facts["another cleaned"] = "--run" in fits.cleaning_args(scene, fits.capture_folder(scene))
state.root = first
facts["the first's lights"] = len(lights.scene_lights(scene))
ops.capture_from_camera(directory=str(out / "exported"))
facts["exported"] = [state.run, len(lights.scene_lights(scene))]

def refused(*_words: object) -> None:
    """A file system without links."""
    raise OSError


# ---- a newer plate, from where pictures are linked and from where they have to be copied ------------
facts["newer plates"] = []
plate = sorted((second / "images").iterdir())[0]
frame_of = part("flare_addon.capture.exporter").write_frame
for name in ("linked", "copied"):
    if name == "copied":
        os.link = refused
    entry = frame_of(scene, scene.camera, 1, plate, out / name)
    picture = out / name / entry["file_path"]
    newer = out / f"newer {name}" / plate.name
    newer.parent.mkdir()
    newer.write_bytes(b"newer")
    before = plate.read_bytes()
    frame_of(scene, scene.camera, 1, newer, out / name)
    facts["newer plates"].append([picture.read_bytes() == b"newer", plate.read_bytes() == before,
                                  sorted(path.name for path in picture.parent.iterdir())])

# ---- frames of another bake -------------------------------------------------------------------------
scene = empty()
ops.import_capture(directory=str(capture))
ops.open_flare(filepath=str(flare))
folder, state = out / "layers", scene.fit_flare
folder.mkdir(parents=True)
state.layers = str(folder)
begun: list[list[object]] = []
engine = part("flare_addon.engine")
engine.run = lambda _kind, _folder, words: begun.append(words)
engine.find_engine = lambda: Path("python")
recorded(shots.read_scene_shot(scene, [], [0, 1, 2], flare, None), range(5))
state.bake_range = "current"
facts["as it was baked"] = [refusal(ops.bake), len(begun)]
state.bake_live = False
facts["colours no longer live"] = [refusal(ops.bake), len(begun), (folder / "live.json").exists()]
facts["replaced"] = [refusal(lambda: ops.bake(replace=True)), len(begun)]
state.bake_live, state.bake_range = True, "scene"
state.lights[0].name = "renamed"
facts["all anew"] = [refusal(ops.bake), len(begun)]
state.bake_range = "current"
facts["renamed"] = refusal(ops.bake)

# ---- an edited flare without a light ----------------------------------------------------------------
unplaced = state.lights.add()
unplaced.name, unplaced.source, unplaced.mute = "sun", "sun", True
state.lights[0].intensity, state.bake_live = 2.0, False
(one,) = shots.read_scene_shot(scene, [], [0], flare, None).frames
facts["edits"] = [[light.name for light in one.lights], list(one.edits)]
state.lights[0].intensity, state.bake_live = 1.0, True
state.lights.remove(len(state.lights) - 1)

# ---- chosen cameras ---------------------------------------------------------------------------------
def layers_of_camera():
    """The folder of the layers of the scene's camera."""
    return part("core.system.steps").finish(shots.view_folders_in_steps(lambda: scene, folder))[""]


one = shots._panel_shot(scene, [scene.camera], [0])
facts["one chosen"] = list(one.folders.values())
one.write(folder / "shot.json")
facts["one chosen, read again"] = layers_of_camera().name
scene.camera.name = "Other"
try:
    layers_of_camera()
except part("core.errors").FrameError as problem:
    facts["renamed since"] = str(problem)
write_json(folder / "bake.json", {"version": 1, "made_from": {}, "layers": {}, "frames": [
    {"file": f"Other_2/layers.{number:04d}.exr", "frame": number, "view": f"Other/{number}", "width": 8, "height": 8}
    for number in range(2)]})
facts["of an earlier bake"] = layers_of_camera().name
(folder / "bake.json").unlink()
facts["the scene's own"] = list(shots._panel_shot(scene, [], [0]).folders.values())
for item in scene.objects:
    item.select_set(False)
facts["none chosen"] = refusal(lambda: ops.bake(selected=True))

# ---- a project that is saved for the first time, moved, and linked from elsewhere --------------------
project = out / "project"
project.mkdir()
shutil.copy(flare, project / "my.flare")
scene = empty()
scene.name, scene.fit_flare.flare = "Shot", str(project / "my.flare")
bpy.ops.wm.save_as_mainfile(filepath=str(project / "copy.blend"), copy=True)
facts["saved as a copy"] = scene.fit_flare.flare == str(project / "my.flare")
bpy.ops.wm.save_as_mainfile(filepath=str(project / "shot.blend"))
project.rename(out / "moved")
bpy.ops.wm.open_mainfile(filepath=str(out / "moved" / "shot.blend"))
facts["saved first and moved"] = looks.path_of(bpy.context.scene) == out / "moved" / "my.flare"
empty()
bpy.ops.wm.save_as_mainfile(filepath=str(out / "edit.blend"))
with bpy.data.libraries.load(str(out / "moved" / "shot.blend"), link=True) as (_, wanted):
    wanted.scenes = ["Shot"]
linked = wanted.scenes[0]
facts["linked"] = looks.path_of(linked) == out / "moved" / "my.flare"
with bpy.context.temp_override(scene=linked):
    facts["changed when linked"] = [refusal(lambda: bpy.ops.fit_flare.open_flare(filepath=str(project / "my.flare"))),
                                    part("flare_addon.preferences").FITFLARE_OT_test_engine.changes_scene]

# ---- footage that an artist's own nodes and another scene show too ----------------------------------
scene = empty()
ops.import_capture(directory=str(second))
other = bpy.data.scenes.new("Other")
part("flare_addon.capture.importer").import_capture(other, second)
backs = [one.camera.data.background_images[0] for one in (scene, other)]
tree = artists_tree(scene)
own, under = (tree.nodes.new("CompositorNodeImage") for _ in range(2))
own.image = under.image = backs[0].image
under.name = part("flare_addon.compositor.footage").PLATE
facts["shared footage"] = []
for which, one in (("removed", scene), ("removed", other), ("images", scene), ("images", other)):
    one.fit_flare.footage = which
    facts["shared footage"].append([Path(bpy.path.abspath(item.image.filepath)).parent.name
                                    for item in (*backs, under, own)])
facts["images of it"] = [sum(image.source == "SEQUENCE" for image in bpy.data.images),
                         backs[0].image_user.frame_duration]
leave(facts)
