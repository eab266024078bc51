"""The grid of a study: its cells in order, each with the key of its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product

from hybridmap.study.cell import CellTask, key_of
from hybridmap.study.false_loops import Kind
from hybridmap.study.model import SettingConfig, SourceConfig, StudyConfig
from hybridmap.study.sources import KINDS, Source, SourceTask

Group = tuple[str, str, str, float]
"""Source, setting, and kind and rate of false loops."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell: one row of the table.

    Attributes:
        source, setting, backend: titles of source, setting and back-end in the study.
        kind: kind of the added false loops; empty string at rate 0.
        rate: share of false loops among all loops, 0 <= rate < 1.
        seed: seed of everything random; None if nothing in the cell is random.
        start: where the back-end begins (`BackendVariant.begins`).
        source_key: cache key of the clean graph.
        key: cache key of the result; cells whose results are necessarily equal share a key.
    """

    source: str
    setting: str
    kind: str
    rate: float
    seed: int | None
    backend: str
    start: str
    source_key: str
    key: str

    @property
    def label(self) -> str:
        """Name for people without back-end and seed: `source/setting/kind rate %`, without kind and rate at rate 0."""
        return f"{self.source}/{self.setting}" + (f"/{self.kind} {100 * self.rate:g} %" if self.kind else "")

    @property
    def group(self) -> Group:
        """Source, setting, kind and rate. The cells of one group and one back-end differ in the seed alone."""
        return self.source, self.setting, self.kind, self.rate


@dataclass(frozen=True, slots=True)
class Grid:
    """All cells of a study, and the tasks that make their graphs.

    Attributes:
        study: the configuration of the study.
        cells: all cells, in the order of the tables.
        sources: cache key of a clean graph -> the task that makes it, for every graph that a cell needs.
    """

    study: StudyConfig
    cells: tuple[Cell, ...]
    sources: dict[str, SourceTask]

    def groups(self) -> dict[tuple[Group, str], list[Cell]]:
        """(Group, title of the back-end) -> its cells, one per seed or one if nothing is random; in the order of the tables."""
        found: dict[tuple[Group, str], list[Cell]] = {}
        for cell in self.cells:
            found.setdefault((cell.group, cell.backend), []).append(cell)
        return found

    def task(self, cell: Cell, frozen: bytes) -> CellTask:
        """The task that computes a cell; it is not run.

        Args:
            cell: a cell of this grid.
            frozen: its clean graph, as bytes of `Frozen.pack`.
        """
        setting = next(setting for setting in self.study.settings if setting.name == cell.setting)
        variant = next(variant for variant in self.study.backends if variant.title == cell.backend)
        kind: Kind = "aliased" if cell.kind == "aliased" else "random"
        return CellTask(cell.key, frozen, setting.drift, kind, cell.rate, cell.seed or 0, variant)


def lay_out(study: StudyConfig) -> Grid:
    """Make the cells of a study: the product of sources, settings, false loops, seeds and back-ends; back-ends vary fastest.

    Sources and settings vary slowest, and a setting is for the sources that it names. What is not random gets one cell for all
    seeds. Files, sessions and recordings are read, since their content is part of the keys. Nothing is mapped.

    Raises:
        GraphError, StoreError, StreamError: a file or session is missing or damaged.
        ConfigError: the mapping configuration of a drive cannot be used.
    """
    opened = {source.title: KINDS[source.kind](source, study.maps) for source in study.sources}
    cells: list[Cell] = []
    tasks: dict[str, SourceTask] = {}
    for source, setting in product(study.sources, study.settings):
        if setting.sources and source.title not in setting.sources:
            continue
        key_at = cache(partial(_enter, tasks, opened[source.title], setting))
        drawn = opened[source.title].by_chance(setting)
        for kind, rate in _false_loops(study):
            for seed in _seeds(study, source, drawn or rate > 0.0 or setting.drift.by_chance):
                source_key = key_at((seed or 0) if drawn else 0)
                for variant in study.backends:
                    key = key_of(source_key, setting.drift, (kind, rate, seed or 0), variant)
                    cells.append(
                        Cell(source.title, setting.name, kind, rate, seed, variant.title, variant.begins, source_key, key)
                    )
    return Grid(study, tuple(cells), tasks)


def _enter(tasks: dict[str, SourceTask], source: Source, setting: SettingConfig, seed: int) -> str:
    """Register the task of a graph; returns its key."""
    task = source.task(setting, seed)
    tasks[task.key] = task
    return task.key


def _false_loops(study: StudyConfig) -> list[tuple[str, float]]:
    """Kinds and rates; a rate of 0 has no kind and appears once."""
    rates = study.false_loops.rates
    none = [("", 0.0)] if 0.0 in rates else []
    return none + [(kind, rate) for kind in study.false_loops.kinds for rate in rates if rate > 0.0]


def _seeds(study: StudyConfig, source: SourceConfig, by_chance: bool) -> Sequence[int | None]:
    """Every seed if the result is random, else a single None."""
    return (source.seeds or study.seeds) if by_chance else (None,)
