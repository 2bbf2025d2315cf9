# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes the tags of a TIFF (Adobe, TIFF 6.0, 1992), which OpenCV does not expose."""
from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...system.reading import open_regular

SUBFILE, WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, ORIENTATION, SAMPLES = 254, 256, 257, 258, 259, 262, 274, 277
PLANES, EXTRA_SAMPLES, SAMPLE_FORMAT = 284, 338, 339
X_RESOLUTION, Y_RESOLUTION, RESOLUTION_UNIT, XMP, COLOUR_PROFILE = 282, 283, 296, 700, 34675

UPRIGHT = 1
"""Orientation: rows from the top, columns from the left."""
WHITE_IS_0, SEPARATED, LAB = 0, 5, (8, 9, 10)
"""Photometric interpretation: 0 is white; CMYK inks; the three kinds of Lab."""
UNSUPPORTED_COMPRESSIONS = {34712: "JPEG 2000", 34887: "LERC", 34925: "LZMA", 50000: "Zstandard",
                            50001: "WebP", 50002: "JPEG XL"}
"""Compressions that the library in OpenCV is mostly built without."""
UNSIGNED, FLOATS = 1, 3
"""Sample format: unsigned integers, floats."""
BIG_TIFF = (b"II+\0", b"MM\0+")
"""First bytes of a BigTIFF, which has 64 bit offsets."""
PLANAR = 2
"""Planar configuration: one plane for each channel."""
ASSOCIATED, UNASSOCIATED = 1, 2
"""Extra sample: alpha that the colours are multiplied with, or not."""

_TYPES = {1: "u1", 2: "u1", 3: "u2", 4: "u4", 5: "u4", 6: "i1", 7: "u1", 8: "i2", 9: "i4", 10: "i4", 11: "f4", 12: "f8"}
_Order = Literal["<", ">"]
_BIG_TYPES = {16: "u8", 17: "i8", 18: "u8"}
"""Types of BigTIFF alone: whole numbers and offsets of 64 bits."""
_MAX_ENTRIES = 1 << 16
"""Largest directory that is read of a BigTIFF, whose field has 64 bits."""
_RATIONALS = (5, 10)
_ZIP = (8, 32946)
"""ZIP compression: Adobe's number and the older one."""
_STRIPS, _TILES = (273, 279), (324, 325)
"""Tags of the places and of the bytes of the parts of a picture."""
_PIECE_BYTES, _BYTES_BEYOND = 1 << 20, 1 << 24
"""Bytes that are uncompressed at once, and bytes beyond the pixels, such as the ends of tiles, that are checked."""
_MAX_PAGES = 1000


class _Layout(NamedTuple):
    """How a TIFF stores numbers: the byte order, and the format characters of struct.

    length: format of a directory's number of entries. offset: format of offsets, and of an entry's number of values.
    """

    order: _Order
    length: str
    offset: str

    def number(self, raw: bytes, kind: str = "") -> int:
        """Decode the number at the start of `raw`. kind: its format character; "" for that of offsets."""
        return int(struct.unpack_from(self.order + (kind or self.offset), raw)[0])

    @property
    def value_position(self) -> int:
        """Where in an entry its last field begins: the values, or their offset if they are longer than the field."""
        return 4 + struct.calcsize(self.offset)

    @property
    def entry_size(self) -> int:
        """Bytes of an entry."""
        return self.value_position + struct.calcsize(self.offset)


_NO_DIRECTORY: tuple[_Layout, list[bytes]] = (_Layout("<", "H", "I"), [])


class Tag(NamedTuple):
    """A tag's type, by the standard's number, and its values; a fraction is two."""

    kind: int
    values: NDArray[np.generic]


def short(value: int) -> Tag:
    """Make a tag with one 16 bit number."""
    return Tag(3, np.array([value], np.uint16))


