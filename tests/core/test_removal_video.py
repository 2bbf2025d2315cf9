# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos in `remove`: their frames are extracted once, and what is missing is said."""
from __future__ import annotations

import errno
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import Cancelled, FrameError, SettingsError
from core.images.read import read_picture
from core.images.video import Video, VideoFrame
from core.images.video_mastering import x265_options
from core.images.video_writer import rewrite_video
from core.images.write import write_png
from core.removal.jobs.clean_video import frames_folder, require_single_video, write_clean_video
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
        assert len([sentence for sentence in heard.texts if "declares 4 frames" in sentence]) == count


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


def darkened(frame: VideoFrame) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """A change of the upper left corner; the second frame has none."""
    if frame.number == 1:
        return None
    before = frame.picture().pixels
    after = before.copy()
    after[:24, :24] *= 0.5
    return before, after


def frames_of(path: Path) -> list[VideoFrame]:
    with Video(path) as video:
        return list(video)


@pytest.mark.parametrize(("suffix", "codec", "source", "pixels", "tags", "full", "bound"), [
    (".mkv", "ffv1", "libx264", "yuv420p", (1, 1, 1), True, 0),
    (".mkv", "ffv1", "ffv1", "yuv444p12le", (9, 16, 9), False, 0),
    (".mkv", "ffv1", "ffv1", "gbrp10le", None, False, 0),
    (".mp4", "h264", "libx264", "yuv422p10le", (1, 1, 1), False, 2),
    (".mkv", "h265", "libx265", "yuv420p10le", (9, 18, 9), False, 2),
    (".mp4", "h265", "libx264", "yuv444p", (6, 6, 6), True, 6),
    (".mov", "prores", "libx264", "yuv422p10le", (1, 1, 1), True, 2),
    (".mov", "prores4444", "ffv1", "gbrp10le", None, False, 3)])
def test_a_video_is_written_with_what_changed_alone(suffix: str, codec: str, source: str, pixels: str,
                                                    tags: tuple[int, int, int] | None, full: bool, bound: int,
                                                    tmp_path: Path) -> None:
    signals = [stripes(96) * (1 - 0.1 * n) for n in range(4)]
    film = write_video(tmp_path / "film.mkv", source, pixels, signals, full=full,
                       matrix=tags[0] if tags else 1, tags=tags,
                       options=X265 if source == "libx265" else LOSSLESS if source == "libx264" else {})
    target = tmp_path / f"out{suffix}"
    assert rewrite_video(film, target, codec, darkened) == []
    before, after = frames_of(film), frames_of(target)
    assert len(after) == 4 and [frame.number for frame in after] == [0, 1, 2, 3]
    for old, new in zip(before, after, strict=True):
        assert new.colour.transfer == old.colour.transfer and new.colour.primaries == old.colour.primaries
        assert float(new.raw.pts * new.raw.time_base) == pytest.approx(float(old.raw.pts * old.raw.time_base), abs=1e-3)
        was, is_now = old.picture().pixels.copy(), new.picture().pixels
        if old.number != 1:
            was[:24, :24] *= 0.5
        was, is_now = (new.colour.from_pixels(pixels) * 255 for pixels in (was, is_now))
        assert np.abs(was - is_now)[32:, 4:24].max() <= bound, "untouched"
        assert np.abs(was - is_now)[4:20, 4:20].max() <= bound + 1, "darkened"


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "h265"), (".mkv", "h265"), (".mkv", "ffv1")])
def test_the_mastering_display_and_light_levels_stay_or_are_named(suffix: str, codec: str, tmp_path: Path) -> None:
    mastering = ("master-display=G(13250,34500)B(7500,3000)R(34000,16000)WP(15635,16450)L(10000000,50):"
                 "max-cll=1000,400")
    film = write_video(tmp_path / "film.mp4", "libx265", "yuv420p10le", [stripes(96)] * 2, matrix=9, tags=(9, 16, 9),
                       options={"x265-params": f"log-level=none:bframes=0:{mastering}", "preset": "ultrafast"})
    target = tmp_path / f"out{suffix}"
    sentences = rewrite_video(film, target, codec, darkened)
    assert x265_options(frames_of(film)[0].raw) == f":{mastering}"
    if codec == "h265":
        assert not sentences and x265_options(frames_of(target)[0].raw) == f":{mastering}"
    else:
        assert any("neither the mastering display nor the light levels" in sentence for sentence in sentences)


