"""Run a study: first the graphs, then the cells; each result is stored as soon as it is known."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from hybridmap import provenance
from hybridmap.backends.base import SolveStatus
from hybridmap.errors import StudyError
from hybridmap.study import cell as cells
from hybridmap.study import sources
from hybridmap.study.cell import UNMAPPED, CellResult
from hybridmap.study.cells import Grid
from hybridmap.study.folder import StudyFolder
from hybridmap.study.pools import Lost, Pool
from hybridmap.study.sources import SourceTask

log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]

CRASHED = "crashed"
WITHOUT_RESULT = (SolveStatus.FAILED, UNMAPPED, CRASHED)
"""Status of cells that an error left without a result."""
"""Status of a cell that raised what no back-end may raise, or that killed its workers; not kept, tried again."""


@dataclass(frozen=True, slots=True)
class Outcomes:
    """The results at the end of a run.

    Attributes:
        results: cache key of a result -> the result, for every cell of the grid.
        computed: number of results that this run computed, crashed cells included; cells that share a key count once. The
            others were stored by earlier runs, or their graph could not be made.
    """

    results: dict[str, CellResult]
    computed: int


def run(grid: Grid, folder: StudyFolder, pool: Pool, progress: Progress | None = None) -> Outcomes:
    """Compute the results that are missing in the folder, which the caller has locked (`output.held`).

    First the graphs that are missing are made, then the cells computed; each result is stored at once. An interrupted run
    continues the next time; the results are the same bit for bit. A cell that crashes is a result too, but is not stored.

    Args:
        grid: the cells.
        folder: where results are stored.
        pool: runs the tasks.
        progress: called at the start and after each graph and each cell, with the number of graphs and cells done (those stored
            by earlier runs included) and their total.

    Returns:
        The results of all cells of the grid, stored ones included.

    Raises:
        OutputError: the folder cannot be written to.
        StudyError: the workers have other code or libraries than this process.
    """
    unique = {cell.key: cell for cell in grid.cells}
    results = {key: result for key in unique if (result := folder.result(key)) is not None}
    missing = [cell for key, cell in unique.items() if key not in results]
    graphs: dict[str, bytes | Lost] = {}
    needed = list(dict.fromkeys(cell.source_key for cell in missing))

    def count() -> None:
        if progress is not None:
            progress(len(results) + len(graphs), len(unique) + len(needed))

    count()
    for key, graph in _graphs([grid.sources[key] for key in needed], folder, pool):
        graphs[key] = graph
        count()
    tasks = []
    for cell in missing:
        graph = graphs[cell.source_key]
        if isinstance(graph, Lost):
            results[cell.key] = _crashed(cell.key, graph)
        else:
            tasks.append(grid.task(cell, graph))
    for index, outcome in pool.run(cells.run, tasks):
        results[tasks[index].key] = _kept(tasks[index].key, outcome, folder)
        count()
    return Outcomes(results, computed=len(tasks))


def _graphs(tasks: Sequence[SourceTask], folder: StudyFolder, pool: Pool) -> Iterator[tuple[str, bytes | Lost]]:
    """(key, packed graph) for each task: stored by an earlier run, or made now and stored."""
    missing = []
    for task in tasks:
        data = folder.frozen(task.key)
        if data is None:
            missing.append(task)
        else:
            yield task.key, data
    for index, outcome in pool.run(sources.prepare, missing):
        key = missing[index].key
        if isinstance(outcome, Lost):
            yield key, outcome
            continue
        _require_same_code(outcome.code)
        folder.keep_frozen(key, outcome.frozen)
        yield key, outcome.frozen


def _kept(key: str, outcome: CellResult | Lost, folder: StudyFolder) -> CellResult:
    """Store and return a result; a lost one is not stored."""
    if isinstance(outcome, Lost):
        return _crashed(key, outcome)
    _require_same_code(outcome.code)
    folder.keep_result(outcome)
    return outcome


def _crashed(key: str, loss: Lost) -> CellResult:
    log.warning("a cell crashed: %s", loss.message)
    return CellResult(key, CRASHED, loss.message)


def _require_same_code(code: str) -> None:
    if code != provenance.solving():
        what = "a worker has another version of hybridmap or its libraries than this process"
        raise StudyError(f"{what}: install the same on all machines, and do not edit it meanwhile")
