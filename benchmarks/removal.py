# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures the cost and the quality of flare removal.

    python benchmarks/removal.py speed                       # 1920x1080 and 4096x2160, time and memory
    python benchmarks/removal.py sample [--capture CAPTURE]  # against the exact scene, and flicker; of frames that were
                                        [--cleaned FOLDER]   # cleaned before, as by remove --run, or by the network;
                                        [--sheet FILE]       # and a picture: frame, clean frame, exact scene
    python benchmarks/removal.py clean PHOTOS...             # pictures without flare, against themselves
    python benchmarks/removal.py matte PHOTOS... [--lenses LENSES]     # the gain with and without a matte
    python benchmarks/removal.py scenes PHOTOS...            # held-out scenes without flare, as training has them
    python benchmarks/removal.py against PHOTOS... [--lenses LENSES]   # flares whose lights are in a bright sky
    python benchmarks/removal.py coloured PHOTOS... [--lenses LENSES]  # flares of lights of a saturated colour
    python benchmarks/removal.py confidence PHOTOS... [--lenses LENSES]  # fits the confidence, and scores it
    python benchmarks/removal.py aspheric PHOTOS...          # ghosts of moulded lenses alone
    python benchmarks/removal.py coverage [--sheet FILE]     # the coverage of synthesised flares, and a sheet of them

Speed: each case in a process of its own, on torch's default threads; reading and writing included; the peak is the
process's resident memory. `full` is the network at the plate's own size, the ratio its time divided by that of the
working size.

Sample: PSNR in display values; flicker is the mean change of the error from one frame to the next, |(result - truth) of
a frame - the same of the frame before|, beside that of the untouched frames.

Clean: PSNR of the result against its input; 100 dB where they are equal to the last bit.

Matte: `count` synthesised pictures of every class, of held-out photographs and lenses and of another seed than
eval-removal's; the matte is rough as an artist would paint it: wide about all that the flare changes, with a soft rim.

Scenes: as `clean`, with the exposures, colours and grain of training, some with a light. Against: the same flares with
their lights where the scene is bright, and anywhere. Coloured: the same flares of lights of a saturated colour (traffic
lights, neon), and of the white ones that their class has. Aspheric: lights with no other flare than the ghosts of
telephones' lenses, which no class has.

