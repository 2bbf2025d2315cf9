# SPDX-License-Identifier: GPL-3.0-or-later
"""Training where a graphics card learns: its pairs are composed on it, out of scenes and flares that processes draw."""
