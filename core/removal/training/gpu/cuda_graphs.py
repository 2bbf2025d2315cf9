# SPDX-License-Identifier: GPL-3.0-or-later
"""CUDA graphs: work that is captured once for each shape of its inputs and then replayed; and results that are copied
without waiting.

Launching the thousands of small kernels of a network's gradients takes a CPU longer than the GPU takes to run them.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

WARMUP_RUNS = 3
"""Runs before the capture, in which libraries choose algorithms and allocate memory."""


class _CapturedGraph(NamedTuple):
    graph: torch.cuda.CUDAGraph
    inputs: list[Tensor]
    outputs: list[Tensor]


class GraphedFunction:
    """A function of GPU tensors that is captured as a CUDA graph at the first call with inputs of new shapes, and
    replayed at later ones. All other tensors that it reads or writes must stay at the same addresses. On a CPU it is
    called as usual."""

    def __init__(self, function: Callable[..., Sequence[Tensor]]) -> None:
        self._function = function
        self._graphs: dict[tuple[torch.Size, ...], _CapturedGraph] = {}

    def __call__(self, *inputs: Tensor) -> list[Tensor]:
        """Return the function's outputs. On a GPU the first call with inputs of new shapes captures a graph, and each
        call overwrites the outputs of the call before."""
        if not inputs[0].is_cuda:
            return list(self._function(*inputs))
        input_shapes = tuple(value.shape for value in inputs)
        if input_shapes not in self._graphs:
            self._graphs[input_shapes] = self._capture([value.clone() for value in inputs])
        graph, static_inputs, outputs = self._graphs[input_shapes]
        for static_input, value in zip(static_inputs, inputs, strict=True):
            static_input.copy_(value)
        graph.replay()
        return outputs

    def _capture(self, inputs: list[Tensor]) -> _CapturedGraph:
        """Warm the function up on a side stream, and capture its graph with these input tensors."""
        side_stream = torch.cuda.Stream(inputs[0].device)
        side_stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side_stream):
            for _ in range(WARMUP_RUNS):
                self._function(*inputs)
        torch.cuda.current_stream().wait_stream(side_stream)
        graph = torch.cuda.CUDAGraph()
        pool = next(iter(self._graphs.values())).graph.pool() if self._graphs else None
        # thread_local: other threads may continue their copies to the GPU during the capture.
        with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
            outputs = list(self._function(*inputs))
        return _CapturedGraph(graph, inputs, outputs)


class AsyncCopy:
    """A copy of numbers from the GPU that nobody waits for until they are needed."""

    def __init__(self, values: Tensor) -> None:
        self._event, self._values = torch.cuda.Event(), torch.empty(values.shape, pin_memory=True)
        self._values.copy_(values, non_blocking=True)
        self._event.record()

    def wait(self) -> list[float]:
        """Wait for the copy and return the numbers."""
        self._event.synchronize()
        return [float(value) for value in self._values]
