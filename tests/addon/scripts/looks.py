# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: other looks are tried on flares that an artist has edited, added to and saved. Arguments: the zip, a
.flare with one light, one with two, a folder to write."""
from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from start import install, leave, part, refusal, scene_with, select

package, flare, two, out = sys.argv[1:5]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
looks, library, shots, overlay, highlight, panels, core_look = (part(name) for name in (
    "flare_addon.looks", "flare_addon.library", "flare_addon.shots", "flare_addon.overlay", "flare_addon.highlight",
    "flare_addon.panels", "core.look"))
look_operators, library_operators = part("flare_addon.operators.look"), part("flare_addon.operators.library")
facts: dict[str, object] = {}
path_of = {item[1]: item[0] for item in library.menu_items()}
rich, plain = path_of["Anamorphic Blue"], path_of["Wide Angle Sun"]
LACKING = ("ghost 4", "ghost 5", "ghost 6", "streak 3")
"""Elements of the rich look that the plain one has not."""


def rows(scene):
    return [[item.name, item.source, item.target.name if item.target else ""] for item in scene.fit_flare.lights]


def element_of(item, name):
    return next(element for element in item.elements if element.name == name)


def reports(operator, context=None, **options):
    """Run `act` of an operator's class; return what it reports."""
    texts = []
    stand_in = SimpleNamespace(report=lambda _kind, text: texts.append(text), **options)
    operator.act(stand_in, context or bpy.context)
    return texts


# ---- another look and back ------------------------------------------------------------------------------
scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
ops.apply_flare(filepath=rich)
(item,) = scene.fit_flare.lights
element_of(item, "ghost 6").scale, element_of(item, "ghost 5").mute, element_of(item, "ghost").solo = 2.0, True, False
for frame, value in ((1, 0.5), (11, 1.5)):
    element_of(item, "streak 3").intensity = value
    element_of(item, "streak 3").keyframe_insert("intensity", frame=frame)
element_of(item, "ghost 4").driver_add("rotation").driver.expression = "0.25"
element_of(item, "ring 2").saturation = 0.5
scene.frame_set(6)


def sliders():
    """The edits and the animated values of the rich look."""
    evaluated = scene.evaluated_get(bpy.context.evaluated_depsgraph_get()).fit_flare.lights[0]
    return [element_of(item, "ghost 6").scale, element_of(item, "ghost 5").mute, element_of(item, "ring 2").saturation,
            round(element_of(evaluated, "streak 3").intensity, 4), round(element_of(evaluated, "ghost 4").rotation, 4)]


facts["edited"] = sliders()
item.element = next(row for row, element in enumerate(item.elements) if element.name == "ghost 6")
element_of(item, "ghost 6").solo = True
ops.apply_flare(filepath=plain)
names = [name for light, name in looks.edits_of(scene.fit_flare).elements if light == item.name]
facts["leaks"] = sorted(set(names) & set(LACKING))
facts["neutral"] = looks.edits_of(scene.fit_flare).is_neutral
shot = shots.read_scene_shot(scene, [], [1], Path(plain), None)
facts["shot"] = list(shot.frames[0].edits)
ops.save_flare(name="Plain")
saved = next(path for path in library.user_files() if path.stem == "Plain")
facts["saved"] = core_look.read_look(saved).edits.texts()
stand_in = SimpleNamespace(filter_name="", use_filter_invert=False, use_filter_sort_alpha=False,
                           bitflag_filter_item=1 << 30, bitflag_item_never_show=1 << 16)


def listed(**options):
    """The names that the list of elements shows."""
    vars(stand_in).update(options)
    flags, order = look_operators.FITFLARE_UL_elements.filter_items(stand_in, bpy.context, item, "elements")
    return [element.name for element, flag in zip(item.elements, flags, strict=True) if flag & 1 << 30], len(order)


present = [element.name for element in core_look.read_look(plain).lights[0].elements]
facts["listed"] = [sorted(listed()[0]) == sorted(present), listed(filter_name="GLA")[0],
                   "streak" in listed(use_filter_invert=True)[0], listed(filter_name="", use_filter_sort_alpha=True)[1]
                   == len(item.elements)]
del stand_in.bitflag_item_never_show  # as before Blender 4.4, where Blender inverts the flags itself
inverted = []
for name in ("GLA", ""):
    flagged = set(listed(filter_name=name, use_filter_invert=True, use_filter_sort_alpha=False)[0])
    inverted.append(sorted(element.name for element in item.elements if element.name not in flagged))
