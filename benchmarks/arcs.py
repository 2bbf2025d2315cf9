# SPDX-License-Identifier: GPL-3.0-or-later
"""Gain of arcs for ghosts that the lens barrel clips: single pictures, fitted with and without arcs.

    python benchmarks/arcs.py --counts 4 16 --seeds 4
"""
from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.report import table
from core.flare.compositing import splat_flare
from core.flare.placement import PlaneGaussians, arcs_of_ellipse, covariance_of_ellipse, opacity_gain

SIZE = 96
INTRINSICS = torch.tensor([[96.0, 0, 48], [0, 96.0, 48], [0, 0, 1]])


def target_pictures() -> dict[str, Tensor]:
    """Return (SIZE, SIZE) pictures of linear light: a ring clipped by a soft edge, a rimmed disc by a hard one."""
    coordinates = torch.arange(SIZE) + 0.5
    x, y = torch.meshgrid(coordinates, coordinates, indexing="xy")

    def ring(radius: float, width: float) -> Tensor:
        return torch.exp(-((torch.hypot(x - 48, y - 48) - radius) ** 2) / (2 * width**2))

    def disc(centre_x: float, centre_y: float, radius: float, softness: float) -> Tensor:
        return torch.sigmoid((radius - torch.hypot(x - centre_x, y - centre_y)) / softness)

    return {"clipped ring": ring(26, 2.5) * disc(70, 48, 34, 4),
            "lune": (0.25 * disc(48, 48, 26, 1) + ring(25, 1.5)) * disc(74, 40, 30, 1.5)}


def fit_psnr(target: Tensor, count: int, arcs: bool, seed: int, iterations: int = 600) -> float:
    """Fit `count` randomly initialised Gaussians to a picture (SIZE, SIZE) of linear light; return the PSNR, dB.

    arcs: fit arcs too.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *ring_shapes: int) -> Tensor:
        return low + (high - low) * torch.rand(ring_shapes, generator=generator)

    rings = torch.zeros(count, 2)
    # Every fourth begins as a ring: radius 3, and width 0.5 as a logarithm.
    rings[::4] = torch.tensor([3.0, math.log(0.5)])
    initial = {
        "means": (uniform(-0.3, 0.3, count, 2), 2e-3),
        "log_scales": (uniform(math.log(0.03), math.log(0.12), count, 1).repeat(1, 2), 2e-2),
        "rotations": (torch.tensor([1.0, 0.0]).repeat(count, 1), 5e-3),
        "opacity_logits": (torch.full((count,), -2.0), 5e-2), "colours": (torch.ones(count, 1), 1e-2),
        "rings": (rings, 2e-2), "arcs": (torch.zeros(count, 2), 2e-2),
    }  # fmt: skip
    parameters = {name: torch.nn.Parameter(values) for name, (values, _) in initial.items()}
    adam = torch.optim.Adam([{"params": [parameters[name]], "lr": rate} for name, (_, rate) in initial.items()])
    # Rates are constant in the first half, then fall to a twentieth.
    schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda i: 0.05 ** max(2 * i / iterations - 1, 0))
    loss = target.new_zeros(())
    for _ in range(iterations):
        ring_shapes = torch.stack([parameters["rings"][:, 0], parameters["rings"][:, 1].clamp(-3, 3).exp()], -1)
        opacities, arc_vectors = parameters["opacity_logits"].sigmoid(), None
        if arcs:
            opacities = opacities * opacity_gain(parameters["arcs"], ring_shapes)
            arc_vectors = arcs_of_ellipse(parameters["arcs"], parameters["log_scales"], parameters["rotations"])
        covariances = covariance_of_ellipse(parameters["log_scales"], parameters["rotations"])
        flare = PlaneGaussians(parameters["means"], covariances, opacities, parameters["colours"].repeat(1, 3),
                               ring_shapes, arc_vectors)
        loss = (splat_flare(flare, INTRINSICS, SIZE, SIZE, "add").colour[..., 0] - target).square().mean()
        adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        schedule.step()
    return -10 * math.log10(float(loss.detach()))


def main() -> None:
    """Fit both pictures with and without arcs, and print a table of the PSNR."""
    parser = argparse.ArgumentParser(description="Gain of arcs for a clipped ghost.")
    parser.add_argument("--counts", nargs="+", type=int, default=[4, 16], help="numbers of Gaussians")
    parser.add_argument("--seeds", type=int, default=4)
    args = parser.parse_args()
    rows = []
    for name, target in target_pictures().items():
        for count in args.counts:
            psnrs = [sum(fit_psnr(target, count, arcs, seed) for seed in range(args.seeds)) / args.seeds
                     for arcs in (False, True)]
            rows.append([name, str(count), *(f"{value:.1f}" for value in psnrs)])
    sys.stdout.write(table(["", "Gaussians", "without arcs, dB", "with arcs, dB"], rows) + "\n")


if __name__ == "__main__":
    main()
