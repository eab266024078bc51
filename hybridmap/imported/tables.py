"""Experience maps as tables: `NAME_nodes.csv` (id,x,y,th,vt_id) and `NAME_links.csv` (from,to,d,heading,facing,dt)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from hybridmap.errors import StreamError, quoted
from hybridmap.geometry import Array
from hybridmap.imported.recorded import Link, RecordedMap, from_links

_COLUMNS = {"nodes": ("id", "x", "y", "th", "vt_id"), "links": ("from", "to", "d", "heading", "facing", "dt")}


def read_tables(path: Path) -> RecordedMap:
    """Read a map from its two tables; `path` is either of them.

    Raises:
        StreamError: a table is missing or damaged, or experiences are not numbered from 0 without gaps.
        GraphError: the links are no map; see `recorded.made_by`.
    """
    name = path.name.removesuffix("_nodes.csv").removesuffix("_links.csv")
    if name == path.name:
        raise StreamError(f"{path}: expected a table named NAME_nodes.csv or NAME_links.csv")
    nodes, links = (_numbers(path.with_name(f"{name}_{what}.csv"), _COLUMNS[what]) for what in ("nodes", "links"))
    where = str(path.with_name(name))
    if (nodes[:, 0] != np.arange(len(nodes))).any():
        raise StreamError(f"{where}_nodes.csv: expected the ids 0 to {len(nodes) - 1} in order, one a line")
    return from_links(name, where, nodes[:, 1:4], nodes[:, 4].astype(np.int64), [_link(row) for row in links])


def _link(row: Array) -> Link:
    source, target, distance, heading, facing, duration = row.tolist()
    delta = np.array([distance * np.cos(heading), distance * np.sin(heading), facing])
    return Link(int(source), int(target), delta, abs(distance), abs(facing), duration)


def _numbers(path: Path, columns: tuple[str, ...]) -> Array:
    """The rows (R, C) of a table of finite numbers."""
    if not path.is_file():
        raise StreamError(f"{path}: no such file; a map has both NAME_nodes.csv and NAME_links.csv")
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        lines = [line for line in csv.reader(file) if line]
    if not lines or tuple(lines[0]) != columns:
        raise StreamError(
            f"{path}: expected the header {','.join(columns)}, found {quoted(','.join(lines[0] if lines else ()))}"
        )
    rows = np.zeros((len(lines) - 1, len(columns)))
    for number, line in enumerate(lines[1:]):
        try:
            rows[number] = [float(field) for field in line]
        except ValueError:
            rows[number] = np.nan
        if len(line) != len(columns) or not (np.abs(rows[number]) <= 1e9).all():
            raise StreamError(f"{path}:{number + 2}: expected the numbers {','.join(columns)}, found {quoted(','.join(line))}")
    return rows
