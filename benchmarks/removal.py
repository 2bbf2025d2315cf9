# SPDX-License-Identifier: GPL-3.0-or-later
"""What the removal of flares costs and what it is worth.

    python benchmarks/removal.py speed                       # 1920x1080 and 4096x2160, time and memory
    python benchmarks/removal.py sample [--capture CAPTURE]  # against the exact scene, and flicker; of frames cleaned
                                        [--cleaned FOLDER]   # before, such as by remove --run, or by the network now;
                                        [--sheet FILE]       # and a picture: frame, cleaned, exact scene
    python benchmarks/removal.py clean PHOTOS...             # pictures without flare, against themselves
    python benchmarks/removal.py matte PHOTOS... [--lenses LENSES]  # what it is worth to mark where flares are
    python benchmarks/removal.py scenes PHOTOS...            # held-out scenes without flare, as training has them
    python benchmarks/removal.py against PHOTOS... [--lenses LENSES]  # flares whose lights are in a bright sky
    python benchmarks/removal.py coloured PHOTOS... [--lenses LENSES]  # flares of lights of one colour
    python benchmarks/removal.py odds PHOTOS... [--lenses LENSES]  # what tells flares from scenes, and how surely
    python benchmarks/removal.py aspheric PHOTOS...          # ghosts of moulded lenses alone
    python benchmarks/removal.py coverage [--sheet FILE]     # what the synthesis spans, and a sheet of it

Speed: each case in a process of its own, on the threads that torch takes; reading and writing included; the
peak is the process's resident memory. `full` is the network at the plate's own size, the ratio its time over
that of the working size. Sample: PSNR in display values; flicker is the mean change of the error from one
frame to the next, |(result - truth) of a frame - the same of the frame before|, beside that of the untouched
frames. Clean: PSNR of the result against its input, not of a number where they are equal to the last bit.
Matte: `count` synthesised pictures of every class, of held-out photographs and lenses and of another seed than
eval-removal's; the matte is as an artist would rough it in, wide about all that the flare changes, with a soft rim.
Scenes: as `clean`, of the exposures, colours and grain that training has, some with a light. Against: the same flares
with their lights where the scene is bright, and anywhere. Coloured: the same flares of lights of one colour (traffic
lights, neon), and of the white ones that their class has. Aspheric: lights with no other flare than the ghosts of
telephones' lenses, which no class has. Odds: the weights of `core/removal/inference/confidence.py` as a logistic
regression finds them
on pictures that are trained on, a third of them under flares of all classes, a fourth graded so that black is grey,
each flare counting by what it is worth to take it. Then, on held-out ones, by the weights in the file and by these: how
surely what is worth taking is told from what would harm (area under the curve), and how much of each is taken.
"""
from __future__ import annotations

import argparse
import inspect
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from core.system.thread_environment import prepare_for_numpy_and_torch

prepare_for_numpy_and_torch()

import numpy as np

from benchmarks.resident import held_at_most
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.write import write_exr, write_png
from core.metrics.pictures import psnr
from core.removal.inference.neighbours import Sequences
from core.removal.inference.remover import WORKING_SIZE, Remover
from core.removal.jobs.batch import remove_all
from core.system.progress import Progress

DESK = ROOT / "sample_scenes" / "desk"
SHOWN = 3
"""Frames on a sheet of the sample."""
CASES = {"1920x1080 png": (1920, 1080), "4096x2160 exr": (4096, 2160)}


def draw_plate(path: Path, width: int, height: int) -> None:
    """A smooth picture with a bright spot, so that there is a flare to take."""
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    glow = 0.5 / (1 + 30 * ((x - 0.4) ** 2 + (y + 0.3) ** 2))
    waves = 0.2 + 0.1 * np.sin(30 * x) * np.cos(23 * y)
    pixels = np.stack([waves + glow, waves * 0.8 + glow, waves * 0.6 + glow], -1).astype(np.float32)
    pixels[np.hypot(x - 0.4, y + 0.3) < 0.03] = 4.0
    if path.suffix == ".exr":
        write_exr(path, {name: pixels[..., k] for k, name in enumerate("RGB")})
    else:
        write_png(path, pixels)


def one(plate: Path, size: int = WORKING_SIZE, weights: Path | None = None) -> None:
    """The measured process: says seconds and peak megabytes."""
    began = time.perf_counter()
    remover = Remover(weights, working_size=size)
    loaded = time.perf_counter()
    remove_all([plate], plate.parent / "out", remover, Progress(), overwrite=True)
    first = time.perf_counter()
    remove_all([plate], plate.parent / "out", remover, Progress(), overwrite=True)
    print(json.dumps({"load_s": loaded - began, "first_s": first - loaded, "again_s": time.perf_counter() - first,
                      "peak_mb": held_at_most()}))


