"""Measure how fast the cells are.

    python tools/bench_neural.py [--steps N] [--json]

The sheets of grid cells are compared with a plain FFT implementation. The whole path integrator is timed as well. Set
OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1. Rates are per second of CPU time on one core, the best of many repeats.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.mapping import NeuralConfig
from hybridmap.metrics import Metric, to_json
from hybridmap.neural import PathIntegrator
from hybridmap.neural.grid import FOURIER_MODES, SOFTPLUS_SHARPNESS, kernel_spectrum
from hybridmap.verification.drives import wander

ODOMETRY_HZ = 100.0
STEP_M = 0.005  # 0.5 m/s
NODE_M = 0.25
BARS = {"sheets / baseline": 8.0, "x real time at 100 Hz": 100.0}
JUDGED = "float32 relu"


class PlainSheets:
    """The baseline: the same dynamics, with one `rfft2` and one `irfft2` over all sheets at each step."""

    def __init__(self, integrator: PathIntegrator) -> None:
        grid, config = integrator.grid, integrator.config
        side = grid.activity.shape[-1]
        self.activity = np.ascontiguousarray(grid.activity)
        p, q = np.fft.fftfreq(side, 1.0 / side)[:, None], np.arange(side // 2 + 1)
        near = (np.abs(p) <= FOURIER_MODES) & (q <= FOURIER_MODES)
        squared = (p * p + q * q - p * q)[near].astype(np.int64)
        gains = np.zeros(near.shape, dtype=self.activity.dtype)
        gains[near] = kernel_spectrum(squared)
        self._gains, self._p, self._q = gains, p[:, 0].astype(gains.dtype), q.astype(gains.dtype)
        self._stripe = 0.5 * config.band_drive * side**2
        self._softplus = SOFTPLUS_SHARPNESS if config.rectifier == "softplus" else None

    def step(self, shift_cycles: NDArray[np.floating], phasors: NDArray[np.complexfloating]) -> None:
        """Advance the sheets by shifts (M, 2) in cycles. The stripes of the band cells stand at phasors (M, 3)."""
        turn = np.exp(-2j * np.pi * shift_cycles[:, 0, None] * self._p)[:, :, None]
        turn = turn * np.exp(-2j * np.pi * shift_cycles[:, 1, None] * self._q)[:, None, :]
        modes = np.fft.rfft2(self.activity) * (turn * self._gains)
        stripes = self._stripe * phasors.conj()
        modes[:, 1, 0] += stripes[:, 0]
        modes[:, -1, 0] += stripes[:, 0].conj()
        modes[:, 1, 1] += stripes[:, 1]
        modes[:, 0, 1] += stripes[:, 2]
        drive = np.fft.irfft2(modes) + 1.0
        beta = self._softplus
        rates = np.maximum(drive, 0.0) if beta is None else np.logaddexp(0.0, beta * drive) / beta
        self.activity = rates.astype(self.activity.dtype, copy=False)


def rates(steps: dict[Callable[[], None], int], repeats: int = 150) -> list[float]:
    """Return the steps per second of CPU time of each function.

    `steps` gives the number of steps in one repeat. The functions take turns. The best repeat of each counts.
    """
    best = dict.fromkeys(steps, np.inf)
    for _ in range(repeats):
        for step, count in steps.items():
            begin = time.process_time()
            for _ in range(count):
                step()
            best[step] = min(best[step], (time.process_time() - begin) / count)
    return [1.0 / seconds for seconds in best.values()]


def measure(dtype: str, rectifier: str, steps: int) -> dict[str, float]:
    """Measure one precision and rectifier. Rates are steps per second of CPU time."""
    config = NeuralConfig.model_validate({"rectifier": rectifier})
    integrator = PathIntegrator(config, dtype=dtype)
    plain = PlainSheets(integrator)
    motion = integrator.bands.step(np.array([0.005, 0.002]))
    shift = motion.advance[:, ::2].astype(dtype)
    for _ in range(20):
        integrator.grid.step(motion.advance, motion.phasors)
        plain.step(shift, motion.phasors)
    apart = float(np.abs(integrator.grid.activity - plain.activity).max() / plain.activity.max())
    sheets, baseline = rates(
        {
            lambda: integrator.grid.step(motion.advance, motion.phasors): steps,
            lambda: plain.step(shift, motion.phasors): max(steps // 8, 1),
        }
    )
    whole = PathIntegrator(config, dtype=dtype)
    front, every = rates({Driving(whole, NODE_M): steps, Driving(whole, STEP_M): max(steps // 4, 1)})
    wandered, cells = wandering(config, dtype)
    return {
        "baseline": baseline,
        "sheets": sheets,
        "sheets / baseline": sheets / baseline,
        "apart after 20 steps": apart,
        "front-end": front,
        "x real time at 100 Hz": front / ODOMETRY_HZ,
        "with the pose every step": every,
        "120 m at random": wandered,
        "place cells by then": float(cells),
    }


class Driving:
    """A drive on a circle in steps of 5 mm. The pose and the place code are read every `node_m`, as at a node."""

    def __init__(self, integrator: PathIntegrator, node_m: float) -> None:
        self._integrator, self._node_steps, self._steps = integrator, max(1, round(node_m / STEP_M)), 0

    def __call__(self) -> None:
        """Take one step."""
        self._integrator.step((STEP_M, 0.0, 0.003), 1.0 / ODOMETRY_HZ)
        self._steps += 1
        if self._steps % self._node_steps == 0:
            _ = self._integrator.pose, self._integrator.place_code


def metrics_of(rows: dict[str, dict[str, float]]) -> list[Metric]:
    """Turn the table into metrics. Only float32 with the paper's rectifier has bars."""
    metrics = []
    for row, figures in rows.items():
        for what, value in figures.items():
            name = f"{what.replace(' / ', '_over_').replace(' ', '_')}/{row.replace(' ', '-')}"
            bar = BARS.get(what) if row == JUDGED else None
            held = f"; at least {bar:g}" if bar is not None else ""
            metrics.append(Metric(name, value, "1", f"{what}, {row}{held}", bar, None if bar is None else value >= bar))
    return metrics


