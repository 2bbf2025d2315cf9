# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos: their colours are those that players show, they stand upright, and what cannot be read is told."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.colour.srgb import linear_from_srgb
from core.errors import Cancelled, FrameError, SettingsError
from core.images.video import Video
from core.removal.jobs.video_frames import expand_videos, extract_frames
from core.removal.training import flare_bank
from core.removal.training.flare_bank import UserFlares
from core.system.progress import Progress
from tests.core.recording_progress import RecordingProgress

PATCHES = np.array([(200, 60, 40), (40, 180, 60), (50, 70, 210), (128, 128, 128), (230, 200, 40), (240, 240, 240)])
"""Red, green, blue."""
STRIPE = 128


def patches(path: Path, height: int, weights: tuple[float, float], told: bytes = b"") -> Path:
    """A video of upright stripes whose codes are those that luma of these weights, of red and blue, makes of PATCHES.
    OpenCV writes by BT.601's. told: put into its description."""
    def luma_and_differences(red: float, blue: float) -> NDArray[np.float64]:
        green = 1 - red - blue
        return np.array([[red, green, blue], [-red / 2 / (1 - blue), -green / 2 / (1 - blue), 0.5],
                         [0.5, -green / 2 / (1 - red), -blue / 2 / (1 - red)]])

    mixed = PATCHES @ (np.linalg.inv(luma_and_differences(0.299, 0.114)) @ luma_and_differences(*weights)).T
    frame = np.repeat(np.repeat(mixed.clip(0, 255).round().astype(np.uint8)[None], STRIPE, 1), height, 0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, (frame.shape[1], height))
    for _ in range(3):
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.find(b"moov") - 4
    if told:
        size = int.from_bytes(data[at:at + 4], "big")
        assert at + size == len(data), "the last box"
        data[at:at + 4] = (size + len(told)).to_bytes(4, "big")
    path.write_bytes(data + told)
    return path


def box(transfer: int, matrix: int) -> bytes:
    """A `colr` box in one that players pass over, for the end of a file's `moov`."""
    colours = b"colrnclx" + b"".join(number.to_bytes(2, "big") for number in (1, transfer, matrix)) + b"\0"
    inner = (len(colours) + 4).to_bytes(4, "big") + colours
    return (len(inner) + 8).to_bytes(4, "big") + b"udta" + inner


@pytest.mark.parametrize(("height", "weights", "told"), [
    (360, (0.299, 0.114), b""), (720, (0.2126, 0.0722), b""), (360, (0.2126, 0.0722), box(1, 1)),
    (720, (0.299, 0.114), box(1, 6)), (720, (0.2627, 0.0593), box(1, 9))])
