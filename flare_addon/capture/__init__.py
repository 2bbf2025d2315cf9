# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures and shots of Blender scenes: import, export, and reading a .blend for the commands."""
