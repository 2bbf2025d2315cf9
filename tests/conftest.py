# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests run as the commands do, with the same environment for numpy and torch."""
import os
import signal
from collections.abc import Iterator

import pytest

from core.system.thread_environment import set_thread_environment

set_thread_environment()
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as shells start what runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _ordinary_priority() -> Iterator[None]:
    """Restore the ordinary scheduling after each test. For root, FFmpeg's AV1 encoder makes the process a real-time
    one, and programs that later tests start would then take the processor from all others."""
    yield
    if hasattr(os, "sched_setscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture
def hangups_are_heard() -> Iterator[None]:
    """Here and by what is started from here, also where the tests themselves run under `nohup`."""
    if not hasattr(signal, "SIGHUP"):
        yield
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
