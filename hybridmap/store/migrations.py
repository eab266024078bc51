"""Map files of earlier versions: each version is made from the one before by queries, so that every old file reads as new.

The file itself is not changed. What writes a map (`edit`, `merge`, `map --onto`) reads all of it so, and writes a new file of
the newest version, which takes the place of the old one at the end.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping

STEPS: dict[int, Mapping[str, str]] = {
    1: {
        "anchors": """
            SELECT 0 AS stamp_ns, 0 AS node, 0 AS next_node, 0.0 AS x_m, 0.0 AS y_m, 0.0 AS yaw_rad,
                0.0 AS next_x_m, 0.0 AS next_y_m, 0.0 AS next_yaw_rad WHERE 0"""
    },
    2: {
        "edges": """
            SELECT number, source, target, kind, status, reason, x_m, y_m, yaw_rad, covariance,
                record_of_scores(scores, reason) AS record, since_node FROM {edges}"""
    },
    3: {
        "sessions": """
            SELECT 0 AS number, 0 AS first_node, json_extract(value, '$') AS name, json_extract(value, '$') AS source,
                0.0 AS x_m, 0.0 AS y_m, 0.0 AS yaw_rad FROM {info} WHERE key = 'source'""",
        "info": "SELECT -1 AS session, * FROM {info}",
        "track": "SELECT 0 AS session, * FROM {track}",
        "anchors": "SELECT 0 AS session, * FROM {anchors}",
        "online": "SELECT 0 AS session, * FROM {online}",
        "solutions": "SELECT -1 AS session, * FROM {solutions}",
    },
}
"""Version -> table -> query that makes the table of the next version from those of this one, for the tables that changed.

Version 1 had no anchors. Before version 3 an edge had figures (`scores`) and a reason in words, but no record of its checks.
Before version 4 a map was one session, and what makes it possible to take it up again was not kept.
"""

NEWEST = max(STEPS) + 1
"""The version that is written."""


def see_as_newest(connection: sqlite3.Connection, version: int) -> None:
    """Let the queries of a connection find the tables of a map file of an earlier version as the newest version has them."""
    connection.create_function("record_of_scores", 2, _record_of_scores, deterministic=True)
    names: dict[str, str] = {}
    for step in range(version, NEWEST):
        before = {table: names.get(table, f"main.{table}") for table in _TABLES}
        for table, query in STEPS[step].items():
            names[table] = f"temp.{table}_{step + 1}"
            connection.execute(f"CREATE TEMP VIEW {table}_{step + 1} AS {query.format_map(before)}")
    for table, name in names.items():
        connection.execute(f"CREATE TEMP VIEW {table} AS SELECT * FROM {name}")


_TABLES = ("info", "nodes", "arrays", "edges", "track", "anchors", "online", "solutions", "sessions")


def _record_of_scores(scores: str, reason: str) -> str:
    """The record of an edge of a version before 3."""
    figures = json.loads(scores)
    carried_m = figures.pop("carried_m", None)
    return json.dumps({"figures": figures, "carried_m": carried_m, "note": reason})