def read_tags(stream: BinaryIO, numbers: Container[int], directory_offset: int | None = None) -> dict[int, Tag]:
    """Read the tags `numbers` of the first page, or of the directory at an offset. Damaged tags are left out; a file
    that is no TIFF gives {}.

    The 64 bit numbers of a BigTIFF are returned as 32 bit numbers, and left out where they do not fit.
    """
    layout, entries = next(_directories(stream, directory_offset), _NO_DIRECTORY)
    tags: dict[int, Tag] = {}
    for entry in entries:
        number, kind = struct.unpack_from(layout.order + "HH", entry)
        types = {**_TYPES, **_BIG_TYPES} if layout.offset == "Q" else _TYPES
        if number not in numbers or kind not in types:
            continue
        count = layout.number(entry[4:])
        value_type = np.dtype(types[kind]).newbyteorder(layout.order)
        length = count * value_type.itemsize * (2 if kind in _RATIONALS else 1)
        raw = entry[layout.value_position:][:length]
        if length > layout.entry_size - layout.value_position:  # the field holds the offset of the values
            start = layout.number(entry[layout.value_position:])
            if start + length > stream.seek(0, io.SEEK_END):  # else `read` would allocate what it claims
                continue
            stream.seek(start)
            raw = stream.read(length)
        if not count or len(raw) != length:
            continue
        decoded = np.frombuffer(raw, value_type).astype(value_type.newbyteorder("="))
        if kind not in _BIG_TYPES:
            tags[number] = Tag(kind, decoded)
        elif kind != 17 and decoded.max() < 1 << 32:  # 17 is signed
            tags[number] = Tag(4, decoded.astype(np.uint32))
    return tags


def integer_values(tags: Mapping[int, Tag]) -> dict[int, int]:
    """Return the values of the tags that hold a single number of 16 or 32 bits."""
    return {name: int(tag.values[0]) for name, tag in tags.items() if tag.kind in (3, 4) and len(tag.values) == 1}


def page_count(stream: BinaryIO) -> int:
    """Count the pages, without the thumbnails that some programs add."""
    count = 0
    for layout, entries in _directories(stream):
        # The values (32 bits) of the tag SUBFILE; a page has at most one.
        subfile_types = [layout.number(entry[layout.value_position:], "I") for entry in entries
                         if layout.number(entry, "H") == SUBFILE]
        count += not any(subfile_type & 1 for subfile_type in subfile_types)  # bit 0: a reduced copy of another page
    return count


def has_corrupt_data(stream: BinaryIO) -> bool:
    """Return whether strips or tiles of ZIP compression do not match their checksums, which the library of the format
    does not compare.

    Checks at most as many bytes as the pixels can have (8 for each channel) and _BYTES_BEYOND more, since hostile data
    uncompress to any length.
    """
    tags = read_tags(stream, (WIDTH, HEIGHT, BITS, SAMPLES, COMPRESSION, *_STRIPS, *_TILES))
    numbers = integer_values(tags)
    if numbers.get(COMPRESSION) not in _ZIP:
        return False
    limit = _BYTES_BEYOND + numbers.get(WIDTH, 0) * numbers.get(HEIGHT, 0) * numbers.get(SAMPLES, 1) * 8
    for offsets_tag, lengths_tag in (_STRIPS, _TILES):
        if offsets_tag in tags and lengths_tag in tags:
            offsets, lengths = tags[offsets_tag].values.tolist(), tags[lengths_tag].values.tolist()
            for offset, length in zip(offsets, lengths, strict=False):
                stream.seek(offset)
                limit -= (inflated := _inflated_size(stream.read(length), limit))
                if inflated < 0:
                    return True
    return False


def _inflated_size(data: bytes, limit: int) -> int:
    """Return the bytes of uncompressed data, counted up to a limit; -1 where they do not match their checksum."""
    inflater, size = zlib.decompressobj(), 0
    try:
        while data and not inflater.eof and size < limit:
            size += len(inflater.decompress(data, _PIECE_BYTES))
            data = inflater.unconsumed_tail
    except zlib.error:
        return -1
    return size


def with_tags(data: bytes, tags: Mapping[int, Tag]) -> bytes:
    """Return a TIFF with these tags added to its first page, in place of tags of the same numbers; a BigTIFF and other
    data unchanged.

    The values and a new directory are appended; the old directory stays in the file, but nothing points to it.
    """
    (order, _, _), entries = next(_directories(io.BytesIO(data)), _NO_DIRECTORY)
    if not entries or not tags or data[:4] in BIG_TIFF:
        return data
    result = bytearray(data)
    new_entries = [entry for entry in entries if struct.unpack(order + "H", entry[:2])[0] not in tags]
    for number, (kind, values) in tags.items():
        raw = values.astype(values.dtype.newbyteorder(order)).tobytes()
        count = len(values) // (2 if kind in _RATIONALS else 1)
        if len(raw) <= 4:
            value_field = raw.ljust(4, b"\0")
        else:
            result += b"\0" * (len(result) % 2)
            value_field = struct.pack(order + "I", len(result))
            result += raw
        new_entries.append(struct.pack(order + "HHI", number, kind, count) + value_field)
    result += b"\0" * (len(result) % 2)
    directory_offset = struct.unpack(order + "I", data[4:8])[0]
    next_offset = data[directory_offset + 2 + 12 * len(entries):][:4].ljust(4, b"\0")  # offset of the next page
    new_entries.sort(key=lambda entry: struct.unpack(order + "H", entry[:2])[0])
    result[4:8] = struct.pack(order + "I", len(result))
    result += struct.pack(order + "H", len(new_entries)) + b"".join(new_entries) + next_offset
    return bytes(result)


