# SPDX-License-Identifier: GPL-3.0-or-later
"""Copies what describes a picture from its file to a new one of the same format: profiles, Exif, XMP, IPTC, text, tags.

By hand, because the libraries that encode either write none of it or only what they parse; here it stays byte for byte.
What no longer fits the new pixels goes together: a gain map or motion clip behind a JPEG, and the XMP that claims it;
likewise the thumbnail in the Exif block, and the picture before refocusing that Google's camera stores in the XMP.
"""
from __future__ import annotations

import io
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import numpy as np

from ..system.reading import open_regular, read_bytes
from .formats import jpeg, png, tiff
from .formats.exif import without_thumbnail
from .formats.image_resources import without_thumbnails

KEPT_CHUNKS = (b"iCCP", b"gAMA", b"cHRM", b"sRGB", b"cICP", b"mDCV", b"cLLI", b"mDCv", b"cLLi", b"pHYs", png.EXIF,
               b"tEXt", b"zTXt", b"iTXt", b"tIME", b"sCAL", b"oFFs", b"pCAL", b"sTER")
"""PNG chunks that are kept; the second pair are the drafts' names of the first."""
_STRUCTURE_TAGS = frozenset({
    tiff.WIDTH, tiff.HEIGHT, tiff.BITS, tiff.COMPRESSION, tiff.PHOTOMETRIC, tiff.SAMPLES, tiff.PLANES,
    tiff.SAMPLE_FORMAT, 254, 255, 263, 266, 273, 278, 279, 280, 281, 288, 289, 290, 291, 292, 293, 317, 320, 321, 322,
    323, 324, 325, 330, 332, 334, 336, 340, 341, 342, 343, 347, 512, 513, 514, 515, 517, 518, 519, 520, 521, 529, 530,
    531, 532})
"""TIFF tags that say how the pixels are stored, which the encoder writes anew; and offsets of other directories."""
EXIF_DIRECTORY, GPS_DIRECTORY = 34665, 34853
_INTEROPERABILITY_TAG = 0xA005
"""Exif tag with the offset of another directory, which is not copied."""
_RESOURCES_TAG = 34377
"""TIFF tag of Photoshop's image resources."""
_MAX_RESOURCE_BYTES = 65_000
"""Bytes of image resources in a segment."""
_COLOUR_TYPE_OFFSET, _HEADER_END = 25, 33
"""Offsets in a PNG of the colour type, whose bit 2 means colour, and of the end of the first chunk, IHDR."""
_SRGB_POINTS, _UNSPECIFIED = (1, 13), 2
"""Code points (ITU-T H.273): primaries and transfer of sRGB, and that for an unspecified one."""
_COPIED_MARKERS = frozenset({jpeg.APP1, jpeg.APP2, jpeg.APP13, jpeg.COMMENT, *range(0xE3, 0xED), 0xEF})
"""JPEG segments that are kept; APP14 says how the encoder stores its colours, and APP0 is replaced as a whole."""
_MULTI_PICTURE_INDEX, _ISO_GAIN_MAP = b"MPF\0", b"urn:iso:std:iso:ts:21496:-1"
"""Segments that describe the pictures behind a JPEG's first one."""
_HEIF_GAIN_MAPS = (b"aux:hdrgainmap", b"urn:iso:std:iso:ts:21496:-1", b"tmap")
"""Names of gain maps in the header of HEIC and AVIF: Apple's, and that of ISO 21496-1."""
_TAIL_BYTES = 1 << 12
"""Bytes at the end of a file that are searched for the picture's last marker, which padding may follow."""
_HEAD_BYTES = 1 << 16
"""Bytes of a file in which its header is looked for."""
_ORIGINAL = "http://ns.google.com/photos/1.0/image/"
"""Name space of XMP of the picture before refocusing, which lies in the segments of extended XMP with its depth."""
_CAMERA = "http://ns.google.com/photos/1.0/camera/"
"""Name space of XMP of Google's camera, which most of its photographs have."""
_CLAIMS = ("http://ns.adobe.com/hdr-gain-map/1.0/", "http://ns.google.com/photos/1.0/container/",
           "http://ns.google.com/photos/dd/1.0/", "http://ns.apple.com/HDRGainMap/1.0/", _ORIGINAL)
"""First letters of the name spaces of XMP by which a file claims that it holds more than its first picture."""
_CAMERA_CLAIMS = ("MotionPhoto", "MicroVideo")
"""First letters of the properties of Google's camera that claim a clip."""
_THUMBNAILS = "http://ns.adobe.com/xap/1.0/g/img/"
"""Name space of XMP of thumbnails, which would show the flare."""
_EXTENDED_CLAIMS = ("http://ns.google.com/photos/1.0/depthmap/", "http://ns.adobe.com/xmp/note/")
"""First letters of the name spaces that go with the segments of extended XMP."""


