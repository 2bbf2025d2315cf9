# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures whose scene and flare are both known exactly, and the scripts that make them.

The flares come from traced lenses (`flares`), the scenes from Cycles (`scenes`, `stage`, `shots`). Nothing here knows
how Fit Flare represents a flare.
"""
