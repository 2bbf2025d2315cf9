# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the animated camera of a Nuke script (.nk), or of a .chan file, and makes a capture of it with its plates.

A Camera node states translation, rotation in degrees with its order (`rot_order`), focal length and horizontal
aperture, or a matrix. Order ZXY turns about z first: the matrix is Ry Rx Rz. A .chan file has a line for each frame:
frame, translation, rotation in Nuke's default order ZXY, vertical field of view in degrees. Nuke's world has y up; the
capture's has z up, as Blender's. `solve` calls `read_nuke_camera` and `write_nuke_capture`.
"""
from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..images.exr import read_data_window
from ..images.size import picture_size
from ..system.files import atomic_path
from ..system.progress import Progress
from ..system.reading import read_text
from ..system.tally import Tally
from .camera import Floats, is_rotation
from .colmap import MAX_MAGNITUDE, ObservedFrame, PointCloud, write_model
from .lens import Lens

NUKE_SUFFIXES = (".nk", ".chan")
ROTATION_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
DEFAULT_ORDER = "ZXY"
DEFAULT_FOCAL, DEFAULT_APERTURE = 50.0, 24.576
"""Focal length and horizontal aperture of a new camera in Nuke, millimetres."""
_NEUTRAL = {"pivot": 0.0, "scaling": 1.0, "uniform_scale": 1.0, "skew": 0.0, "win_translate": 0.0, "win_scale": 1.0,
            "winroll": 0.0}
"""Knobs that must have these values: what they do is not read."""
_CAMERA_NODE = re.compile(r"Camera\d*")
_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's camera axes to those of Nuke, whose camera looks along -z with y up."""

Curve = Mapping[int, float]
"""Values by frame number."""


@dataclass(frozen=True)
class NukeCamera:
    """A camera's pose and focal length by frame number.

    poses: camera to world (4, 4), in Nuke's axes. focal: focal length relative to the width of the frame, or to its
    height where `by_height`. is_still: nothing is animated; the only entry, of frame 0, holds for every frame.
    """

    poses: Mapping[int, Floats]
    focal: Mapping[int, float]
    by_height: bool = False
    is_still: bool = False

    def at_frames(self, numbers: Iterable[int]) -> NukeCamera:
        """Return the camera at these frames, where it is still; else the camera as it is."""
        if not self.is_still:
            return self
        numbers = list(numbers)
        return replace(self, poses=dict.fromkeys(numbers, self.poses[0]), focal=dict.fromkeys(numbers, self.focal[0]))

    def lens(self, number: int, size: tuple[int, int], aspect: float) -> Lens:
        """Return the lens of a frame of this size in pixels and pixel aspect ratio."""
        width, height = size
        focal_y = self.focal[number] * (height if self.by_height else width * aspect)
        return Lens("PINHOLE", (focal_y / aspect, focal_y, width / 2, height / 2), width, height)


def read_nuke_camera(path: Path) -> NukeCamera:
    """Read the one camera of a script or a .chan file. Raises CaptureError."""
    try:
        text = read_text(path, errors="replace")
    except (OSError, ValueError) as problem:
        raise CaptureError(f"{path} cannot be read: {getattr(problem, 'strerror', None) or problem}.") from problem
    camera = _read_chan(path, text) if path.suffix.lower() == ".chan" else _read_script(path, text)
    for number, pose in camera.poses.items():
        if not (np.abs(pose) < MAX_MAGNITUDE).all() or not 0 < camera.focal[number] < MAX_MAGNITUDE:
            raise CaptureError(f"{path}, frame {number}: the camera's numbers make no sense; export it again.")
    return camera


