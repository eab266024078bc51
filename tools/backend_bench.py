"""Measure the CPU time of the back-ends and hold it against bars. The bars are on ratios of times of the same run.

    python tools/backend_bench.py sweep
    python tools/backend_bench.py overhead gnc isam2 orders robust --data $HYBRIDMAP_DATA
    python tools/backend_bench.py bounds --data $HYBRIDMAP_DATA --graphs 10000

`sweep`     compares a sweep of relaxation-ratslam with plain Python over the same links in the same order. The graph has
            1,000 nodes and 1,500 edges.
`overhead`  compares gtsam-lm with tools/bare_gtsam.py on the same files. The time to read a file does not count.
`gnc`       compares gtsam-gnc with gtsam.GncLMOptimizer on intel with random false loops. Odometry edges are known inliers.
`isam2`     compares an update of gtsam-isam2 with one batch optimisation. It then adds false edges and removes them again.
            The graphs are Manhattan and city10000. This takes some minutes.
`orders`    renames the vertices of intel, CSAIL and M3500 at random, by default in 200 ways (`--shuffles`), and compares the
            chi2 of every GTSAM back-end with that of the file. Then the files lose their vertices.
`robust`    counts the loops that relaxation-robust drops where none is false, also after a drift, and where 10 % are false the
            error of its map. It also solves the first 500 nodes of intel with false loops by gtsam-gnc.
`bounds`    looks for maps with less chi2 than the proved bound on random graphs, by default 1,000 (`--graphs`), and measures
            the gap between the best chi2 and the bound, there and on the standard graphs. 1,000 graphs take a minute.

The exit code is 1 if a bar is missed.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import bare_gtsam
import bound_bench
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
from hybridmap.geometry import Array, align, between, compose, exp, transform_points, wrap_angle
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.paths import chain
from hybridmap.graph.pose_graph import PoseGraph, prefix
from hybridmap.metrics import Metric, to_json
from hybridmap.study.false_loops import inject, with_drift
from hybridmap.study.model import DriftConfig

_ROUNDS = 7  # All candidates are timed in turn, this many times, so that load on the machine affects them alike.


def main() -> None:
    """Run the studies that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+", choices=sorted(STUDIES))
    parser.add_argument("--data", type=Path, default=None, help="folder that holds posegraphs/; `sweep` runs without it")
    parser.add_argument("--shuffles", type=int, default=200, help="how many ways of renaming vertices `orders` tries")
    parser.add_argument("--graphs", type=int, default=1000, help="how many random graphs `bounds` draws")
    parser.add_argument("--json", action="store_true", help="print one JSON object; the table goes to standard error")
    chosen = parser.parse_args()
    studies = STUDIES | {
        "orders": partial(orders_study, shuffles=chosen.shuffles),
        "bounds": partial(bound_bench.study, count=chosen.graphs),
    }
    table, metrics = sys.stderr if chosen.json else sys.stdout, list[Metric]()
    for study in chosen.studies:
        for metric in studies[study](chosen.data):
            metrics.append(metric)
            print(line(metric), file=table, flush=True)
    if chosen.json:
        print(to_json({}, metrics))
    raise SystemExit(1 if any(metric.passed is False for metric in metrics) else 0)


def line(metric: Metric) -> str:
    """Format a figure as one line of the table."""
    verdict = "" if metric.passed is None else "ok" if metric.passed else "MISSED"
    return f"{metric.name:52}{metric.value:12.6g} {metric.unit:3}{verdict:7}{metric.description}"


