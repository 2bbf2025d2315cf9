# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests run as the commands do, with the same environment for numpy and torch."""
from core.numeric_environment import prepare_for_numpy_and_torch

prepare_for_numpy_and_torch()
