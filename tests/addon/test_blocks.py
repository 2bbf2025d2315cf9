# SPDX-License-Identifier: GPL-3.0-or-later
"""The docstring of each test that reads facts names the blocks of the script that produce them."""
from __future__ import annotations

import ast
from pathlib import Path

import pytest
from blocks import SCRIPTS, blocks_for, blocks_of, fact_tests, named_blocks

HERE = Path(__file__).parent
MODULES = sorted(path.name for path in HERE.glob("test_*.py") if any(fact_tests(path)))


def test_tests_with_facts_are_found() -> None:
    assert len(MODULES) > 8


@pytest.mark.parametrize("module", MODULES)
def test_every_test_names_the_blocks_of_its_facts(module: str) -> None:
    for test, keys in fact_tests(HERE / module):
        script, named = named_blocks(ast.get_docstring(test) or "")
        assert script, f"{test.name} names no block"
        blocks = blocks_of(SCRIPTS / script)
        assert set(named) <= set(blocks), f"{test.name} names a block that {script} has not"
        for key, holders in blocks_for(keys, blocks).items():
            assert holders & set(named), f"{test.name} reads {key!r} of {sorted(holders)}"
