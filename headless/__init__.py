# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands, as farms, scripts and the add-on start them."""
