# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads mutated files of every format: `python tests/faults/fuzz.py --count 10000`.

Bytes, words and JSON values of valid files are replaced, and each file is read as the program reads it. A reader may
succeed or raise FitFlareError (OSError too, which the commands report in a sentence). Anything else is a failure, and
so are ten seconds for one file, and a gigabyte of memory. Each format is read in a forked process, so that a crash
of a library counts as a failure and does not end the others. Prints a table by format; the exit status is 1 where
anything failed. `test_faults.py` reads a few files of each in its own process.
"""
from __future__ import annotations

import argparse
import contextlib
import copy
import importlib.util
import json
import os
import pickle
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

import cv2
import numpy as np
import torch
from PIL import Image, features

from core.bake.bake import read_manifest
from core.capture import Capture, read_lights
from core.capture.colmap import read_model
from core.capture.ply import read_points
from core.conventions import exposures
from core.errors import FitFlareError
from core.fit import checkpoint, preset
from core.fit.config import read_config, write_config
from core.fit.run import Run
from core.fit.run_loop import _truncate_metrics
from core.flare.file import FlareFile
from core.flare.file import load as load_flare
from core.flare.file import save as save_flare
from core.gaussians.ply import read_ply, write_ply
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.video import Video
from core.images.write import write_exr
from core.look import TrainedCamera, read_look
from core.look.keyed import KeyedEdits
from core.look.shot import Shot, ShotFrame
from core.removal.jobs.manifest import Manifest
from core.removal.model import weights
from core.removal.model.recipe import Recipe, as_dict, from_dict
from core.removal.training.run import _read_log
from core.system.files import read_json, write_json
from tests.core.captures import make_capture, make_transforms
from tests.core.flared import cameras
from tests.core.picture_files import WRITERS, scene
from tests.core.removal_cases import network_file, picture
from tests.core.test_flare import some_flare
from tests.core.videos import X265, stripes, write_video
from tests.faults.media import media
from tests.faults.records import records

TIME_LIMIT_S = 10
MEMORY_LIMIT = 1 << 30
UNWRITABLE = {name for name, package in (("HEIC", "pillow_heif"),) if importlib.util.find_spec(package) is None}
UNWRITABLE |= set() if features.check("avif") else {"PQ AVIF"}
"""Formats of pictures whose encoder is not installed."""
_NUMBERS = ["1" + "0" * 400, "-1", "0", "1e999", "NaN", "Infinity", "9223372036854775808", "2147483648", "1e-320",
            "0.5", "99999999999", "-0.0"]
_WORDS = ["null", "true", "[]", "{}", '""', '"x"', "[" * 3000, '{"a":' * 3000, r'"\u0000"', r'"\ud800"',
          '"' + "n" * 300 + '"', '"../../x"', '"/etc/passwd"', "\n", "=", ",", "#", " ", "\xff"]
_VALUES: list[Any] = [None, True, False, -1, 0, 1, 2**31, 2**63, 10**400, 1e308, float("nan"), float("inf"), "", "x",
                      "\0", "\ud800", "a" * 300, "../x", [], {}, [[]], [None], {"a": 1}, [1, 2, 3], [[0] * 4] * 4]


class Format(NamedTuple):
    """A kind of file. folder: holds a valid one, and what belongs to it. file: its name, which is mutated. read: reads
    the folder with the mutated file."""

    name: str
    folder: Path
    file: str
    read: Callable[[Path], Any]


def formats(base: Path) -> list[Format]:
    """Write a valid file of every format below `base`, and return the formats with their readers."""
    from tests.core.test_interop_splats import write_compressed

    found: list[Format] = []

    def add(name: str, file: str, reader: Callable[[Path], Any], make: Callable[[Path], Any]) -> None:
        folder = base / name.replace(" ", "_")
        if not folder.exists():
            folder.mkdir(parents=True)
            make(folder)
        found.append(Format(name, folder, file, reader))

    def file(name: str, data: str | bytes) -> Callable[[Path], Any]:
        return lambda folder: (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)

    def open_capture(folder: Path) -> None:
        Capture.open(folder / "c", need_frames=False)

    def with_lights(folder: Path) -> None:
        make_transforms(folder / "c")
        write_json(folder / "lights.json", {"lights": [
            {"name": "lamp", "xyz": [1.0, 2.0, 3.0]},
            {"name": "torch", "frames": {"0000.png": {"xy": [1.0, 2.0], "on": 0.5}}}], "found": [[1, 2, 3]]})
        write_json(folder / "split.json", {"test": [Capture.open(folder / "c").views[1].name]})

    def binary_model(folder: Path) -> None:
        make_capture(folder / "c")
        write_binary_model(folder / "c" / "sparse" / "0")

    add("transforms.json", "c/transforms.json", open_capture, lambda folder: make_transforms(folder / "c"))
    for part in ("cameras", "images", "points3D"):
        add(f"COLMAP text {part}", f"c/sparse/0/{part}.txt", open_capture, lambda folder: make_capture(folder / "c"))
        add(f"COLMAP binary {part}", f"c/sparse/0/{part}.bin", lambda folder: read_model(folder / "c/sparse/0"),
            binary_model)
    add("lights.json", "lights.json", lambda folder: read_lights(folder / "lights.json"), with_lights)
    add("split.json", "split.json", lambda folder: Capture.open(folder / "c").split(str(folder / "split.json")),
        with_lights)
    add("exposures.json", "exposures.json", exposures.read_exposures,
        file("exposures.json", '{"1.png": 1.5, "2.png": 0.7}'))
    add("config.toml", "config.toml", lambda folder: read_config(folder / "config.toml"),
        lambda folder: write_config(folder / "config.toml", preset("draft")))

    def make_run(folder: Path) -> None:
        write_config(folder / "config.toml", preset("draft"))
        (folder / "capture.txt").write_text(f"{folder}\n")

    add("capture.txt", "capture.txt", Run.open, make_run)
    lines = "".join(json.dumps({"iteration": number, "loss": 0.1}) + "\n" for number in range(5))
    add("metrics.jsonl", "metrics.jsonl", lambda folder: _truncate_metrics(folder / "metrics.jsonl", 3),
        file("metrics.jsonl", lines))
    add("training.jsonl", "training.jsonl", lambda folder: _read_log(folder / "training.jsonl", 3),
        file("training.jsonl", lines))
    keyed = {"set": ["lamp.intensity=2"], "frames": {"1": ["lamp.tint=1,0.5,0.2"], "9": ["lamp.scale=2"]}}
    add("edits.json", "edits.json", lambda folder: KeyedEdits.read(folder / "edits.json").edits_at(4, ["lamp"]),
        file("edits.json", json.dumps(keyed)))
    add("edits.toml", "edits.toml", lambda folder: KeyedEdits.read(folder / "edits.toml").edits_at(4, ["lamp"]),
        file("edits.toml", 'set = ["lamp.intensity=2"]\n[frames]\n1 = ["lamp.tint=1,0.5,0.2"]\n9 = ["lamp.scale=2"]\n'))
    tables = {"plates": {"a.png": "1"}, "flares": {"a.png": "f/a.exr"}, "flares_made": {"a.png": "1"},
              "sources": {"a.png": "2"}, "written": {"a.png": "3"}}
    add("remove.json", "remove.json", read_removed, file("remove.json", json.dumps(tables)))
    manifest = {"version": 1, "made_from": {"run": "1"}, "layers": {"lamp": "flare_lamp"}, "frames": [
        {"frame": 1, "file": "layers.0001.exr", "width": 64, "height": 48, "rest": []}]}
    add("bake.json", "bake.json", read_manifest, file("bake.json", json.dumps(manifest)))
    look = FlareFile(some_flare(count=6), "over", TrainedCamera(64, 40, 70.0, 70.0, 33.0, 19.5))
    for name, load in (("flare, look", read_look), ("flare, model", load_flare)):
        add(name, "look.flare", lambda folder, load=load: load(folder / "look.flare"),  # type: ignore[misc]
            lambda folder: save_flare(folder / "look.flare", look))

    def make_shot(folder: Path) -> None:
        save_flare(folder / "look.flare", look)
        Shot(folder / "look.flare", tuple(ShotFrame(number, "Camera", camera, (), ("lamp 0.scale=2",))
                                          for number, camera in enumerate(cameras(2), 1))).write(folder / "shot.json")

    add("shot.json", "shot.json", lambda folder: Shot.read(folder / "shot.json").folders, make_shot)
    state = {"iteration": 3, "scene": {"means": torch.zeros(4, 3)}, "views": [["a", "b"]],
             "table": torch.nn.functional.one_hot(torch.tensor([7]), 200_000).T.float().expand(-1, 2)}
    add("checkpoint", "state.safetensors", lambda folder: checkpoint.load(folder / "state.safetensors"),
        lambda folder: checkpoint.save(folder / "state.safetensors", state))

    def load_weights(folder: Path) -> None:
        weights.load_network.__wrapped__(folder / "w.safetensors")

    add("weights", "w.safetensors", load_weights, lambda folder: network_file(folder / "w.safetensors"))
    add("recipe", "recipe.json", lambda folder: from_dict(read_json(folder / "recipe.json", FitFlareError)),
        file("recipe.json", json.dumps(as_dict(Recipe()))))
    points = ("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
              "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n" + "1 2 3 4 5 6\n" * 3)
    add("PLY ascii", "p.ply", lambda folder: read_points(folder / "p.ply"), file("p.ply", points))
    binary = points.split("end_header\n")[0].replace("ascii", "binary_little_endian") + "end_header\n"
    add("PLY binary", "p.ply", lambda folder: read_points(folder / "p.ply"),
        file("p.ply", binary.encode() + struct.pack("<3f3B", 1, 2, 3, 4, 5, 6) * 3))
    add("PLY gaussians", "s.ply", lambda folder: read_ply(folder / "s.ply"),
        lambda folder: write_ply(folder / "s.ply", some_scene()))
    add("PLY compressed", "s.ply", lambda folder: read_ply(folder / "s.ply"),
        lambda folder: write_compressed(folder / "s.ply", some_scene()))
    codes = picture(24, 32)
    for suffix in (".png", ".jpg", ".tif"):
        add(f"picture {suffix}", f"a{suffix}", lambda folder, suffix=suffix: read_both(folder / f"a{suffix}"),  # type: ignore[misc]
            lambda folder, suffix=suffix: cv2.imwrite(str(folder / f"a{suffix}"), codes))  # type: ignore[misc]
    light = scene()
    for name, (file_name, _, write) in WRITERS.items():
        if name not in UNWRITABLE:
            add(f"picture {name}", file_name,
                lambda folder, file_name=file_name: read_both(folder / file_name),  # type: ignore[misc]
                lambda folder, file_name=file_name, write=write: write(folder / file_name, light))  # type: ignore[misc]
    for suffix, options in (("gif", {}), ("avif", {"quality": 90}), ("webp", {"quality": 60})):
        add(f"picture lossy {suffix}", f"a.{suffix}",
            lambda folder, suffix=suffix: read_both(folder / f"a.{suffix}"),  # type: ignore[misc]
            lambda folder, suffix=suffix, options=options: Image.fromarray(codes).save(  # type: ignore[misc]
                folder / f"a.{suffix}", **options))
    for name, codec, pixels, tags in (
            ("h264.mp4", "libx264", "yuv420p", None), ("hevc.mp4", "libx265", "yuv420p10le", (9, 16, 9)),
            ("ffv1.mkv", "ffv1", "gbrp10le", None), ("prores.mov", "prores_ks", "yuva444p10le", None),
            ("vp9.webm", "libvpx-vp9", "yuv420p", None), ("mpeg2.ts", "mpeg2video", "yuv420p", None)):
        add(f"video {name}", name, lambda folder, name=name: read_video(folder / name),  # type: ignore[misc]
            lambda folder, name=name, codec=codec, pixels=pixels, tags=tags: write_video(  # type: ignore[misc]
                folder / name, codec, pixels, [stripes(64, 64)] * 4, matrix=9 if tags else 1, tags=tags,
                options=X265 if codec == "libx265" else {}, alpha=np.ones((64, 64)) if "yuva" in pixels else None))
    add("picture .exr", "a.exr", lambda folder: read_both(folder / "a.exr"), lambda folder: write_exr(
        folder / "a.exr", {channel: np.ones((24, 32), np.float32) for channel in "RGB"}))
    for other in (*media(), *records()):
        add(other.name, other.file, lambda folder, other=other: other.read(folder / other.file),  # type: ignore[misc]
            lambda folder, other=other: other.write(folder / other.file))  # type: ignore[misc]
    return found


def some_scene() -> Any:
    """Return a scene of a few Gaussians."""
    from core.capture.colmap import PointCloud
    from core.gaussians.scene import SceneGaussians

    xyz = np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32)
    return SceneGaussians.from_points(PointCloud(xyz, np.full((5, 3), 90, np.uint8), np.zeros(5, np.float32)))


def write_binary_model(folder: Path) -> None:
    """Replace a text model by a binary one."""
    import pycolmap

    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for path in folder.glob("*.txt"):
        path.unlink()


def read_removed(folder: Path) -> None:
    """Read remove.json as a job does."""
    manifest = Manifest(folder)
    manifest.is_up_to_date(Path("a.png"), "1", [folder / "a.png"])
    list(manifest.unedited_frames([Path("a.png")]))
    manifest.result_paths()


def read_video(path: Path) -> None:
    """Decode all frames of a video."""
    with Video(path) as video:
        for frame in video:
            frame.picture()


def read_both(path: Path) -> None:
    """Read a picture as a frame and as a plate."""
    for reader in (read_picture, read_plate):
        with contextlib.suppress(FitFlareError):
            reader(path)
    read_picture(path)


def mutate(data: bytes, chance: random.Random) -> bytes:
    """Return a damaged copy of a file: changed bytes, words or JSON values, or a false header with a right checksum."""
    head = int.from_bytes(data[:8], "little") if len(data) > 16 and data[8:9] == b"{" else 0
    kind = chance.random()
    if data[:4] == b"\x89PNG" and kind < 0.5:  # a wrong header with a right checksum
        header = bytearray(_mutate_bytes(data[16:29], chance)[:13].ljust(13, b"\0"))
        return data[:16] + header + zlib.crc32(data[12:16] + header).to_bytes(4, "big") + data[33:]
    if head and kind < 0.6:  # the header of safetensors
        header = data[8:8 + head]
        changed = _mutate_json(header, chance) if kind < 0.45 else _mutate_text(header, chance)
        return len(changed).to_bytes(8, "little") + changed + data[8 + head:]
    if data[:1] in (b"{", b"[") and kind < 0.6:
        return _mutate_json(data, chance)
    if kind < 0.75 and _is_text(data):
        return _mutate_text(data, chance)
    return _mutate_bytes(data, chance)


def _is_text(data: bytes) -> bool:
    return all(byte >= 9 for byte in data[:2000])


def _mutate_bytes(data: bytes, chance: random.Random) -> bytes:
    """Return the bytes with 1 to 20 changes: bytes or numbers overwritten, deleted, repeated or inserted."""
    changed = bytearray(data)
    for _ in range(chance.choice([1, 1, 2, 5, 20])):
        at = int(len(changed) * chance.random() ** chance.choice([1, 3]))  # more often near the beginning
        match chance.randrange(6):
            case 0:
                changed[at:at + 1] = bytes([chance.randrange(256)])
            case 1:
                changed[at:at + 4] = struct.pack("<i", chance.choice([-1, 0, 1, 2**31 - 1, -2**31, 65535]))
            case 2:
                changed[at:at + 8] = struct.pack("<d", chance.choice([float("nan"), float("inf"), 1e308, -1.0]))
            case 3:
                del changed[at:at + chance.choice([1, 4, 30, len(changed)])]
            case 4:
                changed[at:at] = changed[at:at + chance.choice([1, 8, 100])]
            case _:
                changed[at:at] = bytes(chance.randrange(256) for _ in range(chance.choice([1, 4])))
    return bytes(changed)


def _mutate_text(data: bytes, chance: random.Random) -> bytes:
    """Return the text with 1 to 4 words or numbers replaced by awkward ones."""
    text = data.decode("latin-1")
    for _ in range(chance.choice([1, 1, 2, 4])):
        words = list(_tokens(text))
        if not words:
            return data
        begin, end = chance.choice(words)
        text = text[:begin] + chance.choice(_NUMBERS + _WORDS) + text[end:]
    return text.encode("latin-1")


def _tokens(text: str) -> Iterator[tuple[int, int]]:
    """Yield begin and end of each word or number."""
    import re

    return (match.span() for match in re.finditer(r"[\w.+-]+", text))


def _mutate_json(data: bytes, chance: random.Random) -> bytes:
    """Return the JSON with 1 to 3 values deleted, repeated or replaced; in a .flare, values of the JSON in its
    metadata.

    Text that is no JSON is changed byte by byte.
    """
    try:
        tree = json.loads(data)
    except ValueError:
        return _mutate_bytes(data, chance)
    for _ in range(chance.choice([1, 1, 2, 3])):
        places: list[tuple[Any, Any]] = []
        inner = {key: json.loads(text) for key, text in tree.get("__metadata__", {}).items()
                 if isinstance(text, str) and text[:1] == "{"} if isinstance(tree, dict) and isinstance(
                     tree.get("__metadata__", {}), dict) else {}
        _walk(inner or tree, places)
        if not places:
            break
        table, key = chance.choice(places)
        match chance.randrange(5):
            case 0 if isinstance(table, dict):
                del table[key]
            case 1 if isinstance(table, list):
                table.insert(key, copy.deepcopy(table[key]))
            case _:
                table[key] = copy.deepcopy(chance.choice(_VALUES))
        for name, value in inner.items():
            tree["__metadata__"][name] = json.dumps(value)
    return json.dumps(tree).encode("utf-8")


def _walk(value: Any, places: list[tuple[Any, Any]]) -> None:
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        places.append((value, key))
        _walk(value[key], places)


class Result(NamedTuple):
    """Numbers of files by outcome; the failures; the slowest file, seconds; the memory that was added, bytes."""

    counts: Counter[str]
    failures: list[str]
    slowest_s: float
    memory: int


def fuzz(one: Format, count: int, seed: int, keep: Path | None = None) -> Result:
    """Read `count` mutated files of a format and count how that ends; the valid file is restored.

    keep: folder for the files that fail: by another error than a refusal, or by taking too long.
    """
    path = one.folder / one.file
    valid = path.read_bytes()
    one.read(one.folder)  # the valid file
    chance = random.Random(f"{seed} {one.name}")
    counts: Counter[str] = Counter()
    failures: list[str] = []
    slowest, before = 0.0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(count):
        data = mutate(valid, chance)
        path.write_bytes(data)
        began = time.monotonic()
        problem = _attempt(one)
        taken = time.monotonic() - began
        slowest = max(slowest, taken)
        if problem is None:
            counts["read"] += 1
        elif isinstance(problem, FitFlareError | OSError) and not isinstance(problem, TimeoutError):
            counts["refused"] += 1
        else:
            counts["failed"] += 1
            where = "".join(traceback.format_tb(problem.__traceback__)[-2:])
            failures.append(f"{one.name} {number}: {type(problem).__name__}: {str(problem)[:200]}\n{where}")
            if keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{one.name.replace(' ', '_')}_{number}").write_bytes(data)
    path.write_bytes(valid)
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    if memory > MEMORY_LIMIT:
        failures.append(f"{one.name}: {memory >> 20} MB of memory")
    return Result(counts, failures, slowest, memory)


def _attempt(one: Format) -> BaseException | None:
    """Read the file; return what that raises, TimeoutError after TIME_LIMIT_S, or None. Uses SIGALRM."""
    def ring(*_: object) -> None:
        raise TimeoutError(f"it takes more than {TIME_LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, TIME_LIMIT_S)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            one.read(one.folder)
    except Exception as problem:
        return problem
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    return None


def _fuzz_in_fork(one: Format, count: int, seed: int, keep: Path) -> Result:
    """Call `fuzz` in a forked process and return its result; the death of the process counts as a failure."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        os.close(reading)
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 2)  # libraries of pictures talk
            result = fuzz(one, count, seed, keep)
        except BaseException as problem:
            result = Result(Counter(), [f"{one.name}: {traceback.format_exc()} {problem}"], 0, 0)
        with os.fdopen(writing, "wb") as stream:
            pickle.dump(result, stream)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as stream:
        data = stream.read()
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if status or not data:
        return Result(Counter(), [f"{one.name}: the process ended with {status}"], 0, 0)
    result: Result = pickle.loads(data)
    return result


