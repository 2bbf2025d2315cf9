# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: the files of a project, before and after it moves. Arguments: the zip, a
capture, a .flare, a folder."""
from __future__ import annotations

import shutil
import sys
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part, refusal

package, capture, flare, out = sys.argv[1], *map(Path, sys.argv[2:5])
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
paths = part("flare_addon.paths")
export, loaded = part("flare_addon.capture.exporter"), part("core.capture").Capture
facts: dict[str, object] = {}
pictures = sorted((capture / "images").iterdir())[:6]


def plates_in(folder: Path) -> Path:
    """A numbered sequence, and its first picture."""
    folder.mkdir(parents=True)
    for number, picture in enumerate(pictures, 1):
        shutil.copy(picture, folder / f"{number:06d}{picture.suffix}")
    return folder / f"{1:06d}{pictures[0].suffix}"


def filmed(first: Path | str, frame_start: int = 1) -> object:
    """Make a scene with a mesh, and with the sequence of pictures as a clip behind its camera; return it."""
    scene = empty()
    mesh = bpy.data.meshes.new("Set")
    mesh.from_pydata([(0, 0, -5), (1, 0, -5), (0, 1, -5)], [], [(0, 1, 2)])
    scene.collection.objects.link(bpy.data.objects.new("Set", mesh))
    camera = scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    clip = bpy.data.movieclips.load(str(first))
    clip.frame_start = frame_start
    back = camera.data.background_images.new()
    back.source, back.clip = "MOVIE_CLIP", clip
    scene.frame_start, scene.frame_end = frame_start, frame_start + len(pictures) - 1
    scene.render.resolution_x, scene.render.resolution_y = 64, 40  # as the pictures are
    return scene


def contents(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(folder.iterdir())]


# ---- plates in the folder that a capture is to go to -------------------------------------------------
first = plates_in(out / "beside" / "images")
before = contents(first.parent)
filmed(first, frame_start=3)
facts["under other numbers"] = [refusal(lambda: ops.capture_from_camera(directory=str(out / "beside"))),
                                contents(first.parent) == before]
filmed(first)
facts["under their own"] = [refusal(lambda: ops.capture_from_camera(directory=str(out / "beside"))),
                            contents(first.parent) == before]
other = plates_in(out / "others" / "images")
other.write_bytes(b"an original")
filmed(first)
facts["over others"] = [refusal(lambda: ops.capture_from_camera(directory=str(out / "others"))), other.read_bytes() ==
                        b"an original"]
scene = filmed(first, frame_start=3)
for _ in range(2):
    ops.capture_from_camera(directory=str(out / "twice"))
facts["made again"] = len(loaded.open(out / "twice").views)
filmed(sorted((out / "twice" / "images").iterdir())[0], frame_start=5)
facts["of its own pictures"] = refusal(lambda: ops.capture_from_camera(directory=str(out / "twice")))

(out / "begun" / "images").mkdir(parents=True)
shutil.copy2(first, out / "begun" / "images" / first.name)  # as a stop leaves it, on a disk without links
filmed(first)
facts["begun before"] = refusal(lambda: ops.capture_from_camera(directory=str(out / "begun")))
filmed(first).render.resolution_x = 1920
facts["of another shape"] = refusal(lambda: ops.capture_from_camera(directory=str(out / "shape")))

mirrored = filmed(first)
mirrored.camera.scale.x = -1
facts["mirrored"] = [refusal(lambda: ops.capture_from_camera(directory=str(out / "mirrored")))]
mirrored.camera.scale.x, stretched = 1, bpy.data.objects.new("Stretched", None)
mirrored.collection.objects.link(stretched)
stretched.scale.z, mirrored.camera.parent, mirrored.camera.rotation_euler.x = 2, stretched, 1
facts["mirrored"] += [refusal(lambda: ops.capture_from_camera(directory=str(out / "mirrored"))),
                      (out / "mirrored" / "images").exists()]

# ---- plates that are links ---------------------------------------------------------------------------
links = out / "links"
links.mkdir()
facts["links"] = None
try:
    for path in sorted(first.parent.iterdir()):
        (links / path.name).symlink_to(Path("..") / "beside" / "images" / path.name)
except OSError:
    can_link = False  # the system, or the user's rights, permit no symbolic links
else:
    can_link = True
if can_link:
    filmed(links / first.name)
    ops.capture_from_camera(directory=str(out / "linked"))
    count = len(loaded.open(out / "linked").views)
    shutil.rmtree(links)
    facts["links"] = [count, len([path for path in (out / "linked" / "images").iterdir() if path.is_file()])]

# ---- a camera that is linked from another folder's .blend -------------------------------------------
asset = plates_in(out / "assets" / "plates")
filmed(asset)
bpy.ops.wm.save_as_mainfile(filepath=str(out / "assets" / "camera.blend"))
bpy.data.movieclips[0].filepath = "//plates/" + asset.name
bpy.ops.wm.save_mainfile()
scene = empty()
(out / "shots").mkdir()
bpy.ops.wm.save_as_mainfile(filepath=str(out / "shots" / "shot.blend"))
with bpy.data.libraries.load(str(out / "assets" / "camera.blend"), link=True) as (_, into):
    into.objects = ["Camera"]
facts["linked camera"] = export.footage_of(into.objects[0]).path(2).is_file()

# ---- a scene that is appended to another project ------------------------------------------------------
scene = empty()
scene.name = "Shot"
(out / "p1").mkdir()
(out / "p2").mkdir()
bpy.ops.wm.save_as_mainfile(filepath=str(out / "p1" / "shot.blend"))
scene.fit_flare.layers, scene.fit_flare.capture = "//layers", str(out / "twice")
bpy.ops.wm.save_mainfile()
empty()
bpy.ops.wm.save_as_mainfile(filepath=str(out / "p2" / "other.blend"))
bpy.ops.wm.append(directory=str(out / "p1" / "shot.blend" / "Scene") + "/", filename="Shot")
state = bpy.data.scenes["Shot"].fit_flare
wanted = [out / "p1" / "layers", out / "twice"]
facts["tells of imports"] = hasattr(bpy.app.handlers, "blend_import_post")
facts["appended"] = [paths.absolute(text) == path for text, path in zip((state.layers, state.capture), wanted,
                                                                        strict=True)]

# ---- a capture imported into a project that moves ------------------------------------------------------
project = out / "project"
shutil.copytree(capture, project / "desk")
scene = empty()
bpy.ops.wm.save_as_mainfile(filepath=str(project / "shot.blend"))
ops.import_capture(directory=str(project / "desk"))
ops.import_capture(directory=str(project / "desk"), cameras="each")
ops.import_capture(directory=str(project / "desk"), cameras="animated")
bpy.ops.wm.save_mainfile()
project.rename(out / "moved")
bpy.ops.wm.open_mainfile(filepath=str(out / "moved" / "shot.blend"))
behind = [back.image for camera in bpy.data.cameras for back in camera.background_images]
facts["footage after a move"] = all(paths.absolute(image.filepath).is_file() for image in behind)
facts["stills and sequences"] = sorted({(image.source, len(camera.background_images))
                                        for camera in bpy.data.cameras for back in camera.background_images
                                        for image in [back.image]})

# ---- an import that is cancelled ------------------------------------------------------------------------
importer, scene = part("flare_addon.capture.importer"), empty()


def all_of_it():
    return [scene.frame_end, scene.frame_current, scene.frame_subframe, scene.render.resolution_x,
            scene.fit_flare.capture,
            *(len(getattr(bpy.data, kind)) for kind in ("objects", "collections", "cameras", "meshes", "images",
                                                                "actions"))]


scene.frame_set(3, subframe=0.25)
before, steps_before_cameras = all_of_it(), 0
steps = importer.import_in_steps(scene, capture, importer.ImportSettings("each"))
for _ in steps:
    if bpy.data.cameras:
        break
    steps_before_cameras += 1
grown = all_of_it()
steps.close()
facts["cancelled import"] = [before == all_of_it(), grown != before, steps_before_cameras > 5]
for kind in ("each", "animated"):
    for _ in (steps := importer.import_in_steps(scene, capture, importer.ImportSettings(kind))):
        if len(scene.objects):
            break
    steps.close()
    facts["cancelled import"].append(before == all_of_it())

# ---- the objects of an import, in portions --------------------------------------------------------------
importer.OBJECTS_PER_LINK = 2
imported = importer.finish(importer.import_in_steps(scene, capture, importer.ImportSettings("each")))
first = len(scene.objects)
portions = [len(scene.objects) for _ in importer.link_objects_in_steps(imported)]
facts["portions of objects"] = [first, portions, len(scene.objects), imported.root.name in scene.objects,
                                [item.name for item in bpy.data.collections if not item.users]]

# ---- an import whose window is closed after the scene has its camera ------------------------------------
operators = part("flare_addon.operators.capture")
scene = empty()
operator = SimpleNamespace(_in_steps=False, _is_complete=False, _name="desk", report=lambda *_words: None)
steps = operators.FITFLARE_OT_import_capture._import_and_show(
    operator, bpy.context, Path(capture), importer.ImportSettings("each"))
while not operator._is_complete:
    next(steps)
few = len(scene.objects)
steps.close()
facts["closed after the scene has its camera"] = [few, len(scene.objects),
                                                  [item.name for item in bpy.data.collections if not item.users]]

# ---- an import that leaves every other turn to the window -----------------------------------------------
done = []


def three_steps():
    for number in range(3):
        done.append(number)
        yield operators.PAUSE


operator = SimpleNamespace(_steps=three_steps(), _is_window_turn=False, _is_complete=False,
                           cancel=lambda _context: None, report=lambda *_words: None, _timer=object())
turns, turn = [], partial(operators.FITFLARE_OT_import_capture.modal, operator, bpy.context,
                         SimpleNamespace(type="TIMER"))
while "FINISHED" not in turn():
    turns.append(len(done))
facts["turns"] = turns

# ---- an import whose scene is deleted -------------------------------------------------------------------
scene = empty()
doomed, kind, calls = bpy.data.scenes.new("Doomed"), operators.FITFLARE_OT_import_capture, MagicMock()
before, steps = all_of_it()[-6:], importer.import_in_steps(doomed, capture, importer.ImportSettings("each"))
while not bpy.data.cameras:
    next(steps)
bpy.data.scenes.remove(doomed)
operator = SimpleNamespace(_steps=steps, _is_window_turn=True, _is_complete=False, report=print, _timer=object())
operator.cancel = partial(kind.cancel, operator)
turn, raised = partial(kind.modal, operator, calls, SimpleNamespace(type="TIMER")), ""
while not raised:
    try:
        turn()
    except ReferenceError:
        raised = "ReferenceError"
facts["scene deleted meanwhile"] = [before == all_of_it()[-6:], operator._timer is None, "CANCELLED" in turn(),
                                    [call[0] for call in calls.mock_calls]]

# ---- footage that is missing when it is loaded ----------------------------------------------------------
operators._load_footage(scene)
missing = MagicMock()
missing.gl_load.side_effect = RuntimeError("Failed to load image")
filming = SimpleNamespace(type="CAMERA", data=SimpleNamespace(background_images=[SimpleNamespace(image=missing)] * 2))
operators._load_footage(SimpleNamespace(camera=filming, frame_current=3))
facts["missing pictures"] = missing.gl_load.call_count

# ---- a large cloud -------------------------------------------------------------------------------------
points, batch = part("flare_addon.points"), sys.modules.setdefault("gpu_extras.batch", ModuleType("batch"))
batch.batch_for_shader = lambda _shader, _kind, content: len(content["pos"])
points._shader = lambda: None
mesh = bpy.data.meshes.new("Cloud")
mesh.vertices.add(2 * points.VERTICES_PER_DRAWING + 5)
mesh.color_attributes.new(points.ATTRIBUTE, "BYTE_COLOR", "POINT")
cloud, drawings = points._Cloud(), []
while not cloud.is_complete:
    cloud.prepare(mesh)
    drawings.append(list(cloud._batches))
facts["cloud"] = [drawings, points.VERTICES_PER_DRAWING]

# ---- a fit that ends while its scene is not the one in the window ---------------------------------------
looks, lights = part("flare_addon.looks"), part("flare_addon.lights")
scene = empty()
ops.import_capture(directory=str(capture))
scene.name = "Shot"
bpy.context.window.scene = bpy.data.scenes.new("Other")
bpy.ops.wm.save_as_mainfile(filepath=str(out / "two.blend"))
bpy.ops.wm.open_mainfile(filepath=str(out / "two.blend"))
scene = bpy.data.scenes["Shot"]
place = {light.name: light.xyz + 0.1 for light in part("core.capture").read_lights(capture / "lights.json")}
lights.move_to_fit(scene, place, capture)
depsgraph = part("flare_addon.objects").depsgraph_of(scene)
facts["moved unseen"] = max(abs(float(lights.capture_position(item, scene.fit_flare.root, depsgraph)[0])
                                - float(place[lights.light_name(item)][0])) for item in lights.scene_lights(scene))

# ---- another flare is saved into the library while one is chosen ----------------------------------------
library, look = part("flare_addon.library"), part("core.look").read_look(flare)
for name in ("mid", "zed"):
    library.save_look(look, look.edits, name, "", "")
manager = bpy.context.window_manager
facts["chosen at first"] = Path(manager.fit_flare_library).stem
manager.fit_flare_library = next(item[0] for item in library.menu_items() if item[1] == "zed")
library.save_look(look, look.edits, "aaa", "", "")
facts["chosen"] = Path(manager.fit_flare_library).stem
Path(manager.fit_flare_library).unlink()
facts["chosen is gone"] = Path(manager.fit_flare_library).stem
leave(facts)
