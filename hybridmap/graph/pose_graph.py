"""The pose graph as growing columns, and the difference of two states of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.errors import GraphError
from hybridmap.geometry import Array
from hybridmap.graph.edges import EdgeKind

_FARTHEST = 1e9  # m and rad: beyond it metres have no millionths left
_LOOSEST, _TIGHTEST = 1e-9, 1e15  # information of standard deviations of some 30 km and 30 nm: beyond, solvers stand still
_UPPER, _LOWER = ([0, 0, 1], [1, 2, 2]), ([1, 2, 2], [0, 0, 1])
_CLEAR = 1e-6  # determinant of correlations from which rounding cannot make it positive


@dataclass(frozen=True, slots=True)
class GraphFile:
    """The file that a graph was read from, so that error messages can name its lines.

    Attributes:
        path: path of the file.
        vertices: (N,) int64, number in the file of each node, in the order of the graph's nodes.
        lines: (E,) int64, line number of each edge, indexed by its `edge_ids`; edges added later have none.
        held: index of the node that the file fixes; None if it fixes none (then node 0 is fixed).
    """

    path: Path
    vertices: NDArray[np.int64]
    lines: NDArray[np.int64]
    held: int | None = None


@dataclass(frozen=True, slots=True)
class PoseGraph:
    """Nodes and accepted edges, as arrays.

    Attributes:
        initial: (N, 3) initial pose of each node, by odometry or from the file, m and rad.
        sources, targets: (E,) int64 node indices.
        deltas: (E, 3) measured pose of the target in the frame of the source, m and rad.
        information: (E, 3, 3) inverse covariance in the frame of the target (right perturbation), x, y, yaw.
        kinds: (E,) int8, `EdgeKind`.
        edge_ids: (E,) int64, number of each edge in the map; strictly increasing.
        entered: (E,) int64, newest node when the edge entered the graph; None: each edge entered with the newer of its nodes.
        file: the file that the graph was read from; None if it was not.
    """

    initial: Array
    sources: NDArray[np.int64]
    targets: NDArray[np.int64]
    deltas: Array
    information: Array
    kinds: NDArray[np.int8]
    edge_ids: NDArray[np.int64]
    entered: NDArray[np.int64] | None = None
    file: GraphFile | None = None

    @property
    def entry_nodes(self) -> NDArray[np.int64]:
        """(E,) the newest node at the time when each edge entered the graph; if unknown (a file), the edge's newer node."""
        return np.maximum(self.sources, self.targets) if self.entered is None else self.entered

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.initial)

    @property
    def n_edges(self) -> int:
        """Number of edges."""
        return len(self.sources)

    @property
    def is_loop(self) -> NDArray[np.bool_]:
        """(E,) which edges are loop closures."""
        return np.asarray(self.kinds == EdgeKind.LOOP)

    @property
    def is_motion(self) -> NDArray[np.bool_]:
        """(E,) which edges measure motion: odometry and registrations to the nodes just before; also over a kidnapping."""
        return np.asarray(self.kinds < EdgeKind.LOOP)

    def only(self, *kinds: EdgeKind) -> PoseGraph:
        """The same nodes with only the edges of the given kinds."""
        return self.with_edges(np.isin(self.kinds, kinds))

    def with_edges(self, kept: NDArray[np.int64] | NDArray[np.bool_]) -> PoseGraph:
        """The same nodes with only the edges of a mask (E,) or of increasing indices; they keep their `edge_ids`."""
        return PoseGraph(
            self.initial,
            self.sources[kept],
            self.targets[kept],
            self.deltas[kept],
            self.information[kept],
            self.kinds[kept],
            self.edge_ids[kept],
            None if self.entered is None else self.entered[kept],
            self.file,
        )

    def node_name(self, node: int) -> str:
        """Name of a node for error messages: "vertex" with its number in the file, or "node" with its index."""
        return f"node {node}" if self.file is None else f"vertex {self.file.vertices[node]}"

    @property
    def where(self) -> str:
        """Beginning of error messages about the graph: the path of its file, or "graph"."""
        return "graph" if self.file is None else str(self.file.path)

    def edge_name(self, edge: int) -> str:
        """Name of an edge (given by index) for error messages: its line and vertices in the file, or its number and nodes."""
        name, source, target = int(self.edge_ids[edge]), int(self.sources[edge]), int(self.targets[edge])
        if self.file is None or name >= len(self.file.lines):
            return f"{self.where}: edge {name} ({source} -> {target})"
        vertices = self.file.vertices
        return f"{self.file.path}:{self.file.lines[name]}: edge {vertices[source]} -> {vertices[target]}"

    def validate(self) -> None:
        """Refuse a graph with invalid numbers. Whether it is connected is not checked: see `paths.require_connected`.

        Raises:
            GraphError: NaN, unknown node, edge from a node to itself, information not symmetric positive definite, no node,
                numbers whose squares overflow or underflow. The message names the edge, what was found and what was expected.
        """
        if not self._plainly_sound():
            self._judge()

    def _plainly_sound(self) -> bool:
        """A quick test for each update: true for valid edges, if their information is exactly symmetric."""
        if self.n_nodes == 0 or self.n_edges == 0:
            return False
        flat = self.information.reshape(-1, 9)
        own, upper, lower = flat[:, ::4], flat[:, [1, 2, 5]], flat[:, [3, 6, 7]]
        ends = np.stack([self.sources, self.targets])
        if not (own.min() >= _LOOSEST and np.abs(flat).max() <= _TIGHTEST and (upper == lower).all()):
            return False
        if not (ends.min() >= 0 and ends.max() < self.n_nodes and (ends[0] != ends[1]).all()):
            return False
        if not (np.abs(self.deltas).max() <= _FARTHEST and np.abs(self.initial).max() <= _FARTHEST):
            return False
        return bool(_positive_definite(self.information).all())

    def _judge(self) -> None:
        if self.n_nodes == 0:
            raise GraphError("graph: holds no node, expected at least one")
        near = (np.abs(self.initial) <= _FARTHEST).all(axis=1)  # which NaN is not
        if not near.all():
            node = int(np.flatnonzero(~near)[0])
            raise GraphError(f"{self.where}: {self.node_name(node)} has a pose with NaN, Inf or a number beyond {_FARTHEST:g}")
        lowest, highest = np.minimum(self.sources, self.targets), np.maximum(self.sources, self.targets)
        self._refuse((lowest < 0) | (highest >= self.n_nodes), "names a node that does not exist")
        self._refuse(self.sources == self.targets, "leads from a node to itself")
        near = (np.abs(self.deltas) <= _FARTHEST).all(axis=1)
        self._refuse(~near, f"has a measurement with NaN, Inf or a number beyond {_FARTHEST:g}")
        self._refuse(~np.isfinite(self.information).all(axis=(1, 2)), "has an information matrix with NaN or Inf")
        upper, lower = self.information[:, *_UPPER], self.information[:, *_LOWER]
        scale = np.abs(self.information).reshape(self.n_edges, 9).max(axis=1)
        self._refuse(
            (np.abs(upper - lower) > 1e-9 * scale[:, None]).any(axis=1), "has an information matrix that is not symmetric"
        )
        self._refuse(~_positive_definite(self.information), "has an information matrix that is not positive definite")
        own = self.information[:, [0, 1, 2], [0, 1, 2]]
        extreme = ((own < _LOOSEST) | (own > _TIGHTEST)).any(axis=1)
        self._refuse(extreme, f"has information outside {_LOOSEST:g} to {_TIGHTEST:g} (1/m^2, 1/rad^2): in which unit is it?")

    def _refuse(self, bad: ArrayLike, what: str) -> None:
        if np.any(bad):
            raise GraphError(f"{self.edge_name(int(np.flatnonzero(bad)[0]))} {what}")