def test_sound_tags_timecode_shape_and_alpha_of_a_video_stay(tmp_path: Path) -> None:
    alpha = np.repeat(np.linspace(0, 1, 96)[:, None], 192, 1)
    film = write_video(tmp_path / "film.mov", "prores_ks", "yuva444p10le", [stripes(96)] * 3, alpha=alpha,
                       options={"profile": "4444", "alpha_bits": "16"}, sound="pcm_s16le", rotation=90,
                       aspect=Fraction(4, 3), tags=(1, 1, 1), metadata={"title": "Shot 10", "timecode": "01:02:03:04"})
    target = tmp_path / "out.mov"
    assert rewrite_video(film, target, "prores4444", darkened) == []
    with Video(film) as old, Video(target) as new:
        assert new.matrix == old.matrix and new.aspect == old.aspect and new.has_alpha
        first, second = next(iter(old)), next(iter(new))
        assert np.array_equal(first.alpha(), second.alpha())
    with av.open(str(film)) as old_file, av.open(str(target)) as new_file:
        assert new_file.metadata["title"] == "Shot 10"
        assert new_file.streams.video[0].metadata["timecode"] == "01:02:03:04"
        assert new_file.streams.video[0].average_rate == old_file.streams.video[0].average_rate
        sounds = [[bytes(packet) for packet in file.demux(audio=0) if packet.size] for file in (old_file, new_file)]
        assert b"".join(sounds[0]) == b"".join(sounds[1])


def test_what_the_new_video_cannot_hold_is_said(tmp_path: Path) -> None:
    film = write_video(tmp_path / "film.mkv", "ffv1", "yuva420p", [stripes(96)] * 2, sound="flac",
                       alpha=np.ones((96, 192)))
    sentences = rewrite_video(film, tmp_path / "out.mov", "prores", darkened)
    assert len(sentences) == 2
    assert "(flac) does not fit into the new file and is encoded as pcm_s24le" in sentences[0]
    assert "prores has no alpha" in sentences[1]
    with av.open(str(tmp_path / "out.mov")) as file:
        assert file.streams.audio[0].codec_context.name == "pcm_s24le"


def test_a_clean_video_waits_for_its_frames_and_is_kept(tmp_path: Path) -> None:
    film, target, heard = clip_of(tmp_path / "film.mp4"), tmp_path / "out.mkv", RecordingProgress()
    assert require_single_video([film], target, None) == film
    folder = frames_folder(target)
    filmed = extract_frames(film, folder, Progress())
    for number in (1, 2):
        shutil.copy(filmed / f"film.{number:06d}.png", folder)
    assert not write_clean_video(film, target, None, heard) and not target.exists()
    assert "1 of 3 frames are not clean yet" in heard.texts[-1]
    write_png(folder / "film.000003.png", np.zeros((64, 192, 3)))
    assert write_clean_video(film, target, None, heard)
    levels = [frame.picture().pixels.mean() for frame in frames_of(target)]
    assert levels[0] > 0.3 and levels[2] < 0.01
    written = target.stat().st_mtime_ns
    assert write_clean_video(film, target, None, heard) and target.stat().st_mtime_ns == written
    target.write_bytes(b"someone's work")
    with pytest.raises(SettingsError, match=r"out\.mkv exists and was not made from these frames"):
        write_clean_video(film, target, None, heard)
    assert write_clean_video(film, target, None, heard, overwrite=True) and target.stat().st_size > 1000


@pytest.mark.parametrize("fails", ["core.removal.jobs.clean_video.write_json", "core.system.files.retry_while_locked"])
def test_a_clean_video_that_could_not_be_finished_is_written_again(fails: str, tmp_path: Path,
                                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    film, target = clip_of(tmp_path / "film.mp4"), tmp_path / "out.mkv"
    filmed = extract_frames(film, frames_folder(target), Progress())
    for number in (1, 2, 3):
        shutil.copy(filmed / f"film.{number:06d}.png", frames_folder(target))
    for level in (0.0, 0.5):  # the first video, and another in its place
        write_png(frames_folder(target) / "film.000003.png", np.full((64, 192, 3), level))
        before = target.read_bytes() if target.exists() else None
        with monkeypatch.context() as patch:
            patch.setattr(fails, full_disk)
            with pytest.raises(OSError):
                write_clean_video(film, target, None, Progress())
        assert (target.read_bytes() if target.exists() else None) == before
        assert write_clean_video(film, target, None, Progress())
        assert abs(frames_of(target)[2].picture().pixels.mean() - level) < 0.02


def full_disk(first: Any, second: Any) -> None:
    """Fail as the `write_json` of a record, or as the rename of a video but not of a record."""
    if isinstance(second, Path) and second.suffix == ".json":
        first(second)
        return
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("given", "name", "codec", "sentence"), [
    (["film.mp4"], "out.webm", None, r"out\.webm is no video that this program writes"),
    (["film.mp4"], "out.mp4", "prores", r"prores is not written to \.mp4; use \.mov or \.mkv"),
    (["film.mp4", "film.mp4"], "out.mov", None, "so one video has to be cleaned"),
    (["."], "out.mov", None, "so one video has to be cleaned"),
    (["film.mp4"], "film.mp4", None, "is the video itself")])
def test_a_video_that_cannot_be_written_is_refused(given: list[str], name: str, codec: str | None, sentence: str,
                                                   tmp_path: Path) -> None:
    clip_of(tmp_path / "film.mp4")
    with pytest.raises(SettingsError, match=sentence):
        require_single_video([tmp_path / path for path in given], tmp_path / name, codec)
