# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos: colours are those that players show or light, frames stand upright, and what cannot be read is said."""
from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from core.colour.spaces import P3_D65, REC_709, REC_2020, matrix_between
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.errors import FrameError
from core.images.formats.exif import apply_orientation
from core.images.video import Video, write_frame
from core.images.video_planes import side_data
from core.removal.training import flare_bank
from core.removal.training.flare_bank import UserFlares
from tests.core.videos import PATCHES, STRIPE, X265, middles, stripes, write_video

LOSSLESS = {"qp": "0", "preset": "ultrafast"}
VP9 = {"lossless": "1"}
AV1 = {"preset": "10", "crf": "1", "svtav1-params": "tune=0"}
HD, SD = (1280, 720), (192, 96)


def first_frame(path: Path) -> NDArray[Any]:
    with Video(path) as video:
        return next(iter(video)).pixels()


def codes_of(path: Path) -> NDArray[Any]:
    """The middles of the stripes of a video's first frame, as codes of 8 bits."""
    pixels = first_frame(path)
    return middles(pixels).astype(float) * 255 / np.iinfo(pixels.dtype).max


@pytest.mark.parametrize(("name", "codec", "pixels", "matrix", "tags", "full", "size", "options"), [
    ("full_8.mp4", "libx264", "yuv420p", 1, (1, 1, 1), True, SD, LOSSLESS),
    ("full_10.mp4", "libx264", "yuv422p10le", 1, (1, 1, 1), True, SD, LOSSLESS),
    ("full_10.mov", "libx265", "yuv420p10le", 1, (1, 1, 1), True, SD, X265),
    ("full_10.mkv", "libx265", "yuv420p10le", 1, (1, 1, 1), True, SD, X265),
    ("full_12.mkv", "libx265", "yuv444p12le", 1, (1, 1, 1), True, SD, X265),
    ("full.webm", "libvpx-vp9", "yuv420p", 1, (1, 1, 1), True, SD, VP9),
    ("full_ffv1.mkv", "ffv1", "yuv422p10le", 1, (1, 1, 1), True, SD, {}),
    ("limited_10.webm", "libsvtav1", "yuv420p10le", 9, (9, 1, 1), False, SD, AV1),
    ("limited_16.mkv", "ffv1", "yuv444p16le", 1, (1, 1, 1), False, SD, {}),
    ("rgb.mkv", "ffv1", "gbrp10le", 0, None, False, SD, {}),
    ("rgb_16.mkv", "ffv1", "gbrp16le", 0, None, False, SD, {}),
    ("rgb.mp4", "libx264rgb", "gbrp", 0, None, False, SD, {**LOSSLESS, "x264-params": ""}),
    ("601_hd.mp4", "libx264", "yuv444p", 6, (6, 6, 6), False, HD, LOSSLESS),
    ("601_hd.mkv", "libx264", "yuv444p", 6, (6, 6, 6), False, HD, LOSSLESS),
    ("601_hd.mkv", "ffv1", "yuv444p", 6, (6, 2, 2), False, HD, {}),
    ("240m.mkv", "libx264", "yuv444p", 7, (7, 7, 7), False, SD, LOSSLESS),
    ("untagged_hd.mp4", "libx264", "yuv444p", 1, None, False, HD, LOSSLESS),
    ("untagged_sd.mp4", "libx264", "yuv444p", 6, None, False, SD, LOSSLESS),
    ("untagged_sd.avi", "mpeg4", "yuv420p", 6, None, False, SD, {"qscale": "1", "flags": "+qscale"}),
    ("709_sd.mp4", "libx264", "yuv420p", 1, (1, 1, 1), False, SD, LOSSLESS),
    ("2020_sdr_matrix.mp4", "libx264", "yuv420p", 9, (9, 1, 1), False, SD, LOSSLESS),
    ("dnxhr.mov", "dnxhd", "yuv422p10le", 1, (1, 1, 1), False, (1280, 720), {"profile": "dnxhr_hqx"}),
    ("prores.mov", "prores_ks", "yuv422p10le", 1, (1, 1, 1), False, SD, {"profile": "hq", "qscale": "2"}),
    ("v210.mov", "v210", "yuv422p10le", 1, (1, 1, 1), False, SD, {}),
    ("mpeg2.mpg", "mpeg2video", "yuv420p", 6, None, False, SD, {"qscale": "1", "flags": "+qscale"}),
    ("jpeg.mov", "mjpeg", "yuvj444p", 6, None, True, SD, {"qscale": "1", "flags": "+qscale"}),
])
def test_codes_are_those_that_players_show(name: str, codec: str, pixels: str, matrix: int,
                                           tags: tuple[int, int, int] | None, full: bool, size: tuple[int, int],
                                           options: dict[str, str], tmp_path: Path) -> None:
    if codec == "libx264rgb":
        pytest.importorskip("av")
        path = _write_rgb264(tmp_path / name)
    else:
        path = write_video(tmp_path / name, codec, pixels, [stripes(size[1], size[0])] * 2, matrix=matrix, tags=tags,
                           full=full, options={key: value for key, value in options.items() if value})
    lossy = codec in ("mpeg4", "mpeg2video", "mjpeg", "dnxhd", "prores_ks", "libsvtav1")
    assert np.abs(codes_of(path) - PATCHES).max() <= (2 if lossy else 1)
    deep = any(depth in pixels for depth in ("10", "12", "16"))
    assert first_frame(path).dtype == (np.uint16 if deep else np.uint8)


