# SPDX-License-Identifier: GPL-3.0-or-later
"""Flare removal of plates of any size and depth.

The network sees the plate at a bounded working size, in several views. The flare that it tells is carried up as it
is, since a flare lies over the scene and knows nothing of its edges. But where the plate is over-exposed, only a part
of the flare is to be seen in it, and that part ends where the clipping does: there it is carried up by a guided filter
(He et al. 2013, in the fast form of He and Sun 2015), flare = a * plate + b, with a and b found at the working size,
smooth, and applied to the plate's own pixels. What was carried up is taken from the plate in linear light. Where the
network tells less than a threshold the flare is exactly zero, and the plate's own codes are kept. Lamps stay too
(`lamps`).
"""
from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...colour.srgb import Pixels, linear_from_srgb
from ...errors import SettingsError
from ...images.picture import Encoding
from ...images.plates import Plate, finite
from ..model import image_formation
from ..model.image_formation import GAMMA, flare_light
from ..model.network import MULTIPLE, RemovalNetwork
from ..model.weights import IN_THE_BOX, load
from . import light_sources
from .test_time_views import Views, believed, told_in_views, trusted, worth_of

WORKING_SIZE = 480
"""Long side of the largest view of a plate: about the most that the network was trained at."""
LEAST = 0.002
"""What a flare adds to display values, below which there is none: half a code of 8 bits."""
SURE = 0.0005
"""Mean over the frame of what a flare adds, below which the network is not trusted at all; from twice as much on
it is trusted whole. It tells small flares where there are none."""
RADIUS, SMOOTHNESS = 1, 1e-3
"""Of the guided filter, at the working size."""
CLIPPED = 0.97
"""Display value from which on a plate is taken for over-exposed."""
ROWS = 256
"""Rows of the plate that are worked on at a time, which bounds the memory."""
COLUMNS = 16384
"""Of them at a time where places are looked up, which OpenCV counts in 16 bits."""
REVISION = 3
"""Raised whenever the same plate, weights and settings come out otherwise, so that what an earlier program has made is
made again."""
Glow = Literal["kept", "kept at lamps", "taken"]
"""What becomes of the glow round lights: it is kept; or of it what lamps at night have with a clean lens too (`lamps`);
or all of it is taken, as a fit wants it, to which it is flare."""


@dataclass(frozen=True)
class FlareMap:
    """A flare at the working size, as what carries it up: flare = gain * display + offset, (h, w, 3) each."""

    gain: Pixels
    offset: Pixels

    @property
    def empty(self) -> bool:
        """Whether there is no flare at all."""
        return not (self.gain.any() or self.offset.any())


class Told(NamedTuple):
    """Of a plate the display values 0..1 that the network was shown (h, w, 3), what a flare adds to them if there is
    one, the part of that, 0..1, which is taken for a flare and not for the scene or its grade, and the part of it, 0..1
    (h, w, 3), which is glow round lights."""

    display: Pixels
    added: Pixels
    worth: np.float32
    glow: Pixels


