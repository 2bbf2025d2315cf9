# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: lights that move, as paths of lights.json and as tracks of a clip. Arguments: the zip, a capture, a
.flare of it, a folder."""
from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part, refusal

package, capture = sys.argv[1], Path(sys.argv[2])
install(package)
lights, importer, light_paths, panels = (
    part(f"flare_addon.{name}") for name in ("lights", "capture.importer", "light_paths", "panels"))
Capture, read_lights = part("core.capture").Capture, part("core.capture").read_lights
facts: dict[str, object] = {}
path = capture / "lights.json"
before = path.read_text()
names = [view.name for view in Capture.open(capture, need_frames=False).views]
numbers = light_paths.frame_numbers(capture)


def states(name: str) -> list[object]:
    """Place and brightness of a light of lights.json in all frames."""
    opened = Capture.open(capture, need_frames=False)
    light = next(light for light in opened.lights if light.name == name)
    return [opened.light_state(light, view) for view in opened.views]


def add(name: str, data: object, parent: object) -> object:
    made = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(made)
    made.parent = parent
    return made


# ---- parented to something that moves, and dimmed ---------------------------------------------------
scene = empty()
root = importer.import_capture(scene, capture).root
car = add("Car", None, root)
lamp = add("headlight", bpy.data.lights.new("headlight", "POINT"), car)
lamp.location = (0, 0.5, 0)
first, last = min(numbers.values()), max(numbers.values())
for frame, x, energy in ((first, 0.0, 100.0), (last, 2.0, 50.0)):
    car.location.x, lamp.data.energy = x, energy
    car.keyframe_insert("location", frame=frame)
    lamp.data.keyframe_insert("energy", frame=frame)
lamp.fit_flare.is_light = True
scene.frame_set(first)
lights.write_to_capture(scene, capture)
written = states("headlight")
facts["on a car"] = [np.round(state.xyz, 3).tolist() for state in (written[0], written[-1])]
facts["between"] = bool(0 < written[1].xyz[0] < 2)
facts["dimmed"] = [round(state.on, 3) for state in (written[0], written[-1])]
facts["current frame"] = scene.frame_current == first
facts["others stand"] = [light.name for light in read_lights(path) if not light.moves]
layout = MagicMock()
panels.FITFLARE_PT_lights.draw(SimpleNamespace(layout=layout), bpy.context)
facts["panel"] = " ".join(str(call.kwargs.get("text", "")) for call in layout.mock_calls)
facts["icons"] = [call.kwargs["icon"] for call in layout.mock_calls if call.args[1:] == ("light",)]
facts["reads back"] = [json.loads(path.read_text())["lights"][-1]["name"]]

lamp.data.animation_data_clear()
lamp.data.energy = 100.0
if hasattr(lamp.data, "exposure"):
    for frame, stops in ((first, 0.0), (last, -2.0)):
        lamp.data.exposure = stops
        lamp.data.keyframe_insert("exposure", frame=frame)
    lights.write_to_capture(scene, capture)
    facts["keyed exposure"] = [round(state.on, 3) for state in (states("headlight")[0], states("headlight")[-1])]
    lamp.data.animation_data_clear()
    lamp.data.exposure, lamp.data.use_temperature = 0.0, True
    drives = part("flare_addon.lamp_drive")
    temperatures = []
    for frame, kelvin in ((first, 3000.0), (last, 9000.0)):
        lamp.data.temperature = kelvin
        lamp.data.keyframe_insert("temperature", frame=frame)
        temperatures.append(float(drives.light_of(lamp.data).max()))
    lamp.data.keyframe_insert("energy", frame=first)
    lights.write_to_capture(scene, capture)
    on = [state.on for state in (states("headlight")[0], states("headlight")[-1])]
    facts["keyed temperature"] = bool(np.allclose(np.divide(*on), np.divide(*temperatures), atol=1e-3)
                                      and abs(on[0] - on[1]) > 0.1)
    facts["temperature is measured"] = [drives.keyed_reference(scene, lamp.data) is None, drives.is_driven(lamp)]
mover = add("pushed", None, None)
scene.collection.objects.link(body := bpy.data.objects.new("Body", bpy.data.meshes.new("Body")))
if bpy.ops.rigidbody.world_add.poll():
    bpy.ops.rigidbody.world_add()
    with bpy.context.temp_override(object=body, selected_objects=[body], active_object=body):
        bpy.ops.rigidbody.object_add()
    mover.parent = body
    facts["pushed by physics"] = light_paths.may_move(mover, None)

# ---- read back, and corrected -----------------------------------------------------------------------
data = json.loads(path.read_text())
data["lights"] = [{"name": "torch", "frames": {
    names[0]: {"xyz": [0, 0, 0.5], "on": 1.0}, names[2]: {"xyz": [0.4, 0, 0.5], "on": 0.5, "confidence": 0.3}}}]
path.write_text(json.dumps(data))
scene = empty()
torch = importer.import_capture(scene, capture).lights[0]
scene.frame_set(numbers[names[1]])
facts["keyed between"] = np.round(torch.location, 4).tolist()
torch.location = (0.4, 0.25, 0.5)
torch.keyframe_insert("location", frame=numbers[names[2]])
lights.write_to_capture(scene, capture)
frames = json.loads(path.read_text())["lights"][0]["frames"]
facts["corrected"] = [np.round(frames[names[0]]["xyz"], 3).tolist(), np.round(frames[names[2]]["xyz"], 3).tolist()]
facts["brightness stays"] = [frames[names[0]]["on"], frames[names[2]]["on"]]
facts["no longer doubtful"] = "confidence" not in frames[names[2]]

# ---- the Movie Clip Editor --------------------------------------------------------------------------
path.write_text(json.dumps({"lights": [{"name": "lamp", "frames": {
    names[0]: {"xy": [10.0, 8.0], "on": 1.0}, names[1]: {"xy": [12.0, 9.0], "on": 0.5, "confidence": 0.2},
    names[2]: {"xy": [14.0, 10.0]}}}]}))
scene = empty()
clip = bpy.data.movieclips.load(str(capture / "images" / names[0]))
scene.active_clip = clip
facts["clip"] = refusal(lambda: bpy.ops.fit_flare.tracks_from_lights())
(track,) = clip.tracking.tracks
width, height = clip.size
facts["markers"] = [[round(marker.co[0] * width, 2), round((1 - marker.co[1]) * height, 2), bool(marker.mute)]
                    for marker in track.markers]
marker = track.markers.find_frame(3)
marker.co = (20 / width, 1 - 11 / height)
facts["written back"] = refusal(lambda: bpy.ops.fit_flare.lights_from_tracks())
frames = json.loads(path.read_text())["lights"][0]["frames"]
facts["picture"] = [[name in frames and frames[name].get("xy"), frames.get(name, {}).get("on")] for name in names[:3]]
facts["no tracks"] = refusal(lambda: bpy.ops.fit_flare.lights_from_tracks(only_selected=True)) if not any(
    each.select for each in clip.tracking.tracks) else "selected"

path.write_text(before)
leave(facts)
