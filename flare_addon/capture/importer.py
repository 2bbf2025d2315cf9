# SPDX-License-Identifier: GPL-3.0-or-later
"""Imports a capture as a collection: cameras with their frames as background, the point cloud, the lights.

All objects are children of one empty, the root, which holds up axis and scale. Keys and positions below it are in the
capture's coordinates, and the root places the capture in the scene.
"""
from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import bpy
import numpy as np

from ...core.capture import REMOVED, Capture, PictureIndex, PointCloud, View
from ...core.capture.camera import Camera, quaternion_from_rotation
from ...core.conventions.frame_numbers import number_views
from ...core.errors import CaptureError
from ...core.removal.jobs.provenance import has_exact_clean_frames
from ...core.system.steps import PAUSE, Steps, finish
from .. import cameras, fcurves, light_paths
from ..cameras import FLIP_YZ
from ..compositor.footage import footage_nodes
from ..compositor.setup import ARTISTS_COMPOSITOR, show_plate
from ..images import load_image
from ..paths import absolute, blend_relative
from ..plate_space import show_recorded
from ..render_settings import set_plain_view

SENSOR = 36.0  # mm
UP_ROTATIONS = {"Z": (0.0, 0.0, 0.0), "-Y": (-math.pi / 2, 0.0, 0.0), "Y": (math.pi / 2, 0.0, 0.0)}
"""Rotation of the root by the up axis of the capture."""

EXPOSURE_PATH = "fit_flare.exposure"
"""RNA path of the exposure on a camera object."""

PIXEL_ASPECT_TOLERANCE = 2e-3
"""Largest relative difference of fx / fy between cameras with the same pixel aspect: one pixel in 1000."""

CAMERAS_PER_STEP = 10
"""Cameras with a picture each that one step adds."""

OBJECTS_PER_LINK = 50
"""Objects that the scene gets in one step."""

CameraLayout = Literal["animated", "each"]
_NUMBER = re.compile(r"(\d+)(?=\D*$)")


@dataclass(frozen=True)
class ImportSettings:
    """Settings of an import. cameras: one animated camera for each folder of frames, or one for each frame. up: the up
    axis of the capture, "Z", "Y" or "-Y"."""

    cameras: CameraLayout = "animated"
    up: str = "Z"
    scale: float = 1.0
    frames: bool = True
    points: bool = True
    match_scene: bool = True


@dataclass(frozen=True)
class Imported:
    """The objects that an import made. notes: warnings.

    collection: the collection in the scene. unlinked: the collection of the objects that the scene does not
    have yet, which `link_objects_in_steps` removes.
    """

    root: Any
    cameras: tuple[Any, ...]
    lights: tuple[Any, ...]
    notes: tuple[str, ...]
    collection: Any
    unlinked: Any


class _SceneState:
    """The state of a scene before an import, which an import that is cancelled restores."""

    def __init__(self, scene: Any) -> None:
        self._scene, render = scene, scene.render
        self._range = scene.frame_start, scene.frame_end
        self._current_frame, self._subframe = scene.frame_current, scene.frame_subframe
        self._render = {name: getattr(render, name) for name in (
            "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y")}
        self._images, self._actions = set(bpy.data.images), set(bpy.data.actions)

    def restore(self, *collections: Any) -> None:
        """Restore size and frames of the scene, and remove collections with their objects and what only these used.

        A scene that was deleted meanwhile is left out; after an undo, which replaces all data, nothing is removed.
        """
        with contextlib.suppress(ReferenceError):
            self._restore_scene()
        with contextlib.suppress(ReferenceError):
            self._remove(collections)

    def _restore_scene(self) -> None:
        """Restore size and frames of the scene. Raises ReferenceError for one that is gone."""
        scene = self._scene
        scene.frame_start, scene.frame_end = self._range
        for name, value in self._render.items():
            setattr(scene.render, name, value)
        scene.frame_set(self._current_frame, subframe=self._subframe)

    def _remove(self, collections: Sequence[Any]) -> None:
        """Remove collections with their objects and what only these used. Raises ReferenceError where they are gone."""
        objects = [item for collection in collections for item in collection.objects]
        data = {item.data for item in objects if item.data is not None}
        bpy.data.batch_remove([*objects, *collections])
        bpy.data.batch_remove([block for block in data if not block.users])
        added = [*(set(bpy.data.images) - self._images), *(set(bpy.data.actions) - self._actions)]
        bpy.data.batch_remove([block for block in added if not block.users])


