# SPDX-License-Identifier: GPL-3.0-or-later
"""Flare removal: image formation, flare synthesis, the network in the box, its training and its use on plates."""
