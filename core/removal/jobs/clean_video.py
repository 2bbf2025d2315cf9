# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes a video of clean frames, with sound and metadata of the source video.

`headless/commands/remove.py` calls it for `--out NAME.mov`: `frames_folder` names where the clean frames lie, and
`write_clean_video` writes the video once all of them are there, so that the tasks of a farm need no order.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FrameError, SettingsError
from ...images.listing import pictures_in
from ...images.read import read_picture
from ...images.video import Video, VideoFrame, is_video
from ...images.video_writer import check_target, choose_codec, rewrite_video
from ...system.files import content_hash, read_json, real_path, write_json
from ...system.progress import Progress
from .manifest import digest_inputs

RECORD = "clean_video.json"
"""The file beside the clean frames that says which video was written of them."""


def require_single_video(inputs: Sequence[Path], target: Path, codec: str | None) -> Path:
    """Return the video among `inputs` that is to be cleaned to `target`.

    codec: name of the codec; None to choose one that suits. Raises SettingsError for anything but one video, and for a
    target that cannot be written with this codec.
    """
    check_target(target, codec)
    if len(inputs) != 1 or not is_video(inputs[0]) or not inputs[0].is_file():
        raise SettingsError(f"--out {target} is a video, so one video has to be cleaned; name a folder for the clean "
                            "frames of anything else.")
    if real_path(inputs[0]) == real_path(target):
        raise SettingsError(f"{target} is the video itself; choose another name for the clean one.")
    return inputs[0]


def frames_folder(target: Path) -> Path:
    """Return the folder of the clean frames of a video: NAME.frames beside NAME.mov."""
    return target.with_suffix(".frames")


def write_clean_video(source: Path, target: Path, codec: str | None, progress: Progress, *,
                      overwrite: bool = False) -> bool:
    """Write the clean frames in `frames_folder` as a video; False while some are missing, else True.

    codec: name of the codec; None to choose one that suits source and target. A video that was written from the same
    frames with the same codec is kept. Raises SettingsError where the target exists and was not written here, unless
    `overwrite`, and FrameError where it cannot be written.
    """
    folder = frames_folder(target)
    extracted = {path.stem: path for path in pictures_in(folder / f"{source.name}.frames")}
    clean_files = [folder / path.name for path in extracted.values()]
    if missing := sum(not path.is_file() for path in clean_files):
        progress.say(f"{missing} of {len(clean_files)} frames are not clean yet; {target} is written when all are.")
        return False
    with Video(source) as video:
        codec_name = choose_codec(target, video, codec)
    digest = digest_inputs(codec_name, [source, *clean_files])
    record = _read_record(folder / RECORD)
    if target.exists() and not overwrite and _is_up_to_date(target, record, digest):
        progress.say(f"{target} is up to date; --overwrite makes it again.")
        return True
    progress.stage(f"write {target.name}", len(clean_files))
    for message in rewrite_video(source, target, codec_name, partial(_changed_pixels, source, folder, extracted),
                                 on_frame=progress.advance,
                                 on_written=partial(_write_record, folder / RECORD, digest, target)):
        progress.say(message)
    progress.say(f"The clean video is {target}.")
    return True


def _changed_pixels(source: Path, folder: Path, extracted: Mapping[str, Path],
                    frame: VideoFrame) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Return the pixels of a frame of the video `source` as extracted and as cleaned; None where they are the same.

    folder: holds the clean frames. extracted: paths of the extracted frames, by the stems of their names. Raises
    FrameError for a frame that is not among `extracted`.
    """
    stem = f"{source.stem}.{frame.number + 1:06d}"
    if stem not in extracted:
        raise FrameError(f"{folder / stem} is missing among the frames of {source}; delete {folder} and clean it "
                         "again.")
    before, after = read_picture(extracted[stem]), read_picture(folder / extracted[stem].name)
    return None if np.array_equal(before.pixels, after.pixels) else (before.pixels, after.pixels)


def _write_record(path: Path, digest: str, target: Path, finished: Path) -> None:
    """Record the content hashes of the finished video and of the one that it replaces.

    digest: hash of what the video was made from. finished: the video under its temporary name. Called before the video
    is renamed to `target`: if the process is killed in between, neither file is mistaken for someone's work.
    """
    replaced = {"replaced": content_hash(target)} if target.exists() else {}
    write_json(path, {"from": digest, "written": content_hash(finished), **replaced})


def _is_up_to_date(target: Path, record: Mapping[str, object], digest: str) -> bool:
    """Return whether the existing video was made from the inputs that `digest` was computed from. Raises SettingsError
    where the record does not name the existing file."""
    existing_hash = content_hash(target)
    if existing_hash not in (record.get("written"), record.get("replaced")):
        raise SettingsError(f"{target} exists and was not made from these frames, so it may be someone's work; "
                            "choose another name, or replace it with --overwrite.")
    return record.get("from") == digest and record.get("written") == existing_hash


def _read_record(path: Path) -> dict[str, object]:
    """Read the record of the video that was written; {} if there is none. Raises SettingsError if it is damaged."""
    record = read_json(path, SettingsError) if path.is_file() else {}
    if not isinstance(record, dict):
        raise SettingsError(f"{path} is damaged; delete it, and write the video again with --overwrite.")
    return record
