# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of videos: from the planes of a decoded frame to display values or scene-linear light, and back.

`video.py` converts decoded frames with it, `video_writer.py` cleaned ones. Colour tags are the code points of ITU-T
H.273. A video of standard range comes out as the display values that players show. PQ and HLG (ITU-R BT.2100) become
scene-linear Rec. 709 light in which `REFERENCE_WHITE_NITS` are 1.

The matrix is applied here, because swscale's fast conversions of subsampled frames are up to three codes off and its 16
bit white is 65280; with its exact flags it takes longer than the decoder.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..colour.spaces import P3_D65, REC_709, REC_2020, Chromaticities, matrix_between
from ..colour.srgb import linear_from_srgb, srgb_from_linear

LIMITED_RANGE, FULL_RANGE = 1, 2
"""FFmpeg's numbers of the ranges of codes; 0 is unspecified."""
REFERENCE_WHITE_NITS = 203.0
"""Luminance of diffuse white in high dynamic range, cd/m² (ITU-R BT.2408)."""
PQ_PEAK_NITS, HLG_PEAK_NITS, HLG_GAMMA = 10000.0, 1000.0, 1.2
"""Luminance of the signal 1, and the system gamma of HLG at that peak (ITU-R BT.2100, tables 4 and 5)."""
HLG_HEADROOM = 1.1
"""Largest signal of HLG that is kept: limited range may go to 109 %."""
_REC_2020_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)

Transfer = Literal["display", "linear", "PQ", "HLG"]
TRANSFERS: dict[int, Transfer] = {8: "linear", 16: "PQ", 18: "HLG"}
"""Transfer characteristics that are not shown as display values."""
UNSUPPORTED_TRANSFERS = {9: "logarithmic (100:1)", 10: "logarithmic (316:1)"}
LUMA_WEIGHTS = {1: (0.2126, 0.0722), 4: (0.30, 0.11), 5: (0.299, 0.114), 6: (0.299, 0.114), 7: (0.212, 0.087),
                9: (0.2627, 0.0593)}
"""Weights of red and blue in the luma, by matrix coefficients."""
BT_709, BT_601, BT_2020, BY_PRIMARIES = 1, 6, 9, 12
"""Matrix coefficients: of three standards; those derived from the primaries. 1 and 9 are the primaries of the same."""
RGB, YCGCO, UNSPECIFIED = 0, 8, 2
"""Matrix coefficients: the planes hold G, B, R; luma with green and orange differences; "unspecified", in all three
tags."""
UNSUPPORTED_MATRICES = {10: "BT.2020 of constant luminance", 11: "SMPTE ST 2085", 14: "ICtCp", 15: "IPT-C2",
                        13: "one by primaries, of constant luminance"}
P3_DCI: Chromaticities = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351)
WIDE_PRIMARIES = {BT_2020: REC_2020, 11: P3_DCI, 12: P3_D65}
"""Colour primaries that are converted to Rec. 709. Those of BT.601 are shown as Rec. 709, as players do."""
MIN_709_WIDTH, MAX_601_HEIGHT = 1280, 576
"""A video without a matrix is BT.709 from this long side, or above this short side, px."""