def with_directory(data: bytes, number: int, tags: Mapping[int, Tag]) -> bytes:
    """Return a TIFF with another directory of these tags, such as Exif's, at its end; the tag `number` of its first
    page points there. A BigTIFF and other data are unchanged."""
    (order, _, _), entries = next(_directories(io.BytesIO(data)), _NO_DIRECTORY)
    if not entries or not tags or data[:4] in BIG_TIFF:
        return data
    result = bytearray(data + b"\0" * (len(data) % 2))
    entry_list = []
    for tag_number, (kind, values) in sorted(tags.items()):
        raw = values.astype(values.dtype.newbyteorder(order)).tobytes()
        value_field = raw.ljust(4, b"\0") if len(raw) <= 4 else struct.pack(order + "I", len(result))
        if len(raw) > 4:
            result += raw + b"\0" * (len(raw) % 2)
        count = len(values) // (2 if kind in _RATIONALS else 1)
        entry_list.append(struct.pack(order + "HHI", tag_number, kind, count) + value_field)
    directory_offset = len(result)
    result += struct.pack(order + "H", len(entry_list)) + b"".join(entry_list) + bytes(4)
    return with_tags(bytes(result), {number: Tag(4, np.array([directory_offset], np.uint32))})


def is_premultiplied(path: Path) -> bool:
    """Return whether a file says that its colours are multiplied with its alpha."""
    with open_regular(path) as stream:
        tags = read_tags(stream, (EXTRA_SAMPLES,))
    return EXTRA_SAMPLES in tags and bool(tags[EXTRA_SAMPLES].values[0] == ASSOCIATED)


def without_reader_changes(data: bytes) -> bytes:
    """Return a TIFF whose pixels a reader neither rotates nor multiplies with alpha: its tags say that they are upright
    and, where there is alpha, multiplied already."""
    tags = read_tags(io.BytesIO(data), (ORIENTATION, EXTRA_SAMPLES))
    changed = {ORIENTATION: short(UPRIGHT)} if ORIENTATION in tags else {}
    if EXTRA_SAMPLES in tags and tags[EXTRA_SAMPLES].values[0] == UNASSOCIATED:
        changed[EXTRA_SAMPLES] = Tag(3, np.array([ASSOCIATED, *tags[EXTRA_SAMPLES].values[1:]], np.uint16))
    return with_tags(data, changed)


def _directories(stream: BinaryIO, offset: int | None = None) -> Iterator[tuple[_Layout, list[bytes]]]:
    """Yield (layout, entries) page by page, or from the directory at `offset`, while the file is intact."""
    stream.seek(0)
    head = stream.read(16)
    order: _Order = "<" if head[:2] == b"II" else ">"
    if head[:4] in (b"II*\0", b"MM\0*") and len(head) >= 8:
        layout, first_offset = _Layout(order, "H", "I"), head[4:8]
    elif head[:4] in BIG_TIFF and len(head) == 16:
        layout, first_offset = _Layout(order, "Q", "Q"), head[8:]
    else:
        return
    offset = layout.number(first_offset) if offset is None else offset
    for _ in range(_MAX_PAGES):
        stream.seek(min(offset, stream.seek(0, io.SEEK_END)))
        raw = stream.read(struct.calcsize(layout.length))
        count = layout.number(raw, layout.length) if len(raw) == struct.calcsize(layout.length) else 0
        entries = stream.read(count * layout.entry_size) if count < _MAX_ENTRIES else b""
        if not count or len(entries) < count * layout.entry_size:
            return
        yield layout, [entries[k:k + layout.entry_size] for k in range(0, len(entries), layout.entry_size)]
        stream.seek(offset + len(raw) + len(entries))
        next_offset = stream.read(struct.calcsize(layout.offset))
        offset = layout.number(next_offset) if len(next_offset) == struct.calcsize(layout.offset) else 0
        if not offset:
            return
