# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores a run against its references: composite, scene and flare, by view and on average. The command `eval` calls it.

The flare of a view is |composite - scene| in display space, against |frame - reference scene|, as in the paper. Where
the exact flare is known, `flare_linear` compares the linear layer itself, without the pixels that the camera clipped,
from which nothing can be learned: exact layers tell which they are where the frame's codes no longer do (noise and JPEG
leave a clipped pixel just below white). PSNR flatters faint flares, so each flare score stands beside that of an empty
flare.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..capture import Camera, Capture, View
from ..capture.renderer import ViewRenderer
from ..colour.srgb import srgb_from_linear
from ..images.borders import PictureArea
from ..images.picture import Picture
from ..system.progress import Progress
from .pictures import Perceptual, flip, psnr, relative_l2, ssim

Array = NDArray[np.float32]
Scores = dict[str, float | None]
Reference = Literal["truth", "removed", "none"]

LAYERS = ("composite", "scene", "flare", "flare_linear")
_COMPARED_TO_EMPTY = ("psnr", "empty_psnr", "relative_l2")
"""Scores of a flare that are read beside those of an empty one."""
_CLIP_LEVEL = 254.5 / 255
"""Display value from which a pixel counts as clipped: the last 8-bit code."""


def evaluate(renderer: ViewRenderer, capture: Capture, cameras: Mapping[View, Camera],
             progress: Progress | None = None, area: PictureArea | None = None,
             lpips: Perceptual | None = None) -> dict[str, Any]:
    """Return the content of eval.json: the scores of the given views, each rendered from its camera.

    Scene and flare are scored against truth/ if the capture has it, else against removed/, else not at all. Pixels that
    a view's mask leaves out of the fit are not scored. cameras: the views to score, with the camera to render each.
    area: the area inside the frames' black borders; only this is scored. lpips: the metric; None leaves its score null.
    Raises FrameError for pictures that cannot be read, and Cancelled.
    """
    progress = progress or Progress()
    reference: Reference = "truth" if capture.has_truth else "removed" if capture.has_clean_frames else "none"
    progress.stage("eval", len(cameras))
    scored, masked = [], dict[str, float]()
    for view, camera in cameras.items():
        rendering = renderer.render(camera)
        composite = sum(rendering.flare_by_light.values(), rendering.scene)
        area_slices = (slice(None), slice(None)) if area is None else area.slices
        read_scene = {"truth": capture.truth_scene, "removed": capture.clean_frame}.get(reference, _no_picture)
        read_flare = capture.truth_flare if reference == "truth" else _no_picture
        scene_reference, flare_truth = (  # None where the capture has none
            None if picture is None else replace(picture, pixels=picture.pixels[area_slices])
            for picture in (read_scene(view, camera.size), read_flare(view, camera.size)))
        filmed = capture.frame(view, camera.size)
        mask = capture.mask(view, camera.size)
        scored_mask = None if mask is None else mask[area_slices]
        scored.append((view.name, score_view(
            composite[area_slices], rendering.scene[area_slices],
            replace(filmed, pixels=filmed.pixels[area_slices]), scene_reference, flare_truth,
            unscored_mask(capture, view, camera.size)[area_slices], lpips, scored_mask)))
        if scored_mask is not None and not scored_mask.all():
            masked[view.name] = round(1 - float(scored_mask.mean()), 4)
        progress.advance()
    size = next(iter(cameras.values())).size if cameras else (0, 0)
    return {**summarise(reference, scored, size), **({"masked": masked} if masked else {})}


def _no_picture(_view: View, _size: tuple[int, int]) -> None:
    return None


