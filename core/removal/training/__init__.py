# SPDX-License-Identifier: GPL-3.0-or-later
"""Trains the removal network: `run.train` is the whole of a training; `train-removal` calls it."""
