# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the weights file that the removal network has by default.

The repository holds the file; the Blender extension does not, since it is larger than all the rest. The add-on
downloads it (`flare_addon/weights.py`) and names it to the commands by FIT_FLARE_WEIGHTS. `inference.remover` and the
add-on import this module, so it needs neither torch nor numpy.
"""
from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from ...system.reading import read_text

IN_THE_BOX = Path(__file__).parents[1] / "box" / "removal.safetensors"
"""The weights that come with the repository."""
DIGEST_FILE = IN_THE_BOX.with_suffix(".sha256")
"""The SHA-256 of IN_THE_BOX, in hexadecimal digits; it also comes with the extension."""
WEIGHTS_VARIABLE = "FIT_FLARE_WEIGHTS"
"""The environment variable that names other weights."""


def default_weights() -> Path:
    """Return the file that FIT_FLARE_WEIGHTS names, else IN_THE_BOX; it may be missing."""
    named = os.environ.get(WEIGHTS_VARIABLE, "")
    return Path(named).expanduser() if named else IN_THE_BOX


@lru_cache(maxsize=1)
def published_digest() -> str:
    """Return the SHA-256 of the weights of this version, 64 hexadecimal digits. Raises OSError."""
    return read_text(DIGEST_FILE).strip()


def published_name() -> str:
    """Return the file name of the weights of this version in a repository of extensions. Raises OSError.

    It contains a part of the digest, so that several versions of the extension can share a repository.
    """
    return f"fit_flare_removal_{published_digest()[:12]}.safetensors"
