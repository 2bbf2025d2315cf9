# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes flares from plates with the removal network.

A plate goes through these steps, in this order; `neighbours.ShotPredictor` runs the first four for a frame of a shot,
`remover.Remover` all but the third for a single plate.

1. Prepare: `remover.Remover.to_network_input` scales the plate to display values at the working size.
2. Predict: `test_time_augmentation` runs the network on scaled and rotated copies and merges the predictions.
3. Filter in time: `temporal` corrects the prediction with those of neighbouring frames, aligned by `optical_flow`.
4. Confidence: `confidence` weighs whether the prediction is a flare at all.
5. Keep lights: `light_discs` leaves the light discs, and part of the glow about them at night, in the frame.
6. Correct streaks, where step 3 has not corrected the prediction: `streaks` clamps predicted streaks to what the
   frame shows along them.
7. Upsample: `guided_filter` brings the flare to the plate's size.
8. Subtract: `plate_light` takes it from the plate's codes in linear light.

`jobs` calls them for folders and captures and writes the results. `diffusion` is another model behind the same steps.
"""
