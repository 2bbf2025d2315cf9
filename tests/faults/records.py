# SPDX-License-Identifier: GPL-3.0-or-later
"""Small records and settings that users write and commands leave beside their results, for `fuzz.py` to damage."""
from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from core.capture.nuke_camera import read_nuke_camera
from core.capture.plate_space import read_plate_space
from core.capture.solve import _read_report
from core.capture.solve.source_frames import read_record
from core.capture.unsolved import cameras_without_solve
from core.errors import CaptureError, SettingsError
from core.fit.traced_settings import TracedFlareSettings
from core.images.write import write_png
from core.lights.file import check_replaceable, write_lights
from core.optics.prescription import read_prescription
from core.removal.jobs.clean_video import frames_folder, write_clean_video
from core.removal.jobs.video_frames import extract_frames
from core.system.progress import Progress
from core.system.reading import parse_toml, read_text
from tests.core.videos import stripes, write_video
from tests.faults.media import Medium

LENS = "50 4 1.6 55 30\n-200 1 1 0 30\nstop 3 1 0 18\n-60 2 1.7 30 24\n60 4 1.6 60 24\n-40 40 1 0 24\n"
NUKE = ("push 0\nCamera2 {\n inputs 0\n rot_order ZXY\n translate {{curve i x1 0 0.1 0.2} 1 5}\n rotate {"
        "{curve x1 1 2 3} {curve x1 20 21 22} 0}\n focal {{curve x1 35 35 36}}\n haperture 24.576\n name cam\n}\n")
LIGHTS = {"lights": [{"name": "lamp", "xyz": [1.0, 2.0, 3.0], "score": 0.5, "uncertainty": 0.1}], "found": [[1, 2, 3]]}
FRAMES = {"stills": [{"name": "0001.png", "file": "/f/0001.png", "width": 64, "height": 48, "focal": 1.2,
                      "orientation": 1, "space": "", "config": None}], "left_out": ["0002.png is damaged"]}


def records() -> Iterator[Medium]:
    """Yield the formats of small text files: records that the program writes, settings, lenses and cameras."""
    def text(content: object) -> str:
        return content if isinstance(content, str) else json.dumps(content)

    for file, content, read in (
            ("plate_space.json", {"space": "logc4", "ocio": None}, lambda path: read_plate_space(path.parent)),
            ("solve.json", {"request": {"a": [1]}, "frames": 8}, lambda path: _read_report(path.parent)),
            ("stills.json", FRAMES, lambda path: read_record(path.parent)),
            ("lens.lens", LENS, read_prescription), ("camera.nk", NUKE, read_nuke_camera),
            ("camera.chan", "1 0 1 5 0 20 0 40\n2 0.1 1 5 0 21 0 40\n", read_nuke_camera),
            ("found.json", LIGHTS, _write_lights_again)):
        yield Medium(file, file, lambda path, content=content: path.write_text(text(content)), read)  # type: ignore[misc]
    yield Medium("make-flare settings", "settings.toml", lambda path: path.write_text(
        'sensor = 24.0\nrings = [{gain = 0.1}]\n[iris]\nblades = 5\nrotation = 3.0\n[fit]\niterations = 10\n'),
        _read_settings)
    yield Medium("camera.json", "camera.json", _write_camera, lambda path: cameras_without_solve(path.parent))
    yield Medium("clean_video.json", "out.frames/clean_video.json", _write_clean_video, _write_video_again)
    yield Medium("video.json", "out.frames/film.mkv.frames/video.json", _write_clean_video, lambda path: extract_frames(
        path.parents[2] / "film.mkv", path.parents[1], Progress()))


def _write_lights_again(path: Path) -> None:
    with contextlib.suppress(CaptureError):  # the valid one was changed by hand
        check_replaceable(path)
    data = path.read_bytes()
    try:
        write_lights(path, [], [], keep=True)
    finally:
        path.write_bytes(data)


def _read_settings(path: Path) -> None:
    """Read a TOML file of settings and apply them, as `make-flare --settings` does."""
    try:
        tables = parse_toml(read_text(path))
    except ValueError as problem:
        raise SettingsError(str(problem)) from problem
    TracedFlareSettings().override({
        f"{table}.{name}" if isinstance(part, dict) else table: value for table, part in tables.items()
        for name, value in (part.items() if isinstance(part, dict) else (("", part),))})


def _write_camera(path: Path) -> None:
    write_png(path.parent / "images" / "0001.png", np.zeros((8, 12, 3)))
    path.write_text('{"focal_px": 400.0, "width": 480}')


def _write_clean_video(path: Path) -> None:
    """Write film.mkv, its clean frames and out.mkv into the folder whose record is `path`."""
    base = next(parent for parent in path.parents if parent.name.startswith(("clean", "video")))
    film = write_video(base / "film.mkv", "ffv1", "yuv444p", [stripes(32, 48)])
    filmed = extract_frames(film, frames_folder(base / "out.mkv"), Progress())
    write_png(filmed.parent / "film.000001.png", np.zeros((32, 48, 3)))
    write_clean_video(film, base / "out.mkv", None, Progress())


def _write_video_again(path: Path) -> None:
    base, data = path.parents[1], path.read_bytes()
    try:
        write_clean_video(base / "film.mkv", base / "out.mkv", None, Progress())
    finally:
        path.write_bytes(data)
