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
BT709_MATRIX = np.array([[1.04, -0.03, -0.01], [-0.02, 1.04, -0.02], [-0.01, -0.03, 1.04]], np.float32)
"""In place of the matrix from BT.601 to BT.709: other numbers, the same cost."""


def write_inputs(folder: Path, frames: int) -> dict[str, Path]:
    """Write videos of 8 and 10 bits and folders of PNGs and JPEGs: a moving view of patches with grain.

    Returns the paths by the names that the table shows.
    """
    random = np.random.default_rng(0)
    scene = cv2.resize(random.integers(20, 220, (40, 60, 3), np.uint8), (SIZE[0] + frames, SIZE[1] + frames),
                       interpolation=cv2.INTER_CUBIC)
    grain = random.integers(0, 24, (SIZE[1], SIZE[0], 3), np.uint8)
    pictures = [np.ascontiguousarray(scene[shift:shift + SIZE[1], shift:shift + SIZE[0]] + grain)
                for shift in range(frames)]
    paths = {}
    for depth, pixel_format in ((8, "yuv420p"), (10, "yuv420p10le")):
        paths[f"HEVC, {depth} bits"] = folder / f"{depth}.mp4"
        with av.open(str(folder / f"{depth}.mp4"), "w") as container:
            stream = container.add_stream("libx265", rate=25, options={"preset": "ultrafast", "crf": "22",
                                                                       "x265-params": "log-level=none"})
            stream.width, stream.height, stream.pix_fmt = *SIZE, pixel_format
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
            container.mux(stream.encode())
    for kind, suffix in (("PNG", ".png"), ("JPEG", ".jpg")):
        paths[kind] = folder / kind
        paths[kind].mkdir()
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(paths[kind] / f"{number:04d}{suffix}"), picture)
    return paths


def read_video_by_opencv(path: Path) -> int:
    """Decode a video by OpenCV to float R G B, with the work that right colours cost; return the number of frames."""
    capture, count = cv2.VideoCapture(str(path)), 0
    while True:
        has_frame, frame = capture.read()
        if not has_frame:
            return count
        cv2.transform(frame, BT709_MATRIX)[..., ::-1].astype(np.float32) / np.float32(255)
        count += 1


def read_video(path: Path) -> int:
    """Read a video by this program; return the number of frames."""
    count = 0
    with Video(path) as video:
        for frame in video:
            frame.picture()
            count += 1
    return count


def read_pictures_by_opencv(folder: Path) -> int:
    """Read pictures by OpenCV, as float R G B at 0..1; return their number."""
    files = sorted(folder.iterdir())
    for file in files:
        stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.cvtColor(stored, cv2.COLOR_BGR2RGB).astype(np.float32) / np.float32(255)
    return len(files)


def read_pictures(folder: Path) -> int:
    """Read pictures by this program; return their number."""
    files = sorted(folder.iterdir())
    for file in files:
        np.ascontiguousarray(read_picture(file).pixels)
    return len(files)


def fastest_times(readers: dict[str, Callable[[Path], int]], path: Path, frames: int,
                  rounds: int) -> dict[str, tuple[float, float]]:
    """Return for each reader the milliseconds per frame by the clock and by processor time, each of its best round."""
    fastest = dict.fromkeys(readers, (np.inf, np.inf))
    for _ in range(rounds):
        for name, read in readers.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            assert read(path) == frames
            elapsed, cpu_elapsed = time.perf_counter() - start, time.process_time() - cpu_start
            fastest[name] = (min(fastest[name][0], elapsed / frames * 1e3),
                             min(fastest[name][1], cpu_elapsed / frames * 1e3))
    return fastest


def main() -> None:
    """Write the inputs, time the readers and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    print("| input | OpenCV, ms a frame (processor) | this program | ratio by the clock | of the processor |")
    print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        for kind, path in write_inputs(Path(name), args.frames).items():
            readers = ({"OpenCV": read_pictures_by_opencv, "ours": read_pictures} if path.is_dir() else
                       {"OpenCV": read_video_by_opencv, "ours": read_video})
            times = fastest_times(readers, path, args.frames, args.rounds)
            (opencv, opencv_cpu), (ours, ours_cpu) = times["OpenCV"], times["ours"]
            print(f"| {kind} | {opencv:.1f} ({opencv_cpu:.1f}) | {ours:.1f} ({ours_cpu:.1f}) | {ours / opencv:.2f} | "
                  f"{ours_cpu / opencv_cpu:.2f} |", flush=True)


if __name__ == "__main__":
    main()