facts["listed, inverted by Blender"] = [inverted[0] == sorted({*present} - {"glare"}), inverted[1] == sorted(present)]
highlight._current = None
item.element = item.element
facts["highlight of a hidden one"] = highlight.current_highlight(scene)
layout = MagicMock()
item.show_elements = True
panels._draw_flare(layout, scene, item, looks.look_of(scene))
facts["headings"] = [call.kwargs["text"] for call in layout.mock_calls if call.kwargs.get("icon") == "DOT"]
ops.apply_flare(filepath=rich)
facts["solo again"] = element_of(item, "ghost 6").solo
element_of(item, "ghost 6").solo = False
facts["back"] = sliders()
for name in ("Clean Prime", "Torch", "Vintage Ring"):
    ops.apply_flare(filepath=path_of[name])
ops.apply_flare(filepath=rich)
facts["after a tour"] = sliders()
ops.apply_flare(filepath=plain)
ops.reset_look()
ops.apply_flare(filepath=rich)
facts["after a reset"] = sliders()[:3]

# ---- a choice against the file --------------------------------------------------------------------------
scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
ops.apply_flare(filepath=rich)
(item,) = scene.fit_flare.lights
element_of(item, "ghost 6").mute, element_of(item, "ghost 5").mute, item.rotation = True, True, 0.5
ops.save_flare(name="Muted")
muted = str(next(path for path in library.user_files() if path.stem == "Muted"))
scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
ops.apply_flare(filepath=muted)
(item,) = scene.fit_flare.lights
element_of(item, "ghost 6").mute = False
item.rotation = 0.0
ops.apply_flare(filepath=plain)
ops.apply_flare(filepath=muted)
facts["chosen against the file"] = [element_of(item, "ghost 6").mute, element_of(item, "ghost 5").mute,
                                    round(item.rotation, 4)]
ops.apply_flare(filepath=rich)
facts["as fitted again"] = [element_of(item, "ghost 5").mute]

# ---- two lights, one light, two lights ------------------------------------------------------------------
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near, far)
ops.open_flare(filepath=two)
before = rows(scene)
ops.apply_flare(filepath=plain)
one = [row[1] for row in rows(scene)]
ops.apply_flare(filepath=two)
facts["each its own look"] = [before == rows(scene), one, [row[1] for row in rows(scene)]]
scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
ops.open_flare(filepath=two)
scene.fit_flare.lights[1].intensity = 0.25  # of the flare without a light object
ops.apply_flare(filepath=plain)
ops.apply_flare(filepath=two)
facts["without a light object"] = [rows(scene), scene.fit_flare.lights[1].intensity]

# ---- flares from selected -------------------------------------------------------------------------------
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near)
ops.open_flare(filepath=two)
first = rows(scene)
select(scene, near, far, scene.camera)
facts["pressed once"] = [reports(look_operators.FITFLARE_OT_add_flare, source="sun"), rows(scene)[len(first):]]
facts["pressed twice"] = [reports(look_operators.FITFLARE_OT_add_flare, source="sun"), len(rows(scene)) - len(first)]
select(scene, near)
facts["another of its looks"] = [list(ops.add_flare(source="moon")), rows(scene)[-1]]

scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near, far)
ops.add_library_flare()
add = part("flare_addon.operators.add_flare").FITFLARE_OT_add_library_flare
options = {"light": "auto", "properties": SimpleNamespace(is_property_set=lambda _name: False)}
facts["added again"] = [reports(add, **options), len(rows(scene))]

# ---- saving several flares ------------------------------------------------------------------------------
save = library_operators.FITFLARE_OT_save_flare
named = {"notes": "", "licence": ""}
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near, far)
ops.apply_flare(filepath=rich)
state = scene.fit_flare
state.light = 0
facts["nothing left out"] = reports(save, name="Both", **named)
state.lights[0].intensity, state.lights[1].elements[0].mute = 0.5, True
facts["one of two"] = reports(save, name="One of Two", **named)
state.lights[0].keyframe_insert("intensity")
state.lights[1].follow_power = False
state.lights[0].extent = "shape"
facts["with switches"] = reports(save, name="With Switches", **named)

# ---- files of the library change ------------------------------------------------------------------------
scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
window = bpy.context.window_manager
window.fit_flare_library = muted
chosen = window.fit_flare_library
ops.apply_flare()
Path(muted).rename(Path(muted).with_name("Renamed.flare"))
facts["renamed while shown"] = [chosen == muted, refusal(ops.apply_flare),
                                Path(scene.fit_flare.flare).stem]
