"""The systems beside each other: errors of their maps of the same drives, over the seeds, and paired with one of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hybridmap.backends.base import ODOMETRY
from hybridmap.geometry import Array
from hybridmap.study.cell import CellResult
from hybridmap.study.model import SourceConfig, StatisticsConfig
from hybridmap.study.statistics import Interval, holm, median_of, signed_rank
from hybridmap.study.study import Study
from hybridmap.verdict import Verdict

BASELINES = {"lab": "bionic", "office": "ratslam", "corridor": "scan-to-map", "corridor-landmarks": "scan-to-map"}
"""World -> the system with which the others are compared there, drive by drive."""

SYSTEMS = {
    "paper": "the paper's system as printed",
    "bionic": "the paper's system repaired: cells, scanline profiles and relaxation; nothing is registered",
    "rgbd": "the default for a camera: features, registration of depth, graph optimisation",
    "laser": "the default for a laser: scan matching, loops between submaps, graph optimisation",
    "ratslam": "RatSLAM: a network of pose cells, view cells, and relaxation of an experience map",
    "scan-to-map": "a conventional SLAM: each scan is matched to the map of the last metres, and no loop is closed",
}
"""Name of a system, which is a configuration -> what it is."""

_GRADES = {float(verdict.grade): str(verdict) for verdict in Verdict}


@dataclass(frozen=True, slots=True)
class Paired:
    """A system compared with the baseline of its world, on the same drives.

    Attributes:
        baseline: the other system.
        difference_m: median of its error minus the baseline's, m.
        lower: share of the drives on which its error is lower.
        p: of Wilcoxon's signed-rank test, corrected by Holm for the systems of the world; NaN with too few drives.
    """

    baseline: str
    difference_m: Interval
    lower: float
    p: float


@dataclass(frozen=True, slots=True)
class SystemResult:
    """The maps that one system made of the drives through one world.

    Attributes:
        world, system: names of world and configuration.
        drives: number of drives.
        errors_m: seed -> error of the map (ATE), for the drives that have one.
        error_m, odometry_m, ratio: medians of the error, of that of the system's odometry, and of their ratio.
        loops, right, recall: medians of the number of loops, the share of them that are right, and the share of revisits with
            one; NaN where there are none.
        verdicts: verdict on the map -> number of drives.
        cpu_s: median process time of a drive.
        lost: seeds of the drives whose back-end diverged or failed: they have no map, and odometry stands for it.
        paired: comparison with the baseline of the world; None for the baseline, or where that was not run.
    """

    world: str
    system: str
    drives: int
    errors_m: Mapping[int, float]
    error_m: Interval
    odometry_m: Interval
    ratio: Interval
    loops: float
    right: float
    recall: float
    verdicts: Mapping[str, int]
    cpu_s: float
    lost: frozenset[int] = frozenset()
    paired: Paired | None = None

    @property
    def without_map(self) -> str:
        """Words on the drives that have no map; empty if all have one."""
        if not self.lost:
            return ""
        where = "" if len(self.lost) == self.drives else f" in {len(self.lost)} of {self.drives}"
        return f"no map{where}: odometry's error"


def results_of(study: Study) -> list[SystemResult]:
    """One result for each source of the study, which is a world mapped by a system; in its order."""
    found = [_result(source, study) for source in study.grid.study.sources]
    by_place = {(one.world, one.system): one for one in found}
    statistics = study.grid.study.statistics
    paired = []
    for one in found:
        other = by_place.get((one.world, BASELINES[one.world]))
        compared = None if other is None or other is one else _compared(one, other, statistics)
        paired.append(replace(one, paired=compared))
    return _corrected(paired)


def _result(source: SourceConfig, study: Study) -> SystemResult:
    rows = [(cell, result) for cell, result in study.rows if cell.source == source.title]
    of_map = {cell.seed or 0: result for cell, result in rows if cell.backend != ODOMETRY}
    wheels = {cell.seed or 0: result for cell, result in rows if cell.backend == ODOMETRY}
    errors, odometry = _known(of_map, "ate_m"), _known(wheels, "ate_m")
    statistics = study.grid.study.statistics
    ratios = [errors[seed] / odometry[seed] for seed in errors if odometry.get(seed)]
    grades = Counter(_known(of_map, "verdict").values())
    return SystemResult(
        world=source.simulated or "",
        system=source.config or "",
        drives=len(of_map),
        errors_m=errors,
        error_m=median_of(np.array(list(errors.values())), statistics),
        odometry_m=median_of(np.array(list(odometry.values())), statistics),
        ratio=median_of(np.array(ratios), statistics),
        loops=_median(_known(of_map, "loops").values()),
        right=_median(_known(of_map, "loop_precision").values()),
        recall=_median(_known(of_map, "loop_recall").values()),
        verdicts={name: grades[grade] for grade, name in _GRADES.items() if grades[grade]},
        cpu_s=_median([result.timings["cpu_s"] for result in of_map.values() if "cpu_s" in result.timings]),
        lost=frozenset(seed for seed, result in of_map.items() if result.lost),
    )


def _known(results: Mapping[int, CellResult], figure: str) -> dict[int, float]:
    """Seed -> a figure, where it is known."""
    return {seed: value for seed, result in results.items() if (value := result.figures.get(figure)) is not None}


def _median(values: Iterable[float]) -> float:
    found = list(values)
    return float(np.median(found)) if found else math.nan


def _compared(one: SystemResult, other: SystemResult, statistics: StatisticsConfig) -> Paired:
    both = [seed for seed in one.errors_m if seed in other.errors_m]
    apart: Array = np.array([one.errors_m[seed] - other.errors_m[seed] for seed in both])
    lower = float(np.mean(apart < 0.0)) if both else math.nan
    return Paired(other.system, median_of(apart, statistics), lower, signed_rank(apart))


def _corrected(results: Sequence[SystemResult]) -> list[SystemResult]:
    """The results, with the p values of each world corrected for the systems that are compared there."""
    found = list(results)
    for world in dict.fromkeys(one.world for one in results):
        at = [k for k, one in enumerate(results) if one.world == world and one.paired is not None]
        ps = [paired.p for k in at if (paired := results[k].paired) is not None]
        for k, p in zip(at, holm(ps), strict=True):
            paired = results[k].paired
            found[k] = replace(results[k], paired=None if paired is None else replace(paired, p=p))
    return found


def of(results: Sequence[SystemResult], world: str) -> list[SystemResult]:
    """The results of one world."""
    return [one for one in results if one.world == world]
