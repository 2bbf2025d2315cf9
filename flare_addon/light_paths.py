# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths of lights between lights.json, animated objects of the scene, and tracks of the Movie Clip Editor.

A lamp or empty that moves, by keys, drivers, constraints or its parents, is written as a path in the world, with the
brightness of an animated lamp. A path of lights.json becomes an empty with keys, which an artist can correct. For
footage without a camera solve, tracks of a movie clip become lights on the picture, and such lights become tracks;
muted markers are doubtful places. `lights.py` and `operators/light_paths.py` call it.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.capture import LIGHTS, Capture, Light, PictureIndex, read_lights
from ..core.capture.lights import DOUBTFUL
from ..core.conventions.frame_numbers import number_views
from ..core.errors import CaptureError
from ..core.system.files import follow_link, read_json, round_for_text, write_json
from ..core.system.steps import FRAMES_PER_STEP, Steps
from . import lamp_drive
from .paths import absolute

MAX_STANDING_MOTION = 1e-4
"""Motion of a light below which it stands, relative to its largest coordinate; world units where that is below 1."""
MAX_UNMOVED_PX = 0.02
"""Distance of a marker from its earlier place, up to which it was not moved."""


def frame_numbers(folder: Path) -> dict[str, int]:
    """Return the scene's frame of each picture of a capture, by the picture's name; {} without a folder images/."""
    images = folder / "images"
    if not images.is_dir():
        return {}
    return {frame.view: frame.number for frame in number_views(PictureIndex(images).names)}


def may_move(item: Any, root: Any) -> bool:
    """Return whether an object may move: by animation, constraints, physics, a vertex or bone as its parent, or a
    parent below `root` that moves."""
    while item is not None and item != root:
        if item.animation_data is not None or item.constraints or item.rigid_body or item.parent_type != "OBJECT":
            return True
        item = item.parent
    return False


def has_animated_light(item: Any) -> bool:
    """Return whether an object is a lamp whose settings are animated."""
    return item.type == "LIGHT" and item.data.animation_data is not None


def world_paths(scene: Any, items: Mapping[str, Any], numbers: Mapping[str, int], position_of: Callable[[Any], Any]
                ) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the keys of the lights that move or change, by name and by picture: {"xyz": [x, y, z], "on": 0..1}.

    The timeline moves to the frame of each picture, and back afterwards. "on" is the light's power relative to its
    largest. A light that stands has keys without xyz, one that does not change has keys without on. items: light
    objects by name. numbers: frames of the scene by picture. position_of: returns the position (3,) of an object at the
    scene's current frame, in the capture's coordinates.
    """
    animated = {name: item for name, item in items.items()
                if may_move(item, scene.fit_flare.root) or has_animated_light(item)}
    if not animated or not numbers:
        return {}
    positions: dict[str, list[Any]] = {name: [] for name in animated}
    powers: dict[str, list[float]] = {name: [] for name in animated}
    current_frame, subframe = scene.frame_current, scene.frame_subframe
    try:
        for number in numbers.values():
            scene.frame_set(number)
            for name, item in animated.items():
                positions[name].append(np.asarray(position_of(item), np.float64))
                powers[name].append(_power(item))
    finally:
        scene.frame_set(current_frame, subframe=subframe)
    return {name: keys for name in animated if (keys := _path_keys(list(numbers), positions[name], powers[name]))}


def _power(item: Any) -> float:
    """Return the light of a lamp at the current frame in its strongest colour channel (`lamp_drive.light_of`).

    It is 1 for other objects, and 0 for any object that is disabled in renders.
    """
    if item.hide_render:
        return 0.0
    return float(lamp_drive.light_of(item.data).max()) if item.type == "LIGHT" else 1.0


def _path_keys(names: Sequence[str], positions: Sequence[Any], powers: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Return the keys of a light by picture; {} if it neither moves nor changes.

    names: the pictures' names. positions (3,), powers: those of the light in each picture.
    """
    xyz = np.array(positions)
    is_standing = np.ptp(xyz, axis=0).max() <= MAX_STANDING_MOTION * max(1.0, float(np.abs(xyz).max()))
    is_constant = max(powers) - min(powers) <= 1e-6 * max(max(powers), 1e-9)
    if is_standing and is_constant:
        return {}
    keys: dict[str, dict[str, Any]] = {name: {} for name in names}
    for name, position, power in zip(names, positions, powers, strict=True):
        if not is_standing:
            keys[name]["xyz"] = [round_for_text(float(value)) for value in position]
        if not is_constant:
            keys[name]["on"] = round(max(power, 0.0) / max(max(powers), 1e-9), 4)
    return keys


