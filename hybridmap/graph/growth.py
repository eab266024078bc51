"""A graph at two times: as it was when it had fewer nodes, and what is new and what is gone between two states."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph

_Rows = slice | NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Change:
    """Difference of two states of one graph; a measurement that changed counts as removed and added.

    Attributes:
        added: (A,) indices into the new graph's edges.
        removed: (R,) indices into the old graph's edges.
        closes: a loop came, an edge went, or one came between nodes that were there before: solved poses may move. Further
            chain edges of a new node (to the last but one, say) do not count: they wait for the next closure.
    """

    added: NDArray[np.int64]
    removed: NDArray[np.int64]
    closes: bool


def prefix(graph: PoseGraph, nodes: int) -> PoseGraph:
    """The graph as it was when it had `nodes` nodes.

    Chain edges are there as soon as both of their ends are; loops that were committed late come late.
    """
    both = np.maximum(graph.sources, graph.targets)
    entry = np.where(graph.kinds < EdgeKind.LOOP, both, np.maximum(both, graph.entry_nodes))
    return replace(graph.with_edges(entry < nodes), initial=graph.initial[:nodes])


def difference(old: PoseGraph | None, new: PoseGraph) -> Change:
    """What happened between two states of one graph."""
    if old is None:
        return Change(np.arange(new.n_edges), np.arange(0), closes=True)
    head = _common_head(old.edge_ids, new.edge_ids)
    came, went = np.ones(new.n_edges, dtype=bool), np.ones(old.n_edges, dtype=bool)
    came[:head] = went[:head] = ~_unchanged(old, slice(head), new, slice(head))
    if head < old.n_edges:
        i_old, i_new = _pairs(old.edge_ids, new.edge_ids, head)
        came[i_new] = went[i_old] = ~_unchanged(old, i_old, new, i_new)
    added, removed = np.flatnonzero(came), np.flatnonzero(went)
    newest = np.maximum(new.sources[added], new.targets[added])
    closes = bool(len(removed) or np.any(newest < old.n_nodes) or np.any(new.kinds[added] >= EdgeKind.LOOP))
    return Change(added, removed, closes)


def _common_head(old: NDArray[np.int64], new: NDArray[np.int64]) -> int:
    """How many numbers two lists have in common before they first differ."""
    both = min(len(old), len(new))
    differ = old[:both] != new[:both]
    return int(differ.argmax()) if differ.any() else both


def _pairs(old: NDArray[np.int64], new: NDArray[np.int64], head: int) -> tuple[_Rows, _Rows]:
    """Rows of the numbers from `head` on that are in both of two increasing lists."""
    in_old = np.flatnonzero(np.isin(old[head:], new[head:], assume_unique=True))
    in_new = np.flatnonzero(np.isin(new[head:], old[head:], assume_unique=True))
    return _sliced(head + in_old), _sliced(head + in_new)


def _sliced(rows: NDArray[np.int64]) -> _Rows:
    """Increasing row numbers, without gaps as a slice: that takes a view where numbers take a copy."""
    gapless = len(rows) and rows[-1] - rows[0] == len(rows) - 1
    return slice(int(rows[0]), int(rows[-1]) + 1) if gapless else rows


def _unchanged(old: PoseGraph, i_old: _Rows, new: PoseGraph, i_new: _Rows) -> NDArray[np.bool_]:
    """Which of some edges of one graph are the same as those of another: ends, kind and measurement."""
    same = np.asarray(old.kinds[i_old] == new.kinds[i_new])
    for name in ("sources", "targets", "deltas", "information"):
        equal = getattr(old, name)[i_old] == getattr(new, name)[i_new]
        if not equal.all():  # nearly always they are: this is the quick way to see it
            same &= equal.reshape(len(same), -1).all(axis=1)
    return same
