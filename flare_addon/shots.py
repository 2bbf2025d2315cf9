# SPDX-License-Identifier: GPL-3.0-or-later
"""Shots of scenes: reads cameras, lights and sliders frame by frame, chooses the folder of their layers, finds layers.

`baking` bakes them.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import bpy

from ..core.bake import bake as bakes
from ..core.bake.layers import layer_names
from ..core.conventions.frame_numbers import layers_file
from ..core.conventions.run_files import FLARE, SCENE
from ..core.errors import CaptureError, FrameError, RunError, SettingsError
from ..core.look import Edit, LookEdits
from ..core.look.shot import Shot, ShotFrame, read_folders_in_steps
from ..core.system.files import hash_files
from ..core.system.reading import parse_json, read_text
from ..core.system.steps import Steps
from . import fits, jobs, library, looks, stereo
from .jobs import Job
from .objects import view_layer_of
from .paths import absolute, blend_relative

SHOT_FILE = "shot.json"
LIVE_FILE = "live.json"  # the lights whose intensity and tint the compositor applies


def frames_to_bake(scene: Any) -> list[int]:
    """Return the frames to bake, as set in the panel; Scene Range and Custom in steps of the scene's Step."""
    state = scene.fit_flare
    if state.bake_range == "current":
        return [scene.frame_current]
    if state.bake_range == "custom":
        return list(range(state.bake_first, max(state.bake_last, state.bake_first) + 1, scene.frame_step))
    return list(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))


class ShotReading:
    """Reads the cameras, lights and sliders of a scene as a shot, one frame a step; each step moves the timeline.

    Without camera objects it reads the scene's camera, which markers on the timeline may change; all frames then have
    the name of the first one. Of a stereo scene it reads every view, under a name of its own. Scene and cameras are
    referred to by name, since an undo replaces the objects. total, done: numbers of frames.
    """

    def __init__(self, scene: Any, camera_objects: Sequence[Any], frames: Sequence[int]) -> None:
        """Prepare the reading of frames; `step` reads one. camera_objects: [] for the scene's camera. Raises
        SettingsError for negative frames, which layers cannot have."""
        if min(frames, default=0) < 0:
            raise SettingsError(f"Frame {min(frames)} cannot be baked, since layers have no negative numbers; start at "
                                "frame 0 or later.")
        self.scene_name, self._cameras = scene.name, [camera.name for camera in camera_objects]
        self._frames, self._frame_before = list(frames), (scene.frame_current, scene.frame_subframe)
        self._is_moved = False
        self._shot_frames: list[ShotFrame] = []
        self._labels: list[str] = []  # names of the sequences of layers at the first frame
        self._views: list[tuple[str, stereo.Eye]] = []  # names and eyes of the views at the first frame
        self.total, self.done = len(self._frames), 0

    @property
    def scene(self) -> Any:
        """The scene. Raises RunError where it was deleted."""
        scene = bpy.data.scenes.get(self.scene_name)
        if scene is None:
            raise RunError(f"The scene {self.scene_name!r} was deleted or renamed while it was read; bake again.")
        return scene

    def step(self) -> None:
        """Read the next frame.

        Raises CaptureError for a camera that is not a perspective camera or was deleted, for a disabled light that is
        animated, and where the stereo settings differ from those at the first frame; FlareFileError for a bad .flare.
        """
        scene, frame = self.scene, self._frames[self.done]
        missing = next((name for name in self._cameras if name not in scene.objects), None)
        if missing is not None or scene.camera is None:
            raise CaptureError(f"The camera {missing or 'of the scene'} was deleted while the scene was read; bake "
                               "again.")
        self._is_moved = True
        scene.frame_set(frame)
        depsgraph = view_layer_of(scene).depsgraph
        camera_objects = [scene.objects[name] for name in self._cameras] or [scene.camera]
        # Two cameras of one Multi-View pair have the same views.
        views = {view.label: view for camera in camera_objects for view in stereo.camera_views(scene, camera)}
        names_and_eyes = [(view.name, view.eye) for view in views.values()]
        self._labels, self._views = self._labels or list(views), self._views or names_and_eyes
        if names_and_eyes != self._views:
            raise CaptureError("The stereo settings changed while the scene was read; bake again.")
        self._shot_frames += [replace(shot_frame(scene, depsgraph, view.camera, frame, view.eye), name=label)
                              for label, view in zip(self._labels, views.values(), strict=True)]
        self.done += 1

    def restore(self) -> None:
        """Move the timeline back to where it was, once."""
        if self._is_moved and self.scene_name in bpy.data.scenes:
            self.scene.frame_set(self._frame_before[0], subframe=self._frame_before[1])
        self._is_moved = False

    def shot(self, flare: Path, run: Path | None) -> Shot:
        """Return the shot of the frames that were read."""
        state = self.scene.fit_flare
        return Shot(flare, tuple(self._shot_frames), looks.query_of(state), run, state.bake_live)