class Remover:
    """The network of a weights file, ready for plates."""

    sure = SURE
    """`SURE` is the network's own; other models have another."""
    described: str
    """Changes when plates would come out otherwise."""

    def __init__(self, weights: Path | None = None, *, working_size: int = WORKING_SIZE,
                 glow: Glow = "kept at lamps") -> None:
        """Raises RunError, SettingsError."""
        if not 64 <= working_size <= 8192:
            raise SettingsError(f"A working size of {working_size} pixels is outside 64 to 8192.")
        self.network: RemovalNetwork = load(weights or IN_THE_BOX)
        self.working_size, self.glow = working_size, glow
        self.described = described("network", weights or IN_THE_BOX, working_size, glow)

    def remove(self, plate: Plate, matte: Pixels | None = None, told: Told | None = None
               ) -> tuple[NDArray[Any], NDArray[np.float16]]:
        """(codes without flare, in the plate's own type; the flare in linear light (height, width, 3)).

        matte: (height, width), 0..1, where someone has marked a flare: that share of it is taken there, of all that is
        told, since it is known that there is one. told: of the plate, where that is known already
        (`sequences.Sequences`).
        """
        told = told or self.told(self.shown(plate))
        found = _carrier(told.display, self.flare(told, marked=matte is not None))
        codes = plate.codes.copy()
        flare = np.zeros(plate.codes.shape, np.float16)
        if not found.empty:
            filmed, clean, taken = (one[plate.inside.part] for one in (plate.codes, codes, flare))
            for rows, light in carried_up(found, filmed, plate.encoding, plate.top):
                light = plate.shown(light)
                if matte is not None:
                    light *= matte[plate.inside.part][rows, :, None]
                clean[rows] = _less(filmed[rows], light, plate.encoding, plate.top)
                taken[rows] = _taken(filmed[rows], clean[rows], light, plate.encoding, plate.top)
        return codes, flare

    def clean_display(self, display: Pixels) -> Pixels:
        """Display values 0..1 (height, width, 3) without flare, as 16 bit codes would give them."""
        codes = (np.clip(display, 0, 1) * 65535 + 0.5).astype(np.uint16)
        clean = self.remove(Plate(Path("display.png"), codes, "srgb"))[0]
        return np.where(clean == codes, display, clean.astype(np.float32) / 65535)

    def told(self, display: Pixels) -> Told:
        """Of what the network is `shown` of a plate by itself."""
        views = self.views(display)
        return Told(display, believed(views), worth_of([(views, 1.0)]), views.glow)

    def views(self, display: Pixels) -> Views:
        """What the network tells of display values 0..1 (h, w, 3), h and w multiples of MULTIPLE."""
        return told_in_views(display, self._told)

    @torch.inference_mode()
    def _told(self, display: Pixels) -> Pixels:
        """What the network tells of a view (`views.Tell`); glow that is kept as it is is no part of it."""
        told = self.network(torch.from_numpy(np.ascontiguousarray(display.transpose(2, 0, 1)))[None])
        flare, gentle = told.flare[0].clamp(min=0), told.gentle[0].clamp(min=0)
        both = [gentle, torch.zeros_like(gentle)] if self.glow == "kept" else [flare, flare - gentle]
        return np.asarray(torch.cat(both).permute(1, 2, 0).numpy())

    def flare(self, told: Told, *, marked: bool = False) -> Pixels:
        """Linear flare (h, w, 3) of what was told, less what is a lamp's; exactly 0 where there is none.

        marked: someone has seen a flare there, so that whatever was told is one, and all of its glow.
        """
        added = told.added
        if not marked:
            # A ramp from nothing to the whole, so that a faint flare has no rim.
            added = added * np.clip((added - LEAST) / LEAST, 0, 1)
            added = trusted(added, self.sure) * told.worth
        stays = self.glow == "kept at lamps" and not marked
        added = added * (1 - light_sources.given_back(told.display, added, told.glow, glow_stays=stays))
        return np.where(added > 0, flare_light(told.display, added), np.float32(0))

    def shown(self, plate: Plate) -> Pixels:
        """Display values 0..1 of a plate as the network is shown it: what lies inside its black borders, pictures
        alone; reduced, sides multiples of what it takes."""
        import cv2

        codes, encoding, top = plate.codes[plate.inside.part], plate.encoding, plate.top
        height, width = codes.shape[:2]
        scale = self.working_size / max(height, width)
        fit = [int(np.clip(round(side * scale / MULTIPLE), 2, max(self.working_size // MULTIPLE, 2))) * MULTIPLE
               for side in (width, height)]
        # In strips, whose floats would not fit memory all at once; reduced in light, as a lens would.
        grow = fit[0] > width or fit[1] > height
        if grow:
            light = np.clip(_light(codes, encoding, top), 0, 1)
            small = cv2.resize(light, (fit[0], fit[1]), interpolation=cv2.INTER_LINEAR)
        else:
            small = _reduced(codes, encoding, top, fit[0], fit[1])
        return _display(np.asarray(small, np.float32))


def described(model: str, weights: Path | str, *settings: Any) -> str:
    """A short text that changes when plates would come out otherwise: by the weights' content, not their name, and
    by `REVISION`."""
    digest = hashlib.sha256(Path(weights).read_bytes())
    digest.update(repr((REVISION, model, *settings)).encode())
    return digest.hexdigest()[:16]


def _reduced(codes: NDArray[Any], encoding: Encoding, top: float, width: int, height: int) -> Pixels:
    """Clipped linear light by area, (height, width, 3), read in strips of whole working rows."""
    import cv2

    rows = codes.shape[0]
    small = np.zeros((height, width, 3), np.float32)
    step = max(height * ROWS // rows, 1)
    for top_row in range(0, height, step):
        end_row = min(top_row + step, height)
        first, last = top_row * rows // height, max(-(-end_row * rows // height), top_row * rows // height + 1)
        strip = np.clip(_light(codes[first:last], encoding, top), 0, 1)
        small[top_row:end_row] = cv2.resize(strip, (width, end_row - top_row), interpolation=cv2.INTER_AREA)
    return small


def _light(codes: NDArray[Any], encoding: Encoding, top: float) -> Pixels:
    """Linear light as `GAMMA` has it, which is that of the network's layers; a fit's are by sRGB's curve (`fitted`)."""
    if encoding == "srgb":
        if codes.dtype == np.uint8:
            return _TABLE[codes]
        return np.power(codes.astype(np.float32) / np.float32(top), np.float32(GAMMA))
    return finite(codes)


def _display(light: Pixels) -> Pixels:
    """What the network was trained on, for files of either encoding, since the sum of scene and flare is one of light
    as `GAMMA` has it."""
    return image_formation.display(light, GAMMA)


_TABLE = np.power(np.arange(256, dtype=np.float32) / 255, np.float32(GAMMA)).astype(np.float32)


def _carrier(display: Pixels, flare: Pixels) -> FlareMap:
    """The flare itself; about over-exposed places the guided filter's two maps, channel by channel: box means over
    a window, then their own means, those of windows with an edge first."""
    import cv2

    if not flare.any():
        return FlareMap(np.zeros_like(flare), np.zeros_like(flare))
    window = (2 * RADIUS + 1, 2 * RADIUS + 1)

    def mean(values: Pixels) -> Pixels:
        return np.asarray(cv2.blur(values, window, borderType=cv2.BORDER_REFLECT), np.float32)

    reach = (4 * RADIUS + 1, 4 * RADIUS + 1)  # as far as the two means carry what is clipped
    clipped = cv2.dilate((display.max(-1) > CLIPPED).astype(np.uint8), np.ones(reach, np.uint8))
    guided = mean(clipped.astype(np.float32))[..., None]
    mean_i, mean_f = mean(display), mean(flare)
    covariance = mean(display * flare) - mean_i * mean_f
    variance = np.maximum(mean(display * display) - mean_i**2, 0)
    gain = np.clip(covariance / (variance + np.float32(SMOOTHNESS)), -4, 4)
    # Running sums leave crumbs where there is nothing at all.
    anything = cv2.dilate((flare > 0).any(-1).astype(np.uint8), np.ones(window, np.uint8))[..., None]
    offset = mean_f - gain * mean_i
    guided = guided * cv2.dilate(anything, np.ones(window, np.uint8))[..., None]
    # Of the windows about a place those count that hold an edge: what they say fits both of its sides.
    weight = (variance + np.float32(SMOOTHNESS)) * anything
    total = mean(variance + np.float32(SMOOTHNESS))
    gain, offset = mean(gain * weight) / total, mean(offset * weight) / total
    return FlareMap(guided * gain, guided * offset + (1 - guided) * flare)


def carried_up(found: FlareMap, codes: NDArray[Any], encoding: Encoding,
               top: float) -> Iterator[tuple[slice, Pixels]]:
    """(rows, linear flare of those rows (n, width, 3)), from the top of the picture to its bottom."""
    import cv2

    height, width = codes.shape[:2]
    low_height, low_width = found.gain.shape[:2]
    x = ((np.arange(width, dtype=np.float32) + 0.5) * (low_width / width) - 0.5)[None, :]
    for first in range(0, height, ROWS):
        rows = slice(first, min(first + ROWS, height))
        y = ((np.arange(first, rows.stop, dtype=np.float32) + 0.5) * (low_height / height) - 0.5)[:, None]
        low = max(int(y[0, 0]) - 2, 0)
        high = min(int(y[-1, 0]) + 4, low_height)
        at = (np.broadcast_to(x, (len(y), width)), np.broadcast_to(y - low, (len(y), width)))
        gain, offset = (np.concatenate([
            cv2.remap(np.ascontiguousarray(part[low:high]), np.ascontiguousarray(at[0][:, left:left + COLUMNS]),
                      np.ascontiguousarray(at[1][:, left:left + COLUMNS]), cv2.INTER_LINEAR,
                      borderMode=cv2.BORDER_REPLICATE) for left in range(0, width, COLUMNS)], 1)
            for part in (found.gain, found.offset))
        light = _light(codes[rows], encoding, top)
        display = codes[rows].astype(np.float32) / np.float32(top) if encoding == "srgb" else _display(light)
        flare = gain * display + offset
        yield rows, np.minimum(np.maximum(flare, 0), np.maximum(light, 0))


def _less(codes: NDArray[Any], flare: Pixels, encoding: Encoding, top: float) -> NDArray[Any]:
    """The codes with the flare taken from their light; kept as they are where it is zero, or they no numbers."""
    light = _light(codes, encoding, top) - flare
    if encoding == "srgb":
        new = (_display(light) * np.float32(top) + np.float32(0.5)).astype(codes.dtype)
    else:
        new = light.astype(codes.dtype)
    return np.where((flare > 0) & np.isfinite(codes), new, codes)


def _taken(codes: NDArray[Any], less: NDArray[Any], flare: Pixels, encoding: Encoding, top: float) -> Pixels:
    """Scene-linear light between the two: of integer codes by the curve that pictures are shown with."""
    if encoding == "linear":
        return np.minimum(flare, 65504)
    before, after = (linear_from_srgb(part.astype(np.float32) / np.float32(top)) for part in (codes, less))
    return np.where(flare > 0, before - after, 0)