def speed(weights: Path | None = None) -> None:
    """Time and memory of each case, at the working size and at full size."""
    for name, (width, height) in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"plate.{name.split()[1]}"
            draw_plate(path, width, height)
            figures: dict[str, dict[str, float]] = {}
            for kind, size in (("working", WORKING_SIZE), ("full", width)):
                words = [sys.executable, __file__, "one", str(path), "--size", str(size)]
                done = subprocess.run(words + (["--weights", str(weights)] if weights else []), capture_output=True,
                                      text=True, check=False)
                if done.returncode:
                    print(f"{name}, {kind}: failed, {done.stderr.strip().splitlines()[-1:]}")
                    continue
                figures[kind] = json.loads(done.stdout)
                told = figures[kind]
                print(f"{name:16} {kind:8} load {told['load_s']:5.2f} s, plate {told['first_s']:6.2f} s, "
                      f"the next {told['again_s']:6.2f} s, peak {told['peak_mb']:6.0f} MB")
            if len(figures) == 2:
                print(f"{name:16} ratio    {figures['full']['again_s'] / figures['working']['again_s']:.1f}")


def sample(capture: Path = DESK, weights: Path | None = None, cleaned: Path | None = None,
           sheet: Path | None = None) -> None:
    """PSNR of every frame against the exact scene, and flicker."""
    before: Any = None
    scores, flicker, rows = [], [], []
    paths = sorted((capture / "images").iterdir())
    results = _by_network(paths, weights) if cleaned is None else _cleaned(paths, cleaned)
    for number, (path, codes) in enumerate(zip(paths, results, strict=True)):
        truth = read_picture(capture / "truth" / "scene" / f"{path.stem}.exr").display()
        frame, result = (part.astype(np.float32) / 255 for part in (read_plate(path).codes, codes))
        scores.append((psnr(frame, truth), psnr(result, truth)))
        if number % max(len(paths) // SHOWN, 1) == 5:
            rows.append(np.concatenate([frame, result, np.clip(truth, 0, 1)], 1))
        errors = (frame - truth, result - truth)
        if before is not None:
            flicker.append([float(np.abs(now - then).mean()) for now, then in zip(errors, before, strict=True)])
        before = errors
    untouched, after = np.mean(scores, 0)
    gains = np.diff(scores, axis=1)[:, 0]
    print(f"scene PSNR {after:.2f} dB, untouched {untouched:.2f}, gain {gains.mean():+.2f} "
          f"(lowest {gains.min():+.2f}, highest {gains.max():+.2f}) over {len(scores)} frames")
    print(f"flicker {np.mean(flicker, 0)[1]:.5f}, untouched {np.mean(flicker, 0)[0]:.5f}")
    if sheet:
        import cv2

        picture = cv2.resize(np.concatenate(rows[:SHOWN]), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(sheet), (picture[..., ::-1] * 255 + 0.5).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 88])


def _by_network(paths: list[Path], weights: Path | None) -> Iterator[Any]:
    """Clean codes of the frames, as `remove` makes them of a folder."""
    remover = Remover(weights)
    sequences = Sequences(remover, paths)
    for path in paths:
        plate, told = sequences.read(path)
        yield remover.remove(plate, told=told)[0]


def _cleaned(paths: list[Path], folder: Path) -> Iterator[Any]:
    """Codes of the frames that were cleaned before, under the same names with any suffix."""
    there = {path.stem: path for path in folder.iterdir()}
    return (read_plate(there[path.stem]).codes for path in paths)


def clean(folders: list[Path], weights: Path | None = None) -> None:
    """What happens to pictures without flare."""
    from core.removal.training.backgrounds import PHOTOS, pictures_of

    remover = Remover(weights)
    values, kept = [], 0
    for path in (path for folder in folders for path in pictures_of(folder, PHOTOS, "all")):
        found = read_plate(path)
        codes = remover.remove(found)[0]
        if np.array_equal(codes, found.codes):
            kept += 1
            values.append(100.0)
            continue
        values.append(psnr(codes / found.top, found.codes / found.top))
    print(f"{len(values)} pictures, {kept} kept to the last bit; PSNR against the input: median "
          f"{np.median(values):.2f}, mean with 100 for the kept {np.mean(values):.2f}, 5 % below "
          f"{np.percentile(values, 5):.2f}, lowest {min(values):.2f} dB; {np.mean(np.array(values) >= 45):.0%} at 45 "
          "dB or more")