def read_scene_shot(scene: Any, camera_objects: Sequence[Any], frames: Sequence[int], flare: Path,
                    run: Path | None) -> Shot:
    """Return the shot of these camera objects at these frames, as `ShotReading` reads it; the scene's current frame is
    restored.

    camera_objects: [] for the scene's camera. flare: the .flare. run: the run whose scene is baked too, or None.
    """
    reading = ShotReading(scene, camera_objects, frames)
    try:
        while reading.done < reading.total:
            reading.step()
    finally:
        reading.restore()
    return reading.shot(flare, run)


def shot_frame(scene: Any, depsgraph: Any, camera: Any, frame: int, eye: stereo.Eye = "") -> ShotFrame:
    """Return the frame of a shot for a camera object, moved to an eye, at the current frame of the scene.

    frame: its number.
    """
    evaluated = camera.evaluated_get(depsgraph)
    pose, lights = looks.place_lights(scene, depsgraph, camera, eye)
    core_camera = stereo.eye_camera(evaluated, scene.render, eye)
    edits = looks.edits_of(scene.fit_flare)
    if scene.fit_flare.bake_live:
        edits = without_live_edits(edits)
    edit_texts = _edits_of_lights(edits, {light.name for light in lights}).texts()
    capture_camera = replace(core_camera, world_to_camera=pose, exposure=evaluated.fit_flare.exposure)
    return ShotFrame(frame, camera.name, capture_camera, tuple(lights), tuple(edit_texts))


def without_live_edits(edits: LookEdits) -> LookEdits:
    """Return the edits without those that the compositor applies: intensity, tint, mute and solo of lights."""
    def without_live(edit: Edit) -> Edit:
        return replace(edit, intensity=1.0, tint=(1.0, 1.0, 1.0), mute=False, solo=False)

    return LookEdits(without_live(edits.master), {name: without_live(edit) for name, edit in edits.lights.items()},
                     edits.elements)


def _edits_of_lights(edits: LookEdits, names: set[str]) -> LookEdits:
    """Return the edits of these lights only, since a shot accepts no edits of other lights."""
    return LookEdits(edits.master, {name: edit for name, edit in edits.lights.items() if name in names},
                     {pair: edit for pair, edit in edits.elements.items() if pair[0] in names})


def live_record(state: Any, names: Sequence[str]) -> dict[str, list[str]]:
    """Return the contents of LIVE_FILE: the names of the baked lights, and ids that stay when a flare is renamed.

    A flare without an id gets one. state: the scene's properties. names: the names of the baked lights.
    """
    identities = {}
    for item in state.lights:
        item.identity = item.identity or uuid4().hex
        identities[item.name] = item.identity
    return {"lights": list(names), "identities": [identities[name] for name in names]}


def live_layers(state: Any, folder: Path) -> dict[str, int] | None:
    """Return the index of the scene's flare for each layer that was baked without intensity and tint.

    state: the scene's properties. folder: the folder of a bake, or of one camera's layers in it.
    Layers of removed flares are left out. None where neither the folder nor its parent has a readable LIVE_FILE.
    """
    folder = next((candidate for candidate in (folder, folder.parent) if (candidate / LIVE_FILE).is_file()), folder)
    try:
        live = parse_json(read_text(folder / LIVE_FILE))
        baked = layer_names(live["lights"])
        # Earlier versions stored no ids.
        identities = dict(zip(live["lights"], live.get("identities", live["lights"]), strict=True))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    by_name, by_identity = ({getattr(item, key): index for index, item in enumerate(state.lights)}
                            for key in ("name", "identity"))
    indices = {layer: by_identity.get(identities[name], by_name.get(name)) for name, layer in baked.items()}
    return {layer: index for layer, index in indices.items() if index is not None}


