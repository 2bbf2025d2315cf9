# SPDX-License-Identifier: GPL-3.0-or-later
"""Which block of a script produces the facts that a test reads.

A script in `scripts` runs in Blender, once for all its tests. Its blocks begin with a line `# ---- name ----`; the
part before the first is the block "beginning". The docstring of each test names its blocks, and `test_blocks.py` checks
that they hold the facts that the test reads.
"""
from __future__ import annotations

import ast
import fnmatch
import re
from collections.abc import Iterator
from pathlib import Path

SCRIPTS = Path(__file__).parent / "scripts"
BEGINNING = "beginning"
NAMES = ("facts", "said")
"""The variables that hold the facts, in scripts and tests."""

_HEADER = re.compile(r"^# ---- (.+?) -*$")
_NAMED = re.compile(r"Blocks? of (\w+\.py): (.+?)\.$", re.MULTILINE | re.DOTALL)


def _key(node: ast.AST) -> str | None:
    """Return the key where a node is `facts["key"]`, `facts.get("key")` or `made.facts["key"]`, else None.

    Computed parts of a key become *; a key in a variable becomes "*" and the variable's name.
    """
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get" and node.args:
        holder, index = node.func.value, node.args[0]
    elif isinstance(node, ast.Subscript):
        holder, index = node.value, node.slice
    else:
        return None
    if (holder.attr if isinstance(holder, ast.Attribute) else getattr(holder, "id", "")) not in NAMES:
        return None
    if isinstance(index, ast.Constant):
        return str(index.value)
    if isinstance(index, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "*" for part in index.values)
    return f"*{index.id}" if isinstance(index, ast.Name) else None


def _keys(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield the keys that a piece of code uses, with their lines; "*name" for a key in a variable."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Dict):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if getattr(target, "id", "") in NAMES:
                yield from ((str(key.value), key.lineno) for key in node.value.keys if isinstance(key, ast.Constant))
        if (key := _key(node)) is not None:
            yield key, node.lineno  # type: ignore[attr-defined]


def _parameters(test: ast.FunctionDef) -> dict[str, list[str]]:
    """Return the text values that `parametrize` gives a test's parameters, by parameter."""
    values: dict[str, list[str]] = {}
    for decorator in test.decorator_list:
        if not (isinstance(decorator, ast.Call) and getattr(decorator.func, "attr", "") == "parametrize"):
            continue
        names, cases = (ast.literal_eval(decorator.args[0]), getattr(decorator.args[1], "elts", ()))
        for case in cases:
            parts = getattr(case, "elts", [case]) if not isinstance(names, str) else [case]
            for name, part in zip([names] if isinstance(names, str) else names, parts, strict=False):
                if isinstance(part, ast.Constant):
                    values.setdefault(name, []).append(str(part.value))
    return values


def blocks_of(script: Path) -> dict[str, set[str]]:
    """Return the keys of the facts that each block of a script writes or reads."""
    text = script.read_text(encoding="utf-8")
    headers = [(number, match[1]) for number, line in enumerate(text.splitlines(), 1)
               if (match := _HEADER.match(line))]
    blocks: dict[str, set[str]] = {BEGINNING: set(), **{name: set() for _, name in headers}}
    for key, line in _keys(ast.parse(text)):
        blocks[next((name for number, name in reversed(headers) if number < line), BEGINNING)].add(key)
    return blocks


def fact_tests(module: Path) -> Iterator[tuple[ast.FunctionDef, set[str]]]:
    """Yield the tests of a file that read facts, with the keys that they read."""
    for node in ast.parse(module.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            parameters = _parameters(node)
            keys = {value for key, _ in _keys(node)
                    for value in (parameters.get(key[1:], []) if key.startswith("*") else [key])}
            if keys:
                yield node, keys


def blocks_for(keys: set[str], blocks: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return for each key the blocks that hold it."""
    return {key: {name for name, written in blocks.items() if any(
        fnmatch.fnmatchcase(key, _pattern(other)) or fnmatch.fnmatchcase(other, _pattern(key)) for other in written)}
            for key in keys}


def _pattern(key: str) -> str:
    return key.replace("[", "[[]")


def named_blocks(docstring: str) -> tuple[str, list[str]]:
    """Return the script and the blocks that the docstring of a test names; "" and [] for none."""
    match = _NAMED.search(" ".join(docstring.split()))
    return (match[1], re.findall(r'"(.+?)"', match[2])) if match else ("", [])
