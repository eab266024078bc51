"""Sessions from one map file to another, row by row: what is copied stays as it was, but for the numbers of nodes and edges."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from hybridmap.store.map_store import MapStore
from hybridmap.store.schema import WHOLE


@dataclass(frozen=True, slots=True)
class _Move:
    """A session on its way: its number here and there, its nodes here, and by how much they are moved there."""

    here: int
    there: int
    nodes: range
    by: int


def copy_sessions(source: MapStore, target: MapStore, sessions: Collection[int] | None = None, *, between: bool = True) -> None:
    """Append sessions of a map to another one, with the edges between nodes that are copied.

    Facts and solutions of the map as a whole become those of its session if it has one session only; otherwise they are left
    out. While the target holds one session only, the facts and solutions of that are those of the whole map: it is the map from
    before it was joined to others.

    Args:
        source: the map that is read.
        target: the map that is written.
        sessions: numbers of the sessions, ascending; None: all.
        between: with the edges between these sessions.

    Raises:
        StoreError: a file cannot be read or written.
    """
    moves = _moves(source, target, sessions)
    if moves and moves[0].there == 0:
        for table in ("sessions", "info"):
            target.write(f"DELETE FROM {table}", ())
    elif moves and moves[0].there == 1:
        for table in ("info", "solutions"):
            target.write(f"UPDATE {table} SET session = 0", ())
    alone = len(source.sessions()) == 1
    for move in moves:
        _copy_session(source, target, move, WHOLE if alone else move.here)
    _copy_edges(source, target, moves, between)
    if len(target.sessions()) == 1:
        for table in ("info", "solutions"):
            target.write(f"UPDATE {table} SET session = {WHOLE}", ())
        target.write("UPDATE sessions SET x_m = 0.0, y_m = 0.0, yaw_rad = 0.0", ())
    target.commit()


def _moves(source: MapStore, target: MapStore, sessions: Collection[int] | None) -> list[_Move]:
    found = source.sessions()
    ends = [*(one.first_node for one in found[1:]), int(source.one("SELECT COUNT(*) FROM nodes", ()))]
    nodes = int(target.one("SELECT COUNT(*) FROM nodes", ()))
    there = len(target.sessions()) if nodes else 0
    moves = []
    for one, end in zip(found, ends, strict=True):
        if sessions is None or one.number in sessions:
            moves.append(_Move(one.number, there, range(one.first_node, end), nodes - one.first_node))
            nodes, there = nodes + end - one.first_node, there + 1
    return moves


def _copy_session(source: MapStore, target: MapStore, move: _Move, own: int) -> None:
    """Copy all of a session but its edges; its own facts and solutions stand under the session number `own`."""
    here, there, by, first, stop = (move.here,), (move.there,), move.by, move.nodes.start, move.nodes.stop
    rows = source.each_row("SELECT * FROM sessions WHERE number = ?", here)
    target.write_rows("sessions", ((*there, row[1] + by, *row[2:]) for row in rows))
    for table in ("info", "solutions"):
        rows = source.each_row(f"SELECT * FROM {table} WHERE session = ?", (own,))
        target.write_rows(table, ((*there, *row[1:]) for row in rows))
    rows = source.each_row("SELECT * FROM nodes WHERE number >= ? AND number < ? ORDER BY number", (first, stop))
    target.write_rows("nodes", ((row[0] + by, *row[1:]) for row in rows))
    rows = source.each_row("SELECT * FROM arrays WHERE node >= ? AND node < ? ORDER BY node, part, name", (first, stop))
    target.write_rows("arrays", ((row[0] + by, *row[1:]) for row in rows))
    rows = source.each_row("SELECT * FROM track WHERE session = ?", here)
    target.write_rows("track", ((*there, row[1], row[2] + by, *row[3:]) for row in rows))
    rows = source.each_row("SELECT * FROM anchors WHERE session = ?", here)
    target.write_rows("anchors", ((*there, row[1], row[2] + by, row[3] + by, *row[4:]) for row in rows))
    rows = source.each_row("SELECT * FROM online WHERE session = ?", here)
    target.write_rows("online", ((*there, *row[1:]) for row in rows))


def _copy_edges(source: MapStore, target: MapStore, moves: list[_Move], between: bool) -> None:
    number = {node: node + move.by for move in moves for node in move.nodes}
    session_of = {node: move.here for move in moves for node in move.nodes}
    count = int(target.one("SELECT COUNT(*) FROM edges", ()))
    for row in source.each_row("SELECT * FROM edges ORDER BY number"):
        ends = number.get(row[1]), number.get(row[2])
        if None in ends or not (between or session_of[row[1]] == session_of[row[2]]):
            continue
        since = number.get(row[11], max(node for node in ends if node is not None))
        target.write_rows("edges", [(count, *ends, *row[3:11], since)])
        count += 1
