# SPDX-License-Identifier: GPL-3.0-or-later
"""Accuracy of the lights that are followed in the sample shots, whose paths and brightness are known.

    python benchmarks/tracks.py [--shots FOLDER] [--seeds 0 1] [--only torch]

Renders the sample shots where they are missing and prints, for each light: frames in which at least 30 % of its disc
are visible in the frame; how many of these were followed; the error in pixels of 480x270 (median, 95 %, largest) over
these frames; the same over all frames whose place is not doubtful; frames that are doubtful, and the largest error that
was not called doubtful; the error of the brightness, where it is known and the light not out of the frame (median, 95
%). A line for each shot counts the
lights that were reported without being one.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.capture import Capture, Light, read_lights
from core.capture.lights import DOUBTFUL
from core.errors import CaptureError
from core.lights.tracks import TrackedLight, track_lights
from core.system.files import read_json
from core.system.progress import Progress
from sample_scenes.render_shot import CACHE, make_shot
from sample_scenes.shot_scenes import SHOTS

MIN_VISIBLE = 0.3
"""Visible share of a light's disc from which a frame is said to show it."""
MAX_MATCH_DISTANCE = 10.0
"""Distance in pixels, below which a followed light counts as near an exact one."""


class TrackScores(NamedTuple):
    """The figures of one light: numbers of frames, and lists of errors by frame."""

    visible: int
    """Frames that show the light."""
    followed: int
    """Frames that show the light and in which it was followed."""
    keys: int
    """Frames with a key."""
    doubtful: int
    """Frames whose key is doubtful."""
    doubtful_visible: int
    """Frames that show the light and whose key is doubtful."""
    visible_errors: list[float]
    """Pixels, in frames that show the light."""
    confident_errors: list[float]
    """Pixels, in frames whose key is not doubtful."""
    brightness_errors: list[float]


def score_track(capture: Capture, truth: Light, visible: dict[str, float], light: TrackedLight) -> TrackScores:
    """Compare a followed light with the exact one, `truth`. visible: share of its disc that is visible, by frame."""
    size = np.array(capture.views[0].camera.size)
    errors, visible_frames, brightness_errors = {}, [], []
    for name, key in truth.keys.items():
        tracked = light.keys.get(name)
        assert key.xy is not None and key.on is not None
        inside = bool(((key.xy > 0) & (key.xy < size)).all())
        if inside and visible[name] >= MIN_VISIBLE and key.on > 0:
            visible_frames.append(name)
        if tracked is None or tracked.xy is None:
            continue
        errors[name] = float(np.linalg.norm(tracked.xy - key.xy))
        if tracked.on is not None and inside:
            brightness_errors.append(abs(tracked.on - key.on))
    return TrackScores(
        visible=len(visible_frames), followed=sum(name in light.support for name in visible_frames),
        keys=len(light.keys), doubtful=len(light.doubtful),
        doubtful_visible=sum(light.keys[name].confidence < DOUBTFUL for name in visible_frames if name in light.keys),
        visible_errors=[errors[name] for name in visible_frames if name in errors],
        confident_errors=[error for name, error in errors.items() if light.keys[name].confidence >= DOUBTFUL],
        brightness_errors=brightness_errors)


def match_light(truth: Light, lights: list[TrackedLight]) -> TrackedLight | None:
    """Return the light that is within MAX_MATCH_DISTANCE of `truth` in the most frames; None where none ever is."""
    def count_near(light: TrackedLight) -> int:
        return sum(float(np.linalg.norm(light.keys[name].place - truth.keys[name].xy)) < MAX_MATCH_DISTANCE
                   for name in light.support)

    best = max(lights, key=count_near, default=None)
    return best if best is not None and count_near(best) else None


def error_columns(values: list[float]) -> str:
    """Return median, 95th percentile and largest value as text."""
    if not values:
        return "    -      -      -"
    return f"{np.median(values):5.2f} {np.percentile(values, 95):6.2f} {max(values):6.1f}"


def score_columns(scores: TrackScores) -> str:
    """Return the scores of a light as the columns of a row."""
    return (f"{scores.visible:7d} {scores.followed:8d} |       {error_columns(scores.visible_errors)}    |"
            f"       {error_columns(scores.confident_errors)}          | "
            f"{scores.doubtful:3d} of {scores.keys:3d} ({scores.doubtful_visible:d})     |"
            f"     {np.median(scores.brightness_errors):5.2f} {np.percentile(scores.brightness_errors, 95):5.2f}")


def main() -> None:
    """Render the shots that are missing, follow the lights of all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=Path, default=CACHE, help="folder of the rendered shots, SHOT_SEED")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--only", choices=sorted(SHOTS), action="append")
    args = parser.parse_args()
    print("shot     light  visible followed | error, px: median 95 % largest | not doubtful: median 95 % largest | "
          "doubtful (visible) | brightness: median 95 %")
    for shot in args.only or SHOTS:
        for seed in args.seeds:
            folder = args.shots / f"{shot}_{seed}"
            make_shot(shot, seed, folder, Progress())
            capture = Capture.open(folder, need_cameras=False)
            lights = track_lights(capture).lights
            entries = read_json(folder / "truth" / "lights.json", CaptureError)["lights"]
            matched = []
            for truth, entry in zip(read_lights(folder / "truth" / "lights.json"), entries, strict=True):
                light = match_light(truth, lights)
                if light is None:
                    print(f"{folder.name:8s} {truth.name:6s} not found")
                    continue
                matched.append(light)
                visible = {name: key["visible"] for name, key in entry["frames"].items()}
                scores = score_track(capture, truth, visible, light)
                print(f"{folder.name:8s} {truth.name:6s} {score_columns(scores)}", flush=True)
            false = sum(light not in matched for light in lights)
            print(f"{folder.name:8s} {len(lights)} lights, {false} of them false")


if __name__ == "__main__":
    main()
