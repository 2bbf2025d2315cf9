# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos in `remove`: their frames are extracted once, and what is missing is said."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from core.errors import Cancelled, FrameError, SettingsError
from core.images.read import read_picture
from core.images.video import Video
from core.removal.jobs.video_frames import expand_videos, extract_frames
from core.system.progress import Progress
from tests.core.recording_progress import RecordingProgress
from tests.core.videos import PATCHES, X265, middles, stripes, write_video

LOSSLESS = {"qp": "0", "preset": "ultrafast"}


def clip_of(path: Path, height: int = 64, frames: int = 3) -> Path:
    return write_video(path, "libx264", "yuv444p", [stripes(height) * (1 - 0.1 * n) for n in range(frames)],
                       options=LOSSLESS, matrix=6)


def test_the_frames_of_a_video_are_extracted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip, out = clip_of(tmp_path / "clip.mp4"), tmp_path / "out"
    frames = extract_frames(clip, out, Progress())
    assert frames == out / "clip.mp4.frames"
    assert sorted(path.name for path in frames.glob("*.png")) == [f"clip.{number:06d}.png" for number in (1, 2, 3)]
    first = cv2.imread(str(frames / "clip.000001.png"), cv2.IMREAD_UNCHANGED)
    assert first.dtype == np.uint8 and np.abs(middles(first)[:, ::-1] - PATCHES.astype(int)).max() <= 1
    with Video(clip) as again:
        assert np.array_equal(first[..., ::-1], next(iter(again)).pixels())
    with monkeypatch.context() as patch:
        patch.setattr("core.removal.jobs.video_frames._decode_frames", lambda *_: pytest.fail("they are there"))
        assert extract_frames(clip, out, Progress()) == frames
    clip_of(clip, 96)
    with pytest.raises(SettingsError, match=r"another video of that name"):
        extract_frames(clip, out, Progress())


def test_deep_video_is_extracted_to_16_bits_and_high_dynamic_range_to_light(tmp_path: Path) -> None:
    deep = write_video(tmp_path / "deep.mkv", "ffv1", "yuv444p10le", [stripes(64)], tags=(1, 1, 1))
    stored = cv2.imread(str(extract_frames(deep, tmp_path, Progress()) / "deep.000001.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16 and np.abs(middles(stored)[:, ::-1] / 257 - PATCHES).max() <= 0.5
    bright = write_video(tmp_path / "bright.mkv", "libx265", "yuv420p10le", [stripes(64)], matrix=9, tags=(9, 16, 9),
                         options=X265)
    picture = read_picture(extract_frames(bright, tmp_path, Progress()) / "bright.000001.exr")
    with Video(bright) as video:
        light = next(iter(video)).pixels()
    assert picture.encoding == "linear" and light.max() > 5
    assert np.abs(picture.pixels - light).max() <= light.max() / 2048


def test_frames_that_another_task_has_extracted_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip, out = clip_of(tmp_path / "clip.mp4"), tmp_path / "out"
    other = extract_frames(clip, tmp_path / "other", Progress())
    monkeypatch.setattr("core.removal.jobs.video_frames._decode_frames",
                        lambda *_: other.rename(out / other.name) and [])
    assert len(list(extract_frames(clip, out, Progress()).glob("*.png"))) == 3


def test_missing_frames_of_a_video_are_reported_each_time(tmp_path: Path) -> None:
    noise = [np.random.default_rng(n).random((48, 64, 3)) for n in range(4)]
    clip = write_video(tmp_path / "clip.avi", "mjpeg", "yuvj420p", noise, full=True)
    whole = clip.read_bytes()
    heard = RecordingProgress()
    extract_frames(clip, tmp_path / "whole", heard)
    assert not heard.texts
    clip.write_bytes(whole[:len(whole) * 6 // 10])
    for count in (1, 2):
        extract_frames(clip, tmp_path / "cut", heard)
        assert len([sentence for sentence in heard.texts if "promises 4 frames" in sentence]) == count


def test_an_unreadable_or_cancelled_video_leaves_no_frames(tmp_path: Path) -> None:
    (tmp_path / "empty.mov").touch()
    clip, out = clip_of(tmp_path / "clip.mp4"), tmp_path / "out"
    stopped = Progress()
    stopped.request_stop()
    with pytest.raises(Cancelled):
        extract_frames(clip, out, stopped)
    with pytest.raises(FrameError, match=r"empty\.mov cannot be decoded"):
        extract_frames(tmp_path / "empty.mov", out, Progress())
    assert list(out.iterdir()) == []
    given = [tmp_path / "empty.mov", clip, tmp_path / "plate.png"]
    plates, left_out = expand_videos(given, out, Progress())
    assert plates == [out / "clip.mp4.frames", given[2]]
    assert len(left_out) == 1 and left_out[0].startswith(f"{given[0]} cannot be decoded")
    with pytest.raises(FrameError, match=r"^\S+empty\.mov cannot be decoded"):
        expand_videos(given[:1], out, Progress())
