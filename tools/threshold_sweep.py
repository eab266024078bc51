r"""Map a source with one setting from far too strict to far too loose; the robust map must never be worse than odometry.

    python tools/threshold_sweep.py office --key vision.rgbd.pnp.min_inliers --values 400 150 60 30 12 8 6 4
    python tools/threshold_sweep.py office --key vision.matching.c_t --values 0.05 0.1 0.2 0.3 0.4 0.6 1 9 \
        --set vision.rgbd.verify=none
    python tools/threshold_sweep.py fr079.mcap --config laser --relations relations.txt \
        --key vision.laser.probes.fit_min --values 0.99 0.95 0.85 0.7 0.5 0.3 0.1 0.01

Errors are ATE against the source's own truth, or, with `--relations`, the mean error of verified relations. A loop counts as
wrong if it is more than a metre from the truth. Exit code 1 if the map is worse than odometry at any value.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from mapping_runs import judged_session

from hybridmap.cli.choose import parse_settings
from hybridmap.config import Config
from hybridmap.evaluate.edges import edge_errors
from hybridmap.graph.edges import EdgeKind
from hybridmap.metrics import Metric, to_json
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.open import open_stream
from hybridmap.trajectory import read_tum

ROUND_OFF_M = 1e-6
"""A map without any loop and registration is the odometry's; how far either may be off the other by rounding."""


@dataclass(frozen=True)
class Outcome:
    """One value of the setting.

    Attributes:
        value: of the setting.
        loops, rejected, wrong, wrong_kept: loop edges in the graph, those that the back-end gave no weight, those wrong by more
            than a metre (-1: no truth), and those of them that it kept.
        odometry_m, map_m: error of odometry and of the primary back-end.
    """

    value: str
    loops: int
    rejected: int
    wrong: int
    wrong_kept: int
    odometry_m: float
    map_m: float

    @property
    def harmless(self) -> bool:
        """The map is no worse than odometry."""
        return self.map_m <= self.odometry_m + ROUND_OFF_M


def main() -> None:
    """Parse the command line, sweep, print."""
    options = _parser().parse_args()
    table = sys.stderr if options.json else sys.stdout
    outcomes = []
    print(HEADER, file=table, flush=True)
    for value in options.values:
        settings = parse_settings([*options.set, f"{options.key}={value}"])
        config = Config.load(options.config or options.source, settings)
        outcomes.append(outcome(options.source, config, value, options.relations))
        print(line(outcomes[-1]), file=table, flush=True)
    worse = [one.value for one in outcomes if not one.harmless]
    print(f"\nworse than odometry: {', '.join(worse) if worse else 'never'}", file=table)
    if options.json:
        print(to_json({"key": options.key}, [metric_of(one) for one in outcomes]))
    raise SystemExit(1 if worse else 0)


def outcome(source: str, config: Config, value: str, relations: Path | None = None) -> Outcome:
    """Map a source into a folder that is thrown away, and judge it."""
    with judged_session(open_stream(source, config), config, relations) as (session, metrics):
        measure = "ate_rmse" if relations is None else "relation_trans_mean"
        primary = config.backends.names[0]
        wrong, kept, loops, rejected = _loops(session, primary)
        return Outcome(value, loops, rejected, wrong, kept, metrics[f"{measure}/odometry"], metrics[f"{measure}/{primary}"])


HEADER = (
    "| value | loops | no weight | wrong by > 1 m | of them kept | odometry, m | map, m | |\n"
    "|---|---:|---:|---:|---:|---:|---:|---|"
)


def metric_of(one: Outcome) -> Metric:
    """The map's error at one value; its bar is the error of odometry."""
    return Metric(f"map/{one.value}", one.map_m, "m", "error of the robust map", one.odometry_m, one.harmless)


def line(one: Outcome) -> str:
    """A line of the table."""
    wrong, kept = (str(n) if n >= 0 else "?" for n in (one.wrong, one.wrong_kept))
    verdict = "" if one.harmless else "✗ worse"
    cells = (one.value, one.loops, one.rejected, wrong, kept, f"{one.odometry_m:.4f}", f"{one.map_m:.4f}", verdict)
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _loops(session: SessionFolder, primary: str) -> tuple[int, int, int, int]:
    """Wrong loops, those of them kept, all loops in the graph, and those of no weight."""
    with MapStore.open(session.path) as store:
        experiences, report = store.map(), store.solutions()[primary].report
    loops = int(experiences.pose_graph().is_loop.sum())
    if not session.groundtruth.is_file():
        return -1, -1, loops, len(report.rejected_edge_ids)
    errors = edge_errors(experiences, read_tum(session.groundtruth), report.weights).get(EdgeKind.LOOP)
    if errors is None:
        return 0, 0, loops, len(report.rejected_edge_ids)
    return errors.wrong, errors.wrong_kept, loops, len(report.rejected_edge_ids)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="recording or simulated world")
    parser.add_argument("--config", help="named configuration or file; default: that of the world")
    parser.add_argument("--key", required=True, help="the setting, such as vision.rgbd.pnp.min_inliers")
    parser.add_argument("--values", nargs="+", required=True, help="from far too strict to far too loose")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings that stay")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output; the table goes to stderr")
    parser.add_argument("--relations", type=Path, help="verified relations, where there is no truth")
    return parser


if __name__ == "__main__":
    main()