def test_the_colours_of_a_video_are_those_that_players_show(height: int, weights: tuple[float, float], told: bytes,
                                                            tmp_path: Path) -> None:
    with Video(patches(tmp_path / "a.mp4", height, weights, told)) as video:
        frames = list(video)
        assert video.warnings == ()
    assert len(frames) == 3
    shown = frames[-1][height // 2, STRIPE // 2::STRIPE, ::-1].astype(int)
    assert np.abs(shown - PATCHES).max() <= 5, "24 by the wrong matrix"


@pytest.mark.parametrize(("suffix", "codec"), [("mkv", "FFV1"), ("avi", "MJPG"), ("mov", "png ")])
def test_colours_of_rgb_and_motion_jpeg_are_unchanged(suffix: str, codec: str, tmp_path: Path) -> None:
    """RGB itself, and JPEG, which is of BT.601 at any size."""
    frame = np.repeat(np.repeat(PATCHES.astype(np.uint8)[None, :, ::-1], 256, 1), 720, 0)
    path = tmp_path / f"a.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25, (frame.shape[1], 720))
    for _ in range(2):
        writer.write(np.ascontiguousarray(frame))
    writer.release()
    with Video(path) as video:
        shown = next(iter(video))[360, 128::256, ::-1].astype(int)
    assert np.abs(shown - PATCHES).max() <= 5


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG")])
def test_high_dynamic_range_raises_a_warning(transfer: int, name: str, tmp_path: Path) -> None:
    with Video(patches(tmp_path / "a.mp4", 64, (0.299, 0.114), box(transfer, 9))) as video:
        assert len(video.warnings) == 1
        assert name in video.warnings[0]


def test_rotated_phone_footage_is_read_upright(tmp_path: Path) -> None:
    path = patches(tmp_path / "a.mp4", 96, (0.299, 0.114))
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 4 + 40
    turned = (0, 1 << 16, 0, -(1 << 16), 0, 0, 96 << 16, 0, 1 << 30)
    data[at:at + 36] = b"".join(number.to_bytes(4, "big", signed=True) for number in turned)
    path.write_bytes(data)
    with Video(path) as video:
        frame = next(iter(video))
    assert frame.shape == (6 * STRIPE, 96, 3)
    assert np.abs(frame[STRIPE // 2, 48, ::-1].astype(int) - PATCHES[0]).max() <= 5


@pytest.mark.parametrize("content", [b"", b"no video at all", None])
def test_an_invalid_or_truncated_video_is_reported(content: bytes | None, tmp_path: Path) -> None:
    path = patches(tmp_path / "a.mp4", 64, (0.299, 0.114))
    path.write_bytes(path.read_bytes()[:200] if content is None else content)
    with pytest.raises(FrameError, match=r"a\.mp4 cannot be decoded: it is cut off, or"):
        Video(path)


def test_a_flare_video_keeps_its_colours(tmp_path: Path) -> None:
    """Of high definition."""
    path = tmp_path / "clips" / "flare.mp4"
    path.parent.mkdir()
    patches(path, 720, (0.2126, 0.0722))
    own = UserFlares(path.parent, 256)
    layers = own.draw(np.random.default_rng(0))
    high, wide = np.nonzero(layers.rest.sum(-1) > 0.01)
    shown = layers.rest[high.min():high.max() + 1, wide.min():wide.max() + 1]
    columns = ((np.arange(6) + 0.5) / 6 * shown.shape[1]).astype(int)
    truth = linear_from_srgb(PATCHES / 255)
    assert np.abs(shown[len(shown) // 2, columns] - truth).max() < 0.04


def test_a_flare_video_that_claims_too_many_frames_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one does whose sound is longer."""
    class Longer(Video):
        def __init__(self, path: Path) -> None:
            super().__init__(path)
            self.length = 1000

    path = tmp_path / "clips" / "flare.mp4"
    path.parent.mkdir()
    patches(path, 360, (0.299, 0.114))
    monkeypatch.setattr(flare_bank, "Video", Longer)
    assert UserFlares(path.parent, 256).draw(np.random.default_rng(0)).rest.max() > 0.1


def with_pixels(path: Path, wide: int, high: int) -> Path:
    """A video of OpenCV's as one whose pixels are of that shape: the box `pasp`, in all boxes about it."""
    data = bytearray(path.read_bytes())
    entry = data.find(b"mp4v", data.find(b"stsd")) - 4
    end = entry + int.from_bytes(data[entry:entry + 4], "big")
    box = (16).to_bytes(4, "big") + b"pasp" + wide.to_bytes(4, "big") + high.to_bytes(4, "big")
    at = data.find(b"moov")
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"):
        at = data.find(name, at) - 4
        data[at:at + 4] = (int.from_bytes(data[at:at + 4], "big") + len(box)).to_bytes(4, "big")
        at += 4
    data[end:end] = box
    path.write_bytes(data)
    return path


def test_the_pixel_aspect_is_read(tmp_path: Path) -> None:
    path = patches(tmp_path / "a.mp4", 240, (0.299, 0.114))
    with Video(path) as video:
        assert video.aspect == 1
    with Video(with_pixels(path, 4, 3)) as video:
        assert video.aspect == pytest.approx(4 / 3) and len(list(video)) == 3


def test_the_frames_of_a_video_are_extracted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip, out = patches(tmp_path / "clip.mp4", 64, (0.299, 0.114)), tmp_path / "out"
    frames = extract_frames(clip, out, Progress())
    assert frames == out / "clip.mp4.frames"
    assert sorted(path.name for path in frames.glob("*.png")) == [f"clip.{number:06d}.png" for number in (1, 2, 3)]
    first = cv2.imread(str(frames / "clip.000001.png"))
    assert np.abs(first[32, STRIPE // 2::STRIPE, ::-1].astype(int) - PATCHES).max() < 12
    with Video(clip) as again:
        assert np.array_equal(first, next(iter(again)))
    with monkeypatch.context() as patch:
        patch.setattr("core.removal.jobs.video_frames._decode_frames", lambda *_: pytest.fail("they are there"))
        assert extract_frames(clip, out, Progress()) == frames
    patches(clip, 96, (0.299, 0.114))
    with pytest.raises(SettingsError, match=r"another video of that name"):
        extract_frames(clip, out, Progress())


def test_frames_that_another_task_has_extracted_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip, out = patches(tmp_path / "clip.mp4", 64, (0.299, 0.114)), tmp_path / "out"
    there = extract_frames(clip, tmp_path / "other", Progress())
    monkeypatch.setattr("core.removal.jobs.video_frames._decode_frames", lambda *_: there.rename(out / there.name))
    assert len(list(extract_frames(clip, out, Progress()).glob("*.png"))) == 3


def test_missing_frames_of_a_video_are_reported(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (64, 48))
    for _ in range(4):
        writer.write(np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8))
    writer.release()
    whole = (tmp_path / "clip.avi").read_bytes()
    told = RecordingProgress()
    extract_frames(tmp_path / "clip.avi", tmp_path / "whole", told)
    assert not told.texts
    (tmp_path / "clip.avi").write_bytes(whole[:len(whole) * 6 // 10])
    extract_frames(tmp_path / "clip.avi", tmp_path / "cut", told)
    assert [sentence for sentence in told.texts if "promises 4 frames" in sentence]


def test_an_unreadable_or_cancelled_video_leaves_no_frames(tmp_path: Path) -> None:
    (tmp_path / "empty.mov").touch()
    clip, out = patches(tmp_path / "clip.mp4", 64, (0.299, 0.114)), tmp_path / "out"
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
