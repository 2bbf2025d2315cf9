# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: help, invalid arguments, errors, and exit statuses."""
from __future__ import annotations

import argparse
import errno
import json
import os
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from fit_flare.core.capture import Capture
from fit_flare.core.capture.colmap import PointCloud
from fit_flare.core.errors import Cancelled, CaptureError, FitFlareError, SettingsError
from fit_flare.core.system.progress import Progress
from fit_flare.headless import cli, layers
from fit_flare.headless.command import Command, ResumeRule, Step
from fit_flare.headless.commands import COMMANDS, compose, fit, lights, remove

from tests.core.captures import make_capture

ROOT = Path(__file__).resolve().parents[2]


def events(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


# ---- arguments ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([name, "--help"]) == 0
    help_text = capsys.readouterr().out
    assert COMMANDS[name].summary in help_text
    assert "run.py " + name in help_text.split("options:")[0].split("\n\n", 1)[1], "an example of its use"
    assert "--progress" in help_text


def test_runs_of_a_list_lie_below_the_folder_for_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of captures that the list names as "..", "." or "../b"."""
    (tmp_path / "shoot" / "lists").mkdir(parents=True)
    (tmp_path / "shoot" / "lists" / "list.txt").write_text("..\n.\n../b\n")
    monkeypatch.chdir(tmp_path / "shoot" / "lists")
    for listed in (tmp_path / "shoot" / "lists" / "list.txt", Path("list.txt")):
        named = [fit.resolve_folders(argparse.Namespace(list_file=listed, entry=entry,
                                                        out=Path("runs")))[1] for entry in (1, 2, 3)]
        assert named == [Path("runs/shoot"), Path("runs/lists"), Path("runs/b")]


def test_runs_whose_names_differ_by_case_alone_are_two_on_every_disk(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("a/Lamp\nb/lamp\nc/desk\n")
    named = [fit.resolve_folders(argparse.Namespace(list_file=tmp_path / "list.txt", entry=entry, out=Path("runs")))[1]
             for entry in (1, 2, 3)]
    assert named == [Path("runs/001_Lamp"), Path("runs/002_lamp"), Path("runs/desk")]


def test_a_read_only_capture_is_reported_before_the_search_for_lights(tmp_path: Path,
                                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: (Path(path), mode) != (tmp_path, os.W_OK))
    monkeypatch.setattr("fit_flare.core.lights.find_lights", lambda *_: pytest.fail("it looked"))
    with pytest.raises(CaptureError, match=r"cannot be written, and lights\.json belongs there"):
        lights.with_lights(Capture(tmp_path, (), PointCloud.empty()), Progress())


def test_a_file_in_place_of_the_sheets_is_reported_before_the_search_for_lights(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lights").touch()
    monkeypatch.setattr("fit_flare.core.lights.find_lights", lambda *_: pytest.fail("it looked"))
    with pytest.raises(CaptureError, match=r"lights is a file where a folder for the sheets is needed"):
        lights.with_lights(Capture(tmp_path, (), PointCloud.empty()), Progress())


def test_making_lights_and_clean_frames_keeps_the_size_of_the_picture_cache(tmp_path: Path,
                                                                            monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit keeps few pictures decoded here, since it has its own."""
    capture = Capture.open(make_capture(tmp_path / "c"), cache_bytes=100_000)
    monkeypatch.setattr(lights, "_find_and_record",
                        lambda *_: (tmp_path / "c" / "lights.json").write_text('{"lights": []}'))
    monkeypatch.setattr("fit_flare.core.removal.inference.remover.Remover", lambda **_: None)
    monkeypatch.setattr("fit_flare.core.removal.jobs.capture.clean_capture", lambda *_: None)
    for made in (lights.with_lights(capture, Progress()), remove.with_clean_frames(capture, Progress())):
        assert made is not capture
        assert (made.folder, made.cache_bytes) == (capture.folder, 100_000)


def test_an_earlier_compositor_file_is_backed_up(tmp_path: Path) -> None:
    blend = tmp_path / "compositor.blend"
    compose._back_up(blend, Progress())
    assert not list(tmp_path.iterdir())
    for work in ("first", "second"):
        blend.write_text(work)
        compose._back_up(blend, Progress())
        assert not blend.exists()
    assert [path.read_text() for path in sorted(tmp_path.iterdir())] == ["first", "second"]


def test_the_help_lists_every_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # a narrow terminal breaks names at their hyphens
    assert cli.main(["--help"]) == 0
    help_text = capsys.readouterr().out
    words = help_text.split()
    assert all(name in words for name in COMMANDS)
    assert cli.main([]) == 2


@pytest.mark.parametrize("words", [
    ["fly"], ["fit"], ["fit", "a"], ["bake", "a"], ["fit", "a", "--out", "b", "--preset", "x"],
    ["fit", "a", "--out", "b", "--seed", "x"], ["fit", "a", "--out", "b", "--pres", "draft"],
    ["eval", "a", "--views", "none"]])
def test_misuse_is_status_2_and_one_line(words: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 2
    output = capfd.readouterr()
    assert output.out == ""
    assert output.err.startswith("error: ")
    assert output.err.count("\n") == 1
    assert cli.main([*words, "--progress", "json"]) == 2
    (event,) = events(capfd.readouterr().out)
    assert event["type"] == "error"


@pytest.mark.parametrize("words", [
    ["eval", "no/run"], ["bake", "no/run", "--out", "{tmp}/o"], ["fit", "no/capture", "--out", "{tmp}/o"],
    ["demo", "--capture", "no/capture", "--out", "{tmp}/o"], ["engine", "--engine", "no/python"],
    ["transfer", "no.flare", "--to", "a.png", "--out", "{tmp}/o", "--light", "nan,20"],
])
def test_failures_are_status_1_and_one_line(words: list[str], capture: Path, tmp_path: Path,
                                            capfd: pytest.CaptureFixture[str]) -> None:
    _is_refused(words, 1, capture, tmp_path, capfd)


@pytest.mark.parametrize("words", [
    ["fit", "{capture}", "--out", "{tmp}/o", "--holdout", "no.json"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--iterations", "0"],
    ["fit", "{capture}", "--out", ""], ["bake", "", "--out", "{tmp}/o"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--size", "-4"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--set", "flare"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--set", "flare.colour=1"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--set", "flare.count=many"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--holdout", "9" * 5000],
    ["fit", "{capture}", "--out", "{tmp}/o", "--holdout", "²"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--iterations", "9" * 400],
    *(["fit", "{capture}", "--out", "{tmp}/o", "--set", change] for change in (
        "flare.form.latent=65", "flare.form.levels=0", "flare.form.base=300", "preview_every=0", "scene.sh_every=0",
        "scene.reorder_every=0", "scene.classic.every=0", "flare.visibility.radius=0", "flare.rates.position=0",
        "flare.rates.final_ratio=-1", "scene.rates.position=-1", "flare.count=100000000000", "seed=" + "9" * 26,
        "seed=" + "9" * 5000, "seed=0x" + "f" * 5000, "ssim_share=" + "9" * 400, "holdout=" + "9" * 5000,
        "seed=" + "[" * 5000)),
    ["fit", "{capture}", "--out", "{tmp}/o", "--list", "{capture}/split.json"],
    ["fit", "{capture}", "--out", "{tmp}/o", "--jobs", "2"], ["fit", "{capture}", "--out", "{tmp}/o", "--entry", "2"],
    ["bake", "no/run", "--out", "{tmp}/o", "--scene", "no.ply"],
    ["remove", "a.png", "--out", "{tmp}/o", "--capture", "{capture}"],
    ["remove", "a.png", "--out", "{tmp}/o", "--base", "sd-turbo"],
    ["remove", "--run", "no/run", "--out", "{tmp}/o", "--base", "sd-turbo"],
    ["bake", "no.flare", "--out", "{tmp}/o", "--capture", "{capture}", "--lights", "Lamp"],
    ["lights", "{capture}", "--keep", "--boxes", "dino"],
    ["fit", "--list", "no.txt", "--out", "{tmp}/o", "--jobs", "0"],
    ["solve", "{capture}/images", "--out", "{tmp}/o", "--lights", "Lamp"],
    ["transfer", "no.flare", "--to", "a.png", "--out", "{tmp}/o", "--focal", "0"],
    ["transfer", "no.flare", "--to", "a.png", "--out", "{tmp}/o", "--scale", "inf"],
    ["transfer", "no.flare", "--to", "a.png", "--out", "{tmp}/o", "--smooth", "99999999999"],
    ["compose", "{capture}", "--out", "{capture}"],
    ["train-removal", "--backgrounds", "{capture}", "--out", "{tmp}/o", "--threads", "-1"],
    *(["train-removal", "--backgrounds", "{capture}", "--out", "{tmp}/o", *more] for more in (
        ["--keep-glow"], ["--base", "sd-turbo"], ["--lpips", "no"], ["--max-lenses", "0"], ["--max-lenses", "7"],
        ["--model", "diffusion", "--start", "box"], ["--model", "diffusion", "--processes", "2"])),
    *(["eval-removal", "{capture}", "--out", "{tmp}/o", *more] for more in (
        ["--seed", "3"], ["--size", "64", "64"], ["--backgrounds", "{capture}"], ["--lenses", "no"],
        ["--all-backgrounds"])),
    ["eval-removal", "--synthetic", "2", "--out", "{tmp}/o"],
    ["solve", "{capture}/images", "--out", "{tmp}/o", "--lens", "PERISCOPE"],
    ["solve", "{capture}/images", "--out", "{tmp}/o", "--work-size", "-3"],
    ["bake", "no.flare", "--out", "{tmp}/o", "--capture", "{capture}", "--blend", "no.blend"],
    *(["train-removal", "--backgrounds", "{capture}", "--out", "{tmp}/o", "--set", change] for change in (
        "learning_rate=abc", "size_stages=5", "psnr_phase=abc", "bank_size=1.5", "seed=-1", "pixels_per_iteration=NaN",
        "weight_decay=-1", "canvas_size=abc", "clean_share=7", "ema_decay=9", "user_flare_share=abc", "blocks=[1,2]")),
])
def test_invalid_arguments_are_status_2_and_one_line(words: list[str], capture: Path, tmp_path: Path,
                                                     capfd: pytest.CaptureFixture[str]) -> None:
    """A farm does not retry status 2."""
    _is_refused(words, 2, capture, tmp_path, capfd)


def _is_refused(words: list[str], status: int, capture: Path, tmp_path: Path,
                capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main([word.format(tmp=tmp_path, capture=capture) for word in words]) == status
    message = capfd.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert not list(tmp_path.iterdir()), "nothing was written"


# ---- how a command ends ---------------------------------------------------------------------------


def ending_with(problem: BaseException | None, monkeypatch: pytest.MonkeyPatch, options: Sequence[str] = (),
                resume_rule: ResumeRule = "starts over") -> None:
    """Register a command "try" that raises `problem`, or succeeds if None. options: its arguments."""
    def run(_words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
        print("a library prints")
        progress.say("working")
        if problem:
            raise problem
        return {"made": 1}

    def arguments(parser: argparse.ArgumentParser) -> None:
        for option in options:
            parser.add_argument(option, nargs="?")

    monkeypatch.setitem(COMMANDS, "try", Command("try", "Tries.", "", arguments, (Step("try", "engine", run),),
                                                 resume_rule))


def looped() -> RuntimeError:
    """As Path.resolve raises it before Python 3.13."""
    problem = RuntimeError("Symlink loop from 'x'")
    problem.__context__ = OSError(errno.ELOOP, "Too many levels of symbolic links", "x")
    return problem


@pytest.mark.parametrize(("problem", "status", "sentence"), [
    (looped(), 1, "A symbolic link leads back to itself (x); remove it or choose another path."),
    (FitFlareError("It is broken."), 1, "It is broken."),
    (Cancelled("Stopped as asked."), 130, "Stopped as asked."),
    (KeyboardInterrupt(), 130, "Stopped."),
    (OSError(28, "No space left on device", "x.exr"), 1,
     "The disk is full (x.exr); make room and start it again, what is finished is kept."),
    (OSError(13, "Permission denied", "x.exr"), 1, "The system refused: Permission denied (x.exr)."),
    (MemoryError(), 1,
     "This machine has not enough memory for it; close other programs, or use a machine with more memory."),
    (RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: you tried "
                  "to allocate 972000000 bytes. Error code 12 (Cannot allocate memory)"), 1,
     "This machine has not enough memory for it; close other programs, or use a machine with more memory."),
    (ZeroDivisionError("division by zero"), 1,
     "A defect of Fit Flare, please report it: ZeroDivisionError: division by zero."),
])
def test_every_error_has_its_status_and_message(problem: BaseException, status: int, sentence: str,
                                                monkeypatch: pytest.MonkeyPatch,
                                                capfd: pytest.CaptureFixture[str]) -> None:
    ending_with(problem, monkeypatch)
    assert cli.main(["try", "--progress=json"]) == status
    output = capfd.readouterr()
    assert events(output.out) == [{"type": "say", "text": "working"}, {"type": "error", "text": sentence}]
    assert ("Traceback" in output.err) == sentence.startswith("A defect")


@pytest.mark.parametrize(("resume_rule", "hint"), [
    ("resumes", "Run the command again to resume."),
    ("resumes with --resume", "Run the command again with --resume to resume."),
    ("starts over", "Run again, the command starts over.")])
def test_a_stop_reports_how_to_resume(resume_rule: ResumeRule, hint: str, monkeypatch: pytest.MonkeyPatch,
                                      capfd: pytest.CaptureFixture[str]) -> None:
    ending_with(Cancelled("Stopped as asked."), monkeypatch, resume_rule=resume_rule)
    assert cli.main(["try"]) == 130
    assert f"Stopped as asked. {hint}" in capfd.readouterr().err


def test_the_help_lists_the_commands_that_resume(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.build_parser().parse_args(["--help"])
    help_text = " ".join(capsys.readouterr().out.split())
    help_text = help_text[help_text.index("run it again,"):]
    for name, command in COMMANDS.items():
        resumes = any(option == "--resume" for option in _options(command))
        assert (command.resume_rule == "resumes with --resume") == resumes, name
        is_listed = f" {name}," in help_text or f" {name} resume" in help_text
        assert is_listed == (command.resume_rule != "starts over"), name


def _options(command: Command) -> list[str]:
    parser = argparse.ArgumentParser()
    command.arguments(parser)
    return [option for action in parser._actions for option in action.option_strings]


@pytest.mark.parametrize(("options", "way"), [(["--size"], "use a smaller --size."),
                                              (["--size", "--jobs"], "use a smaller --size, or fewer --jobs.")])
def test_the_memory_advice_names_options_of_the_command(options: list[str], way: str, monkeypatch: pytest.MonkeyPatch,
                                                        capfd: pytest.CaptureFixture[str]) -> None:
    ending_with(MemoryError(), monkeypatch, options)
    assert cli.main(["try"]) == 1
    assert f"This machine has not enough memory for it; {way}" in capfd.readouterr().err


def test_events_have_standard_output_for_themselves(monkeypatch: pytest.MonkeyPatch,
                                                    capfd: pytest.CaptureFixture[str]) -> None:
    ending_with(None, monkeypatch)
    assert cli.main(["try", "--progress", "json"]) == 0
    output = capfd.readouterr()
    assert [event["type"] for event in events(output.out)] == ["say", "result"]
    assert "a library prints" in output.err
    assert cli.main(["try"]) == 0
    assert "a library prints" in capfd.readouterr().out


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_commands_run_with_closed_streams(closed: tuple[int, ...]) -> None:
    """Daemons and schedulers start programs with closed standard streams."""
    for extra in ([], ["--progress", "json"]):
        args = [sys.executable, str(cli.hand_off.RUN_SCRIPT), "engine", *extra]
        launcher = f"import os; [os.close(n) for n in {closed}]; os.execv({args[0]!r}, {args!r})"
        done = subprocess.run([sys.executable, "-c", launcher], capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
        assert bool(done.stdout) == (1 not in closed and bool(extra))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a disk that is always full")
@pytest.mark.parametrize(("options", "full"), [("", "2"), ("--progress json", "1"),
                                               ("--progress openjd", "1")])
def test_a_full_disk_for_the_output_is_not_a_failure(options: str, full: str) -> None:
    run = f"'{sys.executable}' '{cli.hand_off.RUN_SCRIPT}'"
    done = subprocess.run(f"{run} engine {options} {full}>/dev/full", shell=True, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert subprocess.run(f"{run} fly {options} {full}>/dev/full", shell=True, check=False).returncode == 2


def test_a_torch_that_cannot_be_loaded_is_not_reported_as_a_disk_error(tmp_path: Path) -> None:
    """On Windows a missing library of torch raises an OSError."""
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch" / "__init__.py").write_text("raise OSError(126, 'The specified module could not be found')")
    done = subprocess.run([sys.executable, str(cli.hand_off.RUN_SCRIPT), "engine"], capture_output=True, check=False,
                          text=True, env={**os.environ, "PYTHONPATH": str(tmp_path)})
    assert done.returncode == 1
    assert done.stderr.startswith("error: torch of ")
    assert "cannot be loaded (The specified module could not be found)" in done.stderr


def test_help_is_shown_on_a_terminal_of_ascii() -> None:
    environment = {**os.environ, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    done = subprocess.run([sys.executable, str(cli.hand_off.RUN_SCRIPT), "--help"], capture_output=True,
                          env=environment,
                          check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"COMMAND" in done.stdout


def test_an_option_may_end_with_an_equals_sign(capture: Path, tmp_path: Path,
                                               capfd: pytest.CaptureFixture[str]) -> None:
    """Only one with nothing behind its own is left out."""
    assert cli.main(["bake", str(tmp_path / "no run"), "--out=o=", "--frames="]) == 1
    assert "is not the folder of a run" in capfd.readouterr().err
    assert cli.main(["fit", str(capture), "--out", str(tmp_path / "o"), "--set=flare.count="]) == 2


def test_farm_messages_are_written_as_utf8(tmp_path: Path) -> None:
    args = [sys.executable, str(cli.hand_off.RUN_SCRIPT), "bake", str(tmp_path / "写真"), "--out",
             str(tmp_path / "out"), "--progress", "openjd"]
    done = subprocess.run(args, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "cp1252"}, check=False)
    assert done.returncode == 1
    lines = done.stdout.decode("utf-8").splitlines()
    assert lines[-1].startswith("openjd_fail: ")
    assert "写真" in lines[-1]
    assert b"Traceback" not in done.stderr


# ---- the pieces -----------------------------------------------------------------------------------


def test_settings_are_parsed_from_name_and_value() -> None:
    assert fit.parse_setting("flare.count=400") == ("flare.count", 400)
    assert fit.parse_setting("flare.rates.network=1e-3") == ("flare.rates.network", 1e-3)
    assert fit.parse_setting("detection = false") == ("detection", False)
    assert fit.parse_setting("kernels=cpu") == ("kernels", "cpu")


def test_a_holdout_is_a_number_or_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "split.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    assert fit.parse_holdout("8") == 8
    assert fit.parse_holdout(None) is None
    assert fit.parse_holdout("split.json") == str(tmp_path / "split.json")


def test_sizes_are_parsed_from_width_and_height() -> None:
    assert layers.parse_size(None) == (None, None)
    assert layers.parse_size("960") == (960, None)
    assert layers.parse_size("100x30") == (100, 30)
    for text in ("0", "x", "12x", "-5", "1.5", "999999"):
        with pytest.raises(SettingsError):
            layers.parse_size(text)


def test_a_blender_that_cannot_be_loaded_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "bpy.py").write_text("raise ImportError('libXrender.so.1: cannot open shared object file')")
    done = subprocess.run([sys.executable, str(ROOT / "headless" / "run.py"), "compose", str(tmp_path), "--out",
                           str(tmp_path / "frames"), "--step", "compose"], capture_output=True, text=True, check=False,
                          env={**os.environ, "PYTHONPATH": str(tmp_path)})
    assert done.returncode == 1 and "libXrender.so.1" in done.stderr and "--blender" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("light", [0.5, float("nan")])
def test_an_engine_that_rasterises_wrongly_is_refused(light: float, monkeypatch: pytest.MonkeyPatch,
                                                      capsys: pytest.CaptureFixture[str]) -> None:
    """The button Test in the preferences runs this check."""
    assert cli.main(["engine"]) == 0
    wrong = SimpleNamespace(colour=torch.full((16, 16, 3), light))
    monkeypatch.setattr("fit_flare.core.gaussians.splat", lambda *_, **__: wrong)
    assert cli.main(["engine"]) == 1
    assert "rasterises wrongly" in capsys.readouterr().err


def test_a_python_without_numpy_runs_the_engine_instead(tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    venv.create(bare, with_pip=False, symlinks=os.name != "nt")
    python = next(path for path in (bare / "bin" / "python", bare / "Scripts" / "python.exe") if path.is_file())

    def said(*args: str, **named: str) -> tuple[int, str]:
        done = subprocess.run([str(python), str(ROOT / "headless" / "run.py"), *args], capture_output=True, text=True,
                              check=False, env={**os.environ, **named})
        return done.returncode, done.stdout + done.stderr

    status, output = said("fit", "--help", FIT_FLARE_ENGINE=sys.executable)
    assert status == 0 and "--holdout" in output, output
    status, output = said("fit", str(tmp_path / "none"), "--out", str(tmp_path / "run"), "--engine", sys.executable)
    assert status == 1 and "Traceback" not in output and "none" in output, output
    status, output = said("engine", FIT_FLARE_ENGINE=str(tmp_path / "nowhere"))
    assert (status, output.count("\n")) == (1, 1) and "is not a Python with torch" in output, output


def test_parsing_arguments_needs_numpy_only() -> None:
    """Blender's own Python has numpy and none of the engine's libraries."""
    code = (f"import importlib, runpy, sys\n"
            f"sys.modules.update(dict.fromkeys(('torch', 'cv2', 'OpenEXR', 'numba', 'safetensors', 'tqdm')))\n"
            f"sys.argv = ['run.py', 'fit', '--help']\n"
            f"runpy.run_path({str(ROOT / 'headless' / 'run.py')!r}, run_name='__main__')")
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--holdout" in done.stdout


# ---- renamed options ------------------------------------------------------------------------------


@pytest.mark.parametrize(("argv", "current"), [
    (["try", "--keep-glare"], ["try", "--keep-glow"]), (["try", "--most-lenses=7"], ["try", "--max-lenses=7"]),
    (["try", "--", "--keep-glare"], ["try", "--", "--keep-glare"])])
def test_renamed_options_work_under_their_old_names(argv: list[str], current: list[str],
                                                    monkeypatch: pytest.MonkeyPatch,
                                                    capfd: pytest.CaptureFixture[str]) -> None:
    parsed: list[argparse.Namespace] = []

    def arguments(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--keep-glow", action="store_true")
        parser.add_argument("--max-lenses")
        parser.add_argument("files", nargs="*")

    def run(args: argparse.Namespace, _progress: Progress) -> dict[str, Any]:
        parsed.append(args)
        return {}

    monkeypatch.setitem(COMMANDS, "try", Command("try", "Tries.", "", arguments, (Step("try", "engine", run),)))
    assert cli.main(argv) == 0
    assert parsed[0].argv == current, "what the processes of --jobs get"
    assert (f"{argv[1].partition('=')[0]} is now" in capfd.readouterr().err) == (argv != current)


def test_the_help_has_no_renamed_option(capsys: pytest.CaptureFixture[str]) -> None:
    for name in COMMANDS:
        with pytest.raises(SystemExit):
            cli.build_parser().parse_args([name, "--help"])
        assert not any(option in capsys.readouterr().out for option in cli.OPTION_ALIASES), name
