# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthesises flares from optics and from what film and phones show: endless, and the same for the same seed.

Everything is drawn in linear light on a square canvas whose middle is the principal point and whose coordinates run
from -1 to 1; a frame of any shape is a window of it. `flare.synthesise_flare` is the entry; `training` and `evaluation`
call it.
"""