def scenes(folders: list[Path], weights: Path | None = None, count: int = 300) -> None:
    """What happens to held-out scenes without flare."""
    from core.removal.synthesis.prescription import built_in
    from core.removal.training.backgrounds import read_backgrounds
    from core.removal.training.flare_bank import OneFlare
    from core.removal.training.pairs import pair

    remover, backgrounds = Remover(weights), read_backgrounds(folders, "test", 480)
    values = []
    for number in range(count):
        random, source = np.random.default_rng((1002, number)), OneFlare((1002, number), 160, built_in(), "glare")
        frame = pair(random, source, backgrounds, 480, 320, clean=1.0).frame
        values.append(min(psnr(remover.clean_display(frame), frame), 100.0))
    low = sorted(value for value in values if value < 60)
    print(f"{len(values) - len(low)} of {len(values)} scenes at 60 dB or more, {np.mean(np.array(values) >= 45):.0%} "
          f"at 45; the others {', '.join(f'{value:.1f}' for value in low) or 'none'} dB")


def _unseen(lenses: Path | None) -> Any:
    """The lenses of a folder that training leaves out."""
    from core.removal.evaluation import held_out
    from core.removal.synthesis.prescription import read_lenses

    return held_out(read_lenses(lenses) if lenses else [])


def _seen(lenses: Path | None) -> Any:
    """The lenses of a folder that training takes."""
    from core.removal.synthesis.prescription import built_in, read_lenses
    from core.removal.training.backgrounds import kept_for_test

    return [lens for lens in read_lenses(lenses) if not kept_for_test(lens.name)] if lenses else built_in()


AGAINST = ("scatter", "ghosts", "streak", "glare", "mixed")
"""Classes of flares that have a light in the frame."""


def against(folders: list[Path], lenses: Path | None = None, weights: Path | None = None, count: int = 20) -> None:
    """What removal gains where lights stand in a bright part of the scene, and where they stand anywhere."""
    from core.removal.evaluation import CANVAS
    from core.removal.training.flare_bank import OneFlare

    remover, backgrounds, unseen = Remover(weights), _held_out(folders), _unseen(lenses)
    seeds = [((1003, index, number), kind) for index, kind in enumerate(AGAINST) for number in range(count)]
    for name, share in (("against the light", 1.0), ("anywhere", 0.0)):
        _tell_gains(f"{name:17}", [_gain(remover, seed, OneFlare(seed, CANVAS, unseen, kind), backgrounds, share)
                                   for seed, kind in seeds])


def coloured(folders: list[Path], lenses: Path | None = None, weights: Path | None = None, count: int = 20) -> None:
    """What removal gains of flares whose lights have one colour, and of the same of white lights."""
    from core.removal.evaluation import CANVAS
    from core.removal.synthesis.flare import CLASSES
    from core.removal.training.flare_bank import OneFlare, one_colour
    from core.removal.training.pairs import WHITE

    remover, backgrounds, unseen = Remover(weights), _held_out(folders), _unseen(lenses)
    seeds = [((1004, index, number), kind) for index, kind in enumerate(CLASSES) for number in range(count)]
    for name, white in (("of one colour", False), ("white", True)):
        colours = [WHITE if white else one_colour(np.random.default_rng(seed)) for seed, _ in seeds]
        _tell_gains(f"{name:13}", [_gain(remover, seed, OneFlare(seed, CANVAS, unseen, kind, colour), backgrounds)
                                   for (seed, kind), colour in zip(seeds, colours, strict=True)])


