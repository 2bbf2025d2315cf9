# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos as plates: their frames, taken out once into a folder of their own."""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ...errors import FrameError, SettingsError, spelled_out
from ...images.video import Video, displayed, is_video, told_short
from ...images.write import write_png
from ...system.files import atomic_folder, content_of, read_json, write_json
from ...system.progress import Progress

RECORD = "video.json"
"""In the folder of a video's frames, of which video they are."""


def with_frames(inputs: Iterable[Path], folder: Path, progress: Progress) -> tuple[list[Path], list[str]]:
    """`inputs` with each video replaced by the folder of its frames, below `folder`; what is to be said of videos that
    cannot be read, which are left out. Raises FrameError where nothing else was given."""
    found, left_out = list[Path](), list[str]()
    for given in inputs:
        try:
            found.append(frames_of(given, folder, progress) if given.is_file() and is_video(given) else given)
        except FrameError as problem:
            left_out.append(str(problem))
    if left_out and not found:
        raise FrameError(spelled_out(left_out))
    return found, left_out


def frames_of(video: Path, folder: Path, progress: Progress) -> Path:
    """The folder NAME.frames below `folder` with a video's frames as 8 bit PNGs, STEM.000001.png and on, upright and in
    the colours that players show. Where they are there already they are taken as they are.

    Raises FrameError for a video without a frame that can be read, SettingsError where the folder is of another one.
    """
    frames, content = folder / f"{video.name}.frames", content_of(video)
    if not frames.exists():
        try:
            with atomic_folder(frames) as temporary:
                _take_out(video, temporary, progress)
                write_json(temporary / RECORD, {"content": content})
        except OSError:
            if not frames.exists():  # another task of a farm may have made it meanwhile
                raise
    if read_json(frames / RECORD, SettingsError).get("content") != content:
        raise SettingsError(f"{frames} holds the frames of another video of that name; choose another folder for the "
                            "clean plates, or remove it.")
    return frames


def _take_out(video: Path, folder: Path, progress: Progress) -> None:
    with Video(video) as clip:
        progress.stage(f"take the frames out of {video.name}", clip.length)
        for sentence in clip.says:
            progress.say(sentence)
        number = 0
        for number, frame in enumerate(clip, 1):
            write_png(folder / f"{video.stem}.{number:06d}.png", displayed(frame))
            progress.advance()
    if number == 0:
        raise FrameError(f"{video} has no frame that can be read; copy it again, or convert it to MP4 (H.264).")
    if number < clip.length:
        progress.say(told_short(video, clip.length, number))
