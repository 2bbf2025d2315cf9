# SPDX-License-Identifier: GPL-3.0-or-later
"""Accuracy of the detection of lights: in single pictures, and in 3D.

    python benchmarks/detection.py --photos PHOTOS [--pictures 500] [--method exposure]
    python benchmarks/detection.py --capture sample_scenes/desk

Pictures: 1 to 5 synthetic sources over each photograph (light_composer.py), the union of detected masks
against the union of exact masks by pixel (precision, recall, F1, IoU over all pictures together, as in the
appendix of the paper), by threshold of the score, and by light: detected where a centroid lies on it. Two
truths: `shape` is the emitting shape, `glare` the region that the light and its glow clip, which is all that
a picture shows of it. The photographs are unchanged: their own lamps and windows count against the detector.

Captures: lights found from the frames against lights.json, in pixels (median over the views that have the
light in frame) and in scene units.
"""
from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.light_composer import LitPicture, compose_lights
from core.capture import Capture
from core.errors import EngineError, FitFlareError
from core.images.read import read_picture
from core.lights import Detection, Detector, find_lights, make_detector, union_mask
from core.removal.training.backgrounds import PHOTO_SUFFIXES, list_pictures

THRESHOLDS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


@dataclass
class Tally:
    """Counts over all pictures at one threshold.

    pixels: hit, false and missed pixels, by kind of truth. detected: lights that a detection lies on, of `lights`.
    false: detections on no light.
    """

    pixels: dict[str, np.ndarray] = field(default_factory=lambda: {"shape": np.zeros(3), "glare": np.zeros(3)})
    detected: int = 0
    lights: int = 0
    false: int = 0

    def add(self, picture: LitPicture, detections: Sequence[Detection]) -> None:
        """Count one picture; a detection hits every light whose mask contains the detection's centroid."""
        detected = union_mask(detections, picture.picture.size)
        for name, truth in (("shape", picture.masks.any(axis=0)), ("glare", picture.clipped)):
            self.pixels[name] += [(detected & truth).sum(), (detected & ~truth).sum(), (truth & ~detected).sum()]
        hit_lights = set()
        for detection in detections:
            x, y = detection.xy.astype(int)
            lights_below = np.flatnonzero(picture.masks[:, y, x])
            hit_lights.update(lights_below.tolist())
            self.false += not len(lights_below)
        self.detected += len(hit_lights)
        self.lights += len(picture.masks)

    def scores(self, truth: str) -> tuple[float, float, float, float]:
        """Return precision, recall, F1 and IoU by pixel. truth: "shape" or "glare"."""
        hit, false, missed = self.pixels[truth]
        precision, recall = hit / max(hit + false, 1), hit / max(hit + missed, 1)
        f1 = 2 * precision * recall / max(precision + recall, 1e-9)
        return precision, recall, f1, hit / max(hit + false + missed, 1)


def compose_pictures(photos: Sequence[Path], number: int, seed: int) -> Iterator[LitPicture]:
    """Yield `number` compositions of 1 to 5 lights over the photographs in turn."""
    for i in range(number):
        rng = np.random.default_rng((seed, i))
        yield compose_lights(read_picture(photos[i % len(photos)]), rng, int(rng.integers(1, 6)))


def detect_in_pictures(detector: Detector, photos: Sequence[Path], number: int, seed: int) -> dict[float, Tally]:
    """Return tallies by threshold; the detector, made for the lowest threshold, runs once for each picture."""
    tallies = {threshold: Tally() for threshold in THRESHOLDS}
    for picture in compose_pictures(photos, number, seed):
        detections = detector.detect(picture.picture)
        for threshold, tally in tallies.items():
            tally.add(picture, [detection for detection in detections if detection.score >= threshold])
    return tallies