def merge_entry(known_entry: Mapping[str, Any], name: str, xyz: Sequence[float], keys: Mapping[str, Mapping[str, Any]]
                ) -> dict[str, Any]:
    """Return the entry of a light for lights.json.

    known_entry: its entry so far, whose other values stay. xyz: its place if it stands. keys: from `world_paths`.
    Brightness and confidence of the entry stay where the scene does not animate them; but a place that was moved loses
    its confidence, since an artist has corrected it.
    """
    known_frames = known_entry.get("frames") or {}
    has_path = any("xyz" in key for key in keys.values())
    entry = {**known_entry, "name": name}
    frames: dict[str, Any] = {}
    for frame in dict.fromkeys((*known_frames, *keys)):
        key = {label: value for label, value in (known_frames.get(frame) or {}).items() if label not in ("xyz", "xy")}
        new_key = keys.get(frame, {})
        known_xyz = (known_frames.get(frame) or {}).get("xyz")
        if known_xyz is not None and "xyz" in new_key and not np.allclose(known_xyz, new_key["xyz"], rtol=1e-3,
                                                                          atol=1e-4):
            key.pop("confidence", None)
        merged = {**key, **new_key}
        if {"xyz", "on"} & merged.keys():
            frames[frame] = merged
    for label in ("frames", "xyz", "xy"):
        entry.pop(label, None)
    if not has_path:
        entry["xyz"] = list(xyz)
    if frames:
        entry["frames"] = frames
    return entry


def key_light_path(item: Any, light: Light, capture: Capture, scene_frames: Mapping[str, int]) -> Steps[None]:
    """Key the location of an empty, a child of the root, along the path of a light of lights.json, in steps.

    A light that is known on the picture alone is put on the rays of its pixels (`Capture.light_state`). scene_frames:
    frame of each view, by its name.
    """
    for number, view in enumerate(capture.views, 1):
        state = capture.light_state(light, view)
        item.location = [float(value) for value in state.xyz]
        item.keyframe_insert("location", frame=scene_frames[view.name])
        if number % FRAMES_PER_STEP == 0:
            yield


def capture_of_moving_lights(folder: Path, lights: Sequence[Light]) -> tuple[Capture, dict[str, int]] | None:
    """Return the capture and the frame of each view where some light moves, else None. Raises CaptureError."""
    if not any(light.moves for light in lights):
        return None
    capture = Capture.open(folder, need_frames=False)
    return capture, {frame.view: frame.number for frame in number_views(view.name for view in capture.views)}


# ---- tracks of the Movie Clip Editor --------------------------------------------------------------


def clip_folder(clip: Any) -> Path:
    """Return the folder for a clip's lights.json: the capture whose images/ it shows, else the folder of the pictures.

    Raises CaptureError for a video, whose frames have no names.
    """
    path = absolute(clip.filepath, clip.library)
    if clip.source != "SEQUENCE":
        raise CaptureError(f"The clip {clip.name!r} is a video, whose frames have no names; load the frames that solve "
                           "or shot wrote.")
    return path.parent.parent if path.parent.name.casefold() == "images" else path.parent


def _picture_names(clip: Any) -> dict[int, str]:
    """Return the names of a clip's pictures by frame of the clip. Frame 1 is the file that the clip names, or, with a
    frame offset, as many files after it. Raises CaptureError where that file is missing."""
    path = absolute(clip.filepath, clip.library)
    numbered = {frame.view: frame.number for frame in number_views(PictureIndex(path.parent).names)
                if "/" not in frame.view}  # pictures of subfolders are not of the clip
    if path.name not in numbered:
        raise CaptureError(f"{path} is missing; load the clip again.")
    first = numbered[path.name] + clip.frame_offset
    return {number - first + 1: name for name, number in numbered.items() if number >= first}


