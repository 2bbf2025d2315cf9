# SPDX-License-Identifier: GPL-3.0-or-later
"""Flares made from lens prescriptions: settings, tracing, fit, the .flare."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.errors import Cancelled, SettingsError
from core.fit import traced_flare
from core.fit.traced_flare import make_flare
from core.fit.traced_settings import REFERENCE_REACH, TracedFlareSettings
from core.look import ViewOfLight, draw, read_look
from core.optics.flare import build_optics
from core.optics.ghosts import draw_ghosts, limit_brightness
from core.optics.lenses import find_lens, lens_names
from core.optics.prescription import parse_prescription
from core.optics.starburst import starburst_texture
from core.system.progress import Progress
from tests.core.recording_progress import StopAfter

SMALL = {"lens": "US4099850", "tracing.width": 64, "tracing.positions": 8, "tracing.bands": 2, "ghosts.count": 4,
         "fit.iterations": 80, "fit.gaussians": 150, "fit.max_gaussians": 200}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, traced_flare.TracedResult]:
    file = tmp_path_factory.mktemp("made") / "a.flare"
    return file, make_flare(TracedFlareSettings().override(SMALL), file, Progress(), notes="n", licence="CC0-1.0")


def test_the_error_falls_with_the_length_of_the_fit(made: tuple[Path, traced_flare.TracedResult],
                                                    tmp_path: Path) -> None:
    short = make_flare(TracedFlareSettings().override({**SMALL, "fit.iterations": 2}), tmp_path / "b.flare", Progress())
    assert made[1].error < 0.6 * short.error
    assert made[1].max_error >= made[1].error


def test_a_long_lens_is_fitted_as_well_as_a_short_one(made: tuple[Path, traced_flare.TracedResult],
                                                      tmp_path: Path) -> None:
    settings = TracedFlareSettings().override({**SMALL, "focal_length": 600.0})
    long = make_flare(settings, tmp_path / "b.flare", Progress())
    assert long.error < 1.2 * made[1].error


def test_a_made_flare_is_a_look_as_any_other(made: tuple[Path, traced_flare.TracedResult]) -> None:
    look = read_look(made[0])
    assert (look.blend, look.notes, look.licence, look.names) == ("add", "n", "CC0-1.0", ("light",))
    assert look.pixel_grid is not None and look.pixel_grid.min_focal_length == pytest.approx(look.camera.fx)
    names = [element.name for element in look.lights[0].elements]
    assert names and len(set(names)) == len(names)
    assert sum(len(element.members) for element in look.lights[0].elements) == look.count == made[1].count


def test_the_place_of_the_camera_changes_nothing(made: tuple[Path, traced_flare.TracedResult]) -> None:
    look = read_look(made[0])
    place = np.array([0.1, -0.05], np.float32)

    def drawn(camera: tuple[float, float, float]) -> np.ndarray:
        view = ViewOfLight(np.array(camera, np.float32), np.eye(3, dtype=np.float32), place, 1.0)
        flare = look.lights[0].evaluate(view)
        assert flare is not None
        return draw([flare], look.camera.intrinsics, 64, 36, "add", look.pixel_grid)

    here = drawn((0, 0, 0))
    assert here.max() > 0.1
    np.testing.assert_allclose(drawn((300, -20, 50)), here, atol=1e-3 * float(here.max()))


def test_the_same_settings_make_the_same_file(made: tuple[Path, traced_flare.TracedResult], tmp_path: Path) -> None:
    again = tmp_path / "a.flare"
    make_flare(TracedFlareSettings().override(SMALL), again, Progress(), notes="n", licence="CC0-1.0")
    assert again.read_bytes() == made[0].read_bytes()


def test_a_stopped_fit_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        make_flare(TracedFlareSettings().override(SMALL), tmp_path / "a.flare", StopAfter(1, "fit"))
    assert list(tmp_path.iterdir()) == []


def test_ghosts_have_their_level() -> None:
    """The root mean square of the traced ghosts is the setting `ghosts.level`."""
    settings = TracedFlareSettings().override({**SMALL, "ghosts.level": 0.05})
    setup, camera = traced_flare.setup_with_ghost_gain(settings), traced_flare.traced_camera(settings)
    optics, pairs = build_optics(setup)
    half = settings.reach * np.array([1, settings.height / 64])
    squares = [np.square(draw_ghosts(optics, pairs, setup.ghosts, tuple(half * probe), (camera.fx, camera.fy),
                                     (camera.cx, camera.cy), 64, 36)).mean() for probe in traced_flare.PROBES]
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.05, rel=0.1)


def test_ghosts_in_focus_have_a_limit_and_the_same_level() -> None:
    """At 64 pixels the level alone would give this lens pixels of five times white."""
    values = {**SMALL, "ghosts.level": 0.1}
    free = traced_flare.setup_with_ghost_gain(TracedFlareSettings().override({**values, "ghosts.limit": 1e6}))
    setup = traced_flare.setup_with_ghost_gain(TracedFlareSettings().override({**values, "ghosts.limit": 0.2}))
    assert setup.ghosts.gain > 1.02 * free.ghosts.gain
    light = np.array([[[0.1, 0.4, 0.2]], [[0.1, 0.1, 0.2]]], np.float32)
    np.testing.assert_allclose(limit_brightness(light, 0.2), [[[0.05, 0.2, 0.1]], [[0.1, 0.1, 0.2]]], rtol=1e-6)
    assert limit_brightness(light, 0.4) is light


def test_tangents_scale_with_the_frame() -> None:
    """A telephoto has the starburst of a wide angle, relative to the frame."""
    normal = TracedFlareSettings().override({"focal_length": 27.0}).lens_setup()
    long = TracedFlareSettings().override({"focal_length": 270.0}).lens_setup()
    assert TracedFlareSettings().override({"focal_length": 27.0}).reach == pytest.approx(REFERENCE_REACH)
    assert long.starburst.extent == pytest.approx(normal.starburst.extent / 10)
    assert long.hood == pytest.approx(np.array(normal.hood) / 10)


@pytest.mark.parametrize(("values", "part"), [
    ({"iris.blades": 2}, "iris.blades must lie between 3 and 32"),
    ({"iris.f_number": 0.5}, "opens to f/3.4 at most"),
    ({"lens": "nothing.lens"}, "There is no lens 'nothing.lens'"),
    ({"colour": [0, 0, 0]}, "black light"),
    ({"glass.coating": [0.5, 9.0]}, "glass.coating must lie"),
    ({"streaks": [{"gain": 1.0, "width": 0.0}]}, "streaks need a gain"),
    ({"iris.nothing": 1}, "There is no setting 'iris.nothing'"),
    ({"iris.blades": "six"}, "cannot be used so"),
])
def test_settings_that_cannot_be_used_are_refused(values: dict[str, object], part: str) -> None:
    with pytest.raises(SettingsError, match=part.replace("(", r"\(")):
        TracedFlareSettings().override({**SMALL, **values}).lens_setup()


def test_an_attachment_that_forms_no_picture_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "filter.lens"
    file.write_text("0 2 1.5 60 50\nstop 1 1 0 50\n0 5 1 0 50\n")
    with pytest.raises(SettingsError, match="forms no picture"):
        make_flare(TracedFlareSettings().override({"lens": str(file)}), tmp_path / "a.flare", Progress())


def test_every_lens_of_the_program_can_be_named() -> None:
    for name in lens_names():
        lens = find_lens(name)
        assert 10 < lens.focal_length() < 200 and 1 < lens.widest_f_number() < 8
    assert find_lens("US 1 998 704").name == "US 1 998 704"


def test_a_scaled_lens_has_the_focal_length_and_the_same_f_number() -> None:
    lens = find_lens("GB850117")
    scaled = lens.scaled(2.5)
    assert scaled.focal_length() == pytest.approx(2.5 * lens.focal_length())
    assert scaled.widest_f_number() == pytest.approx(lens.widest_f_number())


def test_a_thin_lens_has_its_f_number() -> None:
    lens = parse_prescription("100 0.001 1.5 60 20\n-100 0.001 1 0 20\nstop 100 1 0 10\n", "thin")
    assert lens.widest_f_number() == pytest.approx(lens.focal_length() / 10, rel=1e-3)


def test_scratches_draw_rays_in_the_starburst() -> None:
    setup = TracedFlareSettings().override({"iris.roundness": 1.0, "glass.dust": 0}).lens_setup()
    clean, _ = build_optics(setup)
    scratched, _ = build_optics(replace(setup, scratches=20))

    def unevenness(aperture: object) -> float:
        texture = starburst_texture(aperture, setup.starburst)[..., 1]  # type: ignore[arg-type]
        y, x = np.mgrid[:1024, :1024] - 512
        around = texture[(np.hypot(x, y) > 100) & (np.hypot(x, y) < 104)]
        return float(around.std() / around.mean())

    assert unevenness(scratched.aperture) > 2 * unevenness(clean.aperture)