def score_view(composite: Array, scene: Array, frame: Picture, scene_reference: Picture | None,
               flare_truth: Picture | None = None, unscored: NDArray[np.bool_] | None = None,
               lpips: Perceptual | None = None, scored_mask: NDArray[np.bool_] | None = None) -> dict[str, Scores]:
    """Return the scores of one view by layer: psnr, ssim, lpips (None without the metric), flip. A flare also has
    `empty_psnr`, the score of an empty flare.

    composite, scene: rendered scene-linear layers (height, width, 3). frame: the picture as filmed. scene_reference,
    flare_truth: references of the same size; None leaves out what needs them. unscored: (height, width), pixels in
    which the linear flare is not scored; None for the clipped ones. scored_mask: (height, width), the pixels to score;
    None for all. In the other pixels the reference replaces the picture, since some scores look at whole windows.
    """
    displayed, clean, filmed = _to_display(composite), _to_display(scene), frame.display()
    scores = {"composite": _score_picture(displayed, filmed, lpips, scored_mask)}
    if scene_reference is not None:
        reference = scene_reference.display()
        flare, flare_reference = displayed_flare(composite, scene), np.abs(filmed - reference)
        scores["scene"] = _score_picture(clean, reference, lpips, scored_mask)
        scores["flare"] = {**_score_picture(flare, flare_reference, lpips, scored_mask),
                           "empty_psnr": psnr(np.zeros_like(flare), flare_reference, scored_mask)}
    if flare_truth is not None:
        truth, layer = flare_truth.linear(), composite - scene
        mask = ~(clipped_mask(frame) if unscored is None else unscored)
        mask = mask if scored_mask is None else mask & scored_mask
        scores["flare_linear"] = {
            "psnr": psnr(layer, truth, mask), "relative_l2": relative_l2(layer, truth, mask),
            "empty_psnr": psnr(np.zeros_like(layer), truth, mask)}
    return scores


def unscored_mask(capture: Capture, view: View, size: tuple[int, int] | None = None) -> NDArray[np.bool_]:
    """Return (height, width), the pixels where the camera clipped, in which the linear flare is not scored.

    A pixel counts as clipped if it has the frame's brightest code or, where the exact layers are known, if scene plus
    flare reach white in any channel. size: (width, height) of the result; None for the camera's.
    """
    frame, scene, flare = capture.frame(view), capture.truth_scene(view), capture.truth_flare(view)
    clipped = clipped_mask(frame)
    if scene is not None and flare is not None and frame.encoding != "linear":
        reaches_white = (scene.linear() + flare.linear() >= 1).any(-1)
        # Layers of another size than the frame are not used.
        clipped = clipped | reaches_white if reaches_white.shape == clipped.shape else clipped
    return _downscale_mask(clipped, frame.size, size)


def clipped_mask(frame: Picture, size: tuple[int, int] | None = None) -> NDArray[np.bool_]:
    """Return (height, width), the pixels that have a frame's brightest code, which hides how bright they were; none in
    a linear frame.

    size: (width, height) of the result; None for the frame's own. A pixel of a smaller result is set if any of the
    frame's pixels that it covers is clipped.
    """
    if frame.encoding == "linear":
        clipped = np.zeros(frame.pixels.shape[:2], np.bool_)
    else:
        clipped = (frame.pixels >= _CLIP_LEVEL).any(-1)
    return _downscale_mask(clipped, frame.size, size)


def _downscale_mask(mask: NDArray[np.bool_], full: tuple[int, int], size: tuple[int, int] | None) -> NDArray[np.bool_]:
    """Return a mask at a smaller size: a pixel is set if any pixel that it covers is."""
    if size is None or size == full:
        return mask
    import cv2

    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32) > 0


def displayed_flare(composite: Array, scene: Array) -> Array:
    """Return |composite - scene| in display values (height, width, 3), the paper's measure of a flare. composite,
    scene: scene-linear layers."""
    return np.abs(_to_display(composite) - _to_display(scene))


def _to_display(linear: Array) -> Array:
    return np.clip(srgb_from_linear(linear), 0, 1)


def _score_picture(image: Array, target: Array, lpips: Perceptual | None,
                   scored_mask: NDArray[np.bool_] | None) -> Scores:
    """Return the scores of `image` against `target`, display values (height, width, 3). scored_mask: (height, width),
    the pixels to score; None for all."""
    if scored_mask is not None:
        image = np.where(scored_mask[..., None], image, target)
    return {"psnr": psnr(image, target, scored_mask), "ssim": ssim(image, target, mask=scored_mask),
            "lpips": lpips(image, target) if lpips else None, "flip": flip(image, target, scored_mask)}


