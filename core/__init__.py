# SPDX-License-Identifier: GPL-3.0-or-later
"""The engine of Fit Flare: everything between footage and layers. No module of it imports Blender's `bpy`."""
