# SPDX-License-Identifier: GPL-3.0-or-later
"""The weights of the removal network, which do not come with the extension: finds and downloads them.

`fits` needs them for clean frames. They are downloaded with the engine, or alone, from the repository that the
extension was installed from (`headless/package.py --repository` writes both); a path in the preferences replaces them.
Every command of the engine gets their path as FIT_FLARE_WEIGHTS.
"""
from __future__ import annotations

import sys
from pathlib import Path
from urllib.parse import urljoin

import bpy

from ..core.errors import EngineError
from ..core.removal.model.weights_file import IN_THE_BOX, WEIGHTS_VARIABLE, published_digest, published_name
from ..core.system.processes import child_environment
from . import jobs
from .jobs import Job
from .user_settings import PACKAGE, check_online_access, configured_path, user_folder

FOLDER = "weights"
PLATFORM = "https://extensions.blender.org/"
"""Blender's own repository, which serves extensions and no other files."""
SET_UP = [sys.executable, *bpy.app.python_args, "-I",
          str(Path(__file__).resolve().parents[1] / "headless" / "set_up.py")]
"""The command line of the script that installs engine and weights."""


def downloaded_file() -> Path:
    """Return where the downloaded weights of this version are; the file may not exist yet."""
    return user_folder(FOLDER) / published_name()


def configured_weights() -> tuple[str, str]:
    """Return the source and the path of configured weights: FIT_FLARE_WEIGHTS, else the preferences, else ("", "")."""
    return configured_path(WEIGHTS_VARIABLE, "weights")


def find_weights() -> Path | None:
    """Return the weights: the configured ones, else those of the source, else the downloaded ones; None without any."""
    _, path = configured_weights()
    candidates = [Path(path).expanduser()] if path else [IN_THE_BOX, downloaded_file()]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def missing_reason() -> str:
    """Return why there are no weights and what to do, without a full stop; "" where there are."""
    if find_weights() is not None:
        return ""
    source, path = configured_weights()
    if path:
        return f"The weights named by {source} are missing: {path}. Name a file that exists, or name none"
    return ("The removal network needs its weights. Open the preferences of Fit Flare and "
            f"{'download them' if published_url() else 'name their file under Removal Weights'}")


def environment() -> dict[str, str]:
    """Return the variable that names the weights to a command; {} where it finds them itself, or where there are
    none."""
    path = find_weights()
    return {} if path is None or path == IN_THE_BOX else {WEIGHTS_VARIABLE: str(path)}


def published_url() -> str:
    """Return the address of the weights in the repository that the extension was installed from.

    "" for Blender's own repository and one on disk, which have no weights, and without a repository."""
    # The package of an installed extension is bl_ext.REPOSITORY.fit_flare.
    module = PACKAGE.split(".")[1] if PACKAGE.count(".") == 2 else ""
    for repository in bpy.context.preferences.extensions.repos:
        if repository.module == module and repository.use_remote_url and repository.remote_url:
            url = str(repository.remote_url)
            return "" if url.startswith(PLATFORM) else urljoin(url, published_name())
    return ""


def download_args() -> list[str]:
    """Return the arguments of SET_UP that download the weights; [] where they are not missing or offered nowhere."""
    url = published_url() if find_weights() is None and not configured_weights()[1] else ""
    return ["--weights", url, str(downloaded_file()), published_digest()] if url else []


def download_weights() -> Job:
    """Download the weights. Raises EngineError where Blender's online access is off or no repository offers them."""
    check_online_access("download")
    args = download_args()
    if not args:
        raise EngineError("No repository offers the weights of the removal network; name their file under Removal "
                          "Weights.")
    return jobs.start_job("weights", user_folder(FOLDER, create=True), [*SET_UP, *args], child_environment())


def download_job() -> Job | None:
    """Return the job of the current or last download; None without one."""
    return jobs.find_job(user_folder(FOLDER))
