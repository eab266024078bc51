"""Measure `gtsam-isam2` as a graph grows node by node, and after false edges are removed. `backend_bench.py` runs this."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from barred import at_least, at_most

from hybridmap import backends
from hybridmap.backends.base import Backend, Solution
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.geometry import Array, between
from hybridmap.graph.io import read_graph
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import PoseGraph, prefix
from hybridmap.metrics import Metric
from hybridmap.study.false_loops import inject

GRAPHS = {"manhattanOlson3500.g2o": None, "city10000.g2o": 4000}
"""Pose graph -> how many of its nodes are replayed with false edges; None for all. All of city10000 would take minutes."""

_SHARE, _SEED = 0.05, 0


@dataclass(frozen=True, slots=True)
class Replay:
    """Result of growing a graph node by node.

    Attributes:
        spent_s: CPU time of each update, without the time to make the graph up to that node.
        works: number of updates that called the solver.
        last: solution after the last update.
    """

    spent_s: Array
    works: int
    last: Solution


def study(path: Path) -> Iterator[Metric]:
    """Yield the figures of `gtsam-isam2` on one graph: first the cost of its updates, then the test with false edges."""
    graph, name = chain(read_graph(path)), path.stem
    batch_s = min(_batch_s(graph) for _ in range(3))
    best = backends.create("gtsam-lm").solve(graph).report.chi2
    backend = backends.create("gtsam-isam2")
    replay = replayed(backend, graph)
    end = backend.finish(graph).report
    median_s, p99_s = np.quantile(replay.spent_s, [0.5, 0.99])
    yield Metric(f"update_median/{name}", 1e3 * median_s, "ms", f"{replay.works} of {graph.n_nodes} updates called ISAM2")
    yield Metric(f"update_p99/{name}", 1e3 * p99_s, "ms", f"all updates: {replay.spent_s.sum():.1f} s of CPU time")
    times = f"CPU time of one batch optimisation from the chain, {batch_s:.3f} s, over that of the median update"
    yield at_least(f"updates_a_batch/{name}", batch_s / median_s, 300.0, times)
    yield at_most(f"chi2_last_update/{name}", replay.last.report.chi2 / best, 1.001, "chi2 over that of batch")
    yield at_most(f"chi2_at_the_end/{name}", end.chi2 / best, 1.001, f"chi2 over that of batch; takes {end.cpu_s:.2f} s of CPU")
    yield from _false_edges(prefix(graph, GRAPHS.get(path.name) or graph.n_nodes), name)


def replayed(backend: Backend, graph: PoseGraph) -> Replay:
    """Grow a graph node by node. Only the updates are timed."""
    spent, works, last = [], 0, None
    for nodes in range(1, graph.n_nodes + 1):
        part = prefix(graph, nodes)
        started = time.process_time()
        last = backend.update(part)
        spent.append(time.process_time() - started)
        works += last.report.iterations > 0
    assert last is not None
    return Replay(np.array(spent), works, last)


def _batch_s(graph: PoseGraph) -> float:
    started = time.process_time()
    run("lm", factor_graph(graph, NoiseModels()), graph.initial, 100)
    return time.process_time() - started


def _false_edges(clean: PoseGraph, name: str) -> Iterator[Metric]:
    """Replay with false edges, remove them all at once, and compare with the optimum of the graph without them."""
    best = backends.create("gtsam-lm").solve(clean)
    false = inject(clean, _SHARE, "random", np.random.default_rng(_SEED))
    backend = backends.create("gtsam-isam2")
    ruined = replayed(backend, false)
    back = backend.update(clean)
    off = np.abs(between(best.poses, back.poses))
    what = f"{false.n_edges - clean.n_edges} false edges among {clean.n_nodes} nodes removed"
    chi2 = f"chi2 over that of the optimum; it was {ruined.last.report.chi2:.4g}; removal: {back.report.cpu_s:.2f} s of CPU"
    yield at_most(f"chi2_after_removal/{name}", back.report.chi2 / best.report.chi2, 1.0 + 1e-6, f"{what}: {chi2}")
    yield Metric(f"off_after_removal/{name}", float(off[:, :2].max()), "m", "largest distance of a node from that optimum")
