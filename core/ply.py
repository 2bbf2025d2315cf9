# SPDX-License-Identifier: GPL-3.0-or-later
"""What a PLY says in its header, and the rows of its elements (Turk 1994, "The PLY Polygon File Format").

Lines of ASCII up to "end_header": the format, comments, and elements, each with a number of rows and the properties of
a row. The rows follow, element after element. What must be in a file, and what to say where it is not, is its reader's.
"""
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .typed import WHOLE_DIGITS

ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Byte orders, as numpy writes them, by format."""
_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
          "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
          "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}


class Element(NamedTuple):
    """A table: its name, how many rows it has, below 0 where that is no number, and the words of each property."""

    name: str
    rows: int
    properties: list[list[str]]

    def layout(self) -> list[tuple[str, str]]:
        """Name and numpy type, without its byte order, of each property. Raises ValueError with the words of one that
        is no plain number, such as a list."""
        for words in self.properties:
            if len(words) != 2 or words[0] not in _TYPES:
                raise ValueError(repr(" ".join(words)))
        return [(name, _TYPES[kind]) for kind, name in self.properties]

    def row(self, order: str) -> np.dtype[Any]:
        """What a row is in a binary file, by its byte order. Raises ValueError likewise, and for a name that is there
        twice."""
        return np.dtype([(name, order + code) for name, code in self.layout()])


class Header(NamedTuple):
    """The format's name, the words of each comment, the elements in their order, and where their rows begin, bytes."""

    form: str
    comments: list[list[str]]
    elements: list[Element]
    start: int


def read_header(data: bytes) -> Header | None:
    """The header of a file, or of its beginning; None where it is no PLY, or the header does not end there."""
    end = data.find(b"\nend_header")
    start = data.find(b"\n", end + 1) + 1
    if not data.startswith(b"ply") or end < 0 or not start:
        return None
    form, comments = "", []
    elements: list[Element] = []
    for line in data[:end].decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", form, *_]:
                pass
            case ["comment", *words]:
                comments.append(words)
            case ["element", name, number]:
                elements.append(Element(name, _whole(number), []))
            case ["property", *words] if elements:
                elements[-1].properties.append(words)
    return Header(form, comments, elements, start)


def table(data: bytes, row: np.dtype[Any], count: int, start: int) -> NDArray[Any]:
    """(count,) rows of a binary file that begin at a byte. Raises ValueError where it ends before them."""
    if count * row.itemsize > len(data) - start:
        raise ValueError(f"it ends before its {count} rows")
    return np.frombuffer(data, row, count, start)


def _whole(number: str) -> int:
    """Of one with more digits than any file has rows, the next power of ten: Python refuses to read thousands."""
    if not number.isdigit():
        return -1
    return int(number) if len(number) <= WHOLE_DIGITS else 10**WHOLE_DIGITS
