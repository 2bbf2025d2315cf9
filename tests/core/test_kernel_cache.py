# SPDX-License-Identifier: GPL-3.0-or-later
"""The cache of compiled functions: its folder, and what happens where it cannot be used."""
from __future__ import annotations

import errno
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytest.importorskip("numba")

from core.system import kernel_cache
from tests.core.test_import_rules import ROOT

COMPILE = """
    import importlib.util, sys
    spec = importlib.util.spec_from_file_location("{package}", "__init__.py", submodule_search_locations=["."])
    module = sys.modules["{package}"] = importlib.util.module_from_spec(spec)
    sys.path[:] = [path for path in sys.path if path not in ("", "{root}")]
    from {package}.core.optics import trace
    from {package}.core.system import kernel_cache
    trace.reflectance(1.0, 1.0, 1.5, 0.5, 0.0)
    print(trace.reflectance._cache.cache_path)
    print(sum(trace.reflectance.stats.cache_hits.values()))
"""


def _compile_elsewhere(environment: dict[str, str], package: str = "flares") -> tuple[Path, int]:
    """Compile a kernel in a process that imports the tree as `package`; return the cache's folder and its hits."""
    code = textwrap.dedent(COMPILE).format(package=package, root=ROOT)
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=ROOT, env={**os.environ, **environment}, check=True,
                          capture_output=True, text=True)
    folder, hits = done.stdout.split()
    return Path(folder), int(hits)


def test_the_cache_lies_in_the_configured_folder(tmp_path: Path) -> None:
    environment = {"FIT_FLARE_CACHE": str(tmp_path)}
    folder, hits = _compile_elsewhere(environment)
    assert folder.is_relative_to(tmp_path) and hits == 0
    assert list(folder.rglob("*.nbc"))
    assert _compile_elsewhere(environment) == (folder, 1)


def test_a_tree_that_is_imported_by_two_names_has_two_caches(tmp_path: Path) -> None:
    """The machine code names the modules that it was compiled in, which the other name does not find."""
    environment = {"FIT_FLARE_CACHE": str(tmp_path)}
    first, _ = _compile_elsewhere(environment, "flares")
    second, hits = _compile_elsewhere(environment, "other_flares")
    assert first != second and hits == 0


@pytest.mark.parametrize("changed", ["program/kernels/a.py", "program/above.py", "program/colour/curve.py"])
def test_each_source_of_a_kernel_and_of_its_constants_changes_the_cache(
        changed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("program/kernels/a.py", "program/above.py", "program/colour/curve.py", "program/other/b.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("GAMMA = 2.4\n")
    monkeypatch.setattr(kernel_cache, "PROGRAM", tmp_path / "program")

    def fingerprint() -> str:
        return kernel_cache._fingerprint("program.kernels", tmp_path / "program" / "kernels")

    before = fingerprint()
    (tmp_path / "program/other/b.py").write_text("GAMMA = 2.2\n")
    assert fingerprint() == before
    (tmp_path / changed).write_text("GAMMA = 2.2\n")
    assert fingerprint() != before


def test_an_unusable_folder_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("FIT_FLARE_CACHE", str(tmp_path / "file"))
    folder = kernel_cache.cache_folder.__wrapped__("package", tmp_path)
    assert not folder.is_relative_to(tmp_path) and os.access(folder, os.W_OK)


def test_a_temporary_folder_is_deleted_at_exit(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    unusable = {"FIT_FLARE_CACHE": str(tmp_path / "file"), "TMPDIR": str(tmp_path / "temporary")}
    folder, hits = _compile_elsewhere(unusable)
    assert folder.is_relative_to(tmp_path / "temporary") and hits == 0
    assert not list((tmp_path / "temporary").glob("fit_flare_*"))


def test_functions_run_where_their_cache_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(kernel_cache, "cache_folder", lambda *_: tmp_path)
    twice = kernel_cache.compile_cached(doubled)
    monkeypatch.setattr(twice._cache._cache_file, "save", full)
    assert twice(2.0) == 4.0
    assert not list(tmp_path.rglob("*.nbc"))


def doubled(value: float) -> float:
    return 2 * value


def test_a_user_without_a_home_gets_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("FIT_FLARE_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(kernel_cache.Path, "home", none)
    assert os.access(kernel_cache.cache_folder.__wrapped__("package", tmp_path), os.W_OK)