def wandering(config: NeuralConfig, dtype: str, way_m: float = 120.0) -> tuple[float, int]:
    """Measure a random walk.

    Return the steps per second of CPU time, the best of the parts in its second half, and the number of place cells at the end.
    """
    drive = wander(np.random.default_rng(1), way_m, ODOMETRY_HZ)
    integrator = PathIntegrator(config, dtype=dtype)
    ways, gone_m, part, times = np.hypot(drive.deltas[:, 0], drive.deltas[:, 1]), 0.0, len(drive.deltas) // 40, []
    for first in range(0, len(drive.deltas) - part, part):
        begin = time.process_time()
        for delta, way in zip(drive.deltas[first : first + part].tolist(), ways[first : first + part].tolist(), strict=True):
            integrator.step(delta, 1.0 / ODOMETRY_HZ)
            gone_m += way
            if gone_m >= NODE_M:
                gone_m = 0.0
                _ = integrator.pose, integrator.place_code
        times.append(time.process_time() - begin)
    return part / min(times[len(times) // 2 :]), len(integrator.place.weights)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100, help="steps in one repeat")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    arguments = parser.parse_args()
    rows = {
        f"{dtype} {rectifier}": measure(dtype, rectifier, arguments.steps)
        for dtype in ("float32", "float64")
        for rectifier in ("relu", "softplus")
    }
    if arguments.json:
        print(to_json({}, metrics_of(rows)))
        return
    print(f"{'steps per CPU-second':28s}" + "".join(f"{name:>20s}" for name in rows))
    for what in next(iter(rows.values())):
        print(f"{what:28s}" + "".join(f"{row[what]:20.4g}" for row in rows.values()))
    for metric in metrics_of(rows):
        if metric.bar is not None:
            print(f"{metric.description}: {metric.value:.4g}, {'kept' if metric.passed else 'missed'}")


if __name__ == "__main__":
    main()
