# SPDX-License-Identifier: GPL-3.0-or-later
"""The option --device of the commands that render Gaussians: fit, bake, eval and transfer."""
from __future__ import annotations

import argparse
from typing import get_args

from ..core.choices import Device


def add_option(parser: argparse.ArgumentParser | argparse._ArgumentGroup, default: Device | None = "auto") -> None:
    """Add --device. default: its value without the option."""
    parser.add_argument("--device", choices=get_args(Device), default=default,
                        help="what computes: cpu, or cuda for an NVIDIA GPU, which needs warp-lang. auto, the default, "
                             "takes the GPU if there is one")
