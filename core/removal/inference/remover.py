# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes the flare from plates of any size and depth: `Remover` is the entry to the removal network.

A plate is predicted at a bounded working size; its flare is upsampled and subtracted from the plate's codes in linear
light. Where the network predicts less than a threshold the flare is exactly 0, and the codes are exactly the plate's.
Light discs stay (`light_discs`). Where no neighbours have corrected the flare, streaks are
corrected by what the frame shows along them (`streaks`). `jobs` runs it
on folders and captures, `evaluation` on test pictures.
"""
from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ...colour import ColourSpace
from ...colour.srgb import Pixels
from ...errors import SettingsError
from ...images.plates import Plate
from ...images.views import split_views
from ...images.write import MAX_HALF
from ...system.reading import read_bytes
from ..model.image_formation import flare_to_linear
from ..model.network import RemovalNetwork
from ..model.weights import load_network
from ..model.weights_file import default_weights
from .confidence import SENSITIVITIES, Sensitivity, gate_by_mean
from .device import select_device
from .framing import (
    fill_hidden,
    input_size,
    merge_margins,
    predict_in_parts,
    wrap_columns,
    wrap_margin,
    wrap_plate,
)
from .guided_filter import GuidedFilterMaps, fit_guided_filter, upsample_flare
from .light_discs import retained_fraction
from .plate_light import (
    downscale_linear,
    removed_light,
    subtract_flare,
    to_display,
    to_linear,
    to_network_plate,
)
from .prediction import FlarePrediction, TtaPrediction
from .streaks import correct_streaks
from .test_time_augmentation import merge_flare, predict_with_tta, shot_confidence

WORKING_SIZE = 480
"""Long side of the network's largest input by default, pixels: about the greatest that it was trained at."""
MIN_FLARE = 0.002
"""What a flare adds to display values, up to which there is none: half a code of 8 bits."""
MIN_MEAN_FLARE = 0.0005
"""Gate (`gate_by_mean`) of the network's predictions, display values: it predicts small flares where there are none."""
REVISION = 6
"""Raised whenever the same plate, weights and settings give another result, so that existing results are made again."""
Glow = Literal["keep", "keep at lights", "remove"]
"""What to do with the glow about lights: keep all of it; keep the part that lights at night have with a clean lens too
(`light_discs`); or remove all of it, as for a fit, which learns it as flare."""
MAX_AMOUNT = 1.5
"""Greatest factor on a removed flare."""
_GLOW_IN_CACHE_KEY = {"keep": "kept", "keep at lights": "kept at lamps", "remove": "taken"}
"""Text of each mode in cache keys. It never changes, so that existing results stay valid."""