def cpu_s(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the shortest CPU time of several runs, in s."""
    best = math.inf
    for _ in range(repeats):
        started = time.process_time()
        work()
        best = min(best, time.process_time() - started)
    return best


def drive(nodes: int, edges: int, rng: np.random.Generator) -> PoseGraph:
    """Make the pose graph of a noisy drive in circles. Its loops join random nodes that are far apart in time."""
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
    """Relax a graph by a direct Python loop over the rows of numpy arrays."""
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
    """Relax a graph by a Python loop over plain floats. This is the fastest form without numpy and numba."""
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
    """Time a relaxation sweep against plain Python. All visit the links in the same order."""
    del data
    graph, theta = drive(1000, 1500, np.random.default_rng(0)), 0.5
    vars(sweeps)["TOLERANCE_M"] = 0.0  # so that no run stops early
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
        yield Metric(f"sweep/{name}", 1e6 * cost_s, "us", f"one sweep over {graph.n_nodes} nodes and {graph.n_edges} edges")
    for name in ("relaxation-ratslam", "relaxation-ratslam-by-20"):
        yield at_least(f"speed/{name}", spent["loop-over-floats"] / spent[name], 15.0, "times as fast as a loop over floats")


def solved(name: str, graph: PoseGraph) -> backends.Solution:
    """Solve a graph with the named back-end."""
    return backends.create(name).solve(graph)


def overhead_study(data: Path | None) -> Iterator[Metric]:
    """Compare `gtsam-lm` with GTSAM alone, in CPU time and in chi2."""
    for name in ("intel.g2o", "manhattanOlson3500.g2o"):
        path = posegraph(data, name)
        graph, parsed = read_graph(path), bare_gtsam.parse(path)
        chi2, bare, ours = bare_gtsam.optimise(*parsed)[1], math.inf, math.inf
        for _ in range(_ROUNDS):
            bare = min(bare, cpu_s(partial(bare_gtsam.optimise, *parsed), 1))
            ours = min(ours, cpu_s(partial(solved, "gtsam-lm", graph), 1))
        mine = solved("gtsam-lm", graph).report.chi2
        yield at_most(f"overhead/{path.stem}", ours / bare, 1.15, f"CPU time over that of GTSAM alone, {bare:.3f} s")
        yield at_most(f"chi2_ratio/{path.stem}", mine / chi2, 1.0 + 1e-6, f"chi2 over that of GTSAM alone, {chi2:.6g}")


def gnc_study(data: Path | None) -> Iterator[Metric]:
    """Compare `gtsam-gnc` with GTSAM's own GNC, in CPU time and in the loops that are rejected."""
    graph = read_graph(posegraph(data, "intel.g2o"))
    for share, times in ((0.1, 5.0), (0.4, 20.0)):
        false, name = inject(graph, share, "random", np.random.default_rng(0)), f"intel-{share:.0%}"
        started = time.process_time()
        theirs = gtsams_gnc(false)
        plain = time.process_time() - started
        ours = cpu_s(partial(solved, "gtsam-gnc", false))
        rejected = np.array(solved("gtsam-gnc", false).report.rejected_edge_ids)
        yield at_least(f"speed_gnc/{name}", plain / ours, times, f"times as fast as GncLMOptimizer, {plain:.2f} s of CPU time")
        injected = np.setdiff1d(false.edge_ids, graph.edge_ids)
        lost, bar = (float(np.isin(graph.edge_ids, out).sum()) for out in (rejected, theirs))
        yield at_most(f"true_loops_lost/{name}", lost, bar, "true loops rejected; the bar is what GncLMOptimizer rejects")
        kept, bar = (float((~np.isin(injected, out)).sum()) for out in (rejected, theirs))
        yield at_most(f"false_loops_kept/{name}", kept, bar, "false loops kept; the bar is what GncLMOptimizer keeps")


def gtsams_gnc(graph: PoseGraph) -> NDArray[np.int64]:
    """Return the ids of the loops that GTSAM's own GNC rejects. Odometry edges are known inliers."""
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([*np.flatnonzero(~graph.is_loop).tolist(), graph.n_edges])
    optimizer = gtsam.GncLMOptimizer(factor_graph(graph, NoiseModels()), values(graph.initial), params)
    optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[: graph.n_edges]
    return graph.edge_ids[graph.is_loop & (weights < 0.5)]


def isam2_study(data: Path | None) -> Iterator[Metric]:
    """Time incremental updates, then add false edges and remove them; see `replay_bench`."""
    for name in replay_bench.GRAPHS:
        yield from replay_bench.study(posegraph(data, name))


def renamed(path: Path, rng: np.random.Generator) -> PoseGraph:
    """Return the graph of a file as it is read after its vertices got random numbers."""
    rows = [row.split() for row in path.read_text(encoding="utf-8").splitlines() if row.strip()]
    ends = [1 if row[0].startswith("VERTEX") else 2 for row in rows]
    old = sorted({int(vertex) for row, count in zip(rows, ends, strict=True) for vertex in row[1 : 1 + count]})
    new = dict(zip(map(str, old), map(str, rng.permutation(7 * len(old))[: len(old)].tolist()), strict=True))
    named = [[row[0], *(new[v] for v in row[1 : 1 + n]), *row[1 + n :]] for row, n in zip(rows, ends, strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / path.name
        other.write_text("\n".join(" ".join(row) for row in named) + "\n", encoding="utf-8")
        return read_graph(other)


def orders_study(data: Path | None, shuffles: int = 200) -> Iterator[Metric]:
    """Solve graphs whose vertices have random numbers, and graphs without vertices, with every GTSAM back-end."""
    names = [name for name in backends.names() if name.startswith("gtsam")]
    for file in ("intel.g2o", "CSAIL.g2o", "manhattanOlson3500.g2o"):
        path = posegraph(data, file)
        graph = read_graph(path)
        expected = {name: solved(name, graph).report.chi2 for name in names}
        worst = dict.fromkeys(names, 0.0)
        for seed in range(shuffles):
            other = renamed(path, np.random.default_rng(seed))
            for name in names:
                off = abs(solved(name, other).report.chi2 / expected[name] - 1.0)
                worst[name] = max(worst[name], off)
        for name, off in worst.items():
            yield at_most(f"renamed/{path.stem}/{name}", off, 1e-6, f"relative change of chi2, worst of {shuffles}")
        for name in names:
            bare = solved(name, chain(graph)).report
            assert bare.status.has_map
            yield Metric(
                f"stripped/{path.stem}/{name}", bare.chi2, "1", f"chi2 without vertices; with them {expected[name]:.8g}"
            )


def robust_study(data: Path | None) -> Iterator[Metric]:
    """Count the true loops that `relaxation-robust` drops, and measure what false ones do."""
    for file in ("intel.g2o", "CSAIL.g2o", "manhattanOlson3500.g2o", "FR079_P_toro.graph"):
        graph = read_graph(posegraph(data, file))
        best = solved("gtsam-lm", graph).poses
        bent = chain(with_drift(graph, DriftConfig(heading_bias_deg_per_m=1.0), 0))
        for way, given in (("as-it-is", graph), ("no-vertices", chain(graph)), ("drift", bent)):
            solution = solved("relaxation-robust", given)
            share = len(solution.report.rejected_edge_ids) / int(graph.is_loop.sum())
            yield at_most(f"dropped/{file.split('.')[0]}/{way}", share, 0.01, "share of loops dropped; none is false")
        for kind in ("random", "aliased"):
            false = inject(graph, 0.1, kind, np.random.default_rng(0))
            off = ate_rmse(solved("relaxation-robust", false).poses, best)
            yield Metric(f"false_loops/{file.split('.')[0]}/{kind}", off, "m", "ATE of relaxation-robust with 10 % false loops")
    graph = prefix(read_graph(posegraph(data, "intel.g2o")), 500)
    false = inject(graph, 0.1, "random", np.random.default_rng(0))
    off = ate_rmse(solved("gtsam-gnc", false).poses, solved("gtsam-lm", graph).poses)
    yield at_most("false_loops/intel-500/gtsam-gnc", off, 0.05, "ATE of gtsam-gnc with 10 % false loops")


def ate_rmse(poses: Array, reference: Array) -> float:
    """Return the RMSE of positions after a rigid alignment, in m."""
    moved = transform_points(align(reference, poses), poses[:, :2])
    return float(np.sqrt(np.mean(np.sum((moved - reference[:, :2]) ** 2, axis=1))))


def posegraph(data: Path | None, name: str) -> Path:
    """Return the path of a standard pose graph in the folder of recordings."""
    if data is None:
        raise SystemExit("backend_bench: this study needs --data, the folder of recordings")
    return data / "posegraphs" / name


STUDIES: dict[str, Callable[[Path | None], Iterator[Metric]]] = {
    "sweep": sweep_study,
    "overhead": overhead_study,
    "gnc": gnc_study,
    "isam2": isam2_study,
    "orders": orders_study,
    "robust": robust_study,
    "bounds": bound_bench.study,
}


if __name__ == "__main__":
    main()