def find_capture(path: Path | str) -> Path:
    """Return the folder of a capture from a path to it or to anything in it, such as images/ or lights.json.

    Raises CaptureError where there is none.
    """
    path = Path(path)
    start = path if path.is_dir() else path.parent
    for folder in (start, *start.parents[:3]):
        if (folder / "images").is_dir() or (folder / "transforms.json").is_file():
            return folder
    raise CaptureError(f"{path} is not in a capture: there is neither a folder images/ beside sparse/0/ nor a "
                       "transforms.json; choose the folder of a capture.")


def import_capture(scene: Any, folder: Path | str, settings: ImportSettings | None = None) -> Imported:
    """Import the capture in `folder` into `scene`, and show its frames in renders. Raises CaptureError and
    FrameError."""
    settings = settings or ImportSettings()
    imported = finish(import_in_steps(scene, folder, settings))
    finish(link_objects_in_steps(imported))
    return replace(imported, notes=(*imported.notes, *show_frames_in_renders(scene, settings)))


def show_frames_in_renders(scene: Any, settings: ImportSettings) -> list[str]:
    """Make renders show the frames of a capture that was imported with these settings; return notes for the user.

    A step of its own after the import: Blender evaluates the new compositor.
    """
    if not settings.frames or show_plate(scene):
        return []
    return [ARTISTS_COMPOSITOR]


def import_in_steps(scene: Any, folder: Path | str, settings: ImportSettings) -> Steps[Imported]:
    """Import a capture as a generator that pauses between short steps, without `show_frames_in_renders`.

    After each step in which the scene gets objects, Blender builds its dependency graph and draws anew, which takes
    longer the more objects there are. The scene therefore gets only the root, its camera and the lights;
    `link_objects_in_steps` links the others, after all else that makes Blender evaluate the scene. If the generator
    fails or is closed early, all that it added is removed.
    """
    folder = find_capture(folder)
    capture = yield from Capture.open_in_steps(folder, need_frames=settings.frames)
    collection = bpy.data.collections.new(folder.resolve().name)
    unlinked = bpy.data.collections.new("Imported Objects")
    previous_state = _SceneState(scene)
    try:
        return (yield from _add_capture(scene, folder, settings, capture, collection, unlinked))
    except BaseException:  # GeneratorExit too
        previous_state.restore(collection, unlinked)
        raise


def link_objects_in_steps(imported: Imported) -> Steps[None]:
    """Link the objects of an import that the scene does not have yet, in steps; one that was deleted is left out."""
    while objects_left := imported.unlinked.objects[:OBJECTS_PER_LINK]:
        _move_objects(objects_left, imported.unlinked, imported.collection)
        yield PAUSE
    bpy.data.collections.remove(imported.unlinked)  # Blender builds its dependency graph once more
    yield PAUSE


def _move_objects(objects: Iterable[Any], source: Any, target: Any) -> None:
    """Move objects from one collection to another."""
    for item in objects:
        target.objects.link(item)
        source.objects.unlink(item)


def _add_capture(scene: Any, folder: Path, settings: ImportSettings, capture: Capture, collection: Any, unlinked: Any
                 ) -> Steps[Imported]:
    """Add the objects of a capture to the collection `unlinked`, which no scene has, in steps; then link the root, the
    first camera and the lights to a new collection of the scene, and make these the scene's own."""
    notes: list[str] = []
    extent = capture.extent
    root = _add_object(unlinked, f"{collection.name} Root", None, None)
    root.empty_display_type, root.empty_display_size = "ARROWS", 0.2 * extent
    root.rotation_euler, root.scale = UP_ROTATIONS[settings.up], (settings.scale,) * 3
    yield
    frame_numbers = {frame.view: frame.number for frame in number_views(view.name for view in capture.views)}
    yield
    camera_objects = yield from _add_cameras(unlinked, root, capture, frame_numbers, settings, scene, notes)
    lights = tuple(add_light(unlinked, root, light.name, np.nan_to_num(light.xyz), 0.02 * extent)
                   for light in capture.lights)
    for item, light in zip(lights, capture.lights, strict=True):
        if light.moves:
            yield from light_paths.key_light_path(item, light, capture, frame_numbers)
    if settings.points and len(capture.points):
        mesh = yield from _make_points_mesh(capture.points)
        _add_points(unlinked, root, mesh)
    scene.collection.children.link(collection)
    _move_objects((root, camera_objects[0], *lights), unlinked, collection)
    yield PAUSE  # the last place at which a cancel finds the scene's own state unchanged
    _assign_to_scene(scene, folder, settings, capture, root)
    scene.camera = camera_objects[0]
    if settings.match_scene:
        notes += [note for note in [set_plain_view(scene)] if note]
        if settings.frames:
            scene.render.film_transparent = True  # else the world hides the frames
    if not lights:
        notes.append("The capture has no lights yet; find or add them in the panel Lights.")
    if any(view.lens for view in capture.views) and settings.frames:
        notes.append("The frames behind the camera show the lens's distortion; the cameras have none.")
    return Imported(root, camera_objects, lights, tuple(notes), collection, unlinked)


