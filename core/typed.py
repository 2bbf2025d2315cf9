# SPDX-License-Identifier: GPL-3.0-or-later
"""Values from files and command lines, checked against the types that dataclasses declare.

Settings, recipes and the forms of flares are read through it.
"""
from __future__ import annotations

import dataclasses
import math
import types
import typing
from typing import Any, Literal

MAX_SEED = 2**31 - 1
"""The greatest seed that every library accepts."""
MAX_INT_DIGITS = 18
"""Digits of a whole number that always fits 64 bits."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """The numbers from `minimum` to `maximum`, with or without the ends themselves (as in JSON Schema)."""

    minimum: float
    maximum: float
    exclusive_minimum: bool = False
    exclusive_maximum: bool = False

    def __str__(self) -> str:
        """Return the range in words, to follow "must lie"."""
        if not self.exclusive_minimum and not self.exclusive_maximum:
            return f"between {self.minimum} and {self.maximum}"
        return (f"{'above' if self.exclusive_minimum else 'from'} {self.minimum} "
                f"{'and below' if self.exclusive_maximum else 'to'} {self.maximum}")

    def contains(self, value: float) -> bool:
        """Return whether the number lies in the range; NaN never does."""
        above_minimum = self.minimum < value if self.exclusive_minimum else self.minimum <= value
        return above_minimum and (value < self.maximum if self.exclusive_maximum else value <= self.maximum)


def is_utf8(text: str) -> bool:
    """Return whether the text can be written as UTF-8; file names may hold bytes that cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def parse_table(kind: Any, data: Any) -> Any:
    """Make a dataclass of type `kind` from a dictionary.

    Raises ValueError for anything but a dictionary, for unknown names, and for values of another type.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{kind.__name__} must be a table")
    hints = typing.get_type_hints(kind)
    unknown = set(data) - set(hints)
    if unknown:
        raise ValueError(f"unknown settings {', '.join(sorted(unknown))}")
    return kind(**{key: parse_value(hints[key], value) for key, value in data.items()})


def parse_field(kind: Any, name: str, value: Any) -> Any:
    """Parse the value of the field `name` of a dataclass. Raises ValueError for a value of another type."""
    return parse_value(typing.get_type_hints(kind)[name], value)


def parse_value(kind: Any, value: Any) -> Any:
    """Parse `value` as the type `kind`: a dataclass, a Literal, a tuple, or one of a union.

    Numbers must be finite, whole ones within 64 bits as in TOML, and text UTF-8. Raises ValueError.
    """
    if isinstance(value, int) and value.bit_length() > 63:
        raise ValueError("it has too many digits")
    if isinstance(value, str) and not is_utf8(value):
        raise ValueError(f"{value!r} is not UTF-8")
    if dataclasses.is_dataclass(kind):
        return parse_table(kind, value)
    type_args = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        if value not in type_args:
            raise ValueError(f"{value!r} is not one of {', '.join(type_args)}")
        return value
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{value!r} is not {_type_name(kind)}")
        part_types = type_args[:1] * len(value) if type_args[-1] is Ellipsis else type_args
        if len(part_types) != len(value):
            raise ValueError(f"{value!r} should have {len(part_types)} parts")
        return tuple(parse_value(part_kind, part) for part_kind, part in zip(part_types, value, strict=True))
    for option in type_args if isinstance(kind, types.UnionType) else (kind,):
        if option is float and isinstance(value, int | float) and not isinstance(value, bool):
            if not math.isfinite(value):
                raise ValueError("it must be a finite number")
            return float(value)
        # Exact types, since to Python True is an int.
        if type(value) is option or (option is type(None) and value is None):
            return value
    raise ValueError(f"{value!r} is not {_type_name(kind)}")


def _type_name(kind: Any) -> str:
    """Name a type in an error message."""
    if typing.get_origin(kind) is tuple:
        return "a list"
    options = [part for part in typing.get_args(kind) if part is not type(None)] or [kind]
    return " or ".join(_TYPE_NAMES.get(option, str(option)) for option in options)


_TYPE_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
