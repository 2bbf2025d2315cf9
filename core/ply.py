# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the header of a PLY and the rows of its elements (Turk 1994, "The PLY Polygon File Format").

A header is lines of ASCII up to "end_header": the format, comments, and elements, each with a number of rows and the
properties of a row. The rows follow, element after element. The readers of points and of Gaussians check the contents.
"""
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .typed import MAX_INT_DIGITS

BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Byte orders, as numpy writes them, by format."""
NUMPY_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
          "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
          "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
"""numpy's types by the names of PLY's."""


class Element(NamedTuple):
    """A table: its name, the number of rows, negative where it is invalid, and the words of each property."""

    name: str
    rows: int
    properties: list[list[str]]

    def layout(self) -> list[tuple[str, str]]:
        """Return name and numpy type, without byte order, of each property.

        Raises ValueError with the words of a property that is no plain number, such as a list.
        """
        for tokens in self.properties:
            if len(tokens) != 2 or tokens[0] not in NUMPY_TYPES:
                raise ValueError(repr(" ".join(tokens)))
        return [(name, NUMPY_TYPES[type_name]) for type_name, name in self.properties]

    def row(self, order: str) -> np.dtype[Any]:
        """Return the type of a row of a binary file. Raises ValueError likewise, and for a duplicate name."""
        return np.dtype([(name, order + code) for name, code in self.layout()])


class Header(NamedTuple):
    """The format's name, the words of each comment, the elements in order, and the byte where their rows begin."""

    format: str
    comments: list[list[str]]
    elements: list[Element]
    start: int


def read_header(data: bytes) -> Header | None:
    """Parse the header of a file, or of its beginning; None where it is no PLY, or the header is incomplete."""
    end = data.find(b"\nend_header")
    start = data.find(b"\n", end + 1) + 1
    if not data.startswith(b"ply") or end < 0 or not start:
        return None
    format_name, comments = "", []
    elements: list[Element] = []
    for line in data[:end].decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", format_name, *_]:
                pass
            case ["comment", *tokens]:
                comments.append(tokens)
            case ["element", name, row_count]:
                elements.append(Element(name, _parse_count(row_count), []))
            case ["property", *tokens] if elements:
                elements[-1].properties.append(tokens)
    return Header(format_name, comments, elements, start)


def read_table(data: bytes, row: np.dtype[Any], count: int, start: int) -> NDArray[Any]:
    """Return (count,) rows of a binary file from byte `start`. Raises ValueError where the file is too short."""
    if count * row.itemsize > len(data) - start:
        raise ValueError(f"it ends before its {count} rows")
    return np.frombuffer(data, row, count, start)


def _parse_count(number: str) -> int:
    """Parse a number of rows; -1 if invalid.

    A number with more digits than any file has rows becomes a power of ten: Python refuses to parse thousands of
    digits.
    """
    if not number.isdigit():
        return -1
    return int(number) if len(number) <= MAX_INT_DIGITS else 10**MAX_INT_DIGITS