def _assign_to_scene(scene: Any, folder: Path, settings: ImportSettings, capture: Capture, root: Any) -> None:
    """Make an imported capture the scene's own: set root, colour space, known lights, and the mode of a fit."""
    state = scene.fit_flare
    if state.root is not None:
        state.root.fit_flare.is_root = True  # earlier versions did not store it
    root.fit_flare.is_root = True
    state.root = None  # so that the frames of an earlier capture are not changed
    state.footage = "images"
    state.capture, state.root = blend_relative(folder), root
    show_recorded(scene, folder)
    state.known_lights = "\n".join(light.name for light in capture.lights)
    if settings.frames:
        state.over = "plate"
    state.mode = "default" if has_exact_clean_frames(capture) else "estimated"


def add_light(collection: Any, root: Any, name: str, xyz: Any, size: float) -> Any:
    """Add an empty for a light of the capture, at `xyz` in the coordinates of the root; return it."""
    light = _add_object(collection, name, None, root)
    light.empty_display_type, light.empty_display_size = "SPHERE", size
    light.location = [float(value) for value in xyz]
    light.show_name = True
    light.fit_flare.is_light, light.fit_flare.is_made, light.fit_flare.light = True, True, name
    return light


# ---- cameras --------------------------------------------------------------------------------------


def _add_cameras(collection: Any, root: Any, capture: Capture, frame_numbers: Mapping[str, int],
                 settings: ImportSettings, scene: Any, notes: list[str]) -> Steps[tuple[Any, ...]]:
    """Add the cameras, with animation and frames as the settings say, in steps; append warnings to `notes`.

    frame_numbers: frame of the scene of each view by its name, ordered by folder and number.
    """
    extent = capture.extent  # the cameras are drawn relative to it
    folders: dict[str, list[View]] = {}
    for name in frame_numbers:
        folders.setdefault(Path(name).parent.as_posix(), []).append(capture.view(name))
    yield
    first = capture.views[0].camera
    aspect = cameras.pixel_aspect(first.fx, first.fy)
    if settings.match_scene:
        render = scene.render
        render.resolution_x, render.resolution_y = first.size
        render.resolution_percentage = 100
        render.pixel_aspect_x, render.pixel_aspect_y = aspect
        scene.frame_start, scene.frame_end = min(frame_numbers.values()), max(frame_numbers.values())
        scene.frame_set(scene.frame_start)
    notes += camera_warnings([view.camera for view in capture.views])
    camera_objects: list[Any] = []
    for folder, views in folders.items():
        name = "Camera" if folder == "." else f"Camera {folder}"
        if settings.cameras == "animated":
            camera = _add_camera(collection, root, name, views[0], aspect, 0.15 * extent)
            camera.fit_flare.view = folder
            yield
            numbers = [frame_numbers[view.name] for view in views]
            _animate_camera(camera, views, numbers, aspect)
            if settings.frames and not _show_sequence(camera, capture, views, numbers):
                notes.append(f"The frames of {name} have no common numbering, so only the first is shown behind it; "
                             "import with one camera for each frame to see all.")
            camera_objects.append(camera)
            yield
        else:
            for view in views:
                if len(camera_objects) % CAMERAS_PER_STEP == 0:
                    yield
                camera = _add_camera(collection, root, Path(view.name).stem, view, aspect, 0.08 * extent)
                camera.fit_flare.view = view.name
                if settings.frames:
                    _add_background(camera, load_image(capture.frame_path(view)))
                camera_objects.append(camera)
    return tuple(camera_objects)


