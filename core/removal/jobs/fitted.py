# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes from a capture's frames the flare that a fit has separated.

A fit knows a flare from all views together, which is more than any single frame shows. Its flare is subtracted from the
frame in linear light, scaled for each light by how much of it the frame shows. Where the frame is clipped, nothing is
left of what lay under the flare; the fitted scene is used there, as far as it is brighter. The light discs stay as
filmed; if the fit was given light above white, the scene is used there too, so that a light keeps its own brightness.
"""
from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...capture import Camera, Capture, View
from ...capture.discs import light_disc_mask
from ...capture.renderer import ViewRenderer
from ...colour.srgb import Pixels, linear_from_srgb, srgb_from_linear
from ...errors import CaptureError, FrameError
from ...images.exr import read_data_window
from ...images.plates import Plate, clean_name, finite_light, read_plate, write_results
from ...images.views import split_views
from ...images.window import DataWindow
from ...system.files import check_no_overwrite, safe_join
from ...system.least_squares import robust_bounded_fit
from ...system.progress import Progress
from ..inference.plate_light import CLIPPING_LEVEL
from .clean_frames import CleanFrame, PreparedResults, write_clean_frames
from .manifest import Manifest, digest_inputs

MAX_SAMPLES = 100_000
"""Approximate number of a frame's pixels by which the gains of the flares are estimated."""
DIM_FLARE = 0.5
"""Gain of a light's flare below which the frame is reported."""
MAX_SCENE_GAIN = 1.25
"""Largest factor by which a frame's scene may be brighter or darker than it was fitted: what `core.fit.metering`
leaves."""
PRIOR_WEIGHT = 1e-4
"""Weight per pixel of the prior that every gain is 1; it outweighs the frame for flares of a thousandth of white."""


class _FittedFlareCleaner:
    """Subtracts the fitted flare from one frame after the other, for `write_clean_frames`.

    The arguments are those of `remove_fitted_flare`. views_by_name: the views, by the name of their clean frame.
    """

    def __init__(self, renderer: ViewRenderer, capture: Capture, views_by_name: Mapping[Path, View],
                 progress: Progress, fit_digest: str, *, above_white: bool) -> None:
        self._renderer, self._capture, self._views_by_name = renderer, capture, views_by_name
        self._progress, self._fit_digest, self._above_white = progress, fit_digest, above_white
        self._light_numbers = [tuple(light.numbers) for light in capture.lights]
        self.dim_counts = Counter[str]()
        """Number of written frames in which a light's flare has a gain below DIM_FLARE, by the light's name."""

    def digest(self, frame: CleanFrame) -> str:
        """Hash the fit, the lights, and the frame with its camera."""
        camera = self._views_by_name[frame.name].camera
        return digest_inputs(repr((self._fit_digest, camera.numbers, self._light_numbers)), [frame.source])

    def clean(self, frame: CleanFrame) -> PreparedResults:
        """Subtract the flare from a frame, and prepare its results."""
        clean_view = _clean_view(self._renderer, self._capture, self._views_by_name[frame.name], self._above_white)
        return PreparedResults(lambda: self._write(frame, clean_view))

    def _write(self, frame: CleanFrame, clean_view: _CleanView) -> None:
        """Write the results, and count the lights whose flare is dim."""
        write_results(frame.results, clean_view.plate, clean_view.codes, clean_view.flare)
        if clean_view.plate.warning:
            self._progress.say(clean_view.plate.warning)
        self.dim_counts.update(light for light, gain in clean_view.gains.items() if gain < DIM_FLARE)


