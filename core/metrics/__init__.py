# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores: of one picture against another, and of a run's layers against its references."""