def layers_folder(scene: Any) -> Path:
    """Return the folder of the scene's layers; an empty path where none is set."""
    state = scene.fit_flare
    return absolute(state.layers, scene.library) if state.layers else Path()


def choose_layers_folder(scene: Any) -> Path:
    """Set the folder of the scene's layers where none is set: a new one beside the .blend, else beside the flare.

    For a .blend that is not saved and a flare of the library, it is in Blender's user folder. Returns the folder.
    Raises RunError without a flare.
    """
    state = scene.fit_flare
    if not state.layers:
        path = looks.path_of(scene)
        if path is None:
            raise RunError("There is no flare to bake; fit one, or open a .flare.")
        if bpy.data.filepath:
            parent = Path(bpy.data.filepath).parent
        elif path.parent.resolve() in (library.folder().resolve(), library.BOX.resolve()):
            parent = Path(bpy.utils.user_resource("DATAFILES", path="fit_flare/layers"))
        else:
            parent = path.parent
        folder, number = parent / "layers", 1
        while folder.exists():
            number += 1
            folder = parent / f"layers_{number}"
        state.layers = blend_relative(folder)
    return layers_folder(scene)


@dataclass(frozen=True)
class BakedFolders:
    """The subfolders of a folder of layers by camera: those of the last bake, and those of all bakes.

    is_of_scene_camera: the last bake was of the scene's camera, not of chosen ones.
    """

    layers: Path
    last: dict[str, str]
    all: dict[str, str]
    is_of_scene_camera: bool

    @classmethod
    def read_in_steps(cls, layers: Path) -> Steps[BakedFolders | None]:
        """Read the subfolders of a folder of layers; None for a folder that no bake of a scene wrote."""
        try:
            last, own_folder = yield from read_folders_in_steps(layers / SHOT_FILE)
        except SettingsError:
            return None
        try:
            entries = (yield from bakes.read_manifest_in_steps(layers))["frames"]
        except RunError:
            entries = []
        baked = {entry["view"].rpartition("/")[0]: entry["file"].rpartition("/")[0] for entry in entries
                 if "/" in entry["view"]}
        return cls(layers, last, {**baked, **last}, not own_folder)

    def of_views(self, scene: Any) -> dict[str, Path]:
        """Return the folder of the layers of each view that the scene renders, by the view's name ("" without stereo).

        Layers of one camera alone are for all views: {"": folder}. Raises FrameError where there are layers of other
        cameras only.
        """
        suffixes = stereo.view_suffixes(scene.render)
        # A bake of the scene's camera is for the scene's camera, whatever its name is now.
        if suffixes and self.is_of_scene_camera and len(self.last) == len(suffixes) and all(
                name.endswith(suffix) for name, suffix in zip(self.last, suffixes.values(), strict=True)):
            return {view: self.layers / folder for view, folder in zip(suffixes, self.last.values(), strict=True)}
        views = stereo.camera_views(scene, scene.camera) if suffixes and scene.camera is not None else []
        if views and all(view.label in self.all for view in views):
            return {view.name: self.layers / self.all[view.label] for view in views}
        return {"": self._of_camera(scene.camera, scene.render)}

    def _of_camera(self, camera: Any, render: Any) -> Path:
        """Return the folder of a camera's layers, inside the folder of a bake or that folder itself.

        camera: a camera object, or None. render: the scene's render settings. Raises FrameError where there are layers
        of other cameras only.
        """
        name = camera.name if camera is not None else ""
        # Where the last bake wrote into the folder itself (""), or EXRs are there, they serve any camera.
        if name not in self.all and "" not in self.last.values() and not any(self.layers.glob("*.exr")):
            labels = stereo.possible_labels(render, name)
            hint = "" if render.use_multiview or labels.isdisjoint(self.all) else (
                " Layers of a stereo render need Stereoscopy switched on.")
            raise FrameError(f"{self.layers} has no layers of the camera {name!r}, only of "
                             f"{', '.join(map(repr, self.all))}; bake it too, or make one of those the scene's camera. "
                             f"A renamed camera needs its old name.{hint}")
        return self.layers / self.all.get(name, "")


