# SPDX-License-Identifier: GPL-3.0-or-later
"""Image formation and synthesised flares: optics that can be checked by hand, and what a seed promises."""
from __future__ import annotations

import ast
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.colour.srgb import Pixels
from core.errors import FrameError, SettingsError
from core.images.write import write_png
from core.optics import prescription as lenses
from core.removal.model import image_formation
from core.removal.model.recipe import Recipe
from core.removal.synthesis import aspheric, shapes
from core.removal.synthesis.canvas import canvas_grid
from core.removal.synthesis.flare import FLARE_CLASSES, SynthesisedFlare, synthesise_flare
from core.removal.training import background_augmentation, pairs, random_cameras
from core.removal.training.backgrounds import Backgrounds, describe_unusable, is_held_out, read_backgrounds
from core.removal.training.flare_bank import MixedBank, SynthesisBank, UserFlares

ROOT = Path(__file__).resolve().parents[2]
SIZE = 96

# A plano-convex lens behind a stop: f = r / (n - 1) = 60 mm.
SIMPLE = """
stop  2.0  1.0  0     10  0
30    4.0  1.5  60    20  1
0     58   1.0  0     20  0
"""


def test_flare_adds_in_linear_light() -> None:
    scene, glow = (np.full((2, 2, 3), value, np.float32) for value in (0.5, 0.4))
    assert image_formation.to_display(scene**2 + glow**2, 2.0) == pytest.approx(np.sqrt(0.25 + 0.16), abs=1e-6)
    assert image_formation.to_display(scene**2.2 + 1, 2.2) == pytest.approx(1.0)
    assert image_formation.to_display(scene**1.8, 1.8) == pytest.approx(0.5, abs=1e-6)


def test_a_flare_adds_less_under_a_shoulder_where_the_scene_is_bright() -> None:
    random = np.random.default_rng(1)
    scene, glow = (random.random((4, 5, 3)).astype(np.float32) * reach for reach in (0.95, 2))
    for shoulder in (0.3, 0.7, 1.0):
        light = -np.log(1 - shoulder * scene) / shoulder
        expected = (1 - np.exp(-shoulder * (light + glow))) / shoulder
        assert image_formation.add_under_shoulder(scene, glow, shoulder) == pytest.approx(expected, abs=1e-5)
    assert image_formation.add_under_shoulder(scene, glow * 0, 0.5) == pytest.approx(scene)
    assert image_formation.add_under_shoulder(scene, glow, 1e-3) == pytest.approx(scene + glow, abs=0.01), "hardly bent"


def test_a_share_of_the_pairs_has_a_shoulder() -> None:
    bright = Backgrounds([np.full((120, 160, 3), 200, np.uint8)], [])
    added: list[list[float]] = []
    for seed in range(12):
        made = Single(synthesise_flare((2, seed), 128, lenses.built_in_lenses(), "glow"))
        both = [pairs.make_pair(np.random.default_rng(seed), made, bright, 96, 64, clean_share=0, shoulder_share=share)
                for share in (0, 1)]
        added.append([float((one.frame - one.scene).mean()) for one in both])
        assert all((one.frame - one.scene).min() > -0.1 for one in both), "no darker, but for JPEG"
    straight, bent = np.mean(added, 0)
    assert 0 < bent < 0.8 * straight


def test_a_share_of_the_pairs_has_lifted_blacks() -> None:
    """With and without flare alike: what lifts all of a frame as much is none."""
    some = Backgrounds([np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)], [])
    for seed in range(8):
        made = Single(synthesise_flare((2, seed), 128, lenses.built_in_lenses(), "ghosts"))
        one = pairs.make_pair(np.random.default_rng(seed), made, some, 96, 64, clean_share=1, lifted_black_share=1)
        assert 0.01 < one.scene.min() < 0.3 and one.scene.max() <= 1
        assert np.array_equal(one.frame, one.scene)
        black, white = random_cameras.draw_fade(np.random.default_rng(seed))
        assert black.shape == white.shape == (3,)
        assert (black >= 0).all() and (black + 0.4 < white).all() and (white <= 1).all()


