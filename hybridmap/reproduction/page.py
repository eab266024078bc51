"""The output of a reproduction: one self-contained page, the tables on it as CSV, and `metrics.json`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hybridmap.config import Config
from hybridmap.metrics import to_json
from hybridmap.output import Held, Kind, holds_only, write_text
from hybridmap.report.page_tables import interval, number, rendered, unit
from hybridmap.report.study_page import write_study_page
from hybridmap.reproduction import figures, paper
from hybridmap.reproduction.cells import CELLS, ENDS, PAPER_NETWORK_M, PAPER_ODOMETRY_M
from hybridmap.reproduction.equations import equations
from hybridmap.reproduction.facts import Facts, facts_of
from hybridmap.reproduction.paper import Item, Parameter, Status
from hybridmap.reproduction.reproduction import STUDY, Reproduction
from hybridmap.reproduction.systems import BASELINES, SYSTEMS, SystemResult
from hybridmap.study.frozen import Frozen
from hybridmap.study.statistics import LEAST, Interval
from hybridmap.study.tables import csv_text
from hybridmap.verdict import Verdict

PAGE, METRICS = "report.html", "metrics.json"
TABLES = ("results.csv", "cells.csv", "parameters.csv", "equations.csv", "parts.csv", "systems.csv", "verification.csv")
"""The tables of the page."""

_FILES = (PAGE, METRICS, *TABLES, CELLS, ENDS, STUDY)
REPRODUCTION = Kind("reproduction", _FILES, lambda folder: holds_only(folder, _FILES), continued=True)

SECTIONS = {
    "results": "What the paper reports, and what came out",
    "types": "Table 1: the cells",
    "parameters": "Table 2: the parameters",
    "cells": "Maps of the cells",
    "distance": "240 m of path integration",
    "places": "Place fields, and what competition does for them",
    "lab": "The laboratory",
    "office": "The office, against RatSLAM",
    "corridors": "The corridor, against a conventional SLAM",
    "path": "16.8 m by path integration alone",
    "systems": "All systems side by side",
    "equations": "The equations",
    "parts": "Done, done differently, missing",
}
"""Anchor of each section of the page -> its title."""

_CONFIGS = ("paper", "bionic", "rgbd", "laser")
_STYLES = {Status.DONE: "kept", Status.DIFFERENT: "changed", Status.MISSING: "missed"}

SYSTEM_COLUMNS = (
    *("world", "system", "error of the map (m)", "of its odometry (m)", "ratio", "loops", "right (%)", "revisits closed (%)"),
    *("verdict", "compared with", "difference (m)", "lower in (%)", "p", "CPU (s)"),
)
"""Columns of the table of systems."""
_SYSTEM_NUMBERS = (
    *("world", "system", "drives", "without_map", "baseline", "error_m", "error_low_m", "error_high_m"),
    *("odometry_m", "odometry_low_m", "odometry_high_m", "ratio", "ratio_low", "ratio_high"),
    *("loops", "loops_right", "revisits_closed", *Verdict, "cpu_s"),
    *("difference_m", "difference_low_m", "difference_high_m", "share_lower", "p_holm"),
)


def write_reproduction(place: Held, done: Reproduction) -> Path:
    """Write the page, its tables, `metrics.json`, and the page of the study of the drives. Returns the path of the page.

    Raises:
        OutputError: they cannot be written.
    """
    facts = facts_of(done.cells.rows, done.results, done.ends)
    write_study_page(done.study)
    for name, text in _tables(done, facts).items():
        write_text(place.path / name, text)
    write_text(place.path / METRICS, to_json(done.head, done.metrics) + "\n")
    write_text(place.path / PAGE, _render(done, facts))
    return place.path / PAGE


def _render(done: Reproduction, facts: Facts) -> str:
    seed = done.study.grid.study.seeds[0]
    worlds = {world: _drives(done, world, seed) for world in BASELINES}
    states = [one.status for one in (*paper.RESULTS, *paper.PARTS)] + [one.status for one in equations()]
    return rendered(
        "reproduce.html.j2",
        head=done.head,
        version=version("hybridmap"),
        sections=SECTIONS,
        numbers={anchor: position for position, anchor in enumerate(SECTIONS, start=1)},
        counts={status: states.count(status) for status in Status},
        styles=_STYLES,
        results=paper.RESULTS,
        parts=paper.PARTS,
        equations=equations(),
        cell_types=paper.CELL_TYPES,
        tables=[("The paper's Table 2", paper.PARAMETERS), ("What the paper gives no number for", paper.OPEN_PARAMETERS)],
        configs=_CONFIGS,
        value=_value,
        fill=facts.fill,
        facts=facts,
        cells=done.cells.figures,
        recurrence=done.cells.recurrence,
        rows=[(row.name.removeprefix("verify/"), number(row.value), unit(row), row) for row in done.cells.rows],
        systems=_systems(done),
        columns=SYSTEM_COLUMNS,
        lines={world: [system_cells(one) for one in done.results if one.world == world] for world in BASELINES},
        maps={world: figures.maps_figure(world, drives) for world, drives in worlds.items()},
        realigned=figures.realignment_figure("lab", worlds["lab"]["bionic"], "bionic") if "bionic" in worlds["lab"] else "",
        errors=figures.errors_figure(done.results),
        ends=figures.ends_figure(done.ends),
        by_seed=[(seed, *(f"({x:.2f}, {y:.2f})" for x, y in (end.odometry, end.network))) for seed, end in done.ends.items()],
        paper_network=PAPER_NETWORK_M,
        paper_odometry=PAPER_ODOMETRY_M,
        seed=seed,
        least=LEAST,
        tables_written=TABLES,
        study=STUDY,
    )


def _drives(done: Reproduction, world: str, seed: int) -> dict[str, Frozen]:
    """System -> its drive through a world with this seed, for the drives that were mapped."""
    found = {}
    for source in done.study.grid.study.sources:
        keys = [cell.source_key for cell in done.study.grid.cells if (cell.source, cell.seed) == (source.title, seed)]
        packed = done.study.folder.frozen(keys[0]) if source.simulated == world else None
        if packed is not None:
            found[source.config or ""] = Frozen.unpack(packed)
    return found


def _systems(done: Reproduction) -> list[tuple[str, str, str, str]]:
    """Name, what it is, its sensor and its primary back-end, for each system that was run."""
    run = dict.fromkeys(one.system for one in done.results)
    settings = {name: Config.load(name) for name in run}
    return [(name, SYSTEMS[name], one.vision.sensor, one.backends.names[0]) for name, one in settings.items()]


def system_cells(one: SystemResult) -> list[str]:
    """A line of the table of systems, a text for each of `SYSTEM_COLUMNS`."""
    paired = one.paired
    compared = ["", "", "", ""]
    error = _median(one.error_m) + (f" ({one.without_map})" if one.lost else "")
    if paired is not None:
        p = "" if math.isnan(paired.p) else f"{paired.p:.2g}"
        compared = [paired.baseline, _median(paired.difference_m), _percent(paired.lower), p]
    return [
        *(one.world, one.system, error, _alone(one.odometry_m), _alone(one.ratio)),
        *(_whole(one.loops), _percent(one.right), _percent(one.recall)),
        ", ".join(f"{count} {verdict}" for verdict, count in one.verdicts.items()),
        *compared,
        "–" if math.isnan(one.cpu_s) else f"{one.cpu_s:.3g}",
    ]


def _system_numbers(one: SystemResult) -> list[Any]:
    """A line of `systems.csv`, a value for each of `_SYSTEM_NUMBERS`; empty where it is not known."""
    medians = (one.error_m, one.odometry_m, one.ratio)
    numbers = [figure for found in medians for figure in (found.value, found.low, found.high)]
    numbers += [one.loops, one.right, one.recall, *(one.verdicts.get(name, 0) for name in Verdict), one.cpu_s]
    paired = one.paired
    apart = [math.nan] * 5
    if paired is not None:
        apart = [paired.difference_m.value, paired.difference_m.low, paired.difference_m.high, paired.lower, paired.p]
    named = [one.world, one.system, one.drives, len(one.lost), "" if paired is None else paired.baseline]
    return [*named, *("" if math.isnan(value) else value for value in (*numbers, *apart))]


def _median(found: Interval) -> str:
    """A median, with its interval if there is one."""
    return interval(found) if found.known else _alone(found)


def _alone(found: Interval) -> str:
    """A median without its interval; a dash if there is none."""
    return f"{found.value:.3g}" if found.count else "–"


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100.0 * share:.0f}"


def _whole(count: float) -> str:
    return "–" if math.isnan(count) else f"{count:.0f}"


@cache
def _settings(config: str) -> dict[str, Any]:
    return Config.load(config).model_dump(mode="json")


def _value(parameter: Parameter, config: str) -> str:
    """The value of a parameter in a configuration, as text."""
    return parameter.between.join(_text(key, config, parameter.unset) for key in parameter.keys)


def _text(key: str, config: str, unset: str) -> str:
    value: Any = _settings(config)
    for part in key.split("."):
        value = value[part]
    if value is None:
        return unset
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)


def _tables(done: Reproduction, facts: Facts) -> dict[str, str]:
    """Name of each file of `TABLES` -> its text."""
    items = ("what", "paper", "here", "status", "why", "section")
    parameters = [(one.name, one.paper, *(_value(one, config) for config in _CONFIGS)) for one in _parameters()]
    verified = [(row.name, row.value, row.unit, row.description, row.bar, row.passed) for row in done.cells.rows]
    texts = (
        csv_text(items, [_line(item, facts) for item in paper.RESULTS]),
        csv_text(
            ("cells", "region", "firing", "code", "measured"),
            [(one.cells, one.region, one.firing, one.here, facts.fill(one.measured)) for one in paper.CELL_TYPES],
        ),
        csv_text(("parameter", "paper", *(f"configuration {name}" for name in _CONFIGS)), parameters),
        csv_text(
            ("number", "equation", "code", "here", "status", "why"),
            [(one.number, one.equation, one.where, one.here, one.status, one.why) for one in equations()],
        ),
        csv_text(items, [_line(item, facts) for item in paper.PARTS]),
        csv_text(_SYSTEM_NUMBERS, [_system_numbers(one) for one in done.results]),
        csv_text(("row", "value", "unit", "description", "bar", "passed"), verified),
    )
    return dict(zip(TABLES, texts, strict=True))


def _parameters() -> Sequence[Parameter]:
    return (*paper.PARAMETERS, *paper.OPEN_PARAMETERS)


def _line(item: Item, facts: Facts) -> tuple[str, ...]:
    return item.what, item.paper, facts.fill(item.ours), item.status, item.why, SECTIONS[item.shown] if item.shown else ""
