"""Run everything that a reproduction needs; what an earlier run in the same folder stored is not computed again."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from hybridmap.metrics import Metric
from hybridmap.output import Held
from hybridmap.reproduction.cells import CellsMeasured, End, ends, measured_cells
from hybridmap.reproduction.equations import equations
from hybridmap.reproduction.systems import SystemResult, results_of
from hybridmap.study import StudyConfig
from hybridmap.study.pools import Pool
from hybridmap.study.study import Study, run_study
from hybridmap.verification import Scale

STUDY = "study"
"""Folder of the study within that of a reproduction."""

Advance = Callable[[int, int | None], None]


@dataclass(frozen=True, slots=True)
class Reproduction:
    """Everything that was measured.

    Attributes:
        cells: the verification of the cells.
        ends: seed -> where path integration over 16.8 m ends.
        study: the drives by every system.
        results: the systems beside each other.
    """

    cells: CellsMeasured
    ends: dict[int, End]
    study: Study
    results: list[SystemResult]

    @property
    def failed(self) -> list[str]:
        """Rows of the verification and bars of the study that are missed, and drives without a result."""
        rows = [row.name for row in self.cells.rows if row.passed is False]
        bars = [f"{verdict.bar.figure}/{verdict.cell.source}" for verdict in self.study.missed]
        lost = [f"{cell.source}, seed {cell.seed}, {cell.backend}: no result" for cell in self.study.without_result]
        return rows + bars + lost

    @property
    def head(self) -> dict[str, Any]:
        """Keys of `metrics.json` besides its list of metrics, with their values."""
        seeds = list(self.study.grid.study.seeds)
        return {"seeds": seeds, "passed": not self.failed, "failed": self.failed, "status": self.study.head["status"]}

    @property
    def metrics(self) -> list[Metric]:
        """The rows of the verification, and of each system in each world the medians over the seeds."""
        return self.cells.rows + [metric for one in self.results for metric in _metrics(one)]


def plan(seeds: int) -> StudyConfig:
    """The study of a reproduction, with so many seeds: 1, 2 and so on.

    Raises:
        ConfigError: no seed, or too many.
    """
    return StudyConfig.load("reproduce", {"seeds": list(range(1, seeds + 1))})


def reproduce(
    place: Held,
    study: StudyConfig,
    scale: Scale,
    pool: Pool,
    progress: Callable[[str], AbstractContextManager[Advance]],
) -> Reproduction:
    """Verify the cells, and map every drive once by every system.

    Args:
        place: the folder, locked against other runs.
        study: the study of the drives, see `plan`.
        scale: size of the verification.
        pool: runs the drives.
        progress: label of a stage -> context that gives the function to call as it progresses.

    Raises:
        OutputError: the folder cannot be written to.
        ConfigError: the table of equations in docs/paper.md is not the one of `paper`.
        StudyError: the workers cannot be used.
    """
    equations()  # read at once: the page needs them after all drives
    with progress("verifying the cells") as advance:
        cells = measured_cells(place.path, scale, advance)
    found = ends(place.path, study.seeds)
    with progress("mapping the drives") as advance:
        done = run_study(study, place.path / STUDY, pool, advance)
    return Reproduction(cells, found, done, results_of(done))


def _metrics(one: SystemResult) -> list[Metric]:
    stage = f"{one.world}/{one.system}"
    over = f"median of {one.drives} drives" + (f" ({one.without_map})" if one.lost else "")
    return [
        Metric(f"ate_median/{stage}", one.error_m.value, "m", f"error of the map, {over}; {one.error_m}"),
        Metric(f"ate_odometry_median/{stage}", one.odometry_m.value, "m", f"error of its odometry, {over}"),
        Metric(f"ate_ratio_median/{stage}", one.ratio.value, "1", f"error of the map over that of its odometry, {over}"),
        Metric(f"without_map/{stage}", len(one.lost), "1", f"of {one.drives} drives: diverged or failed, so odometry counts"),
        Metric(f"loops_median/{stage}", one.loops, "1", f"loops in the graph, {over}"),
        Metric(f"loop_precision_median/{stage}", one.right, "1", f"share of the loops that are right, {over}"),
        Metric(f"loop_recall_median/{stage}", one.recall, "1", f"share of the revisits with a loop, {over}"),
    ]
