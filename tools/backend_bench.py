"""What the back-ends cost, by process time and as ratios within one run, held against bars.

    python tools/backend_bench.py sweep
    python tools/backend_bench.py overhead gnc isam2 --data $HYBRIDMAP_DATA

`sweep`     relaxation-ratslam against loops in plain Python over the same links in the same order: 1,000 nodes, 1,500 edges
`overhead`  gtsam-lm against tools/bare_gtsam.py on the same file, from the parsed file in memory to the optimised poses
`gnc`       gtsam-gnc against gtsam.GncLMOptimizer with odometry as known inliers: intel, random false loops
`isam2`     updates of a replay against one batch optimisation from the odometry chain, and false edges taken out again:
            Manhattan and city10000, some minutes

Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import bare_gtsam
import gtsam
import numpy as np
import replay_bench
from barred import at_least, at_most
from numpy.typing import NDArray

from hybridmap import backends
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph, values
from hybridmap.backends.relaxation import ratslam as sweeps
from hybridmap.backends.relaxation.ratslam import relax_links
from hybridmap.config.backends import RelaxationConfig
from hybridmap.geometry import Array, between, compose, exp, wrap_angle
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import Metric, to_json
from hybridmap.study.false_loops import inject

_ROUNDS = 7  # of measuring everything in turn, so that all see the same machine


def main() -> None:
    """Run the studies that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+", choices=sorted(STUDIES))
    parser.add_argument("--data", type=Path, default=None, help="folder with posegraphs/, for all but `sweep`")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output; the table goes to stderr")
    chosen = parser.parse_args()
    table, metrics = sys.stderr if chosen.json else sys.stdout, list[Metric]()
    for study in chosen.studies:
        for metric in STUDIES[study](chosen.data):
            metrics.append(metric)
            print(line(metric), file=table, flush=True)
    if chosen.json:
        print(to_json({}, metrics))
    raise SystemExit(1 if any(metric.passed is False for metric in metrics) else 0)


def line(metric: Metric) -> str:
    """A figure as people read it."""
    verdict = "" if metric.passed is None else "ok" if metric.passed else "MISSED"
    return f"{metric.name:52}{metric.value:12.6g} {metric.unit:3}{verdict:7}{metric.description}"


def cpu_s(work: Callable[[], object], repeats: int = 3) -> float:
    """Least process time of some runs, s."""
    best = math.inf
    for _ in range(repeats):
        started = time.process_time()
        work()
        best = min(best, time.process_time() - started)
    return best


