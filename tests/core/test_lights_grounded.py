# SPDX-License-Identifier: GPL-3.0-or-later
"""The text-prompted detector: its refinements on masks made by hand, its whole path on tiny random models."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.images.picture import Picture
from core.lights.grounded import GroundedDetector, keep_smallest, refine_detections


def frame(*boxes: tuple[int, int, int, int], values: tuple[int, ...]) -> tuple[np.ndarray, list, np.ndarray]:
    """Return boxes (n, 4), their masks, and a picture whose boxes have these HSV values (of 255)."""
    display = np.full((100, 120, 3), 0.2, np.float32)
    masks = []
    for (left, top, right, bottom), value in zip(boxes, values, strict=True):
        mask = np.zeros((100, 120), bool)
        mask[top:bottom, left:right] = True
        display[mask] = (value / 255, 0.1, 0.1)
        masks.append(mask)
    return np.array(boxes, np.float64), masks, display


def test_masks_below_190_are_dropped() -> None:
    boxes, masks, display = frame((0, 0, 10, 10), (20, 0, 30, 10), (40, 0, 50, 10), values=(189, 191, 255))
    assert refine_detections(boxes, masks, display) == [1, 2]


def test_the_value_is_the_mean_over_the_mask() -> None:
    boxes, masks, display = frame((0, 0, 20, 10), values=(255,))
    display[:, :9] = 0.3
    assert refine_detections(boxes, masks, display) == []  # 0.45 x 76 + 0.55 x 255 = 175
    display[:, 5:9] = 1.0
    assert refine_detections(boxes, masks, display) == [0]  # 0.25 x 76 + 0.75 x 255 = 210


def test_the_smallest_of_contained_and_overlapping_boxes_stays() -> None:
    boxes = np.array([(0, 0, 60, 60), (10, 10, 20, 20), (12, 12, 24, 22), (70, 70, 90, 90), (80, 60, 100, 80)], float)
    # 0 contains 1; 2 covers 64 of 1's 100 pixels; 3 and 4 share a quarter.
    assert sorted(keep_smallest(boxes, range(5))) == [1, 3, 4]


def test_a_box_around_two_lights_is_dropped_and_both_lights_stay() -> None:
    boxes = np.array([(0, 0, 100, 50), (5, 5, 15, 15), (80, 20, 95, 35)], float)
    assert sorted(keep_smallest(boxes, range(3))) == [1, 2]


def test_a_box_dropped_as_too_dark_displaces_nothing() -> None:
    boxes, masks, display = frame((0, 0, 40, 40), (10, 10, 14, 14), values=(255, 100))
    assert refine_detections(boxes, masks, display) == [0]


def test_an_empty_mask_is_dropped() -> None:
    boxes, masks, display = frame((0, 0, 10, 10), values=(255,))
    masks[0][:] = False
    assert refine_detections(boxes, masks, display) == []


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of a tiny random GroundingDINO and a tiny random SAM 2, as transformers saves them."""
    transformers = pytest.importorskip("transformers")
    import torch

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models")
    vocabulary = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "light", "source", "."]
    tokens = transformers.BertTokenizer(vocab={word: i for i, word in enumerate(vocabulary)})
    pictures = transformers.GroundingDinoImageProcessor(size={"shortest_edge": 96, "longest_edge": 128})
    boxes = transformers.GroundingDinoForObjectDetection(transformers.GroundingDinoConfig(
        backbone_config=transformers.SwinConfig(image_size=96, embed_dim=16, depths=[1, 1, 1, 1],
                                                num_heads=[1, 1, 2, 2], window_size=4,
                                                out_features=["stage2", "stage3", "stage4"]),
        text_config=transformers.BertConfig(vocab_size=len(vocabulary), hidden_size=16, num_hidden_layers=1,
                                            num_attention_heads=2, intermediate_size=16, max_position_embeddings=64),
        num_queries=8, encoder_layers=1, decoder_layers=2, encoder_ffn_dim=16, decoder_ffn_dim=16, d_model=32,
        encoder_attention_heads=2, decoder_attention_heads=2, max_text_len=16))
    boxes.save_pretrained(folder / "boxes")
    transformers.GroundingDinoProcessor(pictures, tokens).save_pretrained(folder / "boxes")
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8, image_size=[128, 128], blocks_per_stage=[1, 2, 2, 1], embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 2, 2], window_size_per_stage=[8, 4, 4, 4], global_attention_blocks=[4],
        window_positional_embedding_background_size=[4, 4])
    masks = transformers.Sam2Model(transformers.Sam2Config(
        vision_config=transformers.Sam2VisionConfig(
            backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], fpn_hidden_size=16,
            backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]]),
        prompt_encoder_config=transformers.Sam2PromptEncoderConfig(hidden_size=16, image_size=128, patch_size=16),
        mask_decoder_config=transformers.Sam2MaskDecoderConfig(
            hidden_size=16, mlp_dim=16, num_hidden_layers=1, num_attention_heads=2, iou_head_hidden_dim=16)))
    masks.save_pretrained(folder / "masks")
    return folder / "boxes", folder / "masks"


def test_lights_are_detected_by_the_weights(models: tuple[Path, Path]) -> None:
    picture = Picture(np.random.default_rng(0).uniform(0.8, 1, (90, 120, 3)).astype(np.float32), "srgb")
    everything = GroundedDetector(0.0, *models)
    boxes, masks, scores = everything.predict(picture)
    assert boxes.shape == (8, 4) and scores.shape == (8,) and ((scores >= 0) & (scores <= 1)).all()
    assert len(masks) == 8 and all(mask.shape == (90, 120) and mask.dtype == bool for mask in masks)
    found = everything.detect(picture)
    assert len(found) == len(refine_detections(boxes, masks, picture.pixels)) > 0
    for one in found:
        assert (one.xy >= 0).all() and (one.xy <= (120, 90)).all()
    assert not GroundedDetector(1.0, *models).detect(picture)
    dark = Picture(picture.pixels * np.float32(0.5), "srgb")
    assert not everything.detect(dark)
