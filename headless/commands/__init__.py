# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands in the order of the help. To add one, write a module here and list it in `_MODULES`."""
from __future__ import annotations

from ..command import Command
from . import (
    bake,
    compose,
    demo,
    engine,
    eval_removal,
    evaluate,
    export,
    fit,
    lights,
    make_flare,
    remove,
    shot,
    solve,
    train_removal,
    transfer,
)

_MODULES = (demo, shot, solve, lights, remove, fit, evaluate, bake, compose, transfer, export, make_flare,
            train_removal, eval_removal, engine)

COMMANDS: dict[str, Command] = {module.COMMAND.name: module.COMMAND for module in _MODULES}
