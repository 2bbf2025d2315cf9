# SPDX-License-Identifier: GPL-3.0-or-later
"""Extracts the frames of videos into folders, so that `remove` can clean them like any shot."""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ...errors import FrameError, SettingsError, join_failures
from ...images.video import Video, frame_to_display, is_video, truncated_message
from ...images.write import write_png
from ...system.files import atomic_folder, content_hash, read_json, write_json
from ...system.progress import Progress

VIDEO_MANIFEST = "video.json"
"""The file in the folder of a video's frames that says which video they are of."""


def expand_videos(inputs: Iterable[Path], folder: Path, progress: Progress) -> tuple[list[Path], list[str]]:
    """Return `inputs` with each video replaced by the folder of its frames below `folder`, and messages about videos
    that cannot be read. Raises FrameError if no input is left."""
    paths, failures = list[Path](), list[str]()
    for path in inputs:
        try:
            paths.append(extract_frames(path, folder, progress) if path.is_file() and is_video(path) else path)
        except FrameError as problem:
            failures.append(str(problem))
    if failures and not paths:
        raise FrameError(join_failures(failures))
    return paths, failures


def extract_frames(video: Path, folder: Path, progress: Progress) -> Path:
    """Return the folder NAME.frames below `folder` with a video's frames as 8 bit PNGs, STEM.000001.png and on, upright
    and in the colours that players show. Frames that exist already are kept.

    Raises FrameError for a video without a readable frame, SettingsError where the folder holds frames of another
    video.
    """
    frames, content = folder / f"{video.name}.frames", content_hash(video)
    if not frames.exists():
        try:
            with atomic_folder(frames) as temporary:
                _decode_frames(video, temporary, progress)
                write_json(temporary / VIDEO_MANIFEST, {"content": content})
        except OSError:
            if not frames.exists():  # another task of a farm may have extracted them meanwhile
                raise
    if read_json(frames / VIDEO_MANIFEST, SettingsError).get("content") != content:
        raise SettingsError(f"{frames} holds the frames of another video of that name; choose another folder for the "
                            "clean frames, or delete it.")
    return frames


def _decode_frames(video: Path, folder: Path, progress: Progress) -> None:
    with Video(video) as reader:
        progress.stage(f"extract the frames of {video.name}", reader.length)
        for sentence in reader.warnings:
            progress.say(sentence)
        number = 0
        for number, frame in enumerate(reader, 1):
            write_png(folder / f"{video.stem}.{number:06d}.png", frame_to_display(frame))
            progress.advance()
    if number == 0:
        raise FrameError(f"{video} has no frame that can be read; copy it again, or convert it to MP4 (H.264).")
    if number < reader.length:
        progress.say(truncated_message(video, reader.length, number))
