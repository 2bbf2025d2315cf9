# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene alone (`fit --mode 3dgs`) against gsplat's training, on the same capture, frames and iterations.

    python benchmarks/scene_quality.py CAPTURE [--iterations 1500] [--size 480] [--scaled] [--out FOLDER]

gsplat's rasterizer needs a GPU. So its training runs here over our rasterizer, which draws the same pictures: gsplat's
own `DefaultStrategy`, with the settings of its `examples/simple_trainer.py` (initial Gaussians, learning rates, losses,
degrees of the harmonics). Both are scored on the held-out views at the size of the fit.

gsplat trains for 30,000 iterations; a shorter training ends within its densification. With `--scaled` every schedule is
scaled to the iterations, as its `steps_scaler` does; it then densifies so often that the Gaussians become many. Cameras
are not normalised: positions and scales are relative to gsplat's `scene_scale` in this world.
"""
from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from core.capture import Camera, Capture
from core.conventions.run_files import EVALUATION
from core.errors import RunError
from core.fit.frames import Frames
from core.fit.run import Run
from core.gaussians import Rendering, rasterization
from core.gaussians.loss import l1_ssim
from core.gaussians.scene import SceneGaussians
from core.metrics.pictures import psnr
from core.system.files import read_json

# Settings of gsplat's simple_trainer.py and of its DefaultStrategy.
FULL_ITERATIONS, SH_INTERVAL, SH_DEGREE = 30_000, 1000, 3
SSIM_SHARE, NEAR = 0.2, 0.01
RATES = {"means": 1.6e-4, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
FINAL_MEANS_RATE = 0.01
"""Factor of the positions' rate at the end; it falls exponentially."""
REFINE_START, REFINE_STOP, REFINE_EVERY, RESET_EVERY = 500, 15_000, 100, 3000
SCENE_SCALE_FACTOR = 1.1


