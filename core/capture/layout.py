# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the camera solve and the folder of the frames in a capture, where neighbouring programs put them.

COLMAP and its front ends write `sparse/0`, `sparse/1`, ... (one model for each part of the footage that it could
connect), `sparse` or `colmap/sparse/0`; RealityCapture writes the three text files beside the frames. Names are found
in any case of letters. `capture.py` reads what this module finds.
"""
from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..errors import CaptureError
from ..images.video import is_video
from ..system.file_names import find_entry, natural_key
from ..system.reading import MAX_MODEL_BYTES, UTF8_SIG, open_regular, read_text
from .colmap import image_lines

MODEL_PLACES = (".", "sparse", "sparse/*")
"""Folders of a COLMAP model whose world is that of the capture, whatever else lies beside it; * stands for a number."""
LATER_MODEL_PLACES = ("colmap", "colmap/*", "colmap/sparse", "colmap/sparse/*")
"""Folders of a COLMAP model that counts where there is no transforms.json."""
_MAX_DEPTH, _MAX_FOLDERS = 3, 200
"""Levels of folders, and folders of a level, that are searched for a model in another place."""
_MIN_IMAGE_BYTES = 73
"""Bytes of an image in images.bin, without its name and observations."""


def check_is_folder(folder: Path) -> None:
    """Raise CaptureError, which says what to do, for a capture that is a video, another file, or missing."""
    if folder.is_file() and is_video(folder):
        raise CaptureError(f"{folder} is a video; make a capture of it by `solve {folder.name} --out my_capture`, and "
                           "name that.")
    if not folder.is_dir():
        raise CaptureError(f"{folder} is {'no folder' if folder.exists() else 'missing'}; name a capture's folder.")


def find_models(folder: Path, places: Iterable[str] = MODEL_PLACES) -> list[Path]:
    """Return the folders of the COLMAP models of a capture: place after place, numbered ones in natural order.

    places: paths relative to `folder`, of which a last part * stands for all numbered folders.
    """
    models: list[Path] = []
    for place in places:
        parent = find_entry(folder, place.removesuffix("/*"))
        if parent is None or not parent.is_dir():
            continue
        if place.endswith("/*"):
            children = sorted((child for child in parent.iterdir() if child.name.isdecimal()), key=natural_key)
        else:
            children = [parent]
        models += [child for child in children if is_model(child) and child not in models]
    return models


def find_model(folder: Path, places: Iterable[str] = MODEL_PLACES) -> Path | None:
    """Return the folder of the COLMAP model that a capture uses, or None."""
    return choose_model(find_models(folder, places), folder)[0]


def find_deeper_model(folder: Path) -> Path | None:
    """Return the folder of a COLMAP model that lies elsewhere below a capture, as in dense/0/sparse; None without
    one."""
    places = [folder]
    for _ in range(_MAX_DEPTH):
        places = [child for place in places for child in _subfolders(place)][:_MAX_FOLDERS]
        for place in places:
            if is_model(place):
                return place
    return None


def _subfolders(folder: Path) -> list[Path]:
    try:
        return [child for child in sorted(folder.iterdir(), key=natural_key) if child.is_dir()
                and not child.is_symlink()]
    except OSError:
        return []


def is_model(folder: Path) -> bool:
    """Return whether a folder has the cameras of a COLMAP model."""
    return any((cameras := find_entry(folder, f"cameras{suffix}")) is not None and cameras.is_file()
               for suffix in (".bin", ".txt"))


def count_images(model: Path) -> int:
    """Return the number of images of a model; 0 where that cannot be read."""
    try:
        binary = find_entry(model, "images.bin")
        if binary is not None and binary.is_file():
            with open_regular(binary) as stream:
                number = int(struct.unpack("<Q", stream.read(8))[0])
            # More images than the file has room for: it is damaged.
            return number if number * _MIN_IMAGE_BYTES < binary.stat().st_size else 0
        text = find_entry(model, "images.txt")
        return 0 if text is None else len(image_lines(read_text(text, MAX_MODEL_BYTES, UTF8_SIG).splitlines()))
    except (OSError, ValueError, struct.error):
        return 0


def choose_model(models: Sequence[Path], folder: Path) -> tuple[Path | None, str]:
    """Return the model with the most images, the first of equal ones, and a warning where there are several, else "".

    None and "" for no models.
    """
    if len(models) < 2:
        return (models[0] if models else None), ""
    counts = {model: count_images(model) for model in models}
    chosen = max(models, key=lambda model: counts[model])
    others = ", ".join(f"{_relative(model, folder)} {counts[model]}" for model in models if model != chosen)
    return chosen, (f"The camera solve of {folder} has {len(models)} models: {_relative(chosen, folder)} with "
                    f"{counts[chosen]} frames is used, the others are left out (frames: {others}).")


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def frames_folder(folder: Path, model: Path) -> Path:
    """Return the folder that the names of a model's images start from.

    It is images/ in the capture, in the model's folder or in one of the two folders above the model, the first that
    exists. Without any: the capture's folder where the model lies in it directly, else its images/, which is missing.
    """
    for parent in (folder, model, model.parent, model.parent.parent):
        if parent.is_relative_to(folder):
            images = find_entry(parent, "images")
            if images is not None and images.is_dir():
                return images
    return model if model == folder else folder / "images"
