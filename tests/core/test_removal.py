# SPDX-License-Identifier: GPL-3.0-or-later
"""Removal of flares from plates: what is kept, what is taken, and what cannot be read."""
from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import shutil
import struct
import threading
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from numpy.typing import NDArray

from core.capture import Capture
from core.colour.spaces import AP1
from core.errors import Cancelled, CaptureError, FrameError, RunError, SettingsError
from core.images.exr import read_exr
from core.images.formats import jpeg, png, tiff
from core.images.formats.exif import upright
from core.images.plates import Plate, read_plate, write_plate
from core.images.read import read_picture
from core.images.window import DataWindow
from core.images.write import save_exr, write_exr, write_png
from core.removal.inference import confidence, light_sources
from core.removal.inference import remover as remover_module
from core.removal.inference.remover import FlareMap, Glow, Remover, Told, carried_up
from core.removal.inference.test_time_views import told_once, worth_of
from core.removal.jobs import batch
from core.removal.jobs.batch import plates_of, remove_all
from core.removal.jobs.capture import UNFINISHED, _names, remove_from
from core.removal.jobs.manifest import RECORD, Record, made_from
from core.removal.jobs.mattes import Mattes
from core.removal.jobs.provenance import check_removed, has_exact
from core.removal.model import weights
from core.removal.model.image_formation import flare_light
from core.removal.model.network import LEVELS, SHOWN, RemovalNetwork, seen
from core.removal.model.recipe import Recipe, as_dict
from core.system.progress import Progress
from tests.core.captures import make_capture
from tests.core.heard import Heard
from tests.core.test_exif import exif_segment

TINY = Recipe(widths=(8, 8, 8, 8, 8))


def network_file(path: Path, seed: int = 0, bias: float = 0.0) -> Path:
    """A small network of random weights; `bias` makes it see flare everywhere (> 0) or nowhere (< 0)."""
    torch.manual_seed(seed)
    network = RemovalNetwork(TINY.widths, TINY.blocks, TINY.attention)
    with torch.no_grad():
        network.head.weight.mul_(0.1)
        network.head.bias[:3] = bias
    weights.write(path, {name: value.half() for name, value in network.state_dict().items()},
                  {"recipe": json.dumps(as_dict(TINY)), "iteration": "0"})
    return path


@pytest.fixture(scope="module")
def everywhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that see a flare in every pixel."""
    return network_file(tmp_path_factory.mktemp("weights") / "everywhere.safetensors", bias=0.2)


@pytest.fixture(scope="module")
def nowhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that never see one."""
    return network_file(tmp_path_factory.mktemp("weights") / "nowhere.safetensors", bias=-1.0)


