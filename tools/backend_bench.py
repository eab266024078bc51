"""What the back-ends cost, by process time and as ratios within one run.

    python tools/backend_bench.py sweep
    python tools/backend_bench.py overhead gnc isam2 --data $HYBRIDMAP_DATA

`sweep`     relaxation-ratslam against loops in plain Python over the same links in the same order: 1,000 nodes, 1,500 edges
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hybridmap.backends.link_blocks import BlockSweeps
from hybridmap.backends.links import Links, Planar
from hybridmap.geometry import Array, between, compose, exp, wrap_angle
from hybridmap.graph.connectivity import chain
from hybridmap.graph.pose_graph import EdgeKind, PoseGraph

_SWEEPS = 400


def main() -> None:
    """Run the studies that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="+", choices=sorted(STUDIES))
    parser.add_argument("--data", type=Path, default=None, help="folder with posegraphs/, for all but `sweep`")
    chosen = parser.parse_args()
    for study in chosen.studies:
        for line in STUDIES[study](chosen.data):
            print(line, flush=True)


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


def loop_over_arrays(graph: PoseGraph, links: Links, theta: float, sweeps: int) -> Array:
    """The rule as one writes it: a Python loop over the rows of the arrays."""
    poses = graph.initial.copy()
    for _ in range(sweeps):
        for e in links.order:
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


def loop_over_floats(graph: PoseGraph, links: Links, theta: float, sweeps: int) -> Array:
    """The same with everything taken out of numpy beforehand: as fast as plain Python gets."""
    x, y, yaw = graph.initial.T.tolist()
    rows = np.column_stack([links.sources, links.targets]).tolist()
    of_links = [(*ends, *delta) for ends, delta in zip(rows, graph.deltas[links.order].tolist(), strict=True)]
    two_pi = 2.0 * math.pi
    for _ in range(sweeps):
        for source, target, dx, dy, turn in of_links:
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


def sweep_study(data: Path | None) -> list[str]:
    """A sweep of the per-link rule against plain Python, all in the same order of links."""
    del data
    graph = drive(1000, 1500, np.random.default_rng(0))
    links, theta = Links.of(graph), 0.5
    blocks = BlockSweeps(links, graph.n_nodes, theta)
    start = Planar.of(graph.initial)
    reached = blocks.run(start, 20, -1.0).poses.to_array()
    for plain in (loop_over_arrays, loop_over_floats):
        off = reached - plain(graph, links, theta, 20)
        assert max(np.abs(off[:, :2]).max(), np.abs(wrap_angle(off[:, 2])).max()) < 1e-9
    arrays = cpu_s(lambda: loop_over_arrays(graph, links, theta, 5)) / 5
    floats = cpu_s(lambda: loop_over_floats(graph, links, theta, 100)) / 100
    ours = cpu_s(lambda: blocks.run(start, _SWEEPS, -1.0)) / _SWEEPS

    def swept() -> None:
        poses = start
        for _ in range(100):
            poses = links.sweep(poses, theta)

    single = cpu_s(swept) / 100
    prepare = cpu_s(lambda: BlockSweeps(links, graph.n_nodes, theta))
    return [
        f"sweep of {graph.n_nodes} nodes, {graph.n_edges} edges in {len(links.levels)} levels, us of CPU:",
        f"  loop over arrays {arrays * 1e6:.0f}, loop over floats {floats * 1e6:.0f}",
        f"  level by level {single * 1e6:.0f}: {arrays / single:.1f} x and {floats / single:.1f} x as fast",
        f"  blocks of sweeps {ours * 1e6:.0f}: {arrays / ours:.1f} x and {floats / ours:.1f} x",
        f"  prepared once in {prepare * 1e6:.0f}",
    ]


STUDIES: dict[str, Callable[[Path | None], list[str]]] = {"sweep": sweep_study}


if __name__ == "__main__":
    main()
