# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes the files of a sample capture: scene-linear layers as small EXR, display frames with a sensor's noise."""
from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.colour.srgb import srgb_from_linear
from core.system.files import atomic_path

Pixels = NDArray[np.float32]

FRAME_SUFFIX = ".jpg"
JPEG_QUALITY = 96
SCENE_LEVEL, FLARE_LEVEL = 120.0, 60.0
"""DWA compression levels of the layers: about 48 and 58 dB in display space against the rendered picture."""

READ_NOISE = 0.0006
"""Standard deviation of a pixel in the dark, of full scale, linear."""
SHOT_NOISE = 0.0025
"""Standard deviation at full scale, linear; grows with the root of the light."""


def write_layer(path: Path, pixels: Pixels, level: float) -> None:
    """Write pixels (h, w, 3) as half-float R G B, DWAB at `level` (45 is OpenEXR's default; more is smaller)."""
    import OpenEXR

    header: dict[str, object] = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.DWAB_COMPRESSION,
                                 "dwaCompressionLevel": float(level)}
    channels = {name: np.ascontiguousarray(pixels[..., index], np.float16) for index, name in enumerate("RGB")}
    with atomic_path(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def expose(linear: Pixels, rng: np.random.Generator) -> Pixels:
    """Return display values 0..1 of a sensor that adds read and shot noise, clips, and encodes as sRGB."""
    light = np.clip(linear, 0.0, 1.0)
    deviation = np.sqrt(READ_NOISE**2 + SHOT_NOISE**2 * light)
    noisy = linear + deviation * rng.standard_normal(linear.shape, np.float32)
    return srgb_from_linear(np.clip(noisy, 0.0, 1.0))


def write_frame(path: Path, linear: Pixels, seed: tuple[int, ...]) -> None:
    """Expose linear light and write it as a JPEG without chroma subsampling; the noise depends on `seed` alone."""
    import cv2

    stored = np.round(expose(linear, np.random.default_rng(seed)) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1,
               cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    data = cv2.imencode(FRAME_SUFFIX, stored[..., ::-1], options)[1]
    with atomic_path(path) as temporary:
        data.tofile(temporary)