def view_folders_in_steps(scene_now: Callable[[], Any], layers: Path) -> Steps[dict[str, Path]]:
    """Return the folder of the layers of each view that the scene renders, by the view's name ("" without stereo).

    scene_now: returns the scene, which an undo between two steps replaces. layers: the folder of a bake, or of one
    camera's layers in it. Raises what `BakedFolders.of_views` raises.
    """
    folders = yield from BakedFolders.read_in_steps(layers)
    return {"": layers} if folders is None else folders.of_views(scene_now())


def frames_to_replace(scene: Any, camera_objects: Sequence[Any]) -> list[int]:
    """Return the numbers of the frames whose layers a bake would delete.

    They were baked from another flare, or with other lights or colours, and are not among the frames to bake. Raises
    FitFlareError.
    """
    folder, frames = layers_folder(scene), frames_to_bake(scene)
    if not scene.fit_flare.layers or not (folder / bakes.MANIFEST).exists():
        return []
    shot = _panel_shot(scene, camera_objects, frames[:1])  # one frame has all lights and cameras
    files = {layers_file(camera_subfolder, frame) for camera_subfolder in shot.folders.values() for frame in frames}

    def fingerprint() -> str:
        run = shot.run
        return shot.fingerprint("" if run is None else hash_files(run / name for name in (SCENE, FLARE)))

    return bakes.frames_to_delete(folder, fingerprint, shot.lights, files)


def replacement_warning(folder: Path, frames: Sequence[int]) -> str:
    """Return the warning that a bake would delete the layers of these frames."""
    which = f"frame {frames[0]}" if len(frames) == 1 else f"{len(frames)} frames from {frames[0]} to {frames[-1]}"
    return (f"{folder} has layers of {which} that were baked from another flare or with other lights or colours. They "
            "would be deleted: bake them too, or choose another folder for Layers.")


def _panel_shot(scene: Any, camera_objects: Sequence[Any], frames: Sequence[int]) -> Shot:
    """Return the shot that the panel is set to bake, at these frames."""
    shot = read_scene_shot(scene, camera_objects, frames, looks.look_of(scene).path.resolve(), run_to_bake(scene))
    return replace(shot, own_folder=bool(camera_objects))


def run_to_bake(scene: Any) -> Path | None:
    """Return the run whose scene is baked as well; None where this is off. Raises RunError where there is no run."""
    if not scene.fit_flare.bake_scene:
        return None
    run = fits.run_folder(scene)
    if run is None or not (run / SCENE).is_file():
        raise RunError("There is no fitted scene to bake; switch Fitted Scene Too off, or finish a fit.")
    return run.resolve()


def check_bake(scene: Any, camera_objects: Sequence[Any]) -> None:
    """Raise CaptureError or RunError where the scene has nothing to bake."""
    if not camera_objects and scene.camera is None:
        raise CaptureError("The scene has no camera to bake from; add one, or import a capture.")
    state = scene.fit_flare
    if not any(looks.is_placed(item, scene) for item in state.lights):
        raise RunError("No flare has a light object; choose one for each in the panel Look.")
    if looks.duplicate_name(state):
        raise RunError(f"Two flares have the name {looks.duplicate_name(state)!r}; rename one in the panel Look.")


def running_jobs(scene: Any) -> list[Job]:
    """Return the running jobs of a scene: fit, light search, clean frames and bake."""
    layers = jobs.find_job(layers_folder(scene)) if scene.fit_flare.layers else None
    return [job for job in (*fits.engine_jobs(scene), layers) if job is not None and job.running]


def orphaned_jobs() -> list[Job]:
    """Return running fits and bakes that no scene refers to, as after an undo that reset the scene's folder."""
    candidates = [job for job in jobs.running() if job.kind in ("fit", "bake")]
    known = [job for scene in bpy.data.scenes for job in running_jobs(scene)] if candidates else []
    return [job for job in candidates if job not in known]
