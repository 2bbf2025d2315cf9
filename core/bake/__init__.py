# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes layers: renders a run or a shot from its cameras to multilayer EXR files, for any compositor."""