def print_capture_errors(folders: Sequence[Path], detector: Detector) -> None:
    """Find the lights of every capture; print, for every exact light, its distance from the nearest one found.

    A found light is matched with one exact light at most.
    """
    print(f"{'capture':24s} {'light':12s} {'error':>9s} {'of extent':>9s} {'median px':>9s} {'support':>8s}")
    for folder in folders:
        try:
            capture = Capture.open(folder)
        except FitFlareError as problem:
            print(f"skipped: {problem}")
            continue
        lights = find_lights(capture, detector).lights
        unmatched = list(lights)
        for light in capture.lights:
            if not unmatched:
                print(f"{folder.name:24s} {light.name:12s} not found")
                continue
            nearest = min(unmatched, key=lambda other: float(np.linalg.norm(other.xyz - light.xyz)))
            unmatched.remove(nearest)
            pixel_errors = []
            for view in capture.views:
                pixel, depth = view.camera.project([light.xyz])
                if view.camera.contains(pixel, depth)[0]:
                    pixel_errors.append(np.linalg.norm(view.camera.project([nearest.xyz])[0][0] - pixel[0]))
            error = float(np.linalg.norm(nearest.xyz - light.xyz))
            print(f"{folder.name:24s} {light.name:12s} {error:9.4f} {error / capture.extent:9.4f} "
                  f"{np.median(pixel_errors):9.3f} {len(nearest.support):4d}/{nearest.visible}")
        print(f"{folder.name:24s} {len(capture.lights)} lights, {len(lights)} found, {len(unmatched)} false")


def main() -> None:
    """Make each detector, measure it on the pictures and captures that the arguments name, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, help="folder of photographs, searched with its subfolders")
    parser.add_argument("--pictures", type=int, default=500)
    parser.add_argument("--capture", type=Path, action="append", default=[], help="capture with lights.json")
    parser.add_argument("--method", action="append", choices=("exposure", "grounded"), default=[])
    parser.add_argument("--boxes", help="GroundingDINO's weights: folder or hub name")
    parser.add_argument("--masks", help="SAM 2's weights: folder or hub name")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for method in args.method or ["exposure", "grounded"]:
        try:
            detector = make_detector(method, THRESHOLDS[0], args.boxes, args.masks)
        except EngineError as problem:
            print(f"{method}: skipped. {problem}")
            continue
        if args.photos is not None:
            photos = list_pictures(args.photos, PHOTO_SUFFIXES, "all")
            if not photos:
                print(f"{method}: skipped, {args.photos} holds no photographs.")
            else:
                tallies = detect_in_pictures(detector, photos, args.pictures, args.seed)
                _print_picture_scores(method, tallies, args.pictures)
        if args.capture:
            print_capture_errors(args.capture, make_detector(method, None, args.boxes, args.masks))
    if args.photos is None and not args.capture:
        print("Nothing to measure: give --photos FOLDER, --capture FOLDER or both.")


def _print_picture_scores(method: str, tallies: dict[float, Tally], number: int) -> None:
    """Print precision, recall, F1 and IoU of each threshold. number: how many pictures were composed."""
    print(f"{method}, {number} pictures, {next(iter(tallies.values())).lights} lights")
    print("          |        shape             |        glare             | by light")
    print("threshold |  P     R     F1    IoU   |  P     R     F1    IoU   | recall  precision  false per picture")
    for threshold, tally in tallies.items():
        cells = " | ".join(" ".join(f"{score:.3f}" for score in tally.scores(truth)) + " "
                           for truth in ("shape", "glare"))
        precision = tally.detected / max(tally.detected + tally.false, 1)
        print(f"   {threshold:.2f}   | {cells} |  {tally.detected / max(tally.lights, 1):.3f}    {precision:.3f}      "
              f"{tally.false / number:.2f}")
    for truth in ("shape", "glare"):
        threshold = max(tallies, key=lambda candidate: tallies[candidate].scores(truth)[2])
        print(f"best F1 by {truth}: {tallies[threshold].scores(truth)[2]:.3f} at threshold {threshold:.2f}")


if __name__ == "__main__":
    main()
