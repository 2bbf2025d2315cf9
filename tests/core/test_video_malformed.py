# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged videos: a sentence each, in a process that neither crashes, hangs nor takes a gigabyte."""
from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.core.videos import X265, stripes, write_video

STATUS = Path("/proc/self/status")
if not STATUS.exists():
    pytest.skip("measures memory by /proc", allow_module_level=True)
ROOT = Path(__file__).parents[2]
READ_ALL = """
import json, sys, time
from pathlib import Path
from core.errors import FrameError
from core.images.video import Video
rows = []
for path in sorted(Path(sys.argv[1]).iterdir()):
    begun, sentences, frames = time.monotonic(), [], 0
    try:
        with Video(path) as video:
            for frame in video:
                frame.pixels()
                frames += 1
            sentences = video.problems
    except FrameError as problem:
        sentences = [str(problem)]
    rows.append([path.name, frames, sentences, time.monotonic() - begun])
# Not ru_maxrss, which starts at the memory of the parent.
peak = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps([peak, rows]))
"""


def damaged(data: bytes, random: np.random.Generator) -> bytes:
    """Return a damaged copy: cut off, with bits turned over, with bytes of the header replaced, or with false sizes."""
    kind, content = random.integers(4), bytearray(data)
    if kind == 0:
        return bytes(content[:random.integers(len(content))])
    if kind == 1:  # anywhere
        for at in random.integers(0, len(content), random.integers(1, 40)):
            content[at] ^= 1 << random.integers(8)
    elif kind == 2:  # in the header
        for at in random.integers(0, min(len(content), 1500), random.integers(1, 12)):
            content[at] = random.integers(256)
    else:  # four bytes that may be a size
        for _ in range(3):
            at = int(random.integers(0, len(content) - 4))
            size = int(random.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x00FFFFFF, 1 << 20]))
            content[at:at + 4] = size.to_bytes(4, "big")
    return bytes(content)


def read_all(folder: Path) -> tuple[int, list[tuple[str, int, list[str], float]]]:
    """Read each video in a child; return its peak memory in KiB, and name, frames, sentences and seconds of each."""
    child = subprocess.run([sys.executable, "-c", READ_ALL, str(folder)], cwd=ROOT, capture_output=True, text=True,
                           check=False, timeout=400)
    assert child.returncode == 0, (child.returncode, child.stderr[-2000:])
    peak, rows = json.loads(child.stdout)
    return peak, rows


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("whole")
    signals = [np.clip(stripes(64) + 0.1 * np.random.default_rng(n).random((64, 1, 1)), 0, 1) for n in range(6)]
    return [write_video(folder / name, codec, pixels, signals, options=options) for name, codec, pixels, options in (
        ("a.mp4", "libx264", "yuv420p", {}), ("b.mkv", "libx265", "yuv420p10le", X265),
        ("c.mov", "prores_ks", "yuv422p10le", {}), ("d.avi", "mjpeg", "yuvj420p", {}), ("e.mkv", "ffv1", "yuv420p", {}),
        ("f.webm", "libvpx-vp9", "yuv420p", {"deadline": "realtime"}), ("g.mpg", "mpeg2video", "yuv420p", {}),
        ("h.mov", "v210", "yuv422p10le", {}))]


@pytest.mark.parametrize("seed", range(2))
def test_damaged_videos_end_in_a_sentence(seed: int, whole: list[Path], tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    for number in range(100):
        source = whole[number % len(whole)]
        (tmp_path / f"{number:03d}{source.suffix}").write_bytes(damaged(source.read_bytes(), random))
    peak, rows = read_all(tmp_path)
    assert peak < 1 << 20, "KiB"
    for name, frames, sentences, seconds in rows:
        assert seconds < 20, name
        assert frames or sentences, name
        for sentence in sentences:
            assert name in sentence and sentence.endswith(".") and "\n" not in sentence
    assert sum(not frames for _, frames, _, _ in rows) > 10
    assert sum(frames > 0 for _, frames, _, _ in rows) > 10
