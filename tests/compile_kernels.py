# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiles the kernels of a fit and caches their machine code, which takes a minute: `python -m tests.compile_kernels`.

`make test` runs it before the tests, whose processes would each compile the kernels.
"""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from core.capture import Capture
from core.fit import preset
from core.fit.trainer import Trainer

SAMPLE = Path(__file__).resolve().parents[1] / "sample_scenes" / "desk"
WIDTH, ITERATIONS = 60, 20


def main() -> None:
    """Run the first iterations of a small fit of the sample, with clean frames and without."""
    capture = Capture.open(SAMPLE)
    for mode in ("default", "split"):
        settings = replace(preset("standard", iterations=ITERATIONS), mode=mode, width=WIDTH)
        trainer = Trainer(capture, settings)
        for _ in range(ITERATIONS):
            trainer.step()


if __name__ == "__main__":
    main()
