# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures the removal of streaks and starbursts that another generator than the training's lays over photographs.

    python benchmarks/streaks.py PHOTOS... --out DIR [--count N] [--seed N] [--working-size PIXELS]

Each photograph gets one to three lights, at its brightest compact spots or where it has none at random places. A light
has a disc and the glow of a clean lens, which belong to the scene, and a flare: lines through the light in ones, twos
or threes, slightly curved, whose two sides differ in length, whose colour changes along them, and a glow about them.
All is added in linear light, then clipped, as a camera does.

It prints, and writes to DIR/streaks.json: the PSNR of the photographs with flare and of the results, over whole
pictures and over the streaks (pixels to which a streak adds 4 codes or more, not clipped in the truth); and how much
darker than the truth the results are along the streaks, codes of 8 bits, 95th percentile by picture. DIR/streaks.png
shows the pictures that are darkened most: with flare, result, truth.
"""
from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from core.system.thread_environment import set_thread_environment

set_thread_environment()

import numpy as np
from numpy.typing import NDArray

from core.colour.srgb import Pixels
from core.images.read import read_picture
from core.images.write import write_png
from core.metrics.pictures import psnr
from core.removal.inference.remover import WORKING_SIZE, Remover
from core.removal.training.backgrounds import PHOTO_SUFFIXES, list_pictures

LONG_SIDE = 640
"""Long side of the pictures, pixels."""
STREAK_CODES = 4
"""What a streak adds to a pixel that belongs to it, at least, codes of 8 bits."""
DARK_CODES = 4
"""Darkness along a streak, codes of 8 bits, up to which it counts as none."""
GAMMA = 2.2
"""Gamma of the display values."""
SHOWN = 8
"""Pictures on the sheet."""


class StreakCase(NamedTuple):
    """A photograph under streaks: display values 0..1 (h, w, 3) with flare and without, and where streaks are (h, w).
    """

    frame: Pixels
    truth: Pixels
    streaks: NDArray[np.bool_]


def draw_case(photo: Pixels, random: np.random.Generator) -> StreakCase:
    """Lay lights and their streaks over a photograph of display values 0..1 (h, w, 3)."""
    height, width = photo.shape[:2]
    scene = photo.astype(np.float32) ** GAMMA
    streaks, glow = np.zeros_like(scene), np.zeros_like(scene)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    count = int(random.integers(1, 4))
    axes = [random.uniform(0, math.pi) + k * math.pi / lines + random.normal(0, 0.02)
            for lines in [int(random.choice([1, 1, 2, 3]))] for k in range(lines)]  # of the lens, so the same for all
    lengths = random.uniform(0.12, 0.7, len(axes)) * width
    for place in find_places(photo, count, random):
        tint = 1 + random.uniform(-0.35, 0.35, 3) * random.random()
        dx, dy = x - place[0], y - place[1]
        distance = np.hypot(dx, dy)
        radius = random.uniform(0.004, 0.012) * width
        power = random.uniform(0.4, 3.0)
        scene += (power * 8 / (1 + (distance / radius) ** 4))[..., None] * tint  # the disc
        scene += (power * 0.05 / (1 + (distance / (3 * radius)) ** 2.5))[..., None] * tint  # a clean lens's own glow
        glow += (power * random.uniform(0.0, 0.12) * np.exp(-distance / (random.uniform(0.03, 0.12) * width))
                 )[..., None] * tint
        for axis, length in zip(axes, lengths, strict=True):
            streaks += draw_streak(dx, dy, axis, length, width, random) * (power * random.uniform(0.1, 0.7)) * tint
    truth, frame = to_display(scene), to_display(scene + glow + streaks)
    without = to_display(scene + glow)
    marked = (frame - without).max(-1) * 255 >= STREAK_CODES
    return StreakCase(frame, truth, marked & (truth.min(-1) < 0.98))


def draw_streak(dx: Pixels, dy: Pixels, axis: float, length: float, width: int, random: np.random.Generator) -> Pixels:
    """Draw one line through a light: (h, w, 3), about 1 beside the light.

    dx, dy: offsets from the light, pixels. axis: direction, radians. length: distance over which it fades, pixels.
    """
    along = dx * math.cos(axis) + dy * math.sin(axis)
    across = dy * math.cos(axis) - dx * math.sin(axis) + random.normal(0, 0.02) / length * along**2
    side = np.where(along > 0, length, length * random.uniform(0.5, 1.0))
    spread = random.uniform(0.0015, 0.006) * width * (1 + random.uniform(0, 1.5) * np.abs(along) / length)
    profile = (np.exp(-0.5 * (across / spread) ** 2) if random.random() < 0.5
               else 1 / (1 + (across / spread) ** 2) ** 1.5)
    falloff = (np.exp(-np.abs(along) / (0.4 * side)) if random.random() < 0.5
               else np.clip(1 - np.abs(along) / side, 0, None) ** random.uniform(1, 2.5))
    phase, turns = random.uniform(0, 2 * math.pi), random.uniform(0, 1.5)
    colour = 1 + random.uniform(0, 0.5) * np.cos(phase + turns * 2 * math.pi * (np.abs(along) / length)[..., None]
                                                 - np.array([0.0, 2.1, 4.2], np.float32))
    return np.asarray((profile * falloff)[..., None] * colour, np.float32)


def find_places(photo: Pixels, count: int, random: np.random.Generator) -> list[tuple[float, float]]:
    """Return places of lights (x, y), pixels: the brightest spots of a photograph, each a tenth of its width apart
    from the others, or random ones where it has no spots above 0.85, or more than a twentieth of it is that bright."""
    import cv2

    height, width = photo.shape[:2]
    brightness = np.asarray(cv2.GaussianBlur(photo.mean(-1).astype(np.float32), (0, 0), 2.0))
    places: list[tuple[float, float]] = []
    for _ in range(count):
        y, x = np.unravel_index(int(brightness.argmax()), brightness.shape)
        if brightness[y, x] < 0.85 or (brightness > 0.85).mean() > 0.05:
            places.append((random.uniform(0.05, 0.95) * width, random.uniform(0.05, 0.8) * height))
            continue
        places.append((float(x), float(y)))
        cv2.circle(brightness, (int(x), int(y)), width // 10, (0.0,), -1)
    return places


def to_display(linear: Pixels) -> Pixels:
    """Convert linear light to display values, clipped and rounded to 8 bits."""
    return np.asarray(np.round(np.clip(linear, 0, 1) ** (1 / GAMMA) * 255) / 255, np.float32)


def read_photo(path: Path) -> Pixels:
    """Read a photograph as display values, LONG_SIDE pixels on its long side."""
    picture = read_picture(path)
    scale = LONG_SIDE / max(picture.size)
    return picture.resized(round(picture.size[0] * scale), round(picture.size[1] * scale)).display()


def darkening(result: Pixels, case: StreakCase) -> float:
    """Return how much darker than the truth a result is along the streaks, codes: the 95th percentile."""
    darker = (case.truth - result).mean(-1)[case.streaks] * 255
    return float(np.quantile(darker, 0.95)) if len(darker) else 0.0


def main(args: argparse.Namespace) -> None:
    """Score all photographs, and write scores and sheet."""
    import cv2

    paths = sorted(path for folder in args.photos for path in list_pictures(folder, PHOTO_SUFFIXES, "all"))
    random = np.random.default_rng(args.seed)
    chosen = [paths[k] for k in sorted(random.permutation(len(paths))[:args.count])]
    remover = Remover(args.weights, working_size=args.working_size)
    rows, pictures = [], []
    for number, path in enumerate(chosen):
        case = draw_case(read_photo(path), np.random.default_rng([args.seed, number]))
        result = remover.clean_display(case.frame)
        scores = {"name": path.stem,
                  "psnr": [psnr(case.frame, case.truth), psnr(result, case.truth)],
                  "streak_psnr": [psnr(case.frame, case.truth, case.streaks), psnr(result, case.truth, case.streaks)],
                  "darker": darkening(result, case)}
        rows.append(scores)
        pictures.append((scores["darker"], np.hstack([case.frame, result, case.truth])))
        print("{name:28} {psnr[0]:6.2f} {psnr[1]:6.2f}   {streak_psnr[0]:6.2f} {streak_psnr[1]:6.2f}   {darker:6.1f}"
              .format(**scores), flush=True)
    means = {key: np.mean([row[key] for row in rows], 0).tolist() for key in ("psnr", "streak_psnr")}
    darker = [row["darker"] for row in rows]
    print(f"PSNR {means['psnr'][0]:.2f} -> {means['psnr'][1]:.2f}, over streaks {means['streak_psnr'][0]:.2f} -> "
          f"{means['streak_psnr'][1]:.2f}; darker by more than {DARK_CODES} codes: "
          f"{sum(value > DARK_CODES for value in darker)} of {len(darker)}, median {np.median(darker):.1f}")
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "streaks.json").write_text(json.dumps({"means": means, "pictures": rows}, indent=1), encoding="utf-8")
    worst = [picture for _, picture in sorted(pictures, key=lambda pair: -pair[0])[:SHOWN]]
    sheet = np.vstack([cv2.resize(picture, (3 * LONG_SIDE // 2, round(picture.shape[0] * 1.5 * LONG_SIDE
                                                                      / picture.shape[1]))) for picture in worst])
    write_png(args.out / "streaks.png", sheet)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+", metavar="PHOTOS", help="folders of photographs without flare")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--count", type=int, default=40, metavar="N", help="photographs (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    parser.add_argument("--working-size", type=int, default=WORKING_SIZE, metavar="PIXELS")
    parser.add_argument("--weights", type=Path, metavar="FILE")
    main(parser.parse_args())
