# SPDX-License-Identifier: GPL-3.0-or-later
"""The compositor's pixels equal the sum of the layers, on every Blender that is set up here."""
from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from blenders import Blender

from core.bake.exr import read_layers, write_layers
from core.bake.layers import FrameLayers, flare_alpha
from core.colour import colour_space
from core.colour.srgb import srgb_from_linear
from core.images.exr import read_exr
from core.images.read import read_picture
from core.images.window import DataWindow
from core.images.write import write_exr

SCRIPTS = Path(__file__).parent / "scripts"
NUMBERS = (0, 3, 4, 1000)  # a sequence may begin at 0 and have gaps
SIZE = 20, 32
INTENSITY, TINT = 1.7, np.array([1.0, 0.5, 0.25], np.float32)
HALF = 2.0 ** -11


class Made(NamedTuple):
    facts: dict[str, Any]
    layers: Path
    out: Path
    user: Path


def random_layers(seed: int, lights: tuple[str, ...] = ("lamp", "key light")) -> FrameLayers:
    random = np.random.default_rng(seed)

    def light(reach: float) -> np.ndarray:
        return (random.random((*SIZE, 3), np.float32) ** 3 * reach).astype(np.float32)

    return FrameLayers(light(1), {name: light(4) for name in lights}, np.ones(SIZE, np.float32))


