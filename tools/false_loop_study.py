r"""What a back-end makes of false loops in the standard graphs, over seeds: the table of the false-loop bars.

    python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/intel.g2o --seeds 10 --shares 0.1 0.4 0.7
    python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/manhattanOlson3500.g2o --seeds 3 --shares 0.1 0.2 0.4
    python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/intel.g2o --bias 0.06 --shares 0 --seeds 1 --modes random \
        --backends odometry relaxation-ratslam relaxation-robust gtsam-lm gtsam-dcs gtsam-cauchy gtsam-gnc gtsam-calibrated

    python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/intel.g2o --dropouts 0.01 --shares 0 --modes random \
        --backends gtsam-lm gtsam-cauchy gtsam-gnc --set robust.odometry=cauchy
    python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/intel.g2o --seeds 3 --shares 0 0.1 0.4 \
        --backends gtsam-lm gtsam-gnc --set consistency.enabled=true

`--set` takes settings of the section `backends`. ATE is against the least-squares optimum of the clean graph. A share of
0.4 means that 40 % of all loops are false.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybridmap import backends
from hybridmap.cli.choose import parse_settings
from hybridmap.config import Config
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array, align, transform_points
from hybridmap.graph.io import read_graph
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import Metric, to_json
from hybridmap.study.false_loops import bend, drop_out, inject


@dataclass(frozen=True, slots=True)
class Cell:
    """One graph with false loops through one back-end.

    Attributes:
        ate_m: against the clean optimum.
        lost: true loops rejected.
        kept: false loops not rejected.
        cpu_s: process time.
    """

    ate_m: float
    lost: int
    kept: int
    cpu_s: float


def main() -> None:
    """Print one line a share, kind of false loops and back-end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graph", type=Path)
    parser.add_argument("--backends", nargs="+", default=["gtsam-gnc"], metavar="NAME")
    parser.add_argument("--shares", nargs="+", type=float, default=[0.1, 0.4])
    parser.add_argument("--modes", nargs="+", choices=["random", "aliased"], default=["random", "aliased"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--bias", type=float, default=0.0, metavar="RAD_M", help="heading bias added to odometry, rad/m")
    parser.add_argument("--dropouts", type=float, default=0.0, metavar="SHARE", help="of odometry edges 20 deg and 0.5 m off")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of the back-ends")
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output; the table goes to stderr")
    chosen = parser.parse_args()
    table, metrics = sys.stderr if chosen.json else sys.stdout, list[Metric]()
    graph = read_graph(chosen.graph)
    clean = backends.create("gtsam-lm").solve(graph).poses
    graph = bend(graph, chosen.bias) if chosen.bias else graph
    settings = Config.load(None, {f"backends.{key}": value for key, value in parse_settings(chosen.set).items()}).backends
    print(f"{chosen.graph.name}: {graph.n_nodes} nodes, {int(graph.is_loop.sum())} true loops; ATE in m, CPU in s", file=table)
    print(
        f"{'back-end':20}{'kind':9}{'share':>6}{'ATE median':>12}{'max':>9}{'<= 0.05':>9}"
        f"{'lost max':>12}{'kept max':>10}{'CPU':>8}",
        file=table,
    )
    for name in chosen.backends:
        for share in chosen.shares:
            for mode in chosen.modes:
                seeds = range(chosen.first, chosen.first + chosen.seeds)
                cells = [cell(disturbed(graph, chosen.dropouts, share, mode, s), graph, clean, name, settings) for s in seeds]
                print(line(name, mode, share, cells, int(graph.is_loop.sum())), file=table, flush=True)
                metrics += metrics_of(f"{name}-{mode}-{share:.0%}", cells, int(graph.is_loop.sum()))
    if chosen.json:
        print(to_json({"graph": str(chosen.graph)}, metrics))


def disturbed(graph: PoseGraph, dropouts: float, share: float, mode: str, seed: int) -> PoseGraph:
    """The graph with false loops, and then with drop-outs of its wheels."""
    rng = np.random.default_rng(seed)
    false = inject(graph, share, mode, rng)
    return drop_out(false, dropouts, rng) if dropouts else false


def cell(false: PoseGraph, graph: PoseGraph, clean: Array, name: str, settings: BackendsConfig) -> Cell:
    """Solve one disturbed graph in a fresh back-end."""
    started = time.process_time()
    solution = backends.create(name, settings).solve(false)
    cpu_s = time.process_time() - started
    rejected = np.array(solution.report.rejected_edge_ids, dtype=np.int64)
    lost = int(np.isin(rejected, graph.edge_ids).sum())
    return Cell(ate(solution.poses, clean), lost, false.n_edges - graph.n_edges - (len(rejected) - lost), cpu_s)


def ate(poses: Array, reference: Array) -> float:
    """RMSE of position after alignment, m."""
    moved = transform_points(align(reference, poses), poses[:, :2])
    return float(np.sqrt(np.mean(np.sum((moved - reference[:, :2]) ** 2, axis=1))))


def metrics_of(where: str, cells: list[Cell], true_loops: int) -> list[Metric]:
    """Figures over the seeds."""
    errors = [c.ate_m for c in cells]
    return [
        Metric(f"ate_median/{where}", float(np.median(errors)), "m", "against the clean optimum"),
        Metric(f"ate_max/{where}", max(errors), "m", "in the worst seed"),
        Metric(f"within_5_cm/{where}", sum(error <= 0.05 for error in errors), "1", f"of {len(cells)} seeds"),
        Metric(f"true_lost/{where}", 100.0 * max(c.lost for c in cells) / true_loops, "%", "of true loops, in the worst seed"),
        Metric(f"false_kept/{where}", max(c.kept for c in cells), "1", "in the worst seed"),
    ]


def line(name: str, mode: str, share: float, cells: list[Cell], true_loops: int) -> str:
    """One line of the table."""
    errors = np.array([c.ate_m for c in cells])
    lost = max(c.lost for c in cells)
    figures = f"{np.median(errors):12.4f}{errors.max():9.4f}{f'{(errors <= 0.05).sum()}/{len(cells)}':>9}"
    counts = f"{f'{lost} {lost / true_loops:.2%}':>12}{max(c.kept for c in cells):10d}"
    return f"{name:20}{mode:9}{share:6.0%}{figures}{counts}{np.median([c.cpu_s for c in cells]):8.2f}"


if __name__ == "__main__":
    main()