facts["chosen after"] = [refusal(ops.apply_flare), Path(scene.fit_flare.flare).stem == library.menu_items()[0][1]]
scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
renamed = Path(muted).with_name("Renamed.flare")
ops.apply_flare(filepath=str(renamed))
(item,) = scene.fit_flare.lights
item.spread = 1.5
facts["of the file"] = [element_of(item, "ghost 5").mute, round(item.rotation, 4)]
renamed.unlink()
looks.clear_cache()
facts["deleted"] = refusal(lambda: ops.apply_flare(filepath=str(renamed)))
ops.apply_flare(filepath=rich)
facts["after the deletion"] = [element_of(item, "ghost 5").mute, round(item.rotation, 4), item.spread]

scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
replaced = Path(out) / "replaced.flare"
shutil.copy(rich, replaced)
ops.open_flare(filepath=str(replaced))
(item,) = scene.fit_flare.lights
element_of(item, "ghost 6").scale = element_of(item, "glare").scale = 2.0
scene.fit_flare.lights[0].elements.remove(next(row for row, element in enumerate(item.elements)
                                               if element.name == "streak"))
shutil.copy(plain, replaced)
os.utime(replaced, (1, 1))
facts["replaced"] = [list(shots.read_scene_shot(scene, [], [1], replaced, None).frames[0].edits),
                     refusal(lambda: ops.save_flare(name="Replaced"))]
picking = part("flare_addon.operators.pick_element")
intrinsics = np.array([[160.0, 0, 96], [0, 160.0, 54], [0, 0, 1]])
picking.choose_element(scene, bpy.context.evaluated_depsgraph_get(), scene.camera, intrinsics, (104, 48))
facts["updated"] = sorted(element.name for element in looks.present_elements(item)) == sorted(present)

# ---- a deleted lamp -------------------------------------------------------------------------------------
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near)
ops.apply_flare(filepath=rich)
scene.fit_flare.lights[0].intensity = 0.5
scene.collection.objects.unlink(near)  # as Delete does
select(scene)
facts["no object selected"] = [reports(library_operators.FITFLARE_OT_apply_flare, filepath=plain, add=False)[0],
                               rows(scene)]
select(scene, far)
ops.apply_flare(filepath=rich, add=False)
facts["placed anew"] = [rows(scene), scene.fit_flare.lights[0].intensity]

# ---- undo after a look ----------------------------------------------------------------------------------
scene, (near,) = scene_with((0.4, 8, 0.3))
select(scene, near)
ops.apply_flare(filepath=rich)
element_of(scene.fit_flare.lights[0], "ghost 6").scale = 2.0
bpy.ops.ed.undo_push(message="before")
ops.apply_flare(filepath=plain)
bpy.ops.ed.undo_push(message="look")
bpy.ops.ed.undo()
scene = bpy.context.scene
facts["undone"] = [Path(scene.fit_flare.flare).stem, element_of(scene.fit_flare.lights[0], "ghost 6").scale,
                   len(looks.edits_of(scene.fit_flare).elements), list(looks.evaluate_flares(
                       scene, bpy.context.evaluated_depsgraph_get(), scene.camera))]
bpy.ops.ed.redo()
scene = bpy.context.scene
facts["redone"] = [Path(scene.fit_flare.flare).stem, looks.edits_of(scene.fit_flare).is_neutral]

# ---- copies of a scene ----------------------------------------------------------------------------------
def copied(kind):
    """Copy a scene, change look and flares of the copy; return the facts of both."""
    scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
    select(scene, near, far)
    ops.apply_flare(filepath=rich)
    for frame, value in ((1, 0.5), (11, 1.5)):
        scene.fit_flare.lights[1].intensity = value
        scene.fit_flare.lights[1].keyframe_insert("intensity", frame=frame)
    bpy.ops.scene.new(type=kind)
    copy = bpy.context.scene
    if kind == "LINK_COPY":  # and one action for both scenes, as an artist may choose
        copy.animation_data.action = scene.animation_data.action
        if bpy.app.version >= (4, 4, 0):
            copy.animation_data.action_slot = scene.animation_data.action_slot
    placed = [looks.is_placed(item, copy) for item in copy.fit_flare.lights]
    ops.apply_flare(filepath=plain, add=False)
    copy.fit_flare.lights[0].rotation = 0.5
    other = [Path(scene.fit_flare.flare).stem, scene.fit_flare.lights[0].rotation]
    looks.remove_flare(copy, 0)
    copy.frame_set(6)
    bpy.context.window.scene = scene
    scene.frame_set(6)
    return [placed, other, len(scene.fit_flare.lights), [[round(item.intensity, 4) for item in each.fit_flare.lights]
                                                         for each in (copy, scene)]]


facts["linked copy"] = copied("LINK_COPY")
facts["full copy"] = copied("FULL_COPY")
leave(facts)
