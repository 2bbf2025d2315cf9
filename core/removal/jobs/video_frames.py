# SPDX-License-Identifier: GPL-3.0-or-later
"""Extracts the frames of videos into folders, so that `remove` can clean them like any shot.

`headless/commands/remove.py` calls `expand_videos`; `clean_video.py` writes a video of the clean frames.
"""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...errors import FrameError, SettingsError, join_failures
from ...images.video import Video, is_video, write_frame
from ...system.files import atomic_folder, content_hash, read_json, write_json
from ...system.progress import Progress

VIDEO_MANIFEST = "video.json"
"""The file in the folder of a video's frames that says which video they are of, and what is wrong with it."""


def expand_videos(inputs: Iterable[Path], folder: Path, progress: Progress,
                  space: str | None = None) -> tuple[list[Path], list[str]]:
    """Return `inputs` with each video replaced by the folder of its frames below `folder`, and messages about videos
    that cannot be read. space: the colour space that the user names for the plates; None for what they declare.

    Raises FrameError if no input is left.
    """
    paths, failures = list[Path](), list[str]()
    for path in inputs:
        try:
            paths.append(extract_frames(path, folder, progress, space) if path.is_file() and is_video(path) else path)
        except FrameError as problem:
            failures.append(str(problem))
    if failures and not paths:
        raise FrameError(join_failures(failures))
    return paths, failures


def extract_frames(video: Path, folder: Path, progress: Progress, space: str | None = None) -> Path:
    """Write a video's frames to NAME.frames below `folder`, unless that exists, and return it.

    The files are STEM.000001 and on: PNGs of 8 bits, or of 16 where the video has more, in the colours that players
    show; EXRs of linear light for PQ and HLG. Alpha is kept. Problems of the video are printed, also when its frames
    exist already. space: the colour space that the user names for the plates; None for what the video declares.

    Raises FrameError for a video without a readable frame and for one whose own colours exclude the named space,
    SettingsError where the folder holds frames of another video.
    """
    if space is not None:
        with Video(video) as reader:
            reader.check_named_space(space)
    frames_folder, video_hash = folder / f"{video.name}.frames", content_hash(video)
    if not frames_folder.exists():
        try:
            with atomic_folder(frames_folder) as temporary:
                write_json(temporary / VIDEO_MANIFEST,
                           {"content": video_hash, "problems": _decode_frames(video, temporary, progress)})
        except OSError:
            if not frames_folder.exists():  # another task of a farm may have extracted them meanwhile
                raise
    manifest: Any = read_json(frames_folder / VIDEO_MANIFEST, SettingsError)
    problems = manifest.get("problems", []) if isinstance(manifest, dict) else None
    if not isinstance(problems, list):
        raise SettingsError(f"{frames_folder / VIDEO_MANIFEST} is damaged; delete {frames_folder}, and the frames are "
                            "extracted again.")
    if manifest.get("content") != video_hash:
        raise SettingsError(f"{frames_folder} holds the frames of another video of that name; choose another folder "
                            "for the clean frames, or delete it.")
    for problem in problems:
        progress.say(str(problem))
    return frames_folder


def _decode_frames(video: Path, folder: Path, progress: Progress) -> list[str]:
    """Write all frames, and return sentences about missing and damaged frames."""
    with Video(video) as reader:
        progress.stage(f"extract the frames of {video.name}", reader.estimated_length)
        count = 0
        for frame in reader:
            write_frame(folder / f"{video.stem}.{frame.number + 1:06d}", frame)
            count += 1
            progress.advance()
    if count == 0:
        raise FrameError(f"{video} has no frame that can be read; copy it again, or convert it to MP4 (H.264).")
    return reader.problems
