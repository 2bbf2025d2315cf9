# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands, in the order in which the help lists them. A new one is a module here and a line below."""
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
    remove,
    solve,
    train_removal,
    transfer,
)

_MODULES = (demo, solve, lights, remove, fit, evaluate, bake, compose, transfer, export, train_removal, eval_removal,
            engine)

COMMANDS: dict[str, Command] = {module.COMMAND.name: module.COMMAND for module in _MODULES}
