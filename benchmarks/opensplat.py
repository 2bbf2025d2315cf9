# SPDX-License-Identifier: GPL-3.0-or-later
"""OpenSplat's CPU rasterizer (C++, one thread), built from a checkout, for comparison with ours.

Only its rasterizer is timed; its inputs (projection, spherical harmonics, depth) are computed beforehand, while our
time includes them. The build goes to a temporary folder and needs a C++ compiler and ninja.
"""
from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from core.conventions.pixel_grid import DILATION
from core.gaussians import projection, rendering

_BINDINGS = """
#include <torch/extension.h>
#include "rasterizer/gsplat-cpu/bindings.h"

struct Lists {
    std::vector<int32_t> *of_pixels;
    ~Lists() { delete[] of_pixels; }
};
using T = torch::Tensor;

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    py::class_<Lists, std::shared_ptr<Lists>>(m, "Lists");
    m.def("forward", [](int width, int height, T xys, T conics, T colours, T opacities, T background, T covs,
                        T depths) {
        auto lists = std::make_shared<Lists>();
        auto [picture, left, pixels] = rasterize_forward_tensor_cpu(
            width, height, xys, conics, colours, opacities, background, covs, depths);
        lists->of_pixels = pixels;
        return std::make_tuple(picture, left, lists);
    });
    m.def("backward", [](int width, int height, T xys, T conics, T colours, T opacities, T background, T covs,
                         T depths, T left, std::shared_ptr<Lists> lists, T d_picture, T d_alpha) {
        return rasterize_backward_tensor_cpu(height, width, xys, conics, colours, opacities, background, covs, depths,
                                             left, lists->of_pixels, d_picture, d_alpha);
    });
}
"""


def build_module(checkout: Path) -> Any:
    """Build the rasterizer as a module with `forward` and `backward`. Raises SystemExit if
    `checkout` is not a checkout of OpenSplat."""
    from torch.utils.cpp_extension import load

    source = checkout / "rasterizer" / "gsplat-cpu" / "gsplat_cpu.cpp"
    if not source.is_file():
        raise SystemExit(f"{checkout} is no checkout of OpenSplat: {source} is missing.")
    folder = Path(tempfile.mkdtemp(prefix="opensplat-"))
    bindings = folder / "bindings.cpp"
    bindings.write_text(_BINDINGS, encoding="utf-8")
    return load(
        "opensplat_cpu", [str(bindings), str(source)], extra_cflags=["-O3", "-march=native", "-ffast-math"],
        extra_include_paths=[str(checkout)], build_directory=str(folder),
    )  # fmt: skip


class Rasterizer:
    """A scene that is projected once; only its rasterization is repeated.

    module: from `build_module`. camera: world to camera (4, 4) and intrinsics (3, 3). upstream: gradient of the
    picture (h, w, 3).
    """

    def __init__(
        self, module: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colours: Tensor,
        camera: tuple[Tensor, Tensor], width: int, height: int, upstream: Tensor,
    ) -> None:  # fmt: skip
        """Project the scene with our projection and keep the inputs of OpenSplat's rasterizer."""
        self.module, self.size, self.upstream = module, (width, height), upstream
        with torch.no_grad():
            projected = projection.project(
                means, quats, scales, *camera, width, height, rendering.NEAR, DILATION
            )
            xx, xy, yy = projected.covariances.unbind(-1)
            conics = torch.stack([yy, -xy, xx], -1) / (xx * yy - xy * xy)[:, None]
            covariances = torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2)
            # OpenSplat's pixel centres are at whole numbers, ours at + 0.5. The background is black.
            inputs = (projected.centres - 0.5, conics, colours[projected.indices], opacities[projected.indices, None],
                      torch.zeros(3), covariances, projected.depths)  # fmt: skip
        self.inputs = [value.detach().contiguous() for value in inputs]

    def picture(self) -> Tensor:
        """Return the picture (h, w, 3), for comparison with ours."""
        return self.module.forward(*self.size, *self.inputs)[0]

    def forward_backward(self) -> None:
        """Run the forward and the backward pass."""
        _, transmittance, lists = self.module.forward(*self.size, *self.inputs)
        d_alpha = torch.zeros_like(transmittance)
        self.module.backward(*self.size, *self.inputs, transmittance, lists, self.upstream, d_alpha)
