# SPDX-License-Identifier: GPL-3.0-or-later
"""Sequences: what is told of a frame is in line with what is told of those about it, and cuts stay cuts."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import FrameError
from core.images.plates import Plate
from core.removal.inference.confidence import Signs
from core.removal.inference.neighbours import OFFSETS, Sequences, by_number
from core.removal.inference.remover import Remover, Told, optical_flow
from core.removal.inference.temporal import Neighbour, Sighting, guide, of_one_shot, steadied
from core.removal.inference.test_time_views import Views, told_once
from core.removal.jobs.batch import plates_of, remove_all, with_neighbours
from core.removal.jobs.manifest import RECORD
from core.system.progress import Progress

Pixels = NDArray[np.float32]


def scene(seed: int) -> Pixels:
    """(48, 64, 3), smooth."""
    coarse = np.random.default_rng(seed).uniform(0.1, 0.9, (4, 5, 3))
    return np.asarray(cv2.resize(coarse, (64, 48), interpolation=cv2.INTER_LINEAR), np.float32)


def told(display: Pixels, added: Pixels | float) -> Sighting:
    """A frame of which that is told in every view."""
    return Sighting(guide(display), told_once(np.broadcast_to(np.float32(added), display.shape)))


def in_shot(here: Sighting, others: list[Sighting]) -> Told:
    """What is told of `here` beside those of the others that are of its shot."""
    a = here.guide
    return steadied(here, [
        Neighbour(other, share, optical_flow.flow(a.grey, other.guide.grey),
                  optical_flow.flow(other.guide.grey, a.grey))
        for other in others if (share := of_one_shot(a, other.guide)) > 0])


def in_line(here: Sighting, others: list[Sighting]) -> Pixels:
    """What a flare adds to it."""
    return in_shot(here, others).added


def wall(seed: int = 0) -> Pixels:
    """(96, 192, 3), with something to see in every place."""
    random = np.random.default_rng(seed)
    fine = random.uniform(0.1, 0.5, (24, 48, 3))
    return np.asarray(cv2.resize(fine, (192, 96), interpolation=cv2.INTER_CUBIC), np.float32).clip(0.05, 0.6)


def spot(x: float, y: float = 48) -> Pixels:
    """(96, 192, 3): a soft disc of light, a ghost."""
    at_y, at_x = np.mgrid[:96, :192]
    disc = 0.3 * np.exp(-((at_x - x)**2 + (at_y - y)**2) / (2 * 9**2))
    return np.repeat(disc[..., None], 3, -1).astype(np.float32)


def test_what_wavers_is_calmed_and_its_detail_stays() -> None:
    random = np.random.default_rng(0)
    detail = random.uniform(0, 0.02, (96, 192, 3)).astype(np.float32)
    levels = 0.1 + 0.02 * random.standard_normal(9)
    frames = [told(wall() + 0.2, level + detail) for level in levels]
    made = [in_line(here, [other for other in frames if other is not here]) for here in frames]
    assert np.std([one.mean() for one in made]) < 0.2 * np.std(levels)
    np.testing.assert_allclose(made[3] - made[3].mean(), detail - detail.mean(), atol=2e-3)


def pan(told_of: float) -> tuple[list[Sighting], list[Pixels]]:
    """A wall along which a camera goes by two pixels a frame, a ghost that goes the other way by seven, of which this
    part is told, and what it adds."""
    wide = np.hstack([wall(), wall(1)])
    flares = [spot(40 + 7 * frame) for frame in range(13)]
    return [told(wide[:, 2 * frame:2 * frame + 192] + flare, told_of * flare)
            for frame, flare in enumerate(flares)], flares


@pytest.mark.parametrize("told_of", [0.4, 1.5])
def test_what_is_missed_or_taken_too_much_is_put_right_by_frames_that_have_the_flare_elsewhere(told_of: float) -> None:
    frames, flares = pan(told_of)
    made = in_line(frames[6], [frames[6 + side * offset] for offset in (1, 2, 3, 4, 6) for side in (-1, 1)])
    before, after = (np.square(one - flares[6]).mean() for one in (frames[6].views.mean, made))
    assert after < 0.4 * before


def test_a_camera_that_changes_its_exposure_makes_no_flare() -> None:
    """Of a flare that is told right, under exposures that go to and fro."""
    frames, flares = pan(1)
    levels = 0.7 + 0.3 * np.cos(np.arange(13, dtype=np.float32))
    frames = [told(frame.guide.display * level, flare * level)
              for frame, flare, level in zip(frames, flares, levels, strict=True)]
    made = [in_line(frames[at], [frame for frame in frames if frame is not frames[at]]) for at in range(3, 10)]
    for here, flare, level in zip(made, flares[3:10], levels[3:10], strict=True):
        np.testing.assert_allclose(here, flare * level, atol=0.03)


def test_a_ghost_that_is_told_in_one_frame_is_not_drawn_into_those_that_have_it_elsewhere() -> None:
    frames, flares = pan(1)
    made = in_line(frames[6], [frame for frame in frames if frame is not frames[6]])
    np.testing.assert_allclose(made, flares[6], atol=0.03)


def test_a_lamp_that_comes_on_is_no_flare() -> None:
    """In one frame the wall is lit; nobody told of a flare, or of one elsewhere alone."""
    lit = wall() + spot(60)
    for flare in (0 * lit, spot(160)):
        here, others = told(lit + flare, flare), [told(wall() + flare, flare) for _ in range(8)]
        made = in_line(here, others)
        assert made[:, :90].max() < 1e-6


def test_a_cut_and_a_frame_of_another_shape_change_nothing() -> None:
    here = told(scene(1), 0.05)
    made = in_line(here, [*(told(scene(seed), 0.4) for seed in (2, 3)), told(scene(1)[:32, :32], 0.4)])
    np.testing.assert_allclose(made, here.views.mean, atol=1e-6)


def test_photographs_of_other_things_change_nothing_however_dark_they_are() -> None:
    """Their skies are alike, and so is what is flat in them; what is told of one says nothing of the others."""
    def night(seed: int) -> Pixels:
        lit = np.random.default_rng(seed).random((12, 16, 3)) ** 4
        return np.asarray(cv2.resize(lit, (64, 48), interpolation=cv2.INTER_LINEAR), np.float32) * np.float32(0.15)

    others = [night(seed) for seed in range(1, 9)]
    for level in (0.05, 0.0):
        here = told(night(0), level)
        made = in_line(here, [told(other, 0.05 - level) for other in others])
        np.testing.assert_allclose(made, np.minimum(here.views.mean, here.guide.display), atol=1e-3)


def test_frames_of_a_pan_and_of_a_sky_without_anything_are_of_one_shot() -> None:
    wide = np.asarray(cv2.resize(np.random.default_rng(0).random((12, 40, 3)), (160, 48)), np.float32) * np.float32(0.1)
    grain = np.random.default_rng(1).normal(0.1, 0.002, (2, 48, 64, 3)).astype(np.float32)
    for here, after in ((wide[:, :64], wide[:, 1:65]), grain):
        assert of_one_shot(guide(here), guide(after)) > 0.5


def test_a_frame_that_is_seen_by_itself_is_what_was_told() -> None:
    random = np.random.default_rng(0)
    alone = told(scene(4), 0.1 * random.random((48, 64, 3)).astype(np.float32) * random.integers(0, 2, (48, 64, 1)))
    assert np.array_equal(steadied(alone, []).added, alone.views.mean)


def test_what_of_a_frame_is_glow_is_as_its_own_views_tell() -> None:
    frame = told(scene(4), 0.1)
    glow = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32)
    frame = frame._replace(views=frame.views._replace(glow=glow))
    still = optical_flow.flow(frame.guide.grey, frame.guide.grey)
    for about in ([], [Neighbour(told(scene(4), 0.1), np.float32(1), still, still)]):
        assert np.array_equal(steadied(frame, about).glow, glow)


@pytest.mark.parametrize("shape", [(32, 32), (32, 480), (480, 32)])
def test_the_smallest_frames_are_followed_too(shape: tuple[int, int]) -> None:
    frame = np.random.default_rng(0).uniform(0.2, 0.8, (*shape, 3)).astype(np.float32)
    made = in_line(told(frame, 0.1), [told(frame, 0.1) for _ in range(2)])
    np.testing.assert_allclose(made, 0.1, atol=0.01)


def test_a_flare_is_believed_as_far_as_in_the_frames_of_its_shot() -> None:
    """Of itself it is taken for the scene, the others plainly are flares; in another shot that says nothing."""
    even = np.full((48, 64, 3), 0.1, np.float32)
    unlikely, plain = (Signs(again=0, light=-3, apart=apart, peak=1, patchy=0.5) for apart in (0, -2))
    doubted, *sure = [Sighting(guide(scene(6)), told_once(even)._replace(signs=signs))
                      for signs in (unlikely, plain, plain)]
    elsewhere = Sighting(guide(scene(7)), sure[0].views)
    assert in_shot(doubted, []).worth == 0 and in_shot(doubted, [elsewhere]).worth == 0
    assert in_shot(doubted, sure).worth == 1


def test_names_go_by_their_numbers() -> None:
    names = ["a10.png", "a2.png", "b1.png", "a.png", "10a.png", "9b.png"]
    assert [path.name for path in sorted(map(Path, names), key=by_number)] == [
        "9b.png", "10a.png", "a2.png", "a10.png", "a.png", "b1.png"]


class Wavering(Remover):
    """Tells every plate another flare, without a network, and counts what it is asked."""

    described = "wavering"

    def __init__(self) -> None:
        self.working_size, self.glow, self.asked = 64, "kept at lamps", 0

    def shown(self, plate: Plate) -> Pixels:
        display = super().shown(plate)
        display[0, 0] = 0.1 * (int(plate.path.stem[1:]) % 3)  # by which `views` knows the frame
        return display

    def views(self, display: Pixels) -> Views:
        self.asked += 1
        return told_once(np.full_like(display, 0.1 + 0.2 * display[0, 0, 0]))


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """Twelve equal frames, numbered without leading zeros; the sixth is damaged."""
    folder = tmp_path / "shot"
    folder.mkdir()
    for number in range(1, 13):
        cv2.imwrite(str(folder / f"f{number}.png"), (scene(5) * 255).astype(np.uint8))
    (folder / "f6.png").write_bytes(b"no picture")
    return folder


def means(folder: Path) -> dict[str, float]:
    return {path.stem: float(cv2.imread(str(path)).mean()) for path in folder.glob("*.png")}


def test_a_sequence_is_steady_and_each_frame_is_told_of_once(shot: Path, tmp_path: Path) -> None:
    remover = Wavering()
    with pytest.raises(FrameError, match=r"1 of 12 plates.*f6\.png"):
        remove_all([shot], tmp_path / "out", remover, Progress())
    assert remover.asked == 11
    with pytest.raises(FrameError, match=r"1 of 12"):
        remove_all([shot], tmp_path / "stills", Wavering(), Progress(), stills=True)
    steady, single = means(tmp_path / "out"), means(tmp_path / "stills")
    assert len(steady) == len(single) == 11
    assert np.std(list(steady.values())) < 0.35 * np.std(list(single.values()))


def test_a_frame_is_the_same_whichever_others_are_cleaned(shot: Path, tmp_path: Path) -> None:
    (shot / "f6.png").unlink()
    remove_all([shot], tmp_path / "all", Wavering(), Progress())
    for number in (1, 8):
        remove_all([shot], tmp_path / "one", Wavering(), Progress(), wanted={Path(f"f{number}.png")})
    remove_all([shot / "f3.png"], tmp_path / "one", Wavering(), Progress())
    for path in (tmp_path / "one").glob("*.png"):
        assert path.read_bytes() == (tmp_path / "all" / path.name).read_bytes()
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == ["f1.png", "f3.png", "f8.png",
                                                                          RECORD]


def test_mattes_and_results_beside_a_frame_are_not_its_neighbours(shot: Path) -> None:
    (shot / "matte.png").write_bytes((shot / "f1.png").read_bytes())
    (shot / "clean").mkdir()
    (shot / "clean" / "f1.png").write_bytes((shot / "f1.png").read_bytes())
    found = with_neighbours([shot / "f1.png"], [shot / "clean", shot / "matte.png"])
    assert sorted(found) == sorted(shot.glob("f*.png"))


def test_a_frame_has_its_neighbours_where_results_go_above_or_beside_them(shot: Path, tmp_path: Path) -> None:
    for out, flare in ((shot.parent, None), (tmp_path / "clean", shot)):
        frames = sorted(shot.glob("f*.png"))
        for _ in range(2):
            assert sorted(with_neighbours([shot / "f1.png"], [out, flare])) == frames
            assert sorted(path for path, _ in plates_of([shot], [out, flare])) == frames
            remove_all([shot / "f1.png"], out, Wavering(), Progress(), flare_folder=flare)


def test_neighbours_are_those_of_the_folder(shot: Path) -> None:
    remover = Wavering()
    Sequences(remover, [shot / "f1.png", shot / "f2.png", shot.parent / "f3.png"]).read(shot / "f1.png")
    assert remover.asked == 2


def test_of_frames_of_another_shot_nothing_is_asked(shot: Path) -> None:
    for number in (2, 3):
        cv2.imwrite(str(shot / f"f{number}.png"), (scene(40 + number) * 255).astype(np.uint8))
    remover = Wavering()
    Sequences(remover, [shot / f"f{number}.png" for number in (1, 2, 3, 4)]).read(shot / "f1.png")
    assert remover.asked == 2


def test_what_counts_for_a_frame_is_sixteen_to_each_side_and_its_shot_alone(tmp_path: Path) -> None:
    """The shot is followed from frame to frame: the first and the last of a pan have nothing in common."""
    wide = np.asarray(cv2.resize(np.random.default_rng(0).random((12, 60, 3)), (240, 48)), np.float32)
    for number in range(40):
        frame = wide[:, 4 * number:4 * number + 64] if number < 25 else scene(number)
        cv2.imwrite(str(tmp_path / f"f{number}.png"), (frame * 255).astype(np.uint8))
    paths = [tmp_path / f"f{number}.png" for number in range(40)]
    asked: list[Path] = []

    class Counting(Wavering):
        def shown(self, plate: Plate) -> Pixels:
            self.last = plate.path
            return Remover.shown(self, plate)

        def views(self, display: Pixels) -> Views:
            asked.append(self.last)
            return super().views(display)

    sequences = Sequences(Counting(), paths)
    assert list(sequences.beside(paths[20])) == [*paths[4:20], *paths[21:37]]
    own = sequences.read(paths[20])[1]
    assert len(asked) == 1 + len(OFFSETS) + sum(20 + offset < 25 for offset in OFFSETS)
    assert own.added.shape == own.display.shape