@pytest.fixture(scope="session")
def made(blender: Blender, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Write layers of several kinds and run composite.py on them in Blender; return its facts and the folders."""
    base = tmp_path_factory.mktemp("composite")
    layers, out, user = base / "layers", base / "out", base / "user"
    for number in NUMBERS:
        write_layers(layers / f"layers.{number:04d}.exr", random_layers(number))
    write_layers(base / "fewer" / "layers.0000.exr", random_layers(1, ("key light",)))
    write_exr(base / "none" / "layers.0000.exr", {name: np.ones(SIZE, np.float32) for name in "RGB"})
    aces = colour_space("acescg")
    write_layers(base / "aces" / "layers.0000.exr", random_layers(0).in_space(aces), half=False, pixel_aspect=2.0,
                 chromaticities=aces.chromaticities)
    window = DataWindow((SIZE[1], SIZE[0]), (-7, -2), (20, 15))
    write_layers(base / "overscan" / "layers.0000.exr", replace(random_layers(5), window=window))
    facts = blender.run(SCRIPTS / "composite.py", layers, base / "fewer", base / "none", base / "aces",
                        base / "overscan", out, user=user)
    return Made(facts, layers, out, user)


def test_overscan_is_cut_off_where_the_frame_begins(made: Made) -> None:
    """Block of composite.py: "overscan, in the command and beside an artist's nodes"."""
    composite = random_layers(5).composite[2:17, 7:27]
    found = rgb(made.out / "overscan" / "frame.0000.exr")
    np.testing.assert_allclose(found, composite, rtol=3 * HALF, atol=1e-3)  # of a file of halfs, and a sum of halfs
    assert len(made.facts["crops"]) == 3
    assert made.facts["crops after"] == made.facts["crops removed"] == []


def baked(made: Made, number: int) -> FrameLayers:
    return read_layers(made.layers / f"layers.{number:04d}.exr")


def rgb(path: Path) -> np.ndarray:
    return read_picture(path).pixels


def assert_half_equal(image: np.ndarray, expected: np.ndarray) -> None:
    """Equal within the rounding of the 16 bit file that was written, and of a sum in 32 bit before it."""
    np.testing.assert_allclose(image, expected, rtol=1.01 * HALF, atol=1e-6)


@pytest.mark.parametrize("number", NUMBERS)
def test_frames_are_scene_plus_flare(made: Made, number: int) -> None:
    layers = baked(made, number)
    assert_half_equal(rgb(made.out / "plain" / f"{number}.exr"), layers.scene + layers.flare)


@pytest.mark.parametrize("number", NUMBERS)
def test_intensity_and_tint_are_factors_on_the_flare(made: Made, number: int) -> None:
    layers = baked(made, number)
    assert_half_equal(rgb(made.out / "changed" / f"{number}.exr"), layers.scene + INTENSITY * TINT * layers.flare)


def test_the_png_is_what_a_screen_shows(made: Made) -> None:
    layers = baked(made, 3)
    shown = np.clip(srgb_from_linear(layers.composite), 0, 1)
    np.testing.assert_allclose(rgb(made.out / "plain" / "3.png"), shown, atol=0.51 / 255)


def test_the_flare_output_is_premultiplied_with_its_matte(made: Made) -> None:
    channels = read_exr(made.out / "flare" / "0.exr")
    flare = INTENSITY * TINT * baked(made, 0).flare
    assert_half_equal(np.stack([channels[name] for name in "RGB"], -1), flare)
    assert_half_equal(channels["A"], flare_alpha(flare))


def test_the_group_has_its_sockets(made: Made) -> None:
    """Block of composite.py: "the graph as it comes, rendered and saved"."""
    assert made.facts["inputs"] == ["Scene", "flare_key_light", "flare_lamp", "Intensity", "Tint",
                                    "flare_key_light Gain", "flare_lamp Gain"]
    assert made.facts["outputs"] == ["Image", "Flare"]


def test_setting_up_again_changes_nothing(made: Made) -> None:
    """Block of composite.py: "set up again: nothing doubles, the sliders stay"."""
    before, after = made.facts["doubled"]
    assert before == after
    np.testing.assert_allclose([made.facts["sliders"][0], *made.facts["sliders"][1]], [INTENSITY, *TINT, 1])


def test_the_flare_can_go_over_the_present_image(made: Made) -> None:
    """Block of composite.py: "over what is there: a plain colour in place of the baked scene, twice"."""
    assert made.facts["plate stays"]
    plate = np.array([0.25, 0.5, 0.75], np.float32)
    assert_half_equal(rgb(made.out / "over" / "0.exr"), plate + baked(made, 0).flare)


def test_nothing_is_left_of_lights_that_other_layers_are_without(made: Made) -> None:
    """Block of composite.py: "pointed at layers of fewer lights"."""
    assert made.facts["fewer"] == ["Scene", "flare_key_light"]
    layers = read_layers(made.layers.parent / "fewer" / "layers.0000.exr")
    assert_half_equal(rgb(made.out / "fewer" / "0.exr"), layers.scene + layers.flare)


def test_scenes_that_share_a_tree_do_not_change_each_other(made: Made) -> None:
    """Block of composite.py: "two scenes of one tree"."""
    if "two scenes of one tree" not in made.facts:
        pytest.skip("before 5.0 every scene has a tree of its own")
    assert made.facts["two scenes of one tree"] == [True, True, True]
    assert made.facts["refused of one tree"] == [True, 0], "layers that are none leave no copy"
    assert_half_equal(rgb(made.out / "of one tree" / "0.exr"), baked(made, 0).composite)


def test_a_picture_without_layers_is_refused_where_there_were_layers(made: Made) -> None:
    """Block of composite.py: "pointed at layers of fewer lights"."""
    assert "holds no scene and flare layers" in made.facts.get("no layers", "")


@pytest.mark.parametrize(("name", "factor"), [("over at 50", 0.5), ("over at 200", 2), ("plain at 50", 0.5)])
def test_layers_are_brought_to_the_size_that_is_rendered(made: Made, name: str, factor: float) -> None:
    """Block of composite.py: "beginning"."""
    layers, image = baked(made, 0), rgb(made.out / name / "0.exr")
    assert image.shape[:2] == (SIZE[0] * factor, SIZE[1] * factor)
    expected = layers.flare if name.startswith("over") else layers.composite
    small, large = sorted((image, expected), key=len)
    blocks = large.reshape(len(small), 2, small.shape[1], 2, 3)  # of pixels that know nothing of each other
    smaller = [blocks.mean((1, 3))]
    if made.facts["version"].startswith("4.2"):  # there one pixel of each block stands for it
        smaller += [blocks[:, row, :, column] for row in range(2) for column in range(2)]
    assert max(np.corrcoef(one.ravel(), small.ravel())[0, 1] for one in smaller) > 0.9


def test_layers_in_another_space_and_of_wide_pixels_are_composed_as_they_are(made: Made) -> None:
    """Block of composite.py: "the command, of layers of wide pixels in ACEScg"."""
    assert made.facts["aces"] == ["", 2.0, 1.0]
    exact = random_layers(0)
    np.testing.assert_allclose(rgb(made.out / "aces" / "frame.0000.exr"),
                               exact.scene + exact.flares["lamp"] + exact.flares["key light"], rtol=2e-3, atol=2e-3)


def test_pixel_aspect_and_render_region_of_the_scene_stay(made: Made) -> None:
    """Block of composite.py: "wide pixels stay; a region that is cut out is refused, and leaves nothing"."""
    assert made.facts["pixel aspect"] == 2
    sentence, nothing = made.facts["cropped"]
    assert "switch Crop to Render Region off" in sentence
    assert nothing


def test_a_scene_matched_to_layers_goes_to_one_of_their_frames(made: Made) -> None:
    """Block of composite.py: "the graph as it comes, rendered and saved"."""
    assert made.facts["stands at"] == NUMBERS[0]


def test_the_saved_file_shows_the_same_elsewhere_and_without_us(made: Made, blender: Blender, tmp_path: Path) -> None:
    shutil.copytree(made.layers, tmp_path / "layers")
    shutil.copytree(made.out / "scene", tmp_path / "out" / "scene")
    made.layers.rename(made.layers.with_name("away"))  # so that a path into the first place finds nothing
    try:
        facts = blender.run(SCRIPTS / "reopen.py", tmp_path / "out" / "scene" / "compositor.blend", tmp_path / "again",
                            *NUMBERS, user=tmp_path / "user")
    finally:
        made.layers.with_name("away").rename(made.layers)
    assert facts == {"frames": [0, 1000], "size": [SIZE[1], SIZE[0]]}
    for number in NUMBERS:
        assert_half_equal(rgb(tmp_path / "again" / f"{number}.exr"), rgb(made.out / "changed" / f"{number}.exr"))
    before, after = made.out / "changed" / f"{NUMBERS[-1]}.png", tmp_path / "again" / "last.png"
    np.testing.assert_array_equal(rgb(after), rgb(before))


@pytest.mark.skipif(sys.platform != "linux", reason="files are kept from growing in another way elsewhere")
def test_an_incomplete_file_on_a_full_disk_is_reported_and_removed(made: Made) -> None:
    """Block of composite.py: "a disk that fills up"."""
    refused, left = made.facts["full"]
    assert [sentence.startswith("Blender could not write a complete file to ") for sentence in refused] == [True, True]
    assert left == []