def picture(height: int = 60, width: int = 90, top: int = 255, dtype: type = np.uint8) -> NDArray[np.generic]:
    random = np.random.default_rng(height)
    smooth = cv2.resize(random.random((6, 9, 3)), (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    return (smooth * top).astype(dtype)


def write_codes(path: Path, codes: NDArray[np.generic]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), codes[..., ::-1] if codes.ndim == 3 and codes.shape[2] == 3 else codes)
    return path


# The network.


def test_what_the_flare_adds_as_light() -> None:
    frame, added = np.float32([0.8, 0.8, 0.1]), np.float32([0.0, 0.3, 0.4])
    np.testing.assert_allclose(flare_light(frame, added), [0.0, 0.64 - 0.25, 0.01], atol=1e-6)


def test_every_level_sees_the_frame_turned_about_its_middle_and_its_darkest_values() -> None:
    frame = torch.rand(1, 3, 64, 96)
    levels = seen(frame)
    assert [tuple(part.shape[2:]) for part in levels] == [(64 >> k, 96 >> k) for k in range(1, LEVELS + 1)]
    for level, part in enumerate(levels):
        assert part.shape[1] == SHOWN + (12 if level == 0 else 0)
        side = 2 << level
        here = part[:, -SHOWN:]
        torch.testing.assert_close(here[:, :3, 0, 1], frame[:, :, :side, side:2 * side].mean((2, 3)))
        torch.testing.assert_close(here[:, 4:7, 0, 1], frame[:, :, :side, side:2 * side].amin((2, 3)))
        torch.testing.assert_close(here[:, 8:16], torch.flip(here[:, :8], (2, 3)))
        assert here[0, -3].abs().max() < 1
        assert here[0, -3, 0, 0] == -here[0, -3, 0, -1]


@pytest.mark.parametrize("size", [(32, 32), (64, 128)])
def test_the_network_is_fully_convolutional(size: tuple[int, int]) -> None:
    told = RemovalNetwork(TINY.widths, TINY.blocks, TINY.attention)(torch.rand(2, 3, *size))
    assert told.flare.shape == told.gentle.shape == (2, 3, *size)


def test_what_is_far_away_counts() -> None:
    """A light in one corner may have its ghost in the other."""
    torch.manual_seed(3)
    network = RemovalNetwork(TINY.widths, TINY.blocks, TINY.attention)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    frame = torch.full((1, 3, 96, 96), 0.2, requires_grad=True)
    network(frame).flare[0, :, -4:, :4].sum().backward()
    assert frame.grad is not None
    assert float(frame.grad[0, :, :4, :4].abs().sum()) > 0


def test_weights_keep_their_recipe_and_damage_is_told(tmp_path: Path, everywhere: Path) -> None:
    assert [see.out_channels for see in weights.load(everywhere).see] == list(TINY.widths)
    with pytest.raises(RunError, match="missing"):
        weights.read(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    with pytest.raises(RunError, match="damaged"):
        weights.read(tmp_path / "bad.safetensors")
    weights.write(tmp_path / "other.safetensors", {"a": torch.zeros(2)}, {})
    with pytest.raises(RunError, match="no weights of the removal network"):
        weights.load(tmp_path / "other.safetensors")
    tensors, about = weights.read(everywhere)
    tensors[next(iter(tensors))].view(-1)[0] = torch.nan
    weights.write(tmp_path / "nan.safetensors", tensors, about)
    with pytest.raises(RunError, match="no finite numbers"):
        weights.load(tmp_path / "nan.safetensors")


# Carried up.


def test_a_flat_flare_is_taken_in_light(everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remover = Remover(everywhere, working_size=64)
    monkeypatch.setattr(remover, "flare", lambda told, **_: np.full_like(told.display, 0.1))
    codes = np.full((300, 200, 3), 180, np.uint8)
    clean = np.asarray(_remove(remover, codes))
    expected = np.sqrt((180 / 255) ** 2 - 0.1) * 255
    assert np.abs(clean.astype(float) - expected).max() < 1


def test_edges_of_the_plate_stay_sharp(everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flare that the frame clips has the light's edge in it; it must come up as sharp as the plate has it."""
    remover = Remover(everywhere, working_size=64)
    codes = np.full((512, 512, 3), 80, np.uint8)
    codes[:, 256:] = 255
    monkeypatch.setattr(remover, "flare", lambda told, **_: 0.1 * (told.display > 0.6).astype(np.float32))
    clean = np.asarray(_remove(remover, codes)).astype(int)
    assert np.abs(clean[200:300, 240:256] - 80).max() <= 5, "what is beside the flare keeps its level up to the edge"
    assert (codes[200:300, 258:270].astype(int) - clean[200:300, 258:270]).min() >= 8


def _remove(remover: Remover, codes: NDArray[np.generic]) -> NDArray[np.generic]:
    return remover.remove(plate_of(codes))[0]


def plate_of(codes: NDArray[np.generic]) -> Plate:
    return Plate(Path("plate.png"), codes, "srgb")


def test_where_the_flare_is_zero_the_plate_is_kept_to_the_last_bit(everywhere: Path,
                                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    remover = Remover(everywhere, working_size=128)

    def corner(told: Told, *, marked: bool) -> NDArray[np.float32]:
        assert not marked
        flare = np.zeros_like(told.display)
        flare[:20, :20] = 0.05
        return flare

    monkeypatch.setattr(remover, "flare", corner)
    random = np.random.default_rng(0)
    for dtype in (np.uint8, np.uint16):
        codes = random.integers(0, np.iinfo(dtype).max, (400, 400, 3), dtype)
        clean = np.asarray(_remove(remover, codes))
        assert clean.dtype == codes.dtype
        assert np.array_equal(clean[120:], codes[120:])
        assert np.array_equal(clean[:, 120:], codes[:, 120:])
        assert (clean[:50, :50].astype(int) < codes[:50, :50]).mean() > 0.5


def test_a_network_that_sees_nothing_changes_nothing(nowhere: Path) -> None:
    codes = picture()
    assert np.array_equal(_remove(Remover(nowhere, working_size=64), codes), codes)


def test_a_frame_upside_down_is_told_the_same(everywhere: Path) -> None:
    display = picture(64, 96, 1, np.float32)
    upright = Remover(everywhere).told(display).added
    told = Remover(everywhere).told(np.ascontiguousarray(display[::-1, ::-1])).added
    assert np.ptp(upright) > 1e-3
    np.testing.assert_allclose(told[::-1, ::-1], upright, atol=1e-5)


def without_glow(added: NDArray[np.float32]) -> NDArray[np.float32]:
    """As `Remover._told` tells it."""
    return np.concatenate([added, np.zeros_like(added)], -1)


@pytest.mark.parametrize(("in_two", "worth"), [(0.0, 1), (0.15, 1), (0.9, 0)])
def test_a_flare_in_some_views_alone_is_doubted(everywhere: Path, monkeypatch: pytest.MonkeyPatch, in_two: float,
                                                worth: float) -> None:
    """Of the four views two tell one in the frame's right half, and all of them one in its left. Two more are of the
    frame graded back."""
    share = 1 / (1 + 0.8**2)  # of its two views, by their pixels
    shown: list[tuple[int, ...]] = []

    def told(_: Remover, view: NDArray[np.float32]) -> NDArray[np.float32]:
        upright, middle = len(shown) % 2 == 0, view.shape[1] // 2
        added = np.zeros_like(view)
        added[:, :middle] = 0.1
        if len(shown) < 2:
            added[:, middle:] = in_two
        shown.append(view.shape)
        return without_glow(added if upright else added[::-1, ::-1])

    monkeypatch.setattr(Remover, "_told", told)
    made = Remover(everywhere).told(np.full((160, 320, 3), (0.5, 0.6, 0.7), np.float32))  # no dark frame
    assert shown == [(160, 320, 3)] * 2 + [(128, 256, 3)] * 2 + [(160, 320, 3)] * 2
    assert made.added.shape == (160, 320, 3) and made.worth == worth
    np.testing.assert_allclose(made.added[:, :158], 0.1, rtol=1e-4)
    np.testing.assert_allclose(made.added[:, 162:], in_two * share, rtol=0.02, atol=1e-6)


def test_signs_of_a_flare_are_as_they_are_told() -> None:
    """A spot on a broad light: by how much it stands out, and how much of what is told is narrower than a patch."""
    told = np.full((160, 240, 3), 0.1, np.float32)
    told[70:78, 100:108] += 0.4
    mean, spot = told.mean(), 0.4 * 64 / (160 * 240)
    *logarithms, patchy = confidence.signs(np.full_like(told, 0.5), told, 0.2 * told, 0.5 * told)
    np.testing.assert_allclose(np.exp(logarithms), [
        0.5 + confidence.NOTHING, flare_light(np.full_like(told, 0.5), told).mean() + 0.002,
        0.2 + confidence.AGREED, 0.5 / mean],
        rtol=1e-3)
    np.testing.assert_allclose(patchy, spot / mean, rtol=1e-3)


def dusk(veil: float = 0.0, black: float = 0.0) -> NDArray[np.float32]:
    """(160, 240, 3): a scene with darks of its own, under a veil of light that grows to its right or not, graded so
    that its black is grey."""
    coarse = np.random.default_rng(5).random((80, 120, 1)) ** 2 * (0.9, 0.8, 0.7)
    fine = np.asarray(cv2.resize(coarse, (240, 160), interpolation=cv2.INTER_LINEAR))
    light = fine**2 + veil * np.linspace(0, 2, 240)[None, :, None]
    return np.asarray(black + (1 - black) * np.sqrt(np.clip(light, 0, 1)), np.float32)


def tells_lifted_darks(_: Remover, view: NDArray[np.float32]) -> NDArray[np.float32]:
    """Column by column what the darkest places have, as if it were a veil; of the smaller view half as much."""
    of_all = 1 if view.shape[1] in (256, 480) else 0.5  # and 192, 384
    darks = of_all * (cv2.erode(view.min(0, keepdims=True), np.ones((1, 41))) - 0.01)
    return without_glow(np.broadcast_to(np.maximum(darks, 0), view.shape).astype(np.float32))


def test_a_grade_is_no_flare(everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Remover, "_told", tells_lifted_darks)
    remover = Remover(everywhere)
    grade, veil = remover.told(dusk(black=0.04)), remover.told(dusk(veil=0.1))
    assert grade.added.mean() > 0.02 and remover.flare(grade).max() == 0
    assert remover.flare(grade, marked=True).max() > 0.01  # whoever marks it has seen a flare
    assert veil.worth == 1 and remover.flare(veil).mean() > 0.05


def test_it_is_said_that_a_veil_may_be_a_grade(everywhere: Path, tmp_path: Path,
                                               monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Remover, "_told", tells_lifted_darks)
    for name, shown in (("grade", dusk(black=0.03)), ("veil", dusk(veil=0.1)), ("white", np.ones((160, 240, 3)))):
        write_codes(tmp_path / name / f"{name}.png", (shown * 255 + 0.5).astype(np.uint8))
    plates = [tmp_path / name / f"{name}.png" for name in ("grade", "veil")]
    heard = Heard()
    remove_all(plates, tmp_path / "clean", Remover(everywhere), heard)
    assert [said for said in heard.texts if said.startswith("In 1 of them") and "white all over" in said]
    codes = [cv2.imread(str(path)) for path in (plates[0], tmp_path / "clean" / "grade.png")]
    np.testing.assert_array_equal(*codes)

    heard = Heard()  # as it is told to be done
    matte = Mattes(tmp_path / "white" / "white.png")
    remove_all(plates[:1], tmp_path / "clean", Remover(everywhere), heard, mattes=matte)
    assert not [said for said in heard.texts if "its grade" in said]
    assert cv2.imread(str(tmp_path / "clean" / "grade.png")).mean() < codes[0].mean() - 1


def test_a_shot_is_judged_as_one(everywhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is doubted of a frame is believed in a shot whose other frames have a flare, by their shares."""
    monkeypatch.setattr(Remover, "_told", tells_lifted_darks)
    remover = Remover(everywhere)
    grade, veil = remover.views(dusk(black=0.04)), remover.views(dusk(veil=0.1))
    faint = told_once(np.full_like(grade.mean, 0.001))
    assert worth_of([(grade, 1)]) == 0 and worth_of([(faint, 1)]) == 1
    assert worth_of([(grade, 1), (veil, 1), (veil, 1)]) == 1
    assert worth_of([(grade, 1), (faint, 1)]) == 0  # nothing was asked of the other


@pytest.mark.parametrize("display", [np.zeros((96, 96, 3), np.float32), np.ones((96, 96, 3), np.float32),
                                     np.full((96, 96, 3), 0.3, np.float32)])
def test_a_picture_of_one_value_is_graded_back_to_finite_ones(display: NDArray[np.float32]) -> None:
    back = confidence.graded_back(display)
    assert back.dtype == np.float32 and np.isfinite(back).all()
    assert np.isfinite(confidence.signs(display, display * 0.1, 0 * display, back).log_odds)
    assert np.isfinite(confidence.signs(display, 0 * display, 0 * display, 0 * back).log_odds)


def street(lamp: int, left: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(160, 240, 3) each: a dark street with a white lamp `lamp` pixels a side in a glow, and as a flare the glow and
    of the lamp what leaves it at the display value `left`, a third of that in its rim of a pixel."""
    display, added = np.full((160, 240, 3), 0.1, np.float32), np.zeros((160, 240, 3), np.float32)
    first = 60
    glow, rim = slice(first - 12, first + lamp + 12), slice(first, first + lamp)
    display[glow, glow], added[glow, glow] = 0.5, 0.35
    display[rim, rim], added[rim, rim] = 1, 1 - left / 3
    added[first + 1:first + lamp - 1, first + 1:first + lamp - 1] = 1 - left
    return display, added


@pytest.mark.parametrize("marked", [False, True])
def test_a_lamp_stays_as_bright_as_it_was_filmed(everywhere: Path, marked: bool) -> None:
    """What is left of it says where it is; its glow goes, and of what clips about it the most."""
    display, added = street(10, left=0.7)
    clean = display**2 - Remover(everywhere).flare(Told(display, added, np.float32(1), 0 * added), marked=marked)
    np.testing.assert_allclose(clean[62:68, 62:68], 1)
    np.testing.assert_allclose(clean[50:58, 50:58], 0.15**2, rtol=1e-4)
    assert 0 < np.sqrt(clean[60, 60:70]).max() < 0.35


@pytest.mark.parametrize(("lamp", "left", "glow"), [
    pytest.param(10, 0.2, 0.5, id="a ghost, gone like what is about it"),
    pytest.param(44, 0.7, 1, id="as large as a window"),
    pytest.param(44, 0.2, 1, id="as large as what a glow clips"),
    pytest.param(1, 0.7, 1, id="a pixel, which noise is too"),
])
def test_what_is_no_lamp_goes_as_told(lamp: int, left: float, glow: float) -> None:
    display, added = street(lamp, left)
    assert light_sources.given_back(display, added, np.full_like(added, glow)).max() == 0


@pytest.mark.parametrize(("about", "glow", "part"), [
    pytest.param(0.5, 1.0, 1.0, id="in a glow"),
    pytest.param(0.5, 0.65, 0.5, id="half of it a glow"),
    pytest.param(0.9, 1.0, 0.5, id="hardly brighter than what is about it"),
])
def test_in_a_glow_there_is_a_lamp_though_nothing_is_left_of_it(about: float, glow: float, part: float) -> None:
    """Of its middle all stays, towards its rim less."""
    display, added = street(10, left=0.15)
    added[display == 0.5] += about - 0.5
    display[display == 0.5] = about
    stays = light_sources.given_back(display, added, np.full_like(added, glow))[..., 0]
    np.testing.assert_allclose(stays[63:67, 63:67], part, rtol=0.02)
    assert stays[60, 65] < 0.7 * part


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_picture_of_one_value_has_no_lamps(value: float) -> None:
    display = np.full((64, 96, 3), value, np.float32)
    with np.errstate(all="raise"):
        assert not light_sources.given_back(display, display * 0.5, np.ones_like(display)).any()


def test_a_part_of_the_glow_stays_beside_a_lamp_at_night() -> None:
    """The less, the farther off; of what is no glow nothing does."""
    display, added = street(10, left=0.7)
    stays = light_sources.given_back(display, added, np.float32((1, 0.5, 0)) * np.ones_like(added))
    for off in (2, 8):
        expected = light_sources.STAYS * np.exp(-off / (light_sources.REACH * 240)) * np.array((1, 0.5, 0))
        np.testing.assert_allclose(stays[65, 60 - off], expected, rtol=0.02)


@pytest.mark.parametrize(("about", "part"), [(0.2, 1.0), (0.25, 0.5), (0.3, 0.0)])
def test_by_day_no_glow_stays(about: float, part: float) -> None:
    display, added = street(10, left=0.7)
    display[display < 0.2] = about
    stays = light_sources.given_back(display, added, np.ones_like(added))[65, 58, 0]
    assert stays == pytest.approx(part * light_sources.STAYS * np.exp(-2 / 12), rel=0.02, abs=1e-3)


@pytest.mark.parametrize(("white", "part"), [(0.905, 0.0), (0.935, 0.5), (0.98, 1.0)])
def test_a_lamp_that_is_not_white_keeps_less_of_a_glow(white: float, part: float) -> None:
    display, added = street(10, left=0.7)
    stays = light_sources.given_back(np.minimum(display, white), added, np.ones_like(added))[65, 58, 0]
    assert stays == pytest.approx(part * light_sources.STAYS * np.exp(-2 / 12), rel=0.05, abs=0.03)


@pytest.mark.parametrize(("glow", "marked"), [("kept at lamps", True), ("taken", False)])
def test_of_a_glow_that_is_marked_or_to_be_taken_nothing_stays(everywhere: Path, glow: Glow, marked: bool) -> None:
    """Its lamp does."""
    display, added = street(10, left=0.15)
    told = Told(display, added, np.float32(1), np.ones_like(added))
    whole = Remover(everywhere, glow=glow).flare(told, marked=marked)
    np.testing.assert_allclose(whole[65, 58], 0.5**2 - 0.15**2, rtol=1e-3)
    assert (Remover(everywhere).flare(told)[65, 58] < 0.8 * whole[65, 58]).all()
    assert whole[65, 65].max() == 0


def test_clean_frames_of_a_capture_are_as_their_remover_makes_them(tmp_path: Path, everywhere: Path,
                                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of one that takes all of a glow have none, and are kept by whoever makes them in the same way."""
    display, added = (one[:, :224] for one in street(10, left=0.7))  # as the network is shown it
    capture = Capture.open(make_capture(tmp_path / "capture", views=3))
    shutil.rmtree(capture.folder / "removed", ignore_errors=True)
    frames = [capture.frame_path(view) for view in capture.views]
    for frame in frames:
        cv2.imwrite(str(frame), (display * 255 + 0.5).astype(np.uint8))
    views = told_once(added)._replace(glow=np.ones_like(added))
    monkeypatch.setattr(Remover, "views", lambda *_: views)
    whole = Remover(everywhere, working_size=224, glow="taken")
    remove_all(frames, tmp_path / "plates", Remover(everywhere, working_size=224), Progress())
    ours, plates = (cv2.imread(str(folder / frames[0].name)) for folder in
                    (remove_from(capture, whole, Progress()), tmp_path / "plates"))
    assert (ours[58, 55:59] < plates[58, 55:59] - 5).all() and (ours[65, 65] == plates[65, 65]).all()
    assert remove_all([capture.folder / "images"], capture.folder / "removed", whole, Progress())["made"] == 0


def test_what_of_a_flare_is_glow_is_what_stays_where_glare_is_kept(everywhere: Path) -> None:
    """In every view, in the mean over them by what each tells."""
    display = picture(64, 96, 1, np.float32)
    told, kept = (remover.told(display) for remover in (Remover(everywhere), Remover(everywhere, glow="kept")))
    assert 0.01 < told.glow.mean() < 0.99 and kept.glow.max() == 0
    np.testing.assert_allclose(told.added * (1 - told.glow), kept.added, atol=1e-4)


@pytest.mark.parametrize(("frame", "lit", "alone", "counts"), [
    pytest.param((0.24, 0.1, 0.05), (0.24,), 0.1, 1.0, id="red"),
    pytest.param((0.24, 0.1, 0.05), (0.24,), 0.03, 0.0, id="next to nothing"),
    pytest.param((0.24, 0.23, 0.05), (0.24, 0.23), 0.1, 0.0, id="yellow"),
    pytest.param((0.7, 0.325, 0.1), (0.7,), 0.1, 0.5, id="at dusk"),
    pytest.param((0.7, 0.5, 0.4), (0.7,), 0.1, 0.0, id="by day")])
def test_what_a_channel_tells_alone_counts_of_one_colour_in_the_dark(
        everywhere: Path, monkeypatch: pytest.MonkeyPatch, frame: tuple[float, ...], lit: tuple[float, ...],
        alone: float, counts: float) -> None:
    """As the glow of a red light does."""
    def told(_: Remover, view: NDArray[np.float32]) -> NDArray[np.float32]:
        is_grey = view[0, 0, 0] == view[0, 0, 1]
        lights = is_grey and np.isclose(view[0, 0, 0], lit, atol=1e-3).any()
        return without_glow(np.full_like(view, alone if lights else 0.02))

    monkeypatch.setattr(Remover, "_told", told)
    added = Remover(everywhere).told(np.full((160, 320, 3), frame, np.float32)).added
    expected = 0.02 + (alone - 0.02) * counts * np.isclose(frame, lit[0])
    np.testing.assert_allclose(added[80, 160], expected, rtol=1e-3)


def test_rows_are_worked_on_apart_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)
    found = FlareMap(random.random((32, 64, 3), np.float32) * 0.1, random.random((32, 64, 3), np.float32) * 0.2)
    codes = picture(301, 500)
    whole, parts = np.zeros(codes.shape, np.float32), np.zeros(codes.shape, np.float32)
    for rows, light in carried_up(found, codes, "srgb", 255):
        whole[rows] = light
    monkeypatch.setattr(remover_module, "ROWS", 7)
    for rows, light in carried_up(found, codes, "srgb", 255):
        parts[rows] = light
    np.testing.assert_allclose(parts, whole, atol=2e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (700, 1), (33, 47), (64, 64), (31, 2000)])
def test_any_shape(everywhere: Path, shape: tuple[int, int]) -> None:
    codes = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    assert np.asarray(_remove(Remover(everywhere, working_size=96), codes)).shape == codes.shape


def test_where_glow_is_kept_no_more_is_taken(everywhere: Path) -> None:
    codes = picture()
    gentle, all_of_it = (np.asarray(_remove(remover, codes)).astype(int) for remover in
                         (Remover(everywhere, working_size=96, glow="kept"), Remover(everywhere, working_size=96)))
    assert (gentle >= all_of_it - 1).mean() > 0.98
    assert gentle.mean() > all_of_it.mean()


@pytest.mark.parametrize("size", [0, 63, 10_000])
def test_a_working_size_that_makes_no_sense(everywhere: Path, size: int) -> None:
    with pytest.raises(SettingsError, match="working size"):
        Remover(everywhere, working_size=size)


# Files.


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint8),
                                               (".tif", np.uint16), (".tiff", np.float32), (".jpg", np.uint8)])
def test_kind_and_depth_stay(tmp_path: Path, everywhere: Path, suffix: str, dtype: type) -> None:
    codes = picture(top=1 if dtype is np.float32 else np.iinfo(dtype).max, dtype=dtype)
    source = write_codes(tmp_path / f"plate{suffix}", codes)
    remove_all([source], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    result = cv2.imread(str(tmp_path / "out" / source.name), cv2.IMREAD_UNCHANGED)
    assert result.dtype == dtype
    assert result.shape == codes.shape
    assert result.mean() < codes.mean()


def test_grey_and_alpha_stay(tmp_path: Path, everywhere: Path) -> None:
    grey, alpha = picture()[..., 0], np.random.default_rng(0).integers(0, 256, (60, 90, 4), np.uint8)
    (tmp_path / "in").mkdir()
    write_codes(tmp_path / "in" / "grey.png", grey)
    write_codes(tmp_path / "in" / "alpha.png", alpha)
    remove_all([tmp_path / "in"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    assert cv2.imread(str(tmp_path / "out" / "grey.png"), cv2.IMREAD_UNCHANGED).shape == (60, 90)
    result = cv2.imread(str(tmp_path / "out" / "alpha.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(result[..., 3], alpha[..., 3])
    assert not np.array_equal(result[..., :3], alpha[..., :3])


@pytest.mark.parametrize("half", [True, False])
def test_exr_keeps_values_above_one_other_channels_and_what_is_no_number(tmp_path: Path, everywhere: Path,
                                                                        half: bool) -> None:
    colour = np.random.default_rng(0).uniform(0, 0.6, (48, 64, 3)).astype(np.float32)
    colour[10:14, 10:14] = 40.0
    colour[30, 30] = np.nan
    colour[31, 31, 0] = np.inf
    channels = {name: colour[..., k].copy() for k, name in enumerate("RGB")}
    write_exr(tmp_path / "plate.exr", {**channels, "A": np.full((48, 64), 0.5), "depth.Z": np.full((48, 64), 7.25)},
              half=half, header={"comments": "shot 10"})
    stored = read_plate(tmp_path / "plate.exr")
    remove_all([tmp_path / "plate.exr"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    clean = read_plate(tmp_path / "out" / "plate.exr")
    assert clean.codes.dtype == stored.codes.dtype == (np.float16 if half else np.float32)
    assert clean.codes[11, 11].min() > 38
    assert np.isnan(clean.codes[30, 30]).all()
    assert half or np.isinf(clean.codes[31, 31, 0])
    assert clean.rest["channels"]["depth.Z"].dtype == np.float32
    assert np.array_equal(clean.rest["channels"]["A"], stored.rest["channels"]["A"])
    assert clean.rest["header"]["comments"] == "shot 10"
    assert np.nanmean(clean.codes.astype(np.float32)[20:30]) < np.nanmean(stored.codes.astype(np.float32)[20:30])


def test_colour_tags_are_carried_over(tmp_path: Path) -> None:
    codes = picture()
    write_codes(tmp_path / "a.jpg", codes)
    data = (tmp_path / "a.jpg").read_bytes()
    told = ((0xE1, b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta/>"), (0xE2, b"ICC_PROFILE\0\x01\x01" + b"profile" * 3))
    segments = b"".join(jpeg.segment(*one) for one in told)
    (tmp_path / "a.jpg").write_bytes(data[:2] + segments + data[2:])
    plate = read_plate(tmp_path / "a.jpg")
    write_plate(tmp_path / "b.jpg", plate, plate.codes // 2)
    assert segments in (tmp_path / "b.jpg").read_bytes()
    write_plate(tmp_path / "b.png", plate, plate.codes)
    assert np.array_equal(read_plate(tmp_path / "b.png").codes, plate.codes)


def _tiff_with(path: Path, codes: NDArray[np.generic], tags: dict[int, tiff.Tag]) -> Path:
    _, data = cv2.imencode(".tif", codes)
    path.write_bytes(tiff.with_tags(data.tobytes(), tags))
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("alpha", [tiff.STRAIGHT, tiff.PREMULTIPLIED])
def test_a_tiff_keeps_its_alpha_profile_and_how_it_lies(tmp_path: Path, everywhere: Path, dtype: type,
                                                       alpha: int) -> None:
    codes = (np.random.default_rng(0).random((60, 90, 4)) * np.iinfo(dtype).max).astype(dtype)
    tags = {tiff.EXTRA_SAMPLES: tiff.short(alpha), tiff.ORIENTATION: tiff.short(6),
            tiff.COLOUR_PROFILE: tiff.Tag(7, np.arange(200, dtype=np.uint8)),
            tiff.X_RESOLUTION: tiff.Tag(5, np.array([300, 1], np.uint32))}
    source = _tiff_with(tmp_path / "plate.tif", codes, tags)
    plate = read_plate(source)
    assert np.array_equal(plate.codes, codes[..., 2::-1]) and np.array_equal(plate.alpha, codes[..., 3])
    assert np.array_equal(read_picture(source).pixels, codes[..., 2::-1] / np.float32(np.iinfo(dtype).max))
    remove_all([source], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    clean = read_plate(tmp_path / "out" / "plate.tif")
    assert np.array_equal(clean.alpha, codes[..., 3]) and clean.codes.mean() < plate.codes.mean()
    with open(tmp_path / "out" / "plate.tif", "rb") as stream:
        kept = tiff.read_tags(stream, tags)
    assert {name: (tag.kind, tag.values.tolist()) for name, tag in kept.items()} == {
        name: (tag.kind, tag.values.tolist()) for name, tag in tags.items()}


def test_the_tags_of_a_tiff_of_the_other_byte_order_are_read() -> None:
    entries = struct.pack(">HHII", tiff.COLOUR_PROFILE, 7, 6, 38) + struct.pack(">HHIHH", tiff.SAMPLES, 3, 1, 3, 0)
    data = b"MM\0*" + struct.pack(">IH", 8, 2) + entries + struct.pack(">I", 0) + b"colour"
    found = tiff.read_tags(io.BytesIO(data), (tiff.COLOUR_PROFILE, tiff.SAMPLES))
    assert found[tiff.COLOUR_PROFILE].values.tobytes() == b"colour" and found[tiff.SAMPLES].values[0] == 3
    more = tiff.with_tags(data, {tiff.EXTRA_SAMPLES: tiff.short(2), tiff.SAMPLES: tiff.short(4)})
    found = tiff.read_tags(io.BytesIO(more), range(1 << 16))
    assert {name: tag.values.tolist() for name, tag in found.items()} == {
        tiff.COLOUR_PROFILE: list(b"colour"), tiff.SAMPLES: [4], tiff.EXTRA_SAMPLES: [2]}
    for cut in range(len(more)):
        tiff.read_tags(io.BytesIO(more[:cut]), range(1 << 16))
        tiff.page_count(io.BytesIO(more[:cut]))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".exr"])
def test_a_plate_without_a_flare_is_copied(tmp_path: Path, nowhere: Path, suffix: str) -> None:
    source = tmp_path / f"plate{suffix}"
    if suffix == ".exr":
        write_exr(source, dict.fromkeys("RGB", np.full((60, 90), np.nan)))
    else:
        _, data = cv2.imencode(suffix, picture(), [cv2.IMWRITE_JPEG_QUALITY, 60] if suffix == ".jpg" else [])
        source.write_bytes(data.tobytes())
    remove_all([source], tmp_path / "out", Remover(nowhere, working_size=64), Progress())
    assert (tmp_path / "out" / source.name).read_bytes() == source.read_bytes()


def test_a_profile_of_a_grey_png_is_not_given_to_colours(tmp_path: Path, everywhere: Path) -> None:
    def chunk(name: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")

    rows = b"".join(b"\0" + bytes([90, 200] * 64) for _ in range(64))
    header = struct.pack(">IIBBBBB", 64, 64, 8, 4, 0, 0, 0)
    profile = chunk(b"iCCP", b"grey\0\0" + zlib.compress(b"profile"))
    size = chunk(b"pHYs", bytes(9)) + chunk(b"tEXt", b"Author\0someone")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + profile + size
                                     + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))
    remove_all([tmp_path / "a.png"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    clean = (tmp_path / "out" / "a.png").read_bytes()
    assert size in clean and b"iCCP" not in clean
    assert (read_plate(tmp_path / "out" / "a.png").alpha == 200).all()


def test_each_channel_of_an_exr_keeps_its_depth(tmp_path: Path, everywhere: Path) -> None:
    light = np.random.default_rng(0).uniform(0.2, 0.6, (48, 64)).astype(np.float16)
    save_exr(tmp_path / "plate.exr", {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
             {"R": light, "G": light.astype(np.float32), "B": light})
    remove_all([tmp_path / "plate.exr"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    channels = read_plate(tmp_path / "out" / "plate.exr").rest["channels"]
    assert [channels[name].dtype for name in "RGB"] == [np.float16, np.float32, np.float16]
    assert (channels["R"] < light).all()


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_floats_of_a_tiff_stay_floats(channels: int, tmp_path: Path) -> None:
    light = np.random.default_rng(0).uniform(-1, 30, (24, 32, channels)).astype(np.float32)
    _, data = cv2.imencode(".tif", light, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    (tmp_path / "a.tif").write_bytes(data.tobytes())
    plate = read_plate(tmp_path / "a.tif")
    codes = plate.codes.copy()
    codes[4:9, 5:11] *= np.float32(0.5)
    write_plate(tmp_path / "b.tif", plate, codes)
    again = read_plate(tmp_path / "b.tif")
    np.testing.assert_array_equal(again.codes, codes)
    assert again.codes.dtype == np.float32
    if plate.alpha is not None:
        np.testing.assert_array_equal(again.alpha, plate.alpha)


@pytest.mark.parametrize(("depth", "key"), [(2, 1), (8, 90), (16, 90 * 257)])
def test_the_transparent_code_of_a_grey_png_is_its_alpha(depth: int, key: int, tmp_path: Path) -> None:
    top = 2**depth - 1
    grey = np.where(np.random.default_rng(0).random((8, 8)) < 0.5, key, top).astype(">u2" if depth == 16 else np.uint8)
    packed = grey if depth != 2 else sum(grey[:, part::4] << (6 - 2 * part) for part in range(4)).astype(np.uint8)
    parts = [(b"IHDR", struct.pack(">IIBBBBB", 8, 8, depth, 0, 0, 0, 0)), (b"tRNS", struct.pack(">H", key)),
             (b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in packed))), (b"IEND", b"")]
    (tmp_path / "a.png").write_bytes(png.SIGNATURE + b"".join(png.chunk(*part) for part in parts))
    plate = read_plate(tmp_path / "a.png")
    np.testing.assert_array_equal(plate.alpha == 0, grey == key)
    write_plate(tmp_path / "b.png", plate, plate.codes // 2)
    again = read_plate(tmp_path / "b.png")
    np.testing.assert_array_equal(again.alpha, plate.alpha)
    np.testing.assert_array_equal(again.codes, plate.codes // 2)


def test_a_very_wide_plate(everywhere: Path) -> None:
    codes = picture(70, 40_000)
    less = _remove(Remover(everywhere, working_size=64), codes) < codes
    assert less[:, :30_000].any() and less[:, 35_000:].any()


def test_the_flare_of_an_exr_lies_where_its_plate_does_in_its_colours(tmp_path: Path, everywhere: Path) -> None:
    light = np.random.default_rng(0).uniform(0.2, 0.6, (48, 64)).astype(np.float32)
    header = {"chromaticities": AP1, "dataWindow": (np.array([-5, -5], np.int32), np.array([58, 42], np.int32)),
              "displayWindow": (np.array([0, 0], np.int32), np.array([53, 37], np.int32)), "pixelAspectRatio": 2.0}
    write_exr(tmp_path / "plate.exr", dict.fromkeys("RGB", light), half=False, header=header)
    remove_all([tmp_path / "plate.exr"], tmp_path / "out", Remover(everywhere, working_size=64), Progress(),
               flare_folder=tmp_path / "flare")
    placings = []
    for folder in ("", "out", "flare"):
        with OpenEXR.File(str(tmp_path / folder / "plate.exr"), header_only=True) as file:
            placings.append([np.ravel(file.parts[0].header[name]).tolist() for name in header])
    assert placings[0] == placings[1] == placings[2]
    parts = [read_picture(tmp_path / folder / "plate.exr").pixels for folder in ("", "out", "flare")]
    np.testing.assert_allclose(parts[1] + parts[2], parts[0], atol=1e-3)


def test_the_flare_taken_is_what_plate_and_clean_plate_differ_by(tmp_path: Path, everywhere: Path) -> None:
    write_codes(tmp_path / "plate.png", picture())
    remove_all([tmp_path / "plate.png"], tmp_path / "out", Remover(everywhere, working_size=64), Progress(),
               flare_folder=tmp_path / "flare")
    flare = read_exr(tmp_path / "flare" / "plate.exr")
    before, after = (read_picture(path).linear() for path in (tmp_path / "plate.png", tmp_path / "out" / "plate.png"))
    np.testing.assert_allclose(np.stack([flare[name] for name in "RGB"], -1), before - after, atol=1e-3)


# Mattes.


def _matte(path: Path, width: int, height: int, dtype: type = np.uint8) -> Path:
    """White on the left half, black on the right."""
    values = np.zeros((height, width), dtype)
    values[:, :width // 2] = np.iinfo(dtype).max
    path.parent.mkdir(exist_ok=True)
    return write_codes(path, values)


@pytest.mark.parametrize(("scale", "dtype"), [(1, np.uint8), (1, np.uint16), (2, np.uint8)])
def test_flares_are_taken_where_the_matte_is_white_alone(tmp_path: Path, everywhere: Path, scale: int,
                                                         dtype: type) -> None:
    source = write_codes(tmp_path / "plate.png", picture())
    matte = _matte(tmp_path / "matte.png", 90 // scale, 60 // scale, dtype)
    remove_all([source], tmp_path / "out", Remover(everywhere, working_size=64), Progress(), mattes=Mattes(matte),
               flare_folder=tmp_path / "flare")
    clean, flare = cv2.imread(str(tmp_path / "out" / "plate.png")), read_exr(tmp_path / "flare" / "plate.exr")
    difference = np.abs(clean.astype(int) - cv2.imread(str(source))).max(-1)
    assert (difference[:, :44] > 0).mean() > 0.9, "black has nothing to take"
    assert not difference[:, 46:].any()
    assert not flare["R"][:, 46:].any()
    assert (flare["R"][:, :44] > 0).mean() > 0.9


@pytest.mark.parametrize("painted", ["as shown", "on the pixels", "as the plate"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_matte_lies_as_its_plate_is_shown(tmp_path: Path, orientation: int, painted: str) -> None:
    """A telephone held upright stores its photographs on their sides."""
    stored = np.zeros((60, 90), np.uint8)
    stored[:10, :20] = 255
    if painted == "on the pixels" and orientation == 3:
        pytest.skip("that cannot be told from one that was painted as shown")
    values = upright(stored, orientation) if painted == "as shown" else stored
    raw = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    segment = exif_segment("MM", orientation, 27) if painted == "as the plate" else b""
    (tmp_path / "matte.jpg").write_bytes(raw[:2] + segment + raw[2:])
    found = Mattes(tmp_path / "matte.jpg").read(Path("a.jpg"), whole(90, 60), orientation)
    np.testing.assert_allclose(found, stored / 255, atol=0.03)


def test_a_grey_matte_takes_a_part(everywhere: Path) -> None:
    codes = np.full((60, 90, 3), 180, np.uint8)
    plate = plate_of(codes)
    remover = Remover(everywhere, working_size=64)
    whole, half = (remover.remove(plate, np.full((60, 90), share, np.float32))[1].astype(np.float32).mean()
                   for share in (1, 0.5))
    assert abs(half / whole - 0.5) < 0.03


def test_what_is_faint_is_taken_where_it_is_marked(tmp_path: Path) -> None:
    faint = Remover(network_file(tmp_path / "faint.safetensors", bias=0.9 * remover_module.LEAST), working_size=64)
    codes = np.full((60, 90, 3), 46_000, np.uint16)
    assert np.array_equal(_remove(faint, codes), codes)
    assert (faint.remove(plate_of(codes), np.ones((60, 90), np.float32))[0] < codes).mean() > 0.3


def test_a_plate_is_made_again_when_it_would_come_out_otherwise(tmp_path: Path, everywhere: Path,
                                                                nowhere: Path) -> None:
    """By other weights, options or mattes, whatever the times of their files."""
    for name in "ab":
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    with pytest.raises(FrameError, match=r"c\.png is missing"):
        remove_all([tmp_path / "in" / "c.png"], tmp_path / "none", Remover(everywhere, working_size=64), Progress())
    for name, values in (("left", 0), ("right", 255)):
        for plate in "ab":
            write_codes(tmp_path / name / f"{plate}.png", np.full((60, 90, 3), values, np.uint8))

    def made(remover: Remover, matte: str = "", **options: bool) -> int:
        mattes = Mattes(tmp_path / matte) if matte else None
        found = remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes, **options)
        return int(found["made"])

    first = Remover(everywhere, working_size=64)
    assert [made(first), made(first)] == [2, 0]
    for remover in (Remover(nowhere, working_size=64), Remover(everywhere, working_size=96),
                    Remover(everywhere, working_size=64, glow="kept"),
                    Remover(everywhere, working_size=64, glow="taken"), first):
        assert [made(remover), made(remover)] == [2, 0]
    assert [made(first, "left"), made(first, "left"), made(first, "right"), made(first), made(first, stills=True)] == [
        2, 0, 2, 2, 2]


def test_a_plate_is_made_again_when_it_or_a_neighbour_is_another(tmp_path: Path, everywhere: Path) -> None:
    """Whatever the times of the files: a plate may be replaced by an older one."""
    for number in range(1, 25):
        write_codes(tmp_path / "in" / f"{number}.png", picture())
    remover = Remover(everywhere, working_size=64)

    def made(**options: bool) -> set[str]:
        before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("*.png")}
        remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress(), **options)
        return {path.stem for path in (tmp_path / "out").glob("*.png")
                if path.stat().st_mtime_ns != before.get(path.name)}

    assert len(made()) == 24
    os.utime(tmp_path / "in" / "3.png", (2e9, 2e9))
    assert not made(), "its content is what counts"
    write_codes(tmp_path / "in" / "3.png", np.full((60, 90, 3), 40, np.uint8))
    os.utime(tmp_path / "in" / "3.png", (1, 1))
    assert made() == {str(number) for number in range(1, 20)}, "as far as it is looked at"
    assert len(made(stills=True)) == 24
    write_codes(tmp_path / "in" / "3.png", picture())
    assert made(stills=True) == {"3"}


def test_what_is_not_from_here_is_not_written_over(tmp_path: Path, everywhere: Path) -> None:
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(everywhere, working_size=64)
    work = write_codes(tmp_path / "out" / "a.png", np.zeros((60, 90, 3), np.uint8)).read_bytes()
    with pytest.raises(FrameError, match=r"a\.png is there, and .*remove\.json does not tell of it"):
        remove_all([source], tmp_path / "out", remover, Progress())
    assert (tmp_path / "out" / "a.png").read_bytes() == work
    assert remove_all([source], tmp_path / "out", remover, Progress(), overwrite=True)["made"] == 1
    assert remove_all([source], tmp_path / "out", remover, Progress())["kept"] == 1
    (tmp_path / "out" / RECORD).unlink()
    with pytest.raises(FrameError, match="choose another folder"):
        remove_all([source], tmp_path / "out", remover, Progress())


def test_a_flare_is_not_written_over_what_is_not_from_here(tmp_path: Path, everywhere: Path) -> None:
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(everywhere, working_size=64)
    render = tmp_path / "renders" / "a.exr"
    write_exr(render, dict.fromkeys("RGB", np.zeros((60, 90))))
    work = render.read_bytes()
    with pytest.raises(FrameError, match=r"a\.exr is there, and .*remove\.json does not tell of it"):
        remove_all([source], tmp_path / "out", remover, Progress(), flare_folder=render.parent)
    assert render.read_bytes() == work
    for another in (remover, Remover(everywhere, working_size=64, glow="kept")):
        remove_all([source], tmp_path / "out", another, Progress(), flare_folder=tmp_path / "flares")
    remove_all([source], tmp_path / "out", remover, Progress(), flare_folder=render.parent, overwrite=True)
    assert render.read_bytes() != work


def test_a_plate_that_another_process_has_made_meanwhile_stays(tmp_path: Path) -> None:
    """A farm may give a task again while its first worker lives: what it makes in the same way is neither taken away
    nor taken for someone's work."""
    plate = write_codes(tmp_path / "out" / "b.png", picture())
    plate.unlink()
    source = write_codes(tmp_path / "in" / "b.png", picture())
    second = Record(tmp_path / "out")
    first = Record(tmp_path / "out")
    first.begin(Path("b.png"), source, "one way", [plate], overwrite=False)
    write_codes(plate, picture())
    assert second.is_made(Path("b.png"), "one way", [plate])
    for overwrite in (False, True):
        second.begin(Path("b.png"), source, "one way", [plate], overwrite)
        assert plate.exists()
    second.begin(Path("b.png"), source, "another way", [plate], overwrite=False)
    assert not plate.exists() and not first.is_made(Path("b.png"), "one way", [plate])


@pytest.mark.parametrize("by_the_fit", [True, False])
def test_clean_frames_of_other_frames_are_told(by_the_fit: bool, tmp_path: Path, everywhere: Path) -> None:
    """A regraded capture under its old names: what was removed/ then is no truth now."""
    capture, remover = Capture.open(make_capture(tmp_path / "capture", views=4)), Remover(everywhere, working_size=64)
    removed = capture.folder / "removed"
    shutil.rmtree(removed, ignore_errors=True)
    if by_the_fit:
        remove_from(Capture.open(capture.folder), remover, Progress())
    else:
        remove_all([capture.folder / "images"], removed, remover, Progress())
    check_removed(Capture.open(capture.folder))
    frame = capture.frame_path(capture.views[2])
    cv2.imwrite(str(frame), 255 - cv2.imread(str(frame)))
    with pytest.raises(CaptureError, match=rf"1 of the 4 flare-free frames .*\({frame.stem}"):
        check_removed(Capture.open(capture.folder))
    (removed / "remove.json").unlink()  # someone's own
    check_removed(Capture.open(capture.folder))


def test_clean_frames_are_estimates_until_someone_has_worked_on_all(tmp_path: Path, everywhere: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "capture", views=4))
    remove_from(capture, Remover(everywhere, working_size=64), Progress())
    made = Capture.open(capture.folder)
    for view in made.views:
        assert not has_exact(made)
        path = made.removed_path(view)
        cv2.imwrite(str(path), cv2.imread(str(path)) // 2)
    assert has_exact(made)
    shutil.copy(made.frame_path(made.views[0]), made.removed_path(made.views[0]))
    assert has_exact(made)
    (capture.folder / "removed" / "remove.json").unlink()
    assert has_exact(made), "someone's own"


def test_two_fits_that_clean_one_capture_at_once(tmp_path: Path, everywhere: Path) -> None:
    """Frame by frame in turns: whichever is first, removed/ is whole."""
    capture, remover = Capture.open(make_capture(tmp_path / "capture", views=4)), Remover(everywhere, working_size=64)
    turn, failed = threading.Barrier(2), []

    class InTurns(Progress):
        def advance(self, steps: int = 1, **figures: float) -> None:
            with contextlib.suppress(threading.BrokenBarrierError):
                turn.wait(5)
            super().advance(steps, **figures)

    def clean() -> None:
        try:
            remove_from(capture, remover, InTurns())
        except Exception as problem:
            failed.append(problem)
        turn.abort()

    both = [threading.Thread(target=clean) for _ in range(2)]
    for one in both:
        one.start()
    for one in both:
        one.join()
    assert not failed and not (capture.folder / UNFINISHED).exists()
    assert len(list((capture.folder / "removed").glob("*.png"))) == 4
    assert Capture.open(capture.folder).has_removed


def test_what_a_fit_has_cleaned_may_be_cleaned_again(tmp_path: Path, everywhere: Path) -> None:
    """A capture's removed/ says what made it, as every folder of clean plates does; a stopped one is gone on with."""
    capture, remover = Capture.open(make_capture(tmp_path / "capture", views=3)), Remover(everywhere, working_size=64)
    shutil.rmtree(capture.folder / "removed", ignore_errors=True)

    class Stopped(Progress):
        def advance(self, steps: int = 1, **figures: float) -> None:
            self.request_stop()
            super().advance(steps, **figures)

    with pytest.raises(Cancelled):
        remove_from(capture, remover, Stopped())
    first = next((capture.folder / UNFINISHED).rglob("*.png"))
    begun = first.stat().st_mtime_ns
    made = remove_from(capture, remover, Progress())
    assert (made / first.name).stat().st_mtime_ns == begun
    frames = [capture.frame_path(view) for view in capture.views]
    assert remove_all(frames, made, remover, Progress())["kept"] == 3
    assert remove_all(frames, made, Remover(everywhere, working_size=96), Progress())["made"] == 3


def test_frames_without_leading_noughts_are_told_once_each(tmp_path: Path, everywhere: Path,
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    """Those beside a frame are those of the numbers beside its own, and it is cleaned in that order."""
    folder = make_capture(tmp_path / "capture", views=24)
    model = folder / "sparse" / "0" / "images.txt"
    words = model.read_text()
    for number in range(24):
        (folder / "images" / f"{number:04d}.png").rename(folder / "images" / f"{number}.png")
        words = words.replace(f" {number:04d}.png", f" {number}.png")
    model.write_text(words)
    remover = Remover(everywhere, working_size=64)
    names, told = [], []
    shown, views = remover.shown, remover.views
    monkeypatch.setattr(remover, "shown", lambda plate: names.append(plate.path.name) or shown(plate))
    monkeypatch.setattr(remover, "views", lambda display: told.append(1) or views(display))
    remove_from(Capture.open(folder), remover, Progress())
    assert len(names) == len(set(names)) == len(told) == 24


def test_frames_that_differ_in_their_suffix_alone_are_told_before_any_is_cleaned(tmp_path: Path,
                                                                                 everywhere: Path) -> None:
    """Both would have one clean picture, and the second would be taken for what the first is without its flare."""
    folder = make_capture(tmp_path / "capture", views=3)
    model, frames = folder / "sparse" / "0" / "images.txt", folder / "images"
    model.write_text(model.read_text().replace(" 0001.png", " 0000.jpg"))
    cv2.imwrite(str(frames / "0000.jpg"), cv2.imread(str(frames / "0001.png")))
    with pytest.raises(CaptureError, match=r"0000\.jpg and 0000\.png of .* both have removed/0000\.png; give one"):
        remove_from(Capture.open(folder), Remover(everywhere, working_size=64), Progress())
    assert not (folder / UNFINISHED).exists() and not (folder / "removed").exists()


def test_a_fit_that_was_second_takes_what_the_first_has_cleaned(tmp_path: Path, everywhere: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "capture", views=3))
    shutil.rmtree(capture.folder / "removed", ignore_errors=True)
    remover = Remover(everywhere, working_size=64)

    class Meanwhile(Progress):
        def advance(self, steps: int = 1, **figures: float) -> None:
            if not (capture.folder / "removed").exists():
                remove_from(capture, remover, Progress())
            super().advance(steps, **figures)

    assert remove_from(capture, remover, Meanwhile()) == capture.folder / "removed"
    assert not (capture.folder / UNFINISHED).exists()
    assert Capture.open(capture.folder).has_removed


def test_plates_of_an_earlier_program_are_made_again(tmp_path: Path, everywhere: Path,
                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    source, out = write_codes(tmp_path / "in" / "a.png", picture()), tmp_path / "out"
    made = []
    for revision in (remover_module.REVISION, remover_module.REVISION, remover_module.REVISION + 1):
        monkeypatch.setattr(remover_module, "REVISION", revision)
        made.append(remove_all([source], out, Remover(everywhere, working_size=64), Progress())["made"])
    assert made == [1, 0, 1]


def test_a_plate_that_was_begun_is_made(tmp_path: Path, everywhere: Path) -> None:
    """A kill after the record, before the plate: what an earlier way made there is not taken for it."""
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(everywhere, working_size=64)
    remove_all([source], tmp_path / "out", remover, Progress())
    other = Remover(everywhere, working_size=96)
    how = made_from(other.described, [source])
    Record(tmp_path / "out").begin(Path("a.png"), source, how, [tmp_path / "out" / "a.png"], overwrite=False)
    assert not (tmp_path / "out" / "a.png").exists()
    assert remove_all([source], tmp_path / "out", other, Progress())["made"] == 1


def test_a_plate_that_a_kill_left_without_its_content_written_down_is_kept_once_it_is_worked_on(
        tmp_path: Path, everywhere: Path, nowhere: Path) -> None:
    """A kill after the plate, before the record tells what was written: a later call tells it."""
    source, remover = write_codes(tmp_path / "in" / "a.png", picture()), Remover(everywhere, working_size=64)
    clean, told = tmp_path / "out" / "a.png", tmp_path / "out" / RECORD
    remove_all([source], tmp_path / "out", remover, Progress())
    as_it_ended = told.read_text()
    told.write_text(json.dumps({**json.loads(as_it_ended), "written": {}}))
    assert remove_all([source], tmp_path / "out", remover, Progress())["kept"] == 1
    assert json.loads(told.read_text()) == json.loads(as_it_ended)
    work = write_codes(clean, picture() // 2).read_bytes()
    assert remove_all([source], tmp_path / "out", Remover(nowhere, working_size=64), Progress())["kept"] == 1
    assert clean.read_bytes() == work


def whole(width: int, height: int) -> DataWindow:
    return DataWindow((width, height), (0, 0), (width, height))


def test_a_matte_lies_where_its_file_and_the_plate_s_say(tmp_path: Path) -> None:
    """Cropped to what is painted, or of the frame alone where the plate has overscan, or of all of that."""
    painted = np.zeros((60, 90), np.float32)
    painted[20:30, 50:70] = 1
    cropped = {"dataWindow": ((50, 20), (69, 29)), "displayWindow": ((0, 0), (89, 59))}
    header = {name: tuple(np.array(corner, np.int32) for corner in corners) for name, corners in cropped.items()}
    write_exr(tmp_path / "cropped.exr", {"Y": painted[20:30, 50:70]}, header=header)
    write_exr(tmp_path / "whole.exr", {"Y": painted})
    write_exr(tmp_path / "half.exr", {"Y": painted[::2, ::2]})
    overscan = DataWindow((110, 72), (-10, -6), (90, 60))
    for name, off in (("cropped.exr", 0), ("whole.exr", 0), ("half.exr", 1)):
        for window in (whole(90, 60), overscan):
            found = Mattes(tmp_path / name).read(Path("a.exr"), window)
            assert found.shape == window.size[::-1]
            high, wide = np.nonzero(found > 0.5)
            corners = np.array([wide.min(), wide.max(), high.min(), high.max()]) + np.repeat(window.origin, 2)
            assert np.abs(corners - (50, 69, 20, 29)).max() <= off
    write_exr(tmp_path / "pixels.exr", {"Y": np.pad(painted, ((6, 6), (10, 10)))})
    found = Mattes(tmp_path / "pixels.exr").read(Path("a.exr"), overscan)
    np.testing.assert_array_equal(found[6:-6, 10:-10], painted)


def test_a_matte_that_is_multiplied_with_its_alpha_is_not_so_twice(tmp_path: Path) -> None:
    painted = np.full((60, 90, 4), 128, np.uint8)
    encoded = cv2.imencode(".tif", painted)[1].tobytes()
    for kind, told in ((tiff.PREMULTIPLIED, 128 / 255), (tiff.STRAIGHT, (128 / 255) ** 2)):
        (tmp_path / "matte.tif").write_bytes(tiff.with_tags(encoded, {tiff.EXTRA_SAMPLES: tiff.short(kind)}))
        found = Mattes(tmp_path / "matte.tif").read(Path("a.png"), whole(90, 60))
        np.testing.assert_allclose(found, told, atol=1e-3)


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_a_grey_plate_loses_the_luminance_of_a_flare(suffix: str, tmp_path: Path,
                                                     monkeypatch: pytest.MonkeyPatch, everywhere: Path) -> None:
    """A blue one too, and the flare that is written is what the plate has lost."""
    remover = Remover(everywhere, working_size=64)
    blue = np.zeros((64, 96, 3), np.float32)
    blue[..., 2] = 0.2
    monkeypatch.setattr(remover, "views", lambda display: told_once(blue[:display.shape[0], :display.shape[1]]))
    path = tmp_path / f"a{suffix}"
    if suffix == ".png":
        cv2.imwrite(str(path), np.full((64, 96), 180, np.uint8))
    else:
        write_exr(path, {"Y": np.full((64, 96), 0.5, np.float32)})
    plate = read_plate(path)
    assert plate.grey
    codes, flare = remover.remove(plate)
    assert (codes < plate.codes).all()
    assert np.ptp(codes, -1).max() == 0
    assert np.ptp(flare.astype(np.float32), -1).max() < 1e-3


@pytest.mark.parametrize("compression", ["DWAA", "DWAB", "B44", "B44A", "ZIP"])
def test_what_stays_of_an_exr_stays_whatever_its_compression(compression: str, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    noise = cv2.GaussianBlur(random.random((64, 96, 4)).astype(np.float32), (0, 0), 1.5).astype(np.float16)
    write_exr(tmp_path / "a.exr", {name: noise[..., k] for k, name in enumerate(("R", "G", "B", "mask.R"))},
              header={"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")})
    plate = read_plate(tmp_path / "a.exr")
    codes = plate.codes.copy()
    codes[41:43, 59:66] *= np.float16(0.5)  # across the blocks of 4 x 4 that some compress by
    write_plate(tmp_path / "b.exr", plate, codes)
    again = read_plate(tmp_path / "b.exr")
    np.testing.assert_array_equal(again.codes, codes)
    np.testing.assert_array_equal(again.rest["channels"]["mask.R"], plate.rest["channels"]["mask.R"])


def test_tiles_that_lie_in_any_order_become_lines_in_theirs(tmp_path: Path) -> None:
    path = tmp_path / "tiles.exr"
    header = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription(), "lineOrder": OpenEXR.RANDOM_Y}
    pixels = {name: np.full((60, 90), 0.5, np.float16) for name in "RGB"}
    with OpenEXR.File(header, pixels) as file:
        file.write(str(path))
    plate = read_plate(path)
    write_plate(tmp_path / "clean.exr", plate, plate.codes / np.float16(2))
    assert np.array_equal(read_exr(tmp_path / "clean.exr")["R"], np.full((60, 90), 0.25))


def test_a_matte_painted_on_nothing_is_its_alpha(tmp_path: Path) -> None:
    painted = np.full((60, 90, 4), 255, np.uint8)
    painted[:, :45, 3] = 0
    cv2.imwrite(str(tmp_path / "matte.png"), painted)
    found = Mattes(tmp_path / "matte.png").read(Path("a.png"), whole(90, 60))
    assert not found[:, :45].any()
    assert found[:, 45:].min() == 1


def test_every_plate_has_its_own_matte(tmp_path: Path, everywhere: Path) -> None:
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / "in").mkdir(exist_ok=True)
        write_codes(tmp_path / "in" / name, picture())
    _matte(tmp_path / "mattes" / "a.png", 90, 60)
    write_exr(tmp_path / "mattes" / "b.exr", {"Y": np.full((60, 90), np.nan)})
    remover, mattes = Remover(everywhere, working_size=64), Mattes(tmp_path / "mattes")
    with pytest.raises(FrameError, match=r"1 of 3 plates .*c\.png has no matte"):
        remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png", RECORD]
    assert np.array_equal(cv2.imread(str(tmp_path / "out" / "b.png")), cv2.imread(str(tmp_path / "in" / "b.png")))
    _matte(tmp_path / "mattes" / "c.png", 90, 60)
    mattes = Mattes(tmp_path / "mattes")
    for made, kept in ((1, 2), (0, 3)):
        found = remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes)
        assert (found["made"], found["kept"]) == (made, kept)
    _matte(tmp_path / "mattes" / "a.png", 45, 30)
    found = remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress(), mattes=mattes)
    assert (found["made"], found["kept"]) == (1, 2), "a matte that was painted again"


def test_mattes_that_make_no_sense(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="missing"):
        Mattes(tmp_path / "none.png")
    matte = Mattes(_matte(tmp_path / "mattes" / "a.png", 60, 60))
    with pytest.raises(FrameError, match="another shape"):
        matte.read(Path("a.png"), whole(90, 60))
    _matte(tmp_path / "mattes" / "a.tif", 60, 60)
    with pytest.raises(SettingsError, match="keep one"):
        Mattes(tmp_path / "mattes")


def bad_files(folder: Path) -> list[Path]:
    folder.mkdir(parents=True)
    (folder / "text.png").write_text("not a picture")
    (folder / "empty.jpg").write_bytes(b"")
    whole = write_codes(folder / "cut.png", picture())
    whole.write_bytes(whole.read_bytes()[:400])
    write_exr(folder / "cut.exr", dict.fromkeys("RGB", picture()[..., 0] / np.float32(255)))
    (folder / "cut.exr").write_bytes((folder / "cut.exr").read_bytes()[:-100])
    (folder / "bad.exr").write_bytes(b"\x76\x2f\x31\x01 and no more")
    write_exr(folder / "no_colour.exr", {"Z": np.ones((4, 4))})
    return sorted(folder.iterdir())


def test_bad_plates_do_not_stop_the_others(tmp_path: Path, everywhere: Path) -> None:
    bad = bad_files(tmp_path / "in")
    write_codes(tmp_path / "in" / "good.png", picture())
    with pytest.raises(FrameError) as told:
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    assert f"{len(bad)} of {len(bad) + 1} plates" in str(told.value)
    assert all(path.name in str(told.value) for path in bad)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["good.png", RECORD]


@pytest.mark.parametrize(("kind", "named", "depth", "channels"), [
    (".png", "a.jpg", np.uint16, 3), (".png", "a.jpeg", np.uint8, 4), (".tiff", "a.png", np.float32, 3)])
def test_a_plate_under_a_suffix_that_cannot_hold_it_is_left_out(tmp_path: Path, everywhere: Path, kind: str, named: str,
                                                                depth: type, channels: int) -> None:
    """OpenCV would bring its numbers to 8 bit, or leave its alpha out, without a word."""
    codes = np.full((48, 64, channels), 0.7, np.float32) if depth is np.float32 else np.full(
        (48, 64, channels), np.iinfo(depth).max * 2 // 3, depth)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / named).write_bytes(cv2.imencode(kind, codes)[1].tobytes())
    with pytest.raises(FrameError, match=r"suffix of another kind of file; rename it"):
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    assert not (tmp_path / "out" / named).exists()


@pytest.mark.skipif(os.name == "nt", reason="links want rights on Windows")
def test_a_link_that_leads_nowhere_is_told_as_a_plate_that_is_missing(tmp_path: Path, everywhere: Path) -> None:
    """A disk that is not mounted would leave a hole in the shot, and all would be said to be well."""
    for name in ("a.1", "a.3"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    (tmp_path / "in" / "a.2.png").symlink_to(tmp_path / "away" / "a.2.png")
    with pytest.raises(FrameError, match=r"1 of 3 plates could not be cleaned: .*a\.2\.png is missing"):
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    assert (tmp_path / "out" / "a.3.png").exists()


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_results_cannot_go_where_a_file_is(tmp_path: Path, everywhere: Path, place: str) -> None:
    """Which is said once, before the network is asked about every plate."""
    source = write_codes(tmp_path / "in" / "a.png", picture())
    (tmp_path / "file").touch()
    for folders in ({"folder": tmp_path / place}, {"folder": tmp_path / "out", "flare_folder": tmp_path / place}):
        with pytest.raises(SettingsError, match=r"file is no folder, and results are to go into .*; name another"):
            remove_all([source], remover=Remover(everywhere, working_size=64), progress=Progress(), **folders)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name == "nt", reason="links want rights on Windows")
def test_a_link_that_leads_back_to_itself_does_not_stop_the_others(tmp_path: Path, everywhere: Path) -> None:
    write_codes(tmp_path / "in" / "a.1.png", picture())
    (tmp_path / "in" / "a.0.png").symlink_to(tmp_path / "in" / "a.0.png")
    with pytest.raises(FrameError, match=r"1 of 2 plates could not be cleaned: .*a\.0\.png is missing: it is a link"):
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    assert (tmp_path / "out" / "a.1.png").exists()


def test_a_clean_plate_stays_when_its_plate_can_no_longer_be_read(tmp_path: Path, everywhere: Path) -> None:
    write_codes(tmp_path / "in" / "a.png", picture())
    remover = Remover(everywhere, working_size=64)
    remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress())
    before = (tmp_path / "out" / "a.png").read_bytes()
    plate = tmp_path / "in" / "a.png"
    plate.write_bytes(plate.read_bytes()[:200])
    with pytest.raises(FrameError, match="1 of 1 plates could not be cleaned"):
        remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress())
    assert (tmp_path / "out" / "a.png").read_bytes() == before


def test_a_flare_of_a_plate_that_was_made_otherwise_since_is_made_again(tmp_path: Path, everywhere: Path) -> None:
    """It would not go with the clean plate."""
    write_codes(tmp_path / "in" / "a.png", picture())
    one, other = (Remover(everywhere, working_size=size) for size in (64, 96))
    words = ([tmp_path / "in"], tmp_path / "out")
    remove_all(*words, one, Progress(), flare_folder=tmp_path / "flares")
    stale = (tmp_path / "flares" / "a.exr").read_bytes()
    remove_all(*words, other, Progress())
    assert remove_all(*words, other, Progress(), flare_folder=tmp_path / "flares")["made"] == 1
    assert (tmp_path / "flares" / "a.exr").read_bytes() != stale
    assert remove_all(*words, other, Progress(), flare_folder=tmp_path / "flares")["kept"] == 1


def test_a_plate_that_was_worked_on_is_kept(tmp_path: Path, everywhere: Path) -> None:
    """An artist has retouched one: it is kept when plates are made otherwise, until it is asked to go; and told when it
    shows what the frame no longer is."""
    for name in ("a", "b"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    one, other = (Remover(everywhere, working_size=size) for size in (64, 96))
    plates, out = [tmp_path / "in"], tmp_path / "out"
    remove_all(plates, out, one, Progress(), flare_folder=tmp_path / "flares")
    retouched = write_codes(out / "a.png", picture()[:, ::-1]).read_bytes()
    heard = Heard()
    found = remove_all(plates, out, other, heard, flare_folder=tmp_path / "flares")
    assert (found["made"], found["kept"]) == (1, 1) and any("were worked on" in text for text in heard.texts)
    assert (out / "a.png").read_bytes() == retouched
    write_codes(tmp_path / "in" / "a.png", 255 - picture())
    with pytest.raises(FrameError, match=r"a\.png was worked on since it was made"):
        remove_all(plates, out, other, Progress())
    assert (out / "a.png").read_bytes() == retouched
    remove_all(plates, out, other, Progress(), overwrite=True)
    assert (out / "a.png").read_bytes() != retouched
    assert remove_all(plates, out, one, Progress())["made"] == 2  # and it is no one's work any more


def test_another_ones_flare_is_not_taken_for_a_plates(tmp_path: Path, everywhere: Path) -> None:
    write_codes(tmp_path / "in" / "a.png", picture())
    remover = Remover(everywhere, working_size=64)
    remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress())
    (tmp_path / "flares").mkdir()
    (tmp_path / "flares" / "a.exr").write_bytes(b"another's")
    with pytest.raises(FrameError, match="someone's work"):
        remove_all([tmp_path / "in"], tmp_path / "out", remover, Progress(), flare_folder=tmp_path / "flares")
    assert (tmp_path / "flares" / "a.exr").read_bytes() == b"another's"


def test_a_full_disk_ends_the_batch(tmp_path: Path, nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """None of the others would fit; what else the system refuses is told in its own sentence."""
    for name in ("a", "b", "c"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    tried: list[str] = []

    def refused(number: int) -> Any:
        def write(results: Sequence[Path], *_: object) -> None:
            tried.append(results[0].name)
            raise OSError(number, os.strerror(number), str(results[0]))
        return write

    monkeypatch.setattr(batch, "write_results", refused(errno.ENOSPC))
    with pytest.raises(OSError) as full:
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(nowhere, working_size=64), Progress())
    assert (full.value.errno, tried) == (errno.ENOSPC, ["a.png"])
    monkeypatch.setattr(batch, "write_results", refused(errno.EACCES))
    with pytest.raises(FrameError, match=r"3 of 3 plates could not be cleaned: The system refused: Permission denied"):
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(nowhere, working_size=64), Progress())


@pytest.mark.parametrize("short", [
    MemoryError("Unable to allocate 3.00 GiB for an array"),
    cv2.error("OpenCV(5.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 9000000000 bytes"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory")])
def test_a_plate_that_does_not_fit_into_memory_is_left_out(tmp_path: Path, nowhere: Path, short: Exception,
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    shown = Remover.shown

    def shown_or_not(remover: Remover, plate: Plate) -> Any:
        if plate.path.name == "a.png":
            raise short
        return shown(remover, plate)

    monkeypatch.setattr(Remover, "shown", shown_or_not)
    with pytest.raises(FrameError, match=r"1 of 2 plates could not be cleaned: \S*a\.png does not fit into memory"):
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(nowhere, working_size=64), Progress())
    assert (tmp_path / "out" / "b.png").exists()


def test_a_defect_is_not_taken_for_a_bad_plate(tmp_path: Path, nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_codes(tmp_path / "in" / "a.png", picture())
    monkeypatch.setattr(Remover, "shown", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(nowhere, working_size=64), Progress())


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS])
def test_a_folder_that_may_not_be_written_ends_the_batch(tmp_path: Path, nowhere: Path, number: int,
                                                         monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b", "c"):
        write_codes(tmp_path / "in" / f"{name}.png", picture())
    opened, tried = os.open, []

    def refuse(path: Any, *words: Any, **options: Any) -> int:
        if Path(path).parent != tmp_path / "out":
            return opened(path, *words, **options)
        tried.append(path)
        raise OSError(number, os.strerror(number), path)

    monkeypatch.setattr("core.system.files._REFUSALS", 0)
    monkeypatch.setattr("core.system.files.os.open", refuse)
    with pytest.raises(FrameError, match=r"^[^ ]*out cannot be written to \([^)]*\); choose another folder"):
        remove_all([tmp_path / "in"], tmp_path / "out", Remover(nowhere, working_size=64), Progress())
    assert len(tried) == 1


def test_what_is_there_is_kept(tmp_path: Path, everywhere: Path) -> None:
    source = write_codes(tmp_path / "plate.png", picture())
    remover = Remover(everywhere, working_size=64)
    assert remove_all([source], tmp_path / "out", remover, Progress())["made"] == 1
    assert remove_all([source], tmp_path / "out", remover, Progress())["kept"] == 1
    assert remove_all([source], tmp_path / "out", remover, Progress(), overwrite=True)["made"] == 1
    (tmp_path / "out" / "plate.png").unlink()
    assert remove_all([source], tmp_path / "out", remover, Progress())["made"] == 1


def test_frames_whose_clean_pictures_would_be_one_on_windows_are_told(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "capture", 2))
    capture.views = (replace(capture.views[0], name="a.jpg"), replace(capture.views[1], name="A.png"))
    with pytest.raises(CaptureError, match=r"The frames a\.jpg and A\.png of .* would both have removed/A\.png"):
        _names(capture)


def test_inputs_that_make_no_sense(tmp_path: Path, everywhere: Path) -> None:
    source = write_codes(tmp_path / "plate.png", picture())
    remover = Remover(everywhere, working_size=64)
    with pytest.raises(SettingsError, match="overwritten"):
        remove_all([source], tmp_path, remover, Progress())
    (tmp_path / "other").mkdir()
    with pytest.raises(SettingsError, match="no pictures"):
        plates_of([tmp_path / "other"])
    twin = write_codes(tmp_path / "other" / "plate.png", picture())
    with pytest.raises(SettingsError, match="same file"):
        plates_of([source, twin])
    with pytest.raises(SettingsError, match="same file"):  # on Windows and macOS
        plates_of([source, twin.rename(twin.with_name("Plate.PNG"))])


def test_nothing_that_is_read_is_written_over_and_nothing_twice(tmp_path: Path, nowhere: Path) -> None:
    shot, remover = tmp_path / "shot", Remover(nowhere, working_size=64)
    write_exr(shot / "a.exr", dict.fromkeys("RGB", np.full((60, 90), 0.5)))
    before = (shot / "a.exr").read_bytes()
    with pytest.raises(SettingsError, match=r"a\.exr would be overwritten"):
        remove_all([shot], tmp_path / "out", remover, Progress(), flare_folder=shot)
    with pytest.raises(SettingsError, match="Two results"):
        remove_all([shot], tmp_path / "out", remover, Progress(), flare_folder=tmp_path / "out")
    write_codes(shot / "a.png", picture())
    with pytest.raises(SettingsError, match="Two results"):
        remove_all([shot], tmp_path / "out", remover, Progress(), flare_folder=tmp_path / "flare")
    assert (shot / "a.exr").read_bytes() == before and not (tmp_path / "out").exists()
    matte = write_codes(tmp_path / "roto" / "a.png", picture())
    for roto in (matte.parent, matte):
        with pytest.raises(SettingsError, match=r"a\.png would be overwritten"):
            remove_all([shot], matte.parent, remover, Progress(), mattes=Mattes(roto), overwrite=True)


def test_results_mattes_and_hidden_files_below_a_folder_are_no_plates_of_it(tmp_path: Path, everywhere: Path) -> None:
    shot = tmp_path / "shot"
    for name in ("a.png", ".thumbs/a.png", "roto/a.png"):
        (shot / name).parent.mkdir(parents=True, exist_ok=True)
        write_codes(shot / name, picture())
    for _ in range(2):
        found = remove_all([shot], shot / "clean", Remover(everywhere, working_size=64), Progress(),
                           flare_folder=shot / "flare", mattes=Mattes(shot / "roto"))
        assert found["made"] + found["kept"] == 1
    assert sorted(path.name for path in (shot / "clean").rglob("*")) == ["a.png", RECORD]


def test_clean_plates_of_an_earlier_run_are_no_plates_of_the_next(tmp_path: Path, everywhere: Path) -> None:
    shot, remover = tmp_path / "shot", Remover(everywhere, working_size=64)
    write_codes(shot / "day" / "a.png", picture())
    for out in ("clean", "day/clean2"):
        assert remove_all([shot], shot / out, remover, Progress())["made"] == 1
        assert [path.name for path in (shot / out).rglob("*.png")] == ["a.png"]
    again = remove_all([shot / "clean"], tmp_path / "again", remover, Progress())
    assert again["made"] == 1, "they are where their folder is given"
    write_codes(shot / "clean" / "own.png", picture())
    assert {name for _, name in plates_of([shot])} == {Path("day/a.png"), Path("clean/own.png")}, "no result"
    for name in ("day/a.png", "clean/own.png"):
        (shot / name).unlink()
    with pytest.raises(SettingsError, match="no pictures, or results alone"):
        plates_of([shot])


def test_a_long_shot_with_its_results_below_it_is_looked_through_once(tmp_path: Path,
                                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    names, asked = [f"{number:04d}.png" for number in range(40)], 0
    (tmp_path / "clean").mkdir()
    for name in names:
        for folder in (tmp_path, tmp_path / "clean"):
            (folder / name).touch()
    (tmp_path / "clean" / RECORD).write_text(json.dumps({"plates": dict.fromkeys(names, "so"), "flares": {}}))
    resolve = Path.resolve

    def counted(path: Path, strict: bool = False) -> Path:
        nonlocal asked
        asked += 1
        return resolve(path, strict)

    monkeypatch.setattr(Path, "resolve", counted)
    assert len(plates_of([tmp_path])) == 40
    assert asked < 4 * len(names)


def test_flares_of_an_earlier_run_are_no_plates_of_the_next(tmp_path: Path, everywhere: Path) -> None:
    shot, remover = tmp_path / "shot", Remover(everywhere, working_size=64)
    write_codes(shot / "day" / "a.png", picture())
    remove_all([shot], shot / "clean", remover, Progress())
    remove_all([shot], shot / "clean", remover, Progress(), flare_folder=shot / "flare")
    assert (shot / "flare" / "day" / "a.exr").is_file()
    shot = shot.rename(tmp_path / "moved")
    assert {name for _, name in plates_of([shot])} == {Path("day/a.png")}, "wherever they were moved together"
    assert {name for _, name in plates_of([shot / "flare"])} == {Path("day/a.exr")}, "where they are given"


def _luminance_and_chroma(path: Path) -> None:
    """An EXR of 8 x 8 pixels, 2 x 2 of them with one RY, in 16 bit floats without compression."""
    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    channels = b"".join(name + b"\0" + struct.pack("<iIii", 1, 0, step, step) for name, step in ((b"RY", 2), (b"Y", 1)))
    window = struct.pack("<4i", 0, 0, 7, 7)
    header = b"".join([b"\x76\x2f\x31\x01\x02\0\0\0", attribute(b"channels", b"chlist", channels + b"\0"),
                       attribute(b"compression", b"compression", b"\0"), attribute(b"dataWindow", b"box2i", window),
                       attribute(b"displayWindow", b"box2i", window), attribute(b"lineOrder", b"lineOrder", b"\0"),
                       attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
                       attribute(b"screenWindowCenter", b"v2f", bytes(8)),
                       attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)), b"\0"])
    lines = [struct.pack("<ii", y, length) + bytes(length) for y in range(8) for length in (24 - 8 * (y % 2),)]
    starts = [len(header) + 8 * 8 + sum(map(len, lines[:y])) for y in range(8)]
    path.write_bytes(header + struct.pack("<8Q", *starts) + b"".join(lines))


def test_pictures_that_would_come_out_as_something_else_are_refused_by_name(tmp_path: Path) -> None:
    codes = picture()
    _, data = cv2.imencode(".jpg", codes)
    jpeg = bytearray(data.tobytes())
    frame = jpeg.index(b"\xff\xc0")
    jpeg[frame + 9] = 4  # components; the sentence is about that, before a decoder looks at the rest
    (tmp_path / "print.jpg").write_bytes(jpeg)
    with pytest.raises(FrameError, match=r"print\.jpg is CMYK"):
        read_plate(tmp_path / "print.jpg")
    _tiff_with(tmp_path / "inks.tif", np.zeros((8, 8, 4), np.uint8), {tiff.PHOTOMETRIC: tiff.short(tiff.SEPARATED)})
    with pytest.raises(FrameError, match=r"inks\.tif is CMYK"):
        read_plate(tmp_path / "inks.tif")
    _tiff_with(tmp_path / "grey.tif", np.zeros((8, 8), np.uint8), {tiff.SAMPLES: tiff.short(2)})
    with pytest.raises(FrameError, match="grey with alpha"):
        read_plate(tmp_path / "grey.tif")
    _tiff_with(tmp_path / "lab.tif", np.zeros((8, 8, 3), np.uint16), {tiff.PHOTOMETRIC: tiff.short(tiff.LAB[0])})
    with pytest.raises(FrameError, match=r"lab\.tif is in Lab colours"):
        read_plate(tmp_path / "lab.tif")
    _tiff_with(tmp_path / "mask.tif", np.zeros((8, 8, 4), np.uint8), {tiff.SAMPLES: tiff.short(5)})
    with pytest.raises(FrameError, match=r"mask\.tif has 5 channels"):
        read_plate(tmp_path / "mask.tif")
    _tiff_with(tmp_path / "half.tif", np.zeros((8, 8), np.uint16), {tiff.SAMPLE_FORMAT: tiff.short(tiff.FLOATS)})
    with pytest.raises(FrameError, match="holds floats of 16 bits"):
        read_plate(tmp_path / "half.tif")
    _tiff_with(tmp_path / "long.tif", np.zeros((8, 8), np.float32), {tiff.SAMPLE_FORMAT: tiff.short(tiff.WHOLE)})
    with pytest.raises(FrameError, match="holds whole numbers of 32 bits"):
        read_plate(tmp_path / "long.tif")
    _tiff_with(tmp_path / "zstd.tif", codes, {tiff.COMPRESSION: tiff.short(50000)})
    with pytest.raises(FrameError, match=r"zstd\.tif is compressed by Zstandard, which .*; save it with LZW"):
        read_plate(tmp_path / "zstd.tif")
    jpeg[frame + 9], jpeg[frame + 4] = 3, 12
    (tmp_path / "deep.jpg").write_bytes(jpeg)
    with pytest.raises(FrameError, match=r"deep\.jpg holds 12 bits a colour; save it with 8"):
        read_plate(tmp_path / "deep.jpg")
    _, still = cv2.imencode(".png", codes)
    for frames in (1, 2):
        told = png.chunk(b"acTL", frames.to_bytes(4, "big") + bytes(4))
        (tmp_path / f"{frames}.png").write_bytes(still.tobytes()[:33] + told + still.tobytes()[33:])
    assert read_plate(tmp_path / "1.png").codes.shape == codes.shape
    with pytest.raises(FrameError, match=r"2\.png is an animated PNG; export its frames"):
        read_plate(tmp_path / "2.png")
    (tmp_path / "big.tif").write_bytes(tiff.BIG[0] + bytes(40))
    with pytest.raises(FrameError, match="is a BigTIFF"):
        read_plate(tmp_path / "big.tif")
    _, pages = cv2.imencodemulti(".tif", [codes, codes, codes])
    (tmp_path / "pages.tif").write_bytes(pages.tobytes())
    with pytest.raises(FrameError, match="3 pages"):
        read_plate(tmp_path / "pages.tif")
    _luminance_and_chroma(tmp_path / "chroma.exr")
    with pytest.raises(FrameError, match="several sizes"):
        read_plate(tmp_path / "chroma.exr")


@pytest.mark.parametrize(("colour", "alpha", "marked"), [
    ("black", "left", "left"), ("white", "left", "left"), ("left", "left", "left"), ("left", "full", "left"),
    ("black", "full", "none"), ("black", "none", "none")])
def test_the_alpha_of_an_exr_matte_counts(colour: str, alpha: str, marked: str, tmp_path: Path) -> None:
    """Rotos come with the shape in alpha alone, with it in all channels, or white beside it."""
    left = np.zeros((48, 64), np.float32)
    left[:, :32] = 1
    shapes = {"left": left, "black": 0 * left, "none": 0 * left, "white": 0 * left + 1, "full": 0 * left + 1}
    write_exr(tmp_path / "roto.exr", {**dict.fromkeys("RGB", shapes[colour]), "A": shapes[alpha]})
    found = Mattes(tmp_path / "roto.exr").read(Path("plate.png"), whole(64, 48))
    np.testing.assert_array_equal(found, shapes[marked])


def test_a_grey_png_with_alpha_stays_grey(tmp_path: Path, everywhere: Path) -> None:
    """OpenCV reads it as colour, and writes no such file: three equal channels and the alpha come of it."""
    grey = cv2.cvtColor(picture(), cv2.COLOR_BGR2GRAY)
    with_alpha = np.stack([grey, 255 - grey], -1)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", grey.shape[1], grey.shape[0], 8, 4, 0, 0, 0)),
              (b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in with_alpha))), (b"IEND", b"")]
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks))
    remove_all([tmp_path / "in"], tmp_path / "out", Remover(everywhere, working_size=64), Progress())
    clean = cv2.imread(str(tmp_path / "out" / "a.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(clean[..., 3], with_alpha[..., 1])
    assert np.ptp(clean[..., :3], axis=-1).max() == 0
    assert not np.array_equal(clean[..., 0], grey)


def test_multipart_exr_is_told(tmp_path: Path) -> None:
    pixels = np.zeros((4, 4), np.float32)
    parts = [OpenEXR.Part({"name": name, "type": OpenEXR.scanlineimage}, dict.fromkeys("RGB", pixels)) for name in "ab"]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "two.exr"))
    with pytest.raises(FrameError, match="2 parts"):
        read_plate(tmp_path / "two.exr")


def test_write_png_is_read_as_a_plate(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.full((3, 4, 3), 0.5), bits=16)
    plate = read_plate(tmp_path / "a.png")
    assert plate.top == 65535
    assert plate.codes[0, 0, 0] == 32768


def test_a_jpeg_keeps_the_resolution_of_its_colours(tmp_path: Path) -> None:
    codes = np.zeros((32, 32, 3), np.uint8)
    codes[:, ::2, 2] = codes[:, 1::2, 0] = 220  # columns of red and blue
    full = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    assert cv2.imwrite(str(tmp_path / "a.jpg"), codes, full)
    plate = read_plate(tmp_path / "a.jpg")
    changed = plate.codes.copy()
    changed[0, 0] = 7
    write_plate(tmp_path / "b.jpg", plate, changed)
    before, after = (cv2.imread(str(tmp_path / name))[16:].astype(int) for name in ("a.jpg", "b.jpg"))
    assert np.abs(after - before).max() < 30