def camera_warnings(all_cameras: Sequence[Camera]) -> Iterator[str]:
    """Yield a warning if the cameras of a capture differ in size, and one if they differ in pixel aspect.

    A scene of Blender has one size and one pixel aspect."""
    if len({camera.size for camera in all_cameras}) > 1:
        yield "The frames differ in size; the scene has the size of the first frame."
    aspect = all_cameras[0].fx / all_cameras[0].fy
    difference = max(abs(camera.fx / camera.fy / aspect - 1) for camera in all_cameras)
    if difference > PIXEL_ASPECT_TOLERANCE:
        yield ("The frames differ in pixel aspect; the scene has that of the first frame, and others are up to "
               f"{difference:.1%} too wide or too high behind their cameras.")


def _add_camera(collection: Any, root: Any, name: str, view: View, aspect: tuple[float, float], size: float) -> Any:
    """Add a camera object with the intrinsics and the pose of a view; return it.

    aspect: the scene's pixel aspect (x, y). size: display size of the camera, units of the capture.
    """
    data = bpy.data.cameras.new(name)
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR
    data.lens, data.shift_x, data.shift_y = cameras.lens_of(view.camera, SENSOR, aspect)
    data.display_size, data.passepartout_alpha = size, 0.8
    data.clip_end = 1e4
    camera = _add_object(collection, name, data, root)
    camera.rotation_mode = "QUATERNION"
    matrix = view.camera.camera_to_world @ FLIP_YZ
    camera.location = matrix[:3, 3].tolist()
    camera.rotation_quaternion = quaternion_from_rotation(matrix[:3, :3]).tolist()
    return camera


def _animate_camera(camera: Any, views: Sequence[View], numbers: Sequence[int], aspect: tuple[float, float]) -> None:
    """Insert keys of location and rotation at the frames' numbers, and of focal length and shift where they change.

    numbers: frame of each view. aspect: the scene's pixel aspect.
    """
    matrices = [view.camera.camera_to_world @ FLIP_YZ for view in views]
    positions = np.array([matrix[:3, 3] for matrix in matrices])
    rotations = np.array([quaternion_from_rotation(matrix[:3, :3]) for matrix in matrices])
    for index in range(1, len(rotations)):  # q and -q are the same rotation; the nearer one interpolates correctly
        if rotations[index] @ rotations[index - 1] < 0:
            rotations[index] *= -1
    fcurves.insert_keys(camera, {"location": positions, "rotation_quaternion": rotations}, numbers)
    lenses = np.array([cameras.lens_of(view.camera, SENSOR, aspect) for view in views])
    if np.ptp(lenses, axis=0).max() > 1e-6:
        channels = {"lens": lenses[:, :1], "shift_x": lenses[:, 1:2], "shift_y": lenses[:, 2:]}
        fcurves.insert_keys(camera.data, channels, numbers)


def set_exposures(root: Any, exposures: Mapping[str, float]) -> None:
    """Set the exposure of the cameras of an imported capture from exposures by the names of the views.

    An animated camera gets a key at each frame. A camera without a value gets 1.
    """
    for camera in root.children:
        state = camera.fit_flare
        if camera.type != "CAMERA" or not state.view:
            continue
        for curves in fcurves.fcurves_of(camera):  # from an earlier fit
            for curve in [curve for curve in curves if curve.data_path == EXPOSURE_PATH]:
                curves.remove(curve)
        state.exposure = exposures.get(state.view, 1.0)  # of an animated camera, the view is a folder
        for frame in number_views(exposures):
            if Path(frame.view).parent.as_posix() == state.view:
                state.exposure = exposures[frame.view]
                camera.keyframe_insert(EXPOSURE_PATH, frame=frame.number)


def _show_sequence(camera: Any, capture: Capture, views: Sequence[View], numbers: Sequence[int]) -> bool:
    """Show the frames as a sequence behind the camera; return whether all are shown.

    Blender finds the pictures of a sequence by their names: the same text with the number of the frame. Where the names
    differ otherwise, only the first is shown. numbers: frame of each view.
    """
    paths = [capture.frame_path(view) for view in views]
    patterns = {(path.parent, _NUMBER.sub("#", path.name)) for path in paths}
    matches = [_NUMBER.search(path.stem) for path in paths]
    is_sequence = len(patterns) == 1 and all(match is not None and int(match[1]) == number
                                             for match, number in zip(matches, numbers, strict=True))
    if len(paths) == 1 or not is_sequence:
        _add_background(camera, load_image(paths[0]))
        return len(paths) == 1
    user = _add_background(camera, load_image(paths[0], "SEQUENCE")).image_user
    # Blender shows file number `frame - frame_start + 1 + frame_offset`.
    user.frame_start, user.frame_offset = numbers[0], numbers[0] - 1
    user.frame_duration = numbers[-1] - numbers[0] + 1
    user.use_auto_refresh = True
    return True


