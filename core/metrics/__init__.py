# SPDX-License-Identifier: GPL-3.0-or-later
"""How well a fit separates: picture scores, and the evaluation of a run against its references."""
