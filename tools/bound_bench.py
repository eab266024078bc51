"""Hold the proved lower bound of chi2 against random graphs and the standard ones. `backend_bench.py bounds` runs this."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from barred import at_most

from hybridmap import backends
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.backends.judging.minorant import chi2_bound
from hybridmap.backends.objective import chi2
from hybridmap.geometry import Array, between, compose, exp
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import Metric

GRAPHS = (
    "intel.g2o",
    "CSAIL.g2o",
    "input_M3500_g2o.g2o",
    "manhattanOlson3500.g2o",
    "FR079_P_toro.graph",
    "input_INTEL_g2o.g2o",
    "city10000.g2o",
)
NOISES = (0.01, 0.1, 0.3, 1.0)
"""Upper ends of the groups of random graphs by noise: standard deviation of a component of an edge, m and rad."""
_LEAST = 1e-4
_STARTS = 4
_LONGEST_S = 10.0


def random_graph(rng: np.random.Generator, noise: float, least: int = 2, most: int = 12) -> PoseGraph:
    """Make a random walk with random loops, with random information matrices; `initial` is the truth.

    The condition of an information matrix is up to 10^4, its axes lie anyhow, its coupling of position and heading is random.

    Args:
        rng: randomness.
        noise: standard deviation of an edge along its most certain axis, m or rad; of others up to 100 times that, at most 1.
        least, most: range of the number of nodes.
    """
    nodes = int(rng.integers(least, most + 1))
    truth = np.zeros((nodes, 3))
    for k in range(1, nodes):
        truth[k] = compose(truth[k - 1], [rng.uniform(0.2, 1.5), 0.2 * rng.normal(), 0.8 * rng.normal()])
    loops = int(rng.integers(1, 2 * nodes + 1))
    first = rng.integers(0, nodes, loops)
    sources = np.concatenate([np.arange(nodes - 1), first])
    targets = np.concatenate([np.arange(1, nodes), (first + rng.integers(1, nodes, loops)) % nodes])
    edges, spread = len(sources), 10.0 ** rng.uniform(0.0, 2.0)
    axes = np.linalg.qr(rng.normal(size=(edges, 3, 3)))[0] if rng.random() < 0.5 else np.repeat(np.eye(3)[None], edges, axis=0)
    sigmas = np.minimum(noise * spread ** rng.uniform(0.0, 1.0, (edges, 3)), max(noise, 1.0))
    twists = np.einsum("eij,ej->ei", axes, sigmas * rng.normal(size=(edges, 3)))
    information = np.einsum("eij,ej,ekj->eik", axes, sigmas**-2.0, axes)
    return PoseGraph(
        initial=truth,
        sources=sources,
        targets=targets,
        deltas=compose(between(truth[sources], truth[targets]), exp(twists)),
        information=0.5 * (information + information.transpose(0, 2, 1)),
        kinds=np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP], [nodes - 1, loops]).astype(np.int8),
        edge_ids=np.arange(edges),
    )


@dataclass(frozen=True, slots=True)
class Trial:
    """A random graph: the least chi2 found, the bound from there, and the bound from poses that are far from it."""

    noise: float
    least: float
    bound: float
    bound_from_afar: float

    @property
    def violated(self) -> bool:
        """Whether a map was found that has less than a bound."""
        return max(self.bound, self.bound_from_afar) > self.least


def trial(rng: np.random.Generator, starts: int = _STARTS) -> Trial:
    """Draw a graph, look for its best map from the truth and from `starts` other poses, and bound its chi2."""
    noise = float(np.exp(rng.uniform(np.log(_LEAST), np.log(NOISES[-1]))))
    graph = random_graph(rng, noise)
    scatter = rng.uniform(0.1, 1.5, starts)
    begun = [graph.initial, *(graph.initial + size * rng.normal(size=graph.initial.shape) for size in scatter)]
    found = [_optimum(graph, start) for start in begun]
    best = min(found, key=lambda poses: chi2(graph, poses))
    return Trial(noise, chi2(graph, best), chi2_bound(graph, best), chi2_bound(graph, begun[-1]))


def _optimum(graph: PoseGraph, start: Array) -> Array:
    return run("lm", factor_graph(graph, NoiseModels()), start, 100, tolerance=1e-9).poses


def study(data: Path | None, count: int = 1000) -> Iterator[Metric]:
    """Count the random graphs with a map of less chi2 than the bound, and measure the gap; then on the standard graphs."""
    trials = [trial(np.random.default_rng(seed)) for seed in range(count)]
    yield at_most("bounds/violations", sum(one.violated for one in trials), 0.0, f"of {count} random graphs")
    for below, noise in zip((0.0, *NOISES), NOISES, strict=False):
        gaps = [1.0 - one.bound / one.least for one in trials if below <= one.noise < noise and one.least > 1e-9]
        for share in (50, 95, 100) if gaps else ():
            said = f"gap of {len(gaps)} graphs with noise {below:g} to {noise:g} m and rad, {share} % are below"
            yield Metric(f"bounds/gap/{noise:g}/{share}", float(np.percentile(gaps, share)), "1", said)
    for path in [data / "posegraphs" / name for name in GRAPHS] if data is not None else []:
        graph = read_graph(path)
        poses = backends.create("gtsam-lm").solve(graph).poses
        started, cost = time.process_time(), chi2(graph, poses)
        bound = chi2_bound(graph, poses)
        spent = time.process_time() - started
        yield Metric(f"bounds/gap/{path.stem}", 1.0 - bound / cost, "1", f"gap of chi2 {cost:.7g} to its bound")
        yield at_most(f"bounds/cpu_s/{path.stem}", spent, _LONGEST_S, "CPU time of the bound", "s")