class GsplatTraining:
    """gsplat's training of a scene, one view per `step`."""

    def __init__(self, capture: Capture, width: int, iterations: int, *, scaled: bool = False, seed: int = 0) -> None:
        from gsplat.strategy import DefaultStrategy

        torch.manual_seed(seed)
        self.frames = Frames(capture, width, frames_only=True)
        self.views, self.held_out = capture.split(None)
        self.iteration, self.order = 0, list[int]()
        factor = iterations / FULL_ITERATIONS if scaled else 1.0
        self.sh_interval = max(int(SH_INTERVAL * factor), 1)
        positions = np.array([view.camera.position for view in capture.views])
        scene_scale = SCENE_SCALE_FACTOR * float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
        self.parameters = torch.nn.ParameterDict(self._initial_gaussians(capture))
        self.optimisers = {
            name: torch.optim.Adam([{"params": self.parameters[name], "name": name,
                                     "lr": rate * (scene_scale if name == "means" else 1)}], eps=1e-15)
            for name, rate in RATES.items()}
        self.schedule = torch.optim.lr_scheduler.ExponentialLR(self.optimisers["means"],
                                                               FINAL_MEANS_RATE ** (1 / (FULL_ITERATIONS * factor)))
        self.strategy = DefaultStrategy(
            refine_start_iter=int(REFINE_START * factor), refine_stop_iter=int(REFINE_STOP * factor),
            refine_every=max(int(REFINE_EVERY * factor), 1), reset_every=max(int(RESET_EVERY * factor), 1))
        self.state: dict[str, Any] = self.strategy.initialize_state(scene_scale=scene_scale)

    @staticmethod
    def _initial_gaussians(capture: Capture) -> dict[str, torch.nn.Parameter]:
        """Return the first Gaussians by gsplat's names of their parameters. Ours are the same but for the rotations,
        which do not matter yet, since the Gaussians are round."""
        scene = SceneGaussians.from_points(capture.points)
        sh = scene.sh.detach()
        rows = {"means": scene.means, "scales": scene.log_scales, "quats": scene.quaternions,
                "opacities": scene.opacity_logits, "sh0": sh[:, :1], "shN": sh[:, 1:]}
        return {name: torch.nn.Parameter(values.detach().clone()) for name, values in rows.items()}

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.parameters["means"])

    def render(self, camera: Camera, sh_degree: int = SH_DEGREE) -> Rendering:
        """Render the scene in display values."""
        rows = self.parameters
        return rasterization(rows["means"], rows["quats"], rows["scales"], rows["opacities"],
                             torch.cat([rows["sh0"], rows["shN"]], 1),
                             torch.from_numpy(camera.world_to_camera).float(),
                             torch.from_numpy(camera.intrinsics).float(), camera.width, camera.height,
                             sh_degree=sh_degree, near=NEAR, depth=False, raw=True)

    def step(self) -> None:
        """Make one iteration on the next view of a random order."""
        if not self.order:
            self.order = torch.randperm(len(self.views)).tolist()
        targets = self.frames.targets(self.views[self.order.pop()])
        camera = targets.camera
        rendering = self.render(camera, min(self.iteration // self.sh_interval, SH_DEGREE))
        loss = l1_ssim(rendering.colour, targets.frame, 1 - SSIM_SHARE)
        loss.backward()
        # What gsplat's rasterizer reports of one camera; its strategy reads the gradient by the projected centres.
        centres = rendering.centres[None].clone()
        centres.grad = rendering.centre_gradients[None]
        info = {"width": camera.width, "height": camera.height, "n_cameras": 1, "gaussian_ids": None,
                "radii": rendering.radii[None, :, None].expand(-1, -1, 2), "means2d": centres}
        for optimiser in self.optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        self.schedule.step()
        self.strategy.step_post_backward(self.parameters, self.optimisers, self.state, self.iteration, info)
        self.iteration += 1

    @torch.no_grad()
    def score(self) -> float:
        """Return the mean PSNR of the held-out views, dB, in display values."""
        scores = []
        for view in self.held_out:
            targets = self.frames.targets(view)
            scores.append(psnr(self.render(targets.camera).colour.clamp(0, 1).numpy(), targets.frame.numpy()))
        return statistics.mean(scores)


def train_gsplat(capture: Path, size: int, iterations: int, *, scaled: bool) -> tuple[float, int]:
    """Run gsplat's training; return the mean PSNR of the held-out views, dB, and the number of Gaussians."""
    training = GsplatTraining(Capture.open(capture), size, iterations, scaled=scaled)
    for iteration in range(iterations):
        training.step()
        if iteration % 200 == 0:
            print(f"gsplat's training: {iteration}/{iterations}, {training.count} Gaussians", flush=True)
    return training.score(), training.count


def fit_scene(capture: Path, size: int, iterations: int, out: Path) -> tuple[float, int]:
    """Fit the scene alone by the commands; return the mean PSNR of the held-out views, dB, and the number of Gaussians.
    Raises CalledProcessError."""
    program = report.ROOT / "headless" / "run.py"
    subprocess.run([sys.executable, program, "fit", capture, "--out", out, "--mode", "3dgs", "--preset", "standard",
                    "--size", str(size), "--iterations", str(iterations)], check=True, stdout=subprocess.DEVNULL)
    subprocess.run([sys.executable, program, "eval", out], check=True, stdout=subprocess.DEVNULL)
    scene = Run.open(out).scene
    assert isinstance(scene, SceneGaussians)
    return float(read_json(out / EVALUATION, RunError)["composite"]["psnr"]), len(scene)


def main() -> None:
    """Train both scenes in turn, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--size", type=int, default=480, help="longer side of the pictures, px")
    parser.add_argument("--scaled", action="store_true", help="scale gsplat's schedules to the iterations")
    parser.add_argument("--out", type=Path, help="folder of the run (default: a temporary one)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        rows = [("fit --mode 3dgs", *fit_scene(args.capture, args.size, args.iterations,
                                               args.out or Path(temporary) / "run")),
                ("gsplat's training", *train_gsplat(args.capture, args.size, args.iterations, scaled=args.scaled))]
    print(report.conditions())
    print(report.table(("scene", "PSNR of held-out views, dB", "Gaussians"),
                       [[name, f"{psnr:.2f}", f"{count:,}"] for name, psnr, count in rows]))


if __name__ == "__main__":
    main()