def show_footage(scene: Any, frame_folder: str) -> int:
    """Show the frames of the capture's folder `frame_folder`, images/ or removed/; return how many images changed.

    They are shown behind the cameras, and in the compositor's footage node. A frame without a picture of that name in
    the folder is not changed, nor are other users of an image.
    """
    root, capture_path = scene.fit_flare.root, scene.fit_flare.capture
    if root is None or not capture_path:
        return 0
    capture = absolute(capture_path, scene.library)
    pictures = PictureIndex(capture / frame_folder) if (capture / frame_folder).is_dir() else None
    users_by_image: dict[Any, list[Any]] = {}
    for user in (*_background_images(root), *footage_nodes(scene)):
        users_by_image.setdefault(user.image, []).append(user)
    changed = 0
    for image, users in users_by_image.items():
        # relative_path: in images/ or removed/; None for a picture from elsewhere
        path = absolute(image.filepath, image.library).resolve()
        relative_path = next((path.relative_to((capture / name).resolve()) for name in ("images", REMOVED)
                              if path.is_relative_to((capture / name).resolve())), None)
        if relative_path is None:
            continue
        match = pictures.find(relative_path) if pictures is not None else None
        if match is not None and (capture / frame_folder / match).resolve() != path:
            _exclusive_image(image, users).filepath = blend_relative(capture / frame_folder / match)
            changed += 1
    return changed


def _background_images(root: Any) -> Iterator[Any]:
    """Yield the background images of the cameras of a capture."""
    for data in {item.data for item in root.children if item.type == "CAMERA"}:  # cameras may share their data
        yield from (background for background in data.background_images if background.image is not None)


def _exclusive_image(image: Any, users: Sequence[Any]) -> Any:
    """Return the image of these users, or a copy that replaces it where it has other users too."""
    if image.users - image.use_fake_user > len(users):  # Blender counts a fake user as one
        image = image.copy()
        for user in users:
            user.image = image
    return image


def _add_background(camera: Any, image: Any) -> Any:
    """Add a background image to a camera; return it."""
    camera.data.show_background_images = True
    background = camera.data.background_images.new()
    background.image, background.alpha = image, 1.0
    image.use_view_as_render = True  # through the view transform, as in a render
    background.frame_method, background.display_depth = "STRETCH", "BACK"
    return background


# ---- points and objects -------------------------------------------------------------------------------------


def _make_points_mesh(cloud: PointCloud) -> Steps[Any]:
    """Return the point cloud as a new mesh of vertices with the colour attribute "Col", in steps."""
    rgba = np.ones((len(cloud), 4), np.float32)
    rgba[:, :3] = cloud.rgb / np.float32(255)
    xyz = np.ascontiguousarray(cloud.xyz, np.float32).ravel()
    yield
    mesh = bpy.data.meshes.new("Points")
    try:
        mesh.vertices.add(len(cloud))
        mesh.vertices.foreach_set("co", xyz)
        yield
        colours = mesh.color_attributes.new("Col", "BYTE_COLOR", "POINT")
        colours.data.foreach_set("color_srgb", rgba.ravel())
        mesh.update()
        yield
    except BaseException:  # GeneratorExit too, before an object has the mesh
        bpy.data.meshes.remove(mesh)
        raise
    return mesh


def _add_points(collection: Any, root: Any, mesh: Any) -> None:
    """Add the object of a point cloud, which is not rendered."""
    points = _add_object(collection, "Points", mesh, root)
    points.hide_render = points.hide_select = True
    points.display_type, points.fit_flare.is_points = "BOUNDS", True  # points.py draws them in their colours


def _add_object(collection: Any, name: str, data: Any, parent: Any) -> Any:
    """Add an object to a collection, as a child of `parent`; return it."""
    obj = bpy.data.objects.new(name, data)
    collection.objects.link(obj)
    obj.parent = parent
    return obj