def write_tracks(clip: Any, only_selected: bool = False) -> int:
    """Write the tracks of a clip as lights on the picture into lights.json; return their number.

    An entry with the name of a track keeps its brightness by frame; entries of other names stay. Raises CaptureError
    without tracks.
    """
    names, (width, height) = _picture_names(clip), tuple(clip.size)
    tracks = [track for track in clip.tracking.tracks if track.select or not only_selected]
    path = clip_folder(clip) / LIGHTS
    read_lights(path)  # raises where the file is invalid
    data: dict[str, Any] = read_json(path, CaptureError) if path.is_file() else {}
    entries = {str(entry["name"]): entry for entry in data.get("lights", [])}
    count = 0
    for track in tracks:
        known_entry = entries.get(track.name, {})
        known_frames = known_entry.get("frames") or {}
        frames = _track_frames(track, names, (width, height), known_frames)
        if frames:
            brightness = {name: {"on": key["on"]} for name, key in known_frames.items()
                          if name not in frames and "on" in key}
            others = {label: value for label, value in known_entry.items() if label not in ("xyz", "xy", "frames")}
            entries[track.name] = {**others, "name": track.name,
                                   "frames": dict(sorted({**brightness, **frames}.items()))}
            count += 1
    if not count:
        raise CaptureError(f"The clip {clip.name!r} has no {'selected ' if only_selected else ''}tracks with markers; "
                           "track the lights first.")
    write_json(follow_link(path), {**data, "lights": list(entries.values())})
    return count


def _track_frames(track: Any, names: Mapping[int, str], size: tuple[int, int],
                  known_frames: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the keys of a track's markers by picture, without muted ones.

    A marker within MAX_UNMOVED_PX of the known place was not moved: it keeps place, brightness and confidence. A marker
    that was moved keeps its brightness alone. names: pictures by frame of the clip. size: (width, height) of the
    pictures. known_frames: the keys of the light so far, by picture.
    """
    frames: dict[str, dict[str, Any]] = {}
    width, height = size
    for marker in track.markers:
        name = names.get(marker.frame)
        if name is None or marker.mute:
            continue
        # Markers are in parts of the picture, counted from the lower left corner.
        xy = [round(marker.co[0] * width, 3), round((1 - marker.co[1]) * height, 3)]
        known_key = known_frames.get(name) or {}
        is_unmoved = known_key.get("xy") is not None and np.allclose(known_key["xy"], xy, atol=MAX_UNMOVED_PX)
        values = known_key if is_unmoved else {label: value for label, value in known_key.items() if label == "on"}
        frames[name] = {**values, "xy": known_key["xy"] if is_unmoved else xy}
    return frames


def add_light_tracks(clip: Any) -> int:
    """Add the paths on the picture of lights.json as tracks of a clip; return their number.

    A track of the same name is renamed to "... (before)", since scripts cannot delete tracks. Markers of doubtful
    places are muted. Raises CaptureError where there are no such paths.
    """
    names, (width, height) = _picture_names(clip), tuple(clip.size)
    path = clip_folder(clip) / LIGHTS
    lights = [light for light in read_lights(path) if light.is_on_picture and light.keys]
    if not lights:
        raise CaptureError(f"{path} has no lights on the picture; find them in the frames first.")
    tracking = clip.tracking
    for light in lights:
        markers = [(frame, light.keys[name]) for frame, name in sorted(names.items())
                   if name in light.keys and light.keys[name].xy is not None]
        for earlier_track in [track for track in tracking.tracks if track.name == light.name]:
            earlier_track.name = f"{light.name} (before)"
        track = tracking.tracks.new(name=light.name, frame=markers[0][0] if markers else 1)
        for frame, key in markers:
            assert key.xy is not None
            marker = track.markers.insert_frame(frame, co=(key.xy[0] / width, 1 - key.xy[1] / height))
            marker.mute = key.confidence < DOUBTFUL
    return len(lights)
