# SPDX-License-Identifier: GPL-3.0-or-later
"""The removal network, its weights, the recipe of its training, and the image formation it assumes."""
