"""Measure how fast a view is matched with the stored views.

    python tools/bench_matching.py [--bands B] [--json]

The search is compared with OpenCV alone and with plain numpy. Gated matching is measured on maps of growing size. Set
OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1. Times are CPU times on one core, the best of several repeats.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import MatchingConfig
from hybridmap.metrics import Metric, to_json
from hybridmap.vision.gating import nodes_within
from hybridmap.vision.profile import normalised
from hybridmap.vision.search import ProfileIndex
from hybridmap.vision.templates import Matcher

WIDTH, MAX_SHIFT, NEAREST = 64, 16, 5
MATCHING = MatchingConfig()
BARS = {"search / bare": 1.5, "numpy / search": 10.0, "gated, against the smallest": 2.0}
STEP_M, LANE_M, LANE_NODES = 0.25, 1.0, 200
"""The map for gated matching: parallel lanes of 50 m, 1 m apart, with a node every 25 cm. A larger map has more lanes."""
GATE_M, GATE_RAD = 5.0, float(np.deg2rad(50.0))

Bytes = NDArray[np.uint8]


def views(count: int, bands: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Make smooth random profiles (count, bands, WIDTH), z-normalised."""
    rough = rng.standard_normal((count, bands, WIDTH + 6), dtype=np.float32)
    smooth = np.sum([rough[:, :, at : at + WIDTH] for at in range(7)], axis=0)
    return np.asarray(normalised(smooth.reshape(-1, WIDTH), "z"), dtype=np.float32).reshape(count, bands, WIDTH)


def best_of(work: Callable[[], object], seconds: float = 1.0) -> float:
    """Return the CPU time of one call in ms: the best of the calls that fit into `seconds`, and of three at least."""
    work()
    best, calls, begin = np.inf, 0, time.process_time()
    while calls < 3 or time.process_time() - begin < seconds:
        start = time.process_time()
        work()
        best, calls = min(best, time.process_time() - start), calls + 1
    return 1e3 * best


@dataclass(frozen=True)
class Bare:
    """The same search by OpenCV alone: one `batchDistance` for each shift. Its results are not merged."""

    stored: Bytes
    query: Bytes
    bands: int

    def __call__(self) -> None:
        """Search once."""
        length = self.query.shape[1]
        for c in range(-MAX_SHIFT, MAX_SHIFT + 1):
            skip = self.bands * abs(c)
            ours = self.query[:, skip:] if c >= 0 else self.query[:, : length - skip]
            theirs = self.stored[:, : length - skip] if c >= 0 else self.stored[:, skip:]
            cv2.batchDistance(ours, theirs, cv2.CV_32S, normType=cv2.NORM_L1, K=NEAREST)


def plain(query: NDArray[np.float32], stored: NDArray[np.float32]) -> NDArray[np.int64]:
    """Search in plain numpy: equation 12 for each shift, mean over the bands, minimum over the shifts, nearest views."""
    least = np.full(len(stored), np.inf)
    for c in range(-MAX_SHIFT, MAX_SHIFT + 1):
        ours = query[:, max(c, 0) : WIDTH + min(c, 0)]
        theirs = stored[:, :, max(-c, 0) : WIDTH - max(c, 0)]
        np.minimum(least, np.abs(theirs - ours).mean(axis=(1, 2)), out=least)
    return np.argsort(least, kind="stable")[:NEAREST]


def lanes(count: int) -> NDArray[np.float64]:
    """Make the poses (count, 3) of the map for gated matching."""
    lane, at = np.divmod(np.arange(count), LANE_NODES)
    odd = lane % 2 == 1
    x = np.where(odd, LANE_NODES - 1 - at, at) * STEP_M
    return np.column_stack([x, lane * LANE_M, np.where(odd, np.pi, 0.0)])


def gated(matcher: Matcher, poses: NDArray[np.float64], query: NDArray[np.float32]) -> int:
    """Match one frame with the nodes in the gate and store its profile. Return the number of nodes in the gate."""
    node = len(poses) // 2
    near = nodes_within(poses, node, GATE_M, GATE_RAD, before=len(poses))
    matcher.best(query, NEAREST, near)
    matcher.add(query)
    return len(near)


def measure(count: int, bands: int, numpy_up_to: int) -> dict[str, float]:
    """Measure one size of map. Return times in ms, and their ratios."""
    rng = np.random.default_rng(count)
    stored, query = views(count, bands, rng), views(1, bands, rng)[0]
    index = ProfileIndex(np.full(bands, 1.0 / bands), WIDTH, MAX_SHIFT)
    matcher = Matcher("four-band", MATCHING.mu_r, MATCHING.mu_d, MAX_SHIFT)
    for profile in stored:
        index.add(profile)
        matcher.add(profile)
    bare = Bare(np.stack([index.quantised(profile) for profile in stored]), index.quantised(query)[None], bands)
    row = {
        "bare": best_of(bare),
        "search": best_of(lambda: index.nearest(query, NEAREST)),
        "with G in full": best_of(lambda: matcher.best(query, NEAREST)),
    }
    row["search / bare"] = row["search"] / row["bare"]
    if count <= numpy_up_to:
        row["numpy"] = best_of(lambda: plain(query, stored))
        row["numpy / search"] = row["numpy"] / row["search"]
    poses = lanes(count)
    row["in the gate"] = float(gated(matcher, poses, query))
    row["gated"] = best_of(lambda: gated(matcher, poses, query))
    return row


def metrics_of(size: int, row: dict[str, float]) -> list[Metric]:
    """Turn the figures of one size of map into metrics. The ratios have bars."""
    metrics = []
    for what, value in row.items():
        name = f"{what.replace(' / ', '_over_').replace(', ', '_').replace(' ', '_')}/{size}"
        bar, least = BARS.get(what), what.startswith("numpy /")
        passed = None if bar is None else value >= bar if least else value <= bar
        unit = "1" if bar is not None or what == "in the gate" else "ms"
        held = "" if bar is None else f"; at {'least' if least else 'most'} {bar:g}"
        metrics.append(Metric(name, value, unit, f"{what}, {size} stored views{held}", bar, passed))
    return metrics


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bands", type=int, default=4, help="number of bands of a profile")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 10_000, 100_000], help="numbers of stored profiles")
    parser.add_argument("--numpy-up-to", type=int, default=100_000, help="largest map for the slow search in numpy")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rows = {size: measure(size, arguments.bands, arguments.numpy_up_to) for size in sorted(arguments.sizes)}
    smallest = min(rows)
    for row in rows.values():
        row["gated, against the smallest"] = row["gated"] / rows[smallest]["gated"]
    if arguments.json:
        print(to_json({"bands": arguments.bands}, [metric for size, row in rows.items() for metric in metrics_of(size, row)]))
        return
    print(f"{f'ms of CPU, {arguments.bands} bands x {WIDTH}':30s}" + "".join(f"{size:>12d}" for size in rows))
    for name in dict.fromkeys(key for row in rows.values() for key in row):
        bar = f"   bar: {'>=' if name.startswith('numpy') else '<='} {BARS[name]:g}" if name in BARS else ""
        print(f"{name:30s}" + "".join(f"{row[name]:12.3g}" if name in row else f"{'':12s}" for row in rows.values()) + bar)


if __name__ == "__main__":
    main()