class Remover:
    """The network of a weights file, ready for plates."""

    min_mean_flare = MIN_MEAN_FLARE
    """Gate of the model's predictions; another model has another."""
    _model_key: str
    """Text that changes with the model, its weights and its settings."""
    _controls_key: str = ""
    """Text that changes with the choices of `use_controls`; "" for the default ones."""

    def __init__(self, weights: Path | None = None, *, working_size: int = WORKING_SIZE,
                 glow: Glow = "keep at lights") -> None:
        """Load the network. weights: its file; None for `default_weights`. working_size: long side of the network's
        largest input, pixels. glow: what to do with the glow about lights. Raises RunError, SettingsError."""
        if not 64 <= working_size <= 8192:
            raise SettingsError(f"A working size of {working_size} pixels is outside 64 to 8192.")
        weights = weights or default_weights()
        self.network: RemovalNetwork = load_network(weights)
        self.working_size, self.glow = working_size, glow
        self._model_key = compute_cache_key("network", weights, working_size, _GLOW_IN_CACHE_KEY[glow])

    plate_space: ColourSpace | None = None
    """Space of the plates, in place of what their files declare."""
    amount: float = 1.0
    """Factor on the flare that is removed, 0..MAX_AMOUNT."""
    sensitivity: Sensitivity = SENSITIVITIES["normal"]
    """How much evidence the removal of a flare needs."""

    @property
    def cache_key(self) -> str:
        """Text that changes whenever results would."""
        device = "" if self.device.type == "cpu" else self.device.type
        space = "" if self.plate_space is None else self.plate_space.fingerprint
        return " ".join(filter(None, (self._model_key, device, self._controls_key, space)))

    def use_controls(self, amount: float = 1.0, sensitivity: str = "normal") -> None:
        """Set how much of a flare is removed, 0..MAX_AMOUNT, and how much evidence that needs, a key of
        SENSITIVITIES. Changes `cache_key`, so results of other choices are made again. Raises SettingsError."""
        if not 0 <= amount <= MAX_AMOUNT:  # also false for NaN
            raise SettingsError(f"An amount of {amount} is outside 0 to {MAX_AMOUNT}.")
        if sensitivity not in SENSITIVITIES:
            raise SettingsError(f"There is no sensitivity {sensitivity}; choose one of {', '.join(SENSITIVITIES)}.")
        self.amount, self.sensitivity = amount, SENSITIVITIES[sensitivity]
        self._controls_key = "" if (amount, sensitivity) == (1, "normal") else f"{amount:g} {sensitivity}"

    def use_plate_space(self, space: ColourSpace) -> None:
        """Read plates in this space, in place of what their files declare; results of others are made again."""
        self.plate_space = space

    device = torch.device("cpu")
    """Where the network runs."""

    @property
    def _module(self) -> torch.nn.Module:
        """The model that runs on the device."""
        return self.network

    def use_device(self, name: str) -> None:
        """Run the network on a device (`device.DEVICES`); its results differ from the processor's by rounding, and are
        made again. Raises SettingsError where this machine has none of that name."""
        self.device = select_device(name)
        self._module.to(self.device)

    def remove(self, plate: Plate, matte: Pixels | None = None, prediction: FlarePrediction | None = None
               ) -> tuple[NDArray[Any], NDArray[np.float16]]:
        """Return the codes without flare, in the plate's own type, and the flare in linear light (height, width, 3).

        matte: (height, width), 0..1, where an artist has marked a flare: that share of the predicted flare is removed
        there, whatever its confidence. prediction: the prediction for this plate, if there is one already; None to
        predict here.

        If the network can take the plate's own codes, the flare is subtracted from them. If they had to be converted,
        exposed, filled or wrapped for the network, the flare is converted back and subtracted from the plate's light.
        """
        opaque, margin = fill_hidden(plate), wrap_margin(plate)
        network_plate, gain = to_network_plate(opaque)
        wrapped = wrap_plate(network_plate, margin)  # the plate itself where nothing had to be changed
        prediction = prediction or self.predict(self._scale_to_input(wrapped))
        maps = fit_guided_filter(prediction.display, self.linear_flare(prediction, inside_matte=matte is not None))
        codes = wrapped.codes.copy()
        flare = np.zeros(codes.shape, np.float16 if wrapped is plate else np.float32)
        if not maps.is_empty:
            _subtract_upsampled(wrapped, maps, None if matte is None else wrap_columns(matte, margin), codes, flare)
        if wrapped is plate:
            return codes, flare.astype(np.float16)
        light = merge_margins(flare.astype(np.float32), margin) / gain
        alpha = plate.straight_alpha
        if alpha is not None:
            light = np.where(alpha[..., None] > 0, light, 0)  # codes under alpha 0 are arbitrary, and stay
        written_flare = np.minimum(plate.light_in_plate_primaries(light), MAX_HALF)
        if alpha is not None:
            written_flare = written_flare * alpha[..., None]  # as much as shows when the plate is composited
        return plate.without_light(light), written_flare.astype(np.float16)

    def clean_display(self, display: Pixels) -> Pixels:
        """Return display values 0..1 (height, width, 3) without flare, with the precision of 16 bit codes."""
        codes = (np.clip(display, 0, 1) * 65535 + 0.5).astype(np.uint16)
        clean = self.remove(Plate(Path("display.png"), codes, "srgb"))[0]
        return np.where(clean == codes, display, clean.astype(np.float32) / 65535)

    def to_network_input(self, plate: Plate) -> Pixels:
        """Return a plate as the network takes it: display values 0..1 of what lies inside its black borders, scaled to
        the working size, (h, w, 3), h and w multiples of SIZE_MULTIPLE; with the margins of a panorama (`framing`)."""
        return self._scale_to_input(wrap_plate(to_network_plate(fill_hidden(plate))[0], wrap_margin(plate)))

    def _scale_to_input(self, plate: Plate) -> Pixels:
        """Scale a plate of `to_network_plate`, without its black borders, to the network's input (h, w, 3)."""
        import cv2

        codes, encoding, max_code = plate.codes[plate.picture_area.slices], plate.encoding, plate.max_code
        height, width = codes.shape[:2]
        new_width, new_height = input_size(width, height, self.working_size)
        if new_width > width or new_height > height:  # a picture smaller than the working size is enlarged
            light = np.clip(to_linear(codes, encoding, max_code), 0, 1)
            scaled = cv2.resize(light, (new_width, new_height), interpolation=cv2.INTER_LINEAR)
        else:
            scaled = downscale_linear(codes, encoding, max_code, new_width, new_height)
        return to_display(np.asarray(scaled, np.float32))

    def predict(self, display: Pixels) -> FlarePrediction:
        """Predict the flare of a network input by itself, without neighbouring frames."""
        prediction = self.predict_with_tta(display)
        return FlarePrediction(display, merge_flare(prediction),
                               shot_confidence([(prediction, 1.0)], self.sensitivity.log_odds_bias),
                               prediction.glow_fraction)

    def predict_other_views(self, plate: Plate, first: FlarePrediction) -> list[FlarePrediction]:
        """Predict the flares of the views of a stereo plate after the first one; [] for a plate of one view. first: the
        prediction of the first view, so that the streaks of all views are corrected, or none."""
        return [self.predict(self.to_network_input(view))._replace(has_neighbours=first.has_neighbours)
                for _, view in split_views(plate)[1:]]

    def remove_views(self, plate: Plate, predictions: Sequence[FlarePrediction], matte: Pixels | None = None
                     ) -> list[tuple[NDArray[Any], NDArray[np.float16]]]:
        """Return the result of `remove` for each view of a plate, in the order of `split_views`. predictions: of the
        views, in the same order. matte: as in `remove`, for all views."""
        return [self.remove(view, matte, prediction)
                for (_, view), prediction in zip(split_views(plate), predictions, strict=True)]

    def predict_with_tta(self, display: Pixels) -> TtaPrediction:
        """Predict the flare of display values 0..1 (h, w, 3), h and w multiples of SIZE_MULTIPLE."""
        return predict_with_tta(display, lambda picture: predict_in_parts(picture, self._forward))

    @torch.inference_mode()
    def _forward(self, display: Pixels) -> Pixels:
        """Run the network once, in half precision on a GPU: display values (h, w, 3) to (h, w, 6), the flare and the
        part of it that is glow. If all glow is kept, the flare is without glow and the second part is 0."""
        frame = torch.from_numpy(np.ascontiguousarray(display.transpose(2, 0, 1)))[None].to(self.device)
        with torch.autocast(self.device.type, torch.float16, enabled=self.device.type != "cpu"):
            output = self.network(frame)
        flare, without_glow = (part[0].float().clamp(min=0).cpu()
                               for part in (output.flare, output.flare_without_glow))
        parts = ([without_glow, torch.zeros_like(without_glow)] if self.glow == "keep"
                 else [flare, flare - without_glow])
        return np.asarray(torch.cat(parts).permute(1, 2, 0).numpy())

    def linear_flare(self, prediction: FlarePrediction, *, inside_matte: bool = False) -> Pixels:
        """Return the linear flare (h, w, 3) to remove by a prediction; exactly 0 where there is none.

        inside_matte: an artist has marked the flare, so it is removed whatever its confidence, with all of its glow.
        """
        flare = prediction.flare
        if not inside_matte:
            # A ramp from nothing to the whole, so that a faint flare has no visible edge.
            flare = flare * np.clip((flare - MIN_FLARE) / MIN_FLARE, 0, 1)
            flare = gate_by_mean(flare, self.min_mean_flare * self.sensitivity.gate) * prediction.confidence
        keep_glow = self.glow == "keep at lights" and not inside_matte
        flare = flare * (1 - retained_fraction(prediction.display, flare, prediction.glow_fraction,
                                               keep_glow=keep_glow))
        linear = flare_to_linear(prediction.display, flare)
        if not prediction.has_neighbours:  # these show more of what a streak covers than the frame itself
            linear = correct_streaks(prediction.display, linear, 1.0 if inside_matte else float(prediction.confidence))
        return np.where(flare > 0, self.amount * linear, np.float32(0))


