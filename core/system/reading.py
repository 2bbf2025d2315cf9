# SPDX-License-Identifier: GPL-3.0-or-later
"""Opens and parses files from elsewhere: regular files only, never waited for, and no larger than their format allows.

All readers of the project open files here, or call `check_regular` before a library opens one. A named pipe, a socket,
a device, or a link to one is refused with SpecialFileError, an OSError, so that whoever reports an unreadable file
reports these as well. Text that has parsed may still hold values that no code can use; `parse_json` and `parse_toml`
refuse these with ValueError.
"""
from __future__ import annotations

import errno
import io
import json
import math
import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from ..errors import SpecialFileError

UTF8_SIG = "utf-8-sig"
"""Encoding for reading text that people write: UTF-8, with the byte order mark that Windows' editors put first or
without."""
MAX_TEXT_BYTES = 256 << 20
"""Bound of a text file, JSON included."""
MAX_TOML_BYTES = 16 << 20
"""Bound of a TOML file, whose parser is slow."""
MAX_PATH_BYTES = 1 << 16
"""Bound of a file that holds one path."""
MAX_MODEL_BYTES = 16 << 30
"""Bound of a file of a COLMAP model, binary or text: those of large captures have gigabytes."""
_MAX_UNSIZED_BYTES = 64 << 20
"""Bound of a regular file that grows while it is read, or states no size, as in /proc."""
_MAX_DIGITS = 308
"""Digits of a whole number that still converts to a float."""
_KINDS = ((stat.S_ISFIFO, "a named pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISCHR, "a device"),
          (stat.S_ISBLK, "a device"))
_ESCAPED = re.compile(r"\\u(0000|[dD][89a-fA-F])")
"""JSON's escapes of NUL and of surrogates, of which one alone is no text."""


def check_regular(path: Path | str) -> None:
    """Raise SpecialFileError for a pipe, a socket or a device. For files that a library opens by itself.

    A path that does not exist, or is a folder, passes: whoever opens it reports that.
    """
    try:
        _check_mode(path, Path(path).stat().st_mode)
    except SpecialFileError:
        raise
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return


def open_regular(path: Path | str) -> io.BufferedReader:
    """Open a regular file to read bytes, without waiting. Raises OSError; SpecialFileError for a pipe or a device."""
    return open(path, "rb", opener=_open_regular)


def append_text(path: Path | str, text: str) -> None:
    """Append UTF-8 text to a regular file, which is created where it is missing. Raises OSError likewise."""
    with open(path, "ab", opener=_open_regular) as stream:
        stream.write(text.encode("utf-8"))


def read_bytes(path: Path | str, limit: int | None = None) -> bytes:
    """Read a regular file whole. limit: largest size, bytes; None for the size that the file states. Raises OSError,
    also for a file above the limit, and for one that grows by more than _MAX_UNSIZED_BYTES while it is read."""
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if limit is None:
            limit = max(size, _MAX_UNSIZED_BYTES)
        if size <= limit:
            data = stream.read(size + 1) or b""
            if len(data) > size:  # it grows, or states no size
                limit = min(limit, size + _MAX_UNSIZED_BYTES)
                data += stream.read(limit + 1 - len(data)) or b""
            if len(data) <= limit:
                return data
    raise OSError(errno.EFBIG, f"it has more than {limit} bytes", str(path))


def read_text(path: Path | str, limit: int = MAX_TEXT_BYTES, encoding: str = "utf-8", errors: str = "strict") -> str:
    """Read a text file whole, with line ends as "\\n". Raises OSError, and ValueError for another encoding."""
    text = read_bytes(path, limit).decode(encoding, errors)
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def parse_json(text: str | bytes) -> Any:
    """Parse JSON. Raises ValueError also for what no code can use: a key that occurs twice in an object, a string with
    a NUL or half a surrogate pair, and nesting of thousands of levels.

    A whole number that is too large for a float becomes infinity.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    try:
        data = json.loads(text, object_pairs_hook=_reject_duplicate_keys, parse_int=_parse_int)
        if _ESCAPED.search(text):
            _check_strings(data)
    except RecursionError as problem:
        raise ValueError("it nests too deeply") from problem
    return data


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML. Raises ValueError, for nesting of thousands too."""
    try:
        return tomllib.loads(text)
    except RecursionError as problem:
        raise ValueError("it nests too deeply") from problem


def is_finite_number(value: object) -> bool:
    """Return whether a value of JSON is a number that converts to a finite float; true and false are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _open_regular(name: str, flags: int) -> int:
    """Open a file as an `opener` of `open`, without waiting; raise SpecialFileError for a pipe, a socket or a device.

    The path is checked first, since opening some devices acts on them; the descriptor after, in case the path has
    changed. A folder passes; `open` itself refuses it.
    """
    check_regular(name)
    descriptor = os.open(name, flags | getattr(os, "O_NONBLOCK", 0), 0o666)
    try:
        _check_mode(name, os.fstat(descriptor).st_mode)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _check_mode(path: Path | str, mode: int) -> None:
    """Raise SpecialFileError for a `mode` (of stat) of a pipe, a socket or a device."""
    for is_kind, kind in _KINDS:
        if is_kind(mode):
            raise SpecialFileError(errno.EINVAL, f"it is {kind}, not a file", str(path))


def _reject_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Raise ValueError for a key that occurs twice."""
    unique = dict(pairs)
    if len(unique) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it has {next(name for name in names if names.count(name) > 1)!r} twice")
    return unique


def _parse_int(digits: str) -> int | float:
    """Parse a whole number; infinity where no float holds it, as JSON's parser does with 1e999."""
    return int(digits) if len(digits) <= _MAX_DIGITS else float(digits)


def _check_strings(value: Any) -> None:
    """Raise ValueError if a string anywhere in parsed JSON, keys included, has a NUL or a lone surrogate: it could not
    be a file name, or not be written as UTF-8."""
    if isinstance(value, str):
        if "\0" in value:
            raise ValueError(f"{value!r:.100} has a NUL")
        try:
            value.encode("utf-8", "surrogateescape")  # as in names of files that are not UTF-8
        except UnicodeEncodeError:
            raise ValueError(f"{value!r:.100} is not UTF-8") from None
    elif isinstance(value, dict):
        for name, entry in value.items():
            _check_strings(name)
            _check_strings(entry)
    elif isinstance(value, list):
        for entry in value:
            _check_strings(entry)
