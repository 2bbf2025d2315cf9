# SPDX-License-Identifier: GPL-3.0-or-later
"""Layers out: a run, rendered from its cameras, as multilayer EXR files that any compositor reads."""