def drive(nodes: int, edges: int, rng: np.random.Generator) -> PoseGraph:
    """A noisy drive in circles with loops between random nodes that lie apart in time."""
    truth = np.zeros((nodes, 3))
    for k in range(1, nodes):
        truth[k] = compose(truth[k - 1], [0.5, 0.05, 2 * np.pi / 50])
    newer = rng.integers(nodes // 10, nodes, edges - nodes + 1)
    older = (newer - rng.integers(nodes // 20, nodes, len(newer))) % newer
    sources = np.concatenate([np.arange(nodes - 1), newer])
    targets = np.concatenate([np.arange(1, nodes), older])
    noise = exp(rng.normal(size=(edges, 3)) * [0.03, 0.02, 0.01])
    return chain(
        PoseGraph(
            initial=truth,
            sources=sources,
            targets=targets,
            deltas=compose(between(truth[sources], truth[targets]), noise),
            information=np.repeat(np.diag([1e3, 2.5e3, 1e4])[None], edges, axis=0),
            kinds=np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP], [nodes - 1, edges - nodes + 1]).astype(np.int8),
            edge_ids=np.arange(edges),
        )
    )


def loop_over_arrays(graph: PoseGraph, theta: float, sweeps: int) -> Array:
    """The rule as one writes it: a Python loop over the rows of the arrays."""
    poses, order = graph.initial.copy(), np.argsort(graph.sources, kind="stable")
    for _ in range(sweeps):
        for e in order:
            source, target = graph.sources[e], graph.targets[e]
            dx, dy, turn = graph.deltas[e]
            cos, sin = np.cos(poses[source, 2]), np.sin(poses[source, 2])
            apart = poses[target, :2] - poses[source, :2] - [cos * dx - sin * dy, sin * dx + cos * dy]
            error = wrap_angle(poses[target, 2] - poses[source, 2] - turn)
            poses[source, :2] += theta * apart
            poses[target, :2] -= theta * apart
            poses[source, 2] += theta * error
            poses[target, 2] -= theta * error
    return poses


def loop_over_floats(graph: PoseGraph, theta: float, sweeps: int) -> Array:
    """The same with everything taken out of numpy beforehand: as fast as plain Python gets."""
    x, y, yaw = graph.initial.T.tolist()
    order = np.argsort(graph.sources, kind="stable")
    ends = zip(graph.sources[order].tolist(), graph.targets[order].tolist(), strict=True)
    links = [(*both, *delta) for both, delta in zip(ends, graph.deltas[order].tolist(), strict=True)]
    two_pi = 2.0 * math.pi
    for _ in range(sweeps):
        for source, target, dx, dy, turn in links:
            cos, sin = math.cos(yaw[source]), math.sin(yaw[source])
            apart_x = theta * (x[target] - x[source] - cos * dx + sin * dy)
            apart_y = theta * (y[target] - y[source] - sin * dx - cos * dy)
            error = theta * ((yaw[target] - yaw[source] - turn + math.pi) % two_pi - math.pi)
            x[source] += apart_x
            x[target] -= apart_x
            y[source] += apart_y
            y[target] -= apart_y
            yaw[source] += error
            yaw[target] -= error
    return np.array([x, y, yaw]).T


def sweep_study(data: Path | None) -> Iterator[Metric]:
    """A sweep of the per-link rule against plain Python, all in the same order of links."""
    del data
    graph, theta = drive(1000, 1500, np.random.default_rng(0)), 0.5
    vars(sweeps)["TOLERANCE_M"] = 0.0  # no run ends early
    config = RelaxationConfig(theta=theta)

    def ours(count: int, robust: bool = False) -> Array:
        return relax_links(graph, graph.initial, count, config, robust=robust).poses

    for plain in (loop_over_arrays, loop_over_floats):
        off = ours(20) - plain(graph, theta, 20)
        assert max(np.abs(off[:, :2]).max(), np.abs(wrap_angle(off[:, 2])).max()) < 1e-9
    studied: dict[str, tuple[int, Callable[[], object]]] = {
        "loop-over-arrays": (3, lambda: loop_over_arrays(graph, theta, 3)),
        "loop-over-floats": (100, lambda: loop_over_floats(graph, theta, 100)),
        "relaxation-ratslam": (1000, lambda: ours(1000)),
        "relaxation-ratslam-by-20": (1000, lambda: [ours(20) for _ in range(50)]),
        "relaxation-robust": (1000, lambda: ours(1000, robust=True)),
    }
    spent = dict.fromkeys(studied, math.inf)
    for _ in range(_ROUNDS):
        for name, (count, work) in studied.items():
            spent[name] = min(spent[name], cpu_s(work, 1) / count)
    for name, cost_s in spent.items():
        yield Metric(f"sweep/{name}", 1e6 * cost_s, "us", f"a sweep of {graph.n_nodes} nodes, {graph.n_edges} edges")
    for name in ("relaxation-ratslam", "relaxation-ratslam-by-20"):
        yield at_least(f"speed/{name}", spent["loop-over-floats"] / spent[name], 15.0, "times as fast as plain Python's floats")


def solved(name: str, graph: PoseGraph) -> backends.Solution:
    """What a back-end makes of a graph."""
    return backends.create(name).solve(graph)


def overhead_study(data: Path | None) -> Iterator[Metric]:
    """`gtsam-lm` against GTSAM alone."""
    for name in ("intel.g2o", "manhattanOlson3500.g2o"):
        path = posegraph(data, name)
        graph, parsed = read_graph(path), bare_gtsam.parse(path)
        chi2, bare, ours = bare_gtsam.optimise(*parsed)[1], math.inf, math.inf
        for _ in range(_ROUNDS):
            bare = min(bare, cpu_s(partial(bare_gtsam.optimise, *parsed), 1))
            ours = min(ours, cpu_s(partial(solved, "gtsam-lm", graph), 1))
        mine = solved("gtsam-lm", graph).report.chi2
        yield at_most(f"overhead/{path.stem}", ours / bare, 1.15, f"of {bare:.3f} s of CPU of bare gtsam")
        yield at_most(f"chi2_ratio/{path.stem}", mine / chi2, 1.0 + 1e-6, f"of the chi2 of bare gtsam, {chi2:.6g}")


def gnc_study(data: Path | None) -> Iterator[Metric]:
    """Our GNC against GTSAM's."""
    graph = read_graph(posegraph(data, "intel.g2o"))
    for share, times in ((0.1, 5.0), (0.4, 20.0)):
        false, name = inject(graph, share, "random", np.random.default_rng(0)), f"intel-{share:.0%}"
        started = time.process_time()
        theirs = gtsams_gnc(false)
        plain = time.process_time() - started
        ours = cpu_s(partial(solved, "gtsam-gnc", false))
        rejected = np.array(solved("gtsam-gnc", false).report.rejected_edge_ids)
        yield at_least(f"speed_gnc/{name}", plain / ours, times, f"times as fast as GncLMOptimizer, {plain:.2f} s of CPU")
        injected = np.setdiff1d(false.edge_ids, graph.edge_ids)
        lost, bar = (float(np.isin(graph.edge_ids, out).sum()) for out in (rejected, theirs))
        yield at_most(f"true_loops_lost/{name}", lost, bar, "the bar is GncLMOptimizer's")
        kept, bar = (float((~np.isin(injected, out)).sum()) for out in (rejected, theirs))
        yield at_most(f"false_loops_kept/{name}", kept, bar, "the bar is GncLMOptimizer's")


def gtsams_gnc(graph: PoseGraph) -> NDArray[np.int64]:
    """Edge ids that GTSAM's own GNC rejects, odometry being known inliers."""
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([*np.flatnonzero(~graph.is_loop).tolist(), graph.n_edges])
    optimizer = gtsam.GncLMOptimizer(factor_graph(graph, NoiseModels()), values(graph.initial), params)
    optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[: graph.n_edges]
    return graph.edge_ids[graph.is_loop & (weights < 0.5)]


def isam2_study(data: Path | None) -> Iterator[Metric]:
    """A replay's updates against one batch optimisation, with false edges put in and taken out."""
    for name in replay_bench.GRAPHS:
        yield from replay_bench.study(posegraph(data, name))


def posegraph(data: Path | None, name: str) -> Path:
    """A standard graph in the folder of recordings."""
    if data is None:
        raise SystemExit("backend_bench: this study needs --data, the folder of recordings")
    return data / "posegraphs" / name


STUDIES: dict[str, Callable[[Path | None], Iterator[Metric]]] = {
    "sweep": sweep_study,
    "overhead": overhead_study,
    "gnc": gnc_study,
    "isam2": isam2_study,
}


if __name__ == "__main__":
    main()