def _subtract_upsampled(plate: Plate, maps: GuidedFilterMaps, matte: Pixels | None, codes: NDArray[Any],
                        flare: NDArray[Any]) -> None:
    """Write a plate's codes without flare to `codes`, and the removed light to `flare`, inside its black borders.

    matte: (height, width), 0..1, the share to remove; None for all. codes, flare: (height, width, 3).
    """
    area, encoding, max_code = plate.picture_area.slices, plate.encoding, plate.max_code
    observed, clean, removed = (pixels[area] for pixels in (plate.codes, codes, flare))
    for rows, strip_flare in upsample_flare(maps, observed, encoding, max_code):
        light = plate.to_plate_channels(strip_flare)
        if matte is not None:
            light *= matte[area][rows, :, None]
        clean[rows] = subtract_flare(observed[rows], light, encoding, max_code)
        removed[rows] = removed_light(observed[rows], clean[rows], light, encoding, max_code)


def compute_cache_key(model: str, weights: Path | str, *settings: Any) -> str:
    """Return a short hash of the model, the content of its weights file (not the name), the settings and `REVISION`. It
    changes whenever results would."""
    digest = hashlib.sha256(read_bytes(weights))
    digest.update(repr((REVISION, model, *settings)).encode())
    return digest.hexdigest()[:16]
