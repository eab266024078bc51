"""Covariances of a solution, from the Gauss-Newton Hessian of the whole graph with node 0 fixed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from hybridmap.backends.objective import SLACK, residuals
from hybridmap.errors import BackendError
from hybridmap.geometry import Array, adjoint, between, squared_distance
from hybridmap.graph.agreement import chi2_quantile
from hybridmap.graph.pose_graph import PoseGraph

_AT_ONCE = 64  # pairs of nodes, whose columns are dense
_EXPECTED = 0.999  # quantile of the innovation up to which a loop is expected
_SAMPLE = 40  # nodes on which the error of a map is predicted: their covariances are dense


def expected_loops(
    graph: PoseGraph, poses: Array, loops: NDArray[np.int64], variance: float, bound: float | None = None
) -> NDArray[np.bool_]:
    """Test loops against a map made without them: (L,) whether the innovation fits the covariance of loop and map.

    Args:
        graph: edges of the map, and these loops.
        poses: (N, 3) poses of the map, m and rad.
        loops: (L,) indices of the loops among the edges of the graph.
        variance: unit variance of the map; if below 1, the covariances of map and loops are scaled by it.
        bound: largest squared Mahalanobis distance of an innovation that fits; None: that by which loops are refused.

    Raises:
        BackendError: the map is singular without the loops.
    """
    backbone = graph.with_edges(np.setdiff1d(np.arange(graph.n_edges), loops))
    covariance = Covariances(backbone, poses).relative(graph.sources[loops], graph.targets[loops])
    covariance = (covariance + np.linalg.inv(graph.information[loops])) * min(1.0, variance)
    r = residuals(graph.with_edges(loops), poses)
    innovation = squared_distance(r, covariance)
    return np.asarray(innovation <= (SLACK * chi2_quantile(_EXPECTED) if bound is None else bound))


class Covariances:
    """The factorised Hessian of a graph at a solution.

    Covariances are of right perturbations, m and rad, for the information stated by the edges. Multiply them by
    `SolveReport.unit_variance` if that is far from 1.
    """

    def __init__(self, graph: PoseGraph, poses: Array) -> None:
        """Factorise.

        Raises:
            BackendError: the Hessian is singular: a node has no path to node 0.
        """
        self._poses = poses
        try:
            self._factor: Any = splu(
                _hessian(graph, poses), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as error:
            raise BackendError(f"covariance: the graph is singular ({error})") from error

    def marginal(self, node: int) -> Array:
        """Covariance (3, 3) of a node relative to node 0, in the node's own frame; zero for node 0.

        Raises:
            BackendError: there is no such node.
        """
        if not 0 <= node < len(self._poses):
            raise BackendError(f"covariance: there is no node {node}, expected one of 0..{len(self._poses) - 1}")
        return np.asarray(self._projected(np.eye(3)[None], np.array([node]), np.zeros((1, 3, 3)), np.array([0]))[0])

    def relative(self, sources: NDArray[np.int64], targets: NDArray[np.int64]) -> Array:
        """Covariances (L, 3, 3) of the poses of targets (L,) relative to sources (L,), in the targets' frames."""
        carried = -adjoint(between(self._poses[targets], self._poses[sources]))
        out = np.empty((len(sources), 3, 3))
        for first in range(0, len(sources), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            ends = np.broadcast_to(np.eye(3), carried[part].shape)
            out[part] = self._projected(ends, targets[part], carried[part], sources[part])
        return out

    def position_error(self) -> float:
        """RMS error of the positions of the nodes, m, that the covariances predict after the best SE(2) alignment to the truth.

        It is computed on up to `_SAMPLE` nodes, evenly spaced by their numbers.
        """
        size = len(self._poses) - 1
        nodes = np.unique(np.linspace(1, size, min(size, _SAMPLE)).round().astype(np.int64))
        count = len(nodes)
        if count < 2:
            return 0.0
        cos, sin, rows, at = np.cos(self._poses[nodes, 2]), np.sin(self._poses[nodes, 2]), 3 * (nodes - 1), np.arange(count)
        columns = np.zeros((3 * size, 2 * count))  # the map's x and y of each node, as its own x and y
        columns[rows, at], columns[rows + 1, at] = cos, -sin
        columns[rows, count + at], columns[rows + 1, count + at] = sin, cos
        covariance = columns.T @ self.solve(columns)
        x, y = (self._poses[nodes, :2] - self._poses[nodes, :2].mean(axis=0)).T
        one, none = np.ones(count), np.zeros(count)
        modes = np.stack([np.concatenate(mode) for mode in ((one, none), (none, one), (-y, x))], axis=1)
        aligned = np.linalg.qr(modes)[0]  # motions of the whole map, which the alignment takes away
        left = np.trace(covariance) - np.trace(aligned.T @ covariance @ aligned)
        return float(np.sqrt(max(left, 0.0) / count))

    def solve(self, columns: Array) -> Array:
        """Inverse of the Hessian times `columns` (3N - 3, K); the rows are x, y, yaw of each node from node 1 on."""
        return np.asarray(self._factor.solve(columns))

    def _projected(self, at_first: Array, first: NDArray[np.int64], at_second: Array, second: NDArray[np.int64]) -> Array:
        """J H^-1 J' (L, 3, 3) for Jacobians J with one block at each of two nodes."""
        count, size = len(first), 3 * len(self._poses)
        columns = np.zeros((size, 3 * count))
        for block, node in ((at_first, first), (at_second, second)):
            rows = 3 * node[:, None, None] + np.arange(3)[None, :, None]
            column = 3 * np.arange(count)[:, None, None] + np.arange(3)[None, None, :]
            columns[rows, column] += block.transpose(0, 2, 1)
        solved = self._factor.solve(columns[3:]) if size > 3 else columns[3:]
        wide, known = solved.reshape(-1, count, 3), columns[3:].reshape(-1, count, 3)
        covariance = np.einsum("ski,skj->kij", known, wide, optimize=True)
        return np.asarray(0.5 * (covariance + covariance.transpose(0, 2, 1)))


def _hessian(graph: PoseGraph, poses: Array) -> csc_array:
    """(3N - 3, 3N - 3), with the inner Jacobian of the residual approximated by the identity: exact for small residuals."""
    at_source = -adjoint(between(poses[graph.targets], poses[graph.sources]))
    across = at_source.transpose(0, 2, 1) @ graph.information
    blocks = np.stack([across @ at_source, across, across.transpose(0, 2, 1), graph.information])
    s, t, size = graph.sources, graph.targets, 3 * graph.n_nodes - 3
    rows = np.stack([s, s, t, t])[:, :, None, None] * 3 + np.arange(3)[:, None] - 3
    columns = np.stack([s, t, s, t])[:, :, None, None] * 3 + np.arange(3) - 3
    rows, columns = np.broadcast_to(rows, blocks.shape).ravel(), np.broadcast_to(columns, blocks.shape).ravel()
    free = (rows >= 0) & (columns >= 0)
    return csc_array(coo_array((blocks.ravel()[free], (rows[free], columns[free])), shape=(size, size)))
