# SPDX-License-Identifier: GPL-3.0-or-later
"""Values from files and command lines, checked against the types that dataclasses declare."""
from __future__ import annotations

import dataclasses
import math
import types
import typing
from typing import Any, Literal

MOST_SEED = 2**31 - 1
"""The greatest seed that every library takes."""
WHOLE_DIGITS = 18
"""Of a whole number that 64 bits hold in any case."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """The numbers from `least` to `most`; above, below: without the least, without the most itself."""

    least: float
    most: float
    above: bool = False
    below: bool = False

    def __str__(self) -> str:
        """After "must lie"."""
        if not self.above and not self.below:
            return f"between {self.least} and {self.most}"
        return f"{'above' if self.above else 'from'} {self.least} {'and below' if self.below else 'to'} {self.most}"

    def hold(self, value: float) -> bool:
        """Whether the number is one of them; NaN never is."""
        low = self.least < value if self.above else self.least <= value
        return low and (value < self.most if self.below else value <= self.most)


def is_utf8(text: str) -> bool:
    """Whether it can be written into a file. Names of files can be what UTF-8 has no bytes for."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def table_of(kind: Any, data: Any) -> Any:
    """A dataclass of `kind` from a dictionary. Raises ValueError for what is no table, has other names, or values of
    another type."""
    if not isinstance(data, dict):
        raise ValueError(f"{kind.__name__} must be a table")
    hints = typing.get_type_hints(kind)
    unknown = set(data) - set(hints)
    if unknown:
        raise ValueError(f"unknown settings {', '.join(sorted(unknown))}")
    return kind(**{key: value_of(hints[key], value) for key, value in data.items()})


def field_of(kind: Any, name: str, value: Any) -> Any:
    """A value for the field of a dataclass. Raises ValueError where it is of another type."""
    return value_of(typing.get_type_hints(kind)[name], value)


def value_of(kind: Any, value: Any) -> Any:
    """`value` as the type `kind`: a dataclass, a Literal, a tuple, or one of a union; numbers are finite, whole ones of
    64 bits as TOML has them, and text is UTF-8. Raises ValueError."""
    if isinstance(value, int) and value.bit_length() > 63:
        raise ValueError("it has too many digits")
    if isinstance(value, str) and not is_utf8(value):
        raise ValueError(f"{value!r} is not UTF-8")
    if dataclasses.is_dataclass(kind):
        return table_of(kind, value)
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        if value not in parts:
            raise ValueError(f"{value!r} is not one of {', '.join(parts)}")
        return value
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{value!r} is not {_in_words(kind)}")
        kinds = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        if len(kinds) != len(value):
            raise ValueError(f"{value!r} should have {len(kinds)} parts")
        return tuple(value_of(one, part) for one, part in zip(kinds, value, strict=True))
    for option in parts if isinstance(kind, types.UnionType) else (kind,):
        if option is float and isinstance(value, int | float) and not isinstance(value, bool):
            if not math.isfinite(value):
                raise ValueError("it must be a finite number")
            return float(value)
        if type(value) is option or (option is type(None) and value is None):
            return value
    raise ValueError(f"{value!r} is not {_in_words(kind)}")


def _in_words(kind: Any) -> str:
    """A type, for people."""
    if typing.get_origin(kind) is tuple:
        return "a list"
    options = [part for part in typing.get_args(kind) if part is not type(None)] or [kind]
    return " or ".join(_WORDS.get(option, str(option)) for option in options)


_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
