# SPDX-License-Identifier: GPL-3.0-or-later
"""Clean pictures for `train-removal`: `python sample_scenes/rooms.py --out FOLDER --photos FOLDER --maps FOLDER`.

What is taken for a flare most often is bright and soft, and belongs to the scene. Of such places there are few among
photographs, and none to be sure of; rooms that Cycles renders (`random_room`) are seen through no lens, so that
whatever they show is no flare. Photographs are their pictures and textures, environment maps their skies; those that
trainings hold out are left out here too. A room is a function of its number and of the pictures, but for the noise of
rendering; one that is there already is not rendered again.
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
from core.removal.training.backgrounds import MAPS, PHOTOS, pictures_of
from core.system.progress import Progress
from sample_scenes.command import leave, run
from sample_scenes.random_room import Room


def developed(random: np.random.Generator, light: Pixels) -> Pixels:
    """Display values 0..1, exposed by all but the brightest twentieth."""
    grey = light.mean(-1)
    level = (np.percentile(grey, 60) + np.minimum(grey, np.percentile(grey, 95)).mean()) / 2
    light = light * min(math.exp(random.normal(math.log(0.13), 0.55)) / max(float(level), 1e-4), 500)
    if random.random() < 0.5:  # a soft shoulder
        light = light * (1 + light / 9) / (1 + light) * 1.2
    return np.asarray(np.clip(light, 0, 1) ** (1 / random.choice([1.8, 2.0, 2.2])), np.float32)


def pictures(folder: Path, suffixes: Set[str]) -> list[Path]:
    """Those of a folder that trainings may see. Raises SettingsError where there are none."""
    found = pictures_of(folder, suffixes, "train")
    if not found:
        raise SettingsError(f"{folder} holds none of {', '.join(sorted(suffixes))}; name a folder of clean pictures.")
    return found


def make(folder: Path, photos: Sequence[Path], maps: Sequence[Path], count: int, progress: Progress) -> None:
    """The first `count` pictures of all, those that are not in the folder yet. Raises SettingsError for none at all."""
    if count < 1:
        raise SettingsError(f"--count is the number of rooms, 1 or more, not {count}.")
    paths = [folder / f"room_{number:05d}.png" for number in range(count)]
    missing = [number for number, path in enumerate(paths) if not path.is_file()]
    folder.mkdir(parents=True, exist_ok=True)
    progress.stage("rooms", count, count - len(missing))
    for number in missing:
        random = np.random.default_rng(number)
        write_png(paths[number], developed(random, Room(random, photos, maps).filmed()))
        progress.advance()


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to write the pictures to")
    parser.add_argument("--photos", type=Path, required=True, help="folder of clean photographs")
    parser.add_argument("--maps", type=Path, required=True, help="folder of environment maps")
    parser.add_argument("--count", type=int, default=100)
    chosen = parser.parse_args()
    return run(lambda progress: make(chosen.out, pictures(chosen.photos, PHOTOS), pictures(chosen.maps, MAPS),
                                     chosen.count, progress))


if __name__ == "__main__":
    leave(main())
