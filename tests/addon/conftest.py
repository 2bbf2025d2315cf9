# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import blenders
import pytest
from blenders import Blender


@pytest.fixture(scope="session", params=["newer", "older"])
def blender(request: pytest.FixtureRequest) -> Blender:
    """Each of the Blenders that are set up here."""
    found = getattr(blenders, request.param)()
    if found is None:
        pytest.skip(f"the {request.param} Blender is not set up here (`make setup`)")
    return found
