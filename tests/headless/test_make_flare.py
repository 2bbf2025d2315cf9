# SPDX-License-Identifier: GPL-3.0-or-later
"""The command make-flare."""
from __future__ import annotations

from pathlib import Path

import pytest
from fit_flare.headless import cli

from core.look import read_look

TINY = ("tracing.width=48", "tracing.positions=4", "tracing.bands=1", "ghosts.count=3", "fit.iterations=10",
        "fit.gaussians=60")


def run(*argv: object) -> int:
    return cli.main(["make-flare", *map(str, argv)])


def test_make_flare_writes_a_flare_and_its_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lens, out = tmp_path / "my.lens", tmp_path / "made" / "blue.flare"
    lens.write_text("50 4 1.6 55 30\n-200 1 1 0 30\nstop 3 1 0 18\n-60 2 1.7 30 24\n60 4 1.6 60 24\n-40 40 1 0 24\n")
    settings = tmp_path / "settings.toml"
    settings.write_text('sensor = 24.0\n[iris]\nblades = 5\nrotation = 3.0\n')
    changes = [part for change in TINY for part in ("--set", change)]
    assert run(lens, "--out", out, "--settings", settings, "--blades", 6, "--streak", 0.8, "--colour", "1,0.8,0.5",
               "--coating", "520,0", "--dispersion", "off", "--notes", "mine", *changes) == 0
    look = read_look(out)
    assert look.notes == "mine" and look.camera.width == 48
    text = capsys.readouterr()
    assert "relative L2 in linear light" in text.out + text.err


@pytest.mark.parametrize(("argv", "part"), [
    (("US4099850",), "needs a lens and --out"),
    (("US4099850", "--out", "a.exr"), "is not a .flare"),
    (("nothing", "--out", "a.flare"), "There is no lens"),
    (("US4099850", "--out", "a.flare", "--coating", "blue"), "is not a list of numbers"),
    (("US4099850", "--out", "a.flare", "--set", "iris=3"), "iris"),
])
def test_make_flare_says_what_is_wrong(argv: tuple[str, ...], part: str, tmp_path: Path,
                                       monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*argv) != 0
    text = capsys.readouterr()
    assert part in text.out + text.err
    assert list(tmp_path.iterdir()) == []


def test_make_flare_lists_the_lenses_of_the_program(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--list") == 0
    assert "US4099850" in capsys.readouterr().err