Confidence: fits the weights of `core/removal/inference/confidence.py` by logistic regression on training pictures, a
third of them with flares of all classes, a fourth with lifted blacks, each flare weighted by its gain. Then it scores,
on held-out pictures, the weights in the file and these: the area under the curve, and how much of the useful and of the
harmful predictions is applied.
"""
from __future__ import annotations

import argparse
import inspect
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from core.system.thread_environment import set_thread_environment

set_thread_environment()

import numpy as np

from benchmarks.resident import peak_memory
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.write import write_exr, write_png
from core.metrics.pictures import psnr
from core.removal.inference.neighbours import ShotPredictor
from core.removal.inference.remover import WORKING_SIZE, Remover
from core.removal.jobs.batch import clean_plates
from core.system.progress import Progress

DESK = ROOT / "sample_scenes" / "desk"
SHOWN_FRAMES = 3
"""Frames on a sheet of the sample."""
CASES = {"1920x1080 png": (1920, 1080), "4096x2160 exr": (4096, 2160)}


def draw_plate(path: Path, width: int, height: int) -> None:
    """Draw a smooth picture with a bright spot, so that there is a flare to remove."""
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    glow = 0.5 / (1 + 30 * ((x - 0.4) ** 2 + (y + 0.3) ** 2))
    waves = 0.2 + 0.1 * np.sin(30 * x) * np.cos(23 * y)
    pixels = np.stack([waves + glow, waves * 0.8 + glow, waves * 0.6 + glow], -1).astype(np.float32)
    pixels[np.hypot(x - 0.4, y + 0.3) < 0.03] = 4.0
    if path.suffix == ".exr":
        write_exr(path, {name: pixels[..., index] for index, name in enumerate("RGB")})
    else:
        write_png(path, pixels)


def measure_plate(plate: Path, size: int = WORKING_SIZE, weights: Path | None = None) -> None:
    """Clean one plate twice and print seconds and peak MB as JSON; `speed` runs this in a process of its own."""
    start = time.perf_counter()
    remover = Remover(weights, working_size=size)
    loaded = time.perf_counter()
    clean_plates([plate], plate.parent / "out", remover, Progress(), overwrite=True)
    first = time.perf_counter()
    clean_plates([plate], plate.parent / "out", remover, Progress(), overwrite=True)
    print(json.dumps({"load_s": loaded - start, "first_s": first - loaded, "again_s": time.perf_counter() - first,
                      "peak_mb": peak_memory()}))


def measure_speed(weights: Path | None = None) -> None:
    """Print time and memory of each case, at the working size and at full size."""
    for name, (width, height) in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"plate.{name.split()[1]}"
            draw_plate(path, width, height)
            figures: dict[str, dict[str, float]] = {}
            for kind, size in (("working", WORKING_SIZE), ("full", width)):
                command = [sys.executable, __file__, "measure_plate", str(path), "--size", str(size)]
                command += ["--weights", str(weights)] if weights else []
                process = subprocess.run(command, capture_output=True, text=True, check=False)
                if process.returncode:
                    print(f"{name}, {kind}: failed, {process.stderr.strip().splitlines()[-1:]}")
                    continue
                figures[kind] = json.loads(process.stdout)
                measured = figures[kind]
                print(f"{name:16} {kind:8} load {measured['load_s']:5.2f} s, plate {measured['first_s']:6.2f} s, "
                      f"the next {measured['again_s']:6.2f} s, peak {measured['peak_mb']:6.0f} MB")
            if len(figures) == 2:
                print(f"{name:16} ratio    {figures['full']['again_s'] / figures['working']['again_s']:.1f}")


def score_sample(capture: Path = DESK, weights: Path | None = None, cleaned: Path | None = None,
                 sheet: Path | None = None) -> None:
    """Print the PSNR of every frame against the exact scene, and the flicker; with `sheet`, draw some frames.

    cleaned: folder of clean frames to score in place of those of the network.
    """
    previous_errors: Any = None
    scores, flicker, rows = [], [], []
    paths = sorted((capture / "images").iterdir())
    results = _clean_by_network(paths, weights) if cleaned is None else _read_cleaned(paths, cleaned)
    sheet_numbers = sheet_frames(len(paths))
    for number, (path, codes) in enumerate(zip(paths, results, strict=True)):
        truth = read_picture(capture / "truth" / "scene" / f"{path.stem}.exr").display()
        frame, result = (values.astype(np.float32) / 255 for values in (read_plate(path).codes, codes))
        scores.append((psnr(frame, truth), psnr(result, truth)))
        if number in sheet_numbers:
            rows.append(np.concatenate([frame, result, np.clip(truth, 0, 1)], 1))
        errors = (frame - truth, result - truth)
        if previous_errors is not None:
            flicker.append([float(np.abs(current - previous).mean())
                            for current, previous in zip(errors, previous_errors, strict=True)])
        previous_errors = errors
    psnr_before, psnr_after = np.mean(scores, 0)
    gains = np.diff(scores, axis=1)[:, 0]
    print(f"scene PSNR {psnr_after:.2f} dB, untouched {psnr_before:.2f}, gain {gains.mean():+.2f} "
          f"(lowest {gains.min():+.2f}, highest {gains.max():+.2f}) over {len(scores)} frames")
    print(f"flicker {np.mean(flicker, 0)[1]:.5f}, untouched {np.mean(flicker, 0)[0]:.5f}")
    if sheet:
        import cv2

        picture = cv2.resize(np.concatenate(rows), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(sheet), (picture[..., ::-1] * 255 + 0.5).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 88])


def sheet_frames(count: int) -> list[int]:
    """Return the indices of the frames on a sheet of a sample with `count` frames: up to SHOWN_FRAMES, evenly spaced.

    They begin at the end of the first of as many equal parts, at the sixth frame at the latest.
    """
    step = max(count // SHOWN_FRAMES, 1)
    return list(range(min(5, step - 1), count, step))[:SHOWN_FRAMES]


def _clean_by_network(paths: list[Path], weights: Path | None) -> Iterator[Any]:
    """Yield the codes of the clean frames, as `remove` makes them of a folder."""
    remover = Remover(weights)
    predictor = ShotPredictor(remover, paths)
    for path in paths:
        plate, prediction = predictor.predict(path)
        yield remover.remove(plate, prediction=prediction)[0]


def _read_cleaned(paths: list[Path], folder: Path) -> Iterator[Any]:
    """Yield the codes of frames that were cleaned before, under the same names with any suffix."""
    pictures = {path.stem: path for path in folder.iterdir()}
    return (read_plate(pictures[path.stem]).codes for path in paths)


def measure_clean_pictures(folders: list[Path], weights: Path | None = None) -> None:
    """Print how much pictures without flare are changed."""
    from core.removal.training.backgrounds import PHOTO_SUFFIXES, list_pictures

    remover = Remover(weights)
    values, unchanged = [], 0
    for path in (path for folder in folders for path in list_pictures(folder, PHOTO_SUFFIXES, "all")):
        plate = read_plate(path)
        codes = remover.remove(plate)[0]
        if np.array_equal(codes, plate.codes):
            unchanged += 1
            values.append(100.0)  # in place of an infinite PSNR
            continue
        values.append(psnr(codes / plate.max_code, plate.codes / plate.max_code))
    print(f"{len(values)} pictures, {unchanged} kept to the last bit; PSNR against the input: median "
          f"{np.median(values):.2f}, mean with 100 for the kept {np.mean(values):.2f}, 5 % below "
          f"{np.percentile(values, 5):.2f}, lowest {min(values):.2f} dB; {np.mean(np.array(values) >= 45):.0%} at 45 "
          "dB or more")


def measure_clean_scenes(folders: list[Path], weights: Path | None = None, count: int = 300) -> None:
    """Print how much held-out scenes without flare are changed."""
    from core.optics.prescription import built_in_lenses
    from core.removal.training.backgrounds import read_backgrounds
    from core.removal.training.flare_bank import SingleFlareBank
    from core.removal.training.pairs import make_pair

    remover, backgrounds = Remover(weights), read_backgrounds(folders, "test", 480)
    values = []
    for number in range(count):
        random = np.random.default_rng((1002, number))
        bank = SingleFlareBank((1002, number), 160, built_in_lenses(), "glow")
        frame = make_pair(random, bank, backgrounds, 480, 320, clean_share=1.0).frame
        values.append(min(psnr(remover.clean_display(frame), frame), 100.0))
    changed = sorted(value for value in values if value < 60)
    print(f"{len(values) - len(changed)} of {len(values)} scenes at 60 dB or more, "
          f"{np.mean(np.array(values) >= 45):.0%} at 45; the others "
          f"{', '.join(f'{value:.1f}' for value in changed) or 'none'} dB")


def _held_out_lenses(lenses: Path | None) -> Any:
    """Return the lenses of a folder that training leaves out."""
    from core.optics.prescription import read_lenses
    from core.removal.evaluation import held_out_lenses

    return held_out_lenses(read_lenses(lenses) if lenses else [])


def _training_lenses(lenses: Path | None) -> Any:
    """Return the lenses of a folder that training uses."""
    from core.optics.prescription import built_in_lenses, read_lenses
    from core.removal.training.backgrounds import is_held_out

    return [lens for lens in read_lenses(lenses) if not is_held_out(lens.name)] if lenses else built_in_lenses()


CLASSES_WITH_LIGHTS = ("scatter", "ghosts", "streak", "glow", "mixed")
"""Flare classes that have a light in the frame."""


def measure_against_light(folders: list[Path], lenses: Path | None = None, weights: Path | None = None,
                          count: int = 20) -> None:
    """Print the gain where lights are in a bright part of the scene, and where they are anywhere."""
    from core.removal.evaluation import CANVAS_SIZE
    from core.removal.training.flare_bank import SingleFlareBank

    remover, backgrounds, lenses_held_out = Remover(weights), _held_out_backgrounds(folders), _held_out_lenses(lenses)
    seeds = [((1003, index, number), kind) for index, kind in enumerate(CLASSES_WITH_LIGHTS) for number in range(count)]
    for name, share in (("against the light", 1.0), ("anywhere", 0.0)):
        gains = [_removal_gain(remover, seed, SingleFlareBank(seed, CANVAS_SIZE, lenses_held_out, kind), backgrounds,
                               share) for seed, kind in seeds]
        _print_gains(f"{name:17}", gains)


def measure_coloured_lights(folders: list[Path], lenses: Path | None = None, weights: Path | None = None,
                            count: int = 20) -> None:
    """Print the gain for flares of lights of a saturated colour, and for the same flares of white lights."""
    from core.removal.evaluation import CANVAS_SIZE
    from core.removal.synthesis.flare import FLARE_CLASSES
    from core.removal.training.flare_bank import SingleFlareBank, draw_saturated_colour
    from core.removal.training.pairs import WHITE

    remover, backgrounds, lenses_held_out = Remover(weights), _held_out_backgrounds(folders), _held_out_lenses(lenses)
    seeds = [((1004, index, number), kind) for index, kind in enumerate(FLARE_CLASSES) for number in range(count)]
    for name, white in (("of one colour", False), ("white", True)):
        colours = [WHITE if white else draw_saturated_colour(np.random.default_rng(seed)) for seed, _ in seeds]
        banks = [SingleFlareBank(seed, CANVAS_SIZE, lenses_held_out, kind, colour)
                 for (seed, kind), colour in zip(seeds, colours, strict=True)]
        _print_gains(f"{name:13}", [_removal_gain(remover, seed, bank, backgrounds)
                                    for (seed, _), bank in zip(seeds, banks, strict=True)])


def fit_confidence(folders: list[Path], lenses: Path | None = None, weights: Path | None = None,
                   count: int = 600) -> None:
    """Fit the weights of the confidence on training pictures and print them; then print, on held-out pictures, the
    scores of the weights in use and of the fitted ones."""
    from core.removal.inference.confidence import BIAS, FEATURE_WEIGHTS, confidence_from_log_odds
    from core.removal.training.backgrounds import read_backgrounds

    remover = Remover(weights)
    backgrounds = read_backgrounds(folders, "train", max(SIZE))
    fitted = _fit_logistic_regression(*_draw_features(remover, 1006, count, backgrounds, _training_lenses(lenses)))
    print("FEATURE_WEIGHTS, BIAS =", ", ".join(f"{value:.3g}" for value in fitted))
    features, gains = _draw_features(remover, 1007, count // 2, _held_out_backgrounds(folders),
                                     _held_out_lenses(lenses))
    is_useful = gains > 0  # the prediction brings the picture closer to the truth
    for name, coefficients in (("in use", np.array([*FEATURE_WEIGHTS, BIAS])), ("fitted", fitted)):
        log_odds = features @ coefficients[:-1] + coefficients[-1]
        auc = np.mean(log_odds[is_useful][:, None] > log_odds[~is_useful])
        applied = np.array([confidence_from_log_odds(value) for value in log_odds])
        print(f"{name}: area under the curve {auc:.3f}; applied of {is_useful.sum()} useful predictions "
              f"{applied[is_useful].mean():.1%}, of {(~is_useful).sum()} harmful ones "
              f"{applied[~is_useful].mean():.1%}; the useful ones gain {gains[is_useful].mean():.2f} dB, applied "
              f"{(gains * applied)[is_useful].mean():.2f} dB")


def _draw_features(remover: Remover, seed: int, count: int, backgrounds: Any, lenses: Any) -> tuple[Any, Any]:
    """Draw `count` frames, a third of them with flares; return (n, 5) features of their predictions and (n,) the gains
    of applying these, dB.

    Frames without flare count with a gain of -5. Left out are those that keep 45 dB, and frames without a prediction.
    """
    from core.removal.synthesis.flare import FLARE_CLASSES
    from core.removal.training.flare_bank import SingleFlareBank
    from core.removal.training.pairs import make_pair

    features, gains = [], []
    for number in range(count):
        # Two thirds are without flare; the others have each class in turn.
        without_flare, kind = number % 3 > 0, FLARE_CLASSES[number // 3 % len(FLARE_CLASSES)]
        bank = SingleFlareBank((seed, number), 160, lenses, kind)
        pair = make_pair(np.random.default_rng((seed, number)), bank, backgrounds, *SIZE,
                         clean_share=float(without_flare), lifted_black_share=0.25, shoulder_share=0.3,
                         against_light_share=0.35)
        prediction = remover.predict_with_tta(pair.frame)
        if prediction.features is None:
            continue
        psnr_after = psnr(np.maximum(pair.frame - prediction.mean, 0), pair.scene)
        if not without_flare or psnr_after < 45:
            features.append(prediction.features)
            gains.append(-5.0 if without_flare else psnr_after - psnr(pair.frame, pair.scene))
    return np.array(features), np.array(gains)


def _fit_logistic_regression(features: Any, gains: Any) -> Any:
    """Fit weights (6,) of features (n, 5) and a constant to the log odds that a prediction is useful.

    The constant is last. Predictions are weighted by the size of their gain, up to 15 dB. Newton's method, with a ridge
    penalty on the weights of the standardised features, none on the constant.
    """
    mean, deviation = features.mean(0), features.std(0)
    design = np.column_stack([(features - mean) / deviation, np.ones(len(features))])
    sample_weights, is_useful = np.minimum(np.abs(gains), 15) / 5, gains > 0
    ridge, parameters = np.diag([1.0] * features.shape[1] + [0.0]), np.zeros(design.shape[1])
    for _ in range(30):
        probabilities = 1 / (1 + np.exp(-design @ parameters))
        gradient = design.T @ (sample_weights * (probabilities - is_useful)) + ridge @ parameters
        curvature = sample_weights * probabilities * (1 - probabilities)
        parameters -= np.linalg.solve(design.T @ (design * curvature[:, None]) + ridge, gradient)
    weights = parameters[:-1] / deviation  # of the features as they are
    return np.append(weights, parameters[-1] - weights @ mean)


class _AsphericBank:
    """A source of flares for `make_pair`: the ghosts of lights through moulded aspheres and nothing besides."""

    def __init__(self, seed: tuple[int, ...]) -> None:
        self._seed = seed

    def draw(self, random: np.random.Generator) -> Any:
        """Return the ghosts of another light and lens at every call."""
        from core.optics.prescription import built_in_lenses
        from core.removal.evaluation import CANVAS_SIZE
        from core.removal.synthesis.aspheric import draw_ghosts
        from core.removal.synthesis.flare import synthesise_flare
        from core.removal.training.pairs import FlareLayers

        seed = (*self._seed, int(random.integers(1 << 30)))
        flare = synthesise_flare(seed, CANVAS_SIZE, built_in_lenses(), "scatter")
        ghosts = draw_ghosts((*seed, 3), flare.lights, CANVAS_SIZE)
        return FlareLayers(ghosts, np.zeros_like(ghosts), flare.light, flare.lights)


def measure_aspheric_ghosts(folders: list[Path], weights: Path | None = None, count: int = 64) -> None:
    """Print the gain for ghosts of moulded lenses, of lights that have no other flare."""
    remover, backgrounds = Remover(weights), _held_out_backgrounds(folders)
    seeds = [(1005, number) for number in range(count)]
    _print_gains("moulded lenses", [_removal_gain(remover, seed, _AsphericBank(seed), backgrounds) for seed in seeds])


SIZE = (480, 320)
"""Width and height of synthesised pictures."""


def _held_out_backgrounds(folders: list[Path]) -> Any:
    """Return the photographs that training leaves out."""
    from core.removal.training.backgrounds import read_backgrounds

    return read_backgrounds(folders, "test", max(SIZE))


def _removal_gain(remover: Remover, seed: tuple[int, ...], bank: Any, backgrounds: Any,
                  against_light_share: float = 0.0) -> float:
    """Return the gain of the removal in PSNR, dB, for the picture of a seed with a flare of the bank.

    against_light_share: probability that its lights stand in a bright part of the scene.
    """
    from core.removal.training.pairs import make_pair

    pair = make_pair(np.random.default_rng(seed), bank, backgrounds, *SIZE, clean_share=0,
                     against_light_share=against_light_share)
    return psnr(remover.clean_display(pair.frame), pair.scene) - psnr(pair.frame, pair.scene)


def _print_gains(name: str, gains: Any) -> None:
    """Print the mean of gains (n,), dB, and how many are below -0.5."""
    print(f"{name} gain {np.mean(gains):+.2f} dB, made worse by 0.5 dB {np.mean(np.array(gains) < -0.5):.1%} of "
          f"{len(gains)}")


def measure_matte_gain(folders: list[Path], lenses: Path | None = None, weights: Path | None = None,
                       count: int = 20) -> None:
    """Print the gain with a rough matte of the flare, and without."""
    from core.images.plates import Plate
    from core.removal.evaluation import synthetic_cases

    remover, gains = Remover(weights), []
    for case in synthetic_cases(1001, count, _held_out_backgrounds(folders), _held_out_lenses(lenses), SIZE):
        frame, truth, _ = case.read()
        plate = Plate(Path("frame.png"), (frame * 65535 + 0.5).astype(np.uint16), "srgb")
        results = [remover.remove(plate, marked)[0] / plate.max_code for marked in (None, _rough_matte(frame, truth))]
        gains.append([psnr(result, truth) - psnr(frame, truth) for result in results])
    for name, values in zip(("without", "with a matte"), np.transpose(gains), strict=True):
        _print_gains(f"{name:13}", values)


def _rough_matte(frame: Any, truth: Any) -> Any:
    """Return a matte (height, width), 0..1, of where the pictures differ: without specks, widened, its rim soft."""
    import cv2

    changed = (np.abs(frame - truth).max(-1) > 0.05).astype(np.uint8)
    brush = max(frame.shape[:2]) // 20
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (brush, brush))
    widened = cv2.dilate(cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), kernel)
    return cv2.blur(widened.astype(np.float32), (brush // 2, brush // 2))


def print_coverage(sheet: Path | None = None, count: int = 400) -> None:
    """Print a histogram of the coverage of synthesised flares, the share of the frame that holds nine tenths of their
    energy; with `sheet`, draw a sheet of them."""
    from core.optics.prescription import built_in_lenses
    from core.removal.model.image_formation import coverage
    from core.removal.synthesis.flare import FLARE_CLASSES, add_aspheric_ghosts, synthesise_flare

    lenses = built_in_lenses()
    shares = [coverage(synthesise_flare((1, number), 160, lenses).total) for number in range(count)]
    counts, edges = np.histogram(shares, [0, 0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1])
    for low, high, value in zip(edges[:-1], edges[1:], counts, strict=True):
        print(f"{low:5.1%} to {high:6.1%}  {value / count:6.1%}  {'#' * round(100 * value / count)}")
    print(f"median {np.median(shares):.1%}, below 2 %: {np.mean(np.array(shares) < 0.02):.0%}, above 70 %: "
          f"{np.mean(np.array(shares) > 0.7):.0%} of {count}")
    if sheet:
        rows = [[synthesise_flare((5, number), 256, lenses, kind) for number in range(9)] for kind in FLARE_CLASSES]
        rows.append([add_aspheric_ghosts(synthesise_flare((5, number), 256, lenses, "glow"), (5, number, 3))
                     for number in range(9)])
        tiles = [np.concatenate([np.clip(flare.total + flare.light, 0, 1) ** (1 / 2.2) for flare in row], 1)
                 for row in rows]
        import cv2

        picture = (np.concatenate(tiles)[::2, ::2, ::-1] * 255).astype(np.uint8)
        cv2.imwrite(str(sheet), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])


BENCHMARKS: dict[str, Callable[..., None]] = {
    "speed": measure_speed, "measure_plate": measure_plate, "sample": score_sample, "clean": measure_clean_pictures,
    "scenes": measure_clean_scenes, "matte": measure_matte_gain, "against": measure_against_light,
    "coloured": measure_coloured_lights, "confidence": fit_confidence, "aspheric": measure_aspheric_ghosts,
    "coverage": print_coverage,
}
"""The benchmarks by the name of their command."""
PARAMETERS: dict[str, dict[str, Any]] = {
    "folders": {"type": Path, "nargs": "+", "metavar": "PHOTOS"},
    "plate": {"type": Path},
    "--capture": {"type": Path, "metavar": "CAPTURE"},
    "--cleaned": {"type": Path, "metavar": "FOLDER", "help": "frames that were cleaned before, as by remove --run"},
    "--weights": {"type": Path, "metavar": "FILE", "help": "other weights than the program's own"},
    "--lenses": {"type": Path, "metavar": "FOLDER", "help": "lens prescriptions (default: the program's own)"},
    "--sheet": {"type": Path, "metavar": "FILE", "help": "write a picture"},
    "--count": {"type": int, "help": "pictures, or pictures of every class"},
    "--size": {"type": int, "help": "the network's, in pixels"},
}
"""Command line options of the benchmarks' parameters."""


def main() -> None:
    """Run the benchmark that the arguments name; its parameters are its options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = parser.add_subparsers(required=True, metavar="BENCHMARK")
    for name, benchmark in BENCHMARKS.items():
        aliases = ["odds"] if name == "confidence" else []  # its former name
        subparser = names.add_parser(name, aliases=aliases, help=inspect.getdoc(benchmark))
        subparser.set_defaults(benchmark=benchmark)
        for option, parameter in inspect.signature(benchmark).parameters.items():
            if parameter.default is parameter.empty:
                subparser.add_argument(option, **PARAMETERS[option])
            else:
                subparser.add_argument(f"--{option}", default=parameter.default, **PARAMETERS[f"--{option}"])
    options = vars(parser.parse_args())
    options.pop("benchmark")(**options)


if __name__ == "__main__":
    main()