def _write_rgb264(path: Path) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=25, options=LOSSLESS)
        stream.width, stream.height, stream.pix_fmt = 192, 96, "rgb24"
        shown = np.round(stripes(96) * 255).astype(np.uint8)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(shown, "rgb24")))
        container.mux(stream.encode())
    return path


def test_a_container_names_the_colours_that_the_stream_does_not(tmp_path: Path) -> None:
    """QuickTime's `colr` and Matroska's `Colour`, of codecs that have no tags of their own."""
    for suffix in ("mov", "mkv"):
        path = write_video(tmp_path / f"a.{suffix}", "v210" if suffix == "mov" else "rawvideo",
                           "yuv422p10le" if suffix == "mov" else "yuv420p", [stripes(720, 1280)], matrix=6,
                           tags=(6, 6, 6))
        assert np.abs(codes_of(path) - PATCHES).max() <= 1


NITS = np.array([(203.0, 203, 203), (1000, 100, 50), (10, 20, 40), (0.5, 0.5, 0.5), (4000, 3000, 100), (90, 80, 70)])


def pq(nits: NDArray[Any]) -> NDArray[Any]:
    """SMPTE ST 2084, written out anew."""
    power = (nits / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


@pytest.mark.parametrize(("name", "codec", "pixels", "options"), [
    ("pq.mp4", "libx265", "yuv420p10le", X265), ("pq.mkv", "libx265", "yuv420p10le", X265),
    ("pq.webm", "libsvtav1", "yuv420p10le", AV1), ("pq.mov", "prores_ks", "yuv444p10le",
                                                                 {"profile": "4444", "qscale": "1"}),
    ("pq_ffv1.mkv", "ffv1", "yuv444p12le", {})])
def test_pq_is_light_in_which_reference_white_is_1(name: str, codec: str, pixels: str, options: dict[str, str],
                                                   tmp_path: Path) -> None:
    path = write_video(tmp_path / name, codec, pixels, [stripes(64, colours=pq(NITS))], matrix=9, tags=(9, 16, 9),
                       options=options)
    with Video(path) as video:
        frame = next(iter(video))
    assert frame.encoding == "linear"
    truth = NITS / 203 @ matrix_between(REC_2020, REC_709).T
    seen = middles(frame.pixels())
    back = pq(np.maximum(seen @ np.linalg.inv(matrix_between(REC_2020, REC_709).T) * 203, 0))
    assert np.abs(back - pq(NITS)).max() < 1.6 / 1023, "codes of 10 bits"
    assert np.abs(seen[0] - 1).max() < 0.02
    assert np.abs(seen - truth).max() < 0.03 * truth.max()


@pytest.mark.parametrize(("name", "codec", "options"), [
    ("hlg.mp4", "libx265", X265), ("hlg.mkv", "ffv1", {}), ("hlg.webm", "libsvtav1", AV1)])
def test_hlg_is_light_of_a_display_of_1000_nits(name: str, codec: str, options: dict[str, str], tmp_path: Path) -> None:
    """75 % of the signal is reference white, 203 cd/m², and 100 % is the peak (ITU-R BT.2408, table 1)."""
    signal = np.array([(0.75,) * 3, (1.0,) * 3, (0.5,) * 3, (0.0,) * 3, (0.75, 0.5, 0.5), (0.38,) * 3])
    path = write_video(tmp_path / name, codec, "yuv420p10le", [stripes(64, colours=signal)], matrix=9, tags=(9, 18, 9),
                       options=options)
    seen = middles(first_frame(path))
    assert seen[0] == pytest.approx(1, rel=0.02)
    assert seen[1] == pytest.approx(1000 / 203, rel=0.01)
    assert seen[2] == pytest.approx((1 / 12) ** 1.2 * 1000 / 203, rel=0.02)
    assert np.abs(seen[3]).max() < 1e-4
    assert seen[5] == pytest.approx(26 / 203, rel=0.05), "a grey card of 18 %, BT.2408"


@pytest.mark.parametrize(("primaries", "chromaticities"), [(12, P3_D65), (9, REC_2020)])
def test_wide_primaries_of_standard_range_become_rec_709(primaries: int, chromaticities: Any, tmp_path: Path) -> None:
    light = linear_from_srgb(PATCHES / 255) @ matrix_between(REC_709, chromaticities).T
    path = write_video(tmp_path / "a.mp4", "libx264", "yuv444p10le", [stripes(64, colours=srgb_from_linear(light))],
                       tags=(1, 1, primaries), options=LOSSLESS)
    assert np.abs(codes_of(path) - PATCHES).max() <= 1
    assert first_frame(path).dtype == np.uint16


def test_linear_video_is_light(tmp_path: Path) -> None:
    """A video whose transfer is tagged as linear is read as scene-linear light."""
    light = PATCHES / 255
    path = write_video(tmp_path / "a.mkv", "ffv1", "gbrp16le", [stripes(64)], tags=(0, 8, 1))
    with Video(path) as video:
        picture = next(iter(video)).picture()
    assert picture.encoding == "linear"
    assert np.abs(middles(picture.pixels) - light).max() < 1e-4


@pytest.mark.parametrize(("name", "codec", "pixels", "options"), [
    ("a.mov", "prores_ks", "yuva444p10le", {"profile": "4444", "alpha_bits": "16", "qscale": "1"}),
    ("a.mkv", "ffv1", "yuva420p", {}), ("b.mkv", "ffv1", "gbrap12le", {})])
def test_alpha_is_kept(name: str, codec: str, pixels: str, options: dict[str, str], tmp_path: Path) -> None:
    alpha = np.repeat(np.linspace(0, 1, 96)[:, None], 192, 1)
    path = write_video(tmp_path / name, codec, pixels, [stripes(96)], alpha=alpha, options=options)
    with Video(path) as video:
        frame = next(iter(video))
        assert video.has_alpha
    straight = frame.straight_alpha()
    assert straight is not None and np.abs(straight - alpha).max() < 1 / 250
    file = write_frame(tmp_path / "out", frame)
    stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    assert stored.shape == (96, 192, 4) and stored.dtype == frame.pixels().dtype
    assert np.array_equal(stored[..., 2::-1], frame.pixels())
    assert np.array_equal(stored[..., 3], frame.alpha())


@pytest.mark.parametrize("codec", ["libvpx", "libvpx-vp9"])
def test_alpha_of_webm_is_kept(codec: str, tmp_path: Path) -> None:
    """FFmpeg's own decoders of VP8 and VP9 leave it out."""
    alpha = np.repeat(np.where(np.arange(96) < 48, 0.25, 1)[:, None], 192, 1)
    path = write_video(tmp_path / "a.webm", codec, "yuva420p", [stripes(96)] * 3, alpha=alpha, matrix=6,
                       options={"auto-alt-ref": "0", "crf": "4", "b": "4M"})
    with Video(path) as video:
        assert video.has_alpha
        frames = list(video)
        video.seek(2)
        [last] = video
    assert [frame.number for frame in frames] == [0, 1, 2] and last.time == frames[2].time
    for frame in (*frames, last):
        straight = frame.straight_alpha()
        assert straight is not None and np.abs(straight[[20, 80]] - alpha[[20, 80]]).max() < 0.02
        assert np.abs(middles(frame.pixels()).astype(float) - PATCHES).max() < 8


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("kind", "codec", "pixels", "name"), [("JPEG", "mjpeg", "yuvj444p", "a.avi"),
                                                               ("PNG", "png", "rgb24", "a.mov")])
