# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of the scripts in benchmarks/ that no measurement checks."""
from __future__ import annotations

import pytest

from benchmarks.removal import SHOWN_FRAMES, sheet_frames


@pytest.mark.parametrize("count", [1, 2, 3, 5, 17, 18, 19, 72])
def test_a_sheet_shows_frames_of_a_sample_of_any_length(count: int) -> None:
    shown = sheet_frames(count)
    assert len(shown) == min(count, SHOWN_FRAMES) and shown == sorted(set(shown))
    assert shown[0] >= 0 and shown[-1] < count
