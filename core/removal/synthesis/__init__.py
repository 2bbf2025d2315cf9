# SPDX-License-Identifier: GPL-3.0-or-later
"""Flares made up from optics and from what film and phones show, endless and the same for the same seed.

Everything is drawn on a square canvas of linear light whose middle is the principal point and whose
coordinates run from -1 to 1; a frame of any shape is a window of it (see `layers`).
"""
