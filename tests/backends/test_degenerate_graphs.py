"""Forty degenerate graphs through every back-end: an answer with an honest status, or one typed error; never a traceback."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap import backends
from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.objective import chi2
from hybridmap.errors import BackendError, GraphError
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.io import read_graph
from hybridmap.graph.pose_graph import PoseGraph
from tests.backends.graphs_for_tests import SIGMA, laps, star

ODOMETRY, LOOP = EdgeKind.ODOMETRY, EdgeKind.LOOP
INFORMATION = np.diag(SIGMA**-2.0)


def of(nodes, edges, information=INFORMATION, initial=None):
    """A graph of edges (source, target, kind[, delta]); every delta is one metre ahead unless given."""
    deltas = np.array([list(edge[3]) if len(edge) > 3 else [1.0, 0.0, 0.0] for edge in edges], dtype=float).reshape(-1, 3)
    return PoseGraph(
        initial=np.column_stack([np.arange(nodes), np.zeros((nodes, 2))]) * 1.0 if initial is None else initial,
        sources=np.array([edge[0] for edge in edges], dtype=np.int64),
        targets=np.array([edge[1] for edge in edges], dtype=np.int64),
        deltas=deltas,
        information=np.repeat(np.asarray(information, dtype=float)[None], len(edges), axis=0),
        kinds=np.array([edge[2] for edge in edges], dtype=np.int8),
        edge_ids=np.arange(len(edges)),
    )


def line(nodes, **more):
    return of(nodes, [(k, k + 1, ODOMETRY) for k in range(nodes - 1)], **more)


def loopy():
    return laps(np.random.default_rng(0), nodes=45, per_lap=15)[0]


def informed(factor):
    graph = loopy()
    return replace(graph, information=graph.information * factor)


def one(field, value, edge=3):
    """The laps with one number of one edge changed."""
    graph = loopy()
    numbers = getattr(graph, field).copy()
    numbers[edge] = value
    return replace(graph, **{field: numbers})


def shifted(by):
    graph = loopy()
    return replace(graph, initial=graph.initial + np.array([by, by, 0.0]))


def mixed():
    """The laps with nodes and edges in a random order."""
    graph, rng = loopy(), np.random.default_rng(1)
    number, order = rng.permutation(graph.n_nodes), rng.permutation(graph.n_edges)
    initial = np.empty_like(graph.initial)
    initial[number] = graph.initial
    other = replace(graph, initial=initial, sources=number[graph.sources], targets=number[graph.targets])
    return replace(other.with_edges(order), edge_ids=np.arange(graph.n_edges))


def two_pieces(joins):
    """Two chains of ten nodes, joined by this many loops that are no neighbours."""
    chains = [(k, k + 1, ODOMETRY) for k in range(19) if k != 9]
    return of(20, [*chains, *((k, 19 - k, LOOP, (19 - 2 * k, 0, 0)) for k in range(0, 10, 9)[:joins])])


def thin():
    """Information of condition 1e12: nearly singular."""
    turn = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, np.sqrt(2.0)]]) / np.sqrt(2.0)
    return turn @ np.diag([1e6, 1e-6, 1e4]) @ turn.T


CASES = {
    "one node": lambda: of(1, []),
    "no node": lambda: of(0, []),
    "two nodes, no edge": lambda: of(2, []),
    "two nodes": lambda: line(2),
    "two nodes, a loop only": lambda: of(2, [(0, 1, LOOP)]),
    "two nodes, backwards": lambda: of(2, [(1, 0, ODOMETRY)]),
    "parallel edges": lambda: of(2, [(0, 1, ODOMETRY)] * 3),
    "parallel edges that contradict": lambda: of(2, [(0, 1, ODOMETRY), (0, 1, LOOP, (-5, 3, 2))]),
    "an edge and its inverse": lambda: of(2, [(0, 1, ODOMETRY), (1, 0, LOOP, (-1, 0, 0))]),
    "zero length": lambda: of(4, [(k, k + 1, ODOMETRY, (0, 0, 0)) for k in range(3)] + [(3, 0, LOOP, (0, 0, 0))]),
    "turns of pi": lambda: of(4, [(k, k + 1, ODOMETRY, (0, 0, np.pi)) for k in range(3)] + [(3, 0, LOOP, (0, 0, np.pi))]),
    "turns beyond pi": lambda: of(4, [(k, k + 1, ODOMETRY, (1, 0, 20.0)) for k in range(3)] + [(3, 0, LOOP, (0, 0, -60))]),
    "line": lambda: line(60),
    "star": lambda: star(12),
    "star without loops": lambda: of(9, [(0, k, ODOMETRY) for k in range(1, 9)]),
    "star of loops": lambda: of(9, [(0, k, LOOP) for k in range(1, 9)]),
    "star into the last node": lambda: of(9, [(k, 8, ODOMETRY) for k in range(8)]),
    "all nodes joined": lambda: of(6, [(s, t, LOOP, (t - s, 0, 0)) for s in range(6) for t in range(s + 1, 6)]),
    "ring": lambda: of(5, [(k, (k + 1) % 5, ODOMETRY, (1, 0, 2 * np.pi / 5)) for k in range(5)]),
    "loops only": lambda: replace(loopy(), kinds=np.full(loopy().n_edges, LOOP, dtype=np.int8)),
    "manual edges only": lambda: replace(loopy(), kinds=np.full(loopy().n_edges, EdgeKind.MANUAL, dtype=np.int8)),
    "random order": mixed,
    "random order, no kind": lambda: replace(mixed(), kinds=np.full(loopy().n_edges, LOOP, dtype=np.int8)),
    "two pieces, one loop": lambda: two_pieces(1),
    "two pieces, two lone loops": lambda: two_pieces(2),
    "two pieces": lambda: two_pieces(0),
    "from a node to itself": lambda: one("targets", 3, edge=3),
    "an unknown node": lambda: one("targets", 99),
    "a negative node": lambda: one("sources", -1),
    "nan": lambda: one("deltas", np.nan),
    "infinite": lambda: one("deltas", np.inf),
    "nan information": lambda: one("information", np.nan),
    "no information": lambda: one("information", 0.0),
    "not symmetric": lambda: one("information", np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])),
    "not positive": lambda: one("information", np.diag([1.0, -1.0, 1.0])),
    "nearly singular": lambda: one("information", thin()),
    "all nearly singular": lambda: replace(loopy(), information=np.repeat(thin()[None], loopy().n_edges, axis=0)),
    "huge information": lambda: informed(1e8),
    "small information": lambda: informed(1e-12),
    "one tight edge": lambda: one("information", np.diag([1e14, 1e14, 1e14])),
    "far away": lambda: shifted(1e6),
    "far beyond": lambda: shifted(1e12),
    "a loop of a million metres": lambda: one("deltas", [1e6, 0.0, 0.0], edge=loopy().n_edges - 1),
}


@pytest.mark.parametrize("name", backends.names())
@pytest.mark.parametrize("case", CASES)
def test_every_back_end_has_an_answer_or_one_typed_error(case, name):
    graph = CASES[case]()
    solution = solved_or_told(graph, name)
    if isinstance(solution, Solution):
        check(graph, solution)
    else:
        assert "\n" not in solution


def solved_or_told(graph: PoseGraph, name: str) -> Solution | str:
    """The solution, or the words of the typed error."""
    try:
        return backends.create(name).solve(graph)
    except (GraphError, BackendError) as error:
        return str(error)


def check(graph: PoseGraph, solution: Solution) -> None:
    """The solution has a finite pose for every node, keeps node 0, and its report tells of these poses."""
    report = solution.report
    assert report.status in tuple(SolveStatus)
    assert solution.poses.shape == graph.initial.shape
    assert np.isfinite(solution.poses).all()
    assert np.array_equal(solution.poses[0], graph.initial[0])
    assert report.chi2 == pytest.approx(chi2(graph, solution.poses), rel=1e-5, abs=1e-5)


CONNECTED = [
    case for case in CASES if case.startswith(("two nodes", "star", "random", "two pieces, ")) and "no edge" not in case
]


@pytest.mark.parametrize("case", CONNECTED)
def test_a_connected_graph_is_never_refused(case):
    graph = CASES[case]()
    for name in backends.names():
        check(graph, backends.create(name).solve(graph))


DAMAGED = {
    "a vertex twice": "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n",
    "no edge": "VERTEX_SE2 0 0 0 0\n",
    "an edge to itself": "EDGE_SE2 0 0 1 0 0 1 0 0 1 0 1\n",
    "not a number": "EDGE_SE2 0 1 nan 0 0 1 0 0 1 0 1\n",
    "two parts": "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 7 8 1 0 0 1 0 0 1 0 1\n",
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_one_typed_error(case, tmp_path):
    path = tmp_path / "damaged.g2o"
    path.write_text(DAMAGED[case])
    with pytest.raises(GraphError, match=r"damaged\.g2o"):
        read_graph(path).validate()
