# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare model in torch: canonical Gaussians on a line, their deformation, placement and compositing, and the .flare
file.

`core.fit` optimises it; `core.look` evaluates the same file without torch.
"""