def remove_fitted_flare(renderer: ViewRenderer, capture: Capture, views: Sequence[View], folder: Path,
                        progress: Progress, *, flare_folder: Path | None = None, overwrite: bool = False,
                        fit_digest: str = "", above_white: bool = False) -> dict[str, Any]:
    """Write the views' frames without the fitted flare below `folder`, and return the counts.

    Each frame keeps its name, file format and depth. A result is kept if it was made from the same frame, camera,
    lights and fit, or edited since; with `overwrite` none is kept. flare_folder: where to write the removed flares, if
    at all. fit_digest: a text that changes whenever the fit would render other layers. above_white: the fit was given
    light above white.

    Raises CaptureError for frames with lens distortion, since the flare was fitted to undistorted ones; SettingsError
    where frames would be overwritten; FrameError for a frame that cannot be read, and for a file in `folder` that is
    not listed in its manifest.
    """
    if any(view.lens for view in views):
        raise CaptureError(f"The frames of {capture.folder} are distorted by their lens, and the flare was fitted "
                           "without that; undistort them first (for instance with COLMAP's image_undistorter).")
    views_by_name = {Path(view.name): view for view in views}
    frames = [CleanFrame(name, capture.frame_path(view), _result_paths(view, folder, flare_folder))
              for name, view in views_by_name.items()]
    check_no_overwrite([frame.source for frame in frames],
                       itertools.chain.from_iterable(frame.results for frame in frames))
    progress.stage("remove", len(views))
    manifest = Manifest(folder)
    cleaner = _FittedFlareCleaner(renderer, capture, views_by_name, progress, fit_digest, above_white=above_white)
    written, kept_counts = write_clean_frames(frames, manifest, progress, digest=cleaner.digest,
                                              clean=cleaner.clean, keep_finished=not overwrite, overwrite=overwrite)
    for light, count in cleaner.dim_counts.items():
        progress.say(f"{count} of {written} frames show less than half of the flare that {light!r} has in the fit; no "
                     "more than they show was removed.")
    manifest.report_kept(kept_counts, progress)
    progress.say(f"{len(views)} clean frames are in {folder}.")
    return {"plates": str(folder), "made": written, "kept": kept_counts.total()}


def _result_paths(view: View, folder: Path, flare_folder: Path | None) -> list[Path]:
    """Return the path of the clean frame, then that of its flare where one is requested."""
    plate = safe_join(folder, str(clean_name(Path(view.name))), CaptureError)
    if flare_folder is None:
        return [plate]
    return [plate, safe_join(flare_folder, str(Path(view.name).with_suffix(".exr")), CaptureError)]


class _CleanView(NamedTuple):
    """A clean frame before it is written.

    plate: the frame as its file stores it. codes: codes of the clean frame. flare: the removed flare, linear light
    (height, width, 3). gains: gain of each light's flare in the frame, 0..1, by the light's name.
    """

    plate: Plate
    codes: NDArray[Any]
    flare: Pixels
    gains: dict[str, float]


def _clean_view(renderer: ViewRenderer, capture: Capture, view: View, above_white: bool) -> _CleanView:
    """Subtract the fitted flare from a view's plate.

    above_white: whether the fit had light above white; then the scene fills the discs of lights. Raises FrameError for
    a plate that the fit's cameras do not match: turned by Exif, or with several views.
    """
    if view.upright:
        raise FrameError(f"{capture.frame_path(view)} was solved as viewers show it, and its pixels are stored turned; "
                         "turn the pixels, remove its Exif orientation, and fit again.")
    stored = read_plate(capture.frame_path(view), capture.plate_space)
    if len(views := split_views(stored)) > 1:
        names = " and ".join(name for name, _ in views)
        raise FrameError(f"{stored.path} holds the views {names}, and the fit has the "
                         "cameras of one; export each view as a file of its own.")
    # A plate in Rec. 709 or linear light is changed directly. Any other is cleaned as Rec. 709, and what was removed
    # there is subtracted from it.
    is_direct = stored.is_rec709 or (stored.encoding == "linear" and stored.space.is_linear)
    plate = stored if is_direct else stored.in_rec709
    height, width = plate.codes.shape[:2]
    camera = _stored_pixels_camera(view.camera, read_data_window(capture.frame_path(view)))
    layers = renderer.render(camera)
    scene = _to_plate_light(plate, layers.scene)
    flares = {light: _to_plate_light(plate, pixels) for light, pixels in layers.flare_by_light.items()}
    gains = _fit_flare_gains(plate, scene, flares)
    flare = np.zeros((height, width, 3), np.float32)
    fitted_part = plate.picture_area.slices  # the borders were not fitted, and stay
    for light, light_flare in flares.items():
        flare[fitted_part] += np.float32(gains[light]) * light_flare[fitted_part]
    light_discs = light_disc_mask(_display_values(plate), camera,
                                  [capture.light_state(light, view).xyz for light in capture.lights])
    if above_white and plate.encoding == "linear":  # the scene knows the lights' own brightness
        codes = subtract_fitted_flare(plate, flare, scene, light_discs)
    else:
        flare[light_discs] = 0
        codes = subtract_fitted_flare(plate, flare, scene)
    if is_direct:
        return _CleanView(stored, codes, flare, gains)
    clean = replace(plate, codes=codes)
    return _CleanView(stored, stored.without_light(_linear_light(plate) - _linear_light(clean)), flare, gains)