def main(argv: list[str]) -> int:
    """Fuzz every format and print a table; return the exit status, 1 if anything failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="files, over all formats")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], help="names of formats")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "fuzz-failures")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    base = Path(tempfile.mkdtemp(prefix="fuzz-"))
    chosen = [one for one in formats(base) if not args.only or one.name in args.only]
    total: Counter[str] = Counter()
    failed = 0
    print(f"{'format':<24} {'files':>6} {'read':>6} {'refused':>8} {'failed':>7} {'slowest s':>10} {'MB':>6}")
    for index, one in enumerate(chosen):
        count = args.count // len(chosen) + (index < args.count % len(chosen))
        result = _fuzz_in_fork(one, count, args.seed, args.keep)
        total += result.counts
        failed += len(result.failures)
        print(f"{one.name:<24} {count:>6} {result.counts['read']:>6} {result.counts['refused']:>8} "
              f"{len(result.failures):>7} {result.slowest_s:>10.2f} {result.memory >> 20:>6}", flush=True)
        for text in list(dict.fromkeys(result.failures))[:5]:
            print("  " + text.strip().replace("\n", "\n  "), flush=True)
    print(f"{'all':<24} {sum(total.values()):>6} {total['read']:>6} {total['refused']:>8} {failed:>7}")
    shutil.rmtree(base, ignore_errors=True)
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
