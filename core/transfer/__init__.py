# SPDX-License-Identifier: GPL-3.0-or-later
"""A captured flare on to other footage: pictures, captures, splats, Blender scenes; and out to other tools."""