def _stored_pixels_camera(camera: Camera, window: DataWindow) -> Camera:
    """Return the camera of a frame's stored pixels: an EXR may have overscan or be cropped."""
    camera = camera if camera.size == window.frame else camera.scaled(*window.frame)
    return camera if window.is_frame else camera.cropped(*window.origin, *window.size)


def _to_plate_light(plate: Plate, light: Pixels) -> Pixels:
    """Return a fit's light (height, width, 3), linear Rec. 709, in the plate's primaries and channels."""
    return plate.to_plate_channels(plate.space.from_linear(light) if plate.encoding == "linear" else light)


def _fit_flare_gains(plate: Plate, scene: Pixels, flares: Mapping[str, Pixels]) -> dict[str, float]:
    """Return the gain of each light's flare in the frame, 0..1, by the light's name.

    Fits frame = scene gain * scene + sum of gain * flare by least absolute errors, without clipped pixels. A light that
    is off in the frame, or hidden by something that the fit does not know, gets a small gain, so that no dark flare is
    left. The scene's gain, within MAX_SCENE_GAIN, keeps an underexposed frame from seeming to lack flare.
    """
    if not flares:
        return {}
    area = plate.picture_area.slices
    stride = max(round(math.sqrt(math.prod(plate.codes.shape[:2]) / MAX_SAMPLES)), 1)
    observed, *layers = (pixels[area][::stride, ::stride] for pixels in (_linear_light(plate), scene, *flares.values()))
    # Linear plates do not clip.
    clipping_light = linear_from_srgb(np.array(CLIPPING_LEVEL)) if plate.encoding == "srgb" else np.inf
    unclipped = (observed < clipping_light).all(-1)
    unclipped_light = observed[unclipped].ravel().astype(np.float64)
    columns = np.stack([pixels[unclipped].ravel() for pixels in layers], 1).astype(np.float64)
    # Bounds of the scene's gain, then of each flare's.
    min_gains, max_gains = np.array([[1 / MAX_SCENE_GAIN, MAX_SCENE_GAIN], *len(flares) * [[0.0, 1.0]]]).T
    # The prior alone decides where the whole plate is clipped.
    gains = robust_bounded_fit(columns, unclipped_light, np.ones(len(layers)), min_gains, max_gains, PRIOR_WEIGHT)
    return dict(zip(flares, gains[1:].tolist(), strict=True))


def _linear_light(plate: Plate) -> Pixels:
    """Return the linear light of the codes, by sRGB's curve as in the layers of a fit (the removal network uses a gamma
    instead, `image_formation.GAMMA`)."""
    if plate.encoding == "srgb":
        return linear_from_srgb(_display_values(plate))
    return finite_light(plate.codes)


def _display_values(plate: Plate) -> Pixels:
    """Return display values of the codes, 0..1."""
    if plate.encoding == "srgb":
        return plate.values
    return srgb_from_linear(np.clip(np.nan_to_num(plate.codes.astype(np.float32)), 0, 1))


def subtract_fitted_flare(plate: Plate, flare: Pixels, scene: Pixels,
                          scene_mask: NDArray[np.bool_] | None = None) -> NDArray[Any]:
    """Return the plate's codes (height, width, 3) minus a flare; unchanged to the last bit where the flare is zero or
    the codes are not finite.

    flare, scene: linear light (height, width, 3). The scene replaces the result where the plate is clipped and where
    `scene_mask` (height, width) is set, as far as it is brighter than the result, and no brighter than the plate.
    """
    light = _linear_light(plate)
    filled_mask = np.zeros((*light.shape[:2], 1), bool)
    if plate.encoding == "srgb":
        filled_mask = _display_values(plate).max(-1, keepdims=True) >= CLIPPING_LEVEL
    if scene_mask is not None:
        filled_mask = filled_mask | scene_mask[..., None]
    difference = light - flare
    filled_light = np.maximum(difference, np.minimum(scene, light))
    # Light becomes no less than 0, but negative light of the plate (colours outside its gamut) stays.
    difference = np.maximum(np.where(filled_mask, filled_light, difference), np.minimum(light, 0))
    if plate.encoding == "srgb":
        codes = (srgb_from_linear(difference) * np.float32(plate.max_code) + np.float32(0.5)).astype(plate.codes.dtype)
    else:
        codes = difference.astype(plate.codes.dtype)
    return np.where((flare != 0) & np.isfinite(plate.codes.astype(np.float32)), codes, plate.codes)
