# SPDX-License-Identifier: GPL-3.0-or-later
"""The baked layers in Blender's compositor: the node, its drivers, its set-up, and warnings."""