def test_footage_with_exif_data_is_read_upright(orientation: int, kind: str, codec: str, pixels: str, name: str,
                                               tmp_path: Path) -> None:
    """Mirrored too: PyAV has no name for the side data of Exif, and by itself lists none beside it."""
    shown = np.full((48, 64, 3), 40, np.uint8)
    shown[:16, :24] = 200
    exif, encoded = Image.Exif(), io.BytesIO()
    exif[0x112] = orientation
    Image.fromarray(shown).save(encoded, kind, exif=exif, **({"subsampling": 0} if kind == "JPEG" else {}))
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
        packet = av.Packet(encoded.getvalue())
        packet.stream, packet.pts, packet.dts, packet.time_base = stream, 0, 0, Fraction(1, 25)
        container.mux(packet)
    with Video(tmp_path / name) as video:
        [frame] = video
        assert np.abs(frame.pixels().astype(int) - apply_orientation(shown, orientation)).max() < 12
        assert "DISPLAYMATRIX" in side_data(frame.raw)


@pytest.mark.parametrize("rotation", [90, 180, 270, -90])
@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv"])
def test_rotated_phone_footage_is_read_upright(rotation: int, suffix: str, tmp_path: Path) -> None:
    """Turned counterclockwise by the angle of the display matrix."""
    signal = stripes(96) * np.linspace(1, 0.5, 96)[:, None, None]
    path = write_video(tmp_path / f"a.{suffix}", "libx264", "yuv444p", [signal], options=LOSSLESS, rotation=rotation,
                       aspect=Fraction(4, 3))
    with Video(path) as video:
        seen = next(iter(video)).picture().pixels
        assert video.aspect == pytest.approx(4 / 3 if rotation == 180 else 3 / 4)
    assert np.abs(seen - np.rot90(_stored(path), rotation // 90)).max() == 0


def _stored(path: Path) -> NDArray[Any]:
    with Video(path) as video:
        frame = next(iter(video))
        return frame.orientation.stored(frame.picture().pixels)


def test_mirrored_footage_is_read_upright(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", "libx264", "yuv444p", [stripes(96)], options=LOSSLESS)
    plain = first_frame(path)
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 4 + 40
    mirrored = (-(1 << 16), 0, 0, 0, 1 << 16, 0, 192 << 16, 0, 1 << 30)
    data[at:at + 36] = b"".join(number.to_bytes(4, "big", signed=True) for number in mirrored)
    path.write_bytes(data)
    assert np.array_equal(first_frame(path), plain[:, ::-1])


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "mov"])
def test_the_pixel_aspect_is_read(suffix: str, tmp_path: Path) -> None:
    for number, aspect in enumerate((None, Fraction(4, 3), Fraction(16, 15))):
        path = write_video(tmp_path / f"{number}.{suffix}", "libx264", "yuv420p", [stripes(96)], aspect=aspect)
        with Video(path) as video:
            assert video.aspect == pytest.approx(float(aspect or 1))


@pytest.mark.parametrize(("name", "codec", "options"), [
    ("a.mp4", "libx264", {"g": "7", "bf": "3"}), ("a.mkv", "libx265", {"x265-params": "log-level=none:keyint=6"}),
    ("a.webm", "libvpx-vp9", {"g": "5"}), ("a.avi", "mpeg4", {"g": "6", "bf": "0"}), ("a.mov", "prores_ks", {}),
    ("a.mpg", "mpeg2video", {"g": "6", "bf": "2", "qscale": "1", "flags": "+qscale"}), ("a.ts", "libx264", {"g": "8"})])
def test_seeking_finds_the_frame_of_that_number(name: str, codec: str, options: dict[str, str], tmp_path: Path) -> None:
    signals = [np.full((64, 64, 3), 0.1 + number * 0.035) for number in range(20)]
    path = write_video(tmp_path / name, codec, "yuv422p10le" if codec == "prores_ks" else "yuv420p", signals,
                       options=options)
    with Video(path) as video:
        levels = [frame.pixels().mean() for frame in video]
        assert len(levels) == 20 and np.all(np.diff(levels) > 0)
        for number in (0, 1, 7, 13, 19):
            video.seek(number)
            frame = next(iter(video))
            assert frame.number == number and frame.pixels().mean() == levels[number]
        video.seek(20)
        assert list(video) == []


class DamagedFrame:
    """A frame of PyAV that the decoder calls damaged, of another width if one is named."""

    is_corrupt = True

    def __init__(self, raw: Any, width: int = 0) -> None:
        self._raw, self.width = raw, width or raw.width

    def __getattr__(self, name: str) -> Any:
        return getattr(self._raw, name)


def test_damaged_frames_are_counted_before_the_size_changes(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", "ffv1", "yuv420p", [stripes(32)] * 4)
    with Video(path) as video:
        raws = [frame.raw for frame in video]
        video._frames_from = lambda _start: iter(  # type: ignore[method-assign]
            [raws[0], DamagedFrame(raws[1]), DamagedFrame(raws[2], 64), raws[3]])
        video.length = 4
        assert len(list(video)) == 2
        assert len(video.problems) == 2
        assert "changes its size to 64 x 32 at frame 3" in video.problems[0]
        assert "1 of 2 frames" in video.problems[1] and "damaged (2)" in video.problems[1]


def test_frames_hidden_by_an_edit_list_are_neither_shown_nor_missing(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", "libx264", "yuv420p", [np.full((64, 64, 3), n / 20) for n in range(10)],
                       options={"bf": "0", **LOSSLESS})
    data = bytearray(path.read_bytes())
    at = data.find(b"elst")
    start = at + 16  # of one entry: duration, media time
    ticks = 12800 // 25
    assert int.from_bytes(data[start:start + 4], "big") == 0
    data[start:start + 4] = (4 * ticks).to_bytes(4, "big")
    path.write_bytes(data)
    with Video(path) as video:
        assert video.length == 6
        levels = [frame.picture().pixels.mean() for frame in video]
    assert len(levels) == 6 and levels[0] == pytest.approx(4 / 20, abs=0.01) and video.problems == []


@pytest.mark.parametrize("content", [b"", b"no video at all", None])
def test_an_invalid_or_truncated_video_is_reported(content: bytes | None, tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", "libx264", "yuv420p", [stripes(64)])
    path.write_bytes(path.read_bytes()[:200] if content is None else content)
    with pytest.raises(FrameError, match=r"a\.mp4 cannot be decoded: it is cut off, or"):
        Video(path)


def test_colours_that_cannot_be_converted_are_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", "ffv1", "yuv444p10le", [stripes(64)], tags=(14, 16, 9))
    with pytest.raises(FrameError, match=r"a\.mkv has the colour matrix ICtCp"):
        Video(path)


def test_sound_and_cover_art_are_no_video(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 48000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(FrameError, match=r"a\.mp4 holds no video"):
        Video(path)


def test_a_flare_video_keeps_its_colours(tmp_path: Path) -> None:
    path = tmp_path / "clips" / "flare.mp4"
    path.parent.mkdir()
    write_video(path, "libx264", "yuv444p", [stripes(720, 1280)] * 3, options=LOSSLESS)
    layers = UserFlares(path.parent, 256).draw(np.random.default_rng(0))
    high, wide = np.nonzero(layers.rest.sum(-1) > 0.01)
    shown = layers.rest[high.min():high.max() + 1, wide.min():wide.max() + 1]
    columns = ((np.arange(6) + 0.5) / 6 * shown.shape[1]).astype(int)
    assert np.abs(shown[len(shown) // 2, columns] - linear_from_srgb(PATCHES / 255)).max() < 0.03


def test_a_flare_video_that_claims_too_many_frames_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Longer(Video):
        def __init__(self, path: Path) -> None:
            super().__init__(path)
            self.estimated_length = 1000

    path = tmp_path / "clips" / "flare.mp4"
    path.parent.mkdir()
    write_video(path, "libx264", "yuv420p", [stripes(96, 6 * STRIPE)] * 3)
    monkeypatch.setattr(flare_bank, "Video", Longer)
    assert UserFlares(path.parent, 256).draw(np.random.default_rng(0)).rest.max() > 0.1


@pytest.mark.parametrize(("name", "pixels", "bits", "matrix"), [
    ("a.mkv", "gray", 8, 1), ("b.mkv", "gray", 8, 5), ("c.mkv", "gray10le", 10, 1), ("d.mkv", "gray16le", 16, 9)])
def test_grey_videos_have_the_light_of_their_codes(tmp_path: Path, name: str, pixels: str, bits: int,
                                                   matrix: int) -> None:
    """Their file names a matrix, which means nothing for one plane."""
    top = (1 << bits) - 1
    codes = np.repeat(np.array([[0, top // 4, top // 2, top]], np.uint8 if bits == 8 else np.uint16), 16, 1)
    codes = np.repeat(codes, 32, 0)
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 32, pixels
        stream.codec_context.color_range, stream.codec_context.colorspace = 2, matrix
        frame = av.VideoFrame.from_ndarray(codes, pixels)
        frame.color_range, frame.colorspace = 2, matrix
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with Video(tmp_path / name) as video:
        read = next(iter(video)).pixels()
    read = read / np.iinfo(read.dtype).max
    np.testing.assert_allclose(read[16, 8::16, 0], [0, 0.25, 0.5, 1], atol=0.01)
