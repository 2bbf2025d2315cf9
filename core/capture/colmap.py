# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes COLMAP sparse models, binary and text, with numpy alone: Blender's own Python has no pycolmap.

The format is COLMAP's documented one: cameras, images (pose as quaternion and translation, world to camera) and
points3D. Counts in a file are checked against its length before anything is allocated.
"""
from __future__ import annotations

import math
import re
import struct
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CaptureError
from ..images.size import MAX_PIXELS
from ..system.file_names import find_entry
from ..system.files import atomic_path
from ..system.reading import MAX_MODEL_BYTES, UTF8_SIG, read_bytes, read_text
from ..system.steps import FRAMES_PER_STEP, Steps, finish
from .camera import Floats, quaternion_from_rotation, rotation_from_quaternion
from .lens import MODEL_NAMES, MODELS, Lens

MAX_MAGNITUDE = 1e12
"""Bound for the numbers of a pose or a lens, whatever the unit."""
_MAX_COORDINATE = 1e30
"""Bound for coordinates and errors of points, with which float32 can still compute."""
_MAX_QUATERNION_ERROR = 0.01
"""Difference between a quaternion's length and 1 up to which rounding explains it."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points (n, 3) float32 in world coordinates, colours (n, 3) uint8 sRGB, mean reprojection error (n,) float32 px.

    The error is 0 where unknown.
    """

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def empty(cls) -> PointCloud:
        """Make a cloud without points."""
        return cls(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32))


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A frame of a model: its name, its lens, and its pose (4, 4).

    points: indices (n,) of the points that were observed in it, where the model says.
    """

    name: str
    lens: Lens
    world_to_camera: Floats
    points: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))


def read_model(folder: Path) -> tuple[list[PosedFrame], PointCloud]:
    """Read cameras, images and points3D (.bin where it exists, else .txt; points3D may be absent).

    Raises CaptureError, naming the file, where one is missing, damaged, empty or invalid.
    """
    return finish(read_model_in_steps(folder))


def read_model_in_steps(folder: Path) -> Steps[tuple[list[PosedFrame], PointCloud]]:
    """Read a model as `read_model` does, as a generator that pauses between short steps and returns the result."""
    lenses = yield from _read_file(folder, "cameras", _read_cameras_bin, _read_cameras_txt)
    images = yield from _read_file(folder, "images", _read_images_bin, _read_images_txt)
    points, point_ids = ((yield from _read_file(folder, "points3D", _read_points_bin, _read_points_txt))
                         or (PointCloud.empty(), np.zeros(0, np.int64)))
    order = np.argsort(point_ids, kind="stable")
    if not images:
        raise CaptureError(f"{_file_path(folder, 'images')} holds no images; the solve registered no frame.")
    posed: list[PosedFrame] = []
    for name, camera_id, quaternion, translation, observed_ids in images:
        if len(posed) % FRAMES_PER_STEP == 0:
            yield
        if camera_id not in lenses:
            raise CaptureError(f"{_file_path(folder, 'images')} gives {name} the camera {camera_id}, which "
                               f"{_file_path(folder, 'cameras')} does not have; export the whole model again.")
        pose = _to_pose(quaternion, translation, f"{_file_path(folder, 'images')}, {name}")
        posed.append(PosedFrame(name, lenses[camera_id], pose, _point_indices(observed_ids, point_ids, order)))
    return posed, points


def _to_pose(quaternion: Sequence[float], translation: Sequence[float], source: str) -> Floats:
    """Return the pose (4, 4), world to camera, of an image. Raises CaptureError where it is not a rigid motion.

    quaternion: w, x, y, z. source: beginning of the error's message.
    """
    norm = math.sqrt(sum(q * q for q in quaternion))
    if not all(abs(number) < MAX_MAGNITUDE for number in (*quaternion, *translation)):
        raise CaptureError(f"{source}: the pose is not finite numbers of a sensible size; solve the cameras again.")
    if abs(norm - 1.0) > _MAX_QUATERNION_ERROR:
        raise CaptureError(f"{source}: the quaternion's length is {norm:.4g}, so it is no rotation; solve the cameras "
                           "again.")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_quaternion(quaternion), translation
    return pose


