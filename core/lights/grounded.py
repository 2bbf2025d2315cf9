# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects lights by name: GroundingDINO finds "light source" boxes, SAM 2 their masks, through transformers.

The two refinements are the paper's (section "Light Positions"): a mask that is not over-exposed, of mean HSV value
below 190 of 255, is dropped; and of boxes that overlap or contain one another the smallest stays. Optional: needs
transformers, and the weights in a local folder or in the hub's cache. Nothing is downloaded.
"""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import EngineError
from ..images.picture import Picture
from .detection import Detection, Mask, measure_detection

BOX_WEIGHTS, MASK_WEIGHTS = "IDEA-Research/grounding-dino-base", "facebook/sam2.1-hiera-small"
PROMPT = "light source."
"""GroundingDINO expects lower case and a full stop."""
MIN_MASK_LEVEL = 190 / 255
"""Mean HSV value below which a mask is no light."""
IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MAX_OVERLAP = 0.5
"""Largest intersection of two boxes, as a share of the smaller one; the paper says "high"."""


class GroundedDetector:
    """Detects lights by GroundingDINO and SAM 2.

    boxes, masks: folders or hub names of the weights; threshold: least score of a box. Raises EngineError if
    transformers or weights are missing.
    """

    def __init__(self, threshold: float = 0.35, boxes: str | Path = BOX_WEIGHTS, masks: str | Path = MASK_WEIGHTS,
                 device: str = "auto") -> None:
        """Load both networks. Raises EngineError if transformers is not installed or weights are missing."""
        try:
            import torch
            from transformers import AutoModelForZeroShotObjectDetection, AutoProcessor, Sam2Model, logging
        except ImportError as problem:
            raise EngineError("The grounded method needs transformers; install it with: pip install transformers, "
                              "or use the exposure method.") from problem
        logging.set_verbosity_error()
        logging.disable_progress_bar()
        self.threshold = threshold
        self._device = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
        self._box_processor = _load_weights(AutoProcessor, boxes)
        self._box_model = _load_weights(AutoModelForZeroShotObjectDetection, boxes).to(self._device).eval()
        self._mask_model = _load_weights(Sam2Model, masks).to(self._device).eval()

    def detect(self, picture: Picture) -> list[Detection]:
        """Return the lights of a picture, highest score first."""
        boxes, masks, scores = self.predict(picture)
        display = picture.display()
        detections = []
        for i in refine_detections(boxes, masks, display):
            rows, columns = np.flatnonzero(masks[i].any(axis=1)), np.flatnonzero(masks[i].any(axis=0))
            tight = masks[i][rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
            corner = (int(columns[0]), int(rows[0]))
            detections.append(measure_detection(tight, corner, picture, display, float(scores[i])))
        return sorted(detections, key=lambda detection: -detection.score)

    def predict(self, picture: Picture) -> tuple[NDArray[np.float64], list[Mask], NDArray[np.float64]]:
        """Return boxes (n, 4) left top right bottom, a mask (h, w) for each, and scores (n,), before refinement."""
        import torch

        image = (picture.display() * 255 + 0.5).astype(np.uint8)
        height, width = image.shape[:2]
        with torch.inference_mode():
            inputs = self._box_processor(images=image, text=PROMPT, return_tensors="pt").to(self._device)
            # A text threshold of 0: the words that a box matches are not used.
            output = self._box_processor.post_process_grounded_object_detection(
                self._box_model(**inputs), inputs["input_ids"], threshold=self.threshold, text_threshold=0.0,
                target_sizes=[(height, width)])[0]
            boxes = output["boxes"].cpu().double().numpy().reshape(-1, 4)
            scores = output["scores"].cpu().double().numpy()
            if not len(boxes):
                return boxes, [], scores
            return boxes, self._predict_masks(image, boxes), scores

    def _predict_masks(self, image: NDArray[np.uint8], boxes: NDArray[np.float64]) -> list[Mask]:
        """Return SAM 2's mask (h, w) for each box.

        The network's input is the picture, scaled to a square and normalised by ImageNet's statistics. The processor of
        transformers does the same, but needs torchvision. boxes: (n, 4) left top right bottom.
        """
        import torch
        from torch.nn.functional import interpolate

        height, width = image.shape[:2]
        side = int(self._mask_model.config.prompt_encoder_config.image_size)
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        pixels = interpolate(pixels, (side, side), mode="bilinear", antialias=True)
        mean, deviation = (torch.tensor(values).view(1, 3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_DEVIATION))
        pixels = (pixels - mean) / deviation
        scaled = torch.from_numpy(boxes * (side / width, side / height, side / width, side / height)).float()
        output = self._mask_model(pixel_values=pixels.to(self._device), input_boxes=scaled[None].to(self._device),
                                  multimask_output=False)
        resized = interpolate(output.pred_masks[0].cpu().float(), (height, width), mode="bilinear")
        return [np.asarray(mask[0] > 0) for mask in resized.numpy()]


def _load_weights(kind: Any, source: str | Path) -> Any:
    try:
        return kind.from_pretrained(str(source), local_files_only=True)
    except (OSError, ValueError) as problem:
        raise EngineError(f"The weights {source} are neither a folder nor in the hub's cache; fetch them with: "
                          f"huggingface-cli download {source}, or use the exposure method.") from problem


def refine_detections(boxes: NDArray[np.float64], masks: Sequence[Mask], display: NDArray[np.float32]) -> list[int]:
    """Return the indices of the detections that pass both of the paper's refinements, smallest box first.

    boxes (n, 4) left top right bottom; masks n x (h, w); display (h, w, 3) in 0..1.
    """
    value = display.max(axis=2)
    bright = [i for i, mask in enumerate(masks) if mask.any() and float(value[mask].mean()) >= MIN_MASK_LEVEL]
    return keep_smallest(boxes, bright)


def keep_smallest(boxes: NDArray[np.float64], among: Sequence[int]) -> list[int]:
    """Return those of the boxes `among` (indices) that neither contain nor largely overlap a smaller one."""
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    smallest_boxes: list[int] = []
    for i in sorted(among, key=lambda i: (area[i], i)):
        if not any(_intersection_area(boxes[i], boxes[j]) > MAX_OVERLAP * max(area[j], 1e-9) for j in smallest_boxes):
            smallest_boxes.append(i)
    return smallest_boxes


def _intersection_area(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the area of the intersection of two boxes."""
    width, height = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    return float(max(width, 0.0) * max(height, 0.0))
