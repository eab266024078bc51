"""How fast the cells are: the grid sheets against a straightforward FFT implementation, and the whole path integrator.

`python tools/bench_neural.py [--steps N] [--json]`. Set OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1:
rates are of CPU time on one core, the best of several repeats.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.neural import NeuralConfig
from hybridmap.neural import PathIntegrator
from hybridmap.neural.grid import kernel_spectrum

ODOMETRY_HZ = 100.0


class PlainSheets:
    """The baseline: the same dynamics by one `rfft2` and one `irfft2` over the whole stack a step."""

    def __init__(self, integrator: PathIntegrator) -> None:
        grid = integrator.grid
        side = grid.activity.shape[-1]
        self.activity = grid.activity.copy()
        p, q = np.fft.fftfreq(side, 1.0 / side)[:, None], np.arange(side // 2 + 1)
        near = (np.abs(p) <= integrator.config.fourier_modes) & (q <= integrator.config.fourier_modes)
        squared = (p * p + q * q - p * q)[near].astype(np.int64)
        config = integrator.config
        gains = np.zeros(near.shape, dtype=self.activity.dtype)
        gains[near] = kernel_spectrum(squared, config.kernel_gain_first, config.kernel_gain_zero, config.kernel_widths)
        self._gains, self._p, self._q = gains, p[:, 0].astype(gains.dtype), q.astype(gains.dtype)

    def step(self, shift_cycles: NDArray[np.floating]) -> None:
        """Advance the sheets by shifts (M, 2), cycles."""
        turn = np.exp(-2j * np.pi * shift_cycles[:, 0, None] * self._p)[:, :, None]
        turn = turn * np.exp(-2j * np.pi * shift_cycles[:, 1, None] * self._q)[:, None, :]
        modes = np.fft.rfft2(self.activity) * (turn * self._gains)
        self.activity = np.maximum(np.fft.irfft2(modes) + 1.0, 0.0).astype(self.activity.dtype)


def rate(step: Callable[[], None], steps: int, repeats: int = 9) -> float:
    """Steps per CPU-second, the best of some repeats."""
    best = np.inf
    for _ in range(repeats):
        begin = time.process_time()
        for _ in range(steps):
            step()
        best = min(best, (time.process_time() - begin) / steps)
    return 1.0 / best


def measure(dtype: str, rectifier: str, steps: int) -> dict[str, float]:
    """Rates of one precision and rectifier, steps per CPU-second."""
    config = NeuralConfig.model_validate({"dtype": dtype, "rectifier": rectifier})
    integrator = PathIntegrator(config)
    plain = PlainSheets(integrator)
    motion = integrator.bands.step(np.array([0.005, 0.002]))
    shift = motion.advance[:, ::2].astype(dtype)
    sheets = rate(lambda: integrator.grid.step(motion.advance, motion.phasors), steps)
    baseline = rate(lambda: plain.step(shift), max(steps // 4, 1))
    whole = PathIntegrator(config)
    rng = np.random.default_rng(0)
    turns = iter(np.cumsum(rng.normal(0.0, 1e-3, 10 * steps)))
    front = rate(lambda: whole.step((0.005, 0.0, float(next(turns))), 1.0 / ODOMETRY_HZ), steps)
    with_pose = rate(lambda: _step_and_read(whole), steps)
    return {
        "baseline": baseline,
        "sheets": sheets,
        "sheets / baseline": sheets / baseline,
        "front-end": front,
        "front-end and pose": with_pose,
        "x real time at 100 Hz": front / ODOMETRY_HZ,
    }


def _step_and_read(integrator: PathIntegrator) -> None:
    integrator.step((0.005, 0.0, 0.003), 1.0 / ODOMETRY_HZ)
    _ = integrator.pose


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300, help="steps a repeat")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    arguments = parser.parse_args()
    rows = {
        f"{dtype} {rectifier}": measure(dtype, rectifier, arguments.steps)
        for dtype in ("float32", "float64")
        for rectifier in ("relu", "softplus")
    }
    if arguments.json:
        print(json.dumps(rows))
        return
    print(f"{'steps per CPU-second':24s}" + "".join(f"{name:>24s}" for name in next(iter(rows.values()))))
    for name, row in rows.items():
        print(f"{name:24s}" + "".join(f"{value:24.1f}" for value in row.values()))


if __name__ == "__main__":
    main()
