# SPDX-License-Identifier: GPL-3.0-or-later
"""The engine of Fit Flare: everything between footage and layers. Nothing below this line knows Blender."""