def summarise(reference: Reference, views: Sequence[tuple[str, dict[str, Scores]]],
              size: tuple[int, int]) -> dict[str, Any]:
    """Return the content of eval.json: means over views, then each view. Numbers that are not finite become null.

    views: (name, scores by layer) of each. The means of a flare's PSNR, empty PSNR and relative error are over the
    views whose reference holds a flare: where it is black, an empty flare has an infinite PSNR.
    """
    means = {layer: _mean_scores([scores[layer] for _, scores in views if layer in scores]) for layer in LAYERS}
    return {
        "reference": reference,
        "size": list(size),
        "ssim_borders": "valid",
        **{layer: _null_if_infinite(scores) for layer, scores in means.items() if scores},
        "views": [{"name": name, **{layer: _null_if_infinite(layer_scores) for layer, layer_scores in scores.items()}}
                  for name, scores in views],
    }


def _mean_scores(view_scores: list[Scores]) -> Scores:
    """Return the mean of each score of one layer over its views, without infinite ones; None where no view has one. The
    scores _COMPARED_TO_EMPTY leave out views without a flare."""
    means: Scores = {}
    scores_with_flare = [scores for scores in view_scores if not _has_no_flare(scores)]
    for key in view_scores[0] if view_scores else ():
        values = [value for scores in (scores_with_flare if key in _COMPARED_TO_EMPTY else view_scores)
                  if (value := scores[key]) is not None and math.isfinite(value)]
        means[key] = sum(values) / len(values) if values else None
    return means


def _has_no_flare(scores: Scores) -> bool:
    """Return whether the reference of one view holds no flare: its empty PSNR is infinite, or null as eval.json has
    it."""
    empty = scores.get("empty_psnr", 0.0)
    return empty is None or not math.isfinite(empty)


def _null_if_infinite(scores: Scores) -> Scores:
    return {key: value if value is not None and math.isfinite(value) else None for key, value in scores.items()}


def format_table(scores: dict[str, Any]) -> str:
    """Return the means of eval.json as text, with the view that scored lowest in each layer."""
    count = len(scores["views"])
    reference_text = {"truth": "scene and flare against the exact layers",
                      "removed": "scene and flare against the frames of removed/",
                      "none": "without anything to score scene and flare against"}[scores["reference"]]
    width, height = scores["size"]
    lines = [f"{count} views at {width} x {height}, {reference_text}",
             f"{'':13}{'PSNR':>8}{'empty':>8}{'SSIM':>8}{'LPIPS':>8}{'FLIP':>8}{'rel. L2':>9}  lowest PSNR"]
    for layer in LAYERS:
        if layer not in scores:
            continue
        means = scores[layer]
        cells = [format_cell(means.get(key), decimals) for key, decimals in
                 (("psnr", 2), ("empty_psnr", 2), ("ssim", 4), ("lpips", 4), ("flip", 4))]
        scored_views = [view for view in scores["views"] if view.get(layer, {}).get("psnr") is not None]
        worst = min(scored_views, key=lambda view: view[layer]["psnr"], default=None)
        worst_text = f"{worst[layer]['psnr']:.2f} in {worst['name']}" if worst else "-"
        lines.append(f"{layer:13}{''.join(f'{text:>8}' for text in cells)}"
                     f"{format_cell(means.get('relative_l2'), 3):>9}  {worst_text}")
    if masked := scores.get("masked"):
        share = sum(masked.values()) / len(masked)
        lines.append(f"Masks leave {share:.0%} of the pixels of {len(masked)} views out; these are not scored.")
    for layer in LAYERS:
        without_flare = sum(_has_no_flare(view[layer]) for view in scores["views"] if layer in view)
        if without_flare:
            lines.append(f"{without_flare} of {count} views show no flare to be scored against: PSNR, empty and rel. "
                         f"L2 of {layer} are of the others.")
    return "\n".join(lines)


def is_worse_than_empty(scores: dict[str, Any]) -> bool:
    """Return whether an empty flare would score more, by eval.json."""
    flare = scores.get("flare", {})
    fitted, empty = flare.get("psnr"), flare.get("empty_psnr")
    return fitted is not None and empty is not None and fitted < empty


def format_cell(value: float | None, decimals: int) -> str:
    """Format a number of a table; a dash where there is none."""
    return "-" if value is None else f"{value:.{decimals}f}"
