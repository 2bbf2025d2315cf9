# SPDX-License-Identifier: GPL-3.0-or-later
"""Training on a GPU: it composes pairs in batches from scenes and flares that CPU processes draw."""