@dataclass(frozen=True)
class VideoColour:
    """The meaning of a video's codes: matrix coefficients, range, transfer, primaries (None for Rec. 709).

    limited: luma from 16 to 235 of 255, instead of all codes. bits: bits of a code.
    """

    matrix: int
    limited: bool
    bits: int
    transfer: Transfer = "display"
    primaries: Chromaticities | None = None

    @property
    def is_light(self) -> bool:
        """Return whether frames come out as scene-linear light rather than display values."""
        return self.transfer != "display"

    @property
    def is_wide(self) -> bool:
        """True for display values of wide primaries, which need more than 8 bits in Rec. 709."""
        return self.primaries is not None and not self.is_light

    def to_signal(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Return the signal R G B (height, width, 3) of planes (height, width, 1 or 3), as uint8 or uint16 codes.

        Code 0 stands for the signal 0, the greatest code for `signal_top`. 8 bit codes stay 8 bit, unless a curve
        follows; others become 16 bit.
        """
        import cv2

        dtype = np.uint8 if self.bits == 8 and not self.is_light and not self.is_wide else np.uint16
        max_code = np.iinfo(dtype).max
        matrix, offset = self._decoding_affine
        if planes.shape[-1] == 1:
            levels = (np.arange(1 << self.bits) - self._black) * matrix[0, 0]  # grey: luma without colour differences
            table = (np.clip(levels / self.signal_top, 0, 1) * max_code + 0.5).astype(dtype)
            return np.asarray(cv2.merge([np.take(table, np.minimum(planes[..., 0], (1 << self.bits) - 1))] * 3))
        if dtype == np.uint8 and self.matrix == RGB:
            return planes.copy()  # `stack_planes` reuses their memory
        affine = np.concatenate([matrix, offset[:, None]], 1) * (max_code / self.signal_top)
        if dtype == np.uint16 and planes.dtype == np.uint8:  # cv2.transform returns the type of its input
            planes = planes.astype(np.uint16)
        return np.asarray(cv2.transform(planes, affine.astype(np.float32)))

    def to_pixels(self, signal: NDArray[Any]) -> NDArray[Any]:
        """Return display values as codes, of 8 or 16 bits, or linear light as float32, from `to_signal`'s result; all
        (height, width, 3)."""
        import cv2

        if not self.is_light and not self.is_wide:
            return signal
        light = np.take(_light_table(self.transfer), signal)
        if self.transfer == "HLG":  # OOTF: scene light times a power of its luminance is display light
            luminance = cv2.transform(light, _REC_2020_LUMINANCE[None])
            light *= np.power(luminance, np.float32(HLG_GAMMA - 1))[..., None]
            light *= np.float32(HLG_PEAK_NITS / REFERENCE_WHITE_NITS)
        if self.primaries is not None:
            matrix = matrix_between(self.primaries, REC_709).astype(np.float32)
            light = np.asarray(cv2.transform(light, matrix))
        if self.is_light:
            return light
        return (np.clip(srgb_from_linear(light), 0, 1) * 65535 + 0.5).astype(np.uint16)

    def from_pixels(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert display values 0..1, or linear light, (height, width, 3) to the signal, 0..1, float32.

        The inverse of `to_pixels`; light below 0 becomes 0.
        """
        import cv2

        if not self.is_light and not self.is_wide:
            return pixels
        light = pixels if self.is_light else linear_from_srgb(pixels)
        if self.primaries is not None:
            light = np.asarray(cv2.transform(light, matrix_between(REC_709, self.primaries).astype(np.float32)))
        light = np.maximum(light, 0)
        if self.transfer == "linear":
            return light
        if self.transfer == "PQ":
            return _pq_from_nits(light * np.float32(REFERENCE_WHITE_NITS))
        if self.transfer == "HLG":
            light = light * np.float32(REFERENCE_WHITE_NITS / HLG_PEAK_NITS)
            luminance = np.maximum(np.asarray(cv2.transform(light, _REC_2020_LUMINANCE[None])), np.float32(1e-12))
            return _hlg_from_light(light * np.power(luminance, np.float32(1 / HLG_GAMMA - 1))[..., None])
        return srgb_from_linear(light)

    def to_plane_differences(self, differences: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert differences of the signal R G B, 0..1, to differences of the planes' codes, Y Cb Cr or R G B; both
        (height, width, 3)."""
        import cv2

        return np.asarray(cv2.transform(differences, np.linalg.inv(self._decoding_affine[0]).astype(np.float32)))

    @property
    def signal_top(self) -> float:
        """The signal that the greatest code of `to_signal` stands for: 1, or HLG_HEADROOM for HLG."""
        return HLG_HEADROOM if self.transfer == "HLG" else 1.0

    @property
    def _black(self) -> int:
        """The code of black in luma and in R G B (ITU-T H.273, 8.3)."""
        return 16 << (self.bits - 8) if self.limited else 0

    @property
    def _decoding_affine(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return matrix (3, 3) and offset (3,): signal R G B = matrix @ codes + offset; codes of RGB planes are R G B.
        """
        # Codes that luma and colour differences span (ITU-T H.273, 8.3).
        step, max_code = float(1 << (self.bits - 8)), float((1 << self.bits) - 1)
        luma, difference = (219 * step, 224 * step) if self.limited else (max_code, max_code)
        if self.matrix == RGB:
            return np.eye(3) / luma, np.full(3, -self._black / luma)
        if self.matrix == YCGCO:
            matrix = np.array([[1.0, -1, 1], [1, 1, 0], [1, -1, -1]])
        else:
            # Y = red R + green G + blue B; Cb = (B - Y) / (2 - 2 blue); Cr = (R - Y) / (2 - 2 red).
            red, blue = LUMA_WEIGHTS[self.matrix]
            green = 1 - red - blue
            matrix = np.array([[1, 0, 2 - 2 * red],
                               [1, -blue * (2 - 2 * blue) / green, -red * (2 - 2 * red) / green],
                               [1, 2 - 2 * blue, 0]])
        matrix = matrix / [luma, difference, difference]
        middle = float(1 << (self.bits - 1))
        return matrix, -matrix @ [self._black, middle, middle]


def usual_matrix(width: int, height: int) -> int:
    """Return the matrix coefficients that players assume for a size."""
    is_high = max(width, height) >= MIN_709_WIDTH or min(width, height) > MAX_601_HEIGHT
    return BT_709 if is_high else BT_601


@lru_cache(maxsize=4)
def _light_table(transfer: Transfer) -> NDArray[np.float32]:
    """Return the light (65536,) of each 16 bit code of `to_signal`. 1 is reference white for PQ, and the scene's peak
    for HLG; display values (of wide primaries) are decoded as sRGB."""
    signal = np.arange(65536, dtype=np.float64) / 65535
    if transfer == "PQ":
        return (_nits_from_pq(signal) / REFERENCE_WHITE_NITS).astype(np.float32)
    if transfer == "HLG":
        return _light_from_hlg(signal * HLG_HEADROOM).astype(np.float32)
    return signal.astype(np.float32) if transfer == "linear" else linear_from_srgb(signal)


# Constants of PQ and HLG: ITU-R BT.2100, tables 4 and 5.
_PQ_M1, _PQ_M2 = 2610 / 16384, 2523 / 4096 * 128
_PQ_C1, _PQ_C2, _PQ_C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
_HLG_A = 0.17883277
_HLG_B, _HLG_C = 1 - 4 * _HLG_A, 0.5 - _HLG_A * float(np.log(4 * _HLG_A))


def _nits_from_pq(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Decode by the EOTF of BT.2100 PQ: signal 0..1 to cd/m²."""
    root = np.power(signal, 1 / _PQ_M2)
    return PQ_PEAK_NITS * np.power(np.maximum(root - _PQ_C1, 0) / (_PQ_C2 - _PQ_C3 * root), 1 / _PQ_M1)


def _pq_from_nits(nits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Invert `_nits_from_pq`."""
    power = np.power(np.clip(nits.astype(np.float64) / PQ_PEAK_NITS, 0, 1), _PQ_M1)
    return np.power((_PQ_C1 + _PQ_C2 * power) / (1 + _PQ_C3 * power), _PQ_M2).astype(np.float32)


def _light_from_hlg(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Decode by the inverse OETF of BT.2100 HLG: signal to scene light, 1 at the signal 1."""
    return np.where(signal <= 0.5, signal ** 2 / 3, (np.exp((signal - _HLG_C) / _HLG_A) + _HLG_B) / 12)


def _hlg_from_light(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Invert `_light_from_hlg`."""
    curve = _HLG_A * np.log(np.maximum(12 * light - _HLG_B, 1e-6)) + _HLG_C
    return np.where(light <= 1 / 12, np.sqrt(3 * light), curve).astype(np.float32)
