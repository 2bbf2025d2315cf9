# SPDX-License-Identifier: GPL-3.0-or-later
"""One scene in files of many formats: fit, lights, remove, transfer and bake see the same light in all of them."""
from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from fit_flare.core.fit.frames import Frames
from fit_flare.core.images.picture import Picture
from fit_flare.core.lights.exposure import ExposureDetector
from fit_flare.headless import cli
from numpy.typing import NDArray

from core.bake.exr import read_layers
from core.capture import Camera
from core.capture.colmap import ObservedFrame, PointCloud, write_model
from core.capture.lens import Lens
from core.colour import ColourSpace, colour_space
from core.colour.srgb import linear_from_srgb
from core.fit import Run
from core.fit.settings import SceneRates
from core.gaussians import rasterization, spherical_harmonics
from core.gaussians.ply import write_ply
from core.gaussians.scene import COEFFICIENTS, SceneGaussians
from core.images.plates import clean_name
from core.images.read import read_picture
from tests.core.captures import orbit
from tests.core.picture_files import WRITERS
from tests.core.removal_cases import network_file
from tests.core.videos import X265, write_video

SIZE = WIDTH, HEIGHT = 96, 64
VIEWS, GAUSSIANS, ITERATIONS = 5, 90, 60
LAMP, LAMP_DISPLAY, LAMP_SCALE, LAMP_GAUSSIANS = np.array([0.2, -0.5, 0.0]), 2.2, 0.08, 6
LAMP_REACH = 12.0
"""px around the lamp that are not compared."""
MIDDLE = (0.05, 0.7)
"""Light that every format holds."""
LOOK = Path(__file__).resolve().parents[2] / "flare_addon" / "library_looks" / "Clean Prime.flare"
STILLS = ("sRGB PNG", "linear PNG", "PQ PNG", "LogC4 TIFF", "ACEScg EXR", "Y/RY/BY EXR", "log DPX", "P3 JPEG", "HEIC")
VIDEOS: dict[str, tuple[str, str, str, dict[str, Any]]] = {
    "HLG video": ("hlg.mp4", "libx265", "yuv422p10le", {"matrix": 9, "tags": (9, 18, 9), "options": X265}),
    "full-range 10 bit video": ("full.mp4", "libx265", "yuv422p10le", {"tags": (1, 1, 1), "full": True,
                                                                       "options": X265}),
    "RGB video": ("rgb.mkv", "ffv1", "gbrp10le", {"matrix": 0}),
}
"""File, codec, pixels, and what else `write_video` takes."""

Light = NDArray[Any]


class Scene(NamedTuple):
    """Cameras and the light of their frames, and a scene with wrong colours from which the fits start."""

    cameras: list[Camera]
    light: list[Light]
    start: Path


