"""Map simulated RGB-D drives and hold revisits, edges, maps and costs against the truth and the bars.

    python tools/rgbd_study.py --recordings /somewhere                      office and lab, seeds 1 to 5
    python tools/rgbd_study.py --recordings /somewhere --worlds lab --seeds 1 --set vision.rgbd.closing.accept=3
    python tools/rgbd_study.py --recordings /somewhere --worlds corridor corridor-landmarks
    python tools/rgbd_study.py --recordings /somewhere --worlds office --seeds 1 --camera 320x240@10 --backend gtsam-isam2

Drives are rendered once and kept as recordings in the folder; maps are made in memory and nothing of them is written.

A *revisit* is a node that comes back to within 1 m and 30 degrees of a node made more than 10 s before; it is found if a right
loop edge (within 0.5 m and 10 degrees of the truth) starts within three nodes of it. An edge is *false* if the robust
back-end gives it a weight above 0.5 and it is wrong by more than 0.5 m or 10 degrees. Errors of edges are those of all loop
edges in the graph, right or wrong. chi2 is the median of the edges' squared errors over their own covariances, as a multiple of
what it should be: 1 if they are calibrated, less if they claim too little. ms: process time a frame, by stage (matching: mostly
verification) and in all, whatever the mapper does included; its bar is for `gtsam-isam2` alone, on 320x240 pictures at 10 Hz.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mapping_runs import EdgeErrors, Run, edge_errors, map_in_memory, recorded

from hybridmap.cli.choose import parse_settings
from hybridmap.config import Config
from hybridmap.evaluate.closures import ClosureLimits, closure_errors
from hybridmap.evaluate.edges import EXPECTED_MEDIAN
from hybridmap.graph.edges import EdgeKind
from hybridmap.metrics import Metric, to_json

LIMITS = ClosureLimits(right_m=0.5, right_deg=10.0, revisit_m=1.0, revisit_deg=30.0, revisit_gap_s=10.0, window_nodes=3)


@dataclass(frozen=True)
class Bar:
    """What a figure must keep to: at least (`least`) or at most `limit`."""

    limit: float
    least: bool = False

    def holds(self, value: float) -> bool:
        """Whether it does."""
        return value >= self.limit if self.least else value <= self.limit


BARS: dict[str, Bar] = {
    "recall": Bar(0.85, least=True),
    "false": Bar(0),
    "edge_median_cm": Bar(2.0),
    "edge_median_deg": Bar(0.3),
    "edge_p95_cm": Bar(8.0),
    "edge_p95_deg": Bar(1.5),
    "chi2_loop": Bar(2.0),
    "chi2_registration": Bar(2.0),
    "ms_frame_isam2": Bar(10.0),
}
ATE_BARS_M = {"office": 0.06, "lab": 0.02}
EVERYWHERE = ("false", "ms_frame_isam2")
"""Bars of every world; the others are those of office and lab."""
LEAST_CHI2 = 0.5
"""Medians of chi2, as multiples of the expected one, lie between this and the bar."""


def main() -> None:
    """Parse the command line, map, print."""
    arguments = _parser().parse_args()
    out = sys.stderr if arguments.json else sys.stdout
    width, height, rate = _camera(arguments.camera)
    camera = {} if width is None else {"width_px": width, "height_px": height, "rate_hz": rate}
    settings = {f"simulation.camera.{key}": value for key, value in camera.items()}
    overrides = parse_settings(arguments.set)
    if arguments.backend:
        overrides["backends.names"] = arguments.backend
    rows = []
    for world in arguments.worlds:
        for seed in arguments.seeds:
            drive = recorded(world, seed, settings, arguments.recordings)
            config = Config.load(world, {"seed": seed, **settings, **overrides})
            figures = figures_of(map_in_memory(drive, config))
            rows.append((world, seed, figures))
            print("\n".join(table(rows[-1:])), file=out, flush=True)
    print("\n".join(["", *table(rows)]), file=out)
    if arguments.json:
        print(to_json({}, [metric for row in rows for metric in metrics_of(*row)]))


def figures_of(run: Run) -> dict[str, float]:
    """Every figure of one drive."""
    assert run.truth is not None
    report = run.solutions[run.primary].report
    loops = edge_errors(run, EdgeKind.LOOP)
    closures = closure_errors(run.experiences, run.truth, rejected=frozenset(report.rejected_edge_ids), limits=LIMITS)
    wrong = (loops.trans_m > LIMITS.right_m) | (loops.rot_deg > LIMITS.right_deg)
    weights = np.array([report.weights.get(int(number), 1.0) for number in loops.numbers])
    frames = max(run.frames, 1)
    cost = {name: 1e3 * seconds / frames for name, seconds in run.cpu_s.items()}
    return {
        "recall": closures.recall,
        "loops": float(len(loops.numbers)),
        "false": float(np.count_nonzero(wrong & (weights > 0.5))),
        **_edge_figures("edge", loops),
        "chi2_loop": _median(loops.chi2) / EXPECTED_MEDIAN,
        "chi2_registration": _median(edge_errors(run, EdgeKind.REGISTRATION).chi2) / EXPECTED_MEDIAN,
        "chi2_odometry": _median(edge_errors(run, EdgeKind.ODOMETRY).chi2) / EXPECTED_MEDIAN,
        "ate_odometry": run.ate_m("odometry"),
        **{f"ate_{name}": run.ate_m(name) for name in run.solutions if name != "odometry"},
        **{f"ms_{name}": cost[name] for name in cost},
        "ms_frame_isam2" if list(run.solutions) == ["gtsam-isam2"] else "ms_frame": sum(cost.values()),
    }


def metrics_of(world: str, seed: int, figures: dict[str, float]) -> list[Metric]:
    """Every figure of one drive, held against its bar if it has one."""
    found = []
    for name, value in figures.items():
        bar = _bar(name, world)
        limit, passed = (None, None) if bar is None else (bar.limit, _holds(name, bar, value))
        about = "" if bar is None else f"at {'least' if bar.least else 'most'} {bar.limit:g}"
        found.append(Metric(f"{name}/{world}-{seed}", value, _unit(name), about, limit, passed))
    return found


def table(rows: Sequence[tuple[str, int, dict[str, float]]]) -> list[str]:
    """Markdown: one column a drive, one line a figure, what misses its bar marked."""
    names = list(dict.fromkeys(name for _, _, figures in rows for name in figures))
    lines = [
        "| figure | " + " | ".join(f"{world} {seed}" for world, seed, _ in rows) + " | bar |",
        "|---|" + "---:|" * (len(rows) + 1),
    ]
    for name in names:
        cells = [_cell(name, world, figures[name]) if name in figures else "" for world, _, figures in rows]
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {_bar_text(name, {world for world, _, _ in rows})} |")
    return lines


def _cell(name: str, world: str, value: float) -> str:
    bar = _bar(name, world)
    return f"{value:.4g}" + ("" if bar is None or _holds(name, bar, value) else " ✗")


def _unit(name: str) -> str:
    endings = {"_cm": "cm", "_deg": "deg"}
    beginnings = {"ate_": "m", "ms_": "ms"}
    ended = next((unit for ending, unit in endings.items() if name.endswith(ending)), "1")
    return next((unit for beginning, unit in beginnings.items() if name.startswith(beginning)), ended)


def _holds(name: str, bar: Bar, value: float) -> bool:
    return bar.holds(value) and not (name.startswith("chi2") and value < LEAST_CHI2)


def _bar(name: str, world: str) -> Bar | None:
    if world not in ATE_BARS_M:
        return BARS.get(name) if name in EVERYWHERE else None
    return Bar(ATE_BARS_M[world]) if name == "ate_gtsam-gnc" else BARS.get(name)


def _bar_text(name: str, worlds: set[str]) -> str:
    bars = {bar.limit: bar for bar in (_bar(name, world) for world in sorted(worlds)) if bar is not None}
    return ", ".join(f"{'>=' if bar.least else '<='} {bar.limit:g}" for bar in bars.values())


def _edge_figures(name: str, errors: EdgeErrors) -> dict[str, float]:
    centimetres = 100.0 * errors.trans_m
    return {
        f"{name}_median_cm": _median(centimetres),
        f"{name}_p95_cm": _quantile(centimetres, 0.95),
        f"{name}_median_deg": _median(errors.rot_deg),
        f"{name}_p95_deg": _quantile(errors.rot_deg, 0.95),
    }


def _median(values: np.ndarray) -> float:
    return _quantile(values, 0.5)


def _quantile(values: np.ndarray, share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def _camera(text: str | None) -> tuple[int | None, int | None, float | None]:
    if text is None:
        return None, None, None
    size, rate = text.split("@")
    width, height = size.split("x")
    return int(width), int(height), float(rate)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True, help="folder in which the rendered drives are kept")
    parser.add_argument("--worlds", nargs="+", default=["office", "lab"], help="simulated worlds")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5], help="seeds of the sensors' errors")
    parser.add_argument("--camera", help="size and rate of the camera, such as 320x240@10; default: the world's")
    parser.add_argument("--backend", nargs="+", help="back-ends; default: the configuration's")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output; the table goes to stderr")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings")
    return parser


if __name__ == "__main__":
    main()