def test_coverage_is_the_share_of_the_frame_that_holds_the_energy() -> None:
    layer = np.zeros((10, 10, 3), np.float32)
    assert image_formation.coverage(layer) == 0
    layer[0, 0] = 1
    assert image_formation.coverage(layer) == 0.01
    assert image_formation.coverage(np.ones((10, 10, 3), np.float32)) == 0.9


def test_a_lens_is_read_and_has_its_focal_length() -> None:
    lens = lenses.parse_prescription(SIMPLE, "simple")
    assert lens.focal_length() == pytest.approx(60)
    assert lens.stop == 0
    assert lens.indices(lenses.LINE_F)[1] > lens.indices(lenses.LINE_C)[1], "glass bends blue more"


@pytest.mark.parametrize(("text", "says"), [("", "not a lens"), ("1 2 3\n", "line 1"), ("30 4 1.5 60 20\n" * 3, "stop"),
                                            ("stop 1 nan 0 5\n", "line 1"), ("30 4 1.5 60 -2\n", "line 1")])
def test_a_text_that_is_no_lens_is_refused(text: str, says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        lenses.parse_prescription(text, "bad")


def test_a_single_lens_has_one_ghost_path() -> None:
    """By hand: reflected at the plane and then at the sphere from inside, mirrors of power 0 and 2 n / r."""
    lens = lenses.parse_prescription(SIMPLE, "simple")
    (ghost,) = lenses.trace_ghost_pairs(lens)
    assert ghost.surfaces == (1, 2)
    n, r, thick = lens.indices(lenses.CHANNEL_WAVELENGTHS[1])[1], 30.0, 4.0
    height, slope = 1.0, 0.0
    slope -= (n - 1) / r * height       # in, reduced slope
    height += 2 * thick / n * slope     # to the plane and back
    slope -= 2 * n / r * height         # the sphere, concave from inside
    height += thick / n * slope
    focus = 60 - thick / 1.5            # behind the plane, at the d line
    assert ghost.sensor[1, 0] == pytest.approx(height + focus * slope, rel=1e-6)
    assert ghost.stop[1] == pytest.approx([1, 0])


def test_reflectance_matches_fresnel_bare_and_coated() -> None:
    air, glass, waves = np.ones(1), np.full(1, 1.5), np.full(1, 0.55)
    assert lenses.reflectance(air, glass, waves, 0)[0] == pytest.approx(0.04)
    assert lenses.reflectance(air, glass, waves, 0.55)[0] < 0.015
    assert lenses.reflectance(air, glass, np.full(1, 0.4), 0.55)[0] > lenses.reflectance(air, glass, waves, 0.55)[0]


def test_the_built_in_lenses_are_photographic() -> None:
    assert [round(lens.focal_length()) for lens in lenses.built_in_lenses()] == [50, 51, 20, 28, 100, 20]


@pytest.mark.parametrize("kind", FLARE_CLASSES)
def test_a_flare_is_non_negative_and_a_function_of_its_seed(kind: str) -> None:
    one, again = (synthesise_flare((3, 5), SIZE, lenses.built_in_lenses(), kind) for _ in range(2))
    assert one.kind == kind
    for layer in (one.rest, one.glow, one.light):
        assert layer.shape == (SIZE, SIZE, 3)
        assert layer.dtype == np.float32
        assert np.isfinite(layer).all()
        assert layer.min() >= 0
    assert one.total.max() > 1e-3
    assert np.array_equal(one.total, again.total)
    assert not np.array_equal(one.total, synthesise_flare((3, 6), SIZE, lenses.built_in_lenses(), kind).total)


def test_a_smear_consists_of_beams_from_the_light() -> None:
    x, y = canvas_grid(SIZE)
    turn = np.linspace(-np.pi, np.pi, 400)
    for seed in range(12):
        beams = shapes.draw_smear(np.random.default_rng(seed), (0.1, -0.2), x, y).mean(-1)
        circles = (np.array([0.1 + r * np.cos(turn), -0.2 + r * np.sin(turn)]) for r in (0.02, 0.25))
        near, quarter = (beams[rows, columns] for columns, rows in (np.int32((at + 1) / 2 * SIZE) for at in circles))
        assert near.max() >= quarter.max() * 0.99, "brightest at the light"
        assert 0.1 < quarter.max() < 30
        assert np.median(quarter) < 0.5 * quarter.max(), "in some directions"


def test_flares_span_small_to_full_frame() -> None:
    covered = [image_formation.coverage(synthesise_flare((11, k), SIZE, lenses.built_in_lenses()).total)
               for k in range(60)]
    assert min(covered) < 0.02
    assert max(covered) > 0.7


def test_synthesis_shares_nothing_with_the_sample_scenes() -> None:
    for path in (ROOT / "core" / "removal").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = ([alias.name for alias in node.names] if isinstance(node, ast.Import)
                     else [node.module or ""] if isinstance(node, ast.ImportFrom) else [])
            assert not any("sample_scenes" in name for name in names), path


class Single:
    """A bank of one flare."""

    def __init__(self, made: SynthesisedFlare, colour: tuple[float, float, float] = (1, 1, 1)) -> None:
        self.layers = pairs.FlareLayers(made.rest, made.glow, made.light, made.lights, np.array(colour, np.float32))

    def draw(self, random: np.random.Generator) -> pairs.FlareLayers:
        del random
        return self.layers


def backgrounds() -> Backgrounds:
    random = np.random.default_rng(0)
    return Backgrounds([random.integers(0, 256, (80, 120, 3), np.uint8)], [])


def test_pairs_are_brighter_with_flare_and_keep_the_light() -> None:
    bank = Single(synthesise_flare((2, 0), 128, lenses.built_in_lenses(), "scatter"))
    made = [pairs.make_pair(np.random.default_rng(k), bank, backgrounds(), 96, 64, clean_share=0) for k in range(12)]
    for one in made:
        assert one.frame.shape == one.scene.shape == one.scene_with_glow.shape == (64, 96, 3)
        assert one.frame.min() >= 0 and one.frame.max() <= 1
        assert (one.scene_with_glow - one.scene).min() > -0.03, "the glow adds, but for what saturation takes"
        assert (one.scene_with_glow - one.scene).mean() > 0.01
        assert (one.frame - one.scene_with_glow).mean() > 2e-4, "the rest adds to that, some of it below what is stored"
    again = pairs.make_pair(np.random.default_rng(3), bank, backgrounds(), 96, 64, clean_share=0)
    assert np.array_equal(again.frame, made[3].frame)


def test_lights_against_the_light_are_where_the_scene_is_bright() -> None:
    """The scene is bright in its upper right quarter and dark elsewhere."""
    scene = np.full((64, 96, 3), 0.02, np.float32)
    scene[:32, 48:] = 0.7
    made = synthesise_flare((2, 0), 128, lenses.built_in_lenses(), "glow")
    layers = Single(made).draw(np.random.default_rng(0))
    there: list[bool] = []
    anywhere: list[bool] = []
    for seed in range(60):
        random = np.random.default_rng(seed)
        first = random_cameras.draw_placement(random, layers.size, 96, 64)
        matrix, bright = pairs._place_against_bright_scene(random, layers, first, scene)
        for places, laid in ((there, matrix), (anywhere, first)):
            x, y = pairs._canvas_to_frame(laid, layers, layers.lights[0])
            places.append(bool(x > 48 and y < 32))
        assert bright == pytest.approx(0.7 if there[-1] else 0.02, abs=1e-3)
    assert np.mean(there) > 0.9 > 0.6 > np.mean(anywhere)
    dark, lit = (np.mean([pairs.make_pair(np.random.default_rng(seed), Single(made), backgrounds(), 96, 64,
                                          clean_share=0, against_light_share=share).scene.mean()
                          for seed in range(30)]) for share in (0, 1))
    assert lit > dark, "half of them are exposed for that"


def test_a_share_of_the_pairs_is_clean() -> None:
    bank = Single(synthesise_flare((2, 0), 128, lenses.built_in_lenses(), "glow"))
    one = pairs.make_pair(np.random.default_rng(1), bank, backgrounds(), 96, 64, clean_share=1)
    assert np.array_equal(one.frame, one.scene)


def test_a_renewed_bank_equals_one_that_never_stopped() -> None:
    through, later = (SynthesisBank(4, 3, SIZE, lenses.built_in_lenses()) for _ in range(2))
    for end in range(3, 6):
        through.renew(end)
        for seed in range(6):
            through.draw(np.random.default_rng(seed))
    later.renew(5)
    for seed in range(6):
        a, b = (bank.draw(np.random.default_rng(seed)) for bank in (through, later))
        assert np.array_equal(a.rest, b.rest)
    drawn = [{float(bank.draw(np.random.default_rng(seed)).rest.sum()) for seed in range(20)}
             for bank in (through, SynthesisBank(4, 3, SIZE, lenses.built_in_lenses()))]
    assert [len(some) for some in drawn] == [3, 3]
    assert len(drawn[0] & drawn[1]) == 1, "of the flares 0 to 2, two made way for 3 and 4"


def test_parts_of_a_bank_take_turns() -> None:
    """A bank with fewer places than flares renews its parts in turn, so that each flare comes up again."""
    bank = SynthesisBank(4, 6, SIZE, lenses.built_in_lenses(), part_count=4)
    drawn = []
    for turn in range(8):
        bank.renew(6, turn)
        drawn.append({float(bank.draw(np.random.default_rng(seed)).rest.sum()) for seed in range(8)})
    assert [len(some) for some in drawn[:4]] == [2, 2, 1, 1]
    assert len(set.union(*drawn)) == 6
    assert drawn[4:] == drawn[:4]
    assert len(SynthesisBank(4, 2, SIZE, lenses.built_in_lenses(), part_count=4)) == 2, "more turns than flares"
    SynthesisBank(4, 2, SIZE, lenses.built_in_lenses(), part_count=4).draw(np.random.default_rng(0))


def test_a_share_of_a_bank_has_lights_of_a_saturated_colour() -> None:
    def colours(share: float) -> NDArray[np.float32]:
        """(flares, channels)"""
        bank = SynthesisBank(3, 40, SIZE, lenses.built_in_lenses(), share)
        of_all = {int(np.random.default_rng(seed).integers(40)): bank.draw(np.random.default_rng(seed)).colour
                  for seed in range(150)}
        return np.array([of_all[slot] for slot in sorted(of_all)])

    assert (colours(0) == 1).all()
    np.testing.assert_allclose(colours(1).max(1), 1, rtol=1e-3)
    assert (colours(1).min(1) < 0.31).all(), "in one channel there is little"
    assert 0.03 < (colours(Recipe().coloured_share) < 0.99).any(1).mean() < 0.35


def test_aspheric_ghosts_lie_on_the_line_through_the_middle() -> None:
    turn = np.deg2rad(70)
    for seed in range(12):
        here, again = (aspheric.draw_light_ghosts(np.random.default_rng(seed), (0.5, 0.1), SIZE) for _ in range(2))
        assert np.array_equal(here, again)
        assert np.isfinite(here).all()
        assert here.min() >= 0
        turned = (0.5 * np.cos(turn) - 0.1 * np.sin(turn), 0.5 * np.sin(turn) + 0.1 * np.cos(turn))
        there = aspheric.draw_light_ghosts(np.random.default_rng(seed), turned, SIZE)
        reach = [(layer.mean(-1) * np.hypot(*canvas_grid(SIZE))).sum() for layer in (here, there)]
        assert there.sum() == pytest.approx(here.sum(), rel=0.25), "about the middle it is the same"
        assert reach[1] == pytest.approx(reach[0], rel=0.35)


def even_ghost(monkeypatch: pytest.MonkeyPatch, centre: tuple[float, float], radius: float,
               third: float) -> NDArray[np.float32]:
    """(256, 256, 3) of a round stop without a texture, bent by third order spherical aberration alone."""
    bent = aspheric.Aberrations(np.ones(3, np.float32), np.full(3, third, np.float32), 0.0, 0.0, 0.0)
    monkeypatch.setattr(aspheric, "_draw_aberrations", lambda _: bent)
    monkeypatch.setattr(aspheric, "_draw_pupil", lambda _, u, v: (np.hypot(u, v) < 1).astype(np.float32))
    return aspheric._draw_ghost(np.random.default_rng(1), np.array(centre), radius, np.ones((8, 8), np.float32), 256)


@pytest.mark.parametrize("radius", [0.05, 0.3])
def test_an_even_stop_gives_an_even_ghost(monkeypatch: pytest.MonkeyPatch, radius: float) -> None:
    """Without aberration an evenly lit stop gives a disc of constant brightness."""
    ghost = even_ghost(monkeypatch, (0.2, -0.1), radius, third=0)
    x, y = canvas_grid(256)
    from_it = np.hypot(x - 0.2, y + 0.1)
    assert np.abs(ghost[from_it < 0.6 * radius] - 1).max() < 0.02
    assert ghost[from_it > 1.4 * radius].max() < 0.02


def test_a_fold_of_the_map_piles_light_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the map from stop to picture folds, a ghost has a bright rim, and nothing beyond it."""
    ghost = even_ghost(monkeypatch, (0, 0), 0.5, third=-0.6)  # past r = 0.745 the stop's light turns back
    rim = 128 + int(0.5 * 0.745 * (1 - 0.6 * 0.745**2) * 128)
    assert ghost[128, rim - 2:rim + 2, 0].max() > 2 * ghost[128, 128, 0]
    assert ghost[128, rim + 12:, 0].max() < 0.05


def test_a_share_of_a_bank_has_aspheric_ghosts() -> None:
    def rests(share: float) -> list[NDArray[np.float32]]:
        bank = SynthesisBank(3, 12, SIZE, lenses.built_in_lenses(), 0, share)
        return [bank.draw(np.random.default_rng(seed)).rest for seed in range(12)]

    without, some, of_all = rests(0), rests(0.4), rests(1)
    assert all((more >= less - 1e-3).all() for less, more in zip(without, of_all, strict=True))
    changed = [[not np.array_equal(one, other) for one, other in zip(without, those, strict=True)]
               for those in (some, of_all)]
    assert 0 < sum(changed[0]) < sum(changed[1])


def test_a_saturated_light_is_clipped_in_its_channel_with_flare_and_without() -> None:
    made = synthesise_flare((1, 0), 128, lenses.built_in_lenses(), "scatter")
    white, red = (pairs.make_pair(np.random.default_rng(1), Single(made, colour), backgrounds(), 96, 64, clean_share=0)
                  for colour in ((1, 1, 1), (1, 0.1, 0.01)))
    assert (red.scene[..., 0] > 0.99).sum() > 100
    assert np.array_equal(white.scene[..., 0], red.scene[..., 0])
    assert np.array_equal(white.frame[..., 0], red.frame[..., 0])
    assert red.frame[..., 2].mean() < white.frame[..., 2].mean() - 0.1


def test_a_grey_pair_repeats_one_channel() -> None:
    bank = Single(synthesise_flare((2, 0), 128, lenses.built_in_lenses(), "glow"))
    one = pairs.make_pair(np.random.default_rng(1), bank, backgrounds(), 96, 64, clean_share=0)
    grey = pairs.to_grey(one, 1)
    for part in ("frame", "scene", "scene_with_glow"):
        for channel in range(3):
            assert np.array_equal(getattr(grey, part)[..., channel], getattr(one, part)[..., 1])


def test_user_flares_are_read_with_their_lights(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no flare layers"):
        UserFlares(tmp_path, SIZE)
    picture = np.zeros((40, 60, 3))
    picture[10:30, 20:40] = 0.5
    light = np.zeros((40, 60, 3))
    picture[18:22, 28:32] = light[18:22, 28:32] = 1
    write_png(tmp_path / "Scattering_Flare" / "Compound_Flare" / "1.png", picture)
    write_png(tmp_path / "Scattering_Flare" / "Light_Source" / "1.png", light)
    own = UserFlares(tmp_path, SIZE)
    assert len(own) == 1
    write_png(tmp_path / "other set" / "Reflective_Flare" / "1.png", picture)
    other = UserFlares(tmp_path / "other set", SIZE)
    for both in (UserFlares(tmp_path, SIZE).draw(np.random.default_rng(k)) for k in range(8)):
        assert both.light.max() > 1 or np.array_equal(both.rest, other.draw(np.random.default_rng(0)).rest), \
            "a flare of another set has no light of this one's"
    layers = own.draw(np.random.default_rng(0))
    assert layers.light.max() > 1
    assert layers.lights[0] == pytest.approx((0, 0), abs=0.06)
    middle = SIZE // 2
    assert layers.rest[middle, middle].max() < 0.05, "the light is not flare"
    mixed = MixedBank(Single(synthesise_flare((2, 0), SIZE, lenses.built_in_lenses(), "rings")), own, 1.0)
    assert np.array_equal(mixed.draw(np.random.default_rng(0)).light, layers.light)


def test_unreadable_user_flares_and_missing_lights_are_listed(tmp_path: Path) -> None:
    compound = tmp_path / "Scattering_Flare" / "Compound_Flare"
    picture = np.full((20, 20, 3), 0.5)
    for name in ("1.png", "2.png"):
        write_png(compound / name, picture)
    write_png(tmp_path / "Scattering_Flare" / "Light_Source" / "1.png", picture)
    write_png(tmp_path / "Reflective_Flare" / "1.png", picture)
    own = UserFlares(tmp_path, SIZE)
    assert [path.name for path in own.missing_light] == ["2.png"], "ghosts have no lights in them"
    (compound / "2.png").write_bytes((compound / "2.png").read_bytes()[:60])
    for seed in range(20):
        assert own.draw(np.random.default_rng(seed)).rest.shape == (SIZE, SIZE, 3)
    for path in (compound / "1.png", tmp_path / "Reflective_Flare" / "1.png"):
        path.write_bytes(b"")
    with pytest.raises(FrameError, match=r"\.png"):
        own.draw(np.random.default_rng(0))
    with pytest.raises(SettingsError, match=r"None of the flares .*1\.png"):
        UserFlares(tmp_path, SIZE)
    write_png(compound / "2.png", picture)
    beside = UserFlares(tmp_path, SIZE)
    assert len(beside) == 1
    assert all(name in said for name, said in zip(("Reflective_Flare", "1.png"), beside.unreadable, strict=True))


def test_backgrounds_are_read_from_folders(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no pictures"):
        read_backgrounds([tmp_path])
    with pytest.raises(SettingsError, match="is no folder"):
        read_backgrounds([tmp_path, tmp_path / "misspelt"])
    with pytest.raises(SettingsError, match="no lens prescriptions"):
        lenses.read_lenses(tmp_path / "misspelt")
    (tmp_path / "empty.jpg").touch()
    for k in range(30):
        write_png(tmp_path / f"{k}.png", np.random.default_rng(k).random((64, 80, 3)))
    names = [path.name for path in tmp_path.glob("*.png")]
    both = [len(read_backgrounds([tmp_path], part).photos) for part in ("train", "test")]
    assert sum(both) == 30
    assert both[1] == sum(map(is_held_out, names)) > 0
    found = read_backgrounds([tmp_path])
    assert found.unusable == [tmp_path / "empty.jpg"]
    assert "empty.jpg first" in str(describe_unusable(found.unusable))
    drawn = found.draw(np.random.default_rng(0), 48, 32, 2.2)
    assert drawn.shape == (32, 48, 3)
    assert drawn.dtype == np.float32


def test_augmentation_makes_few_backgrounds_look_like_many() -> None:
    ramp = np.broadcast_to(np.linspace(20, 240, 160)[None, :, None] * np.array([1, 0.5, 0.25]), (120, 160, 3))
    plain, varied = (Backgrounds([ramp.astype(np.uint8)], [], varied) for varied in (False, True))

    def drawn(some: Backgrounds) -> list[Pixels]:
        scenes = [some.draw(np.random.default_rng(seed), 48, 32, 2.0) for seed in range(100)]
        assert all(scene.shape == (32, 48, 3) and scene.dtype == np.float32 for scene in scenes)
        assert all(np.isfinite(scene).all() and scene.min() >= 0 for scene in scenes)
        return scenes

    def sideways(scene: Pixels) -> bool:
        return bool(np.ptp(scene[..., 0], 0).mean() > np.ptp(scene[..., 0], 1).mean())

    def tinted(scene: Pixels) -> bool:
        red, green = (float(scene[..., channel].mean()) for channel in (0, 1))
        return abs(red / 4 - green) > 0.2 * green

    def askew(scene: Pixels) -> bool:
        """Gets brighter downwards too, but less so."""
        down, across = (np.median(np.abs(np.diff(scene.sum(-1), axis=axis))) for axis in (0, 1))
        return bool(across / 20 < down < across)

    def cut(scene: Pixels) -> bool:
        """Has edges both ways."""
        return all(np.abs(np.diff(scene[..., 1], axis=axis)).max() > 0.02 for axis in (0, 1))

    for scene in drawn(plain):
        assert not any(trait(scene) for trait in (sideways, tinted, askew, cut))
    shares = {trait.__name__: sum(map(trait, drawn(varied))) for trait in (sideways, tinted, askew, cut)}
    assert all(5 <= share <= 60 for share in shares.values()), f"of a hundred: {shares}"


def test_augmentation_adds_bright_objects_to_some_backgrounds() -> None:
    grey = Backgrounds([np.full((120, 160, 3), 60, np.uint8)], [], augmented=True)
    random = np.random.default_rng(5)
    drawn = [grey.draw(random, 96, 64, 2.0) for _ in range(200)]
    bright = [one for one in drawn if one.max() > 4 * np.median(one)]
    assert 0.05 < len(bright) / len(drawn) < 0.2
    assert all(np.isfinite(one).all() and one.min() >= 0 for one in drawn)


def test_haze_lies_behind_near_objects() -> None:
    random = np.random.default_rng(3)
    scene = (0.3 + 0.2 * random.random((80, 120, 3))).astype(np.float32)
    scene[50:, 20:70] = 0.01 * random.random((30, 50, 3))  # someone in front of it, against the light
    hidden = []
    for seed in range(30):
        hazy = background_augmentation._add_haze(np.random.default_rng(seed), scene)
        near, far = hazy[54:, 24:66], hazy[:30]
        assert np.abs(near - scene[54:, 24:66]).max() < 0.01, "no veil over it"
        hidden.append(1 - float(np.abs(np.diff(far, axis=1)).mean() / np.abs(np.diff(scene[:30], axis=1)).mean()))
    assert np.mean(hidden) > 0.2, "of what is far away less is seen"


def test_defocus_turns_a_light_into_a_shape_of_the_same_energy() -> None:
    light = np.zeros((80, 120, 3), np.float32)
    light[40, 60] = 900.0
    shapes = [background_augmentation._random_defocus(np.random.default_rng(seed), light) for seed in range(60)]
    for shape in shapes:
        lit = shape[..., 0] > 0.01 * shape.max()
        rows, columns = np.nonzero(lit)
        reach = np.hypot(rows - 40, columns - 60).max()
        assert shape.sum() == pytest.approx(2700, rel=0.01)
        assert reach <= 0.04 * np.hypot(80, 120) + 1.5
        if reach > 3:
            inside = shape[lit][:, 0]
            assert np.median(inside) > 0.8 * shape.max(), "as bright everywhere, unlike a glow"
    sizes = [int((shape[..., 0] > 0.01 * shape.max()).sum()) for shape in shapes]
    assert min(sizes) < 15 < 60 < max(sizes)


def test_a_transparent_flare_lies_on_black(tmp_path: Path) -> None:
    painted = np.full((64, 64, 4), 255, np.uint8)
    painted[..., 3] = 0
    painted[24:40, 24:40, 3] = 255
    cv2.imwrite(str(tmp_path / "a.png"), painted)
    drawn = UserFlares(tmp_path, SIZE).draw(np.random.default_rng(0)).rest
    assert 0 < (drawn.max(-1) > 0.01).mean() < 0.1