class Shot(NamedTuple):
    """The scene as a capture in one format: its frames, and the colour space to name."""

    folder: Path
    frames: list[Path]
    space: ColourSpace | None

    @property
    def words(self) -> list[str]:
        return [] if self.space is None else ["--plate-space", self.space.name]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene of large soft Gaussians and a lamp brighter than white: its cameras, linear light, and start splats."""
    random = np.random.default_rng(3)
    means = random.uniform((-2.6, -1.8, 0.5), (2.6, 1.8, 1.5), (GAUSSIANS, 3))
    scales, colours = np.full((GAUSSIANS, 3), 0.4), random.uniform(0.35, 0.8, (GAUSSIANS, 3))
    means, scales, colours = (np.concatenate([part, np.full((LAMP_GAUSSIANS, 3), lamp)]) for part, lamp in (
        (means, LAMP), (scales, LAMP_SCALE), (colours, LAMP_DISPLAY)))
    count = len(means)
    sh = torch.zeros(count, COEFFICIENTS, 3)
    sh[:, 0] = spherical_harmonics.dc_from_colour(torch.from_numpy(colours.astype(np.float32)))
    splats = SceneGaussians(torch.from_numpy(means.astype(np.float32)),
                            torch.from_numpy(np.log(scales).astype(np.float32)),
                            torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count,), 3.0), sh)
    cameras, light = orbit(VIEWS, size=SIZE, arc=0.5), []
    for camera in cameras:
        view = torch.from_numpy(camera.world_to_camera).float(), torch.from_numpy(camera.intrinsics).float()
        display = rasterization(splats.means, splats.quaternions, splats.scales, splats.opacities, splats.sh, *view,
                                WIDTH, HEIGHT, kernels="torch").colour.clamp(min=0).detach().numpy()
        light.append(linear_from_srgb(display))
    start = tmp_path_factory.mktemp("scene") / "start.ply"
    with torch.no_grad():
        splats.sh *= 0.9
    write_ply(start, splats)
    return Scene(cameras, light, start)


def lamp_distance(camera: Camera) -> NDArray[np.float64]:
    """(height, width) px from the middle of the lamp."""
    (x, y), = camera.project(LAMP[None])[0]
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.asarray(np.hypot(columns - x, rows - y))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return network_file(tmp_path_factory.mktemp("weights") / "everywhere.safetensors", bias=0.1)


def film(name: str, scene: Scene, folder: Path, run: Callable[..., Any], weights: Path) -> Shot:
    """Write the scene as a capture with frames of a format; return it.

    name: of the format in VIDEOS or WRITERS. The frames of a video are those that `remove` extracts.
    """
    images, space = folder / "images", None
    images.mkdir(parents=True)
    if name in VIDEOS:
        file, codec, pixels, options = VIDEOS[name]
        transfer = colour_space("hlg" if "HLG" in name else "srgb")
        write_video(folder / file, codec, pixels, [np.clip(transfer.from_linear(light), 0, 1) for light in scene.light],
                    **options)
        run("remove", folder / file, "--out", folder / "extracted", "--weights", weights, "--stills", "--frames", 1)
        for path in (folder / "extracted" / f"{file}.frames").glob(f"{Path(file).stem}.*"):
            path.rename(images / path.name)
    else:
        file, space_name, write = WRITERS[name]
        space = colour_space(space_name) if space_name else None
        for number, light in enumerate(scene.light, 1):
            write(images / f"{number:04d}{Path(file).suffix}", light)
    frames = sorted(images.iterdir())
    first = scene.cameras[0]
    lens = Lens("PINHOLE", (first.fx, first.fy, first.cx, first.cy), WIDTH, HEIGHT)
    model = [ObservedFrame(path.name, lens, camera.world_to_camera, np.zeros((0, 2)), np.zeros(0, np.int64))
             for path, camera in zip(frames, scene.cameras, strict=True)]
    cloud = np.random.default_rng(0).uniform(-1, 1, (30, 3)).astype(np.float32)
    write_model(folder / "sparse" / "0", model, PointCloud(cloud, np.full((30, 3), 90, np.uint8),
                                                           np.ones(30, np.float32)))
    return Shot(folder, frames, space)


@pytest.mark.parametrize("name", [*STILLS, *VIDEOS])
def test_every_command_sees_the_same_light(name: str, scene: Scene, weights: Path, tmp_path: Path,
                                           monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "HEIC" and importlib.util.find_spec("pillow_heif") is None:
        pytest.skip("pillow-heif is not installed")

    def run(*words: object) -> None:
        assert cli.main([*map(str, words), "--progress", "json"]) == 0

    torch.set_num_threads(1)
    shot = film(name, scene, tmp_path / "shot", run, weights)
    searched, fitted, detect, frame = list[Light](), dict[str, Light](), ExposureDetector.detect, Frames.frame

    def detect_and_record(self: ExposureDetector, picture: Picture) -> Any:
        searched.append(picture.linear())
        return detect(self, picture)

    def frame_and_record(self: Frames, view: Any) -> torch.Tensor:
        display = frame(self, view)
        fitted[view.name] = linear_from_srgb(display.numpy())
        return display

    monkeypatch.setattr(ExposureDetector, "detect", detect_and_record)
    monkeypatch.setattr(Frames, "frame", frame_and_record)
    run("lights", shot.folder, *shot.words)
    run("fit", shot.folder, "--out", tmp_path / "run", "--mode", "3dgs", "--iterations", ITERATIONS, "--scene",
        scene.start, "--set", "scene.rates.features=0.01", "--set", "scene.classic.stop=1", "--holdout", "0")
    assert Run.open(tmp_path / "run").settings.scene.rates.scale == SceneRates().scale  # it was trained before
    for number, path in enumerate(shot.frames):
        compare("lights", searched[number], scene, number)
        compare("fit", fitted[path.name], scene, number)
    (light,) = json.loads((shot.folder / "lights.json").read_text())["lights"]
    np.testing.assert_allclose(light["xyz"], LAMP, atol=0.05)

    run("bake", tmp_path / "run", "--out", tmp_path / "layers")
    baked = read_layers(tmp_path / "layers" / "layers.0001.exr")
    compare("bake", baked.scene, scene, 0)

    run("remove", shot.frames[0], "--out", tmp_path / "clean", "--flare", tmp_path / "flares", "--weights", weights,
        "--stills", *shot.words)
    clean = clean_name(tmp_path / "clean" / shot.frames[0].name)
    is_same_format = clean.suffix == shot.frames[0].suffix
    flare = read_picture(next((tmp_path / "flares").glob("*.exr"))).linear()
    assert flare.mean() > 0.002
    compare("remove", read_picture(clean, space=shot.space if is_same_format else None).linear() + flare, scene, 0)

    (x, y), = scene.cameras[0].project(LAMP[None])[0]
    run("transfer", LOOK, "--to", shot.frames[0], "--light", f"{x},{y}", "--out", tmp_path / "transferred", *shot.words)
    layers = read_layers(tmp_path / "transferred" / "layers.0001.exr")
    compare("transfer", layers.scene, scene, 0)
    plate = clean_name(tmp_path / "transferred" / "frames" / shot.frames[0].name)
    with_flare = read_picture(plate, space=shot.space if is_same_format else None).linear()
    assert layers.flare.mean() > 0.001
    compare("transfer", with_flare - layers.flare, scene, 0, (with_flare < 0.9).all(-1))


def compare(command: str, seen: Light, scene: Scene, number: int, only: NDArray[np.bool_] | None = None) -> None:
    """Compare the means of each channel with the scene's, where every format holds its light, away from the lamp."""
    truth = scene.light[number]
    part = ((truth > MIDDLE[0]) & (truth < MIDDLE[1])).all(-1) & (lamp_distance(scene.cameras[number]) > LAMP_REACH)
    if only is not None:
        part &= only
    assert part.mean() > 0.3
    np.testing.assert_allclose(seen[part].mean(0), truth[part].mean(0), rtol=0.01, err_msg=f"{command} {number}")