def odds(folders: list[Path], lenses: Path | None = None, weights: Path | None = None, count: int = 600) -> None:
    """What tells flares from scenes and their grades."""
    from core.removal.inference.confidence import CONSTANT, WEIGHTS, worth
    from core.removal.training.backgrounds import read_backgrounds

    remover = Remover(weights)
    found = _logistic(*_signs(remover, 1006, count, read_backgrounds(folders, "train", max(SIZE)), _seen(lenses)))
    print("WEIGHTS, CONSTANT =", ", ".join(f"{value:.3g}" for value in found))
    signs, gains = _signs(remover, 1007, count // 2, _held_out(folders), _unseen(lenses))
    flares = gains > 0
    for name, by in (("as it is", np.array([*WEIGHTS, CONSTANT])), ("by these", found)):
        log_odds = signs @ by[:-1] + by[-1]
        surely = np.mean(log_odds[flares][:, None] > log_odds[~flares])
        taken = np.array([worth(value) for value in log_odds])
        print(f"{name}: {surely:.3f} of pairs in order; taken of {flares.sum()} worth taking "
              f"{taken[flares].mean():.1%}, of {(~flares).sum()} that harm {taken[~flares].mean():.1%}; the first are "
              f"worth {gains[flares].mean():.2f} dB, of which {(gains * taken)[flares].mean():.2f} dB are had")


def _signs(remover: Remover, seed: int, count: int, backgrounds: Any, lenses: Any) -> tuple[Any, Any]:
    """(n, 5) signs of frames in which something is told, a third of `count` drawn under flares; (n,) what it is worth
    to take that, in dB. Of frames without flare those are left out which keep 45 dB, and the others are worth -5."""
    from core.removal.synthesis.flare import CLASSES
    from core.removal.training.flare_bank import OneFlare
    from core.removal.training.pairs import pair

    signs, gains = [], []
    for number in range(count):
        bare, kind = number % 3 > 0, CLASSES[number // 3 % len(CLASSES)]
        one = pair(np.random.default_rng((seed, number)), OneFlare((seed, number), 160, lenses, kind), backgrounds,
                   *SIZE, clean=float(bare), faded=0.25, shoulder=0.3, against_light=0.35)
        views = remover.views(one.frame)
        if views.signs is None:
            continue
        left = psnr(np.maximum(one.frame - views.mean, 0), one.scene)
        if not bare or left < 45:
            signs.append(views.signs)
            gains.append(-5.0 if bare else left - psnr(one.frame, one.scene))
    return np.array(signs), np.array(gains)


def _logistic(signs: Any, gains: Any) -> Any:
    """Weights (6,) of signs (n, 5) and a constant, of the odds that what is told is worth to be taken, each counting by
    its gain: Newton's method, held to small ones by a ridge of one observation."""
    middle, spread = signs.mean(0), signs.std(0)
    a = np.column_stack([(signs - middle) / spread, np.ones(len(signs))])
    counts, flares = np.minimum(np.abs(gains), 15) / 5, gains > 0
    ridge, found = np.diag([1.0] * signs.shape[1] + [0.0]), np.zeros(a.shape[1])
    for _ in range(30):
        p = 1 / (1 + np.exp(-a @ found))
        step = a.T @ (counts * (p - flares)) + ridge @ found
        found -= np.linalg.solve(a.T @ (a * (counts * p * (1 - p))[:, None]) + ridge, step)
    by_sign = found[:-1] / spread
    return np.append(by_sign, found[-1] - by_sign @ middle)


class _Moulded:
    """A bank of a single flare, the ghosts of lights through moulded aspheres and nothing besides."""

    def __init__(self, seed: tuple[int, ...]) -> None:
        self._seed = seed

    def draw(self, random: np.random.Generator) -> Any:
        """Another light and lens at every call."""
        from core.removal.evaluation import CANVAS
        from core.removal.synthesis.aspheric import ghosts as ghosts_of
        from core.removal.synthesis.flare import flare
        from core.removal.synthesis.prescription import built_in
        from core.removal.training.pairs import Layers

        seed = (*self._seed, int(random.integers(1 << 30)))
        made = flare(seed, CANVAS, built_in(), "scatter")
        ghosts = ghosts_of((*seed, 3), made.lights, CANVAS)
        return Layers(ghosts, np.zeros_like(ghosts), made.light, made.lights)


def aspheric(folders: list[Path], weights: Path | None = None, count: int = 64) -> None:
    """What removal gains of the ghosts of moulded lenses, of lights that have no other flare."""
    remover, backgrounds = Remover(weights), _held_out(folders)
    seeds = [(1005, number) for number in range(count)]
    _tell_gains("moulded lenses", [_gain(remover, seed, _Moulded(seed), backgrounds) for seed in seeds])


SIZE = (480, 320)
"""Of synthesised pictures, width and height."""


def _held_out(folders: list[Path]) -> Any:
    """The photographs that training leaves out."""
    from core.removal.training.backgrounds import read_backgrounds

    return read_backgrounds(folders, "test", max(SIZE))


def _gain(remover: Remover, seed: tuple[int, ...], bank: Any, backgrounds: Any, against_light: float = 0.0) -> float:
    """Of the picture of a seed under a flare of the bank, a share of those with their lights against the light."""
    from core.removal.training.pairs import pair

    one = pair(np.random.default_rng(seed), bank, backgrounds, *SIZE, clean=0, against_light=against_light)
    return psnr(remover.clean_display(one.frame), one.scene) - psnr(one.frame, one.scene)


def _tell_gains(name: str, gains: Any) -> None:
    print(f"{name} gain {np.mean(gains):+.2f} dB, made worse by 0.5 dB {np.mean(np.array(gains) < -0.5):.1%} of "
          f"{len(gains)}")


def matte(folders: list[Path], lenses: Path | None = None, weights: Path | None = None, count: int = 20) -> None:
    """What removal gains with a rough matte of the flare, and without."""
    from core.images.plates import Plate
    from core.removal.evaluation import synthetic

    remover, gains = Remover(weights), []
    for case in synthetic(1001, count, _held_out(folders), _unseen(lenses), SIZE):
        frame, truth, _ = case.read()
        found = Plate(Path("frame.png"), (frame * 65535 + 0.5).astype(np.uint16), "srgb")
        results = [remover.remove(found, marked)[0] / found.top for marked in (None, _roughed_in(frame, truth))]
        gains.append([psnr(result, truth) - psnr(frame, truth) for result in results])
    for name, values in zip(("without", "with a matte"), np.transpose(gains), strict=True):
        _tell_gains(f"{name:13}", values)


def _roughed_in(frame: Any, truth: Any) -> Any:
    """A matte (height, width), 0..1: specks are overlooked, the rest is circled widely."""
    import cv2

    changed = (np.abs(frame - truth).max(-1) > 0.05).astype(np.uint8)
    reach = max(frame.shape[:2]) // 20
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    wide = cv2.dilate(cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), kernel)
    return cv2.blur(wide.astype(np.float32), (reach // 2, reach // 2))


def coverage(sheet: Path | None = None, count: int = 400) -> None:
    """A histogram of the coverage of synthesised flares, as text, and a sheet of pictures."""
    from core.removal.model.image_formation import coverage as covered
    from core.removal.synthesis.flare import CLASSES, flare, through_aspheres
    from core.removal.synthesis.prescription import built_in

    lenses = built_in()
    shares = [covered(flare((1, number), 160, lenses).whole) for number in range(count)]
    counts, edges = np.histogram(shares, [0, 0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1])
    for k, value in enumerate(counts):
        print(f"{edges[k]:5.1%} to {edges[k + 1]:6.1%}  {value / count:6.1%}  {'#' * round(100 * value / count)}")
    print(f"median {np.median(shares):.1%}, below 2 %: {np.mean(np.array(shares) < 0.02):.0%}, above 70 %: "
          f"{np.mean(np.array(shares) > 0.7):.0%} of {count}")
    if sheet:
        rows = [[flare((5, number), 256, lenses, kind) for number in range(9)] for kind in CLASSES]
        rows.append([through_aspheres(flare((5, number), 256, lenses, "glare"), (5, number, 3)) for number in range(9)])
        tiles = [np.concatenate([np.clip(one.whole + one.light, 0, 1) ** (1 / 2.2) for one in row], 1) for row in rows]
        import cv2

        picture = (np.concatenate(tiles)[::2, ::2, ::-1] * 255).astype(np.uint8)
        cv2.imwrite(str(sheet), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])


WORDS: dict[str, dict[str, Any]] = {
    "folders": {"type": Path, "nargs": "+", "metavar": "PHOTOS"},
    "plate": {"type": Path},
    "--capture": {"type": Path, "metavar": "CAPTURE"},
    "--cleaned": {"type": Path, "metavar": "FOLDER", "help": "frames that were cleaned before, as by remove --run"},
    "--weights": {"type": Path, "metavar": "FILE", "help": "others than those in the box"},
    "--lenses": {"type": Path, "metavar": "FOLDER", "help": "prescriptions; without, those that come along"},
    "--sheet": {"type": Path, "metavar": "FILE", "help": "a picture of it"},
    "--count": {"type": int, "help": "pictures, or pictures of every class"},
    "--size": {"type": int, "help": "the network's, in pixels"},
}
"""What can be said of the parameters of a benchmark on the command line."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = parser.add_subparsers(required=True, metavar="BENCHMARK")
    for benchmark in (speed, one, sample, clean, scenes, matte, against, coloured, odds, aspheric, coverage):
        words = names.add_parser(benchmark.__name__, help=inspect.getdoc(benchmark))
        words.set_defaults(benchmark=benchmark)
        for name, parameter in inspect.signature(benchmark).parameters.items():
            if parameter.default is parameter.empty:
                words.add_argument(name, **WORDS[name])
            else:
                words.add_argument(f"--{name}", default=parameter.default, **WORDS[f"--{name}"])
    given = vars(parser.parse_args())
    given.pop("benchmark")(**given)


if __name__ == "__main__":
    main()