def write_nuke_capture(camera: NukeCamera, plates: Mapping[int, Path], folder: Path, progress: Progress) -> Tally:
    """Copy the plates that have a pose, and write the cameras as a COLMAP model without points; return the tally.

    Raises CaptureError where no plate has a pose, and FrameError for one that cannot be read.
    """
    tally, camera = Tally("frame", "written"), camera.at_frames(plates)
    numbers = sorted(set(plates) & set(camera.poses))
    tally.skip("the camera has no key there", *(plates[number].name for number in sorted(set(plates) - set(numbers))))
    if not numbers:
        keyed = sorted(camera.poses)
        raise CaptureError(f"None of the plates has a pose: the camera has the frames {keyed[0]} to {keyed[-1]}, and "
                           f"the plates {min(plates)} to {max(plates)}.")
    lenses: dict[Lens, Lens] = {}  # frames of one lens share the object
    frames = []
    progress.stage("copy the plates", len(numbers))
    for number in numbers:
        plate = plates[number]
        lens = camera.lens(number, picture_size(plate), read_data_window(plate).aspect)
        pose = np.linalg.inv(_TO_Z_UP @ camera.poses[number] @ _FROM_OPENCV)
        frames.append(ObservedFrame(plate.name, lenses.setdefault(lens, lens), pose, np.zeros((0, 2)),
                                    np.zeros(0, np.int64)))
        copy_path = folder / "images" / plate.name
        copy_path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(copy_path) as temporary:
            shutil.copyfile(plate, temporary)
        progress.advance()
    (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    write_model(folder / "sparse" / "0", frames, PointCloud.empty())
    tally.use(len(numbers))
    return tally


def _read_chan(path: Path, text: str) -> NukeCamera:
    """Return the camera in the text of a .chan file. Raises CaptureError."""
    poses: dict[int, Floats] = {}
    focal: dict[int, float] = {}
    for line in text.splitlines():
        fields = line.split("#")[0].split()
        if not fields:
            continue
        try:
            numbers = [_parse_finite(number) for number in fields]
            frame = int(numbers[0])
        except (ValueError, OverflowError) as problem:
            raise CaptureError(f"{path} is not a .chan file: {line.strip()!r:.60}.") from problem
        if len(numbers) < 8 or frame != numbers[0] or not 0 < numbers[7] < 180:
            raise CaptureError(f"{path}, {line.strip()!r:.60}: a line has a frame number, three of translation, three "
                               "of rotation and the vertical field of view; export the camera as a Nuke script (.nk).")
        poses[frame] = _compose_pose(numbers[1:4], numbers[4:7], DEFAULT_ORDER)
        focal[frame] = 0.5 / math.tan(math.radians(numbers[7]) / 2)
    if not poses:
        raise CaptureError(f"{path} holds no frames; export the camera again.")
    return NukeCamera(poses, focal, by_height=True)


def _read_script(path: Path, text: str) -> NukeCamera:
    """Return the one camera in the text of a script, or its one animated camera. Raises CaptureError."""
    nodes = [_CameraNode(path, command[1]) for command in _commands(text)
             if len(command) > 1 and _CAMERA_NODE.fullmatch(command[0])]
    nodes = [node for node in nodes if node.is_animated] or nodes
    if len(nodes) != 1:
        names = ", ".join(node.name for node in nodes)
        raise CaptureError(f"{path} holds {f'the cameras {names}' if nodes else 'no Camera node'}; export one camera "
                           "into a script of its own.")
    return nodes[0].to_camera()


@dataclass
class _CameraNode:
    """The knobs of a Camera node, as text."""

    path: Path
    body: str
    knobs: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for command in _commands(self.body):
            if len(command) > 1:
                self.knobs[command[0]] = command[1]

    @property
    def name(self) -> str:
        return self.knobs.get("name", "Camera")

    @property
    def is_animated(self) -> bool:
        return any("curve" in value for value in self.knobs.values())

    def to_camera(self) -> NukeCamera:
        """Return the camera at the frames that have keys. Raises CaptureError for values of knobs that are not
        supported."""
        self._check_knobs()
        focal, aperture = self._single_curve("focal", DEFAULT_FOCAL), self._single_curve("haperture", DEFAULT_APERTURE)
        read_poses = self._matrix_poses if self.knobs.get("useMatrix") == "true" else self._transform_poses
        poses, is_still = read_poses(focal, aperture)
        if not poses:
            raise self._unsupported("its curves have no frame in common")
        # An aperture of 0 gives NaN, which `read_nuke_camera` refuses.
        relative_focal = {number: _value_at(focal, number) / (_value_at(aperture, number) or math.nan)
                          for number in poses}
        return NukeCamera(poses, relative_focal, is_still=is_still)

    def _check_knobs(self) -> None:
        """Raise CaptureError for a projection or a transform that this program does not read."""
        for name, neutral in _NEUTRAL.items():
            curves = self._read_curves(name) if name in self.knobs else []
            if any(value != neutral for curve in curves for value in curve.values()):
                raise self._unsupported(f"{name} is not {neutral:g}")
        if self.knobs.get("projection_mode", "perspective") != "perspective":
            raise self._unsupported(f"its projection is {self.knobs['projection_mode']}")
        if self.knobs.get("xform_order", "SRT") != "SRT":
            raise self._unsupported(f"its transform order is {self.knobs['xform_order']}")

    def _matrix_poses(self, *lens_curves: Curve) -> tuple[dict[int, Floats], bool]:
        """Return the poses (4, 4), camera to world, by frame, from the knob `matrix`, and whether nothing is animated.

        lens_curves: curves whose frames count too. Raises CaptureError.
        """
        curves = self._read_curves("matrix", 16)
        numbers, is_still = _common_frames(*curves, *lens_curves)
        poses = {number: np.reshape([_value_at(curve, number) for curve in curves], (4, 4)) for number in numbers}
        if any(not is_rotation(pose[:3, :3]) or (pose[3] != (0, 0, 0, 1)).any() for pose in poses.values()):
            raise self._unsupported("its matrix is no rotation with a translation")
        return poses, is_still

    def _transform_poses(self, *lens_curves: Curve) -> tuple[dict[int, Floats], bool]:
        """Return what `_matrix_poses` does, from the knobs `translate` and `rotate`."""
        order = self.knobs.get("rot_order", DEFAULT_ORDER)
        if order not in ROTATION_ORDERS:
            raise self._unsupported(f"its rotation order is {order}")
        translation, rotation = (self._read_curves(name, 3) for name in ("translate", "rotate"))
        numbers, is_still = _common_frames(*translation, *rotation, *lens_curves)
        return {number: _compose_pose([_value_at(curve, number) for curve in translation],
                                      [_value_at(curve, number) for curve in rotation], order)
                for number in numbers}, is_still

    def _single_curve(self, name: str, default: float) -> Curve:
        return self._read_curves(name, 1)[0] if name in self.knobs else {0: default}

    def _read_curves(self, name: str, number: int | None = None) -> list[Curve]:
        """Return the curves of a knob; zeros where it is not in the script.

        number: values that the knob must have; None for any number. Raises CaptureError.
        """
        if name not in self.knobs and number is not None:
            return [{0: 0.0}] * number
        curves = [self._parse_curve(name, text) for text in _split_words(self.knobs[name])]
        if number is not None and len(curves) != number:
            raise self._unsupported(f"{name} has {len(curves)} values and not {number}")
        return curves

    def _parse_curve(self, name: str, text: str) -> Curve:
        """Parse a number, or an animation curve such as "curve i x1001 1.5 1.6 x1010 2.0".

        x1001 states the frame of the value after it; a value without such a statement belongs to the frame after that
        of the last value. Raises CaptureError.
        """
        tokens = text.split()
        is_curve = tokens[:1] == ["curve"]
        values: dict[int, float] = {}
        keys: list[int] = []
        stated_frame: int | None = None
        try:
            for token in tokens[1:] if is_curve else tokens:
                if is_curve and token[0] == "x":
                    stated_frame = int(token[1:])
                elif not (is_curve and token[0].isalpha()):  # letters are interpolation and slopes
                    if stated_frame is None and len(keys) > 1 and keys[-1] - keys[-2] != 1:
                        raise ValueError  # ambiguous: a value without a frame, after keys with gaps
                    keys.append(stated_frame if stated_frame is not None else keys[-1] + 1 if keys else 1)
                    values[keys[-1]], stated_frame = _parse_finite(token), None
        except (ValueError, OverflowError) as problem:
            raise self._unsupported(f"{name} is an expression or damaged ({text:.40})") from problem
        if not values or (not is_curve and len(values) > 1):
            raise self._unsupported(f"{name} is an expression or damaged ({text:.40})")
        return values

    def _unsupported(self, reason: str) -> CaptureError:
        return CaptureError(f"{self.path}, {self.name}: {reason}, which this program does not read; bake the camera's "
                            "animation into translate, rotate, focal and haperture, and export it again.")


def _compose_pose(translation: Sequence[float], degrees: Sequence[float], order: str) -> Floats:
    """Return camera to world (4, 4); the rotations, in degrees about x, y and z, apply in `order`."""
    pose = np.eye(4)
    for axis in order:  # each turns from the axis after it to the next one: y to z about x
        index = "XYZ".index(axis)
        first, second = (index + 1) % 3, (index + 2) % 3
        angle = math.radians(degrees[index])
        rotation = np.eye(3)
        rotation[first, first] = rotation[second, second] = math.cos(angle)
        rotation[second, first], rotation[first, second] = math.sin(angle), -math.sin(angle)
        pose[:3, :3] = rotation @ pose[:3, :3]
    pose[:3, 3] = translation
    return pose


def _parse_finite(text: str) -> float:
    """Parse a number of a sensible size. Raises ValueError."""
    number = float(text)
    if not abs(number) < MAX_MAGNITUDE:
        raise ValueError
    return number


def _common_frames(*curves: Curve) -> tuple[set[int], bool]:
    """Return the frames at which all animated curves have a key, and False; ({0}, True) where none is animated."""
    animated = [set(curve) for curve in curves if len(curve) > 1]
    return (set.intersection(*animated), False) if animated else ({0}, True)


def _value_at(curve: Curve, number: int) -> float:
    return next(iter(curve.values())) if len(curve) == 1 else curve[number]


def _commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command of a Tcl script, without braces and quotes around them."""
    for line in _split_outside_quotes(text, "\n;"):
        command = _split_words(line)
        if command and not command[0].startswith("#"):
            yield command


def _split_words(text: str) -> list[str]:
    return [piece[1:-1] if len(piece) > 1 and piece[0] + piece[-1] in ("{}", '""') else piece
            for piece in _split_outside_quotes(text, " \t\n") if piece]


def _split_outside_quotes(text: str, separators: str) -> Iterator[str]:
    """Yield the pieces of a text between separators that are outside of braces and quotes."""
    depth, is_quoted, start, index = 0, False, 0, 0
    while index < len(text):
        character = text[index]
        if character == "\\":
            index += 1
        elif character == '"' and not depth:
            is_quoted = not is_quoted
        elif not is_quoted and character in "{}":
            depth = max(depth + (1 if character == "{" else -1), 0)
        elif not depth and not is_quoted and character in separators:
            yield text[start:index]
            start = index + 1
        index += 1
    yield text[start:]
