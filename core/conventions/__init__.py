# SPDX-License-Identifier: GPL-3.0-or-later
"""Conventions that the torch and numpy sides share: names, numbers and file layouts, importable by Blender's Python."""