def copy_metadata(encoded: bytes, source: Path, *, has_alpha: bool) -> bytes:
    """Return an encoded PNG, JPEG or TIFF with the metadata of the file `source`; unchanged for another format.

    has_alpha: whether the encoded picture has alpha.
    """
    source_data = read_bytes(source)
    if encoded[:2] == b"\xff\xd8" == source_data[:2]:
        return _copy_to_jpeg(encoded, source_data)
    if encoded[:8] == png.SIGNATURE == source_data[:8]:
        was_grey, is_grey = (not header[_COLOUR_TYPE_OFFSET] & 2 for header in (source_data, encoded))
        skipped_chunks = (b"iCCP",) if was_grey != is_grey else ()  # a profile is for grey or for R G B
        chunks = b"".join(png.make_chunk(name, without_thumbnail(content) if name == png.EXIF else content)
                          for name, content in png.chunks(io.BytesIO(source_data), KEPT_CHUNKS)
                          if name not in skipped_chunks)
        return encoded[:_HEADER_END] + chunks + encoded[_HEADER_END:]
    if encoded[:4] in (b"II*\0", b"MM\0*") and source_data[:4] in (b"II*\0", b"MM\0*", *tiff.BIG_TIFF):
        return _copy_to_tiff(encoded, source_data, has_alpha)
    return encoded


def with_colour_chunks(encoded: bytes, profile: bytes, code_points: tuple[int, int] | None) -> bytes:
    """Return an encoded PNG with the colour space of the picture of another format that it was made from.

    profile: ICC profile of that picture, written if it is for the PNG's number of channels. code_points: its primaries
    and transfer function (ITU-T H.273), written instead if the profile is not, unless they are sRGB or unspecified.
    """
    is_colour = encoded[_COLOUR_TYPE_OFFSET] & 2 > 0
    if profile and is_colour == (profile[16:20] == b"RGB "):
        # Its name, the number of the compression, and the compressed profile.
        chunk = png.make_chunk(b"iCCP", b"profile\0\0" + zlib.compress(profile))
    elif code_points and code_points != _SRGB_POINTS and _UNSPECIFIED not in code_points:
        chunk = png.make_chunk(b"cICP", bytes((*code_points, 0, 1)))  # matrix R G B, full range
    else:
        return encoded
    return encoded[:_HEADER_END] + chunk + encoded[_HEADER_END:]


def with_description(encoded: bytes, exif: bytes, xmp: bytes) -> bytes:
    """Return an encoded PNG with the Exif block and the XMP of the picture that it was made from, without the XMP's
    claims of parts that the PNG does not hold, such as a gain map. exif, xmp: empty for none."""
    chunks = png.make_chunk(png.EXIF, without_thumbnail(exif)) if exif else b""
    if packet := _without_claims(jpeg.XMP + xmp).removeprefix(jpeg.XMP) if xmp else b"":
        # The zeros: end of the keyword, not compressed, no method, no language, no translation of the keyword.
        chunks += png.make_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet)
    return encoded[:_HEADER_END] + chunks + encoded[_HEADER_END:]


def dropped_parts_warning(path: Path) -> str:
    """Return a warning on what a picture with changed pixels cannot keep of this file; "" where it keeps all."""
    with open_regular(path) as stream:
        head = stream.read(_HEAD_BYTES)
        if head[4:8] == b"ftyp" and any(name in head for name in _HEIF_GAIN_MAPS):
            return (f"{path} holds a gain map, which would show its own pixels; the result goes without it, and "
                    "without the tags that claim it.")
        if head[:2] != b"\xff\xd8":
            return ""
        for _, content in jpeg.segments(stream):
            if content.startswith((_MULTI_PICTURE_INDEX, _ISO_GAIN_MAP)) or (content.startswith(jpeg.XMP)
                                                                             and _has_claims(content)):
                return (f"{path} holds more than one picture (a gain map, a clip or a preview), which would show its "
                        "own pixels; the result goes without them, and without the tags that claim them.")
        stream.seek(-min(_TAIL_BYTES, stream.seek(0, 2)), 2)
        if not stream.read().rstrip(b"\0\r\n ").endswith(b"\xff\xd9"):  # Samsung's motion photos
            return (f"{path} has data after its picture, such as a clip, which would show its own pixels; the result "
                    "goes without it.")
    return ""


def _copy_to_jpeg(encoded: bytes, source: bytes) -> bytes:
    """Return the encoded JPEG with the descriptive segments of the source (`_COPIED_MARKERS`), in their order, without
    thumbnails, gain maps and the XMP that claims them.

    The segments follow a JFIF header: the source's if it has one, else that of the encoded JPEG.
    """
    header, header_end = b"", 2
    if encoded[2:4] == b"\xff\xe0":  # APP0
        header_end = 4 + int.from_bytes(encoded[4:6], "big")
        header = encoded[2:header_end]
    segments = list(jpeg.segments(io.BytesIO(source)))
    has_refocus_original = any(content.startswith(jpeg.XMP) and _ORIGINAL.encode() in content
                               for _, content in segments)
    copied = []
    for marker, content in _without_resource_thumbnails(segments):
        if marker == jpeg.APP0 and content.startswith(b"JFIF\0") and len(content) >= 14:
            header = jpeg.make_segment(marker, content[:12] + b"\0\0")  # density, and a thumbnail of 0 x 0
        elif has_refocus_original and content.startswith(jpeg.EXTENDED_XMP):
            continue  # it holds that original, which shows the flare
        elif marker in _COPIED_MARKERS and not content.startswith((_MULTI_PICTURE_INDEX, _ISO_GAIN_MAP)):
            if content.startswith(jpeg.XMP):
                content = _without_claims(content)
            elif content.startswith(jpeg.EXIF):
                content = jpeg.EXIF + without_thumbnail(content.removeprefix(jpeg.EXIF))
            if content:
                copied.append(jpeg.make_segment(marker, content))
    return encoded[:2] + header + b"".join(copied) + encoded[header_end:]


