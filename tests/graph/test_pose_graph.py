"""The frozen graph: what is refused at the door."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.errors import GraphError
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.pose_graph import PoseGraph


def pair(information, delta=(1.0, 0.0, 0.1)):
    return PoseGraph(
        initial=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        sources=np.array([0]),
        targets=np.array([1]),
        deltas=np.array([delta], dtype=np.float64),
        information=np.array([information], dtype=np.float64),
        kinds=np.array([EdgeKind.ODOMETRY], dtype=np.int8),
        edge_ids=np.array([7]),
    )


@given(st.integers(0, 10_000), st.floats(-4.0, 4.0), st.booleans())
@settings(max_examples=200, deadline=None)
def test_information_is_taken_exactly_where_its_eigenvalues_are_positive(seed, spread, indefinite):
    rng = np.random.default_rng(seed)
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    eigenvalues = 10.0 ** (spread * rng.uniform(-1.0, 1.0, 3))
    eigenvalues[0] *= -1.0 if indefinite else 1.0
    information = turned @ np.diag(eigenvalues) @ turned.T
    information = 0.5 * (information + information.T)
    if np.linalg.eigvalsh(information)[0] > 0.0:
        pair(information).validate()
    else:
        with pytest.raises(GraphError, match=r"edge 7 \(0 -> 1\) .*not positive definite"):
            pair(information).validate()


def test_one_bad_matrix_among_many_is_named():
    good = pair(np.diag([1.0, 2.0, 3.0]))
    many = replace(good, **{name: np.repeat(getattr(good, name), 50, axis=0) for name in ("sources", "targets", "deltas")})
    information = np.repeat(good.information, 50, axis=0)
    information[31, 0, 1] = information[31, 1, 0] = 1.5  # correlation beyond one
    many = replace(many, information=information, kinds=np.repeat(good.kinds, 50), edge_ids=np.arange(100, 150))
    with pytest.raises(GraphError, match=r"edge 131 .*not positive definite"):
        many.validate()


@pytest.mark.parametrize(
    ("graph", "says"),
    [
        (pair(np.diag([1.0, 1.0, 0.0])), "not positive definite"),
        (pair(np.ones((3, 3))), "not positive definite"),
        (pair([[1.0, 0.1, 0.0], [0.2, 1.0, 0.0], [0.0, 0.0, 1.0]]), "not symmetric"),
        (pair(np.diag([1.0, np.nan, 1.0])), "NaN or Inf"),
        (pair(np.diag([1.0, 1.0, 1e-10])), "outside 1e-09 to 1e\\+15"),
        (pair(np.diag([1e16, 1.0, 1.0])), "outside 1e-09 to 1e\\+15"),
        (pair(np.eye(3), (1e10, 0.0, 0.0)), "beyond 1e\\+09"),
        (pair(np.eye(3), (0.0, np.inf, 0.0)), "NaN, Inf"),
        (replace(pair(np.eye(3)), targets=np.array([2])), "does not exist"),
        (replace(pair(np.eye(3)), sources=np.array([-1])), "does not exist"),
        (replace(pair(np.eye(3)), targets=np.array([0])), "from a node to itself"),
        (replace(pair(np.eye(3)), initial=np.array([[0.0, 0.0, 0.0], [1e10, 0.0, 0.0]])), "node 1 .*beyond 1e\\+09"),
    ],
)
def test_what_no_solver_can_take_is_refused(graph, says):
    with pytest.raises(GraphError, match=says):
        graph.validate()