def _point_indices(observed_ids: NDArray[np.int64], point_ids: NDArray[np.int64],
                   order: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices of `observed_ids` in `point_ids`, which `order` sorts; unknown ids are dropped."""
    if not len(point_ids):
        return order  # empty as well
    indices = order[np.searchsorted(point_ids, observed_ids, sorter=order).clip(max=len(point_ids) - 1)]
    return np.unique(indices[point_ids[indices] == observed_ids])


@dataclass(frozen=True, eq=False)
class ObservedFrame:
    """A frame to be written: its name, lens and pose, and its observations: pixels (n, 2) and point indices (n,)."""

    name: str
    lens: Lens
    world_to_camera: Floats
    pixels: Floats
    points: NDArray[np.int64]


def write_model(folder: Path, frames: Sequence[ObservedFrame], cloud: PointCloud) -> None:
    """Write cameras.bin, images.bin and points3D.bin, with ids from 1; frames that share a Lens object share a
    camera."""
    lenses = list(dict.fromkeys(frame.lens for frame in frames))
    cameras = [struct.pack("<Q", len(lenses))]
    cameras += [struct.pack("<iiQQ", number, MODELS[lens.model][0], lens.width, lens.height)
                + struct.pack(f"<{len(lens.params)}d", *lens.params) for number, lens in enumerate(lenses, 1)]
    images = [struct.pack("<Q", len(frames))]
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(len(cloud))]
    for number, frame in enumerate(frames, 1):
        quaternion = quaternion_from_rotation(frame.world_to_camera[:3, :3])
        images.append(struct.pack("<i7di", number, *quaternion, *frame.world_to_camera[:3, 3],
                                  lenses.index(frame.lens) + 1) + frame.name.encode() + b"\0")
        observations = np.zeros(len(frame.points), [("xy", "<f8", 2), ("id", "<i8")])
        observations["xy"], observations["id"] = frame.pixels, frame.points + 1
        images.append(struct.pack("<Q", len(observations)) + observations.tobytes())
        for index, point in enumerate(frame.points):
            tracks[point].append((number, index))
    points = [struct.pack("<Q", len(cloud))]
    for number, (xyz, rgb, error, track) in enumerate(zip(cloud.xyz, cloud.rgb, cloud.error, tracks, strict=True), 1):
        points.append(struct.pack("<Q3d3Bd", number, *xyz.tolist(), *rgb.tolist(), float(error))
                      + struct.pack(f"<Q{2 * len(track)}i", len(track), *(i for pair in track for i in pair)))
    for name, parts in (("cameras", cameras), ("points3D", points), ("images", images)):
        with atomic_path(folder / f"{name}.bin") as path:
            path.write_bytes(b"".join(parts))


def check_lens(lens: Lens, where: str) -> Lens:
    """Return `lens`. Raises CaptureError, whose message begins with `where`, if its numbers cannot be a camera's."""
    if lens.width <= 0 or lens.height <= 0 or lens.width * lens.height > MAX_PIXELS:
        raise CaptureError(f"{where} a size of {lens.width} x {lens.height} pixels makes no sense; solve the cameras "
                           "again.")
    if not all(map(math.isfinite, lens.params)):
        raise CaptureError(f"{where} the camera parameters are not finite numbers; solve the cameras again.")
    if min(lens.focal) <= 0:
        raise CaptureError(f"{where} the focal length {min(lens.focal):g} is not positive; solve the cameras again.")
    return lens


def _file_path(folder: Path, name: str) -> Path:
    """Return the path of a part of a model, in any case of letters; that of the text where there is none."""
    candidates = (find_entry(folder, f"{name}{suffix}") for suffix in (".bin", ".txt"))
    return next((path for path in candidates if path is not None and path.is_file()), folder / f"{name}.txt")


def _read_file(folder: Path, name: str, binary_reader: Any, text_reader: Any) -> Steps[Any]:
    """Read a part of a model by its binary or text reader, in steps; None where points3D, which may be absent, is.
    Raises CaptureError.

    binary_reader: takes a _ByteReader. text_reader: takes the path and the lines.
    """
    yield
    path = _file_path(folder, name)
    if not path.is_file():
        if name == "points3D":
            return None
        raise CaptureError(f"{folder} has no {name}.bin or {name}.txt; export the whole COLMAP model.")
    try:
        if path.suffix.lower() == ".bin":
            result = binary_reader(_ByteReader(path))
            return (yield from result) if isinstance(result, Generator) else result
        return text_reader(path, read_text(path, MAX_MODEL_BYTES, UTF8_SIG).splitlines())
    except OSError as problem:
        raise CaptureError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    except UnicodeDecodeError as problem:
        raise CaptureError(f"{path} is not UTF-8 text; export the model again.") from problem


class _ByteReader:
    """Reads a binary file from front to back; raises CaptureError where it ends too early."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path, MAX_MODEL_BYTES)
        self.offset = 0

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """Unpack little-endian values by `struct` layout."""
        size = struct.calcsize("<" + layout)
        self.require(size)
        values = struct.unpack_from("<" + layout, self.data, self.offset)
        self.offset += size
        return values

    def read_count(self, record_size: int) -> int:
        """Read a 64 bit count of records of at least `record_size` bytes each."""
        number: int = self.unpack("Q")[0]
        self.require(number * record_size)
        return number

    def skip(self, size: int) -> None:
        self.require(size)
        self.offset += size

    def read_name(self) -> str:
        """Read a name that a zero byte ends."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            self.require(len(self.data) + 1)
        text = self.data[self.offset:end].decode("utf-8")
        self.offset = end + 1
        return text

    def require(self, size: int) -> None:
        if self.offset + size > len(self.data):
            raise CaptureError(f"{self.path} is truncated or damaged (it ends after {len(self.data)} bytes); "
                               "copy or export it again.")


def _read_cameras_bin(file: _ByteReader) -> dict[int, Lens]:
    """Return the lenses of a cameras.bin by camera number. Raises CaptureError."""
    lenses: dict[int, Lens] = {}
    for _ in range(file.read_count(24)):  # bytes of a camera without its parameters
        camera_id, model_number, width, height = file.unpack("iiQQ")
        if model_number not in MODEL_NAMES:
            raise CaptureError(f"{file.path} has a camera of model {model_number}, which this program does not know; "
                               "solve the cameras again with another model (OPENCV, for instance).")
        model = MODEL_NAMES[model_number]
        params = file.unpack("d" * len(MODELS[model][1]))
        _add_lens(lenses, file.path, camera_id, Lens(model, params, width, height))
    return lenses


def _read_cameras_txt(path: Path, lines: list[str]) -> dict[int, Lens]:
    """Return the lenses of a cameras.txt by camera number. Raises CaptureError."""
    lenses: dict[int, Lens] = {}
    for line_number, line in _data_lines(lines):
        fields = line.split()
        model = fields[1] if len(fields) > 1 else ""
        if model not in MODELS:
            raise CaptureError(f"{path}, line {line_number}: {model!r} is no camera model this program knows; solve "
                               "the cameras again with another (OPENCV, for instance).")
        if len(fields) < 4:
            raise CaptureError(f"{path}, line {line_number}: a camera takes at least four values (number, model, "
                               f"width, height), not {len(fields)}; export the model again.")
        camera_id, width, height, *params = _parse_numbers(path, line_number, [fields[0], *fields[2:]], "iii")
        if len(params) != len(MODELS[model][1]):
            raise CaptureError(f"{path}, line {line_number}: {model} takes {len(MODELS[model][1])} parameters "
                               f"({' '.join(MODELS[model][1])}), not {len(params)}; export the model again.")
        _add_lens(lenses, path, camera_id, Lens(model, tuple(params), width, height))
    return lenses


def _add_lens(lenses: dict[int, Lens], path: Path, camera: int, lens: Lens) -> None:
    if camera in lenses:
        raise CaptureError(f"{path} has two cameras with the number {camera}; export the model again.")
    lenses[camera] = check_lens(lens, f"{path}, camera {camera}:")


Image = tuple[str, int, tuple[float, ...], tuple[float, ...], NDArray[np.int64]]
"""Name, camera, quaternion, translation, and the ids of the points observed in it."""
_ANNOUNCED = re.compile(r"#\s*Number of images:\s*(\d{1,9})\b")
"""Comment at the head of an images.txt."""
_MAX_NAME_WORDS = 60
"""Words of a picture's name; a line with more is one of 2D points."""
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def _read_images_bin(file: _ByteReader) -> list[Image]:
    """Return the images of an images.bin. Raises CaptureError."""
    images: list[Image] = []
    for _ in range(file.read_count(73)):  # bytes of an image without its name and observations
        _, *pose, camera_id = file.unpack("idddddddi")
        name = file.read_name()
        count = file.read_count(_POINT2D.itemsize)
        point_ids = np.frombuffer(file.data, _POINT2D, count, file.offset)["point"]
        file.skip(count * _POINT2D.itemsize)
        images.append((name, camera_id, tuple(pose[:4]), tuple(pose[4:]), point_ids))
    return images


def _read_images_txt(path: Path, lines: list[str]) -> list[Image]:
    """Return the images of an images.txt, which has a line for each image and a line of its 2D points, perhaps missing.

    Raises CaptureError.
    """
    images: list[Image] = []
    for line_number, line, points_line in image_lines(lines):
        fields = line.split(maxsplit=9)
        if len(fields) < 10:
            raise CaptureError(f"{path}, line {line_number}: an image takes ten values (number, quaternion, "
                               f"translation, camera, name), not {len(fields)}; export the model again.")
        _, *pose, camera_id = _parse_numbers(path, line_number, fields[:9], "iqqqqtttc")
        images.append((fields[9].strip(), camera_id, tuple(pose[:4]), tuple(pose[4:]), _parse_point_ids(points_line)))
    announced = next((int(match[1]) for line in lines[:8] if (match := _ANNOUNCED.match(line))), len(images))
    if len(images) < announced:
        raise CaptureError(f"{path} is truncated: it announces {announced} images and has {len(images)}; export the "
                           "model again.")
    return images


def image_lines(lines: Sequence[str]) -> list[tuple[int, str, str]]:
    """Return (line number from 1, line, line of 2D points or "") of each image of an images.txt.

    COLMAP writes a line of points after each image, which is empty where there are none. Other programs leave these
    lines out; so does an editor that drops empty lines.
    """
    images: list[tuple[int, str, str]] = []
    index = 0
    while index < len(lines):
        line = lines[index]
        index += 1
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        line_number, points_line = index, ""
        if index < len(lines) and len(lines[index].split()) % 3 == 0 and not _is_image(lines[index]):
            points_line = lines[index]
            index += 1
        images.append((line_number, line, points_line))
    return images


def _is_image(line: str) -> bool:
    """Return whether a line has ten fields, the last of which is a name. A line of 2D points has numbers in threes."""
    fields = line.split(maxsplit=9)
    if len(fields) < 10:
        return False
    name_fields = fields[9].split(maxsplit=_MAX_NAME_WORDS)
    if not _are_numbers(fields[:9]) or len(name_fields) > _MAX_NAME_WORDS:
        return False
    return bool((len(name_fields) + 9) % 3) or not _are_numbers(name_fields)


def _are_numbers(fields: Sequence[str]) -> bool:
    try:
        return all(math.isfinite(float(text)) for text in fields)
    except ValueError:
        return False


def _parse_point_ids(line: str) -> NDArray[np.int64]:
    """Parse the point ids of x, y, id, x, y, id, ...; none where the line is invalid: ids are optional."""
    try:
        return np.array([int(text) for text in line.split()[2::3]], np.int64)
    except (ValueError, OverflowError):
        return np.zeros(0, np.int64)


Points = tuple[PointCloud, NDArray[np.int64]]
"""The cloud, and the id of each point."""


_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
"""A point of points3D.bin, before its track of 8 bytes an entry."""
_POINTS_PER_STEP = 1 << 13
_TRACK_AT = 43
"""Offset of the length of the track in a point, bytes."""
_TRACK_LENGTH = struct.Struct("<Q")


def _read_points_bin(file: _ByteReader) -> Steps[Points]:
    """Return the points of a points3D.bin and their ids, in steps (a generator). Raises CaptureError.

    A point's track has any length, so a first pass finds the byte where each point starts; a second pass reads the
    points in blocks.
    """
    number = file.read_count(_POINT.itemsize)
    data, offset, last_start = file.data, file.offset, len(file.data) - _POINT.itemsize
    starts = np.empty(number, np.int64)
    for i in range(number):
        if i % _POINTS_PER_STEP == 0:
            yield
        if offset > last_start:
            file.require(len(data) + 1)  # raises
        starts[i] = offset
        offset += _POINT.itemsize + 8 * _TRACK_LENGTH.unpack_from(data, offset + _TRACK_AT)[0]
    file.offset = min(offset, len(data))
    file.require(offset - file.offset)  # raises where the last track would end behind the file
    points, data_bytes = np.empty(number, _POINT), np.frombuffer(data, np.uint8)
    for first in range(0, number, _POINTS_PER_STEP):
        yield
        byte_indices = starts[first:first + _POINTS_PER_STEP, None] + np.arange(_POINT.itemsize)
        points[first:first + len(byte_indices)] = data_bytes[byte_indices].view(_POINT)[:, 0]
    yield
    values = np.concatenate([points["xyz"], points["error"][:, None]], 1)
    return _to_cloud(file.path, values, points["rgb"].copy()), points["id"].copy()


def _read_points_txt(path: Path, lines: list[str]) -> Points:
    """Return the points of a points3D.txt and their ids. Raises CaptureError."""
    values, rgb, point_ids = [], [], []
    for line_number, line in _data_lines(lines):
        fields = line.split(maxsplit=8)
        if len(fields) < 8:
            raise CaptureError(f"{path}, line {line_number}: a point takes at least eight values, not {len(fields)}; "
                               "export the model again.")
        point_id, x, y, z, *colour, error = _parse_numbers(path, line_number, fields[:8], "ixyziiie")
        if not all(0 <= c <= 255 for c in colour):
            raise CaptureError(f"{path}, line {line_number}: the colour {colour} is not within 0 to 255; export the "
                               "model again.")
        values.append((x, y, z, error))
        rgb.append(colour)
        point_ids.append(point_id if abs(point_id) < 2**63 else 0)  # one beyond int64 loses its observations
    cloud = _to_cloud(path, np.array(values, np.float64).reshape(-1, 4), np.array(rgb, np.uint8).reshape(-1, 3))
    return cloud, np.array(point_ids, np.int64)


def _to_cloud(path: Path, values: Floats, rgb: NDArray[np.uint8]) -> PointCloud:
    if not np.isfinite(values[:, :3]).all() or (np.abs(values[:, :3]) > _MAX_COORDINATE).any():
        raise CaptureError(f"{path} has points that are not finite numbers; solve the cameras again.")
    error = np.where(np.isfinite(values[:, 3]), np.clip(values[:, 3], 0.0, _MAX_COORDINATE), 0.0)
    return PointCloud(values[:, :3].astype(np.float32), rgb, error.astype(np.float32))


def _data_lines(lines: list[str]) -> list[tuple[int, str]]:
    """Return (line number from 1, line) of the lines that are neither empty nor comments."""
    return [(number, line) for number, line in enumerate(lines, 1)
            if line.strip() and not line.lstrip().startswith("#")]


def _parse_numbers(path: Path, line_number: int, fields: list[str], kinds: str) -> list[Any]:
    """Parse fields of a line, for which `kinds` has a letter each: i and c are integers, all others floats.

    Fields past the end of `kinds` are floats. Raises CaptureError.
    """
    try:
        return [int(text) if kinds[i:i + 1] in ("i", "c") else float(text) for i, text in enumerate(fields)]
    except ValueError as problem:
        raise CaptureError(f"{path}, line {line_number}: {problem}; export the model again.") from problem