def _without_resource_thumbnails(segments: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Return a JPEG's segments without the thumbnails in Photoshop's image resources.

    The resources may span several segments, so they are joined, and split anew where the first of them was.
    """
    indices = [index for index, (marker, content) in enumerate(segments)
               if marker == jpeg.APP13 and content.startswith(jpeg.PHOTOSHOP)]
    resources = b"".join(segments[index][1][len(jpeg.PHOTOSHOP):] for index in indices)
    if (cleaned := without_thumbnails(resources)) == resources:
        return segments
    new_segments = [(jpeg.APP13, jpeg.PHOTOSHOP + cleaned[offset:offset + _MAX_RESOURCE_BYTES])
                    for offset in range(0, len(cleaned), _MAX_RESOURCE_BYTES)]
    return [*segments[:indices[0]], *new_segments, *(segments[index] for index in range(indices[0], len(segments))
                                                     if index not in indices)]


def _has_claims(segment: bytes) -> bool:
    """Return whether an XMP segment claims that the file holds more than its first picture."""
    return any(name.encode() in segment for name in _CLAIMS) or (
        _CAMERA.encode() in segment and any(name.encode() in segment for name in _CAMERA_CLAIMS))


def _without_claims(segment: bytes) -> bytes:
    """Return an XMP segment without thumbnails, and without the properties that announce parts (gain map, clip) which
    are not kept.

    A segment with none of these stays byte for byte. One that has some, but cannot be parsed, becomes empty.
    """
    if not _has_claims(segment) and _THUMBNAILS.encode() not in segment:
        return segment
    text = segment[len(jpeg.XMP):].rstrip(b"\0 \n")
    try:
        for _, (prefix, address) in ElementTree.iterparse(io.BytesIO(text), ("start-ns",)):
            if not prefix.startswith("ns"):  # ElementTree writes registered prefixes, and reserves ns0, ns1, ...
                ElementTree.register_namespace(prefix, address)
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError):
        return b""
    names = (*_CLAIMS, *_EXTENDED_CLAIMS) if _ORIGINAL.encode() in segment else _CLAIMS
    # ElementTree names a property "{name space}name".
    claims = (*(f"{{{name}" for name in names), *(f"{{{_CAMERA}}}{name}" for name in _CAMERA_CLAIMS),
              "{http://ns.adobe.com/xap/1.0/}Thumbnails")
    for element in root.iter():
        for name in [name for name in element.attrib if name.startswith(claims)]:
            del element.attrib[name]
        for child in [child for child in element if child.tag.startswith(claims)]:
            element.remove(child)
    return jpeg.XMP + ElementTree.tostring(root, encoding="utf-8")


def _copy_to_tiff(encoded: bytes, data: bytes, has_alpha: bool) -> bytes:
    """Return the TIFF `encoded` with all tags of the source `data` except _STRUCTURE_TAGS, and with its Exif and GPS
    directories. has_alpha: whether the encoded picture has alpha."""
    content_tags = _AllBut(_STRUCTURE_TAGS)
    tags = tiff.read_tags(io.BytesIO(data), content_tags)
    directories = {number: tags.pop(number) for number in (EXIF_DIRECTORY, GPS_DIRECTORY) if number in tags}
    if not has_alpha:  # these tags describe the source's alpha
        tags.pop(tiff.EXTRA_SAMPLES, None)
    if (resources := tags.get(_RESOURCES_TAG)) is not None and resources.values.dtype.itemsize == 1:
        tags.pop(_RESOURCES_TAG)
        if cleaned := without_thumbnails(resources.values.tobytes()):
            tags[_RESOURCES_TAG] = resources._replace(values=np.frombuffer(cleaned, np.uint8))
    encoded = tiff.with_tags(encoded, tags)
    for number, offset_tag in directories.items():
        if len(offset_tag.values) == 1:
            directory = tiff.read_tags(io.BytesIO(data), _AllBut({_INTEROPERABILITY_TAG}),
                                       int(np.uint32(offset_tag.values[0])))
            encoded = tiff.with_directory(encoded, number, directory)
    return encoded


class _AllBut:
    """A container that holds every number except the excluded ones, for `tiff.read_tags`."""

    def __init__(self, excluded: frozenset[int] | set[int]) -> None:
        self._excluded = excluded

    def __contains__(self, number: object) -> bool:
        return number not in self._excluded
