# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw a contact sheet of a capture: `python sample_scenes/sheet.py CAPTURE --out SHEET.png`.

For each of some views, from top to bottom: frame, scene, flare (display values). Prints the score of an empty flare,
|frame - scene| against zero, in dB.
"""
from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.images.read import read_picture
from core.system.files import atomic_path


def psnr_without_flare(frame: NDArray[np.float32], scene: NDArray[np.float32]) -> float:
    """Return the PSNR, dB, of black as an estimate of the flare |frame - scene|; infinite where there is no flare."""
    error = float(np.mean((frame - scene) ** 2))
    return -10 * math.log10(error) if error > 0 else math.inf


def contact_sheet(capture: Path, columns: int, rows: int, width: int) -> NDArray[np.uint8]:
    """Return the sheet, (height, width, 3) BGR, of columns x rows views spread evenly over the capture.

    Prints the score of an empty flare for each of them. width: of one picture, pixels.
    """
    frames = sorted(path for path in (capture / "images").iterdir() if not path.name.startswith("."))
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, columns * rows).round().astype(int)]
    strips = []
    for path in chosen:
        frame = read_picture(path)
        clean = capture / "removed" / path.name
        scene = read_picture(clean if clean.is_file() else capture / "truth" / "scene" / f"{path.stem}.exr")
        flare = read_picture(capture / "truth" / "flare" / f"{path.stem}.exr")
        print(f"{path.stem}  empty flare {psnr_without_flare(frame.display(), scene.display()):.2f} dB")
        height = round(width * frame.size[1] / frame.size[0])
        strips.append(np.vstack([picture.resized(width, height).display() for picture in (frame, scene, flare)]))
    sheet_rows = [np.hstack(strips[start:start + columns]) for start in range(0, len(strips), columns)]
    return np.round(np.clip(np.vstack(sheet_rows), 0, 1) * 255).astype(np.uint8)[..., ::-1]


def main() -> int:
    """Write the sheet that the arguments describe; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--rows", type=int, default=2)
    parser.add_argument("--width", type=int, default=360)
    args = parser.parse_args()
    sheet = contact_sheet(args.capture, args.columns, args.rows, args.width)
    with atomic_path(args.out) as temporary:
        cv2.imwrite(str(temporary), sheet)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