def _positive_definite(matrices: Array) -> NDArray[np.bool_]:
    """Which (E,) of finite symmetric matrices (E, 3, 3) are positive definite.

    Eigenvalues are taken of those only in whose correlations the determinant is not clearly positive.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        scale = np.sqrt(matrices[:, [0, 1, 2], [0, 1, 2]])
        xy, xt, yt = (matrices[:, *_UPPER] / (scale[:, _UPPER[0]] * scale[:, _UPPER[1]])).T
        clear = (1.0 - xy**2 > _CLEAR) & (1.0 + 2.0 * xy * xt * yt - xy**2 - xt**2 - yt**2 > _CLEAR)
    positive = np.asarray(clear)
    unclear = np.flatnonzero(~clear)
    if len(unclear):
        positive[unclear] = np.linalg.eigvalsh(matrices[unclear])[:, 0] > 0.0
    return positive


_Rows = slice | NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Change:
    """Difference of two states of one graph; an edge whose measurement changed counts as removed and added.

    Attributes:
        added: (A,) indices into the new graph's edges.
        removed: (R,) indices into the old graph's edges.
        closes: whether poses that were solved before may move: a loop was added, an edge was removed, or an edge between old
            nodes was added. Further registrations of a new node do not count.
    """

    added: NDArray[np.int64]
    removed: NDArray[np.int64]
    closes: bool


def prefix(graph: PoseGraph, nodes: int) -> PoseGraph:
    """The graph as it was when it had its first `nodes` nodes.

    An edge of motion is in it as soon as both of its nodes are; a loop that was accepted later is not in it. Edges have their
    present measurements, and those removed since are missing.
    """
    both = np.maximum(graph.sources, graph.targets)
    entry = np.where(graph.kinds < EdgeKind.LOOP, both, np.maximum(both, graph.entry_nodes))
    return replace(graph.with_edges(entry < nodes), initial=graph.initial[:nodes])


def difference(old: PoseGraph | None, new: PoseGraph) -> Change:
    """Which edges were added and removed between two states of one graph, whose nodes keep their numbers.

    With `old` None every edge is added, and `closes` is true.
    """
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
    """Length of the common beginning of two lists."""
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
