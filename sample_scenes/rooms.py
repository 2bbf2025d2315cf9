# SPDX-License-Identifier: GPL-3.0-or-later
"""Render clean pictures for `train-removal`: `python sample_scenes/rooms.py --out FOLDER --photos FOLDER --maps
FOLDER`.

What a network most often mistakes for a flare is bright and soft and belongs to the scene. Photographs show few such
places, and none that are certainly free of flare; rooms that Cycles renders (`random_room`) have no lens flare at all.
Photographs serve as pictures on walls and as textures, environment maps as skies; files that trainings hold out are
left out here too. Apart from the render noise a room depends on its number and on these files only. Rooms that exist
are not rendered again.
"""
from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence, Set
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.colour.srgb import Pixels
from core.errors import SettingsError
from core.images.write import write_png
from core.removal.training.backgrounds import MAP_SUFFIXES, PHOTO_SUFFIXES, list_pictures
from core.system.progress import Progress
from sample_scenes.command import exit_process, run_command
from sample_scenes.random_room import Room


def develop(random: np.random.Generator, light: Pixels) -> Pixels:
    """Return display values 0..1 of linear light, with a random exposure and tone curve.

    The exposure brings the scene's level to about 0.13. The level is the mean of the 60th percentile and of the average
    with the brightest twentieth clipped, so that lamps count little.
    """
    grey = light.mean(-1)
    level = (np.percentile(grey, 60) + np.minimum(grey, np.percentile(grey, 95)).mean()) / 2
    # A dark picture is brightened 500 times at most.
    light = light * min(math.exp(random.normal(math.log(0.13), 0.55)) / max(float(level), 1e-4), 500)
    if random.random() < 0.5:  # a soft shoulder: Reinhard's curve with white at 3
        light = light * (1 + light / 9) / (1 + light) * 1.2
    return np.asarray(np.clip(light, 0, 1) ** (1 / random.choice([1.8, 2.0, 2.2])), np.float32)


def training_pictures(folder: Path, suffixes: Set[str]) -> list[Path]:
    """Return the pictures of a folder that trainings may see. Raises SettingsError where there are none."""
    pictures = list_pictures(folder, suffixes, "train")
    if not pictures:
        raise SettingsError(f"{folder} holds none of {', '.join(sorted(suffixes))}; name a folder of clean pictures.")
    return pictures


def make_rooms(folder: Path, photos: Sequence[Path], maps: Sequence[Path], count: int, progress: Progress) -> None:
    """Render those of the first `count` rooms that are not in the folder yet. Raises SettingsError for a count below 1.
    """
    if count < 1:
        raise SettingsError(f"--count is the number of rooms, 1 or more, not {count}.")
    paths = [folder / f"room_{number:05d}.png" for number in range(count)]
    missing = [number for number, path in enumerate(paths) if not path.is_file()]
    folder.mkdir(parents=True, exist_ok=True)
    progress.stage("rooms", count, count - len(missing))
    for number in missing:
        random = np.random.default_rng(number)
        write_png(paths[number], develop(random, Room(random, photos, maps).render()))
        progress.advance()


def main() -> int:
    """Render the rooms that the arguments name; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to write the pictures to")
    parser.add_argument("--photos", type=Path, required=True, help="folder of clean photographs")
    parser.add_argument("--maps", type=Path, required=True, help="folder of environment maps")
    parser.add_argument("--count", type=int, default=100)
    args = parser.parse_args()
    return run_command(lambda progress: make_rooms(args.out, training_pictures(args.photos, PHOTO_SUFFIXES),
                                                   training_pictures(args.maps, MAP_SUFFIXES),
                                                   args.count, progress))


if __name__ == "__main__":
    exit_process(main())
