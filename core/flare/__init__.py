# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare: canonical Gaussians on a line, their deformation, placement, compositing, and the .flare file."""
