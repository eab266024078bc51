"""The log of nodes and edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap.errors import GraphError
from hybridmap.geometry import RelativePose
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap, Node

STEP = RelativePose(np.array([1.0, 0.0, 0.0]), 0.01 * np.eye(3))


def map_of(n: int) -> ExperienceMap:
    chain = ExperienceMap()
    for i in range(n):
        chain.add_node(Node(i, np.zeros(3), np.ones(4, np.float32), -1, float(i)), np.array([i, 0.0, 0.0]))
        if i:
            chain.add_edge(Edge(i - 1, i, EdgeKind.ODOMETRY, Status.ACCEPTED, STEP))
    return chain


def became(chain: ExperienceMap, number: int, status: Status) -> None:
    chain.update_edge(number, replace(chain.edge(number), status=status, since_node=-1))


def test_only_accepted_edges_are_in_the_graph():
    chain = map_of(100)
    number = chain.add_edge(Edge(99, 0, EdgeKind.LOOP, Status.PENDING, STEP))
    assert chain.pose_graph().n_edges == 99
    became(chain, number, Status.ACCEPTED)
    graph = chain.pose_graph()
    assert graph.edge_ids[-1] == number
    assert graph.is_loop.sum() == 1
    assert np.allclose(graph.information[-1], 100 * np.eye(3))
    became(chain, number, Status.REJECTED)
    assert chain.pose_graph().n_edges == 99
    assert chain.edge(number).status is Status.RETRACTED  # it was in the graph


def test_an_edge_accepted_late_enters_late():
    chain = map_of(5)
    number = chain.add_edge(Edge(4, 0, EdgeKind.LOOP, Status.PENDING, STEP))
    chain.add_node(Node(5, np.zeros(3), np.ones(4, np.float32), -1, 5.0), np.zeros(3))
    became(chain, number, Status.ACCEPTED)
    assert chain.pose_graph().entry_nodes[-1] == 5


def test_a_frozen_graph_does_not_move_with_the_map():
    chain = map_of(3)
    graph = chain.pose_graph()
    became(chain, 0, Status.REJECTED)
    assert graph.n_edges == 2
    assert chain.pose_graph().n_edges == 1


@pytest.mark.parametrize(("source", "target"), [(0, 7), (-1, 0), (1, 1)])
def test_an_edge_needs_two_nodes(source, target):
    with pytest.raises(GraphError, match="two different nodes"):
        map_of(3).add_edge(Edge(source, target, EdgeKind.LOOP, Status.REJECTED, None))


def test_an_accepted_edge_needs_a_measurement_and_leaves_the_map_whole():
    chain = map_of(3)
    with pytest.raises(GraphError, match="without a measurement"):
        chain.add_edge(Edge(2, 0, EdgeKind.LOOP, Status.ACCEPTED, None))
    assert len(chain.edges) == 2
    number = chain.add_edge(Edge(2, 0, EdgeKind.LOOP, Status.REJECTED, None))
    with pytest.raises(GraphError, match="without a measurement"):
        became(chain, number, Status.ACCEPTED)
    assert chain.edge(number).status is Status.REJECTED


def test_an_edge_is_replaced_only_between_the_same_nodes():
    chain = map_of(3)
    with pytest.raises(GraphError, match="joins 0 -> 1"):
        chain.update_edge(0, Edge(0, 2, EdgeKind.LOOP, Status.REJECTED, None))


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("deltas", np.nan, "NaN"),
        ("information", np.nan, "NaN"),
        ("information", 0.0, "positive definite"),
        ("targets", 99, "does not exist"),
    ],
)
def test_a_malformed_graph_is_refused_with_the_edge(field, value, expected):
    graph = map_of(4).pose_graph()
    getattr(graph, field)[1] = value
    with pytest.raises(GraphError, match=rf"edge 1 .*{expected}"):
        graph.validate()


def test_an_asymmetric_information_is_refused():
    graph = map_of(4).pose_graph()
    graph.information[2, 0, 1] = 5.0
    with pytest.raises(GraphError, match="not symmetric"):
        graph.validate()


def test_edges_that_are_not_accepted_can_be_added_to_the_graph():
    chain = map_of(5)
    refused = chain.add_edge(Edge(4, 0, EdgeKind.LOOP, Status.REJECTED, STEP))
    unmeasured = chain.add_edge(Edge(4, 1, EdgeKind.LOOP, Status.REJECTED))
    graph = chain.pose_graph(also=[refused])
    assert graph.edge_ids.tolist() == [0, 1, 2, 3, refused]
    assert np.allclose(graph.information[-1], 100 * np.eye(3))
    assert chain.pose_graph().n_edges == 4
    with pytest.raises(GraphError, match="4 -> 1 was never measured"):
        chain.pose_graph(also=[unmeasured])
