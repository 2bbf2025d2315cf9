# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes flares from plates: `model` is the network, `synthesis` draws the flares that `training` trains it on,
`inference` runs it on a plate, `jobs` cleans folders, captures and videos with it or by a fit, and `evaluation` scores
it. The weights are in `box`."""
