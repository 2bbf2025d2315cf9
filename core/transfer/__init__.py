# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfers a fitted flare to other targets (pictures, captures, splats, Blender scenes), and exports it."""
