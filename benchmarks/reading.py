# SPDX-License-Identifier: GPL-3.0-or-later
"""Time to read 100 frames of 1080p HEVC, 100 PNGs and 100 JPEGs, as a ratio to OpenCV's readers in the same run.

    python benchmarks/reading.py [--frames 100] [--rounds 3]

The readers take turns, and the fastest round of each counts: by the clock, and by processor time, which other work on
the machine disturbs less. OpenCV's capture converts every video by the matrix of BT.601, so it is timed with the
conversion to BT.709 that makes its colours right. All readers end in float R G B at 0..1, as the commands need them.
"""
from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import av
import cv2

from core.images.read import read_picture
from core.images.video import Video

SIZE = 1920, 1080
TO_709 = np.array([[1.04, -0.03, -0.01], [-0.02, 1.04, -0.02], [-0.01, -0.03, 1.04]], np.float32)
"""In place of the matrix from BT.601 to BT.709: other numbers, the same cost."""


def write_inputs(folder: Path, frames: int) -> dict[str, Path]:
    """Write a video of 8 bits, one of 10, and pictures: a moving view of patches with grain."""
    random = np.random.default_rng(0)
    scene = cv2.resize(random.integers(20, 220, (40, 60, 3), np.uint8), (SIZE[0] + frames, SIZE[1] + frames),
                       interpolation=cv2.INTER_CUBIC)
    grain = random.integers(0, 24, (SIZE[1], SIZE[0], 3), np.uint8)
    pictures = [np.ascontiguousarray(scene[n:n + SIZE[1], n:n + SIZE[0]] + grain) for n in range(frames)]
    paths = {}
    for bits, pixels in ((8, "yuv420p"), (10, "yuv420p10le")):
        paths[f"HEVC, {bits} bits"] = folder / f"{bits}.mp4"
        with av.open(str(folder / f"{bits}.mp4"), "w") as container:
            stream = container.add_stream("libx265", rate=25, options={"preset": "ultrafast", "crf": "22",
                                                                       "x265-params": "log-level=none"})
            stream.width, stream.height, stream.pix_fmt = *SIZE, pixels
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
            container.mux(stream.encode())
    for kind, suffix in (("PNG", ".png"), ("JPEG", ".jpg")):
        paths[kind] = folder / kind
        paths[kind].mkdir()
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(paths[kind] / f"{number:04d}{suffix}"), picture)
    return paths


def read_by_capture(path: Path) -> int:
    """Decode a video by OpenCV to float R G B, with the work that right colours cost; return the number of frames."""
    capture, count = cv2.VideoCapture(str(path)), 0
    while True:
        good, frame = capture.read()
        if not good:
            return count
        cv2.transform(frame, TO_709)[..., ::-1].astype(np.float32) / np.float32(255)
        count += 1


def read_by_video(path: Path) -> int:
    """Read a video by this program; return the number of frames."""
    count = 0
    with Video(path) as video:
        for frame in video:
            frame.picture()
            count += 1
    return count


def read_by_imread(folder: Path) -> int:
    """Read pictures by OpenCV, as float R G B at 0..1."""
    files = sorted(folder.iterdir())
    for file in files:
        stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.cvtColor(stored, cv2.COLOR_BGR2RGB).astype(np.float32) / np.float32(255)
    return len(files)


def read_by_picture(folder: Path) -> int:
    """Read pictures by this program."""
    files = sorted(folder.iterdir())
    for file in files:
        np.ascontiguousarray(read_picture(file).pixels)
    return len(files)


def measure(readers: dict[str, Callable[[Path], int]], path: Path, frames: int,
            rounds: int) -> dict[str, tuple[float, float]]:
    """Return for each reader the milliseconds per frame, of the clock and of the processor: the least of all rounds."""
    best = dict.fromkeys(readers, (np.inf, np.inf))
    for _ in range(rounds):
        for name, read in readers.items():
            clock, processor = time.perf_counter(), time.process_time()
            assert read(path) == frames
            took = time.perf_counter() - clock, time.process_time() - processor
            best[name] = (min(best[name][0], took[0] / frames * 1e3), min(best[name][1], took[1] / frames * 1e3))
    return best


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    print("| input | OpenCV, ms a frame (processor) | this program | ratio by the clock | of the processor |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        for kind, path in write_inputs(Path(name), args.frames).items():
            readers = ({"old": read_by_imread, "new": read_by_picture} if path.is_dir() else
                       {"old": read_by_capture, "new": read_by_video})
            times = measure(readers, path, args.frames, args.rounds)
            (old, old_cpu), (new, new_cpu) = times["old"], times["new"]
            print(f"| {kind} | {old:.1f} ({old_cpu:.1f}) | {new:.1f} ({new_cpu:.1f}) | {new / old:.2f} | "
                  f"{new_cpu / old_cpu:.2f} |", flush=True)


if __name__ == "__main__":
    main()
